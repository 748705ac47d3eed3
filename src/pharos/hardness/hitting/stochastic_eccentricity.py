"""Start eccentricity under chance: a stochastic shortest path problem for each target that bounds do not rule out.

The target with the largest upper bound is always the next, so that there is an interval whenever the budget ends. The
first bounds are those from the start; solved targets are hubs for others as long as they rule some out (`travel`).
"""

import math
from dataclasses import replace

import numpy as np

from pharos.hardness.hitting.hitting_times import SWEEPS
from pharos.hardness.hitting.stochastic_diameter import CRUDE, RULED_OUT, TRIAL, TargetBounds
from pharos.hardness.interval import BudgetClock, Interval, conventions_of
from pharos.kernels.hitting import UNIT
from pharos.mdp import ExpandedMDP, TabularMDP


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
