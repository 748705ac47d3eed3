"""Targets of `pharos import env`: an environment named by Gymnasium's id, or the user's own function that makes one."""

import contextlib
import importlib.metadata
import platform
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import FolderLocked, ParameterError, RuleError
from pharos.importers.folder import BUILDING, check_free, save
from pharos.importers.jax_stepping import GymnaxEnvironment, PgxEnvironment, jax_source
from pharos.importers.search import SteppedStates
from pharos.importers.step_checkpoint import LAYER_SECONDS, StepCheckpoint
from pharos.importers.stepped_environment import SteppedEnvironment
from pharos.importers.stepping import SteppingOptions, SteppingRun, StepRecording
from pharos.importers.wrappers import Stepped
from pharos.mdp import TabularMDP
from pharos.system import sources, storage
from pharos.system.wording import in_one_line

JAX = "jax:"
ENTRY_POINTS = "gymnasium.envs"
TARGET_FORMAT = 1
"""Of the files of an unfinished import; raised when states get other keys."""


@dataclass(frozen=True)
class NamedCode:
    """A function of the user's own by its name, which any process can import and call.

    Attributes:
        name: module:function or file.py:function. folder: base of relative paths.
        options: keyword arguments.
    """

    name: str
    folder: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, *arguments: object) -> Any:
        """Answer of the function."""
        return self.function(*arguments, **self.options)

    @property
    def source(self) -> sources.Source:
        """File and checksum."""
        return sources.find_source(self.name, self.folder)

    @property
    def function(self) -> Callable[..., Any]:
        """The function itself; ParameterError if there is none."""
        function = sources.load_source(self.source)
        if function is None:
            where, _, name = self.name.rpartition(":")
            raise ParameterError(f"{self.name!r}: there is no {name!r} in {where}; expected a function or a class")
        if not callable(function):
            raise ParameterError(f"{self.name!r}: is {function!r}; expected a function or a class of that name")
        return function


@dataclass(frozen=True)
class GymnasiumEnvironment:
    """Maker of an environment that is registered with Gymnasium.

    Attributes:
        name: the id; module:id imports a module first. options: of the environment.
    """

    name: str
    options: Mapping[str, Any]

    def __call__(self) -> Stepped:
        """A new environment; ParameterError if Gymnasium cannot make it."""
        import gymnasium

        try:
            try:
                return gymnasium.make(self.name, disable_env_checker=True, **self.options)
            except gymnasium.error.UnregisteredEnv:
                _load_entry_points()
                return gymnasium.make(self.name, disable_env_checker=True, **self.options)
        except Exception as error:  # whatever an environment does with options that are none of its own
            reason = in_one_line(error) or type(error).__name__
            raise ParameterError(f"{self.name}: Gymnasium cannot make it: {reason}") from None


MAKERS: dict[str, Callable[[str, Mapping[str, Any]], Any]] = {
    "gymnasium:": GymnasiumEnvironment,
    "gymnax:": GymnaxEnvironment,
    "pgx:": PgxEnvironment,
}
"""Libraries whose environments are made by an id."""
JAX_MAKERS = ("gymnax:", "pgx:")


def _load_entry_points() -> None:
    """Let packages register their environments that announce them by an entry point, as older Gymnasium did itself."""
    from gymnasium.envs import registration

    within = getattr(registration, "namespace", lambda _: contextlib.nullcontext())
    for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
        with (
            contextlib.suppress(Exception),  # of a package that is not asked for
            contextlib.nullcontext() if point.name == "__root__" else within(point.name),
        ):
            register = point.load()
            if callable(register):
                register()


