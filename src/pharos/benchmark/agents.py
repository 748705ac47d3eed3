"""Forms in which an agent plugs in. All leave the same: a curve of exact normalised regret for each task and seed.

    engine       q_learning, dqn, ppo (the batched engine), a2c: pharos trains them, with one setting for all tasks
    class        module:Class or file.py:Class, with Stable-Baselines3's interface
    generator    file.py:learn or a function: learn(env, steps, seed), see budget.py. Its policies may have a memory
    jax          the same with learn(env, params, steps, key) -> (apply, snapshots), see training/functions.py
    exact        oracle and random: the optimal policy and uniform play, solved and not run

`agent_form` chooses. A further form is a subclass of `Form`, and a line there.
"""

import contextlib
import hashlib
import inspect
import os
import random
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from pharos.agents import (
    CLASS,
    COMPILED,
    POLICY,
    agent_called,
    agents,
    check_hyperparameters,
    check_keywords,
    form_of,
    generator_of,
    is_known,
)
from pharos.benchmark.levels import has_held_out
from pharos.benchmark.play import late_play
from pharos.benchmark.suite import BenchmarkTask, Protocol, Suite
from pharos.errors import ParameterError, PharosError
from pharos.solvers import uniform_policy
from pharos.system.sources import Source, find_source, is_reference, load_source, source_of
from pharos.system.wording import capped, in_one_line, line_in
from pharos.system.workers import Terminated, Workers
from pharos.training import (
    MOST_ERROR_LETTERS,
    Curve,
    Execution,
    FailedRun,
    Learn,
    LearnCompiled,
    PolicyRecorder,
    RunConfig,
    Shapes,
    Task,
    TaskCache,
    TrainingProgress,
    Work,
    check_agent_files,
    clear_run,
    compiled_curves,
    evaluate_agent,
    generate,
    read_record,
    read_rows,
    regret,
    run_id,
    train_configs,
    write_curve,
    write_policy,
    write_record,
)

EXACT = ("oracle", "random")
WARM = ("torch", "stable_baselines3")
"""Libraries that take long to load: the process that runs are forked from has them if the agent has."""
LINGER_SECONDS = 10.0  # that a process may take to end when its run has

OnProgress = Callable[[float, str], None]
"""on_progress(share of the steps that are done, text)."""
Send = Callable[[tuple[Path, str | OSError | None]], None]
"""send((folder of a run that has ended, None, an error message, or the OSError of writing))."""


@dataclass(frozen=True)
class RunSettings:
    """Settings of runs that change no result.

    Attributes:
        workers: processes at once.
        checkpoints: folder of checkpoints of the batched engine.
        on_progress: called with the progress.
        timeout: seconds after which a run that has its process is ended, or None for never.
    """

    workers: int
    checkpoints: Path
    on_progress: OnProgress
    timeout: float | None = None


@dataclass(frozen=True)
class Job:
    """One run: an agent on a task, with a seed. Its files go into a folder."""

    task: BenchmarkTask
    seed: int
    folder: Path

    @property
    def id(self) -> str:
        """Its task and seed, in words."""
        return f"{self.task.name}, seed {self.seed}"


