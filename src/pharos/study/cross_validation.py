"""Predictions for classes and MDPs that were left out, and statistics of them that count a class once.

Rows are cells: y (N,) an outcome, x (N, P) predictors, classes (N,) and mdps (N,) integers from 0. Cells of a class
share more than any predictor tells. So a line is fitted to other classes alone, each class weighs as much as any other
however many cells it has, intervals are over classes drawn anew, and permutations exchange whole classes.
"""

from collections.abc import Sequence

import numpy as np

from pharos.statistics import PERMUTED, class_weights, ranks, spearman

MOST_RANKED = 400
Counts = np.ndarray
"""(R, C) how often each class counts in each of R samples."""


def class_predictions(x: np.ndarray, y: np.ndarray, blocks: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """(N,): each block of rows predicted by least squares through all other rows, classes weighing alike."""
    estimates = np.empty(len(y))
    for block in np.unique(blocks):
        out = blocks == block
        rest = np.unique(classes[~out], return_inverse=True)[1]
        root = np.sqrt(class_weights(rest))[:, None]
        design = _with_one(x[~out])
        scale = np.abs(design).max(axis=0)
        scale[scale == 0] = 1.0
        line = np.linalg.lstsq(root * design / scale, root[:, 0] * y[~out], rcond=1e-10)[0]
        estimates[out] = (_with_one(x[out]) / scale) @ line
    return estimates


def calibration(y: np.ndarray, predicted: np.ndarray, classes: np.ndarray) -> tuple[float, float]:
    """(slope, intercept) of y on what was predicted for left-out classes, classes weighing alike: (1, 0) is perfect."""
    weights = class_weights(classes)
    centred = predicted - weights @ predicted
    variance = float(weights @ centred**2)
    slope = float(weights @ (centred * y)) / variance if variance > 1e-15 else np.nan
    return slope, float(weights @ y) - slope * float(weights @ predicted)


def resampled_classes(count: int, resamples: int, seed: int) -> Counts:
    """(R, C) counts of classes drawn anew, at least three different ones in each sample. None for fewer than four
    classes, which make but one such sample."""
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(count, np.full(count, 1 / count), resamples)
    return drawn[((drawn > 0).sum(axis=1) >= 3) & (count > 3)]


def held_out(x: np.ndarray, y: np.ndarray, classes: np.ndarray, counts: Counts) -> tuple[np.ndarray, np.ndarray]:
    """((R,) R2, (R,) rho) of classes left out one by one, for samples of classes.

    A class that counts twice is left out both times, so none is predicted from itself. Its cells are ranked twice. Rank
    correlations are of at most MOST_RANKED samples, the others are NaN.
    """
    means = np.stack([x[classes == each].mean(axis=0) for each in range(classes.max() + 1)]).mean(axis=0)
    spread = x.std(axis=0)
    # Squared errors of each class under the line through the others, from the moments of classes
    design = _with_one((x - means) / np.where(spread > 0, spread, 1.0))
    sizes = np.bincount(classes)
    products, targets = _moments(design, y, classes, sizes)
    lines = _lines(counts, products, targets)  # (R, C, P + 1): of the other classes
    squares = np.bincount(classes, y * y) / sizes
    errors = squares - 2 * np.einsum("rcp,cp->rc", lines, targets)
    errors += np.einsum("rcp,cpq,rcq->rc", lines, products, lines)
    total = counts.sum(axis=1)
    mean = counts @ (np.bincount(classes, y) / sizes) / total
    scores = 1 - (counts * errors).sum(axis=1) / total / (counts @ squares / total - mean**2)
    # Rank correlations need the predictions themselves
    rho = np.full(len(counts), np.nan)
    for r, count in enumerate(counts[:MOST_RANKED]):
        rows = np.repeat(np.arange(len(y)), count[classes])
        rho[r] = spearman(np.einsum("np,np->n", lines[r, classes[rows]], design[rows]), y[rows])
    return scores, rho


def _moments(
    design: np.ndarray, y: np.ndarray, classes: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means of x x' (C, P, P) and x y (C, P) of each class."""
    number, width = len(sizes), design.shape[1]
    products, targets = np.zeros((number, width, width)), np.zeros((number, width))
    np.add.at(products, classes, design[:, :, None] * design[:, None, :])
    np.add.at(targets, classes, design * y[:, None])
    return products / sizes[:, None, None], targets / sizes[:, None]


def _lines(counts: Counts, products: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """(R, C, P): for each sample and class, least squares through the other classes of the sample."""
    left = np.einsum("rc,cpq->rpq", counts, products)[:, None] - counts[:, :, None, None] * products
    right = (counts @ targets)[:, None] - counts[:, :, None] * targets
    return np.einsum("rcpq,rcq->rcp", np.linalg.pinv(left, rcond=1e-10, hermitian=True), right)


def permuted_classes(
    x: np.ndarray, y: np.ndarray, classes: np.ndarray, positions: Sequence[object], permutations: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """((1 + R,) R2, (1 + R,) rho) of left-out classes if each class has the predictors of another one.

    First as it is, then for R permutations of classes. Only positions that all classes have are looked at. NaN if there
    are fewer than three.

    Args:
        positions: (N,) what a row is within its class, such as (its first instance, plain, vector). A row gets the
            predictors of the row at the same position of the other class.
    """
    number = classes.max() + 1
    keys = {position: i for i, position in enumerate(dict.fromkeys(positions))}
    row_at = np.full((number, len(keys)), -1)
    row_at[classes, [keys[each] for each in positions]] = np.arange(len(y))
    row_at = row_at[:, (row_at >= 0).all(axis=0)]
    if row_at.shape[1] < 3 or np.ptp(y[row_at]) == 0:
        return np.full(1 + permutations, np.nan), np.full(1 + permutations, np.nan)
    rng = np.random.default_rng(seed)
    orders = np.stack([np.arange(number), *(rng.permutation(number) for _ in range(permutations))])
    values, aims = (x - x.mean(axis=0)) / np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0), y[row_at]
    parts = [_exchanged(values[row_at], aims, some) for some in np.array_split(orders, len(orders) // PERMUTED + 1)]
    return np.concatenate([one for one, _ in parts]), np.concatenate([other for _, other in parts])


def _exchanged(x: np.ndarray, y: np.ndarray, orders: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((R,) R2, (R,) rho) of left-out classes, x (C, K, P), y (C, K). Class c has the x of class orders[r, c]."""
    design = np.concatenate([np.ones((*x.shape[:2], 1)), x], axis=2)
    products = np.einsum("ckp,ckq->cpq", design, design)[orders]
    targets = np.einsum("dkp,ck->dcp", design, y)[orders, np.arange(len(y))]
    left = products.sum(axis=1, keepdims=True) - products
    lines = np.einsum(
        "rcpq,rcq->rcp",
        np.linalg.pinv(left, rcond=1e-10, hermitian=True),
        targets.sum(axis=1, keepdims=True) - targets,
    )
    predicted = np.einsum("rckp,rcp->rck", design[orders], lines).reshape(len(orders), -1)
    aims = y.ravel()
    scores = 1 - ((aims - predicted) ** 2).mean(axis=1) / aims.var()
    of_predicted, of_aims = ranks(predicted), ranks(aims)
    of_predicted, of_aims = of_predicted - of_predicted.mean(axis=1, keepdims=True), of_aims - of_aims.mean()
    lengths = np.linalg.norm(of_predicted, axis=1) * np.linalg.norm(of_aims)
    return scores, np.divide(of_predicted @ of_aims, lengths, out=np.full(len(orders), np.nan), where=lengths > 0)


def ceiling(means: np.ndarray, noise: np.ndarray, classes: np.ndarray) -> float:
    """The largest R2 that a predictor can reach, as the mean of a cell's seeds is not its expectation.

        1 - mean of noise / variance of the cells' means, classes weighing alike

    Args:
        means, noise: (N,) of cells: the mean over seeds, and the variance over seeds / seeds. NaN for a single seed.
    Returns:
        NaN if no cell has two seeds.
    """
    finite, weights = np.isfinite(noise), class_weights(classes)
    total = float(weights @ (means - weights @ means) ** 2)
    if not finite.any() or total <= 0:
        return np.nan
    return 1 - float(weights[finite] @ noise[finite] / weights[finite].sum()) / total


def partial_correlation(
    x: np.ndarray, y: np.ndarray, others: np.ndarray, classes: np.ndarray, counts: Counts
) -> np.ndarray:
    """(R,) rank correlation of x (N,) and y given the ranks of other predictors (N, Q), for samples of classes."""
    columns = ranks(np.vstack([x, y, others.T])).T / len(y)
    sizes, correlations = np.bincount(classes), np.empty(len(counts))
    for r, count in enumerate(counts):
        root = np.sqrt((count / sizes)[classes])
        design = root[:, None] * _with_one(columns[:, 2:])
        left = root[:, None] * columns[:, :2]
        left = left - design @ np.linalg.lstsq(design, left, rcond=1e-10)[0]
        lengths = np.linalg.norm(left, axis=0)
        correlations[r] = left[:, 0] @ left[:, 1] / lengths.prod() if (lengths > 1e-9).all() else np.nan
    return correlations


def _with_one(x: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(x)), x])
