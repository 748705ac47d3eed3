"""Tables of Q-learning that are learnt together: a batch as one_batch.py knows it, without networks.

Learning a table costs tens of nanoseconds a step; what takes the time is to evaluate what each has learnt, and policies
of one small MDP are evaluated together.
"""

from collections.abc import Callable, Sequence

import numpy as np

from pharos.agents import QLearning, joined_states, state_of

MakeTable = Callable[[], QLearning]


class Tables:
    """N tables that learn; each is what it is alone.

    Attributes:
        steps: of each run so far.
        episodes: (N,) int64, finished ones; returns: (N,) float64, the sums of their returns.
    """

    def __init__(self, makers: Sequence[MakeTable]):
        self._tables = [make() for make in makers]

    @property
    def steps(self) -> int:
        """Steps of each run so far."""
        return self._tables[0].steps

    @property
    def episodes(self) -> np.ndarray:
        """(N,) int64, finished episodes."""
        return np.array([table.episodes for table in self._tables], np.int64)

    @property
    def returns(self) -> np.ndarray:
        """(N,) float64, the sums of the returns of finished episodes."""
        return np.array([table.sum_of_returns for table in self._tables])

    def learn(self, points: Sequence[int], at_point: Callable[[int], None]) -> None:
        """Go on from `steps`, and call `at_point` at each of the points."""
        for point in points:
            for table in self._tables:
                table.learn(point - table.steps)
            at_point(point)

    def policy(self, i: int) -> QLearning:
        """The agent of run i."""
        return self._tables[i]

    def greedy_actions(self, places: Sequence[int]) -> dict[int, np.ndarray]:
        """(S,) actions of each of some runs, by its place; runs that look back at the previous action are left out."""
        tables = {i: self._tables[i].policy_table() for i in places}
        return {i: table for i, table in tables.items() if table.ndim == 1}

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs to go on, bit for bit."""
        return joined_states(table.state() for table in self._tables)

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on from what `state` gave, in a batch of the same runs."""
        for i, table in enumerate(self._tables):
            table.restore(state_of(state, i))
