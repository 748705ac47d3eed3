"""The figures of a study and its tables in LaTeX.

Curves over steps or scores are numbers: what figures draw, and what the page shows when one points at it. Each figure
is a function of tables: a matplotlib figure without global state, light or dark. Tables are in the paper's layout
(packages booktabs, multirow), by pandas' Styler.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import TABULAR_OBSERVATION
from pharos.environments import classes
from pharos.plots import (
    DIAGONAL,
    agent_label,
    color_among,
    label_edges,
    legend_below,
    observation_color,
    panels,
    slug,
    thousands,
)
from pharos.study.analysis import IMAGE, PAPER_AGENT, PAPER_AGENTS, REGRETS, VECTOR, Models, mean_curve
from pharos.study.regression import Fit
from pharos.system.wording import in_words, latex_text
from pharos.training import CELL

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


LINES = {"q_learning": "-", "dqn": "-", "ppo": "--"}
OBSERVATION_WORDS = {TABULAR_OBSERVATION: "", VECTOR: "vector", IMAGE: "image"}
# More lines of runs than this are not told apart in one panel: the page does not offer them
MOST_CURVE_RUNS = 120
# Significant digits of the numbers in the page
CURVE_DIGITS = 5


@dataclass(frozen=True)
class Line:
    """One line of a panel.

    Attributes:
        label: in words, `DQN, image`.
        color: such as `#0072B2`. dash: as matplotlib writes it, such as `--`.
        x: (T,) if it is known. mean, lower, upper: (T,) the line and the ends of its interval.
        runs: name of each run -> (T,) its values.
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
        share: values are shares in [0, 1], over scores. Otherwise they are over steps, and start at 0.
        draws_runs: whether the printed figure has a thin line for each run.
    """

    panels: Sequence[Panel]
    x_label: str
    y_label: str
    share: bool = False
    draws_runs: bool = False

    def to_json(self) -> str:
        """The curves as the page draws them: numbers of DIGITS digits, and runs if there are at most MOST_RUNS."""
        panels = []
        for panel in self.panels:
            num_runs = sum(len(line.runs) for line in panel.lines)
            panels.append(
                {"title": panel.title, "lines": [_numbers(line, num_runs <= MOST_CURVE_RUNS) for line in panel.lines]}
            )
        about = {"x": self.x_label, "y": self.y_label, "share": self.share, "runs": self.draws_runs}
        return json.dumps({**about, "panels": panels}, separators=(",", ":"), allow_nan=False)


def _numbers(line: Line, runs: bool) -> dict[str, Any]:
    values = {name: _short(getattr(line, name)) for name in ("x", "mean", "lower", "upper")}
    each = {name: _short(run) for name, run in line.runs.items()} if runs else {}
    return {"label": line.label, "color": line.color, "dash": line.dash, **values, "runs": each}


def _short(values: np.ndarray) -> list[float | int | None]:
    """The values with DIGITS significant digits, whole ones as integers. null stands for what is not finite."""
    texts = [f"{value:.{CURVE_DIGITS}g}" if np.isfinite(value) else "null" for value in np.asarray(values, np.float64)]
    return [None if text == "null" else int(float(text)) if float(text).is_integer() else float(text) for text in texts]


def line_label(agent: str, observation: str) -> str:
    """Label of an agent and its observation: `DQN, image`, `tabular Q-learning`."""
    words = OBSERVATION_WORDS.get(observation, observation)
    return f"{agent_label(agent)}, {words}" if words else agent_label(agent)


def regret_curves(
    points: "pd.DataFrame", *, by: str | list[str] = "environment", draws_runs: bool = False, resamples: int = 500
) -> Curves:
    """Cumulative expected regret by steps: a panel for each class (or instance, or task), a line for each agent and
    observation.

    The mean over instances and kinds of chance, with its 95 % bootstrap interval over runs. The paper's figure 2.
    """
    panels, observations = [], list(dict.fromkeys(points["observation"]))
    for name, part in points.groupby(by, sort=False):
        panel_lines = []
        for (agent, observation), each in part.groupby(["agent", "observation"], sort=True):
            steps, tasks, runs = same_steps(each)
            mean, lower, upper = mean_curve(tasks, resamples=resamples)
            color = observation_color(observation, observations)
            words, dash = line_label(agent, observation), LINES.get(agent, ":")
            panel_lines.append(Line(words, color, dash, steps, mean, lower, upper, runs))
        text = name if isinstance(name, str) else ", ".join(map(str, name))
        panels.append(Panel(in_words(text), panel_lines))
    return Curves(panels, "steps", "cumulative regret", draws_runs=draws_runs)


def same_steps(points: "pd.DataFrame") -> tuple[np.ndarray, list[np.ndarray], dict[str, np.ndarray]]:
    """Steps, for each task the cumulative regret (runs, T) there, and the regret of each run by its name, for the runs
    that were evaluated at the same steps.

    If blocks of a study differ in steps, these are the steps that most runs have.
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
        panel_lines = []
        for (agent, observation), line in part.groupby(["agent", "observation"], sort=True):
            color = observation_color(observation, observations)
            values = (line[column].to_numpy(np.float64) for column in ("score", "share", "lower", "upper"))
            panel_lines.append(Line(line_label(agent, observation), color, LINES.get(agent, ":"), *values))
        panels.append(Panel(in_words(str(name)), panel_lines))
    return Curves(panels, "score: 1 - normalised regret", "share of runs above it", share=True)


