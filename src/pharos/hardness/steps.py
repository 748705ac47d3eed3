"""Values of every step of an episode of T steps, under optimal, worst and exploring play, for planning measures.

Undiscounted and time-indexed, on the nodes of `choices`: states, or under sticky actions pairs (state, previously
executed action) and the starts without one. Source: Laidlaw, Russell and Dragan (2023).

`return_distribution`: the distribution of the return of a policy over such an episode.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import PrecisionError, UndefinedMeasure
from pharos.mdp import (
    STEPS_EXPECTED,
    ExpandedMDP,
    PolicyTable,
    TabularMDP,
    mean_of_actions,
    most_actions,
    require_mdp,
    whole_number,
)
from pharos.solvers import TablePolicy

# In units of return: an action is optimal if its value is within this of the best (theirs).
OPTIMAL_TIE = 1e-4
# Bytes that the tables of all steps may take.
MEMORY = 8 * 2**30
# Of returns whose squares 64-bit floats hold.
HUGE_RETURN = 1e150


def steps_of(name: str, mdp: TabularMDP, horizon: int | None) -> int:
    """T: the argument, else the horizon of the MDP. UndefinedMeasure if there is neither."""
    steps = mdp.horizon if horizon is None else horizon
    if steps is None:
        raise UndefinedMeasure(f"{name} is defined for episodes of T steps: give a horizon")
    return whole_number(steps, "horizon", STEPS_EXPECTED)


def check_returns(name: str, mdp: TabularMDP, steps: int) -> None:
    """PrecisionError if returns of so many steps may have squares that 64-bit floats do not hold."""
    if not steps * max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest)) <= HUGE_RETURN:
        raise PrecisionError(
            f"{name}: returns of {steps} steps may pass {HUGE_RETURN:g}, and 64-bit floats do not hold their squares; "
            f"use smaller rewards"
        )


class FiniteHorizonValues:
    """Values at every step t = 1, ..., T (index t - 1) of optimal, worst and exploring play, on the nodes of an MDP.

    Attributes:
        choices: the MDP written out. rewards: (N, A). table: (N, A) if each choice has one outcome, else None.
        best, worst, explored: (T, N, A) action values. explored_value: (T, N), clipped to [worst, best].
        optimal: (T, N, A) bool.
        sets: (N, A) bool, the available actions. None: all are everywhere. All are if an episode is over.
        first: (N,) bool, the start nodes. num_visitable: states (pairs under sticky actions) that can be visited.
    """

    def __init__(self, mdp: TabularMDP, steps: int, report: Callable[[str], object] = str):
        """report: called with a line for each step."""
        self.report = report
        size = (mdp.num_states + 1) * mdp.policy_width
        needed = 40 * steps * size * mdp.num_actions
        if needed > MEMORY:
            raise UndefinedMeasure(
                f"effective_horizon: {steps} steps of the {size} nodes that they can meet need {needed / 2**30:.1f} "
                f"GiB, more than {MEMORY / 2**30:.0f}; a smaller horizon or instance would define it"
            )
        choices = ExpandedMDP.of(mdp, restart=False)
        self.choices, self.num_actions, self.steps = choices, mdp.num_actions, steps
        self.most_actions = most_actions(mdp)
        self.num_nodes, self.starts, self.table = len(choices.underlying), choices.starts, choices.table
        self.rewards = choices.rewards(mdp)
        self.sets, shares = None, None
        if mdp.available is not None:
            self.sets = np.append(mdp.available, np.ones((1, mdp.num_actions), np.bool_), axis=0)[choices.underlying]
            shares = self.sets / self.sets.sum(axis=1, keepdims=True)
        shape = (steps, self.num_nodes, self.num_actions)
        self.best, self.worst, self.explored = (np.empty(shape) for _ in range(3))
        self.explored_value = np.empty(shape[:2])
        self.best[-1] = self.worst[-1] = self.explored[-1] = self.rewards
        for t in range(steps - 1, -1, -1):
            report(f"values of step {t} of {steps}")
            if t < steps - 1:
                self.best[t] = self.backup(self.best[t + 1].max(axis=1))
                self.worst[t] = self.backup(self.worst[t + 1].min(axis=1))
                self.explored[t] = self.backup(self.explored_value[t + 1])
            mean = mean_of_actions(self.explored[t]) if shares is None else (self.explored[t] * shares).sum(axis=1)
            self.explored_value[t] = mean.clip(self.worst[t].min(axis=1), self.best[t].max(axis=1))
        self.optimal = self.best >= self.best.max(axis=2, keepdims=True) - OPTIMAL_TIE
        self.first = np.zeros(self.num_nodes, np.bool_)
        self.first[[node for node, _ in self.starts]] = True
        everything = np.ones((self.num_nodes, self.num_actions), np.bool_)
        visitable, current = self.first.copy(), self.first
        inside, ended = choices.underlying < mdp.num_states, False
        for _ in range(steps - 1):
            ended |= bool((current & ~inside).any())
            current = self.successors(current, everything)
            visitable |= current
        if mdp.is_sticky:  # as BRIDGE counts
            pairs = {
                (int(s), 0) for s in choices.underlying[self.first]
            }  # a start stands for itself with the first action
            mask = visitable & (inside | (not ended)) & (choices.previous < mdp.num_actions)
            pairs |= set(zip(choices.underlying[mask].tolist(), choices.previous[mask].tolist(), strict=True))
            self.num_visitable = len(pairs) + ended * mdp.num_actions  # an end leads to itself, by every action
        else:
            self.num_visitable = int((visitable & inside).sum())

    def backup(self, value: np.ndarray) -> np.ndarray:
        """(N, A): r + E value(next)."""
        return self.rewards + self.choices.expected(value)

    def successors(self, is_reached: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """(N,) bool: nodes that some of these actions (N, A) lead to from nodes, (N,) bool."""
        result, nodes = np.zeros(self.num_nodes, np.bool_), np.flatnonzero(is_reached)
        result[self.choices.successors(nodes, actions[nodes])] = True
        return result

    def at_start(self, values: np.ndarray) -> float:
        """The expectation over start nodes."""
        return float(sum(p * values[node] for node, p in self.starts))


# Returns of an episode ------------------------------------------------------------------------------------------------


SAME_RETURN = 1e-9  # returns closer than this are one return


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
        indices = np.flatnonzero(np.cumsum(self.probabilities) >= level - 1e-12)
        return float(self.returns[indices[0] if len(indices) else -1])

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
        policy: as for `evaluate_policy`. Default: uniform.
        horizon: T. Default: the MDP's.
    Raises:
        UndefinedMeasure: there is no horizon, or there are so many different returns that a table of states by returns
            does not fit into 8 GiB.
        ParameterError: the policy or the horizon is wrong.
    Exactness: exact, but returns within 1e-9 of each other count as one. Of general MDPs the reward r(s, a) is paid as
        it is, even if it is an expectation.
    Cost: T passes over S A K, if K returns are possible, and two tables of S A K.
    Source: Bellemare, Dabney and Rowland (2023), "Distributional reinforcement learning", chapter 2.
    """
    steps = steps_of("return_distribution", mdp, horizon)
    returns, last = _backward(mdp, policy, steps)
    mass = np.zeros(len(returns))
    for state, probability in zip(mdp.start_states, mdp.start_probabilities, strict=True):
        mass += probability * last[state, 0]
    is_possible = mass > 0
    conventions = {"horizon": steps, "gamma": 1.0, "policy": "uniform" if policy is None else "given"}
    return ReturnDistribution(returns[is_possible], mass[is_possible], conventions)


