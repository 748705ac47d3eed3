"""Policies that see the last k frames: they are asked in histories of k states, as far as they reach some."""

from collections.abc import Callable
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP
from pharos.policies.policy import PolicyLike
from pharos.policies.query import PolicyAnswers, ReachableRows, Sight

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
        self.by_pairs, self.width = False, 1  # rows are histories, whatever the previous action is
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


def answers_of(policy: PolicyLike, mdp: TabularMDP, sight: Sight, *, deterministic: bool = False) -> PolicyAnswers:
    """The answers of a policy that sees observations, of one state or of several."""
    kind = QueriedHistories if sight.frames > 1 else PolicyAnswers
    return kind(policy, mdp, sight, deterministic=deterministic)
