"""Suboptimality gaps: how much worse an action is than the best one. Source: Simchowitz and Jamieson (2019).

What is proven. Each value is within the solution's error bound of the true one, so a gap is known to twice that. A gap
above the tie tolerance is a gap. Below it, a tie is proven if the best action and this one pay the same and lead to
the same states, or if equal values come from equal rewards for ever. Otherwise it may be a gap of any size, and its
reciprocal anything. Proofs that actions of equal computed value are tied:

1. Two actions that pay the same and have the same outcomes are tied, whatever the MDP.

2. Deterministic dynamics, with or without sticky actions. Let x be the computed values, and let every action that is
not among the best computed ones be surely worse (its gap exceeds the error). Call two pairs (state, previous action)
alike if x is the same to the last bit. If all pairs that are alike, and each of the best actions there, pay the same
and lead to pairs that are alike, then what the best actions collect is the same sequence of rewards for ever, so their
values are the same number: any choice among them solves the same equations, one for each class of pairs. Under sticky
actions the action that is repeated must lead on alike as well. A map from values to rewards and next values
(`kernels.extend`) finds out in one pass.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pharos.errors import ParameterError, PrecisionError
from pharos.hardness.interval import EXACT_WIDTH, Certified, fields_of
from pharos.kernels import gaps as kernels
from pharos.mdp import (
    BEST,
    BellmanEquation,
    TabularMDP,
    lone_starts,
    nodes_after,
    nodes_within,
    require_mdp,
)
from pharos.solvers import Solution, value_iteration
from pharos.system.arrays import UNIT_ROUNDOFF
from pharos.system.memory import large_zeros

# States at once; fixed, so that sums do not depend on the machine, and so few that a block stays in the cache.
_GAP_BLOCK = 1 << 14
# Bytes for the values of every step, with a horizon.
_MEMORY = 8 * 2**30


class Step(NamedTuple):
    """Values of a time step, or of all if there is no horizon, and how often each state counts."""

    own: np.ndarray  # (S + 1, W) x of this step
    next_x: np.ndarray  # (S + 1, W) x of the next step
    later: np.ndarray  # (S,) see `value_steps`
    first: np.ndarray


class GapBlock(NamedTuple):
    """Gaps of a block of states.

    Attributes:
        step: of the gaps. number: of that step.
        states: (N,) indices. is_whole: whether they are a range.
        rewards, next_values: (N, A), expected reward of executing an action, and expected value of the next state.
        gap: (N, A).
        scale: the probability that the chosen action is executed, which each gap is multiplied by.
        weight: (N,) how many pairs (state, previous action) a row stands for.
        counted: (N,) the same, but 0 for terminal states and states that cannot be reached.
    """

    step: Step
    number: int
    states: np.ndarray
    rewards: np.ndarray
    next_values: np.ndarray
    gap: np.ndarray
    scale: float
    weight: np.ndarray
    counted: np.ndarray
    is_whole: bool = True


def weighted_gaps(mdp: TabularMDP, solution: Solution) -> Iterator[GapBlock]:
    """The gaps of all states, in blocks."""
    for number, step in enumerate(value_steps(mdp, solution)):
        yield from _gaps_of_step(mdp, step, number, solution.horizon is None and not mdp.is_sticky)


def _gaps_of_step(mdp: TabularMDP, step: Step, number: int, everywhere: bool) -> Iterator[GapBlock]:
    """The gaps of one step, in blocks. With `everywhere`, states that cannot be reached have a weight, too."""
    chance = mdp.chance
    for first in range(0, mdp.num_states, _GAP_BLOCK):
        block = slice(first, min(first + _GAP_BLOCK, mdp.num_states))
        states = np.arange(block.start, block.stop)
        rewards = mdp.reward_table.rows(block)
        next_values = mdp.acting(mdp.dynamics.expected(step.next_x, block), block)
        difference = kernels.differences(rewards, next_values, mdp.gamma)
        live = ~np.asarray(mdp.terminal[block])
        later = step.later[block].astype(np.int64)
        weight = later + (everywhere & (later == 0))
        arrays = (number, states, rewards, next_values)
        gap = difference if chance.chosen == 1.0 else chance.chosen * difference
        sets = None if mdp.available is None else mdp.available[block]
        yield GapBlock(step, *arrays, _of_sets(gap, sets), chance.chosen, weight, np.where(live, later, 0))
        times = step.first[block].astype(np.int64)
        if times.any():
            some = np.flatnonzero(times)
            arrays = (number, states[some], rewards[some], next_values[some])
            gap = _of_sets(chance.first_chosen * difference[some], None if sets is None else sets[some])
            yield GapBlock(step, *arrays, gap, chance.first_chosen, times[some], live[some] * times[some], False)


def _of_sets(gap: np.ndarray, sets: np.ndarray | None) -> np.ndarray:
    """Gaps (N, A), infinite for actions that are not available, so that their reciprocals are 0."""
    return gap if sets is None else np.where(sets, gap, np.inf)


def value_steps(mdp: TabularMDP, solution: Solution) -> Iterator[Step]:
    """Yield the values of each step t = 1, ..., T, or once, and how many times each state counts.

    later (S,): 1 for a reachable state, under sticky actions the number of actions by which it can be
    reached; first (S,): 1 for start states, which count once more under sticky actions, without a previous action, and
    previous actions that are not available in the state, which count as none.
    """
    lone = lone_starts(mdp)

    def counts(nodes: np.ndarray, lone: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if mdp.available is None or not mdp.is_sticky:
            return nodes.sum(axis=1), lone
        return (nodes & mdp.available).sum(axis=1), lone + (nodes & ~mdp.available).sum(axis=1)

    if solution.horizon is None:
        yield Step(solution.x, solution.x, *counts(nodes_within(mdp), lone))
        return
    all_steps = _all_steps(mdp, solution)
    nodes = np.zeros((mdp.num_states, mdp.width), np.bool_)
    nodes[mdp.starts[~lone[mdp.starts]]] = True
    for step in range(1, solution.horizon + 1):
        to_go = solution.horizon - step + 1
        own, next_x = (_with_end(all_steps[n]) for n in (to_go, to_go - 1))
        yield Step(own, next_x, *counts(nodes, lone))
        nodes, lone = nodes_after(mdp, nodes, lone), np.zeros_like(lone)


def _all_steps(mdp: TabularMDP, solution: Solution) -> np.ndarray:
    """(T + 1, S) or (T + 1, S, A), the values with every number of steps to go."""
    needed = 8 * ((solution.horizon or 0) + 1) * mdp.num_states * mdp.width
    if solution.all_steps is None:
        if needed > _MEMORY:
            raise ParameterError(
                f"gaps of {solution.horizon} steps of {mdp.num_states} states need {needed / 2**30:.1f} GiB; expected "
                f"at most {_MEMORY / 2**30:.0f}: leave out the horizon, or make it or the space smaller"
            )
        solution = value_iteration(mdp, horizon=solution.horizon, keep_all=True)
    assert solution.all_steps is not None
    return solution.all_steps


def _with_end(values: np.ndarray) -> np.ndarray:
    """(S + 1, W), from (S,) or (S, A)."""
    return np.concatenate([values.reshape(len(values), -1), np.zeros((1, values[0].size))])


# Ties -----------------------------------------------------------------------------------------------------------------


# Different values up to which the map is kept; beyond, it would take more than 200 MB, and nothing is proven.
MOST_MAP_VALUES = 1 << 21
# Places of the map in the beginning.
_FIRST = 1 << 12


class TieProof:
    """The second proof of ties, of one block of states after the other.

    Attributes:
        holds: whether it holds for all blocks so far.
    """

    def __init__(self, mdp: TabularMDP):
        self.holds = mdp.dynamics.is_deterministic and not mdp.is_random
        self.holds &= mdp.available is None or not mdp.is_sticky
        self._step = -1

    def add_block(self, part: GapBlock, own: np.ndarray) -> None:
        """Extend the proof to a block of N states with values `own` (N, W). Blocks of one step come together."""
        if not self.holds:
            return
        if part.number != self._step:  # values of different steps are different
            self._step, self._filled = part.number, 0
            self._map = _empty_map(_FIRST, own.shape[1])
            nothing = np.zeros_like(part.rewards[:1])
            ended = np.zeros((1, own.shape[1])), nothing, nothing
            self._extend(*ended, np.zeros_like(part.gap[:1]), np.ones(1, np.int64))  # worth 0 for ever
        self._extend(own, part.rewards, part.next_values, part.gap, part.counted)

    def _extend(
        self, own: np.ndarray, rewards: np.ndarray, next_values: np.ndarray, gap: np.ndarray, counted: np.ndarray
    ) -> None:
        bits = [np.ascontiguousarray(each).view(np.int64) for each in (own, rewards, next_values)]
        begin = 0
        while self.holds and begin < len(gap):
            begin, self._filled = kernels.extend(*bits, gap, counted, begin, self._map, self._filled)
            if begin < 0 or self._filled > MOST_MAP_VALUES:
                self.holds = False
            elif begin < len(gap):
                larger = _empty_map(4 * len(self._map), own.shape[1])
                kernels.refill(self._map, larger)
                self._map = larger


def _empty_map(size: int, width: int) -> np.ndarray:
    return np.full((size, 3 if width == 1 else 5), kernels.FREE_KEY, np.int64)


def same_outcomes(
    mdp: TabularMDP, states: np.ndarray, rewards: np.ndarray, action: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """(K,) bool: whether two actions pay the same and have the same outcomes, the first proof. rewards: (K, A) of the
    states (K,)."""
    rows = np.arange(len(states))
    same = rewards[rows, action] == rewards[rows, other]
    one, two = (mdp.dynamics.outcomes(states, each) for each in (action, other))
    counts = [np.bincount(each.which, minlength=len(states)) for each in (one, two)]
    same &= counts[0] == counts[1]
    firsts = [np.cumsum(each) - each for each in counts]
    for k in range(int(counts[0].max(initial=0))):
        some = np.flatnonzero(same & (counts[0] > k))
        here, there = firsts[0][some] + k, firsts[1][some] + k
        same[some] = (one.states[here] == two.states[there]) & (one.probabilities[here] == two.probabilities[there])
    return same


class UnresolvedTies:
    """Count of the ties that are not proven to be ties.

    Attributes:
        small: gaps that are computed as larger than 0, and no larger than the tolerance. If the tolerance is part of
            the definition, gaps that are within their error of it.
        equal: gaps that are computed as 0, beyond the first of a state.
    """

    def __init__(self, mdp: TabularMDP, tolerance: float, error: float, is_definition: bool):
        self.mdp, self.tolerance, self.error, self.is_definition = mdp, tolerance, error, is_definition
        # values without any error are sums of whole multiples of a power of two, and so are the differences of two
        self.is_exact = error == 0.0 and mdp.gamma == 1.0 and mdp.is_deterministic and mdp.chance.is_none
        self.small = self.equal = 0
        self.proof = TieProof(mdp)

    def add_block(self, part: GapBlock, small: int, equal: int) -> None:
        """Add the ties of a block, of which `small` are small, and `equal` equal."""
        if part.scale == 0.0:
            return  # nothing can be chosen: every action is worth the same
        if self.is_definition:
            near = np.abs(part.gap - self.tolerance) <= self.error
            self.small += int((near.sum(axis=1) * part.counted).sum())
            return
        self.small += small
        self.equal += equal
        if not self.small and self.proof.holds and not self.is_exact:
            own = part.step.own[part.states[0] : part.states[-1] + 1] if part.is_whole else part.step.own[part.states]
            self.proof.add_block(part, own)

    def unresolved(self, parts: Iterator[GapBlock]) -> int:
        """Number of ties that are not proven. `parts`: all blocks once more, for proofs one by one."""
        if self.is_exact and not self.is_definition:
            return 0
        if self.is_definition or (not self.small and self.proof.holds):
            return self.small
        if self.small or not self.equal:
            return self.small + self.equal
        return self.equal - sum(self._num_same(part) for part in parts)

    def _num_same(self, part: GapBlock) -> int:
        """Number of equal gaps of a block between actions that have the same outcomes."""
        if part.scale == 0.0:
            return 0
        zero = (part.gap == 0.0) & (part.counted > 0)[:, None]
        several = np.flatnonzero(zero.sum(axis=1) > 1)
        zero = zero[several]
        best = zero.argmax(axis=1)
        zero[np.arange(several.size), best] = False
        row, action = np.nonzero(zero)
        rows = several[row]
        is_equal = part.next_values[rows, best[row]] == part.next_values[rows, action]
        row, action, rows = row[is_equal], action[is_equal], rows[is_equal]
        same = same_outcomes(self.mdp, part.states[rows], part.rewards[rows], best[row], action)
        return int(part.counted[rows[same]].sum())


# Gaps -----------------------------------------------------------------------------------------------------------------


# Of Colosseum.
REGULARIZER = 0.1
# The default tie tolerance is this times the error bound of the values; more than 2, as a gap is known to twice the
# bound.
ERRORS_PER_TIE = 2.5
# Relative rounding of a gap, its reciprocal and sums of these: a few units each, and one for each action.
_ROUNDING = 1e-12
# Sweeps at most, after the solution, until values settle; and sweeps that change values by no more than rounding.
_SWEEPS = 200
_AT_REST = 40


@dataclass(frozen=True)
class Gaps:
    """The suboptimality gaps gap(s, a) = V*(s) - Q*(s, a) of an MDP, summed up.

    Attributes:
        sum_of_reciprocals: sum of 1 / gap over the states that can be reached and are not terminal, and the actions
            with gap > tie_tolerance. Unit: 1 / return.
        lower, upper: the true sum lies between them: each gap is known up to twice the error bound of the solution.
            `upper` is infinite if ties are unresolved.
        regularized: sum of 1 / (gap + 0.1) over all states and actions, optimal ones and terminal states included, as
            Colosseum prints it.
        minimal: the smallest gap > tie_tolerance, infinite if there is none.
        count, ties: how many gaps exceed tie_tolerance, and how many do not, the best actions among them.
        unresolved: how many ties are not proven, so that they may be gaps smaller than the tolerance. With a
            `tie_tolerance` of the caller's own, how many gaps are within their error of it.
        small: how many gaps are computed as larger than 0, and no larger than the tolerance.
        histogram, edges: (B,) numbers of gaps in bins of a quarter of a decade, and their (B + 1,) edges.
        tie_tolerance: gaps up to it count as ties.
        error: largest error of a gap, twice the error bound of the solution.
        conventions: what the values refer to.
    """

    sum_of_reciprocals: float
    lower: float
    upper: float
    regularized: float
    minimal: float
    count: int
    ties: int
    unresolved: int
    small: int
    histogram: np.ndarray
    edges: np.ndarray
    tie_tolerance: float
    error: float
    conventions: dict[str, Any]

    @property
    def is_resolved(self) -> bool:
        """Whether ties are ties, and the sum is known to a relative 1e-6."""
        return not self.unresolved and self.upper - self.lower <= EXACT_WIDTH * self.upper

    @property
    def certified_sum(self) -> Certified:
        """The sum of reciprocals, with its interval."""
        return self._certified(self.sum_of_reciprocals, self.lower, self.upper)

    @property
    def certified_minimal(self) -> Certified:
        """The smallest gap, with its interval: from 0 on if ties are unresolved."""
        low, high = self.minimal * (1 - _ROUNDING) - self.error, self.minimal * (1 + _ROUNDING) + self.error
        return self._certified(self.minimal, 0.0 if self.unresolved else max(low, 0.0), high)

    @property
    def certified_regularized(self) -> Certified:
        """The regularized sum, with its interval: each 1 / (gap + 0.1) changes by a factor up to 1 + error / 0.1."""
        share = self.error / REGULARIZER
        high = self.regularized / (1 - share) * (1 + _ROUNDING) if share < 1 else math.inf
        low = self.regularized / (1 + share) * (1 - _ROUNDING)
        return Certified(self.regularized, low, high, high - low <= EXACT_WIDTH * high)

    def _certified(self, value: float, lower: float, upper: float) -> Certified:
        exact = not self.unresolved and (lower == upper or upper - lower <= EXACT_WIDTH * upper)
        note = ""
        if self.unresolved:
            note = (
                f"{self.unresolved} of {self.ties} ties at a tolerance of {self.tie_tolerance:.2g} are not resolved: "
                f"they may be smaller gaps"
            )
        extra = {"ties": self.ties, "unresolved_ties": self.unresolved, "tie_tolerance": self.tie_tolerance}
        return Certified(value, lower, upper, exact, note, extra)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, with None for what is infinite."""
        return fields_of(self, "small", "conventions")

    def __str__(self) -> str:
        ties = f", {self.unresolved} unresolved ties" if self.unresolved else ""
        return (
            f"sum of reciprocal gaps {self.sum_of_reciprocals:.10g}, minimal gap {self.minimal:.6g}, "
            f"{self.count} gaps{ties}"
        )


