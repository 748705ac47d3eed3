"""Makers of the kernels that enumerate states of classes with chance, or with an age: what exploration.py is for the
others.

A state has A K branches, branch a K + k for outcome k of action a. An impossible one is taken to lead to the state
itself with probability 0, as the branches of a terminal state do but for its first outcomes; so the search is the one
of exploration.py with A K branches in place of A actions, and only the expansion is another.

From their makers the inner functions take what exploration.py says, and K; 1 in a class with an age alone.
"""

from typing import Any, NamedTuple

from numba import int64

from pharos.kernels.hash_table import FAULT, FIRST, prefetch, slot_of
from pharos.rules.exploration import (
    Words,
    expand_and_find_kernel,
    explore_kernel,
    prefetch_function,
    rewards_of_kernel,
    words_functions,
)
from pharos.rules.packed_view import fault, get_word, packed_view, read_only_view

SUM_TOLERANCE = 1e-9
"""By how much the probabilities of the outcomes of an action may sum to something else than 1."""


class BranchingKernels(NamedTuple):
    """The compiled kernels; see the makers below, and those of exploration.py."""

    explore: Any
    expand_and_find: Any
    rewards_of: Any
    ages_of: Any


def branching(
    compiler: Any, rules: Any, Parameters: Any, W: int, A: int, K: int, pays: bool = False
) -> BranchingKernels:
    """The kernels of a class of environments whose states take W words, with A actions of at most K outcomes.

    pays: whether its reward depends on the outcome.
    """
    search = compiler.calling(*(rule for rule in rules if rule not in ("reward", "draw", "draw_motion")))
    words = words_functions(search, W)
    expand = expand_function(search, rules, Parameters, words, W, A, K)
    prefetch_states = prefetch_function(search, A * K)
    pays_by_outcome = K > 1 and pays
    paying = compiler.calling("reward", *(("probability",) * pays_by_outcome))
    rewards_of = (
        expected_rewards_kernel(paying, rules, Parameters, words, W, A, K if pays_by_outcome else 1)
        if K > 1
        else rewards_of_kernel(paying, rules, Parameters, words, W, A)
    )
    ages = ages_of_kernel(compiler.calling("age"), rules, Parameters, words, W) if "age" in rules else None
    return BranchingKernels(
        explore=explore_kernel(search, expand, prefetch_states, words, W, A * K),
        expand_and_find=expand_and_find_kernel(search, expand, prefetch_states, words, A * K),
        rewards_of=rewards_of,
        ages_of=ages,
    )


def one_outcome(compiler: Any, transition: Any) -> Any:
    """The rule of a class that takes outcomes, where there is but outcome 0, as that of a class that does not."""

    @compiler.inlined
    def transition_of_one(self, state, action, out):
        transition(self, state, action, 0, out)

    return transition_of_one


def reward_of_one_outcome(compiler: Any, reward: Any) -> Any:
    """The reward of a class that pays by outcome, where there is but outcome 0."""

    @compiler.inlined
    def reward_of_one(self, state, action, next_state):
        return reward(self, state, action, next_state, 0)

    return reward_of_one


def reward_of_any_outcome(compiler: Any, reward: Any) -> Any:
    """The reward of a class that does not pay by outcome, as that of one that does."""

    @compiler.inlined
    def reward_of_any(self, state, action, next_state, outcome):
        return reward(self, state, action, next_state)

    return reward_of_any


def _rules_of_branches(compiler: Any, rules: Any, K: int) -> tuple[Any, Any, Any]:
    """(transition, probability, age) as `expand` calls them, whatever the class defines."""
    transition, probability, age = rules["transition"], rules.get("probability"), rules.get("age")

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
        return transition_of_all, certain, age or no_age
    return transition, probability, age or no_age


