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
from dataclasses import dataclass, field
from typing import Any

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
    parts = _compiled(LargeHorizon(mdp, steps, TIE)) if compiled else _vectorized(FiniteHorizonValues(mdp, steps))
    bound = gorp_bound(mdp, horizon=steps, max_k=tight).value if tight else None
    conventions = {
        "horizon": steps,
        "gamma": 1.0,
        "exploration": "uniform",
        "tie_tolerance": TIE,
        "states": mdp.nodes,
    }
    return EffectiveHorizon(**parts, tight=bound, conventions=conventions)


def _vectorized(tree: FiniteHorizonValues) -> dict[str, Any]:
    steps = tree.steps
    bound = _simple_bound(tree)
    return {
        **dict(zip(("value", "ks", "ms", "gaps", "vars"), bound, strict=True)),
        "k_min": _first_greedy(tree, tree.explored, steps),
        "effective_planning_window": _first_greedy(tree, np.broadcast_to(tree.rewards, tree.explored.shape), steps),
        "greedy_returns": [_greedy_return(tree, k) for k in range(1, GREEDY_RETURNS + 1)],
        "optimal_return": tree.at_start(tree.best.max(axis=2)[0]),
        "random_return": tree.at_start(tree.explored_value[0]),
        "worst_return": tree.at_start(tree.worst.min(axis=2)[0]),
        "num_states": tree.num_visitable,
    }


def _compiled(table: Any) -> dict[str, Any]:
    """The same, for each k in turn."""
    steps, best = table.steps, float(table.steps)
    rows: list[tuple[int, int, float, float]] = []
    greedy: list[float] = []
    k_min, k = 0, 1
    while k < best or k <= GREEDY_RETURNS or not k_min:
        if k < best and (needed := table.samples(k)) is not None:
            rows.append((k, *needed))
            best = min(best, k + (math.log(needed[0]) / math.log(table.num_actions) if table.num_actions > 1 else 0.0))
        if not k_min and (table.is_greedy_optimal() or k == steps):
            k_min = k
        if k <= GREEDY_RETURNS:
            greedy.append(table.greedy_return())
        table.advance()
        k += 1
    table.look_at_rewards()
    window = 1
    while not table.is_greedy_optimal() and window < steps:
        table.advance(spread=False)
        window += 1
    ks, ms, gaps, variances = (list(each) for each in zip(*rows, strict=True)) if rows else ([], [], [], [])
    optimal, random, worst = table.returns
    return {
        **{"value": best, "ks": ks, "ms": ms, "gaps": gaps, "vars": variances, "k_min": k_min},
        **{"effective_planning_window": window, "greedy_returns": greedy, "num_states": table.num_visitable},
        **{"optimal_return": optimal, "random_return": random, "worst_return": worst},
    }


def _first_greedy(tree: FiniteHorizonValues, values: np.ndarray, most: int) -> int:
    """The smallest k for which all actions greedy in Q^k, from the start on, are optimal."""
    for k in range(1, most + 1):
        met = tree.first
        for t in range(tree.steps):
            greedy = values[t] == values[t].max(axis=1, keepdims=True)
            if (greedy & ~tree.optimal[t])[met].any():
                break
            met = tree.following(met, greedy)
        else:
            return k
        values = tree.lookahead(values)
    return most


def _simple_bound(tree: FiniteHorizonValues) -> tuple[float, list[int], list[int], list[float], list[float]]:
    """(H, ks, ms, gaps, vars) of theorem 5.4."""
    actions, horizon = tree.num_actions, tree.steps
    values, best = tree.explored, float(horizon)
    variance = (tree.explored - tree.worst) * (tree.best - tree.worst)
    ks: list[int] = []
    ms: list[int] = []
    gaps: list[float] = []
    variances: list[float] = []
    k = 1
    while k < best:
        requirement = _samples(tree, values, variance, math.log(2 * horizon) + k * math.log(actions))
        if requirement is not None:
            samples, gap, spread = requirement
            ks.append(k)
            ms.append(samples)
            gaps.append(gap)
            variances.append(spread)
            best = min(best, k + (math.log(samples) / math.log(actions) if actions > 1 else 0.0))
        values = tree.lookahead(values)
        after = np.zeros_like(variance)
        for t in range(tree.steps - 1):
            after[t] = tree.following_max(variance[t + 1].max(axis=1))
        variance = after
        k += 1
    return best, ks, ms, gaps, variances


def _samples(
    tree: FiniteHorizonValues, values: np.ndarray, variance: np.ndarray, log: float
) -> tuple[int, float, float] | None:
    """(m_k, gap, var where it is attained); None where k fails."""
    worst: tuple[int, float, float] | None = None
    met = tree.first
    for t in range(tree.steps):
        nodes = np.flatnonzero(met)
        best = values[t, nodes].max(axis=1)
        second = np.where(tree.optimal[t, nodes], -math.inf, values[t, nodes]).max(axis=1)
        if (best == second).any():
            return None
        gap, spread = best - second, variance[t, nodes].max(axis=1)
        with np.errstate(invalid="ignore"):
            needed = np.where(np.isinf(gap), 0.0, 16 * spread / gap**2 * log)
        i = int(needed.argmax())
        samples = max(1, math.ceil(needed[i]))  # the first among equals
        if worst is None or samples > worst[0]:
            worst = (samples, float(gap[i]), float(spread[i]))
        better = np.zeros((tree.num_nodes, tree.num_actions), np.bool_)
        better[nodes] = values[t, nodes] > second[:, None]
        met = tree.following(met, better)
    return worst


def _greedy_return(tree: FiniteHorizonValues, k: int) -> float:
    """J_k: the return of the policy greedy in Q^k, its ties broken as badly as possible."""
    values = tree.explored
    for _ in range(k - 1):
        values = tree.lookahead(values)
    value = np.zeros(tree.num_nodes)
    for t in range(tree.steps - 1, -1, -1):
        greedy = values[t] == values[t].max(axis=1, keepdims=True)
        followed = tree.backup(value) if t < tree.steps - 1 else tree.rewards
        value = np.where(greedy, followed, math.inf).min(axis=1)
    return tree.at_start(value)


# Large horizon --------------------------------------------------------------------------------------------------------


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
