"""Execution: the one loop behind `train`, `train_many`, `tune`, studies and the benchmark.

Groups of runs wait until a process is free, are trained there (or in this process), and end. A group is halved here
alone: if its program failed for several runs, as for want of memory, or if its process was killed too often. A
run does not depend on who else is in its group, so nothing does on how groups are made, halved and begun again.
"""

import contextlib
import itertools
import signal
import time
import warnings
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from pharos.errors import ParameterError, PharosError
from pharos.system.storage import read_json
from pharos.system.wording import in_one_line, pluralize
from pharos.system.workers import SERVER_LOST, Workers, one_thread
from pharos.training.batch import CallbackError, remove_batch, train_group
from pharos.training.results import TrainingResult
from pharos.training.schedule import FailedRun, PreparedRun, TaskCache, halves, plan
from pharos.training.task import RunConfig, TaskValues

GROUP_ATTEMPTS = 3
"""How often a group is begun whose process is killed, before it is halved, or fails."""
BUSY_SECONDS = 0.5
PROCESS_WAITING_SECONDS = 1.0
# How often in a row the process that forks workers is begun again
LOST_SERVERS = 10


class Named(Protocol):
    """A run, which has the id of its configuration."""

    @property
    def id(self) -> str: ...


R = TypeVar("R", bound=Named)
Work = tuple[Callable[..., Any], Sequence[Any], Sequence[object]]
"""function, its arguments but for the last, `send(message)`, and the classes and functions that it needs."""


