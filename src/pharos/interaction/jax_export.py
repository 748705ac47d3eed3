"""`to_gymnax`: a state space or an MDP for agents in JAX. JAX is loaded when it is called."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import MissingExtra, ParameterError
from pharos.mdp import TabularMDP
from pharos.observations import observe
from pharos.state_space import StateSpace

if TYPE_CHECKING:
    from pharos.interaction.gymnax_env import GymnaxEnv

EXPORT_BLOCK = 1 << 14  # states that are observed at once


def to_gymnax(
    source: StateSpace | TabularMDP,
    observation: object = "vector",
    *,
    observation_options: Mapping[str, Any] | None = None,
    time_limit: int | None = None,
    joined_ends: bool = False,
    reward_noise: float = 0.0,
) -> "GymnaxEnv":
    """Return a state space or an MDP as an environment of gymnax: `jit`, `vmap` and `scan` go through `reset` and
    `step`.

    Its tables are in `env.default_params`. What is executed and what follows is drawn as the MDP says: sticky, random
    and lazy actions, chance of the rules. The mean reward of what is executed is paid. If some actions are not
    available in some states, a choice of one acts as the first available action, as in `GymEnv`;
    `env.action_mask(state)` and `info["action_mask"]` say which are.

    Args:
        source: a built space, or an MDP, with its chance.
        observation, observation_options: what is seen, as `pharos.observe` takes it, or an array (S, ...). Of an MDP
            that was not made from a space only an array.
        time_limit: steps of an episode. Default: the MDP's horizon, else the limit of the environment.
        joined_ends: whether `step` returns one `done` in place of terminated and truncated, as before gymnax 1.0 and
            as rejax 0.1 expects.
        reward_noise: standard deviation of what is added to each reward.
    Raises:
        MissingExtra: JAX or gymnax is not installed. ParameterError: nothing says what is seen, or how long episodes
            are.
    Cost: S x A x K x 8 bytes for at most K outcomes, and the observations of all states, on the device.
    """
    try:
        from pharos.interaction.gymnax_env import GymnaxEnv, JoinedEnds
    except ImportError as error:
        raise MissingExtra("to_gymnax", str(error.name or "gymnax"), "jax") from error
    mdp = source.mdp(gamma=1.0) if isinstance(source, StateSpace) else source
    if not isinstance(mdp, TabularMDP):
        raise ParameterError(f"to_gymnax: found {source!r}; expected a StateSpace or a TabularMDP")
    space = mdp.space
    env = None if space is None else space.environment
    limit = time_limit or mdp.horizon or (env.max_episode_steps if env is not None else None)
    if limit is None:
        raise ParameterError(f"to_gymnax: nothing says how long episodes of {mdp} are; give a time_limit")
    if isinstance(observation, np.ndarray):
        if len(observation) != mdp.num_states:
            raise ParameterError(f"observation has {len(observation)} rows; expected one for each of {mdp.num_states}")
        observations, low, high = observation, float(observation.min()), float(observation.max())
    elif space is None or env is None:
        raise ParameterError(f"to_gymnax: {mdp} was not made from a state space; give an array (S, ...) as observation")
    else:
        observations, low, high = _observed(space, env, observation, dict(observation_options or {}))
    env_class = JoinedEnds if joined_ends else GymnaxEnv
    name = str(env if env is not None else mdp)
    return env_class(mdp, observations, low, high, int(limit), name, reward_noise)


def _observed(
    space: StateSpace, env: Environment, name: object, options: dict[str, Any]
) -> tuple[np.ndarray, float, float]:
    """(S, ...) observations of all states, and their bounds."""
    observation = observe(env, name, state_space=space, **options)
    blocks = [
        observation(space.states(slice(first, first + EXPORT_BLOCK)))
        for first in range(0, space.num_states, EXPORT_BLOCK)
    ]
    observations = np.concatenate(blocks)
    if observations.ndim == 1:
        observations = observations[:, None]
    low, high = getattr(observation.space, "low", observations), getattr(observation.space, "high", observations)
    return observations, float(np.min(low)), float(np.max(high))
