"""Value of a policy, which is queried and evaluated in the states that it reaches.

`evaluate_policy` gives the values of all states, `policy_value` the value of the start. `table_values` and
`walk_values` give the latter of many policies at once, to the same bits. A deterministic policy in a deterministic game
of a million states reaches some hundred of them. Under chance it may reach many, and beyond a limit the value is
estimated from simulated episodes instead, and the answer says so.

`estimate`: the value from simulated episodes, with an interval that holds it almost surely. `QueriedHistories`:
policies that see the last k frames, or remember, are queried in the histories that they reach.
"""

import hashlib
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np

from pharos import solvers
from pharos.errors import DivergenceError, ParameterError
from pharos.kernels.stepping import execute_choices
from pharos.mdp import PolicyTable, Rewards, Table, TabularMDP, drawn_actions, require_mdp
from pharos.policies.models import SB3Model, check_observation, deep_policy
from pharos.policies.policy import (
    AnswerOptions,
    Arrays,
    MasksLike,
    NumberObserver,
    Observer,
    Policy,
    PolicyAnswers,
    PolicyLike,
    QueriedPolicy,
    ReachableRows,
    RecurrentPolicy,
    TableAnswers,
    TabularAgent,
    masks_for,
)
from pharos.solvers import Solution
from pharos.system.arrays import UNIT_ROUNDOFF, as_index_array

# Histories whose frames are drawn at once
HISTORY_BATCH = 512