@dataclass(frozen=True)
class RunResult:
    """Curve, steps and notes of a finished run.

    Attributes:
        curve: (evaluations,) normalised regret. exact: whether all of it is.
        steps: of the environment, as it counted them, else of the protocol.
        notes: sentences on what looks like a mistake, by kind.
        policies: facts on the policies, by `policy_facts` of training/curve.py, or empty if they are unknown.
        play: regret of what it played in the last third, by `play.late_play`, or empty.
    """

    curve: np.ndarray
    exact: bool
    steps: int
    notes: Mapping[str, str] = field(default_factory=dict)
    policies: Mapping[str, Any] = field(default_factory=dict)
    play: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Form:
    """An agent and the way to train it: the base class of the forms.

    Attributes:
        label: of the agent, for tables. kind: of form, as in the table above.
        hyperparameters: all that are known, one setting for all tasks.
        source: origin of the user's own code.
        checksum: SHA-256 of that file, or of the text of a function that is in none. Empty if pharos has the code.
        errors: of runs that could not write their own, by folder.
    """

    label: str
    kind: str
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    source: Source | None = None
    checksum: str = ""
    errors: dict[Path, str] = field(default_factory=dict)

    @property
    def learns(self) -> bool:
        """Whether runs with other seeds are other runs."""
        return self.kind != "exact"

    def train(self, jobs: Sequence[Job], protocol: Protocol, settings: RunSettings) -> None:
        """Train all runs. Each leaves a finished run.json and a curve in its folder, or a run.json with its error."""
        raise NotImplementedError

    def result(self, job: Job, protocol: Protocol) -> RunResult:
        """The result of a finished run.

        Raises:
            PharosError: the run has not finished, and why not. ResultCorrupted: a file of it was changed since.
        """
        record = read_record(job.folder) if (job.folder / "run.json").exists() else {}
        if record.get("status") != "finished":
            error = record.get("error") or self.errors.get(job.folder)
            raise PharosError(error or "its process ended without a result; the same command goes on")
        check_agent_files(job.folder)
        rows = {row["step"]: row for row in read_rows(job.folder)}
        rows_at = [rows[protocol.evaluation_interval * (i + 1)] for i in range(protocol.evaluations)]
        counted, notes = record["result"].get("counted_steps"), record.get("notes")
        has_play = 0 in rows and not has_held_out(job.task)  # whose episodes begin where no value is measured
        return RunResult(
            np.array([row["normalized_regret"] for row in rows_at]),
            all(row["exact"] for row in rows_at),
            protocol.steps if counted is None else int(counted),
            {str(kind): str(text) for kind, text in notes.items()} if isinstance(notes, Mapping) else {},
            record.get("policies") or {},
            late_play([rows[0], *rows_at], record["result"]) if has_play else {},
        )


def agent_form(agent: str | Callable[..., Any], suite: Suite, hyperparameters: Mapping[str, Any] | None = None) -> Form:
    """The form of an agent, whose code is imported.

    Args:
        agent: a name, `module:Name`, `file.py:Name`, or a generator function.
        hyperparameters: override the suite's hyperparameters, which override the agent's.
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
        source = find_source(agent)
        code = load_source(source)
        if form_of(agent, code) != CLASS:
            return _function(code, source, setting)
        check_hyperparameters(code, setting)
        return TrainedForm(agent, "class", setting, source, sha256(source.file))
    engine_agent = agent_called(agent)
    defaults = {**engine_agent.defaults, **engine_agent.benchmark_defaults}
    values = {**defaults, **suite.hyperparameters.get(agent, {}), **setting}
    engine_agent.check(values, engine_agent.engines[-1])
    return TrainedForm(agent, "engine" if agent in agents() else "class", values)


def sha256(file: str | os.PathLike) -> str:
    """SHA-256 of a file, or empty if there is none."""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if Path(file).is_file() else ""


# What pharos trains ---------------------------------------------------------------------------------------------------


class TrainedForm(Form):
    """An agent that `pharos.training` trains: runs of the batched engine that fit together as one program."""

    def train(self, jobs: Sequence[Job], protocol: Protocol, settings: RunSettings) -> None:
        configs, shapes = {job.folder: self._config(job, protocol) for job in jobs}, Shapes()
        for folder, config in configs.items():
            # Stable-Baselines3 goes on from a checkpoint, but not to the same bytes: a killed run is begun anew
            if not agent_called(self.label).resumes_exactly(config.engine):
                clear_run(folder)
        is_apart = [shapes.key(configs[job.folder]) is None for job in jobs]
        batched = [job for job, apart in zip(jobs, is_apart, strict=True) if not apart]
        if batched:
            self._train_batched(batched, [configs[job.folder] for job in batched], settings)

        def fail(job: Job, reason: str) -> None:
            _write_failure(configs[job.folder], job, failure(self.label, job, reason))

        if alone := [job for job, apart in zip(jobs, is_apart, strict=True) if apart]:
            arguments = {job.folder: (self.label, configs[job.folder].to_dict(), settings.checkpoints) for job in alone}
            Apart(self, [[job] for job in alone], _train_alone, arguments, fail, settings).execute()

    def _train_batched(self, jobs: Sequence[Job], configs: Sequence[RunConfig], settings: RunSettings) -> None:
        """Train runs of the batched engine and tables, by lanes. They are of pharos' own code."""
        folders, seconds = [job.folder for job in jobs], [job.task.seconds.get(self.label, 1.0) for job in jobs]

        def progress(now: TrainingProgress) -> None:
            failures = f", {now.failed} failed" if now.failed else ""
            settings.on_progress(now.done / now.total, f"{now.finished} of {len(jobs)} runs{failures}")

        stored = {config.id: job.task.stored_values for config, job in zip(configs, jobs, strict=True)}
        tasks = TaskCache(lambda config: stored[config.id], trust=True)  # the user has named the code
        options: dict[str, Any] = {"progress": progress, "tasks": tasks, "workers": settings.workers}
        train_configs(configs, folders, checkpoints=settings.checkpoints, seconds=seconds, **options)

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