@require_mdp
def gaps(
    mdp: TabularMDP,
    solution: Solution | None = None,
    *,
    tie_tolerance: float | None = None,
) -> Gaps:
    """Return the suboptimality gaps of an MDP, summed up.

        gap(s, a) = V*(s) - Q*(s, a)

    Under random actions Q* is the value of choosing an action. Under sticky actions a state is a pair (state,
    previously executed action) that can be reached, and a start state without a previous action is one more. gap((s,
    b), a) is the weight of the choice times the difference of the values of executing. With a horizon T, gaps belong to
    steps: the sum runs over t = 1, ..., T and the states that can be reached at step t, as in Simchowitz and Jamieson.

    Args:
        solution: the optimal solution of `mdp`. Default: solved here to an error of 1e-9, and if that leaves ties
            unresolved to what 64-bit floats can reach.
        tie_tolerance: gaps up to it count as ties. None: 2.5 times the error bound of the solution.
    Raises:
        ParameterError: `solution` belongs to another MDP or is not optimal.
        PrecisionError: tie_tolerance is not larger than twice the error bound, so that a tie could be counted as a gap.
    Cost: one pass over the table, 50 to 100 ns a state with its proofs of ties, and 1 to 40 sweeps before it. With a
        horizon T passes and 8 T S bytes.
    Source: Simchowitz and Jamieson (2019), "Non-asymptotic gap-dependent regret bounds for tabular MDPs", section 2;
        the pharos paper, equation 2; regularized: Colosseum (Conserva and Rauber, 2022).
    """
    if solution is None and tie_tolerance is None:
        return resolved_gaps(mdp, optimal_solution(mdp, None))
    return _summed(mdp, optimal_solution(mdp, solution), tie_tolerance)


