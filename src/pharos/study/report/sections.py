"""Contents of the sections of the page, None for an empty one. Texts only: the templates make HTML of them."""

import io
import platform
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import start_distribution
from pharos.errors import PharosError
from pharos.plots import agent_label, slug
from pharos.study.analysis import IMAGE, PAPER_AGENT, VECTOR
from pharos.study.figures import line_label, pairs_of, representations_figure, returns_table, wide_returns
from pharos.study.report.model_sections import agreement_section, models_section
from pharos.study.report.page import Figures, Section, data_table, data_url, figure_image
from pharos.study.report.results import Results
from pharos.study.specification import Specification
from pharos.study.status import duration
from pharos.system.wording import in_words, pluralize

if TYPE_CHECKING:
    import pandas as pd

PICTURE_PIXELS = 220
FEWEST_TASKS = 10  # of which it is counted how many are harder as an image


def sections_of(results: Results, figures: Figures) -> list[Section]:
    """The sections of the page in order, without empty ones."""
    left_out: list[str] = []
    sections = [
        _summary(results),
        _findings(results),
        _regret(results, figures),
        _profiles(results, figures),
        _representations(results, figures, left_out),
        _aliasing(results),
        models_section(results, figures, left_out),
        agreement_section(results, figures, left_out),
        _hardness(results),
        _returns(results),
        _paper_comparison(results),
        _instances(results.study),
        _each_instance(results, figures),
        _provenance(results, left_out),
    ]
    return [section for section in sections if section is not None]


def _summary(results: Results) -> Section:
    now, runs = results.status, results.runs
    failed = f", {now.failed} failed" if now.failed else ""
    lines = [
        f"{now.finished:,} of {pluralize(now.total, 'run')} {'is' if now.total == 1 else 'are'} finished{failed}: "
        f"{pluralize(runs['instance'].nunique(), 'instance')} of "
        f"{pluralize(runs['environment'].nunique(), 'class', 'classes')}, "
        f"{pluralize(runs['chance'].nunique(), 'kind')} of chance, {pluralize(runs['agent'].nunique(), 'agent')}, "
        f"{pluralize(runs['seed'].nunique(), 'seed')}; {int(runs['steps'].sum()):,} steps, which took one processor "
        f"{duration(runs['seconds'].sum())}."
    ]
    lines = [*_winner(results), *_other_winners(results), *lines]
    if (estimated := _estimated(runs)) is not None:
        lines.append(estimated)
    main = results.models[0].get("single", "all")
    if main is not None:
        printed = "; the paper prints 0.09" if results.comparison is not None else ""
        lines.append(
            f"One linear model of {agent_label(results.models[0].agent)}'s cumulative regret over all classes and "
            f"representations explains R² = {main.r_squared:.2f} of it ({main.cross_validated_r_squared:.2f} for tasks "
            f"it has not seen){printed}."
        )
    if results.comparison is not None:
        returns = results.comparison.returns
        matched = int(returns["ours"].notna().sum())
        lines.append(f"{matched} of the {len(returns)} returns that the paper prints have their counterpart here.")
    missing = ""
    if now.missing:
        missing = f"{pluralize(now.missing, 'run')} missing: every number below is of the runs that are there."
    errors = [f"{count} × {error}" for error, count in Counter(now.errors.values()).items()]
    damaged = list({**now.damaged, **results.damaged}.values())
    return Section("Summary", "summary", lines=lines, missing=missing, errors=errors, damaged=damaged)


MOST_COMPARED = 6  # agents and observations with a sentence of their own


def _winner(results: Results) -> list[str]:
    """Sentences on who has the least regret, by how much less than each other one, and how sure that is.

    All are compared on the tasks that all of them have. If there is none, each is averaged over its tasks.
    """
    groups = {
        key: own.groupby(["instance", "chance"])["normalized_regret"].mean().dropna()
        for key, own in results.runs.groupby(["agent", "observation"], sort=True)
    }
    groups = {key: own for key, own in groups.items() if len(own)}
    if not groups:
        return ["No run has a normalised regret: no policy beats uniform play."]
    shared = sorted(set.intersection(*(set(own.index) for own in groups.values())))
    means = {key: float((own.loc[shared] if shared else own).mean()) for key, own in groups.items()}
    first, *others = sorted(means, key=lambda key: means[key])
    over = f"the mean over {pluralize(len(shared), 'task')}" if shared else "the mean over its own tasks"
    scale = "0 is optimal from the first episode on, 1 as bad as acting at random"
    if not others:
        return [f"{line_label(*first)} has a normalised regret of {means[first]:.2f}, {over} ({scale})."]
    lines = [f"{line_label(*first)} has the least normalised regret: {means[first]:.2f}, {over} ({scale})."]
    lines = [lines[0][:1].upper() + lines[0][1:]]
    lines += [_behind(results.differences, first, other, means[other]) for other in others[:MOST_COMPARED]]
    if len(others) > MOST_COMPARED:
        lines.append(f"{len(others) - MOST_COMPARED} more have a larger one: see Regret and Profiles below.")
    return lines


