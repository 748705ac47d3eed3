"""Recorded observations: what an import kept of each state, raw or as agents of Atari games see screens.

Source: Mnih et al. (2015), "Human-level control through deep reinforcement learning", methods: luminance, 84 x 84
pixels, the last four screens.
"""

import math
from collections.abc import Iterable

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.mdp import whole_number
from pharos.observations.images import Frames
from pharos.system import distinct_rows
from pharos.system.distinct_rows import DistinctRows
from pharos.system.threads import in_blocks

LARGEST_TABLE = 1 << 28
"""Bytes of distinct observations, as agents see them, that are kept in memory; more are made when they are seen."""
LARGEST_SIDE = 4096


class Recorded(Frames):
    """The image, grid of codes or vector that the import recorded of each state, zeros for the end of an episode.

    Images and grids: Box of uint8 from 0 to 255, in the source's own shape. Vectors: Box of float32. Agents of Atari
    games see grey=True, size=84, frames=4: (84, 84, 4).

    Args:
        stretch: multiply images and grids, each channel by the largest integer that keeps it below 256: codes from 0 to
            10 become shades that a network for images tells apart.
        grey, gray: luminance in place of colours (ITU-R 601, as ALE's own grey screens): (H, W, 1).
        size: (height, width) in pixels, or a number for both, to which images are scaled by averaging areas.
        frames: k, the last k images of the episode, the oldest first, along the channels. See `Frames`.
    Raises:
        ParameterError: nothing was recorded, as other environments have pictures of their own. Or what was recorded is
            no image, and an option is for images.
    """

    def __init__(
        self,
        env: Environment,
        *,
        stretch: bool = False,
        grey: bool = False,
        gray: bool = False,
        size: object = None,
        frames: int = 1,
    ):
        from gymnasium.spaces import Box

        shown = env.recorded
        if shown is None:
            raise ParameterError(
                f"{env}: has no recorded observations; 'recorded' is for imported MDPs whose import recorded what the "
                f"source shows, as those of MiniGrid: use 'one_hot', or 'index' with q_learning"
            )
        self.name = "recorded"
        self.env = env
        self._shown = shown
        self._grey, self._size = bool(grey or gray), None if size is None else self._checked_size(size)
        self._factors = None
        self._table: np.ndarray | None = None
        self.frames = 1
        if shown.dtype == np.uint8 and len(shown.shape) > 2:
            if (self._grey or self._size) and not (len(shown.shape) == 4 and shown.shape[3] in (1, 3)):
                raise self._no_image(f"of shape {shown.shape[1:]}")
            if stretch:
                self._factors = distinct_rows.stretch(shown)
            height, width = self._size or shown.shape[1:3]
            channels = (1,) if self._grey else shown.shape[3:]
            self.space = Box(0, 255, (height, width, *channels), np.uint8)
            self._stack(frames, 2)
        else:
            if stretch:
                raise ParameterError(f"{env}: stretch is for recorded images and grids; found vectors")
            if self._grey or self._size or frames != 1:
                raise self._no_image("vectors")
            has_end = not isinstance(shown, DistinctRows) or bool((shown.index < 0).any())
            ranges = [(block.min(), block.max()) for block in distinct_rows.blocks(shown)] + [(0, 0)] * has_end
            low, high = np.float32(min(ranges)[0]), np.float32(max(high for _, high in ranges))
            self.space = Box(float(low), float(high), shown.shape[1:], np.float32)

    def frame(self, states: np.ndarray) -> np.ndarray:
        numbers = self.checked(states)[:, 0]
        if not isinstance(self._shown, DistinctRows):
            return self._look(self._shown[numbers])
        length = math.prod(self.space.shape or ()) * self.space.dtype.itemsize // self.frames  # type: ignore[union-attr]
        if self._shown.num_distinct * length > LARGEST_TABLE:
            return self._look(self._shown[numbers])
        if self._table is None:
            looks = [self._look(block) for block in self._shown.blocks()]
            self._table = np.concatenate([*looks, np.zeros_like(looks[0][:1])])  # the last one is the end's: -1
        return self._table[self._shown.index[numbers]]

    def one(self, state: np.ndarray) -> np.ndarray:
        return self(state[None])[0]

    def _look(self, rows: np.ndarray) -> np.ndarray:
        """Rows as the source shows them -> one frame of each."""
        if self.space.dtype != np.uint8:
            return rows.astype(np.float32)
        if self._factors is not None:
            rows = rows * self._factors
        if not self._grey and self._size is None:
            return rows
        height, width = self._size or rows.shape[1:3]
        out = np.empty((len(rows), height, width, 1 if self._grey else rows.shape[3]), np.uint8)

        def scale(begin: int, end: int) -> None:
            from PIL import Image

            for n in range(begin, end):
                row = rows[n]
                image = Image.fromarray(row[:, :, 0] if row.shape[2] == 1 else row)
                image = image.convert("L") if self._grey else image
                image = image if self._size is None else image.resize((width, height), Image.Resampling.BOX)
                out[n] = np.asarray(image).reshape(out.shape[1:])

        in_blocks(scale, len(rows), 16)
        return out

    def _checked_size(self, size: object) -> tuple[int, int]:
        pair = tuple(size) if isinstance(size, Iterable) and not isinstance(size, str) else (size, size)
        what = f"recorded of {self.env}: size"
        if len(pair) != 2:
            raise ParameterError(f"{what} is {size!r}; expected (height, width), or a number for both")
        height, width = (whole_number(n, what, f"1 to {LARGEST_SIDE} pixels", most=LARGEST_SIDE) for n in pair)
        return height, width

    def _no_image(self, what: str) -> ParameterError:
        return ParameterError(
            f"{self.env}: grey, size and frames are for recorded images (H, W, 3) or (H, W, 1); found {what}"
        )
