"""Diameter under chance: for every target a stochastic shortest path problem, most of them only as far as bounds need.

`hitting_times` bounds the hitting times of one target. Here the targets are chosen. A target whose upper bound falls
below the largest hitting time proven so far is dropped at once. Solved targets bound the others (`HubBounds`), so that
there is an interval whenever the budget ends. If a look at each target would take longer than that, the target with
the largest upper bound is always the next. So it is for the start eccentricity, whose first bounds are those from the
start. Solved targets are hubs for others as long as they rule some out.

Upper bounds for all targets at once, from the solution of one of them (`HubBounds`). Let E(s, y) be the least expected
number of steps from s to y, and h a hub with E(s, h) <= U(s) for all s. To go from x to y, choose an action a that may
lead there. With probability P(s') it leads to s' != y instead. From there take a short way back to y if there is
one, each of its steps in the same manner. Otherwise give up, and go to the hub. This attempt takes at most c(x, a, y)
expected steps and is given up with probability at most l(x, a, y), where

    c(x, a, y) = 1 + sum over near s' of P(s') (sum of c along the way back) + sum over other s' of P(s') U(s')
    l(x, a, y) =     sum over near s' of P(s') (sum of l along the way back) + sum over other s' of P(s').

An s' counts as near as long as rho = sum of P(s') (steps of the way back) stays below a limit, so that both have a
solution: for any c' that falls short of the right side by at most d, c' + d / (1 - rho) does not. Given up, go on from
the hub to y directly:

    E(h, y) <= E(h, x) + c(x, a, y) + l(x, a, y) E(h, y),

and Dijkstra's algorithm finds the best x and a for every y: E(h, y) <= V(y). The largest expected time to target e is
then at most the largest U(s) plus V(e). Under sticky actions sums are the largest over the previously executed action,
and so is U.

If slips cannot be taken back, but lead on to nodes from which the way goes on as well, y need not be the next node:
with the nodes around y, those on short ways from h to y, the nearest to y first, as a problem of its own in which to
leave them is to give up,

    E(x, y) <= c(x) + l(x) E(h, y), where c(y) = l(y) = 0, and outside c = U, l = 1,

holds for c = U, l = 1 everywhere, and goes on to hold where c(x), l(x) become 1 + sum P c and sum P l under any action,
node by node (`shortened_bounds`). So E(h, y) <= (E(h, x) + c(x)) / (1 - l(x)) for every x around y, and what was a slip
at each step on the way is one for as many steps as lie between x and y. Each x on the way still has to be met exactly,
at a factor of 1 / (1 - l(x)) each time. So a few targets, drawn at random, are bounded by long ways of thousands of
nodes from each other, and every target by a short way from one of them: a few factors instead of hundreds.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pharos.hardness.hitting_times import SWEEPS_BEFORE_SOLVING, HittingTimes
from pharos.hardness.interval import MORE, BudgetClock, Interval
from pharos.kernels import hitting
from pharos.kernels.hitting import UNIT
from pharos.mdp import ExpandedMDP, TabularMDP, outcome_matrix
from pharos.system.workers import usable_workers

# Nodes around each state among which ways back are looked for: a few steps in all directions of a grid.
NEARBY = 64
# Expected steps on ways back, at most: a step takes 1 / (1 - LIMIT) = 5 times as long then; more ways are seldom worth
# it.
LIMIT = 0.8
# Outcomes of a state beyond which nothing counts as near: ways back are kept for each pair of them.
SQUARE = 64
# Passes over the ways back, and the change of a value, in steps, at which they end; what is missing is added to the
# bound.
PASSES = 100
ACCURACY = 1e-4
# Outcomes below which threads are not worth their start.
FEW_OUTCOMES = 100_000
# Sweeps over the nodes around a target, at most, and parts of all targets, in the order of their bounds: each part
# knows the bounds of those before it, and threads share a part, so that results do not depend on their number.
WAY_ROUNDS, TARGET_PARTS = 30, 64
# More than the relative rounding of sums of positive numbers along any way.
SUM_SLACK = 1 + 1e-9


class HubBounds:
    """The bounds of an MDP. Nodes are its states, and the implicit end if there is one.

    Cost: two searches of 64 nodes around each state, once. For a hub some passes over the ways back and one run of
        Dijkstra's algorithm. Memory: some 30 bytes for each outcome of each action and a byte for each pair of outcomes
        of a state.
    """

    def __init__(self, mdp: TabularMDP, restart: bool):
        chance, num_actions = mdp.chance, mdp.num_actions
        weights = (chance.chosen, chance.previous, chance.uniform / num_actions)
        first = (chance.first_chosen, chance.first_uniform / num_actions)
        self._execution = hitting.ExecutionWeights(*weights, *first, mdp.policy_width - 1, num_actions)
        self._outcomes = _outcome_lists(mdp, restart)
        size = len(self._outcomes.node)
        self._num_nodes = len(self._outcomes.first) - 1
        self._steps = -1, np.empty(0, np.int32)  # a hub, and those from it to each node
        self._threads = usable_workers(None) if size > FEW_OUTCOMES else 1
        with ThreadPoolExecutor(self._threads) as pool:
            self._find_ways_back(pool)
        self.leak = self._solve(0.0, np.ones(self._num_nodes))

    def _find_ways_back(self, pool: ThreadPoolExecutor) -> None:
        first, _, node, _, owner = self._outcomes
        counts = np.diff(first)[owner]
        used = (counts <= SQUARE) & (owner != node)
        ends = np.cumsum(np.where(used, counts, 0))
        square = np.where(used, ends - counts, -1)
        steps = np.empty(int(ends[-1]) if len(ends) else 0, np.uint8)
        into = hitting.outcomes_into(node, self._num_nodes)
        edges = np.linspace(0, self._num_nodes, self._threads + 1).astype(np.int64)
        size, index_type = self._num_nodes, np.int32 if len(node) < 2**31 else np.int64
        room = [
            (np.zeros(size, np.uint8), np.empty(NEARBY, np.int64), np.empty(size, index_type))
            for _ in range(self._threads)
        ]

        def write(ways: hitting.Ways) -> None:
            def part(low: int, high: int, own: tuple[np.ndarray, ...]) -> None:
                hitting.ways_back(low, high, self._outcomes, into, ways, own)

            list(pool.map(part, edges[:-1], edges[1:], room))

        self._ways = hitting.Ways(square, steps, np.empty(0, np.int64), np.empty(0, index_type))
        write(self._ways)
        length = np.empty(len(node), np.int64)
        self._rho = hitting.keep_near(self._outcomes, self._execution, self._ways, LIMIT, length)
        way = np.empty(int(length.sum()), index_type)
        self._ways = hitting.Ways(square, steps, np.cumsum(length) - length, way)
        write(self._ways)

    def _solve(self, own: float, times: np.ndarray) -> np.ndarray:
        """(outcomes,) c for own = 1 and times = U, and l for own = 0 and times = 1."""
        value = np.full(len(self._outcomes.node), own)
        new = value.copy()
        edges = np.linspace(0, len(value), self._threads + 1).astype(np.int64)
        outcomes, execution, ways = self._outcomes, self._execution, self._ways
        with ThreadPoolExecutor(self._threads) as pool:
            for passes in range(PASSES):
                # twice with all arrays, as two take turns
                values, is_first = (own, times, value, new), passes < 2
                parts = [
                    pool.submit(hitting.attempt_costs, low, high, outcomes, execution, ways, values, is_first)
                    for low, high in itertools.pairwise(edges)
                ]
                short = max(part.result() for part in parts)
                if short <= ACCURACY * (1 - self._rho):
                    break
                value, new = new, value
        return value + max(short, 0.0) / (1 - self._rho)

    def times_from(self, hub: int, times: np.ndarray) -> np.ndarray:
        """(N,) V: upper bounds of the expected steps from the hub to each node, given those from each node to the
        hub."""
        first, node = self._outcomes.first, self._outcomes.node
        return hitting.times_from(hub, first, node, self._solve(1.0, times), self.leak) * SUM_SLACK

    def shortened(
        self, times: np.ndarray, bound: np.ndarray, targets: np.ndarray, size: int, is_over: Callable[[], bool]
    ) -> np.ndarray:
        """(N,) `bound`, or less if the way through the nodes around a target is shorter.

        Args:
            times, bound: (N,) upper bounds of the expected steps to the hub, and from it.
            targets: those whose bounds are to be shortened.
            size: nodes around each of them.
            is_over: whether to leave the rest as it is, asked between parts.
        Cost: for each of the targets some passes over `size` nodes.
        """
        room = [
            (
                np.zeros(self._num_nodes, np.int32),
                np.empty(size, np.int64),
                np.empty((4 * size, 2), np.int64),
                np.empty(hitting.MOST_TURNS, np.int64),
                *np.empty((2, size, self._execution.num_previous + 1)),
            )
            for _ in range(self._threads)
        ]
        bound, new = bound.copy(), np.empty(self._num_nodes)
        hub = (self._steps_from(int(np.argmin(bound))), times, bound, new)
        fixed = (self._outcomes, self._into, self._execution, hub, WAY_ROUNDS)
        with ThreadPoolExecutor(self._threads) as pool:
            order = targets[np.argsort(bound[targets], kind="stable")]
            for part in np.array_split(order, min(TARGET_PARTS, max(len(order), 1))):
                if is_over():
                    break
                list(
                    pool.map(
                        lambda some, own: hitting.shorten(some, *fixed, own), np.array_split(part, self._threads), room
                    )
                )
                bound[part] = new[part]
        return bound

    @cached_property
    def _into(self) -> tuple[np.ndarray, np.ndarray]:
        """Outcomes that lead to each node, a large table. It is computed on demand, as only shortening needs it."""
        return hitting.outcomes_into(self._outcomes.node, self._num_nodes)

    def _steps_from(self, hub: int) -> np.ndarray:
        """(N,) int32, see `hitting.steps_from`. The last ones are kept, as rounds of shortening have one hub."""
        if hub != self._steps[0]:
            self._steps = hub, hitting.steps_from(hub, self._outcomes.first, self._outcomes.node)
        return self._steps[1]


def _outcome_lists(mdp: TabularMDP, restart: bool) -> hitting.OutcomeLists:
    """The outcomes of executing each action in each state, and of ending an episode, by any action."""
    terminal = np.asarray(mdp.terminal)
    executed, ends = outcome_matrix(mdp, terminal)
    num_states, num_actions = mdp.num_states, mdp.num_actions
    starts = np.flatnonzero(np.asarray(mdp.start_probabilities) > 0)
    ended = np.append(np.flatnonzero(terminal), np.full(int(ends), num_states, np.int64)).astype(np.int64)
    counts = np.zeros(num_states + ends, np.int64)
    counts[:num_states] = np.diff(executed.indptr).reshape(num_states, num_actions).sum(axis=1)
    counts[ended] = len(starts) if restart else 0
    first = np.concatenate([[0], np.cumsum(counts)])
    action = np.full(int(first[-1]), -1, np.int16)
    node, prob = np.empty(action.size, np.int64), np.empty(action.size)
    of_live = np.ones(action.size, np.bool_)
    if restart:
        indices = (first[ended][:, None] + np.arange(len(starts))).ravel()
        of_live[indices] = False
        node[indices] = np.tile(np.asarray(mdp.start_states)[starts], len(ended))
        prob[indices] = np.tile(np.asarray(mdp.start_probabilities)[starts], len(ended))
    rows = np.repeat(np.arange(num_states * num_actions), np.diff(executed.indptr))
    action[of_live], node[of_live], prob[of_live] = rows % num_actions, executed.indices, executed.data
    return hitting.OutcomeLists(first, action, node, prob, np.repeat(np.arange(len(counts)), counts))


# Diameter -------------------------------------------------------------------------------------------------------------


# Most targets that threads look at before they learn of a larger hitting time: a target may be looked at in vain that
# often.
TARGET_BATCH = 64
# Nodes times targets from which on one search for each target, to find the most promising, takes minutes.
MANY = 10**9
# Targets that are solved before it is judged whether their bounds rule out others.
TRIAL = 16
# Targets that each of the last `TRIAL` ones must have ruled out on average, or all of them half of those left; else
# looking at the others one by one is quicker.
RULED_OUT = 40
# Nodes on the way to a target through which its bound is shortened, and one in how many targets, drawn by their
# numbers: a few are bounded by long ways, and the others from these by short ones. 0: the ones with the largest bounds,
# as many as of the long ways.
WAY_STAGES = ((64, 1), (4096, 64), (1024, 16), (256, 1), (4096, 0))
# Nodes there must be for each node on a way; the share that is left of the median and of the largest of the bounds
# beyond which no more is tried; and times as long as the ways before take the next ones.
NODES_EACH, MOST_LEFT, LONGER = 8, 0.95, 5
# Mixes the numbers of targets, neighbours among which are alike.
_MIX = np.uint64(0x9E3779B97F4A7C15)
# Targets that are solved before that, if there are too many for a look at each, or bounds are so many times apart.
FIRST_TARGETS, APART = 3, 2.0
# `crude_upper` is a product of up to N rounded factors.
CRUDE = 1.01


def stochastic_diameter(mdp: TabularMDP, restart: bool, tolerance: float, spending: BudgetClock) -> Interval:
    """The diameter of an MDP with chance: exact up to `tolerance`, or the interval proven by budget and floats."""
    choices = ExpandedMDP.of(mdp, restart)
    spending.conventions |= {"nodes": len(choices.underlying), "sticky_pairs": mdp.is_sticky}
    return _Diameter(mdp, restart, choices, tolerance, spending).run()


class TargetBounds:
    """Bounds of a time to each target, tightened until none may exceed the largest that is proven.

    Attributes:
        farther: the words for a target that may exceed it.
        upper: (targets,) of the time to each, -inf if it is settled.
        lower: the largest time that is proven. settled_upper: the largest upper bound of settled targets.
        limited: number of targets whose bounds cannot reach the tolerance in float64.
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
        """Report the progress of the bounds."""

    @property
    def num_open(self) -> int:
        """Targets that may exceed what is proven."""
        return int(np.count_nonzero(self.upper > -math.inf))

    def bound_others(self, hub: int, times: np.ndarray) -> None:
        """Bound all targets by way of one whose hitting times are bounded by `times` (nodes,)."""
        if self.mdp.available is not None and not self.mdp.chance.is_none:
            return  # the bounds are of chance that is the same in all states
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
        for shorter in shortened_bounds(self._travel, times, away, self.spending):
            np.minimum(self.upper, to_hub + shorter, out=self.upper)
            self.drop()
            self.report()

    def drop(self) -> None:
        """Settle the targets that cannot exceed what is proven."""
        self.upper[self.upper <= self.lower] = -math.inf

    def interval(self, lower: float, upper: float, is_infinite: bool) -> Interval:
        """The proven interval, given bounds of the finite part."""
        left = self.num_open
        exact = is_infinite or (not left and math.isfinite(upper) and upper - lower <= 2 * self.tolerance * upper)
        note = ""
        if left:
            note = f"budget spent: {left} of {self.choices.num_targets} targets {self.farther}; {MORE}"
        elif not exact and self.limited:
            note = f"hitting times are so large that 64-bit floats prove no closer bounds of {self.limited} targets"
        elif not exact:
            note = f"budget spent before the bounds of the last targets met; {MORE}"
        bounds = (math.inf, math.inf) if is_infinite else (lower, upper)
        method = "a stochastic shortest path problem for each target, bounds from residuals"
        interval = Interval(*bounds, exact, finite_part=lower, tolerance=self.tolerance, method=method, note=note)
        return self.spending.signed(interval)


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

    def run(self) -> Interval:
        """Look at targets until the bounds meet, or the budget ends."""
        connected = self.choices.is_connected
        with ThreadPoolExecutor(len(self.threads)) as pool:
            if connected:
                for batch in self._widest():
                    self._solve_batch(batch, pool, bounding=True)
            if not self.many:  # else, if not connected: it is infinite, and that is all that can be said
                for batch in self._promising():
                    self._solve_batch(batch, pool, bounding=False)
        left, is_infinite = self.num_open, bool(self.unreachable) or not connected
        result = self.interval(self.lower, self._upper(), is_infinite)
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
        """Batches of open targets, the farthest from some node first: a large hitting time, early, rules out others.

        They grow, as one makes a guess for the next.
        """
        wanted, promise, targets = self.upper > -math.inf, np.zeros(len(self.upper)), self.targets
        for target in np.flatnonzero(wanted):
            if self.spending.is_over:
                break
            count = targets.distances(int(target))
            promise[target] = targets.distance[targets.order[count - 1]] if count else 0
        order = [target for target in np.argsort(-promise, kind="stable").tolist() if wanted[target]]
        size = 1
        while order and not self.spending.is_over:
            order = [target for target in order if self.upper[target] > -math.inf]
            left = self.spending.budget.searches - self.spending.searches
            batch, order = order[: int(min(size, left))], order[int(min(size, left)) :]
            if batch:
                yield batch
            size = min(2 * size, TARGET_BATCH)

    def _widest(self) -> Iterator[list[int]]:
        """A start state, then the targets of the largest upper bounds, two at once, as long as this rules out others.

        If there are too many targets for a look at each, to the end of the budget.
        """
        batch = [int(self.choices.underlying[self.choices.starts[0][0]])]
        apart = self.choices.num_targets // 64 + 1
        trial, left_before = TRIAL, self.num_open
        while batch and not self.spending.is_over:
            yield batch
            if self.spending.searches >= FIRST_TARGETS and (self.many or self._upper() > APART * self.lower):
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

    def _solve_batch(self, batch: list[int], pool: ThreadPoolExecutor, bounding: bool) -> None:
        """Solve the targets of a batch, in threads. What a target must exceed is the same for all of a batch.

        So results do not depend on the number of threads. `bounding`: their hitting times bound the hitting times of
        other targets.
        """
        threads = self.threads
        scaling = bounding or not self.spending.searches
        looks = [
            pool.submit(self._solved, own, part, self.lower, scaling, bounding)
            for i, own in enumerate(threads)
            if (part := batch[i :: len(threads)])
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

    def _solved(
        self, targets: HittingTimes, some: Sequence[int], enough: float, scaling: bool, bounding: bool
    ) -> "list[_TargetResult]":
        """Solve each of `some`. A target with an upper bound of at most `enough` is solved no further."""
        looks = []
        for target in some:
            j, count, lost = targets.open(target)
            missing = 0 if lost is None else np.unique(targets.choices.underlying[lost]).size
            bounds = targets.solve(j, count, self.tolerance, enough, self.spending)
            times = j * bounds.high if bounding and lost is None and math.isfinite(bounds.high) else None
            limited = bounds.limited and not bounds.meets(self.tolerance)
            scale = targets.scale_of(j) if scaling else 1.0
            lower = max(bounds.lower, targets.least)
            looks.append(_TargetResult(target, lower, bounds.upper, limited, missing, scale, times))
        return looks


def shortened_bounds(
    travel: HubBounds, times: np.ndarray, away: np.ndarray, spending: BudgetClock
) -> Iterator[np.ndarray]:
    """Bounds of the times from a hub to each target, ever shorter, while this helps and the budget allows for more.

    times, away: (targets,) upper bounds of the expected steps to the hub, and from it.
    """
    count = len(away)
    drawn = np.argsort(np.arange(count, dtype=np.uint64) * _MIX, kind="stable")
    for size, every in WAY_STAGES:
        if size * NODES_EACH > count:
            continue
        began, long = spending.seconds, count // WAY_STAGES[1][1]
        targets = np.sort(drawn[: count // every]) if every else np.argpartition(away, count - long)[count - long :]
        before, away = away, travel.shortened(times, away, targets, size, lambda: spending.is_over)
        yield away
        if spending.is_over or LONGER * (spending.seconds - began) > spending.budget.seconds - spending.seconds:
            return
        if size > WAY_STAGES[0][0] and all(
            f(away[targets]) > MOST_LEFT * f(before[targets]) for f in (np.median, np.max)
        ):
            return


@dataclass
class _TargetResult:
    """Result for a target: bounds of its largest hitting time, and how many states do not surely reach it.

    Attributes:
        limited: whether the bounds cannot reach the tolerance in float64.
        scale: 99th percentile of hitting time divided by distance.
        times: (nodes,) upper bounds of the hitting times, if other targets are to be bounded.
    """

    target: int
    lower: float
    upper: float
    limited: bool
    unreachable: int
    scale: float
    times: np.ndarray | None


# Stochastic eccentricity ----------------------------------------------------------------------------------------------


def stochastic_start_eccentricity(mdp: TabularMDP, restart: bool, tolerance: float, spending: BudgetClock) -> Interval:
    """The largest least expected number of steps from the start: exact up to `tolerance`, or the interval proven."""
    search = _Eccentricity(mdp, restart, ExpandedMDP.of(mdp, restart), tolerance, spending)
    search.run()
    upper = max(search.settled_upper, float(search.upper.max()))
    if search.infinite:
        search.upper[:] = -math.inf
    result = search.interval(search.lower, upper, search.infinite)
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
            times = self._settle(target)
            if times is not None and self.has_hubs:
                before = self.num_open
                self.bound_others(target, times)
                self.drop()
                hubs, ruled_out = hubs + 1, ruled_out + before - self.num_open
                if hubs >= TRIAL and ruled_out < RULED_OUT * hubs:
                    self.shorten()
                    self.has_hubs = False
            target = int(self.upper.argmax())
            self.report()

    def report(self) -> None:
        self.spending.report(self.lower, max(self.settled_upper, float(self.upper.max())), self.num_open)

    def _settle(self, target: int) -> np.ndarray | None:
        """Settle a target. Returns upper bounds (nodes,) of its hitting times, if all are known."""
        targets, rounding = self.targets, 1 + (len(self.nodes) + 8) * UNIT
        self.spending.searches += 1
        before, self.upper[target] = float(self.upper[target]), -math.inf
        j, count, lost = targets.open(target)
        if lost is not None and lost[self.nodes].any():
            self.infinite = True
            return None
        bounds = targets.sweep(j, count, SWEEPS_BEFORE_SOLVING, 0.0, self.spending)
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
        """Mean of J over the starts, at least 0 each, below which J may be before there is an upper bound."""
        return float(self.weights @ np.maximum(j[self.nodes], 0.0))
