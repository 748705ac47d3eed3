"""Start eccentricity under chance: a stochastic shortest path problem for each target that bounds do not rule out.

The target with the largest upper bound is always the next, so that there is an interval whenever the budget ends. The
first bounds are those from the start; solved targets are hubs for others as long as they rule some out (`travel`).
"""

import math

import numpy as np

from pharos.hardness.hitting.hitting_times import SWEEPS, HittingTimes
from pharos.hardness.hitting.stochastic_diameter import CRUDE, RULED_OUT, TRIAL, shortened
from pharos.hardness.hitting.travel import HubBounds
from pharos.hardness.interval import BudgetClock, Interval, conventions_of
from pharos.kernels.hitting import UNIT
from pharos.mdp import ExpandedMDP, TabularMDP


def stochastic_start_eccentricity(mdp: TabularMDP, restart: bool, tolerance: float, spending: BudgetClock) -> Interval:
    """The largest least expected number of steps from the start: exact up to `tolerance`, or the interval proven."""
    search = _Eccentricity(mdp, restart, tolerance, spending)
    search.run()
    lower, upper, note = search.lower, max(search.settled_upper, float(search.upper.max())), ""
    left = int(np.count_nonzero(search.upper > -math.inf))
    if search.infinite:
        lower = upper = math.inf
    elif left:
        note = f"budget spent: {left} of {search.choices.num_targets} targets may be farther"
    exact = search.infinite or (not left and math.isfinite(upper) and upper - lower <= 2 * tolerance * upper)
    if not (exact or note):
        note = f"hitting times are so large that 64-bit floats prove no closer bounds of {search.limited} targets"
        note = note if search.limited else "budget spent before the bounds of the last targets met"
    return Interval(
        lower,
        upper,
        exact,
        finite_part=0.0 if search.infinite else lower,
        tolerance=tolerance,
        searches=spending.searches,
        method="a stochastic shortest path problem for each target, bounds from residuals",
        conventions=conventions_of(mdp, restart),
        note=note,
        seconds=spending.seconds,
    )


class _Eccentricity:
    """Bounds of the expected steps from the start to every target.

    Attributes:
        upper: (targets,); -inf where a target is settled.
        lower: the most that is proven. settled_upper: the largest upper bound of settled targets.
        infinite: whether some target is not surely reached from some start.
        limited: targets whose bounds are as close as floats allow, and no closer than the tolerance.
    """

    def __init__(self, mdp: TabularMDP, restart: bool, tolerance: float, spending: BudgetClock):
        self.tolerance, self.spending = tolerance, spending
        self.choices: ExpandedMDP = ExpandedMDP.of(mdp, restart)
        self.targets = HittingTimes(self.choices)
        self.nodes = np.array([node for node, _ in self.choices.starts])
        self.weights = np.array([weight for _, weight in self.choices.starts])
        self.upper = np.full(self.choices.num_targets, self.choices.crude_upper * CRUDE)
        self.lower = self.settled_upper = 0.0
        self.limited = 0
        self.infinite = bool((np.diff(self.targets.edges) == 0).any())
        hubs = self.choices.is_connected and self.choices.num_targets > TRIAL
        self.travel = HubBounds(mdp, restart) if hubs and not self.infinite else None
        self.hub: tuple[float, np.ndarray, np.ndarray] | None = None

    def run(self) -> None:
        """Look at targets until none may be farther than the farthest, or the budget ends."""
        target = int(self.choices.underlying[self.nodes[0]])
        ruled_out = hubs = 0
        while not (self.infinite or self.spending.is_over) and self.upper[target] > -math.inf:
            times = self._look_at(target)
            if times is not None and self.travel is not None:
                before = self._open
                self._bound_others(target, times)
                hubs, ruled_out = hubs + 1, ruled_out + before - self._open
                if hubs >= TRIAL and ruled_out < RULED_OUT * hubs:
                    self._shorten()
                    self.travel = None
            target = int(self.upper.argmax())

    @property
    def _open(self) -> int:
        return int(np.count_nonzero(self.upper > -math.inf))

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
        self.upper[self.upper <= self.lower] = -math.inf
        return j * bounds.high if lost is None and math.isfinite(bounds.high) else None

    def _mean(self, j: np.ndarray) -> float:
        """Of the starts; no hitting time is below 0, which J may be before there is an upper bound."""
        return float(self.weights @ np.maximum(j[self.nodes], 0.0))

    def _bound_others(self, hub: int, times: np.ndarray) -> None:
        """Bound all targets by way of one whose hitting times are bounded by `times` (nodes,)."""
        assert self.travel is not None
        by_state = np.zeros(self.choices.num_targets)
        np.maximum.at(by_state, self.choices.underlying, times)
        to_hub = float(self.weights @ times[self.nodes]) * (1 + (len(self.nodes) + 8) * UNIT)
        away = self.travel.times_from(hub, by_state)
        if self.hub is None:
            self.hub = to_hub, by_state, away
        np.minimum(self.upper, to_hub + away, out=self.upper)
        self.upper[self.upper <= self.lower] = -math.inf

    def _shorten(self) -> None:
        """Shorten the bounds by way of the start, as long as this narrows the interval."""
        assert self.travel is not None and self.hub is not None
        to_hub, times, away = self.hub
        for shorter in shortened(self.travel, times, away, self.spending):
            np.minimum(self.upper, to_hub + shorter, out=self.upper)
            self.upper[self.upper <= self.lower] = -math.inf
