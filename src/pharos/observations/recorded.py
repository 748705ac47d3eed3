"""Recorded observations of an imported MDP: those of its source, looked up by state."""

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.observations.observation import Observation


class Recorded(Observation):
    """The image, grid of codes or vector that the import recorded of each state; zeros for the end of an episode.

    Images and grids: Box of uint8 from 0 to 255, in the source's own shape. Vectors: Box of float32.

    Args:
        stretch: multiply images and grids, each channel by the largest integer that keeps it below 256: codes from 0 to
            10 become shades that a network for images tells apart.
    Raises:
        ParameterError: nothing was recorded; other environments have pictures of their own.
    """

    def __init__(self, env: Environment, *, stretch: bool = False):
        from gymnasium.spaces import Box

        shown = env.recorded
        if shown is None:
            raise ParameterError(
                f"{env}: has no recorded observations; 'recorded' is for imported MDPs whose import recorded what the "
                f"source shows, as those of MiniGrid: use 'one_hot', or 'index' with q_learning"
            )
        self.name = "recorded"
        self.env = env
        if shown.dtype == np.uint8 and shown.ndim > 2:
            if stretch:
                largest = shown.max(axis=tuple(range(shown.ndim - 1)))
                shown = shown * (255 // np.maximum(largest, 1)).astype(np.uint8)
            self.space = Box(0, 255, shown.shape[1:], np.uint8)
        else:
            if stretch:
                raise ParameterError(f"{env}: stretch is for recorded images and grids; found vectors")
            shown = shown.astype(np.float32)
            self.space = Box(float(shown.min()), float(shown.max()), shown.shape[1:], np.float32)
        self._shown = shown

    def __call__(self, states: np.ndarray) -> np.ndarray:
        return self._shown[states[:, 0]]
