"""Observations beyond the current state: the frames before, and irrelevant coins."""

from typing import Any

import numpy as np

from pharos.interaction.simulator import Simulator, stream_of
from pharos.kernels import stepping


class FrameStack:
    """The observations of N environments whose observation has `frames` or is in part `irrelevant`.

    Frames are kept as pictures: a step draws one. Coins are thrown for each observation, from streams of their own, so
    that steps stay what they are without.
    """

    def __init__(self, simulator: Simulator, num_envs: int):
        context: Any = simulator.context
        self.context, self.observation = context, context.observation
        self._rng = np.random.SeedSequence().generate_state(num_envs, np.uint64)
        self._frames = np.empty((num_envs, 0))
        if self.observation.frames > 1:
            one = self.observation.frame(simulator.start_states[:1])
            self._frames = np.zeros((num_envs, self.observation.frames, *one.shape[1:]), one.dtype)

    def seed(self, seeds: "list[int | None]") -> None:
        """Seed the coins of each environment; None leaves a stream as it is."""
        for i, seed in enumerate(seeds):
            if seed is not None:
                self._rng[i] = stream_of(seed, 2)[0]

    def push(self, states: np.ndarray, moves: np.ndarray, begins: np.ndarray) -> None:
        """Environments are in states (N, D) now; (N,) bool: `moves` by a step, `begins` at the start of an episode."""
        if self.observation.frames > 1:
            frames = self.observation.frame(states)
            self._frames[moves, :-1] = self._frames[moves, 1:]
            self._frames[moves, -1] = frames[moves]
            self._frames[begins] = frames[begins, None]

    def current(self, states: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Any:
        """A batch of N observations of where they are; after `push`."""
        return self._in_context(self._frames, slice(None), states, previous, elapsed)

    def terminal(self, rows: np.ndarray, states: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Any:
        """The last observations of the episodes of environments `rows`, in states (len(rows), D) that `push` is not
        told.
        """
        frames = self._frames[rows]
        if self.observation.frames > 1:
            frames = np.concatenate([frames[:, 1:], self.observation.frame(states)[:, None]], axis=1)
        return self._in_context(frames, rows, states, previous, elapsed)

    def _in_context(
        self, frames: np.ndarray, rows: Any, states: np.ndarray, previous: np.ndarray, elapsed: np.ndarray
    ) -> Any:
        stack = self.observation.stacked(frames) if self.observation.frames > 1 else None
        coins = None
        if self.observation.irrelevant:
            rng = self._rng[rows]
            coins = np.empty((len(states), self.observation.irrelevant), np.float32)
            stepping.throw(rng, coins)
            self._rng[rows] = rng
        return self.context(states, previous, elapsed, seen=stack, coins=coins)
