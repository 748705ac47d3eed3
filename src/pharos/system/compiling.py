"""The folder that keeps compiled code, so that it is compiled once, and the seconds of compiling, apart from work.

`pharos.kernels` calls `prepare` as it is loaded. Before that nothing can have been compiled.
"""

import contextlib
import gc
import os
import re
import stat
import sys
import threading
import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

from pharos.errors import ParameterError
from pharos.system import storage
from pharos.system.storage import compiled_folders

SMALL_STATES = 1 << 16
"""Entries below which rules and kernels are interpreted, as compiling takes longer (benchmarks/startup.py); 0: none."""

NOTICE_AFTER, NOTICE_EVERY = 2.0, 10.0
"""Seconds of compiling after which a line on standard error says so, and says so again."""

announces = True
"""Whether this process writes such lines; of several that work for another one, one does."""

_lock = threading.Lock()
_total, _running, _began = 0.0, 0, 0.0
_next, _kernels = NOTICE_AFTER, 0
_timer: threading.Timer | None = None


def seconds() -> float:
    """Seconds of wall-clock time in which this process has compiled so far. Threads that compile at once count once."""
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


def prepare() -> None:
    """Start the timing of what Numba compiles. Loads Numba.

    Raises:
        ParameterError: variables of the environment keep Numba from compiling.
    """
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        raise ParameterError("NUMBA_DISABLE_JIT is set, and pharos' kernels work compiled alone; unset it")
    try:
        from numba.core import event
    except (ValueError, RuntimeError) as error:
        raise ParameterError(f"Numba cannot be loaded: {error}; look at its variables, NUMBA_...") from error

    class Compiling(event.Listener):
        """Adds up the seconds of compiling. Kernels that others call are compiled within them.

        Meanwhile no garbage is sought, which was a tenth of compiling: it makes many objects, and all live until its
        end.
        """

        _collects = False

        def on_start(self, event: event.Event) -> None:
            global _running, _began
            with _lock:
                if not _running:
                    self._collects = gc.isenabled()
                    gc.disable()
                    _began = time.perf_counter()
                    _announce_later(event.data["dispatcher"].py_func)
                _running += 1

        def on_end(self, event: object) -> None:
            global _running, _total
            with _lock:
                _running -= 1
                if not _running:
                    _total += time.perf_counter() - _began
                    if self._collects:
                        gc.enable()
                    if _timer is not None:
                        _timer.cancel()

    event.register("numba:compile", Compiling())


def _announce_later(function: Callable) -> None:
    """Say on standard error that a function is being compiled, if that is not done when the time for a line comes."""
    global _kernels
    if function.__module__.startswith("pharos."):
        _kernels += 1
        if announces:
            _start_timer(max(0.0, _next - _total), _name_of(function))


def _start_timer(wait: float, name: str) -> None:
    global _timer
    _timer = threading.Timer(wait, _announce, [name])
    _timer.daemon = True
    _timer.start()


def _announce(name: str) -> None:
    global _next
    with _lock:
        if not _running:
            return
        now = _total + time.perf_counter() - _began
        _next = now + NOTICE_EVERY
        _start_timer(NOTICE_EVERY, name)
    outcome = "" if storage.is_cache_temporary() else "; kept for the next time"
    with contextlib.suppress(OSError, ValueError, AttributeError):  # of a stream that is closed, or None
        sys.stderr.write(f"pharos: compiling {name}, kernel {_kernels}, {now:.0f} s so far{outcome}\n")
        sys.stderr.flush()


def _name_of(function: Callable) -> str:
    """A kernel's name, and the name of the class of environments for whose rules it is made."""
    owner = re.fullmatch(r"(\w+)_[0-9a-f]{20}\.\w+", function.__qualname__)
    return f"{function.__name__} for {owner[1]}" if owner else function.__name__


@cache
def private_folder(cache_directory: Path) -> Path | None:
    """The folder of compiled code, which is this user's and which nobody else can write to. None if there is none.

    It is `compiled`, or, if several users share the cache, `compiled-` and the user's number. A warning says what is
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
    """Make the folder if it is missing. Returns the reason against its use, "" if there is none."""
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
