"""Observations of the user's own, named as `module:name` or `file.py:name` like environments and agents.

The name is that of an entry that the module registers, of a pair (function, Gymnasium space), or of a subclass of
`Observation`, which is called with the environment and the options.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.observations.observation import FunctionObservation, Observation, is_built_in, registered
from pharos.system import sources
from pharos.system.sources import Source


@dataclass(frozen=True, eq=False)
class OwnObservation:
    """An observation of the user's own for any environment; `observe` takes it in the place of a name.

    Attributes:
        name: under which results speak of it.
        make: (env, **options) -> Observation.
        source: where it comes from; None where no other process can import it.
    """

    name: str
    make: Callable[..., Observation]
    source: Source | None

    def __str__(self) -> str:
        return self.name


def imported(path: str, folder: str | Path | None = None) -> OwnObservation:
    """Import an observation from "module:name" or "file.py:name".

    Args:
        folder: relative files and modules are looked for there first; None: in the current directory.
    Raises:
        ParameterError: no such module, file or name, or it is no observation.
    """
    source = sources.find(path, folder)
    return _observation(source, sources.load(source))


def observation_of(source: Source, *, trust: bool = False, strict: bool = False) -> OwnObservation:
    """The observation that a stored configuration names.

    Args:
        trust, strict: as for `pharos.system.sources.resolve`.
    Raises:
        UntrustedCode: it was not imported before, and is not trusted. ParameterError: it cannot be imported.
    """
    return _observation(source, sources.resolve(source, trust=trust, strict=strict))


def own_observation(observation: Any, folder: str | Path | None = None) -> OwnObservation | None:
    """What the user named, where it is of the user's own: imported, or registered before; None for all else."""
    if isinstance(observation, OwnObservation):
        return observation
    if sources.is_reference(observation):
        return imported(observation, folder)
    if isinstance(observation, str) and (entry := registered(observation)) is not None:
        function, space = entry
        make = partial(_of_function, observation, function, space)
        return OwnObservation(observation, make, sources.source_of(function, observation))
    return None


def _observation(source: Source, value: Any) -> OwnObservation:
    name = source.attribute
    if is_built_in(name):
        raise ParameterError(f"{source.name!r}: {name!r} is the name of a built-in observation; choose another name")
    if isinstance(value, type) and issubclass(value, Observation):
        return OwnObservation(name, value, source)
    if isinstance(value, tuple) and len(value) == 2 and callable(value[0]):
        return OwnObservation(name, partial(_of_function, name, *value), source)
    entry = registered(name)
    if entry is None:
        raise ParameterError(
            f"{source.name!r}: found {value!r}; expected the name of a pair (function, Gymnasium space), of a subclass "
            f"of Observation, or of what the file registers with pharos.observations.register"
        )
    return OwnObservation(name, partial(_of_function, name, *entry), source)


def _of_function(name: str, function: Any, space: Any, env: Environment) -> Observation:
    return FunctionObservation(env, function, space, name=name)
