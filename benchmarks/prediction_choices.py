"""Does the predicted order of networks and of hyperparameters agree with runs?

    python benchmarks/prediction_choices.py predict     # writes predictions.csv; commit it before the next one
    python benchmarks/prediction_choices.py run         # writes runs.csv; goes on where it was stopped
    python benchmarks/prediction_choices.py judge
    python benchmarks/prediction_choices.py predict|judge --predictions predictions-network.csv    # another predictor's

Six worlds, instances of classes that pharos has, none of them in the published studies; DQN and PPO, 30 thousand steps,
five seeds, the regret of the learnt policies as a mean over 30 evaluations. Hyperparameters: 20 settings of each agent,
drawn once from a grid over what the idealised learner knows (a DQN's discount, exploration and target network; a PPO's
discount, rollouts, epochs, clipping). Networks: three widths and depths behind ten observations, of a DQN.

`judge` prints for each world and over all the rank correlation of both orders, pairs that are ordered rightly among
those whose regrets differ by more than 0.05, what would be lost by taking what is predicted best (its regret less that
of the best one, beside the same of one taken at random), and the regret of the predicted best of any four. Brackets are
95 % intervals over worlds drawn anew.
"""

import argparse
import csv
import itertools
import json
import random
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

import pharos

FOLDER = Path(__file__).parents[1] / "docs" / "studies" / "choices"
WORLDS = {
    "simple_grid": {"height": 9, "width": 9},
    "taxi": {"size": 4},
    "catch": {"rows": 8, "columns": 6},
    "breakout": {"height": 6, "columns": 3, "brick_rows": 1},
    "freeway": {"num_cars": 4, "lane_length": 3},
    "umbrella_chain": {"chain_length": 40},
}
COMMON = {  # those of the published studies
    "dqn": {
        **{"learning_rate": 0.001, "buffer_size": 50000, "learning_starts": 1000, "batch_size": 32, "gamma": 0.95},
        **{"train_freq": 4, "gradient_steps": 1, "n_steps": 1, "n_envs": 1, "target_update_interval": 250},
        **{"exploration_initial_eps": 1.0, "exploration_final_eps": 0.05, "exploration_fraction": 0.3},
        "max_grad_norm": 10,
    },
    "ppo": {
        **{"n_envs": 8, "n_steps": 64, "batch_size": 128, "n_epochs": 4, "learning_rate": 0.0005, "gamma": 0.95},
        **{"gae_lambda": 0.95, "ent_coef": 0.01, "clip_range": 0.2},
    },
}
GRIDS = {
    "dqn": {
        "gamma": (0.8, 0.95, 0.99),
        "exploration_fraction": (0.1, 0.3, 0.8),
        "exploration_final_eps": (0.01, 0.05, 0.3),
        "target_update_interval": (50, 250, 2000),
    },
    "ppo": {
        "gamma": (0.8, 0.95, 0.99),
        "n_steps": (16, 64, 256),
        "n_epochs": (1, 4, 10),
        "gae_lambda": (0.8, 0.95, 1.0),
        "clip_range": (0.1, 0.2, 0.4),
    },
}
SETTINGS = 20
LAYERS = ([8], [128], [256, 256])
SEEN = [
    *(("simple_grid", name, {}) for name in ("vector", "one_hot")),
    *(("taxi", name, {}) for name in ("vector", "one_hot")),
    *(("catch", name, options) for name, options in (("vector", {}), ("hash", {"bits": 64}))),
    *((world, "vector", {}) for world in ("breakout", "freeway", "umbrella_chain")),
    ("catch", "simple_image", {"motion": True}),
]
STEPS, EVALUATIONS, SEEDS, CLEAR = 30_000, 30, 5, 0.05
KEY = ("kind", "agent", "world", "observation", "options", "hyperparameters")


def cells():
    """Rows of what is predicted and run: KEY, as texts."""
    for agent, grid in GRIDS.items():
        settings = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
        for own in random.Random(0).sample(settings, SETTINGS):
            for world in WORLDS:
                yield "setting", agent, world, "vector", "{}", json.dumps(own)
    for (world, observation, options), layers in itertools.product(SEEN, LAYERS):
        yield "network", "dqn", world, observation, json.dumps(options), json.dumps({"net_arch": layers})


def read(name):
    """Rows of a file by KEY."""
    file = FOLDER / name
    if not file.exists():
        return {}
    with file.open(newline="") as lines:
        return {tuple(row[key] for key in KEY): row for row in csv.DictReader(lines)}


def fill(name, columns, made):
    """Add a row for each cell that the file does not have."""
    done = read(name)
    FOLDER.mkdir(parents=True, exist_ok=True)
    with (FOLDER / name).open("a", newline="") as file:
        writer = csv.writer(file)
        if not done:
            writer.writerow((*KEY, *columns))
        for cell in cells():
            if cell not in done:
                _, agent, world, observation, options, own = cell
                hyperparameters = {**COMMON[agent], **json.loads(own)}
                row = made(agent, world, observation, json.loads(options), hyperparameters)
                writer.writerow((*cell, *row))
                file.flush()
                print(*cell, *row, flush=True)


