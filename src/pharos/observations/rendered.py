"""Pictures of states as observations show them, beside those for people."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from pharos.drawing import check_state, human
from pharos.environments import Environment
from pharos.errors import ParameterError, UnknownName
from pharos.observations.observation import names, observe

Renderer = Callable[[Environment, Sequence[int]], np.ndarray]

RENDERERS: dict[str, Renderer] = {"human": human}
"""Name of an observation -> function (environment, state) -> (H, W, 3) or (H, W) uint8. Packages add theirs."""


def render(env: Environment, state: Sequence[int], observation: str = "human", **options: object) -> np.ndarray:
    """Return the picture of `state` under an observation, (H, W, 3) uint8.

    Args:
        observation: "human", another of RENDERERS, or an observation whose values are images; planes stand side by
            side.
        options: of the observation, such as `size="natural"` of "complex_image".
    Raises:
        UnknownName: no observation or option of this name. ParameterError: `state` is none of the environment's, or
            cannot be drawn; the observation is no image.
    """
    if observation in RENDERERS:
        if options:
            raise ParameterError(f"{observation!r} takes no options; found {', '.join(options)}")
        picture = RENDERERS[observation](env, state)
    else:
        check_state(env, state)
        observe = _observer(env, observation, tuple(sorted(options.items())))
        picture = _side_by_side(observe(np.array([state], np.int64))[0], observation)
    return np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture


def renderers() -> list[str]:
    """The names that `render` knows; of the observations, those that may be images."""
    return [*RENDERERS, *(name for name in names() if name not in ("vector", "one_hot", "index", "hash", "mixed"))]


@cache
def _observer(env: Environment, name: str, options: tuple[tuple[str, Any], ...]) -> Any:
    if name not in names():
        raise UnknownName("observation to render", name, [*renderers(), "text"])
    return observe(env, name, **dict(options))


def _side_by_side(values: np.ndarray, name: str) -> np.ndarray:
    """An image (H, W, 3), (H, W, 1) or (H, W) as it is; planes (L, H, W) beside each other with a line between them.

    There are never more planes than columns (see `SimpleImage`), so a board of three columns is not taken for colours.
    """
    if values.dtype != np.uint8 or values.ndim not in (2, 3):
        raise ParameterError(
            f"observation {name!r} is no image: shape {values.shape}, type {values.dtype}; "
            f"expected one of {', '.join(renderers())}"
        )
    if values.ndim == 2:
        return values
    if values.shape[2] in (1, 3) and values.shape[0] > values.shape[2]:
        return values if values.shape[2] == 3 else values[..., 0]
    line = np.full((values.shape[1], 1), 64, np.uint8)
    parts = [part for plane in values for part in (line, plane)][1:]
    return np.concatenate(parts, axis=1)
