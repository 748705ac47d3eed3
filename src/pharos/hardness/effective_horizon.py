"""The effective horizon, the depth of lookahead that planning needs. Source: Laidlaw, Russell and Dragan (2023; chance:
2024).

Undiscounted episodes of T steps, time-indexed. All quantities live on the nodes that can be reached: states, or under
sticky actions pairs (state, previously executed action) and the starts without one.

For deterministic MDPs of millions of states (`LargeHorizon`) the same numbers, compiled.

Q^k_t(s, a) = r(s, a) + W^{k-1}_{t+1}(next state) with W^0 = V of uniform play and W^k_t(s) = max_a Q^k_t(s, a): one
number a state and step is kept instead of one for each action, and each k overwrites the one before, as step t needs
only step t + 1 of it.

`LookAhead` holds the parts of both effective horizons: Laidlaw, Russell and Dragan (2023), theorem 5.4.

The effective horizon of discounted MDPs without time: one value a state, so that millions of states are feasible;
pharos's own variant of Laidlaw, Russell and Dragan's (2023) measure; `effective_horizon` is theirs.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from typing import Any, Protocol

import numpy as np

from pharos.errors import PrecisionError, UndefinedMeasure
from pharos.hardness.gaps import optimal_solution, solution_within
from pharos.hardness.gorp import gorp_bound
from pharos.hardness.interval import fields_of
from pharos.hardness.steps import OPTIMAL_TIE, FiniteHorizonValues, check_returns, steps_of
from pharos.mdp import (
    STEPS_EXPECTED,
    ExpandedMDP,
    TabularMDP,
    mdp_within,
    most_actions,
    require_mdp,
    states_within,
    whole_number,
)
from pharos.solvers import Solution, uniform_value, value_iteration, worst_value
from pharos.system import memory


@dataclass(frozen=True)
class LookAhead:
    """Effective horizon with its parts: the depth of lookahead, and the samples that each depth takes.

    Attributes:
        value: min over k of k + log_A m_k, at most the number of steps.
        k_min: smallest k for which acting greedily in Q^k is optimal, Q^1 being the value of uniform play.
        effective_planning_window: the same from Q^1 = r: the number of rewards ahead that planning needs.
        ks, ms, gaps, vars: for each k that was tried and does not fail: k, the samples m_k, and gap and variance bound
            of the node at which m_k is attained.
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
        return fields_of(self, "conventions")

    def __str__(self) -> str:
        return f"{self.value:.6g} (k_min {self.k_min}, window {self.effective_planning_window})"


LARGEST_WRITTEN_TABLE = 2**26  # bytes of the table of all steps from which on it is not written out
GREEDY_RETURNS = 5
WRITTEN_OUT = 2**18  # action values, of nodes that each lead to one; of more a compiled kernel is worth loading


@dataclass(frozen=True)
class EffectiveHorizon(LookAhead):
    """Effective horizon of an MDP in episodes of T steps.

    Attributes:
        value, k_min, effective_planning_window, ks, ms, gaps, vars: see LookAhead; `value` is the effective horizon by
            the simple bound.
        tight: a tighter bound by GORP's failure probability, if it was asked for; else None.
        greedy_returns: J_k for k = 1, ..., 5: return of the policy greedy in Q^k, ties broken adversarially.
        optimal_return, random_return, worst_return: from the start.
        num_states: number of states that can be met at some step; under sticky actions, as BRIDGE counts, of pairs
            (state, previously executed action), the implicit end with every action among them, and a start with the
            first action.
        conventions: horizon, exploration, chance, tie tolerance.
    """

    tight: float | None = field(default=None, kw_only=True)
    greedy_returns: list[float]
    optimal_return: float
    random_return: float
    worst_return: float
    num_states: int
    conventions: dict[str, Any] = field(default_factory=dict)


