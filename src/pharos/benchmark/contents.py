"""Contents of a report: scores of an agent and of baselines, comparisons, and predictions of theory."""

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from pharos.agents import agents
from pharos.benchmark.charts import ends, frontier_text
from pharos.benchmark.comparison import (
    BETTER,
    NEGLIGIBLE,
    NOT_SHOWN_TO_DIFFER,
    WORSE,
    Comparison,
    compare,
    results_of,
    suite_of_results,
)
from pharos.benchmark.results import RESULTS_FILE, AgentResults, baselines
from pharos.benchmark.scores import (
    CROSSING,
    AxisScore,
    BenchmarkScore,
    ConfidenceInterval,
    as_one_run,
    run_regrets,
    run_scores,
    score,
)
from pharos.benchmark.suite import BenchmarkTask, Suite
from pharos.errors import ParameterError
from pharos.plots import agent_label
from pharos.system import storage
from pharos.system.wording import pluralize

DEFAULT_BASELINES = ("dqn", "ppo", "q_learning")
LEARNERS = ("dqn", "ppo")  # idealised, with networks
RESIDUAL = 0.2
NO_LADDERS = " The ladders were not run, so there are no frontiers."
LATE_GAIN = 0.2  # of an agent that learns late, by which the final score exceeds the mean one, with its whole interval
ENDS_WORSE = 0.05  # the same of one that ends worse than it was, by which the final score is lower
MOST_REASONS = 5  # reasons of failures on the page
MOST_RECORD_LETTERS = 400  # letters of an entry of the record on the page
PHRASES = {
    "exploration": "explores to",
    "estimation": "stands noise of",
    "credit": "assigns credit over",
    "representation": "copes with representations that cost",
    "memory": "remembers",
    "scale": "scales to",
    "exploration_free": "explores free ways of",
    "exploration_costly": "explores costly ways of",
    "large_rewards": "stands rewards larger by",
    "small_rewards": "stands rewards smaller by",
}
PREDICTOR_PHRASES = {
    "dqn": "the idealised DQN",
    "ppo": "the idealised PPO",
    "table": "the idealised DQN with a table",
    "both": "the worse of the idealised DQN and PPO",
}

Source = AgentResults | str | os.PathLike


@dataclass(frozen=True)
class ScoredAgent:
    """An agent on the page: its name, its results and their scores."""

    name: str
    results: AgentResults
    score: BenchmarkScore


@dataclass(frozen=True)
class Contents:
    """Data of a report, computed once: an agent, its baselines, comparisons and predictions.

    Attributes:
        suite: of the results. agent: the one that it is about. beside: baselines.
        comparisons: of the agent with each of `beside`.
        predictor: "dqn", "ppo", "table" or "both" (the larger of dqn and ppo), by which residuals are taken, or "none".
    """

    suite: Suite
    agent: ScoredAgent
    beside: Sequence[ScoredAgent]
    comparisons: Sequence[Comparison]
    predictor: str

    @property
    def agents(self) -> list[ScoredAgent]:
        """The agent of the report, then its baselines."""
        return [self.agent, *self.beside]

    def predicted(self, task: BenchmarkTask) -> float | None:
        """Normalised regret of the idealised learner on a task, or None without a prediction."""
        if self.predictor == "both":
            pair = [task.predicted[name] for name in LEARNERS if name in task.predicted]
            return max(pair) if len(pair) == 2 else None
        return task.predicted.get(self.predictor)

    def num_run(self, tasks: Sequence[BenchmarkTask]) -> int:
        """Number of these tasks that the agent ran."""
        return sum(task.name in self.agent.score.tasks for task in tasks)


