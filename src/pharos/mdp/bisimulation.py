"""Bisimulation: states that no sequence of actions can tell apart, merged. Source: Givan, Dean and Greig (2003).

Two states are bisimilar if they have the same actions, pay the same reward for every action and lead to bisimilar
states. The coarsest such partition is found by refinement: start from terminal flag, rewards and, if wanted,
observations. Then split classes by the classes that their states lead to, until nothing splits (Moore 1956; Kanellakis
and Smolka 1990).
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pharos.errors import ParameterError
from pharos.mdp.arguments import require_mdp
from pharos.mdp.rewards import Rewards
from pharos.mdp.tabular import TabularMDP
from pharos.system.arrays import Indices


@dataclass(frozen=True, eq=False)
class Minimization:
    """An MDP with bisimilar states merged.

    Attributes:
        mdp: the merged MDP, with the same discount, horizon and chance. Classes are numbered by their first states.
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


@require_mdp
def minimize(mdp: TabularMDP, observations: npt.ArrayLike | None = None) -> Minimization:
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
    Cost: O(S A) to find whose next states changed, in each round, and O(A) for each such state. Rounds are at most the
        number of steps that tell two states apart. About 40 bytes a state. Of general MDPs the rows of states that lead
        to a class with a new number, and a state gets at most log2(S): 0.4 s for 100,000 states of 4 actions and 3
        outcomes. About 90 bytes a state and 40 an outcome.
    Source: Givan, Dean and Greig (2003), "Equivalence notions and model minimization in Markov decision processes";
        BRIDGE's consolidation (Laidlaw, Russell and Dragan 2023).
    """
    rewards = mdp.reward_table
    entries = rewards.table if len(rewards.palette) else rewards.table + 0.0  # -0.0 and 0.0 are one reward
    classes = _pair_numbers(entries, np.asarray(mdp.terminal).astype(np.int64))
    if mdp.available is not None:
        classes = _pair_numbers(mdp.available, classes)
    if observations is not None:
        observed = np.asarray(observations)
        if observed.ndim == 0 or len(observed) != mdp.num_states:
            count = len(observed) if observed.ndim else "a number"
            raise ParameterError(f"there are {count} observations; expected {mdp.num_states}, one for each state")
        rows = observed.reshape(mdp.num_states, -1)
        classes = _pair_numbers(rows + 0.0 if observed.dtype.kind == "f" else rows, classes)
    table = mdp.dynamics.deterministic_table()
    classes, rounds = _refined_general(mdp, classes) if table is None else _refined(table, classes)
    _, representatives = np.unique(classes, return_index=True)
    return Minimization(_quotient(mdp, classes, representatives), classes, representatives, rounds)


def _pair_numbers(rows: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(N,) int64: equal pairs (before, row) get equal numbers, in the order in which they appear first."""
    from pharos.kernels import partition

    return partition.numbered_rows(rows, before)[0]


def _refined(table: Indices, classes: np.ndarray) -> tuple[np.ndarray, int]:
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
        count = partition.split_classes(table, now, sizes, count, waiting, n, slots, used, new, changed)
        rounds += 1
        n = partition.affected_states(table, changed, waiting)
    return _pair_numbers(now[:, None], np.zeros(states, np.int64)), rounds


def _refined_general(mdp: TabularMDP, classes: np.ndarray) -> tuple[np.ndarray, int]:
    """(coarsest stable partition, rounds) of transition probabilities."""
    from pharos.kernels import partition

    states, matrix = mdp.num_states, mdp.dynamics.matrix()
    small = np.int32 if max(states, matrix.nnz) < 2**31 else np.int64
    rows = (matrix.indptr.astype(np.int64, copy=False), matrix.indices.astype(small, copy=False), matrix.data)
    into = np.empty(states + 1, np.int64), np.empty(matrix.nnz, small)
    partition.predecessors(rows[0], rows[1], mdp.num_actions, *into)
    now, layout = classes.astype(small), tuple(np.empty(states, small) for _ in range(4))
    rounds = partition.refine(rows, mdp.num_actions, into, now, layout, partition.slots_for(states))
    return _pair_numbers(now[:, None], np.zeros(states, np.int64)), int(rounds)


def _quotient(mdp: TabularMDP, classes: np.ndarray, representatives: np.ndarray) -> TabularMDP:
    count = len(representatives)
    initial = np.zeros(count)
    np.add.at(initial, classes[mdp.start_states], mdp.start_probabilities)
    start = int(initial.argmax()) if np.count_nonzero(initial) == 1 else initial / initial.sum()
    return replace(
        mdp,
        dynamics=mdp.dynamics.merged(classes, representatives),
        reward_table=Rewards.from_array(mdp.reward_table.rows(representatives), mdp.reward_table.rounding),
        terminal=np.asarray(mdp.terminal)[representatives],
        folder=None,
        space=None,
        is_numbered=False,
        age=None,
        available=None if mdp.available is None else mdp.available[representatives],
        names=None,
        staying=None if mdp.staying is None else _lost,
    ).with_initial(start)


def _lost() -> Rewards:
    raise ParameterError(
        "cannot add lazy actions to a minimised MDP: merged states may pay differently for staying; "
        "add lazy actions before you minimize, or pass staying="
    )
