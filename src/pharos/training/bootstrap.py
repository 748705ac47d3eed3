"""Bootstrap intervals: the one place where runs are resampled."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pharos.errors import ParameterError

# Numbers that one batch of resamples may hold
BATCH = 1 << 22


def bootstrap_interval(
    samples: Sequence[Any],
    statistic: Callable[..., np.ndarray],
    *,
    confidence: float = 0.95,
    resamples: int = 1000,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of the percentile bootstrap interval of a statistic of several samples.

    Each sample is resampled with replacement by itself: a stratified bootstrap, in which a sample of one observation
    stays as it is.

    Args:
        samples: arrays (..., N), N observations each; N may differ. The other axes are drawn together, such as all
            points of a curve, and are alike in all samples.
        statistic: `statistic(*samples, axis=-1)`, vectorised over all other axes.
        confidence, resamples, seed: of the bootstrap.
    Returns:
        lower, upper: of the shape of the statistic.
    Raises:
        ParameterError: there is no sample, or one is empty or has an entry that is not finite.
    Cost: `resamples` times the statistic, in batches.
    Source: Efron and Tibshirani (1993), An introduction to the bootstrap, section 13.3; computed by
        scipy.stats.bootstrap.
    """
    from scipy import stats

    arrays = [np.asarray(sample, np.float64) for sample in samples]
    if not arrays or any(array.ndim == 0 or array.shape[-1] == 0 for array in arrays):
        raise ParameterError(
            f"a bootstrap needs at least one run of each task; found {[array.size for array in arrays]}"
        )
    if not all(np.isfinite(array).all() for array in arrays):
        raise ParameterError("a bootstrap needs finite results; found NaN or infinity")
    varying = [array for array in arrays if array.shape[-1] > 1]
    if not varying:
        value = np.asarray(statistic(*arrays, axis=-1))
        return value, value

    def of_all(*drawn: np.ndarray, axis: int) -> np.ndarray:
        """The statistic of the drawn samples and of those that have nothing to draw from."""
        parts, batch = iter(drawn), drawn[0].shape[:-1]
        single = (
            next(parts) if array.shape[-1] > 1 else np.broadcast_to(_beside(array, len(batch)), (*batch, 1))
            for array in arrays
        )
        return statistic(*single, axis=axis)

    result = stats.bootstrap(
        varying,
        of_all,
        n_resamples=resamples,
        batch=max(1, BATCH // sum(array.size for array in arrays)),
        vectorized=True,
        axis=-1,
        confidence_level=confidence,
        method="percentile",
        random_state=np.random.default_rng(seed),
    )
    return np.asarray(result.confidence_interval.low), np.asarray(result.confidence_interval.high)


def _beside(array: np.ndarray, axes: int) -> np.ndarray:
    """A sample (..., 1) with an axis for the resamples before its last, where the batch has one."""
    return array if array.ndim == axes + 1 else np.expand_dims(array, -2)
