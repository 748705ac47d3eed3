"""Probabilities of reaching a target, and the cost of getting there, of the best and of the worst policy.

A probability is a total reward: a step pays the probability that it enters the target, at which play ends. A cost *that
must arrive* counts policies that reach the target surely. If none does, the least one is infinite, and if one may
miss it, the largest one is. `goals.py` solves all four.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from pharos.errors import ParameterError
from pharos.kernels import hitting
from pharos.kernels.hitting import UNIT
from pharos.mdp import (
    BEST,
    WORST,
    Rewards,
    Selection,
    TabularMDP,
    end_components,
    filled,
    names_of,
    require_mdp,
    stand_ins,
)
from pharos.solvers.goals import GoalProblem, table_of_choices, total_reward

if TYPE_CHECKING:
    from pharos.solvers.goals import Choices

TERMINAL_TARGET = "terminal"
"""Name of the target that all terminal states, and the end of an episode without a next state, are."""


@dataclass(frozen=True, eq=False)
class StateBounds:
    """Bounds of a number for each state.

    Attributes:
        lower, upper: (S,) float64, proven. Both infinite if the number is.
    """

    lower: np.ndarray
    upper: np.ndarray

    def __repr__(self) -> str:
        return f"{type(self).__name__}(lower={self.lower}, upper={self.upper})"


@dataclass(frozen=True, eq=False, repr=False)
class Bounds(StateBounds):
    """Bounds of a number for each state, and a policy.

    Attributes:
        lower, upper: (S,) float64, proven. Both infinite if the number is.
        policy: (S,) actions that attain it, or (S, A + 1) under sticky actions, by the previous action. Meaningless if
            the number is infinite.
    """

    policy: np.ndarray


@dataclass(frozen=True, eq=False)
class Reachability:
    """Probabilities and costs of reaching a target from each state, each computed when it is first read.

    Attributes:
        mdp: with gamma 1 and no horizon, whatever was given.
        target: (S,) bool. with_end: whether an episode that ends without a next state counts as arrived.
        costs: (S, A) >= 0 of executed actions. Default: the rewards, as they are or negated.
        tolerance: the largest error of a number.

    Under sticky actions the numbers of a state belong to an episode that starts in it, without a previous action.
    """

    mdp: TabularMDP
    target: np.ndarray
    with_end: bool
    costs: np.ndarray | None
    tolerance: float

    @cached_property
    def maximum(self) -> Bounds:
        """The largest probability of reaching the target, over all policies: 1 in the target itself."""
        return self._probability(BEST)

    @cached_property
    def minimum(self) -> Bounds:
        """The least probability of reaching the target, over all policies."""
        return self._probability(WORST)

    @cached_property
    def least_cost(self) -> Bounds:
        """The least expected cost of reaching the target, over policies that surely do. Infinite if none does.

        Raises:
            ParameterError: costs are needed, as rewards have both signs.
        """
        problem = GoalProblem.of(self._stopping(-self._costs()), BEST, self._arrived)
        surely = problem.proper(problem.choices)[0]
        v, error, policy = problem.solve_in(surely, self.tolerance)
        v = np.where(np.isfinite(v), v, -np.inf)
        return self._of_states(v, error, policy, -self._costs(), BEST, -1.0, 0.0 if self.with_end else -np.inf)

    @cached_property
    def largest_cost(self) -> Bounds:
        """The largest expected cost of reaching the target, over all policies. Infinite if one may miss it.

        Raises:
            ParameterError: costs are needed, as rewards have both signs.
        """
        mdp = self._stopping(self._costs())
        problem = GoalProblem.of(mdp, BEST, self._arrived)
        components = end_components(mdp).labels.ravel() >= 0
        missed = np.zeros(problem.choices.num_nodes + 1, np.bool_)
        missed[problem.node_of[:-2][components]] = True
        missed[-2] = True  # the trap
        v, error, policy = problem.solve_in(~_may_reach(problem.choices, missed), self.tolerance)
        return self._of_states(v, error, policy, self._costs(), BEST, 1.0, 0.0 if self.with_end else np.inf)

    @property
    def stopped(self) -> TabularMDP:
        """The MDP that ends in the target."""
        return self._stopping(self.mdp.rewards)

    # How ------------------------------------------------------------------------------------------------------------

    @property
    def _arrived(self) -> np.ndarray:
        return np.append(self.target, self.with_end)

    def _costs(self) -> np.ndarray:
        if self.costs is not None:
            return self.costs
        rewards = np.where(self.target[:, None], 0.0, self.mdp.rewards)
        if rewards.min(initial=0.0) < 0 < rewards.max(initial=0.0):
            raise ParameterError(
                "reach: rewards have both signs, so none is a cost; expected costs=(S, A) numbers >= 0"
            )
        return np.abs(rewards)

    def _stopping(self, rewards: np.ndarray) -> TabularMDP:
        """The MDP that ends in the target, with other rewards."""
        terminal = np.asarray(self.mdp.terminal) | self.target
        rewards = np.where(terminal[:, None], 0.0, rewards)
        return replace(self.mdp, reward_table=Rewards.from_array(rewards), terminal=terminal, staying=None, age=None)

    def _probability(self, select: Selection) -> Bounds:
        entering = self.mdp.dynamics.expected(self._arrived.astype(np.float64))
        mdp = self._stopping(entering)
        goals = total_reward(mdp, select, self.tolerance)
        error = goals.error + (mdp.dynamics.operations + 8) * UNIT
        result = self._of_states(goals.v, error, goals.policy, mdp.rewards, select, 1.0)
        for bound in (result.lower, result.upper):
            np.clip(bound, 0.0, 1.0, out=bound)
            bound[self.target] = 1.0
        return result

    def _of_states(
        self,
        v: np.ndarray,
        error: np.ndarray,
        policy: np.ndarray,
        rewards: np.ndarray,
        select: Selection,
        sign: float,
        end: float = 0.0,
    ) -> Bounds:
        """Bounds of the states, from values (N,), errors and choices of the nodes. sign -1 negates them.

        end: the value of an episode that ends without a next state.
        """
        mdp = self._stopping(rewards)
        bounds = []
        for x in (v - error, v + error):
            if mdp.is_sticky:
                nodes = np.full((mdp.num_states + 1, mdp.width), end)
                nodes[:-1] = x.reshape(mdp.num_states, mdp.width)
                is_finite = np.isfinite(nodes)
                q = mdp.rewards + mdp.dynamics.expected(np.where(is_finite, nodes, 0.0))
                if not is_finite.all():  # all infinite values have one sign
                    q[mdp.dynamics.expected((~is_finite).astype(np.float64)) > 0] = nodes[~is_finite][0]
                q = mdp.acting(q, slice(None))
                first, best = mdp.chance.first, select.first_value(q)
                x = first.choice(q, best if first.chosen else np.zeros_like(best))[:, 0]
            bounds.append(sign * np.where(np.asarray(mdp.terminal) & np.isfinite(x), 0.0, x))
        lower, upper = bounds if sign > 0 else bounds[::-1]
        room = 8 * UNIT * np.where(np.isfinite(lower), np.abs(lower), 0.0)
        if mdp.available is not None:
            policy = stand_ins(mdp.available)[np.arange(mdp.num_states).repeat(mdp.width), policy]
        return Bounds(lower - room, upper + room, table_of_choices(mdp, policy))


def _may_reach(choices: "Choices", goal: np.ndarray) -> np.ndarray:
    """(M + 1,) bool: the nodes from which some choices may lead to a goal (M + 1,) bool."""
    from scipy import sparse

    size = len(goal)
    counts = np.diff(choices.matrix.indptr)
    edges = (np.ones(choices.matrix.nnz, np.int8), (choices.matrix.indices, np.repeat(choices.owner, counts)))
    back = sparse.csr_matrix(edges, shape=(size, size))
    order, distance = np.empty(size, np.int64), np.empty(size, np.int64)
    hitting.backward_order(back.indptr.astype(np.int64), back.indices.astype(np.int64), goal, order, distance)
    return distance >= 0


@require_mdp
def reach(
    mdp: TabularMDP, target: ArrayLike | str, *, costs: ArrayLike | None = None, tolerance: float = 1e-6
) -> Reachability:
    """Probabilities of reaching a target from each state, and expected costs of getting there, with proven bounds.

    Discount and horizon of the MDP do not count: play goes on until it arrives, or for ever.

    Args:
        target: (S,) bool, or indices of states, or "terminal", every terminal state and the end of an episode. Or a
            label or an expression over the variables of states, such as "x=3 & !done", see `Names.states_where`. What
            there is to name, `names_of(mdp)` says.
        costs: (S, A) numbers >= 0 of executed actions. None: the rewards if none is negative, or those negated if none
            is positive.
        tolerance: the largest error of a probability and of a finite cost.
    Returns:
        A `Reachability` with `maximum`, `minimum`, `least_cost` and `largest_cost`, each with (S,) arrays `lower` and
        `upper`. Costs are those *that must arrive*, as `Rmin=? [F target]` and `Rmax=? [F target]` of PRISM and Storm:
        infinite if they cannot, or need not.
    Raises:
        ParameterError: the target is no states and no expression, or costs are negative. UnknownName: it names a label
            or a variable that is not there.
        PrecisionError: floats, and rational numbers within their limits, do not reach the tolerance.
    Cost: as of total rewards, see `value_iteration`.
    Source: Baier and Katoen (2008), chapter 10, and Haddad and Monmege (2018).
    """
    with_end = isinstance(target, str) and target == TERMINAL_TARGET
    mask = _target_mask(mdp, target)
    if costs is not None:
        costs = np.asarray(costs, np.float64)
        if costs.shape != mdp.rewards.shape or not (np.isfinite(costs) & (costs >= 0)).all():
            raise ParameterError(f"costs have shape {costs.shape}; expected {mdp.rewards.shape} finite numbers >= 0")
        costs = costs if mdp.available is None else filled(costs, mdp.available)
    return Reachability(replace(mdp, gamma=1.0, horizon=None), mask, with_end, costs, tolerance)


def _target_mask(mdp: TabularMDP, target: ArrayLike | str) -> np.ndarray:
    if isinstance(target, str):
        if target == TERMINAL_TARGET:
            return np.array(mdp.terminal)
        return names_of(mdp).states_where(target, mdp.num_states)
    array = np.asarray(target)
    if array.dtype == np.bool_ and array.shape == (mdp.num_states,):
        return array
    if array.dtype.kind not in "iu" or array.ndim > 1 or ((array < 0) | (array >= mdp.num_states)).any():
        raise ParameterError(
            f"target is {array.dtype} of shape {array.shape}; expected ({mdp.num_states},) bool, indices of states "
            f"from 0 to {mdp.num_states - 1}, {TERMINAL_TARGET!r}, a label or an expression"
        )
    mask = np.zeros(mdp.num_states, np.bool_)
    mask[array] = True
    return mask
