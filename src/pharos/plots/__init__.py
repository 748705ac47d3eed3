"""Plots: regret as it grows, values and policies over a grid, policies at play, instances in the plane of hardness.

Each function draws on the matplotlib axes given, or on a new figure, and returns the Figure; `save` writes it. Colours
are told apart by colour-blind people (Okabe and Ito, 2008). Nothing opens a window or changes matplotlib's settings.
"""

from pharos.plots.grid import value_map
from pharos.plots.plane import growth, hardness_plane, predictions, states_by_depth
from pharos.plots.policies import policies
from pharos.plots.regret import regret
from pharos.plots.style import save

__all__ = ["growth", "hardness_plane", "policies", "predictions", "regret", "save", "states_by_depth", "value_map"]
