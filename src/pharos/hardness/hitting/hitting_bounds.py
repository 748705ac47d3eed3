"""Bounds of the hitting times of a target, and sums of two floats; see hitting_times for what they certify."""

import math
from dataclasses import dataclass

import numpy as np

# Relative rounding of a product of a bound and a factor.
PRODUCT = 1 + 2.0**-50


@dataclass(frozen=True)
class Bounds:
    """Bounds of all hitting times of a target: J* lies between J times `low` and J times `high`.

    largest: the largest J. limited: whether floats are too short for closer bounds, so that more time would not help.
    """

    low: float
    high: float
    largest: float
    limited: bool = False

    @property
    def lower(self) -> float:
        """Lower bound of the largest hitting time."""
        return self.largest * self.low / PRODUCT

    @property
    def upper(self) -> float:
        """Upper bound of the largest hitting time."""
        return self.at_most(self.largest) * PRODUCT

    def at_most(self, j: float) -> float:
        """Upper bound of what is j in J, but for rounding: infinite where none is known, also where J is no more than
        0."""
        return j * self.high if math.isfinite(self.high) else math.inf

    @property
    def apart(self) -> float:
        """Upper divided by lower bound, minus 1."""
        return self.high / self.low - 1 if self.low > 0 else math.inf

    def meets(self, tolerance: float) -> bool:
        """Whether the bounds are within `tolerance` of each other."""
        return math.isfinite(self.high) and self.high - self.low <= tolerance * self.high

    def but_limited(self) -> "Bounds":
        """The same bounds, as close as floats allow."""
        return Bounds(self.low, self.high, self.largest, True)


def certified(above: float, below: float, largest: float) -> Bounds:
    """The bounds that follow from T J - J <= above and J - T J <= below."""
    high = PRODUCT / (1 - above) if above < 1 - 1e-9 else math.inf
    return Bounds(1 / ((1 + below) * PRODUCT), high, largest)


def added(high: np.ndarray, low: np.ndarray, more: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """high + low + more as two floats, the first of which is the nearest to the sum. Source: Knuth's and Dekker's
    sums."""
    total = high + more
    part = total - high
    rest = (high - (total - part)) + (more - part) + low
    result = total + rest
    return result, rest - (result - total)
