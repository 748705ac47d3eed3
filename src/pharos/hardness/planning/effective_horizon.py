"""The effective horizon: how far ahead one must look. Source: Laidlaw, Russell and Dragan (2023); stochastic: (2024).

Undiscounted episodes of T steps, time-indexed. All quantities live on the nodes that can be met: states, or under
sticky actions pairs (state, previously executed action) and the starts without one.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.hardness.planning.gorp import gorp_bound
from pharos.hardness.planning.large_horizon import LargeHorizon, applies
from pharos.hardness.planning.look_ahead import LookAhead
from pharos.hardness.planning.steps import TIE, FiniteHorizonValues, check_returns, steps_of
from pharos.mdp import TabularMDP, require_mdp

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
