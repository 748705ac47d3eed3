"""How hard an MDP is to learn: how long it takes to get around, to tell actions apart, and to look ahead.

Visitation complexity: `diameter`, `start_eccentricity`.
"""

from pharos.hardness._diameter import diameter, start_eccentricity
from pharos.hardness._interval import Budget, Interval, Progress

__all__ = ["Budget", "Interval", "Progress", "diameter", "start_eccentricity"]
