"""What came true of predictions on classes left out, without the rest of a report: the tables of representation.md.

python benchmarks/unseen_classes.py STUDY.yaml RUNS.parquet PREDICTIONS.parquet --out TABLE.csv [--figures FOLDER]
    [--permutations N] [--hardness FOLDER]

RUNS.parquet is a packed study (`pharos study pack`). Writes all columns of `study.validation`, prints the primary
outcome and the regret of training episodes, and draws predicted against observed regret and the learners' curves.
"""

import argparse
import tempfile
from pathlib import Path

from pharos import study
from pharos.study.figures import save
from pharos.study.unseen_classes import PERMUTATIONS
from pharos.study.unseen_figures import unseen_figures

OUTCOMES = ("greedy", "played")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("spec", "runs", "predictions"):
        parser.add_argument(name)
    parser.add_argument("--out", required=True)
    parser.add_argument("--figures")
    parser.add_argument("--permutations", type=int, default=PERMUTATIONS)
    parser.add_argument("--hardness", help="folder of a study whose measures of hardness are taken as they are")
    given = parser.parse_args()
    predictions, said = study.read_predictions(given.predictions)
    with tempfile.TemporaryDirectory() as folder:
        place, number = study.unpack(given.runs, Path(folder) / "study")
        runs, points = study.table(place), study.curves(place)
        tasks = set(zip(runs["instance"], runs["chance"], strict=True))
        measures = study.hardness_table(study.specification(given.spec), given.hardness or place, tasks=tasks)
    cells = study.outcomes(runs, points)
    judged = study.validation(predictions, cells, measures=measures, permutations=given.permutations)
    judged.to_csv(given.out, index=False)
    seeds = runs.groupby(["instance", "agent", "observation"]).size().value_counts().to_dict()
    print(f"{number} runs; cells by number of seeds: {seeds}; predictions {said['sha256']}, {said['date']}")
    for outcome in OUTCOMES:
        rows = judged[judged["outcome"] == outcome]
        print(f"\n{outcome}: ceiling {rows['ceiling'].max():.2f}, of agreement {rows['agreement_ceiling'].max():.2f}")
        print("| predictor | R2 | rank correlation | p (Holm) | given the tabular learner | rightly ordered | image |")
        print("|---|---|---|---|---|---|---|")
        for row in rows.to_dict("records"):
            words = [_interval(row, name) for name in ("r_squared", "rho")]
            words += [f"{row['p_rho_holm']:.2g}", _interval(row, "given_tabular_regret"), _interval(row, "agreement")]
            image = f"{row['image_agreement'] * row['image_pairs']:g} of {row['image_pairs']}"
            print(f"| `{row['predictor']}` | {' | '.join(words)} of {row['pairs']} | {image} |")
    if given.figures:
        folder = Path(given.figures)
        folder.mkdir(parents=True, exist_ok=True)
        for name, draw in unseen_figures(predictions, cells, points, runs).items():
            save(draw, folder / name)


def _interval(row, name):
    return f"{row[name]:.2f} ({row[f'{name}_lower']:.2f} to {row[f'{name}_upper']:.2f})"


if __name__ == "__main__":
    main()
