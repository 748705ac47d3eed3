"""Simple images, one small plane for each kind of thing, and complex images, sprites on a ground like an Atari screen.

Both come from the rules' `draw`, compiled if possible, over blocks of states. `render` gives them beside the pictures
for people. Several frames in one image: the last k pictures of an episode, as agents of Atari games see them.

Source: Mnih et al. (2015), "Human-level control through deep reinforcement learning", methods.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from pharos.drawing import (
    check_state,
    color_of,
    glyph_of,
    ground_of,
    human,
    scenery_of,
    shape_of,
    sprite_of,
    sprite_pixels,
)
from pharos.environments import Environment, Layer, Scenery
from pharos.errors import ParameterError, UnknownName
from pharos.mdp import whole_number
from pharos.observations.observation import Observation, hidden_names, names, observe
from pharos.system.threads import in_blocks


def num_values(layer: Layer) -> int:
    """Number of values of a layer's plane, besides 0, that look different. Higher ones look like the last."""
    colors = len(layer.color) if np.ndim(layer.color) == 2 else 1
    sprites = len(layer.sprite) if layer.sprite is not None and not isinstance(layer.sprite[0], str) else 1
    return max(len(layer.glyph), colors, sprites)


class Drawing:
    """Runs a drawing kernel of the rules on batches of states. A twin in Python if Numba cannot compile it.

    Attributes:
        env: the environment. rows, columns: of its grid. `block` frames are worth a thread's while.
        motion: whether the planes of `draw_motion` follow the planes of `draw`. False if the class defines none.
        layers: of all planes.
    Raises:
        ParameterError: the environment declares no grid, no layers or no draw(), or motion is no truth.
    """

    def __init__(self, env: Environment, kernel: str, interpreted: Callable[..., None], block: int, motion: bool):
        if not isinstance(motion, bool):
            raise ParameterError(f"{env}: motion is {motion!r}; expected True or False")
        self.env, self._block = env, block
        self.motion = motion and env.has_motion
        self.layers: dict[str, Layer] = {**env.layers, **(env.motion_layers if self.motion else {})}
        try:
            self.rows, self.columns = env.grid()
            planes = np.zeros((len(self.layers), self.rows, self.columns), np.uint8)
            self._draw(tuple(env.initial_states()[0][0]), planes)
        except NotImplementedError as error:
            raise ParameterError(f"{env}: cannot be drawn: {error}") from None
        if not env.layers:
            raise ParameterError(f"{env}: cannot be drawn: it declares no layers")
        self._shape = planes.shape
        self._kernel = kernel
        self._interpreted = interpreted
        self._compiled: Callable[..., None] | None = None

    def __call__(self, states: np.ndarray, out: np.ndarray, *tables: object) -> None:
        """Draw states (N, D) into out (N, ...), with the tables that the kernel takes between the planes and `out`."""
        if self._compiled is None:
            self._compiled = self._function(states, out, tables)
        draw = self._compiled
        in_blocks(lambda first, last: draw(states, first, last, self._planes(), *tables, out), len(states), self._block)

    def one(self, state: np.ndarray, out: np.ndarray, *tables: object) -> None:
        """Draw one state (D,) into out (1, ...), as the call for many, without its cost."""
        if self._compiled is None:
            self._compiled = self._function(state[None], out, tables)
        self._compiled(state[None], 0, 1, self._planes(), *tables, out)

    def _planes(self) -> np.ndarray:
        return np.empty(self._shape, np.uint8)  # zeroed by the kernel

    def __getstate__(self) -> dict[str, Any]:
        """Without the compiled kernel, which the next call makes ready."""
        return {**self.__dict__, "_compiled": None}

    def _function(self, states: np.ndarray, out: np.ndarray, tables: tuple[object, ...]) -> Callable[..., None]:
        from pharos.rules import rules_of

        nothing = (states, 0, 0, self._planes(), *tables, out)
        return rules_of(self.env).drawing(self._kernel, self._interpret, *nothing, motion=self.motion)

    def _interpret(self, states, first, last, planes, *tables_and_out) -> None:
        for n in range(first, last):
            planes[:] = 0
            self._draw(tuple(states[n].tolist()), planes)
            self._interpreted(planes, *tables_and_out[:-1], tables_and_out[-1][n])

    def _draw(self, state: tuple[int, ...], planes: np.ndarray) -> None:
        things = len(self.env.layers)
        self.env.draw(state, planes[:things])
        if self.motion:
            self.env.draw_motion(state, planes[things:])


