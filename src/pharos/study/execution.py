"""Executes what is missing of a study: one process a run, from a process that has loaded everything already.

Runs are independent, named by the hash of their config, and appear whole or not at all (`_worker`): runner or workers may be
killed at any moment, several runners may share a folder, and the same command goes on from there.
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
from dataclasses import asdict, dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any

from pharos.errors import ParameterError, StateSpaceLocked
from pharos.study import values as _values
from pharos.study import worker as _worker
from pharos.study.specification import Run, Source, Specification, specification, study_name
from pharos.study.worker import write_atomically

ATTEMPTS = 3
STATUS_SECONDS = 2.0
BUSY_SECONDS = 0.5
OTHERS_SECONDS = 20.0  # between two looks at what other runners have finished in the same folder


@dataclass(frozen=True)
class Status:
    """How far a study is.

    Attributes:
        name, folder: of the study.
        total, finished, failed, running: numbers of runs; those in `running` are started and not over.
        errors: of the failed runs, by id.
        elapsed, remaining: seconds since this runner began, and until the end as far as one can tell (None: not yet).
        preparing: what is built or solved before the runs; empty otherwise.
    """

    name: str
    folder: str
    total: int
    finished: int
    failed: int
    running: int
    errors: Mapping[str, str]
    elapsed: float = 0.0
    remaining: float | None = None
    preparing: str = ""

    @property
    def missing(self) -> int:
        """Runs that are not over."""
        return self.total - self.finished - self.failed

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {**asdict(self), "missing": self.missing}

    def __str__(self) -> str:
        if self.preparing:
            return f"{self.name}: {self.preparing}"
        text = f"{self.name}: {self.finished} of {self.total} runs finished"
        if self.failed:
            text += f", {self.failed} failed"
        if self.running:
            text += f", {self.running} running"
        if self.missing and self.remaining is not None:
            text += f", about {duration(self.remaining)} left"
        return text


def duration(seconds: float) -> str:
    """`40 s`, `12 min`, `3.5 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def opened(
    source: Source, folder: str | os.PathLike | None = None, *, trust: bool | None = None
) -> tuple[Specification, Path]:
    """A study and where its results are: `folder`, else the source if that is a study's folder, else studies/NAME.

    Args:
        trust: as for `specification`.
    """
    study = specification(source, trust=trust)
    if folder is None and isinstance(source, str | Path) and Path(source, "study.yaml").is_file():
        folder = source
    return study, Path("studies", study.name) if folder is None else Path(folder)


def train(config: Mapping[str, Any], folder: Path) -> None:
    """The runner of studies: trains as `config` says and writes run.json and curve.parquet into `folder`."""
    from pharos.experiments import TaskValues, train_config

    values = _values.kept(config)
    known = None if values is None else TaskValues.from_dict(values)
    train_config(config, folder, values=known, trust=True, strict=True)


def prepare_instance(config: Mapping[str, Any]) -> None:
    """Build the state space of a run into the cache, and keep the values of its task at the start."""
    _values.task_of(config).space.num_states  # noqa: B018
    _values.solve(config)


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


def run(
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
) -> Status:
    """Execute the runs of a study that are not over, on this machine.

    Args:
        source: YAML file, preset, mapping, Specification, or the folder of a study.
        folder: of the results; None for that folder, or studies/NAME.
        shard: `i/n`: only the i-th of n parts, for n machines that share the folder.
        retry_failed: execute failed runs again.
        resume: let runs that were killed go on from their last checkpoint, for long runs on machines that come and go. A deep
            agent then ends elsewhere than without the interruption; else killed runs start anew, and results never depend on it.
        timeout: seconds after which a run is ended, and failed.
        workers: processes; None for as many as there are processors.
        progress: called with a Status every now and then.
        runner: `runner(config, folder)`, a function of a module, which writes run.json and curve.parquet.
        prepare: called with one config of each instance, in a process of its own, before the runs; None: builds state spaces
            for the usual runner, and does nothing for another.
    Returns:
        The Status at the end. Failed runs do not stop the others.
    Raises:
        ParameterError: the specification or an option is wrong, or the folder holds another study.
    """
    study, place = opened(source, folder)
    runs = shard_of(study.runs, shard)
    if workers is not None and workers < 1:
        raise ParameterError(f"workers is {workers}; expected at least 1")
    claim(study, place)
    name = "status.json" if shard is None else f"status-{str(shard).replace('/', '-of-')}.json"
    execution = _Execution(
        study, place, runs, name, retry_failed, resume, timeout, workers or processors(), progress, runner
    )
    if prepare is None and runner is train:
        prepare = prepare_instance
    if prepare is not None:
        execution.prepare(prepare)
    return execution.run()


def status(source: Source, folder: str | os.PathLike | None = None) -> Status:
    """How far a study is, from its files; `remaining` is what its runners last said."""
    study, place = opened(source, folder)
    states = {run.id: _worker.read_record(place / "runs" / run.id) for run in study.runs}
    errors = {id: str(record.get("error")) for id, record in states.items() if record and record["status"] == "failed"}
    finished = sum(1 for record in states.values() if record and record["status"] == "finished")
    running, remaining = 0, None
    for file in sorted(place.glob("status*.json")):
        with contextlib.suppress(ValueError, OSError):
            said = json.loads(file.read_text(encoding="utf-8"))
            if _lives(said):
                running += said["running"]
                if said["remaining"] is not None:
                    remaining = max(remaining or 0.0, said["remaining"])
    return Status(study.name, str(place), len(states), finished, len(errors), running, errors, 0.0, remaining)


def _lives(said: Mapping[str, Any]) -> bool:
    """Whether the runner that wrote a status file is there: told exactly on its own machine, by the file's age elsewhere."""
    if said["host"] != socket.gethostname():
        return time.time() - said["updated"] < 60
    try:
        os.kill(said["process"], 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return time.time() - said["updated"] < 60


def claim(study: Specification, folder: Path) -> None:
    """Write the specification into the folder, so that it can be reported on alone; refuse a folder of another study."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "study.yaml"
    if file.exists():
        name = study_name(file)
        if name is not None and name != study.name:
            raise ParameterError(f"{folder}: holds the study {name!r}, not {study.name!r}; choose another --out")
    import yaml

    text = yaml.safe_dump(study.model_dump(mode="json", exclude_unset=True), sort_keys=False, width=120)
    write_atomically(file, text)


def processors() -> int:
    """The processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Execution:
    """The loop that starts, awaits and counts worker processes."""

    def __init__(
        self,
        study: Specification,
        folder: Path,
        runs: Sequence[Run],
        status_name: str,
        retry_failed: bool,
        resume: bool,
        timeout: float | None,
        workers: int,
        progress: Callable[[Status], None] | None,
        runner: _worker.Runner,
    ):
        self.study, self.folder, self.runs, self.workers = study, folder, runs, workers
        self.timeout, self.runner, self.tell, self.resume = timeout, runner, progress, resume
        self.status_file = folder / status_name
        self.began = time.monotonic()
        self.told, self.looked = -1e9, time.monotonic()
        self.finished: dict[str, float] = {}
        self.errors: dict[str, str] = {}
        self.again: set[str] = set()
        self.pending: deque[tuple[float, Run]] = deque()
        self.running: dict[int, tuple[Any, Run, float]] = {}
        self.kills: dict[str, int] = defaultdict(int)
        self.seconds_per_step: dict[tuple, tuple[float, int]] = {}
        for run in runs:
            if not self.note(run, retry_failed):
                self.pending.append((0.0, run))

    def prepare(self, prepare: Callable[[Mapping[str, Any]], Any]) -> None:
        """Call `prepare` with one config of each instance that has runs to come; a failure is left to the runs to tell."""
        instances: dict[str, Run] = {}
        for _, run in self.pending:
            config = run.config
            key = json.dumps([config[name] for name in ("environment", "parameters", "chance", "gamma", "horizon")])
            instances.setdefault(key, run)
        todo = list(instances.values())
        while todo:
            receiver, sender = multiprocessing.get_context("spawn").Pipe(duplex=False)
            process = multiprocessing.get_context("spawn").Process(
                target=_prepare_all, args=(prepare, [run.config for run in todo], sender)
            )
            process.start()
            sender.close()
            done = 0
            try:
                while done < len(todo):
                    run = todo[done]
                    self.report(f"preparing {run.instance}, {run.chance} ({len(instances) - len(todo) + done + 1} of {len(instances)})")  # fmt: skip
                    if receiver.poll(STATUS_SECONDS):
                        receiver.recv()
                        done += 1
            except EOFError:
                done += 1  # the process died at this one
            except KeyboardInterrupt:
                process.terminate()
                raise
            finally:
                receiver.close()
            process.join()
            del todo[:done]

    def run(self) -> Status:
        context = _context(self.runner is train)
        try:
            while self.pending or self.running:
                if time.monotonic() - self.looked >= OTHERS_SECONDS:
                    self._look_around()
                self._start(context)
                self.report()
                self._await()
        except BaseException:
            for process, _, _ in self.running.values():
                process.terminate()
            for process, _, _ in self.running.values():
                process.join(10)
            self.running.clear()
            self.report(final=True)
            raise
        _clear(self.folder, self.runs)
        return self.report(final=True)

    def _look_around(self) -> None:
        """Count what other runners have finished: one listing of the folder."""
        self.looked = time.monotonic()
        with contextlib.suppress(OSError):
            there = set(os.listdir(self.folder / "runs"))
            self.pending = deque(
                (due, run)
                for due, run in self.pending
                if run.id not in there or run.id in self.again or not self.note(run)
            )

    def _start(self, context: Any) -> None:
        for _ in range(len(self.pending)):
            if len(self.running) >= self.workers:
                return
            due, run = self.pending.popleft()
            if due > time.monotonic():
                self.pending.append((due, run))
                continue
            if self.note(run, run.id in self.again):
                continue
            again = run.id in self.again
            where = (run.id, self.folder.absolute(), again, self.resume)
            arguments = (self.runner, dict(run.config), *where, dict(os.environ))
            process = context.Process(target=_worker.main, args=arguments, name=run.id)
            process.start()
            self.running[process.sentinel] = (process, run, time.monotonic())

    def _await(self) -> None:
        waiting = BUSY_SECONDS if self.pending and len(self.running) < self.workers else STATUS_SECONDS / 2
        if not self.running:
            time.sleep(BUSY_SECONDS)
            return
        for sentinel in connection.wait(list(self.running), waiting):
            process, run, _ = self.running.pop(sentinel)  # type: ignore[arg-type]
            process.join()
            code = process.exitcode
            process.close()
            if code == _worker.EXIT_BUSY:
                self.pending.append((time.monotonic() + BUSY_SECONDS, run))
            elif not self.note(run, code != 0 and run.id in self.again):
                self._killed(run, code)
        if self.timeout is not None:
            for process, run, started in self.running.values():
                if time.monotonic() - started > self.timeout:
                    self.kills[run.id] = ATTEMPTS
                    process.kill()

    def _killed(self, run: Run, code: int) -> None:
        """A worker ended without a result: again, up to ATTEMPTS times, then the run has failed."""
        self.kills[run.id] += 1
        if self.kills[run.id] < ATTEMPTS:
            self.pending.append((0.0, run))
            return
        if self.kills[run.id] > ATTEMPTS:
            error = f"took longer than {self.timeout:g} s"
        else:
            how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
            error = f"its process ended {how}, {ATTEMPTS} times; was there memory enough?"
        partial = self.folder / "partial" / run.id
        partial.mkdir(parents=True, exist_ok=True)
        _worker.write_failure(partial, run.config, run.id, error, 0.0)
        _worker.publish(partial, self.folder, run.id)
        self.note(run, False)

    def note(self, run: Run, again: bool = False) -> bool:
        """Read the run's result, if it is over; False where it has to be executed."""
        record = _worker.read_record(self.folder / "runs" / run.id)
        if record is None or (record["status"] != "finished" and again):
            if record is not None:
                self.again.add(run.id)
            return False
        if record["status"] == "finished":
            self.finished[run.id] = record["seconds"]
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
        for _, run, started in self.running.values():
            needed = run.config["steps"] * pace.get(run.kind, usual)
            seconds += max(0.0, needed - (time.monotonic() - started))
        return seconds / self.workers

    def report(self, preparing: str = "", *, final: bool = False) -> Status:
        now = Status(
            self.study.name,
            str(self.folder),
            len(self.runs),
            len(self.finished),
            len(self.errors),
            len(self.running),
            dict(self.errors),
            time.monotonic() - self.began,
            self._remaining(),
            preparing,
        )
        if self.tell is not None:
            self.tell(now)
        if final or time.monotonic() - self.told > STATUS_SECONDS:
            self.told = time.monotonic()
            said = {**now.to_dict(), "updated": time.time(), "process": os.getpid(), "host": socket.gethostname()}
            write_atomically(self.status_file, json.dumps(said, indent=1) + "\n")
        return now


def _context(warm: bool) -> Any:
    """Processes are forked from one that has loaded everything; where the system cannot do that, started anew."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pharos.study.warm" if warm else "pharos.study.worker"])
    return context


def _prepare_all(
    prepare: Callable[[Mapping[str, Any]], Any], configs: Iterable[Mapping[str, Any]], sender: Any
) -> None:
    _worker.end_with_parent()
    for config in configs:
        with contextlib.suppress(Exception):  # the runs of this instance will fail with the same error, and say so
            _unless_locked(prepare, config)
        sender.send(True)


def _unless_locked(prepare: Callable[[Mapping[str, Any]], Any], config: Mapping[str, Any]) -> None:
    """Prepare an instance; where another process is building it, wait for that one."""
    while True:
        try:
            prepare(config)
            return
        except StateSpaceLocked:
            time.sleep(STATUS_SECONDS)


def _clear(folder: Path, runs: Iterable[Run]) -> None:
    """Remove what only running needs, once every run is over."""
    for run in runs:
        for name in (f"partial/{run.id}", f"partial/{run.id}.failed", f"locks/{run.id}"):
            shutil.rmtree(folder / name, ignore_errors=True)
    for name in ("partial", "locks"):
        with contextlib.suppress(OSError):
            (folder / name).rmdir()
