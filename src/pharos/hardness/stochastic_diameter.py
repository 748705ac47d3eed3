"""Diameter under chance: for every target one stochastic shortest path problem, most of them only as far as bounds need.

For a target e let T J(n) = 1 + min_a sum_m p(m | n, a) J(m), J = 0 at e; the least expected hitting time J* is its fixed point.

Certificate. For any J >= 0 with T J - J <= above < 1 and J - T J <= below everywhere,

    J / (1 + below)  <=  J*  <=  J / (1 - above).

With c = 1 / (1 - above), T(c J) = 1 + c (T J - 1) <= 1 + c (J + above - 1) = c J: the policy that is greedy in c J loses at least
one expected step a step, so it needs at most c J. With c = 1 / (1 + below), T(c J) >= c J in the same way, and iterating T from
c J rises to J*. It does not matter where J comes from: sweeps in place from the target outwards, then policies evaluated by a
sparse linear solve where sweeps are slow. They begin with the distance times what the hitting times of the farthest target so far are of its
distances, at their upper end: from above, few sweeps prove that a target is not the one. A target whose upper bound falls below the largest proven hitting time is dropped
at once.

Solved targets bound the others (`_travel`), so that there is an interval whenever the budget ends. Where there are so many nodes that a
look at each target would take longer than that, the target with the largest upper bound is always the next.
"""

import itertools
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from pharos.errors import UndefinedMeasure
from pharos.hardness.choices import Choices, choices_of
from pharos.hardness.interval import Budget, Interval, Spending, conventions_of
from pharos.hardness.travel import TravelBounds
from pharos.mdp import TabularMDP
from pharos.rules.compiled import usable_workers

SWEEPS = 40  # before a policy is evaluated by a linear solve
SOLVABLE = 60_000  # nodes up to which linear solves are tried
TOP = 1e300
BATCH = 64  # targets that threads look at with the same largest hitting time known
MANY = 10**9  # nodes times targets from which on looking at each target for the most promising takes too long
TRIAL = 16  # targets after which bounds of others must have closed
CLOSED = 10  # targets each, or the others are looked at one by one


# Targets ----------------------------------------------------------------------------------------------------------------


