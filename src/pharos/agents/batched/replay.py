"""Replay memory of W runs: numbers of states instead of what they look like, 14 bytes a transition.

Where several frames are seen a transition is no larger: the states before are those of the rows before.
"""

import numpy as np
import torch

from pharos.agents.batched.device_buffers import PinnedBuffer
from pharos.kernels import batched as kernels


class Replay:
    """The last transitions of W runs with E copies each; a row is one step of all copies.

    As in Stable-Baselines3 minibatches are drawn from the last max(buffer_size // E, 1) rows. Where k frames are seen,
    k - 1 rows before them are kept as well.

    Attributes:
        size: of how many rows minibatches are drawn; rows: how many there are, of which the oldest is overwritten.
        states, next_states (W, B) int64, or (W, B, k) where k frames are seen, actions (W, B) int64, rewards, discounts
            (W, B) float32: the minibatch that was drawn.
    """

    def __init__(
        self,
        keys: np.ndarray,
        number: int,
        buffer_size: int,
        copies: int,
        batch_size: int,
        device: str = "cpu",
        frames: int = 1,
    ):
        width, self.keys, self.number, self.frames = len(keys), keys, number, frames
        self.size = max(buffer_size // copies, 1)
        self.rows = self.size + frames - 1
        shape = (width, self.rows, copies)
        self.memory: tuple[np.ndarray, ...] = (
            np.zeros(shape, np.int32),
            np.zeros(shape, np.int32),
            np.zeros(shape, np.uint8),
            np.zeros(shape, np.float32),
            np.full(shape, kernels.DONE, np.uint8),  # so that nothing comes before what is written first
        )
        kinds, depth = [torch.int64] * 3 + [torch.float32] * 2, (frames,) if frames > 1 else ()
        shapes = [(width, batch_size, *depth)] * 2 + [(width, batch_size)] * 3
        self.drawn = tuple(PinnedBuffer(each, kind, device) for each, kind in zip(shapes, kinds, strict=True))
        self.states, self.next_states, self.actions, self.rewards, self.discounts = self.drawn

    def add(
        self,
        calls: int,
        state: np.ndarray,
        next_state: np.ndarray,
        actions: np.ndarray,
        reward: np.ndarray,
        flags: np.ndarray,
    ) -> None:
        """Keep the transitions (W, E) of step `calls`, counted from 0."""
        place = calls % self.rows
        for array, new in zip(self.memory, (state, next_state, actions, reward, flags), strict=True):
            array[:, place] = new

    def sample(self, calls: int, draw: int, gammas: np.ndarray, num_steps: int) -> None:
        """Draw a minibatch for each run that is not idle, after `calls` steps; see `kernels.sample`."""
        batch = tuple(part.array[: self.number] for part in self.drawn)
        filled = min(calls, self.size)
        keys, drawn = self.keys[: self.number], kernels.sample if self.frames == 1 else kernels.sample_histories
        drawn(keys, calls, draw, calls % self.rows, filled, gammas, num_steps, self.memory, batch)

    def arrays(self, calls: int) -> dict[str, np.ndarray]:
        """The rows that are filled, by name."""
        names = ("replay_state", "replay_next", "replay_action", "replay_reward", "replay_flags")
        filled = min(calls, self.rows)
        return {name: array[:, :filled] for name, array in zip(names, self.memory, strict=True)}
