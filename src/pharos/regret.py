"""Regret: what is lost by not having played the optimal policy from the first episode on, and its one normalisation.

Episode k starts in s0 and is played with policy pi_k. V* and V^pi are values from the start, in the same setting
(discount, horizon, chance) as the returns.

    expected regret     V*(s0) - V^{pi_k}(s0)      of a policy, by exact evaluation; never negative
    realised regret     V*(s0) - return_k          of an episode as it was played, exploration and luck included
    cumulative          summed over the episodes of a run
    normalised          divided by the same of a reference policy: 0 is optimal, 1 as bad as the reference

Both agree in expectation if pi_k is what played episode k. A DQN also explores, so its realised regret is larger.

Source: expected regret over episodes: Azar, Osband and Munos (2017), section 2. Expected and realised ("pseudo-regret"
and "regret"): Bubeck and Cesa-Bianchi (2012), section 1. 1 minus the normalised regret is the normalised score of Mnih
et al. (2015), with the exact optimum in place of a human.
"""

import math
from dataclasses import dataclass
from typing import Protocol, overload

import numpy as np
from numpy.typing import ArrayLike

from pharos.errors import ParameterError

SMALLEST_SCALE = 1e-12  # in discounted return: below it a ratio is one of rounding errors


@overload
def regret_scale(optimal: float, reference: float, error_bound: float = 0.0) -> float: ...


@overload
def regret_scale(optimal: ArrayLike, reference: ArrayLike, error_bound: float = 0.0) -> float | np.ndarray: ...


def regret_scale(optimal: ArrayLike, reference: ArrayLike, error_bound: float = 0.0) -> float | np.ndarray:
    """Return V* - V of a reference policy: divided by it, the regret of the optimum is 0, of the reference policy 1.

    Args:
        optimal, reference: numbers or arrays, values from the start, in return.
        error_bound: of each of the two.
    Returns:
        A float or an array, in return. NaN if it is not above max(1e-12, 2 `error_bound`): then the reference
        policy is itself optimal, as far as the values can show, and regret has no scale. NaN also if it is infinite.
    Source: 1 - regret / scale is the normalised score of Mnih et al. (2015), with the exact optimum in the place of a
        human. The threshold is ours.
    """
    scale = np.asarray(np.asarray(optimal, np.float64) - np.asarray(reference, np.float64))
    scale = np.where((scale > max(SMALLEST_SCALE, 2 * error_bound)) & (scale < np.inf), scale, np.nan)
    return scale if scale.ndim else float(scale)


class HasReference(Protocol):
    """A task, which knows the values that regret is measured against."""

    @property
    def reference(self) -> "ReferenceValues": ...


@dataclass(frozen=True)
class ReferenceValues:
    """Values from the start of the policies that regret is measured against.

    Attributes:
        optimal, uniform, worst: of the optimal, the uniformly random and the worst policy. `worst` may be NaN if
            unknown.
        error_bound: each is within this of the true value.
    """

    optimal: float
    uniform: float
    worst: float = math.nan
    error_bound: float = 0.0

    @staticmethod
    def of(task: "HasReference") -> "ReferenceValues":
        """Reference values of a task. Its space is built and solved if it is not yet."""
        return task.reference

    def spread(self, reference: str = "uniform") -> float:
        """V* - V of the reference policy, "uniform" or "worst", NaN if it is too small to divide by.

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
        normalized_by: None, or "uniform" or "worst", the policy whose regret is 1.
    Returns:
        A float or an array, in units of return, or without if normalised. NaN if it cannot be normalised, because
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
    losses = np.multiply(between, lost[:-1], out=np.zeros(len(between)), where=between > 0)  # of total rewards: inf
    return np.concatenate([[0.0], np.cumsum(losses)])
