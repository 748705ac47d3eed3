"""Plots of instances: values and policies over cells, policies at play, and the plane of hardness.

`value_map`: values and a policy over the cells of a grid world, or over any two variables of its states.
`hardness_plane`: instances in the plane of hardness: how long it takes to get around, against how hard it is to tell
actions apart.

`growth`: how a state space grows with the number of steps from the start. `policies`: policies at play beside each
other, such as a learnt one beside the best, as an animated GIF.
"""

import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from pharos.drawing import NIGHT, enlarged, image, save_gif
from pharos.errors import ParameterError, UnknownName
from pharos.interaction import GymEnv
from pharos.observations import render as render_state
from pharos.plots.style import INK_COLOR, LINE_COLORS, plain_log, single, styled
from pharos.policies import PolicyAnswers, PolicyLike, TabularAgent
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pharos.environments import State
    from pharos.hardness import Report
    from pharos.mdp import TabularMDP
    from pharos.solvers import Solution
    from pharos.state_space import StateSpace
    from pharos.training import Task


ARROW_VECTORS = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}


ROW_AND_COLUMN = ("row", "column")
LONGEST_LETTERED_SIDE = 40  # a side: beyond it, letters in cells are too small to read


@styled
def value_map(
    space: "StateSpace",
    solution: "Solution",
    *,
    over: tuple[str, str] = ROW_AND_COLUMN,
    fix: Mapping[str, int] | None = None,
    rest: Literal["start"] | None = None,
    title: str = "",
    axes: "Axes | None" = None,
) -> "Figure":
    """Draw V over the cells of a grid, or over two other variables, with the actions that the policy may take.

    Over row and column, arrows show all optimal actions of an optimal solution. The arrows of your own policy are as
    long as their probability. Over other variables, letters say which actions the policy may take. A dot means that
    every action is as good. Terminal states are grey and outside of the colours' range. The number is the reward of
    getting there. A frame marks where episodes start.

    Args:
        space: of any environment.
        solution: of an MDP on this space, without sticky actions: optimal, worst, or of a policy.
        over: the variables that go down and to the right.
        fix: name -> value of every other variable, such as {"passenger": 4}: the slice to draw. What has one value in
            it need not be named.
        rest: "start": variables that `fix` does not name are as in the first start state.
        axes: matplotlib axes to draw on. Default: a new figure.
    Raises:
        ParameterError: states lack these variables, others are not fixed, or values belong to pairs.
    """
    if solution.v.ndim != 1:
        raise ParameterError(
            "values under sticky actions belong to pairs (state, previous action); expected one a state"
        )
    shown, cells = _cells(space, over, fix or {}, rest)
    from matplotlib.patches import Rectangle

    assert space.environment is not None
    # Values as an image over the two variables
    first, size = _extent(space, over, cells)
    cells = cells - first
    mdp = solution.mdp
    terminal = np.asarray(mdp.terminal)
    values = np.full(size, np.nan)
    values[cells[:, 0], cells[:, 1]] = np.where(terminal[shown], np.nan, solution.v[shown])
    drawn, axis = single(axes, (max(3.2, 0.62 * min(size[1], 30) + 1.2), max(2.8, 0.62 * min(size[0], 24) + 0.6)))
    axis.set_facecolor("#c9ccd1")
    image = axis.imshow(values, cmap="cividis")
    drawn.colorbar(image, ax=axis, shrink=0.8, label="value").outline.set_visible(False)
    # The actions of the policy in each cell
    lengths, letters = _lengths(solution), _letters(space.environment.actions)
    draws_actions = over == ROW_AND_COLUMN or max(size) <= LONGEST_LETTERED_SIDE
    low, high = _range_of(values)
    for s, (row, column) in zip(shown, cells, strict=True):
        value = values[row, column]
        dark = np.isnan(value) or (high > low and (value - low) / (high - low) > 0.5)
        color = "#101216" if dark else "#f4f5f7"
        if terminal[s]:
            if draws_actions:
                axis.text(
                    column, row, _reward_on_entering(mdp, s), ha="center", va="center", color=INK_COLOR, fontsize=9
                )
        elif not draws_actions:
            continue
        elif np.isnan(value) or lengths[s].min() == lengths[s].max():
            axis.plot(column, row, "o", color=color, markersize=3)
        elif over == ROW_AND_COLUMN:
            _draw_arrows(axis, (column, row), space.environment.actions, lengths[s], color, letters)
        else:
            text = "".join(letters[int(action)] for action in np.flatnonzero(lengths[s] > 0.02))
            axis.text(column, row, text, ha="center", va="center", color=color, fontsize=7)
    # Frames around start states
    for row, column in cells[np.isin(shown, mdp.start_states)]:
        axis.add_patch(
            Rectangle((column - 0.46, row - 0.46), 0.92, 0.92, fill=False, edgecolor="#D55E00", linewidth=1.6)
        )
    axis.set(xticks=[], yticks=[], title=textwrap.fill(title, max(24, int(9 * drawn.get_figwidth()))))
    if over != ROW_AND_COLUMN:
        key = "   ".join(f"{letter} {name}" for letter, name in zip(letters, space.environment.actions, strict=True))
        axis.set(ylabel=over[0], xlabel=f"{over[1]}\n{key}" if draws_actions and len(letters) <= 12 else over[1])
        axis.set_yticks(*_ticks(size[0], first[0]))
        axis.set_xticks(*_ticks(size[1], first[1]))
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return drawn


