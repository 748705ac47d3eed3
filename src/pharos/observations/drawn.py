"""Common part of simple and complex images: the rules' `draw`, compiled where possible, over blocks of states.

Several frames in one image: the last k pictures of an episode, as agents of Atari games see them.

Source: Mnih et al. (2015), "Human-level control through deep reinforcement learning", methods.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from pharos.environments import Environment, Layer
from pharos.errors import ParameterError
from pharos.observations.blocks import in_blocks
from pharos.observations.observation import Observation


def num_values(layer: Layer) -> int:
    """Number of values that a plane of this layer may have besides 0."""
    colors = len(layer.color) if np.ndim(layer.color) == 2 else 1
    sprites = len(layer.sprite) if layer.sprite is not None and not isinstance(layer.sprite[0], str) else 1
    return max(len(layer.glyph), colors, sprites)


class Drawing:
    """Runs a drawing kernel of the rules on batches of states; a twin in Python where Numba cannot compile it.

    Attributes:
        env: the environment; rows, columns: of its grid. `block` frames are worth a thread's while.
        motion: whether the planes of `draw_motion` follow those of `draw`; not where the class defines none.
        layers: those of all planes.
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
        self._compiled: Any = None

    def __call__(self, states: np.ndarray, out: np.ndarray, *tables: object) -> None:
        """Draw states (N, D) into out (N, ...), with the tables that the kernel takes between the planes and `out`."""
        if self._compiled is None:
            self._compiled = self._function(states, out, tables)
        in_blocks(
            lambda first, last: self._compiled(states, first, last, self._planes(), *tables, out),
            len(states),
            self._block,
        )

    def one(self, state: np.ndarray, out: np.ndarray, *tables: object) -> None:
        """Draw one state (D,) into out (1, ...); as the call for many, without its cost."""
        if self._compiled is None:
            self._compiled = self._function(state[None], out, tables)
        self._compiled(state[None], 0, 1, self._planes(), *tables, out)

    def _planes(self) -> np.ndarray:
        return np.empty(self._shape, np.uint8)  # zeroed by the kernel

    def __getstate__(self) -> dict[str, Any]:
        """Without the compiled kernel, which the next call makes ready."""
        return {**self.__dict__, "_compiled": None}

    def _function(self, states: np.ndarray, out: np.ndarray, tables: tuple[Any, ...]) -> Callable[..., None]:
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


MOST = 16


class Frames(Observation):
    """An image of one state, or of the last k states of an episode, the oldest first, along the channels.

    At the start of an episode the first frame stands k times. As a function of one state it is what an agent sees where
    an episode starts in that state; elsewhere it depends on the k - 1 states before, see `of_histories`.

    Attributes:
        frames: k.
        channel_axis: of an observation, on which frames lie one after another.
    """

    def _stack(self, frames: object, channels: int) -> None:
        """Take `space` for that of one frame, whose axis `channels` is that of its channels, and stack k of them.

        Raises:
            ParameterError: k is no integer from 1 to MOST.
        """
        from gymnasium.spaces import Box

        if isinstance(frames, bool) or not isinstance(frames, int) or not 1 <= frames <= MOST:
            raise ParameterError(f"{self.name} of {self.env}: frames is {frames!r}; expected 1 to {MOST}")
        self.frames, self.channel_axis = frames, channels
        if frames > 1:
            shape: Any = list(self.space.shape or ())
            shape[channels] *= frames
            if shape[channels] > min(shape):
                raise ParameterError(
                    f"{self.name} of {self.env}: {frames} frames of shape {self.space.shape} have {shape[channels]} "
                    f"channels, more than rows or columns, which would be taken for them; use fewer, or a larger size"
                )
            self.space = Box(0, 255, tuple(shape), np.uint8)

    def frame(self, states: np.ndarray) -> np.ndarray:
        """(N, *shape of one frame) of states (N, D)."""
        raise NotImplementedError

    def stacked(self, frames: np.ndarray) -> np.ndarray:
        """(N, *space.shape) of N histories of k frames (N, k, ...), the oldest first; a fresh array."""
        parts = [frames[:, i] for i in range(self.frames)]
        return np.concatenate(parts, axis=1 + self.channel_axis)

    def of_histories(self, histories: np.ndarray) -> np.ndarray:
        """(N, *space.shape) of N times k states (N, k, D), the oldest first."""
        count, k, width = histories.shape
        frames = self.frame(histories.reshape(count * k, width))
        return self.stacked(frames.reshape(count, k, *frames.shape[1:]))

    def __call__(self, states: np.ndarray) -> np.ndarray:
        frames = self.frame(states)
        return frames if self.frames == 1 else self.stacked(np.repeat(frames[:, None], self.frames, axis=1))
