"""Environments drawn as text: one glyph a cell, later layers cover earlier ones."""

from collections.abc import Sequence

import numpy as np

from pharos.environments import Environment

GROUND = "."


def text_drawing(env: Environment, state: Sequence[int]) -> str:
    """Return `state` drawn as text: a line for each row of `env.grid()`, a glyph for each cell.

    Args:
        state: D integers.
    Raises:
        NotImplementedError: the class declares no `grid` or `draw`.
    """
    rows, columns = env.grid()
    planes = np.zeros((len(env.layers), rows, columns), np.uint8)
    env.draw(tuple(state), planes)
    picture = np.full((rows, columns), GROUND)
    for plane, layer in zip(planes, env.layers.values(), strict=True):
        for value, glyph in enumerate(layer.glyph, start=1):
            picture[plane == value] = glyph
    return "\n".join("".join(row) for row in picture)
