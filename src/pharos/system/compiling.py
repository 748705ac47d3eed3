"""Seconds that compiling takes, told apart from seconds of work: compiled code is kept, so that it comes once.

`pharos.kernels` listens as it is loaded; before that nothing can have been compiled.
"""

import threading
import time
from typing import Any

_lock = threading.Lock()
_total, _running, _began = 0.0, 0, 0.0


def seconds() -> float:
    """Seconds of wall-clock time in which this process has compiled so far; threads that compile at once count once."""
    with _lock:
        return _total + (time.perf_counter() - _began if _running else 0.0)


class Stopwatch:
    """Seconds since it was made, of work and of compiling."""

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


def listen() -> None:
    """Begin to measure; loads Numba."""
    from numba.core import event

    class Compiling(event.Listener):
        def on_start(self, event: Any) -> None:
            global _running, _began
            with _lock:
                if not _running:
                    _began = time.perf_counter()
                _running += 1

        def on_end(self, event: Any) -> None:
            global _running, _total
            with _lock:
                _running -= 1
                if not _running:
                    _total += time.perf_counter() - _began

    event.register("numba:compile", Compiling())
