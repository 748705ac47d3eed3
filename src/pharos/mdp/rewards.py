"""Rewards of all transitions, held exactly and compactly.

Games pay few different rewards: up to 256 distinct values are kept as one byte for each transition and a palette of
float64, an eighth of the memory of (S, A) float64 and an eighth of what a sweep has to stream. More are kept as
float64.

Rewards of stored transitions are computed in parallel after the build, and replaced without building again.
"""

import inspect
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from pharos.environments import Environment
from pharos.errors import ParameterError, StateSpaceError
from pharos.kernels import outcomes
from pharos.mdp.arguments import array_argument
from pharos.system.arrays import read_only
from pharos.system.memory import large_zeros
from pharos.system.workers import usable_workers

if TYPE_CHECKING:
    import numpy.typing as npt

    from pharos.mdp.tabular import TabularMDP
    from pharos.state_space import StateSpace


_REWARD_BLOCK = 1 << 16
# Entries of a palette that each reward is compared with, before it is searched for.
_FEW_ENTRIES = 4


@dataclass(frozen=True)
class Rewards:
    """Rewards of S states and A actions: `palette[table[s, a]]`, or `table[s, a]` if the palette is empty.

    Attributes:
        table: (S, A) uint8 codes, or (S, A) float64 rewards.
        palette: (at most 256,) float64, or empty.
        rounding: bound on the error of each reward: 0 for rewards that were given, above it for means of several.
        is_of_many: whether these are some states of an MDP with so many that its sweeps are unrolled.
    """

    table: np.ndarray
    palette: np.ndarray
    rounding: float = 0.0
    is_of_many: bool = False

    @staticmethod
    def from_array(rewards: np.ndarray, rounding: float = 0.0) -> "Rewards":
        """Make rewards of (S, A) numbers. ParameterError if one is NaN or infinite."""
        rewards = np.asarray(rewards, np.float64)
        collector = RewardsCollector((rewards.shape[0], rewards.shape[1]))
        for start in range(0, len(rewards), _REWARD_BLOCK):
            block = rewards[start : start + _REWARD_BLOCK]
            if not np.isfinite(block).all():
                s, a = map(int, np.argwhere(~np.isfinite(block))[0])
                raise ParameterError(
                    f"the reward of state {start + s}, action {a} is {block[s, a]}; expected a finite number"
                )
            collector.add(start, block)
        return collector.finish(rounding)

    @property
    def shape(self) -> tuple[int, int]:
        """(S, A)."""
        return self.table.shape  # type: ignore[return-value]

    @property
    def is_unrolled(self) -> bool:
        """Whether sweeps over them are compiled for their kind, see `kernels.outcomes`."""
        return self.is_of_many or outcomes.is_unrolled(self.shape[0])

    @cached_property
    def for_kernels(self) -> tuple[np.ndarray, np.ndarray]:
        """(table, palette), the arguments of kernels. The rewards of few states are float64, one type for all."""
        if self.is_unrolled:
            return read_only(self.table), read_only(self.palette)
        return read_only(np.ascontiguousarray(self.array)), read_only(np.empty(0))

    @property
    def array(self) -> np.ndarray:
        """(S, A) float64, made anew by each call if the rewards are kept as a palette."""
        return self.rows(slice(None))

    def rows(self, states: slice | np.ndarray) -> np.ndarray:
        """(N, A) float64, the rewards of some states."""
        return self.palette[self.table[states]] if len(self.palette) else self.table[states]

    def of(self, states: slice | np.ndarray) -> "Rewards":
        """The rewards of some states alone."""
        return Rewards(np.asarray(self.table[states]), self.palette, self.rounding, self.is_unrolled)

    def mixed(self, other: "Rewards", p: float) -> "Rewards":
        """(1 - p) times these rewards plus p times others of the same shape.

        A mean is never outside of its two rewards, so it is exact if these are equal. Otherwise each of its two
        terms is rounded up to three times (1 - p, the product, the sum), which `rounding` counts.
        """
        collector, largest = RewardsCollector(self.shape), -1.0  # no two rewards that differ
        for start in range(0, len(self.table), _REWARD_BLOCK):
            own, theirs = (each.rows(slice(start, start + _REWARD_BLOCK)) for each in (self, other))
            terms = (1.0 - p) * own, p * theirs
            collector.add(start, np.clip(sum(terms), np.minimum(own, theirs), np.maximum(own, theirs)))
            sizes = np.abs(terms[0]) + np.abs(terms[1])
            largest = float(np.max(sizes, where=own != theirs, initial=largest))
        rounding = rounding_of_mean(2, largest) if largest >= 0 else 0.0
        return collector.finish(max(self.rounding, other.rounding) + rounding)

    @cached_property
    def unit(self) -> float:
        """The largest power of two, 1 at most, of which all rewards are whole multiples. 0 if they are rounded, or
        more than a palette has."""
        if not len(self.palette) or self.rounding:
            return 0.0
        return 1.0 / max(float(each).as_integer_ratio()[1] for each in self.palette)

    @property
    def lowest(self) -> float:
        """The smallest reward."""
        return float(self.palette.min() if len(self.palette) else self.table.min())

    @property
    def highest(self) -> float:
        """The largest reward."""
        return float(self.palette.max() if len(self.palette) else self.table.max())


