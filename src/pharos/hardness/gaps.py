"""Suboptimality gaps: how much worse an action is than the best one. Source: Simchowitz and Jamieson (2019)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pharos.errors import ParameterError, PrecisionError
from pharos.mdp import TabularMDP
from pharos.solvers import Solution, value_iteration

REGULARIZER = 0.1  # of Colosseum
_BLOCK = 1 << 18  # states at once; fixed, so that sums do not depend on the machine
_MEMORY = 8 * 2**30  # bytes for the values of every step, with a horizon


@dataclass(frozen=True)
class Gaps:
    """The suboptimality gaps gap(s, a) = V*(s) - Q*(s, a) of an MDP, summed up.

    Attributes:
        sum_of_reciprocals: sum of 1 / gap over the states that can be reached and are not terminal, and the actions with
            gap > tie_tolerance. Unit: 1 / return.
        lower, upper: the true sum lies between them, given that the actions counted as ties are ties: each gap is known up to
            twice the error bound of the solution.
        regularized: sum of 1 / (gap + 0.1) over all states and actions, optimal ones and terminal states included, as
            Colosseum prints it.
        minimal: the smallest gap > tie_tolerance; infinite where there is none.
        count, ties: how many gaps exceed tie_tolerance, and how many do not.
        histogram, edges: (B,) numbers of gaps in bins of a quarter of a decade, and their (B + 1,) edges.
        tie_tolerance: gaps up to it count as ties.
        conventions: what the values refer to.
    """

    sum_of_reciprocals: float
    lower: float
    upper: float
    regularized: float
    minimal: float
    count: int
    ties: int
    histogram: np.ndarray
    edges: np.ndarray
    tie_tolerance: float
    conventions: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; an infinite minimal gap is None."""
        return {
            "sum_of_reciprocals": self.sum_of_reciprocals,
            "lower": self.lower,
            "upper": self.upper,
            "regularized": self.regularized,
            "minimal": self.minimal if math.isfinite(self.minimal) else None,
            "count": self.count,
            "ties": self.ties,
            "histogram": self.histogram.tolist(),
            "edges": self.edges.tolist(),
            "tie_tolerance": self.tie_tolerance,
        }

    def __str__(self) -> str:
        return (
            f"sum of reciprocal gaps {self.sum_of_reciprocals:.10g}, minimal gap {self.minimal:.6g}, {self.count} gaps"
        )


def gaps(mdp: TabularMDP, solution: Solution | None = None, *, tie_tolerance: float | None = None) -> Gaps:
    """Return the suboptimality gaps of an MDP, summed up.

        gap(s, a) = V*(s) - Q*(s, a)

    Under random actions Q* is the value of choosing an action. Under sticky actions a state is a pair (state, previously
    executed action) that can be reached, and a start state without a previous action is one more; gap((s, b), a) is the weight
    of the choice times the difference of the values of executing. With a horizon T, gaps belong to steps: the sum runs over
    t = 1, ..., T and the states that can be reached at step t (Simchowitz and Jamieson's setting).

    Args:
        solution: the optimal solution of `mdp`; None: solved here to an error of 1e-9.
        tie_tolerance: gaps up to it count as ties. None: 2.5 times the error bound of the solution, and at least 1e-9.
    Raises:
        ParameterError: `solution` belongs to another MDP or is not optimal.
        PrecisionError: tie_tolerance is not larger than twice the error bound, so that a tie could be counted as a gap.
    Cost: one pass over the table, 30 to 60 ns a state; with a horizon T passes and 8 T S bytes.
    Source: Simchowitz and Jamieson (2019), "Non-asymptotic gap-dependent regret bounds for tabular MDPs", section 2; the
        pharos paper, equation 2; regularized: Colosseum (Conserva and Rauber, 2022).
    """
    solution = checked(mdp, solution)
    tolerance = _tolerance(solution, tie_tolerance)
    error = 2 * solution.error_bound
    total = low = high = regularized = 0.0
    minimal, count, ties = math.inf, 0, 0
    histogram: dict[int, int] = {}
    for gap, weight, counted in _weighted_gaps(mdp, solution):
        regularized += float((weight[:, None] / (gap + REGULARIZER)).sum())
        rows = np.broadcast_to((counted * weight)[:, None], gap.shape)
        positive = (gap > tolerance) & (rows > 0)
        chosen, times = gap[positive], rows[positive]
        count += int(times.sum())
        ties += int(rows.sum()) - int(times.sum())
        if not chosen.size:
            continue
        total += float((times / chosen).sum())
        low += float((times / (chosen + error)).sum())
        high += float((times / (chosen - error)).sum())
        minimal = min(minimal, float(chosen.min()))
        bins, numbers = np.unique(np.floor(4 * np.log10(chosen)).astype(np.int64), return_inverse=True)
        for bin_, number in zip(bins.tolist(), np.bincount(numbers, times).tolist(), strict=True):
            histogram[bin_] = histogram.get(bin_, 0) + int(number)
    first, last = (min(histogram), max(histogram)) if histogram else (0, -1)
    return Gaps(
        total,
        low,
        high,
        regularized,
        minimal,
        count,
        ties,
        np.array([histogram.get(bin_, 0) for bin_ in range(first, last + 1)], np.int64),
        10.0 ** (np.arange(first, last + 2) / 4),
        tolerance,
        _conventions(mdp, solution, tolerance),
    )


