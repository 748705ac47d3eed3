"""Values and a policy drawn over the cells of a grid world, or over any two variables of its states."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pharos.errors import ParameterError, UnknownName
from pharos.plots.style import INK, single, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pharos.solvers import Solution
    from pharos.state_space import StateSpace

ARROWS = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}


CELLS = ("row", "column")
MOST_LETTERS = 40  # a side: beyond it, letters in cells are too small to read


@styled
def value_map(
    space: "StateSpace",
    solution: "Solution",
    *,
    over: tuple[str, str] = CELLS,
    fix: Mapping[str, int] | None = None,
    rest: Literal["start"] | None = None,
    title: str = "",
    axes: Any = None,
) -> "Figure":
    """Draw V over the cells of a grid, or over two other variables, with the actions that the policy may take.

    Over row and column, arrows are those of all optimal actions for an optimal solution; for a given policy as long as
    their probability. Over other variables, letters say which actions the policy may take. A dot stands where every
    action is as good. Terminal states are grey and outside of the colours' range; the number is the reward of getting
    there. A frame marks where episodes start.

    Args:
        space: of any environment.
        solution: of an MDP on this space, without sticky actions: optimal, worst, or of a policy.
        over: the variables that go down and to the right.
        fix: name -> value of every other variable, such as {"passenger": 4}: the slice to draw. What has one value in
            it need not be named.
        rest: "start": variables that `fix` does not name are as in the first start state.
        axes: where to draw; None for a new figure.
    Raises:
        ParameterError: states lack these variables, others are not fixed, or values belong to pairs.
    """
    if solution.v.ndim != 1:
        raise ParameterError(
            "values under sticky actions belong to pairs (state, previous action); expected one a state"
        )
    shown, place = _cells(space, over, fix or {}, rest)
    from matplotlib.patches import Rectangle

    assert space.environment is not None
    first, size = _extent(space, over, place)
    place = place - first
    mdp = solution.mdp
    terminal = np.asarray(mdp.terminal)
    values = np.full(size, np.nan)
    values[place[:, 0], place[:, 1]] = np.where(terminal[shown], np.nan, solution.v[shown])
    drawn, axis = single(axes, (max(3.2, 0.62 * min(size[1], 30) + 1.2), max(2.8, 0.62 * min(size[0], 24) + 0.6)))
    axis.set_facecolor("#c9ccd1")
    image = axis.imshow(values, cmap="cividis")
    drawn.colorbar(image, ax=axis, shrink=0.8, label="value").outline.set_visible(False)
    lengths, letters = _lengths(solution), _letters(space.environment.actions)
    draws_actions = over == CELLS or max(size) <= MOST_LETTERS
    low, high = _range_of(values)
    for s, (row, column) in zip(shown, place, strict=True):
        value = values[row, column]
        dark = np.isnan(value) or (high > low and (value - low) / (high - low) > 0.5)
        color = "#101216" if dark else "#f4f5f7"
        if terminal[s]:
            if draws_actions:
                axis.text(column, row, _reward_on_entering(mdp, s), ha="center", va="center", color=INK, fontsize=9)
        elif not draws_actions:
            continue
        elif np.isnan(value) or lengths[s].min() == lengths[s].max():
            axis.plot(column, row, "o", color=color, markersize=3)
        elif over == CELLS:
            _draw_arrows(axis, (column, row), space.environment.actions, lengths[s], color, letters)
        else:
            text = "".join(letters[int(action)] for action in np.flatnonzero(lengths[s] > 0.02))
            axis.text(column, row, text, ha="center", va="center", color=color, fontsize=7)
    for row, column in place[np.isin(shown, mdp.start_states)]:
        axis.add_patch(
            Rectangle((column - 0.46, row - 0.46), 0.92, 0.92, fill=False, edgecolor="#D55E00", linewidth=1.6)
        )
    axis.set(xticks=[], yticks=[], title=textwrap.fill(title, max(24, int(9 * drawn.get_figwidth()))))
    if over != CELLS:
        key = "   ".join(f"{letter} {name}" for letter, name in zip(letters, space.environment.actions, strict=True))
        axis.set(ylabel=over[0], xlabel=f"{over[1]}\n{key}" if draws_actions and len(letters) <= 12 else over[1])
        axis.set_yticks(*_ticks(size[0], first[0]))
        axis.set_xticks(*_ticks(size[1], first[1]))
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return drawn


def _draw_arrows(
    axis: Any, cell: tuple[int, int], actions: Sequence[str], lengths: np.ndarray, color: str, letters: Sequence[str]
) -> None:
    """Arrows as long as the actions are probable: one alone in the middle of its cell, several from there; a letter for
    each action that leads nowhere."""
    column, row = cell
    indices = [int(action) for action in np.flatnonzero(lengths > 0.02)]
    if still := "".join(letters[action] for action in indices if actions[action] not in ARROWS):
        axis.text(column, row, still, ha="center", va="center", color=color, fontsize=8)
    for action in indices:
        if actions[action] not in ARROWS:
            continue
        x, y = ARROWS[actions[action]]
        head: Any = {"arrowstyle": "->", "color": color, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
        length = 0.1 + 0.26 * lengths[action]
        back = length if len(indices) == 1 else 0.0
        end = (column + length * x, row + length * y)
        axis.annotate("", end, (column - back * x, row - back * y), arrowprops=head)


def _letters(actions: Sequence[str]) -> list[str]:
    """A letter for each action: its first one that no other action has; else its number."""
    letters: list[str] = []
    for number, name in enumerate(actions):
        free = [letter for letter in name if letter.isalnum() and letter not in letters]
        letters.append(free[0] if free else str(number))
    return letters


def _ticks(count: int, first: int) -> tuple[list[int], list[str]]:
    """(where, what): at most a dozen values of a variable."""
    places = list(range(0, count, -(-count // 12)))
    return places, [str(first + place) for place in places]


def _extent(space: "StateSpace", over: tuple[str, str], place: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """(the values in the first row and column, the number of rows and columns)."""
    assert space.environment is not None
    if over == CELLS:
        components = space.environment.components
        which = [components.names.index(name) for name in CELLS]
        return components.low[which], tuple(components.size[which].tolist())
    low, high = place.min(axis=0), place.max(axis=0)
    return low, (int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1)


def _cells(
    space: "StateSpace", over: tuple[str, str], fix: Mapping[str, int], rest: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the states of the slice, (N, 2) their values of the two variables."""
    names, environment = space.component_names, space.manifest["environment"]
    if over == CELLS and not set(CELLS) <= set(names):
        raise ParameterError(
            f"{environment}: a state has {', '.join(names[:4])}; expected row and column alone, or others beside them "
            f"to fix: say which two to draw over, such as --over {','.join(names[:2])} (over=(...) in Python)"
        )
    for name in over:
        if name not in names:
            raise UnknownName(f"component of {environment} to draw over", name, names)
    if len(set(over)) < 2:
        raise ParameterError(f"{environment}: drawn over {' and '.join(over)}; expected two components")
    others = [name for name in names if name not in over]
    for name in fix:
        if name not in others:
            raise UnknownName(f"component of {environment} to fix", name, others)
    start = dict(zip(names, space.states()[0].tolist(), strict=True))
    if rest == "start":
        fix = {name: start[name] for name in others} | dict(fix)
    states = space.states()
    shown = np.arange(len(states))
    for name, value in fix.items():
        shown = shown[states[shown, names.index(name)] == value]
    if not len(shown):
        raise ParameterError(
            f"{environment}: no state has {', '.join(f'{name}={value}' for name, value in fix.items())}"
        )
    free = [name for name in others if name not in fix and np.ptp(states[shown, names.index(name)])]
    if free:
        slices = " ".join(f"--fix {name}={start[name]}" for name in free[:4])
        expected = "row and column alone" if over == CELLS else f"{' and '.join(over)} alone"
        raise ParameterError(
            f"{environment}: a state has {', '.join(names[:6])}; expected {expected}: "
            f"fix the others, such as {slices} (fix={{...}} in Python), or --fix start (rest='start')"
        )
    return shown, states[shown][:, [names.index(name) for name in over]]


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
    rewards = np.unique(mdp.rewards[into])
    return f"{rewards[0]:g}" if len(rewards) == 1 else ""
