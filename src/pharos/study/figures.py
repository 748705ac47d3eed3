"""The figures of a study, each a function of tables: matplotlib figures without global state, light or dark."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pharos.environments import classes
from pharos.plots import DIAGONAL, agent_name, color_among, label_edges, legend_below, panels, slug, thousands
from pharos.study.analysis import IMAGE, REGRETS, VECTOR, Models
from pharos.study.curves import Curves
from pharos.study.regression import Fit
from pharos.system.wording import in_words
from pharos.training import CELL

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

CHANCE_MARKERS = {"plain": "o", "random": "^", "sticky": "s", "lazy": "v", "reward_noise": "P", "reward_delay": "X"}
OTHER_IMAGE = "complex_image"


def lines(curves: Curves) -> "Figure | None":
    """A panel for each group, with a line and its interval for each agent and observation; None without panels."""
    if not curves.panels:
        return None
    figure, axes = panels(len(curves.panels), 3.3, 2.7)
    for axis, panel in zip(axes, curves.panels, strict=False):
        for line in panel.lines:
            axis.plot(line.x, line.mean, line.dash, color=line.color, lw=1.6, label=line.label)
            axis.fill_between(line.x, line.lower, line.upper, color=line.color, alpha=0.18, lw=0)
            for run in line.runs.values() if curves.draws_runs else ():
                axis.plot(line.x, run, line.dash, color=line.color, lw=0.5, alpha=0.5)
        axis.set_title(panel.title)
        if curves.share:
            axis.set_ylim(-0.02, 1.02)
        else:
            axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
            axis.xaxis.set_major_formatter(thousands)
    label_edges(axes, curves.x_label, curves.y_label)
    legend_below(figure, axes)
    return figure


def class_color(name: str, names: Sequence[str]) -> str:
    """The colour of a class of environments among `names`: its own, or one of MORE_COLORS."""
    return color_among(name, names, {other: cls.look.color for other, cls in classes().items() if cls.look.color})


def pairs_of(cells: "pd.DataFrame", agents: Sequence[str]) -> list[tuple[str, str]]:
    """(agent, image) where some task has cells of the agent with that image and with a vector."""
    pairs = []
    for agent in agents:
        own = cells[cells["agent"] == agent]
        wide = own.pivot_table(index=["instance", "chance"], columns="observation", values="normalized_regret")
        for image in (IMAGE, OTHER_IMAGE):
            if {image, VECTOR} <= set(wide.columns) and len(wide[[image, VECTOR]].dropna()):
                pairs.append((agent, image))
    return pairs


def representations_figure(agent: str, image: str) -> str:
    """The name of the figure of `representations`."""
    parts = ["representations", *([] if agent == "dqn" else [slug(agent)]), *([] if image == IMAGE else [slug(image)])]
    return "_".join(parts)


def agents_figure(one: str, two: str) -> str:
    """The name of the figure of two agents."""
    return "agents" if (one, two) == ("dqn", "ppo") else f"agents_{slug(one)}_{slug(two)}"


def representations(cells: "pd.DataFrame", *, agent: str = "dqn", image: str = IMAGE) -> "Figure | None":
    """Normalised regret with a vector against that with an image, a point for each task. The paper's figure 3."""
    words = [f"normalised regret of {agent_name(agent)} with {sight}" for sight in ("an image", "a vector")]
    figure = _against(cells[cells["agent"] == agent], "observation", "normalized_regret", (image, VECTOR), words)
    if figure is not None:
        (axis,) = figure.axes
        high = max(1.0, axis.get_xlim()[1], axis.get_ylim()[1])
        axis.plot([0.0, high], [0.0, high], ":", color=DIAGONAL, lw=1.2)
        axis.set(aspect="equal")
    return figure


def agents_against_each_other(cells: "pd.DataFrame", value: str, agents: tuple[str, str]) -> "Figure | None":
    """The value of one agent against that of another, a point for each task and observation."""
    words = [f"{REGRETS.get(value, value)} of {agent_name(agent)}" for agent in agents]
    return _against(cells, "agent", value, agents, words)