@require_mdp
def effective_horizon(
    mdp: TabularMDP,
    *,
    horizon: int | None = None,
    tight: int = 0,
    progress: Callable[[str], object] | None = None,
) -> EffectiveHorizon:
    """Return the effective horizon of an MDP, and what it is made of.

        Q^1 = Q of the uniform policy,  Q^{k+1}_t(s, a) = r(s, a) + E max_b Q^k_{t+1}(s', b),  Q^k_T = r
        var^1 = (Q^e - Q^w)(Q* - Q^w),  var^{k+1}_t(s, a) = max over s', b of var^k_{t+1}(s', b)
        m_k = max over states met of max(1, ceil(16 max_a var^k / gap_k^2 ln(2 T A^k))),  H = min_k k + log_A m_k

    gap_k is the difference between the largest Q^k and the largest Q^k of an action that is not optimal; states met are
    the states that actions better than all of the latter lead to. k fails if that difference is exactly 0. If
    some actions are not available, the uniform policy takes the available ones, and A is the largest number of them in
    a state.

    Args:
        horizon: T; None: the MDP's.
        tight: the largest k for which the tight bound of `gorp_bound` is computed as well; 0: none.
        progress: called with a line now and then; an exception of its own ends the computation.
    Raises:
        UndefinedMeasure: there is no horizon, or the table of all steps does not fit into memory: 8 GiB under chance,
            else 60 % of the machine's memory. PrecisionError: returns may pass 1e150.
    Cost: a pass over T x nodes x A for every k that is tried, of the nodes that can be met within T steps. Memory 40
        bytes for each of them under chance; 17 bytes for each of T x S without.
    Source: Laidlaw, Russell and Dragan (2023), "Bridging RL theory and practice with the effective horizon", theorem
        5.4 and appendix C; sticky actions: Laidlaw et al. (2024).
    """
    steps = steps_of("effective_horizon", mdp, horizon)
    check_returns("effective_horizon", mdp, steps)
    mdp = mdp_within(mdp, steps)
    compiled = applies(mdp) and 40 * steps * mdp.num_states * mdp.num_actions > LARGEST_WRITTEN_TABLE
    report = progress or str
    parts = horizon_fields(
        LargeHorizon(mdp, steps, OPTIMAL_TIE, report) if compiled else NodeHorizon.of_steps(mdp, steps, report)
    )
    bound = gorp_bound(mdp, horizon=steps, max_k=tight, progress=progress).value if tight else None
    conventions = {
        "horizon": steps,
        "gamma": 1.0,
        "exploration": "uniform",
        "tie_tolerance": OPTIMAL_TIE,
        "states": mdp.nodes,
    }
    return EffectiveHorizon(**parts, tight=bound, conventions=conventions)


def horizon_fields(values: "NodeHorizon | LargeHorizon") -> dict[str, Any]:
    """Fields of an `EffectiveHorizon`, but for `tight` and `conventions`."""
    assert values.steps is not None
    ahead, greedy = look_ahead(values, values.steps, values.most_actions, values.greedy_return, values.report)
    returns = dict(zip(("optimal_return", "random_return", "worst_return"), values.returns, strict=True))
    return {**vars(ahead), **returns, "greedy_returns": greedy, "num_states": values.num_visitable}


class LookaheadValues(Protocol):
    """Q^k for one k after the other, k = 1 at first, with the questions of both effective horizons."""

    def samples(self, log: float) -> tuple[int, float, float] | None:
        """(m_k, gap, variance of the node that attains it), log = ln(2 T A^k); None if k fails."""

    def is_greedy_optimal(self) -> bool:
        """Whether all actions greedy in Q^k, from the start on, are optimal."""

    def advance(self, spread: bool = True) -> None:
        """Go from k to k + 1; spread: of the variances, too."""

    def restart_from_rewards(self) -> None:
        """Begin again with Q^1 = r."""


