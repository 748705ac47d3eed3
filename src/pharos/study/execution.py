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
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pharos.errors import AllRunsFailed, FileFormatError, ParameterError, StateSpaceLocked
from pharos.state_space import build
from pharos.study import batches as _batches
from pharos.study import worker as _worker
from pharos.study.blocks import Run, Specification, part_of
from pharos.study.specification import Source
from pharos.study.status import Forecast, Status, duration, opened, status, write_specification
from pharos.system.records import takes
from pharos.system.storage import replace_json
from pharos.system.workers import Workers, usable_workers
from pharos.training import Execution, ExecutionOptions, Work

__all__ = ["Status", "StudyExecution", "duration", "opened", "run", "shard_of", "status", "write_specification"]

STATUS_SECONDS = 2.0
# Between two counts of the runs that other runners have finished in the same folder
OTHERS_SECONDS = 20.0


def train_run(config: Mapping[str, Any], folder: Path) -> None:
    """Train a run as `config` says, and write run.json and curve.csv into `folder`: the runner of studies."""
    _batches.train_batch([config], [folder], folder)


def shard_of(runs: Sequence[Run], shard: str | tuple[int, int] | None) -> tuple[Run, ...]:
    """The i-th of n parts of the runs, `i/n` with i from 1 to n: every n-th run, so that parts last about as long."""
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
    runner: _worker.Runner = train_run,
    prepare: Callable[[Mapping[str, Any]], Any] | None = None,
    batch_runner: _worker.BatchRunner | None = None,
    on_forecast: Callable[[Forecast], None] | None = None,
    **options: Any,
) -> Status:
    """Execute the runs of a study that are not over, on this machine.

    Args:
        source: YAML file, preset, mapping, Specification, or the folder of a study.
        folder: of the results. Default: that folder, or studies/NAME.
        progress: called with a Status every now and then.
        runner: `runner(config, folder)`, a function of a module, which writes run.json and curve.csv.
        prepare: called with one config of each instance, in a process of its own, before the runs. By default it builds
            state spaces for the usual runner, and does nothing for another.
        batch_runner: `runner(configs, folders, folder for checkpoints)` of runs that the study says are batched.
            Default: the usual one for the usual runner, else each of them alone.
        on_forecast: called before the first run with how many are to come, and how long they will take.
        options: of `pharos.training.ExecutionOptions`: shard, retry_failed, resume, timeout, workers, device, block,
            agent, observation.
    Returns:
        The Status at the end. Failed runs do not stop the others.
    Raises:
        ParameterError: the specification or an option is wrong, the folder holds another study, or torch has no such
            device here.
        AllRunsFailed: every run has failed. Its `outcome` is the Status.
    """
    on_forecast = options.pop("foretold", on_forecast)  # its name before
    execution = StudyExecution(*opened(source, folder), ExecutionOptions(**options), runner, batch_runner, progress)
    missing = execution.missing
    if missing and runner is train_run:
        check_device_in_process(execution.options.device)
    if on_forecast is not None and missing:
        on_forecast(execution.forecast())
    if prepare is None and runner is train_run:
        prepare = prepare_instance
    if prepare is not None:  # the runs report a failure there
        prepare_instances(prepare, missing, execution.report)
    end = execution.run()
    if end.failed and end.failed == end.total:
        raise AllRunsFailed(execution.folder, end.errors, end)
    return end


