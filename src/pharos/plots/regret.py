"""Regret: curves of training runs, and predictions.

Curves: what the learnt policy loses, and what was lost on the way. Predicted regret: bars of one instance; of a study
by class, by observation of an MDP, and beside its curves.
"""

import json
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import agent_called
from pharos.environments import class_called, instance_name
from pharos.errors import ParameterError
from pharos.observations import title
from pharos.plots.style import (
    COLORS,
    DIAGONAL,
    GRID,
    INK,
    agent_name,
    label_edges,
    legend_below,
    observation_color,
    panels,
    single,
    slug,
    styled,
    thousands,
)
from pharos.system.wording import in_words
from pharos.training import CELL, bootstrap_interval, read_curve, read_record

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pharos.validation import Prediction


# The class of imported MDPs, which has no parameters but its folder
IMPORTED = "imported"
# Two labels up to this long stand beside each other
WIDE = 60


@styled
def regret(
    folders: Sequence[str | os.PathLike],
    *,
    confidence: float = 0.95,
    resamples: int = 1000,
    axes: Sequence[Any] | None = None,
) -> "Figure":
    """Draw the regret of runs over their steps; runs that differ in the seed alone are one line with an interval.

    Left, the normalised expected regret of the policy learnt so far: 0 is optimal, 1 is playing at random (in units of
    return where playing at random is optimal in one of the tasks). Right, the cumulative realised regret of all
    episodes played, exploration included; a dotted line is what playing at random would have cost in as many episodes.

    Args:
        folders: of finished runs, on any number of tasks.
        confidence, resamples: of the bootstrap interval of the mean over seeds (percentile).
        axes: two axes to draw on; None for a new figure.
    Raises:
        FileFormatError: a folder holds no finished run. ParameterError: no folder is given.
    """
    if not folders:
        raise ParameterError("no runs to draw; give at least one folder of a finished run")
    groups = _groups(folders)
    left, right = axes if axes is not None else panels(2, 4.6, 3.5)[1]
    relative = not any(np.isnan(curve["normalized_regret"]).any() for runs in groups.values() for _, curve in runs)
    column = "normalized_regret" if relative else "expected_regret"
    for number, (label, runs) in enumerate(groups.items()):
        color = COLORS[number % len(COLORS)]
        steps, normalized = _aligned(runs, column)
        _line(left, steps, normalized, color, label, confidence, resamples)
        steps, realised = _aligned(runs, "cumulative_realised_regret")
        _line(right, steps, realised, color, label, confidence, resamples)
        spread = np.array(
            [[record["result"]["value_optimal"] - record["result"]["value_uniform"]] for record, _ in runs]
        )
        random = (_aligned(runs, "episodes")[1] * spread).mean(axis=0)
        right.plot(steps, random, ":", color=color, linewidth=1.2)
    if relative:
        left.axhline(1, color=INK, linewidth=0.8, linestyle=":")
    left.set(title="policy learnt so far", xlabel="steps", ylabel=in_words(column))
    left.set_ylim(bottom=min(0.0, left.get_ylim()[0]))
    right.set(title="all episodes played", xlabel="steps", ylabel="cumulative realised regret")
    for axis in (left, right):
        axis.xaxis.set_major_formatter(thousands)
    right.yaxis.set_major_formatter(thousands)
    right.plot([], [], ":", color=INK, linewidth=1.2, label="at random")
    if axes is None:
        legend_below(left.figure, [right], 2 if max(map(len, right.get_legend_handles_labels()[1])) <= WIDE else 1)
    else:
        right.legend(loc="best")
    return left.figure


def _groups(folders: Sequence[str | os.PathLike]) -> dict[str, list[tuple[dict[str, Any], Any]]]:
    """label -> [(record, curve)]: the runs that differ in the seed alone."""
    groups: dict[str, list[tuple[dict[str, Any], Any]]] = {}
    for folder in folders:
        record = read_record(folder)
        key = json.dumps({**record["config"], "seed": None}, sort_keys=True)
        groups.setdefault(key, []).append((record, read_curve(folder)))
    configs = [runs[0][0]["config"] for runs in groups.values()]
    return dict(zip(_labels(configs), groups.values(), strict=True))


def _labels(configs: list[dict[str, Any]]) -> list[str]:
    """The label of each group of runs; where two are alike, with discount and horizon, or a number."""
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
        parts.append(" ".join(f"{name}={p:g}" for name, p in config["chance"].items() if p) or "no chance")
    if differ("hyperparameters"):
        hyperparameters = config["hyperparameters"]
        parts.append(" ".join(f"{name}={hyperparameters[name]}" for name in hyperparameters if _varies(name, configs)))
    return ", ".join(part for part in parts if part)


