"""Least expected hitting times of one target under chance, with a certificate that counts rounding.

For a target e let T J(n) = 1 + min_a sum_m p(m | n, a) J(m), J = 0 at e. The least expected hitting time J* is its
fixed point.

Certificate. For any J >= 0 with T J - J <= above < 1 and J - T J <= below everywhere,

    J / (1 + below)  <=  J*  <=  J / (1 - above).

With c = 1 / (1 - above), T(c J) = 1 + c (T J - 1) <= 1 + c (J + above - 1) = c J: the policy that is greedy in c J
loses at least one expected step a step, so it needs at most c J. With c = 1 / (1 + below), T(c J) >= c J in the same
way, and iterating T from c J rises to J*. The origin of J does not matter, and the second half holds for J of any
sign.

The slow mode. If an attempt mostly fails and begins again, sweeps bring J nearer by one failure each. What is
missing then has one shape: W(n), how likely the target is missed for long from n. It is swept along,
W(n) = sum_m p(m | n, a) W(m) under the best actions, beginning with 1. A sweep adds f to J and takes g from W. If f is
nearly c g, J + c W is the solution, but for what sweeps mend. If J is so low that the best actions never arrive, as
each failure costs less than is missing, J is raised by itself along W first: from above, attempts are worth their
while.

Rounding. Rows sum to 1, so T J(n) - J(n) = 1 + min_a sum_m p(m | n, a) (J(m) - J(n)), and its rounding error is a few
units in the last place of sum_m p(m | n, a) |J(m) - J(n)|. The kernels add it to `above` and `below`. What is left is
that J itself is rounded: a float of 1e10 is known to 1e-6 steps, and each of the 1e10 visits on the way to the target
may lose as much. So beyond 1e9 or so J is kept as the sum of two floats, improved by Newton's method (`_refined`), and
moved up and down by W with

    W(n) - sum_m p(m | n, policy) W(m) = 2 (|residual(n)| + its error): what the residuals cost over all visits.

J + W then falls short of no step, J - W exceeds none: both certificates hold with 0. W is about 1e-12 of J. If the
linear solver itself has no correct digit (J beyond 1e15), the bounds of plain floats stand, wide as they are.

The file also has the linear equations of the hitting times of one policy, with all restart nodes as one unknown, and
the rows of the MDP without what the actions of a node share.
"""

import math
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy  # whose `sparse` is loaded on first use

from pharos.hardness.interval import BudgetClock
from pharos.kernels import hitting
from pharos.mdp import ExpandedMDP

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix
    from scipy.sparse.linalg import SuperLU

# Relative rounding of a product of a bound and a factor.
PRODUCT = 1 + 2.0**-50


@dataclass(frozen=True)
class HittingBounds:
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
        """Upper bound of a hitting time that is j in J, but for rounding: infinite if none is known, also if j is
        at most 0."""
        return j * self.high if math.isfinite(self.high) else math.inf

    @property
    def apart(self) -> float:
        """Upper divided by lower bound, minus 1."""
        return self.high / self.low - 1 if self.low > 0 else math.inf

    def meets(self, tolerance: float) -> bool:
        """Whether the bounds are within `tolerance` of each other."""
        return math.isfinite(self.high) and self.high - self.low <= tolerance * self.high

    def but_limited(self) -> "HittingBounds":
        """The same bounds, as close as floats allow."""
        return HittingBounds(self.low, self.high, self.largest, True)


def certified(above: float, below: float, largest: float) -> HittingBounds:
    """The bounds that follow from T J - J <= above and J - T J <= below."""
    high = PRODUCT / (1 - above) if above < 1 - 1e-9 else math.inf
    return HittingBounds(1 / ((1 + below) * PRODUCT), high, largest)


