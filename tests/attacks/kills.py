"""Commands of pharos that are killed: each in a process forked from one that has loaded everything.

A kill is SIGKILL, either after a while, or just before the n-th time that the process changes a file: opens one to
write, renames, removes, syncs. A process that it started may be the one that is hit.
"""

import contextlib
import importlib
import json
import mmap
import multiprocessing
import os
import signal
import struct
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from patience import PATIENCE
from pharos.system.workers import one_thread

CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.symlink")
"""What Python reports (`sys.addaudithook`) of a process that changes files, beside files that it opens."""
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
VOLATILE = {
    "seconds",
    "compiling_seconds",
    "written",
    "digest",
    "elapsed",
    "remaining",
    "updated",
    "process",
    "host",
    "batch",
}
"""What JSON files say of when, where and beside which other runs (fewer, once some have ended), not of what came
out."""
UNCOMPARED = ("log.txt", "status.json", "lock")
REMADE = ("cache/values",)
"""What is computed again where it is not there, and then not kept."""
PYTHON = "python"
"""A command of this name is code of Python, its second word."""


@dataclass(frozen=True)
class End:
    """How a command ended.

    Attributes:
        code: exit code; negative: the signal that ended it.
        text: what it printed.
        changes: how often it changed files. is_killed: whether it, or a process that it started, was killed.
        is_of_worker: whether it was one that it started.
        seconds: that it took.
    """

    code: int
    text: str
    changes: int
    is_killed: bool
    is_of_worker: bool
    seconds: float


class ForkServer:
    """A process that executes commands, each in a fork; before that `programs`, folder -> commands, which compile."""

    def __init__(self, programs: dict[Path, list[list[str]]]):
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(other, programs))
        with one_thread():  # a process with threads must not be forked
            self.process.start()
        other.close()
        self.connection.recv()

    def execute(self, words: list[str], folder: Path, *, change: int = 0, seconds: float = 0.0) -> End:
        """Execute a command in a folder; kill it before the change of this number, or after so many seconds."""
        self.connection.send((words, folder, change, seconds))
        return self.connection.recv()

    def close(self) -> None:
        """End the process."""
        self.connection.close()
        self.process.join()


def _serve(connection: Any, programs: dict[Path, list[list[str]]]) -> None:
    _prepare(programs)
    connection.send("ready")
    with contextlib.suppress(EOFError):
        while True:
            connection.send(_execute(*connection.recv()))


def _prepare(programs: dict[Path, list[list[str]]]) -> None:
    """Load, and execute what compiles; let small worlds pass through many blocks and checkpoints."""
    from pharos import state_space
    from pharos.system import memory
    from pharos.training import results

    search = importlib.import_module("pharos.state_space.search")
    search.CHUNK, search.WIDE_FOR_THREADS = 512, 200  # type: ignore[attr-defined]
    state_space.build.__kwdefaults__["checkpoint_seconds"] = 0.0
    memory.LEAST_MEMORY = 1 << 16
    results.RUN_CHECKPOINT_SECONDS = 0.0
    os.fsync = lambda _: None  # type: ignore[assignment]  # what is killed loses nothing that is not on the disk yet
    fork = multiprocessing.get_context("fork")
    multiprocessing.get_context = lambda method=None: fork  # type: ignore[assignment]
    for folder, commands in programs.items():
        os.chdir(folder)
        for words in commands:
            code, text = _command(words)
            assert code == 0, (words, text)


def _command(words: list[str]) -> tuple[int, str]:
    """Exit code and output of a command in this process."""
    from typer.testing import CliRunner

    from pharos.cli import app

    if words[0] == PYTHON:
        exec(words[1], {})
        return 0, ""
    done = CliRunner().invoke(app, words)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.output


def _execute(words: list[str], folder: Path, change: int, seconds: float) -> End:
    """Execute a command in a fork of this process."""
    shared, began = mmap.mmap(-1, 16), time.monotonic()  # changes so far, and the process that was killed at the last
    with tempfile.TemporaryFile() as output:
        process = os.fork()
        if process == 0:
            _child(words, folder, change, shared, output.fileno())
        status = 0
        while time.monotonic() < began + (seconds or PATIENCE):
            ended, status = os.waitpid(process, os.WNOHANG)
            if ended:
                break
            time.sleep(0.001)
        else:
            os.kill(process, signal.SIGKILL)
            _, status = os.waitpid(process, 0)
        took = time.monotonic() - began
        output.seek(0)
        text = output.read().decode(errors="replace")
    code, (changes, killed) = os.waitstatus_to_exitcode(status), struct.unpack("qq", shared)
    assert took < PATIENCE, (words, text)
    return End(code, text, changes, bool(killed) or code == -signal.SIGKILL, killed not in (0, process), took)


def processes_in(folder: Path) -> list[int]:
    """Living processes whose current folder this is, where the system tells."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is another user's
            found += [int(process.name)] * os.path.samefile(process / "cwd", folder)
    return found


def _child(words: list[str], folder: Path, change: int, shared: mmap.mmap, output: int) -> None:
    """The process of a command; it never returns."""
    code = 99
    try:
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(folder)
        os.environ["PHAROS_CACHE_DIR"] = str(folder / "cache")
        _count_changes(str(folder), change, shared)
        from pharos.cli import app

        if words[0] == PYTHON:
            exec(words[1], {})
            code = 0
        else:
            app(words)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _count_changes(folder: str, last: int, shared: mmap.mmap) -> None:
    """Count how often this process changes files in a folder, and kill it before the last of these changes."""

    def note() -> None:
        done = struct.unpack_from("q", shared)[0] + 1
        struct.pack_into("q", shared, 0, done)
        if done == last:
            struct.pack_into("q", shared, 8, os.getpid())
            os.kill(os.getpid(), signal.SIGKILL)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, _, flags = arguments
            if flags & WRITING and isinstance(path, str | os.PathLike) and os.path.abspath(path).startswith(folder):
                note()
        elif event in CHANGES:
            note()

    os.fsync = lambda _: note()  # type: ignore[assignment,return-value]
    sys.addaudithook(hook)


# What a command leaves -----------------------------------------------------------------------------------------------


def content(folder: Path) -> dict[str, Any]:
    """Every file and folder by its path: the bytes of a file, but of JSON what does not depend on when and where."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name.startswith(REMADE):
            continue
        if path.is_dir() or path.name in UNCOMPARED:
            found[name] = ""
        elif path.suffix == ".json":
            found[name] = _lasting(json.loads(path.read_text()))
        else:
            found[name] = path.read_bytes()
    return found


def _lasting(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _lasting(item) for name, item in value.items() if name not in VOLATILE}
    return [_lasting(item) for item in value] if isinstance(value, list) else value
