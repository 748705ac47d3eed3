"""Do the batched engine and Stable-Baselines3 learn alike? The same cells with many seeds of both, and two tests.

    python benchmarks/agreement.py --out build/agreement --pilot     # how many runs each setting needs
    python benchmarks/agreement.py --out build/agreement [--workers 2]
    python benchmarks/agreement.py --out build/agreement --report    # the table of what is finished

Trains every cell (instance, chance, observation, agent) with both engines: two studies, in OUT/sb3 and OUT/batched. It
may be interrupted at any time; the same command goes on from there. What is compared is the normalised cumulative
regret of runs. For each cell:

    equivalence    two one-sided Welch tests that the means differ by less than MARGIN; p_tost is the larger p
    distribution   Kolmogorov-Smirnov's two-sample test; p_ks_holm is corrected over the cells by Holm's method

How many runs: if the means are equal and runs deviate by s, n of Stable-Baselines3 and 2 n of the batched engine show
it with the chance POWER where n = (z(0.95) + z((1 + POWER) / 2))^2 * 1.5 * s^2 / MARGIN^2. The pilot trains 32 runs of
the batched engine alone for each candidate (more where 32 had missed rare runs), so that a setting is chosen before any
difference is seen; RESERVE is for the error of its deviations. Runs of the comparison have other seeds than the pilot.

Writes docs/agreement.csv, and prints the table.

Cost, one worker on a busy machine: the pilots half an hour, the batched runs 15, those of Stable-Baselines3 1.7 hours.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from pharos import study
from pharos.statistics import holm

MARGIN, POWER, RESERVE = 0.03, 0.8, 1.2
PILOT = 32
CELL = ["environment", "instance", "chance", "observation", "agent"]
LAKE = {"name": "frozen_lake", "parameters": {"map": "SFF/FFH/FFG"}}
GRID = {"name": "simple_grid", "parameters": {"height": 3, "width": 3, "rewards": "2,0:0.1"}}
BREAKOUT = {"name": "breakout", "parameters": {"height": 7, "columns": 5, "brick_rows": 1}}


def freeway(cars, length, **more):
    """A small Freeway."""
    speeds, directions = [1, 2, 3][:cars], [1, -1, 1][:cars]
    parameters = {"num_cars": cars, "lane_length": length, "car_speeds": speeds, "directions": directions}
    return {"name": "freeway", "parameters": {**parameters, **more}}


RANDOM, STICKY = {"random": 0.1}, {"sticky": 0.25}
LAKES, GRIDS = [LAKE, "frozen_lake/4x4"], [GRID, "simple_grid/4x4-decoy"]
FREEWAYS = [freeway(1, 3), freeway(2, 3), freeway(3, 5)]
# agent, environment, chance, observation, steps, runs of Stable-Baselines3 after a second look: 8 cells an agent
CELLS = (
    ("dqn", LAKE, "plain", "vector", 5000, 216),
    ("dqn", LAKE, RANDOM, "vector", 5000, 55),
    ("dqn", GRID, STICKY, "vector", 2500, 152),
    ("dqn", GRID, "plain", "simple_image", 2500, 109),
    ("dqn", BREAKOUT, "plain", "vector", 2500, 30),
    ("dqn", BREAKOUT, "plain", "simple_image", 2500, 30),
    ("dqn", freeway(3, 5), STICKY, "vector", 4500, 119),
    ("dqn", freeway(3, 5), "plain", "simple_image", 2500, 156),
    ("ppo", "frozen_lake/4x4", "plain", "vector", 2500, 30),
    ("ppo", "frozen_lake/4x4", RANDOM, "vector", 2500, 30),
    ("ppo", "simple_grid/4x4-decoy", STICKY, "vector", 2500, 120),
    ("ppo", "simple_grid/4x4-decoy", "plain", "simple_image", 2500, 124),
    ("ppo", BREAKOUT, "plain", "vector", 2500, 30),
    ("ppo", BREAKOUT, "plain", "simple_image", 2500, 30),
    ("ppo", freeway(1, 3), STICKY, "vector", 2500, 30),
    ("ppo", freeway(1, 3), "plain", "simple_image", 2500, 30),
)
# agent, environments, chance, observation, steps: where runs of 2,500 steps of the larger world were too noisy
CANDIDATES = (
    ("dqn", LAKES, "plain", "vector", (2500, 5000, 10_000)),
    ("dqn", LAKES, RANDOM, "vector", (2500, 5000, 10_000)),
    ("dqn", GRIDS, STICKY, "vector", (2500, 5000, 10_000)),
    ("dqn", GRIDS, "plain", "simple_image", (2500, 5000)),
    ("dqn", FREEWAYS, STICKY, "vector", (2500, 5000, 10_000)),
    ("dqn", [FREEWAYS[0], FREEWAYS[2]], "plain", "simple_image", (2500, 5000)),
    ("ppo", GRIDS, "plain", "simple_image", (2500, 5000)),
    ("ppo", FREEWAYS, STICKY, "vector", (2500, 5000, 10_000)),
    ("ppo", FREEWAYS, "plain", "simple_image", (2500, 5000, 10_000)),
)
# The same with numbers of runs, and seeds from 10,000: 32 runs had missed the rare ones that lose most
SECOND_CANDIDATES = (
    ("dqn", [freeway(1, 3, hit_penalty=loss) for loss in (0.1, 0.5)], STICKY, "vector", (2500, 5000), 256),
    ("dqn", [freeway(1, 3)], STICKY, "vector", (5000,), 256),
    ("dqn", [freeway(2, 3), freeway(3, 5), freeway(3, 8)], STICKY, "vector", (2500, 5000), 96),
    ("dqn", [freeway(3, 5)], STICKY, "vector", (4000, 4500), 192),
)
SMALL = {
    "dqn": {"learning_starts": 500, "buffer_size": 10_000, "target_update_interval": 250, "exploration_fraction": 0.4},
    "ppo": {"n_envs": 4},
}


def specification(engine, cells):
    """The study of one engine: of each cell agent, environments, chance, observation, steps and seeds."""
    blocks = [
        {
            "environments": environments,
            "chance": [chance],
            "observations": [observation],
            "agents": [agent],
            "hyperparameters": {agent: SMALL[agent]},
            "horizon": 100,
            "steps": steps,
            "seeds": seeds,
        }
        for agent, environments, chance, observation, steps, seeds in cells
    ]
    name = f"agreement-{engine}"
    return study.specification({"name": name, "engine": engine, "evaluations": 10, "seeds": 1, "blocks": blocks})


def compared_studies():
    """The studies of both engines, with twice as many batched runs; seeds are not those of the pilot."""
    return {
        engine: specification(
            engine,
            [(agent, [world], *rest, list(range(PILOT, PILOT + times * runs))) for agent, world, *rest, runs in CELLS],
        )
        for engine, times in (("batched", 2), ("sb3", 1))
    }


def runs_needed(deviation):
    """How many runs of Stable-Baselines3, beside twice as many batched ones, show equal means to be within MARGIN."""
    quantiles = stats.norm.ppf(0.95) + stats.norm.ppf((1 + POWER) / 2)
    return max(30, int(np.ceil(RESERVE * 1.5 * (quantiles * deviation / MARGIN) ** 2)))


def pilot(folder, workers):
    """Print mean and deviation of each candidate, and how many runs and steps of Stable-Baselines3 it needs."""
    cells = [(*rest, steps, PILOT) for *rest, lengths in CANDIDATES for steps in lengths]
    for *rest, lengths, number in SECOND_CANDIDATES:
        cells += [(*rest, steps, list(range(10_000, 10_000 + number))) for steps in lengths]
    spec = specification("batched", cells)
    print(study.run(spec, folder, workers=workers))
    runs = study.table(spec, folder)
    print("| agent | cell | steps | mean | deviation | runs of SB3 | their steps |\n|---|---|---|---|---|---|---|")
    for key, part in runs.groupby([*CELL, "steps"], sort=False):
        _, instance, chance, observation, agent, steps = key
        regret = part["normalized_regret"]
        needed = runs_needed(regret.std())
        cell = f"{agent} | {instance}, {chance}, {observation} | {steps:,}"
        print(f"| {cell} | {regret.mean():.3f} | {regret.std():.3f} | {needed} | {needed * steps:,} |")


def compared(sb3, batched):
    """A row for each cell that has runs of both."""
    rows = []
    groups = {cell: part["normalized_regret"].dropna().to_numpy() for cell, part in batched.groupby(CELL, sort=False)}
    for cell, part in sb3.groupby(CELL, sort=False):
        ours, theirs = groups.get(cell, np.empty(0)), part["normalized_regret"].dropna().to_numpy()
        if len(ours) < 2 or len(theirs) < 2:
            continue
        difference = ours.mean() - theirs.mean()
        spread = [each.var(ddof=1) / len(each) for each in (ours, theirs)]
        error = np.sqrt(sum(spread))
        freedom = sum(spread) ** 2 / sum(
            each**2 / (len(runs) - 1) for each, runs in zip(spread, (ours, theirs), strict=True)
        ) if error > 0 else np.inf  # fmt: skip
        reach = stats.t.ppf(0.95, freedom) * error if error > 0 else 0.0
        one_sided = [
            stats.t.sf((difference + MARGIN) / error, freedom) if error > 0 else float(difference <= -MARGIN),
            stats.t.sf((MARGIN - difference) / error, freedom) if error > 0 else float(difference >= MARGIN),
        ]
        ks = stats.ks_2samp(ours, theirs)
        rows.append(
            {
                **dict(zip(CELL, cell, strict=True)),
                "steps": int(part["steps"].max()),
                "runs_sb3": len(theirs),
                "runs_batched": len(ours),
                "mean_sb3": theirs.mean(),
                "mean_batched": ours.mean(),
                "deviation_sb3": theirs.std(ddof=1),
                "deviation_batched": ours.std(ddof=1),
                "difference": difference,
                "lower_90": difference - reach,
                "upper_90": difference + reach,
                "p_tost": max(one_sided),
                "ks": ks.statistic,
                "p_ks": ks.pvalue,
            }
        )
    table = pd.DataFrame(rows)
    if len(table):
        table["p_ks_holm"] = holm(table["p_ks"].to_numpy())
        table["equivalent"] = table["p_tost"] < 0.05
        table["differs"] = table["p_ks_holm"] < 0.05
    return table


def printed(table):
    """The table for people, in Markdown."""
    print("| cell | SB3 | batched | difference (90 %) | p, within 0.03 | p, other distribution (Holm) |")
    print("|---|---|---|---|---|---|")
    for row in table.itertuples():
        cell = f"{row.instance}, {row.chance}, {row.observation}, {row.agent}"
        means = f"{row.mean_sb3:.3f} ({row.runs_sb3}) | {row.mean_batched:.3f} ({row.runs_batched})"
        between = f"{row.difference:+.3f} ({row.lower_90:+.3f} to {row.upper_90:+.3f})"
        print(f"| {cell} | {means} | {between} | {row.p_tost:.2g} | {row.p_ks_holm:.2g} |")
    print(f"\n{int(table['equivalent'].sum())} of {len(table)} cells equivalent within {MARGIN}; ", end="")
    print(f"{int(table['differs'].sum())} with another distribution")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/agreement"))
    parser.add_argument("--table", type=Path, default=Path("docs/agreement.csv"))
    parser.add_argument("--pilot", action="store_true", help="the candidates, with the batched engine alone")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--report", action="store_true", help="only the table of what is finished")
    arguments = parser.parse_args()
    if arguments.pilot:
        return pilot(arguments.out / "pilot", arguments.workers)
    specifications = compared_studies()
    if not arguments.report:
        for engine, spec in specifications.items():
            print(study.run(spec, arguments.out / engine, workers=arguments.workers))
    tables = {engine: study.table(spec, arguments.out / engine) for engine, spec in specifications.items()}
    table = compared(tables["sb3"], tables["batched"])
    if table.empty:
        print("no cell has two finished runs of both engines")
        return None
    table.to_csv(arguments.table, index=False, float_format="%.6g")
    printed(table)


if __name__ == "__main__":
    main()
