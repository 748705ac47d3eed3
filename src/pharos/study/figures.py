"""The figures of a study, each a function of tables: matplotlib figures without global state, light or dark."""

import io
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos import storage
from pharos.agents import TABULAR_OBSERVATION
from pharos.environments import classes
from pharos.study.analysis import IMAGE, REGRETS, VECTOR, Models, mean_curve
from pharos.study.regression import Fit

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which people tell apart whatever their sight; those of classes stand in their `look`
MORE_COLORS = ("#CC79A7", "#E69F00", "#F0E442", "#999999")
OBSERVATION_COLORS = {TABULAR_OBSERVATION: "#009E73", VECTOR: "#0072B2", IMAGE: "#D55E00"}
CHANCE_MARKERS = {"plain": "o", "random": "^", "sticky": "s", "lazy": "v", "reward_noise": "P", "reward_delay": "X"}
LINES = {"q_learning": "-", "dqn": "-", "ppo": "--"}
NAMES = {"q_learning": "tabular Q-learning", "dqn": "DQN", "ppo": "PPO"}
OBSERVATIONS = {TABULAR_OBSERVATION: "", VECTOR: "vector", IMAGE: "image"}
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


def label(agent: str, observation: str) -> str:
    """`DQN, image`, `tabular Q-learning`."""
    seen = OBSERVATIONS.get(observation, observation)
    return f"{agent_name(agent)}, {seen}" if seen else agent_name(agent)


def agent_name(agent: str) -> str:
    """`DQN`; of an algorithm from a module or a file, the name of its class."""
    return NAMES.get(agent, agent.rpartition(":")[2])


def slug(name: str) -> str:
    """A name as part of a file's name."""
    return "".join(c if c.isalnum() else "_" for c in name)


def title(name: str) -> str:
    """A name for people: `frozen lake`."""
    return name.replace("_", " ")


def class_color(name: str, names: Sequence[str]) -> str:
    """The colour of a class of environments among `names`: its own, or one of MORE_COLORS."""
    own = {other: cls.look.color for other, cls in classes().items() if cls.look.color is not None}
    others = [other for other in names if other not in own]
    return own.get(name) or MORE_COLORS[others.index(name) % len(MORE_COLORS)]


def regret_curves(
    points: "pd.DataFrame", *, by: str | list[str] = "environment", seeds: bool = False, resamples: int = 500
) -> "Figure":
    """Cumulative expected regret by steps: a panel for each class (or instance, or task), a line for each agent and
    observation.

    The mean over instances and kinds of chance, with its 95 % bootstrap interval over runs; with `seeds` a thin line
    for each run as well. The paper's figure 2.
    """
    groups = [
        (name if isinstance(name, str) else ", ".join(map(str, name)), part)
        for name, part in points.groupby(by, sort=False)
    ]
    figure, axes = _panels(len(groups), 3.3, 2.7)
    for axis, (name, part) in zip(axes, groups, strict=False):
        for (agent, observation), lines in part.groupby(["agent", "observation"], sort=True):
            steps, tasks = _tasks(lines)
            mean, lower, upper = mean_curve(tasks, resamples=resamples)
            color = OBSERVATION_COLORS.get(observation, MORE_COLORS[0])
            axis.plot(steps, mean, LINES.get(agent, ":"), color=color, lw=1.6, label=label(agent, observation))
            axis.fill_between(steps, lower, upper, color=color, alpha=0.18, lw=0)
            for run in np.concatenate(tasks) if seeds else ():
                axis.plot(steps, run, LINES.get(agent, ":"), color=color, lw=0.5, alpha=0.5)
        axis.set_title(title(str(name)))
        axis.set_xlabel("steps")
        axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
        axis.xaxis.set_major_formatter(_thousands)
    for axis in axes[:: max(1, _columns(len(groups)))]:
        axis.set_ylabel("cumulative regret")
    _legend(figure, axes)
    return figure


def _tasks(lines: "pd.DataFrame") -> tuple[np.ndarray, list[np.ndarray]]:
    """Steps, and for each task the cumulative regret (runs, T) there, of the runs that were evaluated at the same
    steps.

    Where blocks of a study differ in steps, those are the steps that most runs have.
    """
    by_run = lines.pivot_table(index=["instance", "chance", "id"], columns="step", values="cumulative_expected_regret")
    present = by_run.notna()
    kinds = present.apply(lambda row: row.to_numpy().tobytes(), axis=1)
    same = kinds == kinds.mode().iloc[0]
    by_run = by_run.loc[same, present[same].all()]
    tasks = [group.to_numpy() for _, group in by_run.groupby(level=["instance", "chance"], sort=True)]
    return by_run.columns.to_numpy(), tasks


def pairs_of(cells: "pd.DataFrame", agents: Sequence[str]) -> list[tuple[str, str]]:
    """(agent, image) where some task has cells of the agent with that image and with a vector."""
    pairs = []
    for agent in agents:
        own = cells[cells["agent"] == agent]
        wide = own.pivot_table(index=["instance", "chance"], columns="observation", values="normalized_regret")
        for seen in (IMAGE, OTHER_IMAGE):
            if {seen, VECTOR} <= set(wide.columns) and len(wide[[seen, VECTOR]].dropna()):
                pairs.append((agent, seen))
    return pairs