def _backward(mdp: TabularMDP, policy: TablePolicy | None, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """((K,) possible returns, (S + 1, 1, K) their probabilities from each state on, without a previous action)."""
    states, num_actions, chance = mdp.num_states, mdp.num_actions, mdp.chance
    table = PolicyTable.of(mdp, policy)
    rewards = np.where(np.asarray(mdp.terminal)[:, None], 0.0, mdp.rewards)
    distinct, which = np.unique(rewards, return_inverse=True)
    which = which.reshape(rewards.shape)
    support, values = np.zeros(1), np.ones((states + 1, mdp.width, 1))
    for t in range(steps - 1, -1, -1):
        # Returns that are possible from this step on.
        sums = np.sort(np.append((distinct[:, None] + support).ravel(), 0.0))  # ended episodes have return 0
        returns = sums[np.concatenate([[True], np.diff(sums) > SAME_RETURN])]
        if 8 * states * num_actions * len(returns) * 3 > MEMORY:
            raise UndefinedMeasure(
                f"return_distribution: {len(returns)} returns are possible in {steps - t} steps from {states} "
                f"states, more than {MEMORY / 2**30:.0f} GiB hold; a smaller horizon or instance would define it"
            )
        # Distribution of the return after executing each action, then of the chosen one.
        executed = np.zeros((states, num_actions, len(returns)))
        after = mdp.dynamics.expected(values)
        for i, reward in enumerate(distinct):
            s, a = np.nonzero(which == i)
            index = np.searchsorted(returns, reward + support + SAME_RETURN / 2) - 1
            block = np.zeros((len(s), len(returns)))
            block[:, np.maximum(index, 0)] = after[s, a]
            executed[s, a] = block
        if mdp.is_sticky and t == 0:
            choice = chance.first.choice(executed, table.first_value(executed))
        else:
            choice = chance.choice(executed, table.value(executed))
        now = np.zeros((states + 1, *choice.shape[1:]))
        now[states, :, int(np.abs(returns).argmin())] = 1.0
        now[:states] = choice
        live = (now > 0).any(axis=(0, 1))
        support, values = returns[live], now[..., live]
    return support, values
