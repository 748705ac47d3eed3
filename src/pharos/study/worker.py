"""One run, or a batch of runs, in one process: the folder of a run appears whole, or not at all.

    DIR/partial/ID/   while it is being run: its log (of a batch: with its first run), and whatever the runner writes
    DIR/runs/ID/      when it is over, moved there in one step: run.json (finished or failed), curve.csv, log.txt
    DIR/locks/ID/     held by the process that runs it

A process that is killed leaves a folder in `partial`, which the next attempt throws away, unless its result is
complete, or unless it is to be resumed: then the runner finds there what it wrote before.
"""

import contextlib
import os
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path
from typing import Any

from pharos import training
from pharos.errors import FileFormatError, FolderLocked
from pharos.system import storage
from pharos.system.wording import in_one_line

FINISHED, FAILED, BUSY = "finished", "failed", "busy"
# Seconds in a record that no run can take: ten thousand years
LONGEST_SECONDS = 3e11

BATCHES = "batches"
EXIT_BUSY = 75
"""Exit code of a process whose runs another process trains."""

Runner = Callable[[Mapping[str, Any], Path], Any]
BatchRunner = Callable[[Sequence[Mapping[str, Any]], Sequence[Path], Path], Sequence[str | None]]
"""runner(configs, folders, folder for checkpoints) -> for each run None, or why it failed, or HalfAsMany."""


class HalfAsMany(str):
    """Why runs cannot be trained together, as for want of memory: they have not failed, and go on in halves."""


def read_status(folder: Path) -> str | None:
    """`finished` or `failed`, or None if a run has no folder yet, or a damaged record."""
    try:
        record = run_record(folder)
    except FileFormatError:
        return None
    return None if record is None else str(record["status"])


def run_record(folder: Path) -> dict[str, Any] | None:
    """The record in run.json of a run, or None if there is none.

    Raises:
        FileFormatError: it is not the record of a run that is over. ResultCorrupted: it, or the curve of a finished
        run, was cut short or changed.
    Cost: 1.2 ms for a curve of a hundred rows.
    """
    file = folder / "run.json"
    if not file.exists():
        if folder.exists() and not folder.is_dir():
            raise FileFormatError(f"{folder}: is a file; expected the folder of a run")
        return None
    record = training.read_record(folder)
    if record.get("status") not in (FINISHED, FAILED):
        raise FileFormatError(f"{file}: is not the record of a run that is over")
    seconds = record.get("seconds")
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 <= seconds < LONGEST_SECONDS:
        raise FileFormatError(f"{file}: seconds are {str(seconds)[:20]}; expected how long the run took")
    if record["status"] == FINISHED:
        if not isinstance(record.get("result"), dict):
            raise FileFormatError(f"{file}: is of a finished run, but has no result")
        training.read_rows(folder, ())
    return record


def attempt_run(
    runner: BatchRunner,
    configs: Sequence[Mapping[str, Any]],
    ids: Sequence[str],
    folder: Path,
    *,
    again: Container[str] = (),
    resume: bool = False,
) -> list[str]:
    """Execute the runs that are not over. Return FINISHED, FAILED, BUSY (held by another process) or HalfAsMany for
    each.

    A run that raises is FAILED: its error stands in run.json and its log. Runs in `again` are repeated. With `resume`
    the runner gets what an attempt that was killed left behind, else empty folders.
    """
    ends: dict[str, str] = {}
    with contextlib.ExitStack() as held:
        todo = []
        for config, id in zip(configs, ids, strict=True):
            holder, partial = storage.inside(folder, "locks", id), storage.inside(folder, "partial", id)
            holder.mkdir(parents=True, exist_ok=True)
            try:
                held.enter_context(storage.lock(holder, FolderLocked, "training"))
            except FolderLocked:
                ends[id] = BUSY
                continue
            done = read_status(folder / "runs" / id)
            if done == FINISHED or (done == FAILED and id not in again):
                ends[id] = done
            elif read_status(partial) == FINISHED:  # its process was killed before it could publish it
                training.clear_run(partial)
                publish_run(partial, folder, id)
            else:
                if partial.exists() and not resume:
                    shutil.rmtree(partial)
                partial.mkdir(parents=True, exist_ok=True)
                todo.append((config, id, partial))
        if todo:
            ends |= _execute(runner, todo, folder)
        return [ends.get(id) or read_status(folder / "runs" / id) or FAILED for id in ids]


