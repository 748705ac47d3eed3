"""Rewards of the stored transitions: computed in parallel after the build, replaced without building again."""

import inspect
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError, StateSpaceError
from pharos.system.workers import usable_workers

if TYPE_CHECKING:
    from pharos.mdp.rewards import Rewards
    from pharos.state_space import StateSpace

_ROWS = 1 << 16


def rewards_of_space(space: "StateSpace", rewards: Any = None, *, workers: int | None = None) -> "Rewards":
    """The rewards of all transitions of a state space.

    Args:
        rewards: None, an (S, A) array, or a function reward(self, state, action, next_state) -> float, or with the
            outcome as one more argument.
        workers: threads; the result does not depend on them.
    Raises:
        ParameterError: the array has the wrong shape, or holds NaN or infinity.
        RuleError: the reward function gave NaN or infinity for a transition, which the message names.
    """
    from pharos.mdp.rewards import Rewards

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
            f"{space.folder}: pharos does not know the class {space.manifest['environment']!r}, so it cannot compute "
            f"the rewards; import the module that registers it, or pass rewards as an (S, A) array"
        )
    env = space.environment if rewards is None else _with_reward(space.environment, rewards)
    return _collected(space, env, _blocks(space, env, workers))


def ranged_rewards(space: "StateSpace") -> "Rewards":
    """The rewards by the rules, of which each range is computed when it is asked for."""
    from pharos.mdp.rewards import RangedRewards

    env = space.environment
    assert env is not None

    def compute(start: int, stop: int) -> "Rewards":
        return _collected(space, env, _blocks(space, env, None, start, stop), start, stop)

    return RangedRewards((space.num_states, space.num_actions), compute)


def rewards_of_staying(space: "StateSpace", reward: Callable | None = None) -> "Rewards":
    """What the rules pay for going from a state to itself, whether an action leads there or not; 0 in terminal states.

    Args:
        reward: a function reward(self, state, action, next_state) in place of the environment's.
    Raises:
        RuleError: NaN or infinity.
    """
    from pharos.rules import rules_of

    assert space.environment is not None
    env = space.environment if reward is None else _with_reward(space.environment, reward)
    rules, num_actions = rules_of(env).rewards, space.num_actions

    def blocks() -> Iterator[tuple[int, np.ndarray]]:
        for start in range(0, space.num_states, _ROWS):
            stop = min(start + _ROWS, space.num_states)
            states, terminal, count = space.packed_states[start:stop], space.terminal[start:stop], stop - start
            own = np.repeat(np.arange(count), num_actions)
            if space.has_chance:
                outcomes = np.arange(len(own)), own, np.ones(len(own))
                nothing = np.full(len(own), -1)
                yield start, rules.expected_block(states, outcomes, terminal, 0, count, nothing)
            else:
                table = own.reshape(count, num_actions).astype(space.successors.dtype)
                yield start, rules.block(states, table, terminal, 0, count)

    return _collected(space, env, blocks())


def _collected(
    space: "StateSpace",
    env: Environment,
    blocks: Iterator[tuple[int, np.ndarray]],
    first: int = 0,
    last: int | None = None,
) -> "Rewards":
    """Blocks (first state, rewards) of the states [first, last) as one; RuleError where one is not finite."""
    from pharos.mdp.rewards import RewardsCollector
    from pharos.rules import refused_reward

    stop = space.num_states if last is None else last
    collector = RewardsCollector((stop - first, space.num_actions))
    for start, block in blocks:
        if not np.isfinite(block).all():
            s, a = map(int, np.argwhere(~np.isfinite(block))[0])
            raise refused_reward(env, space.state(start + s), a, f"is {block[s, a]}; expected a finite number")
        collector.add(start - first, block)
    return collector.finish()


def rewards_of_outcomes(space: "StateSpace") -> np.ndarray:
    """What each possible outcome of a state space with chance pays when it is drawn: (N,) float64, in their order.

    Raises:
        RuleError: the reward function raised an exception.
    """
    from pharos.rules import rules_of

    assert space.environment is not None
    rules, num_actions = rules_of(space.environment).rewards, space.num_actions
    blocks = [np.empty(0)]
    for start in range(0, space.num_states, _ROWS):
        stop = min(start + _ROWS, space.num_states)
        which, successors, _ = space.outcomes.entries(start, stop, num_actions)
        number = np.arange(len(which)) - np.searchsorted(which, which)  # of each outcome within its row
        paid = np.zeros(len(which))
        for k in range(int(number.max(initial=-1)) + 1):  # as if the k-th were the only one
            now = number == k
            outcomes = which[now], successors[now], np.ones(int(now.sum()))
            ranks = np.full(len(outcomes[0]), k)
            means = rules.expected_block(space.packed_states, outcomes, space.terminal, start, stop, ranks)
            paid[now] = means.reshape(-1)[which[now]]
        blocks.append(paid)
    return np.concatenate(blocks)


def _blocks(
    space: "StateSpace", env: Environment, workers: int | None, first: int = 0, last: int | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """(start, rewards of the states from start on), in order, of the states [first, last)."""
    from pharos.rules import rules_of

    rules = rules_of(env).rewards
    end = space.num_states if last is None else last
    starts = range(first, end, _ROWS)
    states, terminal = space.packed_states, space.terminal
    successors = None if space.has_chance else space.successors

    def block(start: int) -> np.ndarray:
        stop = min(start + _ROWS, end)
        if successors is not None:
            return rules.block(states, successors, terminal, start, stop)
        outcomes = space.outcomes.entries(start, stop, space.num_actions)
        return rules.expected_block(states, outcomes, terminal, start, stop)

    threads = rules.threads(usable_workers(workers))
    with ThreadPoolExecutor(threads) as pool:
        window = 2 * threads
        pending = [pool.submit(block, start) for start in starts[:window]]
        for i, start in enumerate(starts):
            rewards = pending[i % window].result()
            if i + window < len(starts):
                pending[i % window] = pool.submit(block, starts[i + window])
            yield start, rewards


def _with_reward(env: Environment, reward: Callable) -> Environment:
    """An environment with the same rules and parameters but another reward function."""
    names = list(inspect.signature(reward).parameters)
    if len(names) not in (4, 5):
        raise ParameterError(
            f"a reward function takes (self, state, action, next_state); found ({', '.join(names)}); the outcome may "
            f"be a fifth argument"
        )
    cls: type[Environment] = type(type(env).__name__, (type(env),), {"reward": reward, "__module__": reward.__module__})
    return cls(**env.parameters)