def sum_of_reciprocal_gaps(
    mdp: TabularMDP, solution: Solution | None = None, *, tie_tolerance: float | None = None, regularized: bool = False
) -> float:
    """Return the sum of 1 / gap(s, a) over reachable, non-terminal states s and actions a with a gap; as `gaps` says.

    Args:
        regularized: instead, the sum of 1 / (gap + 0.1) over all states and actions.
    """
    result = gaps(mdp, solution, tie_tolerance=tie_tolerance)
    return result.regularized if regularized else result.sum_of_reciprocals


def minimal_gap(mdp: TabularMDP, solution: Solution | None = None, *, tie_tolerance: float | None = None) -> float:
    """Return the smallest gap(s, a) that is no tie; infinite where all actions are optimal everywhere. As `gaps` says."""
    return gaps(mdp, solution, tie_tolerance=tie_tolerance).minimal


def gaps_of_states(
    mdp: TabularMDP, solution: Solution | None, tie_tolerance: float | None
) -> tuple[Iterator[tuple[np.ndarray, np.ndarray]], float, dict[str, Any]]:
    """(blocks of (gap (N, A), weight (N,): how often each row counts, 0 for none), tie tolerance, conventions)."""
    solution = checked(mdp, solution)
    tolerance = _tolerance(solution, tie_tolerance)
    blocks = ((gap, counted * weight) for gap, weight, counted in _weighted_gaps(mdp, solution))
    return blocks, tolerance, _conventions(mdp, solution, tolerance)


def _tolerance(solution: Solution, tie_tolerance: float | None) -> float:
    error = 2 * solution.error_bound
    tolerance = max(1e-9, 1.25 * error) if tie_tolerance is None else tie_tolerance
    if not (isinstance(tolerance, int | float | np.floating) and math.isfinite(tolerance) and tolerance > error):
        raise PrecisionError(
            f"tie_tolerance is {tolerance!r}; expected more than twice the error bound of the solution, {error:.3g}: "
            f"raise it, or solve with a smaller tolerance"
        )
    return float(tolerance)


def checked(mdp: TabularMDP, solution: Solution | None) -> Solution:
    """The optimal solution of `mdp` that was given, or a new one.

    Raises:
        ParameterError: it is of another kind or MDP.
    """
    if solution is None:
        return value_iteration(mdp, 1e-9)
    shape = (mdp.num_states, mdp.num_actions)
    given = (solution.mdp.num_states, solution.mdp.num_actions)
    if solution.kind != "optimal" or given != shape or solution.mdp.chance != mdp.chance:
        raise ParameterError(
            f"solution is of kind {solution.kind!r} for {solution.mdp}; expected the optimal one of {mdp}"
        )
    return solution


def _conventions(mdp: TabularMDP, solution: Solution, tolerance: float) -> dict[str, Any]:
    return {
        **solution.conventions(),
        "tie_tolerance": tolerance,
        "states": "pairs (state, previously executed action), and starts without one" if mdp.is_sticky else "states",
        "steps": "each step of the horizon" if solution.horizon is not None else "any",
    }


# Gaps and how often they count -------------------------------------------------------------------------------------------


