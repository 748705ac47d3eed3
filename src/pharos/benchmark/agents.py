"""Forms in which an agent plugs in. All leave the same: a curve of exact normalised regret for each task and seed.

    engine       q_learning, dqn, ppo (the batched engine), a2c: pharos trains them, with one setting for all tasks
    class        module:Class or file.py:Class, with Stable-Baselines3's interface
    generator    file.py:learn or a function: learn(env, steps, seed), see budget.py; its policies may have a memory
    jax          the same with learn(env, params, steps, key) -> (apply, snapshots), see jax_agents.py
    exact        oracle and random: the optimal policy and uniform play, solved and not run

`agent_form` chooses; a further form is a subclass of `Form`, and a line there.
"""

import contextlib
import hashlib
import inspect
import os
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pharos.agents import COMPILED, agent_called, agents, check_hyperparameters, form_of, is_known
from pharos.benchmark.suite import BenchmarkTask, Protocol, Suite
from pharos.errors import ParameterError, PharosError
from pharos.system.sources import Source, find, is_reference, load, source_of
from pharos.system.wording import in_one_line
from pharos.system.workers import Workers, one_thread
from pharos.training import (
    Curve,
    Learn,
    LearnCompiled,
    RunConfig,
    Task,
    TaskCache,
    check_agent,
    clear_run,
    compiled_curves,
    dealt,
    evaluate_agent,
    generated_curve,
    read_record,
    read_rows,
    regret,
    run_id,
    train_configs,
    uniform_policy,
    write_curve,
    write_policy,
    write_record,
)

EXACT = ("oracle", "random")

Tell = Callable[[float, str], None]
"""tell(share of the steps that are done, text)."""


@dataclass(frozen=True)
class Job:
    """One run: an agent on a task, with a seed; its files go into a folder."""

    task: BenchmarkTask
    seed: int
    folder: Path


@dataclass(frozen=True)
class Form:
    """An agent and the way to train it; base class of the forms.

    Attributes:
        label: of the agent, for tables. kind: of form, as in the table above.
        hyperparameters: all that are known; one setting for all tasks.
        source: where code of the user's own comes from.
        checksum: SHA-256 of that file, or of the text of a function that is in none; empty where pharos has the code.
        errors: of runs that could not write their own, by folder.
    """

    label: str
    kind: str
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    source: Source | None = None
    checksum: str = ""
    errors: dict[Path, str] = field(default_factory=dict)

    def train(self, jobs: Sequence[Job], protocol: Protocol, workers: int, checkpoints: Path, tell: Tell) -> None:
        """Train all runs. Each leaves a finished run.json and a curve in its folder, or a run.json with its error."""
        raise NotImplementedError

    def steps_used(self, job: Job, protocol: Protocol) -> int:
        """Environment steps of a finished run: as the environment counted them, else those of the protocol."""
        counted = read_record(job.folder)["result"].get("counted_steps")
        return protocol.steps if counted is None else int(counted)

    def curve(self, job: Job, protocol: Protocol) -> tuple[np.ndarray, bool]:
        """(evaluations,) normalised regret, and whether all of it is exact.

        Raises:
            PharosError: the run has not finished; why not. ResultCorrupted: a file of it was changed since.
        """
        record = read_record(job.folder) if (job.folder / "run.json").exists() else {}
        if record.get("status") != "finished":
            error = record.get("error") or self.errors.get(job.folder)
            raise PharosError(error or "its process ended without a result; the same command goes on")
        check_agent(job.folder)
        rows = {row["step"]: row for row in read_rows(job.folder)}
        points = [protocol.evaluation_interval * (i + 1) for i in range(protocol.evaluations)]
        exact = all(rows[point]["exact"] for point in points)
        return np.array([rows[point]["normalized_regret"] for point in points]), exact


def agent_form(agent: str | Callable[..., Any], suite: Suite, hyperparameters: Mapping[str, Any] | None = None) -> Form:
    """The form of an agent; its code is imported.

    Args:
        agent: a name, `module:Name`, `file.py:Name`, or a generator function.
        hyperparameters: go before those of the suite, and these before the agent's own.
    Raises:
        UnknownName, ParameterError: there is no such agent, file or hyperparameter.
        MissingExtra: the library that it needs is not installed.
    """
    setting = dict(hyperparameters or {})
    if not isinstance(agent, str):
        return _function(agent, source_of(agent), setting)
    if agent in EXACT:
        if setting:
            raise ParameterError(f"agent {agent!r} has no hyperparameters; found {', '.join(setting)}")
        return ExactForm(agent, "exact")
    if agent.endswith(".py"):
        raise ParameterError(f"agent {agent!r}: expected what in the file, such as {agent}:learn")
    if is_reference(agent) and not is_known(agent):
        source = find(agent)
        code = load(source)
        if not isinstance(code, type):
            return _function(code, source, setting)
        check_hyperparameters(code, setting)
        return TrainedForm(agent, "class", setting, source, sha256(source.file))
    engine_agent = agent_called(agent)
    defaults = {**engine_agent.defaults, **engine_agent.benchmark_defaults}
    values = {**defaults, **suite.hyperparameters.get(agent, {}), **setting}
    engine_agent.check(values, engine_agent.engines[-1])
    return TrainedForm(agent, "engine" if agent in agents() else "class", values)


