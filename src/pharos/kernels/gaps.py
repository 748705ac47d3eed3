"""Suboptimality gaps of blocks of states, and their sums; hardness/gaps/gaps.py says what they mean.

gap (N, A) float64 >= 0, 0 for the best actions; counted (N,) int64, how often a row counts.
"""

import math

import numpy as np
from numba import njit

from pharos.kernels.interpreted import interpreted_first

# Bin b of a histogram holds 10^((b - BIN_OF_ONE) / 4) <= gap < 10^((b + 1 - BIN_OF_ONE) / 4), for all floats.
BIN_OF_ONE = 1300
_BINS = 2 * BIN_OF_ONE
# Larger gaps, infinite ones, are in the bin of the largest floats.
_LARGEST = 1232.0


def empty_sums() -> np.ndarray:
    """(2, 4): the sums of 1 / gap, 1 / (gap + error), 1 / (gap - error) and 1 / (gap + regularizer), and what rounding
    took from each (Kahan)."""
    return np.zeros((2, 4))


def empty_counts() -> np.ndarray:
    """(3,): gaps that exceed the tolerance, those in (0, tolerance], and those of 0 beyond the first of a row."""
    return np.zeros(3, np.int64)


def empty_histogram() -> np.ndarray:
    """(B,): how many gaps above the tolerance are in each quarter of a decade."""
    return np.zeros(_BINS, np.int64)


@interpreted_first()
@njit(cache=True, nogil=True)
def differences(rewards, following, gamma):
    """(N, A): the largest r + gamma x of a row, less each; rewards r, following x (N, A)."""
    num_states, num_actions = rewards.shape
    gap = np.empty((num_states, num_actions))
    for i in range(num_states):
        best = -np.inf
        for a in range(num_actions):
            gap[i, a] = rewards[i, a] + gamma * following[i, a]
            best = max(best, gap[i, a])
        for a in range(num_actions):
            gap[i, a] = best - gap[i, a]
    return gap


@interpreted_first("gap")
@njit(cache=True, nogil=True, error_model="numpy")
def add_up(gap, weight, counted, minimal, tolerance, error, regularizer, sums, counts, histogram):
    """Add the gaps of a block to sums, counts and histogram: regularized ones as often as weight (N,) says, others as
    often as their rows count. Returns the smallest gap above the tolerance, or `minimal` where that is smaller."""
    for i in range(len(gap)):
        regularized = 0.0
        for a in range(gap.shape[1]):
            regularized += 1.0 / (gap[i, a] + regularizer)
        _add(sums, 3, weight[i] * regularized)
        times = counted[i]
        if times == 0:
            continue
        total, low, high = 0.0, 0.0, 0.0
        num_large, num_zero = 0, 0
        for a in range(gap.shape[1]):
            each = gap[i, a]
            if each > tolerance:
                num_large += 1
                total += 1.0 / each
                low += 1.0 / (each + error)
                high += 1.0 / (each - error)
                minimal = min(minimal, each)
                histogram[BIN_OF_ONE + math.floor(min(4.0 * math.log10(each), _LARGEST))] += times
            elif each == 0.0:
                num_zero += 1
        counts[0] += times * num_large
        counts[1] += times * (gap.shape[1] - num_large - num_zero)
        counts[2] += times * (num_zero - 1)
        if num_large:
            _add(sums, 0, times * total)
            _add(sums, 1, times * low)
            _add(sums, 2, times * high)
    return minimal


@njit(cache=True, nogil=True)
def _add(sums, k, value):
    """Kahan's sum: its error is two units, however many numbers there are."""
    value -= sums[1, k]
    total = sums[0, k] + value
    sums[1, k] = (total - sums[0, k]) - value if math.isfinite(total) else 0.0
    sums[0, k] = total
