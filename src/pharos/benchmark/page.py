"""The report of an agent's results: one HTML file that loads and runs nothing, and LaTeX for a paper.

Frontiers and scores stand beside the baselines'. A difference is said in words only if an interval shows it. Of
theory the page has two things: the dashed line on each ladder, and residuals, tasks that an idealised learner solves
and the agent does not. The page is a tree of elements, so that every text in it is escaped.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

from pharos.benchmark.charts import (
    bars,
    bullets,
    captioned,
    difference_bar,
    document,
    element,
    frontier_text,
    html_table,
    ladder_panel,
    learning_panel,
    legend,
    radar,
    scatter,
    section,
)
from pharos.benchmark.comparison import EQUAL_SEEDS, LEAST_DIFFERENCE, ONE_SEED, WORSE, compare_groups
from pharos.benchmark.contents import (
    LEARNERS,
    PREDICTOR_PHRASES,
    RESIDUAL,
    Contents,
    Source,
    contents_of,
    description,
    excerpt,
    final_regret,
    learning_curve,
    learning_sentence,
    listed,
    number,
    regret_of,
    residual_tasks,
    run_warnings,
    seeds_text,
    sentence,
    signed,
    unclipped_regret,
)
from pharos.benchmark.diagnosis import (
    OWN_RESIDUAL,
    SHIPPED,
    fall_everywhere,
    falls,
    groups_of,
    is_own,
    level_gaps,
    lowest_rungs,
    nearest,
    play_sentences,
    policies_of,
    policy_sentences,
    predictor_sentence,
    random_play,
    seeds_sentence,
    shipped_regret,
    strengths,
    suspicion,
    without_verdict,
    worst_groups,
)
from pharos.benchmark.latex import latex_of
from pharos.benchmark.properties import known_properties, purpose_of
from pharos.benchmark.suite import BenchmarkTask, Ladder, Suite
from pharos.plots import agent_label
from pharos.system import storage
from pharos.system.wording import pluralize

NO_VERDICT = (ONE_SEED, EQUAL_SEEDS)


def report(
    results: Source,
    out: str | os.PathLike,
    *,
    beside: Sequence[Source] | None = None,
    latex: bool = False,
    predictor: str | None = None,
    suite: Suite | str | None = None,
) -> tuple[Path, ...]:
    """Write the page on an agent's results, and return the files.

    Args:
        results: folder of a run, file, shipped baseline by name, or results read.
        out: the page, one self-contained file of HTML.
        beside: agents to stand beside it, as `results`. Default: dqn, ppo and q_learning, if shipped.
        latex: whether to write a table and a paragraph on methods beside the page, with the ending .tex.
        predictor: idealised learner that the agent is compared with: "dqn", "ppo", "table", "both" (the larger regret
            of dqn and ppo) or "none". Default: by the agent's name, and "both" if that says nothing.
        suite: the one that `results` are of, if that is not shipped.
    Raises:
        ParameterError: there are no such results, they are of another suite, or the predictor is none of these.
    Cost: less than a second.
    """
    contents = contents_of(results, beside=beside, predictor=predictor, suite=suite)
    texts = {Path(out): page(contents)} | ({Path(out).with_suffix(".tex"): latex_of(contents)} if latex else {})
    for file, text in texts.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        storage.replace_file(file, text.encode(errors="replace"), follow=True)
    return tuple(texts)


def page(contents: Contents) -> str:
    """The HTML page. Every text passes through the tree, which escapes it."""
    title = f"{contents.agent.name} on the Pharos Benchmark {contents.suite.name}"
    sections = [part for make in SECTIONS if (part := make(contents)) is not None]
    return document(title, _lead(contents), sections)


def _lead(contents: Contents) -> list[Element]:
    own = contents.agent.score
    lines = [element("p", sentence(contents), class_="lead")]
    lines += [element("p", text, class_="warning") for text in seeds_sentence(contents.agents)]
    if broken := fall_everywhere(contents):
        lines.append(element("p", broken, class_="warning"))
    core = f"Core score {number(own.core)} on {pluralize(contents.num_run(contents.suite.core), 'task')}"
    compared = zip(contents.beside, contents.comparisons, strict=True)  # on the tasks that both have run
    core += "".join(f"; {each.name} {both.core.theirs:.2f}" for each, both in compared if both.core is not None)
    rest = {"Final score": own.final, "interquartile mean": own.iqm}
    parts = [*(f"{name} {number(interval)}" for name, interval in rest.items()), unclipped_regret(contents)]
    scale = "A score is 1 for the optimal policy and 0 for random play. Intervals are of 95 %, over seeds."
    scores = f"{f'{core}. ' if own.axes else ''}{', '.join(filter(None, parts))}."
    lines.append(element("p", f"{scores if own.has_core else 'The core was not run.'} {scale}"))
    if own.preliminary:
        seeds = pluralize(len(contents.agent.results.seeds), "seed")
        missing = f", and {pluralize(len(own.missing), 'task')} without results" if own.missing else ""
        text = f"Preliminary: {seeds}{missing}; a result has {contents.suite.protocol.seeds} seeds and all tasks."
        lines.append(element("p", text, class_="warning"))
    results = contents.agent.results
    lines += [element("p", text, class_="warning") for text in (*run_warnings(results), *random_play(results))]
    if own.below_random:
        lines.append(element("p", f"Worse than random play on {', '.join(own.below_random)}.", class_="warning"))
    return lines


def _axes(contents: Contents) -> Element:
    agents = dict(enumerate(contents.agents))
    cores = {k: (each.name, each.score.core) for k, each in agents.items() if each.score.has_core}
    figures = [captioned("core", bars(cores, "core: scores of agents"))] if cores else []
    axes = list(contents.agent.score.axes)
    for axis in axes:
        rows = {k: (each.name, each.score.axes[axis].score) for k, each in agents.items() if axis in each.score.axes}
        figures.append(captioned(axis, bars(rows, f"{axis}: scores of agents")))
    parts = [element("div", *figures, class_="panels")]
    if len(axes) > 2:
        scores = [{axis: own.score.value for axis, own in each.score.axes.items()} for each in contents.agents]
        figure = captioned(
            "", radar(axes, scores, "scores on all axes"), legend([each.name for each in contents.agents])
        )
        parts.append(element("details", element("summary", "The same as a radar"), figure))
    title, means = ("Scores on the core and on each axis", "tasks or rungs") if axes else ("Score on the core", "tasks")
    return section(title, f"Mean over {means}; lines are intervals.", *parts)


def _learning(contents: Contents) -> Element | None:
    names = [task.name for task in contents.suite.core if task.name in contents.agent.results.curves]
    if not names:
        return None
    lines = [learning_curve(each, names) for each in contents.agents]
    without = [each.name for each, own in zip(contents.agents, lines, strict=True) if not own]
    text = f"Normalised regret of the policy at each evaluation, mean over {pluralize(len(names), 'core task')}. "
    text += "Each run's is clipped to [0, 1] at each evaluation here; scores clip its mean over the run. The band is "
    text += f"the interval.{f' Without {listed(without)}, which did not run all of these.' if without else ''}"
    chart = learning_panel(contents.suite.protocol.steps, lines, "regret on the core while learning")
    names = [each.name for each in contents.agents]
    words = element("p", learning_sentence(contents))
    return section("Learning curve", text, words, legend(names), captioned("", chart, class_="wide"))


def _ladders(contents: Contents) -> Element | None:
    axes = contents.agent.score.axes
    ladders = [ladder for ladder in contents.suite.ladders if ladder.axis in axes and not ladder.pairs]
    if not ladders:
        return None
    is_predicted = any(contents.predicted(task) is not None for ladder in ladders for task in ladder.tasks)
    theory = f"theory: {PREDICTOR_PHRASES[contents.predictor]}" if is_predicted else None
    figures = [captioned(ladder.axis, _ladder(contents, ladder), text=ladder.quantity) for ladder in ladders]
    return section(
        "Ladders",
        "Normalised regret along one world that gets harder. The shaded band is the interval of the frontier, where "
        "regret crosses 0.5. Rungs stand equally far apart, whatever their levels.",
        legend([each.name for each in contents.agents], theory),
        element("div", *figures, class_="panels"),
    )


def _ladder(contents: Contents, ladder: Ladder) -> Element:
    frontier = contents.agent.score.axes[ladder.axis].frontier
    lines = [[regret_of(each, task) for task in ladder.tasks] for each in contents.agents]
    title = f"{ladder.axis}: regret by {ladder.quantity}; frontier of {contents.agent.name} "
    title += frontier_text(frontier, ladder.unit)
    levels = [task.level or 0.0 for task in ladder.tasks]
    theory = [contents.predicted(task) for task in ladder.tasks]
    return ladder_panel(levels, lines, theory, frontier, ladder.unit, title)


def _pairs(contents: Contents) -> Element | None:
    rows: list[list[str | Element]] = []
    for ladder in contents.suite.ladders:
        for pair in ladder.pairs:
            regrets = [[regret_of(each, task) for task in pair] for each in contents.agents]
            cells = ["–" if a is None or b is None else f"{a.value:.2f}, {b.value:.2f}" for a, b in regrets]
            rows.append([ladder.axis, pair[0].name, pair[1].name, *cells])
    if not rows:
        return None
    heads = ["axis", "first", "second", *(each.name for each in contents.agents)]
    return section(
        "Pairs",
        "One world in two ways, and the regret in both. The score of the axis is 1 less what the second task costs, so "
        "an agent that fails both loses nothing: read it only if the first is learnt.",
        html_table(heads, rows, numeric=range(3, len(heads))),
    )


def _core(contents: Contents) -> Element | None:
    names = {task.name for task in contents.suite.core}
    if (near := nearest(contents)) is None:
        return None
    index, distance, same = near
    other = contents.beside[index]
    differences = {name: each for name, each in contents.comparisons[index].tasks.items() if name in names}
    rows: list[list[str | Element]] = []
    for name, each in sorted(differences.items(), key=lambda item: item[1].interval.value):
        scores = (f"{agent.score.tasks[name].value:.2f}" for agent in (contents.agent, other))
        task = contents.suite.task(name)
        fixed = known_properties().get(task.digest)
        constant = "–" if fixed is None else f"{min(1.0, max(0.0, 1.0 - fixed.constant)):.2f}"
        rows.append(
            [_task(task), *scores, constant, signed(each.interval), difference_bar(each.interval), each.verdict]
        )
    heads = ["task", "score", other.name, "one action", "difference", "", "verdict"]
    verdict = "The verdict is after Holm's correction over tasks."
    if reasons := {each.verdict for each in differences.values()} & {*NO_VERDICT}:
        heads, rows, verdict = heads[:-1], [row[:-1] for row in rows], f"{min(reasons).capitalize()}: no verdict."
    return section(
        f"Core tasks beside {other.name}",
        f"Of the baselines, {other.name} is {'of the same kind' if same else 'the nearest'}: scores are "
        f"{distance:.2f} apart on the average task. Sorted by difference, the worst first. {verdict} "
        "One action: the best policy that always plays the same one.",
        html_table(heads, rows, numeric=(1, 2, 3, 4)),
        *([folded] if (folded := _purposes(contents)) is not None else []),
    )


def _purposes(contents: Contents) -> Element | None:
    """A folded table of what each core task asks, and what failing it means."""
    tasks = [(task, purpose) for task in contents.suite.core if (purpose := purpose_of(task)) is not None]
    rows: list[list[str | Element]] = [[_task(task), purpose.asks, purpose.failing] for task, purpose in tasks]
    if not rows:
        return None
    table = element("div", html_table(["task", "asks to", "failing means, most often"], rows), class_="words")
    return element("details", element("summary", "What each task asks, and what failing it means"), table)


def _policies(contents: Contents) -> Element | None:
    sentences = [*policy_sentences(contents), *play_sentences(contents)]
    if not sentences:
        return None
    scores, facts = contents.agent.score.tasks, policies_of(contents.agent.results)
    rows: list[list[str | Element]] = []
    for task in contents.suite.core:
        if (own := facts.get(task.name)) is not None:
            greedy = f"{own['greedy_score']:.2f}" if "greedy_score" in own else "the same"
            cells = (
                f"{scores[task.name].value:.2f}",
                greedy,
                *(f"{100 * own[each]:.0f} %" for each in ("one_action", "deterministic")),
            )
            rows.append([_task(task), *cells])
    heading = "What the policies are like"
    if not rows:
        return section(heading, "", bullets(sentences))
    rows.sort(key=lambda row: -float(str(row[3]).removesuffix(" %")))
    heads = ["task", "score", "played greedily", "one action in", "runs that end deterministic"]
    table = element("details", element("summary", "Task by task"), html_table(heads, rows, numeric=(1, 2, 3, 4)))
    return section(
        heading,
        "Of all states of a task that are not terminal, reached or not. Played greedily: the most probable action of "
        "each snapshot, evaluated exactly.",
        bullets(sentences),
        table,
    )


def _gaps(contents: Contents) -> Element | None:
    rows = level_gaps(contents)
    if not rows:
        return None
    heads = ["generator", "training levels", "score on these", "on held-out levels", "gap"]
    heads += [f"gap of {each.name}" for each in contents.beside]
    return section(
        "Levels seen and held out",
        "The gap is the normalised regret on held-out levels less that on the levels of training, by seed.",
        html_table(heads, rows, numeric=range(1, len(heads))),
    )


def _groups(contents: Contents) -> Element | None:
    if (near := nearest(contents)) is None:
        return None
    ours, other = contents.agent.results, contents.beside[near[0]]
    by_seen, by_property = groups_of(contents)
    groups = {**by_seen, **by_property}
    tables = [compare_groups(ours, other.results, each) for each in (by_seen, by_property)]
    texts = worst_groups(tables, groups, ours, other.results)
    parts = []
    for caption, differences, text in zip(("by what is seen", "by property"), tables, texts, strict=True):
        if len(differences) < 2:
            continue
        rows: list[list[str | Element]] = []
        for group, each in differences.items():
            scores = (f"{score:.2f}" for score in (each.ours, each.theirs))
            bar = difference_bar(each.interval)
            rows.append([group, str(len(groups[group])), *scores, signed(each.interval), bar, each.verdict])
        heads = [caption, "tasks", "score", other.name, "difference", "", "verdict"]
        parts.append(html_table(heads, rows, numeric=(1, 2, 3, 4)))
        parts += [element("p", text)] if text else []
    if parts and (text := suspicion(ours, other.results, groups)):
        parts.append(element("p", text))
    if not parts:
        return None
    return section(
        f"Core tasks in groups, beside {other.name}",
        "Means over the tasks of a group. A fault that spares one group and hits another has its name here: a kind of "
        "observation (features, the network's input), several sizes of rewards (clipping), ends by time alone "
        "(truncation taken for an end). The verdicts of each table are after Holm's correction over its rows.",
        *parts,
    )


def _plane(contents: Contents) -> Element | None:
    name = contents.predictor if contents.predictor in LEARNERS else LEARNERS[0]
    points = [
        (f"{task.name}: {description(task)}", table, task.predicted[name] - table, own.value)
        for task in contents.suite.tasks
        if (own := regret_of(contents.agent, task)) is not None and {"table", name} <= task.predicted.keys()
        for table in [task.predicted["table"]]
    ]
    if len(points) < 2:
        return None
    below = "regret of an idealised table"
    beside = f"extra regret of the idealised {name.upper()}", "over a table (negative: it generalises)"
    dots = scatter(points, below, beside, "tasks by predicted difficulty, coloured by regret")
    return section(
        "What makes a task hard, and where the agent fails",
        "Each dot is a task, placed by what theory predicts before any run: to the right, even a learner with a table "
        "needs longer; above, a network loses more than a table. The colour is the agent's regret.",
        captioned("", dots, class_="wide"),
    )


def _words(contents: Contents) -> Element | None:
    if not contents.comparisons or not contents.agent.score.axes:
        return None
    title = "Strengths and weaknesses in words"
    if broken := fall_everywhere(contents):
        return section(title, "", element("p", broken))
    lines = strengths(contents)
    parts = [part for verdict, texts in lines.items() for part in (element("h3", verdict.capitalize()), bullets(texts))]
    for reason, names in without_verdict(contents).items():
        parts.append(element("p", f"{reason.capitalize()}: no verdict beside {listed(names)}."))
    if lines and WORSE not in lines:
        parts.insert(0, element("p", "On no axis is the score shown to lie below a baseline's."))
    parts += [element("p", text) for text in lowest_rungs(contents)]
    if rows := falls(contents):
        parts.append(element("p", "Each axis as a fall from its own first rung: a fall is what the axis adds."))
        beside = [f"{each.name}: lowest rung, fall" for each in contents.beside]
        heads = ["axis", "score on the lowest rung", "fall above it", *beside]
        parts.append(html_table(heads, rows, numeric=range(1, len(heads))))
    return section(
        title,
        "By the scores of axes, as `pharos benchmark compare` says them, after Holm's correction over axes; frontiers "
        f"say how much that is in the unit of the axis. Scores less than {LEAST_DIFFERENCE:g} apart have no verdict.",
        *parts,
    )


def _residuals(contents: Contents) -> Element | None:
    title = "Residuals: worse than theory says"
    if contents.predictor == "none":
        return section(title, "No idealised learner is known for this kind of agent.")
    if all(contents.predicted(task) is None for task in contents.suite.tasks):
        return None
    rows = residual_tasks(contents)
    means = PREDICTOR_PHRASES[contents.predictor]
    text = (
        f"Tasks where the regret is more than {RESIDUAL:g} above that of {means}, predicted before any run. Theory "
        "says that an agent of this kind solves them better: look for a bug or a hyperparameter. At the end is "
        "the regret of the last evaluation: near 0, the agent is slow; near 1, it never learns the task."
    )
    parts = [element("p", predictor_sentence(contents))]
    if not rows:
        return section(title, f"On no task the regret is more than {RESIDUAL:g} above that of {means}.", *parts)
    lists: tuple[list[list[str | Element]], list[list[str | Element]]] = ([], [])
    is_beside = False
    for task, own, expected in rows:
        final, shipped = final_regret(contents.agent, task), shipped_regret(contents, task)
        is_beside = is_beside or shipped is not None
        cells = (own.value, expected), (final, *(() if shipped is None else (shipped,)))
        first, last = ([f"{x:.2f}" for x in each] for each in cells)
        row: list[str | Element] = [_task(task), *first, f"{own.value - expected:+.2f}", *last]
        lists[not is_own(contents, task, own.value)].append(row)
    heads = ["task", "observed", "predicted", "residual", "at the end", *(["shipped"] if is_beside else [])]
    names = f"{' and '.join(agent_label(name) for name in SHIPPED[contents.predictor])} of pharos"
    captions = (
        f"Worse than theory, and by more than {OWN_RESIDUAL:g} than {names} (the worse of two): look for a bug here.",
        f"Theory is too hopeful: {names} fares alike.",
    )
    for caption, cells_of_list in zip(captions, lists, strict=True):
        if cells_of_list:
            parts += [element("p", caption)] * is_beside
            parts.append(html_table(heads, cells_of_list, numeric=range(1, len(heads))))
    return section(title, text, *parts)


def _task(task: BenchmarkTask) -> Element:
    """The name of a task, with its description as a tooltip."""
    return element("span", task.name, title=description(task))


def _provenance(contents: Contents) -> Element:
    own, protocol = contents.agent.results, contents.suite.protocol
    exact = own.record.get("exact")
    exact = exact if isinstance(exact, Mapping) else {}
    count = sum(bool(value) for value in exact.values())
    how = "all tasks" if count == len(exact) else f"{count} of {pluralize(len(exact), 'task')}, else estimated"
    facts = {
        "suite": f"{contents.suite.name}, digest {contents.suite.digest}",
        "protocol": f"{protocol.steps:,} steps, {pluralize(protocol.evaluations, 'evaluation')}, "
        f"gamma {protocol.gamma:g}, horizon {protocol.horizon}",
        "seeds": ", ".join(map(str, own.seeds)),
        "evaluation": f"exact on {how}" if exact else "see agent.json",
        **({"steps used": f"{steps:,}"} if isinstance(steps := own.record.get("steps_used"), int) else {}),
        **{f"baseline {each.name}": seeds_text(each.results) for each in contents.beside},
        "division": str(own.record.get("division") or "one setting for all tasks"),
        **{name: excerpt(value) for name, value in own.record.items() if value and name not in ON_PAGE},
    }
    claims = [
        "Proven: V* and the value of uniform play of each task, solved when the suite was frozen.",
        "Claimed, until `pharos benchmark verify` computes them again from a submission: values of the final policies.",
        "Claimed: curves while learning, and so scores and frontiers; the steps used; that one setting was used for "
        "all tasks. Policies cannot show these; only running the code again does.",
    ]
    rows: list[Sequence[str | Element]] = [[name, text] for name, text in facts.items()]
    table = element("div", html_table(["what", "value"], rows), class_="words")
    return section("What is proven, and what is claimed", "", bullets(claims), table)


SECTIONS: tuple[Callable[[Contents], Element | None], ...] = (
    _axes,
    _learning,
    _ladders,
    _pairs,
    _words,
    _gaps,
    _policies,
    _core,
    _groups,
    _plane,
    _residuals,
    _provenance,
)


ON_PAGE = ("exact", "division", "steps_used", "failed", "notes", "policies", "play")
"""Entries of the record that the page says in words."""
