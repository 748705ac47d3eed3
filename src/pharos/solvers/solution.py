"""Solution: values, policy, and their error bound; and regret, what a policy loses against the optimal one.

Regret: what is lost by not having played the optimal policy from the first episode on.

Episode k starts in s0 and is played with policy pi_k; V* and V^pi are values from the start, in the same setting
(discount, horizon, chance) as the returns.

    expected regret     V*(s0) - V^{pi_k}(s0)      of a policy, by exact evaluation; never negative
    realised regret     V*(s0) - return_k          of an episode as it was played, exploration and luck included
    cumulative          summed over the episodes of a run
    normalised          divided by the same of a reference policy: 0 is optimal, 1 as bad as the reference

Both agree in expectation where pi_k is what played episode k; a DQN also explores, so its realised regret is larger.

Source: expected regret over episodes: Azar, Osband and Munos (2017), section 2; expected and realised ("pseudo-regret"
and "regret"): Bubeck and Cesa-Bianchi (2012), section 1; 1 minus the normalised regret is the normalised score of Mnih
et al. (2015), with the exact optimum in the place of a human.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import ArrayLike

from pharos.errors import ParameterError
from pharos.mdp import Selection, TabularMDP

# States whose greedy actions are worked out in one go.
_BLOCK = 1 << 20


@dataclass(frozen=True, eq=False)
class Solution:
    """Values of the optimal policy, or of a given one.

    Attributes:
        mdp: what was solved.
        error_bound: every entry of `v` and `q` is within this of the true value (proven; in units of return). If the
            probabilities of the MDP were rounded, also of those of each MDP within its `residual`; that part may exceed
            the tolerance.
        sweeps, seconds: cost of the solve; compiling is not among the seconds.
        horizon: number of steps to go of the values; or None.
        select: which action is chosen: the best one, the worst one, or that of a policy.
        x: (S + 1, W) float64, or float32 where it was asked for: values of (state, previously executed action), W = A
            under sticky actions, else 1; row S, the end, is 0.
        next_x: the values of next states: x, or with a horizon those with one step less to go.
        all_steps: with a horizon, where they were kept: (T + 1, S), or (T + 1, S, A), row t with t steps to go.

    Under sticky actions values belong to pairs: `v` is (S, A), the value of (state, previously executed action), and
    `q` is (S, A), the value of executing an action. Otherwise `v` is (S,), and `q` (S, A) is the value of choosing an
    action.
    """

    mdp: TabularMDP
    error_bound: float
    sweeps: int
    seconds: float
    horizon: int | None
    select: Selection
    x: np.ndarray
    next_x: np.ndarray
    all_steps: np.ndarray | None = None

    @property
    def gamma(self) -> float:
        """The discount of the values."""
        return self.mdp.gamma

    @property
    def kind(self) -> str:
        """ "optimal", "worst" or "policy"."""
        return self.select.kind

    @property
    def v(self) -> np.ndarray:
        """(S,) values; (S, A) under sticky actions."""
        return self.mdp.without_width(self.x[:-1])

    @property
    def q(self) -> np.ndarray:
        """(S, A) action values, of choosing; of executing under sticky actions. Computed anew by each call."""
        executed = self.q_of(slice(None))
        return executed if self.mdp.is_sticky else self.mdp.chance.choice(executed, executed)

    def q_of(self, states: np.ndarray | slice) -> np.ndarray:
        """(N, A), the values of executing each action in some states (indices or a slice)."""
        next_values = self.mdp.dynamics.expected(self.next_x, states).astype(np.float64, copy=False)
        return self.mdp.reward_table.rows(states) + self.mdp.gamma * next_values

    @cached_property
    def policy(self) -> np.ndarray:
        """The policy: for "optimal" and "worst" (S,) greedy actions, the first among equals; else the one given."""
        policy_table = self.given_policy
        if policy_table is not None:
            return policy_table
        actions = np.empty(self.mdp.num_states, np.int64)
        for start in range(0, self.mdp.num_states, _BLOCK):
            block = slice(start, min(start + _BLOCK, self.mdp.num_states))
            actions[block] = self.select.policy(self.q_of(block)).table
        return actions

    @property
    def given_policy(self) -> np.ndarray | None:
        """The policy that was evaluated: (S,) actions, (S, A) or (S, A + 1, A) probabilities; else None."""
        return getattr(self.select, "table", None)

    def optimal_actions(self, tie_tolerance: float = 1e-6) -> np.ndarray:
        """(S, A) bool: actions whose value is within `tie_tolerance` of the best."""
        q = self.q
        return q >= q.max(axis=1, keepdims=True) - tie_tolerance

    @property
    def value_at_start(self) -> float:
        """The expected value of an episode's first state."""
        return self.value_from(self.mdp.start_states, self.mdp.start_probabilities)

    def value_from(self, starts: np.ndarray, probabilities: np.ndarray) -> float:
        """The expected value of an episode's first state, drawn from other states or probabilities (N,)."""
        if not self.mdp.is_sticky:
            return float(probabilities @ self.v[starts])
        q = self.q_of(starts)
        return float(probabilities @ self.mdp.chance.first.choice(q, self.select.first_value(q, starts))[:, 0])

    def conventions(self) -> dict[str, Any]:
        """Discount, horizon, kind and error bound of the values, JSON-able."""
        return {"gamma": self.gamma, "horizon": self.horizon, "kind": self.kind, "error_bound": self.error_bound}

    def __repr__(self) -> str:
        return (
            f"Solution({self.kind}, value_at_start={self.value_at_start:.6g}, error_bound={self.error_bound:.2g}, "
            f"sweeps={self.sweeps}, seconds={self.seconds:.2f})"
        )


