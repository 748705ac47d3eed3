"""Words of the report, which follow from its numbers: verdicts of `compare`, falls of axes, what a mistake looks like.

Nothing here tests anything anew: a verdict is taken from the score in `compare`, after Holm's correction, so that page
and command cannot contradict each other. A frontier is the unit in which it is reported.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from pharos.benchmark.charts import frontier_text
from pharos.benchmark.comparison import (
    BETTER,
    LEAST_DIFFERENCE,
    NEGLIGIBLE,
    NOT_SHOWN_TO_DIFFER,
    WORSE,
    AxisComparison,
    Comparison,
    Difference,
    compare_groups,
)
from pharos.benchmark.contents import (
    PREDICTOR_PHRASES,
    Contents,
    ScoredAgent,
    fails_on_the_lowest_rung,
    learner_kind,
    listed,
    number,
    residual_tasks,
    signed,
)
from pharos.benchmark.levels import twins
from pharos.benchmark.play import play_symptoms
from pharos.benchmark.properties import known_properties
from pharos.benchmark.results import AgentResults, baselines
from pharos.benchmark.scores import ConfidenceInterval, equal_seeds, run_scores
from pharos.benchmark.suite import BenchmarkTask
from pharos.system.wording import pluralize

SHIPPED = {"dqn": ("dqn",), "ppo": ("ppo",), "table": ("q_learning",), "both": ("dqn", "ppo")}
OWN_RESIDUAL = 0.1  # by which the regret of a residual is above the regret of the shipped agent of the kind
LOSS = 0.1  # of score, on a group of tasks or an axis, that is a symptom
SUSPECTS = frozenset({"vector", "simple_image", "rewards of several sizes", "ended by time alone"})
"""Groups of tasks that one mistake hits."""
ONE_ACTION = 0.9  # share of states in which a policy prefers the same action, to be told so
SHOWN_TASKS = 5  # names of tasks in a sentence
VERDICTS = (WORSE, BETTER, NEGLIGIBLE, NOT_SHOWN_TO_DIFFER)


def nearest(contents: Contents) -> tuple[int, float, bool] | None:
    """Index of the baseline to compare the agent with, mean distance of their scores, whether of the same kind.

    Among baselines of the agent's kind, else among all, the one with the nearest scores on core tasks, or None without
    any.
    """
    names = {task.name for task in contents.suite.core}
    distances = {}
    for k, comparison in enumerate(contents.comparisons):
        own = [abs(each.interval.value) for name, each in comparison.tasks.items() if name in names]
        if own:
            distances[k] = sum(own) / len(own)
    if not distances:
        return None
    kind = learner_kind(contents.agent.results)
    same = [k for k in distances if kind == learner_kind(contents.beside[k].results) and kind not in ("both", "none")]
    nearest = min(same or distances, key=distances.__getitem__)
    return nearest, distances[nearest], bool(same)


def strengths(contents: Contents) -> dict[str, list[str]]:
    """Lines on the axes for each verdict of `compare` that occurs, in the order of VERDICTS. Without a comparison,
    none.

    A line: the axis with the agent's frontier, then each baseline's frontier and the difference of scores.
    """
    lines: dict[str, list[str]] = {verdict: [] for verdict in VERDICTS}
    for axis, own in contents.agent.score.axes.items():
        others: dict[str, list[str]] = {verdict: [] for verdict in VERDICTS}
        for other, comparison in zip(contents.beside, contents.comparisons, strict=True):
            if axis in comparison.axes and (score := comparison.axes[axis].score).verdict in others:
                frontier = frontier_text(comparison.axes[axis].frontiers[1], interval=False)
                others[score.verdict].append(f"{other.name} {frontier}, score {signed(score.interval)}")
        for verdict, texts in others.items():
            if texts:
                lines[verdict].append(f"{axis}: {frontier_text(own.frontier, own.unit)}; {'; '.join(texts)}")
    return {verdict: texts for verdict, texts in lines.items() if texts}


def without_verdict(contents: Contents) -> dict[str, list[str]]:
    """Names of baselines beside which an axis has no verdict, by the reason: "one seed" or "equal seeds"."""
    reasons: dict[str, list[str]] = {}
    for other, comparison in zip(contents.beside, contents.comparisons, strict=True):
        for reason in {each.score.verdict for each in comparison.axes.values()} - {*VERDICTS}:
            reasons.setdefault(reason, []).append(other.name)
    return reasons


def is_worse_everywhere(comparison: Comparison) -> bool:
    """Whether the core and all ladders, two or more, are worse. Pairs compare an agent with itself, so they do not
    count."""
    verdicts = [each.score.verdict for each in ladders_of(comparison).values()]
    return comparison.core is not None and len(verdicts) > 1 and {comparison.core.verdict, *verdicts} == {WORSE}


def ladders_of(comparison: Comparison) -> dict[str, AxisComparison]:
    """The axes that are ladders, on which more than one rung was run, without pairs."""
    return {axis: each for axis, each in comparison.axes.items() if not math.isnan(each.frontiers[0].value)}


def fall_everywhere(contents: Contents) -> str:
    """A sentence if the core and all axes are worse than the nearest baseline's, else empty."""
    if (near := nearest(contents)) is None or not is_worse_everywhere(contents.comparisons[near[0]]):
        return ""
    return (
        f"Falls everywhere: the core and all {len(ladders_of(contents.comparisons[near[0]]))} axes are below "
        f"{contents.beside[near[0]].name}'s. Look for a bug first; axes say nothing before it is mended."
    )


