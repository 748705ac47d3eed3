"""Makers of the kernels that enumerate states: they call the rules of one class, on packed states.

Each maker is an ordinary function that returns compiled ones (see `compiler.Compiler`). What the inner functions take
from it are constants for Numba: the rules; `Parameters`, what the rules see as `self`; W words a state; A actions.
`layout` is a tuple of one table (D, 4): where component i of a state sits (layout.py).

Classes with chance or an age have kernels of branching.py, which takes the search from here: A is the number of
branches of a state then, and `terminal` whatever their `expand` writes beside the successors.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import int64

from pharos.kernels.hash_table import COUNT, DEPTH, FAULT, FIRST, LEVEL_END, entry_at, mixed, prefetch, slot_of
from pharos.rules.packed_view import fault, get_word, packed_view, read_only_view, set_word

BATCH = 16  # states expanded before their successors are looked up: enough look-ups to hide the memory's latency


class ExplorationKernels(NamedTuple):
    """The compiled kernels; see the makers below."""

    explore: Any
    expand_and_find: Any
    rewards_of: Any


class Words(NamedTuple):
    """Functions on states of W words."""

    load: Any
    hash_of: Any
    same: Any


def exploration(compiler: Any, rules: object, Parameters: object, W: int, A: int) -> ExplorationKernels:
    """The kernels of a class of environments whose states take W words and which has A actions."""
    search = compiler.calling("transition", "is_terminal")
    words = words_functions(search, W)
    expand = expand_function(search, rules, Parameters, words, W, A)
    prefetch_states = prefetch_function(search, A)
    return ExplorationKernels(
        explore=explore_kernel(search, expand, prefetch_states, words, W, A),
        expand_and_find=expand_and_find_kernel(search, expand, prefetch_states, words, A),
        rewards_of=rewards_of_kernel(compiler.calling("reward"), rules, Parameters, words, W, A),
    )


def words_functions(compiler: Any, W: int) -> Words:
    """Reading, hashing and comparing states of W words."""

    @compiler.inlined
    def load(view, states, index):
        for k in range(W):
            set_word(view, k, states[index, k])

    @compiler.inlined
    def hash_of(keys, j):
        h = mixed(keys[j, 0])
        for k in range(1, W):
            h = mixed(h ^ keys[j, k])
        return h

    @compiler.inlined
    def same(keys, j, states, index):
        for k in range(W):
            if keys[j, k] != states[index, k]:
                return False
        return True

    return Words(load, hash_of, same)


def expand_function(compiler: Any, rules: Any, Parameters: Any, words: Words, W: int, A: int) -> Any:
    """Successors of a few states, and where in the table to look for them."""
    transition, is_terminal = rules["transition"], rules["is_terminal"]
    load, hash_of, _ = words
    WORDS = (0,) * W

    @compiler.function
    def expand(parameters, layout, states, first, n, keys, slots, terminal, row, table, progress):
        """Successors of states [first, first + n): packed words to keys, slots from which to search to slots, -1 if
        terminal.

        keys (n * A, W), slots (n * A,); terminal[row + i] gets whether state first + i is terminal. The slots are
        prefetched.
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
            for j in range(i * A, (i + 1) * A):
                if ended:
                    slots[j] = -1
                    continue
                load(out, states, first + i)
                transition(self, state, j - i * A, out)
                for k in range(W):
                    keys[j, k] = get_word(out, k)
                slots[j] = slot_of(hash_of(keys, j), capacity)
                prefetch(table, slots[j])
        progress[FAULT] = max(fault(state), fault(out))

    return expand


def prefetch_function(compiler: Any, A: int) -> Any:
    """Fetching the states that look-ups will meet."""

    @compiler.inlined
    def prefetch_states(table, states, slots, n):
        """Fetch the states that sit in the slots, which will be compared soon."""
        for j in range(n * A):
            if slots[j] >= 0:
                index = entry_at(table, slots[j])
                if index >= 0:
                    prefetch(states, index)

    return prefetch_states


