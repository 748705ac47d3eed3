"""Sums of rows: the one rule for probabilities that were given, in whatever form.

| sum of a row | what happens |
|---|---|
| within 1e-6 of 1 | the row is divided by its sum. What that may change is counted in the error bounds of values |
| lower | the rest ends the episode if the caller has said that rows may end, else an error |
| higher | an error |

The MDP is the one with the divided rows P. Its values also hold, within their bounds, for every MDP with other rows P'
and rewards r' that is as near as the sums say:

    sum over t of |P'(t | s, a) - P(t | s, a)| <= d      the end counts as an outcome; no other outcome is new
    |r'(s, a) - r(s, a)| <= e

where d is the largest |sum - 1| of a row and e the same times the largest reward of an outcome of that row (0 if
rewards were given for states and actions). The rows as they were given are such P', if what they lack ends the episode.
With V' = T' V', |V' - V| <= |T' V' - T' V| + |T' V - T V| <= gamma |V' - V| + gamma d |V| + e in the maximum norm,
hence |V' - V| <= (gamma d |V| + e) / (1 - gamma). With a horizon, or if no state is visited twice, the step from one
backup to the next is the same, and the sum has as many terms as there are steps.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from pharos.system.arrays import rounding_of_sums

NumberOrArray = TypeVar("NumberOrArray", float, np.ndarray)

ROUNDED = 1e-6
"""The sum of a row that was rounded differs from 1 by at most this."""


class Residual(NamedTuple):
    """Distance to which the bounds of values cover other MDPs: what the sums of rows leave open.

    Attributes:
        probabilities: d, the largest |sum - 1| of a row. rewards: e, in reward.
    """

    probabilities: float = 0.0
    rewards: float = 0.0

    def deviation(self, gamma: float, largest: NumberOrArray) -> NumberOrArray:
        """gamma d |V| + e: how far a backup of values up to `largest` may be from the backup of such an MDP."""
        return gamma * self.probabilities * largest + self.rewards

    def plus(self, other: "Residual") -> "Residual":
        """The distance to MDPs within one residual of an MDP that is within the other one."""
        return Residual(self.probabilities + other.probabilities, self.rewards + other.rewards)

    @staticmethod
    def of(residuals: np.ndarray, largest: np.ndarray | float = 0.0) -> "Residual":
        """The largest of |sum - 1| (N,) of all rows, and of its products with the largest reward of each row (N,)."""
        return Residual(float(residuals.max(initial=0.0)), float((residuals * largest).max(initial=0.0)))


def normalized_rows(
    probabilities: np.ndarray,
    rows: np.ndarray,
    count: int,
    refuse: Callable[[int, float], Exception],
    *,
    ends: bool | np.ndarray = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (probabilities (N,), |sum - 1| (count,) of the rows that were divided by their sums, else 0).

    Rows that sum to 1 up to the rounding of their entries keep every bit.

    Args:
        probabilities: (N,) finite numbers >= 0. rows: (N,) the row of each.
        refuse: (row, sum) -> the error to raise.
        ends: True if what lacks by more than 1e-6 ends the episode. Or (count,) the probability that each row ends, a
            part of its sum.
    """
    most = int(np.bincount(rows, minlength=1).max())
    sums = np.bincount(rows, probabilities, minlength=count)
    if not isinstance(ends, bool):
        sums = sums + ends
    away, rounding = np.abs(sums - 1), rounding_of_sums(most)
    is_near = away <= ROUNDED + rounding
    wrong = ~is_near & ~((sums < 1) & (ends is True))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise refuse(row, float(sums[row]))
    is_divided = is_near & (away > rounding)
    if not is_divided.any():
        return probabilities, np.zeros(count)
    return probabilities / np.where(is_divided, sums, 1.0)[rows], np.where(is_divided, away + rounding, 0.0)


def rounding_hint(total: float) -> str:
    """The likely reason if a sum is nearly 1, for the end of a message, else empty."""
    is_near = abs(total - 1) <= 1e-2
    return ": were they rounded, or computed in float32? divide each row by its sum" if is_near else ""
