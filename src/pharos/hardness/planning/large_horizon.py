"""The effective horizon of deterministic MDPs of millions of states: the numbers of effective_horizon, compiled.

Q^k_t(s, a) = r(s, a) + W^{k-1}_{t+1}(next state) with W^0 = V of uniform play and W^k_t(s) = max_a Q^k_t(s, a): one
number a state and step is kept instead of one for each action, and each k overwrites the one before, as step t needs
only step t + 1 of it.
"""

import math
from typing import Any

import numpy as np

from pharos.errors import UndefinedMeasure
from pharos.mdp import TabularMDP
from pharos.system import memory

_PARTS = 0.6  # of the memory that is free


def applies(mdp: TabularMDP) -> bool:
    """Whether the MDP has one next state for each state and action."""
    return mdp.is_deterministic and mdp.num_actions <= 64


class LargeHorizon:
    """Values at every step of an episode.

    Attributes:
        ahead: (T + 1, S) W^{k-1}, for the present k; row T is 0.
        spread: (T, S) max over a of var^k.
        optimal: (T, S) bit a is set where a is optimal.
    """

    def __init__(self, mdp: TabularMDP, steps: int, tie: float):
        from pharos.kernels import horizon as kernels

        self.kernels, self.steps, self.num_actions = kernels, steps, mdp.num_actions
        states = mdp.num_states
        bits = next(
            kind for kind in (np.uint8, np.uint16, np.uint32, np.uint64) if mdp.num_actions <= 8 * kind(0).itemsize
        )
        needed = (16 + bits(0).itemsize) * steps * states
        if needed > (room := _room()):
            raise UndefinedMeasure(
                f"effective_horizon: {steps} steps of the {states} states that they can meet need "
                f"{needed / 2**30:.1f} GiB, more than {room / 2**30:.1f}, "
                f"{_PARTS:.0%} of the free memory; a smaller horizon or instance would define it"
            )
        table = mdp.dynamics.deterministic_table()
        assert table is not None
        self.next_states = np.ascontiguousarray(table)
        self.rewards = np.array(mdp.rewards)
        self.rewards[np.asarray(mdp.terminal)] = 0.0
        self.starts = [
            (int(s), float(p)) for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True) if p > 0
        ]
        self.ahead, self.spread = np.zeros((steps + 1, states)), np.empty((steps, states))
        self.optimal = np.empty((steps, states), bits)
        best, worst = np.zeros((2, states)), np.zeros((2, states))
        for t in range(steps - 1, -1, -1):
            now, after = t % 2, 1 - t % 2
            kernels.values(
                *(self.next_states, self.rewards, tie, best[after], worst[after], self.ahead[t + 1]),
                *(best[now], worst[now], self.ahead[t], self.optimal[t], self.spread[t]),
            )
        self.returns = tuple(self._at_start(values) for values in (best[0], self.ahead[0], worst[0]))
        small = np.int32 if states < 2**31 else np.int64
        self.nodes = (np.empty(states, small), np.empty(states, small))
        self.is_visited = np.zeros(states, np.bool_)
        self.num_visitable = int(mdp.states_within(steps - 1).sum())

    def _at_start(self, values: np.ndarray) -> float:
        return float(sum(p * values[s] for s, p in self.starts))

    def _begin(self) -> int:
        first = sorted({s for s, _ in self.starts})
        self.nodes[0][: len(first)] = first
        return len(first)

    def samples(self, k: int) -> tuple[int, float, float] | None:
        """(m_k, gap, variance where it is attained); None where k fails."""
        log = math.log(2 * self.steps) + k * math.log(self.num_actions)
        worst: tuple[int, float, float] | None = None
        for needed, gap, variance in self._walk(log, near=True):
            if needed is None:
                return None
            samples = max(1, math.ceil(needed))
            if worst is None or samples > worst[0]:
                worst = (samples, gap, variance)
        return worst

    def is_greedy_optimal(self) -> bool:
        """Whether all actions greedy in Q^k, from the start on, are optimal."""
        return all(needed is not None for needed, _, _ in self._walk(0.0, near=False))

    def _walk(self, log: float, near: bool) -> Any:
        n, most = self._begin(), np.zeros(3)
        now, following = self.nodes
        for t in range(self.steps):
            n = self.kernels.walk(
                *(self.next_states, self.rewards, self.ahead[t + 1], self.optimal[t], self.spread[t], log, near),
                *(now, n, following, self.is_visited, most),
            )
            if n < 0:
                yield None, 0.0, 0.0
                return
            yield tuple(most.tolist())
            now, following = following, now
            if not n:
                return

    def advance(self, spread: bool = True) -> None:
        """From k to k + 1."""
        nothing = np.zeros(len(self.next_states))
        for t in range(self.steps):
            self.kernels.lookahead(self.next_states, self.rewards, 1.0, self.ahead[t + 1], self.ahead[t])
            if spread:
                after = self.spread[t + 1] if t + 1 < self.steps else nothing
                self.kernels.largest(self.next_states, after, self.spread[t])

    def look_at_rewards(self) -> None:
        """Begin again with Q^1 = r."""
        self.ahead[:] = 0.0

    def greedy_return(self) -> float:
        """J_k: the return of the policy greedy in Q^k, its ties broken as badly as possible."""
        value, now = np.zeros(len(self.next_states)), np.empty(len(self.next_states))
        for t in range(self.steps - 1, -1, -1):
            self.kernels.greedy_return(self.next_states, self.rewards, self.ahead[t + 1], value, now)
            value, now = now, value
        return self._at_start(value)


def _room() -> float:
    return _PARTS * memory.available_memory()