def _train_alone(label: str, entry: dict[str, Any], checkpoints: Path, jobs: Sequence[Job], send: Send) -> None:
    """The body of a process: one run of an algorithm of Stable-Baselines3."""
    os.dup2(2, 1)
    (job,) = jobs
    _seed(job.seed)
    config = RunConfig.from_dict(entry)
    try:
        tasks = TaskCache(lambda _: job.task.stored_values, trust=True)  # the user has named the code
        (end,) = train_configs([config], [job.folder], checkpoints=checkpoints, tasks=tasks)
        send((job.folder, end.error if isinstance(end, FailedRun) else None))
    except Terminated:
        raise
    except OSError as error:
        send((job.folder, error))
    except BaseException as error:
        message = failure(label, job, error, config.sources["agent"].file if "agent" in config.sources else None)
        _write_failure(config, job, message)
        send((job.folder, message))


def _write_failure(config: RunConfig, job: Job, message: str) -> None:
    record = {"format": 1, "id": config.id, "config": config.to_dict(), "status": "failed", "error": message}
    job.folder.mkdir(parents=True, exist_ok=True)
    write_record(job.folder, record)


# Functions ------------------------------------------------------------------------------------------------------------


def _function(code: Callable[..., Any], source: Source | None, setting: Mapping[str, Any]) -> Form:
    name = source.name if source is not None else getattr(code, "__qualname__", repr(code))
    form = form_of(name, code)
    if form == CLASS:
        raise ParameterError(f"agent {name!r} is a class itself; expected its name, such as mine.py:{code.__name__}")
    check_keywords(name, code, setting)
    checksum = sha256(source.file) if source is not None else _text_checksum(code)
    return FunctionForm(name, form, setting, source, checksum, learn=code)


def _text_checksum(code: Callable[..., Any]) -> str:
    with contextlib.suppress(OSError, TypeError):
        return hashlib.sha256(inspect.getsource(code).encode()).hexdigest()
    return ""


@dataclass(frozen=True)
class FunctionForm(Form):
    """A function. Each run of a generator has a process of its own with one thread.

    A function of JAX is one program for all seeds of a task, which runs again if the result of a seed is missing. Each
    program has a process of its own, one after another: it uses all processors, or most of a GPU's memory.

    Attributes:
        learn: the function. It is sent by value if it has no source.
    """

    learn: Learn | LearnCompiled | None = None

    def train(self, jobs: Sequence[Job], protocol: Protocol, settings: RunSettings) -> None:
        code = self.source or _by_value(self.learn, self.label)
        groups, body = [[job] for job in jobs], _generate
        if self.kind == COMPILED:
            programs: dict[str, list[Job]] = defaultdict(list)
            for job in jobs:
                programs[job.task.name].append(job)
            groups, body, settings = list(programs.values()), _compile, replace(settings, workers=1)

        def fail(job: Job, reason: str) -> None:
            record_run(self.label, job, protocol, reason)

        arguments = dict.fromkeys((job.folder for job in jobs), (code, self.label, protocol, self.hyperparameters))
        Apart(self, groups, body, arguments, fail, settings).execute()


def _by_value(learn: Learn | LearnCompiled | None, label: str) -> bytes:
    """A function that no other process can import, of a notebook or within another one, with what it needs."""
    import cloudpickle  # which Gymnasium needs; this process sends it to its own processes

    try:
        return cloudpickle.dumps(learn)
    except Exception as error:
        raise ParameterError(
            f"agent {label!r}: cannot be sent to the process of a run: {in_one_line(error)}; name it in a file, "
            f"file.py:learn"
        ) from error


