"""Kernels of a search by several processes: each owns the states whose hash falls to it, whoever finds them.

An owner has keys (capacity, W) uint64, states in the order in which it heard of them, and numbers (capacity,) int64:
the number of a state, or -1 - place while it waits for one, where place is the first of the places in the block that
lead to it. table (slots,) leads from the hash of a state to its entry, as in hash_table.py.
"""

import numpy as np
from numba import int64, njit, uint64

from pharos.kernels.hash_table import hash_of_row, prefetch, slot_of

_AHEAD = 16
_OWNER_BITS = 24  # the lowest of a hash, which the slots of tables below 2^32 of them do not depend on


@njit(cache=True, nogil=True)
def route(keys, indices, size, order, counts):
    """Sort candidates by their owners.

    keys (M, W); indices (M,): negative where a candidate is to be asked for. order (M,) int64 gets these candidates,
    those of the first owner first and each owner's in their order; counts (size,) int64 gets how many there are.
    """
    owners = np.empty(len(keys), np.int64)
    counts[:] = 0
    for j in range(len(keys)):
        if indices[j] < 0:
            low = hash_of_row(keys, j) & uint64((1 << _OWNER_BITS) - 1)
            owners[j] = int64((low * uint64(size)) >> uint64(_OWNER_BITS))
            counts[owners[j]] += 1
    place = np.zeros(size, np.int64)
    for owner in range(1, size):
        place[owner] = place[owner - 1] + counts[owner - 1]
    for j in range(len(keys)):
        if indices[j] < 0:
            order[place[owners[j]]] = j
            place[owners[j]] += 1


@njit(cache=True, nogil=True)
def claim(table, keys, numbers, count, candidates, places, entries):
    """Find the entry of each candidate that is asked for, and make one for each that is new.

    candidates (N, W), places (N,): states and where in the block they stand; entries (N,) int64 gets their entries. Of
    the places that lead to a new state the first is kept, whatever the order in which they come. Returns the number of
    entries.
    """
    capacity, words = table.shape[0], keys.shape[1]
    for j in range(len(candidates)):
        if j + _AHEAD < len(candidates):
            prefetch(table, slot_of(hash_of_row(candidates, j + _AHEAD), capacity))
        slot = slot_of(hash_of_row(candidates, j), capacity)
        while True:
            entry = int64(table[slot])
            if entry < 0:
                entry = count
                for k in range(words):
                    keys[count, k] = candidates[j, k]
                numbers[count] = -1 - places[j]
                table[slot] = count
                count += 1
                break
            equal = True
            for k in range(words):
                equal = equal and keys[entry, k] == candidates[j, k]
            if equal:
                if numbers[entry] < 0:
                    numbers[entry] = max(numbers[entry], -1 - places[j])
                break
            slot = slot + 1 if slot + 1 < capacity else 0
        entries[j] = entry
    return count
