"""Several frames in one image: the last k pictures of an episode, as agents of Atari games see them.

Source: Mnih et al. (2015), "Human-level control through deep reinforcement learning", methods.
"""

from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.observations.observation import Observation

MOST = 16


class Frames(Observation):
    """An image of one state, or of the last k states of an episode, the oldest first, along the channels.

    At the start of an episode the first frame stands k times. As a function of one state it is what an agent sees where
    an episode starts in that state; elsewhere it depends on the k - 1 states before, see `of_histories`.

    Attributes:
        frames: k.
        channel_axis: of an observation, on which frames lie one after another.
    """

    def _stack(self, frames: Any, channels: int) -> None:
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
