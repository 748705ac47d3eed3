"""Suboptimality gaps of blocks of states, and their sums; hardness/gaps.py says what they mean.

gap (N, A) float64 >= 0, 0 for the best actions; counted (N,) int64, how often a row counts.

Proofs of ties between actions; hardness/gaps.py says what is proven.

gap (N, A) >= 0, 0 for the best actions; counted (N,) how often a row counts. The map from values to what comes of them:
places (C, 3) int64, or (C, 5) where there are several previous actions, with open addressing: the bits of a value
(FREE where there is none), of the reward and the value that follow, and of those of the previous action; C is a power
of two.
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


# Ties -----------------------------------------------------------------------------------------------------------------


FREE = -1  # the bits of a NaN, which no value is


@interpreted_first("gap")
@njit(cache=True, nogil=True)
def extend(own, rewards, following, gap, counted, begin, places, filled):
    """Map own[i, b] to (rewards, following) of the best actions, and where there are several b to those of b as well.

    own (N, W), rewards, following (N, A): int64, the bits of floats. The best actions of a row have the same value, so
    they must have the same rewards and following; then one of them stands for all.

    Returns:
        (i, filled): where it stopped, because all are done (i = N) or half of the places are taken, and how many those
        are; i = -1 where a value has two different rows.
    """
    num_actions, width = gap.shape[1], own.shape[1]
    for i in range(begin, len(gap)):
        if counted[i] == 0:
            continue
        if 2 * (filled + width) >= len(places):
            return i, filled
        best = -1
        for a in range(num_actions):
            if gap[i, a] != 0.0:
                continue
            if best < 0:
                best = a
            elif rewards[i, a] != rewards[i, best] or following[i, a] != following[i, best]:
                return -1, filled
        if best < 0:
            continue
        for b in range(width):
            put = _put(own[i, b], rewards[i, best], following[i, best], rewards[i, b], following[i, b], places)
            if put < 0:
                return -1, filled
            filled += put
    return len(gap), filled


@interpreted_first()
@njit(cache=True, nogil=True)
def refill(old_places, places):
    """Put one map into a larger one."""
    for i in range(len(old_places)):
        if old_places[i, 0] != FREE:
            place = _place(old_places[i, 0], places)
            for k in range(places.shape[1]):
                places[place, k] = old_places[i, k]


@njit(cache=True, nogil=True)
def _put(key, reward, following, other_reward, other_following, places):
    """1 where the key is new, 0 where it has this row, -1 where it has another."""
    place = _place(key, places)
    is_new = places[place, 0] == FREE
    if is_new:
        places[place, 0], places[place, 1], places[place, 2] = key, reward, following
    elif places[place, 1] != reward or places[place, 2] != following:
        return -1
    if places.shape[1] > 3:
        if is_new:
            places[place, 3], places[place, 4] = other_reward, other_following
        elif places[place, 3] != other_reward or places[place, 4] != other_following:
            return -1
    return 1 if is_new else 0


@njit(cache=True, nogil=True)
def _place(key, places):
    """Where the key is, or may be put. Its hash is the finalizer of SplitMix64: similar floats go to different
    places."""
    z = np.uint64(key)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mask = len(places) - 1
    place = np.int64(z ^ (z >> np.uint64(31))) & mask
    while places[place, 0] != FREE and places[place, 0] != key:
        place = (place + 1) & mask
    return place
