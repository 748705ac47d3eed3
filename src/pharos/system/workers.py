"""Processes that work for this one: how many there may be, and what they import."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

from pharos.errors import ParameterError

PARENT_GONE = 76  # the exit status of a worker that nobody waits for
CLEAN_SECONDS = 2.0  # until it ends at once


def usable_workers(workers: int | None) -> int:
    """`workers`, or the number of processors that this process may use."""
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if workers < 1:
        raise ParameterError(f"workers is {workers}; expected at least 1")
    return int(workers)


NO_GUARD = 78
"""Exit code of a process that imports a script which starts processes, without a guard."""


@contextlib.contextmanager
def without_main(*definitions: object) -> Iterator[None]:
    """Processes that are started within do not import the user's script, which therefore needs no guard.

    multiprocessing lets each new process import the `__main__` of the first one, under another name. Code of the user's
    own travels by its file (`sources`), so nothing is missing; but where one of the `definitions` (classes, functions)
    that the processes need stands in the script, they import it, and it needs the guard (`check_guard`).
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(NO_GUARD)
    if any(getattr(getattr(each, "func", each), "__module__", None) == "__main__" for each in definitions):
        yield
        return
    main = vars(sys.modules["__main__"])
    hidden: dict[str, Any] = {name: main[name] for name in ("__spec__", "__file__") if name in main}
    main["__spec__"] = None
    main.pop("__file__", None)
    try:
        yield
    finally:
        main.update(hidden)


def check_guard(exit_code: int | None) -> None:
    """ParameterError where a process has ended since the script that it imported starts processes."""
    if exit_code == NO_GUARD:
        raise ParameterError(
            "workers import this script, since it defines an environment, observation or function of the runs, and "
            'it starts them again: put what starts runs below `if __name__ == "__main__":`, or move the definitions '
            "into a file of their own"
        )


@contextlib.contextmanager
def without_interrupts() -> Iterator[None]:
    """Programs that are started within leave interrupts to this one, from their first line on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # which new programs inherit
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler if before is None else before)


def end_with_parent() -> None:
    """End this process when the one that started it is gone, however it went: cleanly, and if that takes long, at
    once."""
    from multiprocessing import connection, parent_process

    parent = parent_process()
    if parent is None:
        return

    def watch() -> None:
        connection.wait([parent.sentinel])
        if signal.getsignal(signal.SIGTERM) not in (signal.SIG_DFL, signal.SIG_IGN):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(CLEAN_SECONDS)
        os._exit(PARENT_GONE)

    threading.Thread(target=watch, daemon=True, name="watch").start()