def _behind(differences: "pd.DataFrame", first: tuple[str, str], other: tuple[str, str], regret: float) -> str:
    """A sentence on one that is not the first."""
    forward = differences[(differences["ours"] == first) & (differences["theirs"] == other)]
    backward = differences[(differences["ours"] == other) & (differences["theirs"] == first)]
    if len(forward) == len(backward) == 0:
        return f"{line_label(*other)}: {regret:.2f}, on other tasks: no comparison."
    row, sign = (forward.iloc[0], -1.0) if len(forward) else (backward.iloc[0], 1.0)
    more, ends = sign * row["difference"], sorted((sign * row["lower"], sign * row["upper"]))
    text = f"{line_label(*other)}: {regret:.2f}, {more:.2f} more on {pluralize(int(row['tasks']), 'task')}"
    if not np.isfinite(row["p_value"]):
        return f"{text}; a task has one run, so nothing can be said about how sure this is."
    p = "p < 0.001" if row["adjusted"] < 0.001 else f"p = {row['adjusted']:.3f}"
    corrected = f" after Holm's correction for {len(differences)} comparisons" if len(differences) > 1 else ""
    verdict = ("worse" if more > 0 else "better") if row["adjusted"] < 0.05 else "not shown to differ"
    return f"{text} (95 % interval {ends[0]:.2f} to {ends[1]:.2f}, {p}{corrected}): {verdict}."


def _other_winners(results: Results) -> list[str]:
    """A sentence if returns and regret order agents differently, with the task on which regrets are farthest apart."""
    tasks = results.other_winners
    if len(tasks) == 0:
        return []
    row = tasks.loc[(tasks["most_regret"] - tasks["least_regret"]).idxmax()]
    many = pluralize(results.other_winners.attrs["tasks"], "task")
    return [
        f"Returns and regret order them differently in {len(tasks)} of {many}. On {row['instance']} "
        f"(chance: {results.chances[row['instance'], row['chance']]}) "
        f"{line_label(*row['most'])} has the highest return ({row['most_return']:.2f}) and a regret of "
        f"{row['most_regret']:.2f}; {line_label(*row['least'])} has the least regret ({row['least_regret']:.2f}) and a "
        f"return of {row['least_return']:.2f}. Returns are of episodes played while learning, exploration included; "
        "regret is of the policies that were learnt."
    ]


def _estimated(runs: "pd.DataFrame") -> str | None:
    """Sentences on the regret that is estimated, and how wrong it may be. None if all regret is exact."""
    estimates = runs[~runs["exact"].astype(bool)]
    if len(estimates) == 0:
        return None
    groups = estimates.groupby(["environment", "agent"], sort=True).size()
    of = ", ".join(f"{agent_label(agent)} on {in_words(name)} ({count})" for (name, agent), count in groups.items())
    return (
        f"The regret of {pluralize(len(estimates), 'run')} of {len(runs):,} is estimated by playing, because the "
        f"policy reaches too many states for an exact value: {of}. Their normalised regret may be off by up to ± "
        f"{estimates['half_width'].max():.4f} if all errors of a run add up; tables mark them by ≈. All other regret "
        "is exact."
    )


def _findings(results: Results) -> Section | None:
    if results.findings is None:
        return None
    decided = results.findings[results.findings["verdict"] != "no data"]
    if len(decided) == 0:
        return None
    counts = "; ".join(f"{number} x {verdict}" for verdict, number in decided["verdict"].value_counts().items())
    return Section(
        "Findings of the paper",
        "findings",
        counts=f"{len(decided)} of {len(results.findings)} can be looked at here: {counts}.",
        table=data_table(
            decided,
            "What the paper says in words, and the same from these runs. Undecided: not significant at 0.05; no "
            "correction for the number of tests. Every test counts a task once. Power: how probable it is that these "
            "tasks find an effect as large as the paper prints; where it is small, undecided says nothing against the "
            "paper. How each is tested: docs/study.md.",
        ),
    )


