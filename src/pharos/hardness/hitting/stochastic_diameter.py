"""Diameter under chance: for every target one stochastic shortest path problem, most of them only as far as bounds
need.

`hitting_times` bounds the hitting times of one target. This file chooses the targets. A target whose upper bound falls
below the largest hitting time proven so far is dropped at once. Solved targets bound the others (`travel`), so that
there is an interval whenever the budget ends. Where a look at each target would take longer than that, the target with
the largest upper bound is always the next.

Start eccentricity under chance: a stochastic shortest path problem for each target that bounds do not rule out.

The target with the largest upper bound is always the next, so that there is an interval whenever the budget ends. The
first bounds are those from the start; solved targets are hubs for others as long as they rule some out (`travel`).
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pharos.hardness.hitting.hitting_times import SWEEPS, HittingTimes
from pharos.hardness.hitting.travel import HubBounds
from pharos.hardness.interval import BudgetClock, Interval, conventions_of
from pharos.kernels.hitting import UNIT
from pharos.mdp import ExpandedMDP, TabularMDP
from pharos.system.workers import usable_workers

# Most targets that threads look at before they learn of a larger hitting time: a target may be looked at in vain that
# often.
BATCH = 64
# Nodes times targets from which on one search for each target, to find the most promising, takes minutes.
MANY = 10**9
# Targets that are solved before it is judged whether their bounds rule out others.
TRIAL = 16
# Targets that each of the last `TRIAL` ones must have ruled out on average, or all of them half of those left; else
# looking at the others one by one is quicker.
RULED_OUT = 40
# Nodes on the way to a target through which its bound is shortened, and one in how many targets, drawn by their
# numbers: a few are bounded by long ways, and the others from these by short ones. 0: those of the largest bounds, as
# many as of the long ways.
WAYS = ((64, 1), (4096, 64), (1024, 16), (256, 1), (4096, 0))
# Nodes there must be for each node on a way; the share that is left of the median and of the largest of the bounds
# beyond which no more is tried; and times as long as the ways before take the next ones.
NODES_EACH, TAKEN, LONGER = 8, 0.95, 5
# Mixes the numbers of targets, neighbours among which are alike.
_MIX = np.uint64(0x9E3779B97F4A7C15)
# Targets that are solved before that, where there are too many for a look at each, or bounds are so many times apart.
FIRST, APART = 3, 2.0
# `crude_upper` is a product of up to N rounded factors.
CRUDE = 1.01


def stochastic_diameter(mdp: TabularMDP, restart: bool, tolerance: float, spending: BudgetClock) -> Interval:
    """The diameter of an MDP with chance: exact up to `tolerance`, or the interval proven by budget and floats."""
    choices = ExpandedMDP.of(mdp, restart)
    conventions = {**conventions_of(mdp, restart), "nodes": len(choices.underlying), "sticky_pairs": mdp.is_sticky}
    return _Diameter(mdp, restart, choices, tolerance, spending).run(conventions)


class TargetBounds:
    """Bounds of a time to each target, tightened until none may exceed the largest that is proven.

    Attributes:
        farther: the words for a target that may exceed it.
        upper: (targets,) of the time to each; -inf where it is settled.
        lower: the largest time that is proven. settled_upper: the largest upper bound of settled targets.
        limited: targets whose bounds are as close as floats allow, and no closer than the tolerance.
    """

    farther: str

    def __init__(self, mdp: TabularMDP, restart: bool, choices: ExpandedMDP, tolerance: float, spending: BudgetClock):
        self.mdp, self.restart, self.choices = mdp, restart, choices
        self.tolerance, self.spending = tolerance, spending
        self.targets = HittingTimes(choices)
        self.upper = np.full(choices.num_targets, math.inf)
        self.lower = self.settled_upper = 0.0
        self.limited = 0
        self._travel: HubBounds | None = None
        self._first: tuple[float, np.ndarray, np.ndarray] | None = None
        self._is_short = False

    def to_hub(self, times: np.ndarray) -> float:
        """The time to a hub, of upper bounds (nodes,) of its hitting times."""
        return float(times.max())

    def report(self) -> None:
        """Report how far the bounds are."""

    @property
    def num_open(self) -> int:
        """Targets that may exceed what is proven."""
        return int(np.count_nonzero(self.upper > -math.inf))

    def bound_others(self, hub: int, times: np.ndarray) -> None:
        """Bound all targets by way of one whose hitting times are bounded by `times` (nodes,)."""
        if self._travel is None:
            self._travel = HubBounds(self.mdp, self.restart)
        by_state = np.zeros(self.choices.num_targets)
        np.maximum.at(by_state, self.choices.underlying, times)
        to_hub, away = self.to_hub(times), self._travel.times_from(hub, by_state)
        if self._first is None:  # the start, to which all that fails comes back
            self._first = to_hub, by_state, away
        np.minimum(self.upper, to_hub + away, out=self.upper)

    def shorten(self) -> None:
        """Shorten the bounds by way of the start, once, as long as this narrows them."""
        if self._first is None or self._travel is None or self._is_short:
            return
        (to_hub, times, away), self._is_short = self._first, True
        for shorter in shortened(self._travel, times, away, self.spending):
            np.minimum(self.upper, to_hub + shorter, out=self.upper)
            self.drop()
            self.report()

    def drop(self) -> None:
        """Settle the targets that cannot exceed what is proven."""
        self.upper[self.upper <= self.lower] = -math.inf

    def interval(self, lower: float, upper: float, is_infinite: bool, conventions: dict[str, Any]) -> Interval:
        """What is proven, from bounds of what is finite."""
        left = self.num_open
        exact = is_infinite or (not left and math.isfinite(upper) and upper - lower <= 2 * self.tolerance * upper)
        note = ""
        if left:
            note = f"budget spent: {left} of {self.choices.num_targets} targets {self.farther}"
        elif not exact and self.limited:
            note = f"hitting times are so large that 64-bit floats prove no closer bounds of {self.limited} targets"
        elif not exact:
            note = "budget spent before the bounds of the last targets met"
        return Interval(
            math.inf if is_infinite else lower,
            math.inf if is_infinite else upper,
            exact,
            finite_part=lower,
            tolerance=self.tolerance,
            searches=self.spending.searches,
            method="a stochastic shortest path problem for each target, bounds from residuals",
            conventions=conventions,
            note=note,
            seconds=self.spending.seconds,
        )


class _Diameter(TargetBounds):
    """Bounds of the largest hitting time of every target, of pairs that are surely connected."""

    farther = "may have a larger hitting time"

    def __init__(self, mdp: TabularMDP, restart: bool, choices: ExpandedMDP, tolerance: float, spending: BudgetClock):
        super().__init__(mdp, restart, choices, tolerance, spending)
        self.threads = [self.targets, *(self.targets.for_another_thread() for _ in range(usable_workers(None) - 1))]
        has_nodes = np.diff(self.targets.edges) > 0
        self.many = len(choices.underlying) * choices.num_targets > MANY
        crude = math.inf if self.many else choices.crude_upper * CRUDE
        self.upper = np.where(has_nodes, crude, -math.inf)
        # States that cannot be reached at all are unreachable from all others.
        self.unreachable = int(np.count_nonzero(~has_nodes)) * (choices.num_targets - 1)

    def run(self, conventions: dict[str, Any]) -> Interval:
        """Look at targets until the bounds meet, or the budget ends."""
        connected = self.choices.is_connected
        with ThreadPoolExecutor(len(self.threads)) as pool:
            if connected:
                for batch in self._widest():
                    self._look_at(batch, pool, bounding=True)
            if not self.many:  # else, where not connected: it is infinite, and that is all that can be said
                for batch in self._promising():
                    self._look_at(batch, pool, bounding=False)
        left, is_infinite = self.num_open, bool(self.unreachable) or not connected
        result = self.interval(self.lower, self._upper(), is_infinite, conventions)
        self.spending.report(result.lower, result.upper, left, now=True)
        return replace(
            result,
            exact=not left if is_infinite else result.exact,
            unreachable_pairs=int(self.unreachable),
            counted=not left,
        )

    def report(self) -> None:
        self.spending.report(self.lower, self._upper(), self.num_open)

    def _upper(self) -> float:
        return float(max(self.settled_upper, self.lower, self.upper.max()))

    def _promising(self) -> Iterator[list[int]]:
        """Batches of open targets, the farthest from some node first; they grow, as one makes a guess for the next."""
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
        """A start state, then the targets of the largest upper bounds, two at once, as long as this rules out others.

        Where there are too many targets for a look at each, to the end of the budget.
        """
        batch = [int(self.choices.underlying[self.choices.starts[0][0]])]
        apart = self.choices.num_targets // 64 + 1
        trial, left_before = TRIAL, self.num_open
        while batch and not self.spending.is_over:
            yield batch
            if self.spending.searches >= FIRST and (self.many or self._upper() > APART * self.lower):
                self.shorten()
            if not self.many and self.spending.searches >= trial:
                if left_before - self.num_open < min(RULED_OUT * TRIAL, left_before / 2):
                    self.shorten()
                    return
                trial, left_before = self.spending.searches + TRIAL, self.num_open
            widest = int(self.upper.argmax())
            others = self.upper.copy()
            others[max(0, widest - apart) : widest + apart] = -math.inf  # neighbours bound each other
            left = self.spending.budget.searches - self.spending.searches
            batch = [each for each in (widest, int(others.argmax())) if self.upper[each] > -math.inf]
            batch = list(dict.fromkeys(batch))[: int(min(2, left))]

    def _look_at(self, batch: list[int], pool: ThreadPoolExecutor, bounding: bool) -> None:
        """Solve the targets of a batch, in threads. What a target must exceed is the same for all of a batch.

        So results do not depend on the number of threads. `bounding`: their hitting times bound those of other targets.
        """
        threads = self.threads
        scaling = bounding or not self.spending.searches
        task = (self.tolerance, self.lower, self.spending, scaling, bounding)
        looks = [
            pool.submit(_look, own, part, *task) for i, own in enumerate(threads) if (part := batch[i :: len(threads)])
        ]
        for look in itertools.chain.from_iterable(look.result() for look in looks):
            if scaling and look.lower >= self.lower:
                self.targets.initial_scale = look.scale
            self.lower = max(self.lower, look.lower)
            self.settled_upper = max(self.settled_upper, min(look.upper, self.upper[look.target]))
            self.limited += look.limited
            self.unreachable += look.unreachable
            self.upper[look.target] = -math.inf
            if look.times is not None:
                self.bound_others(look.target, look.times)
        self.drop()
        self.spending.searches += len(batch)
        for own in threads:
            own.initial_scale = self.targets.initial_scale
        self.report()


def shortened(travel: HubBounds, times: np.ndarray, away: np.ndarray, spending: BudgetClock) -> Iterator[np.ndarray]:
    """Bounds of the times from a hub to each target, ever shorter, while this helps and the budget allows for more.

    times, away: (targets,) upper bounds of the expected steps to the hub, and from it.
    """
    count = len(away)
    drawn = np.argsort(np.arange(count, dtype=np.uint64) * _MIX, kind="stable")
    for size, every in WAYS:
        if size * NODES_EACH > count:
            continue
        began, long = spending.seconds, count // WAYS[1][1]
        targets = np.sort(drawn[: count // every]) if every else np.argpartition(away, count - long)[count - long :]
        before, away = away, travel.shortened(times, away, targets, size, lambda: spending.is_over)
        yield away
        if spending.is_over or LONGER * (spending.seconds - began) > spending.budget.seconds - spending.seconds:
            return
        if size > WAYS[0][0] and all(f(away[targets]) > TAKEN * f(before[targets]) for f in (np.median, np.max)):
            return


@dataclass
class _Look:
    """What is known of a target: bounds of its largest hitting time, and how many states do not surely reach it.

    Attributes:
        limited: whether floats allow no closer bounds.
        scale: 99th percentile of hitting time divided by distance.
        times: (nodes,) upper bounds of the hitting times, where other targets are to be bounded.
    """

    target: int
    lower: float
    upper: float
    limited: bool
    unreachable: int
    scale: float
    times: np.ndarray | None


def _look(
    targets: HittingTimes,
    some: Sequence[int],
    tolerance: float,
    enough: float,
    spending: BudgetClock,
    scaling: bool,
    bounding: bool,
) -> list[_Look]:
    """Solve each of `some`; one with an upper bound of at most `enough` no further than that."""
    looks = []
    for target in some:
        j, count, lost = targets.open(target)
        missing = 0 if lost is None else np.unique(targets.choices.underlying[lost]).size
        bounds = targets.solve(j, count, tolerance, enough, spending)
        times = j * bounds.high if bounding and lost is None and math.isfinite(bounds.high) else None
        limited = bounds.limited and not bounds.meets(tolerance)
        scale = targets.scale_of(j) if scaling else 1.0
        looks.append(_Look(target, max(bounds.lower, targets.least), bounds.upper, limited, missing, scale, times))
    return looks


def _by_promise(targets: HittingTimes, wanted: np.ndarray, spending: BudgetClock) -> np.ndarray:
    """The targets wanted, those first that are farthest from some node: a large hitting time, early, rules out
    others."""
    promise = np.zeros(len(wanted))
    for target in np.flatnonzero(wanted):
        if spending.is_over:
            break
        count = targets.distances(int(target))
        promise[target] = targets.distance[targets.order[count - 1]] if count else 0
    order = np.argsort(-promise, kind="stable")
    return order[wanted[order]]


# Stochastic eccentricity ----------------------------------------------------------------------------------------------


def stochastic_start_eccentricity(mdp: TabularMDP, restart: bool, tolerance: float, spending: BudgetClock) -> Interval:
    """The largest least expected number of steps from the start: exact up to `tolerance`, or the interval proven."""
    search = _Eccentricity(mdp, restart, ExpandedMDP.of(mdp, restart), tolerance, spending)
    search.run()
    upper = max(search.settled_upper, float(search.upper.max()))
    if search.infinite:
        search.upper[:] = -math.inf
    result = search.interval(search.lower, upper, search.infinite, conventions_of(mdp, restart))
    return replace(result, finite_part=0.0) if search.infinite else result


class _Eccentricity(TargetBounds):
    """Bounds of the expected steps from the start to every target.

    Attributes:
        infinite: whether some target is not surely reached from some start.
    """

    farther = "may be farther"

    def __init__(self, mdp: TabularMDP, restart: bool, choices: ExpandedMDP, tolerance: float, spending: BudgetClock):
        super().__init__(mdp, restart, choices, tolerance, spending)
        self.nodes = np.array([node for node, _ in choices.starts])
        self.weights = np.array([weight for _, weight in choices.starts])
        self.upper[:] = choices.crude_upper * CRUDE
        self.infinite = bool((np.diff(self.targets.edges) == 0).any())
        self.has_hubs = choices.is_connected and choices.num_targets > TRIAL and not self.infinite

    def to_hub(self, times: np.ndarray) -> float:
        return float(self.weights @ times[self.nodes]) * (1 + (len(self.nodes) + 8) * UNIT)

    def run(self) -> None:
        """Look at targets until none may be farther than the farthest, or the budget ends."""
        target = int(self.choices.underlying[self.nodes[0]])
        ruled_out = hubs = 0
        while not (self.infinite or self.spending.is_over) and self.upper[target] > -math.inf:
            times = self._look_at(target)
            if times is not None and self.has_hubs:
                before = self.num_open
                self.bound_others(target, times)
                self.drop()
                hubs, ruled_out = hubs + 1, ruled_out + before - self.num_open
                if hubs >= TRIAL and ruled_out < RULED_OUT * hubs:
                    self.shorten()
                    self.has_hubs = False
            target = int(self.upper.argmax())

    def _look_at(self, target: int) -> np.ndarray | None:
        """Settle a target; returns upper bounds (nodes,) of its hitting times, where all are known."""
        targets, rounding = self.targets, 1 + (len(self.nodes) + 8) * UNIT
        self.spending.searches += 1
        before, self.upper[target] = float(self.upper[target]), -math.inf
        j, count, lost = targets.open(target)
        if lost is not None and lost[self.nodes].any():
            self.infinite = True
            return None
        bounds = targets.sweep(j, count, SWEEPS, 0.0, self.spending)
        if bounds.at_most(self._mean(j)) * rounding > self.settled_upper:
            bounds = targets.solve(j, count, self.tolerance, 0.0, self.spending)
            mean = self._mean(j)
            if mean * bounds.low / rounding > self.lower:
                self.lower = mean * bounds.low / rounding
                targets.initial_scale = targets.scale_of(j)
            self.settled_upper = max(self.settled_upper, min(bounds.at_most(mean) * rounding, before))
            self.limited += bounds.limited and not bounds.meets(self.tolerance)
        self.drop()
        return j * bounds.high if lost is None and math.isfinite(bounds.high) else None

    def _mean(self, j: np.ndarray) -> float:
        """Of the starts; no hitting time is below 0, which J may be before there is an upper bound."""
        return float(self.weights @ np.maximum(j[self.nodes], 0.0))
