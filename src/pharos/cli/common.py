"""What the verbs share: parameters, TARGET, sizes, and the two ways of answering, JSON and tables."""

import ast
import contextlib
import dataclasses
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos import compiling
from pharos.environments import as_tuples
from pharos.errors import ParameterError

if TYPE_CHECKING:
    from rich.console import Console

    from pharos.environments import Environment
    from pharos.mdp import TabularMDP
    from pharos.state_space import StateSpace


def complete_target(incomplete: str) -> list[str]:
    """What a shell proposes for TARGET: classes, and once there is a slash or one class is left, named instances."""
    from pharos.environments import BUILT_IN

    names = [entry.name for entry in BUILT_IN if entry.name.startswith(incomplete)]
    if "/" in incomplete or len(names) == 1:
        names += [f"{entry.name}/{instance}" for entry in BUILT_IN for instance in entry.instance_names]
    return [name for name in names if name.startswith(incomplete)]


def complete_parameter(context: typer.Context, incomplete: str) -> list[str]:
    """What a shell proposes after TARGET: its parameters."""
    from pharos.environments import class_called

    target = context.params.get("target") or context.params.get("environment") or ""
    cls = class_called(str(target).partition("/")[0])
    names = [field.name for field in dataclasses.fields(cls)] if cls is not None else []  # type: ignore[arg-type]
    return [f"{name}=" for name in names if name.startswith(incomplete)]


Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output, nothing else.")]
TargetArgument = Annotated[
    str,
    typer.Argument(
        metavar="TARGET",
        help="Environment, module:Class, built folder or imported file.",
        autocompletion=complete_target,
    ),
]
Parameters = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[NAME=VALUE]...",
        help="Parameters of the environment.",
        show_default=False,
        autocompletion=complete_parameter,
    ),
]
Tolerance = Annotated[float, typer.Option("--tolerance", help="Largest error of a value, in units of return.")]
Memory = Annotated[
    str | None, typer.Option("--memory", metavar="SIZE", help="Memory to use at most, such as 2GiB or 500MB.")
]
Workers = Annotated[int | None, typer.Option("--workers", min=1, help="Threads; all processors when not given.")]
Gamma = Annotated[
    float | None,
    typer.Option(
        "--gamma", min=0, max=1, help="Discount; 0.99 when not given, or 1 with a horizon.", show_default=False
    ),
]
Horizon = Annotated[
    int | None, typer.Option("--horizon", min=1, help="Steps after which an episode ends; without end when not given.")
]
Sticky = Annotated[
    float, typer.Option("--sticky", min=0, max=1, help="Probability that the previous action is executed again.")
]
Random = Annotated[
    float, typer.Option("--random", min=0, max=1, help="Probability that a uniformly random action is executed.")
]
Lazy = Annotated[float, typer.Option("--lazy", min=0, max=1, help="Probability that the action has no effect.")]
Trust = Annotated[
    bool, typer.Option("--trust", help="Execute code that received files name: classes, observations and agents.")
]
MaxStates = Annotated[
    int | None, typer.Option("--max-states", min=1, help="Stop with an error beyond this many states.")
]

NOTABLE_SECONDS = 0.2  # of compiling, beside those of work

# Parameters -----------------------------------------------------------------------------------------------------------


def parse_parameters(words: Iterable[str] | None) -> dict[str, Any]:
    """`["height=12", "speeds=1,2"]` -> `{"height": 12, "speeds": (1, 2)}`; ParameterError: not name=value."""
    parameters: dict[str, Any] = {}
    for word in words or ():
        name, sign, text = word.partition("=")
        if not sign or not name.isidentifier():
            raise ParameterError(f"found {word!r}; expected a parameter name=value, such as height=12")
        if name in parameters:
            raise ParameterError(f"parameter {name!r} is given twice; give it once")
        parameters[name] = parse_value(text)
    return parameters


def parse_value(text: str) -> Any:
    """A value as Python or JSON writes it: 1, true, null, [[1,1],-1], (1,2), 1,2,3; lists become tuples; else text."""
    words = {"true": True, "false": False, "null": None, "none": None}
    if text.lower() in words:
        return words[text.lower()]
    for read in (json.loads, ast.literal_eval):
        try:
            return as_tuples(read(text))
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            continue
    return text


_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}


