"""Actions of an environment as a list, and its observations as images or vectors, by its spaces."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.importers.folder import IMAGE_OBSERVATION, VECTOR_OBSERVATION
from pharos.importers.wrappers import Stepped, as_integer
from pharos.system.wording import capped

MOST_NAMED = 1_024
"""Values of a discrete observation that are shown as a vector of zeros and a one; more are shown as a number."""
PLAIN_ACTIONS = 4_096


def listed_actions_of(
    env: Stepped, actions: tuple[Any, ...] | None, name: str
) -> tuple[tuple[Any, ...], tuple[str, ...] | None]:
    """(what `step` takes, names of the actions or None)."""
    if actions is not None:
        if not actions:
            raise ParameterError(f"{name}: actions are empty; expected one or more")
        return actions, None
    space = getattr(env, "action_space", None)
    listed = _listed_actions(space)
    if listed is None:
        from pharos.importers.jax_stepping import JaxFunctions

        if isinstance(env, JaxFunctions):
            raise ParameterError(
                f"{name}: functions of JAX; expected jax: before what makes them, as in jax:file.py:make"
            )
        raise ParameterError(
            f"{name}: its actions are {capped(space)}; expected a discrete space or a product of such, or actions=, a "
            f"list of what step takes"
        )
    return listed, _action_names(getattr(env, "unwrapped", env), listed)


def _listed_actions(space: Any) -> tuple[Any, ...] | None:
    """All actions of a space; None if they are not finitely many, or no product of numbers."""
    kind = type(space).__name__
    if kind == "Discrete":
        start = int(getattr(space, "start", 0))
        return tuple(range(start, start + int(space.n)))
    if kind in ("MultiDiscrete", "MultiBinary"):
        sizes = np.ravel(space.nvec) if kind == "MultiDiscrete" else np.full(space.shape, 2).ravel()
        starts = np.ravel(getattr(space, "start", np.zeros(len(sizes), int)))
        if np.prod(sizes.astype(float)) > PLAIN_ACTIONS:
            return None
        ranges = [range(int(low), int(low) + int(n)) for low, n in zip(starts, sizes, strict=True)]
        return tuple(np.array(each, space.dtype).reshape(space.shape) for each in itertools.product(*ranges))
    if kind == "Tuple":
        parts = [_listed_actions(each) for each in space.spaces]
        whole = [each for each in parts if each is not None]
        return tuple(itertools.product(*whole)) if len(whole) == len(parts) else None
    return None


def _action_names(env: Stepped, actions: tuple[Any, ...]) -> tuple[str, ...] | None:
    """Names that an environment gives to its actions; None if it gives none."""
    names: list[str] = []
    if hasattr(env, "get_action_meanings"):
        names = [str(each) for each in env.get_action_meanings()]
    elif hasattr(getattr(env, "actions", None), "__members__"):
        names = list(env.actions.__members__)
    is_fitting = len(names) == len(actions) and len(set(names)) == len(names) and all(names)
    if not is_fitting and actions and isinstance(actions[0], np.ndarray | tuple):
        return tuple(",".join(map(str, np.ravel(action))) for action in actions)
    return tuple(names) if is_fitting else None


class SpaceRecorder:
    """Observations of an environment as images or vectors.

    Attributes:
        notes: lines on what is not recorded.
    """

    def __init__(self, space: Any, name: str):
        self.notes: list[str] = []
        self._parts: list[str] | None = None
        self._space = space
        shape, dtype = getattr(space, "shape", None), getattr(space, "dtype", None)
        self._is_image = type(space).__name__ == "Box" and dtype == np.uint8 and shape is not None and shape[2:] == (3,)
        self._is_shown = self._is_image or self._can_flatten(space)
        if not self._is_shown and type(space).__name__ == "Dict":
            from gymnasium.spaces import Dict

            parts = {part: each for part, each in space.spaces.items() if self._can_flatten(each)}
            others = sorted(set(space.spaces) - set(parts))
            self._parts, self._space, self._is_shown = list(parts), Dict(parts), bool(parts)
            self.notes.append(f"{name}: of its observation, {', '.join(others)} cannot be flattened, and is left out")
        elif not self._is_shown:
            self.notes.append(f"{name}: its observations, {capped(space, 80)}, cannot be flattened; none are recorded")

    @staticmethod
    def _can_flatten(space: object) -> bool:
        from gymnasium import spaces

        try:
            return isinstance(space, spaces.Space) and space.is_np_flattenable and spaces.flatdim(space) > 0
        except (NotImplementedError, ValueError):
            return False

    def shown(self, observation: Any) -> np.ndarray | None:
        """An observation as an array; None if none are recorded."""
        if not self._is_shown:
            return None
        if self._is_image:
            return np.array(observation, np.uint8)
        if self._parts is not None:
            observation = {part: observation[part] for part in self._parts}
        if type(self._space).__name__ == "Discrete" and self._space.n > MOST_NAMED:
            return np.array([as_integer(observation)])
        from gymnasium.spaces import flatten

        return np.asarray(flatten(self._space, observation)).ravel()

    def stacked(self, observations: Sequence[np.ndarray | None]) -> tuple[np.ndarray | None, str | None]:
        """(the observations of all states, their kind)."""
        rows = [row for row in observations if row is not None]
        if not self._is_shown or len(rows) < len(observations):
            return None, None
        array = np.stack(rows)
        if array.dtype.kind in "iu" and array.size and array.min() >= 0 and array.max() <= 255:
            array = array.astype(np.uint8)
        return array, IMAGE_OBSERVATION if self._is_image else VECTOR_OBSERVATION
