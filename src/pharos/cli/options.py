"""Options shared by commands: declarations, shell completion, and parsers.

TARGET is what a command works on: an environment, or a folder or file that holds something already made.
"""

import ast
import dataclasses
import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.models import ParameterInfo

from pharos.cli.answers import complain
from pharos.environments import as_tuples
from pharos.errors import ParameterError
from pharos.mdp import ChanceSetting

if TYPE_CHECKING:
    from pharos.environments import Environment
    from pharos.mdp import TabularMDP
    from pharos.state_space import StateSpace


def complete_target(incomplete: str) -> list[str]:
    """Proposals of a shell for TARGET: classes, and once there is a slash or one class is left, named instances."""
    from pharos.environments import BUILT_IN

    names = [entry.name for entry in BUILT_IN if entry.name.startswith(incomplete)]
    if "/" in incomplete or len(names) == 1:
        names += [f"{entry.name}/{instance}" for entry in BUILT_IN for instance in entry.instance_names]
    return [name for name in names if name.startswith(incomplete)]


def complete_parameter(context: typer.Context, incomplete: str) -> list[str]:
    """Proposals of a shell after TARGET: its parameters."""
    from pharos.environments import class_called

    target = context.params.get("target") or context.params.get("environment") or ""
    cls = class_called(str(target).partition("/")[0])
    names = [field.name for field in dataclasses.fields(cls)] if cls is not None else []  # type: ignore[arg-type]
    return [f"{name}=" for name in names if name.startswith(incomplete)]


Targets = Annotated[
    list[str], typer.Argument(metavar="TARGET...", help="Instances such as frozen_lake/8x8, or folders.")
]
Count = Annotated[int, typer.Option(min=1)]
Seed = Annotated[int, typer.Option(min=0)]
Seconds = Annotated[float, typer.Option(min=0)]
Discount = Annotated[float, typer.Option(min=0, max=1)]
Gamma = Annotated[float | None, typer.Option(min=0, max=1, help="Discount. Default: 0.99, or 1 with a horizon.")]
Objective = Annotated[
    Literal["discounted", "total", "average"] | None,
    typer.Option(
        help="discounted; total: gamma 1 and no horizon, not even a world's own; average: reward a step in the long "
        "run. By --gamma if not given."
    ),
]
Horizon = Annotated[int | None, typer.Option(min=1, help="Steps after which an episode ends. Default: no limit.")]
Tolerance = Annotated[float, typer.Option(help="Largest error of a value, in units of return.")]
Chance = Annotated[ChanceSetting, "sticky random lazy"]
Trust = Annotated[bool, typer.Option(help="Execute code that received files name: classes, observations and agents.")]


def file_ending(*suffixes: str, help: str | None = None) -> ParameterInfo:
    """A file to write, whose name has one of the endings, in a folder that is there."""

    def checked(option: typer.CallbackParam, path: Path | None) -> Path | None:
        if path is not None:
            check_format(Path(path), suffixes, option.opts[0])
        return path

    return typer.Option(callback=checked, help=help)


# Texts ----------------------------------------------------------------------------------------------------------------


def parse_parameters(words: list[str] | None) -> dict[str, Any]:
    """`["height=12", "speeds=1,2"]` -> `{"height": 12, "speeds": (1, 2)}`. ParameterError: not name=value."""
    parameters: dict[str, Any] = {}
    for word in words or ():
        name, sign, text = word.partition("=")
        if not sign or not name.isidentifier():
            raise ParameterError(f"found {word!r}; expected a parameter name=value, such as height=12")
        if name in parameters:
            raise ParameterError(f"parameter {name!r} is given twice; give it once")
        parameters[name] = parse_value(text)
    return parameters


def parse_value(text: str) -> object:
    """A value as Python or JSON writes it: 1, true, null, [[1,1],-1], (1,2), 1,2,3. Lists become tuples. Anything else
    is text."""
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


def parse_size(text: str | None) -> int | None:
    """`2GiB` -> 2147483648, `500MB` -> 500000000, `4096` -> 4096. ParameterError if it is no size."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([KMGT]I?)?B?\s*", text.upper())
    if match is None:
        raise ParameterError(f"--memory {text!r}; expected a size such as 2GiB, 500MB or 4096 (bytes)")
    return int(float(match[1]) * _UNITS[match[2] or ""])


def parse_seeds(text: str) -> list[int]:
    """`0:64`, `0,1,5` or both, as a list. The end of a range does not belong to it.

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


