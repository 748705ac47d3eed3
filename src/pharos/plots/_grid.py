"""Values and a policy drawn over the cells of a grid world."""

from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.plots._style import figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pharos.solvers import Solution
    from pharos.state_space import StateSpace

ARROWS = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}


def value_map(space: "StateSpace", solution: "Solution", *, title: str = "") -> "Figure":
    """Draw V over the cells of a grid, with an arrow for each optimal action; dots where nothing is left to do.

    Args:
        space: of an environment whose state is a row and a column, such as simple_grid and frozen_lake.
        solution: of an MDP on this space, without sticky actions.
    Raises:
        ParameterError: states are no cells, or values belong to pairs.
    """
    if space.component_names != ("row", "column"):
        raise ParameterError(
            f"{space.manifest['environment']}: a state has {', '.join(space.component_names[:4])}; expected row and column alone"
        )
    if solution.v.ndim != 1:
        raise ParameterError(
            "values under sticky actions belong to pairs (state, previous action); expected one a state"
        )
    assert space.environment is not None
    rows, columns = space.environment.grid()
    states = space.states()
    values = np.full((rows, columns), np.nan)
    values[states[:, 0], states[:, 1]] = solution.v
    drawn, axes = figure(1, 1, (max(3.2, 0.62 * columns + 1.2), max(2.8, 0.62 * rows + 0.6)))
    axis = axes[0, 0]
    image = axis.imshow(values, cmap="cividis")
    drawn.colorbar(image, ax=axis, shrink=0.8, label="value")
    best, terminal = solution.optimal_actions(1e-9), np.asarray(solution.mdp.terminal)
    low, high = np.nanmin(values), np.nanmax(values)
    for (row, column), choices, ended, value in zip(states, best, terminal, solution.v, strict=True):
        light = high > low and (value - low) / (high - low) > 0.6
        color = "#101216" if light else "#f4f5f7"
        if ended or choices.all():
            axis.plot(column, row, "o", color=color, markersize=3)
            continue
        for action in np.flatnonzero(choices):
            x, y = ARROWS.get(space.environment.actions[action], (0, 0))
            head: Any = {"arrowstyle": "->", "color": color, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
            axis.annotate("", (column + 0.36 * x, row + 0.36 * y), (column, row), arrowprops=head)
    axis.set(xticks=[], yticks=[], title=title)
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return drawn