def representations_figure(agent: str, seen: str) -> str:
    """The name of the figure of `representations`."""
    parts = ["representations", *([] if agent == "dqn" else [slug(agent)]), *([] if seen == IMAGE else [slug(seen)])]
    return "_".join(parts)


def agents_figure(one: str, two: str) -> str:
    """The name of the figure of two agents."""
    return "agents" if (one, two) == ("dqn", "ppo") else f"agents_{slug(one)}_{slug(two)}"


def representations(cells: "pd.DataFrame", *, agent: str = "dqn", seen: str = IMAGE) -> "Figure | None":
    """Normalised regret with a vector against that with an image, a point for each task. The paper's figure 3."""
    wide = cells[cells["agent"] == agent].pivot_table(
        index=["environment", "instance", "chance"], columns="observation", values="normalized_regret"
    )
    if not {seen, VECTOR} <= set(wide.columns):
        return None
    wide = wide[[seen, VECTOR]].dropna().reset_index()
    names = list(dict.fromkeys(wide["environment"]))
    figure, (axis,) = _panels(1, 4.6, 4.2)
    for (environment, chance), part in wide.groupby(["environment", wide["chance"].str.split().str[0]], sort=True):
        marker = CHANCE_MARKERS.get(chance, "D")
        color = class_color(environment, names)
        axis.scatter(part[seen], part[VECTOR], s=34, color=color, marker=marker, alpha=0.85, lw=0)
    low, high = min(0.0, wide[[seen, VECTOR]].min().min()), max(1.0, wide[[seen, VECTOR]].max().max())
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
    figure, axes = _panels(len(fits), 3.1, 3.0)
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
        _legend(figure, axes)
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
    figure, (axis,) = _panels(1, 4.2, 3.6)
    for environment, part in wide.groupby("environment", sort=False):
        color = class_color(str(environment), names)
        axis.scatter(
            part[agents[0]], part[agents[1]], s=28, color=color, alpha=0.8, lw=0, label=title(str(environment))
        )
    axis.set_xlabel(f"{REGRETS.get(value, value)} of {agent_name(agents[0])}")
    axis.set_ylabel(f"{REGRETS.get(value, value)} of {agent_name(agents[1])}")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def performance_profiles(profiles: "pd.DataFrame") -> "Figure | None":
    """A panel for each class: the share of runs above each score, a line for each agent and observation."""
    groups = list(profiles.groupby("environment", sort=False))
    if not groups:
        return None
    figure, axes = _panels(len(groups), 3.3, 2.7)
    for axis, (name, part) in zip(axes, groups, strict=False):
        for (agent, observation), line in part.groupby(["agent", "observation"], sort=True):
            color = OBSERVATION_COLORS.get(observation, MORE_COLORS[0])
            text = label(agent, observation)
            axis.plot(line["score"], line["share"], LINES.get(agent, ":"), color=color, lw=1.6, label=text)
            axis.fill_between(line["score"], line["lower"], line["upper"], color=color, alpha=0.18, lw=0)
        axis.set_title(title(str(name)))
        axis.set_xlabel("score: 1 - normalised regret")
        axis.set_ylim(-0.02, 1.02)
    for axis in axes[:: max(1, _columns(len(groups)))]:
        axis.set_ylabel("share of runs above it")
    _legend(figure, axes)
    return figure


def all_figures(
    points: "pd.DataFrame",
    cells: "pd.DataFrame",
    models: Sequence[Models],
    agents: Sequence[str],
    profiles: "pd.DataFrame",
) -> dict[str, Callable[[], "Figure | None"]]:
    """Name -> function that draws it; fits are drawn for the first agent."""
    drawn: dict[str, Callable[[], Figure | None]] = {
        "regret": lambda: regret_curves(points),
        "regret_by_instance": lambda: regret_curves(points, by="instance"),
        "profiles": lambda: performance_profiles(profiles),
    }
    for environment, part in points.groupby("environment", sort=False):
        by_task = partial(regret_curves, part, by=["instance", "chance"], seeds=True, resamples=200)
        drawn[f"regret_by_task_{slug(str(environment))}"] = by_task
    for agent, seen in pairs_of(cells, agents):
        drawn[representations_figure(agent, seen)] = partial(representations, cells, agent=agent, seen=seen)
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


def _panels(count: int, width: float, height: float) -> tuple["Figure", list[Any]]:
    from matplotlib.figure import Figure

    columns = _columns(count)
    lines = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * lines), layout="constrained")
    axes = np.atleast_1d(figure.subplots(lines, columns, squeeze=False)).ravel().tolist()
    for axis in axes[count:]:
        axis.set_visible(False)
    return figure, axes[:count]


def _legend(figure: "Figure", axes: Sequence[Any]) -> None:
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