def all_curves(points: "pd.DataFrame", profiles: "pd.DataFrame") -> dict[str, Curves]:
    """Curves by the name of their figure."""
    curves = {"regret": regret_curves(points), "regret_by_instance": regret_curves(points, by="instance")}
    curves["profiles"] = performance_profiles(profiles)
    for environment, part in points.groupby("environment", sort=False):
        by_task = regret_curves(part, by=["instance", "chance"], draws_runs=True, resamples=200)
        curves[f"regret_by_task_{slug(str(environment))}"] = by_task
    return curves


# Figures --------------------------------------------------------------------------------------------------------------


CHANCE_MARKERS = {
    "plain": "o",
    "random": "^",
    "sticky": "s",
    "lazy": "v",
    "reward_noise": "P",
    "reward_delay": "X",
    "scale_rewards": "D",
}
OTHER_IMAGE = "complex_image"


def lines(curves: Curves) -> "Figure | None":
    """A panel for each group, with a line and its interval for each agent and observation. None without panels."""
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
    """(agent, image) if some task has cells of the agent with that image and with a vector."""
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
    others = [slug(agent)] * (agent != PAPER_AGENT) + [slug(image)] * (image != IMAGE)
    return "_".join(["representations", *others])


def agents_figure(one: str, two: str) -> str:
    """The name of the figure of two agents."""
    return "agents" if (one, two) == PAPER_AGENTS else f"agents_{slug(one)}_{slug(two)}"


def representations(cells: "pd.DataFrame", *, agent: str = "dqn", image: str = IMAGE) -> "Figure | None":
    """Normalised regret with a vector against that with an image, a point for each task. The paper's figure 3."""
    words = [f"normalised regret of {agent_label(agent)} with {sight}" for sight in ("an image", "a vector")]
    figure = _against(cells[cells["agent"] == agent], "observation", "normalized_regret", (image, VECTOR), words)
    if figure is not None:
        (axis,) = figure.axes
        high = max(1.0, axis.get_xlim()[1], axis.get_ylim()[1])
        axis.plot([0.0, high], [0.0, high], ":", color=DIAGONAL, lw=1.2)
        axis.set(aspect="equal")
    return figure


