"""Which observation of an MDP is the better one: what predictions say, beside the runs of a packed study.

python benchmarks/image_or_vector.py [docs/studies/small/runs.parquet]

For each agent and predictor the number of tasks (instance and chance) in which the predictor says rightly whether
vectors or images have the larger mean regret of greedy policies, among those whose regrets differ by more than 0.02
(one half where it says that both are alike); and Spearman's correlation over all cells, and over those of each class.
Prints rows of a Markdown table.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from pharos import study
from pharos.agents import primary_predictors
from pharos.prediction.pairs import Pairs
from pharos.statistics import spearman

CLEAR = 0.02
PREDICTORS = ("kernel_regret", "kernel_regret_played", "adam_regret", "adam_regret_played", "kernel_learning_time")


def main():
    file = sys.argv[1] if len(sys.argv) > 1 else "docs/studies/small/runs.parquet"
    with tempfile.TemporaryDirectory() as folder:
        place, _ = study.unpack(file, Path(folder) / "study")
        runs, points = study.table(place), study.curves(place)
        cells = study.predict(place, progress=lambda line: print(line, file=sys.stderr, flush=True))
        cells = cells.merge(study.outcomes(runs, points))
    print("| agent | predictor | clear tasks | images are better in | rightly said | rank correlation | of a class |")
    print("|---|---|---|---|---|---|---|")
    for agent, part in cells.groupby("agent"):
        regret, tasks = part["greedy"].to_numpy(float), part.groupby(["instance", "chance"]).ngroup().to_numpy()
        pairs = Pairs.of(regret, tasks, CLEAR)
        images = pairs.agreement((part["observation"] == "vector").to_numpy(float)) * len(pairs.first)
        counts = f"{len(pairs.first)} | {images:g}"
        for predictor in (*PREDICTORS, primary_predictors()[agent]):
            predicted = part[predictor].to_numpy(float)
            rho = spearman(predicted, regret)
            classes = part["environment"].to_numpy()
            of_classes = [
                f"{name} {spearman(predicted[classes == name], regret[classes == name]):.2f}"
                for name in np.unique(classes)
            ]
            right = f"{pairs.right(predicted).sum():g}"
            print(f"| {agent.upper()} | `{predictor}` | {counts} | {right} | {rho:.2f} | {', '.join(of_classes)} |")


if __name__ == "__main__":
    main()
