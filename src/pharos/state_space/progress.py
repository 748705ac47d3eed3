"""Progress of a build: the record that a callback receives, and the bar on a terminal."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from pharos.environments import Environment


@dataclass(frozen=True)
class BuildProgress:
    """Progress of a build, as a callback receives it.

    Attributes:
        num_states, num_expanded: states numbered, and how many of them are expanded.
        depth: levels finished.
        seconds: since the build began.
        finished: whether this is the last report.
        on_disk: whether the table of states is on disk.
    """

    num_states: int
    num_expanded: int
    depth: int
    seconds: float
    finished: bool = False
    on_disk: bool = False


BuildCallback = Callable[[BuildProgress], None]


@contextlib.contextmanager
def reporter(progress: BuildCallback | bool | None, env: Environment) -> Iterator[BuildCallback]:
    """The function that gets each BuildProgress: the caller's, a bar on a terminal, or nothing."""
    if callable(progress):
        yield progress
    elif progress is False or not sys.stderr.isatty():
        yield lambda _: None
    else:
        with _bar(env) as show:
            yield show


@contextlib.contextmanager
def _bar(env: Environment) -> Iterator[BuildCallback]:
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    texts = (TextColumn("{task.description}"), TextColumn("{task.fields[text]}"))
    with Bar(SpinnerColumn(), *texts, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"building {env.name}", text="", total=None)

        def show(done: BuildProgress) -> None:
            left = done.num_states - done.num_expanded
            rate = done.num_states / max(done.seconds, 1e-9)
            bar.update(
                task,
                text=f"{done.num_states:,} states, {left:,} to expand, level {done.depth}, {rate:,.0f} states/s"
                f"{', table on disk' if done.on_disk else ''}",
            )

        yield show