def _generate(
    code: Source | bytes,
    label: str,
    protocol: Protocol,
    hyperparameters: Mapping[str, Any],
    jobs: Sequence[Job],
    send: Send,
) -> None:
    """The body of a process: one run of a generator.

    Its standard output goes to standard error. Whatever draws from the global random numbers of Python, NumPy or
    PyTorch draws others in each run.
    """
    os.dup2(2, 1)
    (job,), process = jobs, os.getpid()

    def end(result: Curve | BaseException, notes: Mapping[str, str], file: str | None = None) -> None:
        if os.getpid() != process:  # a fork that the agent has made, and that has come back
            os._exit(1)
        _send_end(send, label, job, protocol, result, notes, file)

    def give_up() -> NoReturn:
        """End an agent that goes on and on after its budget, with the policies that it has."""
        try:
            end(recorder.curve(), recorder.notes())
        except Exception as error:
            end(error, recorder.notes())
        os._exit(0)

    notes: dict[str, str] = {}
    result: Curve | BaseException
    file = code.file if isinstance(code, Source) else None
    try:
        learn = generator_of(_loaded(code))
        file = file or getattr(getattr(learn, "__code__", None), "co_filename", None)
        _seed(job.seed)
        task = job.task.training_task(protocol)
        recorder = PolicyRecorder(task, steps=protocol.steps, interval=protocol.evaluation_interval, seed=job.seed)
        recorder.budget.give_up = give_up
        generate(partial(learn, **hyperparameters), recorder, job.seed)
        result, notes = recorder.curve(), recorder.notes()
    except Terminated:
        raise
    except BaseException as error:  # SystemExit and KeyboardInterrupt of an agent end its own run alone
        result = error
    end(result, notes, file)


def _compile(
    code: Source | bytes,
    label: str,
    protocol: Protocol,
    hyperparameters: Mapping[str, Any],
    jobs: Sequence[Job],
    send: Send,
) -> None:
    """The body of a process: all seeds of a task with a function of JAX."""
    os.dup2(2, 1)
    file = code.file if isinstance(code, Source) else None
    ends: Sequence[Curve | BaseException]
    try:
        learn, task = partial(_loaded(code), **hyperparameters), jobs[0].task.training_task(protocol)
        seeds = [job.seed for job in jobs]
        ends = compiled_curves(learn, task, steps=protocol.steps, evaluations=protocol.evaluations, seeds=seeds)
    except Terminated:
        raise
    except BaseException as error:
        ends = [error] * len(jobs)
    for job, end in zip(jobs, ends, strict=True):
        _send_end(send, label, job, protocol, end, {}, file)


def _send_end(send: Send, label: str, job: Job, *ended: Any) -> None:
    """Write the folder of a run as `record_run`, and send what became of it."""
    try:
        send((job.folder, record_run(label, job, *ended)))
    except OSError as error:
        send((job.folder, error))


def _loaded(code: Source | bytes) -> Any:
    if isinstance(code, Source):
        sys.path.append(str(Path(code.file).parent))  # for imports within functions, and files of Numba's cache
        return load_source(code)
    import cloudpickle

    return cloudpickle.loads(code)


def _seed(seed: int) -> None:
    """Seed the global random numbers of Python, NumPy and, if the agent has loaded it, PyTorch.

    A forked process starts with the random numbers of the process that it was forked from.
    """
    random.seed(seed)
    np.random.seed(seed % (1 << 32))  # noqa: TID251  (of the agent's own code, which is its own affair)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(seed)


def record_run(
    label: str,
    job: Job,
    protocol: Protocol,
    end: Curve | BaseException | str,
    notes: Mapping[str, str] | None = None,
    file: str | None = None,
) -> str | None:
    """Write the result of a run, or its error, into its folder. Returns None, or the error message.

    Args:
        end: the curve, or why there is none.
        notes: on what looks like a mistake.
        file: of the agent's code, whose last line in the traceback the message names.
    """
    config = {
        "benchmark": {"task": job.task.name, "digest": job.task.digest},
        "agent": label,
        "steps": protocol.steps,
        "seed": job.seed,
        "evaluations": protocol.evaluations,
    }
    job.folder.mkdir(parents=True, exist_ok=True)
    record: dict[str, Any] = {"format": 1, "id": run_id(config), "config": config}
    if not isinstance(end, Curve):
        message = failure(label, job, end, file)
        write_record(job.folder, {**record, "status": "failed", "error": message})
        return message
    if end.table is not None:
        write_policy(job.folder, end.table)
    else:
        (job.folder / POLICY).unlink(missing_ok=True)  # of an earlier attempt
    write_curve(job.folder, end.rows)
    record |= {name: dict(entry) for name, entry in {"notes": notes, "policies": end.policies}.items() if entry}
    write_record(job.folder, {**record, "status": "finished", "result": end.result()})
    return None


