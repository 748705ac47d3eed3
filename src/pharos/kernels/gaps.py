"""Suboptimality gaps of blocks of states, their sums, and proofs of ties. hardness/gaps.py says what they mean.

gap (N, A) float64 >= 0, 0 for the best actions. counted (N,) int64: how often a row counts.

A tie is proven if equal values have equal rewards and next values. The map from a value to these: entries (C, 3)
int64, or (C, 5) if there are several previous actions, with open addressing: the bits of a value (FREE if there
is none), of the reward and the value that follow, and the same two of the previous action. C is a power of two.
"""

import math

import numpy as np

from pharos.kernels.interpreted import interpreted_first
from pharos.kernels.kernel_cache import kernel

# Bin b of a histogram holds 10^((b - BIN_OF_ONE) / 4) <= gap < 10^((b + 1 - BIN_OF_ONE) / 4), for all floats.
BIN_OF_ONE = 1300
_BINS = 2 * BIN_OF_ONE
# Larger gaps, infinite ones, are in the bin of the largest floats.
_LARGEST = 1232.0


def empty_sums() -> np.ndarray:
    """(2, 4) zeros: sums of 1 / gap, 1 / (gap + error), 1 / (gap - error) and 1 / (gap + regularizer), with rounding.

    The second row holds the rounding errors that each sum has still to make up for (Kahan).
    """
    return np.zeros((2, 4))


def empty_counts() -> np.ndarray:
    """(3,) zeros: gaps that exceed the tolerance, those in (0, tolerance], and gaps of 0 beyond the first of a row."""
    return np.zeros(3, np.int64)


def empty_histogram() -> np.ndarray:
    """(B,) zeros: number of gaps above the tolerance in each quarter of a decade."""
    return np.zeros(_BINS, np.int64)


def bin_of(gap: float) -> int:
    """The bin of a gap."""
    return BIN_OF_ONE + (int(_LARGEST) if gap == math.inf else math.floor(min(4.0 * math.log10(gap), _LARGEST)))


@interpreted_first()
@kernel
def differences(rewards, next_values, gamma):
    """(N, A) gaps: the largest r + gamma x of a row, less each, for rewards r and next_values x (N, A)."""
    num_states, num_actions = rewards.shape
    gap = np.empty((num_states, num_actions))
    for i in range(num_states):
        best = -np.inf
        for a in range(num_actions):
            gap[i, a] = rewards[i, a] + gamma * next_values[i, a]
            best = max(best, gap[i, a])
        for a in range(num_actions):
            gap[i, a] = best - gap[i, a]
    return gap


@interpreted_first("gap")
@kernel(error_model="numpy")
def add_up(gap, weight, counted, minimal, tolerance, error, regularizer, sums, counts, histogram):
    """Add the gaps of a block to sums, counts and histogram. Returns the smallest gap above the tolerance so far.

    Regularized gaps count weight (N,) times, all others as often as their row counts. `minimal`: the smallest gap of
    earlier blocks.
    """
    for i in range(len(gap)):
        regularized = 0.0
        for a in range(gap.shape[1]):
            regularized += 1.0 / (gap[i, a] + regularizer)
        _add_exactly(sums, 3, weight[i] * regularized)
        # sums and counts of one row, added as often as it counts
        times = counted[i]
        if times == 0:
            continue
        total, low, high = 0.0, 0.0, 0.0
        num_large, num_zero = 0, 0
        for a in range(gap.shape[1]):
            value = gap[i, a]
            if value > tolerance:
                num_large += 1
                total += 1.0 / value
                low += 1.0 / (value + error)
                high += 1.0 / (value - error)
                minimal = min(minimal, value)
                histogram[BIN_OF_ONE + math.floor(min(4.0 * math.log10(value), _LARGEST))] += times
            elif value == 0.0:
                num_zero += 1
        counts[0] += times * num_large
        counts[1] += times * (gap.shape[1] - num_large - num_zero)
        counts[2] += times * (num_zero - 1)
        if num_large:
            _add_exactly(sums, 0, times * total)
            _add_exactly(sums, 1, times * low)
            _add_exactly(sums, 2, times * high)
    return minimal


@kernel
def _add_exactly(sums, k, value):
    """Add a value to sum k (Kahan's algorithm): its error is two units, however many numbers there are."""
    value -= sums[1, k]
    total = sums[0, k] + value
    sums[1, k] = (total - sums[0, k]) - value if math.isfinite(total) else 0.0
    sums[0, k] = total


# Ties -----------------------------------------------------------------------------------------------------------------


FREE_KEY = -1  # the bits of a NaN, which no value is


@interpreted_first("gap")
@kernel
def extend(values, rewards, next_values, gap, counted, begin, entries, filled):
    """Map values[i, b] to (rewards, next_values) of the best actions. If there are several b, also to those under b.

    values (N, W), rewards, next_values (N, A): int64, the bits of floats. The best actions of a row have the same
    value, so they must have the same rewards and next values. Then one of them stands for all.

    Returns:
        (i, filled): the row at which it stopped, because all are done (i = N) or half of the entries are taken, and how
        many those are. i = -1 if a value has two different rows.
    """
    num_actions, width = gap.shape[1], values.shape[1]
    for i in range(begin, len(gap)):
        if counted[i] == 0:
            continue
        if 2 * (filled + width) >= len(entries):
            return i, filled
        # a best action, with which all other ones must agree
        best = -1
        for a in range(num_actions):
            if gap[i, a] != 0.0:
                continue
            if best < 0:
                best = a
            elif rewards[i, a] != rewards[i, best] or next_values[i, a] != next_values[i, best]:
                return -1, filled
        if best < 0:
            continue
        # its reward and next value, by the value of the state
        for b in range(width):
            put = _put(values[i, b], rewards[i, best], next_values[i, best], rewards[i, b], next_values[i, b], entries)
            if put < 0:
                return -1, filled
            filled += put
    return len(gap), filled


@interpreted_first()
@kernel
def refill(old_entries, entries):
    """Copy a map into a larger one."""
    for i in range(len(old_entries)):
        if old_entries[i, 0] != FREE_KEY:
            index = _entry_of(old_entries[i, 0], entries)
            for k in range(entries.shape[1]):
                entries[index, k] = old_entries[i, k]


@kernel
def _put(key, reward, next_value, other_reward, other_next_value, entries):
    """Enter a key with its row. Returns 1 if the key is new, 0 if it has this row, -1 if it has another."""
    index = _entry_of(key, entries)
    is_new = entries[index, 0] == FREE_KEY
    if is_new:
        entries[index, 0], entries[index, 1], entries[index, 2] = key, reward, next_value
    elif entries[index, 1] != reward or entries[index, 2] != next_value:
        return -1
    if entries.shape[1] > 3:
        if is_new:
            entries[index, 3], entries[index, 4] = other_reward, other_next_value
        elif entries[index, 3] != other_reward or entries[index, 4] != other_next_value:
            return -1
    return 1 if is_new else 0


@kernel
def _entry_of(key, entries):
    """The index of a key in the map, or of the free entry in which it belongs.

    Its hash is the finalizer of SplitMix64: similar floats go to different entries.
    """
    z = np.uint64(key)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mask = len(entries) - 1
    index = np.int64(z ^ (z >> np.uint64(31))) & mask
    while entries[index, 0] != FREE_KEY and entries[index, 0] != key:
        index = (index + 1) & mask
    return index