def parse_size(text: str | None, option: str = "--memory") -> int | None:
    """`2GiB` -> 2147483648, `500MB` -> 500000000, `4096` -> 4096; ParameterError where it is no size."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([KMGT]I?)?B?\s*", text.upper())
    if match is None:
        raise ParameterError(f"{option} {text!r}; expected a size such as 2GiB, 500MB or 4096 (bytes)")
    return int(float(match[1]) * _UNITS[match[2] or ""])


# TARGET ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    """What a command works on: an environment, or a folder or file that holds something already made.

    Attributes:
        text: as it was typed.
        environment: for a name or module:Class.
        path: for a folder or file.
    """

    text: str
    environment: "Environment | None" = None
    path: Path | None = None

    def space(
        self,
        *,
        memory: int | None = None,
        workers: int | None = None,
        max_states: int | None = None,
        out: Path | None = None,
    ) -> "StateSpace":
        """The state space: built (or taken from the cache) for an environment, loaded from a folder."""
        from pharos.state_space import build, load

        if self.environment is not None or self.is_imported:
            return build(self.found_environment(), out, memory=memory, workers=workers, max_states=max_states)
        assert self.path is not None
        space = load(self.path)
        if max_states is not None and space.num_states > max_states:
            raise ParameterError(f"{self.path}: has {space.num_states} states; expected at most {max_states}")
        return space

    def mdp(
        self,
        *,
        gamma: float | None = None,
        horizon: int | None = None,
        sticky: float = 0.0,
        random: float = 0.0,
        lazy: float = 0.0,
        **building: Any,
    ) -> "TabularMDP":
        """The tabular MDP, with chance; `gamma` None is 0.99, or 1 with a horizon. `building` as for `space`."""
        from pharos.experiments import ChanceSetting

        chance = ChanceSetting(sticky, random, lazy)
        if self.is_imported:
            mdp = self._imported(horizon)
            return chance.of(mdp if gamma is None else mdp.with_gamma(gamma))
        space = self.space(**building)
        if space.environment is None:
            raise ParameterError(
                f"{self.text}: pharos does not know the class {space.manifest['class']} of this environment, "
                f"so not its rewards; name it as module:Class instead of its folder"
            )
        return chance.of(space.mdp(gamma=discount(gamma, horizon)).with_horizon(horizon))

    def found_environment(self) -> "Environment":
        """The environment, also of a folder: the one it was built from, or that of the imported MDP.

        Raises:
            ParameterError: a file, or the folder of a class that pharos does not know.
        """
        if self.environment is not None:
            return self.environment
        assert self.path is not None
        if self.path.is_file():
            raise ParameterError(
                f"{self.path}: a file is no environment; bring it into a folder: "
                f"pharos import bridge {self.path} --out FOLDER"
            )
        if self.is_imported:
            from pharos.environments import make

            return make("imported", folder=str(self.path))
        space = self.space()
        if space.environment is None:
            raise ParameterError(
                f"{self.text}: pharos does not know the class {space.manifest['class']} of this environment; "
                f"name it as module:Class instead of its folder"
            )
        return space.environment

    @property
    def is_imported(self) -> bool:
        """Whether it is an imported MDP, a file or a folder, which has a gamma and a horizon of its own."""
        from pharos.importers import is_folder

        return self.path is not None and (self.path.is_file() or is_folder(self.path))

    def _imported(self, horizon: int | None) -> "TabularMDP":
        from pharos import importers

        assert self.path is not None
        if self.path.is_dir():
            mdp = importers.load(self.path)
            return mdp if horizon is None else mdp.with_horizon(horizon)
        return importers.bridge(self.path, horizon)


def discount(gamma: float | None, horizon: int | None) -> float:
    """The discount that `--gamma` names: when not given 0.99, or 1 with a horizon."""
    if gamma is not None:
        return gamma
    return 0.99 if horizon is None else 1.0


def build_options(memory: str | None, workers: int | None, max_states: int | None) -> dict[str, Any]:
    """What `build` takes, of --memory, --workers and --max-states."""
    return {"memory": parse_size(memory), "workers": workers, "max_states": max_states}


def parse_target(text: str, words: Iterable[str] | None = None) -> Target:
    """The target that a command names.

    Raises:
        UnknownName: no such environment, class or parameter. ParameterError: no such folder or file, a parameter is
            wrong.
    """
    parameters = parse_parameters(words)
    from pharos.environments import list_environments, make

    if text in list_environments():
        if Path(text).is_dir():
            complain(f"{text}: is taken as the environment of this name; write ./{text} for the folder")
        return Target(text, environment=make(text, **parameters))
    path = Path(text).expanduser()
    if path.exists():
        if parameters:
            raise ParameterError(
                f"{text}: is a {'folder' if path.is_dir() else 'file'}, which has its parameters already; "
                f"leave out {', '.join(f'{name}=...' for name in parameters)}"
            )
        return Target(text, path=path)
    if ":" not in text and (path.suffix or text.startswith((".", "~", os.sep)) or text.endswith(os.sep)):
        raise ParameterError(f"{text}: no such folder or file")
    return Target(text, environment=make(text, **parameters))


def parse_environment(text: str, words: Iterable[str] | None = None) -> "Environment":
    """Like `parse_target`, where an environment is needed: a folder stands for the one that it was built from."""
    return parse_target(text, words).found_environment()


def parse_seeds(text: str) -> list[int]:
    """`0:64`, `0,1,5` or both, as a list; the end of a range does not belong to it.

    Raises:
        ParameterError: it is none of these, or has a seed twice.
    """
    seeds: list[int] = []
    for word in text.split(","):
        first, colon, last = word.partition(":")
        try:
            seeds += range(int(first), int(last)) if colon else [int(first)]
        except ValueError:
            seeds = []
            break
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ParameterError(f"--seeds {text!r}; expected whole numbers, each once, such as 0:64 or 0,1,5")
    return seeds


# Answers --------------------------------------------------------------------------------------------------------------


def print_json(answer: Mapping[str, Any]) -> None:
    """One JSON object on standard output; what JSON cannot say (infinity, not a number) is null."""
    print(json.dumps(_plain(answer), allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numbers and arrays of NumPy
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if hasattr(value, "to_dict"):
        return _plain(value.to_dict())
    return str(value)


def console(*, stderr: bool = False) -> "Console":
    """A Rich console; wide where nobody looks, so that a pipe gets whole lines."""
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() or "COLUMNS" in os.environ else 160
    return Console(stderr=stderr, width=width, highlight=False)


@contextlib.contextmanager
def progress_line(what: str) -> Iterator[Callable[[str], None]]:
    """Report progress in a line on standard error, on a terminal; removed at the end."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn(what), TextColumn("{task.fields[text]}"), TimeElapsedColumn())
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None, text="")
        yield lambda text: bar.update(task, text=text)


