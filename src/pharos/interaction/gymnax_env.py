"""A tabular MDP as an environment of gymnax, for agents in JAX: jit, vmap and scan go through it. Needs the extra jax.

The tables are parameters of the environment, arrays on the device, so that one compiled program steps any MDP of the
same shape, and `vmap` over parameters trains on several at once.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnax.environments import environment, spaces

from pharos.mdp import TabularMDP


@struct.dataclass
class EnvState(environment.EnvState):
    """State of an episode.

    Attributes:
        time: steps so far.
        index: number of the state. S is the end.
        previous: the action that was executed last, A before the first step.
    """

    time: jax.Array
    index: jax.Array
    previous: jax.Array


@struct.dataclass
class EnvParams:
    """The tables of an MDP with S states, A actions and at most K outcomes of an action.

    Attributes:
        max_steps_in_episode: time limit.
        successors: (S + 1, A, K) int32. The last row is the end.
        cumulative: (S + 1, A, K) float32, cumulated probabilities of the outcomes.
        rewards: (S + 1, A) float32, what executing an action pays on average.
        ends: (S + 1,) bool, whether an episode is over there.
        starts, start_cumulative: (N,) int32, (N,) float32: start states and their cumulated probabilities.
        observations: (S + 1, ...) what is seen of each state.
        chance: (4,) float32: probabilities that the chosen, the previous, a uniform action is executed, and that the
            chosen one is on the first step.
        available: (S + 1, A) bool, the actions that exist in each state, all at the end.
    """

    max_steps_in_episode: int
    successors: jax.Array
    cumulative: jax.Array
    rewards: jax.Array
    ends: jax.Array
    starts: jax.Array
    start_cumulative: jax.Array
    observations: jax.Array
    chance: jax.Array
    available: jax.Array


class GymnaxEnv(environment.Environment):
    """A tabular MDP. `default_params` holds its tables.

    Args:
        mdp: with its chance.
        observations: (S, ...) what is seen of each state.
        low, high: of the observations.
        time_limit: steps of an episode.
        name: of the environment.
        reward_noise: standard deviation of what is added to each reward.
    """

    def __init__(
        self,
        mdp: TabularMDP,
        observations: np.ndarray,
        low: float,
        high: float,
        time_limit: int,
        name: str,
        reward_noise: float = 0.0,
    ):
        super().__init__()
        self._reward_noise, self._has_sets = reward_noise, mdp.available is not None
        everything = np.ones((mdp.num_states + 1, mdp.num_actions), np.bool_)
        if mdp.available is not None:
            everything[:-1] = mdp.available
        self._name, self._num_actions, self._num_states = name, mdp.num_actions, mdp.num_states
        self._space = spaces.Box(low, high, observations.shape[1:], observations.dtype)
        nothing = np.zeros_like(observations[:1])
        cumulative = np.cumsum(mdp.start_probabilities)
        successors, probabilities = _padded_outcomes(mdp)
        ends = np.append(np.asarray(mdp.terminal, np.bool_), True)
        rewards = np.vstack([np.where(ends[:-1, None], 0.0, mdp.rewards), np.zeros((1, mdp.num_actions))])
        params_class: Any = EnvParams  # whose fields flax declares
        self._params = params_class(
            max_steps_in_episode=time_limit,
            successors=jnp.asarray(successors, jnp.int32),
            cumulative=jnp.asarray(probabilities, jnp.float32),
            rewards=jnp.asarray(rewards, jnp.float32),
            ends=jnp.asarray(ends),
            starts=jnp.asarray(mdp.start_states, jnp.int32),
            start_cumulative=jnp.asarray(cumulative, jnp.float32),
            observations=jnp.asarray(np.concatenate([observations, nothing])),
            chance=jnp.asarray([*mdp.chance.triple, mdp.chance.first_chosen], jnp.float32),
            available=jnp.asarray(everything),
        )

    def joined_ends(self) -> "JoinedEnds":
        """This environment with the `step` of gymnax before 1.0, which returns one `done`."""
        other = object.__new__(JoinedEnds)
        other.__dict__.update(self.__dict__)
        return other

    @property
    def default_params(self) -> EnvParams:
        """The tables of the MDP."""
        return self._params

    @property
    def name(self) -> str:
        """Name of the environment as pharos writes it."""
        return self._name

    @property
    def num_actions(self) -> int:
        """Number of actions A."""
        return self._num_actions

    def step_env(self, key: jax.Array, state: EnvState, action: jax.Array, params: EnvParams) -> tuple[Any, ...]:
        """One step: (observation, state, reward, whether a terminal state was reached, info)."""
        key_which, key_uniform, key_outcome = jax.random.split(key, 3)
        p_action, p_previous, _, p_first_action = params.chance
        u = jax.random.uniform(key_which)
        is_first = state.previous == self._num_actions
        if self._has_sets:
            mask = params.available[state.index]
            action = jnp.where(mask[action], action, jnp.argmax(mask))
            rank = jax.random.randint(key_uniform, (), 0, mask.sum())
            uniform = jnp.argmax(jnp.cumsum(mask) > rank)
            is_first |= ~mask[jnp.minimum(state.previous, self._num_actions - 1)]
        else:
            uniform = jax.random.randint(key_uniform, (), 0, self._num_actions)
        later = jnp.where(u < p_action, action, jnp.where(u < p_action + p_previous, state.previous, uniform))
        first = jnp.where(u < p_first_action, action, uniform)
        executed = jnp.where(is_first, first, later).astype(jnp.int32)
        outcome = _first_above(params.cumulative[state.index, executed], jax.random.uniform(key_outcome))
        next_index = params.successors[state.index, executed, outcome]
        reward = params.rewards[state.index, executed]
        if self._reward_noise:  # its key does not change the keys of the steps
            reward += self._reward_noise * jax.random.normal(jax.random.fold_in(key, 3))
        after = EnvState(time=state.time + 1, index=next_index, previous=executed)
        is_over = params.ends[next_index]
        info = {"discount": jnp.where(is_over, 0.0, 1.0), "executed": executed}
        if self._has_sets:
            info["action_mask"] = params.available[next_index]
        return self.get_obs(after, params), after, reward, is_over, info

    def reset_env(self, key: jax.Array, params: EnvParams) -> tuple[jax.Array, EnvState]:
        """A start state: (observation, state)."""
        index = params.starts[_first_above(params.start_cumulative, jax.random.uniform(key))]
        state = EnvState(
            time=jnp.zeros((), jnp.int32), index=index, previous=jnp.full((), self._num_actions, jnp.int32)
        )
        return self.get_obs(state, params), state

    def get_obs(self, state: EnvState, params: EnvParams | None = None, key: jax.Array | None = None) -> jax.Array:
        """Observation of a state."""
        return (self._params if params is None else params).observations[state.index]

    def action_mask(self, state: EnvState, params: EnvParams | None = None) -> jax.Array:
        """(A,) bool, the actions that are available in a state, also in the first one of an episode."""
        return (self._params if params is None else params).available[state.index]

    def is_terminated(self, state: EnvState, params: EnvParams) -> jax.Array:
        """Whether a terminal state was reached."""
        return params.ends[state.index]

    def action_space(self, params: EnvParams | None = None) -> spaces.Discrete:
        """Discrete(A)."""
        return spaces.Discrete(self._num_actions)

    def observation_space(self, params: EnvParams | None = None) -> spaces.Box:
        """A Box."""
        return self._space

    def state_space(self, params: EnvParams | None = None) -> spaces.Dict:
        """A Dict of the components of `EnvState`."""
        limit = (self._params if params is None else params).max_steps_in_episode
        return spaces.Dict(
            {
                "time": spaces.Discrete(limit + 1),
                "index": spaces.Discrete(self._num_states + 1),
                "previous": spaces.Discrete(self._num_actions + 1),
            }
        )


class JoinedEnds(GymnaxEnv):
    """`GymnaxEnv` for agents of gymnax before 1.0, such as rejax 0.1: `step` joins both kinds of end to `done`."""

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: EnvParams | None = None
    ) -> tuple[Any, ...]:
        """(observation, state, reward, done, info)."""
        observation, after, reward, terminated, truncated, info = super().step(key, state, action, params)
        return observation, after, reward, jnp.logical_or(terminated, truncated), info


def _first_above(cumulative: jax.Array, u: jax.Array) -> jax.Array:
    """The first entry whose cumulated probability exceeds u. Entries that cannot be drawn come after all others."""
    return jnp.minimum(jnp.sum(u >= cumulative), len(cumulative) - 1)


def _padded_outcomes(mdp: TabularMDP) -> tuple[np.ndarray, np.ndarray]:
    """(S + 1, A, K) next states, S for the end, and cumulated probabilities, 1 from the last possible outcome on."""
    num_states, num_actions = mdp.num_states, mdp.num_actions
    states = np.repeat(np.arange(num_states), num_actions)
    outcomes = mdp.dynamics.outcomes(states, np.tile(np.arange(num_actions), num_states))
    which = np.asarray(outcomes.which)
    order = np.argsort(which, kind="stable")
    which = which[order]
    index = np.arange(len(which)) - np.searchsorted(which, which)
    pairs, width = num_states * num_actions, int(index.max(initial=0)) + 1
    successors, cumulative = np.full((pairs, width), num_states), np.zeros((pairs, width))
    successors[which, index] = np.asarray(outcomes.states)[order]
    cumulative[which, index] = np.asarray(outcomes.probabilities)[order]
    counts = np.bincount(which, minlength=pairs)
    cumulative = np.cumsum(cumulative, axis=1)
    cumulative[np.arange(width) >= counts[:, None] - 1] = 1.0
    end = np.full((1, num_actions, width), num_states), np.ones((1, num_actions, width))
    shape = (num_states, num_actions, width)
    return np.concatenate([successors.reshape(shape), end[0]]), np.concatenate([cumulative.reshape(shape), end[1]])
