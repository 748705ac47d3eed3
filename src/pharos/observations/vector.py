"""Vectors: every component of the state, normalised by its declared range; one-hot; the number of the state."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.observations.hiding import hidden_names
from pharos.observations.observation import Observation

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

MOST_EXACT = 1 << 24  # integers up to here are told apart in float32
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
            the state is. As a function of the state they are 0; environments throw them. At most MOST_IRRELEVANT.
    Attributes:
        low, scale: (D,), the observation is (state - low) * scale.
    Raises:
        ParameterError: a component has more values than float32 tells apart; or too many irrelevant entries.
    Source: irrelevant features: Rajan et al. (2023), MDP Playground, whose irrelevant part is a chain of its own.
    """

    def __init__(self, env: Environment, *, hide: int | str | Sequence[str] = (), irrelevant: int = 0):
        from gymnasium.spaces import Box

        components = env.components
        if (components.size > MOST_EXACT).any():
            i = int(np.argmax(components.size))
            raise ParameterError(
                f"{env}: {components.names[i]} has {components.size[i]} values; the vector observation tells at most "
                f"{MOST_EXACT} apart: pass an observation of your own"
            )
        self.name = "vector"
        self.env = env
        self.names = components.names
        self.low = components.low
        self.scale = np.where(components.size > 1, 1 / np.maximum(components.size - 1, 1), 0.0)
        whose = f"vector of {env.name}"
        if isinstance(hide, int):
            if not -len(components.names) <= hide < 0:
                raise ParameterError(f"{whose}: hide is {hide}; expected a name, or -1 to -{len(components.names)}")
            hide = [components.names[hide]]
        for name in hidden_names(hide, whose, components.variables, components.names):
            self.scale[components.variables.get(name) or components.names.index(name)] = 0.0
        if isinstance(irrelevant, bool) or not isinstance(irrelevant, int) or not 0 <= irrelevant <= MOST_IRRELEVANT:
            raise ParameterError(
                f"{whose}: irrelevant is {irrelevant!r}; expected 0 to {MOST_IRRELEVANT} entries, so that a policy can "
                f"be asked about all their values in a state"
            )
        self.irrelevant = irrelevant
        self.names = (*components.names, *(f"irrelevant[{i}]" for i in range(irrelevant)))
        self.space = Box(0.0, 1.0, (len(self.names),), np.float32)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        from pharos.kernels.observation_kernels import normalize

        out = np.zeros((len(states), len(self.names or ())), np.float32)
        normalize(states, self.low, self.scale, out)
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
        whose = f"one_hot of {env.name}"
        for name in hidden_names(seen_first, whose, components.variables, components.names, "seen_first"):
            columns = components.variables.get(name) or components.names.index(name)
            for i in np.arange(len(components))[columns].ravel():
                self._first[self._offset[i] : self._offset[i] + components.size[i]] = True
        starts = env.initial_states() if self._first.any() else []
        if len(starts) > MOST_STARTS:
            raise ParameterError(f"{whose}: seen_first with {len(starts)} start states; expected at most {MOST_STARTS}")
        self._starts = np.array([state for state, _ in starts], np.int64)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        from pharos.kernels.observation_kernels import mark_components

        out = np.zeros((len(states), len(self.names or ())), np.int8)
        mark_components(states, self._low, self._offset, out)
        if len(self._starts):
            is_start = np.zeros(len(states), bool)
            for start in self._starts:
                is_start |= (states == start).all(axis=1)
            out[np.ix_(~is_start, self._first)] = 0
        return out


class Index(Observation):
    """The number of the state in a built state space: Discrete(S). Complete; what tabular agents learn from.

    Raises:
        ParameterError: no state space was given, or one of another environment.
    """

    def __init__(self, env: Environment, state_space: "StateSpace | None" = None):
        from gymnasium.spaces import Discrete

        if state_space is None:
            raise ParameterError(f"{env}: observation 'index' needs the built state space: space=pharos.build(env)")
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

    def one(self, state: np.ndarray) -> Any:
        return self.state_space.indices(state[None])[0]
