"""Policies that see the last k frames, or remember: they are asked in histories, as far as they reach some."""

import hashlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP
from pharos.policies.policy import Arrays, Model, Policy, PolicyLike, RecurrentPolicy, deep_policy
from pharos.policies.query import PolicyAnswers, QueriedPolicy, ReachableRows, Sight, check_observation

# Histories whose frames are drawn at once
BATCH = 512


class QueriedHistories(PolicyAnswers):
    """Answers of a policy that sees k frames; a row is the number of a history, the last k states of an episode.

    The histories that a policy reaches, with what is executed in them, are an MDP again: a history leads to the one
    without its first state and with the next state behind. So the value of the policy is exact where they are few.
    """

    def __init__(self, policy: PolicyLike, mdp: TabularMDP, sight: Sight, *, deterministic: bool = False):
        if sight.previous_action:
            raise ParameterError("the policy sees several frames and the previous action; expected one or the other")
        super().__init__(policy, mdp, sight, deterministic=deterministic)
        self._name_rows()

    def _name_rows(self) -> None:
        """Rows are histories, whatever the previous action is; the last entry of a history is the state."""
        self.by_pairs, self.width = False, 1
        self._histories: list[tuple[int, ...]] = []
        self._number: dict[tuple[int, ...], int] = {}
        self._place = np.zeros(64, np.int32)

    def first_rows(self, states: np.ndarray) -> np.ndarray:
        return self._numbers([(int(s),) * self.sight.frames for s in states])

    def next_rows(self, rows: np.ndarray, executed: np.ndarray, next_states: np.ndarray) -> np.ndarray:
        pairs, inverse = np.unique(np.stack([rows, next_states], axis=1), axis=0, return_inverse=True)
        numbers = self._numbers([(*self._histories[row][1:], t) for row, t in pairs.tolist()])
        return numbers[inverse.reshape(-1)]

    def query_all(self, reach: Callable[[], ReachableRows]) -> bool | None:
        """Never: rows are histories."""
        return None

    def states_of(self, rows: np.ndarray) -> np.ndarray:
        return np.array([self._histories[row][-1] for row in rows], np.int64)

    def reach(self, max_rows: int | None = None, steps: int | None = None) -> bool:
        """See `QueriedPolicy.reach`; under sticky actions a history is visited once with each previous action."""
        mdp, width = self.mdp, self.mdp.policy_width
        frontier = np.unique(self.start_rows()) * width + (width - 1)
        visited, level = set(frontier.tolist()), 0
        while frontier.size and (steps is None or level < steps):
            level += 1
            rows, previous = np.divmod(frontier, width)
            probabilities = self.of(rows)
            if max_rows is not None and len(self.rows) > max_rows:
                return False
            weights = mdp.chance.weights(probabilities, previous)
            which, actions = np.nonzero(weights > 0)
            outcomes = mdp.dynamics.outcomes(self.states_of(rows[which]), actions)
            live = outcomes.states < mdp.num_states
            live[live] = ~np.asarray(mdp.terminal)[outcomes.states[live]]
            origin = outcomes.which[live]
            after = self.next_rows(rows[which[origin]], actions[origin], outcomes.states[live])
            pairs = np.unique(after * width + (actions[origin] if width > 1 else 0))
            frontier = np.array([pair for pair in pairs.tolist() if pair not in visited], np.int64)
            visited.update(frontier.tolist())
        return True

    def reached_mdp(self) -> tuple[TabularMDP, np.ndarray]:
        """The MDP on the histories that are reached, and the policy on it."""
        rows = self.rows

        def number(next_states: np.ndarray, executed: np.ndarray, origin: np.ndarray) -> np.ndarray:
            return self.index(self.next_rows(rows[origin], executed, next_states))

        return self._mdp_on(self.states_of(rows), self.index(self.start_rows()), number), self.probabilities

    def index(self, rows: np.ndarray) -> np.ndarray:
        self._make_room()
        return super().index(rows)

    def of(self, rows: np.ndarray) -> np.ndarray:
        self._make_room()
        return super().of(rows)

    def _make_room(self) -> None:
        """`_place` has an entry for each history that has a number."""
        if len(self._place) < len(self._histories):
            more = np.zeros(2 * len(self._histories) - len(self._place), np.int32)
            self._place = np.concatenate([self._place, more])

    def _query(self, rows: np.ndarray) -> np.ndarray:
        answers = []
        context: Any = self.sight.observe
        for start in range(0, len(rows), BATCH):
            histories = np.array([self._histories[row] for row in rows[start : start + BATCH]], np.int64)
            count, frames = histories.shape
            states = self.sight.space.states(histories.ravel()).reshape(count, frames, -1)
            observations = context.observation.of_histories(states)
            answers.append(self.answer(observations, count))
        return np.concatenate(answers)

    def _numbers(self, histories: list[tuple[int, ...]]) -> np.ndarray:
        """(N,) of histories, those that are new included."""
        for history in histories:
            if history not in self._number:
                self._number[history] = len(self._histories)
                self._histories.append(history)
        return np.array([self._number[history] for history in histories], np.int64)


