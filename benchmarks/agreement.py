"""Do the batched engine and Stable-Baselines3 learn alike? The same cells with many seeds of both, and two tests.

    python benchmarks/agreement.py --out build/agreement [--seeds 30] [--batched-seeds 90] [--steps 10000]
        [--evaluations 20] [--workers 2]
    python benchmarks/agreement.py --out build/agreement --report         # the table of what is finished

Trains every cell (instance, chance, observation, agent) with both engines: two studies, in OUT/sb3 and OUT/batched. It
may be interrupted at any time; the same command goes on from there. What is compared is the normalised cumulative
regret of runs. For each cell:

    equivalence    two one-sided Welch tests that the means differ by less than MARGIN; p_tost is the larger p
    distribution   Kolmogorov-Smirnov's two-sample test; p_ks_holm is corrected over the cells by Holm's method

Writes docs/agreement.csv and prints the table. Runs of the batched engine are cheap, so there are more of them: a mean
of 30 runs with a deviation of 0.07 is known to 0.013, and the difference cannot be bounded better than that.

Cost: on one busy core 306 (vector) and 185 (image) steps/s of Stable-Baselines3's DQN, 1,200 and 860 of its PPO: 10,000
steps, 30 seeds, 16 cells take about 2.5 hours on two such cores, an idle machine a third of that; the batched engine a
sixth of it.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from pharos import study

MARGIN = 0.03
CELL = ["environment", "instance", "chance", "observation", "agent"]
BREAKOUT = {"name": "breakout", "parameters": {"height": 7, "columns": 5, "brick_rows": 1}}
FREEWAY = {
    "name": "freeway",
    "parameters": {"num_cars": 3, "lane_length": 5, "car_speeds": [1, 2, 3], "directions": [1, -1, 1]},
}
# (environments, kinds of chance, observations): 8 cells for each agent
CELLS = (
    (["frozen_lake/4x4"], ["plain", {"random": 0.1}], ["vector"]),
    (["simple_grid/4x4-decoy"], [{"sticky": 0.25}], ["vector"]),
    (["simple_grid/4x4-decoy"], ["plain"], ["simple_image"]),
    ([BREAKOUT], ["plain"], ["vector", "simple_image"]),
    ([FREEWAY], [{"sticky": 0.25}], ["vector"]),
    ([FREEWAY], ["plain"], ["simple_image"]),
)
SMALL = {
    "dqn": {"learning_starts": 500, "buffer_size": 10_000, "target_update_interval": 250, "exploration_fraction": 0.4},
    "ppo": {},
}


def specification(engine, seeds, steps, evaluations=20):
    """The study of one engine."""
    blocks = [
        {
            "environments": environments,
            "chance": chance,
            "observations": observations,
            "agents": [agent],
            "hyperparameters": {agent: {**given, **({"n_envs": 4} if agent == "ppo" else {})}},
            "horizon": 100,
        }
        for agent, given in SMALL.items()
        for environments, chance, observations in CELLS
    ]
    return study.specification(
        {
            "name": f"agreement-{engine}",
            "engine": engine,
            "steps": steps,
            "evaluations": evaluations,
            "seeds": seeds,
            "blocks": blocks,
        }
    )


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


def holm(p):
    """Holm's correction: the k-th smallest of n p-values times n - k + 1, not decreasing, at most 1."""
    order = np.argsort(p)
    corrected = np.minimum(1.0, np.maximum.accumulate(p[order] * (len(p) - np.arange(len(p)))))
    result = np.empty(len(p))
    result[order] = corrected
    return result


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
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--batched-seeds", type=int, default=90)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--evaluations", type=int, default=20)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--report", action="store_true", help="only the table of what is finished")
    arguments = parser.parse_args()
    specifications = {
        engine: specification(engine, seeds, arguments.steps, arguments.evaluations)
        for engine, seeds in (("batched", arguments.batched_seeds), ("sb3", arguments.seeds))
    }
    if not arguments.report:
        for engine, spec in specifications.items():
            end = study.run(spec, arguments.out / engine, workers=arguments.workers, foretold=print)
            print(end)
    tables = {engine: study.table(spec, arguments.out / engine) for engine, spec in specifications.items()}
    table = compared(tables["sb3"], tables["batched"])
    if table.empty:
        print("no cell has two finished runs of both engines")
        return
    table.to_csv(arguments.table, index=False, float_format="%.6g")
    printed(table)


if __name__ == "__main__":
    main()
