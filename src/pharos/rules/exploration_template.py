# mypy: ignore-errors
# ruff: noqa: F821
"""The kernels that call an environment's rules; a template, run once per class of environments by `compiling.py`.

Names that the template gets from there: the rules `transition`, `is_terminal`, `reward`, `draw`; `Parameters`, a namedtuple,
what the rules see as `self`; the constants NUM_WORDS, NUM_ACTIONS and WORDS, a tuple of NUM_WORDS zeros; CACHE, whether
compiled code is kept on disk.
`layout` is a tuple of one table (D, 4): where component i of a state sits (state_space/_packing.py).
"""

import numpy as np
from numba import int64, njit

from pharos.kernels.hash_table import mixed, prefetch, seen, slot_of
from pharos.rules.packed_view import fault, get_word, packed_view, read_only_view, set_word

BATCH = 16  # states expanded before their successors are looked up: enough look-ups to hide the memory's latency
FIRST, COUNT, LEVEL_END, DEPTH, FAULT = range(5)  # fields of `progress`


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


@njit(nogil=True)
def expand(parameters, layout, states, first, n, keys, slots, terminal, row, table, progress):
    """Successors of states [first, first + n): packed words to keys, slots from which to search to slots, -1 if terminal.

    keys (n * A, W), slots (n * A,); terminal[row + i] gets whether state first + i is terminal. The slots are prefetched.
    """
    self = Parameters(*parameters)
    state = read_only_view(WORDS, *layout)
    out = packed_view(WORDS, *layout)
    capacity = table.shape[0]
    progress[FIRST] = first  # where to look, should a rule fail
    for i in range(n):
        load(state, states, first + i)
        ended = is_terminal(self, state)
        terminal[row + i] = ended
        for j in range(i * NUM_ACTIONS, (i + 1) * NUM_ACTIONS):
            if ended:
                slots[j] = -1
                continue
            load(out, states, first + i)
            transition(self, state, j - i * NUM_ACTIONS, out)
            for k in range(NUM_WORDS):
                keys[j, k] = get_word(out, k)
            slots[j] = slot_of(hash_of(keys, j), capacity)
            prefetch(table, slots[j])
    progress[FAULT] = max(fault(state), fault(out))


@njit(forceinline=True)
def prefetch_states(table, states, slots, n):
    """Fetch the states that sit in the slots, which will be compared soon."""
    for j in range(n * NUM_ACTIONS):
        if slots[j] >= 0:
            index = seen(table, slots[j])
            if index >= 0:
                prefetch(states, index)


@njit(cache=CACHE, nogil=True)
def explore(parameters, layout, states, successors, terminal, table, base, last, room, progress):
    """Breadth-first search: expand states from progress[FIRST] on, in order, until `last` or until `room` is used up.

    states (capacity, W) uint64: found so far, in the order of discovery: progress[COUNT] of them.
    successors (rows, A), terminal (rows,) uint8: row i belongs to state base + i.
    table (slots,): index of a state, or -1; its place follows from the hash of the state.
    While one batch is looked up, the next one is expanded already where it is known: memory has that long to answer.
    """
    keys = np.empty((2, BATCH * NUM_ACTIONS, NUM_WORDS), np.uint64)
    slots = np.empty((2, BATCH * NUM_ACTIONS), np.int64)
    capacity = table.shape[0]
    first, count = progress[FIRST], progress[COUNT]
    level_end, depth = progress[LEVEL_END], progress[DEPTH]
    waiting, buffer = 0, 0  # states [first, first + waiting) are expanded, in the other buffer
    while True:
        n = 0
        if count + 2 * BATCH * NUM_ACTIONS <= room:
            n = max(0, min(BATCH, count - first - waiting, last - first - waiting))
        if n == 0 and waiting == 0:
            break
        if n > 0:
            progress[COUNT] = count
            ahead = first + waiting
            expand(
                parameters,
                layout,
                states,
                ahead,
                n,
                keys[buffer],
                slots[buffer],
                terminal,
                ahead - base,
                table,
                progress,
            )
            if progress[FAULT]:
                return
        buffer = 1 - buffer
        for i in range(waiting):
            for a in range(NUM_ACTIONS):
                j = i * NUM_ACTIONS + a
                slot = slots[buffer, j]
                found = first + i
                while slot >= 0:
                    found = int64(table[slot])
                    if found < 0:
                        found = count
                        for k in range(NUM_WORDS):
                            states[count, k] = keys[buffer, j, k]
                        table[slot] = count
                        count += 1
                        break
                    if same(keys[buffer], j, states, found):
                        break
                    slot = slot + 1 if slot + 1 < capacity else 0
                successors[first + i - base, a] = found
            if first + i + 1 == level_end:
                level_end = count
                depth += 1
        first += waiting
        prefetch_states(table, states, slots[1 - buffer], n)
        waiting = n
    progress[FIRST], progress[COUNT] = first, count
    progress[LEVEL_END], progress[DEPTH] = level_end, depth


@njit(cache=CACHE, nogil=True)
def expand_and_find(parameters, layout, states, start, stop, base, keys, found, terminal, table, progress):
    """The part of a wide frontier that threads share: successors of states [start, stop), and those already known.

    keys ((rows * A), W) gets the successors' words; found (rows * A,) their indices, or -1 - slot where one is not known yet;
    row i belongs to state base + i. The table is only read; another thread may insert meanwhile: what it inserts is found or
    not found, and the one that numbers the states searches on from the slot.
    """
    slots = np.empty((2, BATCH * NUM_ACTIONS), np.int64)
    capacity = table.shape[0]
    waiting, buffer = 0, 0
    for batch in range(start, stop + BATCH, BATCH):
        n = max(0, min(BATCH, stop - batch))
        if n > 0:
            part = keys[(batch - base) * NUM_ACTIONS : (batch - base + n) * NUM_ACTIONS]
            expand(parameters, layout, states, batch, n, part, slots[buffer], terminal, batch - base, table, progress)
            if progress[FAULT]:
                return
        buffer = 1 - buffer
        before = batch - BATCH
        first = (before - base) * NUM_ACTIONS
        for j in range(waiting * NUM_ACTIONS):
            slot = slots[buffer, j]
            index = before + j // NUM_ACTIONS
            while slot >= 0:
                index = seen(table, slot)
                if index < 0:
                    index = -1 - slot
                    break
                if same(keys, first + j, states, index):
                    break
                slot = slot + 1 if slot + 1 < capacity else 0
            found[first + j] = index
        prefetch_states(table, states, slots[1 - buffer], n)
        waiting = n


@njit(cache=CACHE, nogil=True)
def rewards_of(parameters, layout, states, successors, terminal, start, stop, out):
    """out[i, a] = reward of the stored transition of state start + i; 0 in terminal states. Returns whether all are finite."""
    self = Parameters(*parameters)
    state = read_only_view(WORDS, *layout)
    following = read_only_view(WORDS, *layout)
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
