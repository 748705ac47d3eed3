"""Random binary codes of states: of all of them (`hash`), or of a share (`mixed`), without likeness between neighbours.

Complete: different states differ.
"""

from typing import Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.observations.observation import Observation
from pharos.observations.vector import OneHot

SPARE = 8  # bits beyond those that write the state
ROUNDS = 6
MOST_BITS = 1 << 16
FRACTION = 40  # bits of the number that decides whether a state is in the share of `mixed`


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
        _check_seed(seed, f"hash of {env.name}")
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


class Mixed(Observation):
    """`one_hot` with a share of the states given random words instead: (sum of the sizes of the ranges,) float32.

    One-hot codes of neighbours are alike, words are not, so the share says how much of a representation is lost while
    the size of the input and the length of every code, sqrt(D) for D components, stay. A state is in the share where a
    random number of its own in [0, 1) is below it: a larger share has the same states, and more. A word has L entries
    of +-sqrt(D / L), the signs being those of `hash` with L bits and the same seed. Complete: words differ from each
    other, and a one-hot code has entries that no word has.

    Args:
        share: of the states, from 0 (one_hot) to 1 (words only).
        seed: another one gives other words and other states.
    Raises:
        ParameterError: share is no number from 0 to 1, a seed below 0, no component has two values, or `one_hot` or
            `hash` of that length does not exist.
    """

    def __init__(self, env: Environment, *, share: float = 0.5, seed: int = 0):
        from gymnasium.spaces import Box

        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share <= 1:
            raise ParameterError(f"mixed of {env.name}: share is {share!r}; expected a number from 0 to 1")
        _check_seed(seed, f"mixed of {env.name}")
        components = env.components
        if not (components.size > 1).any():
            raise ParameterError(f"mixed of {env.name}: no component has two values; expected states that differ")
        self.name = "mixed"
        self.env = env
        self._one_hot = OneHot(env)
        length, needed = int(components.size.sum()), sum(int(size - 1).bit_length() for size in components.size)
        self._word = Hash(env, bits=length, seed=seed)
        self._draw = Hash(env, bits=max(FRACTION, needed), seed=seed + 1)
        self._share, self._entry = share, np.float32(np.sqrt(len(components) / length))
        self.names = tuple(f"entry {i}" for i in range(length))
        self.space = Box(-1.0, 1.0, (length,), np.float32)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        out = self._one_hot(states).astype(np.float32)
        drawn = self._draw(states)[:, :FRACTION] @ 0.5 ** np.arange(1, FRACTION + 1)
        rows = np.flatnonzero(drawn < self._share)
        out[rows] = self._entry * (2.0 * self._word(states[rows]) - 1)
        return out


def _check_seed(seed: int, whose: str) -> None:
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ParameterError(f"{whose}: seed is {seed!r}; expected an integer of at least 0")