def look_ahead(
    values: LookaheadValues,
    steps: int,
    num_actions: int,
    greedy_return: Callable[[], float] | None = None,
    report: Callable[[str], object] = str,
) -> tuple[LookAhead, list[float]]:
    """(LookAhead of episodes of `steps` steps, `greedy_return` for k = 1, ..., 5, if it is given)."""
    best, log_actions = float(steps), math.log(num_actions)
    rows: list[tuple[int, int, float, float]] = []
    greedy: list[float] = []
    last = 0 if greedy_return is None else GREEDY_RETURNS
    k_min, k = 0, 1
    # Q^1 of uniform play, Q^2, ...: the smallest k + log_A m_k, and the smallest k that acts optimally.
    while k < best or k <= last or not k_min:
        report(f"k = {k}, bound {best:.4g}")
        if k < best and (needed := values.samples(math.log(2 * steps) + k * log_actions)) is not None:
            rows.append((k, *needed))
            best = min(best, k + (math.log(needed[0]) / log_actions if num_actions > 1 else 0.0))
        if not k_min and (k >= steps or values.is_greedy_optimal()):
            k_min = k
        if greedy_return is not None and k <= last:
            greedy.append(greedy_return())
        values.advance()
        k += 1
    # The same from Q^1 = r.
    values.restart_from_rewards()
    window = 1
    while window < steps and not values.is_greedy_optimal():
        report(f"window {window}")
        values.advance(spread=False)
        window += 1
    ks, ms, gaps, variances = (list(each) for each in zip(*rows, strict=True)) if rows else ([], [], [], [])
    return LookAhead(best, k_min, window, ks, ms, gaps, variances), greedy