def resolved_gaps(
    mdp: TabularMDP, solution: Solution, in_place: bool = False, go_on: Callable[[], bool] = lambda: True
) -> Gaps:
    """The gaps of a solution, or of a more accurate one if ties are unresolved or the sum is wide.

    in_place: whether the values of the solution may become the more accurate ones. Its bound holds for these, too.
    go_on: whether there may be another sweep, asked before each.
    """
    if solution.horizon is not None or mdp.gamma == 1.0:
        return _summed(mdp, solution, None)
    settled = solution
    if TieProof(mdp).holds:  # else ties cannot be proven that way
        settled = _settled(mdp, solution, in_place, go_on)
    result = _summed(mdp, settled, None)
    if result.is_resolved or settled is not solution:
        return result
    settled = _settled(mdp, solution, in_place, go_on)
    return _summed(mdp, settled, None) if settled.error_bound < solution.error_bound else result


def _settled(mdp: TabularMDP, solution: Solution, in_place: bool, go_on: Callable[[], bool]) -> Solution:
    """The solution after more sweeps, until values do not change, or by no more than rounding.

    The bound comes from `pharos.solvers`: (rho change + rounding) / (1 - rho). Values that do not change at all make
    proofs of ties possible, as equal states then have equal floats. A sweep keeps every bound D of that form: new
    entries are within rho D + rounding <= D of the fixed point.
    """
    equation = BellmanEquation(mdp.reward_table, mdp.gamma, mdp.chance, BEST)
    operations = 2 * mdp.num_actions + mdp.dynamics.operations + 16
    rho = mdp.gamma * max(1.0, mdp.dynamics.mass) * (1 + 16 * UNIT_ROUNDOFF)
    if rho >= 1:
        return solution
    largest_reward = max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest))
    x, bound, at_rest = solution.x, solution.error_bound, 0
    if not in_place:
        x = large_zeros(solution.x.shape, np.float64)
        x[:] = solution.x
    largest = max(float(x.max(initial=0.0)), -float(x.min(initial=0.0)))
    sweeps = 0
    while sweeps < _SWEEPS and go_on():
        sweeps += 1
        change = mdp.dynamics.sweep(equation, x)
        largest += change
        rounding = operations * UNIT_ROUNDOFF * (largest_reward + largest + change) + mdp.reward_table.rounding
        bound = min(bound, (rho * change + rounding) / (1 - rho) * (1 + _ROUNDING))
        at_rest += change <= rounding
        if change == 0.0 or at_rest == _AT_REST:
            break
    return replace(solution, x=x, next_x=x, error_bound=bound, sweeps=solution.sweeps + sweeps)


