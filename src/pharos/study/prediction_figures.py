"""Figures of predicted regret in a study: by class, by observation of an MDP, and beside the curves of its runs."""

import json
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.plots import DIAGONAL, agent_label, label_edges, legend_below, observation_color, panels, slug
from pharos.system.wording import in_words
from pharos.training import CELL

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

MOST_PANELS = 24
# Predictors and curves of the idealised learners; the first that there is counts.
LEARNER_COLUMNS = (
    *("network_policy_regret", "network_regret"),
    *("clipped_regret_evaluated", "policy_regret", "kernel_regret"),
)
CURVES = ("network_curve", "clipped_curve", "policy_curve", "curve")
LONGEST_TITLE = 34


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


def predicted_by_class(part: "pd.DataFrame") -> "Figure | None":
    """A panel for each class: regret against the prediction by a line through the other classes."""
    from pharos.study.cross_validation import class_predictions
    from pharos.study.leave_one_class_out import Cells

    predictor = _learner(part)
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
    label_edges(axes, "predicted regret", f"regret of {agent_label(str(part['agent'].iloc[0]))}")
    legend_below(figure, axes)
    return figure


def observations_of_mdps(part: "pd.DataFrame") -> "Figure | None":
    """A panel for each MDP, up to MOST_PANELS: regret under each observation, of the agent and as predicted."""
    predictor = _learner(part)
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
        ticks = np.arange(len(observations))
        for i, observation in enumerate(observations):
            color = observation_color(observation, observations)
            pair = rows[[predictor, "greedy"]].iloc[i].to_numpy(float)
            axis.plot([i, i], pair, color=color, lw=1.2, alpha=0.7)
            axis.scatter([i], pair[:1], s=34, facecolors="none", edgecolors=color, lw=1.4)
            axis.scatter([i], pair[1:], s=34, color=color, lw=0, label=observation)
        axis.set_title(_short(*map(str, key)), fontsize=8)
        axis.set(xticks=ticks, xticklabels=[], ylim=(-0.05, top + 0.08), xlim=(-0.6, len(observations) - 0.4))
    hollow, full = {"facecolors": "none", "edgecolors": DIAGONAL}, {"color": DIAGONAL}
    axes[0].scatter([], [], s=34, lw=1.4, label="predicted", **hollow)
    axes[0].scatter([], [], s=34, lw=0, label=agent_label(str(part["agent"].iloc[0])), **full)
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
    axes[0].plot([], [], color=DIAGONAL, lw=1.5, label=agent_label(str(part["agent"].iloc[0])))
    label_edges(axes, "steps", "regret")
    legend_below(figure, axes)
    return figure


def _learner(part: "pd.DataFrame") -> str:
    """The predictor that an agent is held against."""
    has = (name for name in LEARNER_COLUMNS if name in part and part[name].notna().any())
    return next(has, LEARNER_COLUMNS[-1])


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
    """`taxi: size 7`, with the chance, if there is some, in a separate line."""
    inside = instance[instance.find("(") + 1 : -1] if instance.endswith(")") else instance.partition("/")[2] or instance
    first, *others = [part.strip().replace("=", " ").replace("_", " ") for part in inside.split(",")]
    text = f"{in_words(environment)}: {first}"
    for word in others:
        if len(text) + len(word) > LONGEST_TITLE:
            break
        text += f", {word}"
    return text + ("" if chance == "plain" else f"\n{chance}")
