"""Sweeps of one range of states after another, with a bound of each: for values that memory does not hold at once.

A range is swept a few times while its values and transitions are in memory, and left alone once its bound is met. Two
ranges of `breakout/12x8x1` are read 14 times and four 20 times, where plain sweeps read everything 33 times; they take
the backups of 46 and 67 sweeps.

The bound. Let state s of a range have been backed up last at some time. If no entry has changed by more than p since
(its own range in that sweep, others afterwards), then |T x - x|(s) <= rho p + e, with e the rounding of a backup: that
is the residual of the range. The error of all values is at most the largest residual / (1 - rho), as |x - x*| <=
|T x - x| + rho |x - x*|. So a range whose (rho p + e) / (1 - rho) is within the tolerance need not be swept again
before others have changed by more. Sums of changes are rounded up, so that p is no less than what it stands for; the
margin of the bound is for the rounding of its own computation.
"""

import math
from collections.abc import Callable

import numpy as np

from pharos.mdp import TabularMDP
from pharos.solvers.convergence import Convergence
from pharos.solvers.fixed_point import Backup, FixedPoint, fixed_point, largest_of

MOST_BLOCKS = 4096
# Sweeps of a range at most before the next one; fewer once they change it by a tenth of what the first one did.
_REPEATS, _ENOUGH = 4, 0.1


def can_be_swept_by_blocks(mdp: TabularMDP) -> bool:
    """Whether a range of its states can be swept alone, and more than once."""
    return mdp.gamma < 1 and mdp.age is None and mdp.dynamics.sweeps_ranges


def blocked_fixed_point(
    backup: Backup,
    tolerance: float,
    blocks: int,
    progress: Callable[[int, float], None] | None = None,
    x: np.ndarray | None = None,
) -> FixedPoint:
    """The fixed point of a backup, by sweeps of `blocks` ranges of the states.

    Args:
        progress: called with the number of rounds and the largest bound of a range.
        x: where to sweep, from any finite values; None: from zeros.
    Returns:
        Values and their bound; by `fixed_point`, of all ranges at once, where rounds would not end (near gamma = 1).
    Raises:
        PrecisionError: floats cannot reach the tolerance.
    """
    mdp = backup.mdp
    convergence = Convergence(mdp, backup, tolerance, progress)
    x = backup.zeros() if x is None else x
    cuts = [mdp.num_states * i // blocks for i in range(blocks + 1)]
    moved = np.full((blocks, blocks), math.inf)  # by how much range b has changed, at most, since range c was swept
    sweeps, largest = 0.0, largest_of(x)
    while True:
        for c in range(blocks - 1, -1, -1):
            if _bound(backup, moved[c], largest) <= tolerance:
                continue
            total, last, count = _swept(backup, x, (cuts[c], cuts[c + 1]), largest, tolerance)
            sweeps += count / blocks
            largest += total
            moved[:, c] = np.nextafter(moved[:, c] + total, math.inf)
            moved[c] = 0.0
            moved[c, c] = last
        largest = largest_of(x)
        if convergence.is_met(max(_bound(backup, each, largest) for each in moved)):
            return FixedPoint(x, convergence.bound, math.ceil(sweeps))
        if convergence.is_endless():
            return fixed_point(mdp, backup.select, tolerance, progress, x, backup.threads, backup.dtype)
        convergence.check(True, backup.patience)


def _swept(
    backup: Backup, x: np.ndarray, part: tuple[int, int], largest: float, tolerance: float
) -> tuple[float, float, int]:
    """Sweep a range some times; (by how much its values have changed in all, and in the last sweep, sweeps)."""
    total = first = change = 0.0
    count = 0
    while count < _REPEATS:
        count += 1
        change = backup.changed(backup.sweep(x, part), largest + total)
        total = math.nextafter(total + change, math.inf)
        first = first or change
        if change <= _ENOUGH * first or _bound(backup, np.array([change]), largest + total) <= tolerance:
            break
    return total, change, count


def _bound(backup: Backup, moved: np.ndarray, largest: float) -> float:
    """The largest residual of a range whose inputs have changed so much, over 1 - rho."""
    change = float(moved.max())
    return backup.bound(change, backup.rounding(backup.size(largest + change)))
