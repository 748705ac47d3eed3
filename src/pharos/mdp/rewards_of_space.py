"""Rewards of the stored transitions: computed in parallel after the build, replaced without building again."""

import inspect
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError, RuleError, StateSpaceError
from pharos.rules.traced import WORTH_TRACING, TracedReward

if TYPE_CHECKING:
    from pharos.mdp.rewards import Rewards
    from pharos.state_space.store import StateSpace

_ROWS = 1 << 16


def rewards_of_space(space: "StateSpace", rewards: Any = None, *, workers: int | None = None) -> "Rewards":
    """The rewards of all transitions of a state space.

    Args:
        rewards: None, an (S, A) array, or a function reward(self, state, action, next_state) -> float.
        workers: threads; the result does not depend on them.
    Raises:
        ParameterError: the array has the wrong shape, or holds NaN or infinity.
        RuleError: the reward function gave NaN or infinity for a transition, which the message names.
    """
    from pharos.mdp.rewards import Rewards, RewardsCollector

    shape = (space.num_states, space.num_actions)
    if rewards is not None and not callable(rewards):
        array = np.asarray(rewards, np.float64)
        if array.shape != shape:
            raise ParameterError(
                f"{space}: rewards have shape {array.shape}; expected {shape}, one for each state and action"
            )
        return Rewards.from_array(array)
    if space.environment is None:
        raise StateSpaceError(
            f"{space.folder}: pharos does not know the class {space.manifest['environment']!r}, so it cannot compute the "
            f"rewards; import the module that registers it, or pass rewards as an (S, A) array"
        )
    env = space.environment if rewards is None else _with_reward(space.environment, rewards)
    collector = RewardsCollector(shape)
    for start, block in _blocks(space, env, workers):
        if not np.isfinite(block).all():
            s, a = map(int, np.argwhere(~np.isfinite(block))[0])
            raise _refused(space, env, start + s, a, f"is {block[s, a]}; expected a finite number")
        collector.add(start, block)
    return collector.finish()


def _refused(space: "StateSpace", env: Environment, s: int, a: int, why: str) -> RuleError:
    return RuleError(f"{env}: reward of action {env.actions[a]!r} in state {space.state(s)} {why}")


def _blocks(space: "StateSpace", env: Environment, workers: int | None):
    """(start, rewards of the states from start on), in order."""
    from pharos.rules.compiled import compiled_rules
    from pharos.workers import usable_workers

    starts = range(0, space.num_states, _ROWS)
    rules = compiled_rules(env, space.layout.num_words, ["rewards_of"])
    states, successors, terminal = space.packed_states, space.successors, space.terminal
    if rules is None:
        traced = TracedReward(env)
        for start in starts:
            block = _traced_rewards(space, traced, start)
            yield start, _interpreted_rewards(space, env, start) if block is None else block
        return

    def compiled(start: int) -> np.ndarray:
        stop = min(start + _ROWS, space.num_states)
        out = np.empty((stop - start, space.num_actions))
        try:
            rules.kernels.rewards_of(
                rules.parameters, space.layout.tables, states, successors, terminal, start, stop, out
            )
        except Exception as error:  # of the rule, such as a division by zero: name the state
            out = _interpreted_rewards(space, env, start)
            if np.isfinite(out).all():
                raise RuleError(f"{env}: compiled, reward raises {error!r}; interpreted it does not") from error
        return out

    with ThreadPoolExecutor(usable_workers(workers)) as pool:
        window = 2 * usable_workers(workers)
        pending = [pool.submit(compiled, start) for start in starts[:window]]
        for i, start in enumerate(starts):
            block = pending[i % window].result()
            if i + window < len(starts):
                pending[i % window] = pool.submit(compiled, starts[i + window])
            yield start, block


def _traced_rewards(space: "StateSpace", traced: TracedReward, start: int) -> np.ndarray | None:
    """The same by tracing the rule; None where that does not work."""
    stop = min(start + _ROWS, space.num_states)
    if not traced.is_on or stop - start < WORTH_TRACING:
        return None
    successors = np.asarray(space.successors[start:stop])
    following = space.states(successors.ravel()).reshape(*successors.shape, -1)
    going = np.flatnonzero(~np.asarray(space.terminal[start:stop]))
    return traced.rewards(space.states(slice(start, stop)), following, going)


def _interpreted_rewards(space: "StateSpace", env: Environment, start: int) -> np.ndarray:
    """Rewards of the states from `start` on, the rule called in Python."""
    stop = min(start + _ROWS, space.num_states)
    out = np.zeros((stop - start, space.num_actions))
    rows = list(map(tuple, space.states(slice(start, stop)).tolist()))
    going = np.flatnonzero(~space.terminal[start:stop]).tolist()
    with np.errstate(all="ignore"):  # what is not finite is reported
        for a in range(space.num_actions):
            following = list(map(tuple, space.states(space.successors[start:stop, a]).tolist()))
            for i in going:
                try:
                    out[i, a] = env.reward(rows[i], a, following[i])
                except Exception as error:
                    raise _refused(space, env, start + i, a, f"raises {error!r}") from error
    return out


def _with_reward(env: Environment, reward: Callable) -> Environment:
    """An environment with the same rules and parameters but another reward function."""
    names = list(inspect.signature(reward).parameters)
    if len(names) != 4:
        raise ParameterError(f"a reward function takes (self, state, action, next_state); found ({', '.join(names)})")
    cls: type[Environment] = type(type(env).__name__, (type(env),), {"reward": reward, "__module__": reward.__module__})
    return cls(**env.parameters)