@require_mdp
def sum_of_reciprocal_gaps(
    mdp: TabularMDP,
    solution: Solution | None = None,
    *,
    tie_tolerance: float | None = None,
    regularized: bool = False,
) -> float:
    """Return the sum of 1 / gap(s, a) over reachable, non-terminal states s and actions a with a gap, as `gaps` says.

    Args:
        regularized: instead, the sum of 1 / (gap + 0.1) over all states and actions.
    """
    result = gaps(mdp, solution, tie_tolerance=tie_tolerance)
    return result.regularized if regularized else result.sum_of_reciprocals


@require_mdp
def minimal_gap(
    mdp: TabularMDP,
    solution: Solution | None = None,
    *,
    tie_tolerance: float | None = None,
) -> float:
    """Return the smallest gap(s, a) that is no tie, infinite if there is none. As `gaps` says."""
    return gaps(mdp, solution, tie_tolerance=tie_tolerance).minimal


def gaps_of_states(
    mdp: TabularMDP, solution: Solution | None, tie_tolerance: float | None
) -> tuple[Iterator[tuple[np.ndarray, np.ndarray]], float, dict[str, Any]]:
    """(blocks of (gap (N, A), weight (N,): how often each row counts, 0 for none), tie tolerance, conventions)."""
    solution = optimal_solution(mdp, solution)
    tolerance = _tolerance(tie_tolerance, _error(mdp, solution))
    blocks = ((part.gap, part.counted) for part in weighted_gaps(mdp, solution))
    return blocks, tolerance, _gap_conventions(mdp, solution, tolerance)


