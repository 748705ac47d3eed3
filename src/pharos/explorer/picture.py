"""The drawing of a state for a page: what is in which cell, and once for all how each thing looks.

A page composes the drawing itself, so a state costs some numbers, not a picture. It looks as `drawing.human` draws it.
"""

import base64
import io
from typing import Any

import numpy as np

from pharos.drawing import NIGHT, ground_of, image, planes_of, tile
from pharos.environments import Environment, Layer, State

CELLS = (8, 16, 24, 32, 48, 64)  # pixels of a cell
LONGEST = 720  # pixels of the longer side of a drawing, where cells are not smaller than CELLS[0] for it


class Pictures:
    """Draws the states of an environment; where that is not possible, `fault` says why, in one line.

    Attributes:
        kit: what all drawings are composed of, for the page; None where the states cannot be drawn.
        fault: why they cannot; "" where they can.
    """

    def __init__(self, env: Environment | None, start: State | None):
        self.env, self.kit, self.fault = env, None, ""
        if env is None or start is None:
            self.fault = "There is no drawing: the MDP came without an environment."
            return
        try:
            self.kit = kit_of(env) if env.picture(start) is None else {}
            if not self.kit:
                return
            planes_of(env, start)
        except Exception as error:  # whatever a class of one's own does when it is to be drawn
            self.kit, self.fault = None, f"There is no drawing: {' '.join(str(error).split()) or type(error).__name__}"

    def of(self, state: State) -> dict[str, Any]:
        """`cells`, a list of (layer, row, column, value); or `picture`, the URL of one that the class has of its own;
        or `fault`."""
        if self.env is None or self.kit is None:
            return {"fault": self.fault}
        try:
            if (own := self.env.picture(state)) is not None:
                return {"picture": url_of(own)}
            planes = planes_of(self.env, state)
            layers, rows, columns = np.nonzero(planes)
            return {"cells": np.stack([layers, rows, columns, planes[layers, rows, columns]], axis=1).tolist()}
        except Exception as error:  # as above
            return {"fault": f"This state cannot be drawn: {' '.join(str(error).split()) or type(error).__name__}"}


def kit_of(env: Environment) -> dict[str, Any]:
    """What the drawings of an environment are composed of.

    Returns:
        `rows`, `columns`, `cell` (pixels) and `margin` (pixels) of the drawing; `ground`, the URL of what lies below
        all things; `tiles`, of each layer the URLs of what its values 1, 2, ... look like, the last for higher ones;
        `layers`, their names.
    """
    rows, columns = env.grid()
    fits = [cell for cell in CELLS if (max(rows, columns) + 1) * cell <= LONGEST]
    cell = fits[-1] if fits else CELLS[0]
    margin = cell // 2
    canvas = np.empty((rows * cell + 2 * margin, columns * cell + 2 * margin, 3), np.float64)
    canvas[:] = NIGHT
    ground_of(env.look.ground)(canvas, (cell, cell), (margin,) * 4)
    tiles = [
        [url_of(tile(name, layer, value + 1, cell) * (1, 1, 1, 255)) for value in range(num_kinds(layer))]
        for name, layer in env.layers.items()
    ]
    return {
        "rows": rows,
        "columns": columns,
        "cell": cell,
        "margin": margin,
        "ground": url_of(canvas),
        "tiles": tiles,
        "layers": list(env.layers),
    }


def num_kinds(layer: Layer) -> int:
    """How many values of a layer look different; higher ones look like the last."""
    colors = len(layer.color) if np.ndim(layer.color) == 2 else 1
    sprites = len(layer.sprite) if layer.sprite is not None and not isinstance(layer.sprite[0], str) else 1
    return max(len(layer.glyph), colors, sprites)


def url_of(picture: np.ndarray) -> str:
    """A picture (H, W, 3 or 4), 0 to 255, as the URL of a PNG that holds it."""
    written = io.BytesIO()
    image(np.rint(picture).astype(np.uint8)).save(written, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(written.getvalue()).decode()
