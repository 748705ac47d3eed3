"""Regret: what is lost by not having played the optimal policy from the first episode on.

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
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.solvers import regret_scale
from pharos.training import results as _results

if TYPE_CHECKING:
    from pharos.training.task import Task


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
    def of(task: "Task") -> "ReferenceValues":
        """Those of a task; the space is built and solved where it is not yet."""
        return task.reference

    def spread(self, reference: str = "uniform") -> float:
        """V* - V of the reference policy, "uniform" or "worst"; NaN where it is too small to divide by.

        Raises:
            ParameterError: another reference.
        """
        if reference not in ("uniform", "worst"):
            raise ParameterError(f"reference is {reference!r}; expected 'uniform' or 'worst'")
        return regret_scale(self.optimal, getattr(self, reference), self.error_bound)


def regret(value: Any, values: ReferenceValues, *, normalized_by: str | None = None) -> Any:
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


def cumulative_expected_regret(episodes: Any, expected: Any) -> np.ndarray:
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


@dataclass(frozen=True, eq=False)
class RegretCurve:
    """The regret of one run, at its N evaluations.

    Attributes:
        steps, episodes: (N,) environment steps and finished episodes before each evaluation.
        policy_values: (N,) value of the policy from the start.
        returns: (N,) sum of the returns of all episodes finished so far.
        values: of the task's reference policies.
    """

    steps: np.ndarray
    episodes: np.ndarray
    policy_values: np.ndarray
    returns: np.ndarray
    values: ReferenceValues

    @staticmethod
    def read(folder: str | os.PathLike) -> "RegretCurve":
        """That of a finished run.

        Raises:
            FileFormatError: the folder holds no finished run.
        """
        curve, result = _results.read_curve(folder), _results.read_record(folder)["result"]
        episodes = curve["episodes"].to_numpy(np.int64)
        entries = [result[f"value_{name}"] for name in ("optimal", "uniform", "worst")]
        values = ReferenceValues(*(math.nan if value is None else value for value in entries))
        returns = episodes * values.optimal - curve["cumulative_realised_regret"].to_numpy(np.float64)
        return RegretCurve(curve["step"].to_numpy(np.int64), episodes, curve["value"].to_numpy(float), returns, values)

    @property
    def expected(self) -> np.ndarray:
        """(N,) expected regret of the policy at each evaluation."""
        return regret(self.policy_values, self.values)

    @property
    def cumulative_expected(self) -> np.ndarray:
        """(N,) expected regret summed over episodes, see `cumulative_expected_regret`."""
        return cumulative_expected_regret(self.episodes, self.expected)

    @property
    def cumulative_realised(self) -> np.ndarray:
        """(N,) episodes V*(s0) - sum of returns."""
        return self.episodes * self.values.optimal - self.returns

    def normalized(self, cumulative: np.ndarray, reference: str = "uniform") -> np.ndarray:
        """A cumulative regret of this run divided by what the reference policy loses in as many episodes.

        NaN before the first episode is finished, and where the reference policy is optimal.
        """
        lost = self.episodes * self.values.spread(reference)
        return np.divide(cumulative, lost, out=np.full(len(lost), math.nan), where=lost > 0)
