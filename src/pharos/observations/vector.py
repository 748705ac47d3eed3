"""Vectors: every component of the state, normalised by its declared range; one-hot; the number of the state, in its
state space or in its source; random binary codes of all states (`hash`) or of a share (`mixed`), without likeness
between neighbours.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.mdp import whole_number
from pharos.observations.observation import Observation, hidden_names, kernels

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

LARGEST_EXACT_INTEGER = 1 << 24  # integers up to here are told apart in float32
MOST_ONE_HOT = 1 << 20
MOST_IRRELEVANT = 10
MOST_STARTS = 4096


class Vector(Observation):
    """(value - low) / (high - low) of every component, in the order of `env.components`: (D,) float32 in [0, 1].

    Complete: different states have different vectors. A component with one value only is always 0.

    Args:
        hide: variables that the agent does not see, such as "ball_goes_right" or "bricks", or single components of
            them, such as "bricks[0,3]": their entries stay, and are always 0. Or -1 for the last component, -2 for
            the last but one, ...: the same rule for all classes.
        irrelevant: how many entries follow that mean nothing: fair coins, 0 or 1, thrown anew at every step, whatever
            the state is. As a function of the state they are 0. Environments throw them. At most MOST_IRRELEVANT.
    Attributes:
        low, scale: (D,), the observation is (state - low) * scale.
    Raises:
        ParameterError: a component has more values than float32 tells apart, or there are too many irrelevant entries.
    Source: irrelevant features: Rajan et al. (2023), MDP Playground, whose irrelevant part is a chain of its own.
    """

    def __init__(self, env: Environment, *, hide: int | str | Sequence[str] = (), irrelevant: int = 0):
        from gymnasium.spaces import Box

        components = env.components
        if (components.size > LARGEST_EXACT_INTEGER).any():
            i = int(np.argmax(components.size))
            raise ParameterError(
                f"{env}: {components.names[i]} has {components.size[i]} values; the vector observation tells at most "
                f"{LARGEST_EXACT_INTEGER} apart: pass an observation of your own"
            )
        self.name = "vector"
        self.env = env
        self.names = components.names
        self.low = components.low
        self.scale = np.where(components.size > 1, 1 / np.maximum(components.size - 1, 1), 0.0)
        source = f"vector of {env.name}"
        if isinstance(hide, int):
            if not -len(components.names) <= hide < 0:
                raise ParameterError(f"{source}: hide is {hide}; expected a name, or -1 to -{len(components.names)}")
            hide = [components.names[hide]]
        for name in hidden_names(hide, source, components.variables, components.names):
            self.scale[components.variables.get(name) or components.names.index(name)] = 0.0
        few = f"0 to {MOST_IRRELEVANT} entries, so that a policy can be asked about all their values in a state"
        self.irrelevant = whole_number(irrelevant, f"{source}: irrelevant", few, least=0, most=MOST_IRRELEVANT)
        self.names = (*components.names, *(f"irrelevant[{i}]" for i in range(self.irrelevant)))
        self.space = Box(0.0, 1.0, (len(self.names),), np.float32)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        states = self.checked(states)
        out = np.zeros((len(states), len(self.names or ())), np.float32)
        kernels().normalize(states, self.low, self.scale, out)
        return out


class OneHot(Observation):
    """A one for the value of every component and zeros elsewhere: (sum of the sizes of the ranges,) uint8. Complete.

    Args:
        seen_first: variables that the agent sees in start states only, or single components of them, named as for
            `hide` of a vector: their entries stay, and are 0 in all other states. So what an episode is about can be
            told once, and has to be remembered.
    Raises:
        ParameterError: it would have more than MOST_ONE_HOT entries, `seen_first` names no variable, or there are more
            than MOST_STARTS start states to compare with.
    Source: seen_first: memory_chain of bsuite, which shows its bits in the first step alone.
    """

    def __init__(self, env: Environment, *, seen_first: str | Sequence[str] = ()):
        from gymnasium.spaces import MultiBinary

        components = env.components
        length = int(components.size.sum())
        if length > MOST_ONE_HOT:
            raise ParameterError(
                f"{env}: one_hot would have {length} entries; expected at most {MOST_ONE_HOT}: use 'vector'"
            )
        self.name = "one_hot"
        self.env = env
        self.names = tuple(
            f"{name}={low + value}"
            for name, low, size in zip(components.names, components.low, components.size, strict=True)
            for value in range(size)
        )
        self.space = MultiBinary(length)
        self._low = components.low
        self._offset = np.cumsum(components.size) - components.size
        self._first = np.zeros(length, bool)  # entries that start states alone show
        source = f"one_hot of {env.name}"
        for name in hidden_names(seen_first, source, components.variables, components.names, "seen_first"):
            columns = components.variables.get(name) or components.names.index(name)
            for i in np.arange(len(components))[columns].ravel():
                self._first[self._offset[i] : self._offset[i] + components.size[i]] = True
        starts = env.initial_states() if self._first.any() else []
        if len(starts) > MOST_STARTS:
            raise ParameterError(
                f"{source}: seen_first with {len(starts)} start states; expected at most {MOST_STARTS}"
            )
        self._starts = np.array([state for state, _ in starts], np.int64)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        states = self.checked(states)
        out = np.zeros((len(states), len(self.names or ())), np.int8)
        kernels().mark_components(states, self._low, self._offset, out)
        if len(self._starts):
            is_start = np.zeros(len(states), bool)
            for start in self._starts:
                is_start |= (states == start).all(axis=1)
            out[np.ix_(~is_start, self._first)] = 0
        return out


class Index(Observation):
    """The number of the state in a built state space: Discrete(S). It is complete, and what tabular agents learn from.

    Raises:
        ParameterError: no state space was given, or one of another environment.
    """

    def __init__(self, env: Environment, state_space: "StateSpace | None" = None):
        from gymnasium.spaces import Discrete

        if state_space is None:
            raise ParameterError(
                f"{env}: observation 'index' needs the built state space: observe(env, 'index', "
                f"state_space=pharos.build(env)), or space=pharos.build(env) of pharos.GymEnv"
            )
        if state_space.environment != env:
            raise ParameterError(
                f"observation 'index': the state space belongs to {state_space.environment}; expected one of {env}"
            )
        self.name = "index"
        self.env = env
        self.state_space = state_space
        self.space = Discrete(state_space.num_states)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        return self.state_space.indices(states)


class Number(Observation):
    """The number of the state in its source: Discrete(n), with the source's n. What an agent of Gymnasium has seen.

    Toy text has the numbers of Gymnasium: row x columns + column in frozen_lake and cliff_walking; ((row x size +
    column) x (L + 1) + passenger) x L + destination in taxi with L landmarks, 500 numbers on 5 x 5 cells, which do not
    say whether a fickle passenger may still change his mind. An imported world has the number in its folder, which is
    the number in the table, matrix or file, 0 for the end of an episode.

    Raises:
        ParameterError: the source does not number its states.
    """

    def __init__(self, env: Environment):
        from gymnasium.spaces import Discrete

        if not env.numbered_by:
            raise ParameterError(
                f"{env}: observation 'number' is the source's number of a state, which {env.name} has none of; use "
                f"'index', the number in its state space"
            )
        components = env.components
        self.name = "number"
        self.env = env
        self.space = Discrete(env.num_numbered)
        columns = [np.arange(len(components))[components.variables[name]] for name in env.numbered_by]
        self._columns = np.concatenate(columns)
        self._low, self._sizes = components.low[self._columns], components.size[self._columns]

    def __call__(self, states: np.ndarray) -> np.ndarray:
        values = (self.checked(states)[:, self._columns] - self._low).T
        number = np.ravel_multi_index(tuple(values), tuple(self._sizes.tolist()))
        return np.where(number < self.space.n, number, 0).astype(np.int64)  # type: ignore[attr-defined]


SPARE = 8  # bits beyond those that write the state
HASH_ROUNDS = 6
MOST_BITS = 1 << 16
SEED_EXPECTED = "an integer of at least 0"
FRACTION = 40  # bits of the number that decides whether a state is in the share of `mixed`


class Hash(Observation):
    """A random word of bits for each state: (bits,) int8 of zeros and ones. Complete: different states differ.

    A control for what a representation is worth: it tells the state as a vector does, but states that follow each other
    have words as different as any two. The components of the state, in binary, go through a Feistel network of 6
    rounds, which permutes the words of this length. So it needs no state space, and is the same on every machine.

    Args:
        bits: length of the word. Default: as many as the components have in binary, and 8 more.
        seed: another one gives other words.
    Raises:
        ParameterError: fewer bits than write the state, or more than 65,536, or a seed below 0.
    Source: Luby and Rackoff (1988) for the network.
    """

    def __init__(self, env: Environment, *, bits: int | None = None, seed: int = 0):
        from gymnasium.spaces import MultiBinary

        components = env.components
        lengths = np.array([int(size - 1).bit_length() for size in components.size])
        needed = int(lengths.sum())
        enough = max(2, needed)
        expected = f"an integer from {enough}, which write the state, to {MOST_BITS}"
        count = needed + SPARE if bits is None else bits
        count = whole_number(count, f"hash of {env.name}: bits", expected, enough, MOST_BITS)
        whole_number(seed, f"hash of {env.name}: seed", SEED_EXPECTED, least=0)
        self.name = "hash"
        self.env = env
        self.names = tuple(f"bit {i}" for i in range(count))
        self.space = MultiBinary(count)
        self._low, self._lengths = components.low, lengths
        self._keys = np.random.SeedSequence(seed).generate_state(HASH_ROUNDS, np.uint64)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        states = self.checked(states)
        out = np.zeros((len(states), len(self.names or ())), np.int8)
        kernels().scramble(states, self._low, self._lengths, self._keys, out)
        return out


class Mixed(Observation):
    """`one_hot` with a share of the states given random words instead: (sum of the sizes of the ranges,) float32.

    One-hot codes of neighbours are alike, words are not, so the share says how much of a representation is lost while
    the size of the input and the length of every code, sqrt(D) for D components, stay. A state is in the share if a
    random number of its own in [0, 1) is below it: a larger share has the same states, and more. A word has L entries
    of +-sqrt(D / L), the signs being the signs of `hash` with L bits and the same seed. Complete: words differ from
    each other, and a one-hot code has entries that no word has.

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
        whole_number(seed, f"mixed of {env.name}: seed", SEED_EXPECTED, least=0)
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
