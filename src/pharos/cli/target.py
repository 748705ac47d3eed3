"""TARGET: what a command works on, an environment, or a folder or file that holds something already made."""

import os
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import complain
from pharos.cli.options import (
    Count,
    complete_parameter,
    complete_target,
    discount,
    parse_parameters,
    parse_size,
    ranks_of,
)
from pharos.errors import ParameterError
from pharos.mdp import ChanceSetting

if TYPE_CHECKING:
    from pharos.environments import Environment
    from pharos.mdp import TabularMDP
    from pharos.state_space import StateSpace


@dataclass(frozen=True, kw_only=True)
class Building:
    """How a state space is built.

    Attributes:
        memory: memory to use at most, such as 2GiB or 500MB.
        workers: threads; all processors when not given.
        max_states: stop with an error beyond this many states.
        ranks: processes, as `build` takes them.
    """

    memory: Annotated[str | None, typer.Option(metavar="SIZE")] = None
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
    """The same by several processes; made before anything is said, as all but the first are silent from then on.

    Attributes:
        processes: processes that share the work and the memory, by MPI; under mpiexec: those that it has started.
    """

    processes: Annotated[str, typer.Option(metavar="N|mpi")] = "1"

    def __post_init__(self) -> None:
        object.__setattr__(self, "ranks", ranks_of(self.processes))

    @property
    def options(self) -> dict[str, Any]:
        """Keywords of `build`; the memory is that of one process."""
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
        """As it was typed."""
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
        if options["max_states"] is not None and space.num_states > options["max_states"]:
            raise ParameterError(
                f"{self.path}: has {space.num_states} states; expected at most {options['max_states']}"
            )
        return space

    def mdp(
        self,
        building: Building | None = None,
        *,
        gamma: float | None = None,
        horizon: int | None = None,
        chance: ChanceSetting | None = None,
        by_range: bool = False,
    ) -> "TabularMDP":
        """The tabular MDP, with chance; `gamma` None is 0.99, or 1 with a horizon.

        by_range: whether rewards may wait until they are asked for; they do under MPI.
        """
        chance = chance or ChanceSetting()
        if self.is_imported:
            mdp = self._imported(horizon)
            return chance.of(mdp if gamma is None else mdp.with_gamma(gamma))
        space = self.rewarded_space(building)
        by_range = by_range or (building is not None and building.ranks == "mpi")
        return chance.of(space.mdp(gamma=discount(gamma, horizon), by_range=by_range).with_horizon(horizon))

    def rewarded_space(self, building: Building | None = None) -> "StateSpace":
        """The state space of an environment whose class pharos knows, and so its rewards; ParameterError else."""
        space = self.space(building)
        if space.environment is None:
            raise ParameterError(
                f"{self.target}: pharos does not know the class {space.manifest['class']} of this environment, "
                f"so not its rewards; name it as module:Class instead of its folder"
            )
        return space

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
