"""How often actions are nearly as good as each other: the action-gap regularity."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.hardness.gaps.gaps import gaps_of_states
from pharos.mdp import TabularMDP, require_mdp
from pharos.solvers import Solution


@dataclass(frozen=True, eq=False)
class ActionGapRegularity:
    """How the action gap g(s) = V*(s) - max over actions that are not optimal of Q*(s, a) is distributed.

    Attributes:
        constant: the smallest c with P(0 < g(s) <= t) <= c t^zeta for all t > 0; 0 where there are no gaps.
        zeta: the exponent.
        gaps: (K,) the different gaps, ascending.
        shares: (K,) P(0 < g(s) <= gaps[i]).
        states: the number of states (of pairs and steps, where values have them) that were counted.
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

    s is uniform over the states that `gaps` counts: those that can be reached and are not terminal; under sticky
    actions pairs with the previously executed action; with a horizon the states of every step.

    Args:
        solution: the optimal solution of `mdp`; None: solved here to an error of 1e-9, or what floats reach.
        zeta: the exponent, above 0 or 0.
        tie_tolerance: as for `gaps`.
    Raises:
        ParameterError: zeta is negative or no number; PrecisionError: as for `gaps`.
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
