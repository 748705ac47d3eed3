"""Shapes of things: tiles (cell, cell, 4) of red, green, blue in 0 to 255, and in [0, 1] how much they cover."""

from collections.abc import Sequence
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pharos.environments import Color, Layer, Shape
from pharos.errors import UnknownName

T = TypeVar("T")


@cache
def tile(name: str, layer: Layer, value: int, cell: int) -> np.ndarray:
    """(cell, cell, 4): how the thing number `value` of the layer called `name` looks in a cell of `cell` pixels.

    Raises:
        UnknownName: the layer names a shape that SHAPES does not have.
    """
    color = color_of(layer, value)
    if layer.sprite is not None and layer.shape is None:
        return sprite_tile(sprite_of(layer.sprite, value), color, cell)
    return shape_of(name, layer)(np.array(color, np.float64), cell, glyph_of(layer, value))


def shape_of(name: str, layer: Layer) -> Shape:
    """The function that draws a layer: its own, the one in SHAPES that it names, the one called like it, or a block."""
    if layer.shape is None:
        return SHAPES.get(name, block)
    if not isinstance(layer.shape, str):
        return layer.shape
    if layer.shape not in SHAPES:
        raise UnknownName("shape", layer.shape, SHAPES)
    return SHAPES[layer.shape]


def color_of(layer: Layer, value: int) -> Color:
    """The colour of value 1, 2, ... of a layer. For a higher value than it has colours, the last."""
    colors: Any = layer.color
    return _of_value(colors, value) if np.ndim(colors) == 2 else colors


def glyph_of(layer: Layer, value: int) -> str:
    """The character of value 1, 2, ... of a layer."""
    return _of_value(layer.glyph, value)


def sprite_of(sprite: Any, value: int) -> Sequence[str]:
    """The rows of text of value 1, 2, ... of a sprite."""
    return sprite if isinstance(sprite[0], str) else _of_value(sprite, value)


def _of_value(several: Sequence[T], value: int) -> T:
    return several[min(value, len(several)) - 1]


def sprite_pixels(rows: Sequence[str], color: Color) -> np.ndarray:
    """(rows, columns, 4): a sprite of text, a pixel for each letter."""
    pixels = np.zeros((len(rows), max(map(len, rows)), 4))
    for y, row in enumerate(rows):
        for x, letter in enumerate(row):
            if letter not in ". ":
                pixels[y, x] = (*letter_color(color, letter), 1.0)
    return pixels


