"""Regret: curves of training runs, and predictions.

Curves: what the learnt policy loses, and what was lost on the way. Predicted regret: bars of one instance.
"""

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import agent_called
from pharos.environments import class_called, instance_name
from pharos.errors import ParameterError
from pharos.observations import title
from pharos.plots.style import (
    GRID_COLOR,
    INK_COLOR,
    LINE_COLORS,
    legend_below,
    panels,
    single,
    styled,
    thousands,
)
from pharos.regret import regret_scale
from pharos.statistics import bootstrap_interval
from pharos.system.wording import in_words
from pharos.training import GAIN_TOLERANCE, read_curve, read_record

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pharos.prediction import Prediction


# The class of imported MDPs, which has no parameters but its folder
IMPORTED = "imported"
# Columns that are drawn: normalised and not, of the policy so far; and summed
EPISODE_COLUMNS = ("normalized_regret", "expected_regret", "cumulative_realised_regret")
AVERAGE_REGRET_COLUMNS = ("normalized_average_regret", "average_regret", "cumulative_average_regret")
# Two labels up to this long stand beside each other
MOST_LABEL_LETTERS = 60


@styled
def regret(
    folders: Sequence[str | os.PathLike],
    *,
    confidence: float = 0.95,
    resamples: int = 1000,
    axes: Sequence[Any] | None = None,
) -> "Figure":
    """Draw the regret of runs over their steps. Runs that differ in the seed alone are one line with an interval.

    Left, the normalised expected regret of the policy learnt so far: 0 is optimal, 1 is playing at random (in units of
    return if playing at random is optimal in one of the tasks). Right, the cumulative realised regret of all
    episodes played, exploration included. A dotted line is what playing at random would have cost in as many episodes.
    If all runs measure the average reward of a step in the long run, both are of the average regret of the policies
    learnt: left a step, right summed over the steps.

    Args:
        folders: of finished runs, on any number of tasks.
        confidence, resamples: of the bootstrap interval of the mean over seeds (percentile).
        axes: two axes to draw on. Default: a new figure.
    Raises:
        FileFormatError: a folder holds no finished run. ParameterError: no folder is given.
    """
    if not folders:
        raise ParameterError("no runs to draw; give at least one folder of a finished run")
    groups = _groups(folders)
    left, right = axes if axes is not None else panels(2, 4.6, 3.5)[1]
    curves = [curve for runs in groups.values() for _, curve in runs]
    average = all("average_regret" in curve for curve in curves)
    normalized, column, summed = AVERAGE_REGRET_COLUMNS if average else EPISODE_COLUMNS
    relative = not any(np.isnan(curve[normalized]).any() for curve in curves)
    column = normalized if relative else column
    for number, (label, runs) in enumerate(groups.items()):
        color = LINE_COLORS[number % len(LINE_COLORS)]
        _line(left, *_aligned(runs, column), color, label, confidence, resamples)
        steps, losses = _aligned(runs, summed)
        _line(right, steps, losses, color, label, confidence, resamples)
        spread = np.array([[_spread(record["result"], average)] for record, _ in runs])
        random = ((steps if average else _aligned(runs, "episodes")[1]) * spread).mean(axis=0)
        right.plot(steps, random, ":", color=color, linewidth=1.2)
    if relative:
        left.axhline(1, color=INK_COLOR, linewidth=0.8, linestyle=":")
    is_infinite = any(np.isinf(curve[column]).any() for curve in curves)  # a total reward of a policy without end
    title_left = "policy learnt so far" + " (gaps: infinite)" * is_infinite
    left.set(title=title_left, xlabel="steps", ylabel=in_words(column), xlim=right.get_xlim())
    left.set_ylim(bottom=min(0.0, left.get_ylim()[0]))
    right.set(title="all steps" if average else "all episodes played", xlabel="steps", ylabel=in_words(summed))
    for axis in (left, right):
        axis.xaxis.set_major_formatter(thousands)
    right.yaxis.set_major_formatter(thousands)
    right.plot([], [], ":", color=INK_COLOR, linewidth=1.2, label="at random")
    if axes is None:
        legend_below(
            left.figure, [right], 2 if max(map(len, right.get_legend_handles_labels()[1])) <= MOST_LABEL_LETTERS else 1
        )
    else:
        right.legend(loc="best")
    return left.figure


def _groups(folders: Sequence[str | os.PathLike]) -> dict[str, list[tuple[dict[str, Any], Any]]]:
    """label -> [(record, curve)]: the runs that differ in the seed alone."""
    groups: dict[str, list[tuple[dict[str, Any], Any]]] = {}
    for folder in folders:
        record = read_record(folder)
        key = json.dumps({**record["config"], "seed": None}, sort_keys=True)
        groups.setdefault(key, []).append((record, _with_averages(read_curve(folder), record["result"])))
    configs = [runs[0][0]["config"] for runs in groups.values()]
    return dict(zip(_labels(configs), groups.values(), strict=True))


def _spread(result: dict[str, Any], average: bool) -> float:
    """Regret of playing at random, of an episode or of a step in the long run, NaN if it is infinite."""
    if average:
        return (sum(result["optimal_gain_at_start"].values()) - sum(result["uniform_gain_at_start"].values())) / 2
    uniform = result["value_uniform"]
    return math.nan if uniform is None else result["value_optimal"] - uniform


def _with_averages(curve: "pd.DataFrame", result: dict[str, Any]) -> "pd.DataFrame":
    """A curve with the middle of its average regret, the same normalised, and summed over steps, if it has them."""
    if "average_regret_lower" not in curve:
        return curve
    lost = (curve["average_regret_lower"] + curve["average_regret_upper"]) / 2
    total = np.concatenate([[0.0], np.cumsum(np.diff(curve["step"]) * lost.to_numpy()[:-1])])
    columns = (lost / regret_scale(_spread(result, True), 0.0, GAIN_TOLERANCE), lost, total)
    return curve.assign(**dict(zip(AVERAGE_REGRET_COLUMNS, columns, strict=True)))


