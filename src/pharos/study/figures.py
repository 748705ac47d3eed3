"""The figures of a study, each a function of tables: matplotlib figures without global state, light or dark."""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import classes
from pharos.study.analysis import IMAGE, REGRETS, VECTOR, Models
from pharos.study.curves import MORE_COLORS, Curves, agent_name, slug, title
from pharos.study.regression import Fit
from pharos.system import storage

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which people tell apart whatever their sight; those of classes stand in their `look`
CHANCE_MARKERS = {"plain": "o", "random": "^", "sticky": "s", "lazy": "v", "reward_noise": "P", "reward_delay": "X"}
OTHER_IMAGE = "complex_image"
DPI = 120


def style(dark: bool) -> dict[str, Any]:
    """Matplotlib settings of a figure."""
    ink, ground, grid = ("#d8dbe2", "#1b1e24", "#3a3f4a") if dark else ("#23262d", "#ffffff", "#dfe2e8")
    return {
        "figure.facecolor": ground, "axes.facecolor": ground, "savefig.facecolor": ground,
        "text.color": ink, "axes.labelcolor": ink, "axes.edgecolor": grid, "xtick.color": ink, "ytick.color": ink,
        "axes.grid": True, "grid.color": grid, "grid.linewidth": 0.6, "axes.axisbelow": True,
        "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False,
        "font.size": 9, "axes.titlesize": 10, "legend.fontsize": 8, "figure.dpi": DPI, "pdf.fonttype": 42,
    }  # fmt: skip


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
        axis.set_xlabel(curves.x_label)
        if curves.share:
            axis.set_ylim(-0.02, 1.02)
        else:
            axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
            axis.xaxis.set_major_formatter(_thousands)
    for axis in axes[:: max(1, _columns(len(axes)))]:
        axis.set_ylabel(curves.y_label)
    legend_below(figure, axes)
    return figure


def class_color(name: str, names: Sequence[str]) -> str:
    """The colour of a class of environments among `names`: its own, or one of MORE_COLORS."""
    own = {other: cls.look.color for other, cls in classes().items() if cls.look.color is not None}
    others = [other for other in names if other not in own]
    return own.get(name) or MORE_COLORS[others.index(name) % len(MORE_COLORS)]


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
    wide = cells[cells["agent"] == agent].pivot_table(
        index=["environment", "instance", "chance"], columns="observation", values="normalized_regret"
    )
    if not {image, VECTOR} <= set(wide.columns):
        return None
    wide = wide[[image, VECTOR]].dropna().reset_index()
    names = list(dict.fromkeys(wide["environment"]))
    figure, (axis,) = panels(1, 4.6, 4.2)
    for (environment, chance), part in wide.groupby(["environment", wide["chance"].str.split().str[0]], sort=True):
        marker = CHANCE_MARKERS.get(chance, "D")
        color = class_color(environment, names)
        axis.scatter(part[image], part[VECTOR], s=34, color=color, marker=marker, alpha=0.85, lw=0)
    low, high = min(0.0, wide[[image, VECTOR]].min().min()), max(1.0, wide[[image, VECTOR]].max().max())
    axis.plot([low, high], [low, high], ":", color="#888888", lw=1.2)
    axis.set(xlabel=f"normalised regret of {agent_name(agent)} with an image", aspect="equal")
    axis.set_ylabel(f"normalised regret of {agent_name(agent)} with a vector")
    for name in names:
        axis.scatter([], [], color=class_color(name, names), label=title(name))
    for chance in dict.fromkeys(wide["chance"].str.split().str[0]):
        axis.scatter([], [], color="#888888", marker=CHANCE_MARKERS.get(chance, "D"), label=chance)
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
            axis.scatter(fit.actual[points], fit.fitted[points], s=22, color=color, alpha=0.8, lw=0, label=title(name))
        both = np.concatenate((fit.actual, fit.fitted))
        low, high = both.min(), both.max()
        axis.plot([low, high], [low, high], ":", color="#888888", lw=1.2)
        axis.set_title(f"{title(fit.subset)}: R² = {fit.r_squared:.2f}, {fit.num_rows} rows")
        axis.set_xlabel(f"actual {regret}")
        axis.xaxis.set_major_formatter(_thousands)
        axis.yaxis.set_major_formatter(_thousands)
    for axis in axes[:: max(1, _columns(len(fits)))]:
        axis.set_ylabel(f"fitted {regret}")
    if len({name for fit in fits for name in fit.classes}) > 1:
        legend_below(figure, axes)
    return figure


def agents_against_each_other(cells: "pd.DataFrame", value: str, agents: tuple[str, str]) -> "Figure | None":
    """The value of one agent against that of another, a point for each task and observation."""
    wide = cells.pivot_table(index=["environment", "instance", "chance", "observation"], columns="agent", values=value)
    if not set(agents) <= set(wide.columns):
        return None
    wide = wide[list(agents)].dropna().reset_index()
    if len(wide) == 0:
        return None
    names = list(dict.fromkeys(wide["environment"]))
    figure, (axis,) = panels(1, 4.2, 3.6)
    for environment, part in wide.groupby("environment", sort=False):
        color = class_color(str(environment), names)
        axis.scatter(
            part[agents[0]], part[agents[1]], s=28, color=color, alpha=0.8, lw=0, label=title(str(environment))
        )
    axis.set_xlabel(f"{REGRETS.get(value, value)} of {agent_name(agents[0])}")
    axis.set_ylabel(f"{REGRETS.get(value, value)} of {agent_name(agents[1])}")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
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


def save(draw: Callable[[], "Figure | None"], place: Path) -> dict[str, bytes] | None:
    """Draw a figure into place.png and place.pdf; its PNG for light and for dark pages. None where there is nothing to
    draw."""
    import matplotlib

    images = {}
    for theme in ("light", "dark"):
        with matplotlib.rc_context(style(theme == "dark")):  # type: ignore[arg-type]
            figure = draw()
            if figure is None:
                return None
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=DPI, bbox_inches="tight", metadata={"Software": None})
            images[theme] = buffer.getvalue()
            if theme == "light":
                place.parent.mkdir(parents=True, exist_ok=True)
                storage.replace_file(place.with_suffix(".png"), images[theme])
                with storage.replacing(place.with_suffix(".pdf")) as file:
                    figure.savefig(file, format="pdf", bbox_inches="tight", metadata={"CreationDate": None})
    return images


def _columns(count: int) -> int:
    return min(count, 4) if count <= 4 or count % 3 else 3


def panels(count: int, width: float, height: float) -> tuple["Figure", list[Any]]:
    """A figure of so many axes, each of that width and height in inches."""
    from matplotlib.figure import Figure

    columns = _columns(count)
    lines = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * lines), layout="constrained")
    axes = np.atleast_1d(figure.subplots(lines, columns, squeeze=False)).ravel().tolist()
    for axis in axes[count:]:
        axis.set_visible(False)
    return figure, axes[:count]


def legend_below(figure: "Figure", axes: Sequence[Any]) -> None:
    """One legend below all panels."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, name in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, handle)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(5, len(handles)))


def _thousands(value: float, _: int) -> str:
    """`50k`, `0.25`, `1.2M`."""
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if abs(value) >= 1e3 else f"{value:g}"
