"""Contents of a report: an agent's scores, those beside it, comparisons, and what theory expected of it."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pharos.benchmark.charts import frontier_text
from pharos.benchmark.comparison import Comparison, compare, results_of, suite_of_results
from pharos.benchmark.results import AgentResults, baselines
from pharos.benchmark.scores import BenchmarkScore, Interval, score
from pharos.benchmark.suite import BenchmarkTask, Suite
from pharos.errors import ParameterError
from pharos.plots import agent_name
from pharos.system import storage

BESIDE = ("dqn", "ppo", "q_learning")
RESIDUAL = 0.2
LONGEST = 400  # letters of an entry of the record on the page
PHRASES = {
    "exploration": "explores to",
    "estimation": "stands noise of",
    "credit": "assigns credit over",
    "representation": "copes with representations that cost",
    "memory": "remembers",
    "scale": "scales to",
}
PREDICTORS = {
    "dqn": "the idealised DQN",
    "ppo": "the idealised PPO",
    "table": "the idealised DQN with a table",
    "both": "the worse of the idealised DQN and PPO",
}
# Words in the name of an algorithm, and the idealised learner that it is a kind of; recurrent ones have none
KINDS = {"recurrent": "none", "q_learning": "table", "dqn": "dqn", "ppo": "ppo", "a2c": "ppo", "trpo": "ppo"}

Source = AgentResults | str | os.PathLike


@dataclass(frozen=True)
class Agent:
    """An agent on the page: its name, its results and their scores."""

    name: str
    results: AgentResults
    score: BenchmarkScore


@dataclass(frozen=True)
class Contents:
    """Everything that a report says, computed once.

    Attributes:
        suite: of the results. agent: the one that it is about. beside: baselines.
        comparisons: of the agent with each of `beside`.
        predictor: "dqn", "ppo", "table" or "both" (the larger of dqn and ppo), by which residuals are taken; "none".
    """

    suite: Suite
    agent: Agent
    beside: Sequence[Agent]
    comparisons: Sequence[Comparison]
    predictor: str

    @property
    def agents(self) -> list[Agent]:
        """The agent, then those beside it."""
        return [self.agent, *self.beside]

    def predicted(self, task: BenchmarkTask) -> float | None:
        """Normalised regret of the idealised learner on a task; None without a prediction."""
        if self.predictor == "both":
            pair = [task.predicted[name] for name in ("dqn", "ppo") if name in task.predicted]
            return max(pair) if len(pair) == 2 else None
        return task.predicted.get(self.predictor)

    def num_run(self, tasks: Sequence[BenchmarkTask]) -> int:
        """How many of these tasks the agent ran."""
        return sum(task.name in self.agent.score.tasks for task in tasks)

    def observed(self, task: BenchmarkTask) -> Interval | None:
        """Normalised regret of the agent on a task, clipped to [0, 1]; None where it did not run."""
        return regret_of(self.agent, task)


def contents_of(
    results: Source,
    *,
    beside: Sequence[Source] | None = None,
    predictor: str | None = None,
    suite: Suite | str | None = None,
) -> Contents:
    """Contents of a report; arguments and errors as for `report`."""
    own = results_of(results)
    suite = suite_of_results(own, suite)
    if beside is None:
        beside = [name for name in BESIDE if name in baselines(suite.name) and name != own.agent]
    if predictor not in (None, "none", *PREDICTORS):
        raise ParameterError(f"predictor {predictor}; expected one of {', '.join(PREDICTORS)}, none")
    others = [results_of(each) for each in beside]
    names = f"{own.agent} {own.record.get('source')}".lower()
    return Contents(
        suite,
        Agent(own.agent, own, score(own, suite)),
        [Agent(_name(each.agent), each, score(each, suite)) for each in others],
        [compare(own, each, suite=suite) for each in others],
        predictor or next((kind for word, kind in KINDS.items() if word in names), "both"),
    )


def _name(label: str) -> str:
    """An agent beside: as pharos spells its own, and whole where it is of a file or a module."""
    return label if ":" in label else agent_name(label)


def regret_of(agent: Agent, task: BenchmarkTask) -> Interval | None:
    """Normalised regret of an agent on a task, clipped to [0, 1]; None where it did not run."""
    own = agent.score.tasks.get(task.name)
    return None if own is None else Interval(1 - own.value, 1 - own.high, 1 - own.low)


def sentence(contents: Contents) -> str:
    """Sentence on what the agent can do, in units: a frontier for each axis, with those of the baselines."""
    clauses = []
    for axis, own in contents.agent.score.axes.items():
        others = [
            f"{each.name} {frontier_text(each.score.axes[axis].frontier, interval=False)}"
            for each in contents.beside
            if axis in each.score.axes
        ]
        text, ends = _split(frontier_text(own.frontier, own.unit))
        inside = "; ".join(part for part in (ends, ", ".join(others)) if part)
        clauses.append(f"{PHRASES.get(axis, axis + ':')} {text}{f' ({inside})' if inside else ''}")
    if not clauses:
        return f"{contents.agent.name}: the ladders were not run, so there are no frontiers."
    return f"{contents.agent.name} {listed(clauses)}."


def _split(text: str) -> tuple[str, str]:
    """A value and, without its parentheses, what stands in them at the end."""
    value, _, ends = text.partition(" (")
    return value, ends.removesuffix(")")


def listed(parts: Sequence[str]) -> str:
    """Texts as a list in a sentence: `a, b and c`."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def residuals(contents: Contents) -> list[tuple[BenchmarkTask, Interval, float]]:
    """Tasks whose regret is more than 0.2 above the predicted one, the largest first: task, observed, predicted."""
    pairs = [(task, contents.observed(task), contents.predicted(task)) for task in contents.suite.tasks]
    rows = [(task, own, expected) for task, own, expected in pairs if own is not None and expected is not None]
    rows.sort(key=lambda row: row[2] - row[1].value)
    return [row for row in rows if row[1].value - row[2] > RESIDUAL]


def excerpt(value: object) -> str:
    """A value of the record as text, at most 400 letters: `numpy 2.4, pharos 0.1`."""
    if isinstance(value, Mapping):
        value = ", ".join(f"{name} {each}" for name, each in sorted(value.items()))
    text = value if isinstance(value, str) else json.dumps(storage.plain(value), sort_keys=True)
    return text if len(text) <= LONGEST else text[:LONGEST] + "…"


def number(interval: Interval, form: str = ".2f") -> str:
    """A score with its interval, which one seed does not have: `0.70 (0.68 to 0.72)`."""
    ends = "" if math.isnan(interval.low) else f" ({interval.low:{form}} to {interval.high:{form}})"
    return f"{interval.value:{form}}{ends}"


def signed(interval: Interval) -> str:
    """A difference of scores with its interval: `+0.12 (+0.03 to +0.21)`."""
    return number(interval, "+.2f")
