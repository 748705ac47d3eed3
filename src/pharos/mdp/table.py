"""Dynamics with one next state for each state and action: games, and whatever is deterministic."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pharos.kernels import bellman, graph, occupancy, paths
from pharos.mdp.dynamics import BellmanEquation, Dynamics, Outcomes, Play, as_indices
from pharos.mdp.selection import Extreme, PolicyTable


class Table(Dynamics):
    """One next state for each state and action, as a table.

    Attributes:
        next_states: (S, A) int32 or int64; -1: the episode ends there.
    """

    operations, mass, is_deterministic = 0, 1.0, True

    def __init__(self, next_states: np.ndarray):
        self.next_states = next_states
        self.num_states, self.num_actions = next_states.shape
        self._has_ends: bool | None = None

    @property
    def has_ends(self) -> bool:  # type: ignore[override]
        if self._has_ends is None:
            self._has_ends = bool((self.next_states == -1).any())
        return self._has_ends

    def deterministic_table(self) -> np.ndarray:
        return self.next_states

    def arrays(self) -> dict[str, np.ndarray]:
        return {"next_states": np.asarray(self.next_states)}

    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        table = self.next_states[states]  # -1 reads the last row, which is the end's
        if x.ndim == 1:
            return x[table]
        return x[table, np.arange(self.num_actions)] if x.shape[1] > 1 else x[table, 0]

    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        after = np.zeros((self.num_states, width))
        s, a = np.nonzero(mass)
        t = self.next_states[s, a]
        inside = t >= 0
        column = a[inside] if width > 1 else np.zeros_like(a[inside])
        np.add.at(after, (t[inside], column), mass[s, a][inside])
        return after

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        following = self.next_states[states, actions].astype(np.int64)
        following[following < 0] = self.num_states
        return Outcomes(np.arange(len(following)), following, np.ones(len(following)))

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return self.next_states[states, actions]

    def restricted_to(self, states: np.ndarray) -> "Table":
        """These states alone; what leads out of them leads back to where it came from."""
        number = np.full(self.num_states, -1, np.int64)
        number[states] = np.arange(len(states))
        table = np.asarray(self.next_states[states])
        inside = number[table]  # what leads to -1 gets any number here
        own = np.broadcast_to(np.arange(len(states))[:, None], table.shape)
        return Table(as_indices(np.where(table < 0, -1, np.where(inside < 0, own, inside)), len(states)))

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "Table":
        table = np.asarray(self.next_states)[representatives].astype(np.int64)
        return Table(as_indices(np.where(table >= 0, classes[table], -1), len(representatives)))

    # Compiled: the same, without temporary arrays -------------------------------------------------------------------

    def backup(self, equation: BellmanEquation, x: np.ndarray, out: np.ndarray) -> None:
        rewards, gamma, chance, select = equation
        if not isinstance(select, Extreme):
            return super().backup(equation, x, out)
        tables = (self.next_states, rewards.table, rewards.palette, gamma)
        actions = bellman.actions_of(self.num_actions)
        kernel, weights, x_, out_ = (
            (bellman.sticky_block, chance.triple, x, out)
            if chance.is_sticky
            else (bellman.optimal_block, chance.uniform, x[:, 0], out[:, 0])
        )
        out[-1] = 0.0
        _shared(
            lambda start, stop: kernel(*tables, weights, select.sign, x_, out_, actions, start, stop), self.num_states
        )

    def sweep(self, equation: BellmanEquation, x: np.ndarray) -> float:
        rewards, gamma, chance, select = equation
        tables = (self.next_states, rewards.table, rewards.palette, gamma)
        actions = bellman.actions_of(self.num_actions)
        if isinstance(select, PolicyTable):
            if chance.is_sticky:
                scratch = np.empty(self.num_actions)
                return bellman.sticky_policy_sweep(*tables, chance.triple, select.later, x, scratch)
            weights = (float(chance.chosen), float(chance.uniform))
            return bellman.policy_sweep(*tables, *weights, select.later[:, 0], x[:, 0])
        assert isinstance(select, Extreme)
        if chance.is_sticky:
            return bellman.sticky_sweep(*tables, chance.triple, select.sign, x, actions, np.empty(self.num_actions))
        return bellman.optimal_sweep(*tables, chance.uniform, select.sign, x[:, 0], actions)

    def move(self, play: Play, now: np.ndarray, after: np.ndarray) -> float:
        if now.shape[1] != after.shape[1]:  # the first step of sticky actions
            return super().move(play, now, after)
        return occupancy.push(self.next_states, play.live, play.policy, play.chance.triple, now, after)

    def settle(self, play: Play, gamma: float, least: float, waiting: np.ndarray, visits: np.ndarray) -> float:
        weights = play.chance.triple
        return occupancy.settle(self.next_states, play.live, play.policy, weights, gamma, least, waiting, visits)

    def support(self, play: Play, reached: np.ndarray) -> None:
        occupancy.support(self.next_states, play.live, play.policy, play.chance.triple, reached)

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        is_reached = np.zeros(self.num_states, np.bool_)
        frontier = np.unique(starts)
        is_reached[frontier] = True
        small = np.int32 if self.num_states < 2**31 else np.int64
        now, following = (np.empty(self.num_states, small) for _ in range(2))
        count, level = len(frontier), 0
        now[:count] = frontier
        while count and (steps is None or level < steps):
            count = graph.onwards(self.next_states, now, count, following, is_reached)
            now, following = following, now
            level += 1
        return is_reached

    def longest_path(self, live: np.ndarray) -> int:
        return int(paths.longest_path_of_table(self.next_states, live))


def _shared(block: Callable[[int, int], None], num_states: int) -> None:
    """block(start, stop) over all states, on all processors where there are enough states to share."""
    from pharos.workers import usable_workers

    workers = usable_workers(None) if num_states >= 1 << 16 else 1
    if workers == 1:
        return block(0, num_states)
    cuts = [num_states * i // workers for i in range(workers + 1)]
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(block, cuts[:-1], cuts[1:]))
