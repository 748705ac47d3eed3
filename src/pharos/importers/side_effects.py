"""Effects of an environment's code on the process: what it prints and warns of, windows, and global generators.

What it prints is caught, and told in one line. Draws from the global generators of NumPy and Python are found by
comparing their states, and the line of code that drew is found by running the step again under a trace.
"""

import contextlib
import os
import random as python_random
import re
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, TextIO

import numpy as np

from pharos.importers.chance import line_of_code
from pharos.system.wording import capped

CLOCKS = frozenset(
    [
        *("time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "process_time"),
        *("now", "today", "utcnow", "urandom", "open", "listdir", "scandir"),
        *("start_new_thread", "start_joinable_thread"),
    ]
)
"""Names of functions in C whose answers change from call to call."""
HEADLESS = {"SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy", "PYGAME_HIDE_SUPPORT_PROMPT": "1"}
LONGEST_LINE = 120
COLOR_CODES = re.compile("\x1b\\[[0-9;]*m")


class _Printed:
    """Text that was printed: its first line, and how many there were."""

    def __init__(self) -> None:
        self.first, self.count = "", 0

    def add(self, text: str) -> None:
        self.count += text.count("\n")
        if not self.first:
            self.first = capped(" ".join(COLOR_CODES.sub("", text).split()), LONGEST_LINE)


class _Sink:
    """A stream that catches what this thread writes; other threads, which may draw a bar, write as before."""

    def __init__(self, stream: TextIO, printed: _Printed):
        self._stream, self._printed, self._thread = stream, printed, threading.get_ident()

    def write(self, text: str) -> int:
        if threading.get_ident() != self._thread:
            return self._stream.write(text)
        self._printed.add(text)
        return len(text)

    def isatty(self) -> bool:
        return threading.get_ident() != self._thread and self._stream.isatty()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class SideEffects:
    """Effects of an environment on the process, while it was watched.

    Attributes:
        lines: one for each kind of effect, for people.
    """

    def __init__(self) -> None:
        self._printed = _Printed()
        self._warnings: dict[str, int] = {}
        self._reseeded = self._has_window = False
        self._threads = threading.active_count()

    @property
    def lines(self) -> list[str]:
        """A line for each kind of effect."""
        lines = []
        if self._printed.first:
            count = max(self._printed.count, 1)
            lines.append(f"it printed {count:,} line{'s' * (count > 1)}, the first: {self._printed.first}")
        if self._warnings:
            (first, count), others = next(iter(self._warnings.items())), len(self._warnings) - 1
            lines.append(f"it warned: {first}" + (f" (and {others} other warnings)" if others else ""))
        if self._reseeded:
            lines.append("it seeds the global generators of NumPy or Python, which were put back")
        if self._has_window or _has_window():
            lines.append("it shows itself in a window, without which it was stepped")
        return lines

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Catch what is printed, and warnings."""
        with (
            contextlib.redirect_stdout(_Sink(sys.stdout, self._printed)),  # type: ignore[type-var]
            contextlib.redirect_stderr(_Sink(sys.stderr, self._printed)),  # type: ignore[type-var]
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("always")
            warnings.showwarning = self._on_warning
            yield

    def _on_warning(self, message: Warning | str, *_: object, **__: object) -> None:
        text = capped(COLOR_CODES.sub("", str(message)), LONGEST_LINE)
        if text in self._warnings or len(self._warnings) < 100:
            self._warnings[text] = self._warnings.get(text, 0) + 1

    def note_seeding(self) -> None:
        """Remember that the code seeds global generators."""
        self._reseeded = True

    def note_window(self) -> None:
        """Remember that it has a window for people."""
        self._has_window = True

    def has_new_threads(self) -> bool:
        """Whether there are more threads than before."""
        return threading.active_count() > self._threads


@contextlib.contextmanager
def undone() -> Iterator[None]:
    """Put the global generators, the working directory and variables of windows back when the block ends."""
    python, numpy, folder = python_random.getstate(), np.random.get_state(), os.getcwd()
    variables = {name: os.environ.get(name) for name in HEADLESS}
    for name, value in HEADLESS.items():
        os.environ.setdefault(name, value)
    try:
        yield
    finally:
        python_random.setstate(python)
        np.random.set_state(numpy)
        if os.getcwd() != folder:
            os.chdir(folder)
        for name, before in variables.items():
            if before is None:
                os.environ.pop(name, None)


def global_generators() -> tuple[tuple, tuple]:
    """States of the global generators of Python and NumPy, to be compared."""
    state: Any = np.random.get_state(legacy=False)
    parts = state["state"]
    return python_random.getstate(), (parts["key"].tobytes(), parts["pos"], state["has_gauss"])


def move_global_generators() -> None:
    """Bring the global generators into another state."""
    python_random.seed(python_random.random())
    np.random.set_state(np.random.RandomState(python_random.randrange(1 << 30)).get_state())


def line_that_changes(run: Callable[[], object], state: Callable[[], object]) -> str:
    """The line of the environment's code that changes a state while it runs, file and number; else ""."""
    before, line, last = state(), "", ""

    def trace(frame: FrameType, *_: object) -> object:
        nonlocal line, last
        if not line and state() != before:
            line = last
        last = (line_of_code(frame) or last) if not line else last
        return None if line else trace

    _under(sys.settrace, sys.gettrace(), trace, run)
    return line or last


def line_that_asks(run: Callable[[], object]) -> str:
    """The first line of the environment's code that asks for the time, a file or the system's randomness; else ""."""
    line = ""

    def profile(frame: FrameType, event: str, argument: object) -> None:
        nonlocal line
        if not line and event == "c_call" and getattr(argument, "__name__", "") in CLOCKS:
            line = line_of_code(frame)

    _under(sys.setprofile, sys.getprofile(), profile, run)
    return line


def _under(install: Callable[[Any], object], before: object, function: object, run: Callable[[], object]) -> None:
    install(function)
    try:
        with contextlib.suppress(Exception):
            run()
    finally:
        install(before)


def _has_window() -> bool:
    pygame = sys.modules.get("pygame")
    try:
        return bool(pygame and pygame.display.get_init() and pygame.display.get_surface())
    except Exception:  # of a pygame without windows
        return False
