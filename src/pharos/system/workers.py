"""Processes that work for this one: how many there may be, how they begin and end, and what they import."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing import connection, resource_tracker
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import Any

from pharos.errors import ParameterError
from pharos.system import compiling

PARENT_GONE = 76  # the exit status of a worker that nobody waits for
CLEAN_SECONDS = 2.0  # until it ends at once
TERMINATION_SECONDS = 5.0
SERVER_LOST = 255  # the exit status of a worker when the process that it was forked from is gone
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def usable_workers(workers: int | None) -> int:
    """`workers`, or the number of processors that this process may use."""
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if workers < 1:
        raise ParameterError(f"workers is {workers}; expected at least 1")
    return int(workers)


def check_timeout(timeout: float | None) -> None:
    """ParameterError unless `timeout` is a number of seconds above 0, or None."""
    is_number = isinstance(timeout, int | float) and not isinstance(timeout, bool)
    if timeout is not None and not (is_number and timeout > 0):
        raise ParameterError(f"timeout is {timeout!r}; expected a number of seconds above 0")


def check_processes(processes: int | str) -> None:
    """Raise a ParameterError unless `processes` is 1 or "mpi"."""
    if processes != "mpi" and (processes != 1 or isinstance(processes, bool)):
        raise ParameterError(
            f"processes is {processes!r}; expected 1, or 'mpi' in a program that `mpiexec -n 8 python PROGRAM` starts; "
            "`pharos build` and `pharos solve` take --processes 8"
        )


class Terminated(SystemExit):
    """SIGTERM in a worker: its `finally` blocks run, and it ends."""


class _Begun:
    """Message of a worker that has imported what it needs and begins its work."""


class Workers:
    """Processes that work for this one, each under a key: what they send, and how they end.

    They leave interrupts to this one, and end with it, however it ends. Processes that still run at the end of the
    block are ended.

    Args:
        preload: modules that one process loads, from which the others are forked, if the system can do that. With none
            (or None) each begins anew.
        groups: whether processes that one of them starts, and leaves behind, are killed when it has ended.
    """

    def __init__(self, *preload: str | None, groups: bool = False):
        self.groups = groups
        self._context: ForkServerContext | SpawnContext = multiprocessing.get_context("spawn")
        modules = [each for each in preload if each is not None]
        if modules and "forkserver" in multiprocessing.get_all_start_methods():
            self._context = multiprocessing.get_context("forkserver")
            self._context.set_forkserver_preload(modules)
        self._running: dict[str, tuple[BaseProcess, connection.Connection]] = {}
        self._begun: set[str] = set()

    def __len__(self) -> int:
        return len(self._running)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        """Terminate the processes. Kill those that take too long."""
        processes = [process for process, _ in self._running.values()]
        self._running.clear()
        for process in processes:
            process.terminate()
        latest = time.monotonic() + TERMINATION_SECONDS
        for process in processes:
            process.join(max(0.0, latest - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
            self._end_group(process.pid)

    def start(
        self, key: str, function: Callable[..., None], arguments: Sequence[Any], definitions: Sequence[object] = ()
    ) -> None:
        """Start a process that calls function(*arguments, send), where `send(message)` makes an event here.

        Args:
            definitions: classes and functions that it needs, see `without_main`.
        Raises:
            EOFError, ConnectionError: the process from which it is to be forked is gone.
        """
        receiver, sender = self._context.Pipe(duplex=False)
        settings = dict(os.environ), not self._running, self.groups
        process = self._context.Process(target=_work, args=(function, arguments, sender, *settings), name=key)
        with without_main(*definitions):
            if isinstance(self._context, ForkServerContext):
                from multiprocessing import forkserver

                with without_interrupts():  # it loads much
                    forkserver.ensure_running()
                process.start()
            else:
                with without_interrupts():
                    process.start()
        sender.close()
        self._begun.discard(key)
        self._running[key] = process, receiver

    def events(self, seconds: float | None = None) -> Iterator[tuple[str, Any]]:
        """Yield the next events, within so many seconds: (key, a message), or (key, exit code) of a process that ended.

        Raises:
            ParameterError: a process has imported a script without a guard.
        """
        alive = {process.sentinel: key for key, (process, _) in self._running.items()}
        receivers = [receiver for _, receiver in self._running.values() if not receiver.closed]
        ready = connection.wait([*alive, *receivers], seconds)
        for sentinel, key in alive.items():
            process, receiver = self._running[key]
            try:
                while not receiver.closed and receiver.poll():
                    message = receiver.recv()
                    if isinstance(message, _Begun):
                        self._begun.add(key)
                    else:
                        yield key, message
            except EOFError:
                receiver.close()
            if sentinel in ready:
                del self._running[key]
                process.join()
                code = process.exitcode
                self._end_group(process.pid)
                process.close()
                if key not in self._begun:
                    check_guard(code)
                yield key, code

    def _end_group(self, leader: int | None) -> None:
        if self.groups and leader is not None and hasattr(os, "killpg") and leader != os.getpgrp():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(leader, signal.SIGKILL)

    def kill(self, key: str) -> None:
        """Kill a process. Its end is an event."""
        self._running[key][0].kill()


def _work(
    function: Callable[..., None],
    arguments: Sequence[Any],
    sender: connection.Connection,
    environment: Mapping[str, str],
    announces: bool,
    leads: bool,
) -> None:
    """The body of a process. `environment` are the variables of the one that started it, now.

    They may have changed since the process from which others are forked was started. Numba refuses that the number of
    threads changes.

    Args:
        announces: whether it says that it compiles: others compile the same.
        leads: whether it and the processes that it starts are a group of their own.
    """
    if leads:
        with contextlib.suppress(OSError, AttributeError):  # it leads one; Windows
            os.setsid()
    compiling.announces = compiling.announces and announces
    threads = {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ}
    os.environ.clear()
    os.environ.update({**environment, **threads})
    end_cleanly()
    end_with_parent()

    def send(message: object) -> None:
        try:
            sender.send(message)
        except OSError:  # nobody listens any more
            sys.exit(1)

    send(_Begun())  # from here on an exit code is about the work
    function(*arguments, send)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it ends by itself: an exception in what is given back is printed


def end_cleanly() -> None:
    """Leave interrupts to the process that started this one. On SIGTERM, raise Terminated, so that `finally` runs.

    A process that SIGTERM kills leaves its semaphores behind, of which Python then warns.
    """

    def leave(*_: object) -> None:
        raise Terminated(128 + signal.SIGTERM)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, leave)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Give one thread to each process that starts within, and to its forks, unless the user's variables say otherwise.

    Numba reads its variable when it is loaded, which is before any line of the new process.
    """
    added = [name for name in THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


NO_GUARD = 78
"""Exit code of a process that imports a script which starts processes, without a guard."""


@contextlib.contextmanager
def without_main(*definitions: object) -> Iterator[None]:
    """Keep processes that are started within from importing the user's script, which then needs no guard.

    multiprocessing lets each new process import the `__main__` of the first one, under another name. Code of the user's
    own travels by its file (`sources`), so nothing is missing. But if one of the `definitions` (classes, functions)
    that the processes need stands in the script, they import it, and it needs the guard (`check_guard`).
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(NO_GUARD)
    if is_in_main(*definitions):
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


def is_in_main(*definitions: object) -> bool:
    """Whether one of the classes and functions stands in the user's script."""
    return any(getattr(getattr(each, "func", each), "__module__", None) == "__main__" for each in definitions)


def check_guard(exit_code: int | None) -> None:
    """Raise ParameterError if a process has ended because the script that it imported starts processes."""
    if exit_code == NO_GUARD:
        raise ParameterError(
            "workers import this script, since it defines an environment, observation or function of the runs, and "
            'it starts them again: put what starts runs below `if __name__ == "__main__":`, or move the definitions '
            "into a file of their own"
        )


@contextlib.contextmanager
def without_interrupts(*, forks: bool = False) -> Iterator[None]:
    """Let processes that are started within leave interrupts to this one, from their first line on.

    This one is interrupted at the end of the block. To ignore interrupts would lose those that come meanwhile.

    Args:
        forks: whether the processes are forked from this one.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    if not forks:
        resource_tracker.ensure_running()  # which unblocks interrupts when it begins, and is needed by the others
    arrived: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: arrived.append(number))  # of another thread
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which new processes inherit
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, signal.default_int_handler if before is None else before)
        for number in arrived[:1]:
            signal.raise_signal(number)


def end_with_parent() -> None:
    """End this process when the one that started it is gone: by SIGTERM, and after CLEAN_SECONDS at once."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        connection.wait([parent.sentinel])
        if signal.getsignal(signal.SIGTERM) not in (signal.SIG_DFL, signal.SIG_IGN):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(CLEAN_SECONDS)
        os._exit(PARENT_GONE)

    threading.Thread(target=watch, daemon=True, name="watch").start()