# Regret ---------------------------------------------------------------------------------------------------------------


SMALLEST_SCALE = 1e-12  # in discounted return: below it a ratio is one of rounding errors


@overload
def regret_scale(optimal: float, reference: float, error_bound: float = 0.0) -> float: ...


@overload
def regret_scale(optimal: ArrayLike, reference: ArrayLike, error_bound: float = 0.0) -> float | np.ndarray: ...


def regret_scale(optimal: ArrayLike, reference: ArrayLike, error_bound: float = 0.0) -> float | np.ndarray:
    """Return V* - V of a reference policy: divided by it, the regret of the optimum is 0, of the reference policy 1.

    Args:
        optimal, reference: numbers or arrays; values from the start, in return.
        error_bound: of each of the two.
    Returns:
        A float or an array, in return. NaN where it is not above max(1e-12, 2 `error_bound`): there the reference
        policy is itself optimal, as far as the values can tell, and regret has no scale.
    Source: 1 - regret / scale is the normalised score of Mnih et al. (2015), with the exact optimum in the place of a
        human. The threshold is ours.
    """
    scale = np.asarray(np.asarray(optimal, np.float64) - np.asarray(reference, np.float64))
    scale = np.where(scale > max(SMALLEST_SCALE, 2 * error_bound), scale, np.nan)
    return scale if scale.ndim else float(scale)


class HasReference(Protocol):
    """A task, which knows the values that regret is measured against."""

    @property
    def reference(self) -> "ReferenceValues": ...


@dataclass(frozen=True)
class ReferenceValues:
    """Values from the start of the policies that regret is measured against.

    Attributes:
        optimal, uniform, worst: of the optimal, the uniformly random and the worst policy; `worst` may be NaN where
            unknown.
        error_bound: each is within this of the true value.
    """

    optimal: float
    uniform: float
    worst: float = math.nan
    error_bound: float = 0.0

    @staticmethod
    def of(task: "HasReference") -> "ReferenceValues":
        """Reference values of a task; its space is built and solved where it is not yet."""
        return task.reference

    def spread(self, reference: str = "uniform") -> float:
        """V* - V of the reference policy, "uniform" or "worst"; NaN where it is too small to divide by.

        Raises:
            ParameterError: another reference.
        """
        if reference not in ("uniform", "worst"):
            raise ParameterError(f"reference is {reference!r}; expected 'uniform' or 'worst'")
        return regret_scale(self.optimal, getattr(self, reference), self.error_bound)


@overload
def regret(value: float, values: ReferenceValues, *, normalized_by: str | None = None) -> float: ...


@overload
def regret(value: np.ndarray, values: ReferenceValues, *, normalized_by: str | None = None) -> np.ndarray: ...


def regret(
    value: float | np.ndarray, values: ReferenceValues, *, normalized_by: str | None = None
) -> float | np.ndarray:
    """The regret of a policy's value, or of an episode's return: V* - value.

    Args:
        value: a number or an array: values for expected, returns for realised regret.
        values: of the task.
        normalized_by: None; or "uniform" or "worst", the policy whose regret is 1.
    Returns:
        A float or an array; in units of return, or without where normalised. NaN where it cannot be normalised, since
        the reference policy is itself optimal (within the errors of the values). Values with errors may give as much
        less than 0.
    Raises:
        ParameterError: another reference.
    """
    lost = values.optimal - np.asarray(value, np.float64)
    if normalized_by is not None:
        lost = lost / values.spread(normalized_by)
    return lost if lost.ndim else float(lost)


def cumulative_expected_regret(episodes: ArrayLike, expected: ArrayLike) -> np.ndarray:
    """Expected regret summed over episodes, when the policy is evaluated only now and then.

    Between two evaluations every finished episode counts with the policy of the earlier one: a step function that a
    denser grid of evaluations refines.

    Args:
        episodes: (N,) episodes finished before each evaluation, not decreasing.
        expected: (N,) expected regret there.
    Returns:
        (N,) sums, the first 0.
    Raises:
        ParameterError: shapes differ, or the number of episodes falls.
    """
    count, lost = np.asarray(episodes, np.float64), np.asarray(expected, np.float64)
    if count.ndim != 1 or count.shape != lost.shape or not len(count):
        raise ParameterError(
            f"episodes {count.shape} and regret {lost.shape}; expected one of each for each evaluation"
        )
    between = np.diff(count)
    if (between < 0).any():
        k = int(np.argmax(between < 0)) + 1
        raise ParameterError(f"episodes fall from {count[k - 1]:g} to {count[k]:g} at evaluation {k}; expected a count")
    return np.concatenate([[0.0], np.cumsum(between * lost[:-1])])