def _execute(runner: BatchRunner, todo: Sequence[tuple[Mapping[str, Any], str, Path]], folder: Path) -> dict[str, str]:
    """Call the runner, and put every run into its place, finished or failed. Return HalfAsMany by id of the others."""
    began = time.perf_counter()
    first, *others = partials = [partial for _, _, partial in todo]
    with redirected_output(first / "log.txt"):
        try:
            errors = list(runner([config for config, _, _ in todo], partials, folder / BATCHES))
        except Exception as error:
            traceback.print_exc()
            errors = [in_one_line(error)] * len(todo)
    left: dict[str, str] = {
        id: reason for (_, id, _), reason in zip(todo, errors, strict=True) if isinstance(reason, HalfAsMany)
    }
    for partial in others:
        shutil.copyfile(first / "log.txt", partial / "log.txt")
    seconds = (time.perf_counter() - began) / len(todo)
    for (config, id, partial), reason in zip(todo, errors, strict=True):
        if id in left:
            continue
        if read_status(partial) != FINISHED:
            missing = "the runner returned without a finished run.json and a curve"
            write_failure(partial, config, id, reason or missing, seconds)
        publish_run(partial, folder, id)
    return left


def run_alone(
    runner: Runner, configs: Sequence[Mapping[str, Any]], folders: Sequence[Path], _: Path
) -> Sequence[str | None]:
    """Call a runner of single runs with a batch of one. With `functools.partial` it is a BatchRunner."""
    runner(configs[0], folders[0])
    return [None]


def write_failure(folder: Path, config: Mapping[str, Any], id: str, error: str, seconds: float) -> None:
    """Write a run.json that says why there is no result."""
    record = {"format": 1, "id": id, "config": dict(config), "status": FAILED, "error": error, "seconds": seconds}
    storage.replace_json(folder / "run.json", storage.sealed(record))


def publish_run(partial: Path, folder: Path, id: str) -> None:
    """Move a run's folder to its place, on disk before it is there. An earlier failed attempt makes room."""
    for path in partial.rglob("*"):
        if path.is_file():
            storage.sync(path)
    runs = storage.inside(folder, "runs")
    runs.mkdir(parents=True, exist_ok=True)
    target = runs / id
    if target.exists():
        old = folder / "partial" / f"{id}.failed"
        _remove(old)
        os.rename(target, old)
        os.rename(partial, target)
        _remove(old)
    else:
        os.rename(partial, target)
    storage.sync(runs)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def redirected_output(path: Path):
    """Redirect the output of this process to a file."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    with open(path, "ab", opener=storage.own_file) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            with (
                open(1, "w", closefd=False) as out,
                open(2, "w", closefd=False, buffering=1) as err,
                contextlib.redirect_stdout(out),
                contextlib.redirect_stderr(err),
            ):
                yield
        finally:
            for number, old in zip((1, 2), saved, strict=True):
                os.dup2(old, number)
                os.close(old)


# As a process ---------------------------------------------------------------------------------------------------------


def main(
    runner: BatchRunner,
    configs: Sequence[Mapping[str, Any]],
    ids: Sequence[str],
    folder: Path,
    again: Container[str],
    resume: bool,
    send: Callable[[tuple[list[str], str]], None],
) -> None:
    """The body of a worker process. It sends the ids of runs that cannot be trained together, and why."""
    use_one_thread()
    try:
        ends = attempt_run(runner, configs, ids, folder, again=again, resume=resume)
    except OSError as error:  # a full disk, on which not even the log can say so
        sys.exit(f"pharos: run {ids[0]}: {error.strerror or error}")
    for reason in {id(end): end for end in ends if isinstance(end, HalfAsMany)}.values():
        send(([id for id, end in zip(ids, ends, strict=True) if end is reason], str(reason)))
    if BUSY in ends:
        sys.exit(EXIT_BUSY)


def use_one_thread() -> None:
    """Set one thread for PyTorch, if it is loaded, and for Numba. A process per run keeps the processors busy."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(1)