class NodeHorizon:
    """Lookahead values on nodes, states or pairs with the previous action: of each of T steps, or the same at all.

    Attributes:
        choices: the MDP written out. rewards: (N, A) of choosing an action.
        values: Q^k of each step. spread: (N,) max over a of var^k, of each step. optimal: (N, A) bool, of each step.
        slack: values within it are equal.
        returns, num_visitable: of episodes of T steps, see `EffectiveHorizon`.
    """

    values: list["_ActionValues"]
    returns: tuple[float, ...]
    num_visitable: int
    most_actions: int

    def __init__(self, choices: ExpandedMDP, rewards: np.ndarray, gamma: float = 1.0, steps: int | None = None):
        self.choices, self.rewards, self.gamma, self.steps = choices, rewards, gamma, steps
        self.num_nodes, self.starts = len(rewards), np.array(sorted(node for node, _ in choices.starts))
        self.is_large = choices.table is not None and choices.table.size > WRITTEN_OUT
        self.report: Callable[[str], object] = str

    @staticmethod
    def of_steps(mdp: TabularMDP, steps: int, report: Callable[[str], object] = str) -> "NodeHorizon":
        """Values of T steps, all of which are written out."""
        tree = FiniteHorizonValues(mdp, steps, report)
        nodes = NodeHorizon(tree.choices, tree.rewards, steps=steps)
        nodes.report, nodes.most_actions, nodes.num_visitable = report, tree.most_actions, tree.num_visitable
        values = (tree.best.max(axis=2)[0], tree.explored_value[0], tree.worst.min(axis=2)[0])
        nodes.returns = tuple(map(tree.at_start, values))
        nodes.values = [_ActionValues(nodes, value) for value in nodes._after(tree.explored_value)]
        nodes.compare(zip(tree.best, tree.worst, tree.explored, strict=True), OPTIMAL_TIE)
        return nodes

    def compare(self, values: Iterable[Sequence[np.ndarray]], tie: float, slack: float = 0.0) -> None:
        """Begin with var^1; actions within `tie` of the best are optimal.

        values: action values (N, A) of the best, worst and uniform play at each step.
        """
        self.slack, self.optimal, self.spread = slack, [], []
        for b, w, e in values:
            self.optimal.append(b >= b.max(axis=1, keepdims=True) - tie)
            self.spread.append(((e - w) * (b - w)).max(axis=1))

    def _after(self, rows: Iterable[np.ndarray]) -> list[np.ndarray]:
        """Rows (N,) that come after each step, from the rows of each step: zeros after the last of T steps."""
        return list(rows) if self.steps is None else [*rows, np.zeros(self.num_nodes)][1:]

    def samples(self, log: float) -> tuple[int, float, float] | None:
        gaps = np.empty((len(self.values), self.num_nodes))

        def better(t: int, nodes: np.ndarray) -> np.ndarray | None:
            q, optimal = self.values[t].at(nodes), self.optimal[t][nodes]
            second = np.where(optimal, -math.inf, q).max(axis=1)
            gaps[t, nodes] = gap = q.max(axis=1) - second
            return None if (gap <= self.slack).any() else optimal & (q > second[:, None] - self.slack)

        layers = self.met(better)
        if layers is None:
            return None
        each = (most_samples(gaps[t, nodes], self.spread[t][nodes], log) for t, nodes in enumerate(layers))
        return max(each, key=itemgetter(0))

    def is_greedy_optimal(self) -> bool:
        def greedy(t: int, nodes: np.ndarray) -> np.ndarray | None:
            q = self.values[t].at(nodes)
            is_greedy = q >= q.max(axis=1, keepdims=True) - self.slack
            return None if (is_greedy & ~self.optimal[t][nodes]).any() else is_greedy

        return self.met(greedy) is not None

    def met(self, actions: Callable[[int, np.ndarray], np.ndarray | None]) -> list[np.ndarray] | None:
        """The nodes that are met at each of T steps by some actions, or at any step; None if `actions` is None.

        actions: from a step and nodes (n,) to (n, A) bool, the actions that are chosen there.
        """
        layers: list[np.ndarray] = []
        is_met, nodes = np.zeros(self.num_nodes, np.bool_), self.starts
        while nodes.size and len(layers) != self.steps:
            allowed = actions(0 if self.steps is None else len(layers), nodes)
            if allowed is None:
                return None
            layers.append(nodes)
            is_next = np.zeros(self.num_nodes, np.bool_)
            is_next[self.choices.successors(nodes, allowed)] = True
            if self.steps is None:
                is_met[nodes] = True
                is_next &= ~is_met
            nodes = np.flatnonzero(is_next)
        return [np.flatnonzero(is_met)] if self.steps is None else layers

    def advance(self, spread: bool = True) -> None:
        best = []
        for t, values in enumerate(self.values):
            self.report(f"lookahead of step {t} of {self.steps}")
            best.append(values.best)
        self.values = [_ActionValues(self, value) for value in self._after(best)]
        if spread:
            self.spread = self._after([self.gamma**2 * self._largest_after(each) for each in self.spread])

    def _largest_after(self, values: np.ndarray) -> np.ndarray:
        """(N,): the largest of values (N,) over the nodes that some action may lead to, at least 0 if it is sure to."""
        if not self.is_large:
            largest = np.asarray(self.choices.largest(values).max(axis=1))
            return largest if self.choices.table is None else np.maximum(largest, 0.0)
        from pharos.kernels import horizon

        result = np.empty(self.num_nodes)
        horizon.largest_after(self.choices.table, values, result)
        return result

    def restart_from_rewards(self) -> None:
        self.values = [_ActionValues(self, np.zeros(self.num_nodes))] * len(self.values)

    def greedy_return(self) -> float:
        """J_k: the return of the policy greedy in Q^k, its ties broken as badly as possible."""
        value, everywhere = np.zeros(self.num_nodes), np.s_[:]
        for values in reversed(self.values):
            q = values.at(everywhere)
            returns = _ActionValues(self, value).at(everywhere)
            value = np.where(q == q.max(axis=1, keepdims=True), returns, math.inf).min(axis=1)
        return float(sum(p * value[node] for node, p in self.choices.starts))


