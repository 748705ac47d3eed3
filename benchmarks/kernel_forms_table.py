"""Tables of what `benchmarks/kernel_forms.py` computed: which form of a kernel orders observations as agents do?

python benchmarks/kernel_forms_table.py FORMS.csv [...] [--study NAME]

For each agent a row for each form. Image or vector: instances under one chance whose regrets with the two differ by
more than CLEAR, and the share of them in which the form says rightly which is larger; all: the same of every pair of
observations. Intervals are of 95 %, over classes drawn anew where there are at least three of them, else over
instances. R2 and rank correlation are of classes that are left out one by one, classes weighing alike.

Below a table stand what choosing would give: for each class the form that is best on all others, and how it does there;
and the chance that the best of as many forms would do as well if all of them knew nothing (signs of an instance's
differences exchanged together, all forms at once).
"""

import argparse
from itertools import combinations

import numpy as np
import pandas as pd

CLEAR = 0.02
RESAMPLES = 2000
IMAGE_OR_VECTOR = {"simple_image", "vector"}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--study")
    given = parser.parse_args()
    cells = pd.concat([pd.read_csv(file) for file in given.files])
    if given.study:
        cells = cells[cells["study"] == given.study]
    for agent, part in cells.groupby("agent"):
        print(f"\n### {agent.upper()}: {len(part)} cells, {part['environment'].nunique()} classes\n")
        table(part.reset_index(drop=True))


def table(cells):
    """Print the rows of an agent."""
    forms = [name for name in cells if "_" in name and cells[name].notna().sum() > len(cells) / 2]
    pairs = _pairs(cells)
    pictures = pairs[pairs["kind"].map(_is_image_or_vector)]
    print("| form | image or vector | rightly said | all pairs | rightly said | R2 | rank correlation |")
    print("|---|---|---|---|---|---|---|")
    for form in forms:
        words = []
        for some in (pictures, pairs):
            right = _right(some, form)
            words += [str(len(some)), f"{right.mean():.2f} ({_interval(some, right)})"]
        print(f"| `{form}` | {' | '.join(words)} | {_held_out(cells, form)} |")
    for name, some in (("image or vector", pictures), ("all pairs", pairs)):
        chosen, luck = _chosen(some, forms), _luck(some, forms)
        best = max(_right(some, form).mean() for form in forms)
        print(
            f"\n{name}: the best of {len(forms)} forms {best:.2f} (p {luck:.3f}); chosen on other classes {chosen:.2f}"
        )


def _pairs(cells):
    """A row for each clear pair of observations of an instance under a chance: differences of regret and forms."""
    numbers = [name for name in cells if "_" in name or name == "greedy"]
    numbers = [name for name in numbers if pd.api.types.is_numeric_dtype(cells[name])]
    rows = []
    for (environment, instance, chance), part in cells.groupby(["environment", "instance", "chance"]):
        for (_, one), (_, other) in combinations(part.iterrows(), 2):
            difference = one[numbers] - other[numbers]
            if abs(difference["greedy"]) > CLEAR:
                about = {"environment": environment, "instance": instance, "chance": chance}
                rows.append(about | {"kind": (one["observation"], other["observation"])} | dict(difference))
    return pd.DataFrame(rows)


def _is_image_or_vector(kind):
    """Whether one is the plain vector, the other an image, whatever its options."""
    return "vector" in kind and {name.split("(")[0] for name in kind} == IMAGE_OR_VECTOR


def _right(pairs, form):
    """(N,): 1 where a form says what is larger, 0 where it says the opposite, 1/2 where it says nothing."""
    said = np.nan_to_num(pairs[form].to_numpy(float))
    return 0.5 + 0.5 * np.sign(said) * np.sign(pairs["greedy"].to_numpy(float))


def _clusters(pairs):
    by = "environment" if pairs["environment"].nunique() >= 3 else "instance"
    return pairs[by].astype("category").cat.codes.to_numpy()


def _interval(pairs, right):
    clusters = _clusters(pairs)
    totals, counts = np.bincount(clusters, right), np.bincount(clusters)
    draws = np.random.default_rng(0).integers(0, len(counts), (RESAMPLES, len(counts)))
    low, high = np.percentile(totals[draws].sum(axis=1) / counts[draws].sum(axis=1), [2.5, 97.5])
    return f"{low:.2f} to {high:.2f}"


def _held_out(cells, form):
    """The cells of a table for R2 and rank correlation."""
    from scipy.stats import spearmanr

    part = cells[["environment", "greedy", form]].dropna()
    x, y, classes = part[form].to_numpy(), part["greedy"].to_numpy(), part["environment"].to_numpy()
    names = np.unique(classes)
    if len(names) < 3 or np.ptp(x) == 0:
        return f"- | {spearmanr(x, y)[0]:.2f} (nothing left out)"
    weights = 1 / part["environment"].map(part["environment"].value_counts()).to_numpy()
    said = np.empty(len(x))
    for name in names:
        others = classes != name
        slope, offset = np.polyfit(x[others], y[others], 1, w=np.sqrt(weights[others]))
        said[~others] = slope * x[~others] + offset
    left, spread = weights @ (y - said) ** 2, weights @ (y - weights @ y / weights.sum()) ** 2
    return f"{1 - left / spread:.2f} | {spearmanr(said, y)[0]:.2f}"


def _chosen(pairs, forms):
    """The share that is rightly said where each class gets the form that is best on all others."""
    clusters = _clusters(pairs)
    right = np.stack([_right(pairs, form) for form in forms])
    total = 0.0
    for cluster in np.unique(clusters):
        inside = clusters == cluster
        best = right[:, ~inside].mean(axis=1).argmax() if not inside.all() else 0
        total += right[best, inside].sum()
    return total / len(pairs)


def _luck(pairs, forms):
    """P(the best of all forms does as well) where the signs of an instance's differences are drawn anew."""
    right = np.stack([_right(pairs, form) for form in forms])
    instances = pairs["instance"].astype("category").cat.codes.to_numpy()
    signs = np.random.default_rng(0).integers(0, 2, (RESAMPLES, instances.max() + 1)) * 2 - 1
    drawn = 0.5 + (right - 0.5) @ signs[:, instances].T / len(pairs)
    return (1 + (drawn.max(axis=0) >= right.mean(axis=1).max() - 1e-12).sum()) / (1 + RESAMPLES)


if __name__ == "__main__":
    main()