def contents_of(
    results: Source,
    *,
    beside: Sequence[Source] | None = None,
    predictor: str | None = None,
    suite: Suite | str | None = None,
) -> Contents:
    """Contents of a report. Arguments and errors are the same as for `report`."""
    own = results_of(results)
    suite = suite_of_results(own, suite)
    if beside is None:
        beside = [
            f"{suite.name}/{name}" for name in DEFAULT_BASELINES if name in baselines(suite.name) and name != own.agent
        ]
    if predictor not in (None, "none", *PREDICTOR_PHRASES):
        raise ParameterError(f"predictor {predictor}; expected one of {', '.join(PREDICTOR_PHRASES)}, none")
    others = [results_of(each) for each in beside]
    agents: list[ScoredAgent] = []
    for source, each in zip((results, *beside), (own, *others), strict=True):
        names = [agent.name.lower() for agent in agents]
        name = next(name for name in _names(source, each.agent, not agents) if name.lower() not in names)
        agents.append(ScoredAgent(name, each, score(each, suite)))
    comparisons = [compare(own, each, suite=suite) for each in others]
    return Contents(suite, agents[0], agents[1:], comparisons, predictor or learner_kind(own))


def learner_kind(results: AgentResults) -> str:
    """The idealised learner that an agent is a kind of, by its name and source, or "both" if these do not decide it."""
    names = f"{results.agent} {results.record.get('source')}".lower()
    if "recurrent" in names:  # no idealised learner has a memory
        return "none"
    kinds = {word: each.idealised.kind for each in agents().values() for word in (each.name, *each.relatives)}
    return next((kind for word, kind in kinds.items() if word in names), "both")


def _names(source: Source, label: str, is_first: bool) -> Iterator[str]:
    """Candidate names of an agent, best first: pharos' spelling, then with the folder of its results, with a number.

    The agent that the report is about, and agents of a file or a module, have the label that they ran with.
    """
    name = label if is_first or ":" in label else agent_label(label)
    yield name
    if not isinstance(source, AgentResults) and Path(source).exists():
        path = Path(source).resolve()
        yield f"{name} ({path.parent.name if path.name == RESULTS_FILE else path.name.removesuffix('.safetensors')})"
    yield from (f"{name} ({k})" for k in count(2))


def regret_of(agent: ScoredAgent, task: BenchmarkTask) -> ConfidenceInterval | None:
    """Normalised regret of an agent on a task, clipped to [0, 1], or None if it did not run."""
    own = agent.score.tasks.get(task.name)
    return None if own is None else ConfidenceInterval(1 - own.value, 1 - own.high, 1 - own.low)


def fails_on_the_lowest_rung(own: AxisScore) -> bool:
    """Whether regret on the first rung is above 0.5 by its whole interval. Not for memory, which that rung asks for."""
    return own.axis != "memory" and not math.isnan(own.lowest.low) and own.lowest.high < CROSSING


def sentence(contents: Contents) -> str:
    """Sentence on what the agent can do, in units: a frontier for each axis, with the baselines' frontiers.

    Of an axis whose lowest rung it fails it has no such unit, so the scores there are said.
    """
    clauses = []
    for axis, own in contents.agent.score.axes.items():
        if math.isnan(own.frontier.value):  # of one rung
            continue
        beside = [(each.name, each.score.axes[axis]) for each in contents.beside if axis in each.score.axes]
        if fails_on_the_lowest_rung(own):
            scores = listed([f"{own.lowest.value:.2f}", *(f"{name} {each.lowest.value:.2f}" for name, each in beside)])
            clauses.append(f"fails on the lowest rung of {axis} already ({scores})")
            continue
        others = [f"{name} {frontier_text(each.frontier, interval=False)}" for name, each in beside]
        text, ends = _split(frontier_text(own.frontier, own.unit))
        inside = "; ".join(part for part in (ends, ", ".join(others)) if part)
        clauses.append(f"{PHRASES.get(axis, axis + ':')} {text}{f' ({inside})' if inside else ''}")
    if clauses:
        return f"{contents.agent.name} {listed(clauses)}."
    return _core_sentence(contents) if contents.agent.score.has_core else "One rung of a ladder has no frontier."