class _ActionValues:
    """Action values r + gamma E value(next) of nodes; on demand if there are many and each leads to one node."""

    def __init__(self, nodes: NodeHorizon, value: np.ndarray):
        self.nodes, self.value = nodes, value
        self.table: np.ndarray | None = None
        if not nodes.is_large:
            self.table = nodes.choices.expected(value)
            self.table *= nodes.gamma
            self.table += nodes.rewards

    def at(self, index: np.ndarray | slice) -> np.ndarray:
        """(n, A): the action values of some nodes."""
        if self.table is not None:
            return self.table[index]
        nodes = self.nodes
        assert nodes.choices.table is not None
        return nodes.rewards[index] + nodes.gamma * self.value[nodes.choices.table[index]]

    @cached_property
    def best(self) -> np.ndarray:
        """(N,): the largest action value of each node."""
        if self.table is not None:
            return np.asarray(self.table.max(axis=1))
        from pharos.kernels import horizon

        result, nodes = np.empty(len(self.value)), self.nodes
        horizon.lookahead(nodes.choices.table, nodes.rewards, nodes.gamma, self.value, result)
        return result


def most_samples(gap: np.ndarray, variance: np.ndarray, log: float) -> tuple[int, float, float]:
    """(max(1, ceil(16 variance / gap^2 log)), gap, variance) of the node that needs most, the first among equals."""
    with np.errstate(invalid="ignore"):
        needed = np.where(np.isinf(gap), 0.0, 16 * variance / gap**2 * log)
    i = int(needed.argmax())
    return max(1, math.ceil(needed[i])), float(gap[i]), float(variance[i])


# Large horizon --------------------------------------------------------------------------------------------------------


_MEMORY_SHARE = 0.6  # of the memory that is free


def applies(mdp: TabularMDP) -> bool:
    """Whether the MDP has one next state for each state and action."""
    return mdp.is_deterministic and mdp.num_actions <= 64 and mdp.available is None


