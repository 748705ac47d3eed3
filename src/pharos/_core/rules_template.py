# mypy: ignore-errors
# ruff: noqa: F821
"""The kernels that call an environment's rules; a template, run once per class of environments by `compiling.py`.

Names that the template gets from there: the rules `transition`, `is_terminal`, `reward`, `draw`; `Parameters`, a namedtuple,
what the rules see as `self`; the constants NUM_WORDS, NUM_ACTIONS and WORDS, a tuple of NUM_WORDS zeros; CACHE, whether
compiled code is kept on disk.
`layout` stands for five (D,) tables (word, shift, mask, low, size): where component i of a state sits.
"""

import numpy as np
from numba import int64, njit

from pharos._core.hash_table import mixed, prefetch, slot_of
from pharos._core.packed import fault, get_word, packed_view, set_word

BATCH = 16  # states expanded before their successors are looked up: enough look-ups to hide the memory's latency
FIRST, COUNT, LEVEL_END, DEPTH, FAULT, FAULT_ACTION = range(6)  # fields of `progress`


@njit(forceinline=True)
def load(view, states, index):
    for k in range(NUM_WORDS):
        set_word(view, k, states[index, k])


@njit(forceinline=True)
def hash_of(keys, j):
    h = mixed(keys[j, 0])
    for k in range(1, NUM_WORDS):
        h = mixed(h ^ keys[j, k])
    return h


@njit(forceinline=True)
def same(keys, j, states, index):
    for k in range(NUM_WORDS):
        if keys[j, k] != states[index, k]:
            return False
    return True


@njit(forceinline=True)
def expand(self, state, out, states, index, keys, j, progress):
    """Write the packed successors of states[index] to keys[j : j + A]; return whether it is terminal."""
    load(state, states, index)
    ended = is_terminal(self, state)
    if not ended:
        for a in range(NUM_ACTIONS):
            load(out, states, index)
            transition(self, state, a, out)
            for k in range(NUM_WORDS):
                keys[j + a, k] = get_word(out, k)
            if fault(out) and not progress[FAULT]:
                progress[FAULT], progress[FAULT_ACTION] = fault(out), a
    if fault(state) and not progress[FAULT]:
        progress[FAULT], progress[FAULT_ACTION] = fault(state), -1
    return ended


@njit(cache=CACHE, nogil=True)
def explore(parameters, layout, states, successors, terminal, table, base, last, room, progress):
    """Breadth-first search: expand states from progress[FIRST] on, in order, until `last` or until `room` is used up.

    states (capacity, W) uint64: found so far, in the order of discovery: progress[COUNT] of them.
    successors (rows, A), terminal (rows,) uint8: row i belongs to state base + i.
    table (slots,): index of a state, or -1; its place follows from the hash of the state.
    """
    self = Parameters(*parameters)
    state = packed_view(WORDS, *layout)
    out = packed_view(WORDS, *layout)
    keys = np.empty((BATCH * NUM_ACTIONS, NUM_WORDS), np.uint64)
    slots = np.empty(BATCH * NUM_ACTIONS, np.int64)
    capacity = table.shape[0]
    first, count = progress[FIRST], progress[COUNT]
    level_end, depth = progress[LEVEL_END], progress[DEPTH]
    while first < count and first < last and count + BATCH * NUM_ACTIONS <= room:
        progress[FIRST], progress[COUNT] = first, count  # where to look, should a rule fail
        n = min(BATCH, count - first, last - first)
        for i in range(n):
            j = i * NUM_ACTIONS
            ended = expand(self, state, out, states, first + i, keys, j, progress)
            terminal[first + i - base] = ended
            for a in range(NUM_ACTIONS):
                slots[j + a] = -1
                if not ended:
                    slots[j + a] = slot_of(hash_of(keys, j + a), capacity)
                    prefetch(table, slots[j + a])
        if progress[FAULT]:
            break
        for j in range(n * NUM_ACTIONS):
            if slots[j] >= 0 and table[slots[j]] >= 0:
                prefetch(states, int64(table[slots[j]]))
        for i in range(n):
            for a in range(NUM_ACTIONS):
                j = i * NUM_ACTIONS + a
                slot = slots[j]
                found = first + i
                while slot >= 0:
                    found = int64(table[slot])
                    if found < 0:
                        found = count
                        for k in range(NUM_WORDS):
                            states[count, k] = keys[j, k]
                        table[slot] = count
                        count += 1
                        break
                    if same(keys, j, states, found):
                        break
                    slot = slot + 1 if slot + 1 < capacity else 0
                successors[first + i - base, a] = found
            if first + i + 1 == level_end:
                level_end = count
                depth += 1
        first += n
    progress[FIRST], progress[COUNT] = first, count
    progress[LEVEL_END], progress[DEPTH] = level_end, depth


@njit(cache=CACHE, nogil=True)
def expand_and_find(parameters, layout, states, start, stop, base, keys, found, terminal, table, progress):
    """The part of a wide frontier that threads share: successors of states [start, stop), and those already known.

    keys ((rows * A), W) gets the successors' words; found (rows * A,) their indices, or -1 - slot where one is not known yet;
    row i belongs to state base + i. The table is only read.
    """
    self = Parameters(*parameters)
    state = packed_view(WORDS, *layout)
    out = packed_view(WORDS, *layout)
    slots = np.empty(BATCH * NUM_ACTIONS, np.int64)
    capacity = table.shape[0]
    for batch in range(start, stop, BATCH):
        progress[FIRST] = batch
        n = min(BATCH, stop - batch)
        first = (batch - base) * NUM_ACTIONS
        for i in range(n):
            j = i * NUM_ACTIONS
            ended = expand(self, state, out, states, batch + i, keys, first + j, progress)
            terminal[batch + i - base] = ended
            for a in range(NUM_ACTIONS):
                slots[j + a] = -1
                if not ended:
                    slots[j + a] = slot_of(hash_of(keys, first + j + a), capacity)
                    prefetch(table, slots[j + a])
        if progress[FAULT]:
            return
        for j in range(n * NUM_ACTIONS):
            if slots[j] >= 0 and table[slots[j]] >= 0:
                prefetch(states, int64(table[slots[j]]))
        for j in range(n * NUM_ACTIONS):
            slot = slots[j]
            index = batch + j // NUM_ACTIONS
            while slot >= 0:
                index = int64(table[slot])
                if index < 0:
                    index = -1 - slot
                    break
                if same(keys, first + j, states, index):
                    break
                slot = slot + 1 if slot + 1 < capacity else 0
            found[first + j] = index


@njit(cache=CACHE, nogil=True)
def rewards_of(parameters, layout, states, successors, terminal, start, stop, out):
    """out[i, a] = reward of the stored transition of state start + i; 0 in terminal states. Returns whether all are finite."""
    self = Parameters(*parameters)
    state = packed_view(WORDS, *layout)
    following = packed_view(WORDS, *layout)
    finite = True
    for s in range(start, stop):
        load(state, states, s)
        for a in range(NUM_ACTIONS):
            value = 0.0
            if not terminal[s]:
                load(following, states, int64(successors[s, a]))
                value = float(reward(self, state, a, following))
            finite = finite and np.isfinite(value)
            out[s - start, a] = value
    return finite
