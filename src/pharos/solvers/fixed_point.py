"""The fixed point of a Bellman equation, with an error bound that is proven and met.

Sweeps go in place and in reverse order of discovery: breadth-first search numbers a state before those that it leads
to, so a sweep from the last state to the first carries values back along whole paths. 20 to 40 sweeps solve games that
take a thousand plain ones. If no state can be visited twice, and gamma is 1 or the states have an age, one pass is
enough. If sweeps are slow, because gamma is near 1, solving strongly connected components one after another or
policy iteration gives a better x to go on from.

The bound. Let T be the backup, a contraction with factor rho, x* its fixed point, and let one sweep in place change
entries by at most d, with rounding errors of at most e an entry. Every new entry is a backup of entries that are old or
already new, so it is within rho max(|x_old - x*|, |x_new - x*|) + e of x*. With D = |x_new - x*| in the maximum norm
and |x_old - x*| <= D + d, D <= rho (D + d) + e, hence D <= (rho d + e) / (1 - rho). Nothing is assumed of x_old: it may
be a guess. Nor of the order: threads may share the states, as long as each state is swept once. rho is gamma times the
largest sum of probabilities, which is 1 up to the rounding of what was given.

Values that follow from x are as accurate: q = r + gamma E x has an error of at most rho D + e <= D.

Values of 32 bits. Backups are computed in 64 bits, and what is stored is the nearest float of 32: with |v| the largest
backup it is off by at most s = 2^-24 |v| + 2^-150. That is one more rounding of a new entry, so e becomes e + s. And d,
which sweeps report of the backups before they are stored, becomes d + s: D <= (rho (d + s) + e + s) / (1 - rho).

Values component by component: if play cannot come back to a state, the states that it leads to are solved first.

A strongly connected component needs the values of those that it leads to, and no others. Sweeps over all states
go on over those that are long settled, and a component settles only after the components behind it. One after another,
from the last to the first, each is swept until it is settled, and states without a cycle once.

Its result is a better x to go on sweeping from, like the result of policy_iteration.py: the bound of `fixed_point`
comes from the next sweep over all states, and nothing has to be proven of components.
Source: Dai, Mausam, Weld and Goldsmith (2011), "Topological value iteration algorithms".
"""

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from pharos.errors import PrecisionError
from pharos.mdp import BellmanEquation, Part, PolicyTable, Selection, TabularMDP
from pharos.solvers.convergence import (
    SETTLED,
    SETTLING,
    Convergence,
    operations,
    precision_error,
    shrinking,
    sweeps_left,
)
from pharos.solvers.policy_iteration import PolicyIteration
from pharos.system.arrays import UNIT_ROUNDOFF
from pharos.system.memory import SHARE_OF_VALUES, available_memory, large_zeros

M = TypeVar("M", bound="TabularMDP | Part")
Numbers = TypeVar("Numbers", float, np.ndarray)
# Half a unit in the last place of 32 bits, for numbers from 1 to 2, and for the smallest ones.
_UNIT32, _LEAST32 = 2.0**-24, 2.0**-150
# Entries of x that are looked at in one go.
_LARGEST_BLOCK = 1 << 20
# Rounding of the computation of a bound itself, and products of rounding errors.
ROUNDING_MARGIN = 1 + 2.0**-40


class FixedPoint(NamedTuple):
    """The fixed point of a backup.

    Attributes:
        x: (S + 1, W) float64 or float32: V(s, b), row S the end. W previous actions under sticky actions, else 1.
        bound: every entry is within this of the true one.
        sweeps: what it took.
    """

    x: np.ndarray
    bound: float
    sweeps: int


