"""The effective horizon: how far ahead one must look. Source: Laidlaw, Russell and Dragan (2023); stochastic: (2024).

Undiscounted episodes of T steps, time-indexed. All quantities live on the nodes that can be met: states, or under
sticky actions pairs (state, previously executed action) and the starts without one.

The effective horizon of deterministic MDPs of millions of states: the numbers of effective_horizon, compiled.

Q^k_t(s, a) = r(s, a) + W^{k-1}_{t+1}(next state) with W^0 = V of uniform play and W^k_t(s) = max_a Q^k_t(s, a): one
number a state and step is kept instead of one for each action, and each k overwrites the one before, as step t needs
only step t + 1 of it.

What both effective horizons consist of. Source: Laidlaw, Russell and Dragan (2023), theorem 5.4.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from pharos.errors import UndefinedMeasure
from pharos.hardness.planning.gorp import gorp_bound
from pharos.hardness.planning.steps import TIE, FiniteHorizonValues, check_returns, steps_of
from pharos.mdp import TabularMDP, require_mdp
from pharos.system import memory


@dataclass(frozen=True)
class LookAhead:
    """How far ahead one must look, and the samples that each depth takes.

    Attributes:
        value: min over k of k + log_A m_k, at most the number of steps.
        k_min: smallest k for which acting greedily in Q^k is optimal, Q^1 being the value of uniform play.
        effective_planning_window: the same from Q^1 = r: how many rewards ahead one must see.
        ks, ms, gaps, vars: for each k that was tried and does not fail: k, the samples m_k, and gap and variance bound
            where m_k is attained.
    """

    value: float
    k_min: int
    effective_planning_window: int
    ks: list[int]
    ms: list[int]
    gaps: list[float]
    vars: list[float]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; infinite gaps are None."""
        return {
            "value": self.value,
            "k_min": self.k_min,
            "effective_planning_window": self.effective_planning_window,
            "ks": self.ks,
            "ms": self.ms,
            "gaps": [gap if math.isfinite(gap) else None for gap in self.gaps],
            "vars": self.vars,
        }

    def __str__(self) -> str:
        return f"{self.value:.6g} (k_min {self.k_min}, window {self.effective_planning_window})"


COMPILED = 2**26  # bytes of the table of all steps from which on it is not written out
GREEDY_RETURNS = 5