def lowest_rungs(contents: Contents) -> list[str]:
    """A sentence for each axis that the agent fails on its lowest rung already."""
    sentences = []
    for axis, own in contents.agent.score.axes.items():
        if fails_on_the_lowest_rung(own):
            others = [
                f"{each.name} {each.score.axes[axis].lowest.value:.2f}"
                for each in contents.beside
                if axis in each.score.axes and not math.isnan(each.score.axes[axis].lowest.value)
            ]
            beside = f" ({', '.join(others)})" if others else ""
            sentences.append(
                f"Fails on the lowest rung of {axis} already, with a score of {number(own.lowest)}{beside}: not a "
                f"matter of {axis}, but of its world."
            )
    return sentences


def falls(contents: Contents) -> list[list[str]]:
    """Rows on each axis whose first rung was run, and another one: score there, and fall above it, of all agents.

    The fall is the score on the first rung less the mean of those above it.
    """
    rows = []
    for axis, own in contents.agent.score.axes.items():
        if math.isnan(own.fall.value):
            continue
        others = [
            f"{each.score.axes[axis].lowest.value:.2f}, {each.score.axes[axis].fall.value:.2f}"
            if axis in each.score.axes and not math.isnan(each.score.axes[axis].fall.value)
            else "–"
            for each in contents.beside
        ]
        rows.append([axis, number(own.lowest), number(own.fall), *others])
    return rows


def level_gaps(contents: Contents) -> list[list[str]]:
    """Rows on each pair of levels seen and held out that was run: both scores of the agent, and the gap of all agents.

    The gap is regret on held-out levels less that on training levels, by seed.
    """
    rows = []
    runs = [run_scores(each.results) for each in contents.agents]
    for own_levels, held_out in twins(contents.suite):
        texts = [
            signed(ConfidenceInterval.of_mean([own[own_levels.name] - own[held_out.name]]))
            if {own_levels.name, held_out.name} <= own.keys()
            else "–"
            for own in runs
        ]
        if texts[0] != "–":
            scores = (number(contents.agent.score.tasks[each.name]) for each in (own_levels, held_out))
            rows.append([held_out.axis, str(own_levels.parameters["train"]), *scores, *texts])
    return rows