def total_of(mdp: "TabularMDP", gamma: float | None, horizon: int | None, objective: str | None) -> "TabularMDP":
    """The MDP, with gamma 1 and no horizon if the objective is the total reward, or the reward of a step in the long
    run."""
    if objective not in ("total", "average"):
        return mdp
    if objective == "average" and (gamma is not None or horizon is not None):
        what = f"--horizon {horizon}" if horizon is not None else f"--gamma {gamma:g}"
        raise ParameterError(f"--objective average has neither a discount nor a horizon; found {what}")
    if gamma not in (None, 1.0) or horizon is not None:
        what = f"--horizon {horizon}" if horizon is not None else f"--gamma {gamma:g}"
        raise ParameterError(f"--objective total has gamma 1 and no horizon; found {what}")
    return mdp.with_gamma(1.0).with_horizon(None)


def discount(gamma: float | None, horizon: int | None) -> float:
    """The discount that `--gamma` names. Default: 0.99, or 1 with a horizon."""
    if gamma is not None:
        return gamma
    return 0.99 if horizon is None else 1.0


def ranks_of(processes: str) -> int | str:
    """Return 1, or "mpi" in a process that a launcher has started with others. All but the first of them are silenced.

    A number above 1 starts this command once more, by `mpiexec`.
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


def check_format(path: Path, suffixes: Sequence[str], option: str = "--out") -> str:
    """The suffix of `path`, lower case. ParameterError unless it is among `suffixes` and the folder above exists."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise ParameterError(f"{option} {path}; expected a file name that ends in {' or '.join(suffixes)}")
    if not path.absolute().parent.is_dir():
        raise ParameterError(f"{option} {path}: there is no folder {path.absolute().parent}; make it first")
    return suffix


# Target ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Building:
    """Options of building a state space.

    Attributes:
        memory: memory to use at most, such as 2GiB or 500MB.
        workers: threads (default: as many as processors).
        max_states: stop with an error beyond this many states.
        ranks: processes, as `build` takes them.
    """

    memory: Annotated[str | None, "SIZE"] = None
    workers: Count | None = None
    max_states: Count | None = None
    ranks: int | str = field(init=False, default=1)

    @property
    def options(self) -> dict[str, Any]:
        """Keywords of `build`."""
        own = {"workers": self.workers, "max_states": self.max_states, "processes": self.ranks}
        return {"memory": parse_size(self.memory), **own}


@dataclass(frozen=True, kw_only=True)
class SharedBuilding(Building):
    """Options of building by several processes, made before any output, as all but the first then fall silent.

    Attributes:
        processes: processes that share the work and the memory, by MPI, or under mpiexec the processes that it has
            started.
    """

    processes: Annotated[str, "N|mpi"] = "1"

    def __post_init__(self) -> None:
        object.__setattr__(self, "ranks", ranks_of(self.processes))

    @property
    def options(self) -> dict[str, Any]:
        """Keywords of `build`. The memory is meant for one process."""
        size = parse_size(self.memory)
        if size is not None and self.processes.isdigit():
            size //= int(self.processes)
        return {**super().options, "memory": size}