@contextlib.contextmanager
def progress_bar(what: str, total: int, before: str = "") -> Iterator[Callable[[int, str], None] | None]:
    """A bar on standard error, on a terminal: call it with how much is done and a text. None elsewhere.

    Args:
        before: what happens until the first call.
    """
    screen = console(stderr=True)
    if not screen.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[text]}"), TimeRemainingColumn())
    with Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task(what, total=total, text=before)
        yield lambda done, text: bar.update(task, completed=done, text=text)


def print_facts(title: str, facts: Sequence[tuple[str, object]]) -> None:
    """A table of two columns: what, and how much."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts:
        table.add_row(name, escape(str(value)))
    to = console()
    to.print(f"[bold]{escape(title)}[/bold]", soft_wrap=True)
    to.print(table)


def describe_chance(
    sticky: float, random: float, of_the_world: bool = False, lazy: float = 0.0, noise: float = 0.0, delay: int = 0
) -> str:
    """Chance in words.

    Args:
        of_the_world: whether executing an action may have several outcomes itself.
        noise, delay: of the rewards that are paid.
    """
    parts = ["of the world"] * of_the_world
    parts += [f"sticky actions {sticky:g}"] * bool(sticky) + [f"random actions {random:g}"] * bool(random)
    parts += [f"lazy actions {lazy:g}"] * bool(lazy) + [f"reward noise {noise:g}"] * bool(noise)
    parts += [f"rewards {delay} steps late"] * bool(delay)
    return ", ".join(parts) or "none"


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
    """An environment in one line: `breakout height=12 columns=8`, as the command line writes it."""
    words = (f"{name}={_written(value)}" for name, value in environment.parameters.items())
    return " ".join((environment.name, *words))


def _written(value: Any) -> str:
    return json.dumps(value, separators=(",", ":")) if isinstance(value, tuple | list) else str(value)


def compiling_fact() -> list[tuple[str, str]]:
    """What this command has spent on compiling, a fact or none: where little was compiled there is nothing to tell."""
    seconds = compiling.seconds()
    return [("compiling", f"{seconds:.1f} s, kept for the next time")] if seconds >= NOTABLE_SECONDS else []


def peak_memory_bytes() -> int:
    """The most memory that this process has held so far."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def bytes_of(folder: Path) -> int:
    """Bytes of the files in a folder and below."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def complain(message: object) -> None:
    """One line on standard error."""
    print(f"pharos: {' '.join(str(message).split())}", file=sys.stderr)


def check_format(path: Path, suffixes: Sequence[str], option: str = "--out") -> str:
    """The suffix of `path`, lower case; ParameterError unless it is among `suffixes` and the folder above exists."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise ParameterError(f"{option} {path}; expected a file name that ends in {' or '.join(suffixes)}")
    if not path.absolute().parent.is_dir():
        raise ParameterError(f"{option} {path}: there is no folder {path.absolute().parent}; make it first")
    return suffix
