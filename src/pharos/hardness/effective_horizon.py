"""The effective horizon: how far ahead one must look. Source: Laidlaw, Russell and Dragan (2023); stochastic: (2024).

Undiscounted episodes of T steps, time-indexed. All quantities live on the nodes that can be met: states, or under sticky actions
pairs (state, previously executed action) and the starts without one.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import sparse

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.mdp import TabularMDP

TIE = 1e-4  # an action is optimal if its value is within this of the best
MEMORY = 8 * 2**30
COMPILED = 2**26  # bytes of the table of all steps from which on it is not written out
GREEDY_RETURNS = 5


@dataclass(frozen=True)
class EffectiveHorizon:
    """How far ahead one must look in an MDP.

    Attributes:
        value: the effective horizon by the simple bound, H = min over k of k + log_A m_k, at most T.
        k_min: smallest k for which acting greedily in Q^k is optimal, Q^1 being the value of the exploration policy (uniform).
        effective_planning_window: the same from Q^1 = r: how many rewards ahead one must see.
        ks, ms, gaps, vars: for each k that was tried and does not fail: k, the samples m_k, and gap and variance bound where m_k is
            attained.
        tight: a tighter bound by GORP's failure probability, where it was asked for; else None.
        greedy_returns: J_k for k = 1, ..., 5: return of the policy greedy in Q^k, ties broken adversarially.
        optimal_return, random_return, worst_return: from the start.
        num_states: number of states that can be met at some step; under sticky actions, as BRIDGE counts, of pairs (state,
            previously executed action), the implicit end with every action among them, and a start with the first action.
        conventions: horizon, exploration, chance, tie tolerance.
    """

    value: float
    k_min: int
    effective_planning_window: int
    ks: list[int]
    ms: list[int]
    gaps: list[float]
    vars: list[float]
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
            "value": self.value,
            "k_min": self.k_min,
            "effective_planning_window": self.effective_planning_window,
            "ks": self.ks,
            "ms": self.ms,
            "gaps": [gap if math.isfinite(gap) else None for gap in self.gaps],
            "vars": self.vars,
            "tight": self.tight,
            "greedy_returns": self.greedy_returns,
            "optimal_return": self.optimal_return,
            "random_return": self.random_return,
            "worst_return": self.worst_return,
            "num_states": self.num_states,
        }

    def __str__(self) -> str:
        return f"{self.value:.6g} (k_min {self.k_min}, window {self.effective_planning_window})"


def effective_horizon(mdp: TabularMDP, *, horizon: int | None = None, tight: int = 0) -> EffectiveHorizon:
    """Return the effective horizon of an MDP, and what it is made of.

        Q^1 = Q of the uniform policy,  Q^{k+1}_t(s, a) = r(s, a) + E max_b Q^k_{t+1}(s', b),  Q^k_T = r
        var^1 = (Q^e - Q^w)(Q* - Q^w),  var^{k+1}_t(s, a) = max over s', b of var^k_{t+1}(s', b)
        m_k = max over states met of max(1, ceil(16 max_a var^k / gap_k^2 ln(2 T A^k))),  H = min_k k + log_A m_k

    gap_k is the difference between the largest Q^k and the largest Q^k of an action that is not optimal; states met are those
    that actions better than all of the latter lead to. k fails where that difference is exactly 0.

    Args:
        horizon: T; None: that of the MDP.
        tight: the largest k for which the tight bound of `gorp_bound` is computed as well; 0: none.
    Raises:
        UndefinedMeasure: there is no horizon, or the table of all steps does not fit into memory: 8 GiB under chance, else 60 % of
            that of the machine.
    Cost: a pass over T x nodes x A for every k that is tried, of those that can be met within T steps. Memory 40 bytes for each of them
        under chance; 17 bytes for each of T x S without.
    Source: Laidlaw, Russell and Dragan (2023), "Bridging RL theory and practice with the effective horizon", theorem 5.4 and
        appendix C; sticky actions: Laidlaw et al. (2024).
    """
    steps = steps_of("effective_horizon", mdp, horizon)
    mdp = mdp.within(steps)
    from pharos.hardness import large_horizon as _large_horizon

    compiled = _large_horizon.applies(mdp) and 40 * steps * mdp.num_states * mdp.num_actions > COMPILED
    parts = _compiled(_large_horizon.LargeHorizon(mdp, steps, TIE)) if compiled else _vectorized(_Steps(mdp, steps))
    bound = gorp_value(mdp, steps, tight) if tight else None
    conventions = {
        "horizon": steps,
        "gamma": 1.0,
        "exploration": "uniform",
        "tie_tolerance": TIE,
        "states": "pairs (state, previously executed action)" if mdp.is_sticky else "states",
    }
    return EffectiveHorizon(**parts, tight=bound, conventions=conventions)


def gorp_value(mdp: TabularMDP, steps: int, max_k: int) -> float:
    """The tight bound, with BRIDGE's methods."""
    from pharos.hardness.gorp import gorp_bound

    return gorp_bound(mdp, horizon=steps, max_k=max_k).value