@dataclass
class Target:
    """Input of a command: an environment, or a folder or file that holds something already made.

    Attributes:
        target: Environment, module:Class, built folder or imported file.
        parameters: parameters of the environment.
        environment: for a name or module:Class.
        path: for a folder or file.
    Raises:
        UnknownName: no such environment, class or parameter. ParameterError: no such folder or file, a parameter is
            wrong.
    """

    target: Annotated[str, typer.Argument(metavar="TARGET", autocompletion=complete_target)]
    parameters: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME=VALUE]...", show_default=False, autocompletion=complete_parameter),
    ] = None
    environment: "Environment | None" = field(init=False, default=None)
    path: Path | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        from pharos.environments import list_environments, make

        text, parameters, path = self.target, parse_parameters(self.parameters), Path(self.target).expanduser()
        if text in list_environments():
            if Path(text).is_dir():
                complain(f"{text}: is taken as the environment of this name; write ./{text} for the folder")
        elif path.exists():
            if parameters:
                raise ParameterError(
                    f"{text}: is a {'folder' if path.is_dir() else 'file'}, which has its parameters already; "
                    f"leave out {', '.join(f'{name}=...' for name in parameters)}"
                )
            self.path = path
            return
        elif ":" not in text and (path.suffix or text.startswith((".", "~", os.sep)) or text.endswith(os.sep)):
            raise ParameterError(f"{text}: no such folder or file")
        self.environment = make(text, **parameters)

    @property
    def title(self) -> str:
        """The target as typed."""
        return " ".join((self.target, *(self.parameters or ())))

    def space(self, building: Building | None = None, out: Path | None = None, **options: Any) -> "StateSpace":
        """The state space: built (or taken from the cache) for an environment, loaded from a folder."""
        from pharos.ranks import launched
        from pharos.state_space import build, load

        options = {**(building or Building()).options, **options}
        if self.environment is not None or self.is_imported:
            return build(self.found_environment(), out, **options)
        assert self.path is not None
        space = load(self.path, verify=launched()[0] == 0)  # of ranks, the first reads it all
        self._check_size(space.num_states, options)
        return space

    def _check_size(self, num_states: int, options: Mapping[str, Any]) -> None:
        """ParameterError if the folder of the target has more states than the options allow."""
        if options["max_states"] is not None and num_states > options["max_states"]:
            raise ParameterError(f"{self.path}: has {num_states} states; expected at most {options['max_states']}")

    def mdp(
        self,
        building: Building | None = None,
        *,
        gamma: float | None = None,
        horizon: int | None = None,
        chance: ChanceSetting | None = None,
        by_range: bool = False,
    ) -> "TabularMDP":
        """The tabular MDP, with chance. `gamma` None is 0.99, or 1 with a horizon.

        by_range: whether rewards may wait until they are asked for. They do under MPI.
        """
        chance = chance or ChanceSetting()
        if self.is_imported:
            mdp = self._imported(horizon)
            self._check_size(mdp.num_states, (building or Building()).options)
            return chance.of(mdp if gamma is None else mdp.with_gamma(gamma))
        space = self.rewarded_space(building)
        by_range = by_range or (building is not None and building.ranks == "mpi")
        return chance.of(space.mdp(gamma=discount(gamma, horizon), by_range=by_range).with_horizon(horizon))

    def rewarded_space(self, building: Building | None = None) -> "StateSpace":
        """The state space of an environment whose class pharos knows, and so its rewards. ParameterError for others."""
        space = self.space(building)
        if space.environment is None:
            raise ParameterError(
                f"{self.target}: pharos does not know the class {space.manifest['class']} of this environment, "
                f"so not its rewards; name it as module:Class instead of its folder"
            )
        return space

    def found_environment(self) -> "Environment":
        """The environment, also of a folder: the one it was built from, or of the imported MDP.

        Raises:
            ParameterError: a file, or the folder of a class that pharos does not know.
        """
        if self.environment is not None:
            return self.environment
        assert self.path is not None
        if self.path.is_file():
            from pharos.importers import how_to_import

            raise ParameterError(
                f"{self.path}: a file is no environment; bring it into a folder: {how_to_import(self.path)}"
            )
        if self.is_imported:
            from pharos.environments import make

            return make("imported", folder=str(self.path))
        environment = self.rewarded_space().environment
        assert environment is not None
        return environment

    def as_environment(self) -> "Target":
        """The environment of an imported folder in the place of its table."""
        other = copy(self)
        other.environment, other.path = self.found_environment(), None
        return other

    @property
    def is_imported(self) -> bool:
        """Whether the target is an imported MDP (file or folder), which has a gamma and a horizon of its own."""
        from pharos.importers import is_folder

        return self.path is not None and (self.path.is_file() or is_folder(self.path))

    def _imported(self, horizon: int | None) -> "TabularMDP":
        from pharos import importers

        assert self.path is not None
        if self.path.is_dir():
            mdp = importers.load(self.path)
            return mdp if horizon is None else mdp.with_horizon(horizon)
        return importers.bridge(self.path, horizon)