def predicted(agent, world, observation, options, hyperparameters):
    """The primary predictor, its deviation of one walk, and the same of a table."""
    prediction = pharos.predict(
        *(world, [(observation, options)]),
        agent=agent,
        steps=STEPS,
        hyperparameters=hyperparameters,
        **WORLDS[world],
    )
    (cell,) = prediction.cells
    return tuple(round(number, 6) for number in (cell.value, cell.deviation, cell.tabular))


def observed(agent, world, observation, options, hyperparameters):
    """Mean normalised regret of the learnt policies over evaluations and seeds, and its deviation over seeds."""
    results = pharos.train_many(
        *(agent, world),
        seeds=range(SEEDS),
        steps=STEPS,
        observation=observation,
        observation_options=options,
        evaluation_interval=STEPS // EVALUATIONS,
        hyperparameters=hyperparameters,
        **WORLDS[world],
    )
    regrets = [np.mean([row["normalized_regret"] for row in run.curve]) for run in results]
    return round(float(np.mean(regrets)), 6), round(float(np.std(regrets, ddof=1)), 6)


def group_of(cell):
    """What is ordered together: the settings of an agent in a world; the networks behind an observation."""
    kind, agent, world, observation, options, _ = cell
    return kind, agent, world, observation, options


def scores(said, seen):
    """(rank correlation, pairs in order, clear pairs, lost by the predicted best, at random; regrets of shortlists)."""
    first, second = np.triu_indices(len(said), 1)
    clear = np.abs(seen[first] - seen[second]) > CLEAR
    right = (np.sign(said[first] - said[second]) == np.sign(seen[first] - seen[second]))[clear]
    rank = spearmanr(said, seen).statistic if np.ptp(said) and np.ptp(seen) else np.nan
    fours = np.array([*itertools.combinations(range(len(said)), min(4, len(said)))])
    of_four = seen[fours[np.arange(len(fours)), said[fours].argmin(axis=1)]].mean()
    lost = seen[said.argmin()] - seen.min(), seen.mean() - seen.min()
    return rank, right.sum(), clear.sum(), *lost, of_four, seen.mean()


def judge(predictions="predictions.csv"):
    """Print a table of each kind and agent."""
    told, runs = read(predictions), read("runs.csv")
    groups = {}
    for cell in cells():
        if cell in told and cell in runs:
            groups.setdefault(group_of(cell), []).append(cell)
    for kind, agent in dict.fromkeys(name[:2] for name in groups):
        print(f"\n### {kind}s of {agent}\n")
        columns = ("cells", "rank correlation", "pairs in order", "lost by the predicted best", "at random")
        print(f"| world | {' | '.join(columns)} | regret of the predicted best of four | at random |")
        print("|---" * 8 + "|")
        rows = {}
        for name, members in groups.items():
            if name[:2] == (kind, agent):
                said = np.array([float(told[cell]["predicted"]) for cell in members])
                seen = np.array([float(runs[cell]["observed"]) for cell in members])
                rows[name] = row = np.array(scores(said, seen), float)
                title = name[2] if kind == "setting" else " ".join((*name[2:4], name[4].strip("{}")))
                words = (len(members), f"{row[0]:.2f}", f"{row[1]:.0f} of {row[2]:.0f}", *(f"{x:.3f}" for x in row[3:]))
                print(f"| {title} | {' | '.join(map(str, words))} |")
        table, rng = np.array(list(rows.values())), np.random.default_rng(0)
        worlds = np.array([name[2] for name in rows])
        names = np.unique(worlds)

        def whole(table):
            return np.nanmean(table[:, 0]), table[:, 1].sum() / table[:, 2].sum(), *table[:, 3:].mean(axis=0)

        samples = []
        for _ in range(2000):
            drawn = rng.choice(names, len(names))
            samples.append(whole(np.concatenate([table[worlds == name] for name in drawn])))
        low, high = np.nanpercentile(samples, [2.5, 97.5], axis=0)
        texts = [f"{value:.2f} ({a:.2f} to {b:.2f})" for value, a, b in zip(whole(table), low, high, strict=True)]
        print(f"| all | {len(rows)} orders | {' | '.join(texts)} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("predict", "run", "judge"))
    parser.add_argument("--predictions", default="predictions.csv", help="a file of docs/studies/choices")
    arguments = parser.parse_args()
    what = arguments.what
    if what == "predict":
        fill(arguments.predictions, ("predicted", "deviation", "tabular"), predicted)
    elif what == "run":
        if set(read("predictions.csv")) < set(cells()):
            raise SystemExit("predictions.csv lacks cells: `predict` comes first")
        fill("runs.csv", ("observed", "deviation"), observed)
    else:
        judge(arguments.predictions)


if __name__ == "__main__":
    main()
