"""Which observation of an MDP is the better one: what predictions say, beside the runs of a packed study.

python benchmarks/image_or_vector.py [docs/studies/small/runs.parquet]

For each agent and predictor the share of tasks (instance and chance) in which the predictor says rightly whether
vectors or images have the larger mean regret of greedy policies, among those whose regrets differ by more than 0.02;
and Spearman's correlation over all cells. Prints rows of a Markdown table.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from pharos import study

CLEAR = 0.02
PREDICTORS = ("kernel_regret", "kernel_regret_played", "adam_regret", "adam_regret_played", "kernel_learning_time")


def main():
    file = sys.argv[1] if len(sys.argv) > 1 else "docs/studies/small/runs.parquet"
    with tempfile.TemporaryDirectory() as folder:
        place, _ = study.unpack(file, Path(folder) / "study")
        runs, points = study.table(place), study.curves(place)
        cells = study.predict(place, progress=lambda line: print(line, file=sys.stderr, flush=True))
        cells = cells.merge(study.outcomes(runs, points))
    print("| agent | predictor | tasks | clear | image is better | rightly said | rank correlation |")
    print("|---|---|---|---|---|---|---|")
    for agent, part in cells.groupby("agent"):
        for predictor in PREDICTORS:
            wide = part.pivot_table(
                index=["instance", "chance"], columns="observation", values=["greedy", predictor]
            ).dropna()
            truth, said = (wide[name]["simple_image"] - wide[name]["vector"] for name in ("greedy", predictor))
            clear = truth.abs() > CLEAR
            right = (np.sign(truth) == np.sign(said))[clear].mean()
            rho = part[["greedy", predictor]].corr("spearman").iloc[0, 1]
            counts = f"{len(wide)} | {clear.sum()} | {(truth[clear] < 0).sum()}"
            print(f"| {agent} | `{predictor}` | {counts} | {right:.2f} | {rho:.2f} |", flush=True)


if __name__ == "__main__":
    main()