# Frames ---------------------------------------------------------------------------------------------------------------


MOST_FRAMES = 16


class Frames(Observation):
    """An image of one state, or of the last k states of an episode, the oldest first, along the channels.

    At the start of an episode the first frame stands k times. As a function of one state it is what an agent sees if
    an episode starts in that state. Otherwise it depends on the k - 1 states before, see `of_histories`.

    Attributes:
        frames: k.
        channel_axis: of an observation, on which frames lie one after another.
    """

    def _stack(self, frames: object, channels: int) -> None:
        """Set `space` to k stacked frames, if it was the space of one. `channels` is the axis of its channels.

        Raises:
            ParameterError: k is no integer from 1 to MOST_FRAMES.
        """
        from gymnasium.spaces import Box

        k = whole_number(frames, f"{self.name} of {self.env}: frames", f"1 to {MOST_FRAMES}", most=MOST_FRAMES)
        self.frames, self.channel_axis = k, channels
        if k > 1:
            shape = list(self.space.shape or ())
            shape[channels] *= k
            if shape[channels] > min(shape):
                raise ParameterError(
                    f"{self.name} of {self.env}: {k} frames of shape {self.space.shape} have {shape[channels]} "
                    f"channels, more than rows or columns, which would be taken for them; use fewer, or a larger size"
                )
            self.space = Box(0, 255, tuple(shape), np.uint8)

    def stacked(self, frames: np.ndarray) -> np.ndarray:
        parts = [frames[:, i] for i in range(self.frames)]
        return np.concatenate(parts, axis=1 + self.channel_axis)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        frames = self.frame(states)
        return frames if self.frames == 1 else self.stacked(np.repeat(frames[:, None], self.frames, axis=1))


DARKEST = 128  # of the shades of things on a plane of their own


