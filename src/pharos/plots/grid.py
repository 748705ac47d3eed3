"""Values and a policy drawn over the cells of a grid world."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError, UnknownName
from pharos.plots.style import INK, single, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pharos.solvers import Solution
    from pharos.state_space import StateSpace

ARROWS = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}


@styled
def value_map(
    space: "StateSpace",
    solution: "Solution",
    *,
    fix: Mapping[str, int] | None = None,
    title: str = "",
    axes: Any = None,
) -> "Figure":
    """Draw V over the cells of a grid, with an arrow for each action that the policy may take.

    Arrows are those of all optimal actions for an optimal solution; for a given policy as long as their probability. A
    dot stands where every action is as good. Terminal cells are grey and outside of the colours' range; the number is
    the reward of getting there. A frame marks the cell where episodes start.

    Args:
        space: of an environment whose states have a row and a column, such as simple_grid and frozen_lake.
        solution: of an MDP on this space, without sticky actions: optimal, worst, or of a policy.
        fix: name -> value of every other component of a state, such as {"passenger": 4}: the slice to draw.
        axes: where to draw; None for a new figure.
    Raises:
        ParameterError: states have no row and column, other components are not fixed, or values belong to pairs.
    """
    shown, place = _cells(space, fix or {})
    if solution.v.ndim != 1:
        raise ParameterError(
            "values under sticky actions belong to pairs (state, previous action); expected one a state"
        )
    from matplotlib.patches import Rectangle

    assert space.environment is not None
    rows, columns = space.environment.grid()
    mdp = solution.mdp
    terminal = np.asarray(mdp.terminal)
    values = np.full((rows, columns), np.nan)
    values[place[:, 0], place[:, 1]] = np.where(terminal[shown], np.nan, solution.v[shown])
    drawn, axis = single(axes, (max(3.2, 0.62 * columns + 1.2), max(2.8, 0.62 * rows + 0.6)))
    axis.set_facecolor("#c9ccd1")
    image = axis.imshow(values, cmap="cividis")
    drawn.colorbar(image, ax=axis, shrink=0.8, label="value").outline.set_visible(False)
    lengths = _lengths(solution)
    low, high = _range_of(values)
    for s, (row, column) in zip(shown, place, strict=True):
        value = values[row, column]
        dark = np.isnan(value) or (high > low and (value - low) / (high - low) > 0.5)
        color = "#101216" if dark else "#f4f5f7"
        if terminal[s]:
            axis.text(column, row, _reward_on_entering(mdp, s), ha="center", va="center", color=INK, fontsize=9)
        elif np.isnan(value) or lengths[s].min() == lengths[s].max():
            axis.plot(column, row, "o", color=color, markersize=3)
        else:
            for action in np.flatnonzero(lengths[s] > 0.02):
                x, y = ARROWS.get(space.environment.actions[action], (0, 0))
                head: Any = {"arrowstyle": "->", "color": color, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
                length = 0.1 + 0.26 * lengths[s, action]
                axis.annotate("", (column + length * x, row + length * y), (column, row), arrowprops=head)
    for row, column in place[np.isin(shown, mdp.start_states)]:
        axis.add_patch(
            Rectangle((column - 0.46, row - 0.46), 0.92, 0.92, fill=False, edgecolor="#D55E00", linewidth=1.6)
        )
    axis.set(xticks=[], yticks=[], title=title)
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return drawn


def _cells(space: "StateSpace", fix: Mapping[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the states of the slice, (N, 2) their rows and columns."""
    names, environment = space.component_names, space.manifest["environment"]
    others = [name for name in names if name not in ("row", "column")]
    for name in fix:
        if name not in others:
            raise UnknownName(f"component of {environment} to fix", name, others)
    if not {"row", "column"} <= set(names):
        raise ParameterError(
            f"{environment}: a state has {', '.join(names[:4])}; "
            f"expected row and column alone, or others beside them to fix"
        )
    free = [name for name in others if name not in fix]
    if free:
        start = dict(zip(names, space.states()[0].tolist(), strict=True))
        slices = " ".join(f"--fix {name}={start[name]}" for name in free[:4])
        raise ParameterError(
            f"{environment}: a state has {', '.join(names[:6])}; expected row and column alone: "
            f"fix the others, such as {slices} (fix={{...}} in Python)"
        )
    states = space.states()
    shown = (
        np.flatnonzero(np.all([states[:, names.index(name)] == value for name, value in fix.items()], axis=0))
        if fix
        else np.arange(len(states))
    )
    if not len(shown):
        raise ParameterError(
            f"{environment}: no state has {', '.join(f'{name}={value}' for name, value in fix.items())}"
        )
    return shown, states[shown][:, [names.index("row"), names.index("column")]]


def _range_of(values: np.ndarray) -> tuple[float, float]:
    numbers = values[~np.isnan(values)]
    return (float(numbers.min()), float(numbers.max())) if numbers.size else (0.0, 0.0)


def _lengths(solution: "Solution") -> np.ndarray:
    """(S, A) in [0, 1]: which actions the policy takes, and how often."""
    if solution.kind == "policy":
        policy = np.asarray(solution.policy)
        return np.eye(solution.mdp.num_actions)[policy] if policy.ndim == 1 else np.nan_to_num(policy)
    sign, tolerance = (-1 if solution.kind == "worst" else 1), max(1e-9, 2 * solution.error_bound)
    q = sign * solution.q
    return (q >= q.max(axis=1, keepdims=True) - tolerance).astype(np.float64)


def _reward_on_entering(mdp: Any, terminal: int) -> str:
    """The reward of the transitions that lead into a terminal state; empty where they differ or there are none."""
    into = mdp.dynamics.leads_to(terminal) & ~np.asarray(mdp.terminal)[:, None]
    paid = np.unique(mdp.rewards[into])
    return f"{paid[0]:g}" if len(paid) == 1 else ""