def groups_of(contents: Contents) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Names of core tasks by what is seen, and by property: reward sizes, length, ends, chance, number of actions.

    Properties with one group say nothing, and are left out. So are tasks that `known_properties` lacks.
    """
    by_observation: dict[str, list[str]] = {}
    kinds: list[dict[str, list[str]]] = []
    for task in contents.suite.core:
        if task.name not in contents.agent.score.tasks:
            continue
        by_observation.setdefault(task.observation, []).append(task.name)
        if (own := known_properties().get(task.digest)) is not None:
            for index, group in enumerate(own.groups):
                kinds += [{}] * (index == len(kinds))
                kinds[index] = {**kinds[index], group: [*kinds[index].get(group, []), task.name]}
    return by_observation, {group: names for kind in kinds if len(kind) > 1 for group, names in sorted(kind.items())}


def outside(ours: AgentResults, theirs: AgentResults, group: Sequence[str], other: Sequence[str]) -> float:
    """Difference of the mean scores on the tasks of a group that another group lacks. NaN if it has all or none."""
    rest = sorted({*group} - {*other})
    if not rest or len(rest) == len({*group}):
        return math.nan
    differences = compare_groups(ours, theirs, {"": rest})
    return differences[""].interval.value if differences else math.nan


def is_of(loss: float, outside_of_it: float) -> bool:
    """Whether a loss on a group is that of another group: less than half of it is left outside of the other one."""
    return outside_of_it > loss / 2


def worst_groups(
    tables: Sequence[Mapping[str, Difference]],
    groups: Mapping[str, Sequence[str]],
    ours: AgentResults,
    theirs: AgentResults,
) -> list[str]:
    """For each table a sentence on the group with the largest significant loss, if others are shown to lose less than
    half of it, else an empty one.

    Groups of two tables share tasks. So if the loss is that of the other table's group, this is said.
    """
    worst = [_worst_of(table) for table in tables]
    texts = []
    for own, table in zip(worst, tables, strict=True):
        loss = table[own].interval.value if own else 0.0
        spared = [name for name, each in table.items() if each.interval.low > loss / 2]
        if not own or not spared:
            texts.append("")
            continue
        text = f"The largest loss is on {own}, {loss:+.2f}. Less than half of that on {listed(spared)}."
        for other, table_of_other in zip(worst, tables, strict=True):
            if other and other != own:
                rest = outside(ours, theirs, groups[own], groups[other])
                back = outside(ours, theirs, groups[other], groups[own])
                if is_of(loss, rest) and not is_of(table_of_other[other].interval.value, back):
                    text += f" It is a loss on {other}: tasks of {own} without these have {rest:+.2f}."
        texts.append(text)
    return texts


def suspicion(ours: AgentResults, theirs: AgentResults, groups: Mapping[str, Sequence[str]]) -> str:
    """A sentence on the group of SUSPECTS that loses most, if too few seeds show it: 0.05 before Holm's correction.

    The loss is LOSS or more, and other tasks lose less than half of it. Empty if some group of SUSPECTS is shown to
    lose, or none is suspicious.
    """
    differences = compare_groups(ours, theirs, groups)
    every = sorted({name for names in groups.values() for name in names})
    suspects = []
    for name in SUSPECTS.intersection(differences):
        each = differences[name]
        rest = outside(ours, theirs, every, groups[name])
        if each.verdict == WORSE:
            return ""
        if each.verdict == NOT_SHOWN_TO_DIFFER and each.interval.high < 0 and each.interval.value <= -LOSS:
            suspects += [(each.interval.value, name, rest)] * is_of(each.interval.value, rest)
    if not suspects:
        return ""
    loss, name, rest = min(suspects)
    return (
        f"Not shown, but suspicious: {name}, {loss:+.2f}, beside {rest:+.2f} on the other tasks. "
        f"{pluralize(len(ours.seeds), 'seed')} are too few to tell; run more."
    )


def _worst_of(table: Mapping[str, Difference]) -> str:
    """The group with the largest significant loss, or empty."""
    losses = {name: each.interval.value for name, each in table.items() if each.verdict == WORSE}
    return min(losses, key=losses.__getitem__) if losses else ""


def shipped_regret(contents: Contents, task: BenchmarkTask) -> float | None:
    """Normalised regret on a task of the shipped agent of the predictor's kind, the larger of two, or None without
    one."""
    regrets = []
    for name in SHIPPED.get(contents.predictor, ()):
        beside = [each.results for each in contents.beside if each.results.agent == name]
        shipped = beside or (
            [AgentResults.read(f"{contents.suite.name}/{name}")] if name in baselines(contents.suite.name) else []
        )
        regrets += [float(1.0 - run_scores(each)[task.name].mean()) for each in shipped if task.name in each.curves]
    return max(regrets, default=None)


def is_own(contents: Contents, task: BenchmarkTask, regret: float) -> bool:
    """Whether a residual is the agent's own: it is more than 0.1 worse than the shipped agent, or there is none."""
    shipped = shipped_regret(contents, task)
    return shipped is None or regret - shipped > OWN_RESIDUAL


def predictor_sentence(contents: Contents) -> str:
    """Sentence on which idealised learner was taken, and the number of tasks that the others would list."""
    counts = {
        name: len(residual_tasks(replace(contents, predictor=name)))
        for name in PREDICTOR_PHRASES
        if name != contents.predictor
    }
    others = listed([f"{count} beside {PREDICTOR_PHRASES[name]}" for name, count in counts.items()])
    request = (
        "The agent's name does not say its kind, so the worse of two was taken, which lists the fewest; say it: "
        "--predictor dqn, ppo, table or none. "
    )
    is_unsaid = contents.predictor == learner_kind(contents.agent.results) == "both"
    return f"{request if is_unsaid else ''}Others would list {others}."