def optimal_solution(mdp: TabularMDP, solution: Solution | None) -> Solution:
    """The optimal solution of `mdp`: the argument, or a new one to 1e-9 or to what 64-bit floats reach.

    Raises:
        ParameterError: it is of another kind or MDP.
    """
    if solution is None:
        return solution_within(value_iteration, mdp, 1e-9)
    shape = (mdp.num_states, mdp.num_actions)
    solution_shape = (solution.mdp.num_states, solution.mdp.num_actions)
    chance, other = ((each.chance, each.laziness) for each in (mdp, solution.mdp))
    sets, other_sets = mdp.available, solution.mdp.available
    is_same = sets is other_sets or np.array_equal(sets, other_sets)  # type: ignore[arg-type]  # None is none
    if solution.kind != "optimal" or solution_shape != shape or chance != other or not is_same:
        raise ParameterError(
            f"solution is of kind {solution.kind!r} for {solution.mdp}; expected the optimal one of {mdp}"
        )
    if solution.x.dtype != np.float64:
        x = solution.x.astype(np.float64)  # the same numbers, whose bound holds
        return replace(solution, x=x, next_x=x)
    return solution


def solution_within(solve: Callable[..., Solution], mdp: TabularMDP, tolerance: float, **options: Any) -> Solution:
    """A solution to a tolerance, in return. If floats do not reach it, to the least multiple by a power of ten that
    they reach, which `error_bound` says.

    Raises:
        PrecisionError: they reach none below the largest value that the MDP may have.
    """
    rewards = mdp.reward_table
    largest = max(abs(rewards.lowest), abs(rewards.highest)) / max(1 - mdp.gamma, 2.0**-53)
    while True:
        try:
            return solve(mdp, tolerance, **options)
        except PrecisionError:
            if tolerance > largest or not math.isfinite(largest):
                raise
            tolerance *= 10