class SimpleImage(Frames):
    """One plane for each layer of the environment, channel first: (L, rows k, columns k) uint8, 0 if a cell is empty.

    A layer with one kind of thing shows it as 255, one with several (such as cars of several colours) in even shades
    from 255 down to 128. Shows the positions of things, not their motion: directions and timers that `draw` leaves out
    cannot be seen without `motion`.

    Args:
        motion: planes for the M motion layers follow, such as the cell that a ball comes from: with them no two states
            of the classes of pharos look alike. If a class declares none, `draw` shows all that there is.
        frames: k, the last k pictures of the episode, the oldest first: (k L, rows, columns). See `Frames`.
        hide: names of layers that the agent does not see: their planes stay, and are always 0.
        grey: one plane (1, rows k, columns k) for all things, each in a shade of its own, later layers over earlier
            ones.
        scale: k, pixels on each side of a cell. None: 1, or more if there are more planes than rows or columns,
            because Stable-Baselines3 takes the smallest dimension for the channels.
    Attributes:
        shades: (L, 256) uint8, the shade of every value on the plane of every layer.
    Raises:
        ParameterError: the environment cannot be drawn, or there are more planes than pixels on a side.
    """

    def __init__(
        self,
        env: Environment,
        *,
        motion: bool = False,
        frames: int = 1,
        hide: str | Sequence[str] = (),
        grey: bool = False,
        scale: int | None = None,
    ):
        from gymnasium.spaces import Box

        self.name = "simple_image"
        self.env = env
        self._drawing = Drawing(env, "draw_simple", _paint, block=512, motion=motion)
        layers = self._drawing.layers
        self._covering = bool(grey)
        rows, columns = self._drawing.rows, self._drawing.columns
        each = 1 if grey else len(layers)
        planes = each * max(frames, 1) if isinstance(frames, int) else each
        if scale is None:
            scale = -(-planes // min(rows, columns))
        scale = whole_number(scale, "simple_image: scale", "an integer of at least 1")
        if planes > min(rows, columns) * scale:
            raise ParameterError(
                f"simple_image of {env}: {planes} planes ({', '.join(layers)}) "
                f"of {rows * scale} x {columns * scale} pixels "
                f"would be taken for an image of {min(rows, columns) * scale} channels; "
                f"use scale={-(-planes // min(rows, columns))} or grey=True"
            )
        self._one = (1, each, rows * scale, columns * scale)
        self.space = Box(0, 255, self._one[1:], np.uint8)
        self._stack(frames, 0)
        self.shades = _shades(layers, self._covering)
        hidden = hidden_names(hide, f"simple_image of {env.name}", layers)
        self.shades[[name in hidden for name in layers]] = 0
        self.is_flat = scale == 1 and not grey and not self._drawing.motion and frames == 1

    def frame(self, states: np.ndarray) -> np.ndarray:
        states = self.checked(states)
        out = np.zeros((len(states), *self._one[1:]), np.uint8)
        self._drawing(states, out, self.shades, self._covering)
        return out

    def one(self, state: np.ndarray) -> np.ndarray:
        if self.frames > 1:
            return self(state[None])[0]
        out = np.zeros(self._one, np.uint8)
        self._drawing.one(self.checked(state[None])[0], out, self.shades, self._covering)
        return out[0]


def _shades(layers: Mapping[str, Layer], covering: bool) -> np.ndarray:
    """(L, 256) uint8, the shade of every value of every layer. Values beyond the declared ones look like the last."""
    shades = np.zeros((len(layers), 256), np.uint8)
    counts = [num_values(layer) for layer in layers.values()]
    before = np.cumsum(counts) - counts
    for layer, count in enumerate(counts):
        if covering:
            values = 255 * (before[layer] + 1 + np.arange(count)) / sum(counts)
        else:
            values = np.linspace(255, max(1, min(DARKEST, 256 - count)), count)
        shades[layer, 1 : 1 + count] = np.rint(values)
        shades[layer, 1 + count :] = shades[layer, count]
    return shades


def _paint(planes: np.ndarray, shades: np.ndarray, covering: bool, out: np.ndarray) -> None:
    """Python twin of the kernel for one state: the part of `interaction.draw_simple` after drawing."""
    size = out.shape[1] // planes.shape[1]
    for layer, plane in enumerate(planes):
        shade = shades[layer, plane].repeat(size, axis=0).repeat(size, axis=1)
        target = out[0 if covering else layer]
        target[shade > 0] = shade[shade > 0]


MOST_PIXELS = 1024  # pixels on a side
LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601, as in Pillow and OpenCV


class ComplexImage(Frames):
    """A colour picture (height, width, 3) uint8 of all layers, with sprites.

    The picture is composed at the size asked for: ground and sprites are scaled once, by averaging areas, to whole
    pixels of each cell, so that a frame costs a few microseconds. Shows what `draw` declares, as simple images do.

    Args:
        size: (height, width) in pixels, (84, 84) as agents of Atari games see, or "natural", as large as the sprites
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
        sprite, offset, color, keep = _sprite_tables(layers, scenery, np.diff(top), np.diff(left))
        hidden = hidden_names(hide, f"complex_image of {env.name}", layers)
        sprite[[name in hidden for name in layers]] = -1
        if grey:
            picture, color = (values @ np.array(LUMINANCE)[:, None] for values in (picture, color))
        self._tables = (_bytes(picture), top, left, sprite, offset, _bytes(color), keep)
        channels = picture.shape[2]
        shape = (channels, height, width) if channels_first else (height, width, channels)
        self.space = Box(0, 255, shape, np.uint8)
        self._stack(frames, 0 if channels_first else 2)

    def frame(self, states: np.ndarray) -> np.ndarray:
        states = self.checked(states)
        out = np.empty((len(states), *self._tables[0].shape), np.uint8)
        self._drawing(states, out, *self._tables)
        return np.ascontiguousarray(out.transpose(0, 3, 1, 2)) if self._channels_first else out

    def _checked_size(self, size: object) -> tuple[int, int]:
        try:
            height, width = size if isinstance(size, Iterable) else ()
            valid = all(int(n) == n and 1 <= n <= MOST_PIXELS for n in (height, width))
        except (TypeError, ValueError):
            valid = False
        if not valid:
            raise ParameterError(
                f"complex_image of {self.env}: size is {size!r}; "
                f"expected 'natural' or (height, width) of 1 to {MOST_PIXELS} pixels"
            )
        return int(height), int(width)


def _natural_size(scenery: Scenery, rows: int, columns: int) -> tuple[int, int]:
    top, right, bottom, left = scenery.margin
    return top + rows * scenery.cell[0] + bottom, left + columns * scenery.cell[1] + right


def _edges(before: int, cell: int, number: int, natural: int, size: int) -> np.ndarray:
    """(number + 1,) the beginning of each cell, in pixels of the picture."""
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
    """(new, old): the share of each old pixel in each new one. Rows sum to 1."""
    edges = np.arange(new + 1) * old / new
    pixels = np.arange(old)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return overlap.clip(0) * new / old


def _sprite_tables(
    layers: Mapping[str, Layer], scenery: Scenery, heights: np.ndarray, widths: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """sprite, offset, color and keep, as `draw_complex` takes them, with color still (P, 3) float64."""
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
    offset = np.zeros((max(1, len(images)), heights.max() + 1, widths.max() + 1), np.int64)
    pixels: list[np.ndarray] = []
    used = 0
    for i, image in enumerate(images):
        for height in np.unique(heights):
            for width in np.unique(widths):
                offset[i, height, width] = used
                pixels.append(_scaled(image, int(height), int(width)).reshape(-1, 4))
                used += int(height * width)
    table = np.concatenate([np.zeros((1, 4)) if not pixels else np.empty((0, 4)), *pixels])
    keep = 256 - np.rint(table[:, 3] * 256).astype(np.uint16)
    return sprite, offset, table[:, :3], keep


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


def _compose(planes, picture, top, left, sprite, offset, color, keep, out) -> None:
    """Python twin of the kernel for one state: the part of `interaction.draw_complex` after drawing."""
    out[:] = picture
    for layer, plane in enumerate(planes):
        for row, column in np.argwhere(plane):
            number = sprite[layer, row, plane[row, column]]
            if number < 0:
                continue
            height, width = top[row + 1] - top[row], left[column + 1] - left[column]
            pixels = slice(offset[number, height, width], offset[number, height, width] + height * width)
            target = out[top[row] : top[row + 1], left[column] : left[column + 1]]
            stays = keep[pixels].reshape(height, width, 1).astype(np.int64)
            target[:] = color[pixels].reshape(height, width, -1) + (target * stays >> 8)


Renderer = Callable[[Environment, Sequence[int]], np.ndarray]

RENDERERS: dict[str, Renderer] = {"human": human}
"""Name of an observation -> function (environment, state) -> (H, W, 3) or (H, W) uint8. Packages add theirs."""
NO_IMAGES = ("vector", "one_hot", "index", "number", "hash", "mixed")


def render(env: Environment, state: Sequence[int], observation: str = "human", **options: object) -> np.ndarray:
    """Return the picture of `state` under an observation, (H, W, 3) uint8.

    Args:
        observation: "human", another of RENDERERS, or an observation whose values are images. Planes stand side by
            side.
        options: of the observation, such as `size="natural"` of "complex_image".
    Raises:
        UnknownName: no observation or option of this name. ParameterError: `state` is none of the environment's, or
        cannot be drawn, or the observation is no image.
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
    """The names that `render` knows: of the observations, only those that may be images."""
    return [*RENDERERS, *(name for name in names() if name not in NO_IMAGES)]


@cache
def _observer(env: Environment, name: str, options: tuple[tuple[str, object], ...]) -> Observation:
    if name not in names():
        raise UnknownName("observation to render", name, [*renderers(), "text"])
    return observe(env, name, state_space=None, **dict(options))


def _side_by_side(values: np.ndarray, name: str) -> np.ndarray:
    """An image (H, W, 3), (H, W, 1) or (H, W) as it is, planes (L, H, W) beside each other with a line between them.

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
