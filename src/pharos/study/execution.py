"""Execution of the missing runs of a study: one process a run, forked from one that has loaded everything already.

Runs are independent, named by the hash of their config, and appear whole or not at all (worker.py): runner or workers
may be killed at any moment, several runners may share a folder, and the same command goes on from there.

Before the runs of a study, state spaces are built and tasks solved, once for all runs on them.
"""

import contextlib
import json
import os
import shutil
import socket
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pharos.errors import AllRunsFailed, FileFormatError, ParameterError, PharosError, StateSpaceLocked
from pharos.state_space import build
from pharos.study import batches as _batches
from pharos.study import worker as _worker
from pharos.study.blocks import Run, Specification
from pharos.study.specification import Source
from pharos.study.status import Forecast, Status, claim, duration, opened, status
from pharos.system.records import takes
from pharos.system.storage import replace_json
from pharos.system.wording import in_one_line, pluralize
from pharos.system.workers import Workers, one_thread, usable_workers
from pharos.training import ExecutionOptions

__all__ = ["Execution", "Status", "claim", "duration", "opened", "run", "shard_of", "status"]

ATTEMPTS = 3
STATUS_SECONDS = 2.0
BUSY_SECONDS = 0.5
# Between two counts of the runs that other runners have finished in the same folder
OTHERS_SECONDS = 20.0
# How often in a row the process that forks workers is begun again, and the exit code that multiprocessing gives a
# worker whose server is gone
LOST_SERVERS = 10
SERVER_LOST = 255


Job = tuple[_worker.BatchRunner, list[dict[str, Any]], list[str], Path, set[str], bool]


def train(config: Mapping[str, Any], folder: Path) -> None:
    """Train a run as `config` says, and write run.json and curve.csv into `folder`: the runner of studies."""
    from pharos.training import TaskValues, train_config

    values = _batches.stored_values(config)
    task_values = None if values is None else TaskValues.from_dict(values)
    train_config(config, folder, values=task_values, trust=True, strict=True)


def shard_of(runs: Sequence[Run], shard: str | tuple[int, int] | None) -> tuple[Run, ...]:
    """The i-th of n parts of the runs, `i/n` with i from 1 to n; every n-th run, so that parts last about as long."""
    if shard is None:
        return tuple(runs)
    try:
        part, parts = map(int, shard.split("/")) if isinstance(shard, str) else shard
    except ValueError:
        part = parts = 0
    if not 1 <= part <= parts:
        raise ParameterError(f"shard is {shard!r}; expected i/n with i from 1 to n, such as 1/8")
    return tuple(runs[part - 1 :: parts])


@takes(ExecutionOptions)
def run(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    progress: Callable[[Status], None] | None = None,
    runner: _worker.Runner = train,
    prepare: Callable[[Mapping[str, Any]], Any] | None = None,
    batch_runner: _worker.BatchRunner | None = None,
    foretold: Callable[[Forecast], None] | None = None,
    **options: Any,
) -> Status:
    """Execute the runs of a study that are not over, on this machine.

    Args:
        source: YAML file, preset, mapping, Specification, or the folder of a study.
        folder: of the results; None for that folder, or studies/NAME.
        progress: called with a Status every now and then.
        runner: `runner(config, folder)`, a function of a module, which writes run.json and curve.csv.
        prepare: called with one config of each instance, in a process of its own, before the runs; None: builds state
            spaces for the usual runner, and does nothing for another.
        batch_runner: `runner(configs, folders, folder for checkpoints)` of runs that the study says are batched; None:
            the usual one for the usual runner, else each of them alone.
        foretold: called before the first run with how many are to come, and how long they will take.
        options: of `pharos.training.ExecutionOptions`: shard, retry_failed, resume, timeout, workers, device.
    Returns:
        The Status at the end. Failed runs do not stop the others.
    Raises:
        ParameterError: the specification or an option is wrong, the folder holds another study, or torch has no such
            device here.
        AllRunsFailed: every run has failed; its `outcome` is the Status.
    """
    execution = Execution(*opened(source, folder), ExecutionOptions(**options), runner, batch_runner, progress)
    if execution.pending and runner is train:
        refuse_missing(execution.options.device)
    if foretold is not None and execution.pending:
        foretold(execution.forecast())
    if prepare is None and runner is train:
        prepare = prepare_instance
    if prepare is not None:
        execution.prepare(prepare)
    end = execution.run()
    if end.failed and end.failed == end.total:
        raise AllRunsFailed(execution.folder, end.errors, end)
    return end


