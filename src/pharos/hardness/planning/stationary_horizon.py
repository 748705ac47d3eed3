"""The effective horizon of discounted MDPs without time: one value a state, so that millions of states are feasible.

pharos's own variant of Laidlaw, Russell and Dragan's (2023) measure; `effective_horizon` is theirs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from pharos.errors import ParameterError, PrecisionError, UndefinedMeasure
from pharos.hardness.gaps.gaps import optimal_solution, solved
from pharos.hardness.planning.effective_horizon import LookAhead, look_ahead, most_samples
from pharos.hardness.planning.steps import expected_rewards, single_outcomes
from pharos.mdp import ExpandedMDP, TabularMDP, require_mdp
from pharos.solvers import Solution, uniform_value, value_iteration, worst_value


@dataclass(frozen=True)
class StationaryHorizon(LookAhead):
    """How far ahead one must look in a discounted MDP.

    Attributes:
        value, k_min, effective_planning_window, ks, ms, gaps, vars: see LookAhead; k_min is `steps` where no k will do.
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
    the time limit, only counts the decisions. Where an MDP ends by itself within T steps, each state at one depth, both
    are the same for gamma = 1.

    Args:
        solution: the optimal solution of `mdp`; None: solved here.
        steps: T; None: the MDP's horizon, else ceil(1 / (1 - gamma)).
        tie_tolerance: an action is optimal if its value is within it of the best; None: 2.5 times the largest error of
            the values, at least 1e-9.
        tolerance: largest error of the values; a larger one is used where floats cannot reach it.
        progress: called with a line on how far it is.
    Raises:
        UndefinedMeasure: gamma is 1.
        ParameterError: an option is wrong, or `solution` is not of this MDP. PrecisionError: tie_tolerance is not above
            twice the error.
    Exactness: Q^k is known up to an error; what differs by less than `slack`, four times that, counts as equal, which
        makes k fail rather than pass.
    Cost: three solutions, then a backup and a walk over the states met for each k. breakout/12x8x1 (2.4 million states)
        takes about ten seconds.
    Source: pharos; after Laidlaw, Russell and Dragan (2023), theorem 5.4.
    """
    if mdp.gamma == 1.0:
        raise UndefinedMeasure(
            "stationary_effective_horizon is defined for gamma < 1; see effective_horizon for episodes"
        )
    limit = steps if steps is not None else mdp.horizon or math.ceil(1 / (1 - mdp.gamma))
    if isinstance(limit, bool) or not isinstance(limit, int | np.integer) or limit < 1:
        raise ParameterError(f"steps is {limit!r}; expected a whole number of steps, at least 1")
    endless = mdp if mdp.horizon is None else mdp.with_horizon(None)
    tell = progress or (lambda line: None)
    nodes = _Nodes(endless, solution, tolerance, tell)
    floor = 2 * nodes.error
    tie = max(1e-9, 1.25 * floor) if tie_tolerance is None else float(tie_tolerance)
    if not tie > floor:
        raise PrecisionError(
            f"tie_tolerance is {tie_tolerance!r}; expected more than twice the error of the values, {floor:.3g}: raise "
            "it, or solve with a smaller tolerance"
        )
    slack = max(1e-12, 2 * floor)
    nodes.compare(tie, slack)
    ahead, _ = look_ahead(nodes, int(limit), mdp.num_actions, tell=tell)
    conventions = {
        "gamma": mdp.gamma,
        "steps": int(limit),
        "exploration": "uniform",
        "tie_tolerance": tie,
        "slack": slack,
        "states": mdp.nodes,
    }
    return StationaryHorizon(**vars(ahead), conventions=conventions)


class _StoredQ:
    """Action values that are kept as a table (N, A)."""

    def __init__(self, table: np.ndarray):
        self.table = table

    @cached_property
    def best(self) -> np.ndarray:
        """(N,): max over a."""
        return self.table.max(axis=1)

    def at(self, nodes: np.ndarray) -> np.ndarray:
        """(n, A), of some nodes."""
        return self.table[nodes]


class _LookaheadQ:
    """Action values r + gamma value(next), where each action leads to one node: computed where they are asked for."""

    def __init__(self, nodes: "_Nodes", value: np.ndarray):
        self.nodes, self.value = nodes, value

    @cached_property
    def best(self) -> np.ndarray:
        """(N,): max over a."""
        from pharos.kernels import horizon

        result = np.empty(self.nodes.num_nodes)
        horizon.lookahead(self.nodes.table, self.nodes.rewards, self.nodes.gamma, self.value, result)
        return result

    def at(self, nodes: np.ndarray) -> np.ndarray:
        """(n, A), of some nodes."""
        assert self.nodes.table is not None
        return self.nodes.rewards[nodes] + self.nodes.gamma * self.value[self.nodes.table[nodes]]


class _Nodes:
    """`Play` without time, on nodes that can be met: states, or pairs with the previous action.

    Attributes:
        rewards, best, worst, explored: (N, A) of choosing an action. error: the largest error of any of them.
        table: (N, A), the only node that an action leads to, where that is so everywhere; else None, and matrix (N A,
            N) says.
    """

    def __init__(self, mdp: TabularMDP, solution: Solution | None, tolerance: float, tell: Callable[[str], None]):
        self.gamma, self.num_actions = mdp.gamma, mdp.num_actions
        self.table: np.ndarray | None
        if mdp.is_deterministic:
            choices, self.table = _states_and_the_end(mdp)
        else:
            choices = ExpandedMDP.of(mdp, restart=False).reachable()
            self.table = single_outcomes(choices.matrix, len(choices.underlying), mdp.num_actions)
        self.num_nodes = len(choices.underlying)
        self.matrix = choices.matrix
        self.starts = np.array(sorted(node for node, _ in choices.starts))
        self.rewards = expected_rewards(mdp, choices)
        tell("values of optimal play")
        best = optimal_solution(mdp, solution) if solution is not None else solved(value_iteration, mdp, tolerance)
        tell("values of the worst play")
        worst = solved(worst_value, mdp, tolerance)
        tell("values of uniform play")
        explored = solved(uniform_value, mdp, tolerance)
        self.error = mdp.gamma * max(best.error_bound, worst.error_bound, explored.error_bound)
        everywhere = np.arange(self.num_nodes)
        self.best, self.worst, self.explored = (
            self.backup(_on_nodes(each, choices, mdp)).at(everywhere) for each in (best, worst, explored)
        )

    def compare(self, tie: float, slack: float) -> None:
        """Begin with Q^1 of uniform play; what is within `tie` of the best is optimal, within `slack` equal."""
        self.slack, self.optimal = slack, self.best >= self.best.max(axis=1, keepdims=True) - tie
        self.values: _StoredQ | _LookaheadQ = _StoredQ(self.explored)
        self.spread = ((self.explored - self.worst) * (self.best - self.worst)).max(axis=1)

    def samples(self, log: float) -> tuple[int, float, float] | None:
        def second(n: np.ndarray, q: np.ndarray) -> np.ndarray:
            return np.asarray(np.where(self.optimal[n], -math.inf, q).max(axis=1))

        def better(n: np.ndarray) -> np.ndarray | None:
            q = self.values.at(n)
            others = second(n, q)
            if (q.max(axis=1) - others <= self.slack).any():
                return None
            return self.optimal[n] & (q > others[:, None] - self.slack)

        nodes = self.closure(better)
        if nodes is None:
            return None
        q = self.values.at(nodes)
        return most_samples(q.max(axis=1) - second(nodes, q), self.spread[nodes], log)

    def is_greedy_optimal(self) -> bool:
        def greedy(n: np.ndarray) -> np.ndarray | None:
            q = self.values.at(n)
            is_greedy = q >= q.max(axis=1, keepdims=True) - self.slack
            return None if (is_greedy & ~self.optimal[n]).any() else is_greedy

        return self.closure(greedy) is not None

    def advance(self, spread: bool = True) -> None:
        self.values = self.backup(self.values.best)
        if spread:
            self.spread = self.gamma**2 * self.following_max(self.spread)

    def look_at_rewards(self) -> None:
        self.values = _StoredQ(self.rewards)

    def backup(self, value: np.ndarray) -> _StoredQ | _LookaheadQ:
        """r + gamma E value(next)."""
        if self.table is not None:
            return _LookaheadQ(self, value)
        return _StoredQ(self.rewards + self.gamma * (self.matrix @ value).reshape(self.num_nodes, self.num_actions))

    def following_max(self, values: np.ndarray) -> np.ndarray:
        """(N,): the largest of values (N,) >= 0 over the nodes that some action may lead to."""
        if self.table is not None:
            from pharos.kernels import horizon

            result = np.empty(self.num_nodes)
            horizon.largest(self.table, values, result)
            return result
        each = np.maximum.reduceat(values[self.matrix.indices], self.matrix.indptr[:-1])
        return each.reshape(self.rewards.shape).max(axis=1)

    def closure(self, actions: Callable[[np.ndarray], np.ndarray | None]) -> np.ndarray | None:
        """The nodes that can be met from the start by some actions; None where `actions` answers None.

        actions: from nodes (n,) to (n, A) bool, the actions that are taken there.
        """
        is_reached = np.zeros(self.num_nodes, np.bool_)
        is_reached[self.starts] = True
        nodes = self.starts
        while nodes.size:
            allowed = actions(nodes)
            if allowed is None:
                return None
            rows, chosen = np.nonzero(allowed)
            if self.table is not None:
                following = self.table[nodes[rows], chosen]
            else:
                following = self.matrix[nodes[rows] * self.num_actions + chosen].indices
            nodes = np.unique(following[~is_reached[following]])
            is_reached[nodes] = True
        return np.flatnonzero(is_reached)


def _states_and_the_end(mdp: TabularMDP) -> tuple[ExpandedMDP, np.ndarray]:
    """The states without chance, then the implicit end; and where each action leads.

    What has ended stays where it is.
    """
    next_states: Any = mdp.dynamics.deterministic_table()
    size = mdp.num_states
    table = np.full((size + 1, mdp.num_actions), size, next_states.dtype)
    table[:size] = next_states
    table[table < 0] = size
    terminal = np.flatnonzero(mdp.terminal)
    table[terminal] = terminal[:, None]
    starts = [(int(s), float(p)) for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True) if p > 0]
    none = np.zeros(size + 1, np.bool_)
    return ExpandedMDP(None, np.arange(size + 1), np.full(size + 1, -1), starts, mdp.num_actions, size + 1, none), table


def _on_nodes(solution: Solution, choices: Any, mdp: TabularMDP) -> np.ndarray:
    """(N,): V of the nodes; 0 at the end. Of starts without a previous action any number, as nothing leads there."""
    inside = choices.underlying < mdp.num_states
    v = solution.v
    if v.ndim == 2:
        result = v[np.where(inside, choices.underlying, 0), np.clip(choices.previous, 0, mdp.num_actions - 1)]
    else:
        result = v[np.where(inside, choices.underlying, 0)]
    return np.where(inside, result, 0.0)
