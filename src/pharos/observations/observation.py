"""Observation: a pure function of the state with a Gymnasium space, for one environment.

Observations of the user's own, named as `module:name` or `file.py:name` like environments and agents.

The name is the key of an entry that the module registers, of a pair (function, Gymnasium space), or of a subclass of
`Observation`, which is called with the environment and the options.
"""

import importlib
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from pharos.drawing import check_state
from pharos.environments import Environment, make
from pharos.errors import ParameterError, UnknownName
from pharos.system import sources
from pharos.system.sources import Source

if TYPE_CHECKING:
    import gymnasium

    from pharos.state_space import StateSpace

Function = Callable[[Environment, np.ndarray], np.ndarray]


@cache
def kernels() -> ModuleType:
    """Compiled functions of blocks of states. An import at every call would take as long as they do."""
    from pharos.kernels import observation_kernels

    return observation_kernels


class Observation:
    """A function of the state for one environment. Called with a batch of states it gives a batch of observations.

    Two options tell an agent something else besides: `frames`, pictures of the states before (images.py), and
    `irrelevant`, coins that are thrown anew at each step (context.py). Who steps an environment brings them along.

    Attributes:
        name: such as "vector".
        env: the environment.
        space: Gymnasium space of one observation.
        names: of the entries of a one-dimensional observation, None for others.
        frames: k, if the last k states are seen, else 1.
        irrelevant: how many entries of noise follow a vector.
        is_flat: whether a compiled step may draw it: a pixel is a cell, and each layer has a plane of its own.
        shades: (L, 256) uint8, of an image: the shade of every value on the plane of every layer.
    """

    name: str
    env: Environment
    space: "gymnasium.Space"
    names: tuple[str, ...] | None = None
    is_flat: bool = False
    frames: int = 1
    irrelevant: int = 0
    shades: np.ndarray

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """(N, D) int64 states -> (N, *space.shape) of space.dtype, a fresh array. ParameterError: see `checked`."""
        raise NotImplementedError

    def checked(self, states: np.ndarray) -> np.ndarray:
        """States as (N, D) int64. Compiled drawings of other numbers would write where they must not.

        Raises:
            ParameterError: `states` is no table of integers with D columns, or a number lies outside of the range that
                the environment declares for its component.
        """
        states, components = np.asarray(states), self.env.components
        if states.ndim != 2 or states.shape[1] != len(components) or states.dtype.kind not in "iub":
            raise ParameterError(
                f"observation {self.name!r} of {self.env}: found states of shape {states.shape} and type "
                f"{states.dtype}; expected integers of shape (N, {len(components)})"
            )
        states = states.astype(np.int64, copy=False)
        if (n := kernels().first_beyond_ranges(states, components.low, components.size)) >= 0:
            check_state(self.env, states[n].tolist())
        return states

    def one(self, state: np.ndarray) -> np.ndarray:
        """The observation of one state (D,): a fresh array, or an integer if the space is Discrete."""
        return self(state[None])[0]

    def frame(self, states: np.ndarray) -> np.ndarray:
        """(N, *shape of one frame) of states (N, D), of an observation of several frames."""
        raise NotImplementedError(f"{self} has no frames")

    def stacked(self, frames: np.ndarray) -> np.ndarray:
        """(N, *space.shape) of N histories of k frames (N, k, ...), the oldest first, in a fresh array."""
        raise NotImplementedError(f"{self} has no frames")

    def of_histories(self, histories: np.ndarray) -> np.ndarray:
        """(N, *space.shape) of N times k states (N, k, D), the oldest first."""
        count, k, width = histories.shape
        frames = self.frame(histories.reshape(count * k, width))
        return self.stacked(frames.reshape(count, k, *frames.shape[1:]))

    def __repr__(self) -> str:
        return f"<observation {self.name!r} of {self.env}: {self.space}>"


