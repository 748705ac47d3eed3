"""Values of every step of an episode of T steps, under optimal, worst and exploring play: what planning measures share.

Undiscounted and time-indexed, on the nodes of `choices`: states, or under sticky actions pairs (state, previously
executed action) and the starts without one. Source: Laidlaw, Russell and Dragan (2023).
"""

from typing import Any

import numpy as np
import scipy  # whose `sparse` is loaded where it is used

from pharos.errors import ParameterError, PrecisionError, UndefinedMeasure
from pharos.mdp import ExpandedMDP, TabularMDP

# In units of return: an action is optimal if its value is within this of the best (theirs).
TIE = 1e-4
# Bytes that the tables of all steps may take.
MEMORY = 8 * 2**30
# Of returns whose squares 64-bit floats hold.
LARGEST = 1e150


def steps_of(name: str, mdp: TabularMDP, horizon: int | None) -> int:
    """T: what was given, else the horizon of the MDP."""
    steps = mdp.horizon if horizon is None else horizon
    if steps is None:
        raise UndefinedMeasure(f"{name} is defined for episodes of T steps: give a horizon")
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ParameterError(f"horizon is {steps!r}; expected a whole number of steps, at least 1")
    return int(steps)


def check_returns(name: str, mdp: TabularMDP, steps: int) -> None:
    """PrecisionError where returns of so many steps may have squares that 64-bit floats do not hold."""
    if not steps * max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest)) <= LARGEST:
        raise PrecisionError(
            f"{name}: returns of {steps} steps may pass {LARGEST:g}, and 64-bit floats do not hold their squares; "
            f"use smaller rewards"
        )


class FiniteHorizonValues:
    """Values at every step t = 1, ..., T (index t - 1) of optimal, worst and exploring play, on the nodes of an MDP.

    Attributes:
        matrix: (N A, N) probabilities; rewards (N, A).
        best, worst, explored: (T, N, A) action values; explored_value (T, N), clipped to [worst, best].
        optimal: (T, N, A) bool.
        met: (T, N) bool, whether a node can be met at step t.
    """

    def __init__(self, mdp: TabularMDP, steps: int):
        size = (mdp.num_states + 1) * mdp.policy_width
        needed = 40 * steps * size * mdp.num_actions
        if needed > MEMORY:
            raise UndefinedMeasure(
                f"effective_horizon: {steps} steps of the {size} nodes that they can meet need {needed / 2**30:.1f} "
                f"GiB, more than {MEMORY / 2**30:.0f}; a smaller horizon or instance would define it"
            )
        choices = ExpandedMDP.of(mdp, restart=False)
        self.matrix, self.num_actions, self.steps = choices.matrix, mdp.num_actions, steps
        self.underlying, self.num_nodes = choices.underlying, len(choices.underlying)
        self.starts = choices.starts
        self.rewards = expected_rewards(mdp, choices)
        self.table = single_outcomes(self.matrix, self.num_nodes, self.num_actions)
        self.support = scipy.sparse.csr_matrix(
            (np.ones(self.matrix.nnz, np.float32), self.matrix.indices, self.matrix.indptr), shape=self.matrix.shape
        )
        shape = (steps, self.num_nodes, self.num_actions)
        self.best, self.worst, self.explored = (np.empty(shape) for _ in range(3))
        self.explored_value = np.empty(shape[:2])
        self.best[-1] = self.worst[-1] = self.explored[-1] = self.rewards
        for t in range(steps - 1, -1, -1):
            if t < steps - 1:
                self.best[t] = self.backup(self.best[t + 1].max(axis=1))
                self.worst[t] = self.backup(self.worst[t + 1].min(axis=1))
                self.explored[t] = self.backup(self.explored_value[t + 1])
            mean = mean_of_actions(self.explored[t])
            self.explored_value[t] = mean.clip(self.worst[t].min(axis=1), self.best[t].max(axis=1))
        self.optimal = self.best >= self.best.max(axis=2, keepdims=True) - TIE
        self.first = np.zeros(self.num_nodes, np.bool_)
        self.first[[node for node, _ in self.starts]] = True
        everything = np.ones((self.num_nodes, self.num_actions), np.bool_)
        visitable, reached = self.first.copy(), self.first
        inside, ended = choices.underlying < mdp.num_states, False
        for _ in range(steps - 1):
            ended |= bool((reached & ~inside).any())
            reached = self.following(reached, everything)
            visitable |= reached
        if mdp.is_sticky:  # as BRIDGE counts
            pairs = {
                (int(s), 0) for s in choices.underlying[self.first]
            }  # a start stands for itself with the first action
            met = visitable & (inside | (not ended)) & (choices.previous < mdp.num_actions)
            pairs |= set(zip(choices.underlying[met].tolist(), choices.previous[met].tolist(), strict=True))
            self.num_visitable = len(pairs) + ended * mdp.num_actions  # an end leads to itself, by every action
        else:
            self.num_visitable = int((visitable & inside).sum())

    def backup(self, value: np.ndarray) -> np.ndarray:
        """(N, A): r + E value(next)."""
        if self.table is not None:
            return self.rewards + value[self.table]
        return self.rewards + (self.matrix @ value).reshape(self.num_nodes, self.num_actions)

    def following(self, met: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """(N,) bool: nodes that some of these actions (N, A) lead to from the nodes that are met."""
        chosen = np.flatnonzero((met[:, None] & actions).ravel())
        result = np.zeros(self.num_nodes, np.bool_)
        result[self.matrix[chosen].indices] = True
        return result

    def following_max(self, values: np.ndarray) -> np.ndarray:
        """(N, A): the largest of values (N,) >= 0 over the nodes that an action may lead to."""
        if self.table is not None:
            return values[self.table]
        largest = np.maximum.reduceat(values[self.matrix.indices], self.matrix.indptr[:-1])
        return largest.reshape(self.num_nodes, self.num_actions)

    def at_start(self, values: np.ndarray) -> float:
        """The expectation over start nodes."""
        return float(sum(p * values[node] for node, p in self.starts))

    def lookahead(self, values: np.ndarray) -> np.ndarray:
        """(T, N, A): Q^{k+1} from Q^k."""
        result = np.empty(self.best.shape)
        result[-1] = self.rewards
        for t in range(self.steps - 1):
            result[t] = self.backup(values[t + 1].max(axis=1))
        return result


def mean_of_actions(values: np.ndarray) -> np.ndarray:
    """Mean over actions, added up in their order."""
    total = values[:, 0].copy()
    for action in range(1, values.shape[1]):
        total += values[:, action]
    return total / values.shape[1]


def single_outcomes(matrix: Any, nodes: int, num_actions: int) -> np.ndarray | None:
    """(N, A) next nodes where every choice has one outcome; else None."""
    if matrix.nnz == nodes * num_actions and (np.diff(matrix.indptr) == 1).all() and (matrix.data == 1.0).all():
        return matrix.indices.reshape(nodes, num_actions).astype(np.int64)
    return None


def expected_rewards(mdp: TabularMDP, choices: Any) -> np.ndarray:
    """(N, A): the expected reward of choosing an action in a node."""
    num_actions = mdp.num_actions
    paid = np.vstack([mdp.rewards, np.zeros((1, num_actions))])
    paid[:-1][np.asarray(mdp.terminal)] = 0.0
    executed = paid[np.minimum(choices.underlying, mdp.num_states)]
    mean = mean_of_actions(executed)[:, None]
    return mdp.chance.chosen_values(executed, choices.previous, mean)
