"""Bounds on the probability that each of several means of m samples is the largest, from bounds on their tails.

Each distribution is cut into 100 parts of equal probability; `low` and `high` enclose the part. For N rows of n means:
lower[i, a] = sum over parts of 1/100 prod over b != a of P(mean b < low), upper the same with P(mean b <= high).
"""

import math

import numpy as np
from numba import njit

PARTS = 100


@njit(cache=True, nogil=True)
def _below(distance, m, width, variance):
    """Bernstein: P(mean <= expectation - distance) is at most this."""
    if distance <= 0:
        return 1.0
    if distance == math.inf or variance + width * distance == 0:
        return 0.0
    return math.exp(-(distance**2) * m / 2 / (variance + width * distance / 3))


@njit(cache=True, nogil=True)
def _quantile(probability, m, width, variance):
    """The distance beyond which Bernstein leaves no more than this probability."""
    if width == 0 or variance == 0:
        return 0.0
    if probability <= 0:
        return math.inf
    bits = -math.log(probability)
    return (width * bits / m + math.sqrt(18 * variance / m * bits + (width * bits / m) ** 2)) / 3


@njit(cache=True, nogil=True)
def bernstein(means, widths, m, lower, upper):
    """Samples in intervals of length `widths` (N, n), whose variance is at most (best - mean) (mean - worst) = `upper`
    on entry."""
    n = means.shape[1]
    variances = np.empty(n)
    for row in range(len(means)):
        variances[:] = upper[row]
        lower[row] = 0.0
        upper[row] = 0.0
        for a in range(n):
            for part in range(PARTS):
                high = means[row, a] + _quantile(1 - (part + 1) / PARTS, m, widths[row, a], variances[a])
                low = means[row, a] - _quantile(part / PARTS, m, widths[row, a], variances[a])
                least = most = 1 / PARTS
                for b in range(n):
                    if b != a:
                        most *= _below(means[row, b] - high, m, widths[row, b], variances[b])
                        least *= 1 - _below(low - means[row, b], m, widths[row, b], variances[b])
                lower[row, a] += least
                upper[row, a] += most