class _Targets:
    """The hitting times of one target after the other."""

    def __init__(self, choices: Choices):
        matrix = choices.matrix
        self.choices = choices
        self.support = (matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64), choices.num_actions)
        self.arrays = _without_common(matrix, choices.num_actions)
        first, previous = choices.reversed
        self.back = (first.astype(np.int64), previous.astype(np.int64))
        self.members = np.argsort(choices.underlying, kind="stable")
        self.edges = np.searchsorted(choices.underlying[self.members], np.arange(choices.num_targets + 1))
        self.ratio = 1.0
        self._make_room()

    def ratio_of(self, j: np.ndarray) -> float:
        """What the hitting times of the target last opened are of the distances, at their upper end."""
        there = (self.distance > 0) & (j < TOP)
        return float(np.quantile(j[there] / self.distance[there], 0.99)) if there.any() else 1.0

    def _make_room(self) -> None:
        size = len(self.choices.underlying)
        self.order, self.distance = np.empty(size, np.int64), np.empty(size, np.int64)
        self.policy, self.goal = np.zeros(size, np.int64), np.zeros(size, np.bool_)

    def for_another_thread(self) -> "_Targets":
        """The same problem with room of its own."""
        other = copy(self)
        other._make_room()
        return other

    def nodes_of(self, target: int) -> np.ndarray:
        return self.members[self.edges[target] : self.edges[target + 1]]

    def open(self, target: int) -> tuple[np.ndarray, int, np.ndarray | None]:
        """(J, nodes to sweep, nodes that do not surely reach the target, or None): J a guess, `ratio` times the distance."""
        from pharos.kernels import hitting

        self.goal[:] = False
        self.goal[self.nodes_of(target)] = True
        count = hitting.backward_order(*self.back, self.goal, self.order, self.distance)
        j = np.maximum(self.distance, 0) * self.ratio
        if self.choices.is_connected:
            return j, count, None
        sure, found = np.empty_like(self.goal), np.empty_like(self.goal)
        hitting.almost_surely(*self.support, self.goal, sure, found)
        keep = sure[self.order[:count]]
        kept = self.order[:count][keep]
        self.order[: kept.size] = kept
        j[~sure] = TOP  # a choice that may lead there is never the best
        return j, kept.size, ~sure

    def bounds(self, j: np.ndarray, count: int) -> tuple[float, float, float]:
        """(factor of the lower bound, factor of the upper bound, largest J): J* is between J times these."""
        from pharos.kernels import hitting

        above, below, largest = hitting.residuals(*self.arrays, self.goal, self.order, count, j, self.policy)
        return 1 / (1 + below), 1 / (1 - above) if above < 1 else math.inf, largest

    def sweep(
        self, j: np.ndarray, count: int, sweeps: int, enough: float, spending: Spending
    ) -> tuple[float, float, float]:
        """Sweeps in place; ends early where the upper bound is at most `enough`, or the budget ends."""
        from pharos.kernels import hitting

        for number in range(sweeps):
            change = hitting.sweep_in_place(*self.arrays, self.goal, self.order, count, j)
            if number % 4 == 3 or change < 1e-13:
                low, high, largest = self.bounds(j, count)
                if largest * high <= enough or change < 1e-13 or spending.is_over:
                    return low, high, largest
        return self.bounds(j, count)

    def solve(
        self, j: np.ndarray, count: int, tolerance: float, enough: float, spending: Spending
    ) -> tuple[float, float, float]:
        """Until the bounds are within `tolerance` of each other, or the upper one is at most `enough`."""
        low, high, largest = self.sweep(j, count, SWEEPS, enough, spending)
        while not _met(low, high, tolerance) and largest * high > enough and not spending.is_over:
            if count <= SOLVABLE:
                improved = self._evaluate(count)
                if improved is not None:
                    j[self.order[:count]] = improved
                    low, high, largest = self.bounds(j, count)
                    if _met(low, high, tolerance) or largest * high <= enough:
                        break
            low, high, largest = self.sweep(j, count, SWEEPS if count <= SOLVABLE else 8 * SWEEPS, enough, spending)
        return low, high, largest

    def _evaluate(self, count: int) -> np.ndarray | None:
        """The hitting times of the greedy policy; None where it is not proper."""
        nodes = self.order[:count]
        inner = nodes[~self.goal[nodes]]
        rows = self.choices.matrix[inner * self.choices.num_actions + self.policy[inner]][:, inner]
        try:
            times = splu(sparse.csc_matrix(sparse.identity(inner.size) - rows)).solve(np.ones(inner.size))
        except RuntimeError:  # singular
            return None
        if not (np.isfinite(times).all() and (times > 0).all()):
            return None
        full = np.zeros(len(self.goal))
        full[inner] = times
        return full[nodes]


