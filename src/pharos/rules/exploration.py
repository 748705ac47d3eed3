"""Makers of the kernels that enumerate states: they call the rules of one class, on packed states.

Each maker is an ordinary function that returns compiled ones (see `compiler.Compiler`). The variables that the inner
functions take from it are constants for Numba: the rules; `Parameters`, the class of `self` in rules; W words a state;
A actions of at most K outcomes, 1 without chance.
`layout` is a tuple of one table (D, 4): the position of component i in a packed state (layout.py).

A state has A K branches, branch a K + k for outcome k of action a. With chance or an age the expansion is another one
(`expand_branches_function`), and the search the same with A K in place of A: an impossible branch is taken to lead to
the state itself with probability 0, as the branches of a terminal state do but for its first outcomes; `terminal` is
then the pair of arrays that the expansion writes beside the successors.
"""

from typing import NamedTuple

import numpy as np
from numba import int64

from pharos.kernels.hash_table import COUNT, DEPTH, FAULT, FIRST, LEVEL_END, entry_at, mixed, prefetch, slot_of
from pharos.rules.compiler import CompiledRules, Compiler, Constructor, Function
from pharos.rules.packed_view import fault, get_word, packed_view, read_only_view, set_word
from pharos.system.arrays import SUM_TOLERANCE

LOOKUP_BATCH = 16  # states expanded before their successors are looked up: enough look-ups to hide the memory's latency


class ExpansionKernels(NamedTuple):
    """Compiled kernels that expand states; see the makers below."""

    explore: Function
    expand_and_find: Function
    rewards_of: Function
    ages_of: Function


class Words(NamedTuple):
    """Functions on states of W words."""

    load: Function
    hash_of: Function
    same: Function


def exploration(
    compiler: Compiler, rules: CompiledRules, Parameters: Constructor, W: int, A: int, K: int = 1, pays: bool = False
) -> ExpansionKernels:
    """The kernels of a class of environments whose states take W words, with A actions of at most K outcomes.

    pays: whether its reward depends on the outcome.
    """
    search = compiler.calling(*(rule for rule in rules if rule not in ("reward", "draw", "draw_motion")))
    words = words_functions(search, W)
    prefetch_states = prefetch_function(search, A * K)
    if K > 1 or "age" in rules:
        expand = expand_branches_function(search, rules, Parameters, words, W, A, K)
    else:
        expand = expand_function(search, rules, Parameters, words, W, A)
    if K > 1:
        paying = compiler.calling("reward", *(("probability",) * pays))
        rewards_of = expected_rewards_kernel(paying, rules, Parameters, words, W, A, K if pays else 1)
    else:
        rewards_of = rewards_of_kernel(compiler.calling("reward"), rules, Parameters, words, W, A)
    ages = ages_of_kernel(compiler.calling("age"), rules, Parameters, words, W) if "age" in rules else no_ages
    return ExpansionKernels(
        explore=explore_kernel(search, expand, prefetch_states, words, W, A * K),
        expand_and_find=expand_and_find_kernel(search, expand, prefetch_states, words, A * K),
        rewards_of=rewards_of,
        ages_of=ages,
    )


def words_functions(compiler: Compiler, W: int) -> Words:
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


def expand_function(
    compiler: Compiler, rules: CompiledRules, Parameters: Constructor, words: Words, W: int, A: int
) -> Function:
    """Function that writes the successors of a few states, and the slots of the table in which to look for them."""
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
        # the rules see packed states as views: `state` is read, `out` is written
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


def prefetch_function(compiler: Compiler, A: int) -> Function:
    """Function that fetches from memory the states with which look-ups will compare."""

    @compiler.inlined
    def prefetch_states(table, states, slots, n):
        """Fetch the states that sit in the slots, which will be compared soon."""
        for j in range(n * A):
            if slots[j] >= 0:
                index = entry_at(table, slots[j])
                if index >= 0:
                    prefetch(states, index)

    return prefetch_states