def _against(
    cells: "pd.DataFrame", column: str, value: str, both: tuple[str, str], words: Sequence[str]
) -> "Figure | None":
    """The value with one entry of `column` against that with another; None where no cell has both."""
    index = [name for name in CELL if name != column]
    wide = cells.pivot_table(index=index, columns=column, values=value)
    if not {*both} <= {*wide.columns} or not len(wide := wide[list(both)].dropna().reset_index()):
        return None
    names, chances = list(dict.fromkeys(wide["environment"])), wide["chance"].str.split().str[0]
    figure, (axis,) = panels(1, 4.6, 4.0)
    for (environment, chance), part in wide.groupby(["environment", chances]):
        color, marker = class_color(environment, names), CHANCE_MARKERS.get(chance, "D")
        axis.scatter(part[both[0]], part[both[1]], s=32, color=color, marker=marker, alpha=0.85, lw=0)
    for name in names:
        axis.scatter([], [], color=class_color(name, names), label=in_words(name))
    for chance in dict.fromkeys(chances):
        axis.scatter([], [], color=DIAGONAL, marker=CHANCE_MARKERS.get(chance, "D"), label=chance)
    axis.set(xlabel=words[0], ylabel=words[1])
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def fitted_against_actual(fits: Sequence[Fit], regret: str) -> "Figure":
    """A panel for each fit: what the model gives against what was measured; a perfect model is the dotted diagonal."""
    figure, axes = panels(len(fits), 3.1, 3.0)
    for axis, fit in zip(axes, fits, strict=False):
        names = list(dict.fromkeys(fit.classes)) or [""]
        for name in names:
            points = np.array([other == name for other in fit.classes] or [True] * len(fit.actual))
            color = class_color(name, names)
            axis.scatter(
                fit.actual[points], fit.fitted[points], s=22, color=color, alpha=0.8, lw=0, label=in_words(name)
            )
        both = np.concatenate((fit.actual, fit.fitted))
        low, high = both.min(), both.max()
        axis.plot([low, high], [low, high], ":", color=DIAGONAL, lw=1.2)
        axis.set_title(f"{in_words(fit.subset)}: R² = {fit.r_squared:.2f}, {fit.num_rows} rows")
        axis.xaxis.set_major_formatter(thousands)
        axis.yaxis.set_major_formatter(thousands)
    label_edges(axes, f"actual {regret}", f"fitted {regret}")
    if len({name for fit in fits for name in fit.classes}) > 1:
        legend_below(figure, axes)
    return figure


def all_figures(
    curves: Mapping[str, Curves], cells: "pd.DataFrame", models: Sequence[Models], agents: Sequence[str]
) -> dict[str, Callable[[], "Figure | None"]]:
    """Name -> function that draws it; fits are drawn for the first agent."""
    drawn: dict[str, Callable[[], Figure | None]] = {name: partial(lines, each) for name, each in curves.items()}
    for agent, image in pairs_of(cells, agents):
        drawn[representations_figure(agent, image)] = partial(representations, cells, agent=agent, image=image)
    for each in models:
        if each.agent != models[0].agent:
            continue
        name = each.regret.removesuffix("_regret")
        kinds = {"single": "single_model", "representation": "representation_models", "class": "class_models"}
        for kind, file in kinds.items():
            fits = [fit for fit in each.fits if fit.model == kind]
            drawn[f"{file}_{name}"] = partial(_fits, fits, REGRETS[each.regret])
    for i, one in enumerate(agents):
        for two in agents[i + 1 :]:
            both = partial(agents_against_each_other, cells, "normalized_regret", (one, two))
            drawn[agents_figure(one, two)] = both
    return drawn


def _fits(fits: Sequence[Fit], regret: str) -> "Figure | None":
    return fitted_against_actual(fits, regret) if fits else None