class Backup(Generic[M]):
    """The Bellman backup T of an MDP under a selection of actions: the best, the worst, or the actions of a policy.

    Attributes:
        dtype: that values are stored in. Backups are computed in 64 bits.
        is_single: whether that is float32.
    """

    def __init__(self, mdp: M, select: Selection, threads: int = 1, dtype: DTypeLike = np.float64):
        chance = mdp.chance
        self.dtype = np.dtype(dtype)
        self.is_single = self.dtype == np.float32
        self.mdp = mdp
        self.select, self.threads = select, threads
        self.equation = BellmanEquation(mdp.reward_table, mdp.gamma, chance, select)
        self.factor = self.factor_of(select.mass)
        # q: a product and a sum, each of two half units; with chance of choosing the mean over actions, too, and a
        # product and a sum for each of three weights, and their rounding
        per_state = 4 if chance.is_none else mdp.num_actions + 12
        self.operations = per_state + select.operations(mdp.num_actions) + mdp.dynamics.operations
        self.largest_reward = max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest))
        self.rounding_of_rewards = mdp.reward_table.rounding
        # without chance and discount, sums of whole multiples of a power of two are exact as long as 53 bits hold them
        is_sum = mdp.gamma == 1.0 and chance.is_none and mdp.dynamics.is_deterministic
        is_pure = not isinstance(select, PolicyTable) or select.actions is not None
        self._exact_to = 2.0**53 * mdp.reward_table.unit if is_sum and is_pure and mdp.reward_table.unit else -1.0

    def factor_of(self, mass: float) -> float:
        """Contraction factor, if the probabilities of choosing sum to at most `mass`."""
        chance, dynamics = self.mdp.chance, self.mdp.dynamics
        executed = chance.chosen * mass + chance.previous + chance.uniform
        is_exact = mass == 1.0 and dynamics.mass == 1.0 and chance.is_none
        return self.mdp.gamma * (1.0 if is_exact else max(1.0, executed * dynamics.mass) * (1 + 8 * UNIT_ROUNDOFF))

    @property
    def patience(self) -> float:
        """Number of sweeps that, without rounding, shrink the error by a factor of e = 2.7 or more."""
        return SETTLING + math.ceil(1 / (1 - self.factor))

    def zeros(self) -> np.ndarray:
        """(S + 1, W), mapped from a file if memory has little room for it."""
        return large_zeros((self.mdp.num_states + 1, self.mdp.width), self.dtype, share=SHARE_OF_VALUES)

    def __call__(self, x: np.ndarray, out: np.ndarray) -> np.ndarray:
        """T x, in another array, which is returned."""
        with np.errstate(over="ignore", invalid="ignore"):
            self.mdp.dynamics.backup(self.equation, x, out)
        return out

    def sweep(self, x: np.ndarray, part: tuple[int, int] | None = None) -> float:
        """Set x to T x in place, from the last state to the first if possible. Return the largest change.

        part: the range of states [start, stop) alone, if transitions are in arrays.
        """
        options = {} if part is None else {"part": part}
        with np.errstate(over="ignore", invalid="ignore"):  # the bound of values beyond floats is infinite
            return self.mdp.dynamics.sweep(self.equation, x, self.threads, **options)

    def rounding(self, largest: float) -> float:
        """A bound on the rounding error of one backup of entries up to `largest`: half a unit for each operation, and
        what storing it costs.
        """
        return float(self.rounding_of(self.largest_reward, largest)) + self.stored(largest)

    def rounding_of(self, rewards: Numbers, largest: Numbers) -> Numbers:
        """A bound on the rounding error of a backup in 64 bits of rewards up to `rewards`, entries up to `largest`.

        Rewards that are means have errors of their own, which any choice between them passes on once. 0 if whole
        numbers are added up, and 53 bits hold them.
        """
        bound = self.operations * (UNIT_ROUNDOFF * (rewards + largest) + 2.0**-1074) + self.rounding_of_rewards
        return bound * np.logical_not(rewards + largest <= self._exact_to)

    def stored(self, largest: float) -> float:
        """A bound on the error of storing a backup, if the result is at most `largest`: 0 in 64 bits."""
        return _UNIT32 * (1 + 4 * _UNIT32) * largest + 2 * _LEAST32 if self.is_single else 0.0

    def size(self, largest: float) -> float:
        """A bound on backups before they are stored, the largest of which was stored as `largest`."""
        return largest * (1 + 4 * _UNIT32) + 4 * _LEAST32 if self.is_single else largest

    def changed(self, change: float, largest: float) -> float:
        """A bound on the change of stored entries of at most `largest`. `change` is the change of a sweep, which
        compares backups before they are stored, and which some dynamics compute in 32 bits.
        """
        if not self.is_single:
            return change
        change *= 1 + 4 * _UNIT32
        return change + self.stored(self.size(largest + change))

    def bound(self, change: float, rounding: float) -> float:
        """The largest error of values that a sweep has changed by at most `change`: (rho d + e) / (1 - rho)."""
        return (self.factor * change + rounding) / (1 - self.factor) * ROUNDING_MARGIN


