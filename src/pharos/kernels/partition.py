"""Partitions of states: equal rows get equal numbers; classes split by where their members lead.

Exact: hashes only say where to look, and rows are compared entry by entry. `slots` is a hash table of at least twice as
many entries as rows, -1 where empty, that is empty again after each call.
"""

import numpy as np
from numba import njit, uint64

from pharos.kernels.hash_table import mixed


@njit(cache=True, nogil=True)
def number_rows(rows, before, slots, numbers):
    """numbers[i] = the same for equal pairs (before[i], rows[i]), counted in the order of appearance; returns how many.

    rows (N, W) uint8; before, numbers (N,) int64.
    """
    mask = len(slots) - 1
    count = 0
    for i in range(len(rows)):
        h = mixed(uint64(before[i]))
        for j in range(rows.shape[1]):
            h = (h ^ uint64(rows[i, j])) * uint64(0x100000001B3)
        h = mixed(h)
        slot = np.int64(h) & mask
        while True:
            other = slots[slot]
            if other < 0:
                slots[slot] = i
                numbers[i] = count
                count += 1
                break
            same = before[other] == before[i]
            for j in range(rows.shape[1]):
                if not same:
                    break
                same = rows[other, j] == rows[i, j]
            if same:
                numbers[i] = numbers[other]
                break
            slot = (slot + 1) & mask
    slots[:] = -1
    return count


def numbered_rows(rows, before=None):
    """((N,) int64, how many): equal rows (N, ...) get equal numbers, in the order in which they appear first.

    before (N,) int64: rows are equal only where these are, too.
    """
    rows = np.ascontiguousarray(rows)
    before = np.zeros(len(rows), np.int64) if before is None else before
    numbers = np.empty(len(rows), np.int64)
    count = number_rows(rows.view(np.uint8).reshape(len(rows), -1), before, slots_for(len(rows)), numbers)
    return numbers, count


def slots_for(rows):
    """An empty hash table for so many rows."""
    return np.full(1 << max(3, (2 * rows - 1).bit_length()), -1, np.int32 if rows < 2**31 else np.int64)


@njit(cache=True, nogil=True)
def states_to_ask(next_states, changed, candidates):
    """candidates[:n] = the states with a next state that changed its class; returns n."""
    n = 0
    for s in range(len(next_states)):
        for a in range(next_states.shape[1]):
            t = next_states[s, a]
            if t >= 0 and changed[t]:
                candidates[n] = s
                n += 1
                break
    return n


@njit(cache=True, nogil=True)
def split(next_states, classes, sizes, count, candidates, n, slots, used, new, changed):
    """Split classes by the classes that the asked states lead to; returns the number of classes.

    Members that are not asked lead where their class led before, and keep its number; so does the first group where all
    are asked. classes (S,), sizes (S,) members of each class; candidates (S,), of which n are asked; used, new (S,)
    scratch; changed (S,) bool: whose class changed.
    """
    mask = len(slots) - 1
    num_actions = next_states.shape[1]
    changed[:] = False
    members = np.zeros(count, np.int32)
    for i in range(n):
        members[classes[candidates[i]]] += 1
    for i in range(n):
        s = candidates[i]
        h = mixed(uint64(classes[s]))
        for a in range(num_actions):
            t = next_states[s, a]
            h = mixed(h ^ uint64(classes[t] if t >= 0 else -1))
        slot = np.int64(h) & mask
        while True:
            place = slots[slot]
            if place < 0:
                slots[slot] = i
                used[i] = slot
                c = classes[s]
                if members[c] == sizes[c]:  # all are asked, and this is the first group
                    members[c] = -1
                    new[i] = c
                else:
                    new[i] = count
                    count += 1
                break
            other = candidates[place]
            same = classes[other] == classes[s]
            for a in range(num_actions):
                if not same:
                    break
                t, u = next_states[s, a], next_states[other, a]
                same = (classes[t] if t >= 0 else -1) == (classes[u] if u >= 0 else -1)
            if same:
                used[i] = slot
                new[i] = new[place]
                break
            slot = (slot + 1) & mask
    for i in range(n):
        slots[used[i]] = -1
        s = candidates[i]
        if new[i] != classes[s]:
            sizes[classes[s]] -= 1
            sizes[new[i]] += 1
            classes[s] = new[i]
            changed[s] = True
    return count