def _error(mdp: TabularMDP, solution: Solution) -> float:
    """Bound on the error of a gap: twice the bound of values, of which all steps are within the bound of the solution.

    With a horizon the bound belongs to the first step. If gamma is below 1, the bound of a later one may be larger: it
    is a sum of discounted rounding errors, in proportion to the largest reward and value of its own steps.
    """
    error = 2 * solution.error_bound
    if solution.horizon is None or mdp.gamma == 1.0 or solution.error_bound == 0.0:
        return error
    reward = max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest))
    steps = min(solution.horizon, 1 / (1 - mdp.gamma))
    return error * steps * (1 + steps) if reward else error


def _tolerance(tie_tolerance: float | None, error: float) -> float:
    tolerance = max(np.finfo(float).tiny, ERRORS_PER_TIE / 2 * error) if tie_tolerance is None else tie_tolerance
    if not (isinstance(tolerance, int | float | np.floating) and math.isfinite(tolerance) and tolerance > error):
        raise PrecisionError(
            f"tie_tolerance is {tolerance!r}; expected more than twice the error bound of the solution, {error:.3g}: "
            f"raise it, or solve with a smaller tolerance"
        )
    return float(tolerance)


def _gap_conventions(mdp: TabularMDP, solution: Solution, tolerance: float) -> dict[str, Any]:
    return {
        **solution.conventions(),
        "tie_tolerance": tolerance,
        "states": "pairs (state, previously executed action), and starts without one" if mdp.is_sticky else "states",
        "steps": "each step of the horizon" if solution.horizon is not None else "any",
    }


