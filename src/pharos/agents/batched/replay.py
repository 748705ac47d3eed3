"""Replay memory of W runs: numbers of states instead of what they look like, 14 bytes a transition."""

import numpy as np
import torch

from pharos.agents.batched.handover import Mirror
from pharos.kernels import batched_learning as kernels


class Replay:
    """The last transitions of W runs with E copies each; a row is one step of all copies.

    As in Stable-Baselines3 there are max(buffer_size // E, 1) rows, and the oldest is overwritten.

    Attributes:
        states, next_states, actions (W, B) int64, rewards, discounts (W, B) float32: the minibatch that was drawn.
    """

    def __init__(
        self, keys: np.ndarray, number: int, buffer_size: int, copies: int, batch_size: int, device: str = "cpu"
    ):
        width, self.keys, self.number = len(keys), keys, number
        self.size = max(buffer_size // copies, 1)
        shape = (width, self.size, copies)
        self.memory: tuple[np.ndarray, ...] = (
            np.zeros(shape, np.int32),
            np.zeros(shape, np.int32),
            np.zeros(shape, np.uint8),
            np.zeros(shape, np.float32),
            np.zeros(shape, np.uint8),
        )
        kinds = [torch.int64] * 3 + [torch.float32] * 2
        self.drawn = tuple(Mirror((width, batch_size), kind, device) for kind in kinds)
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
        place = calls % self.size
        for array, new in zip(self.memory, (state, next_state, actions, reward, flags), strict=True):
            array[:, place] = new

    def sample(self, calls: int, draw: int, gammas: np.ndarray, num_steps: int) -> None:
        """Draw a minibatch for each run that is not idle, after `calls` steps; see `kernels.sample`."""
        batch = tuple(part.array[: self.number] for part in self.drawn)
        filled = min(calls, self.size)
        keys = self.keys[: self.number]
        kernels.sample(keys, calls, draw, calls % self.size, filled, gammas, num_steps, self.memory, batch)

    def arrays(self, calls: int) -> dict[str, np.ndarray]:
        """The rows that are filled, by name."""
        names = ("replay_state", "replay_next", "replay_action", "replay_reward", "replay_flags")
        filled = min(calls, self.size)
        return {name: array[:, :filled] for name, array in zip(names, self.memory, strict=True)}