class QueriedMemories(QueriedHistories):
    """Answers of a policy with a memory; a row is the number of (memory, previous action if it is seen, state).

    A memory is what the policy has kept of the observations before. It has one number where the observations before
    were the same, and where what is kept is the same to the last bit: a policy that keeps nothing is asked once about
    each state and once more at the start, one that counts steps once about each state and step.

    Raises:
        ParameterError: the policy would see several frames, or entries that are drawn at every step, besides.
    Cost: what the policy keeps is stored for each row.
    """

    def __init__(self, policy: RecurrentPolicy, mdp: TabularMDP, sight: Sight, *, deterministic: bool = False):
        observation = sight.observe.observation
        if observation.frames > 1 or observation.irrelevant:
            besides = "several frames" if observation.frames > 1 else "irrelevant entries"
            raise ParameterError(f"the policy has a memory and sees {besides}; expected one or the other")
        QueriedPolicy.__init__(self, mdp)
        self.recurrent, self.sight, self.deterministic = policy, sight, deterministic
        check_observation(policy, sight.observe.space, sight.observation)
        self._name_rows()
        # of each memory but the first, which is that of the start, what is kept; `_layout` says how to read it
        self._kept: list[bytes] = [b""]
        self._memory: dict[bytes, int] = {}
        self._layout: Any = None
        self._after: dict[int, int] = {}  # row -> memory when the policy has been asked there
        self._answered: dict[tuple[int, bytes], tuple[np.ndarray, int]] = {}

    def first_rows(self, states: np.ndarray) -> np.ndarray:
        return self._numbers([(0, self.num_actions, int(s)) for s in states])

    def next_rows(self, rows: np.ndarray, executed: np.ndarray, next_states: np.ndarray) -> np.ndarray:
        after = np.array([self._after[row] for row in rows.tolist()], np.int64)
        previous = executed if self.sight.previous_action else np.full(len(rows), self.num_actions)
        keys, inverse = np.unique(np.stack([after, previous, next_states], axis=1), axis=0, return_inverse=True)
        return self._numbers([tuple(key) for key in keys.tolist()])[inverse.reshape(-1)]

    def _query(self, rows: np.ndarray) -> np.ndarray:
        memory, previous, states = np.array([self._histories[row] for row in rows], np.int64).T
        previous = np.where(previous == self.num_actions, -1, previous)
        observations = self.sight.observe(self.sight.space.states(states), previous, np.minimum(memory, 1))
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
        """Numbers of what the policy keeps of `count` episodes."""
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
        """What the policy has kept, as it gave it, of memories other than the first."""
        joined = np.frombuffer(b"".join(self._kept[number] for number in memory), np.uint8).reshape(len(memory), -1)
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
    """The same with other arrays."""
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


def answers_of(policy: PolicyLike, mdp: TabularMDP, sight: Sight, *, deterministic: bool = False) -> PolicyAnswers:
    """The answers of a policy that sees observations, of one state or of several, or remembers them."""
    if isinstance(policy, Model) and not isinstance(policy, Policy):
        policy = deep_policy(policy)
    if isinstance(policy, RecurrentPolicy) and not isinstance(policy, Policy):
        return QueriedMemories(policy, mdp, sight, deterministic=deterministic)
    kind = QueriedHistories if sight.frames > 1 else PolicyAnswers
    return kind(policy, mdp, sight, deterministic=deterministic)
