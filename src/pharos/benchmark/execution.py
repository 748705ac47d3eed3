"""Runs of an agent on a suite: all tasks and seeds in one folder. Finished runs are kept, missing ones continue.

DIR/suite.json             name, digest and protocol of the suite
DIR/agent.json             form, source, hyperparameters, versions
DIR/runs/TASK/seed-N/      run.json and curve of each run
DIR/checkpoints/           of runs of the batched engine, while they learn
DIR/results.safetensors    all curves of what was asked for, when the runs have ended
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from pharos.agents import COMPILED
from pharos.benchmark.agents import Form, Job, OnProgress, RunSettings, agent_form
from pharos.benchmark.play import mean_play
from pharos.benchmark.results import RESULTS_FILE, AgentResults
from pharos.benchmark.scores import AxisScore, BenchmarkScore, ConfidenceInterval, equal_seeds, score
from pharos.benchmark.suite import CORE, EARLIER, BenchmarkTask, Suite, load_suite
from pharos.errors import AllRunsFailed, FolderLocked, ParameterError, PharosError, UnknownName
from pharos.system import storage
from pharos.system.wording import in_one_line, pluralize
from pharos.system.workers import check_timeout, usable_workers
from pharos.training import versions

SUITE, AGENT, SCORE = "suite.json", "agent.json", "score.json"
SHOWN_CHARACTERS = 200  # characters of what differs


@dataclass(frozen=True)
class Outcome:
    """Result of `run`: curves of finished tasks, and the runs that are missing.

    Attributes:
        results: curves of the tasks of which all runs have finished.
        folder: of the runs.
        missing: "task, seed" -> why that run has no result.
        suite: that was run.
        steps_used: environment steps of all finished runs together.
        notes: on what looks like a mistake of the agent: kind -> "task, seed" -> sentence.
    """

    results: AgentResults
    folder: Path
    missing: Mapping[str, str]
    suite: Suite
    steps_used: int = 0
    notes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @cached_property
    def scores(self) -> BenchmarkScore:
        """All scores."""
        return score(self.results, self.suite)

    @property
    def score(self) -> ConfidenceInterval:
        """Score of the core."""
        return self.scores.core

    @property
    def axes(self) -> Mapping[str, AxisScore]:
        """Scores and frontiers of the ladders."""
        return self.scores.axes


def run(  # noqa: PLR0913
    agent: str | Callable[..., Any],
    suite: str | Path | Suite = "v1",
    *,
    out: str | os.PathLike,
    seeds: Iterable[int] | None = None,
    quick: bool = False,
    tasks: str | Iterable[str] | None = None,
    name: str | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    workers: int | None = None,
    timeout: float | None = None,
    progress: OnProgress | None = None,
) -> Outcome:
    """Run an agent on the tasks of a suite, with one setting for all of them.

    Finished runs in `out` are kept, so that the same call resumes after an interruption, and ends with the same bytes
    of results. Runs of the batched engine and of tables resume from their last checkpoint, others begin anew.

    Args:
        agent: a name (q_learning, dqn, ppo, a2c; oracle, random), `module:Class` or `file.py:Class` with
            Stable-Baselines3's interface, `file.py:learn`, or a generator function `learn(env, steps, seed)` that
            yields policies. Code that is named here is imported.
        suite: name, file, or a suite that was loaded, by `load_suite(file, trust=True)` if it names code.
        out: folder of one agent with one setting, of one suite.
        seeds: of the runs of each task. Default: as many as the suite asks for, from 0 on.
        quick: the tasks and the number of seeds that the suite has for a quick look, of v1 the core with three. Results
            of a quick look are preliminary.
        tasks: "core", axes and names of tasks. Default: all.
        name: label of the agent in tables. Default: its own.
        hyperparameters: of all tasks. They override the hyperparameters of the suite and of the agent.
        workers: processes. Default: as many as processors. Changes no result.
        timeout: seconds after which a run of the user's own code, or of Stable-Baselines3, is ended, and failed. None:
            never.
        progress: called with the share of all steps that is done, and a text.
    Raises:
        ParameterError: an option is wrong, a task is another one on this installation, or the folder holds another
            agent, setting or suite. AllRunsFailed: no run has finished. FolderLocked: another process is at it.
    Cost: 30,000 steps a task and seed for v1, 600,000 for large.
    """
    check_timeout(timeout)
    folder = Path(out).absolute()  # an agent may change the directory when its file is loaded
    suite = suite if isinstance(suite, Suite) else load_suite(suite)
    form = agent_form(agent, suite, hyperparameters)
    protocol = suite.protocol
    default = range(suite.quick_seeds if quick else protocol.seeds)
    numbers = [int(seed) for seed in (default if seeds is None else seeds)]
    numbers = numbers[: suite.quick_seeds if quick else None]
    if not numbers or len(set(numbers)) < len(numbers) or min(numbers) < 0:
        raise ParameterError(f"seeds are {numbers}; expected whole numbers of at least 0, each once")
    entries = selected(suite, suite.quick_tasks if quick and tasks is None else tasks)
    if protocol.steps % protocol.evaluations:
        raise ParameterError(
            f"suite {suite.name}: {protocol.steps} steps with {protocol.evaluations} evaluations; expected a multiple"
        )
    if form.kind == COMPILED and any(task.stored for task in entries):
        raise ParameterError(
            f"agent {form.label!r} learns from tables of observations, and tasks of suite {suite.name} have "
            f"millions of states; expected an agent that steps an environment, such as file.py:learn"
        )
    for task in entries:
        task.check(protocol)
    folder.mkdir(parents=True, exist_ok=True)
    with storage.lock(folder, FolderLocked, "running a benchmark"):
        record = claimed(folder, form, suite, name or form.label)
        jobs = [
            Job(task, seed, storage.inside(folder, "runs", task.name, f"seed-{seed}"))
            for task in entries
            for seed in numbers
        ]
        checkpoints = storage.inside(folder, "checkpoints")
        form.train(
            jobs,
            protocol,
            RunSettings(usable_workers(workers), checkpoints, progress or (lambda *_: None), timeout),
        )
        return collected(folder, form, suite, record, jobs)


def selected(suite: Suite, tasks: str | Iterable[str] | None) -> tuple[BenchmarkTask, ...]:
    """Tasks of a suite, in its order.

    Args:
        tasks: "core", axes and names. Default: all.
    Raises:
        UnknownName: there is no such axis or task.
    """
    if tasks is None:
        return suite.tasks
    words = [tasks] if isinstance(tasks, str) else list(tasks)
    names = {CORE, *(ladder.axis for ladder in suite.ladders), *(task.name for task in suite.tasks)}
    for word in words:
        if word not in names:
            raise UnknownName(f"axis or task of suite {suite.name}", word, sorted(names))
    return tuple(task for task in suite.tasks if task.axis in words or task.name in words)


def claimed(folder: Path, form: Form, suite: Suite, label: str) -> Mapping[str, Any]:
    """Contents of agent.json for this agent and setting. The file is written if it does not exist.

    Raises:
        ParameterError: the folder is of another agent, setting, suite or installation.
    """
    source = None if not form.checksum else {"name": form.label, "sha256": form.checksum}
    numbers = versions()
    if form.label.startswith("sb3_contrib"):
        numbers["sb3-contrib"] = metadata.version("sb3-contrib")
    contents: dict[str, dict[str, Any]] = storage.plain(
        {
            SUITE: {"suite": suite.name, "suite_digest": suite.digest, "protocol": vars(suite.protocol)},
            AGENT: {
                "agent": label,
                "form": form.kind,
                "source": source,
                "hyperparameters": form.hyperparameters,
                "versions": numbers,
            },
        }
    )
    for file, entry in contents.items():
        try:
            stored = storage.read_json(folder / file)
        except FileNotFoundError:
            storage.replace_json(folder / file, {"format": 1, **entry})
            continue
        before = stored if isinstance(stored, dict) else {}
        before |= {"suite_digest": EARLIER.get(str(before.get("suite_digest")), before.get("suite_digest"))}
        different = [name for name in entry if before.get(name) != entry[name]]
        if different:
            raise ParameterError(
                f"{folder}: holds runs with another {different[0]}: "
                f"{str(before.get(different[0]))[:SHOWN_CHARACTERS]}, now "
                f"{str(entry[different[0]])[:SHOWN_CHARACTERS]}; choose another folder, or delete it"
            )
    return contents[AGENT]


def collected(folder: Path, form: Form, suite: Suite, record: Mapping[str, Any], jobs: Iterable[Job]) -> Outcome:
    """Collect the curves of all runs into one results file, and write the scores.

    Its record has the reasons of runs that failed, what looks like mistakes, and the steps of finished runs.
    """
    curves: dict[str, list[np.ndarray]] = {}
    exact: dict[str, bool] = {}
    missing: dict[str, str] = {}
    notes: dict[str, dict[str, str]] = {}
    facts: dict[str, list[Mapping[str, Any]]] = {}
    play: dict[str, list[Mapping[str, float]]] = {}
    seeds, steps = tuple(dict.fromkeys(job.seed for job in jobs)), 0
    for job in jobs:
        task, which = job.task.name, job.id
        try:
            result = form.result(job, suite.protocol)
        except PharosError as error:
            missing[which] = in_one_line(error)
            continue
        steps += result.steps
        for kind, text in result.notes.items():
            notes.setdefault(kind, {})[which] = text
        curves.setdefault(task, []).append(result.curve)
        exact[task] = exact.get(task, True) and result.exact
        facts.setdefault(task, []).append(result.policies)
        play.setdefault(task, []).append(result.play)
    whole = {task: np.stack(each) for task, each in curves.items() if len(each) == len(seeds)}
    if (text := equal_seeds(whole)) and form.learns:
        notes["equal seeds"] = {pluralize(len(whole), "task"): text}
    full_record = {**record, "exact": {task: exact[task] for task in whole}, "steps_used": steps}
    policies = {task: mean_facts(facts[task], whole[task]) for task in whole if all(facts[task])}
    earned = {task: means for task in whole if (means := mean_play(play[task]))}
    optional = {"failed": missing, "notes": notes, "policies": policies, "play": earned}
    full_record |= {name: value for name, value in optional.items() if value}
    results = AgentResults(str(record["agent"]), suite.name, suite.digest, seeds, whole, full_record)
    outcome = Outcome(results, folder, missing, suite, steps, notes)
    if not whole:
        reason, _ = Counter(missing.values()).most_common(1)[0]
        raise AllRunsFailed(folder, {reason: reason}, outcome)
    results.write(folder / RESULTS_FILE)
    if outcome.scores.has_core:
        storage.replace_json(folder / SCORE, {"agent": results.agent, "suite": suite.name, **asdict(outcome.scores)})
    return outcome


def mean_facts(facts: Sequence[Mapping[str, Any]], curves: np.ndarray) -> dict[str, float]:
    """Means over the runs of a task: `one_action`, `deterministic` (a share of runs), and `greedy_score`.

    The last is the score if the policies of all evaluations are played greedily. It is left out if none is stochastic.

    Args:
        curves: (runs, evaluations) normalised regret of what was played.
    """
    means = {name: float(np.mean([each[name] for each in facts])) for name in ("one_action", "deterministic")}
    if any("greedy_regret" in each for each in facts):
        regrets = [np.mean(each.get("greedy_regret", curve)) for each, curve in zip(facts, curves, strict=True)]
        means["greedy_score"] = float(np.mean(1.0 - np.clip(regrets, 0.0, 1.0)))
    return means