def agents_against_each_other(cells: "pd.DataFrame", value: str, agents: tuple[str, str]) -> "Figure | None":
    """The value of one agent against the value of another, a point for each task and observation."""
    words = [f"{REGRETS.get(value, value)} of {agent_label(agent)}" for agent in agents]
    return _against(cells, "agent", value, agents, words)


def _against(
    cells: "pd.DataFrame", column: str, value: str, both: tuple[str, str], words: Sequence[str]
) -> "Figure | None":
    """The value with one entry of `column` against the value with another. None if no cell has both."""
    index = [name for name in CELL if name != column]
    wide = cells.pivot_table(index=index, columns=column, values=value)
    if not {*both} <= {*wide.columns} or not len(wide := wide[list(both)].dropna().reset_index()):
        return None
    names, chances = list(dict.fromkeys(wide["environment"])), wide["chance"].str.split().str[0]
    figure, (axis,) = panels(1, 4.2, 3.7)
    for (environment, chance), part in wide.groupby(["environment", chances]):
        color, marker = class_color(environment, names), CHANCE_MARKERS.get(chance, "D")
        axis.scatter(part[both[0]], part[both[1]], s=32, color=color, marker=marker, alpha=0.85, lw=0)
    for name in names:
        axis.scatter([], [], color=class_color(name, names), label=in_words(name))
    for chance in dict.fromkeys(chances) if chances.nunique() > 1 else ():
        words = "no added noise" if chance == "plain" else in_words(chance)
        axis.scatter([], [], color=DIAGONAL, marker=CHANCE_MARKERS.get(chance, "D"), label=words)
    axis.set(xlabel=words[0], ylabel=words[1])
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def fitted_against_actual(fits: Sequence[Fit], regret: str) -> "Figure":
    """A panel for each fit: what the model gives against what was measured. A perfect model is the dotted diagonal."""
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
    """Functions that draw the figures, by name. Fits are drawn for the first agent."""
    figures: dict[str, Callable[[], Figure | None]] = {name: partial(lines, each) for name, each in curves.items()}
    for agent, image in pairs_of(cells, agents):
        figures[representations_figure(agent, image)] = partial(representations, cells, agent=agent, image=image)
    for each in models:
        if each.agent != models[0].agent:
            continue
        name = each.regret.removesuffix("_regret")
        kinds = {"single": "single_model", "representation": "representation_models", "class": "class_models"}
        for kind, file in kinds.items():
            fits = [fit for fit in each.fits if fit.model == kind]
            figures[f"{file}_{name}"] = partial(_fits, fits, REGRETS[each.regret])
    for i, one in enumerate(agents):
        for two in agents[i + 1 :]:
            both = partial(agents_against_each_other, cells, "normalized_regret", (one, two))
            figures[agents_figure(one, two)] = both
    return figures


def _fits(fits: Sequence[Fit], regret: str) -> "Figure | None":
    return fitted_against_actual(fits, regret) if fits else None


# LaTeX ----------------------------------------------------------------------------------------------------------------


# As the paper orders them
RETURN_COLUMNS = (("ppo", IMAGE), ("ppo", VECTOR), ("dqn", IMAGE), ("dqn", VECTOR))
TITLES = {"ppo": "PPO", "dqn": "DQN", IMAGE: "IMAGE", VECTOR: "MINIMAL"}
CHANCES = {"plain": "None", "random": "random", "sticky": "stick"}


def tables_of(cells: "pd.DataFrame", measured: "pd.DataFrame", models: Sequence[Models]) -> dict[str, str]:
    """LaTeX tables by name: the returns of each class, hardness, and the fits for each agent and kind of regret."""
    tables = {
        f"returns_{environment}": returns_table(cells, environment)
        for environment in dict.fromkeys(cells["environment"])
    }
    tables["hardness"] = latex_hardness(measured)
    for each in models:
        tables[f"models_{each.regret}{each.suffix(models[0].agent)}"] = models_table(each)
    return tables


