"""The two ways of answering, JSON and tables, with progress and complaints on standard error, and facts in words."""

import contextlib
import dataclasses
import json
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

import typer

from pharos.system import compiling, storage
from pharos.system.interrupts import INTERRUPTED, is_importing, send_again

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from pharos.environments import Environment

NOTABLE_SECONDS = 0.2  # of compiling, beside those of work
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
        """Print it; typer.Exit where it says that something failed."""
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
    """Print one JSON object on standard output; infinity and NaN become null."""
    print(json.dumps(storage.plain(answer), default=_plain, allow_nan=False))


def _plain(value: object) -> object:
    """JSON form of a value that is neither a number nor text: sets, dataclasses; text of all else."""
    if isinstance(value, set | frozenset):
        return storage.plain(list(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return storage.plain(dataclasses.asdict(value))
    return storage.plain(value.to_dict()) if hasattr(value, "to_dict") else str(value)


def console(*, stderr: bool = False) -> "Console":
    """A Rich console; outside a terminal 160 columns wide, so that a pipe gets whole lines, without trailing blanks."""
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


@contextlib.contextmanager
def progress_line(what: str, *, logged: bool = False) -> Iterator[Callable[[str], None]]:
    """Report progress in a line on standard error, on a terminal; removed at the end.

    Args:
        logged: whether each text is a line of its own elsewhere, as in a log; else nothing is written there.
    """
    if not sys.stderr.isatty():
        yield lambda text: print(f"pharos: {text}", file=sys.stderr, flush=True) if logged else None
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn(what), TextColumn("{task.fields[text]}"), TimeElapsedColumn())
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None, text="")
        yield lambda text: bar.update(task, text=text)


@contextlib.contextmanager
def progress_bar(what: str, total: int, before: str = "") -> Iterator[Callable[..., None]]:
    """A bar on standard error, on a terminal: call it with how much is done, a text, and the total where that changes.

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
        columns: their names; `>name` has numbers, which end at one place.
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
    """Seconds of compiling in this command as a fact; none if they are few."""
    seconds = compiling.seconds()
    suffix = "" if storage.is_cache_temporary() else ", kept for the next time"
    return [("compiling", f"{seconds:.1f} s{suffix}")] if seconds >= NOTABLE_SECONDS else []


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
    """Turn SIGTERM into SystemExit in the block, so that running work ends first; prints that the command resumes."""

    def leave(number: int, frame: FrameType | None) -> None:
        if is_importing(frame):  # where SystemExit may be lost
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
