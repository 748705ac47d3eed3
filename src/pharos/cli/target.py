"""TARGET: what a command works on, an environment, or a folder or file that holds something already made."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pharos.cli.answers import complain
from pharos.cli.options import discount, parse_parameters
from pharos.errors import ParameterError

if TYPE_CHECKING:
    from pharos.environments import Environment
    from pharos.mdp import TabularMDP
    from pharos.state_space import StateSpace


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
        processes: int | str = 1,
    ) -> "StateSpace":
        """The state space: built (or taken from the cache) for an environment, loaded from a folder."""
        from pharos.ranks import launched
        from pharos.state_space import build, load

        if self.environment is not None or self.is_imported:
            options: dict[str, Any] = {"memory": memory, "workers": workers, "max_states": max_states}
            return build(self.found_environment(), out, processes=processes, **options)
        assert self.path is not None
        space = load(self.path, verify=launched()[0] == 0)  # of ranks, the first reads it all
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
        by_range: bool = False,
        **building: Any,
    ) -> "TabularMDP":
        """The tabular MDP, with chance; `gamma` None is 0.99, or 1 with a horizon. `building` as for `space`.

        by_range: whether rewards may wait until they are asked for; they do under MPI.
        """
        from pharos.training import ChanceSetting

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
        by_range = by_range or building.get("processes") == "mpi"
        return chance.of(space.mdp(gamma=discount(gamma, horizon), by_range=by_range).with_horizon(horizon))

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