class StepTarget:
    """An environment named on the command line, with what is named beside it.

    Args:
        target: gymnasium:ID, gymnax:ID, pgx:ID, module:factory or file.py:factory; jax: before these if the
            factory returns `JaxFunctions`.
        options: of the environment or the factory.
        key, reward: names of functions, see `stepping`. weights: "1,0.5", of a vector of rewards.
    Attributes:
        words: target and options, for people.
    Raises:
        ParameterError: a name is none of these.
    """

    def __init__(
        self,
        target: str,
        options: Mapping[str, Any] | None = None,
        *,
        key: str | None = None,
        reward: str | None = None,
        weights: str = "",
    ):
        options = dict(options or {})
        self.words = " ".join([target, *(f"{name}={value}" for name, value in options.items())])
        here = str(Path.cwd())
        maker = next((prefix for prefix in MAKERS if target.startswith(prefix)), None)
        reference = target.removeprefix(JAX)
        self.source_of: Callable[..., Any] = (
            jax_source if maker in JAX_MAKERS or reference != target else SteppedEnvironment
        )
        self.factory: Any
        if maker is not None:
            self.factory = MAKERS[maker](target.removeprefix(maker), options)
        elif sources.is_reference(reference):
            self.factory = NamedCode(reference, here, options)
        else:
            raise ParameterError(
                f"{target!r}: expected gymnasium:ID, gymnax:ID, pgx:ID, module:factory or file.py:factory"
            )
        if reward is not None and weights:
            raise ParameterError("a reward and weights; expected one of them")
        self.key, self.reward = (None if name is None else NamedCode(name, here) for name in (key, reward))
        self.weights = _numbers(weights)
        for code in (self.factory, self.key, self.reward):
            if isinstance(code, NamedCode):
                code.function  # noqa: B018  (refused before anything begins)

    def import_into(
        self,
        folder: Path,
        *,
        seed: int | None = None,
        ignore: tuple[str, ...] = (),
        max_outcomes: int,
        gamma: float | None = None,
        progress: Callable[[SteppedStates, float, bool], None] | None = None,
        seconds: float = LAYER_SECONDS,
        **options: Any,
    ) -> tuple[TabularMDP, StepRecording]:
        """Import the environment into a folder, or finish an import that was begun there.

        Args:
            seconds: between two writes of what is finished.
            options: horizon, max_states, workers and check of `stepping`.
        Raises:
            ParameterError: the folder holds something else, or the beginning of another import. As `stepping`.
        """
        check_free(folder)
        payment = self.reward or self.weights or None
        stepping_options = SteppingOptions(
            seed=seed, ignore=frozenset(ignore), key=self.key, reward=payment, max_outcomes=max_outcomes
        )
        building = folder / BUILDING
        building.mkdir(parents=True, exist_ok=True)
        checkpoint = StepCheckpoint(building, self._identity(stepping_options, options.get("horizon")), seconds)
        run = SteppingRun(self.factory, stepping_options, checkpoint=checkpoint, source_of=self.source_of, **options)
        try:
            with storage.lock(building, FolderLocked, "importing"):
                mdp, recording = run.finish(gamma, progress)
                save(mdp, folder, source=f"stepped: {self.words}", **recording.arguments())
                checkpoint.discard()
        except RuleError:  # the code or the options have to change
            checkpoint.discard()
            raise
        finally:
            if checkpoint.is_empty:
                shutil.rmtree(building, ignore_errors=True)
                with contextlib.suppress(OSError):
                    folder.rmdir()  # if it is empty
        return mdp, recording

    def _identity(self, options: SteppingOptions, horizon: int | None) -> dict[str, Any]:
        """Names, options and versions that decide about the states and their numbers."""
        packages = ["gymnasium", *["jax", "gymnax", "pgx"] * (self.source_of is jax_source)]
        codes = {"factory": self.factory, "key": self.key, "reward": self.reward}
        return {
            "format": TARGET_FORMAT,
            "target": self.words,
            "code": {name: code.source.checksum for name, code in codes.items() if isinstance(code, NamedCode)},
            "seed": options.seed,
            "ignore": sorted(options.ignore),
            "key": self.key.name if self.key else None,
            "reward": self.reward.name if self.reward else list(self.weights),
            "max_outcomes": options.max_outcomes,
            "horizon": horizon,
            "versions": [platform.python_version(), np.__version__, *map(_version, packages)],
        }


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(each) for each in text.split(",")) if text else ()
    except ValueError:
        raise ParameterError(f"weights are {text!r}; expected numbers such as 1,0.5") from None