def explore_kernel(
    compiler: Compiler, expand: Function, prefetch_states: Function, words: Words, W: int, A: int
) -> Function:
    """Kernel of the search by one thread."""
    same = words.same

    @compiler.kernel
    def explore(parameters, layout, states, successors, terminal, table, base, last, room, progress):
        """Breadth-first search: expand states from progress[FIRST] on, in order, until `last` or until `room` is used
        up.

        states (capacity, W) uint64: the states of the search, in the order of discovery: progress[COUNT] of them.
        successors (rows, A), terminal (rows,) uint8: row i belongs to state base + i.
        table (slots,): index of a state, or -1; its place follows from the hash of the state.
        While one batch is looked up, the next one is expanded already if it is known: memory has that long to
        answer.
        """
        keys = np.empty((2, LOOKUP_BATCH * A, W), np.uint64)
        slots = np.empty((2, LOOKUP_BATCH * A), np.int64)
        capacity = table.shape[0]
        first, count = progress[FIRST], progress[COUNT]
        level_end, depth = progress[LEVEL_END], progress[DEPTH]
        waiting, buffer = 0, 0  # states [first, first + waiting) are expanded, in the other buffer
        while True:
            # size of the next batch; 0 at the end, or if its successors might not fit
            n = 0
            if count + 2 * LOOKUP_BATCH * A <= room:
                n = max(0, min(LOOKUP_BATCH, count - first - waiting, last - first - waiting))
            if n == 0 and waiting == 0:
                break
            # expand the next batch into one buffer
            if n > 0:
                progress[COUNT] = count
                begin = first + waiting
                batch, slots_of_batch = keys[buffer], slots[buffer]
                expand(
                    parameters, layout, states, begin, n, batch, slots_of_batch, terminal, begin - base, table, progress
                )
                if progress[FAULT]:
                    return
            buffer = 1 - buffer
            # look up the successors of the batch in the other buffer, and number those that are new
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
                # the last state of a level: the next level ends with the newest state
                if first + i + 1 == level_end:
                    level_end = count
                    depth += 1
            first += waiting
            prefetch_states(table, states, slots[1 - buffer], n)
            waiting = n
        progress[FIRST], progress[COUNT] = first, count
        progress[LEVEL_END], progress[DEPTH] = level_end, depth

    return explore


def expand_and_find_kernel(
    compiler: Compiler, expand: Function, prefetch_states: Function, words: Words, A: int
) -> Function:
    """Kernel of the part of a wide frontier that threads share: expand states and find known successors."""
    same = words.same

    @compiler.kernel
    def expand_and_find(parameters, layout, states, start, stop, base, keys, indices, terminal, table, progress):
        """Successors of states [start, stop), and the indices of the successors that the table has.

        keys ((rows * A), W) gets the successors' words; indices (rows * A,) their indices, or -1 - slot if the table
        has none; row i belongs to state base + i. The table is only read. Another thread may insert meanwhile: a state
        that it inserts is found or not, and the thread that numbers the states searches on from the slot.
        """
        slots = np.empty((2, LOOKUP_BATCH * A), np.int64)
        capacity = table.shape[0]
        waiting, buffer = 0, 0
        for batch in range(start, stop + LOOKUP_BATCH, LOOKUP_BATCH):
            # expand the next batch into one buffer
            n = max(0, min(LOOKUP_BATCH, stop - batch))
            if n > 0:
                part = keys[(batch - base) * A : (batch - base + n) * A]
                slots_of_batch, row = slots[buffer], batch - base
                expand(parameters, layout, states, batch, n, part, slots_of_batch, terminal, row, table, progress)
                if progress[FAULT]:
                    return
            buffer = 1 - buffer
            # look up the successors of the batch before it
            before = batch - LOOKUP_BATCH
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


def rewards_of_kernel(
    compiler: Compiler, rules: CompiledRules, Parameters: Constructor, words: Words, W: int, A: int
) -> Function:
    """Kernel of the rewards of stored transitions, without chance."""
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
        next_state = read_only_view(WORDS, *layout)
        finite = True
        for s in range(start, stop):
            load(state, states, s)
            for a in range(A):
                value = 0.0
                if not terminal[s]:
                    load(next_state, states, int64(successors[s, a]))
                    value = float(reward(self, state, a, next_state))
                finite = finite and np.isfinite(value)
                out[s - start, a] = value
        return finite

    return rewards_of


# Chance and ages ------------------------------------------------------------------------------------------------------


def _rules_of_branches(compiler: Compiler, rules: CompiledRules, K: int) -> tuple[Function, Function, Function]:
    """(transition, probability, age) with the arguments of `expand`, whether the class defines them or not."""
    transition = rules["transition"]

    @compiler.inlined
    def transition_of_all(self, state, action, outcome, out):
        transition(self, state, action, out)

    @compiler.inlined
    def certain(self, state, action, outcome):
        return 1.0

    @compiler.inlined
    def no_age(self, state):
        return 0

    if K == 1:  # rules["transition"] takes no outcome then
        return transition_of_all, certain, rules.get("age", no_age)
    return transition, rules["probability"], rules.get("age", no_age)