class Execution:
    """The loop that starts, awaits and counts worker processes; arguments as for `run`."""

    def __init__(
        self,
        study: Specification,
        folder: Path,
        options: ExecutionOptions,
        runner: _worker.Runner = train,
        batch_runner: _worker.BatchRunner | None = None,
        progress: Callable[[Status], None] | None = None,
    ):
        self.study, self.folder, self.options, self.progress = study, folder, options, progress
        self.runs = shard_of(study.runs, options.shard)
        alone = options.workers is None and options.device != "cpu"  # several processes would share a GPU's memory
        self.num_workers = usable_workers(1 if alone else options.workers)
        claim(study, folder)
        if batch_runner is None and runner is train:
            batch_runner = partial(_batches.train_batch, device=options.device)
        self.runner, self.batch_runner = runner, batch_runner
        self.began = time.monotonic()
        self.last_report, self.last_listing = -1e9, time.monotonic()
        self.finished: dict[str, float] = {}
        self.errors: dict[str, str] = {}
        self.damaged: dict[str, str] = {}
        self.repeated: set[str] = set()
        self.pending: deque[tuple[float, Run]] = deque()
        self.running: dict[str, tuple[tuple[Run, ...], float]] = {}
        # Stable-Baselines3 asks whether there is a GPU, and CUDA refuses in what is forked after that
        preload = "pharos.study.warm" if runner is train else "pharos.study.worker"
        self.workers = Workers(preload if options.device == "cpu" else None)
        self.batches = _batches.Batches(folder, options.device)
        self.kills: dict[str, int] = defaultdict(int)
        self.lost_servers = 0
        self.seconds_per_step: dict[tuple, tuple[float, int]] = {}
        for run in self.runs:
            if not self.record_result(run, options.retry_failed):
                self.pending.append((0.0, run))

    def forecast(self) -> Forecast:
        """Forecast of the missing runs: their number, their steps, and the seconds that they will take."""
        steps = sum(run.config["steps"] for _, run in self.pending)
        return Forecast(len(self.pending), steps, self.num_workers, self._remaining())

    def prepare(self, prepare: Callable[[Mapping[str, Any]], Any]) -> None:
        """Call `prepare` with one config of each instance that has runs to come; a failure is left to the runs to
        tell."""
        prepare_instances(prepare, [run for _, run in self.pending], self.report)

    def run(self) -> Status:
        """Execute the pending runs; return the Status at the end."""
        try:
            with self.workers:
                while self.pending or self.running:
                    if time.monotonic() - self.last_listing >= OTHERS_SECONDS:
                        self._refresh()
                    self._start()
                    self.report()
                    self._await()
        except BaseException:
            self.running.clear()
            self.report(final=True)
            raise
        _clear(self.folder, self.runs)
        return self.report(final=True)

    def _refresh(self) -> None:
        """Count the runs that other runners have finished, by one listing of the folder."""
        self.last_listing = time.monotonic()
        with contextlib.suppress(OSError):
            ids = set(os.listdir(self.folder / "runs"))
            self.pending = deque(
                (due, run)
                for due, run in self.pending
                if run.id not in ids or run.id in self.repeated or not self.record_result(run)
            )

    def _start(self) -> None:
        for _ in range(len(self.pending)):
            if not self.pending or len(self.running) >= self.num_workers:
                return
            due, run = self.pending.popleft()
            if due > time.monotonic():
                self.pending.append((due, run))
                continue
            if self.record_result(run, run.id in self.repeated):
                continue
            batch = self.next_batch(run)
            try:
                self._worker(batch)
            except (EOFError, ConnectionError) as error:
                self._server_lost(error)
                self.pending.extendleft((due, each) for each in reversed(batch))
                return
            self.running[run.id] = (batch, time.monotonic())

    def _server_lost(self, error: Exception) -> None:
        """Wait a little for another process that forks workers, as it is gone; PharosError after LOST_SERVERS times."""
        self.lost_servers += 1
        if self.lost_servers > LOST_SERVERS:
            raise PharosError(
                f"the process that starts runs died {pluralize(self.lost_servers, 'time')} in a row "
                f"({in_one_line(error)}); was there memory enough?"
            ) from error
        time.sleep(BUSY_SECONDS)

    def _worker(self, batch: tuple[Run, ...]) -> None:
        of_runs = (each for run in batch for each in run.configuration.definitions)
        definitions = (self.runner, self.batch_runner, *of_runs)
        with one_thread():
            self.workers.start(batch[0].id, _worker.main, self.job(batch), definitions)

    def next_batch(self, run: Run) -> tuple[Run, ...]:
        """A run and those that the same process executes, which are taken from `pending`."""
        return (run,) if self.batch_runner is None else self.batches.next_batch(run, self.pending)

    def job(self, batch: Sequence[Run]) -> Job:
        """The arguments of `worker.main` for these runs."""
        runner, resume = self.batch_runner, True
        if runner is None or batch[0].engine != "batched":
            runner, resume = partial(_worker.run_alone, self.runner), self.options.resume
        ids = [run.id for run in batch]
        configs, again = [dict(run.config) for run in batch], self.repeated.intersection(ids)
        return runner, configs, ids, self.folder.absolute(), again, resume

    def _await(self) -> None:
        if not self.running:
            time.sleep(BUSY_SECONDS)
            return
        waiting = BUSY_SECONDS if self.pending and len(self.running) < self.num_workers else STATUS_SECONDS / 2
        for id, code in self.workers.events(waiting):
            self._ended(self.running.pop(id)[0], code)
        for id, (batch, started) in self.running.items():
            if self.options.timeout is not None and time.monotonic() - started > self.options.timeout * len(batch):
                self.kills.update({run.id: ATTEMPTS for run in batch})
                self.workers.kill(id)

    def _ended(self, batch: tuple[Run, ...], code: int) -> None:
        """Count the results of a process that has ended; its other runs are executed again."""
        is_killed = code not in (0, _worker.EXIT_BUSY)
        left = [run for run in batch if not self.record_result(run, is_killed and run.id in self.repeated)]
        if code == SERVER_LOST and left and self.lost_servers < LOST_SERVERS:
            self.lost_servers += 1  # the worker may well live: the next attempt waits for it
        elif is_killed or (code == 0 and batch[0].engine != "batched"):
            self._killed(left, code)
            return
        self.pending.extend((time.monotonic() + BUSY_SECONDS, run) for run in left)  # another process is at them

    def _killed(self, batch: Sequence[Run], code: int) -> None:
        """Repeat runs without results up to ATTEMPTS times; then halve their batch, or mark a single run as failed."""
        for run in batch:
            self.kills[run.id] += 1
        most = max((self.kills[run.id] for run in batch), default=0)
        if most < ATTEMPTS:
            self.batches.scan_checkpoints()
        elif len(batch) > 1 and most == ATTEMPTS:
            self.batches.halve(batch)
            self.kills.update({run.id: 0 for run in batch})
        else:
            for run in batch:
                self._mark_failed(run, code)
            return
        self.pending.extend((0.0, run) for run in batch)

    def _mark_failed(self, run: Run, code: int) -> None:
        """Publish a run as failed, because its process was killed too often, or took too long."""
        if self.kills[run.id] > ATTEMPTS:
            self.fail(run, f"took longer than {self.options.timeout:g} s")
        else:
            how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
            self.fail(run, f"its process ended {how}, {ATTEMPTS} times; was there memory enough?")

    def fail(self, run: Run, error: str) -> None:
        """Publish a run that has failed, with the files that its process has left behind."""
        folder = self.folder / "partial" / run.id
        folder.mkdir(parents=True, exist_ok=True)
        _worker.write_failure(folder, run.config, run.id, error, 0.0)
        _worker.publish(folder, self.folder, run.id)
        self.record_result(run, False)

    def record_result(self, run: Run, again: bool = False) -> bool:
        """Read and count the result of a run that is over; False where it has to be executed, a damaged one again."""
        try:
            record = _worker.read_record(self.folder / "runs" / run.id)
        except FileFormatError as error:
            self.damaged[run.id] = str(error)
            return False
        if record is None or (record["status"] != "finished" and again):
            if record is not None:
                self.repeated.add(run.id)
            return False
        self.damaged.pop(run.id, None)
        if record["status"] == "finished":
            self.finished[run.id] = record["seconds"]
            self.lost_servers = 0
            self.errors.pop(run.id, None)
            seconds, steps = self.seconds_per_step.get(run.kind, (0.0, 0))
            self.seconds_per_step[run.kind] = (seconds + record["seconds"], steps + run.config["steps"])
        else:
            self.errors[run.id] = str(record.get("error"))
        return True

    def _remaining(self) -> float | None:
        """Seconds until the end: the steps to come at the pace of finished runs of the same kind."""
        if not self.seconds_per_step:
            return None
        pace = {kind: seconds / steps for kind, (seconds, steps) in self.seconds_per_step.items()}
        usual = sum(pace.values()) / len(pace)
        seconds = sum(run.config["steps"] * pace.get(run.kind, usual) for _, run in self.pending)
        for batch, started in self.running.values():
            needed = sum(run.config["steps"] * pace.get(run.kind, usual) for run in batch)
            seconds += max(0.0, needed - (time.monotonic() - started))
        return seconds / self.num_workers

    def report(self, preparing: str = "", *, final: bool = False) -> Status:
        """The Status now, which `progress` is called with; every STATUS_SECONDS it is written into the folder."""
        now = Status(
            name=self.study.name,
            folder=str(self.folder),
            total=len(self.runs),
            finished=len(self.finished),
            failed=len(self.errors),
            running=sum(len(batch) for batch, _ in self.running.values()),
            errors=dict(self.errors),
            elapsed=time.monotonic() - self.began,
            remaining=self._remaining(),
            preparing=preparing,
            damaged=dict(self.damaged),
        )
        if self.progress is not None:
            self.progress(now)
        if final or time.monotonic() - self.last_report > STATUS_SECONDS:
            self.last_report = time.monotonic()
            record = {**now.to_dict(), "updated": time.time(), "process": os.getpid(), "host": socket.gethostname()}
            part = "" if self.options.shard is None else f"-{str(self.options.shard).replace('/', '-of-')}"
            replace_json(self.folder / f"status{part}.json", record, durable=False)
        return now


