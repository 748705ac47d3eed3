"""Executes what is missing of a study: one process a run, from a process that has loaded everything already.

Runs are independent, named by the hash of their config, and appear whole or not at all (worker.py): runner or workers
may be killed at any moment, several runners may share a folder, and the same command goes on from there.

What comes before the runs of a study: state spaces are built, and tasks solved, once for all runs on them.
"""

import contextlib
import json
import multiprocessing
import os
import shutil
import socket
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from pharos.errors import AllRunsFailed, FileFormatError, ParameterError, PharosError, StateSpaceLocked
from pharos.state_space import build
from pharos.study import batches as _batches
from pharos.study import worker as _worker
from pharos.study.blocks import Run, Specification
from pharos.study.specification import Source
from pharos.study.status import Forecast, Status, claim, duration, opened, status
from pharos.study.worker import end_processes, one_thread, processors, ready, worker_context
from pharos.system.storage import replace_json
from pharos.system.wording import in_one_line, many
from pharos.system.workers import check_guard, end_with_parent, without_interrupts, without_main

__all__ = ["Execution", "Options", "Status", "claim", "duration", "opened", "processors", "run", "shard_of", "status"]

ATTEMPTS = 3
STATUS_SECONDS = 2.0
BUSY_SECONDS = 0.5
# Between two looks at what other runners have finished in the same folder
OTHERS_SECONDS = 20.0
# How often in a row the process that forks workers is begun again, and what multiprocessing says of a worker whose
# server is gone
LOST_SERVERS = 10
SERVER_LOST = 255


Job = tuple[_worker.BatchRunner, list[dict[str, Any]], list[str], Path, set[str], bool]


def train(config: Mapping[str, Any], folder: Path) -> None:
    """The runner of studies: trains as `config` says and writes run.json and curve.parquet into `folder`."""
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


def run(  # noqa: PLR0913
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    shard: str | tuple[int, int] | None = None,
    retry_failed: bool = False,
    resume: bool = False,
    timeout: float | None = None,
    workers: int | None = None,
    progress: Callable[[Status], None] | None = None,
    runner: _worker.Runner = train,
    prepare: Callable[[Mapping[str, Any]], Any] | None = None,
    batch_runner: _worker.BatchRunner | None = None,
    foretold: Callable[[Forecast], None] | None = None,
    device: str = "cpu",
) -> Status:
    """Execute the runs of a study that are not over, on this machine.

    Args:
        source: YAML file, preset, mapping, Specification, or the folder of a study.
        folder: of the results; None for that folder, or studies/NAME.
        shard: `i/n`: only the i-th of n parts, for n machines that share the folder.
        retry_failed: execute failed runs again.
        resume: let runs that were killed go on from their last checkpoint, for long runs on machines that come and go.
            A deep agent then ends elsewhere than without the interruption; else killed runs start anew, and results
            never depend on it.
        timeout: seconds after which a run is ended, and failed; a batch gets as many for each of its runs.
        workers: processes; None for as many as there are processors.
        progress: called with a Status every now and then.
        runner: `runner(config, folder)`, a function of a module, which writes run.json and curve.parquet.
        prepare: called with one config of each instance, in a process of its own, before the runs; None: builds state
            spaces for the usual runner, and does nothing for another.
        batch_runner: `runner(configs, folders, folder for checkpoints)` of runs that the study says are batched; None:
            the usual one for the usual runner, else each of them alone.
        foretold: called before the first run with how many are to come, and how long they will take.
        device: where batches are trained, as torch names it: "cpu", "cuda".
    Returns:
        The Status at the end. Failed runs do not stop the others.
    Raises:
        ParameterError: the specification or an option is wrong, or the folder holds another study.
        AllRunsFailed: every run has failed; its `outcome` is the Status.
    """
    study, place = opened(source, folder)
    runs = shard_of(study.runs, shard)
    if workers is not None and workers < 1:
        raise ParameterError(f"workers is {workers}; expected at least 1")
    claim(study, place)
    name = "status.json" if shard is None else f"status-{str(shard).replace('/', '-of-')}.json"
    options = Options(
        retry_failed=retry_failed,
        resume=resume,
        timeout=timeout,
        workers=workers or processors(),
        progress=progress,
        runner=runner,
        batch_runner=partial(_batches.train_batch, device=device)
        if batch_runner is None and runner is train
        else batch_runner,
        device=device,
        status_file=name,
    )
    execution = Execution(study, place, runs, options)
    if foretold is not None and execution.pending:
        foretold(execution.forecast())
    if prepare is None and runner is train:
        prepare = prepare_instance
    if prepare is not None:
        execution.prepare(prepare)
    end = execution.run()
    if end.failed and end.failed == end.total:
        raise AllRunsFailed(place, end.errors, end)
    return end