def _without_common(matrix: Any, num_actions: int) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """(first, node, weight) of the rows without what all actions of a node have in common, and that: (first, node, weight) of nodes.

    Under random actions each action may be replaced by any other, under sticky ones by the previous: that part is then added up once.
    """
    nodes = matrix.shape[0] // num_actions
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    pairs, place, times = np.unique(
        (row // num_actions) * np.int64(nodes) + matrix.indices, return_inverse=True, return_counts=True
    )
    least = np.full(len(pairs), np.inf)
    np.minimum.at(least, place, matrix.data)
    least[times < num_actions] = 0.0
    rest = matrix.data - least[place]
    kept = rest > 1e-15
    if kept.sum() + np.count_nonzero(least) >= matrix.nnz:  # nothing gained
        least[:] = 0.0
        rest, kept = matrix.data, np.ones(matrix.nnz, np.bool_)
    shared = least > 0
    first = np.concatenate([[0], np.cumsum(np.bincount(row[kept], minlength=matrix.shape[0]))])
    always = np.concatenate([[0], np.cumsum(np.bincount(pairs[shared] // nodes, minlength=nodes))])
    return (
        (first.astype(np.int64), matrix.indices[kept].astype(np.int64), rest[kept]),
        (always.astype(np.int64), (pairs[shared] % nodes).astype(np.int64), least[shared]),
    )


def _met(low: float, high: float, tolerance: float) -> bool:
    """Whether bounds by these factors are within `tolerance` of each other."""
    return math.isfinite(high) and high - low <= tolerance * high


def stochastic_diameter(mdp: TabularMDP, restart: bool, tolerance: float, spending: Spending) -> Interval:
    """The diameter of an MDP with chance: exact up to `tolerance`, or the interval proven when the budget ends."""
    choices = choices_of(mdp, restart)
    conventions = {**conventions_of(mdp, restart), "nodes": len(choices.underlying), "sticky_pairs": mdp.is_sticky}
    return _Diameter(mdp, restart, choices, tolerance, spending).interval(conventions)


class _Diameter:
    """Bounds of the largest hitting time of every target, tightened until none may exceed the largest that is proven.

    Attributes:
        upper: (targets,) of the largest hitting time of each; -inf where it is settled.
        lower: the largest hitting time that is proven, of pairs that are surely connected.
        settled_upper: the largest upper bound of settled targets.
    """

    def __init__(self, mdp: TabularMDP, restart: bool, choices: Choices, tolerance: float, spending: Spending):
        self.mdp, self.restart, self.choices = mdp, restart, choices
        self.tolerance, self.spending = tolerance, spending
        self.targets = _Targets(choices)
        self.threads = [self.targets, *(self.targets.for_another_thread() for _ in range(usable_workers(None) - 1))]
        met = np.diff(self.targets.edges) > 0
        self.many = len(choices.underlying) * choices.num_targets > MANY
        self.upper = np.where(met, math.inf if self.many else choices.crude_upper, -math.inf)
        self.lower = self.settled_upper = 0.0
        self.unreachable = int(np.count_nonzero(~met)) * (
            choices.num_targets - 1
        )  # states that cannot be reached at all
        self._travel: TravelBounds | None = None

    def interval(self, conventions: dict[str, Any]) -> Interval:
        """Look at targets until the bounds meet, or the budget ends."""
        connected = self.choices.is_connected
        with ThreadPoolExecutor(len(self.threads)) as pool:
            if connected:
                for batch in self._widest():
                    self._look_at(batch, pool, bounding=True)
            if not self.many:  # else, where not connected: it is infinite, and that is all that can be said
                for batch in self._promising():
                    self._look_at(batch, pool, bounding=False)
        left = int(np.count_nonzero(self.upper > -math.inf))
        lower, upper, note = self.lower, self._upper(), ""
        exact = not left and (math.isfinite(upper) and upper - lower <= 2 * self.tolerance * upper)
        if left:
            note = f"budget spent: {left} of {self.choices.num_targets} targets may have a larger hitting time"
        elif not exact:
            note = "budget spent before the bounds of the last targets met"
        if self.unreachable or not connected:
            lower = upper = math.inf
            exact = not left
            note = note if left else ""
        self.spending.report(lower, upper, left, now=True)
        return Interval(
            lower,
            upper,
            exact,
            unreachable_pairs=int(self.unreachable),
            finite_part=self.lower,
            counted=not left,
            tolerance=self.tolerance,
            searches=self.spending.searches,
            method="a stochastic shortest path problem for each target, bounds from residuals",
            conventions=conventions,
            note=note,
            seconds=self.spending.seconds,
        )

    def _upper(self) -> float:
        return max(self.settled_upper, self.lower, float(self.upper.max()))

    def _promising(self) -> Iterator[list[int]]:
        """Those that are left, the farthest from some node first; in batches that grow, as the first makes a guess for the others."""
        order = [int(target) for target in _by_promise(self.targets, self.upper > -math.inf, self.spending)]
        size = 1
        while order and not self.spending.is_over:
            order = [target for target in order if self.upper[target] > -math.inf]
            left = self.spending.budget.searches - self.spending.searches
            batch, order = order[: int(min(size, left))], order[int(min(size, left)) :]
            if batch:
                yield batch
            size = min(2 * size, BATCH)

    def _widest(self) -> Iterator[list[int]]:
        """A start state, then those of the largest upper bounds, two at once; for as long as it pays, or while there are too many for anything else."""
        batch = [int(self.choices.underlying[self.choices.starts[0][0]])]
        apart = self.choices.num_targets // 64 + 1
        while batch and not self.spending.is_over:
            yield batch
            searches = self.spending.searches
            if not self.many and searches >= TRIAL and np.count_nonzero(self.upper == -math.inf) < CLOSED * searches:
                return
            widest = int(self.upper.argmax())
            others = self.upper.copy()
            others[max(0, widest - apart) : widest + apart] = -math.inf  # neighbours bound each other
            left = self.spending.budget.searches - self.spending.searches
            batch = [each for each in (widest, int(others.argmax())) if self.upper[each] > -math.inf]
            batch = list(dict.fromkeys(batch))[: int(min(2, left))]

    def _look_at(self, batch: list[int], pool: ThreadPoolExecutor, bounding: bool) -> None:
        threads = self.threads
        learning = bounding or not self.spending.searches
        looks = [
            pool.submit(_look, own, part, self.tolerance, self.lower, self.spending, learning, bounding)
            for i, own in enumerate(threads)
            if (part := batch[i :: len(threads)])
        ]
        for look in itertools.chain.from_iterable(look.result() for look in looks):
            if learning and look.low >= self.lower:
                self.targets.ratio = look.ratio
            self.lower = max(self.lower, look.low)
            self.settled_upper = max(self.settled_upper, min(look.high, self.upper[look.target]))
            self.unreachable += look.unreachable
            self.upper[look.target] = -math.inf
            if look.times is not None and math.isfinite(look.high):
                self._bound_others(look.target, look.times)
        self.upper[self.upper <= self.lower] = -math.inf
        self.spending.searches += len(batch)
        for own in threads:
            own.ratio = self.targets.ratio
        self.spending.report(self.lower, self._upper(), int(np.count_nonzero(self.upper > -math.inf)))

    def _bound_others(self, hub: int, times: np.ndarray) -> None:
        """From the hitting times (nodes,) of a solved target."""
        if self._travel is None:
            self._travel = TravelBounds(self.mdp, self.restart)
        by_state = np.zeros(self.choices.num_targets)
        np.maximum.at(by_state, self.choices.underlying, times)
        bound = float(by_state.max()) + self._travel.times_from(hub, by_state)
        np.minimum(self.upper, bound, out=self.upper)


@dataclass
class _Look:
    """Bounds of the largest hitting time of a target, how many states do not surely reach it, and upper bounds for all nodes.

    ratio: what its hitting times are of the distances.
    """

    target: int
    low: float
    high: float
    unreachable: int
    ratio: float
    times: np.ndarray | None


def _look(
    targets: _Targets, some: list[int], tolerance: float, enough: float, spending: Spending, learn: bool, hubs: bool
) -> list[_Look]:
    """Each of `some`. What lies below `enough` is known no better than that; it is the same for all targets of a batch, so that
    results do not depend on the number of threads. With `learn`, the ratio comes along; with `hubs`, upper bounds for all nodes.
    """
    found = []
    for target in some:
        j, count, lost = targets.open(target)
        missing = 0 if lost is None else np.unique(targets.choices.underlying[lost]).size
        low, high, largest = targets.solve(j, count, tolerance, enough, spending)
        times = j * high if hubs and lost is None and math.isfinite(high) else None
        ratio = targets.ratio_of(j) if learn else 1.0
        found.append(_Look(target, largest * low, largest * high, missing, ratio, times))
    return found


def _by_promise(targets: _Targets, wanted: np.ndarray, spending: Spending) -> np.ndarray:
    """The targets wanted, those first that are farthest from some node: a large hitting time found early lets others be dropped."""
    from pharos.kernels import hitting

    promise = np.zeros(len(wanted))
    for target in np.flatnonzero(wanted):
        if spending.is_over:
            break
        targets.goal[:] = False
        targets.goal[targets.nodes_of(int(target))] = True
        count = hitting.backward_order(*targets.back, targets.goal, targets.order, targets.distance)
        promise[target] = targets.distance[targets.order[count - 1]] if count else 0
    order = np.argsort(-promise, kind="stable")
    return order[wanted[order]]


def stochastic_start_eccentricity(
    mdp: TabularMDP, restart: bool, tolerance: float, budget: Budget | None = None
) -> float:
    """The largest least expected number of steps from the start, within `tolerance`.

    Raises:
        UndefinedMeasure: out of reach of the budget (300 seconds by default).
    """
    choices = choices_of(mdp, restart)
    targets = _Targets(choices)
    spending = Spending(budget or Budget(), None)
    nodes = np.array([node for node, _ in choices.starts])
    weights = np.array([weight for _, weight in choices.starts])
    best = 0.0
    for target in range(choices.num_targets):
        if spending.is_over:
            raise UndefinedMeasure(
                f"start_eccentricity: {target} of {choices.num_targets} targets were solved in the budget, and reach {best:.6g}; "
                f"a larger budget would define it"
            )
        if not targets.nodes_of(target).size:
            return math.inf
        j, count, lost = targets.open(target)
        if lost is not None and lost[nodes].any():
            return math.inf
        _, high, _ = targets.sweep(j, count, SWEEPS, 0.0, spending)
        if float(weights @ j[nodes]) * high <= best:
            continue
        low, high, _ = targets.solve(j, count, tolerance, 0.0, spending)
        if not _met(low, high, tolerance):
            raise UndefinedMeasure(
                f"start_eccentricity: the budget ended within a target, at {float(weights @ j[nodes]) * low:.6g} or more; "
                f"a larger budget would define it"
            )
        best = max(best, float(weights @ j[nodes]) * high)
    return best