class Execution(Generic[R]):
    """Groups of runs that wait, are trained, and end. A subclass says what a run is, and which folder its result is in.

    Args:
        groups: runs that one process trains.
        pool: of processes. None: they are trained in this one.
        workers: most processes at a time.
        checkpoints: folder for checkpoints of programs of several runs. None: none are written.
        timeout: seconds for each run, after which it has failed.
        attempts: GROUP_ATTEMPTS, or 1 for a pool that begins again itself.
    Attributes:
        waiting: (the earliest time to begin, runs). running: key of the process -> (runs, when it began).
        lost_servers: how often in a row the process that forks workers was gone.
        exit_busy: exit code of a process whose runs another process trains. None: nobody else is at them.
        is_divisible: whether a group whose process was killed too often is halved.
    """

    lost_servers = 0
    exit_busy: int | None = None
    is_divisible = True

    def __init__(
        self,
        groups: Iterable[Sequence[R]],
        pool: Workers | None,
        *,
        workers: float,
        checkpoints: Path | None,
        timeout: float | None = None,
        attempts: int = GROUP_ATTEMPTS,
    ):
        self.waiting = deque((0.0, list(group)) for group in groups)
        self.running: dict[str, tuple[list[R], float]] = {}
        self.pool, self.num_workers, self.timeout, self.attempts = pool, workers, timeout, attempts
        self.checkpoints = checkpoints
        self._ids = {run.id for _, group in self.waiting for run in group}
        self.kills: dict[int, int] = defaultdict(int)  # by the identity of the run
        self._keys = map(str, itertools.count())
        self._reasons: set[str] = set()

    # What a subclass says --------------------------------------------------------------------------------------------

    def work(self, group: Sequence[R]) -> Work:
        """The function that trains the runs, with its arguments."""
        raise NotImplementedError

    def is_over(self, run: R, *, ended: bool = False) -> bool:
        """Whether there is a result, or the reason why not. `ended`: the process that trained it has just ended."""
        raise NotImplementedError

    def receive(self, key: str, message: tuple[Any, ...]) -> None:
        """Take a message of the work. Whatever else comes from a pool is the end of a process."""
        raise NotImplementedError

    def fail(self, run: R, reason: str) -> None:
        """Note that a run has failed, as its process was killed too often or took too long."""
        raise NotImplementedError

    def look(self) -> None:
        """Look around and report, every now and then."""

    # The loop --------------------------------------------------------------------------------------------------------

    def execute(self) -> None:
        """Train all runs."""
        with contextlib.nullcontext() if self.pool is None else self.pool:
            while self.waiting or self.running:
                self._start()
                self.look()
                self._await()
        if self.checkpoints is not None and self.checkpoints.is_dir():
            for folder, ids in stored_batches(self.checkpoints).items():
                if ids <= self._ids:  # a process was killed before it had removed this
                    remove_batch(folder)
            for folder in (*self.checkpoints.iterdir(), self.checkpoints):
                with contextlib.suppress(OSError):  # it is not empty
                    folder.rmdir()

    def halve(self, key: str, runs: Sequence[R], reason: str = "") -> None:
        """Let the halves of runs that cannot be trained together begin anew, before all others.

        Args:
            key: of the process that has, or had, them. reason: reported once. Empty if each run will say it.
        """
        if key in self.running:
            group, leaving = self.running[key][0], {id(run) for run in runs}
            group[:] = [run for run in group if id(run) not in leaving]
        self._forget(runs)
        parts = [part for part in halves(runs) if part]
        self.waiting.extendleft((0.0, part) for part in reversed(parts))
        if reason and reason not in self._reasons:
            self._reasons.add(reason)
            warnings.warn(
                f"{reason}: {pluralize(len(runs), 'run')} at once; goes on with {pluralize(len(parts[0]), 'run')} "
                f"at once",
                stacklevel=2,
            )

    def _forget(self, runs: Sequence[R]) -> None:
        """Remove the checkpoints of programs with these runs."""
        ids = {run.id for run in runs}
        for folder, others in stored_batches(self.checkpoints).items():
            if ids & others:
                remove_batch(folder)

    def _start(self) -> None:
        for _ in range(len(self.waiting)):
            if not self.waiting or len(self.running) >= self.num_workers:
                return
            due, group = self.waiting.popleft()
            if due > time.monotonic():
                self.waiting.append((due, group))
            elif group := [run for run in group if not self.is_over(run)]:
                key = next(self._keys)
                try:
                    self.running[key] = group, time.monotonic()
                    self._begin(key, *self.work(group))
                except (EOFError, ConnectionError) as error:
                    del self.running[key]
                    self.waiting.appendleft((due, group))
                    self._lose_server(error)
                    return

    def _begin(self, key: str, function: Callable[..., Any], arguments: Sequence[Any], needs: Sequence[object]) -> None:
        if self.pool is None:
            function(*arguments, lambda message: self.receive(key, message))
            self._end(key, 0)
            return
        with one_thread():
            self.pool.start(key, function, arguments, needs)

    def _lose_server(self, error: Exception) -> None:
        """Wait a little for another process that forks workers, as it is gone. PharosError after LOST_SERVERS times."""
        self.lost_servers += 1
        if self.lost_servers > LOST_SERVERS:
            raise PharosError(
                f"the process that starts runs died {pluralize(self.lost_servers, 'time')} in a row "
                f"({in_one_line(error)}); was there memory enough?"
            ) from error
        time.sleep(BUSY_SECONDS)

    def _await(self) -> None:
        if self.pool is None:
            return
        if not self.running:
            time.sleep(BUSY_SECONDS)
            return
        has_room = self.waiting and len(self.running) < self.num_workers
        for key, event in self.pool.events(BUSY_SECONDS if has_room else PROCESS_WAITING_SECONDS):
            if isinstance(event, tuple):
                self.receive(key, event)
            else:
                self._end(key, event)
        for key, (group, began) in self.running.items():
            if self.timeout is not None and time.monotonic() - began > self.timeout * len(group):
                self.kills.update({id(run): self.attempts for run in group})
                assert self.pool is not None
                self.pool.kill(key)

    def _end(self, key: str, code: int | str) -> None:
        """Count the results of a process that has ended. Its other runs wait again.

        Args:
            code: exit code, or, of other pools, why it has died.
        """
        group, _ = self.running.pop(key)
        left = [run for run in group if not self.is_over(run, ended=code in (0, self.exit_busy))]
        if code == SERVER_LOST and left and self.lost_servers < LOST_SERVERS:
            self.lost_servers += 1  # the worker may well live: the next attempt waits for it
        elif code != self.exit_busy:
            self._repeat(key, left, code if isinstance(code, str) else self._in_words(code))
            return
        if left:  # another process is at them
            self.waiting.append((time.monotonic() + BUSY_SECONDS, left))

    def _in_words(self, code: int) -> str:
        name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
        how = f"by {name}" if code < 0 else f"with exit code {code}"
        advice = "was there memory enough?" if code == -signal.SIGKILL else "look at what it wrote to standard error"
        return f"its process ended {how}{f', {self.attempts} times' * (self.attempts > 1)}; {advice}"

    def _repeat(self, key: str, group: list[R], reason: str) -> None:
        """Let runs without results wait again, up to `attempts` times. Then halve them, or let a single run fail."""
        for run in group:
            self.kills[id(run)] += 1
        most = max((self.kills[id(run)] for run in group), default=0)
        if group and most < self.attempts:
            self.waiting.append((0.0, group))
        elif len(group) > 1 and most == self.attempts and self.is_divisible:
            self.kills.update({id(run): 0 for run in group})
            self.halve(key, group)
        else:
            if most > self.attempts:
                advice = "it was ended: raise --timeout, or look for a loop without an end"
                reason = f"took longer than {self.timeout:g} s; {advice}"
            for run in group:
                self.fail(run, reason)


