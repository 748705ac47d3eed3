"""Instances in the plane of hardness: how long it takes to get around, against how hard it is to tell actions apart.

How a state space grows with the number of steps from the start.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.plots.style import COLORS, plain_log, single, styled
from pharos.system.wording import many

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pharos.hardness import Report
    from pharos.state_space import StateSpace

MARKERS = "os^Dv<>P*X"


@styled
def hardness_plane(
    reports: Mapping[str, "Report"],
    *,
    visitation: str = "diameter",
    estimation: str = "sum_of_reciprocal_gaps",
    axes: Any = None,
) -> "Figure":
    """Draw instances by two measures on logarithmic axes; a diameter that is an interval is drawn as a bar.

    Args:
        reports: name of an instance, such as "breakout/12x8x1", to its report. One colour for each class before the
            slash.
        visitation, estimation: names of measures in the reports.
        axes: where to draw; None for a new figure.
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
        color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
        axis.plot([low, high], [gaps, gaps], color=color, linewidth=2)
        axis.plot((low * high) ** 0.5, gaps, marker, color=color, markersize=6, markeredgecolor="white")
        points[name] = ((low * high) ** 0.5, gaps)
    for number, cls in enumerate(classes):
        axis.plot(
            [], [], MARKERS[number % len(MARKERS)], color=COLORS[number % len(COLORS)], label=cls.replace("_", " ")
        )
    axis.set(xscale="log", yscale="log", xlabel=visitation.replace("_", " "), ylabel=estimation.replace("_", " "))
    axis.margins(0.18)
    for side in (axis.xaxis, axis.yaxis):
        plain_log(side)
    axis.legend(loc="upper left")
    _label(axis, points)
    return drawn


def _label(axis: Any, points: Mapping[str, tuple[float, float]]) -> None:
    """Names beside their points, on the side and at the height where the fewest others are in the way."""
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
            place: sum(_overlap(box, other) for other in obstacles) + 2 * abs(place[1] + 3)
            for place, box in boxes.items()
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
    """(depth + 1,) numbers of states whose shortest way from a start state has 0, 1, ... steps; they sum to S.

    Cost: one read of the successors in blocks; 8 bytes a state of memory.
    """
    reached = np.zeros(space.num_states, np.bool_)
    frontier = np.unique(space.start_states)
    reached[frontier] = True
    counts = []
    while frontier.size:
        counts.append(frontier.size)
        next_states = space.dynamics.successors_of(frontier)
        frontier = next_states[~reached[next_states]]
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