def failure(label: str, job: Job, end: BaseException | str, file: str | None = None) -> str:
    """The message of a run that has failed: its agent, task and seed, the error, and the line of the agent's file."""
    text, line = (end, "") if isinstance(end, str) else (in_one_line(end), line_in(end, file))
    printable = "".join(
        letter if letter.isprintable() else ascii(letter)[1:-1] for letter in capped(text, MOST_ERROR_LETTERS)
    )
    return f"{label} on {job.id}: {printable.rstrip(': ')}{line}"


# Processes ------------------------------------------------------------------------------------------------------------


class Apart(Execution[Job]):
    """Execution of runs that are not finished: each group in a process of its own, forked from one that has loaded
    what runs need.

    So nothing of one run, neither of its modules nor of its threads, reaches another one, and a process that dies costs
    its own runs, whose run.json says why. Processes that an agent leaves behind end with its run.

    Args:
        form: the form of the jobs. It keeps errors of runs that could not write their own.
        groups: of jobs. Finished jobs of a group run again if one of the group is not finished.
        body: function(*arguments[folder of the first job], jobs, send), which writes the folders of all runs and sends
            for each (its folder, None, an error message, or the OSError of writing).
        fail: fail(job, reason) writes the folder of a run whose process could not.
    """

    is_divisible = False

    def __init__(
        self,
        form: Form,
        groups: Sequence[Sequence[Job]],
        body: Callable[..., None],
        arguments: Mapping[Path, Sequence[Any]],
        fail: Callable[[Job, str], object],
        settings: RunSettings,
    ):
        self.form, self.body, self.arguments, self.on_failure, self.on_progress = (
            form,
            body,
            arguments,
            fail,
            settings.on_progress,
        )
        self.total = sum(len(group) for group in groups)
        groups = [group for group in groups if not all(map(is_finished, group))]
        self.left = sum(len(group) for group in groups)
        self.failed: dict[Path, bool] = {}  # of runs that have ended
        self.sent: dict[str, float] = {}  # when the runs of a process have ended
        preload = [*(name for name in WARM if name in sys.modules), "pharos.benchmark.warm"]
        pool = Workers(*preload, groups=True)
        super().__init__(groups, pool, workers=settings.workers, checkpoints=None, timeout=settings.timeout, attempts=1)

    def execute(self) -> None:
        super().execute()
        self.look()

    def work(self, group: Sequence[Job]) -> Work:
        return self.body, (*self.arguments[group[0].folder], group), ()

    def is_over(self, run: Job, *, ended: bool = False) -> bool:
        return run.folder in self.failed

    def receive(self, key: str, message: tuple[Any, ...]) -> None:
        folder, error = message
        self.failed[folder] = error is not None
        self.sent[key] = time.monotonic()
        if isinstance(error, OSError):
            self.form.errors[folder] = f"{error.strerror or error}; the same command goes on"

    def fail(self, run: Job, reason: str) -> None:
        self.failed[run.folder] = True
        try:
            self.on_failure(run, reason)
        except OSError as error:
            self.form.errors[run.folder] = f"{error.strerror or error}; the same command goes on"

    def look(self) -> None:
        """Report, and kill processes whose runs have ended and which do not end themselves."""
        failed, done = sum(self.failed.values()), self.total - self.left + len(self.failed)
        self.on_progress(
            done / self.total, f"{done - failed} of {self.total} runs{f', {failed} failed' * (failed > 0)}"
        )
        for key in self.running.keys() & self.sent.keys():
            if time.monotonic() - self.sent[key] > LINGER_SECONDS and self.pool is not None:
                self.pool.kill(key)


def is_finished(job: Job) -> bool:
    return (job.folder / "run.json").exists() and read_record(job.folder).get("status") == "finished"


# Exact ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExactForm(Form):
    """The optimal policy, whose value solving gives, and uniform play, evaluated: nothing is run."""

    regrets: dict[str, float] = field(default_factory=dict)

    def train(self, jobs: Sequence[Job], protocol: Protocol, settings: RunSettings) -> None:
        """Do nothing: there is nothing to learn."""

    def result(self, job: Job, protocol: Protocol) -> RunResult:
        if job.task.name not in self.regrets:
            self.regrets[job.task.name] = self._regret(job.task.training_task(protocol))
        return RunResult(np.full(protocol.evaluations, self.regrets[job.task.name]), True, 0)

    def _regret(self, task: Task) -> float:
        if self.label == "oracle" or task.values is not None:  # U of a large task is stored
            return float(self.label != "oracle")
        return float(
            regret(evaluate_agent(uniform_policy(task.mdp), task).value, task.reference, normalized_by="uniform")
        )
