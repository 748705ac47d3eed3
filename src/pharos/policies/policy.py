"""Kinds of policies: a table over the states, or a function of observations that returns probabilities or actions.

A policy is queried once in each state that it reaches, in batches: `PolicyAnswers` queries functions of observations,
`TableAnswers` tables.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol, TypeAlias, TypedDict, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.mdp import Rewards, TabularMDP, check_choices, lacking
from pharos.observations import ObservationInContext, observe
from pharos.policies.models import (
    DeepPolicy,
    Observations,
    SB3Model,
    check_observation,
    memory_error,
    no_masks_error,
    takes_masks,
)
from pharos.state_space import StateSpace


@runtime_checkable
class Policy(Protocol):
    """Chooses actions from observations."""

    def action_probabilities(self, observations: np.ndarray) -> np.ndarray:
        """(N, A) probabilities, or (N,) actions, for a batch of N observations as the environment gives them."""


@runtime_checkable
class TabularAgent(Protocol):
    """Chooses actions from the index of the state."""

    def policy_table(self) -> np.ndarray:
        """(S,) actions, (S, A) probabilities, or (S, A + 1, A) if previous actions are seen."""


Arrays: TypeAlias = Any
"""An array, or tuples of arrays, nested at will."""


@runtime_checkable
class RecurrentPolicy(Protocol):
    """Chooses actions from observations and from what it has kept of those before.

    The first axis of the arrays of a state has one entry for each of n episodes. What comes back must depend on nothing
    else than what is given.
    """

    def initial_state(self, n: int) -> Arrays:
        """The state of n episodes that begin."""

    def __call__(self, observations: Arrays, state: Arrays, starts: np.ndarray) -> tuple[np.ndarray, Arrays]:
        """((N, A) probabilities or (N,) actions, the next state). starts: (N,) bool, whether an episode begins."""


PolicyLike = np.ndarray | TabularAgent | Policy | RecurrentPolicy | SB3Model | Callable[[Any], Any]
"""What is taken for a policy: a table (S,), (S, A) or (S, A + 1, A), an agent, a model of Stable-Baselines3, a function
from a batch of observations to (N, A) probabilities or (N,) actions, or one that keeps a state besides."""


def policy_function(policy: PolicyLike, *, masked: bool = False) -> Callable[..., Any]:
    """A policy over observations as a function of a batch of them.

    Args:
        masked: whether the function takes (N, A) masks as well.
    Raises:
        ParameterError: it is none, has a memory, or takes masks although there are none, or the other way round.
    """
    if isinstance(policy, RecurrentPolicy) and not isinstance(policy, Policy | SB3Model):
        raise memory_error(policy)
    if isinstance(policy, SB3Model) and not isinstance(policy, Policy):
        return DeepPolicy(policy, masked=masked).action_probabilities
    if masked and not getattr(policy, "masked", False):
        raise no_masks_error(policy)
    if isinstance(policy, Policy):
        return policy.action_probabilities
    if callable(policy):
        return policy
    raise ParameterError(
        f"agent is {policy!r}; expected a policy table, a model of Stable-Baselines3, or a function of observations"
    )


def masks_for(policy: PolicyLike, mdp: TabularMDP, masks: "MasksLike | None") -> "MasksLike | None":
    """Masks under which a policy is asked: as given. Otherwise, for a policy trained under masks, the sets of the MDP,
    if any."""
    if masks is not None or mdp.available is None:
        return masks
    is_model = isinstance(policy, SB3Model) and not isinstance(policy, Policy)
    is_masked = takes_masks(policy) if is_model else getattr(policy, "masked", False)  # type: ignore[arg-type]
    return mdp.available if is_masked else None


# Queried policies -----------------------------------------------------------------------------------------------------


# Observations in one query of a policy.
QUERY_BATCH = 4096
SINGLE, HALF = 1.1e-4, 1e-2  # by which a sum of probabilities may miss 1, of 32 bits and of 16
SOME = 1024  # rows that stand for all if these are too many for an exact value


@dataclass(frozen=True, eq=False)
class Observer:
    """Observations of the states of an environment, as a policy sees them.

    Attributes:
        space: the states.
        env: the environment that is observed.
        observation: as `pharos.observe` takes it, with its options.
        previous_action: whether the previously executed action is seen as well.
        time_limit: of an episode, in steps.
    """

    space: StateSpace
    env: Environment
    observation: object = "vector"
    options: Mapping[str, Any] = field(default_factory=dict)
    previous_action: bool = False
    time_limit: int | None = None

    @cached_property
    def observe(self) -> ObservationInContext:
        """Function from a batch of states, their previous actions and their steps to their observations."""
        observation = observe(self.env, self.observation, state_space=self.space, **self.options)
        return ObservationInContext(
            observation, previous_action=self.previous_action, remaining_time=False, limit=self.time_limit
        )

    @property
    def frames(self) -> int:
        """Number of states that are seen at once, the last ones of the episode."""
        return self.observe.observation.frames


class Numbers:
    """Numbers of the states of an MDP that is given as a table, in the place of a state space and its observation."""

    frames, irrelevant = 1, 0

    def __init__(self, count: int):
        from gymnasium.spaces import Discrete

        self.space, self.observation = Discrete(count), self

    def states(self, indices: np.ndarray) -> np.ndarray:
        """(N, 1) the states."""
        return np.asarray(indices)[:, None]

    def __call__(self, states: np.ndarray, *_: object) -> np.ndarray:
        return states[:, 0]


class NumberObserver(Observer):
    """The numbers of states as a policy sees them that was trained on the source of a table."""

    @staticmethod
    def of(count: int) -> "NumberObserver":
        """The observer of `count` states."""
        numbers = Numbers(count)
        return NumberObserver(numbers, numbers, "number")  # type: ignore[arg-type]  # neither is asked for more

    @property
    def observe(self) -> Numbers:  # type: ignore[override]
        """Function from a batch of states (N, 1) to their numbers."""
        return self.space  # type: ignore[return-value]


class ReachableRows(NamedTuple):
    """Rows that every policy reaches in which each action has a positive probability.

    Attributes:
        rows: (N,) in the order in which `QueriedPolicy.reach` visits them.
        is_whole: whether these are all. False: there are more than `reach` was allowed to visit.
    """

    rows: np.ndarray
    is_whole: bool


class QueriedPolicy:
    """Answers of a policy so far, by row: a state s, or s (A + 1) + b if the previous action b matters (A: none).

    Attributes:
        by_pairs: whether rows are pairs of state and previous action.
        width: rows of a state, A + 1 or 1.
    """

    def __init__(self, mdp: TabularMDP, *, sees_previous_action: bool = False, by_state: bool = False):
        self.mdp, self.num_actions = mdp, mdp.num_actions
        self.width = 1 if by_state else mdp.num_actions + 1 if sees_previous_action else mdp.policy_width
        self.by_pairs = self.width > 1
        # index + 1 of each row, 0: not queried; pages of zeros take no memory until they are written
        self._index = np.zeros(mdp.num_states * self.width, np.int32)
        # number of filled entries of the next two arrays, which double when they are full
        self._count = 0
        self._rows, self._answers = np.empty(64, np.int64), np.empty((64, mdp.num_actions))

    @property
    def rows(self) -> np.ndarray:
        """(N,) rows that were queried."""
        return self._rows[: self._count]

    @property
    def probabilities(self) -> np.ndarray:
        """(N, A) the answers."""
        return self._answers[: self._count]

    def index(self, rows: np.ndarray) -> np.ndarray:
        """(N,) index of each row in `rows` and `probabilities`; -1 for rows that were not queried."""
        return self._index[rows] - 1

    def query(self, rows: np.ndarray) -> np.ndarray:
        """(N, A) probabilities of distinct or repeated rows. Only new ones are queried."""
        indices = self.index_after_query(rows)  # before `probabilities`, which it appends to
        return self.probabilities[indices]

    def index_after_query(self, rows: np.ndarray) -> np.ndarray:
        """(N,) index of each row in `rows` and `probabilities`. New ones are queried."""
        indices = self.index(rows)
        if (is_new := indices < 0).any():
            unknown = np.unique(rows[is_new])
            count = self._count + unknown.size
            if count > len(self._rows):
                more = max(count, 2 * len(self._rows)) - len(self._rows)
                self._rows = np.concatenate([self._rows, np.empty(more, np.int64)])
                self._answers = np.concatenate([self._answers, np.empty((more, self.num_actions))])
            for start in range(0, unknown.size, QUERY_BATCH):
                block = unknown[start : start + QUERY_BATCH]
                part = slice(self._count + start, self._count + start + len(block))
                self._rows[part], self._answers[part] = block, self._query(block)
            self._index[unknown] = np.arange(self._count, count) + 1
            self._count = count
            indices = self.index(rows)
        return indices

    def _query(self, rows: np.ndarray) -> np.ndarray:
        """(N, A) probabilities in rows that are new."""
        raise NotImplementedError

    def start_rows(self) -> np.ndarray:
        """The rows of the start states."""
        return self.first_rows(self.mdp.start_states)

    def first_rows(self, states: np.ndarray) -> np.ndarray:
        """(N,) the rows of states in which episodes start."""
        return states * self.width + (self.num_actions if self.by_pairs else 0)

    def next_rows(self, rows: np.ndarray, executed: np.ndarray, next_states: np.ndarray) -> np.ndarray:
        """(N,) rows of the states `next_states` that are reached by executing actions in `rows`."""
        return self._arrivals(next_states, executed)

    def reach(self, max_rows: int | None = None, steps: int | None = None) -> bool:
        """Query the policy in all rows that it reaches within `steps`, level by level. False beyond `max_rows` rows."""
        mdp, frontier, level = self.mdp, self._start_nodes(), 0
        while frontier.size and (steps is None or level < steps):
            level += 1
            rows, states, previous = self._parts(frontier)
            probabilities = self.query(rows)
            if max_rows is not None and len(self.rows) > max_rows:
                return False
            check_choices(probabilities, None if mdp.available is None else mdp.available[states], states)
            weights = mdp.chance.at(states).weights(probabilities, previous)
            which, actions = np.nonzero(weights > 0)
            outcomes = mdp.dynamics.outcomes(states[which], actions)
            live = outcomes.states < mdp.num_states
            live[live] = ~np.asarray(mdp.terminal)[outcomes.states[live]]
            origin = outcomes.which[live]
            frontier = self._new_nodes(rows[which[origin]], actions[origin], outcomes.states[live])
        return True

    # Nodes: what `reach` visits, with all that decides what may come after: rows here.

    def _start_nodes(self) -> np.ndarray:
        return np.unique(self.start_rows())

    def _parts(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(rows, states, previous actions) of nodes."""
        return (nodes, *np.divmod(nodes, self.width))

    def _new_nodes(self, rows: np.ndarray, executed: np.ndarray, next_states: np.ndarray) -> np.ndarray:
        """Nodes, not visited before, to which executing actions in rows leads."""
        rows = np.unique(self.next_rows(rows, executed, next_states))
        return rows[self.index(rows) < 0]

    def query_all(self, reach: Callable[[], ReachableRows]) -> bool | None:
        """Query the policy in all rows of `reach` at once. Returns True.

        False if there are more rows, and the policy reaches all of these (every action has a positive probability,
        as seen in SOME of them). None if an action has probability 0, so that it may reach less. Then nothing is
        stored.
        """
        chance = self.mdp.chance
        always = chance.uniform > 0 and chance.first_uniform > 0
        if not always and not (self._query(self.start_rows()) > 0).all():
            return None
        rows, is_whole = reach()
        if not is_whole:
            return False if always or (self._query(rows[:: len(rows) // SOME + 1]) > 0).all() else None
        blocks = [self._query(rows[start : start + QUERY_BATCH]) for start in range(0, len(rows), QUERY_BATCH)]
        probabilities = np.concatenate(blocks)
        if not always and not (probabilities > 0).all():
            return None
        self._rows, self._answers, self._count = rows.copy(), probabilities, len(rows)
        self._index[rows] = np.arange(1, self._count + 1)
        return True

    def _arrivals(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """(N,) the rows of states that were reached by executing these actions."""
        return states * self.width + (actions if self.by_pairs else 0)

    def reached_states(self) -> np.ndarray:
        """(N,) the state that each state of `reached_mdp` behaves as: the state of a row, or each once under sticky
        actions, if the MDP tells previous actions apart itself."""
        states = self.rows // self.width
        return np.unique(states) if self.mdp.is_sticky else states

    def reached_mdp(self) -> tuple[TabularMDP, np.ndarray]:
        """The MDP on the queried states, and the policy on it. Other states have probability 0, and become the end."""
        mdp, states = self.mdp, self.reached_states()
        if not mdp.is_sticky:
            starts = self.index(self.start_rows())
            return self._mdp_on(
                states, starts, lambda next_states, executed, _: self.index(self._arrivals(next_states, executed))
            ), self.probabilities
        index = np.full(mdp.num_states, -1, np.int64)
        index[states] = np.arange(states.size)
        policy = np.zeros((states.size, self.width, mdp.num_actions))
        policy[:, :, 0] = 1.0  # arbitrary, in pairs that are not reached
        policy[index[self.rows // self.width], self.rows % self.width] = self.probabilities
        return self._mdp_on(states, index[mdp.start_states], lambda next_states, *_: index[next_states]), policy

    def _mdp_on(
        self, states: np.ndarray, starts: np.ndarray, number: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    ) -> TabularMDP:
        """The MDP in which state i behaves as `states[i]`.

        Args:
            starts: numbers of the start states.
            number: (next states, executed actions, numbers of the states before) -> numbers in the new MDP, -1 for the
                end.
        """
        mdp, count, num_actions = self.mdp, len(states), self.mdp.num_actions
        initial = np.zeros(count)
        np.add.at(initial, starts, mdp.start_probabilities)
        rewards = mdp.reward_table.rows(states)
        rounding = mdp.reward_table.rounding
        setting: dict[str, Any] = {"gamma": mdp.gamma, "initial": initial, "horizon": mdp.horizon}
        actions = np.tile(np.arange(num_actions), count)
        outcomes = mdp.dynamics.outcomes(np.repeat(states, num_actions), actions)
        inside = outcomes.states < mdp.num_states
        next_states = np.full(len(inside), -1, np.int64)
        which = outcomes.which[inside]
        next_states[inside] = number(outcomes.states[inside], actions[which], which // num_actions)
        if mdp.dynamics.is_deterministic:
            sub_mdp = TabularMDP.from_arrays(next_states.reshape(count, num_actions), rewards, **setting)
        else:
            from scipy import sparse

            stays = next_states >= 0
            entries = (outcomes.probabilities[stays], (outcomes.which[stays], next_states[stays]))
            matrix = sparse.csr_matrix(entries, (count * num_actions, count))
            sub_mdp = TabularMDP.from_matrices(matrix, rewards, ends=lacking(matrix), **setting)
        sub_mdp.dynamics.is_of_many = is_of_many = mdp.dynamics.is_unrolled
        table = replace(sub_mdp.reward_table, rounding=rounding, is_of_many=is_of_many)
        if mdp.horizon is not None:  # every step reads the rewards: no palette
            table = Rewards(np.asarray(rewards, np.float64), np.empty(0), rounding, is_of_many)
        return replace(
            sub_mdp,
            reward_table=table,
            chance=mdp.chance,
            residual=mdp.residual.plus(sub_mdp.residual),
            available=None if mdp.available is None else mdp.available[states],
        )


class AnyAnswers(QueriedPolicy):
    """Answers of the uniform policy, which reaches what any policy can reach."""

    def _query(self, rows: np.ndarray) -> np.ndarray:
        if self.mdp.available is None:
            return np.full((len(rows), self.num_actions), 1 / self.num_actions)
        sets = self.mdp.available[rows // self.width]
        return np.asarray(sets / sets.sum(axis=1, keepdims=True))


def reachable_rows(
    mdp: TabularMDP, max_rows: int, steps: int | None, *, sees_previous_action: bool = False
) -> ReachableRows:
    """Rows reached within so many steps by every policy in which each action has a positive probability."""
    answers = AnyAnswers(mdp, sees_previous_action=sees_previous_action)
    is_whole = answers.reach(max_rows, steps)
    return ReachableRows(answers.rows.copy(), is_whole)


MasksLike: TypeAlias = ArrayLike | Callable[[np.ndarray], ArrayLike]


class AnswerOptions(TypedDict, total=False):
    """Options of `PolicyAnswers`."""

    deterministic: bool
    masks: MasksLike | None


class ActionMasks:
    """Actions that may be chosen in each state.

    Args:
        masks: (S, A) bool by the states of the MDP, or a function from states (N, D), as a state space gives them, to
            (N, A) bool.
    Raises:
        ParameterError: they have another shape or type, or a state that is not terminal has no action.
    """

    def __init__(self, masks: MasksLike, mdp: TabularMDP, observer: "Observer"):
        self._function = masks if callable(masks) else None
        self._observer, self._num_actions = observer, mdp.num_actions
        if self._function is None:
            self._table = self._checked(masks, mdp.num_states)  # type: ignore[arg-type]  # no function
            self._check_rows(self._table | np.asarray(mdp.terminal)[:, None], np.arange(mdp.num_states))

    def of(self, states: np.ndarray) -> np.ndarray:
        """(N, A) bool, of states by their index (N,)."""
        if self._function is None:
            return self._table[states]
        masks = self._checked(self._function(self._observer.space.states(states)), len(states))
        self._check_rows(masks, states)
        return masks

    def _checked(self, masks: ArrayLike, count: int) -> np.ndarray:
        try:
            array = np.asarray(masks)
        except ValueError:  # rows of several lengths
            array = np.empty(0)
        is_truth = array.dtype == bool or (array.dtype.kind in "iu" and bool(np.isin(array, (0, 1)).all()))
        if array.shape != (count, self._num_actions) or not is_truth:
            raise ParameterError(
                f"masks have shape {array.shape} and type {array.dtype}; expected ({count}, {self._num_actions}) bool: "
                f"for each state, whether an action may be chosen"
            )
        return array.astype(bool)

    def _check_rows(self, masks: np.ndarray, states: np.ndarray) -> None:
        without = np.flatnonzero(~masks.any(axis=1))
        if without.size:
            raise ParameterError(
                f"masks allow no action in state {states[without[0]]}; expected one or more in every state that is not "
                f"terminal"
            )


class PolicyAnswers(QueriedPolicy):
    """Answers of a policy that sees observations.

    Args:
        policy: as `policy_function` takes it.
        deterministic: whether the most probable action is taken.
        masks: the actions that a model trained under masks may choose, as `ActionMasks` takes them. Default: the
            actions that are available in the MDP.
    Raises:
        ParameterError: it is no policy, was trained on other observations, or masks are missing or do not fit.
    """

    def __init__(
        self,
        policy: PolicyLike,
        mdp: TabularMDP,
        observer: Observer,
        *,
        deterministic: bool = False,
        masks: MasksLike | None = None,
    ):
        super().__init__(mdp, sees_previous_action=observer.previous_action)
        masks = masks_for(policy, mdp, masks)
        self.masks = None if masks is None else ActionMasks(masks, mdp, observer)
        self.policy = policy_function(policy, masked=masks is not None)
        self.observer, self.deterministic = observer, deterministic
        check_observation(policy, observer.observe.space, observer.observation)

    @cached_property
    def by_state(self) -> "AnswersByState":
        """Answers to observations of states alone, whatever the previous action was."""
        return AnswersByState(self)

    def _query(self, rows: np.ndarray) -> np.ndarray:
        return self.ask(rows) if self.observer.previous_action else self.by_state.query(rows // self.width)

    def query_all(self, reach: Callable[[], ReachableRows]) -> bool | None:
        """Query the policy as `QueriedPolicy` does. If that is None, one of vectors under chance has answered in all
        states of `reach` nevertheless, in blocks: level by level it would be asked about few at a time."""
        is_whole = super().query_all(reach)
        has_chance = self.by_pairs or self.mdp.dynamics.has_chance
        is_vector = len(getattr(self.observer.observe.space, "shape", None) or ()) == 1
        if is_whole is None and has_chance and is_vector and not self.observer.previous_action:
            reachable = reach()
            if reachable.is_whole:
                self.by_state.query(reachable.rows // self.width)
        return is_whole

    def ask(self, rows: np.ndarray) -> np.ndarray:
        """(N, A) probabilities in rows, asked now."""
        states, previous = np.divmod(rows, self.width)
        previous = np.where(previous == self.num_actions, -1, previous) if self.by_pairs else np.full(len(rows), -1)
        context = self.observer.space.states(states), previous, np.zeros(len(rows), np.int64)
        irrelevant = self.observer.observe.observation.irrelevant
        if not irrelevant:
            return self.answer(self.observer.observe(*context), len(rows), states)
        total = np.zeros((len(rows), self.num_actions))  # coins are fair and thrown anew at each step
        for coins in np.ndindex(*(2,) * irrelevant):
            thrown = np.tile(np.array(coins, np.float32), (len(rows), 1))
            total += self.answer(self.observer.observe(*context, coins=thrown), len(rows), states)
        return total / 2**irrelevant

    def answer(self, observations: Observations, count: int = 1, states: np.ndarray | None = None) -> np.ndarray:
        """(N, A) probabilities for a batch of `count` observations, of these states (N,) if masks need them."""
        if self.masks is None:
            return self.checked(self.policy(observations), count)
        assert states is not None
        return self.checked(self.policy(observations, self.masks.of(states)), count)

    def checked(self, answer: ArrayLike, count: int) -> np.ndarray:
        """(N, A) probabilities of an answer to `count` observations. ParameterError for any other."""
        answer = np.asarray(answer)
        if answer.dtype.kind in "iu" and answer.shape == (count,):
            if (answer < 0).any() or (answer >= self.num_actions).any():
                raise ParameterError(
                    f"the policy chose action {answer.min()} to {answer.max()}; expected 0 to {self.num_actions - 1}"
                )
            return np.eye(self.num_actions)[answer]
        kind = answer.dtype
        answer = answer.astype(np.float64)
        if np.isnan(answer).any():
            raise ParameterError(
                f"the policy answered NaN for {count} observations; expected probabilities, or actions"
            )
        if answer.shape != (count, self.num_actions):
            raise ParameterError(
                f"the policy answered with shape {answer.shape} of {kind} for {count} observations; expected "
                f"({count}, {self.num_actions}) probabilities, or ({count},) actions, which are integers"
            )
        if not (answer >= 0).all():
            raise ParameterError(
                f"the policy answered {answer.min():g}, a {kind}; expected probabilities of at least 0, or actions: of "
                f"values return the argmax, of logits the softmax"
            )
        total = answer.sum(axis=1, keepdims=True)
        if not (np.abs(total - 1) <= (HALF if kind == np.float16 else SINGLE)).all():
            raise ParameterError(
                f"the policy's probabilities sum to {total.min():g}; expected 1: of values return the argmax, of "
                f"logits the softmax"
            )
        if self.deterministic:
            return np.eye(self.num_actions)[answer.argmax(axis=1)]
        return answer / total


class AnswersByState(QueriedPolicy):
    """Answers of a policy that does not see the previous action: it is asked once about each state."""

    def __init__(self, answers: PolicyAnswers):
        super().__init__(answers.mdp, by_state=True)
        self.answers = answers

    def _query(self, rows: np.ndarray) -> np.ndarray:
        return self.answers.ask(rows * self.answers.width)


class TableAnswers(QueriedPolicy):
    """Answers of a table: (S,) actions, (S, A) probabilities, or either for each previous action.

    Raises:
        ParameterError: it has another shape.
    """

    def __init__(self, table: np.ndarray, mdp: TabularMDP, *, sees_previous_action: bool = False):
        super().__init__(mdp, sees_previous_action=sees_previous_action)
        states, actions = mdp.num_states, mdp.num_actions
        shapes = [(states,), (states, actions)]
        if self.by_pairs:
            shapes += [(states, actions + 1), (states, actions + 1, actions)]
        if table.shape not in shapes or (table.ndim == 2 and self.by_pairs and table.dtype.kind in "iu") != (
            table.shape == (states, actions + 1)
        ):
            raise ParameterError(f"the policy has shape {table.shape}; expected one of {', '.join(map(str, shapes))}")
        self.table = table

    def _query(self, rows: np.ndarray) -> np.ndarray:
        states, previous = np.divmod(rows, self.width)
        by_previous = self.table.ndim == 3 or self.table.shape == (self.mdp.num_states, self.num_actions + 1)
        answers = self.table[states, previous] if by_previous else self.table[states]
        return np.eye(self.num_actions)[answers] if answers.ndim == 1 else np.asarray(answers, np.float64)