def explore_kernel(compiler: Any, expand: Any, prefetch_states: Any, words: Words, W: int, A: int) -> Any:
    """The search by one thread."""
    same = words.same

    @compiler.kernel
    def explore(parameters, layout, states, successors, terminal, table, base, last, room, progress):
        """Breadth-first search: expand states from progress[FIRST] on, in order, until `last` or until `room` is used
        up.

        states (capacity, W) uint64: the states of the search, in the order of discovery: progress[COUNT] of them.
        successors (rows, A), terminal (rows,) uint8: row i belongs to state base + i.
        table (slots,): index of a state, or -1; its place follows from the hash of the state.
        While one batch is looked up, the next one is expanded already where it is known: memory has that long to
        answer.
        """
        keys = np.empty((2, BATCH * A, W), np.uint64)
        slots = np.empty((2, BATCH * A), np.int64)
        capacity = table.shape[0]
        first, count = progress[FIRST], progress[COUNT]
        level_end, depth = progress[LEVEL_END], progress[DEPTH]
        waiting, buffer = 0, 0  # states [first, first + waiting) are expanded, in the other buffer
        while True:
            n = 0
            if count + 2 * BATCH * A <= room:
                n = max(0, min(BATCH, count - first - waiting, last - first - waiting))
            if n == 0 and waiting == 0:
                break
            if n > 0:
                progress[COUNT] = count
                ahead = first + waiting
                batch, places = keys[buffer], slots[buffer]
                expand(parameters, layout, states, ahead, n, batch, places, terminal, ahead - base, table, progress)
                if progress[FAULT]:
                    return
            buffer = 1 - buffer
            for i in range(waiting):
                for a in range(A):
                    j = i * A + a
                    slot = slots[buffer, j]
                    index = first + i
                    while slot >= 0:
                        index = int64(table[slot])
                        if index < 0:
                            index = count
                            for k in range(W):
                                states[count, k] = keys[buffer, j, k]
                            table[slot] = count
                            count += 1
                            break
                        if same(keys[buffer], j, states, index):
                            break
                        slot = slot + 1 if slot + 1 < capacity else 0
                    successors[first + i - base, a] = index
                if first + i + 1 == level_end:
                    level_end = count
                    depth += 1
            first += waiting
            prefetch_states(table, states, slots[1 - buffer], n)
            waiting = n
        progress[FIRST], progress[COUNT] = first, count
        progress[LEVEL_END], progress[DEPTH] = level_end, depth

    return explore


def expand_and_find_kernel(compiler: Any, expand: Any, prefetch_states: Any, words: Words, A: int) -> Any:
    """The part of a wide frontier that threads share."""
    same = words.same

    @compiler.kernel
    def expand_and_find(parameters, layout, states, start, stop, base, keys, indices, terminal, table, progress):
        """Successors of states [start, stop), and the indices of those that the table has.

        keys ((rows * A), W) gets the successors' words; indices (rows * A,) their indices, or -1 - slot where the table
        has none; row i belongs to state base + i. The table is only read; another thread may insert meanwhile: what it
        inserts is found or not found, and the one that numbers the states searches on from the slot.
        """
        slots = np.empty((2, BATCH * A), np.int64)
        capacity = table.shape[0]
        waiting, buffer = 0, 0
        for batch in range(start, stop + BATCH, BATCH):
            n = max(0, min(BATCH, stop - batch))
            if n > 0:
                part = keys[(batch - base) * A : (batch - base + n) * A]
                places, row = slots[buffer], batch - base
                expand(parameters, layout, states, batch, n, part, places, terminal, row, table, progress)
                if progress[FAULT]:
                    return
            buffer = 1 - buffer
            before = batch - BATCH
            first = (before - base) * A
            for j in range(waiting * A):
                slot = slots[buffer, j]
                index = before + j // A
                while slot >= 0:
                    index = entry_at(table, slot)
                    if index < 0:
                        index = -1 - slot
                        break
                    if same(keys, first + j, states, index):
                        break
                    slot = slot + 1 if slot + 1 < capacity else 0
                indices[first + j] = index
            prefetch_states(table, states, slots[1 - buffer], n)
            waiting = n

    return expand_and_find


def rewards_of_kernel(compiler: Any, rules: Any, Parameters: Any, words: Words, W: int, A: int) -> Any:
    """Rewards of stored transitions."""
    reward = rules["reward"]
    load = words.load
    WORDS = (0,) * W

    @compiler.kernel
    def rewards_of(parameters, layout, states, successors, terminal, start, stop, out):
        """out[i, a] = reward of the stored transition of state start + i; 0 in terminal states.

        Returns whether all are finite.
        """
        self = Parameters(*parameters)
        state = read_only_view(WORDS, *layout)
        following = read_only_view(WORDS, *layout)
        finite = True
        for s in range(start, stop):
            load(state, states, s)
            for a in range(A):
                value = 0.0
                if not terminal[s]:
                    load(following, states, int64(successors[s, a]))
                    value = float(reward(self, state, a, following))
                finite = finite and np.isfinite(value)
                out[s - start, a] = value
        return finite

    return rewards_of
