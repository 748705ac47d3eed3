"""Statistics of benchmark, study, plots and predictions: NumPy and SciPy alone, arrays in, numbers out.

Strata are tasks: an array of the values of its runs (seeds) for each. Runs are replications, tasks are fixed.

Intervals   of Student's t over strata (`standard_error`, `student_interval`, `fieller_interval`), which covers what it
            says with few runs, and of the stratified percentile bootstrap (`bootstrap_interval`), for any statistic.
Aggregates  `interquartile_mean`, `mean_of_means`, `probability_of_improvement`, `r_squared`.
Tests       `welch_p_value`, `permutation_p_value`, and `holm` for several of them.
Ranks       `ranks` and `spearman`, in which rounding makes no order.

Source: Agarwal et al. (2021), Deep reinforcement learning at the edge of the statistical precipice, for strata and
aggregates. Others stand at each function.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pharos.errors import ParameterError

CONFIDENCE = 0.95
TIE_TOLERANCE = 1e-9  # of the spread: what differs by less is rounding, and has one rank
ZERO_VARIANCE = 1e-30  # equal numbers whose mean is rounded vary by less
RESAMPLED = 1 << 22  # numbers that one batch of resamples may hold
PERMUTED = 250  # permutations at a time
GRID = 256  # points of a segment between two levels, between which `fieller_interval` looks for a root

Strata = Sequence[np.ndarray]
UNBOUNDED = (-math.inf, math.inf)


# Aggregates -----------------------------------------------------------------------------------------------------------


def interquartile_mean(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half of all values of all strata pooled: their 25 % trimmed mean.

        mean of the sorted values from number floor(n / 4) to n - floor(n / 4)

    Args:
        strata: arrays whose `axis` counts runs, alike in all other axes.
    Cost: O(n), without sorting.
    Source: Agarwal et al. (2021), section 4.3. With five runs a stratum, percentile intervals of it are too narrow
        (about 85 % coverage for a nominal 95 %).

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 90.0])))
    1.5
    """
    pooled = np.moveaxis(np.concatenate(strata, axis=axis), axis, -1)
    number = pooled.shape[-1]
    cut = number // 4
    return np.asarray(np.partition(pooled, (cut, number - cut - 1))[..., cut : number - cut].mean(axis=-1))