def _core_sentence(contents: Contents) -> str:
    """Sentence on the core alone: below or above which baselines by an interval, and on which tasks it is worst."""
    core, scores = contents.suite.core, contents.agent.score.tasks
    names = sorted((task.name for task in core if task.name in scores), key=lambda name: scores[name].value)
    words = {WORSE: "below", BETTER: "above", NOT_SHOWN_TO_DIFFER: "not shown to differ from", NEGLIGIBLE: "as good as"}
    groups: dict[str, list[str]] = {word: [] for word in (*words.values(), "beside")}
    for other, comparison in zip(contents.beside, contents.comparisons, strict=True):
        if comparison.core is not None:
            common = sum(name in comparison.tasks for name in names)
            text = f"{other.name}'s {comparison.core.theirs:.2f}"
            text += f" on {pluralize(common, 'task')} in common" if common < len(names) else ""
            groups[words.get(comparison.core.verdict, "beside")].append(text)
    parts = [f"Core score {number(contents.agent.score.core)} on {pluralize(len(names), 'task')}"]
    parts += [f"{word} {listed(texts)}" for word, texts in groups.items() if texts]
    worst = f"worst on {listed(names[:3])}" if len(names) > 3 else ""
    return "; ".join(filter(None, (", ".join(parts), worst))) + "." + NO_LADDERS * bool(contents.suite.ladders)


def _split(text: str) -> tuple[str, str]:
    """A text split into the part before its final parentheses and the part inside them."""
    value, _, ends = text.partition(" (")
    return value, ends.removesuffix(")")


def listed(parts: Sequence[str]) -> str:
    """Texts as a list in a sentence: `a, b and c`."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def residual_tasks(contents: Contents) -> list[tuple[BenchmarkTask, ConfidenceInterval, float]]:
    """Tasks whose regret is more than 0.2 above the predicted one, the largest first: task, observed, predicted."""
    pairs = [(task, regret_of(contents.agent, task), contents.predicted(task)) for task in contents.suite.tasks]
    rows = [(task, own, expected) for task, own, expected in pairs if own is not None and expected is not None]
    rows.sort(key=lambda row: row[2] - row[1].value)
    return [row for row in rows if row[1].value - row[2] > RESIDUAL]


def description(task: BenchmarkTask) -> str:
    """A task in words: `deep_sea, size 8; observation one_hot; chance random 0.1`."""
    parameters, options, chance = (
        ", ".join(f"{name} {value}" for name, value in each.items())
        for each in (task.parameters, task.observation_options, task.chance)
    )
    world = f"{task.environment}, {parameters}" if parameters else task.environment
    sight = f"observation {task.observation}{f' ({options})' if options else ''}"
    return f"{world}; {sight}; {f'chance {chance}' if chance else 'no chance added'}"


def final_regret(agent: ScoredAgent, task: BenchmarkTask) -> float:
    """Normalised regret of an agent at the last evaluation of a task, each run's clipped to [0, 1]."""
    return float(np.clip(agent.results.curves[task.name][:, -1], 0.0, 1.0).mean())


def learning_curve(agent: ScoredAgent, names: Sequence[str]) -> list[ConfidenceInterval]:
    """Mean over tasks of normalised regret at each evaluation, each run's clipped to [0, 1]. Empty if one was not run.

    Args:
        names: of the tasks.
    """
    own = as_one_run(agent.results).curves
    curves = [np.clip(own[name], 0.0, 1.0) for name in names if name in own]
    if len(curves) < len(names):
        return []
    return [ConfidenceInterval.of_mean([own[:, k] for own in curves], (0.0, 1.0)) for k in range(curves[0].shape[1])]