def _clear(folder: Path, runs: Iterable[Run]) -> None:
    """Remove the folders that only running needs, once every run is over."""
    for run in runs:
        for name in (f"partial/{run.id}", f"partial/{run.id}.failed", f"locks/{run.id}"):
            shutil.rmtree(folder / name, ignore_errors=True)
    for name in ("partial", "locks", _worker.BATCHES):
        with contextlib.suppress(OSError):
            (folder / name).rmdir()


# Prebuild -------------------------------------------------------------------------------------------------------------


POLL_SECONDS = 2.0


def prepare_instance(config: Mapping[str, Any]) -> None:
    """Build the state space of a run into the cache, and keep the values of its task at the start."""
    build(_batches.task_of(config).env, wait=False)
    _batches.solve(config)


def prepare_instances(
    prepare: Callable[[Mapping[str, Any]], Any], runs: Iterable[Run], tell: Callable[[str], Any]
) -> None:
    """Call `prepare` with one config of each instance of the runs, and `tell` with its progress; failures are ignored.

    A process of their own prepares them one after the other; where it dies, another goes on with the next.
    """
    instances: dict[str, Run] = {}
    for run in runs:
        config = run.config
        key = json.dumps([config[name] for name in ("environment", "parameters", "chance", "gamma", "horizon")])
        instances.setdefault(key, run)
    todo, waits_for = deque(instances.values()), ""
    with Workers() as workers:
        while todo:
            if not workers:
                definitions = [prepare, *(each for run in todo for each in run.configuration.definitions)]
                workers.start("", _prepare_all, (prepare, [run.config for run in todo]), definitions)
            number, run = len(instances) - len(todo) + 1, todo[0]
            tell(f"preparing {run.instance}, {run.chance} ({number} of {len(instances)}){waits_for}")
            for _, message in workers.events(POLL_SECONDS):
                waits_for = f"; {message}" if isinstance(message, str) and message else ""
                if not waits_for and todo:  # one is prepared, or its process has died
                    todo.popleft()


