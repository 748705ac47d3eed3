"""The processes of workers: how they are made, and how they end."""

import contextlib
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from typing import Any

from pharos.study import worker as _worker
from pharos.system.workers import without_interrupts

TERMINATION_SECONDS = 5.0


def processors() -> int:
    """The processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """What starts here, and whatever it forks, uses one thread, unless the user's variables say otherwise.

    Numba reads its variable when it is loaded, which is before any line of the new process.
    """
    added = [name for name in _worker.THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def end_processes(processes: Sequence[Any]) -> None:
    """End processes cleanly; at once those that take too long."""
    for process in processes:
        process.terminate()
    latest = time.monotonic() + TERMINATION_SECONDS
    for process in processes:
        process.join(max(0.0, latest - time.monotonic()))
        if process.is_alive():
            process.kill()
            process.join()


def worker_context(warm: bool) -> Any:
    """Processes are forked from one that has loaded everything; where the system cannot do that, started anew."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pharos.study.warm" if warm else "pharos.study.worker"])
    return context


def ready(context: Any) -> None:
    """See to it that the process which forks workers is there; it loads much, and leaves interrupts to this one."""
    if context.get_start_method() == "forkserver":
        from multiprocessing import forkserver

        with without_interrupts():
            forkserver.ensure_running()