@dataclass(frozen=True, kw_only=True)
class Options:
    """How the runs of a study are executed; see `run`."""

    retry_failed: bool = False
    resume: bool = False
    timeout: float | None = None
    workers: int
    progress: Callable[[Status], None] | None = None
    runner: _worker.Runner = train
    batch_runner: _worker.BatchRunner | None = None
    device: str = "cpu"
    status_file: str = "status.json"


class Execution:
    """The loop that starts, awaits and counts worker processes."""

    def __init__(self, study: Specification, folder: Path, runs: Sequence[Run], options: Options):
        self.study, self.folder, self.runs, self.options = study, folder, runs, options
        self.began = time.monotonic()
        self.last_report, self.last_listing = -1e9, time.monotonic()
        self.finished: dict[str, float] = {}
        self.errors: dict[str, str] = {}
        self.damaged: dict[str, str] = {}
        self.repeated: set[str] = set()
        self.pending: deque[tuple[float, Run]] = deque()
        self.running: dict[int, tuple[Any, tuple[Run, ...], float]] = {}
        self.batches = _batches.Batches(folder, options.device)
        self.kills: dict[str, int] = defaultdict(int)
        self.lost_servers = 0
        self.seconds_per_step: dict[tuple, tuple[float, int]] = {}
        for run in runs:
            if not self.note(run, options.retry_failed):
                self.pending.append((0.0, run))

    def forecast(self) -> Forecast:
        """How long the runs that are missing will take."""
        steps = sum(run.config["steps"] for _, run in self.pending)
        return Forecast(len(self.pending), steps, self.options.workers, self._remaining())

    def prepare(self, prepare: Callable[[Mapping[str, Any]], Any]) -> None:
        """Call `prepare` with one config of each instance that has runs to come; a failure is left to the runs to
        tell."""
        prepare_instances(prepare, [run for _, run in self.pending], self.report)

    def run(self) -> Status:
        context = worker_context(self.options.runner is train)
        try:
            while self.pending or self.running:
                if time.monotonic() - self.last_listing >= OTHERS_SECONDS:
                    self._look_around()
                self._start(context)
                self.report()
                self._await()
        except BaseException:
            end_processes([process for process, _, _ in self.running.values()])
            self.running.clear()
            self.report(final=True)
            raise
        _clear(self.folder, self.runs)
        return self.report(final=True)

    def _look_around(self) -> None:
        """Count what other runners have finished: one listing of the folder."""
        self.last_listing = time.monotonic()
        with contextlib.suppress(OSError):
            there = set(os.listdir(self.folder / "runs"))
            self.pending = deque(
                (due, run)
                for due, run in self.pending
                if run.id not in there or run.id in self.repeated or not self.note(run)
            )

    def _start(self, context: "_worker.Context") -> None:
        for _ in range(len(self.pending)):
            if len(self.running) >= self.options.workers:
                return
            due, run = self.pending.popleft()
            if due > time.monotonic():
                self.pending.append((due, run))
                continue
            if self.note(run, run.id in self.repeated):
                continue
            unit = self.unit(run)
            try:
                process = self._worker(context, unit)
            except (EOFError, ConnectionError) as error:
                self._server_lost(error)
                self.pending.extendleft((due, each) for each in reversed(unit))
                return
            self.running[process.sentinel] = (process, unit, time.monotonic())
            if not self.pending:
                return

    def _server_lost(self, error: Exception) -> None:
        """The process that forks workers is gone: wait a little, and the next start begins another."""
        self.lost_servers += 1
        if self.lost_servers > LOST_SERVERS:
            raise PharosError(
                f"the process that starts runs died {many(self.lost_servers, 'time')} in a row "
                f"({in_one_line(error)}); was there memory enough?"
            ) from error
        time.sleep(BUSY_SECONDS)

    def _worker(self, context: "_worker.Context", unit: tuple[Run, ...]) -> BaseProcess:
        arguments = (*self.job(unit), dict(os.environ))
        process = context.Process(target=_worker.main, args=arguments, name=unit[0].id)
        definitions = [each for run in unit for each in run.configuration.definitions]
        with one_thread(), without_main(self.options.runner, self.options.batch_runner, *definitions):
            ready(context)
            process.start()
        return process

    def unit(self, run: Run) -> tuple[Run, ...]:
        """The runs that are executed by one process with this one; they are taken from `pending`."""
        return (run,) if self.options.batch_runner is None else self.batches.unit(run, self.pending)

    def job(self, unit: Sequence[Run]) -> Job:
        """The arguments of `worker.main` for these runs, but for the last."""
        runner, resume = self.options.batch_runner, True
        if runner is None or unit[0].engine != "batched":
            runner, resume = partial(_worker.run_alone, self.options.runner), self.options.resume
        ids = [run.id for run in unit]
        configs, again = [dict(run.config) for run in unit], self.repeated.intersection(ids)
        return runner, configs, ids, self.folder.absolute(), again, resume

    def _await(self) -> None:
        waiting = BUSY_SECONDS if self.pending and len(self.running) < self.options.workers else STATUS_SECONDS / 2
        if not self.running:
            time.sleep(BUSY_SECONDS)
            return
        for sentinel in connection.wait(list(self.running), waiting):
            process, unit, _ = self.running.pop(sentinel)  # type: ignore[arg-type]
            process.join()
            code = process.exitcode
            process.close()
            self._ended(unit, code)
        if self.options.timeout is not None:
            for process, unit, started in self.running.values():
                if time.monotonic() - started > self.options.timeout * len(unit):
                    self.kills.update({run.id: ATTEMPTS for run in unit})
                    process.kill()

    def _ended(self, unit: tuple[Run, ...], code: int) -> None:
        """A process is over: what it has not left behind is done again."""
        check_guard(code)
        if code == _worker.EXIT_BUSY:
            left = list(unit)
        else:
            left = [run for run in unit if not self.note(run)]
            if code == SERVER_LOST and left and self.lost_servers < LOST_SERVERS:
                self.lost_servers += 1  # the worker may well live: the next attempt waits for it
            elif code == 0 and unit[0].engine == "batched":
                pass  # another process is at them
            else:
                self._killed([run for run in unit if not self.note(run, code != 0 and run.id in self.repeated)], code)
                return
        self.pending.extend((time.monotonic() + BUSY_SECONDS, run) for run in left)

    def _killed(self, unit: Sequence[Run], code: int) -> None:
        """Without results: again, up to ATTEMPTS times; then a batch is halved, and a run has failed."""
        for run in unit:
            self.kills[run.id] += 1
        if all(self.kills[run.id] < ATTEMPTS for run in unit):
            self.batches.look()
            self.pending.extend((0.0, run) for run in unit)
            return
        if len(unit) > 1 and all(self.kills[run.id] <= ATTEMPTS for run in unit):
            self.batches.halve(unit)
            self.kills.update({run.id: 0 for run in unit})
            self.pending.extend((0.0, run) for run in unit)
            return
        for run in unit:
            self._give_up(run, code)

    def _give_up(self, run: Run, code: int) -> None:
        """A run has failed: its process was killed too often, or took too long."""
        if self.kills[run.id] > ATTEMPTS:
            self.fail(run, f"took longer than {self.options.timeout:g} s")
        else:
            how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
            self.fail(run, f"its process ended {how}, {ATTEMPTS} times; was there memory enough?")

    def fail(self, run: Run, error: str) -> None:
        """Publish a run that has failed, with what its process has left behind."""
        folder = self.folder / "partial" / run.id
        folder.mkdir(parents=True, exist_ok=True)
        _worker.write_failure(folder, run.config, run.id, error, 0.0)
        _worker.publish(folder, self.folder, run.id)
        self.note(run, False)

    def note(self, run: Run, again: bool = False) -> bool:
        """Read the run's result, if it is over; False where it has to be executed, a damaged one again."""
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
        for _, unit, started in self.running.values():
            needed = sum(run.config["steps"] * pace.get(run.kind, usual) for run in unit)
            seconds += max(0.0, needed - (time.monotonic() - started))
        return seconds / self.options.workers

    def report(self, preparing: str = "", *, final: bool = False) -> Status:
        now = Status(
            name=self.study.name,
            folder=str(self.folder),
            total=len(self.runs),
            finished=len(self.finished),
            failed=len(self.errors),
            running=sum(len(unit) for _, unit, _ in self.running.values()),
            errors=dict(self.errors),
            elapsed=time.monotonic() - self.began,
            remaining=self._remaining(),
            preparing=preparing,
            damaged=dict(self.damaged),
        )
        if self.options.progress is not None:
            self.options.progress(now)
        if final or time.monotonic() - self.last_report > STATUS_SECONDS:
            self.last_report = time.monotonic()
            record = {**now.to_dict(), "updated": time.time(), "process": os.getpid(), "host": socket.gethostname()}
            replace_json(self.folder / self.options.status_file, record, durable=False)
        return now


