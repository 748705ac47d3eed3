"""The table of states already found, on disk: each entry is a whole state and its index, in the first free slot from
its hash's.

entries (slots, W + 1) uint64, a mapped file: W words of a state, then 1 + its index, 0 in a free slot, or NEW + j while
it waits for its number. Memory is read and written in order of slots: many candidates are first sorted by the 16
highest bits of their hash, their bucket, which are the highest bits of their slot in a table of any size.

keys (M, W) uint64: candidates; indices (M,) int64: -1 - bucket, or an index where it is known; order (M,) int32:
candidates that are looked up, by bucket, each bucket in the order of candidates.
"""

import numpy as np
from numba import int64, njit, uint64

from pharos.kernels.hash_table import COUNT, DEPTH, FIRST, LEVEL_END, hash_of_row, prefetch, slot_of

BUCKETS = 1 << 16
_AHEAD = 16
_FEW = 1 << 12  # candidates that are not worth sorting
_NEW = uint64(1 << 63)


@njit(forceinline=True)
def _slot_for(entries, keys, j):
    """(slot, its entry): where keys[j] is, or the free slot where it belongs."""
    capacity, words = entries.shape[0], keys.shape[1]
    slot = slot_of(hash_of_row(keys, j), capacity)
    while True:
        entry = entries[slot, words]
        if entry == 0:
            return slot, entry
        equal = True
        for k in range(words):
            equal = equal and entries[slot, k] == keys[j, k]
        if equal:
            return slot, entry
        slot = slot + 1 if slot + 1 < capacity else 0


@njit(forceinline=True)
def _enter(entries, slot, keys, j, entry):
    """Put keys[j] into a slot, with what is said of it."""
    words = keys.shape[1]
    for k in range(words):
        entries[slot, k] = keys[j, k]
    entries[slot, words] = entry


@njit(cache=True, nogil=True)
def sort_by_bucket(indices, first, order):
    """Fill order; returns its length. indices[j] >= 0, a state in this block that leads to itself, gets its index:
    first + indices[j].
    """
    size = 0
    if len(indices) <= _FEW:
        for j in range(len(indices)):
            if indices[j] >= 0:
                indices[j] += first
            else:
                order[size] = j
                size += 1
        return size
    place = np.zeros(BUCKETS + 1, np.int64)
    for j in range(len(indices)):
        if indices[j] >= 0:
            indices[j] += first
        else:
            place[-indices[j]] += 1
            size += 1
    for bucket in range(BUCKETS):
        place[bucket + 1] += place[bucket]
    for j in range(len(indices)):
        if indices[j] < 0:
            bucket = -1 - indices[j]
            order[place[bucket]] = j
            place[bucket] += 1
    return size


@njit(cache=True, nogil=True)
def look_up(entries, keys, order, low, high, indices, slots):
    """indices[j] for candidates order[low:high]: its index; -1 where it is new, slots[j] then being its slot; -2 - i
    where i is equal.
    """
    capacity = entries.shape[0]
    for p in range(low, high):
        if p + _AHEAD < high:
            prefetch(entries, slot_of(hash_of_row(keys, order[p + _AHEAD]), capacity))
        j = order[p]
        slot, entry = _slot_for(entries, keys, j)
        slots[j] = -1
        if entry == 0:
            _enter(entries, slot, keys, j, _NEW | uint64(j))
            indices[j] = -1
            slots[j] = slot
        elif entry & _NEW:
            indices[j] = -2 - int64(entry ^ _NEW)
        else:
            indices[j] = int64(entry) - 1


@njit(cache=True, nogil=True)
def number(keys, indices, successors, states, appended, progress):
    """Number what is new in the order of candidates, into states[count - appended :]; row i of successors (rows, A) is
    state progress[FIRST] + i.

    `progress` goes on by these rows.
    """
    first, count, level_end, depth = progress[FIRST], progress[COUNT], progress[LEVEL_END], progress[DEPTH]
    rows, num_actions = successors.shape
    for i in range(rows):
        for a in range(num_actions):
            j = i * num_actions + a
            if indices[j] == -1:
                for k in range(keys.shape[1]):
                    states[count - appended, k] = keys[j, k]
                indices[j] = count
                count += 1
            elif indices[j] < 0:
                indices[j] = indices[-2 - indices[j]]  # an earlier candidate
            successors[i, a] = indices[j]
        if first + i + 1 == level_end:
            level_end = count
            depth += 1
    progress[FIRST], progress[COUNT], progress[LEVEL_END], progress[DEPTH] = first + rows, count, level_end, depth


@njit(cache=True, nogil=True)
def settle(entries, order, low, high, indices, slots):
    """Give the new entries of candidates order[low:high] their numbers."""
    words = entries.shape[1] - 1
    for p in range(low, high):
        j = order[p]
        if slots[j] >= 0:
            entries[slots[j], words] = uint64(indices[j] + 1)


@njit(cache=True, nogil=True)
def place(entries, keys, order, low, high, first):
    """Put states order[low:high] of keys, not there yet, into the table; state j has index first + j."""
    for p in range(low, high):
        j = order[p]
        slot, _ = _slot_for(entries, keys, j)
        _enter(entries, slot, keys, j, uint64(first + j + 1))


@njit(cache=True, nogil=True)
def place_from_memory(entries, table, states, low, high):
    """Put the states in slots [low, high) of a table in memory (hash_table.py) into an empty table."""
    for i in range(low, high):
        if i + _AHEAD < high and table[i + _AHEAD] >= 0:
            prefetch(states, int64(table[i + _AHEAD]))
        index = int64(table[i])
        if index >= 0:
            slot, _ = _slot_for(entries, states, index)
            _enter(entries, slot, states, index, uint64(index + 1))


@njit(cache=True, nogil=True)
def place_again(entries, old, low, high):
    """Put the entries in slots [low, high) of an old table into a larger one."""
    words = old.shape[1] - 1
    keys = old[:, :words]
    for i in range(low, high):
        if old[i, words] > 0:
            slot, _ = _slot_for(entries, keys, i)
            _enter(entries, slot, keys, i, old[i, words])