def sprite_tile(rows: Sequence[str], color: Color, cell: int) -> np.ndarray:
    """(cell, cell, 4): a sprite of text, enlarged without smoothing."""
    pixels = sprite_pixels(rows, color)
    ys, xs = (np.arange(cell) * n // cell for n in pixels.shape[:2])
    return pixels[ys[:, None], xs]


def letter_color(color: Color, letter: str) -> Color:
    """The colour of a letter of a sprite: '#' is `color`, '1' nearly white, '5' `color`, '9' nearly black."""
    if not letter.isdigit() or letter == "0":
        return color
    distance = (int(letter) - 5) / 5
    target = 255.0 if distance < 0 else 0.0
    red, green, blue = (round(part + (target - part) * abs(distance)) for part in color)
    return red, green, blue


def block(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A tile with a light upper and a dark lower edge and a hair of ground around it."""
    tile = np.empty((cell, cell, 4))
    tile[..., :3], tile[..., 3] = color, 1.0
    edge, gap = max(1, cell // 12), max(1, cell // 32)
    tile[: gap + edge, :, :3] = _mixed(color, 255, 0.28)
    tile[-gap - edge :, :, :3] = _mixed(color, 0, 0.28)
    for side in (np.s_[:gap], np.s_[-gap:], np.s_[:, :gap], np.s_[:, -gap:]):
        tile[side] = (*_mixed(color, 0, 0.55), 1.0)
    return tile


def _disc(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A ball with a highlight and a thin dark rim."""
    distance = _distance(cell, 0.5, 0.5)
    light = np.clip(1 - _distance(cell, 0.38, 0.34) / 0.5, 0, 1)[..., None]
    body = color + (255 - color) * 0.55 * light**2
    body = np.where((distance > 0.35)[..., None], _mixed(color, 0, 0.45), body)
    return np.concatenate((body, _cover(distance, 0.40, cell)[..., None]), axis=2)


def _pit(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A hole: dark water that is deeper in the middle, with a bright rim of broken ice."""
    distance = _distance(cell, 0.5, 0.5)
    deep = np.clip(1 - distance / 0.42, 0, 1)[..., None]
    water = np.array((38, 84, 128.0)) * (1 - 0.6 * deep)
    water = np.where((distance > 0.38)[..., None], (232, 243, 250), water)
    return np.concatenate((water, _cover(distance, 0.42, cell)[..., None]), axis=2)


def _flag(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A goal: a golden cell with a flag on it."""
    y, x = _grid(cell)
    tile = np.empty((cell, cell, 4))
    tile[..., :3], tile[..., 3] = (236, 190, 66), 1.0
    border = (np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y)) < 0.07)[..., None]
    tile[..., :3] = np.where(border, (196, 148, 40), tile[..., :3])
    pole = (abs(x - 0.32) < 0.035) & (y > 0.16) & (y < 0.86)
    cloth = (x > 0.34) & (x < 0.78 - 1.6 * abs(y - 0.34)) & (abs(y - 0.34) < 0.17)
    tile[pole, :3] = (70, 52, 30)
    tile[cloth, :3] = (196, 52, 44)
    return tile


def _mixed(color: np.ndarray, target: float, share: float) -> np.ndarray:
    return color + (target - color) * share


def _grid(cell: int) -> tuple[np.ndarray, np.ndarray]:
    centre = (np.arange(cell) + 0.5) / cell
    return np.meshgrid(centre, centre, indexing="ij")  # type: ignore[return-value]


def _distance(cell: int, x0: float, y0: float) -> np.ndarray:
    y, x = _grid(cell)
    return np.hypot(x - x0, y - y0)


def _cover(distance: np.ndarray, radius: float, cell: int) -> np.ndarray:
    """1 inside, 0 outside, smooth over one pixel."""
    return np.clip((radius - distance) * cell + 0.5, 0, 1)


def _bar(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A slab in the upper half of the cell. Neighbours join."""
    tile = np.zeros((cell, cell, 4))
    height, edge = max(3, cell * 7 // 16), max(1, cell // 12)
    tile[:height, :, :3], tile[:height, :, 3] = color, 1.0
    tile[:edge, :, :3] = _mixed(color, 255, 0.4)
    tile[height - edge : height, :, :3] = _mixed(color, 0, 0.35)
    return tile


def _car(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A car from above, with its lights on. It goes left if its glyph is "<"."""
    fine = 4
    y, x = _grid(fine * cell)
    if glyph == "<":
        x = 1 - x
    canvas = np.zeros((*x.shape, 4))

    def box(x0: float, x1: float, half: float, round_off: float, paint: ArrayLike) -> None:
        dx = np.maximum(np.maximum(x0 + round_off - x, x - x1 + round_off), 0)
        dy = np.maximum(abs(y - 0.5) - half + round_off, 0)
        canvas[np.hypot(dx, dy) <= round_off] = (*np.broadcast_to(paint, 3), 1.0)

    for start in (0.16, 0.66):  # wheels
        box(start, start + 0.18, 0.34, 0.03, 14.0)
    box(0.04, 0.96, 0.28, 0.10, _mixed(color, 0, 0.35))  # rim
    box(0.06, 0.94, 0.25, 0.09, color)
    box(0.22, 0.72, 0.21, 0.06, (34, 40, 52))  # windows
    box(0.31, 0.58, 0.19, 0.04, _mixed(color, 255, 0.22))  # roof
    for sign in (-1, 1):  # headlights, brake lights
        canvas[(x > 0.89) & (x < 0.95) & (abs(y - 0.5 - 0.16 * sign) < 0.05), :3] = (255, 246, 190)
        canvas[(x > 0.05) & (x < 0.09) & (abs(y - 0.5 - 0.17 * sign) < 0.05), :3] = (230, 30, 30)
    parts = canvas.reshape(cell, fine, cell, fine, 4)
    cover = parts[..., 3].mean(axis=(1, 3))
    body = (parts[..., :3] * parts[..., 3:]).sum(axis=(1, 3)) / np.maximum(cover[..., None] * fine**2, 1e-9)
    return np.concatenate((body, cover[..., None]), axis=2)


def _lettered(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A block with its glyph, a digit or a capital, in the middle."""
    return _written(color, cell, glyph)


def _power(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A block with a power of two, whose exponent in base 36 is the glyph. With the glyph if the cell is small."""
    number = str(2 ** int(glyph, 36))
    return _written(color, cell, number if 4 * len(number) < cell else glyph)


def _written(color: np.ndarray, cell: int, text: str) -> np.ndarray:
    tile = block(color, cell, text)
    if all(letter in FONT for letter in text):
        scale = max(1, cell // max(8, 4 * len(text) + 1))
        bits = [[[FONT[letter] >> (14 - 3 * y - x) & 1 for x in range(3)] for y in range(5)] for letter in text]
        letters = np.concatenate([np.pad(letter, ((0, 0), (0, 1))) for letter in bits], axis=1)[:, :-1].astype(bool)
        letters = letters.repeat(scale, axis=0).repeat(scale, axis=1)[:cell, :cell]
        top, left = ((cell - size) // 2 for size in letters.shape)
        part = tile[top : top + letters.shape[0], left : left + letters.shape[1]]
        part[letters, :3] = 24.0 if color.mean() > 110 else 240.0
    return tile


# Letters of 3 x 5 pixels, from the top left: an octal digit for each row
FONT = {
    **{"0": 0o75557, "1": 0o26227, "2": 0o71747, "3": 0o71717, "4": 0o55711, "5": 0o74717, "6": 0o74757, "7": 0o71122},
    **{"8": 0o75757, "9": 0o75717, "A": 0o25755, "B": 0o65656, "C": 0o34443, "D": 0o65556, "E": 0o74647, "F": 0o74644},
    **{"G": 0o34553, "H": 0o55755, "I": 0o72227, "J": 0o11152, "K": 0o55655, "L": 0o44447, "M": 0o57755, "N": 0o57775},
    **{"O": 0o25552, "P": 0o65644, "Q": 0o25563, "R": 0o65655, "S": 0o34216, "T": 0o72222, "U": 0o55557, "V": 0o55552},
    **{"W": 0o55775, "X": 0o55255, "Y": 0o55222, "Z": 0o71247},
}

SHAPES: dict[str, Shape] = {
    "block": block,
    "ball": _disc,
    "agent": _disc,
    "holes": _pit,
    "goal": _flag,
    "paddle": _bar,
    "car": _car,
    "lettered": _lettered,
    "power": _power,
}
"""Name of a shape, and of layers that look like it by default -> function (colour, pixels, glyph) -> tile."""
