"""Bisimulation: states that no sequence of actions can tell apart, merged. Source: Givan, Dean and Greig (2003).

Two states are bisimilar if they pay the same reward for every action and lead to bisimilar states. The coarsest such
partition is found by refinement: start from terminal flag, rewards and, if wanted, observations; split classes by the
classes that their states lead to, until nothing splits (Moore 1956; Kanellakis and Smolka 1990).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp.arguments import takes_mdp
from pharos.mdp.rewards import Rewards
from pharos.mdp.tabular import TabularMDP

# Rows of as many entries as the longest are compared in one go where that takes at most so many times the entries.
_PADDING = 8


@dataclass(frozen=True, eq=False)
class Minimization:
    """An MDP with bisimilar states merged.

    Attributes:
        mdp: the merged MDP, with the same discount, horizon and chance; classes are numbered by their first states.
        classes: (S,) int64, the class of each state.
        representatives: (C,) int64, the first state of each class.
        rounds: refinements until nothing split.
    """

    mdp: TabularMDP
    classes: np.ndarray
    representatives: np.ndarray
    rounds: int

    @property
    def num_classes(self) -> int:
        """C."""
        return len(self.representatives)


@takes_mdp
def minimize(mdp: TabularMDP, observations: Any = None) -> Minimization:
    """Return the smallest MDP that cannot be told from this one.

    V(s) = V(class of s) for every policy that depends on classes, under sticky and random actions too, because both act
    on executed actions. Terminal states are not merged with others, as they restart.

    Args:
        observations: (S, ...) one for each state: states that look different stay apart. None: rewards alone tell them
            apart.
    Raises:
        ParameterError: there is not one observation for each state.
    Exactness: exact for tables of next states. In general MDPs the probabilities of reaching a class are compared after
        rounding to 2^-40, so that the order of additions does not split classes.
    Cost: O(S A) to find whose next states changed, in each round, and O(A) for each such state; rounds are at most the
        number of steps that tell two states apart. About 40 bytes a state. Of general MDPs a pass over all transitions
        in each round.
    Source: Givan, Dean and Greig (2003), "Equivalence notions and model minimization in Markov decision processes";
        BRIDGE's consolidation (Laidlaw, Russell and Dragan 2023).
    """
    rewards = mdp.reward_table
    paid = rewards.table if len(rewards.palette) else rewards.table + 0.0  # -0.0 and 0.0 are one reward
    classes = _numbered(paid, np.asarray(mdp.terminal).astype(np.int64))
    if observations is not None:
        observed = np.asarray(observations)
        if observed.ndim == 0 or len(observed) != mdp.num_states:
            count = len(observed) if observed.ndim else "a number"
            raise ParameterError(f"there are {count} observations; expected {mdp.num_states}, one for each state")
        rows = observed.reshape(mdp.num_states, -1)
        classes = _numbered(rows + 0.0 if observed.dtype.kind == "f" else rows, classes)
    table = mdp.dynamics.deterministic_table()
    classes, rounds = _refined_general(mdp, classes) if table is None else _refined(table, classes)
    _, representatives = np.unique(classes, return_index=True)
    return Minimization(_merged(mdp, classes, representatives), classes, representatives, rounds)


def _numbered(rows: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(N,) int64: equal pairs (before, row) get equal numbers, in the order in which they appear first."""
    from pharos.kernels import partition

    return partition.numbered_rows(rows, before)[0]


def _refined(table: np.ndarray, classes: np.ndarray) -> tuple[np.ndarray, int]:
    """(coarsest stable partition, rounds) of a table of next states."""
    from pharos.kernels import partition

    states = len(table)
    small = np.int32 if states < 2**31 else np.int64
    slots, now = partition.slots_for(states), classes.astype(small)
    waiting, used, new = np.arange(states, dtype=small), np.empty(states, small), np.empty(states, small)
    count = int(now.max()) + 1
    sizes = np.zeros(states, small)
    sizes[:count] = np.bincount(now)
    changed = np.zeros(states, np.bool_)
    rounds, n = 0, states
    while n:
        count = partition.split(table, now, sizes, count, waiting, n, slots, used, new, changed)
        rounds += 1
        n = partition.states_to_ask(table, changed, waiting)
    return _numbered(now[:, None], np.zeros(states, np.int64)), rounds


def _refined_general(mdp: TabularMDP, classes: np.ndarray) -> tuple[np.ndarray, int]:
    """The same for transition probabilities."""
    rounds, count = 0, int(classes.max()) + 1
    while True:
        reached = mdp.dynamics.to_classes(classes, count)
        refined, number = _numbered_by_outcomes(reached, classes)
        classes, rounds = refined, rounds + 1
        if number == count:
            return classes, rounds
        count = number


def _numbered_by_outcomes(reached: Any, classes: np.ndarray) -> tuple[np.ndarray, int]:
    """((S,) numbers, how many) of equal pairs (class, rows of the state in `reached`, (S A, C) with sorted columns)."""
    num_states = len(classes)
    num_actions = reached.shape[0] // num_states
    whole = np.rint(reached.data * 2.0**40).astype(np.int64)
    keep = whole > 0
    edges = np.concatenate([[0], np.cumsum(keep)])[reached.indptr]
    columns, weights = reached.indices[keep].astype(np.int64), whole[keep]
    counts = np.diff(edges)
    width = int(counts.max(initial=0))
    if len(counts) * width <= _PADDING * max(len(columns), 1):
        from pharos.kernels import partition

        padded = np.full((len(counts), width, 2), -1, np.int64)
        padded[np.arange(width) < counts[:, None]] = np.stack([columns, weights], axis=1)
        return partition.numbered_rows(padded.reshape(num_states, -1), classes)
    numbers: dict[tuple[Any, ...], int] = {}
    refined = np.empty_like(classes)
    for s in range(num_states):
        ends = edges[s * num_actions : (s + 1) * num_actions + 1]
        inside = slice(ends[0], ends[-1])
        key = (int(classes[s]), (ends - ends[0]).tobytes(), columns[inside].tobytes(), weights[inside].tobytes())
        refined[s] = numbers.setdefault(key, len(numbers))
    return refined, len(numbers)


def _merged(mdp: TabularMDP, classes: np.ndarray, representatives: np.ndarray) -> TabularMDP:
    count = len(representatives)
    initial = np.zeros(count)
    np.add.at(initial, classes[mdp.start_states], mdp.start_probabilities)
    start: Any = int(initial.argmax()) if np.count_nonzero(initial) == 1 else initial / initial.sum()
    return replace(
        mdp,
        dynamics=mdp.dynamics.merged(classes, representatives),
        reward_table=Rewards.from_array(mdp.reward_table.rows(representatives)),
        terminal=np.asarray(mdp.terminal)[representatives],
        folder=None,
        age=None,
        staying=None if mdp.staying is None else _lost,
    ).with_initial(start)


def _lost() -> Rewards:
    raise ParameterError(
        "lazy_actions: the states of this MDP stand for several, which staying may pay differently; "
        "add lazy actions before you minimize, or say what staying= pays"
    )
