"""Convergence of sweeps: tests for it and for its failure, and estimates of the sweeps left and of their cost."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from pharos.errors import PrecisionError
from pharos.mdp import TabularMDP

if TYPE_CHECKING:
    from pharos.mdp import Part
    from pharos.solvers.fixed_point import Backup

# Sweeps that gain nothing, from values that only rounding still moves, until it is clear that it stops them.
SETTLING = 64

# Operations that calling a sweep costs, however few states there are.
CALL = 5000
# The relative change by a sweep that is no more than rounding.
SETTLED = 2.0**-47
# Sweeps left from which on sweeping alone is given up; looked at once this many have been made.
_ENDLESS, _LOOK = 10_000, 64


def shrinking(change: float, before: float, sweeps: int, gamma: float) -> float:
    """The factor, at most gamma, by which a sweep shrinks the largest change.

    It is the mean over the last half of the sweeps: changes often shrink by much more than gamma in each.

    Args:
        change: by the last of `sweeps` sweeps. before: by the one after half of them.
    """
    return min(gamma, max(change / before, 1e-300) ** (2 / sweeps))


def sweeps_left(change: float, factor: float, tolerance: float, gamma: float) -> float:
    """Sweeps until the change proves the tolerance, when each shrinks it by `factor` < 1."""
    return math.log(max(change / (tolerance * (1 - gamma)), 1.0)) / -math.log(factor)


class Convergence:
    """Record of sweeps, or of rounds of them, on the way to a proven bound that meets the tolerance.

    Attributes:
        sweeps: number so far. bound: after the last one. least: the smallest bound so far, but for gains of less than a
            tenth. in_vain: sweeps since then.
    """

    def __init__(
        self,
        mdp: TabularMDP,
        backup: "Backup[TabularMDP] | Backup[Part]",
        tolerance: float,
        progress: Callable[[int, float], None] | None = None,
    ):
        """
        Raises:
            PrecisionError: rounding errors alone are beyond the tolerance.
        """
        self.mdp, self.is_single, self.tolerance, self.progress = mdp, backup.is_single, tolerance, progress
        self.sweeps, self.in_vain, self.least = 0, 0, math.inf
        self.bound = backup.rounding(0.0) / (1 - backup.factor) if backup.factor < 1 else math.inf
        if not self.bound <= tolerance:
            raise precision_error(mdp, self.bound, tolerance, self.is_single)
        self._bounds: list[float] = []

    def is_met(self, bound: float) -> bool:
        """Whether the bound after one more sweep meets the tolerance."""
        self.sweeps, self.bound, self.in_vain = self.sweeps + 1, bound, self.in_vain + 1
        if self.progress is not None:
            self.progress(self.sweeps, bound)
        if bound < 0.9 * self.least:
            self.least, self.in_vain = bound, 0
        return bound <= self.tolerance

    def is_endless(self) -> bool:
        """Whether 10,000 further sweeps would not suffice: near gamma = 1 on cycles, or if rounding moves values.

        To be called after every sweep.
        """
        self._bounds.append(self.bound)
        count = len(self._bounds)
        if count < _LOOK or not math.isfinite(self.bound):
            return False
        factor = (self.bound / self._bounds[count // 2]) ** (2 / count)
        return not factor < 1 or math.log(self.bound / self.tolerance) > _ENDLESS * -math.log(factor)

    def tick(self) -> None:
        """Say between sweeps that work goes on."""
        if self.progress is not None:
            self.progress(self.sweeps, self.bound)

    def check(self, is_moving: bool, patience: float) -> None:
        """PrecisionError unless sweeps move values by more than rounding does, and have gained within `patience`."""
        if not math.isfinite(self.bound):
            raise precision_error(self.mdp, self.bound, self.tolerance, self.is_single)
        if not is_moving or self.in_vain > patience:
            raise precision_error(self.mdp, min(self.least, self.bound), self.tolerance, self.is_single)


def operations(mdp: TabularMDP, sweeps: float) -> float:
    """Operations that so many sweeps take."""
    return sweeps * (CALL + 4.0 * mdp.num_states * mdp.width * mdp.num_actions)


def precision_error(mdp: TabularMDP, bound: float, tolerance: float, is_single: bool = False) -> PrecisionError:
    """PrecisionError that 64-bit floats, or 32-bit ones if values are stored so, do not reach the tolerance."""
    bits, end, advice = (32, "3.4e38", "use float64, ") if is_single else (64, "1.8e308", "")
    if not math.isfinite(bound):
        return PrecisionError(
            f"{mdp}: {bits}-bit floats give no bound at gamma = {mdp.gamma!r}: values pass {end}, or probabilities sum "
            "to 1 / gamma or more; lower gamma or the rewards"
        )
    return PrecisionError(
        f"{mdp}: {bits}-bit floats reach a bound of {bound:.2g} at gamma = {mdp.gamma!r}; asked for {tolerance:.2g}: "
        f"{advice}raise the tolerance or lower gamma"
    )
