"""Ctrl-C in a command: one line and exit code 130, whenever it comes.

Python raises KeyboardInterrupt between any two instructions of the main thread. Some of them are callbacks (of a weak
reference, such as locks of imports have, `__del__`, or one that C calls), in which it is printed and lost, and the
command would go on to exit code 0. So:

- While the command loads, the process ends at once (`pharos/__init__.py`): nothing has begun.
- While it works, KeyboardInterrupt is raised, so that locks and processes end in order. Not within an import, whose end
  is awaited, and once more if it was lost.
- When it has ended, the line is printed, what `atexit` has to clean up is cleaned up, and the exit code becomes 130.
"""

import _thread
import atexit
import contextlib
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType

EXIT_INTERRUPTED = 130
INTERRUPTED = "interrupted; finished work is kept, and the same command goes on from there"
IMPORT_SECONDS = 5.0  # an import that takes longer is interrupted
_AGAIN_SECONDS = 0.01


class CommandInterrupts:
    """Interrupts of the one command that this process runs. Signals of other programs are left alone.

    Attributes:
        is_active: whether `begin` was called, and interrupts are not ignored.
        is_pending: whether an interrupt came that was not raised so far.
        is_over: whether the command has ended.
        is_reported: whether the line was printed, or is about to be.
    """

    def __init__(self) -> None:
        self.is_active = self.is_pending = self.is_over = self.is_reported = False
        self._since = 0.0
        self._is_to_end = False
        atexit.register(self._end)  # the first to be registered is the last to run

    def begin(self) -> None:
        """Raise interrupts as KeyboardInterrupt from now on."""
        handler = signal.getsignal(signal.SIGINT)
        if handler in (signal.SIG_IGN, None) or threading.current_thread() is not threading.main_thread():
            return
        self.is_active = True
        self._hook = sys.unraisablehook
        sys.unraisablehook = self._on_unraisable
        signal.signal(signal.SIGINT, self._on_interrupt)

    def finish(self) -> bool:
        """Raise none any more, as the command has ended. Return whether there is one that was not raised."""
        self.is_over = self.is_active
        return self.is_pending

    def report(self) -> bool:
        """Whether the line is to be printed, which the caller does."""
        is_new = not (self.is_active and self.is_reported)
        self.is_reported = True
        return is_new

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.is_over:
            if self._is_to_end:  # once more
                os._exit(EXIT_INTERRUPTED)
            self._is_to_end = True
            if self.report():
                with contextlib.suppress(OSError):  # nobody listens
                    os.write(2, f"pharos: {INTERRUPTED}\n".encode())
            return
        if not self.is_pending:
            self.is_pending, self._since = True, time.monotonic()
        if is_importing(frame) and time.monotonic() - self._since < IMPORT_SECONDS:
            send_again(signal.SIGINT)
            return
        self.is_pending = False
        raise KeyboardInterrupt

    def _on_unraisable(self, unraisable: "sys.UnraisableHookArgs") -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._hook(unraisable)
        elif not self.is_over:
            self.is_pending, self._since = True, time.monotonic()
            send_again(signal.SIGINT)

    def _end(self) -> None:
        if self.is_active:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # what is left is the interpreter's
        if self._is_to_end:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(Exception):
                    stream.flush()
            os._exit(EXIT_INTERRUPTED)


def send_again(number: int) -> None:
    """Let the main thread get a signal once more, a little later."""
    with contextlib.suppress(RuntimeError):  # no thread can be started any more
        _thread.start_new_thread(_send, (number,))


def _send(number: int) -> None:
    time.sleep(_AGAIN_SECONDS)
    signal.pthread_kill(threading.main_thread().ident or 0, number)


def is_importing(frame: FrameType | None) -> bool:
    """Whether a frame, or one that it was called from, is part of an import."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


interrupts = CommandInterrupts()


@contextlib.contextmanager
def time_limit(seconds: float | None, error: type[BaseException]) -> Iterator[None]:
    """Raise an error in the block after that many seconds of wall-clock time, and every second until the block ends.

    A compiled kernel is not interrupted. It raises when it returns. Only the main thread can be stopped, by SIGALRM:
    elsewhere, and on Windows, there is no limit.

    Args:
        seconds: None, or infinity: no limit. error: called with a text.
    """
    able = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if not able or seconds is None or not seconds < math.inf:
        yield
        return

    def stop(*_: object) -> None:
        raise error(f"takes more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    try:
        signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-6), 1.0)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    finally:  # once more: the alarm may have come before the block began, or while it was turned off
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