def _clear(folder: Path, runs: Iterable[Run]) -> None:
    """Remove what only running needs, once every run is over."""
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
    """Call `prepare` with one config of each instance of the runs, and `tell` what it is at; failures are not told."""
    instances: dict[str, Run] = {}
    for run in runs:
        config = run.config
        key = json.dumps([config[name] for name in ("environment", "parameters", "chance", "gamma", "horizon")])
        instances.setdefault(key, run)
    todo = list(instances.values())
    while todo:
        del todo[: _prepare(prepare, todo, len(instances), tell)]


def _prepare(
    prepare: Callable[[Mapping[str, Any]], Any], todo: Sequence[Run], total: int, tell: Callable[[str], Any]
) -> int:
    """Prepare instances in a process of their own; how many are done, the one at which it died included."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_prepare_all, args=(prepare, [run.config for run in todo], sender))
    with without_main(prepare, *(each for run in todo for each in run.configuration.definitions)), without_interrupts():
        process.start()
    sender.close()
    done, waits_for = 0, ""
    try:
        while done < len(todo):
            run = todo[done]
            number = total - len(todo) + done + 1
            tell(f"preparing {run.instance}, {run.chance} ({number} of {total}){waits_for}")
            if receiver.poll(POLL_SECONDS):
                message = receiver.recv()
                waits_for = f"; {message}" if message else ""
                done += not message
    except EOFError:
        done += 1
    except BaseException:
        end_processes([process])
        raise
    finally:
        receiver.close()
    process.join()
    check_guard(process.exitcode)
    return done


def _prepare_all(
    prepare: Callable[[Mapping[str, Any]], Any], configs: Iterable[Mapping[str, Any]], sender: Connection
) -> None:
    """Prepare instances one after the other; send "" after each, and why where it waits."""
    _worker.end_cleanly()
    end_with_parent()
    for config in configs:
        with contextlib.suppress(Exception):  # the runs of this instance will fail with the same error, and say so
            unless_locked(prepare, config, sender.send)
        sender.send("")
    _worker.is_ending()


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
