"""Complex images: sprites on a ground, like the screen of an Atari game."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pharos.drawing import color_of, glyph_of, ground_of, scenery_of, shape_of, sprite_of, sprite_pixels
from pharos.environments import Environment, Layer, Scenery
from pharos.errors import ParameterError
from pharos.observations.drawn import Drawing, Frames, num_values
from pharos.observations.hiding import hidden_names

LARGEST = 1024  # pixels on a side
LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601, as in Pillow and OpenCV


class ComplexImage(Frames):
    """A colour picture (height, width, 3) uint8 of all layers, with sprites.

    The picture is composed at the size asked for: ground and sprites are scaled once, by averaging areas, to whole
    pixels of each cell, so that a frame costs a few microseconds. Shows what `draw` declares, as simple images do.

    Args:
        size: (height, width) in pixels, (84, 84) as agents of Atari games see; or "natural", as large as the sprites
            are.
        grey: one channel of luminance instead of three of colour.
        channels_first: (C, height, width).
        motion: the M motion layers are laid over the others, as in simple images.
        frames: k, the last k pictures of the episode, the oldest first, along the channels. See `Frames`.
        hide: names of layers that the agent does not see.
    Raises:
        ParameterError: the environment cannot be drawn, or the size is too small for a pixel a cell.
    """

    def __init__(
        self,
        env: Environment,
        *,
        size: object = (84, 84),
        grey: bool = False,
        channels_first: bool = False,
        motion: bool = False,
        frames: int = 1,
        hide: str | Sequence[str] = (),
    ):
        from gymnasium.spaces import Box

        self.name = "complex_image"
        self.env = env
        self._drawing = Drawing(env, "draw_complex", _compose, block=64, motion=motion)
        self._channels_first = bool(channels_first)
        scenery = scenery_of(env)
        natural = _natural_size(scenery, self._drawing.rows, self._drawing.columns)
        height, width = self._checked_size(natural if size == "natural" else size)
        top = _edges(scenery.margin[0], scenery.cell[0], self._drawing.rows, natural[0], height)
        left = _edges(scenery.margin[3], scenery.cell[1], self._drawing.columns, natural[1], width)
        if (np.diff(top) < 1).any() or (np.diff(left) < 1).any():
            raise ParameterError(
                f"complex_image of {env}: {height} x {width} pixels leave less than one for some of its "
                f"{self._drawing.rows} x {self._drawing.columns} cells; expected a larger size, such as {natural}"
            )
        ground = np.zeros((*natural, 3))
        ground_of(scenery.ground)(ground, scenery.cell, scenery.margin)
        picture = _scaled(ground, height, width)
        layers = self._drawing.layers
        sprite, place, color, keep = _sprite_tables(layers, scenery, np.diff(top), np.diff(left))
        hidden = hidden_names(hide, f"complex_image of {env.name}", layers)
        sprite[[name in hidden for name in layers]] = -1
        if grey:
            picture, color = (values @ np.array(LUMINANCE)[:, None] for values in (picture, color))
        self._tables = (_bytes(picture), top, left, sprite, place, _bytes(color), keep)
        channels = picture.shape[2]
        shape = (channels, height, width) if channels_first else (height, width, channels)
        self.space = Box(0, 255, shape, np.uint8)
        self._stack(frames, 0 if channels_first else 2)

    def frame(self, states: np.ndarray) -> np.ndarray:
        out = np.empty((len(states), *self._tables[0].shape), np.uint8)
        self._drawing(states, out, *self._tables)
        return np.ascontiguousarray(out.transpose(0, 3, 1, 2)) if self._channels_first else out

    def _checked_size(self, size: Any) -> tuple[int, int]:
        try:
            height, width = size
            valid = all(int(n) == n and 1 <= n <= LARGEST for n in (height, width))
        except (TypeError, ValueError):
            valid = False
        if not valid:
            raise ParameterError(
                f"complex_image of {self.env}: size is {size!r}; "
                f"expected 'natural' or (height, width) of 1 to {LARGEST} pixels"
            )
        return int(height), int(width)


def _natural_size(scenery: Scenery, rows: int, columns: int) -> tuple[int, int]:
    top, right, bottom, left = scenery.margin
    return top + rows * scenery.cell[0] + bottom, left + columns * scenery.cell[1] + right


def _edges(before: int, cell: int, number: int, natural: int, size: int) -> np.ndarray:
    """(number + 1,) where each cell begins, in pixels of the picture."""
    return np.rint((before + cell * np.arange(number + 1)) * size / natural).astype(np.int64)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.rint(values).clip(0, 255), np.uint8)


def _scaled(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """(H, W, C) -> (height, width, C) by averaging areas.

    Each new pixel is a sum over the few old ones that it covers, row by row: to the last bit the sum over all of them.
    """
    rows, row_shares = _covered(len(values), height)
    columns, column_shares = _covered(values.shape[1], width)
    out = np.zeros((height, width, values.shape[2]))
    for row, row_share in zip(rows, row_shares, strict=True):
        weighted = row_share[:, None, None] * values[row]
        for column, column_share in zip(columns, column_shares, strict=True):
            out += weighted[:, column] * column_share[:, None]
    return out


def _covered(old: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """(n, new): the old pixels, at most n, that each new one covers, and their shares in it, of which some are 0."""
    weights = _area_weights(old, new)
    pixels = np.argmax(weights > 0, axis=1) + np.arange(np.count_nonzero(weights, axis=1).max())[:, None]
    shares = np.where(pixels < old, weights[np.arange(new), np.minimum(pixels, old - 1)], 0.0)
    return np.minimum(pixels, old - 1), shares


def _area_weights(old: int, new: int) -> np.ndarray:
    """(new, old): the share of each old pixel in each new one; rows sum to 1."""
    edges = np.arange(new + 1) * old / new
    pixels = np.arange(old)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return overlap.clip(0) * new / old


def _sprite_tables(
    layers: Mapping[str, Layer], scenery: Scenery, heights: np.ndarray, widths: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """sprite, place, color and keep, as `draw_complex` takes them; color still (P, 3) float64."""
    rows = len(heights)
    sprite = np.full((len(layers), rows, 256), -1, np.int64)
    images: list[np.ndarray] = []
    for number, (name, layer) in enumerate(layers.items()):
        if name in scenery.sprites and scenery.sprites[name] is None:
            continue
        count = num_values(layer)
        by_row = scenery.row_colors.get(name)
        looks = [layer] if by_row is None else [replace(layer, color=color) for color in by_row]
        for row in range(rows):
            first = len(images) + count * (row % len(looks))
            sprite[number, row, 1:] = first + count - 1
            sprite[number, row, 1 : 1 + count] = first + np.arange(count)
        images += [_sprite_image(name, look, value, scenery) for look in looks for value in range(1, count + 1)]
    place = np.zeros((max(1, len(images)), heights.max() + 1, widths.max() + 1), np.int64)
    pixels: list[np.ndarray] = []
    used = 0
    for i, image in enumerate(images):
        for height in np.unique(heights):
            for width in np.unique(widths):
                place[i, height, width] = used
                pixels.append(_scaled(image, int(height), int(width)).reshape(-1, 4))
                used += int(height * width)
    table = np.concatenate([np.zeros((1, 4)) if not pixels else np.empty((0, 4)), *pixels])
    keep = 256 - np.rint(table[:, 3] * 256).astype(np.uint16)
    return sprite, place, table[:, :3], keep


def _sprite_image(name: str, layer: Layer, value: int, scenery: Scenery) -> np.ndarray:
    """(h, w, 4): colour 0 .. 255 times cover, and cover 0 .. 1."""
    color = color_of(layer, value)
    sprite = scenery.sprites.get(name, layer.sprite)
    if sprite is None:
        image = shape_of(name, layer)(np.array(color, np.float64), 4 * scenery.cell[0], glyph_of(layer, value)).copy()
    else:
        image = sprite_pixels(sprite_of(sprite, value), color)
    image[..., :3] *= image[..., 3:]
    return image


def _compose(planes, picture, top, left, sprite, place, color, keep, out) -> None:
    """The twin of the kernel for one state: what `interaction.draw_complex` does after drawing."""
    out[:] = picture
    for layer, plane in enumerate(planes):
        for row, column in np.argwhere(plane):
            number = sprite[layer, row, plane[row, column]]
            if number < 0:
                continue
            height, width = top[row + 1] - top[row], left[column + 1] - left[column]
            pixels = slice(place[number, height, width], place[number, height, width] + height * width)
            target = out[top[row] : top[row + 1], left[column] : left[column + 1]]
            stays = keep[pixels].reshape(height, width, 1).astype(np.int64)
            target[:] = color[pixels].reshape(height, width, -1) + (target * stays >> 8)