class QueriedHistories(PolicyAnswers):
    """Answers of a policy that sees k frames. A row is the number of a history, the last k states of an episode.

    The histories that a policy reaches, with what is executed in them, are an MDP again: a history leads to the one
    without its first state and with the next state behind. So the value of the policy is exact if they are few.
    """

    def __init__(self, policy: PolicyLike, mdp: TabularMDP, observer: Observer, **options: Unpack[AnswerOptions]):
        if observer.previous_action:
            raise ParameterError("the policy sees several frames and the previous action; expected one or the other")
        super().__init__(policy, mdp, observer, **options)
        self._name_rows()

    def _name_rows(self) -> None:
        """Number rows by history, whatever the previous action is. The last entry of a history is the state."""
        self.by_pairs, self.width = False, 1
        self._histories: list[tuple[int, ...]] = []
        self._number: dict[tuple[int, ...], int] = {}
        self._index = np.zeros(64, np.int32)

    def first_rows(self, states: np.ndarray) -> np.ndarray:
        return self._numbers([(int(s),) * self.observer.frames for s in states])

    def next_rows(self, rows: np.ndarray, executed: np.ndarray, next_states: np.ndarray) -> np.ndarray:
        pairs, inverse = np.unique(np.stack([rows, next_states], axis=1), axis=0, return_inverse=True)
        numbers = self._numbers([(*self._histories[row][1:], t) for row, t in pairs.tolist()])
        return numbers[inverse.reshape(-1)]

    def query_all(self, reach: Callable[[], ReachableRows]) -> bool | None:
        """None, with nothing stored: rows are histories here, which `reach` does not list."""
        return None

    def states_of(self, rows: np.ndarray) -> np.ndarray:
        return np.array([self._histories[row][-1] for row in rows], np.int64)

    def _start_nodes(self) -> np.ndarray:
        """Pairs of a row and the previous action: under sticky actions a history is visited once with each of them."""
        width = self.mdp.policy_width
        nodes = np.unique(self.start_rows()) * width + (width - 1)
        self._visited = set(nodes.tolist())
        return nodes

    def _parts(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rows, previous = np.divmod(nodes, self.mdp.policy_width)
        return rows, self.states_of(rows), previous

    def _new_nodes(self, rows: np.ndarray, executed: np.ndarray, next_states: np.ndarray) -> np.ndarray:
        width = self.mdp.policy_width
        after = self.next_rows(rows, executed, next_states) * width + (executed if width > 1 else 0)
        nodes = np.array([node for node in np.unique(after).tolist() if node not in self._visited], np.int64)
        self._visited.update(nodes.tolist())
        return nodes

    def reached_mdp(self) -> tuple[TabularMDP, np.ndarray]:
        """The MDP on the visited histories, and the policy on it."""
        rows = self.rows

        def number(next_states: np.ndarray, executed: np.ndarray, origin: np.ndarray) -> np.ndarray:
            return self.index(self.next_rows(rows[origin], executed, next_states))

        return self._mdp_on(self.states_of(rows), self.index(self.start_rows()), number), self.probabilities

    def index(self, rows: np.ndarray) -> np.ndarray:
        self._make_room()
        return super().index(rows)

    def _make_room(self) -> None:
        """Grow `_index` to an entry for each numbered history."""
        if len(self._index) < len(self._histories):
            more = np.zeros(2 * len(self._histories) - len(self._index), np.int32)
            self._index = np.concatenate([self._index, more])

    def _query(self, rows: np.ndarray) -> np.ndarray:
        answers = []
        context: Any = self.observer.observe
        for start in range(0, len(rows), HISTORY_BATCH):
            histories = np.array([self._histories[row] for row in rows[start : start + HISTORY_BATCH]], np.int64)
            count, frames = histories.shape
            states = self.observer.space.states(histories.ravel()).reshape(count, frames, -1)
            observations = context.observation.of_histories(states)
            answers.append(self.answer(observations, count, histories[:, -1]))
        return np.concatenate(answers)

    def _numbers(self, histories: list[tuple[int, ...]]) -> np.ndarray:
        """Numbers (N,) of histories. New ones are appended."""
        for history in histories:
            if history not in self._number:
                self._number[history] = len(self._histories)
                self._histories.append(history)
        return np.array([self._number[history] for history in histories], np.int64)


class QueriedMemories(QueriedHistories):
    """Answers of a policy with a memory. A row is the number of (memory, previous action if it is seen, state).

    A memory is what the policy has kept of the observations before. It has one number if the observations before
    were the same, and if what is kept is the same to the last bit: a policy that keeps nothing is queried once about
    each state and once more at the start, one that counts steps once about each state and step.

    Raises:
        ParameterError: the policy would see several frames, or entries that are drawn at every step, besides.
    Cost: what the policy keeps is stored for each row.
    """

    def __init__(self, policy: RecurrentPolicy, mdp: TabularMDP, observer: Observer, *, deterministic: bool = False):
        observation = observer.observe.observation
        if observation.frames > 1 or observation.irrelevant:
            besides = "several frames" if observation.frames > 1 else "irrelevant entries"
            raise ParameterError(f"the policy has a memory and sees {besides}; expected one or the other")
        QueriedPolicy.__init__(self, mdp)
        self.masks = None
        self.recurrent, self.observer, self.deterministic = policy, observer, deterministic
        check_observation(policy, observer.observe.space, observer.observation)
        self._name_rows()
        # bytes of each memory but the first, which belongs to the start; `_layout` gives their dtypes and shapes
        self._kept: list[bytes] = [b""]
        self._memory: dict[bytes, int] = {}
        self._layout: tuple[Arrays, list[tuple[np.dtype, tuple[int, ...]]]] | None = None
        self._after: dict[int, int] = {}  # row -> memory after the policy was queried there
        self._answered: dict[tuple[int, bytes], tuple[np.ndarray, int]] = {}

    def first_rows(self, states: np.ndarray) -> np.ndarray:
        return self._numbers([(0, self.num_actions, int(s)) for s in states])

    def next_rows(self, rows: np.ndarray, executed: np.ndarray, next_states: np.ndarray) -> np.ndarray:
        after = np.array([self._after[row] for row in rows.tolist()], np.int64)
        previous = executed if self.observer.previous_action else np.full(len(rows), self.num_actions)
        keys, inverse = np.unique(np.stack([after, previous, next_states], axis=1), axis=0, return_inverse=True)
        return self._numbers([tuple(key) for key in keys.tolist()])[inverse.reshape(-1)]

    def _query(self, rows: np.ndarray) -> np.ndarray:
        memory, previous, states = np.array([self._histories[row] for row in rows], np.int64).T
        previous = np.where(previous == self.num_actions, -1, previous)
        observations = self.observer.observe(self.observer.space.states(states), previous, np.minimum(memory, 1))
        digests = [hashlib.sha256(row).digest() for row in _packed(observations, len(rows))]
        pairs = list(zip(memory.tolist(), digests, strict=True))
        first = {pair: i for i, pair in reversed(list(enumerate(pairs))) if pair not in self._answered}
        if first:
            at = np.array(list(first.values()))
            at_start, count = memory[at] == 0, len(at)
            state = self.recurrent.initial_state(count) if at_start.all() else self._states(memory[at])
            new = _rebuilt(observations, (leaf[at] for leaf in _leaves(observations)))
            answer, after = self.recurrent(new, state, at_start)
            answers = zip(self.checked(answer, count), self._memories(after, count), strict=True)
            self._answered.update(zip(first, answers, strict=True))
        self._after.update((row, self._answered[pair][1]) for row, pair in zip(rows.tolist(), pairs, strict=True))
        return np.array([self._answered[pair][0] for pair in pairs])

    def _memories(self, state: Arrays, count: int) -> list[int]:
        """Numbers of the memories of `count` episodes, new ones appended. `state` is what the policy returned."""
        leaves = _leaves(state)
        layout = [(leaf.dtype, leaf.shape[1:]) for leaf in leaves]
        if any(leaf.dtype.hasobject or leaf.shape[:1] != (count,) for leaf in leaves):
            arrays = ", ".join(f"{leaf.dtype} {leaf.shape}" for leaf in leaves)
            raise ParameterError(f"the policy keeps {arrays}; expected arrays whose first axis is {count} episodes")
        if self._layout is not None and self._layout[1] != layout:
            raise ParameterError(f"the policy keeps {layout} now; expected {self._layout[1]}, as it kept before")
        self._layout, numbers = (state, layout), []
        for entry in _packed(state, count):
            number = self._memory.setdefault(entry, len(self._kept))
            if number == len(self._kept):
                self._kept.append(entry)
            numbers.append(number)
        return numbers

    def _states(self, memory: np.ndarray) -> Arrays:
        """Batch of memories other than the first, in the structure in which the policy returned them."""
        joined = np.frombuffer(b"".join(self._kept[number] for number in memory), np.uint8).reshape(len(memory), -1)
        assert self._layout is not None
        template, layout = self._layout
        ends = np.cumsum([dtype.itemsize * int(np.prod(shape)) for dtype, shape in layout])
        parts = np.split(joined, ends[:-1], axis=1) if layout else []
        return _rebuilt(
            template,
            (
                part.copy().view(dtype).reshape(len(memory), *shape)
                for part, (dtype, shape) in zip(parts, layout, strict=True)
            ),
        )


def _leaves(tree: Arrays) -> list[np.ndarray]:
    """The arrays of an array, or of nested tuples, lists or dictionaries of arrays."""
    if isinstance(tree, dict):
        tree = tuple(tree.values())
    return [leaf for part in tree for leaf in _leaves(part)] if isinstance(tree, tuple | list) else [np.asarray(tree)]


def _rebuilt(template: Arrays, leaves: Iterator[np.ndarray]) -> Arrays:
    """Tree of the structure of `template`, with the next `leaves` in the places of its arrays."""
    if isinstance(template, dict):
        return {name: _rebuilt(part, leaves) for name, part in template.items()}
    if not isinstance(template, tuple | list):
        return next(leaves)
    parts = [_rebuilt(part, leaves) for part in template]
    return type(template)(*parts) if hasattr(template, "_fields") else type(template)(parts)


def _packed(tree: Arrays, count: int) -> list[bytes]:
    """The bytes of each of `count` entries of the first axis of all arrays."""
    parts = [np.ascontiguousarray(leaf).reshape(count, -1).view(np.uint8) for leaf in _leaves(tree)]
    joined = np.concatenate([*parts, np.empty((count, 0), np.uint8)], axis=1)
    return [row.tobytes() for row in joined]


def policy_answers(
    policy: PolicyLike, mdp: TabularMDP, observer: Observer, **options: Unpack[AnswerOptions]
) -> PolicyAnswers:
    """Answers of a policy that sees observations: of the state alone, of the last frames, or with a memory."""
    options["masks"] = masks_for(policy, mdp, options.get("masks"))
    masked = options["masks"] is not None
    if isinstance(policy, SB3Model) and not isinstance(policy, Policy):
        policy = deep_policy(policy, masked=masked)
    if isinstance(policy, RecurrentPolicy) and not isinstance(policy, Policy) and not masked:
        return QueriedMemories(policy, mdp, observer, deterministic=options.get("deterministic", False))
    kind = QueriedHistories if observer.frames > 1 else PolicyAnswers
    return kind(policy, mdp, observer, **options)


# Values ---------------------------------------------------------------------------------------------------------------


# Part of a discounted value that is left out: of states that the policy reaches after so many steps.
TAIL = 1e-9
MOST_ROWS = 1 << 16  # pairs of a state and what came before, so that all of them may be reached by many policies
MOST_TOGETHER = 1 << 18  # such pairs of the policies that are evaluated at once


@dataclass(frozen=True)
class Evaluation:
    """The value of a policy from the start.

    Attributes:
        value: expected return of an episode, in the setting of the task.
        exact: whether the value is computed, not estimated.
        error_bound: proven bound on the error of an exact value, for the probabilities that the policy
            returned. (A network computes them in float32, which moves values by more.) For an estimate, half the width
            of an interval that holds the value with a probability of at least 99 % (empirical Bernstein bound).
        states: number of states (or pairs of state and previous action) in which the policy was asked.
        episodes: simulated episodes behind an estimate, 0 if the value is exact.
        gain: average reward a step in the long run, within proven bounds. None unless it was asked for.
    """

    value: float
    exact: bool
    error_bound: float
    states: int
    episodes: int = 0
    gain: solvers.GainInterval | None = None


def policy_value(
    policy: PolicyLike,
    mdp: TabularMDP,
    observer: Callable[[], Observer],
    return_range: Callable[[], tuple[float, float]],
    *,
    deterministic: bool = False,
    masks: MasksLike | None = None,
    max_states: int = 100_000,
    episodes: int = 2_000,
    seed: int = 0,
    reach: Callable[[int, int], ReachableRows] | None = None,
) -> Evaluation:
    """Return the value of a policy from the start: exact if it reaches few states, else estimated with a bound.

    A total reward (gamma 1, no horizon) is -inf if the policy may go on for ever and pays on average. It is NaN if it
    goes on for ever and pays nothing on average, though something each time, so that its sum has no limit.

    Args:
        observer: gives what the policy sees. It is called for policies over observations alone.
        return_range: gives the lowest and the highest return of an episode. It is called if the value is estimated.
        deterministic, masks, max_states, episodes, seed: as for `training.evaluate_agent`.
        reach: (rows at most, steps) -> the rows that every policy of positive probabilities reaches, if more than
            one policy is evaluated: such policies are queried in all of them at once. Changes no value.
    Raises:
        ParameterError: it reaches more than `max_states`, and the total reward of an episode has no limits.
    """
    if isinstance(policy, TabularAgent):
        policy = policy.policy_table()
    is_total = mdp.gamma == 1.0 and mdp.horizon is None
    if isinstance(policy, np.ndarray) and masks is None and mdp.num_states <= max_states and not is_total:
        solution = solvers.evaluate_policy(mdp, _table_of(policy, deterministic))
        return Evaluation(solution.value_at_start, True, solution.error_bound, mdp.num_states)
    answers = _answers(policy, mdp, observer, deterministic=deterministic, masks=masks)
    steps, error = steps_that_matter(mdp)
    is_whole = None if reach is None else answers.query_all(lambda: reach(max_states, steps))
    if answers.reach(max_states, steps) if is_whole is None else is_whole:
        part = answers.reached_mdp()
        try:
            solution = solvers.evaluate_policy(*part)
        except DivergenceError:
            return Evaluation(endless_value(*part), True, 0.0, len(answers.rows))
        return Evaluation(solution.value_at_start, True, solution.error_bound + error, len(answers.rows))
    if is_total:
        raise ParameterError(
            f"the policy reaches more than {max_states:,} states, and a total reward is not estimated from episodes, "
            f"whose returns have no limits; give a horizon, or gamma < 1"
        )
    value, width = estimate(answers, return_range(), episodes, np.random.default_rng(seed))
    return Evaluation(value, False, width, len(answers.rows), episodes)


def endless_value(mdp: TabularMDP, policy: np.ndarray | str) -> float:
    """The total reward of a policy that goes on for ever while something is paid, in an MDP whose optimum is finite.

    Returns:
        -inf if it pays on average, else NaN, as the sums of positive and of negative rewards are both infinite.
    """
    return -math.inf if solvers.average_reward(mdp, policy).gain_at_start.upper < 0 else math.nan


def _table_of(policy: np.ndarray, deterministic: bool) -> np.ndarray:
    return np.asarray(policy.argmax(axis=-1)) if deterministic and policy.dtype.kind == "f" else policy


def _answers(
    policy: PolicyLike, mdp: TabularMDP, observer: Callable[[], Observer], **options: Unpack[AnswerOptions]
) -> QueriedPolicy:
    """Answers of a table, or of a policy that sees observations."""
    if not isinstance(policy, np.ndarray):
        return policy_answers(policy, mdp, observer(), **options)
    if options.get("masks") is not None:
        raise ParameterError("masks given for a policy that is a table; expected a model trained under masks")
    return TableAnswers(_table_of(policy, options.get("deterministic", False)), mdp)


class ObserverOptions(TypedDict, total=False):
    """Options of policies that see observations, which `evaluate_policy` describes."""

    observation_options: Mapping[str, object] | None
    previous_action: bool
    deterministic: bool
    masks: MasksLike | None


@require_mdp
def evaluate_policy(
    mdp: TabularMDP,
    policy: PolicyLike,
    tolerance: float | solvers.Solving = 1e-6,
    *,
    horizon: int | None = None,
    observation: object = None,
    processes: int | str = 1,
    **observer_options: Unpack[ObserverOptions],
) -> Solution:
    """The values of a policy.

    V(s) = sum_a pi(a | s) q(s, a), q(s, a) = r(s, a) + gamma E V(next); chance acts between what the policy chooses and
    what is executed, see `random_actions` and `sticky_actions`.

    Args:
        policy: (S,) integers, an action for each state, or (S, A) probabilities. Under sticky actions also (S, A + 1)
            integers or (S, A + 1, A) probabilities, for each previously executed action and, last, for none. Or a
            function from an array of state indices to either. Or a policy that sees observations: a model of
            Stable-Baselines3, or, with `observation`, a function of a batch of observations that returns (N, A)
            probabilities or (N,) actions. One with a memory has no values of states, see `training.evaluate_agent`.
        tolerance: every value is within this of the true one, proven. Or the options of `pharos.solvers.Solving`.
        horizon: number of steps to go, instead of the MDP's own.
        observation: what the policy sees, a name or an Observation. Default for models: "vector".
        processes: that share the work, for policies over states, see `pharos.value_iteration`.
        observer_options: further options of policies that see observations: `observation_options`, a dictionary;
            `previous_action`, whether they see it, under sticky actions; `deterministic`, whether the most probable
            action is taken; `masks`, the actions that a model trained under masks (MaskablePPO) may choose, (S, A) bool
            or a function from states (N, D), as `StateSpace.states` gives them, to (N, A) bool.
    Returns:
        A Solution of kind "policy", see `pharos.solvers.evaluate_policy`. A policy that sees observations is asked only
        in the states that it reaches from the start. Values elsewhere are NaN.
    Raises:
        ParameterError: the policy has the wrong shape, or its rows are not probabilities. Or it sees observations, and
            the MDP was not made from a state space (the observation "number" is of any table). Or a model was trained
            on other observations, behind a VecNormalize that is not with it, or under masks that are not given.
        DivergenceError: gamma is 1, there is no horizon, and the policy goes on for ever while something is paid.
    Source: Puterman (1994), section 6.1.
    """
    if isinstance(policy, TabularAgent):
        policy = policy.policy_table()
    options: solvers.SolvingOptions = {} if horizon is None else {"horizon": horizon}
    if processes != 1 or processes is True:  # which is no number of processes
        options["processes"] = processes
    solving = solvers.Solving.of(mdp, tolerance, options)
    if observation is not None or isinstance(policy, Policy | RecurrentPolicy | SB3Model):
        if solving.is_distributed:
            raise ParameterError("a policy that sees observations is evaluated by one process; expected processes=1")
        timed = mdp.with_horizon(solving.horizon)
        return _solution_of_reached(timed, policy, solving, observation=observation or "vector", **observer_options)
    if observer_options:
        raise ParameterError(
            f"{', '.join(observer_options)} given for a policy that sees no observations; name the observation"
        )
    return solvers.evaluate_policy(mdp, policy, solving)


class AverageRegret(NamedTuple):
    """Loss of a policy a step in the long run, from the start, with each number within proven bounds.

    Attributes:
        regret: the optimal gain less the gain of the policy. gain, optimal: of the policy, and of the best one.
    """

    regret: solvers.GainInterval
    gain: solvers.GainInterval
    optimal: solvers.GainInterval

    @staticmethod
    def of(gain: solvers.GainInterval, optimal: solvers.GainInterval) -> "AverageRegret":
        """The regret of a policy by its gain and the optimal one."""
        room = 2.0**-52 * max(abs(each) for each in (*optimal, *gain))
        lower, upper = optimal.lower - gain.upper - room, optimal.upper - gain.lower + room
        return AverageRegret(solvers.GainInterval(max(lower, 0.0), max(upper, 0.0)), gain, optimal)


@require_mdp
def average_regret(
    mdp: TabularMDP,
    policy: PolicyLike | str,
    tolerance: float = 1e-6,
    *,
    observation: object = None,
    optimal: solvers.GainInterval | None = None,
    **observer_options: Unpack[ObserverOptions],
) -> AverageRegret:
    """The average regret a step of a policy in the long run: the optimal gain less its own, from the start.

    Args:
        policy: as `evaluate_policy` takes it, or "uniform", "worst" or "optimal". One that sees observations may see
            several frames, or have a memory.
        tolerance: each gain is within this of the middle of its bounds.
        observation, observer_options: as `evaluate_policy` takes them.
        optimal: the optimal gain at the start, if it is there already.
    Returns:
        An `AverageRegret` of the intervals `regret`, `gain` and `optimal`. Regret is never negative.
    Raises:
        ParameterError: the policy has the wrong shape, its rows are not probabilities, or as for `evaluate_policy`.
        PrecisionError: floats, within limits of time, prove no bound within the tolerance.
    Cost: twice the cost of `average_reward`.
    Source: Auer, Jaksch and Ortner (2009), "Near-optimal regret bounds for reinforcement learning".
    """
    best = solvers.average_reward(mdp, tolerance=tolerance).gain_at_start if optimal is None else optimal
    if isinstance(policy, str):
        own = solvers.average_reward(mdp, policy, tolerance=tolerance).gain_at_start
    elif observation is not None or isinstance(policy, Policy | RecurrentPolicy | SB3Model):
        options, previous = observer_options.get("observation_options"), observer_options.get("previous_action", False)
        observer = _observer_of(mdp, observation or "vector", dict(options or {}), previous)
        limits: AnswerOptions = {
            "deterministic": observer_options.get("deterministic", False),
            "masks": observer_options.get("masks"),
        }
        gain = policy_gain(policy, mdp, lambda: observer, tolerance=tolerance, **limits)
        assert gain is not None  # without a limit of states
        own = gain
    else:
        own = solvers.average_reward(mdp, policy, tolerance=tolerance).gain_at_start
    return AverageRegret.of(own, best)


def policy_gain(
    policy: PolicyLike,
    mdp: TabularMDP,
    observer: Callable[[], Observer],
    *,
    max_states: int | None = None,
    tolerance: float = 1e-6,
    **options: Unpack[AnswerOptions],
) -> solvers.GainInterval | None:
    """The average reward a step of a policy in the long run, from the start. None if it reaches more than `max_states`.

    Args:
        observer: gives what the policy sees. It is called for policies over observations alone.
        tolerance: the gain is within this of the middle of its bounds.
        options: `deterministic` and `masks`, as for `training.evaluate_agent`.
    """
    if isinstance(policy, TabularAgent):
        policy = policy.policy_table()
    answers = _answers(policy, mdp, observer, **options)
    if not answers.reach(max_states):
        return None
    return solvers.average_reward(*answers.reached_mdp(), tolerance=tolerance).gain_at_start


@dataclass(frozen=True, eq=False, repr=False)
class ReachedSolution(Solution):
    """Values of a policy in the states that it reaches from the start, numbered as in the whole MDP. NaN elsewhere.

    Attributes:
        start: value of an episode's first state.
        states_reached: number of states in which the policy was asked.
    """

    start: float = math.nan
    states_reached: int = 0

    @property
    def value_at_start(self) -> float:
        """The expected value of an episode's first state."""
        return self.start


def _solution_of_reached(
    mdp: TabularMDP,
    policy: PolicyLike,
    tolerance: float | solvers.Solving = 1e-6,
    *,
    observation: object = "vector",
    observation_options: Mapping[str, object] | None = None,
    previous_action: bool = False,
    deterministic: bool = False,
    masks: MasksLike | None = None,
) -> ReachedSolution:
    """Values of a policy that sees observations. `training.evaluate_agent` also gives estimates.

    Raises:
        ParameterError: the MDP was not made from a state space of an environment, the policy is none for its
            observations, or it sees the previous action although actions are not sticky, so that values do not belong
            to states.
        DivergenceError: gamma is 1, there is no horizon, and the policy goes on for ever while something is paid.
    """
    if previous_action and not mdp.is_sticky:
        raise ParameterError(
            "the policy sees the previous action, so its values belong to no state; use training.evaluate_agent"
        )
    observer = _observer_of(mdp, observation, dict(observation_options or {}), previous_action)
    if observer.frames > 1:
        raise ParameterError(
            "the policy sees several frames, so its values belong to no state; use `pharos evaluate`, or "
            "training.evaluate_agent"
        )
    answers = PolicyAnswers(policy, mdp, observer, deterministic=deterministic, masks=masks)
    answers.reach()
    sub, reached_policy = answers.reached_mdp()
    solution = solvers.evaluate_policy(sub, reached_policy, tolerance)
    x, next_x = (_on_all_states(answers, values) for values in (solution.x, solution.next_x))
    table = np.full((mdp.num_states * answers.width, mdp.num_actions), np.nan)
    table[answers.rows] = answers.probabilities
    return ReachedSolution(
        mdp,
        solution.error_bound,
        solution.sweeps,
        solution.seconds,
        mdp.horizon,
        PolicyTable(mdp.num_actions, table.reshape(mdp.num_states, answers.width, mdp.num_actions)),
        x,
        next_x,
        start=solution.value_at_start,
        states_reached=len(answers.reached_states()),
    )


def _observer_of(mdp: TabularMDP, observation: object, options: dict[str, object], previous_action: bool) -> Observer:
    """Observer of the states of an MDP. ParameterError if there is nothing to observe."""
    space = mdp.space
    if space is None and observation == "number" and mdp.is_numbered:
        if options or previous_action:
            raise ParameterError("the numbers of states of a table take no options, and no previous action besides")
        return NumberObserver.of(mdp.num_states)
    if space is None or space.environment is None:
        raise ParameterError(
            f"{mdp}: is not of a state space whose environment is known, so there is nothing to observe but the number "
            f"of a state in its table: observation='number'; or give the policy as a table"
        )
    return Observer(space, space.environment, observation, options, previous_action, mdp.horizon)


def _on_all_states(answers: QueriedPolicy, x: np.ndarray) -> np.ndarray:
    """(S + 1, W): values on the states that the policy reaches (N + 1, W), NaN elsewhere, and 0 in terminal states."""
    mdp = answers.mdp
    states = answers.reached_states()
    rows = states[:, None] * answers.width + np.arange(mdp.width)
    values = np.full((mdp.num_states + 1, mdp.width), np.nan)
    values[states] = np.where(answers.index(rows) >= 0, x[:-1], np.nan)
    values[:-1][np.asarray(mdp.terminal)] = 0.0
    values[-1] = 0.0
    return values


def steps_that_matter(mdp: TabularMDP) -> tuple[int, float]:
    """Number of steps whose rewards decide the value at the start up to an error, and a bound on that error.

    Without a horizon 2 gamma^n max |r| / (1 - gamma), below TAIL. The policy is not queried about later steps.
    """
    if mdp.horizon is not None:
        return mdp.horizon, 0.0
    if mdp.gamma == 1.0:
        return sys.maxsize, 0.0
    largest = 2 * max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest)) / (1 - mdp.gamma)
    if largest <= TAIL or mdp.gamma == 0.0:
        return 1, largest * mdp.gamma
    steps = max(1, math.ceil(math.log(TAIL / largest) / math.log(mdp.gamma)))
    return steps, largest * mdp.gamma**steps