class FunctionObservation(Observation):
    """A user's function(env, states) with its Gymnasium space, checked at every call.

    The function gets the environment and states (N, D) int64, and returns an array (N, *space.shape). Its numbers are
    converted to the space's dtype if that keeps their kind (float64 to float32, integers to floats).

    Raises:
        ParameterError: the result has another shape, a dtype that does not fit, NaN, or a number that a space of
            numbers lacks. For the start states also if a value lies outside a Box.
    """

    def __init__(self, env: Environment, function: Function, space: object, *, name: str | None = None):
        from gymnasium import spaces

        self.name = name or str(getattr(function, "__name__", "function"))
        self.env = env
        self.function = function
        one = space(env) if callable(space) else space
        if not isinstance(one, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
            raise ParameterError(
                f"observation {self.name!r}: its space is {one!r}; expected a Box, Discrete, MultiDiscrete or "
                f"MultiBinary of Gymnasium, or a function that gives one for env"
            )
        if 0 in (one.shape or ()):
            raise ParameterError(f"observation {self.name!r}: its space {one} has no entries; expected at least one")
        self.space = one
        starts = np.array([state for state, _ in env.initial_states()], np.int64)
        for state, observation in zip(starts, self(starts), strict=True):
            if not self.space.contains(observation):
                raise ParameterError(
                    f"observation {self.name!r} of the start state {tuple(state.tolist())} is "
                    f"{observation!r:.80}, which is not in its space {self.space}"
                )

    def __call__(self, states: np.ndarray) -> np.ndarray:
        batch = np.asarray(self.function(self.env, states.copy()))  # functions may write to what they get
        expected = (len(states), *(self.space.shape or ()))
        if batch.shape != expected:
            raise ParameterError(
                f"observation {self.name!r} has shape {batch.shape} for {len(states)} states; expected {expected}: "
                f"one row a state, each as its space says"
            )
        dtype = np.dtype(self.space.dtype)
        if batch.dtype != dtype and not np.can_cast(batch.dtype, dtype, "same_kind"):
            raise ParameterError(
                f"observation {self.name!r} has dtype {batch.dtype}; expected {dtype}, as its space says: use .astype"
            )
        batch = np.array(batch, dtype)  # a copy: functions may return the same buffer twice
        wrong = self._is_wrong(batch)
        if wrong.any():
            state = states[int(np.flatnonzero(wrong)[0])]
            raise ParameterError(
                f"observation {self.name!r} of the state {tuple(state.tolist())} is {batch[wrong][0]!r:.80}; expected "
                f"{'numbers, no NaN' if dtype.kind == 'f' else f'one of its space {self.space}'}"
            )
        return batch

    def _is_wrong(self, batch: np.ndarray) -> np.ndarray:
        """(N,) bool, observations that no network could read: with NaN, or numbers that a space of numbers lacks."""
        from gymnasium import spaces

        rows = batch.reshape(len(batch), int(np.prod(batch.shape[1:])))
        if isinstance(self.space, spaces.Box):
            return np.isnan(rows).any(axis=1) if batch.dtype.kind == "f" else np.zeros(len(batch), np.bool_)
        first, number = np.zeros(1, np.int64), np.full(1, 2)  # of MultiBinary
        if isinstance(self.space, spaces.Discrete | spaces.MultiDiscrete):
            numbers = self.space.n if isinstance(self.space, spaces.Discrete) else self.space.nvec
            first, number = np.ravel(self.space.start), np.ravel(numbers)
        return np.asarray(((rows < first) | (rows >= first + number)).any(axis=1))


# Name of one of pharos' own -> its file and class, which is loaded when it is first asked for
_BUILT_IN = {
    "vector": "vector:Vector",
    "simple_image": "images:SimpleImage",
    "complex_image": "images:ComplexImage",
    "one_hot": "vector:OneHot",
    "index": "vector:Index",
    "number": "vector:Number",
    "hash": "vector:Hash",
    "mixed": "vector:Mixed",
    "recorded": "recorded:Recorded",
}
_registered: dict[str, tuple[Function, object]] = {}

# Options that change what an agent is told, not how
INFORMATION_OPTIONS = ("motion", "hide", "seen_first", "frames", "irrelevant")


def names() -> list[str]:
    """The names that `observation=` knows, the registered ones last."""
    return [*_BUILT_IN, *_registered]


def title(name: str, options: Mapping[str, Any], *, whole: bool = False) -> str:
    """The name of an observation in tables and figures, with the options that change what the agent sees:
    "simple_image(motion=True)".

    Args:
        whole: with all options.
    """
    shown = (*INFORMATION_OPTIONS, *sorted(set(options) - set(INFORMATION_OPTIONS))) if whole else INFORMATION_OPTIONS
    words = (f"{option}={_words(options[option])}" for option in shown if options.get(option))
    return f"{name}({', '.join(words)})".removesuffix("()")


def _words(value: str | bool | int | Iterable[object]) -> str:
    return str(value) if isinstance(value, str | bool | int) else "+".join(map(str, value))


def register(name: str, function: Function, space: object) -> None:
    """Make a user's observation known as `observation=name`, so that a spec, a study or a command can name it.

    Args:
        name: a new name. Registering it again replaces the function, so that a notebook cell can be run twice.
        function: function(env, states (N, D) int64) -> (N, *space.shape).
        space: a Gymnasium space, or a function env -> space.
    Raises:
        ParameterError: the name belongs to a built-in observation.
    """
    if name in _BUILT_IN:
        raise ParameterError(f"observations.register: {name!r} is built in; choose another name")
    _registered[name] = (function, space)


def registered(name: str) -> tuple[Function, object] | None:
    """The (function, space) that a user registered under this name."""
    return _registered.get(name)


def observe(
    env: Environment | str,
    observation: object = "vector",
    *,
    state_space: "StateSpace | None" = None,
    **options: object,
) -> Observation:
    """Return an observation of `env`.

    Args:
        env: an Environment, or a name that `pharos.make` knows.
        observation: a name (see `names`), "module:name" or "file.py:name" of the user's own, a pair (function,
            Gymnasium space) as in `register`, or an Observation, which is returned.
        state_space: the built state space. "index" needs it.
        options: of the named observation, such as `grey=True`.
    Raises:
        UnknownName: no such observation or option. The nearest is suggested.
        ParameterError: the observation does not exist for this environment.
    """
    env = make(env) if isinstance(env, str) else env
    if not isinstance(env, Environment):
        raise ParameterError(f"env is {env!r}; expected a pharos Environment, or a name such as 'breakout/12x8x1'")
    if not isinstance(observation, Observation):
        instance, keywords = _observation_and_keywords(_maker(observation), env, state_space, options)
    elif observation.env != env:
        raise ParameterError(f"observation {observation.name!r} belongs to {observation.env}; expected one of {env}")
    else:
        instance, keywords = observation, []
    _check_known(instance.name, options, keywords)
    return instance


def _observation_and_keywords(
    make: Callable[..., Observation], env: Environment, state_space: "StateSpace | None", options: Mapping[str, Any]
) -> tuple[Observation, list[str]]:
    """The observation that `make` returns, and the names of its options: the keywords of `make`."""
    keywords = _keywords(make)
    space = {"state_space": state_space} if "state_space" in inspect.signature(make).parameters else {}
    return make(env, **space, **{name: value for name, value in options.items() if name in keywords}), keywords


def _keywords(make: Callable[..., Observation]) -> list[str]:
    parameters = inspect.signature(make).parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]


