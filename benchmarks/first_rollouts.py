"""Why is PPO slower in its first rollouts than its idealised learner? Runs with one hyperparameter changed.

    python benchmarks/first_rollouts.py [--worlds 28] [--seeds 2]

Cells are the small instances of docs/studies/sealed-2 behind vectors and hash. Prints for each kind of PPO, as means in
which classes weigh alike, the regret after some numbers of steps, over all of training, and the median of the steps to
a regret of 0.5, relative to the idealised learner's. The first lines are what was predicted and what the test observed.
The table of docs/evidence/sealed-2.md. Some ten minutes of a processor.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd

from pharos import study, train_many
from pharos.training import RunConfig

SEALED = Path(__file__).parents[1] / "docs" / "studies" / "sealed-2"
KINDS = {
    "as published": {},
    "learning rate x 3": {"learning_rate": 0.0015},
    "learning rate x 10": {"learning_rate": 0.005},
    "gradients not clipped": {"max_grad_norm": 1e9},
    "no entropy bonus": {"ent_coef": 0.0},
    "16 epochs": {"n_epochs": 16},
    "learning rate x 3, 16 epochs": {"learning_rate": 0.0015, "n_epochs": 16},
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
    print(f"| {name} | {shown} | {mean.mean():.2f} | {ratio:.1f} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=28, help="cells")
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    predictions = pd.read_parquet(SEALED / "predictions-a-ppo.parquet")
    curves = pd.read_parquet(SEALED / "curves.parquet")
    key = ["instance", "observation"]
    small = predictions.loc[predictions.groupby(["environment", "observation"])["num_states"].idxmin()]
    cells = small.sort_values(key).head(arguments.worlds).set_index(key)
    classes = cells["environment"].tolist()
    points = [np.array(json.loads(text)) for text in cells["clipped_curve"]]
    predicted = np.array([np.interp(STEPS, each[:, 0], each[:, 1]) for each in points])
    of_part = curves[curves["part"] == "a-ppo"].set_index(key)
    observed = []
    for cell in cells.index:
        rows = of_part.loc[[cell]]
        scale = (rows["value_optimal"] - rows["value_uniform"]).to_numpy()
        regrets = [
            (best - np.interp(STEPS, steps, values)) / spread
            for best, steps, values, spread in zip(
                rows["value_optimal"], rows["step"], rows["value"], scale, strict=True
            )
        ]
        observed.append(np.mean(regrets, axis=0))
    print(f"| PPO | {' | '.join(f'{step:,}' for step in SHOWN)} | mean | steps to half, ratio |", flush=True)
    printed("predicted", predicted, classes, predicted)
    printed("observed in the test, four seeds", np.array(observed), classes, predicted)
    runs = study.specification(SEALED / "report.yaml", trust=True).runs
    configs = {
        (run.cell["instance"], run.cell["observation"]): run.config
        for run in reversed(runs)
        if run.config["agent"] == "ppo" and run.cell["chance"] == "plain"
    }
    for name, changed in KINDS.items():
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
                hyperparameters={**config["hyperparameters"], **changed},
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