def _regret(results: Results, figures: Figures) -> Section:
    estimates = results.intervals
    exact = results.runs.groupby(["environment", "agent", "observation"])["exact"].all()
    keys = zip(estimates["environment"], estimates["agent"], estimates["observation"], strict=True)
    marks = ["" if exact[key] else "≈ " for key in keys]
    shown = estimates.assign(
        iqm=[f"{mark}{value:.3f}" for mark, value in zip(marks, estimates["iqm"], strict=True)],
        interval=_intervals(estimates, 3),
    )
    columns = ["environment", "agent", "observation", "tasks", "runs", "iqm", "interval"]
    return Section(
        "Regret",
        "regret",
        figure=figure_image(
            figures,
            "regret",
            "Cumulative regret by steps (lower is better), the mean over instances and kinds of chance with the 95 % "
            "bootstrap interval over seeds." + (" The paper's figure 2." if results.comparison is not None else ""),
        ),
        table=data_table(
            shown[columns],
            "Interquartile mean of the normalised regret (0: optimal from the first episode on; 1: as bad as acting "
            "at random) and its 95 % stratified bootstrap interval. With few seeds such intervals are too narrow; n/a: "
            "a task has one run. ≈: some values are estimated.",
        ),
    )


def _intervals(rows: "pd.DataFrame", digits: int) -> list[str]:
    """Texts of the columns `lower` and `upper`, n/a if there is no interval."""
    ends = zip(rows["lower"], rows["upper"], strict=True)
    return [f"{low:.{digits}f} to {high:.{digits}f}" if np.isfinite(low) else "n/a" for low, high in ends]


def _profiles(results: Results, figures: Figures) -> Section | None:
    """Profiles and improvements. None if there is but one agent and observation."""
    if len(results.improvements) == 0:
        return None
    shown = results.improvements.assign(interval=_intervals(results.improvements, 2)).drop(columns=["lower", "upper"])
    return Section(
        "Profiles",
        "regret",
        figure=figure_image(
            figures,
            "profiles",
            "Performance profiles: the share of runs whose score (1 minus the normalised regret: 1 is optimal, 0 as "
            "bad as acting at random) exceeds what stands below, with 95 % stratified bootstrap bands.",
        ),
        table=data_table(
            shown,
            "How probable it is that a run of the first has less regret than one of the second on the same task, the "
            "mean over tasks, with the 95 % stratified bootstrap interval (n/a: a task has one run); 0.5: no "
            "difference.",
            digits=2,
        ),
    )


def _representations(results: Results, figures: Figures, left_out: list[str]) -> Section | None:
    parts = []
    for agent, observation in pairs_of(results.cells, results.agents):
        wide = results.cells[results.cells["agent"] == agent].pivot_table(
            index=["environment", "instance", "chance"], columns="observation", values="normalized_regret"
        )
        wide = wide[[observation, VECTOR]].dropna()
        harder = (wide[observation] > wide[VECTOR]).groupby(level="environment").agg(["sum", "size"])
        lines = [
            f"{in_words(str(name))}: the {in_words(observation) if observation != IMAGE else 'image'} costs "
            f"{agent_label(agent)} more regret in {row['sum']} of {row['size']} tasks"
            for name, row in harder[harder["size"] >= FEWEST_TASKS].iterrows()
        ]
        caption = (
            f"Normalised regret of {agent_label(agent)} that sees a vector against that of {agent_label(agent)} that "
            "sees an image, a point for each instance and kind of chance. Below the dotted line the image is harder."
        )
        if results.comparison is not None and agent == PAPER_AGENT:
            caption += " The paper's figure 3."
        parts.append(
            {"figure": figure_image(figures, representations_figure(agent, observation), caption), "lines": lines}
        )
    if not parts:
        left_out.append(
            "Vector against image: there are no cells of DQN with both a vector and an image, nor of another agent."
        )
        return None
    paper = ""
    if results.comparison is not None:
        paper = (
            "The paper finds the image harder in simple grid and frozen lake, "
            "the vector harder in freeway and breakout."
        )
    return Section("Vector against image", "representations", parts=parts, paper=paper)


def _aliasing(results: Results) -> Section | None:
    shared = results.aliasing[results.aliasing["share"] > 0]
    if len(shared) == 0:
        return None
    shown = shared.assign(share=[f"{100 * share:.1f} %" for share in shared["share"]])
    regrets = results.cells.pivot_table(
        index=["instance", "observation"], columns="agent", values="normalized_regret"
    ).rename(columns=lambda agent: f"regret of {agent_label(agent)}")
    shown = shown.merge(regrets.reset_index(), on=["instance", "observation"], how="left")
    return Section(
        "States that share an observation",
        "aliasing",
        text="These observations do not tell every state: an agent that remembers nothing cannot act differently in "
        "states that look alike, and learns from targets that mix them. Regret is measured against the optimal policy "
        "of the states. So where vectors and images are compared, a part of the difference may be this.",
        table=data_table(
            shown,
            "Reachable states, different observations among them, the share of states that look like another, and the "
            "normalised regret of agents that see them, the mean over kinds of chance.",
        ),
    )