class RangedRewards(Rewards):
    """Rewards of a state space that are computed when they are read, of a range of states or of all.

    Attributes:
        whole: the rewards of all states, once they were computed, else None.
    """

    def __init__(self, shape: tuple[int, int], compute: Callable[[int, int], Rewards]):
        """compute(start, stop): the rewards of the states [start, stop)."""
        vars(self).update(_shape=shape, _compute=compute, whole=None)  # the class is frozen

    @property
    def shape(self) -> tuple[int, int]:
        return vars(self)["_shape"]

    @property
    def rounding(self) -> float:  # type: ignore[override]
        return self._computed().rounding

    def __getattr__(self, name: str) -> np.ndarray:
        if name not in ("table", "palette"):
            raise AttributeError(name)
        return getattr(self._computed(), name)

    def _computed(self) -> Rewards:
        if vars(self)["whole"] is None:
            vars(self)["whole"] = vars(self)["_compute"](0, self.shape[0])
        return vars(self)["whole"]

    def of(self, states: slice | np.ndarray) -> Rewards:
        if vars(self)["whole"] is None and isinstance(states, slice) and states.step is None:
            start, stop, _ = states.indices(self.shape[0])
            return vars(self)["_compute"](start, stop)
        return super().of(states)


@dataclass
class RewardsCollector:
    """Collector of rewards, block by block. They end with a palette if few are distinct."""

    shape: tuple[int, int]
    _codes: np.ndarray | None = None
    _values: np.ndarray | None = None
    _palette: np.ndarray = field(default_factory=lambda: np.empty(0))

    def add(self, start: int, block: np.ndarray) -> None:
        """Add the rewards of the states from `start` on."""
        if self._values is None:
            if self._codes is None:
                self._codes = large_zeros(self.shape, np.uint8)
            entries = self._palette
            if self._is_known(start, block):
                return
            new = np.setdiff1d(block, entries)  # sorted and unique
            if len(entries) + len(new) <= 256:
                self._palette = palette = np.concatenate([entries, new])
                order = np.argsort(palette)
                codes = order[np.searchsorted(palette[order], block)]
                self._codes[start : start + len(block)] = codes
                return
            self._values = entries[self._codes] if len(entries) else np.zeros(self.shape)
            self._codes = None
        self._values[start : start + len(block)] = block

    def _is_known(self, start: int, block: np.ndarray) -> bool:
        """Enter a block whose rewards are all among the first few of the palette. Return whether they are."""
        assert self._codes is not None
        codes, left = np.zeros(block.shape, np.uint8), block.size
        for code, reward in enumerate(self._palette[:_FEW_ENTRIES]):
            equal = block == reward
            left -= int(np.count_nonzero(equal))
            codes += equal.view(np.uint8) * np.uint8(code)
        if left == 0:
            self._codes[start : start + len(block)] = codes
        return left == 0

    def finish(self, rounding: float = 0.0) -> Rewards:
        """The rewards of all states, each within `rounding` of the true one."""
        if self._values is not None:
            return Rewards(self._values, np.empty(0), rounding)
        codes = self._codes if self._codes is not None else np.zeros(self.shape, np.uint8)
        return Rewards(codes, self._palette if len(self._palette) else np.zeros(1), rounding)


