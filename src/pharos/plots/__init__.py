"""Plots: regret as it grows, values and policies over a grid, instances in the plane of hardness.

Each function returns a matplotlib Figure; `save` writes it. Colours are told apart by colour-blind people (Okabe and Ito, 2008).
"""

from pharos.plots._grid import value_map
from pharos.plots._plane import hardness_plane
from pharos.plots._regret import regret
from pharos.plots._style import save

__all__ = ["hardness_plane", "regret", "save", "value_map"]
