"""Simple images: one small plane for each kind of thing, a pixel for each cell; or all things on one grey plane."""

from collections.abc import Mapping, Sequence

import numpy as np

from pharos.environments import Environment, Layer
from pharos.errors import ParameterError
from pharos.observations.drawn import Drawing, Frames, num_values
from pharos.observations.hiding import hidden_names

DARKEST = 128  # of the shades of things on a plane of their own


class SimpleImage(Frames):
    """One plane for each layer of the environment, channel first: (L, rows k, columns k) uint8, 0 where nothing is.

    A layer with one kind of thing shows it as 255; one with several (such as cars of several colours) in even shades
    from 255 down to 128. Shows where things are, not where they go: directions and timers that `draw` leaves out cannot
    be seen without `motion`.

    Args:
        motion: planes for the M motion layers follow, such as the cell that a ball comes from: with them no two states
            of the classes of pharos look alike. Where a class declares none, `draw` shows all that there is.
        frames: k, the last k pictures of the episode, the oldest first: (k L, rows, columns). See `Frames`.
        hide: names of layers that the agent does not see: their planes stay, and are always 0.
        grey: one plane (1, rows k, columns k) for all things, each in a shade of its own, later layers over earlier
            ones.
        scale: k, pixels on each side of a cell. None: 1, or more where there are more planes than rows or columns,
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
        if isinstance(scale, bool) or not isinstance(scale, int) or scale < 1:
            raise ParameterError(f"simple_image: scale is {scale!r}; expected an integer of at least 1")
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
        out = np.zeros((len(states), *self._one[1:]), np.uint8)
        self._drawing(states, out, self.shades, self._covering)
        return out

    def one(self, state: np.ndarray) -> np.ndarray:
        if self.frames > 1:
            return self(state[None])[0]
        out = np.zeros(self._one, np.uint8)
        self._drawing.one(state, out, self.shades, self._covering)
        return out[0]


def _shades(layers: Mapping[str, Layer], covering: bool) -> np.ndarray:
    """(L, 256) uint8, the shade of every value of every layer; values beyond the declared ones look like the last."""
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
    """The twin of the kernel for one state: what `interaction.draw_simple` does after drawing."""
    size = out.shape[1] // planes.shape[1]
    for layer, plane in enumerate(planes):
        shade = shades[layer, plane].repeat(size, axis=0).repeat(size, axis=1)
        target = out[0 if covering else layer]
        target[shade > 0] = shade[shade > 0]
