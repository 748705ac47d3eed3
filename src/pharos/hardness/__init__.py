"""How hard an MDP is to learn: how long it takes to get around, to tell actions apart, and to look ahead.

Visitation complexity: `diameter`, `start_eccentricity`. Estimation complexity: `gaps`, `sum_of_reciprocal_gaps`, `minimal_gap`.
"""

from pharos.hardness._diameter import diameter, start_eccentricity
from pharos.hardness._gaps import Gaps, gaps, minimal_gap, sum_of_reciprocal_gaps
from pharos.hardness._interval import Budget, Interval, Progress

__all__ = [
    "Budget",
    "Gaps",
    "Interval",
    "Progress",
    "diameter",
    "gaps",
    "minimal_gap",
    "start_eccentricity",
    "sum_of_reciprocal_gaps",
]
