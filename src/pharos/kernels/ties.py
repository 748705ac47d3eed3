"""Counts and proofs of ties between actions; hardness/ties.py says what is proven.

gap (N, A) >= 0, 0 for the best actions; counted (N,) how often a row counts.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def count(gap, counted, tolerance):
    """(gaps in (0, tolerance], gaps of 0 beyond the first of a row): each as often as its row counts."""
    small, equal = 0, 0
    for i in range(len(gap)):
        if counted[i] == 0:
            continue
        zeros = 0
        for a in range(gap.shape[1]):
            if gap[i, a] == 0.0:
                zeros += 1
            elif gap[i, a] <= tolerance:
                small += counted[i]
        equal += counted[i] * (zeros - 1)
    return small, equal


@njit(cache=True, nogil=True)
def extend(own, rewards, following, gap, counted, begin, used, keys, rows, filled):
    """Map own[i, b] to (rewards, following) of each best action, and where there are several b to those of b as well.

    own (N, W), rewards, following (N, A): int64, the bits of floats. The map: used (C,) bool, keys (C,), rows (C, 2 or
    4) int64, with open addressing; C is a power of two.

    Returns:
        (i, filled): where it stopped, because all are done (i = N) or half of the places are taken, and how many those
        are; i = -1 where a key has two different rows.
    """
    for i in range(begin, len(gap)):
        if counted[i] == 0:
            continue
        if 2 * (filled + own.shape[1]) >= len(keys):
            return i, filled
        for a in range(gap.shape[1]):
            if gap[i, a] != 0.0:
                continue
            for b in range(own.shape[1]):
                c = b if own.shape[1] > 1 else a
                put = _put(own[i, b], rewards[i, a], following[i, a], rewards[i, c], following[i, c], used, keys, rows)
                if put < 0:
                    return -1, filled
                filled += put
    return len(gap), filled


@njit(cache=True, nogil=True)
def refill(old_used, old_keys, old_rows, used, keys, rows):
    """Put one map into a larger one."""
    for i in range(len(old_keys)):
        if old_used[i]:
            place = _place(old_keys[i], used, keys)
            used[place], keys[place] = True, old_keys[i]
            rows[place] = old_rows[i]


@njit(cache=True, nogil=True)
def _put(key, reward, following, other_reward, other_following, used, keys, rows):
    """1 where the key is new, 0 where it has this row, -1 where it has another."""
    place = _place(key, used, keys)
    if not used[place]:
        used[place], keys[place] = True, key
        rows[place, 0], rows[place, 1] = reward, following
        rows[place, 2], rows[place, 3] = other_reward, other_following
        return 1
    same = rows[place, 0] == reward and rows[place, 1] == following
    return 0 if same and rows[place, 2] == other_reward and rows[place, 3] == other_following else -1


@njit(cache=True, nogil=True)
def _place(key, used, keys):
    """Where the key is, or may be put. Its hash is the finalizer of SplitMix64: similar floats go to different
    places."""
    z = np.uint64(key)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mask = len(keys) - 1
    place = np.int64(z ^ (z >> np.uint64(31))) & mask
    while used[place] and keys[place] != key:
        place = (place + 1) & mask
    return place