def expand_function(compiler: Any, rules: Any, Parameters: Any, words: Words, W: int, A: int, K: int) -> Any:
    """Successors of a few states by all branches, how likely they are, and where in the table to look for them."""
    load, hash_of, _ = words
    transition, probability, age = _rules_of_branches(compiler, rules, K)
    is_terminal = rules["is_terminal"]
    WORDS = (0,) * W
    AGED, CHANCE = "age" in rules, K > 1
    TOLERANCE = SUM_TOLERANCE

    @compiler.function
    def expand(parameters, layout, states, first, n, keys, slots, rows, row, table, progress):
        """Successors of states [first, first + n): packed words to keys, slots from which to search to slots, -1 where
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
            now = int64(0) if ended else int64(age(self, state))
            for a in range(A):
                total = 0.0
                for k in range(K):
                    slots[j] = -1
                    likely = 1.0 if k == 0 else 0.0
                    if not ended:
                        likely = float(probability(self, state, a, k))
                        total += likely
                        if not (likely >= 0.0 and likely <= 1.0 + TOLERANCE):
                            broken = True
                        if likely > 0.0:
                            load(out, states, first + i)
                            transition(self, state, a, k, out)
                            if AGED and int64(age(self, out)) <= now:
                                broken = True
                            for w in range(W):
                                keys[j, w] = get_word(out, w)
                            slots[j] = slot_of(hash_of(keys, j), capacity)
                            prefetch(table, slots[j])
                    if CHANCE:
                        probabilities[row + i, a * K + k] = likely if likely > 0.0 else 0.0
                    j += 1
                if CHANCE and not ended and not abs(total - 1.0) <= TOLERANCE:
                    broken = True
        progress[FAULT] = max(fault(state), fault(out))
        if broken and progress[FAULT] == 0:
            progress[FAULT] = len(state) + 2  # no component, but a probability or an age

    return expand


def expected_rewards_kernel(compiler: Any, rules: Any, Parameters: Any, words: Words, W: int, A: int, K: int) -> Any:
    """Rewards of stored transitions: what executing an action pays on average.

    K: 1 where rewards do not depend on the outcome, which is not looked for then.
    """
    reward, probability = rules["reward"], rules["probability"]
    load = words.load
    WORDS = (0,) * W

    @compiler.kernel
    def rewards_of(parameters, layout, states, which, successors, probabilities, ranks, terminal, start, out):
        """out[i, a] = expected reward of action a in state start + i; 0 in terminal states; out (n, A), zeros.

        which (N,), ascending: i A + a of each outcome; successors, probabilities (N,): where it leads, how likely it
        is. ranks (N,): which one of the possible outcomes, -1 for none; without entries: they are counted. Rewards that
        are all the same are their own expectation, to the last bit.
        """
        self = Parameters(*parameters)
        state = read_only_view(WORDS, *layout)
        following = read_only_view(WORDS, *layout)
        before, first, same = int64(-1), 0.0, True
        passed, outcome = int64(-1), int64(-1)  # possible outcomes of this action passed by, and the last of them
        for j in range(len(which)):
            i, a = which[j] // A, which[j] % A
            if terminal[start + i]:
                continue
            if which[j] != before:
                load(state, states, start + i)
                passed, outcome = int64(-1), int64(-1)
            load(following, states, int64(successors[j]))
            if K > 1:
                rank = ranks[j] if len(ranks) > 0 else passed + 1
                while passed < rank and outcome < K - 1:
                    outcome += 1
                    if probability(self, state, a, outcome) > 0.0:
                        passed += 1
            value = float(reward(self, state, a, following, outcome))
            if which[j] != before:
                before, first, same = which[j], value, True
                out[i, a] = 0.0
            same = same and value == first
            out[i, a] += probabilities[j] * value
            if j + 1 == len(which) or which[j + 1] != before:
                out[i, a] = first if same else out[i, a]

    return rewards_of


def ages_of_kernel(compiler: Any, rules: Any, Parameters: Any, words: Words, W: int) -> Any:
    """Ages of states."""
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
