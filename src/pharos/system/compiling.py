"""Folders that keep compiled code, so that it is compiled once; and the seconds of compiling, apart from work.

`pharos.kernels` calls `prepare` as it is loaded; before that nothing can have been compiled.
"""

import contextlib
import os
import stat
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

from pharos.errors import ParameterError
from pharos.system import storage
from pharos.system.storage import compiled_folders

SMALL = 1 << 16
"""Entries below which rules and kernels are interpreted, as compiling takes longer (benchmarks/startup.py); 0: none."""

SOURCES = "sources.json"
"""Names, times and sizes of the files whose kernels lie compiled beside it."""

_lock = threading.Lock()
_total, _running, _began = 0.0, 0, 0.0
is_told = False
"""Whether a line on the terminal has told that this process compiles, or need not, as the command does it itself."""


def seconds() -> float:
    """Seconds of wall-clock time in which this process has compiled so far; threads that compile at once count once."""
    with _lock:
        return _total + (time.perf_counter() - _began if _running else 0.0)


class Stopwatch:
    """Stopwatch of work and of compiling, which counts from its creation on."""

    def __init__(self) -> None:
        self._began, self._compiled = time.perf_counter(), seconds()

    @property
    def compiling(self) -> float:
        """Seconds of compiling."""
        return seconds() - self._compiled

    @property
    def seconds(self) -> float:
        """Seconds of everything else."""
        return max(0.0, time.perf_counter() - self._began - self.compiling)


def prepare(kernels: Path) -> None:
    """Start the timing, and give Numba a folder for the compiled code of the files in `kernels`; loads Numba.

    Numba keeps it beside the files. Where nothing can be written there (an installation for all users, a container), it
    goes into the private folder of the cache, for the processes that this one starts, too; where there is none, into a
    temporary folder of this process.

    Raises:
        ParameterError: variables of the environment keep Numba from compiling.
    """
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        raise ParameterError("NUMBA_DISABLE_JIT is set, and pharos' kernels work compiled alone; unset it")
    if not os.environ.get("NUMBA_CACHE_DIR") and not _can_be_written(kernels / "__pycache__"):
        os.environ["NUMBA_CACHE_DIR"] = str(
            private_folder(storage.cache_directory()) or storage.temporary_folder("pharos-")
        )
    if not os.environ.get("NUMBA_CACHE_DIR"):
        _forget_outdated(kernels)
    _start_timing()


def _forget_outdated(kernels: Path) -> None:
    """Delete compiled code of older sources: Numba checks a kernel's own file, not the files of what it calls."""
    files = [(path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in sorted(kernels.glob("*.py"))]
    text, compiled = storage.json_text(files), kernels / "__pycache__"
    with contextlib.suppress(OSError):  # of a process that does the same at the same time
        if not (compiled / SOURCES).is_file() or (compiled / SOURCES).read_text() != text:
            for index in compiled.glob("*.nbi"):
                index.unlink()
            storage.replace_file(compiled / SOURCES, text, durable=False)


def _can_be_written(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _start_timing() -> None:
    """Register a listener of Numba that adds up the seconds of compiling."""
    try:
        from numba.core import config, event
    except (ValueError, RuntimeError) as error:
        raise ParameterError(f"Numba cannot be loaded: {error}; look at its variables, NUMBA_...") from error

    vars(config)["CACHE_DIR"] = os.environ.get("NUMBA_CACHE_DIR", "")  # Numba may have been loaded before

    class Compiling(event.Listener):
        def on_start(self, event: event.Event) -> None:
            global _running, _began
            with _lock:
                if not _running:
                    _began = time.perf_counter()
                _running += 1
            _tell(event.data["dispatcher"].py_func)

        def on_end(self, event: object) -> None:
            global _running, _total
            with _lock:
                _running -= 1
                if not _running:
                    _total += time.perf_counter() - _began

    event.register("numba:compile", Compiling())


def _tell(function: Callable) -> None:
    """Print once, on a terminal, that the first call compiles, which takes some seconds."""
    global is_told
    if not is_told and function.__module__.startswith("pharos.") and sys.stderr is not None and sys.stderr.isatty():
        is_told = True
        print("pharos: compiling, some seconds; kept for the next time", file=sys.stderr, flush=True)


@cache
def private_folder(cache_directory: Path) -> Path | None:
    """The folder of compiled code, which is this user's and which nobody else can write to; None where there is none.

    It is `compiled`, or, where several users share the cache, `compiled-` and the user's number. A warning says what is
    wrong with a folder that is refused.
    """
    problems = []
    for folder in compiled_folders(cache_directory):
        problem = _problem_of(folder)
        if not problem:
            break
        problems.append(f"{folder} {problem}")
    if problems:
        instead = f"{folder} is used instead" if not problem else "code is compiled anew by every process"
        warnings.warn(
            f"compiled code: {'; '.join(problems)}; {instead}. "
            f"Reading compiled code runs it: `chmod 700` the folder or delete it, or set PHAROS_CACHE_DIR",
            RuntimeWarning,
            stacklevel=2,
        )
    return None if problem else folder


def _problem_of(folder: Path) -> str:
    """Make the folder where it is missing. Returns the reason against its use, "" where there is none."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status, link, parent = folder.stat(), folder.lstat(), folder.parent.stat()
    except OSError as error:
        return f"cannot be used ({error.strerror})"
    if not stat.S_ISDIR(status.st_mode):
        return "is no folder"
    if not hasattr(os, "getuid"):
        return ""
    if others := {status.st_uid, link.st_uid} - {os.getuid()}:
        return f"belongs to another user (number {others.pop()})"
    if parent.st_mode & stat.S_IWOTH and not parent.st_mode & stat.S_ISVTX:
        return "lies in a folder whose entries anybody can rename"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "can be written to by other users"
    return "" if os.access(folder, os.W_OK | os.X_OK) else "cannot be written to"
