"""Instances in the plane of hardness: how long it takes to get around, against how hard it is to tell actions apart."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pharos.errors import ParameterError
from pharos.plots._style import COLORS, single, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pharos.hardness import Report

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
        reports: name of an instance, such as "breakout/12x8x1", to its report. One colour for each class before the slash.
        visitation, estimation: names of measures in the reports.
        axes: where to draw; None for a new figure.
    Raises:
        ParameterError: no reports, or a report lacks a measure or has no finite value for it.
    """
    if not reports:
        raise ParameterError("no reports to draw; give at least one")
    drawn, axis = single(axes, (6.0, 4.4))
    classes = list(dict.fromkeys(name.split("/")[0] for name in reports))
    for name, report in reports.items():
        number = classes.index(name.split("/")[0])
        low, high = _range(name, report, visitation)
        gaps = _range(name, report, estimation)[1]
        color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
        axis.plot([low, high], [gaps, gaps], color=color, linewidth=2)
        axis.plot((low * high) ** 0.5, gaps, marker, color=color, markersize=6, markeredgecolor="white")
        short = name.split("/", 1)[-1]
        axis.annotate(short, ((low * high) ** 0.5, gaps), (5, 4), textcoords="offset points", fontsize=7)
    for number, cls in enumerate(classes):
        axis.plot(
            [], [], MARKERS[number % len(MARKERS)], color=COLORS[number % len(COLORS)], label=cls.replace("_", " ")
        )
    axis.set(xscale="log", yscale="log", xlabel=visitation.replace("_", " "), ylabel=estimation.replace("_", " "))
    axis.margins(0.12)
    axis.legend()
    return drawn


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