def mean_of_means(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean over strata of the mean over runs, which `axis` counts.

    >>> float(mean_of_means(np.array([1.0, 3.0]), np.array([6.0])))
    4.0
    """
    return np.mean([stratum.mean(axis=axis) for stratum in strata], axis=0)


def probability_of_improvement(ours: Strata, theirs: Strata, axis: int = -1) -> np.ndarray:
    """Return how probable it is that a run of ours scores higher than one of theirs, on a stratum drawn at random.

        P(X > Y) = mean over strata of the mean over pairs of runs of 1 if x > y, 1/2 if x = y

    Args:
        ours, theirs: for each stratum the scores of its runs along `axis`, the same strata in the same order.
    Source: Agarwal et al. (2021), section 4.3, and Mann and Whitney (1947).

    >>> float(probability_of_improvement([np.array([1.0, 2.0])], [np.array([1.0, 0.0])]))
    0.875
    """
    return np.mean([wins.mean(axis=(-1, -2)) for wins in _wins(ours, theirs, axis)], axis=0)


def improvement_error(ours: Strata, theirs: Strata) -> tuple[float, float]:
    """Return the standard error of `probability_of_improvement` and its degrees of freedom, as `standard_error`.

    Args:
        ours, theirs: for each stratum the (N,) scores of its runs.
    Source: DeLong et al. (1988): a run's placement is the share of the other side's runs that it beats.
    """
    wins = _wins(ours, theirs, -1)
    placements = [each.mean(axis=1) for each in wins] + [each.mean(axis=0) for each in wins]
    return standard_error(placements, [1.0 / len(wins)] * len(placements))


def _wins(ours: Strata, theirs: Strata, axis: int) -> list[np.ndarray]:
    """For each stratum (..., N, M): 1 if run n of ours scores higher than run m of theirs, 1/2 if equal, else 0."""
    pairs = [
        (np.moveaxis(one, axis, -1)[..., :, None], np.moveaxis(other, axis, -1)[..., None, :])
        for one, other in zip(ours, theirs, strict=True)
    ]
    return [(x > y) + 0.5 * (x == y) for x, y in pairs]


# Student's intervals over strata --------------------------------------------------------------------------------------


def standard_error(strata: Strata, weights: Sequence[float]) -> tuple[float, float]:
    """Return the standard error of a weighted sum of means, and its degrees of freedom.

        se^2 = sum of v_t,  v_t = w_t^2 s_t^2 / n_t;   df = (sum of v_t)^2 / sum of v_t^2 / (n_t - 1)

    Args:
        strata: (n_t,) values of each stratum. weights: w_t of each mean.
    Returns:
        NaN and NaN if a stratum has one run. 0 and infinity if the runs of every one agree.
    Source: Welch (1947), The generalization of Student's problem when several different population variances are
        involved, and Satterthwaite (1946), An approximate distribution of estimates of variance components.

    >>> standard_error([np.array([0.0, 2.0]), np.array([1.0, 1.0])], [0.5, 0.5])
    (0.5, 1.0)
    """
    sizes = np.array([len(own) for own in strata])
    if sizes.min() < 2:
        return math.nan, math.nan
    variances = np.array([weight**2 for weight in weights]) * _variances(strata) / sizes
    variances[variances < ZERO_VARIANCE] = 0.0
    total = variances.sum()
    if total == 0.0:
        return 0.0, math.inf
    shares = variances / total
    return math.sqrt(total), float(1.0 / (shares**2 / (sizes - 1)).sum())


def student_interval(
    value: float, error: float, degrees: float, bounds: tuple[float, float] = UNBOUNDED
) -> tuple[float, float, float]:
    """Return (value, low, high), the ends value -/+ t error of a 95 % interval, clipped to `bounds`.

    Args:
        error, degrees: as from `standard_error`. The ends are NaN if the error is.

    >>> [round(end, 3) for end in student_interval(0.5, 0.1, math.inf)]
    [0.5, 0.304, 0.696]
    """
    from scipy.special import stdtrit

    half = error * float(stdtrit(degrees, (1.0 + CONFIDENCE) / 2.0)) if error else error
    return value, max(value - half, bounds[0]), min(value + half, bounds[1])


def welch_p_value(difference: float, error: float, degrees: float) -> float:
    """Return the two-sided p-value of a difference of means, which `student_interval` excludes 0 by if p < 0.05.

    Args:
        error, degrees: as from `standard_error`. Without error any difference beyond rounding has p = 0.

    >>> round(welch_p_value(0.196, 0.1, math.inf), 3)
    0.05
    """
    from scipy.special import stdtr

    return float(2.0 * stdtr(degrees, -abs(difference) / error)) if error else float(abs(difference) < 1e-12)


def mean_interval(strata: Strata, bounds: tuple[float, float] = UNBOUNDED) -> tuple[float, float, float]:
    """Return (`mean_of_means`, low, high), with Student's 95 % interval, NaN without strata.

    >>> mean_interval([np.array([0.25, 0.25]), np.array([0.75, 0.75])])
    (0.5, 0.5, 0.5)
    """
    if not strata:
        return (math.nan,) * 3
    weights = [1.0 / len(strata)] * len(strata)
    return student_interval(float(mean_of_means(*strata)), *standard_error(strata, weights), bounds)


def interquartile_interval(strata: Strata, bounds: tuple[float, float] = UNBOUNDED) -> tuple[float, float, float]:
    """Return (`interquartile_mean`, low, high), with Student's 95 % interval, NaN without strata.

    The standard error is computed for twice the mean of runs winsorised at the pooled quartiles, over runs in strata.

    Source: Tukey and McLaughlin (1963), Less vulnerable confidence and significance procedures for location.
    """
    if not strata:
        return (math.nan,) * 3
    pooled = np.sort(np.concatenate(strata))
    cut = len(pooled) // 4
    value = float(pooled[cut : len(pooled) - cut].mean())  # the order of summands that published scores have
    inner = [np.clip(own, pooled[cut], pooled[-1 - cut]) for own in strata]
    weights = [2.0 * len(own) / len(pooled) for own in strata]
    return student_interval(value, *standard_error(inner, weights), bounds)


def fieller_interval(levels: np.ndarray, strata: Strata, target: float) -> tuple[float, float]:
    """Return the 95 % interval of the level at which a mean that is linear between levels crosses a target from below.

    It holds the levels at which Student's interval of the interpolated mean contains the target, with limits made
    increasing, as the mean is: the upper limit at a level is the smallest from there on, the lower one the largest up
    to there. So it runs from the last level whose upper limit is below the target to the first one whose lower limit is
    above it. If the first lies behind the second, between them. Both ends are roots, found to rounding between
    neighbours of 256 points of a segment.

    Args:
        levels: (L,) increasing. strata: for each level the values of its runs.
    Returns:
        NaN and NaN if a level has one run. -/+ infinity for an end beyond the first or last level.
    Source: Fieller (1954), Some problems in interval estimation.

    >>> fieller_interval(np.array([1.0, 3.0]), [np.array([0.0, 0.0]), np.array([1.0, 1.0])], target=0.5)
    (2.0, 2.0)
    """
    from scipy.optimize import brentq
    from scipy.special import stdtrit

    sizes = np.array([len(own) for own in strata])
    if sizes.min() < 2:
        return math.nan, math.nan
    means, variances = np.array([own.mean() for own in strata]), _variances(strata) / sizes
    variances[variances < ZERO_VARIANCE] = 0.0
    last = len(levels) - 1

    def excess(position: float | np.ndarray, side: int) -> np.ndarray:
        """Upper (side 1) or lower (side -1) limit of the mean less the target. Positions count levels from 0."""
        left = np.minimum(np.asarray(position).astype(int), max(last - 1, 0))
        right = np.minimum(left + 1, last)
        share = position - left
        parts = np.stack([(1.0 - share) ** 2 * variances[left], share**2 * variances[right]])
        total = parts.sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            degrees = total**2 / (parts[0] ** 2 / (sizes[left] - 1) + parts[1] ** 2 / (sizes[right] - 1))
            half = np.where(total > 0.0, stdtrit(degrees, (1.0 + CONFIDENCE) / 2.0) * np.sqrt(total), 0.0)
        return (1.0 - share) * means[left] + share * means[right] + side * half - target

    def level(left: float, right: float, side: int) -> float:
        root = brentq(excess, left, right, args=(side,), xtol=1e-15)
        return float(np.interp(root, np.arange(last + 1), levels))

    grid = np.linspace(0.0, last, GRID * last + 1)
    below, above = np.flatnonzero(excess(grid, 1) < 0.0), np.flatnonzero(excess(grid, -1) > 0.0)
    low, high = -math.inf, math.inf
    if below.size:
        end = below[-1]
        low = level(grid[end], grid[end + 1], 1) if end < len(grid) - 1 else float(levels[-1])
    if above.size:
        end = above[0]
        high = level(grid[end - 1], grid[end], -1) if end > 0 else float(levels[0])
    return min(low, high), max(low, high)


def _variances(strata: Strata) -> np.ndarray:
    return np.array([np.var(own, ddof=1) for own in strata])


# Bootstrap ------------------------------------------------------------------------------------------------------------


def bootstrap_interval(
    strata: Sequence[Any],
    statistic: Callable[..., np.ndarray],
    *,
    confidence: float = CONFIDENCE,
    resamples: int = 1000,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of the percentile bootstrap interval of a statistic of several strata.

    Each stratum is resampled with replacement by itself.

    Args:
        strata: arrays (..., N) of N runs each. N may differ. The other axes are drawn together, such as all points of
            a curve, and are alike in all strata.
        statistic: `statistic(*strata, axis=-1)`, vectorised over all other axes.
        confidence, resamples, seed: of the bootstrap.
    Returns:
        lower, upper: of the shape of the statistic. NaN if it is NaN for a resample, or if a stratum has one run: that
            does not say how runs vary.
    Raises:
        ParameterError: there is no stratum, or one is empty or has an entry that is not finite.
    Cost: `resamples` times the statistic, in batches.
    Source: Efron and Tibshirani (1993), An introduction to the bootstrap, section 13.3. Draws are the same as in
        scipy.stats.bootstrap.

    >>> low, high = bootstrap_interval([np.array([0.0, 1.0]), np.array([0.5, 0.5])], mean_of_means)
    >>> float(low), float(high)
    (0.25, 0.75)
    """
    arrays = [np.asarray(stratum, np.float64) for stratum in strata]
    if not arrays or any(array.ndim == 0 or array.shape[-1] == 0 for array in arrays):
        raise ParameterError(
            f"a bootstrap needs at least one run of each task; found {[array.size for array in arrays]}"
        )
    if not all(np.isfinite(array).all() for array in arrays):
        raise ParameterError("a bootstrap needs finite results; found NaN or infinity")
    if min(array.shape[-1] for array in arrays) == 1:
        nothing = np.full_like(np.asarray(statistic(*arrays, axis=-1), np.float64), np.nan)
        return nothing, nothing
    rng, values = np.random.default_rng(seed), []
    batch = max(1, RESAMPLED // sum(array.size for array in arrays))
    for first in range(0, resamples, batch):
        size = min(batch, resamples - first)
        drawn = [array[..., rng.integers(0, array.shape[-1], (size, array.shape[-1]))] for array in arrays]
        values.append(statistic(*drawn, axis=-1))
    ascending, tail = np.sort(np.concatenate(values, axis=-1), axis=-1), (1 - confidence) / 2
    return _quantile(ascending, tail), _quantile(ascending, 1 - tail)


def _quantile(ascending: np.ndarray, share: float) -> np.ndarray:
    """Linear interpolation between order statistics (..., R), rounded as scipy.stats.quantile, NaN if one is."""
    number = ascending.shape[-1]
    position = share * number + (1 - share)  # counted from 1
    above, fraction = min(int(position), number - 1), position % 1
    between = (1 - fraction) * ascending[..., above - 1] + fraction * ascending[..., above]
    return np.where(np.isnan(ascending[..., -1]), np.nan, between)


def percentiles(values: np.ndarray, *shares: float) -> np.ndarray:
    """Return percentiles, shares in [0, 100], of the values that are finite, NaN without any.

    >>> percentiles(np.array([1.0, np.nan, 3.0]), 50).tolist()
    [2.0]
    """
    finite = values[np.isfinite(values)]
    return np.percentile(finite, shares) if len(finite) else np.full(len(shares), np.nan)


# Tests ----------------------------------------------------------------------------------------------------------------


def permutation_p_value(value: float, permuted: np.ndarray) -> float:
    """Return the share of permutations whose statistic is as large, the observed order among them, NaN without any.

        p = (1 + number of permuted >= value) / (1 + R)

    Source: Phipson and Smyth (2010), Permutation p-values should never be zero.

    >>> permutation_p_value(2.0, np.array([0.0, 1.0, 2.0]))
    0.5
    """
    finite = permuted[np.isfinite(permuted)]
    if not np.isfinite(value) or len(finite) == 0:
        return np.nan
    return (1 + int((finite >= value - 1e-12).sum())) / (1 + len(finite))


def holm(p_values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return (N,) p-values after the step-down correction for their number. NaN stays NaN, and does not count.

        the k-th smallest of n times n - k + 1, not decreasing, at most 1

    Source: Holm (1979), A simple sequentially rejective multiple test procedure.

    >>> holm([0.02, 0.03, math.nan]).tolist()
    [0.04, 0.04, nan]
    """
    p = np.asarray(p_values, np.float64)
    finite = np.flatnonzero(np.isfinite(p))
    order = finite[np.argsort(p[finite], kind="stable")]
    corrected = np.full(len(p), np.nan)
    corrected[order] = np.minimum(np.maximum.accumulate((len(order) - np.arange(len(order))) * p[order]), 1.0)
    return corrected


# Fits and ranks -------------------------------------------------------------------------------------------------------


def class_weights(classes: np.ndarray) -> np.ndarray:
    """Return (N,) weights that sum to 1, the same sum for each class. `classes` (N,) are integers from 0.

    >>> class_weights(np.array([0, 0, 1])).tolist()
    [0.25, 0.25, 0.5]
    """
    sizes = np.bincount(classes)
    return 1.0 / sizes[classes] / len(sizes)


def r_squared(values: np.ndarray, errors: np.ndarray, classes: np.ndarray | None = None) -> float:
    """Return 1 - sum of squared errors / sum of squares about the mean, NaN if all values are equal.

    Args:
        values, errors: (N,) outcomes, and what a prediction of each lacks.
        classes: (N,) integers from 0, to weigh classes alike, each by `class_weights`. None: rows weigh alike.

    >>> r_squared(np.array([0.0, 2.0]), np.array([1.0, 0.0]))
    0.5
    """
    if classes is None:
        total, rest = float(((values - values.mean()) ** 2).sum()), float((errors**2).sum())
    else:
        weights = class_weights(classes)
        total, rest = float(weights @ (values - float(weights @ values)) ** 2), float(weights @ errors**2)
    return 1 - rest / total if total > 0 else math.nan


def ranks(values: np.ndarray) -> np.ndarray:
    """Return (..., N) ranks from 1 along the last axis. Ties share their mean rank.

    What lies within 1e-9 of the spread of its neighbour is tied, so equal predictors whose predictions differ in the
    last bits are ranked alike on every machine.

    >>> ranks(np.array([0.5, 0.1 + 0.2, 0.3])).tolist()
    [3.0, 1.5, 1.5]
    """
    from scipy.stats import rankdata

    values = np.asarray(values, np.float64)
    order = np.argsort(values, axis=-1, kind="stable")
    ascending = np.take_along_axis(values, order, axis=-1)
    is_new = np.diff(ascending, axis=-1) > TIE_TOLERANCE * np.ptp(ascending, axis=-1, keepdims=True)
    levels = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(is_new, axis=-1)], axis=-1)
    joined = np.empty_like(values)
    np.put_along_axis(joined, order, levels, axis=-1)
    return np.asarray(rankdata(joined, axis=-1))


def spearman(x: np.ndarray, y: np.ndarray) -> float:
    """Return the rank correlation of x (N,) and y by `ranks`, NaN with fewer than three rows, or if one is constant.

    >>> round(spearman(np.array([1.0, 2.0, 9.0]), np.array([0.3, 0.2, 0.1])), 9)
    -1.0
    """
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return np.nan
    return float(np.corrcoef(ranks(x), ranks(y))[0, 1])