def learning_sentence(contents: Contents) -> str:
    """Sentences on how the agent learns the core: its final and mean score, and tasks still like random play."""
    own, results = contents.agent.score, as_one_run(contents.agent.results)
    curves = results.curves
    names = [task.name for task in contents.suite.core if task.name in curves]
    runs, finals = run_scores(results), run_scores(results, last=True)
    gain = ConfidenceInterval.of_mean([finals[name] - runs[name] for name in names])
    word = (
        ": it learns late" if gain.low > LATE_GAIN else ": it ends worse than it was" if gain.high < -ENDS_WORSE else ""
    )
    text = f"Ends at a score of {own.final.value:.2f}, averages {own.core.value:.2f}{word}."
    evaluations = curves[names[0]].shape[1]
    third = max(1, evaluations // 3)
    early, late = (
        sum(ends(ConfidenceInterval.of_mean([curves[name][:, k - 1]]))[1] > 1 - 1e-6 for name in names)
        for k in (third, evaluations)
    )
    if early or late:
        step = contents.suite.protocol.steps * third // evaluations
        text += f" At step {step:,} its policy is not shown to be better than random play on {early} of "
        text += f"{pluralize(len(names), 'task')}, at the end on {late}."
    return text


def unclipped_regret(contents: Contents) -> str:
    """The mean regret on the core without clipping, in words, if runs far below random play make it differ."""
    own = contents.agent.score
    if not own.optimality_gap.value > 1 - own.core.value + 0.1:
        return ""
    runs, core = run_regrets(contents.agent.results), {task.name for task in contents.suite.core}
    regrets = {name: np.maximum(each, 0.0).mean() for name, each in runs.items() if name in core}
    worst = max(regrets, key=regrets.__getitem__)
    share = "most of it" if regrets[worst] > sum(regrets.values()) / 2 else "the largest part"
    return f"mean regret {own.optimality_gap.value:.2f}, not clipped ({share} from {worst})"


def excerpt(value: object) -> str:
    """A value of the record as text, at most 400 letters: `numpy 2.4, pharos 0.1`."""
    if isinstance(value, Mapping):
        value = ", ".join(f"{name} {each}" for name, each in sorted(value.items()))
    text = value if isinstance(value, str) else json.dumps(storage.plain(value), sort_keys=True)
    return text if len(text) <= MOST_RECORD_LETTERS else text[:MOST_RECORD_LETTERS] + "…"


def run_warnings(results: AgentResults) -> list[str]:
    """Sentences on runs that failed, and on what looks like a mistake of the agent, a reason or a kind each.

    At most MOST_REASONS of each, with the first run that it holds of.
    """
    sentences = []
    failed = results.record.get("failed")
    if isinstance(failed, Mapping) and failed:
        reasons: dict[str, list[str]] = {}
        for which, reason in failed.items():
            reasons.setdefault(str(reason).partition(f"{which}: ")[2] or str(reason), []).append(which)
        sentences = [f"Failed: {_first_of(runs)}: {reason}" for reason, runs in list(reasons.items())[:MOST_REASONS]]
        if len(reasons) > MOST_REASONS:
            sentences.append(
                f"Failed: {pluralize(sum(map(len, list(reasons.values())[MOST_REASONS:])), 'run')} for other reasons."
            )
    notes = results.record.get("notes")
    kinds = list(notes.values())[:MOST_REASONS] if isinstance(notes, Mapping) else []
    for runs in kinds:
        if isinstance(runs, Mapping) and runs:
            sentences.append(f"Note: {_first_of(list(runs))}: {next(iter(runs.values()))}.")
    return sentences


def _first_of(runs: Sequence[str]) -> str:
    return f"{runs[0]}{f' and {len(runs) - 1:,} more' * (len(runs) > 1)}"


def seeds_text(results: AgentResults) -> str:
    """The seeds of results: `seed 0`, `seeds 0, 1, 2`."""
    return f"seed{'s' * (len(results.seeds) > 1)} {', '.join(map(str, results.seeds))}"


def number(interval: ConfidenceInterval, form: str = ".2f") -> str:
    """A score with its interval, which one seed does not have: `0.70 (0.68 to 0.72)`."""
    value, low, high = (f"{round(each, 2) + 0.0:{form}}" for each in (interval.value, interval.low, interval.high))
    if math.isnan(interval.value):
        return "–"
    return value if math.isnan(interval.low) else f"{value} ({low} to {high})"


def signed(interval: ConfidenceInterval) -> str:
    """A difference of scores with its interval: `+0.12 (+0.03 to +0.21)`."""
    return number(interval, "+.2f")
