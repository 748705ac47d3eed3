"""How a class of environments looks: the layers of things, the ground below them, and the screen of complex images.

These are declarations; `pharos.drawing` paints from them. Wherever a name of a ground or a shape is expected, a
function of one's own may stand.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

Color = tuple[int, int, int]
"""(red, green, blue), 0 to 255."""

Rows = tuple[str, ...]
Sprite = Rows | tuple[Rows, ...] | None

Margin = tuple[int, int, int, int]
"""Pixels around the cells: (top, right, bottom, left)."""

Ground = Callable[[np.ndarray, tuple[int, int], Margin], None]
"""Function(picture (H, W, 3) float64, (height, width) of a cell, margin) that paints what lies below all layers."""

Shape = Callable[[np.ndarray, int, str], np.ndarray]
"""Function(color (3,) float64, pixels of a cell, glyph) -> (cell, cell, 4): red, green, blue, cover in [0, 1]."""


@dataclass(frozen=True)
class Layer:
    """How one kind of thing looks. `draw` puts it on its plane; every picture is made from the planes.

    Attributes:
        glyph: one character for text drawings; several, one for each value 1, 2, ... on the plane.
        color: (red, green, blue), 0 to 255; or several, one for each value on the plane.
        sprite: rows of text, '#' where the sprite has the colour and '.' where the ground shows through; digits 1-9
            pick shades from light to dark; several sprites, one for each value on the plane. None draws a full cell.
        shape: how pictures for people draw it, in place of the sprite: a name in `pharos.drawing.SHAPES`, or a function
            (see `Shape`). None: the sprite, or else the shape that is called like the layer ("ball", "agent", "holes",
            "goal", "paddle"), or else a block.
    """

    glyph: str | tuple[str, ...]
    color: Color | tuple[Color, ...]
    sprite: Sprite = None
    shape: str | Shape | None = None


@dataclass(frozen=True)
class Scenery:
    """How complex images of a class look, in pixels of their natural size.

    Attributes:
        cell: (height, width) of a cell.
        margin: (top, right, bottom, left) around the cells.
        ground: a name in `pharos.drawing.GROUNDS`, or a function (see `Ground`).
        sprites: name of a layer -> sprite in place of its own (see `Layer`), or None: the layer is not drawn.
        row_colors: name of a layer -> colours of rows 0, 1, ... of the grid, again from the first after the last.
    """

    cell: tuple[int, int]
    margin: Margin
    ground: str | Ground
    sprites: Mapping[str, Sprite] = field(default_factory=dict)
    row_colors: Mapping[str, tuple[Color, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Look:
    """How a class of environments looks beside its layers.

    Attributes:
        ground: of pictures for people: a name in `pharos.drawing.GROUNDS`, or a function (see `Ground`).
        scenery: of complex images; None: square cells on `ground`, with the sprites and shapes of the layers.
        color: of the class in plots, such as "#0072B2"; None: one that no other class has.
    """

    ground: str | Ground = "plain"
    scenery: Scenery | None = None
    color: str | None = None
