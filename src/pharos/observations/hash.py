"""A random binary code of the state: complete, and without any likeness between states that are alike."""

from typing import Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.observations.observation import Observation

SPARE = 8  # bits beyond those that write the state
ROUNDS = 6
MOST_BITS = 1 << 16


class Hash(Observation):
    """A random word of bits for each state: (bits,) int8 of zeros and ones. Complete: different states differ.

    A control for what a representation is worth: it tells the state as a vector does, but states that follow each other
    have words as different as any two. The components of the state, in binary, go through a Feistel network of 6
    rounds, which permutes the words of this length; so it needs no state space, and is the same on every machine.

    Args:
        bits: length of the word; None: as many as the components have in binary, and 8 more.
        seed: another one gives other words.
    Raises:
        ParameterError: fewer bits than write the state, or more than 65,536; a seed below 0.
    Source: Luby and Rackoff (1988) for the network.
    """

    def __init__(self, env: Environment, *, bits: int | None = None, seed: int = 0):
        from gymnasium.spaces import MultiBinary

        components = env.components
        lengths = np.array([int(size - 1).bit_length() for size in components.size])
        needed = int(lengths.sum())
        count = needed + SPARE if bits is None else bits
        if isinstance(count, bool) or not isinstance(count, int) or not max(2, needed) <= count <= MOST_BITS:
            raise ParameterError(
                f"hash of {env.name}: bits is {count!r}; expected an integer from {max(2, needed)}, which write the "
                f"state, to {MOST_BITS}"
            )
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise ParameterError(f"hash of {env.name}: seed is {seed!r}; expected an integer of at least 0")
        self.name = "hash"
        self.env = env
        self.names = tuple(f"bit {i}" for i in range(count))
        self.space = MultiBinary(count)
        self._low, self._lengths = components.low, lengths
        self._keys = np.random.SeedSequence(seed).generate_state(ROUNDS, np.uint64)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        from pharos.kernels.observation_kernels import scramble

        out = np.zeros((len(states), len(self.names or ())), np.int8)
        scramble(states, self._low, self._lengths, self._keys, out)
        return out

    def one(self, state: np.ndarray) -> Any:
        return self(state[None])[0]