def _in_words(config: dict[str, Any]) -> str:
    """`Frozen lake 8x8`; of an imported MDP the name of its folder."""
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
    return steps, np.stack([curve.set_index("step")[column].loc[steps].to_numpy(float) for _, curve in runs])


def _line(
    axis: "Axes", steps: np.ndarray, values: np.ndarray, color: str, label: str, confidence: float, resamples: int
) -> None:
    axis.plot(steps, values.mean(axis=0), color=color, label=label)
    if len(values) > 1:
        low, high = bootstrap_interval([values.T], np.mean, confidence=confidence, resamples=resamples)
        axis.fill_between(steps, low, high, color=color, alpha=0.18, linewidth=0)


# Predictions ----------------------------------------------------------------------------------------------------------


MOST_PANELS = 24
# Predictors and curves of the idealised learners; the first that there is counts.
LEARNERS = ("clipped_regret_evaluated", "policy_regret", "kernel_regret")
CURVES = ("clipped_curve", "policy_curve", "curve")
LONGEST_TITLE = 34


@styled
def predictions(prediction: "Prediction", *, axes: "Axes | None" = None) -> "Figure":
    """Draw a bar for each observation and network, from 0 (optimal) towards 1 (uniform play), with its interval.

    Args:
        axes: where to draw; None for a new figure.
    """
    cells = prediction.cells
    drawn, axis = single(axes, (6.4, 1.1 + 0.42 * len(cells)))
    rows = range(len(cells))
    same_network = len({cell.network for cell in cells}) == 1
    axis.barh(rows, [cell.value for cell in cells], color=COLORS[0], height=0.55)
    ends = [[cell.value - cell.low for cell in cells], [cell.high - cell.value for cell in cells]]
    axis.errorbar([cell.value for cell in cells], rows, xerr=ends, fmt="none", ecolor=INK, capsize=3, linewidth=1.2)
    axis.axvline(1.0, color=INK, linewidth=1, linestyle=(0, (4, 3)))
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
    axis.grid(axis="x", color=GRID)
    axis.invert_yaxis()
    return drawn


def unseen_figures(
    predictions: "pd.DataFrame", cells: "pd.DataFrame", points: "pd.DataFrame"
) -> dict[str, Callable[[], "Figure | None"]]:
    """Name -> function that draws it, three for each agent that has predictions.

    Args:
        predictions: of `predict`. cells: of `outcomes`. points: of `curves`.
    """
    both = predictions.merge(cells, on=CELL, how="inner")
    drawn: dict[str, Callable[[], Figure | None]] = {}
    for agent, part in both.groupby("agent", sort=False):
        name = slug(str(agent))
        drawn[f"predicted_by_class_{name}"] = partial(predicted_by_class, part)
        drawn[f"observations_of_mdps_{name}"] = partial(observations_of_mdps, part)
        drawn[f"idealised_curves_{name}"] = partial(idealised_curves, part, points)
    return drawn


def predicted_by_class(part: "pd.DataFrame", predictor: str | None = None) -> "Figure | None":
    """A panel for each class: regret against the prediction by a line through the other classes."""
    from pharos.validation import Cells, class_predictions

    predictor = predictor or _learner(part)
    cells = Cells.of(part, [predictor], "greedy")
    if len(np.unique(cells.classes)) < 2:
        return None
    frame = cells.frame.assign(predicted=class_predictions(cells.x, cells.y, cells.classes, cells.classes))
    observations = list(dict.fromkeys(frame["observation"]))
    groups = list(frame.groupby("environment", sort=False))
    figure, axes = panels(len(groups), 2.3, 2.3)
    low, high = min(0.0, frame[["predicted", "greedy"]].min().min()), frame[["predicted", "greedy"]].max().max()
    for axis, (name, rows) in zip(axes, groups, strict=True):
        others = frame[frame["environment"] != name]
        axis.scatter(others["predicted"], others["greedy"], s=5, color=DIAGONAL, alpha=0.25, lw=0)
        for observation, some in rows.groupby("observation", sort=False):
            color = observation_color(str(observation), observations)
            axis.scatter(some["predicted"], some["greedy"], s=30, color=color, alpha=0.9, lw=0, label=str(observation))
        axis.plot([low, high], [low, high], ":", color=DIAGONAL, lw=1.2)
        axis.set_title(in_words(str(name)))
        axis.set(xlim=(low - 0.05, high + 0.05), ylim=(low - 0.05, high + 0.05))
    label_edges(axes, "predicted regret", f"regret of {agent_name(str(part['agent'].iloc[0]))}")
    legend_below(figure, axes)
    return figure


