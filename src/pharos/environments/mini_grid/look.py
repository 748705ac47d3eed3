"""Appearance of MiniGrid: colours, shapes of walls, lava, doors, things and the player, in the spirit of the package.

Shapes are functions of (colour, pixels of a cell, glyph), see `look.Shape`. x goes right and y down, from 0 to 1.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from pharos.environments.base import Layer, Look

Mask = Callable[[np.ndarray, np.ndarray], np.ndarray]

# In the order of `mini_grid_layouts.COLORS`: blue, green, grey, purple, red, yellow
GRID_COLORS = ((72, 104, 240), (64, 190, 84), (150, 152, 160), (164, 92, 224), (228, 70, 66), (240, 208, 62))
SAMPLES = 4  # on each side of a pixel
DARK = (24, 26, 33)


def box(x0: float, x1: float, y0: float, y1: float) -> Mask:
    """A rectangle."""
    return lambda x, y: (x >= x0) & (x < x1) & (y >= y0) & (y < y1)


def disc(x0: float, y0: float, radius: float) -> Mask:
    """A filled circle."""
    return lambda x, y: np.hypot(x - x0, y - y0) < radius


def painted(cell: int, *parts: tuple[Mask, Any], turns: int = 0) -> np.ndarray:
    """(cell, cell, 4): the parts over one another, smooth at their edges, turned clockwise by quarters."""
    centre = (np.arange(SAMPLES * cell) + 0.5) / (SAMPLES * cell)
    y, x = np.meshgrid(centre, centre, indexing="ij")
    canvas = np.zeros((*x.shape, 4))
    for mask, color in parts:
        canvas[mask(x, y)] = (*color, 1.0)
    canvas = np.rot90(canvas, -turns).reshape(cell, SAMPLES, cell, SAMPLES, 4)
    cover = canvas[..., 3].mean(axis=(1, 3))
    body = canvas[..., :3].sum(axis=(1, 3)) / np.maximum(cover[..., None] * SAMPLES**2, 1e-9)
    return np.concatenate((body, cover[..., None]), axis=2)


def wall(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """Bricks in two courses."""
    mortar = color * 0.72
    parts = [(box(0, 1, y, y + 0.05), mortar) for y in (0.0, 0.5)]
    parts += [(box(x, x + 0.05, y, y + 0.5), mortar) for x, y in ((0.0, 0.0), (0.5, 0.5))]
    return painted(cell, (box(0, 1, 0, 1), color), *parts)


def lava(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """Three dark waves."""

    def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return abs((3 * y + 0.18 * np.sin(4 * np.pi * x)) % 1 - 0.5) < 0.12

    return painted(cell, (box(0, 1, 0, 1), color), (waves, color * 0.45))


def goal(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A square with a lighter one in it."""
    return painted(cell, (box(0, 1, 0, 1), color * 0.8), (box(0.12, 0.88, 0.12, 0.88), color))


def door(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A door: open at the side of the cell, closed with a handle, or locked with a keyhole in a darker leaf."""
    if glyph == "_":
        return painted(cell, (box(0.84, 1, 0, 1), color), (box(0.9, 0.94, 0.06, 0.94), DARK))
    leaf = (box(0, 1, 0, 1), color), (box(0.08, 0.92, 0.08, 0.92), DARK), (box(0.13, 0.87, 0.13, 0.87), color * 0.8)
    if glyph == "D":
        return painted(cell, *leaf, (disc(0.72, 0.5, 0.09), color + (255 - color) * 0.6))
    hole = (disc(0.5, 0.43, 0.1), color), (box(0.46, 0.54, 0.43, 0.68), color)
    return painted(cell, *leaf[:2], (box(0.13, 0.87, 0.13, 0.87), color * 0.42), *hole)


def thing(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """A key, a ball or a box."""
    if glyph == "K":
        teeth = [(box(0.3, 0.5, y, y + 0.09), color) for y in (0.58, 0.78)]
        return painted(cell, (disc(0.5, 0.28, 0.19), color), (disc(0.5, 0.28, 0.08), DARK), *teeth, (KEY_SHAFT, color))
    if glyph == "A":
        return painted(cell, (disc(0.5, 0.5, 0.32), color * 0.75), (disc(0.48, 0.47, 0.27), color))
    ribbon = (box(0.14, 0.86, 0.44, 0.56), color * 0.6)
    return painted(cell, (box(0.14, 0.86, 0.14, 0.86), color), (box(0.22, 0.78, 0.22, 0.78), color * 0.35), ribbon)


KEY_SHAFT = box(0.45, 0.56, 0.44, 0.9)


def player(color: np.ndarray, cell: int, glyph: str) -> np.ndarray:
    """An arrowhead with a pale rim that points where the player looks. What is carried shows behind it."""

    def arrow(rim: float) -> Mask:
        return lambda x, y: (
            (abs(y - 0.5) < (0.5 - rim) * (0.94 - 1.6 * rim - x) / 0.84) & (x > 0.08 + rim + (0.42 - abs(y - 0.5)) / 2)
        )

    return painted(cell, (arrow(0.05), (250, 226, 222)), (arrow(0.1), color), turns=">v<^".index(glyph))


LAYERS = {
    "goal": Layer("G", (74, 200, 96), shape=goal),
    "lava": Layer("~", (240, 122, 36), shape=lava),
    "walls": Layer("#", (112, 116, 126), shape=wall),
    "doors": Layer(tuple("_DL" * len(GRID_COLORS)), tuple(c for c in GRID_COLORS for _ in range(3)), shape=door),
    "things": Layer(tuple("KAB" * len(GRID_COLORS)), tuple(c for c in GRID_COLORS for _ in range(3)), shape=thing),
    "player": Layer(tuple(">v<^"), (236, 64, 60), shape=player),
}
LOOK = Look(ground="plain", color="#882255")
