"""Curves over steps or scores, as numbers: what figures draw, and what the page shows where one points at it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import TABULAR_OBSERVATION
from pharos.plots import agent_name, observation_color, slug
from pharos.study.analysis import IMAGE, VECTOR, mean_curve
from pharos.system.wording import in_words

if TYPE_CHECKING:
    import pandas as pd

LINES = {"q_learning": "-", "dqn": "-", "ppo": "--"}
OBSERVATIONS = {TABULAR_OBSERVATION: "", VECTOR: "vector", IMAGE: "image"}
# More lines of runs than this are not told apart in one panel: the page does not offer them
MOST_RUNS = 120
# Significant digits of the numbers in the page
DIGITS = 5


@dataclass(frozen=True)
class Line:
    """One line of a panel.

    Attributes:
        label: in words, `DQN, image`.
        color, dash: `#0072B2`; as matplotlib writes it, such as `--`.
        x: (T,) where it is known; mean, lower, upper: (T,) the line and the ends of its interval.
        runs: what each run is called -> (T,) its values.
    """

    label: str
    color: str
    dash: str
    x: np.ndarray
    mean: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    runs: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Panel:
    """One pair of axes: its title and its lines."""

    title: str
    lines: Sequence[Line]


@dataclass(frozen=True)
class Curves:
    """A figure of panels that share their axes' meaning.

    Attributes:
        share: values are shares in [0, 1], over scores; else they are over steps, and start at 0.
        draws_runs: whether the printed figure has a thin line for each run.
    """

    panels: Sequence[Panel]
    x_label: str
    y_label: str
    share: bool = False
    draws_runs: bool = False

    def to_json(self) -> str:
        """What the page needs to draw them: numbers of DIGITS digits; runs where there are at most MOST_RUNS."""
        panels = []
        for panel in self.panels:
            num_runs = sum(len(line.runs) for line in panel.lines)
            panels.append(
                {"title": panel.title, "lines": [_numbers(line, num_runs <= MOST_RUNS) for line in panel.lines]}
            )
        about = {"x": self.x_label, "y": self.y_label, "share": self.share, "runs": self.draws_runs}
        return json.dumps({**about, "panels": panels}, separators=(",", ":"), allow_nan=False)


def _numbers(line: Line, runs: bool) -> dict[str, Any]:
    values = {name: _short(getattr(line, name)) for name in ("x", "mean", "lower", "upper")}
    each = {name: _short(run) for name, run in line.runs.items()} if runs else {}
    return {"label": line.label, "color": line.color, "dash": line.dash, **values, "runs": each}


def _short(values: np.ndarray) -> list[float | int | None]:
    """The values with DIGITS significant digits, whole ones as integers; null for what is not finite."""
    texts = [f"{value:.{DIGITS}g}" if np.isfinite(value) else "null" for value in np.asarray(values, np.float64)]
    return [None if text == "null" else int(float(text)) if float(text).is_integer() else float(text) for text in texts]


def label(agent: str, observation: str) -> str:
    """`DQN, image`, `tabular Q-learning`."""
    words = OBSERVATIONS.get(observation, observation)
    return f"{agent_name(agent)}, {words}" if words else agent_name(agent)


def regret_curves(
    points: "pd.DataFrame", *, by: str | list[str] = "environment", draws_runs: bool = False, resamples: int = 500
) -> Curves:
    """Cumulative expected regret by steps: a panel for each class (or instance, or task), a line for each agent and
    observation.

    The mean over instances and kinds of chance, with its 95 % bootstrap interval over runs. The paper's figure 2.
    """
    panels, observations = [], list(dict.fromkeys(points["observation"]))
    for name, part in points.groupby(by, sort=False):
        drawn = []
        for (agent, observation), each in part.groupby(["agent", "observation"], sort=True):
            steps, tasks, runs = same_steps(each)
            mean, lower, upper = mean_curve(tasks, resamples=resamples)
            color = observation_color(observation, observations)
            words, dash = label(agent, observation), LINES.get(agent, ":")
            drawn.append(Line(words, color, dash, steps, mean, lower, upper, runs))
        text = name if isinstance(name, str) else ", ".join(map(str, name))
        panels.append(Panel(in_words(text), drawn))
    return Curves(panels, "steps", "cumulative regret", draws_runs=draws_runs)


def same_steps(points: "pd.DataFrame") -> tuple[np.ndarray, list[np.ndarray], dict[str, np.ndarray]]:
    """Steps, for each task the cumulative regret (runs, T) there, and that of each run by its name, of the runs that
    were evaluated at the same steps.

    Where blocks of a study differ in steps, those are the steps that most runs have.
    """
    by_run = points.pivot_table(index=["instance", "chance", "id"], columns="step", values="cumulative_expected_regret")
    present = by_run.notna()
    kinds = present.apply(lambda row: row.to_numpy().tobytes(), axis=1)
    same = kinds == kinds.mode().iloc[0]
    by_run = by_run.loc[same, present[same].all()]
    tasks = [group.to_numpy() for _, group in by_run.groupby(level=["instance", "chance"], sort=True)]
    seeds = points.groupby("id")["seed"].first() if "seed" in points else {}
    runs = {}
    for instance, chance, id in by_run.index:
        text = f"seed {seeds[id]}" if id in seeds else id
        runs[f"{instance}, {chance}, {text}"] = by_run.loc[(instance, chance, id)].to_numpy()
    return by_run.columns.to_numpy(), tasks, runs


def performance_profiles(profiles: "pd.DataFrame") -> Curves:
    """A panel for each class: the share of runs above each score, a line for each agent and observation."""
    panels, observations = [], list(dict.fromkeys(profiles["observation"]))
    for name, part in profiles.groupby("environment", sort=False):
        drawn = []
        for (agent, observation), line in part.groupby(["agent", "observation"], sort=True):
            color = observation_color(observation, observations)
            values = (line[column].to_numpy(np.float64) for column in ("score", "share", "lower", "upper"))
            drawn.append(Line(label(agent, observation), color, LINES.get(agent, ":"), *values))
        panels.append(Panel(in_words(str(name)), drawn))
    return Curves(panels, "score: 1 - normalised regret", "share of runs above it", share=True)


def all_curves(points: "pd.DataFrame", profiles: "pd.DataFrame") -> dict[str, Curves]:
    """Name of the figure -> its curves."""
    curves = {"regret": regret_curves(points), "regret_by_instance": regret_curves(points, by="instance")}
    curves["profiles"] = performance_profiles(profiles)
    for environment, part in points.groupby("environment", sort=False):
        by_task = regret_curves(part, by=["instance", "chance"], draws_runs=True, resamples=200)
        curves[f"regret_by_task_{slug(str(environment))}"] = by_task
    return curves
