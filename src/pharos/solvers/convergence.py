"""How many sweeps are left and what they cost: what solvers weigh against an attempt at something else."""

import math

from pharos.mdp import TabularMDP

# Operations that calling a sweep costs, however few states there are.
CALL = 5000
# The relative change by a sweep that is no more than rounding.
SETTLED = 2.0**-47
# Sweeps left from which on sweeping alone is given up; looked at once this many have been made.
_ENDLESS, _LOOK = 10_000, 64


def shrinking(change: float, before: float, sweeps: int, gamma: float) -> float:
    """The factor, at most gamma, by which a sweep shrinks the largest change.

    The last half of the sweeps tells: changes often shrink by much more than gamma in each.

    Args:
        change: by the last of `sweeps` sweeps. before: by the one after half of them.
    """
    return min(gamma, max(change / before, 1e-300) ** (2 / sweeps))


def sweeps_left(change: float, factor: float, tolerance: float, gamma: float) -> float:
    """Sweeps until the change proves the tolerance, when each shrinks it by `factor` < 1."""
    return math.log(max(change / (tolerance * (1 - gamma)), 1.0)) / -math.log(factor)


class Endless:
    """Whether sweeps alone would go on for ever: near gamma = 1 on cycles, or where rounding moves values about."""

    def __init__(self) -> None:
        self._bounds: list[float] = []

    def after(self, bound: float, tolerance: float) -> bool:
        """After a sweep, or a round of them, with this bound: whether 10,000 more would not reach the tolerance."""
        self._bounds.append(bound)
        count = len(self._bounds)
        if count < _LOOK:
            return False
        factor = (bound / self._bounds[count // 2]) ** (2 / count)
        return not factor < 1 or math.log(bound / tolerance) > _ENDLESS * -math.log(factor)


def operations(mdp: TabularMDP, sweeps: float) -> float:
    """Operations that so many sweeps take."""
    return sweeps * (CALL + 4.0 * mdp.num_states * mdp.width * mdp.num_actions)
