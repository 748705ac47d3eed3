"""Why is PPO slower in its first rollouts than its idealised learner? Runs with one hyperparameter changed.

    python benchmarks/first_rollouts.py [--study sealed-2] [--cells 28] [--larger] [--seeds 2] [--kind NAME ...]

Cells are the small instances of a sealed set behind vectors and hash. Prints for each kind of PPO, as means in
which classes weigh alike, the regret after some numbers of steps, over all of training, and the median of the steps to
a regret of 0.5, relative to the idealised learner's, and R2 of the predictions as they are. The first line is what was
predicted. The tables of docs/evidence/sealed-3.md. Some ten minutes of a processor.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd

from pharos import study, train_many
from pharos.training import RunConfig

STUDIES = Path(__file__).parents[1] / "docs" / "studies"
FILES = {"sealed-2": "report.yaml", "sealed-3": "study.yaml"}
DIVIDED = "rewards divided by V* - U"
KINDS = {
    "as published": {},
    "learning rate x 3": {"learning_rate": 0.0015},
    "learning rate x 10": {"learning_rate": 0.005},
    "gradients not clipped": {"max_grad_norm": 1e9},
    "no entropy bonus": {"ent_coef": 0.0},
    "16 epochs": {"n_epochs": 16},
    "learning rate x 3, 16 epochs": {"learning_rate": 0.0015, "n_epochs": 16},
    DIVIDED: {},
}
STEPS = np.arange(0, 30_001, 1000)
SHOWN = 2000, 4000, 8000, 16_000, 30_000
HALF = 0.5


def first_at_half(curve):
    """Steps until the regret is below HALF, infinity if it never is."""
    below = np.flatnonzero(curve < HALF)
    return STEPS[below[0]] if len(below) else np.inf


def printed(name, curves, classes, predicted):
    """A row of the table. curves, predicted: (cells, steps) regrets."""
    weights = np.array([1 / Counter(classes)[each] for each in classes])
    mean = np.average(curves, axis=0, weights=weights)
    ratios = [first_at_half(one) / first_at_half(other) for one, other in zip(curves, predicted, strict=True)]
    ratio = np.nanmedian([each for each in ratios if 0 < each < np.inf])
    shown = " | ".join(f"{mean[step // 1000]:.2f}" for step in SHOWN)
    cells = curves.mean(axis=1), predicted.mean(axis=1)
    error = np.average((cells[0] - cells[1]) ** 2, weights=weights)
    spread = np.average((cells[0] - np.average(cells[0], weights=weights)) ** 2, weights=weights)
    print(f"| {name} | {shown} | {mean.mean():.2f} | {ratio:.1f} | {1 - error / spread:.2f} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--study", choices=[*FILES], default="sealed-2")
    parser.add_argument("--cells", type=int, default=28)
    parser.add_argument("--larger", action="store_true", help="larger instances as well")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--kind", action="append", choices=[*KINDS])
    arguments = parser.parse_args()
    folder = STUDIES / arguments.study
    predictions = pd.read_parquet(folder / "predictions-a-ppo.parquet")
    key = ["instance", "observation"]
    if not arguments.larger:
        predictions = predictions.loc[predictions.groupby(["environment", "observation"])["num_states"].idxmin()]
    cells = predictions.sort_values(key).head(arguments.cells).set_index(key)
    classes = cells["environment"].tolist()
    points = [np.array(json.loads(text)) for text in cells["clipped_curve"]]
    predicted = np.array([np.interp(STEPS, each[:, 0], each[:, 1]) for each in points])
    print(f"| PPO | {' | '.join(f'{step:,}' for step in SHOWN)} | mean | steps to half, ratio | R2 |", flush=True)
    printed("predicted", predicted, classes, predicted)
    runs = study.specification(folder / FILES[arguments.study], trust=True).runs
    configs = {
        (run.cell["instance"], run.cell["observation"]): run.config
        for run in reversed(runs)
        if run.config["agent"] == "ppo" and run.cell["chance"] == "plain"
    }
    for name in arguments.kind or KINDS:
        found = []
        for cell in cells.index:
            config = configs[cell]
            task = RunConfig.from_dict(config).task(trust=True)
            results = train_many(
                "ppo",
                task.env,
                seeds=range(arguments.seeds),
                steps=config["steps"],
                evaluation_interval=1000,
                hyperparameters={**config["hyperparameters"], **KINDS[name]},
                scale_rewards="range" if name == DIVIDED else "",
                observation=config["observation"],
                observation_options=dict(task.observation_options),
                horizon=task.horizon_steps,
            )
            regrets = [
                np.interp(
                    STEPS,
                    [0, *(row["step"] for row in result.curve if row["step"])],
                    [1.0, *(row["normalized_regret"] for row in result.curve if row["step"])],
                )
                for result in results
            ]
            found.append(np.mean(regrets, axis=0))
        printed(name, np.array(found), classes, predicted)


if __name__ == "__main__":
    main()