def check_options(observation: object, options: Iterable[str]) -> None:
    """UnknownName unless the observation has options of these names. Whether an environment has it is not asked."""
    _check_known(str(observation), options, _keywords(_maker(observation)))


def _check_known(name: str, options: Iterable[str], keywords: list[str]) -> None:
    for option in options:
        if option not in keywords:
            raise UnknownName(f"option of observation {name!r}", option, keywords)


def _maker(observation: object) -> Callable[..., Observation]:
    """Function (env, **options) -> Observation, of a name or a pair (function, Gymnasium space)."""
    if _is_pair(observation):
        return partial(_of_function, None, *observation)
    if (own := own_observation(observation)) is not None:
        return own.make
    if not isinstance(observation, str):
        raise ParameterError(
            f"observation is {observation!r}; expected one of {', '.join(names())}, or a pair (function, Gymnasium "
            "space)"
        )
    if observation not in _BUILT_IN:
        raise UnknownName("observation", observation, names())
    file, _, class_name = _BUILT_IN[observation].partition(":")
    return getattr(importlib.import_module(f"pharos.observations.{file}"), class_name)


def _is_pair(value: object) -> TypeGuard[tuple[Function, object]]:
    return isinstance(value, tuple) and len(value) == 2 and callable(value[0])


# Custom ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class OwnObservation:
    """An observation of the user's own for any environment. `observe` takes it in the place of a name.

    Attributes:
        name: under which results speak of it.
        make: (env, **options) -> Observation.
        source: its origin. None if no other process can import it.
    """

    name: str
    make: Callable[..., Observation]
    source: Source | None

    def __str__(self) -> str:
        return self.name


