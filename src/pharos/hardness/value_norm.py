"""The environmental value norm. Source: Maillard, Mann and Mannor (2014), "How hard is my MDP?".

Action-gap regularity: how often actions are nearly as good as each other.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.hardness.gaps import gaps_of_states, optimal_solution
from pharos.hardness.interval import EXACT_WIDTH, Certified
from pharos.mdp import (
    Chance,
    TabularMDP,
    lone_starts,
    nodes_within,
    require_mdp,
)
from pharos.solvers import Solution
from pharos.system.arrays import UNIT_ROUNDOFF

# States at once: values of all their outcomes are in memory.
_VARIANCE_BLOCK = 1 << 16


@require_mdp
def environmental_value_norm(mdp: TabularMDP, solution: Solution | None = None) -> float:
    """Return the largest standard deviation of the value of the next state.

        max over s, a of sqrt(Var(V*(s') : s' ~ p(. | s, a)))

    over the states that can be reached. 0 for deterministic MDPs. Under sticky actions s is a pair (state, previously
    executed action), and so is s'. With a horizon, V* belongs to the first step.

    Args:
        solution: the optimal solution of `mdp`. Default: solved here to an error of 1e-9, or what floats reach.
    Raises:
        ParameterError: `solution` belongs to another MDP or is not optimal.
    Exactness: `certified_value_norm` returns the interval that follows from the error of the values.
    Cost: one pass over the table, 20 to 100 ns a state.
    Source: Maillard, Mann and Mannor (2014), definition 1. (Colosseum centres with the expectation of another state: a
        slip.)
    """
    return certified_value_norm(mdp, solution).value


def certified_value_norm(
    mdp: TabularMDP, solution: Solution | None = None, *, progress: Callable[[str], object] = str
) -> Certified:
    """Return `environmental_value_norm` with its interval. `progress` is called with a line for each block of states.

    A standard deviation changes by no more than the values do. Every variance is a sum of squares of values less their
    mean, in the row of one state, so that large values that lie close together lose no digits.
    """
    solution = optimal_solution(mdp, solution)
    if mdp.is_deterministic:
        return Certified(0.0, 0.0, 0.0, True)
    live = ~np.asarray(mdp.terminal)
    nodes, lone = nodes_within(mdp), lone_starts(mdp)
    states, largest = np.flatnonzero((lone | nodes.any(axis=1)) & live), 0.0
    size = float(np.abs(solution.x).max(initial=0.0))
    scale = 2.0 ** math.frexp(size)[1] if 0 < size < math.inf else 1.0  # squares of 1e160 and 1e-170 are no floats
    for number, block in enumerate(np.array_split(states, max(1, -(-states.size // _VARIANCE_BLOCK)))):
        progress(f"state {number * _VARIANCE_BLOCK:,} of {states.size:,}")
        means, within = _moments(mdp, solution.x, block, scale)
        first = lone[block]
        largest = max(largest, _largest_variance(mdp.chance.first.at(block[first]), means[first], within[first], 0))
        for previous in range(mdp.width):
            is_node = nodes[block, previous]
            if mdp.available is not None and mdp.is_sticky:  # as on the first step
                is_free = is_node & ~mdp.available[block, previous]
                here = mdp.chance.first.at(block[is_free]), means[is_free], within[is_free]
                largest, is_node = max(largest, _largest_variance(*here, previous)), is_node & ~is_free
            here = mdp.chance.at(block[is_node]), means[is_node], within[is_node]
            largest = max(largest, _largest_variance(*here, previous))
    value = math.sqrt(largest) * scale
    error = solution.error_bound + (3 * mdp.num_actions + mdp.dynamics.operations + 16) * UNIT_ROUNDOFF * size
    lower, upper = max(0.0, value - error), value + error
    return Certified(value, lower, upper, upper - lower <= EXACT_WIDTH * upper or upper == 0.0)


def _moments(mdp: TabularMDP, x: np.ndarray, states: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """((N, A) mean less the mean of the row, (N, A) variance) of the next state's value under each executed action,
    over `scale`."""
    means = mdp.dynamics.expected(x, states) / scale
    within: np.ndarray = np.zeros_like(means)
    if not mdp.dynamics.is_deterministic:
        rows = np.repeat(states, mdp.num_actions)
        actions = np.tile(np.arange(mdp.num_actions), states.size)
        outcomes = mdp.dynamics.outcomes(rows, actions)
        column = actions[outcomes.which] if x.shape[1] > 1 else 0
        apart = x[outcomes.states, column] / scale - means.ravel()[outcomes.which]
        within = np.bincount(outcomes.which, outcomes.probabilities * apart**2, means.size).reshape(means.shape)
    means, within = mdp.acting(means, states), mdp.acting(within, states)
    return means - means.mean(axis=1, keepdims=True), within


def _largest_variance(chance: Chance, means: np.ndarray, within: np.ndarray, previous: int) -> float:
    """The largest variance of the next state's value after a choice: within the outcomes of executed actions, and
    between their means."""
    repeated = means[:, previous : previous + 1]
    mean = chance.chosen * means + chance.uniform * chance.mean(means) + chance.previous * repeated
    result = chance.chosen * (within + (means - mean) ** 2)
    if chance.uniform:
        middle = chance.mean(means)
        spread = chance.mean(within + (means - middle) ** 2)
        result += chance.uniform * (spread + (mean - middle) ** 2)
    if chance.previous:
        result += chance.previous * (within[:, previous : previous + 1] + (repeated - mean) ** 2)
    return float(result.max(initial=0.0))


# Action gap -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ActionGapRegularity:
    """Distribution of the action gap g(s) = V*(s) - max over actions that are not optimal of Q*(s, a).

    Attributes:
        constant: the smallest c with P(0 < g(s) <= t) <= c t^zeta for all t > 0. 0 if there are no gaps.
        zeta: the exponent.
        gaps: (K,) the different gaps, ascending.
        shares: (K,) P(0 < g(s) <= gaps[i]).
        states: the number of states (of pairs and steps, if values have them) that were counted.
        tie_tolerance: gaps up to it count as none.
        conventions: what the values refer to.
    """

    constant: float
    zeta: float
    gaps: np.ndarray
    shares: np.ndarray
    states: int
    tie_tolerance: float
    conventions: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """A summary, JSON-able."""
        return {
            "constant": self.constant,
            "zeta": self.zeta,
            "smallest": float(self.gaps[0]) if len(self.gaps) else None,
            "share_with_gap": float(self.shares[-1]) if len(self.shares) else 0.0,
            "states": self.states,
            "tie_tolerance": self.tie_tolerance,
        }

    def __str__(self) -> str:
        return f"P(0 < gap <= t) <= {self.constant:.6g} t^{self.zeta:g}"


@require_mdp
def action_gap_regularity(
    mdp: TabularMDP, solution: Solution | None = None, *, zeta: float = 1.0, tie_tolerance: float | None = None
) -> ActionGapRegularity:
    """Return how regular the action gap is: the smallest c with P(0 < g(s) <= t) <= c t^zeta for all t.

        g(s) = V*(s) - max over a with V*(s) - Q*(s, a) > tie_tolerance of Q*(s, a)

    s is uniform over the states that `gaps` counts: states that can be reached and are not terminal. Under sticky
        actions they are pairs with the previously executed action, with a horizon the states of every step.

    Args:
        solution: the optimal solution of `mdp`. Default: solved here to an error of 1e-9, or what floats reach.
        zeta: the exponent, above 0 or 0.
        tie_tolerance: as for `gaps`.
    Raises:
        ParameterError: zeta is negative or no number. PrecisionError: as for `gaps`.
    Exactness: gaps are known up to twice the error bound of the solution.
    Cost: as `gaps`, and a sort.
    Source: Farahmand (2011), "Action-gap phenomenon in reinforcement learning", assumption A1, for any number of
        actions.
    """
    if isinstance(zeta, bool) or not isinstance(zeta, int | float | np.floating) or not 0 <= zeta < math.inf:
        raise ParameterError(f"zeta is {zeta!r}; expected a finite number, at least 0")
    weights: dict[float, float] = {}
    states = 0.0
    blocks, tolerance, conventions = gaps_of_states(mdp, solution, tie_tolerance)
    for gap, weight in blocks:
        states += float(weight.sum())
        smallest = np.where(gap > tolerance, gap, math.inf).min(axis=1)
        there = np.isfinite(smallest) & (weight > 0)
        values, which = np.unique(smallest[there], return_inverse=True)
        for value, times in zip(values.tolist(), np.bincount(which, weight[there]).tolist(), strict=True):
            weights[value] = weights.get(value, 0.0) + times
    ordered = np.array(sorted(weights))
    shares = np.cumsum([weights[value] for value in ordered.tolist()]) / max(states, 1.0)
    constant = float((shares / ordered**zeta).max()) if len(ordered) else 0.0
    return ActionGapRegularity(constant, float(zeta), ordered, shares, int(states), tolerance, conventions)