def observations_of_mdps(part: "pd.DataFrame", predictor: str | None = None) -> "Figure | None":
    """A panel for each MDP, up to MOST_PANELS: regret under each observation, of the agent and as predicted."""
    predictor = predictor or _learner(part)
    observations = list(dict.fromkeys(part["observation"]))
    groups = [
        (key, rows) for key, rows in part.groupby(["environment", "instance", "chance"], sort=False) if len(rows) > 1
    ]
    if len(observations) < 2 or not groups:
        return None
    groups = _spread(groups)
    figure, axes = panels(len(groups), 2.3, 1.9)
    top = max(1.0, part[[predictor, "greedy"]].max().max())
    for axis, (key, rows) in zip(axes, groups, strict=True):
        rows = rows.set_index("observation").reindex(observations)
        places = np.arange(len(observations))
        for i, observation in enumerate(observations):
            color = observation_color(observation, observations)
            pair = rows[[predictor, "greedy"]].iloc[i].to_numpy(float)
            axis.plot([i, i], pair, color=color, lw=1.2, alpha=0.7)
            axis.scatter([i], pair[:1], s=34, facecolors="none", edgecolors=color, lw=1.4)
            axis.scatter([i], pair[1:], s=34, color=color, lw=0, label=observation)
        axis.set_title(_short(*map(str, key)), fontsize=8)
        axis.set(xticks=places, xticklabels=[], ylim=(-0.05, top + 0.08), xlim=(-0.6, len(observations) - 0.4))
    hollow, full = {"facecolors": "none", "edgecolors": DIAGONAL}, {"color": DIAGONAL}
    axes[0].scatter([], [], s=34, lw=1.4, label="predicted", **hollow)
    axes[0].scatter([], [], s=34, lw=0, label=agent_name(str(part["agent"].iloc[0])), **full)
    label_edges(axes, "", "regret")
    legend_below(figure, axes)
    return figure


def idealised_curves(part: "pd.DataFrame", points: "pd.DataFrame") -> "Figure | None":
    """A panel for each MDP, up to MOST_PANELS / 2: regret by steps of the agent and of the idealised learner."""
    curve = next((name for name in CURVES if name in part and part[name].fillna("").astype(bool).any()), None)
    if curve is None:
        return None
    observations = list(dict.fromkeys(part["observation"]))
    groups = _spread(list(part.groupby(["environment", "instance", "chance"], sort=False)), MOST_PANELS // 2)
    figure, axes = panels(len(groups), 3.0, 2.2)
    for axis, (key, rows) in zip(axes, groups, strict=True):
        for row in rows.to_dict("records"):
            color = observation_color(row["observation"], observations)
            curve_points = points[(points[CELL] == [row[name] for name in CELL]).all(axis=1)]
            mean = curve_points.groupby("step")["normalized_regret"].mean()
            axis.plot(mean.index, mean.to_numpy(), color=color, lw=1.5, label=row["observation"])
            dashed = json.loads(row[curve] or "[]")
            if dashed:
                axis.plot(*zip(*dashed, strict=True), "--", color=color, lw=1.2, alpha=0.9)
        axis.set_title(_short(*map(str, key)), fontsize=8)
        axis.set(ylim=(-0.05, 1.5))
    axes[0].plot([], [], "--", color=DIAGONAL, lw=1.2, label="idealised learner")
    axes[0].plot([], [], color=DIAGONAL, lw=1.5, label=agent_name(str(part["agent"].iloc[0])))
    label_edges(axes, "steps", "regret")
    legend_below(figure, axes)
    return figure


def _learner(part: "pd.DataFrame") -> str:
    """The predictor that an agent is held against."""
    has = (name for name in LEARNERS if name in part and part[name].notna().any())
    return next(has, LEARNERS[-1])


def _spread(groups: list[Any], max_panels: int = MOST_PANELS) -> list[Any]:
    """Up to `max_panels` groups, taken from each class in turn, in their original order."""
    if len(groups) <= max_panels:
        return groups
    by_class: dict[str, list[int]] = {}
    for i, (key, _) in enumerate(groups):
        by_class.setdefault(key[0], []).append(i)
    turns = sorted((turn, i) for rows in by_class.values() for turn, i in enumerate(rows))
    return [groups[i] for i in sorted(i for _, i in turns[:max_panels])]


def _short(environment: str, instance: str, chance: str) -> str:
    """`taxi: size 7`, with the chance, where there is some, in a line of its own."""
    inside = instance[instance.find("(") + 1 : -1] if instance.endswith(")") else instance.partition("/")[2] or instance
    first, *others = [part.strip().replace("=", " ").replace("_", " ") for part in inside.split(",")]
    text = f"{in_words(environment)}: {first}"
    for word in others:
        if len(text) + len(word) > LONGEST_TITLE:
            break
        text += f", {word}"
    return text + ("" if chance == "plain" else f"\n{chance}")