@dataclass(frozen=True)
class EffectiveHorizon(LookAhead):
    """How far ahead one must look in an MDP.

    Attributes:
        value, k_min, effective_planning_window, ks, ms, gaps, vars: see LookAhead; `value` is the effective horizon by
            the simple bound.
        tight: a tighter bound by GORP's failure probability, where it was asked for; else None.
        greedy_returns: J_k for k = 1, ..., 5: return of the policy greedy in Q^k, ties broken adversarially.
        optimal_return, random_return, worst_return: from the start.
        num_states: number of states that can be met at some step; under sticky actions, as BRIDGE counts, of pairs
            (state, previously executed action), the implicit end with every action among them, and a start with the
            first action.
        conventions: horizon, exploration, chance, tie tolerance.
    """

    greedy_returns: list[float]
    optimal_return: float
    random_return: float
    worst_return: float
    num_states: int
    tight: float | None = None
    conventions: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; infinite gaps are None."""
        return {
            **super().to_dict(),
            "tight": self.tight,
            "greedy_returns": self.greedy_returns,
            "optimal_return": self.optimal_return,
            "random_return": self.random_return,
            "worst_return": self.worst_return,
            "num_states": self.num_states,
        }


@require_mdp
def effective_horizon(mdp: TabularMDP, *, horizon: int | None = None, tight: int = 0) -> EffectiveHorizon:
    """Return the effective horizon of an MDP, and what it is made of.

        Q^1 = Q of the uniform policy,  Q^{k+1}_t(s, a) = r(s, a) + E max_b Q^k_{t+1}(s', b),  Q^k_T = r
        var^1 = (Q^e - Q^w)(Q* - Q^w),  var^{k+1}_t(s, a) = max over s', b of var^k_{t+1}(s', b)
        m_k = max over states met of max(1, ceil(16 max_a var^k / gap_k^2 ln(2 T A^k))),  H = min_k k + log_A m_k

    gap_k is the difference between the largest Q^k and the largest Q^k of an action that is not optimal; states met are
    those that actions better than all of the latter lead to. k fails where that difference is exactly 0.

    Args:
        horizon: T; None: that of the MDP.
        tight: the largest k for which the tight bound of `gorp_bound` is computed as well; 0: none.
    Raises:
        UndefinedMeasure: there is no horizon, or the table of all steps does not fit into memory: 8 GiB under chance,
            else 60 % of that of the machine. PrecisionError: returns may pass 1e150.
    Cost: a pass over T x nodes x A for every k that is tried, of those that can be met within T steps. Memory 40 bytes
        for each of them under chance; 17 bytes for each of T x S without.
    Source: Laidlaw, Russell and Dragan (2023), "Bridging RL theory and practice with the effective horizon", theorem
        5.4 and appendix C; sticky actions: Laidlaw et al. (2024).
    """
    steps = steps_of("effective_horizon", mdp, horizon)
    check_returns("effective_horizon", mdp, steps)
    mdp = mdp.within(steps)
    compiled = applies(mdp) and 40 * steps * mdp.num_states * mdp.num_actions > COMPILED
    parts = parts_of(LargeHorizon(mdp, steps, TIE) if compiled else SmallHorizon(mdp, steps))
    bound = gorp_bound(mdp, horizon=steps, max_k=tight).value if tight else None
    conventions = {
        "horizon": steps,
        "gamma": 1.0,
        "exploration": "uniform",
        "tie_tolerance": TIE,
        "states": mdp.nodes,
    }
    return EffectiveHorizon(**parts, tight=bound, conventions=conventions)


def parts_of(play: "SmallHorizon | LargeHorizon") -> dict[str, Any]:
    """What an `EffectiveHorizon` consists of."""
    ahead, greedy = look_ahead(play, play.steps, play.num_actions, play.greedy_return)
    returns = dict(zip(("optimal_return", "random_return", "worst_return"), play.returns, strict=True))
    return {**vars(ahead), **returns, "greedy_returns": greedy, "num_states": play.num_visitable}


class Play(Protocol):
    """Q^k for one k after the other, k = 1 at first: what both effective horizons ask."""

    def samples(self, log: float) -> tuple[int, float, float] | None:
        """(m_k, gap, variance where it is attained), log = ln(2 T A^k); None where k fails."""

    def is_greedy_optimal(self) -> bool:
        """Whether all actions greedy in Q^k, from the start on, are optimal."""

    def advance(self, spread: bool = True) -> None:
        """From k to k + 1; spread: of the variances, too."""

    def look_at_rewards(self) -> None:
        """Begin again with Q^1 = r."""


def look_ahead(
    play: Play,
    steps: int,
    num_actions: int,
    greedy_return: Callable[[], float] | None = None,
    tell: Callable[[str], object] = str,
) -> tuple[LookAhead, list[float]]:
    """How far ahead one must look in episodes of `steps` steps, and `greedy_return` for k = 1, ..., 5, where asked."""
    best, log_actions = float(steps), math.log(num_actions)
    rows: list[tuple[int, int, float, float]] = []
    greedy: list[float] = []
    last = 0 if greedy_return is None else GREEDY_RETURNS
    k_min, k = 0, 1
    while k < best or k <= last or not k_min:
        tell(f"k = {k}, bound {best:.4g}")
        if k < best and (needed := play.samples(math.log(2 * steps) + k * log_actions)) is not None:
            rows.append((k, *needed))
            best = min(best, k + (math.log(needed[0]) / log_actions if num_actions > 1 else 0.0))
        if not k_min and (k >= steps or play.is_greedy_optimal()):
            k_min = k
        if greedy_return is not None and k <= last:
            greedy.append(greedy_return())
        play.advance()
        k += 1
    play.look_at_rewards()
    window = 1
    while window < steps and not play.is_greedy_optimal():
        tell(f"window {window}")
        play.advance(spread=False)
        window += 1
    ks, ms, gaps, variances = (list(each) for each in zip(*rows, strict=True)) if rows else ([], [], [], [])
    return LookAhead(best, k_min, window, ks, ms, gaps, variances), greedy


class SmallHorizon(FiniteHorizonValues):
    """`Play` of MDPs whose action values of all steps are written out.

    Attributes:
        values: (T, N, A) Q^k. variance: (T, N, A) var^k.
    """

    def __init__(self, mdp: TabularMDP, steps: int):
        super().__init__(mdp, steps)
        self.values, self.variance = self.explored, (self.explored - self.worst) * (self.best - self.worst)
        values = (self.best.max(axis=2)[0], self.explored_value[0], self.worst.min(axis=2)[0])
        self.returns = tuple(map(self.at_start, values))

    def samples(self, log: float) -> tuple[int, float, float] | None:
        worst: tuple[int, float, float] | None = None
        met = self.first
        for t in range(self.steps):
            nodes = np.flatnonzero(met)
            best = self.values[t, nodes].max(axis=1)
            second = np.where(self.optimal[t, nodes], -math.inf, self.values[t, nodes]).max(axis=1)
            if (best == second).any():
                return None
            samples, gap, spread = most_samples(best - second, self.variance[t, nodes].max(axis=1), log)
            if worst is None or samples > worst[0]:
                worst = (samples, gap, spread)
            better = np.zeros((self.num_nodes, self.num_actions), np.bool_)
            better[nodes] = self.values[t, nodes] > second[:, None]
            met = self.following(met, better)
        return worst

    def is_greedy_optimal(self) -> bool:
        met = self.first
        for t in range(self.steps):
            greedy = self.values[t] == self.values[t].max(axis=1, keepdims=True)
            if (greedy & ~self.optimal[t])[met].any():
                return False
            met = self.following(met, greedy)
        return True

    def advance(self, spread: bool = True) -> None:
        self.values = self.lookahead(self.values)
        if spread:
            after = np.zeros_like(self.variance)
            for t in range(self.steps - 1):
                after[t] = self.following_max(self.variance[t + 1].max(axis=1))
            self.variance = after

    def look_at_rewards(self) -> None:
        self.values = np.broadcast_to(self.rewards, self.explored.shape)

    def greedy_return(self) -> float:
        """J_k: the return of the policy greedy in Q^k, its ties broken as badly as possible."""
        value = np.zeros(self.num_nodes)
        for t in range(self.steps - 1, -1, -1):
            greedy = self.values[t] == self.values[t].max(axis=1, keepdims=True)
            followed = self.backup(value) if t < self.steps - 1 else self.rewards
            value = np.where(greedy, followed, math.inf).min(axis=1)
        return self.at_start(value)


def most_samples(gap: np.ndarray, variance: np.ndarray, log: float) -> tuple[int, float, float]:
    """(max(1, ceil(16 variance / gap^2 log)), gap, variance) of the node that needs most, the first among equals."""
    with np.errstate(invalid="ignore"):
        needed = np.where(np.isinf(gap), 0.0, 16 * variance / gap**2 * log)
    i = int(needed.argmax())
    return max(1, math.ceil(needed[i])), float(gap[i]), float(variance[i])


# Large horizon --------------------------------------------------------------------------------------------------------


_PARTS = 0.6  # of the memory that is free


def applies(mdp: TabularMDP) -> bool:
    """Whether the MDP has one next state for each state and action."""
    return mdp.is_deterministic and mdp.num_actions <= 64


class LargeHorizon:
    """`Play` of deterministic MDPs of millions of states: values of states at every step.

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

    def samples(self, log: float) -> tuple[int, float, float] | None:
        worst: tuple[int, float, float] | None = None
        for needed, gap, variance in self._walk(log, near=True):
            if needed is None:
                return None
            samples = max(1, math.ceil(needed))
            if worst is None or samples > worst[0]:
                worst = (samples, gap, variance)
        return worst

    def is_greedy_optimal(self) -> bool:
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
        nothing = np.zeros(len(self.next_states))
        for t in range(self.steps):
            self.kernels.lookahead(self.next_states, self.rewards, 1.0, self.ahead[t + 1], self.ahead[t])
            if spread:
                after = self.spread[t + 1] if t + 1 < self.steps else nothing
                self.kernels.largest(self.next_states, after, self.spread[t])

    def look_at_rewards(self) -> None:
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
