"""The options that verbs share: their declarations, what a shell proposes for them, and how their texts are read."""

import ast
import dataclasses
import json
import os
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from pharos.environments import as_tuples
from pharos.errors import ParameterError


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
Processes = Annotated[
    str,
    typer.Option(
        "--processes",
        metavar="N|mpi",
        help="Processes that share the work and the memory, by MPI; under mpiexec: those that it has started.",
    ),
]
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

# Texts ----------------------------------------------------------------------------------------------------------------


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


_MOST_PROCESSES = 1024  # of a machine that anybody may mean
_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}


def parse_size(text: str | None, option: str = "--memory") -> int | None:
    """`2GiB` -> 2147483648, `500MB` -> 500000000, `4096` -> 4096; ParameterError where it is no size."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([KMGT]I?)?B?\s*", text.upper())
    if match is None:
        raise ParameterError(f"{option} {text!r}; expected a size such as 2GiB, 500MB or 4096 (bytes)")
    return int(float(match[1]) * _UNITS[match[2] or ""])


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


def discount(gamma: float | None, horizon: int | None) -> float:
    """The discount that `--gamma` names: when not given 0.99, or 1 with a horizon."""
    if gamma is not None:
        return gamma
    return 0.99 if horizon is None else 1.0


def build_options(
    memory: str | None, workers: int | None, max_states: int | None, processes: str = "1"
) -> dict[str, Any]:
    """What `build` takes, of --memory, --workers and --max-states."""
    return {"memory": memory_of(memory, processes), "workers": workers, "max_states": max_states}


def ranks_of(processes: str) -> int | str:
    """1, or "mpi" in a process that a launcher has started with others; all but the first of them are silent from here
    on. A number above 1 starts this command once more, by `mpiexec`.
    """
    from pharos.ranks import launched, mpi_rank, start_under_mpiexec

    rank, size = launched()
    if processes != "mpi" and not (processes.isdigit() and 1 <= int(processes) <= _MOST_PROCESSES):
        raise typer.BadParameter(f"--processes {processes}: expected a number from 1 to {_MOST_PROCESSES}, or mpi")
    if size == 1 and processes not in ("1", "mpi"):
        start_under_mpiexec(int(processes))
    if processes == "mpi" and size == 1:  # a launcher that says nothing to its processes
        rank = mpi_rank().rank
    if rank > 0:  # the first one speaks for all
        sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    return "mpi" if size > 1 or processes == "mpi" else 1


def memory_of(memory: str | None, processes: str) -> int | None:
    """Bytes of --memory that a process has, where --processes N share them."""
    size = parse_size(memory)
    return size // int(processes) if size is not None and processes.isdigit() else size


def check_format(path: Path, suffixes: Sequence[str], option: str = "--out") -> str:
    """The suffix of `path`, lower case; ParameterError unless it is among `suffixes` and the folder above exists."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise ParameterError(f"{option} {path}; expected a file name that ends in {' or '.join(suffixes)}")
    if not path.absolute().parent.is_dir():
        raise ParameterError(f"{option} {path}: there is no folder {path.absolute().parent}; make it first")
    return suffix