class StudyExecution(Execution[Run]):
    """Execution of the runs of a study that are not over. Arguments are the same as for `run`.

    Args:
        pool: None: processes of this machine.
    """

    exit_busy = _worker.EXIT_BUSY

    def __init__(
        self,
        study: Specification,
        folder: Path,
        options: ExecutionOptions,
        runner: _worker.Runner = train_run,
        batch_runner: _worker.BatchRunner | None = None,
        progress: Callable[[Status], None] | None = None,
        pool: Workers | None = None,
    ):
        self.study, self.folder, self.options, self.progress = study, folder, options, progress
        part = part_of(study, options.block, options.agent, options.observation)
        self.runs = shard_of(tuple(part), options.shard)
        write_specification(study, folder)
        if batch_runner is None and runner is train_run:
            batch_runner = partial(_batches.train_batch, device=options.device)
        self.runner, self.batch_runner = runner, batch_runner
        self.began = time.monotonic()
        self.last_report, self.last_listing = -1e9, time.monotonic()
        self.finished: dict[str, float] = {}
        self.errors: dict[str, str] = {}
        self.damaged: dict[str, str] = {}
        self.repeated: set[str] = set()
        self.seconds_per_step: dict[tuple, tuple[float, int]] = {}
        missing = [run for run in self.runs if not self.record_result(run, options.retry_failed)]
        checkpoints = folder / _worker.BATCHES
        groups = [[run] for run in missing]
        if batch_runner is not None:
            groups = _batches.batches(missing, checkpoints, options.device)
        if pool is not None:
            super().__init__(groups, pool, workers=len(self.runs), checkpoints=checkpoints, attempts=1)
            return
        # Stable-Baselines3 asks whether there is a GPU, and CUDA refuses in what is forked after that
        preload = "pharos.study.warm" if runner is train_run else "pharos.study.worker"
        pool = Workers(preload if options.device == "cpu" else None)
        alone = options.workers is None and options.device != "cpu"  # several processes would share a GPU's memory
        workers = usable_workers(1 if alone else options.workers)
        super().__init__(groups, pool, workers=workers, checkpoints=checkpoints, timeout=options.timeout)

    @property
    def missing(self) -> list[Run]:
        """Runs that wait."""
        return [run for _, group in self.waiting for run in group]

    def forecast(self) -> Forecast:
        """Forecast of the missing runs: their number, their steps, and the seconds that they will take."""
        steps = sum(run.config["steps"] for run in self.missing)
        return Forecast(len(self.missing), steps, int(self.num_workers), self._remaining())

    def run(self) -> Status:
        """Execute the missing runs, and return the Status at the end."""
        try:
            self.execute()
        except BaseException:
            self.running.clear()
            self.report(final=True)
            raise
        _clear(self.folder, self.runs)
        return self.report(final=True)

    def work(self, group: Sequence[Run]) -> Work:
        runner, resume = self.batch_runner, True
        if runner is None or group[0].engine != "batched":
            runner, resume = partial(_worker.run_alone, self.runner), self.options.resume
        ids = [run.id for run in group]
        arguments = runner, [dict(run.config) for run in group], ids, self.folder.absolute()
        of_runs = (each for run in group for each in run.configuration.definitions)
        again = self.repeated.intersection(ids)
        return _worker.main, (*arguments, again, resume), (self.runner, self.batch_runner, *of_runs)

    def is_over(self, run: Run, *, ended: bool = False) -> bool:
        return self.record_result(run, not ended and run.id in self.repeated)

    def receive(self, key: str, message: tuple[Any, ...]) -> None:
        """Take ids of runs that cannot be trained together, and why."""
        ids, reason = message
        self.halve(key, [run for run in self.running[key][0] if run.id in ids], reason)

    def look(self) -> None:
        """Count the runs that other runners have finished, by one listing of the folder, and report."""
        if time.monotonic() - self.last_listing >= OTHERS_SECONDS:
            self.last_listing = time.monotonic()
            with contextlib.suppress(OSError):
                ids = set(os.listdir(self.folder / "runs"))
                for _, group in self.waiting:
                    group[:] = [
                        run
                        for run in group
                        if run.id not in ids or run.id in self.repeated or not self.record_result(run)
                    ]
        self.report()

    def fail(self, run: Run, reason: str) -> None:
        """Publish a run that has failed, with the files that its process has left behind."""
        folder = self.folder / "partial" / run.id
        folder.mkdir(parents=True, exist_ok=True)
        _worker.write_failure(folder, run.config, run.id, reason, 0.0)
        _worker.publish_run(folder, self.folder, run.id)
        self.record_result(run, False)

    def record_result(self, run: Run, again: bool = False) -> bool:
        """Read and count the result of a run that is over. False if it has to be executed, a damaged one again."""
        try:
            record = _worker.run_record(self.folder / "runs" / run.id)
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
        seconds = sum(run.config["steps"] * pace.get(run.kind, usual) for run in self.missing)
        for group, began in self.running.values():
            needed = sum(run.config["steps"] * pace.get(run.kind, usual) for run in group)
            seconds += max(0.0, needed - (time.monotonic() - began))
        return seconds / self.num_workers

    def report(self, preparing: str = "", *, final: bool = False) -> Status:
        """The Status now, which `progress` is called with. Every STATUS_SECONDS it is written into the folder."""
        now = Status(
            name=self.study.name,
            folder=str(self.folder),
            total=len(self.runs),
            finished=len(self.finished),
            failed=len(self.errors),
            running=sum(len(group) for group, _ in self.running.values()),
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
    for name in ("partial", "locks"):
        with contextlib.suppress(OSError):
            (folder / name).rmdir()


# Prebuild -------------------------------------------------------------------------------------------------------------


POLL_SECONDS = 2.0


def prepare_instance(config: Mapping[str, Any]) -> None:
    """Build the state space of a run into the cache, and keep the values of its task at the start."""
    build(_batches.task_of_config(config).env, wait=False)
    _batches.solve(config)


def prepare_instances(
    prepare: Callable[[Mapping[str, Any]], Any], runs: Iterable[Run], progress: Callable[[str], Any]
) -> None:
    """Call `prepare` with one config of each instance of the runs, and `progress` with a text. Failures are ignored.

    A separate process prepares them one after the other. If it dies, another goes on with the next.
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
            progress(f"preparing {run.instance}, {run.chance} ({number} of {len(instances)}){waits_for}")
            for _, message in workers.events(POLL_SECONDS):
                waits_for = f"; {message}" if isinstance(message, str) and message else ""
                if not waits_for and todo:  # one is prepared, or its process has died
                    todo.popleft()


def check_device_in_process(device: str) -> None:
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
    """Prepare instances one after the other. Send "" after each, and the reason if one waits."""
    for config in configs:
        with contextlib.suppress(Exception):  # the runs of this instance will fail with the same error, and say so
            unless_locked(prepare, config, send)
        send("")


def unless_locked(
    prepare: Callable[[Mapping[str, Any]], Any], config: Mapping[str, Any], on_wait: Callable[[str], None]
) -> None:
    """Prepare an instance. If another process is building it, wait for that one."""
    while True:
        try:
            prepare(config)
            return
        except StateSpaceLocked as error:
            on_wait(str(error))
            time.sleep(POLL_SECONDS)