def rounding_of_mean(outcomes: int, largest: float) -> float:
    """A bound on the error of a mean that was added up from products of probabilities and rewards.

    Each product is rounded at most once more than there are terms, and numbers below 2^-1022 have no digits to lose.

    Args:
        outcomes: the number of terms.
        largest: bound on the sum of the absolute products, or on the rewards.
    """
    return (outcomes + 2) * (2.0**-53 * largest + 2.0**-1074)


# Given by users -------------------------------------------------------------------------------------------------------


def rewards_of_shape(rewards: npt.ArrayLike | Rewards, shape: tuple[int, ...]) -> Rewards:
    """Rewards of an array, or those that were made. ParameterError if their shape is not `shape`, or not finite."""
    array = rewards.array if isinstance(rewards, Rewards) else array_argument(rewards, "rewards", np.float64)
    if array.shape != shape:
        raise ParameterError(f"rewards have shape {array.shape}; expected {shape}, one for each state and action")
    return rewards if isinstance(rewards, Rewards) else Rewards.from_array(array)


def expected_over_outcomes(
    rewards: npt.ArrayLike, probabilities: np.ndarray
) -> tuple[Rewards | np.ndarray, np.ndarray | float]:
    """((S, A) expected rewards, the largest that an outcome pays): as given, and 0, or means of rewards (S, A, K).

    Raises:
        ParameterError: they have neither shape, or one of a possible outcome is not finite.
    """
    array, shape = array_argument(rewards, "rewards", np.float64), probabilities.shape
    if array.shape == shape[:2]:
        return array, 0.0
    if array.shape != shape:
        raise ParameterError(
            f"rewards have shape {array.shape}; expected {shape[:2]}, one for each state and action, or {shape}, one "
            "for each outcome"
        )
    possible = probabilities > 0
    wrong = possible & ~np.isfinite(array)
    if wrong.any():
        s, a, k = map(int, np.argwhere(wrong)[0])
        raise ParameterError(
            f"the reward of state {s}, action {a}, outcome {k} is {array[s, a, k]}; expected a finite number"
        )
    rewards_of_outcomes = np.where(possible, array, 0.0)
    return means_of(probabilities * rewards_of_outcomes), np.abs(rewards_of_outcomes).max(axis=2)


def means_of(terms: np.ndarray) -> Rewards:
    """Expected rewards, from the products (S, A, K) of probabilities and rewards."""
    largest = float(np.abs(terms).sum(axis=2).max())
    return Rewards.from_array(terms.sum(axis=2), rounding_of_mean(terms.shape[2], largest))


# Rewards of stored transitions ----------------------------------------------------------------------------------------


_RECORDED_ROWS = 1 << 16
# (first state, rewards (N, A), the largest absolute reward of an outcome that was averaged)
Blocks = Iterator[tuple[int, np.ndarray, float]]


def rewards_of_space(space: "StateSpace", rewards: "npt.ArrayLike | Callable[..., float] | None" = None) -> "Rewards":
    """The rewards of all transitions of a state space.

    Args:
        rewards: None, an (S, A) array, or a function reward(self, state, action, next_state) -> float, or with the
            outcome as one more argument.
    Raises:
        ParameterError: the array has the wrong shape, or holds NaN or infinity.
        RuleError: the reward function gave NaN or infinity for a transition, which the message names.
    """
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
    return _rewards_of_blocks(space, env, _blocks(space, env))


def ranged_rewards(space: "StateSpace") -> "Rewards":
    """The rewards by the rules, of which each range of states is computed when it is read."""
    env = space.environment
    assert env is not None

    def compute(start: int, stop: int) -> "Rewards":
        return _rewards_of_blocks(space, env, _blocks(space, env, start, stop), start, stop)

    return RangedRewards((space.num_states, space.num_actions), compute)