def expand_branches_function(
    compiler: Compiler, rules: CompiledRules, Parameters: Constructor, words: Words, W: int, A: int, K: int
) -> Function:
    """Function that writes the successors of a few states by all branches, their probabilities and slots."""
    load, hash_of, _ = words
    transition, probability, age = _rules_of_branches(compiler, rules, K)
    is_terminal = rules["is_terminal"]
    WORDS = (0,) * W
    AGED, CHANCE = "age" in rules, K > 1
    TOLERANCE = SUM_TOLERANCE

    @compiler.function
    def expand(parameters, layout, states, first, n, keys, slots, rows, row, table, progress):
        """Successors of states [first, first + n): packed words to keys, slots from which to search to slots, -1 if
        a branch leads to the state itself: it is terminal, or the branch is impossible.

        keys (n * A * K, W), slots (n * A * K,). rows is (terminal, probabilities): terminal[row + i] gets whether state
        first + i is terminal, and probabilities[row + i] (A * K,) how likely the branches are.
        """
        terminal, probabilities = rows
        self = Parameters(*parameters)
        state = read_only_view(WORDS, *layout)
        out = packed_view(WORDS, *layout)
        capacity = table.shape[0]
        progress[FIRST] = first  # where to look, should a rule fail
        broken = False
        j = 0
        for i in range(n):
            load(state, states, first + i)
            ended = is_terminal(self, state)
            terminal[row + i] = ended
            now = np.int64(0) if ended else np.int64(age(self, state))
            for a in range(A):
                total = 0.0
                for k in range(K):
                    # a branch: its probability, and, if that is positive, its successor
                    slots[j] = -1
                    p = 1.0 if k == 0 else 0.0
                    if not ended:
                        p = float(probability(self, state, a, k))
                        total += p
                        if not (p >= 0.0 and p <= 1.0 + TOLERANCE):
                            broken = True
                        if p > 0.0:
                            load(out, states, first + i)
                            transition(self, state, a, k, out)
                            if AGED and np.int64(age(self, out)) <= now:
                                broken = True
                            for w in range(W):
                                keys[j, w] = get_word(out, w)
                            slots[j] = slot_of(hash_of(keys, j), capacity)
                            prefetch(table, slots[j])
                    if CHANCE:
                        probabilities[row + i, a * K + k] = p if p > 0.0 else 0.0
                    j += 1
                # the probabilities of an action must sum to 1
                if CHANCE and not ended and not abs(total - 1.0) <= TOLERANCE:
                    broken = True
        progress[FAULT] = max(fault(state), fault(out))
        if broken and progress[FAULT] == 0:
            progress[FAULT] = len(state) + 2  # no component, but a probability or an age

    return expand


def expected_rewards_kernel(
    compiler: Compiler, rules: CompiledRules, Parameters: Constructor, words: Words, W: int, A: int, K: int
) -> Function:
    """Kernel of the expected rewards of stored transitions, with chance.

    K: 1 if rewards do not depend on the outcome, which is not looked for then.
    """
    reward, probability = rules["reward"], rules["probability"]
    load = words.load
    WORDS = (0,) * W

    @compiler.kernel
    def rewards_of(parameters, layout, states, which, successors, probabilities, ranks, terminal, start, out, largest):
        """out[i, a] = expected reward of action a in state start + i; 0 in terminal states; out (n, A), zeros.

        which (N,), ascending: i A + a of each outcome; successors, probabilities (N,): its next state and its
        probability. ranks (N,): which one of the possible outcomes, -1 for none; without entries: they are counted.
        Rewards that are all the same are their own expectation, to the last bit. largest (1,): raised to the largest
        absolute reward that is averaged.
        """
        self = Parameters(*parameters)
        state = read_only_view(WORDS, *layout)
        next_state = read_only_view(WORDS, *layout)
        before, first, same, size = int64(-1), 0.0, True, 0.0
        last_rank, outcome = int64(-1), int64(-1)  # the last possible outcome so far: its rank among these, its number
        for j in range(len(which)):
            i, a = which[j] // A, which[j] % A
            if terminal[start + i]:
                continue
            if which[j] != before:
                load(state, states, start + i)
                last_rank, outcome = int64(-1), int64(-1)
            # the number of the outcome, from its rank among the possible ones
            load(next_state, states, int64(successors[j]))
            if K > 1:
                rank = ranks[j] if len(ranks) > 0 else last_rank + 1
                while last_rank < rank and outcome < K - 1:
                    outcome += 1
                    if probability(self, state, a, outcome) > 0.0:
                        last_rank += 1
            value = float(reward(self, state, a, next_state, outcome))
            if which[j] != before:
                before, first, same, size = which[j], value, True, 0.0
                out[i, a] = 0.0
            # add up; equal rewards are not averaged, so that no rounding changes them
            same, size = same and value == first, max(size, abs(value))
            out[i, a] += probabilities[j] * value
            if j + 1 == len(which) or which[j + 1] != before:
                out[i, a] = first if same else out[i, a]
                largest[0] = largest[0] if same else max(largest[0], size)

    return rewards_of


def no_ages(*arguments: object) -> None:
    """Raise: the class defines no age."""
    raise NotImplementedError("a class without age() has no ages")


def ages_of_kernel(compiler: Compiler, rules: CompiledRules, Parameters: Constructor, words: Words, W: int) -> Function:
    """Kernel of the ages of states."""
    age = rules["age"]
    load = words.load
    WORDS = (0,) * W

    @compiler.kernel
    def ages_of(parameters, layout, states, start, stop, out):
        """out[i] = age of state start + i."""
        self = Parameters(*parameters)
        state = read_only_view(WORDS, *layout)
        for s in range(start, stop):
            load(state, states, s)
            out[s - start] = int64(age(self, state))

    return ages_of