def imported(path: str, folder: str | Path | None = None) -> OwnObservation:
    """Import an observation from "module:name" or "file.py:name".

    Args:
        folder: relative files and modules are looked for there first. Default: the current directory.
    Raises:
        ParameterError: no such module, file or name, or it is no observation.
    """
    source = sources.find_source(path, folder)
    return _observation(source, sources.load_source(source))


def observation_of(source: Source, *, trust: bool = False, strict: bool = False) -> OwnObservation:
    """The observation that a stored configuration names.

    Args:
        trust, strict: as for `pharos.system.sources.resolve`.
    Raises:
        UntrustedCode: it was not imported before, and is not trusted. ParameterError: it cannot be imported.
    """
    return _observation(source, sources.resolve(source, trust=trust, strict=strict))


def own_observation(observation: object, folder: str | Path | None = None) -> OwnObservation | None:
    """The user's own observation of this name, imported or registered before, or None for all others."""
    if isinstance(observation, OwnObservation):
        return observation
    if sources.is_reference(observation):
        return imported(observation, folder)
    if isinstance(observation, str) and (entry := registered(observation)) is not None:
        source = sources.source_of(entry[0], observation)
        return OwnObservation(observation, partial(_of_function, observation, *entry), source)
    return None


def _observation(source: Source, value: object) -> OwnObservation:
    name = source.attribute
    if name in _BUILT_IN:
        raise ParameterError(f"{source.name!r}: {name!r} is the name of a built-in observation; choose another name")
    if isinstance(value, type) and issubclass(value, Observation):
        return OwnObservation(name, value, source)
    entry = value if _is_pair(value) else registered(name)
    if entry is None:
        raise ParameterError(
            f"{source.name!r}: found {value!r}; expected the name of a pair (function, Gymnasium space), of a subclass "
            f"of Observation, or of what the file registers with pharos.observations.register"
        )
    return OwnObservation(name, partial(_of_function, name, *entry), source)


def _of_function(name: str | None, function: Function, space: object, env: Environment) -> Observation:
    return FunctionObservation(env, function, space, name=name)


def hidden_names(
    hide: str | Sequence[str], what: str, choices: Collection[str], also: Collection[str] = (), option: str = "hide"
) -> set[str]:
    """The names that `hide` has, a sequence or a text with commas.

    Args:
        what: whose they are, such as "vector of breakout".
        choices: what can be hidden, as a message lists it. also: further names.
        option: in whose value they stand.
    Raises:
        ParameterError: one of them cannot be hidden, or they are no names. The message says what can.
    """
    names = [name.strip() for name in hide.split(",") if name.strip()] if isinstance(hide, str) else hide
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise ParameterError(f"{what}: {option} is {hide!r}; expected names, some of {', '.join(choices)}")
    for name in names:
        if name not in choices and name not in also:
            raise ParameterError(f"{what}: there is no {name!r} to hide; expected some of {', '.join(choices)}")
    return set(names)