def _draw_arrows(
    axis: "Axes", cell: tuple[int, int], actions: Sequence[str], lengths: np.ndarray, color: str, letters: Sequence[str]
) -> None:
    """Arrows as long as the actions are probable: one alone in the middle of its cell, several from there. A letter
    stands for each action that leads nowhere."""
    column, row = cell
    indices = [int(action) for action in np.flatnonzero(lengths > 0.02)]
    if still := "".join(letters[action] for action in indices if actions[action] not in ARROW_VECTORS):
        axis.text(column, row, still, ha="center", va="center", color=color, fontsize=8)
    for action in indices:
        if actions[action] not in ARROW_VECTORS:
            continue
        x, y = ARROW_VECTORS[actions[action]]
        head: dict[str, object] = {"arrowstyle": "->", "color": color, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
        length = 0.1 + 0.26 * lengths[action]
        back = length if len(indices) == 1 else 0.0
        end = (column + length * x, row + length * y)
        axis.annotate("", end, (column - back * x, row - back * y), arrowprops=head)


def _letters(actions: Sequence[str]) -> list[str]:
    """A letter for each action: its first one that no other action has, else its number."""
    letters: list[str] = []
    for number, name in enumerate(actions):
        free = [letter for letter in name if letter.isalnum() and letter not in letters]
        letters.append(free[0] if free else str(number))
    return letters


def _ticks(count: int, first: int) -> tuple[list[int], list[str]]:
    """(positions, labels) of ticks: at most a dozen values of a variable."""
    indices = list(range(0, count, -(-count // 12)))
    return indices, [str(first + index) for index in indices]


def _extent(space: "StateSpace", over: tuple[str, str], cells: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """(the values in the first row and column, the number of rows and columns)."""
    assert space.environment is not None
    if over == ROW_AND_COLUMN:
        components = space.environment.components
        which = [components.names.index(name) for name in ROW_AND_COLUMN]
        return components.low[which], tuple(components.size[which].tolist())
    low, high = cells.min(axis=0), cells.max(axis=0)
    return low, (int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1)


def _cells(
    space: "StateSpace", over: tuple[str, str], fix: Mapping[str, int], rest: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the states of the slice, (N, 2) their values of the two variables."""
    names, environment = space.component_names, space.manifest["environment"]
    if over == ROW_AND_COLUMN and not set(ROW_AND_COLUMN) <= set(names):
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
    # States whose other variables have the fixed values
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
    # Variables that still vary in the slice
    free = [name for name in others if name not in fix and np.ptp(states[shown, names.index(name)])]
    if free:
        slices = " ".join(f"--fix {name}={start[name]}" for name in free[:4])
        expected = "row and column alone" if over == ROW_AND_COLUMN else f"{' and '.join(over)} alone"
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


def _reward_on_entering(mdp: "TabularMDP", terminal: int) -> str:
    """Reward of the transitions into a terminal state, as text, or empty if they differ or there are none."""
    into = mdp.dynamics.leads_to(terminal) & ~np.asarray(mdp.terminal)[:, None]
    rewards = np.unique(mdp.rewards[into])
    return f"{rewards[0]:g}" if len(rewards) == 1 else ""


# Planes of hardness ---------------------------------------------------------------------------------------------------


PLOT_MARKERS = "os^Dv<>P*X"


@styled
def hardness_plane(
    reports: Mapping[str, "Report"],
    *,
    visitation: str = "diameter",
    estimation: str = "sum_of_reciprocal_gaps",
    axes: "Axes | None" = None,
) -> "Figure":
    """Draw instances by two measures on logarithmic axes. A diameter that is an interval is drawn as a bar.

    Args:
        reports: name of an instance, such as "breakout/12x8x1", to its report. One colour for each class before the
            slash.
        visitation, estimation: names of measures in the reports.
        axes: matplotlib axes to draw on. Default: a new figure.
    Raises:
        ParameterError: no reports, or a report lacks a measure or has no finite value for it.
    """
    if not reports:
        raise ParameterError("no reports to draw; give at least one")
    drawn, axis = single(axes, (6.0, 4.4))
    classes = list(dict.fromkeys(name.split("/")[0] for name in reports))
    points: dict[str, tuple[float, float]] = {}
    for name, report in reports.items():
        number = classes.index(name.split("/")[0])
        low, high = _range(name, report, visitation)
        gaps = _range(name, report, estimation)[1]
        color, marker = LINE_COLORS[number % len(LINE_COLORS)], PLOT_MARKERS[number % len(PLOT_MARKERS)]
        axis.plot([low, high], [gaps, gaps], color=color, linewidth=2)
        axis.plot((low * high) ** 0.5, gaps, marker, color=color, markersize=6, markeredgecolor="white")
        points[name] = ((low * high) ** 0.5, gaps)
    for number, cls in enumerate(classes):
        axis.plot(
            [],
            [],
            PLOT_MARKERS[number % len(PLOT_MARKERS)],
            color=LINE_COLORS[number % len(LINE_COLORS)],
            label=cls.replace("_", " "),
        )
    axis.set(xscale="log", yscale="log", xlabel=visitation.replace("_", " "), ylabel=estimation.replace("_", " "))
    axis.margins(0.18)
    for side in (axis.xaxis, axis.yaxis):
        plain_log(side)
    axis.legend(loc="upper left")
    _label(axis, points)
    return drawn


def _label(axis: Any, points: Mapping[str, tuple[float, float]]) -> None:
    """Draw names beside their points, on the side and at the height where the fewest others are in the way."""
    axis.figure.draw_without_rendering()  # the layout decides where points are
    scale = 72 / axis.figure.dpi
    at = {name: scale * axis.transData.transform(point) for name, point in points.items()}
    left, low, right_end, high = (scale * edge for edge in axis.bbox.extents)
    far = 1e4
    obstacles = [(x - 4, y - 4, x + 4, y + 4) for x, y in at.values()]
    obstacles += [(left - far, -far, left, far), (right_end, -far, right_end + far, far)]  # outside
    obstacles += [(-far, low - far, far, low), (-far, high, far, high + far)]
    for name, (x, y) in at.items():
        short = name.split("/", 1)[-1]
        width, height = 4.2 * len(short), 8.0
        boxes = {}
        for dy in (-3.0, 5.0, -11.0, 13.0, -19.0):
            for right in (True, False):
                edge = x + 6 if right else x - 6 - width
                boxes[right, dy] = (edge, y + dy, edge + width, y + dy + height)
        cost = {
            offset: sum(_overlap(box, other) for other in obstacles) + 2 * abs(offset[1] + 3)
            for offset, box in boxes.items()
        }
        right, dy = min(cost, key=cost.__getitem__)
        obstacles.append(boxes[right, dy])
        axis.annotate(
            short,
            points[name],
            (6 if right else -6, dy),
            textcoords="offset points",
            ha="left" if right else "right",
            fontsize=7,
        )


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    across = min(one[2], other[2]) - max(one[0], other[0])
    along = min(one[3], other[3]) - max(one[1], other[1])
    return max(0.0, across) * max(0.0, along)


def _range(name: str, report: "Report", measure: str) -> tuple[float, float]:
    if measure not in report.results:
        raise ParameterError(f"{name}: the report lacks {measure!r}; it has {', '.join(report.results)}")
    value: Any = report[measure].value
    low, high = (value.get("lower"), value.get("upper")) if isinstance(value, Mapping) else (value, value)
    if not low or not high or not 0 < low <= high < float("inf"):
        raise ParameterError(
            f"{name}: {measure} is {report[measure].text or 'undefined'}; expected a positive, finite value"
        )
    return float(low), float(high)


# Growth ---------------------------------------------------------------------------------------------------------------


def states_by_depth(space: "StateSpace") -> np.ndarray:
    """(depth + 1,) numbers of states whose shortest way from a start state has 0, 1, ... steps. They sum to S.

    Cost: one read of the successors in blocks, and 8 bytes a state of memory.
    """
    visited = np.zeros(space.num_states, np.bool_)
    frontier = np.unique(space.start_states)
    visited[frontier] = True
    counts = []
    while frontier.size:
        counts.append(frontier.size)
        next_states = space.dynamics.successors_of(frontier)
        frontier = next_states[~visited[next_states]]
        visited[frontier] = True
    return np.array(counts, np.int64)


@styled
def growth(spaces: Mapping[str, "StateSpace"], *, axes: "Axes | None" = None) -> "Figure":
    """Draw how many states are within so many steps from the start, a line for each space, on logarithmic axes.

    Args:
        spaces: label -> state space.
        axes: matplotlib axes to draw on. Default: a new figure.
    Raises:
        ParameterError: no space is given.
    """
    if not spaces:
        raise ParameterError("no state spaces to draw; give at least one")
    drawn, axis = single(axes, (5.6, 3.6))
    for number, (label, space) in enumerate(spaces.items()):
        within, color = states_by_depth(space).cumsum(), LINE_COLORS[number % len(LINE_COLORS)]
        distance = np.arange(1, len(within) + 1)
        axis.plot(distance, within, color=color, label=f"{label}: {pluralize(space.num_states, 'state')}")
        axis.plot(distance[-1:], within[-1:], "o", color=color, markersize=5)
    axis.set(xscale="log", yscale="log", xlabel="steps from the start + 1", ylabel="states")
    for side in (axis.xaxis, axis.yaxis):
        plain_log(side)
    axis.legend()
    return drawn


# Policies at play -----------------------------------------------------------------------------------------------------


Observed: TypeAlias = np.ndarray | dict[str, np.ndarray]
GAP = 12  # pixels between two pictures


def policies(
    task: "Task",
    agents: Mapping[str, Any],
    path: str | os.PathLike,
    *,
    steps: int | None = None,
    observation: str = "human",
    seed: int = 0,
    frames_per_second: float = 8.0,
) -> Path:
    """Write an episode of each agent, side by side, with the return so far below.

    All start in the same state and meet the same chance as far as they act alike. For the best policy give the
    policy of a discounted solution: with many undiscounted steps left, a policy that waits is as good as one that goes
    straight to the goal.

    Args:
        task: environment, chance, and what the agents see.
        agents: label -> what `training.evaluate_agent` takes: a table (S,) or (S, A), a model, or a function of
            observations.
        path: of the .gif.
        steps: at most. Default: the time limit of the task.
        observation: how states are drawn, "human" or an observation that is an image.
        seed: of chance and of random actions.
    Raises:
        ParameterError: no agent, or a path that does not end in .gif.
    """
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise ParameterError(f"{path}: expected a name that ends in .gif")
    if not agents:
        raise ParameterError("no policies to draw; give at least one")
    limit = task.time_limit if steps is None else steps
    played = [_episode(task, agent, limit, seed) for agent in agents.values()]
    frames = []
    for step in range(max(len(episode) for episode in played)):
        parts = []
        for label, episode in zip(agents, played, strict=True):
            state, gained = episode[min(step, len(episode) - 1)]
            over = "   over" if step >= len(episode) - 1 else ""
            picture = enlarged(render_state(task.env, state, observation), 200)
            parts.append(np.asarray(image(picture, f"{label}   return {gained:g}{over}")))
        frames.append(_beside(parts))
    return save_gif(path, frames, frames_per_second=frames_per_second)


def _beside(parts: Sequence[np.ndarray]) -> np.ndarray:
    gap = np.full((parts[0].shape[0], GAP, 3), NIGHT, np.uint8)
    return np.concatenate([piece for part in parts for piece in (gap, part)][1:], axis=1)


def _episode(task: "Task", agent: PolicyLike, steps: int, seed: int) -> list[tuple["State", float]]:
    """[(state, return so far)] from the start to the end of one episode, as `GymEnv` plays it."""
    env = GymEnv(task.env, **task.interaction)
    choose = _chooser(task, agent, np.random.default_rng(seed))
    observation, info = env.reset(seed=seed)
    episode, gained = [(info["state"], 0.0)], 0.0
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(choose(observation, info["state"]))
        gained += float(reward)
        episode.append((info["state"], gained))
        if terminated or truncated:
            break
    return episode


def _chooser(task: "Task", agent: PolicyLike, rng: np.random.Generator) -> Callable[[Observed, "State"], int]:
    """A function (observation, state) -> action."""
    if isinstance(agent, TabularAgent):
        agent = agent.policy_table()
    table = agent if isinstance(agent, np.ndarray) else None
    shapes = (task.space.num_states,), (task.space.num_states, task.env.num_actions)
    if table is not None and table.shape not in shapes:
        raise ParameterError(
            f"the policy has shape {table.shape}; expected ({task.space.num_states},) actions or "
            f"({task.space.num_states}, {task.env.num_actions}) probabilities"
        )
    answers = None if table is not None else PolicyAnswers(agent, task.mdp, task.observer)

    def choose(observation: Observed, state: "State") -> int:
        if answers is not None:
            row = answers.answer(_batch(observation))[0]
        elif table is not None:
            row = table[task.space.index(state)]
            if np.ndim(row) == 0:
                return int(row)
        return int(rng.choice(task.env.num_actions, p=row / row.sum()))

    return choose


def _batch(observation: Observed) -> Observed:
    return (
        {name: np.asarray(value)[None] for name, value in observation.items()}
        if isinstance(observation, dict)
        else np.asarray(observation)[None]
    )
