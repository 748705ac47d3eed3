"""Values of every step of an episode of T steps, under optimal, worst and exploring play: what planning measures share.

Undiscounted and time-indexed, on the nodes of `choices`: states, or under sticky actions pairs (state, previously
executed action) and the starts without one. Source: Laidlaw, Russell and Dragan (2023).

`return_distribution`: the distribution of the return of a policy over such an episode.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy  # whose `sparse` is loaded where it is used

from pharos.errors import ParameterError, PrecisionError, UndefinedMeasure
from pharos.mdp import ExpandedMDP, PolicyTable, TabularMDP, require_mdp
from pharos.solvers import TablePolicy

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

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


def single_outcomes(matrix: "csr_matrix", nodes: int, num_actions: int) -> np.ndarray | None:
    """(N, A) next nodes where every choice has one outcome; else None."""
    if matrix.nnz == nodes * num_actions and (np.diff(matrix.indptr) == 1).all() and (matrix.data == 1.0).all():
        return matrix.indices.reshape(nodes, num_actions).astype(np.int64)
    return None


def expected_rewards(mdp: TabularMDP, choices: ExpandedMDP) -> np.ndarray:
    """(N, A): the expected reward of choosing an action in a node."""
    num_actions = mdp.num_actions
    paid = np.vstack([mdp.rewards, np.zeros((1, num_actions))])
    paid[:-1][np.asarray(mdp.terminal)] = 0.0
    executed = paid[np.minimum(choices.underlying, mdp.num_states)]
    mean = mean_of_actions(executed)[:, None]
    return mdp.chance.chosen_values(executed, choices.previous, mean)


# Returns of an episode ------------------------------------------------------------------------------------------------


SAME = 1e-9  # returns closer than this are one return


@dataclass(frozen=True, eq=False)
class ReturnDistribution:
    """The returns of a policy from the start, and how probable they are.

    Attributes:
        returns: (K,) float64, ascending.
        probabilities: (K,) float64 > 0, sum 1.
        conventions: horizon, gamma (1), policy.
    """

    returns: np.ndarray
    probabilities: np.ndarray
    conventions: dict[str, Any] = field(default_factory=dict)

    @property
    def mean(self) -> float:
        return float(self.returns @ self.probabilities)

    @property
    def variance(self) -> float:
        return float((self.returns - self.mean) ** 2 @ self.probabilities)

    def quantile(self, level: float) -> float:
        """The smallest return that is exceeded with probability 1 - level at most."""
        reached = np.flatnonzero(np.cumsum(self.probabilities) >= level - 1e-12)
        return float(self.returns[reached[0] if len(reached) else -1])

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "returns": self.returns.tolist(),
            "probabilities": self.probabilities.tolist(),
            "mean": self.mean,
            "variance": self.variance,
            **self.conventions,
        }

    def __str__(self) -> str:
        return f"mean {self.mean:.6g}, deviation {self.variance**0.5:.6g}, {len(self.returns)} returns"


@require_mdp
def return_distribution(
    mdp: TabularMDP, policy: TablePolicy | None = None, *, horizon: int | None = None
) -> ReturnDistribution:
    """Return the distribution of r_1 + ... + r_T under a policy, from the start, under every kind of chance.

    Args:
        policy: as for `evaluate_policy`; None: uniform.
        horizon: T; None: that of the MDP.
    Raises:
        UndefinedMeasure: there is no horizon, or there are so many different returns that a table of states by returns
            does not fit into 8 GiB.
        ParameterError: the policy or the horizon is wrong.
    Exactness: exact; returns within 1e-9 of each other count as one. Of general MDPs the reward r(s, a) is paid as it
        is, even where it is an expectation.
    Cost: T passes over S A K, where K returns are possible; two tables of S A K.
    Source: Bellemare, Dabney and Rowland (2023), "Distributional reinforcement learning", chapter 2.
    """
    steps = steps_of("return_distribution", mdp, horizon)
    for support, values, first in _backward(mdp, policy, steps):
        returns, last = support, first if first is not None else values
    mass = np.zeros(len(returns))
    for state, probability in zip(mdp.start_states, mdp.start_probabilities, strict=True):
        mass += probability * last[state, 0]
    is_possible = mass > 0
    conventions = {"horizon": steps, "gamma": 1.0, "policy": "uniform" if policy is None else "given"}
    return ReturnDistribution(returns[is_possible], mass[is_possible], conventions)


def _backward(
    mdp: TabularMDP, policy: TablePolicy | None, steps: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
    """For t = T - 1, ..., 0: the possible returns (K,), and their probabilities.

    These are (S + 1, W, K), from t on, W being A previous actions or 1.

    Under sticky actions also (S + 1, 1, K), as if no action had been executed before, for the last of them.
    """
    states, num_actions, chance = mdp.num_states, mdp.num_actions, mdp.chance
    table = PolicyTable.of(mdp, policy)
    rewards = np.where(np.asarray(mdp.terminal)[:, None], 0.0, mdp.rewards)
    paid, which = np.unique(rewards, return_inverse=True)
    which = which.reshape(rewards.shape)
    width = mdp.width
    support, values = np.zeros(1), np.ones((states + 1, width, 1))
    for t in range(steps - 1, -1, -1):
        sums = np.sort(np.append((paid[:, None] + support).ravel(), 0.0))  # what has ended has return 0
        following = sums[np.concatenate([[True], np.diff(sums) > SAME])]
        if 8 * states * num_actions * len(following) * 3 > MEMORY:
            raise UndefinedMeasure(
                f"return_distribution: {len(following)} returns are possible in {steps - t} steps from {states} "
                f"states, more than {MEMORY / 2**30:.0f} GiB hold; a smaller horizon or instance would define it"
            )
        executed = np.zeros((states, num_actions, len(following)))
        after = mdp.dynamics.expected(values)
        for i, reward in enumerate(paid):
            s, a = np.nonzero(which == i)
            place = np.searchsorted(following, reward + support + SAME / 2) - 1
            block = np.zeros((len(s), len(following)))
            block[:, np.maximum(place, 0)] = after[s, a]
            executed[s, a] = block
        now = np.zeros((states + 1, width, len(following)))
        origin = int(np.abs(following).argmin())
        now[states, :, origin] = 1.0
        now[:states] = chance.choice(executed, table.value(executed))
        first = None
        if mdp.is_sticky and t == 0:
            first = np.zeros((states + 1, 1, len(following)))
            first[:states] = chance.first.choice(executed, table.first_value(executed))
            first[states, 0, origin] = 1.0
        live = (now > 0).any(axis=(0, 1)) | (False if first is None else (first > 0).any(axis=(0, 1)))
        support, values = following[live], now[..., live]
        yield support, values, None if first is None else first[..., live]