# Many policies at once ------------------------------------------------------------------------------------------------


def is_small_table(mdp: TabularMDP) -> bool:
    """Whether policies of the MDP can be evaluated together: it has a horizon, few states, and one next state each."""
    is_small = mdp.horizon is not None and _rows(mdp) <= MOST_ROWS and not mdp.laziness
    return is_small and mdp.dynamics.deterministic_table() is not None


def table_values(mdp: TabularMDP, policies: Sequence[np.ndarray]) -> list[Evaluation]:
    """The values from the start of N policies of an MDP of which `is_small_table` holds.

    They are evaluated as one policy of as many copies of the MDP: to the bits that `policy_value` gives.

    Args:
        policies: (S,) actions each, evaluated in all states. Or (S, A) probabilities, evaluated in states they reach.
    Cost: one backward induction for all, in some groups if they are large.
    """
    size, evaluations = max(1, MOST_TOGETHER // _rows(mdp)), []
    for first in range(0, len(policies), size):
        group = policies[first : first + size]
        number, states = len(group), mdp.num_states
        joined, copies = np.concatenate(group), _copies(mdp, len(group))
        part, counts = np.repeat(np.arange(number), states), [states] * number
        if joined.ndim > 1:
            answers = TableAnswers(joined, copies)
            answers.reach(None, mdp.horizon)
            part = answers.reached_states() // states
            counts = np.bincount(answers.rows // (answers.width * states), minlength=number).tolist()
            copies, joined = answers.reached_mdp()
        values = solvers.evaluate_parts(copies, joined, part, mdp.start_probabilities)
        evaluations += [Evaluation(value, True, bound, n) for (value, bound), n in zip(values, counts, strict=True)]
    return evaluations


def _rows(mdp: TabularMDP) -> int:
    """Number of pairs of a state and, if that matters, a previous action."""
    return mdp.num_states * mdp.policy_width


def _copies(mdp: TabularMDP, number: int) -> TabularMDP:
    """Disjoint union of `number` copies of the MDP: state s of copy i has the number i S + s."""
    table, rewards = np.asarray(mdp.dynamics.deterministic_table(), np.int64), mdp.reward_table
    first = np.arange(number) * mdp.num_states
    next_states = np.where(table < 0, -1, table + first[:, None, None]).reshape(-1, mdp.num_actions)
    return replace(
        mdp,
        dynamics=Table(next_states),
        reward_table=Rewards(np.tile(rewards.table, (number, 1)), rewards.palette, rewards.rounding),
        terminal=np.tile(np.asarray(mdp.terminal), number),
        start_states=(mdp.start_states + first[:, None]).ravel(),
        start_probabilities=np.tile(mdp.start_probabilities / number, number),
        folder=None,
        age=None,
        staying=None,
        available=None if mdp.available is None else np.tile(mdp.available, (number, 1)),
    )


def is_walk(mdp: TabularMDP) -> bool:
    """Whether a deterministic policy always visits the same states, so many as matter: one start, no chance."""
    is_chosen = mdp.chance.triple[0] == 1.0 and not mdp.laziness and (mdp.horizon is not None or mdp.gamma < 1.0)
    return is_chosen and len(mdp.start_states) == 1 and mdp.dynamics.deterministic_table() is not None


def walk_values(
    mdps: Sequence[TabularMDP], act: Callable[[np.ndarray], np.ndarray], *, frames: int = 1
) -> list[Evaluation]:
    """The values of N deterministic policies from the start, exact, each in its own MDP of which `is_walk` holds.

    Such a policy visits one state after the other, so that evaluating it alone costs a call of `act` for each. Here one
    call serves a step of all policies.

    Args:
        act: (N,) states -> (N,) actions, of the policies in their states. Policies at the end of an episode are queried
            in their last state.
        frames: k, the number of states that the policies see. If more than one, `act` gets histories (N, k): the last
            k states of the episode, the oldest first. The first state stands for earlier ones.
    Cost: the longest episode times a call of `act`.
    """
    worlds = {
        id(mdp): (as_index_array(mdp.dynamics.deterministic_table()), np.asarray(mdp.terminal), mdp.reward_table)
        for mdp in mdps
    }
    indices = {key: np.array([i for i, mdp in enumerate(mdps) if id(mdp) == key]) for key in worlds}
    ahead = [steps_that_matter(mdp) for mdp in mdps]
    state = np.array([mdp.start_states[0] for mdp in mdps], np.int64)
    history = np.repeat(state[:, None], frames, axis=1)
    limits, gammas = np.array([steps for steps, _ in ahead]), np.array([mdp.gamma for mdp in mdps])
    is_over = np.array([bool(mdp.terminal[s]) for mdp, s in zip(mdps, state, strict=True)])
    rounding = np.array([mdp.reward_table.rounding for mdp in mdps])
    value, size, discount = np.zeros(len(mdps)), np.zeros(len(mdps)), np.ones(len(mdps))
    of_rewards = np.zeros(len(mdps))
    path: list[np.ndarray] = []
    while not (is_over := is_over | (len(path) >= limits)).all():
        path.append(np.where(is_over[:, None], -1, history))
        actions = act(state if frames == 1 else history)
        for key, (table, terminal, rewards) in worlds.items():
            i = indices[key][~is_over[indices[key]]]
            s, a = state[i], actions[i]
            next_states, entries = table[s, a], rewards.table[s, a]
            reward = discount[i] * (rewards.palette[entries] if len(rewards.palette) else entries)
            value[i] += reward
            size[i] += np.abs(reward)
            of_rewards[i] += discount[i] * rounding[i]
            is_over[i] = (next_states < 0) | terminal[next_states]
            state[i] = np.where(next_states < 0, s, next_states)
        history = np.concatenate([history[:, 1:], state[:, None]], axis=1)
        discount *= gammas
    bounds = [tail for _, tail in ahead] + 2 * UNIT_ROUNDOFF * (len(path) + 1) * size + of_rewards
    visited = [
        len(np.unique(column[column[:, 0] >= 0], axis=None if frames == 1 else 0))
        for column in np.array(path, np.int64).reshape(-1, len(mdps), frames).swapaxes(0, 1)
    ]
    parts = zip(value.tolist(), bounds.tolist(), visited, strict=True)
    return [Evaluation(each, True, bound, states) for each, bound, states in parts]


# Estimation -----------------------------------------------------------------------------------------------------------


# Probability that an interval misses the value.
RISK = 0.01


def estimate(
    answers: QueriedPolicy, return_range: tuple[float, float], episodes: int, rng: np.random.Generator
) -> tuple[float, float]:
    """(mean return, half the width of the interval around it) of simulated episodes.

    Args:
        return_range: the lowest and the highest return that an episode can have.
    Source: Maurer and Pontil (2009), theorem 4.
    """
    mdp, chance = answers.mdp, (*answers.mdp.chance.triple, float(answers.mdp.chance.first_chosen))
    steps = mdp.horizon or math.ceil(math.log(1e-9) / math.log(mdp.gamma)) if mdp.gamma > 0 else 1
    rewards, terminal = mdp.reward_table.for_kernels, np.asarray(mdp.terminal)
    states = rng.choice(mdp.start_states, episodes, p=mdp.start_probabilities)
    previous, rows = np.full(episodes, mdp.num_actions), answers.first_rows(states)
    returns, alive = np.zeros(episodes), np.arange(episodes)
    for step in range(steps):
        indices = answers.index_after_query(rows)
        numbers = rng.random(alive.size), rng.random(alive.size), rng.integers(mdp.num_actions, size=alive.size)
        if mdp.available is not None and not mdp.chance.is_none:
            sets = mdp.available[states[alive]]
            numbers = (*numbers[:2], drawn_actions(sets, rng))
            before = previous[alive]
            can_be = sets[np.arange(alive.size), np.minimum(before, mdp.num_actions - 1)]
            previous[alive] = np.where(can_be, before, mdp.num_actions)
        execute_choices(
            answers.probabilities, indices, numbers, chance, *rewards, states, mdp.gamma**step, alive, previous, returns
        )
        executed = previous[alive]
        next_states = mdp.dynamics.sample(states[alive], executed, rng)
        goes_on = (next_states >= 0) & ~terminal[next_states]
        alive, executed, next_states = alive[goes_on], executed[goes_on], next_states[goes_on]
        states[alive], rows = next_states, answers.next_rows(rows[goes_on], executed, next_states)
        if not alive.size:
            break
    return float(returns.mean()), _half_width(returns, *return_range)


def _half_width(returns: np.ndarray, low: float, high: float) -> float:
    """Half the width of an interval that holds the mean with probability 1 - RISK, for returns in [low, high]."""
    count, log = len(returns), math.log(4 / RISK)
    spread = math.sqrt(2 * float(returns.var(ddof=1)) * log / count)
    return spread + 7 * (high - low) * log / (3 * (count - 1))