def _vectorized(tree: "_Steps") -> dict[str, Any]:
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
    found: list[tuple[int, int, float, float]] = []
    greedy: list[float] = []
    k_min, k = 0, 1
    while k < best or k <= GREEDY_RETURNS or not k_min:
        if k < best and (needed := table.samples(k)) is not None:
            found.append((k, *needed))
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
    ks, ms, gaps, variances = (list(each) for each in zip(*found, strict=True)) if found else ([], [], [], [])
    optimal, random, worst = table.returns
    return {
        **{"value": best, "ks": ks, "ms": ms, "gaps": gaps, "vars": variances, "k_min": k_min},
        **{"effective_planning_window": window, "greedy_returns": greedy, "num_states": table.num_visitable},
        **{"optimal_return": optimal, "random_return": random, "worst_return": worst},
    }


def steps_of(name: str, mdp: TabularMDP, horizon: int | None) -> int:
    """T: what was given, else the horizon of the MDP."""
    steps = mdp.horizon if horizon is None else horizon
    if steps is None:
        raise UndefinedMeasure(f"{name} is defined for episodes of T steps: give a horizon")
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ParameterError(f"horizon is {steps!r}; expected a whole number of steps, at least 1")
    return int(steps)


class _Steps:
    """Values at every step t = 1, ..., T (index t - 1) of optimal, worst and exploring play, on the nodes of an MDP.

    Attributes:
        matrix: (N A, N) probabilities; rewards (N, A).
        best, worst, explored: (T, N, A) action values; explored_value (T, N), clipped to [worst, best].
        optimal: (T, N, A) bool.
        met: (T, N) bool, whether a node can be met at step t.
    """

    def __init__(self, mdp: TabularMDP, steps: int):
        from pharos.hardness.choices import choices_of

        size = (mdp.num_states + 1) * (mdp.num_actions + 1 if mdp.is_sticky else 1)
        needed = 40 * steps * size * mdp.num_actions
        if needed > MEMORY:
            raise UndefinedMeasure(
                f"effective_horizon: {steps} steps of the {size} nodes that they can meet need {needed / 2**30:.1f} GiB, more than {MEMORY / 2**30:.0f}; "
                f"a smaller horizon or instance would define it"
            )
        choices = choices_of(mdp, restart=False)
        self.matrix, self.num_actions, self.steps = choices.matrix, mdp.num_actions, steps
        self.underlying, self.num_nodes = choices.underlying, len(choices.underlying)
        self.starts = choices.starts
        self.rewards = _expected_rewards(mdp, choices)
        self.table = _single_outcomes(self.matrix, self.num_nodes, self.num_actions)
        self.support = sparse.csr_matrix(
            (np.ones(self.matrix.nnz, np.float32), self.matrix.indices, self.matrix.indptr), shape=self.matrix.shape
        )
        shape = (steps, self.num_nodes, self.num_actions)
        self.best, self.worst, self.explored = (np.empty(shape) for _ in range(3))
        self.explored_value = np.empty(shape[:2])
        self.best[-1] = self.worst[-1] = self.explored[-1] = self.rewards
        for t in range(steps - 1, -1, -1):
            if t < steps - 1:
                self.best[t] = self.backup(self.best[t + 1].max(axis=1))
                self.worst[t] = self.backup(self.worst[t + 1].min(axis=1))
                self.explored[t] = self.backup(self.explored_value[t + 1])
            mean = _mean(self.explored[t])
            self.explored_value[t] = mean.clip(self.worst[t].min(axis=1), self.best[t].max(axis=1))
        self.optimal = self.best >= self.best.max(axis=2, keepdims=True) - TIE
        self.first = np.zeros(self.num_nodes, np.bool_)
        self.first[[node for node, _ in self.starts]] = True
        everything = np.ones((self.num_nodes, self.num_actions), np.bool_)
        visitable, reached = self.first.copy(), self.first
        inside, ended = choices.underlying < mdp.num_states, False
        for _ in range(steps - 1):
            ended |= bool((reached & ~inside).any())
            reached = self.following(reached, everything)
            visitable |= reached
        if mdp.is_sticky:  # as BRIDGE counts
            pairs = {
                (int(s), 0) for s in choices.underlying[self.first]
            }  # a start stands for itself with the first action
            met = visitable & (inside | (not ended)) & (choices.previous < mdp.num_actions)
            pairs |= set(zip(choices.underlying[met].tolist(), choices.previous[met].tolist(), strict=True))
            self.num_visitable = len(pairs) + ended * mdp.num_actions  # an end leads to itself, by every action
        else:
            self.num_visitable = int((visitable & inside).sum())

    def backup(self, value: np.ndarray) -> np.ndarray:
        """(N, A): r + E value(next)."""
        if self.table is not None:
            return self.rewards + value[self.table]
        return self.rewards + (self.matrix @ value).reshape(self.num_nodes, self.num_actions)

    def following(self, met: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """(N,) bool: nodes that some of these actions (N, A) lead to from the nodes that are met."""
        chosen = np.flatnonzero((met[:, None] & actions).ravel())
        result = np.zeros(self.num_nodes, np.bool_)
        result[self.matrix[chosen].indices] = True
        return result

    def following_max(self, values: np.ndarray) -> np.ndarray:
        """(N, A): the largest of values (N,) >= 0 over the nodes that an action may lead to."""
        if self.table is not None:
            return values[self.table]
        largest = np.maximum.reduceat(values[self.matrix.indices], self.matrix.indptr[:-1])
        return largest.reshape(self.num_nodes, self.num_actions)

    def at_start(self, values: np.ndarray) -> float:
        """The expectation over start nodes."""
        return float(sum(p * values[node] for node, p in self.starts))

    def lookahead(self, values: np.ndarray) -> np.ndarray:
        """(T, N, A): Q^{k+1} from Q^k."""
        result = np.empty(self.best.shape)
        result[-1] = self.rewards
        for t in range(self.steps - 1):
            result[t] = self.backup(values[t + 1].max(axis=1))
        return result


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over actions, added up in their order."""
    total = values[:, 0].copy()
    for action in range(1, values.shape[1]):
        total += values[:, action]
    return total / values.shape[1]


def _single_outcomes(matrix: Any, nodes: int, num_actions: int) -> np.ndarray | None:
    """(N, A) next nodes where every choice has one outcome; else None."""
    if matrix.nnz == nodes * num_actions and (np.diff(matrix.indptr) == 1).all() and (matrix.data == 1.0).all():
        return matrix.indices.reshape(nodes, num_actions).astype(np.int64)
    return None


def _expected_rewards(mdp: TabularMDP, choices: Any) -> np.ndarray:
    """(N, A): the expected reward of choosing an action in a node."""
    chance, num_actions = mdp.chance, mdp.num_actions
    paid = np.vstack([mdp.rewards, np.zeros((1, num_actions))])
    paid[:-1][np.asarray(mdp.terminal)] = 0.0
    executed = paid[np.minimum(choices.underlying, mdp.num_states)]
    if not mdp.is_sticky and not mdp.is_random:
        return executed
    mean = _mean(executed)[:, None]
    if not mdp.is_sticky:
        return chance.chosen * executed + chance.uniform * mean
    previous = choices.previous
    first = previous == num_actions
    repeated = executed[np.arange(len(previous)), np.minimum(previous, num_actions - 1)][:, None]
    later = chance.chosen * executed + chance.previous * repeated + chance.uniform * mean
    return np.where(first[:, None], chance.first_chosen * executed + chance.first_uniform * mean, later)


def _first_greedy(tree: _Steps, values: np.ndarray, most: int) -> int:
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


def _simple_bound(tree: _Steps) -> tuple[float, list[int], list[int], list[float], list[float]]:
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
        found = _samples(tree, values, variance, math.log(2 * horizon) + k * math.log(actions))
        if found is not None:
            samples, gap, spread = found
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


def _samples(tree: _Steps, values: np.ndarray, variance: np.ndarray, log: float) -> tuple[int, float, float] | None:
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


def _greedy_return(tree: _Steps, k: int) -> float:
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