class LargeHorizon:
    """Lookahead values of deterministic MDPs of millions of states: values of states at every step.

    Attributes:
        ahead: (T + 1, S) W^{k-1}, for the present k; row T is 0.
        spread: (T, S) max over a of var^k.
        optimal: (T, S) bit a is set if a is optimal.
    """

    def __init__(self, mdp: TabularMDP, steps: int, tie: float, report: Callable[[str], object] = str):
        from pharos.kernels import horizon as kernels

        self.kernels, self.steps, self.most_actions, self.report = kernels, steps, mdp.num_actions, report
        states = mdp.num_states
        bits = next(
            kind for kind in (np.uint8, np.uint16, np.uint32, np.uint64) if mdp.num_actions <= 8 * kind(0).itemsize
        )
        needed = (16 + bits(0).itemsize) * steps * states
        if needed > (room := _MEMORY_SHARE * memory.available_memory()):
            raise UndefinedMeasure(
                f"effective_horizon: {steps} steps of the {states} states that they can meet need "
                f"{needed / 2**30:.1f} GiB, more than {room / 2**30:.1f}, "
                f"{_MEMORY_SHARE:.0%} of the free memory; a smaller horizon or instance would define it"
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
            report(f"values of step {t} of {steps}")
            kernels.step_values(
                *(self.next_states, self.rewards, tie, best[after], worst[after], self.ahead[t + 1]),
                *(best[now], worst[now], self.ahead[t], self.optimal[t], self.spread[t]),
            )
        self.returns = tuple(self._at_start(values) for values in (best[0], self.ahead[0], worst[0]))
        small = np.int32 if states < 2**31 else np.int64
        self.nodes = (np.empty(states, small), np.empty(states, small))
        self.is_visited = np.zeros(states, np.bool_)
        self.num_visitable = int(states_within(mdp, steps - 1).sum())

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

    def _walk(self, log: float, near: bool) -> Iterator[tuple[float | None, float, float]]:
        n, most = self._begin(), np.zeros(3)
        now, after = self.nodes
        for t in range(self.steps):
            self.report(f"states met at step {t} of {self.steps}")
            n = self.kernels.step_along(
                *(self.next_states, self.rewards, self.ahead[t + 1], self.optimal[t], self.spread[t], log, near),
                *(now, n, after, self.is_visited, most),
            )
            if n < 0:
                yield None, 0.0, 0.0
                return
            yield float(most[0]), float(most[1]), float(most[2])
            now, after = after, now
            if not n:
                return

    def advance(self, spread: bool = True) -> None:
        nothing = np.zeros(len(self.next_states))
        for t in range(self.steps):
            self.report(f"lookahead of step {t} of {self.steps}")
            self.kernels.lookahead(self.next_states, self.rewards, 1.0, self.ahead[t + 1], self.ahead[t])
            if spread:
                after = self.spread[t + 1] if t + 1 < self.steps else nothing
                self.kernels.largest_after(self.next_states, after, self.spread[t])

    def restart_from_rewards(self) -> None:
        self.ahead[:] = 0.0

    def greedy_return(self) -> float:
        """J_k: the return of the policy greedy in Q^k, its ties broken as badly as possible."""
        value, now = np.zeros(len(self.next_states)), np.empty(len(self.next_states))
        for t in range(self.steps - 1, -1, -1):
            self.kernels.greedy_return(self.next_states, self.rewards, self.ahead[t + 1], value, now)
            value, now = now, value
        return self._at_start(value)


# Discounted MDPs ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StationaryHorizon(LookAhead):
    """Effective horizon of a discounted MDP, of values that do not depend on the step.

    Attributes:
        value, k_min, effective_planning_window, ks, ms, gaps, vars: see LookAhead; k_min is `steps` if no k will do.
        conventions: gamma, steps, tie tolerance, slack of comparisons.
    """

    conventions: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; infinite gaps are None."""
        return {**super().to_dict(), **self.conventions}


@require_mdp
def stationary_effective_horizon(
    mdp: TabularMDP,
    solution: Solution | None = None,
    *,
    steps: int | None = None,
    tie_tolerance: float | None = None,
    tolerance: float = 1e-9,
    progress: Callable[[str], None] | None = None,
) -> StationaryHorizon:
    """Return the stationary effective horizon of a discounted MDP, under every kind of chance.

        Q^1 = Q of the uniform policy,  Q^{k+1}(s, a) = r(s, a) + gamma E max_b Q^k(s', b)
        var^1 = (Q^e - Q^w)(Q* - Q^w),  var^{k+1}(s, a) = gamma^2 max over s', b of var^k(s', b)
        m_k = max over states met of max(1, ceil(16 max_a var^k / gap_k^2 ln(2 T A^k))),  H = min_k k + log_A m_k

    As `effective_horizon`, but for values that do not depend on the step: in place of T steps there are states, and T,
    the time limit, only counts the decisions. If an MDP ends by itself within T steps, each state at one depth, both
    are the same for gamma = 1.

    Args:
        solution: the optimal solution of `mdp`; None: solved here.
        steps: T; None: the MDP's horizon, else ceil(1 / (1 - gamma)).
        tie_tolerance: an action is optimal if its value is within it of the best; None: 2.5 times the largest error of
            the values, at least 1e-9.
        tolerance: largest error of the values; a larger one is used if floats cannot reach it.
        progress: called with a line on the progress.
    Raises:
        UndefinedMeasure: gamma is 1.
        ParameterError: an option is wrong, or `solution` is not of this MDP. PrecisionError: tie_tolerance is not above
            twice the error.
    Exactness: Q^k is known up to an error; values that differ by less than `slack`, four times that, count as equal,
        which makes k fail rather than pass.
    Cost: three solutions, then a backup and a walk over the states met for each k. breakout/12x8x1 (2.4 million states)
        takes about ten seconds.
    Source: pharos; after Laidlaw, Russell and Dragan (2023), theorem 5.4.
    """
    if mdp.gamma == 1.0:
        raise UndefinedMeasure(
            "stationary_effective_horizon is defined for gamma < 1; see effective_horizon for episodes"
        )
    limit = (
        mdp.horizon or math.ceil(1 / (1 - mdp.gamma)) if steps is None else whole_number(steps, "steps", STEPS_EXPECTED)
    )
    endless = mdp if mdp.horizon is None else mdp.with_horizon(None)
    report = progress or str
    nodes, values, error = _nodes_of(endless, solution, tolerance, report)
    floor = 2 * error
    tie = max(1e-9, 1.25 * floor) if tie_tolerance is None else float(tie_tolerance)
    if not tie > floor:
        raise PrecisionError(
            f"tie_tolerance is {tie_tolerance!r}; expected more than twice the error of the values, {floor:.3g}: raise "
            "it, or solve with a smaller tolerance"
        )
    slack = max(1e-12, 2 * floor)
    nodes.compare([values], tie, slack)
    ahead, _ = look_ahead(nodes, limit, most_actions(mdp), report=report)
    conventions = {
        "gamma": mdp.gamma,
        "steps": limit,
        "exploration": "uniform",
        "tie_tolerance": tie,
        "slack": slack,
        "states": mdp.nodes,
    }
    return StationaryHorizon(**vars(ahead), conventions=conventions)


def _nodes_of(
    mdp: TabularMDP, solution: Solution | None, tolerance: float, report: Callable[[str], object]
) -> tuple[NodeHorizon, list[np.ndarray], float]:
    """(Lookahead values without time, action values (N, A) of the best, worst and uniform play, their error)."""
    choices = _states_and_the_end(mdp) if mdp.is_deterministic else ExpandedMDP.of(mdp, restart=False).reachable()
    nodes = NodeHorizon(choices, choices.rewards(mdp), mdp.gamma)

    def solution_of(solve: Callable[..., Solution], play: str) -> Solution:
        report(f"values of {play} play")
        return solution_within(
            solve, mdp, tolerance, progress=lambda sweeps, _: report(f"sweep {sweeps} of the values of {play} play")
        )

    best = solution_of(value_iteration, "optimal") if solution is None else optimal_solution(mdp, solution)
    solutions = best, solution_of(worst_value, "the worst"), solution_of(uniform_value, "uniform")
    values = [_ActionValues(nodes, _on_nodes(each, choices, mdp)) for each in solutions]
    nodes.values = values[2:]
    error = mdp.gamma * max(each.error_bound for each in solutions) + mdp.reward_table.rounding
    return nodes, [each.at(np.s_[:]) for each in values], error


def _states_and_the_end(mdp: TabularMDP) -> ExpandedMDP:
    """A deterministic MDP written out: its states and the implicit end, with the table of next nodes.

    Terminal states and the end lead to themselves.
    """
    next_states = mdp.dynamics.deterministic_table()
    assert next_states is not None
    size = mdp.num_states
    table = np.full((size + 1, mdp.num_actions), size, next_states.dtype)
    table[:size] = next_states
    table[table < 0] = size
    terminal = np.flatnonzero(mdp.terminal)
    table[terminal] = terminal[:, None]
    starts = [(int(s), float(p)) for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True) if p > 0]
    none = np.zeros(size + 1, np.bool_)
    choices = ExpandedMDP(None, np.arange(size + 1), np.full(size + 1, -1), starts, mdp.num_actions, size + 1, none)
    choices.table = table
    return choices


def _on_nodes(solution: Solution, choices: ExpandedMDP, mdp: TabularMDP) -> np.ndarray:
    """(N,): V of the nodes; 0 at the end. Of starts without a previous action any number, as nothing leads there."""
    return solution.x[np.minimum(choices.underlying, mdp.num_states), np.clip(choices.previous, 0, mdp.width - 1)]