def fixed_point(
    backup: Backup[TabularMDP],
    tolerance: float,
    progress: Callable[[int, float], None] | None = None,
    x: np.ndarray | None = None,
) -> FixedPoint:
    """Sweep until the proven bound is at most the tolerance. At gamma = 1 no state may be visited twice.

    Args:
        x: (S + 1, W) of the backup's dtype, to sweep in, from any finite values. None: from zeros.
    Raises:
        PrecisionError: floats cannot reach the tolerance.
    """
    mdp, select = backup.mdp, backup.select
    if mdp.gamma == 1.0 or mdp.age is not None:
        return _in_one_pass(backup, tolerance, progress, x)
    convergence = Convergence(mdp, backup, tolerance, progress)
    x = backup.zeros() if x is None else x
    if backup.is_single:
        return _in_single(backup, convergence, x)
    rho, largest = backup.factor, largest_of(x)
    components, better = ComponentSolver(mdp, select), PolicyIteration(mdp, select, convergence.tick)
    while True:
        change = backup.sweep(x)
        largest += change  # at most that: the entries are read if it matters, which costs a third of a sweep
        if better.is_exact or not rho * change > max(backup.rounding(largest + change), tolerance * (1 - rho)):
            largest = largest_of(x)
        rounding = backup.rounding(largest + change)
        if convergence.is_met(backup.bound(change, rounding)):
            return FixedPoint(x, convergence.bound, convergence.sweeps)
        # x is exact up to rounding, also if values are infinite; or sweeps move rounding errors about
        convergence.check(rho * change > rounding, SETTLING if better.is_exact else math.inf)
        if components.is_worth_it(convergence.sweeps, change, tolerance) and components.improve(x, tolerance):
            largest = largest_of(x)
        elif better.is_worth_it(convergence.sweeps, change, tolerance):
            better.improve(x, tolerance)
            largest = largest_of(x)


def _in_single(backup: Backup[TabularMDP], convergence: Convergence, x: np.ndarray) -> FixedPoint:
    """Fixed point in values of 32 bits, by sweeps alone. If these would not end, in 64 bits, rounded to 32 bits at
    last: near gamma = 1 rounding to 32 bits adds up over 1 / (1 - gamma) sweeps."""
    tolerance = convergence.tolerance
    while True:
        shift = backup.sweep(x)
        largest = largest_of(x)
        change = backup.changed(shift, largest)
        if convergence.is_met(backup.bound(change, backup.rounding(backup.size(largest + change)))):
            return FixedPoint(x, convergence.bound, convergence.sweeps)
        if convergence.is_endless():
            double = Backup(backup.mdp, backup.select, backup.threads)
            result = fixed_point(double, tolerance, convergence.progress)
            with np.errstate(over="ignore"):
                x[:] = result.x
            bound = (result.bound + backup.stored(largest_of(result.x))) * ROUNDING_MARGIN
            if not bound <= tolerance:
                raise precision_error(backup.mdp, bound, tolerance, is_single=True)
            return FixedPoint(x, bound, convergence.sweeps + result.sweeps)
        convergence.check(shift != 0.0, backup.patience)


