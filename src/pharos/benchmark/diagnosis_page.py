"""The page of `pharos diagnose` as one HTML file that loads and runs nothing, with a plot beside the nearest agents."""

from collections.abc import Mapping
from xml.etree.ElementTree import Element

import numpy as np

from pharos.benchmark.agent_diagnosis import Diagnosis
from pharos.benchmark.charts import (
    bars,
    captioned,
    document,
    drawing,
    element,
    html_table,
    label,
    legend,
    line,
    marker,
    section,
)
from pharos.benchmark.faults import HEALTHY
from pharos.benchmark.profiles import Profile, deviations
from pharos.benchmark.scores import ConfidenceInterval

MOST_READINGS = 12  # readings in the plot
WIDEST = 8.0  # deviations


def diagnosis_page(diagnosis: Diagnosis) -> str:
    """The HTML page of a diagnosis. Every text passes through the tree, which escapes it."""
    lead = [element("p", diagnosis.verdict, class_="lead")]
    parts = [_findings(diagnosis), _likeness(diagnosis), _profile(diagnosis), _scores(diagnosis)]
    return document(f"Diagnosis of {diagnosis.agent}", lead, [part for part in parts if part is not None])


def _findings(diagnosis: Diagnosis) -> Element | None:
    if not diagnosis.findings:
        return None
    rows = [[str(k), each.wrong, each.advice] for k, each in enumerate(diagnosis.findings, start=1)]
    table = element("div", html_table(["", "what is wrong", "what to try"], rows), class_="words")
    return section("What no healthy agent shows", "", table)


def _likeness(diagnosis: Diagnosis) -> Element | None:
    if not diagnosis.likeness:
        return None
    rows = [[f"{share:.2f}", name, text] for name, share, text in diagnosis.nearest()]
    table = element("div", html_table(["likeness", "fault", ""], rows), class_="words")
    return section("Nearest known agents", diagnosis.how_often, table)


def _profile(diagnosis: Diagnosis) -> Element | None:
    """The readings that set the agent apart, in deviations from healthy ones, beside the two nearest faults."""
    if not diagnosis.likeness:
        return None
    faults = [name for name in diagnosis.likeness if name != HEALTHY][:2]
    names, rows = profile_rows(diagnosis.readings, diagnosis.library, faults)
    return section(
        "Beside the nearest known agents",
        f"The {len(names)} readings (of `--json`) in which it, or one of them, differs most from healthy agents: 0 is "
        f"their mean, the unit is the deviation within faults, and differences of more than {WIDEST:g} end at the "
        f"edge. Between the two lines at -2 and 2 most healthy agents are.",
        legend([diagnosis.agent, *faults]),
        captioned("", _dots(names, rows, [diagnosis.agent, *faults]), class_="wide"),
    )


def profile_rows(
    numbers: Mapping[str, float], library: list[Profile], faults: list[str]
) -> tuple[list[str], list[tuple[float, ...]]]:
    """Names of the readings in which an agent, or one of some faults, differs most from healthy ones, and how much.

    Each row: the agent, then the faults, in deviations from the mean of healthy ones.
    """
    away = deviations(numbers, library)
    own = away.rows[away.faults.index(HEALTHY)]
    columns = np.array([own, *(own - away.rows[away.faults.index(fault)] for fault in faults)])
    order = np.argsort(-np.abs(np.clip(columns, -WIDEST, WIDEST)).sum(axis=0), kind="stable")[:MOST_READINGS]
    return [away.names[k] for k in order], [tuple(map(float, columns[:, k])) for k in order]


def _dots(names: list[str], rows: list[tuple[float, ...]], agents: list[str]) -> Element:
    """Rows of markers, one for each agent."""
    left, right, step, top = 150, 540, 24, 20
    bottom = top + step * len(names)

    def across(x: float) -> float:
        return left + (right - left) * (min(max(x, -WIDEST), WIDEST) + WIDEST) / (2 * WIDEST)

    shapes = [line(across(x), top - 6, across(x), bottom, "edge" if x == 0 else "grid") for x in (-8, -2, 0, 2, 8)]
    shapes += [label(across(x), bottom + 15, f"{x:g}", "middle", "faint") for x in (-8, -2, 0, 2, 8)]
    for k, (name, row) in enumerate(zip(names, rows, strict=True)):
        y = top + step * k + step / 2
        shapes += [line(left, y, right, y, "grid"), label(left - 8, y + 4, name.replace("_", " "), "end")]
        for series, x in reversed(list(enumerate(row))):
            shapes.append(marker(across(x), y, series, f"{agents[series]}, {name}: {x:+.1f} deviations"))
    return drawing(560, bottom + 20, "deviations from healthy agents", *shapes)


def _scores(diagnosis: Diagnosis) -> Element:
    if not diagnosis.readings:
        cells = [[name, f"{score:.2f}"] for name, score in diagnosis.scores.items()]
        table = element("details", element("summary", "Task by task"), html_table(["task", "score"], cells, [1]))
        mean = f"{diagnosis.score:.2f} on the average task; 1 is optimal, 0 is uniform play."
        return section("Scores", mean, table)
    nan = float("nan")
    rows = {
        6 * k: (name, ConfidenceInterval(max(score, 0.0), nan, nan))  # all in the first colour
        for k, (name, score) in enumerate(diagnosis.scores.items())
    }
    picture = captioned("", bars(rows, "scores"))
    return section("Scores", "1 is optimal, 0 is uniform play; lower ones are drawn as 0.", picture)