def added(high: np.ndarray, low: np.ndarray, more: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """high + low + more as two floats, the first of which is the nearest to the sum. Source: Knuth's and Dekker's
    sums."""
    total = high + more
    part = total - high
    rest = (high - (total - part)) + (more - part) + low
    result = total + rest
    return result, rest - (result - total)


# Sweeps before a policy is evaluated by a linear solve: as many as cost about as much as one.
SWEEPS_BEFORE_SOLVING = 40
# Nodes at the same distance from the target up to which they are tried: so many are about the size of a full matrix in
# the factors. A grid of a million nodes has a thousand, a random graph of ten thousand five thousand.
MOST_WIDTH = 8_000
# Sweeps that a linear solve takes as long as: FILL_IN times the cube of that number of nodes, by the outcomes.
FILL_IN = 1 / 30
# Seconds of a multiplication of a linear solve on a slow core: one that would outlast the budget is not begun.
SECONDS_EACH = 2e-9
# Times half of `SWEEPS_BEFORE_SOLVING` that are made in any case.
LEAST_ROUNDS = 6
# They end closer than the tolerance asks for, nearly as close as a linear solve does.
CLOSER = 1e-3
# Nodes up to which linear solves are tried: beyond, their fill-in takes more memory than the MDP.
SOLVABLE = 60_000
# Sweeps before the slow mode is looked at, sweeps between two looks, and sweeps between two that raise J by itself.
PLAIN_SWEEPS, TIME_CHECKS, RAISE = 8, 4, 12
# Cosine, squared, of the angle between what J gains and what the mode loses, from which on they are one direction.
SAME_DIRECTION = 0.95
# Beyond, no J proves anything in 64-bit floats, and raising it ends.
HIGHEST = 1e15
# Stands for infinity in the hitting times of nodes that do not surely reach the target: products with it stay finite.
TOP = 1e300
# The residual of a float J is some units in its last place: if that is more than the tolerance, one float is too
# short.
RESIDUAL_UNITS = 16
# Linear solves that do not halve the distance of the bounds, after which one float is too short as well.
STALLS = 3
# Newton steps and policies that are tried with two floats a node; each step gains two digits or more, or is the last.
MOST_NEWTON_STEPS = 12
# Linear solves without a proper policy as result, one after the other, after which the bounds stand as they are.
FAILURES = 3


class HittingTimes:
    """Solver of the hitting times of one target after the other."""

    def __init__(self, choices: ExpandedMDP):
        matrix = choices.matrix
        self.choices = choices
        self.support = (matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64), choices.num_actions)
        self.rows = hitting.Rows._make((*without_common(matrix, choices.num_actions), choices.is_restart))
        first, previous = choices.reversed
        self.back = (first.astype(np.int64), previous.astype(np.int64))
        self.node_order = np.argsort(choices.underlying, kind="stable")
        self.edges = np.searchsorted(choices.underlying[self.node_order], np.arange(choices.num_targets + 1))
        self.initial_scale = 1.0
        self._allocate()

    def _allocate(self) -> None:
        size = len(self.choices.underlying)
        self.order, self.distance = np.empty(size, np.int64), np.empty(size, np.int64)
        self.policy, self.goal = np.zeros(size, np.int64), np.zeros(size, np.bool_)
        self.mode: np.ndarray | None = None
        self.swept = self.raised = 0
        self.least = 0.0

    def for_another_thread(self) -> "HittingTimes":
        """The same problem with arrays of its own."""
        other = copy(self)
        other._allocate()
        return other

    def nodes_of(self, target: int) -> np.ndarray:
        """The nodes of a target: one, or under sticky actions one for each previous action."""
        return self.node_order[self.edges[target] : self.edges[target + 1]]

    def scale_of(self, j: np.ndarray) -> float:
        """99th percentile of hitting time divided by distance, of the target last opened."""
        there = (self.distance > 0) & (j < TOP)
        return float(np.quantile(j[there] / self.distance[there], 0.99)) if there.any() else 1.0

    def distances(self, target: int) -> int:
        """Put the nodes that lead to the target into `order` by their `distance`. Returns how many they are."""
        self.goal[:] = False
        self.goal[self.nodes_of(target)] = True
        return int(hitting.backward_order(*self.back, self.goal, self.order, self.distance))

    def open(self, target: int) -> tuple[np.ndarray, int, np.ndarray | None]:
        """Begin with a target.

        Returns:
            (J, nodes to sweep, nodes that do not surely reach the target, or None). J is a guess: `initial_scale` times
            the distance. A guess from above proves after few sweeps that a target is not the farthest.
        """
        count = self.distances(target)
        self.mode, self.swept, self.raised, self.least = None, 0, 0, 0.0
        j = np.maximum(self.distance, 0) * self.initial_scale
        if self.choices.is_connected:
            return j, count, None
        sure, reachable = np.empty_like(self.goal), np.empty_like(self.goal)
        rows = np.arange(len(sure) + 1) * self.support[2]
        hitting.almost_surely(*self.support[:2], rows, self.goal, sure, reachable, None)
        nodes = self.order[:count][sure[self.order[:count]]]
        self.order[: nodes.size] = nodes
        j[~sure] = TOP  # a choice that may lead there is never the best
        return j, nodes.size, ~sure

    def bounds(self, j: np.ndarray, count: int) -> HittingBounds:
        """Bounds by the residuals of J; the greedy policy stands in `policy` then. `least` is the best lower one."""
        arrays = (self.rows, self.goal, self.order[:count], j, None, self.policy, None)
        above, below, largest = hitting.residual_bounds(*arrays)
        bounds = certified(above, below, largest)
        self.least = max(self.least, bounds.lower)
        return bounds

    def sweep(self, j: np.ndarray, count: int, sweeps: int, enough: float, spending: BudgetClock) -> HittingBounds:
        """Bounds after sweeps in place, fewer if the upper bound is at most `enough`, the budget ends, or J does not
        move."""
        for number in range(sweeps):
            if self.swept < PLAIN_SWEEPS:
                change = hitting.sweep_in_place(self.rows, self.goal, self.order[:count], j, None)[0]
            else:
                change = self._sweep_with_mode(j, count)
            self.swept += 1
            if number % 4 == 3 or change < 1e-13:
                bounds = self.bounds(j, count)
                if change < max(1e-13, 4 * hitting.UNIT * bounds.largest):
                    return bounds.but_limited()
                if bounds.upper <= enough or spending.is_over:
                    return bounds
        return self.bounds(j, count)

    def _sweep_with_mode(self, j: np.ndarray, count: int) -> float:
        """Sweep J and the slow mode, along which J is moved now and then. Return the largest change by the sweep."""
        if self.mode is None:
            self.mode = np.zeros(len(j))
            self.mode[self.order[:count]] = ~self.goal[self.order[:count]]
        change, ff, fg, gg = hitting.sweep_in_place(self.rows, self.goal, self.order[:count], j, self.mode)
        if self.swept % TIME_CHECKS != TIME_CHECKS - 1 or not (gg > 0 and math.isfinite(ff) and change > 0):
            return float(change)
        nodes = self.order[:count]
        if fg * fg > SAME_DIRECTION * ff * gg:
            j[nodes] += fg / gg * self.mode[nodes]
        elif fg > 0 and self.swept - self.raised >= RAISE and math.isinf(self.bounds(j, count).high):
            largest = float(j[nodes].max())
            if largest < HIGHEST:
                j[nodes] += largest * self.mode[nodes]
                self.raised = self.swept
        return float(change)

    def solve(self, j: np.ndarray, count: int, tolerance: float, enough: float, spending: BudgetClock) -> HittingBounds:
        """Bounds within `tolerance` of each other, or an upper bound of at most `enough`, or what budget and floats
        allow."""
        bounds, failures, stalls, apart = self._converged(j, count, tolerance, enough, spending), 0, 0, math.inf
        while not bounds.meets(tolerance) and bounds.upper > enough and not spending.is_over:
            if count > SOLVABLE or self._outlasts(count, spending):
                if bounds.limited:
                    return bounds
                bounds = self.sweep(j, count, 8 * SWEEPS_BEFORE_SOLVING, enough, spending)
                continue
            improved = self._evaluate(count)
            if improved is None:  # the greedy policy may stay away for ever: begin with one that does not
                arrays = (*self.support[:2], self.choices.matrix.data, self.support[2])
                hitting.proper_policy(*arrays, self.goal, self.order[:count], self.policy)
                improved = self._evaluate(count)
            if improved is None:
                failures += 1
                if failures >= FAILURES:
                    return bounds.but_limited()
            else:
                failures = 0
                j[self.order[:count]] = improved
                bounds = self.bounds(j, count)
                if bounds.meets(tolerance) or bounds.upper <= enough:
                    return bounds
                stalls = stalls + 1 if bounds.apart > apart / 2 else 0
                apart = bounds.apart
                if RESIDUAL_UNITS * hitting.UNIT * bounds.largest > tolerance or stalls >= STALLS:
                    return self._refined(j, count, tolerance, bounds, spending)
            bounds = self._converged(j, count, tolerance, enough, spending)
        return bounds

    def _converged(
        self, j: np.ndarray, count: int, tolerance: float, enough: float, spending: BudgetClock
    ) -> HittingBounds:
        """Bounds after sweeps, as long as at their rate these meet sooner than a linear solve takes, or nearly so.

        The rate is taken over three times `SWEEPS_BEFORE_SOLVING` / 2 sweeps: moves along the slow mode set single ones
        back.
        """
        bounds = self.sweep(j, count, SWEEPS_BEFORE_SOLVING // 2, enough, spending)
        as_long = FILL_IN * int(self._layers(count).max(initial=0)) ** 3 / max(self.support[1].size, 1)
        left = max(LEAST_ROUNDS, int(as_long / (SWEEPS_BEFORE_SOLVING // 2)) - 1)
        unbounded = max(LEAST_ROUNDS // 2, left // 4)  # of these: while nothing is proven, no rate is known
        apart, goal = [bounds.apart], CLOSER * tolerance
        while left > 0 and not (bounds.upper <= enough or bounds.limited or bounds.apart <= goal or spending.is_over):
            bounds = self.sweep(j, count, SWEEPS_BEFORE_SOLVING // 2, enough, spending)
            left -= 1
            apart.append(bounds.apart)
            if math.isinf(bounds.apart):
                unbounded -= 1
                if unbounded < 0:
                    break
                continue
            if len(apart) > 3 and math.isfinite(apart[-4]):
                before, now = apart[-4], max(min(apart[-3:]), goal)
                if now >= before or left * math.log(before / now) < 3 * math.log(now / goal):
                    break
        return bounds

    def _outlasts(self, count: int, spending: BudgetClock) -> bool:
        """Whether a linear solve takes more than memory and the time that is left."""
        layers = self._layers(count)
        return layers.max(initial=0) > MOST_WIDTH or multiplications(layers) * SECONDS_EACH > spending.seconds_left

    def _layers(self, count: int) -> np.ndarray:
        """Numbers of nodes at each distance from the target."""
        return np.bincount(self.distance[self.order[:count]])

    def _factored(self, count: int) -> "tuple[np.ndarray, Factors] | None":
        """(inner nodes, factors of 1 - P of the greedy policy), or None if no policy is proper. Rows are made to sum to
        1."""
        nodes = self.order[:count]
        inner = nodes[~self.goal[nodes]]
        factors = factors_of(self.choices, self.policy, inner)
        return None if factors is None else (inner, factors)

    def _evaluate(self, count: int) -> np.ndarray | None:
        """The hitting times of the greedy policy, or None if it is not proper."""
        factored = self._factored(count)
        if factored is None:
            return None
        inner, factors = factored
        times = factors.solve(np.ones(inner.size))
        if not (np.isfinite(times).all() and (times > 0).all()):
            return None
        full = np.zeros(len(self.goal))
        full[inner] = times
        return full[self.order[:count]]

    # Two floats a node ------------------------------------------------------------------------------------------------

    def _refined(
        self, j: np.ndarray, count: int, tolerance: float, plain: HittingBounds, spending: BudgetClock
    ) -> HittingBounds:
        """Bounds of a J that is the sum of two floats, or `plain`, the bounds of one, if these are no better. j
        becomes J + W."""
        high, low = j.copy(), np.zeros_like(j)
        best, policy = plain.but_limited(), None
        for _ in range(MOST_NEWTON_STEPS):
            residual, _, _ = self._residuals(high, low, count)
            if policy is None or (policy != self.policy).any():
                policy, factored = self.policy.copy(), self._factored(count)
            if factored is None or spending.is_over:
                break
            inner, factors = factored
            correction = factors.solve(residual[inner])
            if not np.isfinite(correction).all():
                break
            high[inner], low[inner] = added(high[inner], low[inner], correction)
            if not (high[inner] > 0).all():
                break
            if np.abs(correction).max(initial=0.0) > 1e-3 * tolerance * high[inner].max(initial=0.0):
                continue
            bounds, above = self._moved(high, low, count, factored, spending)
            if bounds.high - bounds.low < best.high - best.low:
                best = bounds
                j[:] = above
            if best.meets(tolerance):
                break
        return best

    def _moved(
        self,
        high: np.ndarray,
        low: np.ndarray,
        count: int,
        factored: tuple[np.ndarray, "Factors"],
        spending: BudgetClock,
    ) -> tuple[HittingBounds, np.ndarray]:
        """(bounds of J* relative to J + W, J + W rounded up), by a policy that is greedy in J - W in place of J if ties
        need it."""
        inner, factors = factored
        residual, error, _ = self._residuals(high, low, count)
        cost = 2 * (np.abs(residual[inner]) + error[inner])
        margin = np.zeros_like(high)
        margin[inner] = np.maximum(factors.solve(cost), 0.0)
        _, _, (above, _) = self._residuals(*added(high, low, margin), count)
        upper = certified(above, 0.0, 1.0).high
        ceiling = np.nextafter(high + margin, math.inf) * PRODUCT
        ceiling[self.goal] = 0.0
        for _ in range(MOST_NEWTON_STEPS):
            below_high, below_low = added(high, low, -margin)
            residual, error, (_, below) = self._residuals(below_high, below_low, count)
            if below <= 1e-9 or spending.is_over:
                break
            again = self._factored(count)
            if again is None:
                break
            more = again[1].solve(np.maximum(-(residual[inner]), 0.0) + 2 * error[inner])
            if not np.isfinite(more).all():
                break
            margin[inner] += np.maximum(more, 0.0)
        lower = certified(0.0, below, 1.0).low
        ratio = float(np.min(below_high[inner] / ceiling[inner], initial=1.0)) / PRODUCT
        return HittingBounds(max(ratio * lower, 0.0), upper, float(ceiling[inner].max(initial=0.0)), True), ceiling

    def _residuals(
        self, high: np.ndarray, low: np.ndarray, count: int
    ) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
        """(residuals of J = high + low, their errors, (bound of T J - J, bound of J - T J)). The greedy policy stands
        in `policy`."""
        residuals = np.zeros_like(high), np.zeros_like(high)
        arrays = (self.rows, self.goal, self.order[:count], high, low, self.policy, residuals)
        return *residuals, hitting.residual_bounds(*arrays)[:2]


# Hitting equations ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Factors:
    """Factors of a linear system in which all restart nodes are one unknown.

    first: (unknowns,) the first node of each. unknown: (inner nodes,) which one a node is.
    """

    factors: "SuperLU"
    first: np.ndarray
    unknown: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """(inner nodes,) the solution, given the right side."""
        solution: np.ndarray = self.factors.solve(right[self.first])[self.unknown]
        return solution


def multiplications(layers: np.ndarray) -> float:
    """Multiplications of an elimination, about: of one layer after the other, each as if it were full with the next.

    Args:
        layers: (D,) numbers of nodes at each distance from the target.
    """
    return float((layers.astype(float) ** 3).sum())


def factors_of(choices: ExpandedMDP, policy: np.ndarray, inner: np.ndarray) -> Factors | None:
    """The factors of 1 - P of a policy on the `inner` nodes, or None if it is not proper. Rows are made to sum to 1."""
    first, unknown = _numbered_once(choices.is_restart[inner])
    index = np.full(len(policy), first.size)  # what leads elsewhere is left out of the equations
    index[inner] = unknown
    solved = inner[first]
    rows = scipy.sparse.csr_matrix(choices.matrix[solved * choices.num_actions + policy[solved]])
    row, column = np.repeat(np.arange(first.size), np.diff(rows.indptr)), index[rows.indices]
    data = np.where(row == column, 0.0, rows.data)
    leaving = np.bincount(row, data, first.size)
    if not _all_leave(row[data > 0], column[data > 0], first.size):
        return None  # singular, for which the linear algebra prints messages of its own
    inside = column < first.size
    matrix = scipy.sparse.coo_matrix((data[inside], (row[inside], column[inside])), shape=(first.size, first.size))
    try:
        return Factors(
            scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(scipy.sparse.diags(leaving) - matrix)), first, unknown
        )
    except RuntimeError:  # singular
        return None


def _all_leave(nodes: np.ndarray, successors: np.ndarray, number: int) -> bool:
    """Whether from each node `number`, which stands for all outside, is reached over edges from nodes to successors."""
    from scipy.sparse import csgraph

    backward = scipy.sparse.csr_matrix((np.ones(len(nodes)), (successors, nodes)), shape=(number + 1, number + 1))
    return len(csgraph.breadth_first_order(backward, number, return_predecessors=False)) == number + 1


def _numbered_once(is_restart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(first node of each group, (N,) group of each node): restart nodes are one group, every other node is one."""
    opens = ~is_restart
    if is_restart.any():
        opens[is_restart.argmax()] = True
    group = np.cumsum(opens) - 1
    if is_restart.any():
        group[is_restart] = group[is_restart.argmax()]
    return np.flatnonzero(opens), group


def without_common(matrix: "csr_matrix", num_actions: int) -> tuple[np.ndarray, ...]:
    """Rows split into the part that all actions of a node share, to be added up once, and the rest of each action.

    Under random and sticky actions most of a row is shared.

    Returns:
        ((first, node, weight) of the rest, one row for each action, (first, node, weight) of the shared part, one row
        for each node).
    """
    nodes = matrix.shape[0] // num_actions
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    pairs, index, times = np.unique(
        (row // num_actions) * np.int64(nodes) + matrix.indices, return_inverse=True, return_counts=True
    )
    least = np.full(len(pairs), np.inf)
    np.minimum.at(least, index, matrix.data)
    least[times < num_actions] = 0.0
    rest = matrix.data - least[index]
    distinct = rest > 8 * hitting.UNIT * matrix.data  # the kernels count as much as rounding of `least`
    if distinct.sum() + np.count_nonzero(least) >= matrix.nnz:  # nothing gained
        least[:] = 0.0
        rest, distinct = matrix.data, np.ones(matrix.nnz, np.bool_)
    shared = least > 0
    first = np.concatenate([[0], np.cumsum(np.bincount(row[distinct], minlength=matrix.shape[0]))])
    always = np.concatenate([[0], np.cumsum(np.bincount(pairs[shared] // nodes, minlength=nodes))])
    rest_of_rows = first.astype(np.int64), matrix.indices[distinct].astype(np.int64), rest[distinct]
    return *rest_of_rows, always.astype(np.int64), (pairs[shared] % nodes).astype(np.int64), least[shared]