def rewards_of_staying(space: "StateSpace", reward: Callable | None = None) -> "Rewards":
    """(S, A) rewards by the rules for going from a state to itself, possible or not, 0 in terminal states.

    Args:
        reward: a function reward(self, state, action, next_state) in place of the environment's.
    Raises:
        RuleError: NaN or infinity.
    """
    from pharos.rules import rules_of

    assert space.environment is not None
    env = space.environment if reward is None else _with_reward(space.environment, reward)
    rules, num_actions = rules_of(env).rewards_of(space.num_states), space.num_actions

    def blocks() -> Blocks:
        for start in range(0, space.num_states, _RECORDED_ROWS):
            stop = min(start + _RECORDED_ROWS, space.num_states)
            states, terminal, count = space.packed_states[start:stop], space.terminal[start:stop], stop - start
            own = np.repeat(np.arange(count), num_actions)
            if space.has_chance:
                outcomes = np.arange(len(own)), own, np.ones(len(own))
                nothing = np.full(len(own), -1)
                yield start, rules.expected_block(states, outcomes, terminal, 0, count, nothing), 0.0
            else:
                table = own.reshape(count, num_actions).astype(space.successors.dtype)
                yield start, rules.block(states, table, terminal, 0, count), 0.0

    return _rewards_of_blocks(space, env, blocks())


def _rewards_of_blocks(
    space: "StateSpace",
    env: Environment,
    blocks: Blocks,
    first: int = 0,
    last: int | None = None,
) -> "Rewards":
    """Rewards of the states [first, last), from blocks. RuleError if one is not finite."""
    from pharos.rules import refused_reward

    stop = space.num_states if last is None else last
    collector, largest = RewardsCollector((stop - first, space.num_actions)), 0.0
    for start, block, averaged in blocks:
        largest = max(largest, averaged)
        if not np.isfinite(block).all():
            s, a = map(int, np.argwhere(~np.isfinite(block))[0])
            raise refused_reward(env, space.state(start + s), a, f"is {block[s, a]}; expected a finite number")
        collector.add(start - first, block)
    return collector.finish(rounding_of_mean(env.outcomes, largest) if largest else 0.0)


def rewards_of_outcomes(space: "StateSpace") -> np.ndarray:
    """(N,) float64, the reward of each possible outcome of a state space with chance, in the order of the outcomes.

    Raises:
        RuleError: the reward function raised an exception.
    """
    from pharos.rules import rules_of

    assert space.environment is not None
    rules = rules_of(space.environment).rewards_of(space.num_states)
    blocks = [np.empty(0)]
    for start in range(0, space.num_states, _RECORDED_ROWS):
        stop = min(start + _RECORDED_ROWS, space.num_states)
        which, successors, _ = space.dynamics.entries_of(np.arange(start, stop))
        number = np.arange(len(which)) - np.searchsorted(which, which)  # of each outcome within its row
        rewards = np.zeros(len(which))
        for k in range(int(number.max(initial=-1)) + 1):  # as if the k-th were the only one
            now = number == k
            outcomes = which[now], successors[now], np.ones(int(now.sum()))
            ranks = np.full(len(outcomes[0]), k)
            means = rules.expected_block(space.packed_states, outcomes, space.terminal, start, stop, ranks)
            rewards[now] = means.reshape(-1)[which[now]]
        blocks.append(rewards)
    return np.concatenate(blocks)


class PaidOutcomes(NamedTuple):
    """Possible next states and rewards of executed actions, in all states.

    Attributes:
        which: (N,) row s A + a of the state and the executed action, ascending.
        states: (N,) next states, S for the end.
        rewards: (N,) reward of the outcome.
        probabilities: (N,) float64 > 0.
    """

    which: np.ndarray
    states: np.ndarray
    rewards: np.ndarray
    probabilities: np.ndarray