def returns_table(cells: "pd.DataFrame", environment: str) -> str:
    """The returns of one class, a line for each kind of chance.

    As in appendix C if PPO and DQN see images and vectors: IMAGE and MINIMAL (the vector). Else a column for each
    agent and observation that there is.
    """
    import pandas as pd

    wide = wide_returns(cells, environment, lambda row: _entry(row["return"], row["return_deviation"])).fillna("--")
    keys = list(wide)
    titles = [(latex_text(agent_label(agent)), latex_text(in_words(name))) for agent, name in keys]
    if {key for key in keys if key[1] != TABULAR_OBSERVATION} == set(RETURN_COLUMNS):
        keys, titles = list(RETURN_COLUMNS), [(TITLES[agent], TITLES[name]) for agent, name in RETURN_COLUMNS]
    rows = []
    for instance, chance in wide.index:
        kind = chance if "," in chance else CHANCES.get(chance.split()[0], chance)
        rows.append((rf"{{\small {latex_text(instance)}}}", latex_text(kind)))
    index = pd.MultiIndex.from_tuples(rows, names=["instance", "randomization"])
    data = pd.DataFrame(wide[keys].to_numpy(), index, pd.MultiIndex.from_tuples(titles))
    return _latex(data, "ll" + "c" * len(keys), multirow_align="c", clines="skip-last;data")


def wide_returns(cells: "pd.DataFrame", environment: str, text: Callable[[Mapping[str, Any]], str]) -> "pd.DataFrame":
    """The text of each cell of a class: a row for each instance and kind of chance, a column for each agent and
    observation, PPO first.
    """
    part = cells[cells["environment"] == environment]
    texts = part.assign(text=[text(row) for row in part.to_dict("records")])
    wide = texts.pivot(index=["instance", "chance"], columns=["agent", "observation"], values="text")
    rows = list(dict.fromkeys(zip(part["instance"], part["chance"], strict=True)))
    return wide.loc[rows, sorted(wide, key=lambda key: (key[0] != PAPER_AGENTS[1], *key))]


def latex_hardness(measured: "pd.DataFrame") -> str:
    """The measures of each instance under each kind of chance."""
    names = [name for name in measured.columns if name not in ("environment", "instance", "chance", "notes")]
    texts = measured[["instance", "chance"]].map(latex_text)
    numbers = measured[names].map(lambda x: "--" if x is None or not np.isfinite(x) else f"{x:.6g}")
    table = texts.join(numbers).rename(columns=lambda name: latex_text(in_words(name)))
    return _latex(table, "ll" + "r" * len(names), is_indexed=False)


def models_table(models: Models) -> str:
    """The fits: rows, R2 within and outside the sample."""
    import pandas as pd

    names = ["model", "of", "rows", "$R^2$", "adjusted", "outside"]
    lines = []
    for fit in models.fits:
        numbers = (f"{value:.2f}" for value in (fit.r_squared, fit.adjusted_r_squared, fit.cross_validated_r_squared))
        lines.append([fit.model, latex_text(fit.subset), str(fit.num_rows), *numbers])
    return _latex(pd.DataFrame(lines, columns=names), "llrrrr", is_indexed=False)


def _latex(
    data: "pd.DataFrame",
    column_format: str,
    *,
    is_indexed: bool = True,
    multirow_align: str = "c",
    clines: str | None = None,
) -> str:
    """A frame of LaTeX texts as a tabular."""
    styler = data.style if is_indexed else data.style.hide(axis="index")
    text = styler.to_latex(
        hrules=True,
        column_format=column_format,
        multicol_align="c",
        multirow_align=multirow_align,
        clines=clines,
    )
    return re.sub(r" +", " ", text)


def _entry(mean: float, deviation: float) -> str:
    if not np.isfinite(mean):
        return "--"
    return rf"${mean:.2f}$" if np.isnan(deviation) else rf"${mean:.2f} \pm {deviation:.2f}$"
