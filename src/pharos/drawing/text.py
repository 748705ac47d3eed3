"""Environments drawn as text: one glyph a cell, later layers cover earlier ones.

Planes: what an environment says is where, one plane of cells for each layer.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pharos.drawing.shapes import color_of, glyph_of
from pharos.environments import Environment
from pharos.errors import ParameterError

if TYPE_CHECKING:
    from rich.text import Text

GROUND = "."


def text_drawing(env: Environment, state: Sequence[int]) -> str:
    """Return `state` drawn as text: a line for each row of `env.grid()`, a glyph for each cell.

    Args:
        state: D integers.
    Raises:
        ParameterError: the class declares no `grid` or `draw`, or `state` is none of its states.
    """
    planes = planes_of(env, state)
    picture = np.full(planes.shape[1:], GROUND)
    for plane, layer in zip(planes, env.layers.values(), strict=True):
        for value, glyph in enumerate(layer.glyph, start=1):
            picture[plane == value] = glyph
    return "\n".join("".join(row) for row in picture)


def colored_text(env: Environment, state: Sequence[int]) -> "Text":
    """Return `state` as Rich text for a terminal: two columns for each cell, in the colours of the layers."""
    from rich.text import Text

    drawn = Text()
    planes = planes_of(env, state)
    layers = list(env.layers.values())
    for row in range(planes.shape[1]):
        for column in range(planes.shape[2]):
            here = np.flatnonzero(planes[:, row, column])
            if not here.size:
                drawn.append(" .", style="bright_black")
                continue
            layer, value = layers[here[-1]], int(planes[here[-1], row, column])
            red, green, blue = color_of(layer, value)
            drawn.append(f" {glyph_of(layer, value)}", style=f"bold rgb({red},{green},{blue})")
        drawn.append("\n")
    drawn.rstrip()
    return drawn


# Planes ---------------------------------------------------------------------------------------------------------------


def planes_of(env: Environment, state: Sequence[int]) -> np.ndarray:
    """(L, rows, columns) uint8: for each layer, 0 where nothing is, 1, 2, ... where its things are.

    Raises:
        ParameterError: the class declares no `grid` or `draw`, or `state` is none of its states.
    """
    check_state(env, state)
    try:
        rows, columns = env.grid()
        planes = np.zeros((len(env.layers), rows, columns), np.uint8)
        env.draw(tuple(int(value) for value in state), planes)
    except NotImplementedError as error:
        raise ParameterError(f"{env}: cannot be drawn: {error}") from error
    return planes


def check_state(env: Environment, state: Sequence[int]) -> None:
    """ParameterError unless `state` has D components, each in its declared range."""
    components = env.components
    if len(state) != len(components):
        raise ParameterError(f"{env}: found a state with {len(state)} components; expected {len(components)}")
    for name, value, low, high in zip(components.names, state, components.low, components.high, strict=True):
        if not low <= value <= high:
            raise ParameterError(f"{env}: state has {name} = {value}; expected {low} to {high}")
