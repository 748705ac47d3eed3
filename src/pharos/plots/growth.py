"""How a state space grows with the number of steps from the start."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.plots.style import COLORS, plain_log, single, styled
from pharos.system.wording import many

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pharos.state_space import StateSpace


def states_by_depth(space: "StateSpace") -> np.ndarray:
    """(depth + 1,) numbers of states whose shortest way from a start state has 0, 1, ... steps; they sum to S.

    Cost: one read of the successors in blocks; 8 bytes a state of memory.
    """
    reached = np.zeros(space.num_states, np.bool_)
    frontier = np.unique(space.start_states)
    reached[frontier] = True
    counts = []
    while frontier.size:
        counts.append(frontier.size)
        following = space.dynamics.successors_of(frontier)
        frontier = following[~reached[following]]
        reached[frontier] = True
    return np.array(counts, np.int64)


@styled
def growth(spaces: Mapping[str, "StateSpace"], *, axes: Any = None) -> "Figure":
    """Draw how many states are within so many steps from the start, a line for each space, on logarithmic axes.

    Args:
        spaces: label -> state space.
        axes: where to draw; None for a new figure.
    Raises:
        ParameterError: no space is given.
    """
    if not spaces:
        raise ParameterError("no state spaces to draw; give at least one")
    drawn, axis = single(axes, (5.6, 3.6))
    for number, (label, space) in enumerate(spaces.items()):
        within, color = states_by_depth(space).cumsum(), COLORS[number % len(COLORS)]
        distance = np.arange(1, len(within) + 1)
        axis.plot(distance, within, color=color, label=f"{label}: {many(space.num_states, 'state')}")
        axis.plot(distance[-1:], within[-1:], "o", color=color, markersize=5)
    axis.set(xscale="log", yscale="log", xlabel="steps from the start + 1", ylabel="states")
    for side in (axis.xaxis, axis.yaxis):
        plain_log(side)
    axis.legend()
    return drawn
