"""Sceneries: the ground, the proportions and the sprites of a class of environments in complex images.

A class without one is drawn like pictures for people: square cells on its ground, sprites and shapes of its layers.
The look of Freeway and Breakout follows the Atari 2600 games (colours of its palette, wide pixels).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from pharos.environments import Environment

Rows = tuple[str, ...]
Sprite = Rows | tuple[Rows, ...] | None


@dataclass(frozen=True)
class Scenery:
    """How complex images of one environment look, in pixels of its natural size.

    Attributes:
        cell: (height, width) of a cell.
        margin: (top, right, bottom, left) around the cells.
        ground: function(picture (H, W, 3) float64, cell, margin) that paints what lies below all layers.
        sprites: name of a layer -> sprite in place of its own (see Layer.sprite), or None: the layer is not drawn.
        row_colors: name of a layer -> colours of rows 0, 1, ... of the grid, again from the first after the last.
    """

    cell: tuple[int, int]
    margin: tuple[int, int, int, int]
    ground: Callable[[np.ndarray, "Scenery"], None]
    sprites: Mapping[str, Sprite] = field(default_factory=dict)
    row_colors: Mapping[str, tuple[tuple[int, int, int], ...]] = field(default_factory=dict)


def scenery_of(env: Environment) -> Scenery:
    """The scenery of `env`."""
    make = SCENERIES.get(env.name, _plain)
    return make(env)


def _plain(env: Environment) -> Scenery:
    """Square cells on the ground that pictures for people have."""
    from pharos.drawing.pictures import GROUNDS, _plain_ground

    paint = GROUNDS.get(env.name, _plain_ground)

    def ground(picture: np.ndarray, scenery: Scenery) -> None:
        paint(picture, picture, scenery.cell[0])

    return Scenery(cell=(16, 16), margin=(0, 0, 0, 0), ground=ground)


# Freeway -----------------------------------------------------------------------------------------------------------------

ASPHALT, SIDEWALK, CURB, WHITE, YELLOW = (142, 142, 142), (170, 170, 170), (96, 96, 96), (214, 214, 214), (210, 210, 64)

CAR_RIGHT = (
    "....................",
    "...9999.....9999....",
    "...9999.....9999....",
    ".###############....",
    ".#################..",
    ".####3333####9######",
    "3####3333####9######",
    "3####3333####9######",
    ".####3333####9######",
    ".#################..",
    ".###############....",
    "...9999.....9999....",
)
CAR_LEFT = tuple(row[::-1] for row in CAR_RIGHT)
CHICKEN = (
    ".........####.......",
    ".........######.....",
    ".........##88##77...",
    "..##.....######.....",
    "..####...####.......",
    "..############......",
    "....############....",
    "....############....",
    "......########......",
    "........####........",
    "........7..7........",
    "......777.777.......",
)


def _freeway(env: Environment) -> Scenery:
    colors = len(env.layers["cars"].color) // 2
    cars = (CAR_RIGHT,) * colors + (CAR_LEFT,) * colors

    def ground(picture: np.ndarray, scenery: Scenery) -> None:
        """Grey asphalt with dashed lines between the lanes, a double line in the middle, and pavements with kerbs."""
        height = scenery.cell[0]
        picture[:] = ASPHALT
        lanes = len(picture) // height - 2
        dashes = np.arange(picture.shape[1]) % 20 < 10
        for lane in range(1, lanes):
            y = (1 + lane) * height
            if lanes >= 4 and lane == lanes // 2:
                picture[y - 2 : y - 1] = picture[y : y + 1] = YELLOW
            else:
                picture[y - 1 : y, dashes] = WHITE
        for pavement, kerb in ((slice(0, height), height - 2), (slice(-height, None), -height)):
            picture[pavement] = SIDEWALK
            picture[kerb : kerb + 2] = CURB

    return Scenery(
        cell=(12, 20), margin=(0, 0, 0, 0), ground=ground, sprites={"kerb": None, "cars": cars, "player": CHICKEN}
    )


# Breakout ----------------------------------------------------------------------------------------------------------------

WALL = (142, 142, 142)
ROWS = (
    (66, 72, 200),
    (200, 72, 72),
    (198, 108, 58),
    (180, 122, 48),
    (162, 162, 42),
    (72, 160, 72),
)  # bricks begin in row 1
BRICK = ("#" * 16,) * 11 + ("." * 16,)
PADDLE = ("." * 16,) * 2 + ("#" * 16,) * 5 + ("." * 16,) * 5
BALL = ("." * 16,) * 3 + ("." * 6 + "#" * 4 + "." * 6,) * 6 + ("." * 16,) * 3


def _breakout(env: Environment) -> Scenery:
    def ground(picture: np.ndarray, scenery: Scenery) -> None:
        """A black court inside grey walls, open at the bottom."""
        top, right, _, left = scenery.margin
        picture[:] = WALL
        picture[top:, left:-right] = 0

    return Scenery(
        cell=(12, 16),
        margin=(16, 8, 4, 8),
        ground=ground,
        sprites={"bricks": BRICK, "paddle": PADDLE, "ball": BALL},
        row_colors={"bricks": ROWS},
    )


SCENERIES: dict[str, Callable[[Environment], Scenery]] = {"freeway": _freeway, "breakout": _breakout}
"""Name of a class of environments -> function that makes the scenery of an instance."""