def sha256(file: str | os.PathLike) -> str:
    """SHA-256 of a file; empty where there is none."""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if Path(file).is_file() else ""


# What pharos trains ---------------------------------------------------------------------------------------------------


class TrainedForm(Form):
    """An agent that `pharos.training` trains: runs of the batched engine that fit together as one program."""

    def train(self, jobs: Sequence[Job], protocol: Protocol, workers: int, checkpoints: Path, tell: Tell) -> None:
        configs = [self._config(job, protocol) for job in jobs]
        for job, config in zip(jobs, configs, strict=True):
            # Stable-Baselines3 goes on from a checkpoint, but not to the same bytes: a killed run is begun anew
            if not agent_called(self.label).resumes_exactly(config.engine):
                clear_run(job.folder)
        folders, seconds = [job.folder for job in jobs], [job.task.seconds.get(self.label, 1.0) for job in jobs]

        def progress(now: Any) -> None:
            failures = f", {now.failed} failed" if now.failed else ""
            tell(now.done / now.total, f"{now.finished} of {len(jobs)} runs{failures}")

        tasks = TaskCache(trust=True)  # the user has named the code
        options: dict[str, Any] = {"progress": progress, "tasks": tasks, "workers": workers, "seconds": seconds}
        train_configs(configs, folders, checkpoints=checkpoints, **options)

    def _config(self, job: Job, protocol: Protocol) -> RunConfig:
        task, agent = job.task.training_task(protocol), agent_called(self.label)
        if agent.fixed_observation is not None:
            task = replace(task, observation=agent.fixed_observation, observation_options={})
        return RunConfig.of_task(
            task,
            self.label,
            steps=protocol.steps,
            seed=job.seed,
            evaluation_interval=protocol.evaluation_interval,
            hyperparameters=self.hyperparameters,
            engine=agent.engines[-1],
        )


# Generators -----------------------------------------------------------------------------------------------------------


def _function(code: Callable[..., Any], source: Source | None, setting: Mapping[str, Any]) -> Form:
    name = source.name if source is not None else getattr(code, "__qualname__", repr(code))
    form = form_of(name, code)
    if setting:
        raise ParameterError(
            f"agent {name!r} is a function, which has its hyperparameters in its code; found {', '.join(setting)}"
        )
    checksum = sha256(source.file) if source is not None else _text_checksum(code)
    kind = CompiledForm if form == COMPILED else GeneratedForm
    return kind(name, form, source=source, checksum=checksum, learn=code)


def _text_checksum(code: Callable[..., Any]) -> str:
    with contextlib.suppress(OSError, TypeError):
        return hashlib.sha256(inspect.getsource(code).encode()).hexdigest()
    return ""


@dataclass(frozen=True)
class GeneratedForm(Form):
    """A generator, run in processes of its own with one thread each; in this process if no other can import it.

    Attributes:
        learn: the function.
    """

    learn: Learn | None = None

    def train(self, jobs: Sequence[Job], protocol: Protocol, workers: int, checkpoints: Path, tell: Tell) -> None:
        missing, failed = [job for job in jobs if not _is_finished(job)], 0

        def report_progress(left: int) -> None:
            text = f"{len(jobs) - left - failed} of {len(jobs)} runs{f', {failed} failed' * (failed > 0)}"
            tell(1 - left / len(jobs), text)

        report_progress(len(missing))
        ends = (
            self._in_processes(missing, protocol, workers) if self.source is not None else self._here(missing, protocol)
        )
        for left, error in zip(range(len(missing) - 1, -1, -1), ends, strict=False):
            failed += error is not None
            report_progress(left)

    def _here(self, jobs: Sequence[Job], protocol: Protocol) -> Iterator[str | None]:
        assert self.learn is not None
        for job in jobs:
            yield _generate(self.learn, self.label, job, protocol)

    def _in_processes(self, jobs: Sequence[Job], protocol: Protocol, workers: int) -> Iterator[str | None]:
        """Yield None or an error message for each run, in the order in which the runs end.

        Where a process dies, the run that it was at has failed, and another process goes on with the others.
        """
        assert self.source is not None
        seconds = [job.task.seconds.get(self.label, 1.0) for job in jobs]
        left = {
            str(part): deque(jobs[i] for i in sorted(indices)) for part, indices in enumerate(dealt(seconds, workers))
        }
        with Workers() as pool, one_thread():

            def start(key: str) -> None:
                pool.start(key, _generate_all, (self.source, self.label, list(left[key]), protocol), [self.learn])

            for key in left:
                start(key)
            while pool:
                for key, event in pool.events():
                    if not isinstance(event, int):  # one of its runs has ended
                        (error,) = event
                        yield self._ended(left[key].popleft(), error)
                    elif left[key]:
                        yield self._ended(left[key].popleft(), f"its process ended with exit code {event}")
                        if left[key]:
                            start(key)

    def _ended(self, job: Job, error: str | OSError | None) -> str | None:
        """Note the error of a run that could not write its own, as of a full disk or a process that is gone."""
        if isinstance(error, OSError):
            self.errors[job.folder] = f"{error.strerror or error}; the same command goes on"
            return in_one_line(error)
        return error