def _hardness(results: Results) -> Section:
    aliasing = results.aliasing
    complete = ""
    if len(aliasing) and not (aliasing["share"] > 0).any():
        complete = "No two states share an observation, on any instance and for any observation that was counted."
    return Section(
        "Hardness of the instances",
        "hardness",
        table=data_table(
            _worded(results, results.hardness),
            "The tabular measures of each instance under each kind of chance, as they enter the models; notes say "
            "where one is of the instance without chance, or stands for a proven interval.",
        ),
        complete=complete,
    )


def _worded(results: Results, rows: "pd.DataFrame") -> "pd.DataFrame":
    """Rows with their kinds of chance in words."""
    keys = zip(rows["instance"], rows["chance"], strict=True)
    return rows.assign(chance=[results.chances.get(key, key[1]) for key in keys])


def _returns(results: Results) -> Section:
    """Returns of each class, and in LaTeX below."""
    parts = []
    for environment in dict.fromkeys(results.cells["environment"]):
        wide = wide_returns(results.cells, environment, _return).fillna("")
        wide.columns = [line_label(*key) for key in wide]
        latex = returns_table(results.cells, environment)
        shown = _worded(results, wide.reset_index())
        parts.append({"title": in_words(environment), "table": data_table(shown), "latex": latex})
    return Section("Returns", "returns", parts=parts)


def _return(row: Mapping[str, Any]) -> str:
    return f"{row['return']:.2f}" + (f" ± {row['return_deviation']:.2f}" if row["seeds"] > 1 else "")


def _paper_comparison(results: Results) -> Section | None:
    """Our numbers beside the paper's. None if no number is in both."""
    if results.comparison is None:
        return None
    ours = [name for name in results.comparison.regressions.columns if name.startswith("ours_")]
    fits = results.comparison.regressions.dropna(subset=ours, how="all")
    fits = fits.drop(columns=["r_squared", "significant_predictors_as_printed"])
    fits = fits.rename(columns={name: name.replace("_", ", ") for name in fits.columns})
    returns = results.comparison.returns[results.comparison.returns["ours"].notna()]
    if len(fits) == len(returns) == 0:
        return None
    text = (
        f"Returns: {len(returns)} of {len(results.comparison.returns)} printed values have one of ours; the difference "
        f"is {returns['difference'].mean():+.2f} in the mean, and {returns['difference'].abs().median():.2f} in the "
        "middle case. The paper trains 50 thousand steps on grids and lakes, else 600 thousand; it prints no rewards, "
        "discounts, probabilities of chance, or what of a run its returns are means of: differences are to be "
        "expected."
    )
    caption = "R² and correlation: printed, ours, and the difference, for both kinds of regret."
    return Section(
        "Beside the paper",
        "beside",
        regressions=data_table(fits, caption) if len(fits) else None,
        text=text if len(returns) else "",
        title_of_returns=f"All {len(returns)} values",
        returns=data_table(returns.drop(columns=["parameters_as_printed"]), digits=2),
    )


def _instances(study: Specification) -> Section | None:
    pictures = [{"name": name, "data": data_url(png)} for name, png in _pictures(study).items()]
    return Section("Instances", "instances", pictures=pictures) if pictures else None


def _pictures(study: Specification) -> dict[str, bytes]:
    """Instance -> PNG of its start state. Environments that draw nothing are left out."""
    from PIL import Image

    from pharos.drawing import human

    pictures: dict[str, bytes] = {}
    for run in study.runs:
        if run.instance in pictures:
            continue
        try:
            environment = run.configuration.make_environment()
            picture = Image.fromarray(human(environment, start_distribution(environment)[0][0], cell=16))
        except PharosError:
            continue
        picture.thumbnail((PICTURE_PIXELS * 2, PICTURE_PIXELS * 2))
        buffer = io.BytesIO()
        picture.save(buffer, format="PNG", optimize=True)
        pictures[run.instance] = buffer.getvalue()
    return pictures


def _each_instance(results: Results, figures: Figures) -> Section:
    parts = []
    for environment in dict.fromkeys(results.runs["environment"]):
        caption = (
            f"Cumulative regret on each instance of {in_words(environment)} under each kind of chance: the mean, its "
            "95 % bootstrap interval, and thin a line for each seed."
        )
        figure = figure_image(figures, f"regret_by_task_{slug(environment)}", caption)
        parts.append({"title": f"{in_words(environment)}, each kind of chance and each seed", "figure": figure})
    text = "Cumulative regret on each instance, all kinds of chance together."
    return Section(
        "Each instance", "each_instance", figure=figure_image(figures, "regret_by_instance", text), parts=parts
    )


def _provenance(results: Results, left_out: Sequence[str]) -> Section:
    import pharos

    date = time.strftime("%Y-%m-%d %H:%M", time.gmtime())
    facts = f"pharos {pharos.__version__}, Python {platform.python_version()}, {date} UTC"
    text = results.study.to_yaml()
    return Section("How it was made", "made", facts=facts, left_out=list(left_out), specification=text)