def backward_induction(
    mdp: TabularMDP, select: Selection, horizon: int, keep_all: bool = False
) -> tuple[FixedPoint, np.ndarray, np.ndarray | None]:
    """(values with `horizon` steps to go, x with one step less, all steps (T + 1, S + 1, W) if they are kept).

    Raises:
        PrecisionError: values are too large for 64-bit floats.
    """
    backup = Backup(mdp, select)
    x = backup.zeros()
    before, bound = backup.zeros(), 0.0
    steps = np.zeros((horizon + 1, *x.shape)) if keep_all else None
    largest = 0.0
    for t in range(horizon):
        before, x = x, backup(x, before)
        bound = backup.factor * bound + backup.rounding(largest) + mdp.residual.deviation(mdp.gamma, largest)
        largest = largest_of(x)
        if steps is not None:
            steps[t + 1] = x
    return FixedPoint(x, bound_of_steps(mdp, horizon, bound, largest), horizon), before, steps


def chain_bound(mdp: TabularMDP, select: Selection, x: np.ndarray, successor: np.ndarray, reward: np.ndarray) -> float:
    """The error of values x on the functional graph of a deterministic policy.

    gamma < 1: |x - x*| <= |T x - x| / (1 - gamma), with the rounding of T x. gamma = 1: paths that do not end lead into
    cycles of value 0, and rounding errors add up along at most S steps. So does what the residual of the MDP allows.
    """
    largest = largest_of(x)
    rounding = Backup(mdp, select).rounding(largest) + mdp.residual.deviation(mdp.gamma, largest)
    if mdp.gamma == 1.0:
        bound = rounding * mdp.num_states
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            residual = np.abs(reward + mdp.gamma * x[successor, 0] - x[:-1, 0]).max(initial=0.0)
        bound = (float(residual) + rounding) / (1 - mdp.gamma)
    if not math.isfinite(bound):
        raise precision_error(mdp, bound, 0.0)
    return bound * ROUNDING_MARGIN


def within_residual(mdp: TabularMDP, bound: float, x: np.ndarray) -> float:
    """The error bound of a fixed point x, enlarged so that it holds for every MDP within the residual of this one.

    (gamma d |V| + e) / (1 - gamma), see `Residual`. At gamma = 1 the sum over the steps of the longest path.
    """
    if not any(mdp.residual):
        return bound
    order = None if mdp.gamma < 1 else mdp.order()
    steps = 1 / (1 - mdp.gamma) if order is None else order.longest + 1
    return (bound + steps * mdp.residual.deviation(mdp.gamma, largest_of(x) + bound)) * ROUNDING_MARGIN


def largest_of(x: np.ndarray) -> float:
    """max |x|, NaN if an entry is NaN."""
    flat = x.reshape(-1)  # one long row: faster
    largest = 0.0
    for start in range(0, flat.size, _LARGEST_BLOCK):  # each is read once, which counts if x is in a file
        block = flat[start : start + _LARGEST_BLOCK]
        largest = float(np.maximum(largest, np.maximum(block.max(), -block.min())))
    return largest


def _in_one_pass(
    backup: Backup[TabularMDP], tolerance: float, progress: Callable[[int, float], None] | None, x: np.ndarray | None
) -> FixedPoint:
    """Fixed point if no state can be visited again: each is backed up once, after all states that it leads to.

    Rounding adds up along the way: the rounding of a state n steps before the end is at most e (1 + rho + ... + rho^n).
    """
    mdp, rho = backup.mdp, backup.factor
    order = mdp.order()
    assert order is not None  # else `goals.py` solves it
    x, backups = backup.zeros() if x is None else x, order.longest + 1
    with np.errstate(over="ignore", invalid="ignore"):
        mdp.dynamics.sweep_once(backup.equation, x, order)
        series = min(backups, 1 / (1 - rho)) if rho < 1 else backups * np.float64(rho) ** order.longest
        bound = float(backup.rounding(backup.size(largest_of(x))) * series * ROUNDING_MARGIN)
    if progress is not None:
        progress(1, bound)
    if not bound <= tolerance:
        raise precision_error(mdp, bound, tolerance, backup.is_single)
    return FixedPoint(x, bound, 1)