def _generate_all(
    source: Source, label: str, jobs: Sequence[Job], protocol: Protocol, send: Callable[[tuple[object]], None]
) -> None:
    """The body of a process: run one job after the other, and send (None,) or (error,) after each.

    Its standard output goes to standard error.
    """
    os.dup2(2, 1)
    for job in jobs:
        try:
            send((_generate_from(source, label, job, protocol),))
        except OSError as error:
            send((error,))


def _generate_from(source: Source, label: str, job: Job, protocol: Protocol) -> str | None:
    try:
        learn = load(source)
    except Exception as error:
        return in_one_line(error)
    return _generate(learn, label, job, protocol)


def _generate(learn: Learn, label: str, job: Job, protocol: Protocol) -> str | None:
    """Train one run and write its folder. Returns None, or an error message if the run failed."""
    try:
        task = job.task.training_task(protocol)
        curve = generated_curve(learn, task, steps=protocol.steps, evaluations=protocol.evaluations, seed=job.seed)
    except Exception as error:
        return _record(label, job, protocol, error)
    return _record(label, job, protocol, curve)


def _record(label: str, job: Job, protocol: Protocol, end: Curve | Exception) -> str | None:
    """Write the result of a run, or its error, into its folder. Returns None, or the error message."""
    config = {
        "benchmark": {"task": job.task.name, "digest": job.task.digest},
        "agent": label,
        "steps": protocol.steps,
        "seed": job.seed,
        "evaluations": protocol.evaluations,
    }
    job.folder.mkdir(parents=True, exist_ok=True)
    record = {"format": 1, "id": run_id(config), "config": config}
    if isinstance(end, Exception):
        message = f"{label} on {job.task.name}, seed {job.seed}: {type(end).__name__}: {in_one_line(end)}"
        write_record(job.folder, {**record, "status": "failed", "error": message})
        return message
    if end.table is not None:
        write_policy(job.folder, end.table)
    write_curve(job.folder, end.rows)
    write_record(job.folder, {**record, "status": "finished", "result": end.result()})
    return None


def _is_finished(job: Job) -> bool:
    return (job.folder / "run.json").exists() and read_record(job.folder).get("status") == "finished"


# JAX ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CompiledForm(Form):
    """A function of JAX: one program for all seeds of a task; it runs again if the result of a seed is missing.

    Attributes:
        learn: the function.
    """

    learn: LearnCompiled | None = None

    def train(self, jobs: Sequence[Job], protocol: Protocol, workers: int, checkpoints: Path, tell: Tell) -> None:
        assert self.learn is not None
        groups: dict[str, list[Job]] = defaultdict(list)
        for job in jobs:
            groups[job.task.name].append(job)
        for number, group in enumerate(groups.values()):
            tell(number / len(groups), f"{number} of {len(groups)} tasks")
            if all(_is_finished(job) for job in group):
                continue
            task, seeds = group[0].task.training_task(protocol), [job.seed for job in group]
            ends: Sequence[Curve | Exception]
            try:
                ends = compiled_curves(
                    self.learn, task, steps=protocol.steps, evaluations=protocol.evaluations, seeds=seeds
                )
            except Exception as error:
                ends = [error] * len(group)
            for job, end in zip(group, ends, strict=True):
                _record(self.label, job, protocol, end)
        tell(1.0, f"{len(groups)} of {len(groups)} tasks")


# Exact ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExactForm(Form):
    """The optimal policy, whose value solving gives, and uniform play, evaluated: nothing is run."""

    regrets: dict[str, float] = field(default_factory=dict)

    def train(self, jobs: Sequence[Job], protocol: Protocol, workers: int, checkpoints: Path, tell: Tell) -> None:
        """Do nothing: there is nothing to learn."""

    def steps_used(self, job: Job, protocol: Protocol) -> int:
        return 0

    def curve(self, job: Job, protocol: Protocol) -> tuple[np.ndarray, bool]:
        if job.task.name not in self.regrets:
            self.regrets[job.task.name] = self._regret(job.task.training_task(protocol))
        return np.full(protocol.evaluations, self.regrets[job.task.name]), True

    def _regret(self, task: Task) -> float:
        if self.label == "oracle":
            return 0.0
        return float(regret(evaluate_agent(uniform_policy(task), task).value, task.reference, normalized_by="uniform"))