def refuse_missing(device: str) -> None:
    """Raise ParameterError for a device that torch does not have here, before each run fails for it.

    A process of its own asks torch: it would keep some of a GPU's memory.
    """
    if device == "cpu":
        return
    with Workers() as workers:
        workers.start("", _ask_for_device, (device,))
        while workers:
            for _, message in workers.events():
                if isinstance(message, ParameterError):
                    raise message


def _ask_for_device(device: str, send: Callable[[ParameterError], None]) -> None:
    from pharos.training import check_device

    try:
        check_device(device)
    except ParameterError as error:
        send(error)


def _prepare_all(
    prepare: Callable[[Mapping[str, Any]], Any], configs: Iterable[Mapping[str, Any]], send: Callable[[str], None]
) -> None:
    """Prepare instances one after the other; send "" after each, and the reason where one waits."""
    for config in configs:
        with contextlib.suppress(Exception):  # the runs of this instance will fail with the same error, and say so
            unless_locked(prepare, config, send)
        send("")


def unless_locked(
    prepare: Callable[[Mapping[str, Any]], Any], config: Mapping[str, Any], tell: Callable[[str], None]
) -> None:
    """Prepare an instance; where another process is building it, wait for that one."""
    while True:
        try:
            prepare(config)
            return
        except StateSpaceLocked as error:
            tell(str(error))
            time.sleep(POLL_SECONDS)