def _labels(configs: list[dict[str, Any]]) -> list[str]:
    """The label of each group of runs. If two are alike, with discount and horizon, or a number."""
    plain_labels = [_label(config, configs) for config in configs]
    labels: list[str] = []
    for config, label in zip(configs, plain_labels, strict=True):
        if plain_labels.count(label) > 1:
            episode = f"{config['horizon']} steps an episode" if config["horizon"] else "no horizon"
            label += f", discount {config['gamma']:g}, {episode}"
        labels.append(f"{label} ({len(labels) + 1})" if label in labels else label)
    return labels


def _label(config: dict[str, Any], configs: list[dict[str, Any]]) -> str:
    """Label of a group of runs: agent, environment, steps, and the settings that differ from other groups."""

    def differ(*keys: str) -> bool:
        return any(len({json.dumps(other[key], sort_keys=True) for other in configs}) > 1 for key in keys)

    agent = agent_called(config["agent"])
    observation = title(config["observation"], config.get("observation_options", {})).replace("_", " ")
    is_shown = observation and agent.fixed_observation is None
    who = agent.title.removeprefix("tabular ") + (f" ({observation})" if is_shown else "")
    parts = [f"{who} on {_in_words(config)}", f"{_spaced(config['steps'])} steps"]
    if differ("chance"):
        knobs = {name: p if isinstance(p, str) else f"{p:g}" for name, p in config["chance"].items() if p}
        parts.append(" ".join(f"{name}={p}" for name, p in knobs.items()) or "no chance")
    if differ("hyperparameters"):
        hyperparameters = config["hyperparameters"]
        parts.append(" ".join(f"{name}={hyperparameters[name]}" for name in hyperparameters if _varies(name, configs)))
    return ", ".join(part for part in parts if part)


def _in_words(config: dict[str, Any]) -> str:
    """`Frozen lake 8x8`. For an imported MDP, the name of its folder."""
    if config["environment"] == IMPORTED:
        return Path(config["parameters"]["folder"]).name
    name, *setting = instance_name(config["environment"], config["parameters"]).split(" ")
    if class_called(config["environment"]) is not None:
        name = name.replace("_", " ").replace("/", " ")
        name = name[:1].upper() + name[1:]
    return " ".join([name, *setting])


def _spaced(steps: int) -> str:
    """`300 k`."""
    text = thousands(steps)
    return f"{text[:-1]} {text[-1]}" if text[-1].isalpha() else text


def _varies(name: str, configs: list[dict[str, Any]]) -> bool:
    """Whether a hyperparameter differs between runs of the same agent."""
    by_agent: dict[str, set[str]] = {}
    for config in configs:
        value = json.dumps(config["hyperparameters"].get(name))
        by_agent.setdefault(config["agent"], set()).add(value)
    return any(len(values) > 1 for values in by_agent.values())


def _aligned(runs: list[tuple[dict[str, Any], Any]], column: str) -> tuple[np.ndarray, np.ndarray]:
    """(steps (N,), values (runs, N)) at the steps that all runs have."""
    steps = runs[0][1]["step"].to_numpy()
    for _, curve in runs[1:]:
        steps = np.intersect1d(steps, curve["step"].to_numpy())
    if not len(steps):
        raise ParameterError("curves of one setting have no evaluated step in common; give these runs one by one")
    return steps, np.stack([curve.set_index("step")[column].loc[steps].to_numpy(float) for _, curve in runs])


def _line(
    axis: "Axes", steps: np.ndarray, values: np.ndarray, color: str, label: str, confidence: float, resamples: int
) -> None:
    axis.plot(steps, values.mean(axis=0), color=color, label=label)
    if len(values) > 1:
        low, high = bootstrap_interval([values.T], np.mean, confidence=confidence, resamples=resamples)
        axis.fill_between(steps, low, high, color=color, alpha=0.18, linewidth=0)


# Predictions ----------------------------------------------------------------------------------------------------------


@styled
def predictions(prediction: "Prediction", *, axes: "Axes | None" = None) -> "Figure":
    """Draw a bar for each observation and network, from 0 (optimal) towards 1 (uniform play), with its interval.

    Args:
        axes: matplotlib axes to draw on. Default: a new figure.
    """
    cells = prediction.cells
    drawn, axis = single(axes, (6.4, 1.1 + 0.42 * len(cells)))
    rows = range(len(cells))
    same_network = len({cell.network for cell in cells}) == 1
    axis.barh(rows, [cell.value for cell in cells], color=LINE_COLORS[0], height=0.55)
    ends = [[cell.value - cell.low for cell in cells], [cell.high - cell.value for cell in cells]]
    axis.errorbar(
        [cell.value for cell in cells], rows, xerr=ends, fmt="none", ecolor=INK_COLOR, capsize=3, linewidth=1.2
    )
    axis.axvline(1.0, color=INK_COLOR, linewidth=1, linestyle=(0, (4, 3)))
    right = max(1.15, *(cell.high + 0.05 for cell in cells))
    axis.set(
        yticks=list(rows),
        yticklabels=[cell.observation if same_network else cell.label for cell in cells],
        xlim=(0, right),
        xlabel=f"predicted regret of {prediction.agent.upper()} after {prediction.steps:,} steps"
        "  (0: optimal, 1: uniform play)",
        title=f"{prediction.environment}, {prediction.chance}",
    )
    axis.grid(axis="y", visible=False)
    axis.grid(axis="x", color=GRID_COLOR)
    axis.invert_yaxis()
    return drawn