def _summed(mdp: TabularMDP, solution: Solution, tie_tolerance: float | None) -> Gaps:
    error = _error(mdp, solution)
    tolerance = _tolerance(tie_tolerance, error)
    ties, added = UnresolvedTies(mdp, tolerance, error, tie_tolerance is not None), _Sums(mdp.available is not None)
    for part in weighted_gaps(mdp, solution):
        ties.add_block(part, *added.add(part, tolerance, error))
    unresolved = ties.unresolved(weighted_gaps(mdp, solution))
    total, low, high, regularized = added.sums[0].tolist()
    count, bins = int(added.counts[0]), np.flatnonzero(added.histogram)
    first, last = (int(bins[0]), int(bins[-1])) if bins.size else (0, -1)
    return Gaps(
        sum_of_reciprocals=total,
        lower=low * (1 - _ROUNDING),
        upper=high * (1 + _ROUNDING) if not unresolved else math.inf,
        regularized=regularized,
        minimal=added.minimal,
        count=count,
        ties=added.num_pairs - count,
        unresolved=unresolved,
        small=ties.small,
        histogram=added.histogram[first : last + 1].copy(),
        edges=10.0 ** ((np.arange(first, last + 2) - kernels.BIN_OF_ONE) / 4),
        tie_tolerance=tolerance,
        error=error,
        conventions=_gap_conventions(mdp, solution, tolerance),
    )


class _Sums:
    """Sums over the gaps of states, a block at a time. The arrays are described in `kernels.gaps`.

    Attributes:
        minimal: the smallest gap above the tolerance. num_pairs: how many gaps count.
    Args:
        has_sets: whether gaps that are infinite are of actions that are not available, and do not count.
    """

    def __init__(self, has_sets: bool) -> None:
        self.has_sets = has_sets
        self.sums, self.counts = kernels.empty_sums(), kernels.empty_counts()
        self.histogram = kernels.empty_histogram()
        self.minimal, self.num_pairs = math.inf, 0

    def add(self, part: GapBlock, tolerance: float, error: float) -> tuple[int, int]:
        """Add a block. Return how many of its ties are small, and how many equal."""
        previous = self.counts.copy()
        arguments = (tolerance, error, REGULARIZER, self.sums, self.counts, self.histogram)
        self.minimal = kernels.add_up(part.gap, part.weight, part.counted, self.minimal, *arguments)
        self.num_pairs += int(part.counted.sum()) * part.gap.shape[1]
        if self.has_sets:
            missing = int(part.counted @ (part.gap == math.inf).sum(axis=1))
            self.num_pairs -= missing
            self.counts[0] -= missing  # the kernel has counted them as large ones
            self.histogram[kernels.bin_of(math.inf)] -= missing
        small, equal = (self.counts - previous)[1:].tolist()
        return small, equal