def stored_batches(checkpoints: Path | None) -> dict[Path, frozenset[str]]:
    """Folders with the checkpoint of a program of several runs, and the ids of those."""
    batches = {}
    for file in [] if checkpoints is None else sorted(checkpoints.glob("*/batch.json")):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            batches[file.parent] = frozenset(read_json(file)["ids"])
    return batches


# Runs by their configurations -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of the runs of `train_configs` after an evaluation.

    Attributes:
        done, total: environment steps of all runs together.
        rows: of the curves, by the index of the run among the configurations, of this evaluation alone.
        finished, failed: numbers of runs.
    """

    done: int
    total: int
    rows: Mapping[int, Mapping[str, Any]]
    finished: int
    failed: int


ProgressCallback = Callable[[TrainingProgress], None]


def train_configs(
    configs: Sequence[RunConfig | Mapping[str, Any]],
    folders: Sequence[Path] | None = None,
    *,
    checkpoints: Path | None = None,
    progress: ProgressCallback | None = None,
    tasks: TaskCache | None = None,
    device: str | None = None,
    lane: int | None = None,
    workers: int = 1,
    seconds: Sequence[float] | None = None,
) -> list[TrainingResult | FailedRun]:
    """Train a run for each configuration. Runs of the batched engine that fit together train as one program.

    Args:
        folders: of the runs, one for each. None: nothing is written. Finished runs there are returned.
        checkpoints: folder for checkpoints of whole batches. None: none are written. A batch that was killed goes on
            from there with the runs that it had.
        progress: called after each evaluation. What it raises ends the training and is raised here.
        tasks: makes tasks, with values that are known already, and code of the user's own if it is trusted. None:
            from scratch, trusting none.
        device: "cpu" or "cuda". Default: the tasks' device, and "cpu" if there are none.
        lane: the most runs in a batch. Default: all that fit together. Changes no result.
        workers: processes that share the runs, lane by lane, if there are folders. What they learn is in these alone.
            They trust the code that the configurations name. Changes no result.
        seconds: that each run takes, in any unit, by which they are shared out. Default: all take as long.
    Returns:
        The result of each run, or why it has none.
    Raises:
        FileFormatError: not the configuration of a run. ParameterError: there is no such device, or the tasks are
            for another one.
        MissingExtra: PyTorch is not installed. OSError: the disk is full.
    """
    tasks = TaskCache(device=device or "cpu") if tasks is None else tasks
    if device not in (None, tasks.device):
        raise ParameterError(f"device is {device!r}, and the tasks are for {tasks.device!r}; expected one device")
    check_device(tasks.device)
    run_configs = [config if isinstance(config, RunConfig) else RunConfig.from_dict(config) for config in configs]
    groups = plan(run_configs, workers=1 if folders is None else workers, device=tasks.device, seconds=seconds)
    return Training(run_configs, folders, groups, checkpoints, progress, tasks, lane=lane).results_in_order()


def check_device(device: str) -> None:
    """Raise ParameterError for a device that torch does not have here."""
    if device == "cpu":
        return
    import torch

    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch has a type for each of its builds
        reason = (str(error).splitlines() or [""])[0]
        raise ParameterError(f"device is {device!r}, which torch does not have here: {reason}; try cpu") from None


class Training(Execution[PreparedRun]):
    """Execution of the runs of one call: in this process if they are one group, else each group in one of its own.

    Args:
        groups: indices of runs among the configurations.
        options: of `train_group`.
    Attributes:
        results: of the runs that have ended, by index.
    """

    def __init__(
        self,
        configs: Sequence[RunConfig],
        folders: Sequence[Path] | None,
        groups: Sequence[Sequence[int]],
        checkpoints: Path | None,
        progress: ProgressCallback | None,
        tasks: TaskCache,
        **options: Any,
    ):
        paths = [None] * len(configs) if folders is None else [Path(folder) for folder in folders]
        self.runs = [PreparedRun(i, *each, tasks) for i, each in enumerate(zip(configs, paths, strict=True))]
        self.progress, self.tasks = progress, tasks
        self.options = {**options, "is_single": len(configs) == 1}
        self.results: dict[int, TrainingResult | FailedRun] = {}
        self.steps: dict[str, int] = {}  # of runs that are being trained, by process
        pool = Workers() if len(groups) > 1 else None
        prepared = [[self.runs[index] for index in group] for group in groups]
        super().__init__(prepared, pool, workers=len(groups), checkpoints=checkpoints)

    def results_in_order(self) -> list[TrainingResult | FailedRun]:
        """Train all runs, and return their results in the order of the configurations."""
        try:
            self.execute()
        except CallbackError as stop:
            (cause,) = stop.args
            raise cause from None
        return [self.results[index] for index in range(len(self.runs))]

    def work(self, group: Sequence[PreparedRun]) -> Work:
        if self.pool is None:
            fresh = [PreparedRun(run.index, run.config, run.folder, self.tasks) for run in group]
            return partial(train_group, **self.options), (fresh, self.checkpoints), ()
        values = [None if self.tasks.values is None else self.tasks.values(run.config) for run in group]
        entries = [(run.index, run.config.to_dict(), run.folder, own) for run, own in zip(group, values, strict=True)]
        arguments = entries, self.checkpoints, self.tasks.device, self.options
        return _train_in_process, arguments, group[0].config.definitions

    def is_over(self, run: PreparedRun, *, ended: bool = False) -> bool:
        return run.index in self.results

    def receive(self, key: str, message: tuple[Any, ...]) -> None:
        """Take what `train_group` tells."""
        kind, *content = message
        if kind == "error":  # a full disk, which ends the other groups as well
            raise content[0]
        if kind == "rows":
            self.steps[key], rows = content
            self._report(rows)
            return
        if kind == "end":
            index, self.results[index] = content  # its steps are counted there, those of its group's others stay here
            self.steps[key] = max(0, self.steps.get(key, 0) - self.runs[index].config.steps)
        else:
            indices, reason = content
            self.steps[key] = 0
            self.halve(key, [self.runs[index] for index in indices], reason)

    def fail(self, run: PreparedRun, reason: str) -> None:
        assert run.index is not None
        error = PharosError(reason)
        run.fail(error)
        self.results[run.index] = FailedRun(run.config.to_dict(), run.folder, error)

    def _report(self, rows: Mapping[int, Mapping[str, Any]]) -> None:
        """Call the progress function. CallbackError for what it raises, which is not an error of the runs."""
        if self.progress is None:
            return
        failed = sum(isinstance(end, FailedRun) for end in self.results.values())
        done = sum(self.runs[index].config.steps for index in self.results) + sum(self.steps.values())
        total = sum(run.config.steps for run in self.runs)
        try:
            self.progress(TrainingProgress(done, total, rows, len(self.results) - failed, failed))
        except BaseException as error:
            raise CallbackError(error) from error


def _train_in_process(
    entries: Sequence[tuple[int, dict[str, Any], Path, TaskValues | None]],
    checkpoints: Path | None,
    device: str,
    options: Mapping[str, Any],
    send: Callable[[tuple[Any, ...]], None],
) -> None:
    """Body of a process: train a group, and send what `train_group` reports.

    SIGTERM ends it at once, as there is nothing to clean up, and a repeated call needs its locks.
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    run_configs = [RunConfig.from_dict(config) for _, config, _, _ in entries]
    stored = {config.id: own for config, (*_, own) in zip(run_configs, entries, strict=True)}
    # Code is that which the process that started this one has imported
    tasks = TaskCache(lambda config: stored[config.id], trust=True, device=device)
    runs = [
        PreparedRun(index, config, folder, tasks)
        for config, (index, _, folder, _) in zip(run_configs, entries, strict=True)
    ]

    def report(message: tuple[Any, ...]) -> None:
        kind, *content, last = message
        if isinstance(last, TrainingResult):  # what was learnt is in the folder
            last = replace(last, agent=None)
        elif isinstance(last, FailedRun):  # its error may be of a class that the other process does not know
            last = replace(last, exception=PharosError(last.error))
        send((kind, *content, last))

    try:
        train_group(runs, checkpoints, report, **options)
    except OSError as error:
        send(("error", error))
