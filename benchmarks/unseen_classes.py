"""What came true of predictions on classes left out, without the rest of a report: the tables of representation.md.

python benchmarks/unseen_classes.py STUDY.yaml RUNS.parquet PREDICTIONS.parquet --out TABLE.csv [--figures FOLDER]
    [--permutations N] [--hardness FOLDER] [--and STUDY.yaml RUNS.parquet PREDICTIONS.parquet] [--later RUNS.parquet]

RUNS.parquet is a packed study (`pharos study pack`); --and adds another one, with predictions of its own, --later the
runs of these studies that another packed study has, such as a preset that all of them are part of. Writes all
columns of `study.validation`, prints the primary outcome and the regret of training episodes, and how far today's
predictor is off without a line, and draws predicted against observed regret and the learners' curves.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from pharos import study
from pharos.agents import primary_predictors
from pharos.plots import save_for_page
from pharos.prediction import published
from pharos.study import PredictedCells
from pharos.study.leave_one_class_out import PERMUTATIONS
from pharos.study.prediction_figures import unseen_figures
from pharos.training import CELL

OUTCOMES = ("greedy", "played")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("spec", "runs", "predictions"):
        parser.add_argument(name)
    parser.add_argument("--out", required=True)
    parser.add_argument("--figures")
    parser.add_argument("--permutations", type=int, default=PERMUTATIONS)
    parser.add_argument("--hardness", help="folder of a study whose measures of hardness are taken as they are")
    parser.add_argument("--and", dest="more", nargs=3, action="append", default=[], metavar="FILE")
    parser.add_argument("--later", metavar="FILE", help="packed runs, of which those of the studies are added")
    given = parser.parse_args()
    studies = [(given.spec, given.runs, given.predictions), *given.more]
    foretold = PredictedCells.of([study.read_predictions(file) for _, _, file in studies])
    predictions = foretold.cells
    each = [_finished(spec, runs, given.hardness, given.later) for spec, runs, _ in studies]
    runs, points, measures = (pd.concat(parts, ignore_index=True) for parts in zip(*each, strict=True))
    measures = measures.drop_duplicates(["environment", "instance", "chance"])  # studies may share tasks
    cells = study.outcomes(runs, points)
    judged = study.validation(predictions, cells, measures=measures, permutations=given.permutations)
    judged.to_csv(given.out, index=False)
    seeds = runs.groupby(["instance", "chance", "agent", "observation"]).size().value_counts().to_dict()
    begun, unknown = foretold.late(runs)
    print(f"{len(runs)} runs; cells by number of seeds: {seeds}")
    print(f"{begun} began before they were predicted, {unknown} do not say when; predictions:")
    for _, said in foretold.parts:
        print(f"    {said['sha256']}, {said['date']}")
    for (agent, outcome), rows in judged.groupby(["agent", "outcome"], sort=False):
        if outcome not in OUTCOMES:
            continue
        whole = rows.loc[rows["cells"].idxmax()]  # predictors that are undefined somewhere have ceilings of their own
        print(f"\n{agent}, {outcome}: ceiling {whole['ceiling']:.2f}, of agreement {whole['agreement_ceiling']:.2f}")
        print("| predictor | R2 | rank correlation | p (Holm) | given the tabular learner | rightly ordered | image |")
        print("|---|---|---|---|---|---|---|")
        for row in rows.to_dict("records"):
            words = [_interval(row, name) for name in ("r_squared", "rho")]
            words += [f"{row['p_rho_holm']:.2g}", _interval(row, "given_tabular_regret"), _interval(row, "agreement")]
            image = f"{row['image_agreement'] * row['image_pairs']:g} of {row['image_pairs']}"
            print(f"| `{row['predictor']}` | {' | '.join(words)} of {row['pairs']} | {image} |")
        if outcome == "greedy":
            _print_misses(predictions, cells, agent)
    if given.figures:
        folder = Path(given.figures)
        folder.mkdir(parents=True, exist_ok=True)
        for name, draw in unseen_figures(predictions, cells, points).items():
            save_for_page(draw, folder / name)


def _finished(spec, packed, hardness, later):
    """(runs, points of their curves, measures of hardness of their tasks) of a packed study."""
    with tempfile.TemporaryDirectory() as folder:
        place, _ = study.unpack(packed, Path(folder) / "study")
        if later is not None:
            study.unpack(later, place, into=place)
        runs = study.table(place)
        tasks = set(zip(runs["instance"], runs["chance"], strict=True))
        return (
            runs,
            study.curves(place),
            study.hardness_table(study.specification(spec), hardness or place, tasks=tasks),
        )


def _print_misses(predictions, cells, agent):
    """Print how today's predictor does as it is, and how many cells are within the interval of `pharos predict`."""
    kind = agent.split()[0]  # without the name of its setting
    both = predictions.merge(cells[[*CELL, "greedy"]], on=CELL)
    both = both[both["agent"] == agent]
    primary = primary_predictors()
    if primary.get(kind) not in both:
        return
    miss, classes = both["greedy"] - both[primary[kind]], both["environment"]
    weights = 1 / classes.groupby(classes).transform("size")  # classes weigh alike
    middle = np.average(both["greedy"], weights=weights)
    unfitted = 1 - (weights * miss**2).sum() / (weights * (both["greedy"] - middle) ** 2).sum()
    width = published(kind).half_width()
    held = miss.abs() <= width
    least = held.groupby(classes).mean()
    within = f"{held.mean():.2f} of {len(held)} cells within {width:.2f}, of {least.idxmin()} {least.min():.2f}"
    print(f"`{primary[kind]}` without a line: R2 {unfitted:.2f}; {within}")


def _interval(row, name):
    return f"{row[name]:.2f} ({row[f'{name}_lower']:.2f} to {row[f'{name}_upper']:.2f})"


if __name__ == "__main__":
    main()
