"""Aggregates over tasks and seeds: the interquartile mean and its stratified bootstrap interval.

Source: Agarwal et al. (2021), Deep reinforcement learning at the edge of the statistical precipice, section 4; computed
through scipy.stats (the authors' library does not import beside pandas 3).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pharos.errors import ParameterError


@dataclass(frozen=True)
class Estimate:
    """A value and its bootstrap interval at the given confidence."""

    value: float
    lower: float
    upper: float
    confidence: float


def interquartile_mean(*tasks: np.ndarray) -> float:
    """The mean of the middle half of all runs of all tasks pooled (25 % trimmed mean)."""
    from scipy import stats

    return float(stats.trim_mean(np.concatenate([np.ravel(task) for task in tasks]), 0.25))


def stratified_interval(
    tasks: Sequence[np.ndarray],
    *,
    statistic=interquartile_mean,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Estimate:
    """The percentile bootstrap interval of a statistic of several tasks, runs resampled within each task.

    Args:
        tasks: for each task an array of the results of its runs (seeds).
        statistic: of the arrays, one argument a task.
        confidence, resamples, seed: of the bootstrap.
    Raises:
        ParameterError: there is no task, a task has no run, or a result is not finite.
    Note: with five runs a task, percentile intervals are too narrow (about 85 % coverage for a nominal 95 %).
    Cost: resamples times the statistic.
    """
    arrays = [np.ravel(np.asarray(task, np.float64)) for task in tasks]
    if not arrays or any(len(array) == 0 for array in arrays):
        raise ParameterError(
            f"a bootstrap needs at least one run of each task; found {[len(array) for array in arrays]}"
        )
    if not all(np.isfinite(array).all() for array in arrays):
        raise ParameterError("a bootstrap needs finite results; found NaN or infinity")
    value = float(statistic(*arrays))
    rng = np.random.default_rng(seed)
    draws = np.array([statistic(*(rng.choice(array, len(array)) for array in arrays)) for _ in range(resamples)])
    tail = (1 - confidence) / 2
    lower, upper = np.quantile(draws, [tail, 1 - tail])
    return Estimate(value, float(lower), float(upper), confidence)
