"""The two ways of answering, JSON and tables, with progress and complaints on standard error, and facts in words."""

import contextlib
import dataclasses
import json
import os
import re
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

import typer

from pharos.system import compiling, storage
from pharos.system.interrupts import INTERRUPTED, is_importing, send_again

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress
    from rich.text import Text

    from pharos.environments import Environment

NOTABLE_SECONDS = 0.2  # of compiling, beside lines on work
SPECIAL = re.compile(r"[^\w@%+=:,./\[\]-]")  # what a shell would read as more than a character of a word


class Answer(NamedTuple):
    """Answer of a command.

    Attributes:
        json: the object that `--json` prints.
        text: what people get instead: (title, facts), text or a path, or a function that prints.
        failed: whether the exit code is 1.
    """

    json: Mapping[str, Any]
    text: object
    failed: bool = False

    def say(self, json: bool) -> None:
        """Print it. typer.Exit if it says that something failed."""
        if json:
            print_json(self.json)
        elif isinstance(self.text, tuple):
            print_facts(*self.text)
        elif callable(self.text):
            self.text()
        else:
            print(self.text)
        if self.failed:
            raise typer.Exit(1)


def print_json(answer: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output. Infinity and NaN become null."""
    print(json.dumps(storage.plain(answer), default=_plain, allow_nan=False))


def _plain(value: object) -> object:
    """JSON form of a value that is neither a number nor text: sets, dataclasses. Anything else becomes text."""
    if isinstance(value, set | frozenset):
        return storage.plain(list(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return storage.plain(dataclasses.asdict(value))
    return storage.plain(value.to_dict()) if hasattr(value, "to_dict") else str(value)


def console(*, stderr: bool = False) -> "Console":
    """A Rich console, outside a terminal 160 columns wide, so that a pipe gets whole lines, without trailing blanks."""
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    file = None if stream.isatty() else _Trimmed(stream)
    width = None if file is None or "COLUMNS" in os.environ else 160
    return Console(emoji=False, stderr=stderr, width=width, highlight=False, file=file)  # type: ignore[arg-type]


class _Trimmed:
    """A stream whose lines lose the blanks at their ends: Rich fills the cells of its tables."""

    def __init__(self, stream: TextIO):
        self.stream = stream

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        return self.stream.write(re.sub(r" +(?=\n)", "", text))


SLOW_AFTER, TOLD_AT_LEAST_EVERY = 10.0, 60.0  # seconds of work after which a line says what is going on, and again


class SlowWork:
    """Lines on standard error on work that takes long, if no terminal shows its progress.

    The first comes after `SLOW_AFTER` seconds, the next ones when it has taken twice as long, and every
    `TOLD_AT_LEAST_EVERY` seconds in the end.

    Attributes:
        text: how far the work is.
    """

    def __init__(self, what: str, clock: Callable[[], float] = time.monotonic):
        self.what, self.text = what, ""
        self._clock, self._began, self._due = clock, clock(), SLOW_AFTER

    def report_if_due(self) -> None:
        """Write a line if the time for one has come."""
        seconds = self._clock() - self._began
        if seconds >= self._due:
            self._due = seconds + min(seconds, TOLD_AT_LEAST_EVERY)
            complain(f"{self.what}{': ' * bool(self.text)}{self.text}, {seconds:.0f} s so far")

    @contextlib.contextmanager
    def watched(self) -> Iterator["SlowWork"]:
        """Look once a second, in a thread, whether a line is due."""
        is_done = threading.Event()

        def watch() -> None:
            while not is_done.wait(1.0):
                self.report_if_due()

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            is_done.set()
            thread.join()


@contextlib.contextmanager
def told_if_slow(what: str) -> Iterator[None]:
    """Say on standard error, if that is no terminal, that a block is slow. Its progress is otherwise for terminals
    only."""
    with contextlib.nullcontext() if sys.stderr.isatty() else SlowWork(what).watched():
        yield


class ProgressLine:
    """A line of progress: call it with a text."""

    def __init__(self, show: Callable[[str], None], bar: "Progress | None" = None):
        self._show, self._bar = show, bar

    def __call__(self, text: str) -> None:
        self._show(text)

    @contextlib.contextmanager
    def away(self) -> Iterator[None]:
        """Remove the line for the time of the block, which prints on the same terminal."""
        if self._bar is not None:
            self._bar.stop()
        yield
        if self._bar is not None:
            self._bar.start()


@contextlib.contextmanager
def progress_line(what: str, *, logged: bool = False) -> Iterator[ProgressLine]:
    """Report progress in a line on standard error: on a terminal always, and removed at the end, elsewhere if it is
    slow.

    Args:
        logged: whether each text is a separate line if there is no terminal, as in a log.
    """
    if not sys.stderr.isatty():
        with SlowWork(what).watched() as work:

            def report(text: str) -> None:
                work.text = text
                if logged:
                    print(f"pharos: {text}", file=sys.stderr, flush=True)

            yield ProgressLine(report)
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn(what), TextColumn("{task.fields[text]}"), TimeElapsedColumn())
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None, text="")
        yield ProgressLine(lambda text: bar.update(task, text=text), bar)


@contextlib.contextmanager
def progress_bar(what: str, total: int, before: str = "") -> Iterator[Callable[..., None]]:
    """A bar on standard error, on a terminal: call it with how much is done, a text, and the total if that changes.

    Nothing is shown elsewhere.

    Args:
        before: what happens until the first call.
    """
    screen = console(stderr=True)
    if not screen.is_terminal:
        yield lambda _done, _text, _total=None: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[text]}"), TimeRemainingColumn())
    with Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task(what, total=total, text=before)
        yield lambda done, text, total=None: bar.update(task, completed=done, text=text, total=total)


@contextlib.contextmanager
def counted_bar(what: str) -> Iterator[Callable[[int, int, str], None]]:
    """A bar that is called with how many of how many are done, and the name of the next one."""
    with progress_bar(what, 1) as show:
        yield lambda done, total, text: show(done, f"{done} of {total}: {text}", total)


def print_facts(title: str, facts: Sequence[tuple[str, object]]) -> None:
    """Print a table of two columns: name and value."""
    print_table(title, ("", ""), ((name, str(value)) for name, value in facts))


LONGEST_NAME = 30  # of a first column whose names stay in one line, whatever room that leaves for others


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Iterable["str | Text"]],
    *,
    before: Iterable[str] = (),
    notes: Iterable[str] = (),
) -> None:
    """Print a table below its title and the lines `before`, with notes below.

    Args:
        columns: their names. `>name` has numbers, which end at one place.
    """
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold", show_header=any(columns))
    lines = [tuple(row) for row in rows]
    longest = max((len(line[0]) for line in lines), default=0)
    first: dict[str, Any] = {"style": "cyan", "no_wrap": longest <= LONGEST_NAME}
    for number, name in enumerate(columns):
        how: dict[str, Any] = {"justify": "right"} if name.startswith(">") else {"overflow": "fold"}
        table.add_column(escape(name.removeprefix(">")), **how | ({} if number else first))
    for line in lines:
        table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in line))
    to = console()
    if title:
        to.print(escape(title), style="bold", soft_wrap=True)
    for text in before:
        to.print(escape(text), style="dim", soft_wrap=True)
    to.print(table)
    for text in notes:
        to.print(escape(text), style="dim", soft_wrap=True)


class GrowingTable:
    """A table whose rows are printed one by one. What is too long for its column goes on in the next line.

    Args:
        columns: name to width. `>name` has numbers, which end at one place. Width 0 means a share of what is left.
    """

    def __init__(self, columns: Mapping[str, int]):
        self._columns, self._to = columns, console()
        self._print(columns, style="bold")

    def add(self, row: Iterable["str | Text"]) -> None:
        """Print a row."""
        self._print(row)

    def _print(self, row: Iterable["str | Text"], style: str = "") -> None:
        from rich.markup import escape
        from rich.table import Table

        line = Table(box=None, pad_edge=False, show_header=False, expand=not all(self._columns.values()))
        for number, (name, width) in enumerate(self._columns.items()):
            how: dict[str, Any] = {"justify": "right"} if name.startswith(">") else {"overflow": "fold"}
            how |= {"width": width} if width else {"ratio": 1}
            line.add_column(style=style or ("" if number else "cyan"), no_wrap=not number, **how)
        line.add_row(*(escape(cell.removeprefix(">")) if isinstance(cell, str) else cell for cell in row))
        self._to.print(line)
        self._to.file.flush()


def describe_discount(gamma: float, horizon: int | None) -> str:
    """Discount and horizon in words."""
    return f"{gamma:g}, {'no horizon' if horizon is None else f'horizon {horizon}'}"


def size_text(count: float) -> str:
    """Bytes for people: 1.5 GiB."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} TiB"


def describe(environment: "Environment") -> str:
    """An environment in one line: `breakout height=12 columns=8`, as the command line reads it."""
    absent = {field.name for field in dataclasses.fields(environment) if field.default is None}  # type: ignore[arg-type]
    parameters = {
        name: value for name, value in environment.parameters.items() if value is not None or name not in absent
    }
    words = (f"{name}={written(value)}" for name, value in parameters.items())
    return " ".join((environment.name, *(shlex.quote(word) if SPECIAL.search(word) else word for word in words)))


def written(value: object) -> str:
    """A value as the command line reads it."""
    return str(value) if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def compiling_fact() -> list[tuple[str, str]]:
    """Seconds of compiling in this command as a fact, or none if they are few."""
    seconds = compiling.seconds()
    suffix = "" if storage.is_cache_temporary() else ", kept for the next time"
    return [("compiling", f"{seconds:.1f} s{suffix}")] if seconds >= NOTABLE_SECONDS else []


def note_facts(notes: Mapping[str, Mapping[str, str]]) -> list[tuple[str, str]]:
    """A fact for each kind of note, kind -> run -> sentence, with its first run and how many more have one."""
    firsts = [(*next(iter(runs.items())), len(runs) - 1) for runs in notes.values()]
    return [("note", f"{run}{f' and {more:,} more' * (more > 0)}: {text}") for run, text, more in firsts]


def peak_memory_bytes() -> int:
    """Peak memory of this process so far, in bytes."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def bytes_of(folder: Path) -> int:
    """Bytes of the files in a folder and below."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


@contextlib.contextmanager
def termination() -> Iterator[None]:
    """Turn SIGTERM into SystemExit in the block, so that running work ends first. Prints that the command resumes."""

    def leave(number: int, frame: FrameType | None) -> None:
        if is_importing(frame):  # if SystemExit may be lost
            send_again(number)
            return
        complain(INTERRUPTED)
        sys.exit(128 + signal.SIGTERM)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def complain(message: object) -> None:
    """Print one line on standard error, with nothing that a terminal would obey."""
    text = " ".join(str(message).split())
    shown = "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)
    print(f"pharos: {shown}", file=sys.stderr)