def random_play(results: AgentResults) -> list[str]:
    """Sentences if most runs are random play at all evaluations, or at all but the last one.

    A few may be so by chance: on some tasks always playing one action has the value of uniform play.
    """
    random = [abs(curve - 1.0) < 1e-9 for curve in results.curves.values()]
    never = sum(int(each.all(axis=1).sum()) for each in random)
    at_end = sum(int((each[:, :-1].all(axis=1) & ~each[:, -1]).sum()) for each in random if each.shape[1] > 1)
    runs, evaluations = sum(map(len, random)), max((each.shape[1] for each in random), default=0)
    texts = {
        f"all {evaluations} evaluations are random play: was no policy yielded?": never,
        f"{evaluations - 1} of {evaluations} evaluations are random play, the first policy counts at the end: yield "
        "earlier": at_end,
    }
    return [f"In {count:,} of {pluralize(runs, 'run')} {text}." for text, count in texts.items() if 2 * count > runs]


def policies_of(results: AgentResults) -> dict[str, Mapping[str, float]]:
    """Facts on the policies by task, of tasks with curves: `one_action`, `deterministic`, and maybe `greedy_score`.

    Results that were made before there were such facts, and agents of pharos and classes, have none.
    """
    stored = results.record.get("policies")
    entries = stored.items() if isinstance(stored, Mapping) else ()
    return {
        name: facts
        for name, facts in entries
        if name in results.curves
        and isinstance(facts, Mapping)
        and all(_is_share(facts.get(each)) for each in ("one_action", "deterministic"))
        and _is_share(facts.get("greedy_score", 0.0))
    }


def _is_share(value: object) -> bool:
    return isinstance(value, int | float) and 0 <= value <= 1


def policy_sentences(contents: Contents) -> list[str]:
    """Sentences on the final policies on core tasks: one action nearly everywhere, chance, and noise in play."""
    names = {task.name for task in contents.suite.core}
    facts = {name: each for name, each in policies_of(contents.agent.results).items() if name in names}
    if not facts:
        return []
    count, sentences = pluralize(len(facts), "core task"), []
    fixed = [name for name, each in facts.items() if each["one_action"] >= ONE_ACTION]
    if fixed:
        more = f" and {len(fixed) - SHOWN_TASKS} more" if len(fixed) > SHOWN_TASKS else ""
        shown = f"{', '.join(fixed[:SHOWN_TASKS])}{more}"
        sentences.append(
            f"One action in {100 * ONE_ACTION:.0f} % of states and more: on {len(fixed)} of {count} the final policy "
            f"prefers the same action nearly everywhere ({shown}). If the observation does not reach the policy, or "
            f'the step size is too large, this is what comes out; the column "one action" of core tasks says what '
            f"that scores."
        )
    certain = [name for name, each in facts.items() if each["deterministic"] == 1]
    sentences.append(f"Deterministic on {len(certain)} of {count} at the end, in all runs.")
    greedy = [name for name, each in facts.items() if "greedy_score" in each]
    if greedy:
        runs = run_scores(contents.agent.results)
        own = sum(float(runs[name].mean()) for name in facts) / len(facts)
        best = sum(facts[name].get("greedy_score", float(runs[name].mean())) for name in facts) / len(facts)
        noise = (
            f"of {1 - own:.2f} below optimal, {best - own:.2f} is noise in play"
            if best - own >= LEAST_DIFFERENCE
            else "noise in play costs nothing"
            if best - own > -LEAST_DIFFERENCE
            else f"it plays {own - best:.2f} better with its chance"
        )
        sentences.append(
            f"Played greedily, the same snapshots score {best:.2f} instead of {own:.2f} on {count}: {noise}."
        )
    return sentences


def seeds_sentence(agents: Sequence[ScoredAgent]) -> list[str]:
    """A sentence on each agent whose seeds are one run: the first paragraph of a page on it."""
    texts = [(each.name, equal_seeds(each.results.curves)) for each in agents]
    return [f"{name}: {text}. Here nothing of it has an interval or a verdict." for name, text in texts if text]


def play_sentences(contents: Contents) -> list[str]:
    """Sentences on what an agent played at the end of training, beside the nearest baseline. Most have none."""
    if (near := nearest(contents)) is None:
        return []
    other = contents.beside[near[0]]
    symptoms = play_symptoms(contents.agent.results, other.results, other.name)
    return [f"{each.wrong[0].upper()}{each.wrong[1:]}: {each.advice}." for each in symptoms]