def bound_of_steps(mdp: TabularMDP, horizon: int, bound: float, largest: float) -> float:
    """The error bound of the values of a horizon, enlarged by the rounding of its own computation.

    Args:
        bound: sum of the errors of all steps. largest: of the values.

    Raises:
        PrecisionError: values are too large for 64-bit floats.
    """
    if not math.isfinite(bound * ROUNDING_MARGIN + largest):
        raise PrecisionError(
            f"{mdp}: the values of {horizon} steps pass 1.8e308, the largest 64-bit float; use smaller rewards"
        )
    return bound * ROUNDING_MARGIN


# Components -----------------------------------------------------------------------------------------------------------


# Sweeps before the attempt, and how many must be left: finding components takes as long as some tens of them.
SWEEPS_BEFORE, LEAST_SWEEPS_LEFT = 32, 100
# Operations that must be left: fewer take less time than compiling.
WORTH = 5e8
# States under sticky actions that are swept in one call, at least.
LEAST_PART = 512
# Sweeps over all states that an attempt may cost, at most: near gamma = 1 the number of sweeps left has no limit.
MOST_ATTEMPT_SWEEPS = 4096
# Bytes of a state that an attempt takes, at most.
STATE_BYTES = 48
# The share of the change that the tolerance allows which a component may have left.
COMPONENT_SHARE = 0.25


class ComponentSolver:
    """Solver of strongly connected components: decides once, by counting operations, whether that pays."""

    def __init__(self, mdp: TabularMDP, select: Selection):
        self.mdp, self.select = mdp, select
        self.equation = BellmanEquation(mdp.reward_table, mdp.gamma, mdp.chance, select)
        self._change, self._left = math.inf, 0.0
        self._is_tried = False

    def is_worth_it(self, sweeps: int, change: float, tolerance: float) -> bool:
        """Whether the sweeps that are left cost more than an attempt."""
        if self._is_tried or sweeps & (sweeps - 1) or not 0 < change < math.inf:
            return False
        before, self._change = self._change, change
        gamma = self.mdp.gamma
        if sweeps < SWEEPS_BEFORE or gamma == 0.0 or not self._is_known:
            return False
        self._left = sweeps_left(change, shrinking(change, before, sweeps, gamma), tolerance, gamma)
        return self._left > LEAST_SWEEPS_LEFT and operations(self.mdp, self._left) > WORTH and self._fits

    def improve(self, x: np.ndarray, tolerance: float) -> bool:
        """Settle the components of x (S + 1, W) one after another. Return whether that was tried.

        An attempt may cost half of the sweeps that seem to be left, and at most `MOST_ATTEMPT_SWEEPS`. After that every
        remaining component is swept once.
        """
        mdp, self._is_tried = self.mdp, True
        components = mdp.dynamics.components(~np.asarray(mdp.terminal), LEAST_PART if mdp.is_sticky else 1)
        if components.largest > mdp.num_states // 2:
            return False
        target = COMPONENT_SHARE * tolerance * (1 - mdp.gamma)
        with np.errstate(over="ignore", invalid="ignore"):
            most = min(0.5 * self._left, MOST_ATTEMPT_SWEEPS) * mdp.num_states
            mdp.dynamics.settle_components(self.equation, x, components, target, SETTLED, most)
        return True

    @property
    def _is_known(self) -> bool:
        """Whether parts can be swept, and a policy may have several ways from a state: one way is solved at once."""
        if isinstance(self.select, PolicyTable):
            return self.select.actions is not None and not self.mdp.is_deterministic
        return not self.mdp.is_deterministic

    @property
    def _fits(self) -> bool:
        """Whether memory has room for what an attempt takes, and for the transitions, which are read out of order."""
        each = STATE_BYTES + 4 * self.mdp.num_actions
        return each * self.mdp.num_states <= available_memory()