def paid_outcomes(mdp: "TabularMDP") -> PaidOutcomes:
    """The possible outcomes of all states and executed actions of an MDP, each with its own reward.

    A reward is the outcome's own if the MDP is of an environment whose rewards it has, else the expected one of
    state and action. Cost: some 50 bytes an outcome, for MDPs that fit.
    """
    num_states, num_actions = mdp.num_states, mdp.num_actions
    expected = np.ravel(mdp.rewards)
    rows = np.arange(num_states * num_actions)
    which, states, probabilities = mdp.dynamics.outcomes(rows // num_actions, rows % num_actions)
    outcomes = PaidOutcomes(which, np.asarray(states, np.int64), expected[which], probabilities)
    own = _outcomes_of_environment(mdp)
    if own is None:
        return outcomes
    count = len(expected)
    mean = np.bincount(own.which, own.rewards * own.probabilities, count)
    largest = np.ones(count)
    np.maximum.at(largest, own.which, np.abs(own.rewards))
    is_own = np.abs(mean - expected) <= 1e-9 * largest  # else rewards were replaced
    parts = [
        [column[is_taken[table.which]] for column in table] for table, is_taken in ((own, is_own), (outcomes, ~is_own))
    ]
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    return PaidOutcomes(*(column[order] for column in joined))


def _outcomes_of_environment(mdp: "TabularMDP") -> PaidOutcomes | None:
    """Outcomes with rewards by the rules, if the MDP has chance and is of an environment, else None."""
    space = mdp.space
    if space is None or space.environment is None or mdp.dynamics.is_deterministic:
        return None
    rows, stays = np.arange(space.num_states * space.num_actions), mdp.laziness
    if space.has_chance:
        which, successors, probabilities = space.dynamics.entries_of(np.arange(space.num_states))
        columns = [which, successors, rewards_of_outcomes(space), (1.0 - stays) * probabilities]
    else:  # lazy actions alone
        rewards = rewards_of_space(space).array.ravel()
        columns = [rows, np.ravel(space.successors), rewards, np.full(len(rows), 1.0 - stays)]
    if stays:
        staying = rows, rows // space.num_actions, rewards_of_staying(space).array.ravel(), np.full(len(rows), stays)
        columns = [np.concatenate(pair) for pair in zip(columns, staying, strict=True)]
        by_row = np.argsort(columns[0], kind="stable")
        columns = [column[by_row] for column in columns]
    return _joined(PaidOutcomes(*columns))


def _joined(outcomes: PaidOutcomes) -> PaidOutcomes:
    """Outcomes of a row that have the same next state and reward are joined, in the place of the first."""
    which, states, rewards, probabilities = outcomes
    order = np.lexsort((rewards, states, which))
    key = np.stack([which, states, rewards])[:, order]
    begins = np.flatnonzero(np.append(True, (key[:, 1:] != key[:, :-1]).any(axis=0)))
    first = np.minimum.reduceat(order, begins)
    by_first = np.argsort(first)
    first, sums = first[by_first], np.add.reduceat(probabilities[order], begins)[by_first]
    return PaidOutcomes(which[first], states[first], rewards[first], sums)


def _blocks(space: "StateSpace", env: Environment, first: int = 0, last: int | None = None) -> Blocks:
    """Blocks of rewards of the states [first, last), in order."""
    from pharos.rules import rules_of

    rules = rules_of(env).rewards_of(space.num_states)
    end = space.num_states if last is None else last
    starts = range(first, end, _RECORDED_ROWS)
    states, terminal = space.packed_states, space.terminal
    successors, dynamics = None if space.has_chance else space.successors, space.dynamics

    def block(start: int) -> tuple[np.ndarray, float]:
        stop, largest = min(start + _RECORDED_ROWS, end), np.zeros(1)
        if successors is not None:
            return rules.block(states, successors, terminal, start, stop), 0.0
        outcomes = dynamics.entries_of(np.arange(start, stop))
        return rules.expected_block(states, outcomes, terminal, start, stop, largest=largest), float(largest[0])

    threads = rules.threads(usable_workers(None))
    with ThreadPoolExecutor(threads) as pool:
        window = 2 * threads
        pending = [pool.submit(block, start) for start in starts[:window]]
        for i, start in enumerate(starts):
            rewards, largest = pending[i % window].result()
            if i + window < len(starts):
                pending[i % window] = pool.submit(block, starts[i + window])
            yield start, rewards, largest


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