def _weighted_gaps(mdp: TabularMDP, solution: Solution) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(gap (N, A), weight (N,), counted (N,) bool) of blocks of states: a gap stands for `weight` pairs; terminal: not counted."""
    chance = mdp.chance
    if solution.horizon is None:
        values = [(solution.q_of(slice(None)) if mdp.transitions is not None else None, _visits(mdp))]
        steps: Iterator[tuple[np.ndarray | None, tuple[np.ndarray, np.ndarray]]] = iter(values)
    else:
        steps = _steps(mdp, solution)
    everywhere = solution.horizon is None and not mdp.is_sticky
    for q, (later, first) in steps:
        for start in range(0, mdp.num_states, _BLOCK):
            block = slice(start, min(start + _BLOCK, mdp.num_states))
            executed = solution.q_of(block) if q is None else q[block]
            difference = executed.max(axis=1, keepdims=True) - executed
            live = ~np.asarray(mdp.terminal[block])
            reached = later[block] > 0
            yield chance.chosen * difference, later[block] + (everywhere & ~reached), live & reached
            if first[block].any():
                some = np.flatnonzero(first[block])
                yield chance.first_chosen * difference[some], np.ones(some.size), live[some]


def _visits(mdp: TabularMDP) -> tuple[np.ndarray, np.ndarray]:
    """(later, first): how many times each state counts, and which start states count once more, without a previous action.

    later (S,) int64: 1 for a reachable state, under sticky actions the number of actions by which it can be reached.
    """
    reached = reachable(mdp)
    nothing = np.zeros(mdp.num_states, np.bool_)
    if not mdp.is_sticky:
        return reached.astype(np.int64), nothing
    arrived = _arrivals(mdp, reached)
    return arrived.sum(axis=1), _starts(mdp)


def _starts(mdp: TabularMDP) -> np.ndarray:
    mask = np.zeros(mdp.num_states, np.bool_)
    mask[mdp.start_states[mdp.start_probabilities > 0]] = True
    return mask


def _arrivals(mdp: TabularMDP, reached: np.ndarray) -> np.ndarray:
    """(S, A) bool: whether executing action a in some state of `reached` leads to s."""
    result = np.zeros((mdp.num_states, mdp.num_actions), np.bool_)
    live = np.flatnonzero(reached & ~np.asarray(mdp.terminal))
    if mdp.next_states is None:
        for action in range(mdp.num_actions):
            assert mdp.transitions is not None
            rows = mdp.transitions[live * mdp.num_actions + action]
            result[rows.indices[rows.data > 0], action] = True
        return result
    for start in range(0, live.size, _BLOCK):
        table = mdp.next_states[live[start : start + _BLOCK]]
        for action in range(mdp.num_actions):
            following = table[:, action]
            result[following[following >= 0], action] = True
    return result


def reachable(mdp: TabularMDP) -> np.ndarray:
    """(S,) bool: the states that can be reached from the start states, whatever is done."""
    reached = _starts(mdp)
    if mdp.next_states is not None:
        from pharos.kernels.graph import mark_reachable

        queue = np.empty(mdp.num_states, np.int32 if mdp.num_states < 2**31 else np.int64)
        starts = np.flatnonzero(reached)
        queue[: starts.size] = starts
        mark_reachable(mdp.next_states, np.asarray(mdp.terminal), reached, queue, starts.size)
        return reached
    frontier = np.flatnonzero(reached & ~mdp.terminal)
    while frontier.size:
        arrived = np.zeros(mdp.num_states, np.bool_)
        assert mdp.transitions is not None
        rows = mdp.transitions[(frontier[:, None] * mdp.num_actions + np.arange(mdp.num_actions)).ravel()]
        arrived[rows.indices[rows.data > 0]] = True
        frontier = np.flatnonzero(arrived & ~reached & ~mdp.terminal)
        reached |= arrived
    return reached


def _steps(mdp: TabularMDP, solution: Solution) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]]:
    """For each step t = 1, ..., T: the values of executing (S, A), and how often states count, as in `_visits`."""
    horizon = solution.horizon
    assert horizon is not None
    width = mdp.num_actions if mdp.is_sticky else 1
    needed = 8 * (horizon + 1) * mdp.num_states * width
    if solution.all_steps is None:
        if needed > _MEMORY:
            raise ParameterError(
                f"gaps of {horizon} steps of {mdp.num_states} states need {needed / 2**30:.1f} GiB; expected at most "
                f"{_MEMORY / 2**30:.0f}: leave out the horizon, or make it or the space smaller"
            )
        solution = value_iteration(mdp, horizon=horizon, keep_all=True)
    all_steps = solution.all_steps
    assert all_steps is not None
    reached = _starts(mdp)
    first = reached if mdp.is_sticky else np.zeros_like(reached)
    later = np.zeros(mdp.num_states, np.int64) if mdp.is_sticky else reached.astype(np.int64)
    for step in range(1, horizon + 1):
        to_go = horizon - step + 1
        q = _executed(mdp, all_steps[to_go - 1], solution.gamma)
        yield q, (later, first)
        arrived = _arrivals(mdp, reached)
        first = np.zeros_like(first)
        reached = np.asarray(arrived.any(axis=1))
        later = arrived.sum(axis=1) if mdp.is_sticky else reached.astype(np.int64)


def _executed(mdp: TabularMDP, v: np.ndarray, gamma: float) -> np.ndarray:
    """(S, A), the values of executing each action once and then collecting `v`, (S,) or (S, A) by what was executed."""
    return mdp.rewards + gamma * mdp.dynamics.expected(np.concatenate([v, np.zeros((1, *v.shape[1:]))]))
