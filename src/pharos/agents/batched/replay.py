"""Replay memory of W runs: numbers of states instead of what they look like, 14 bytes a transition."""

import numpy as np

from pharos.kernels import batched_learning as kernels


class Replay:
    """The last transitions of W runs with E copies each; a row is one step of all copies.

    As in Stable-Baselines3 there are max(buffer_size // E, 1) rows, and the oldest is overwritten.
    """

    def __init__(self, keys: np.ndarray, buffer_size: int, copies: int, batch_size: int):
        width, self.keys = len(keys), keys
        self.size = max(buffer_size // copies, 1)
        shape = (width, self.size, copies)
        self.memory: tuple[np.ndarray, ...] = (
            np.zeros(shape, np.int32),
            np.zeros(shape, np.int32),
            np.zeros(shape, np.uint8),
            np.zeros(shape, np.float32),
            np.zeros(shape, np.uint8),
        )
        batch = (width, batch_size)
        self.states, self.next_states = np.zeros(batch, np.int64), np.zeros(batch, np.int64)
        self.actions = np.zeros(batch, np.int64)
        self.rewards, self.discounts = np.zeros(batch, np.float32), np.zeros(batch, np.float32)

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
        """Draw a minibatch for each run, after `calls` steps; see `kernels.sample`."""
        batch = (self.states, self.next_states, self.actions, self.rewards, self.discounts)
        filled = min(calls, self.size)
        kernels.sample(self.keys, calls, draw, calls % self.size, filled, gammas, num_steps, self.memory, batch)

    def arrays(self, calls: int) -> dict[str, np.ndarray]:
        """The rows that are filled, by name."""
        names = ("replay_state", "replay_next", "replay_action", "replay_reward", "replay_flags")
        filled = min(calls, self.size)
        return {name: array[:, :filled] for name, array in zip(names, self.memory, strict=True)}
