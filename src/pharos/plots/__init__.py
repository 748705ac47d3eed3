"""Plots: regret as it grows, values and policies over a grid, policies at play, instances in the plane of hardness.

Each function draws on the matplotlib axes given, or on a new figure, and returns the Figure. `save` writes it. Colours
are told apart by colour-blind people (Okabe and Ito, 2008). Nothing opens a window or changes matplotlib's settings.
"""

from pharos.plots.instances import growth, hardness_plane, policies, states_by_depth, value_map
from pharos.plots.regret import predictions, regret
from pharos.plots.style import (
    DIAGONAL,
    agent_label,
    color_among,
    label_edges,
    legend_below,
    observation_color,
    panels,
    save,
    save_for_page,
    slug,
    thousands,
)

__all__ = [
    "growth",
    "hardness_plane",
    "policies",
    "predictions",
    "regret",
    "save",
    "value_map",
]
