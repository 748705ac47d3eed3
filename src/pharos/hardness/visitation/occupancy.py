"""Occupancy measures: how often a policy is where, and what it does there. Source: Puterman (1994), section 6.9.

Where measures of representations look: half the visits of uniform play, half those of optimal play.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.kernels import occupancy as kernels
from pharos.mdp import Chance, PolicyStep, PolicyTable, TabularMDP, chosen_mass, require_mdp
from pharos.solvers import value_iteration

_MEMORY = 8 << 30  # bytes that all steps together may take
_LEAST = 1e-280  # mass that is not worth a step: smaller numbers lose their digits, and take a hundred times longer


@dataclass(frozen=True, eq=False)
class Occupancy:
    """How often a policy is in a state and takes an action.

    Attributes:
        visits: (S, A) float64, the sum over t of gamma^t mu_t(s, a), t = 0, 1, ...
        largest: (S, A) float64, the maximum over t of mu_t(s, a), without discount.
        steps: t that were gone through.
        error_bound: the entries of `visits` lack no more than this together; 0 with a horizon.
        by_step: (T, S, A), mu_t(s, a), where all were asked for; else None.
        conventions: gamma, horizon, and whether actions are chosen or executed ones.
    """

    visits: np.ndarray
    largest: np.ndarray
    steps: int
    error_bound: float
    by_step: np.ndarray | None = None
    conventions: dict[str, Any] = field(default_factory=dict)

    @property
    def states(self) -> np.ndarray:
        """(S,), the visits of states, whatever is done there."""
        return self.visits.sum(axis=1)

    def to_dict(self) -> dict[str, Any]:
        """A summary, JSON-able."""
        is_visited = self.visits > 0
        return {
            "steps": self.steps,
            "error_bound": self.error_bound,
            "total": float(self.visits.sum()),
            "visited_pairs": int(is_visited.sum()),
            "smallest": float(self.visits[is_visited].min()) if is_visited.any() else None,
            **self.conventions,
        }

    def __str__(self) -> str:
        return f"{int((self.visits > 0).sum())} pairs visited, {self.visits.sum():.6g} steps in all"


@require_mdp
def occupancy(
    mdp: TabularMDP,
    policy: Any = None,
    *,
    horizon: int | None = None,
    executed: bool = False,
    keep_all: bool = False,
    tolerance: float = 1e-9,
) -> Occupancy:
    """Return the occupancy measure of a policy.

        mu_t(s, a) = P(s_t = s, a_t = a),   visits(s, a) = sum over t of gamma^t mu_t(s, a),   t = 0, 1, ...

    An episode that has ended is nowhere: terminal states have no visits. The expected return is the sum of
    visits(s, a) r(s, a) over executed actions.

    Args:
        policy: as for `evaluate_policy`: (S,) actions, (S, A) probabilities, under sticky actions also one for each
            previous action; None: uniform.
        horizon: T, steps t = 0, ..., T - 1; None: that of the MDP; where it has none, until what is left is within
            `tolerance`.
        executed: whether a_t is the action that is executed, after chance; otherwise the one that the policy chooses.
        keep_all: whether to keep mu_t for all t, with a horizon.
        tolerance: of the sum of all visits, without a horizon.
    Raises:
        UndefinedMeasure: gamma is 1 and there is no horizon, so that visits may be infinite.
        ParameterError: the policy or an option is wrong, or all steps would take more than 8 GiB.
    Cost: O(S A) a step and O(S A) memory; without a horizon about ln(1 / tolerance) / (1 - gamma) steps. 100 steps on
        the 2.4 million states of `breakout/12x8x1` take 0.8 s.
    Source: Puterman (1994), section 6.9; Laidlaw, Russell and Dragan (2023) for mu_t.
    """
    walk = Walk(mdp, policy, horizon)
    shape = (mdp.num_states, mdp.num_actions)
    if keep_all and walk.horizon is None:
        raise ParameterError("keep_all is for episodes of T steps: give a horizon")
    if keep_all and 8 * walk.horizon * mdp.num_states * mdp.num_actions > _MEMORY:  # type: ignore[operator]
        raise ParameterError(
            f"{walk.horizon} steps of {mdp.num_states} states need more than {_MEMORY >> 30} GiB; leave out keep_all"
        )
    if not tolerance > 0:
        raise ParameterError(f"tolerance is {tolerance!r}; expected a number above 0")
    total, largest = np.zeros(shape), np.zeros(shape)
    by_step, scale, steps, left = [], 1.0, 0, 0.0
    for now, alive in walk.distributions():
        if walk.horizon is None:
            left = scale * alive / (1 - mdp.gamma)
            if left <= tolerance:
                break
        walk.record(now, executed, scale, total, largest)
        if keep_all:
            each = np.zeros(shape)
            walk.record(now, executed, 1.0, each, np.zeros(shape))
            by_step.append(each)
        scale *= mdp.gamma
        steps += 1
    conventions = {
        "gamma": mdp.gamma,
        "horizon": walk.horizon,
        "actions": "executed" if executed else "chosen",
        "policy": "uniform" if policy is None else "given",
    }
    return Occupancy(total, largest, steps, left, np.stack(by_step) if keep_all else None, conventions)


def discounted_visits(mdp: TabularMDP, policy: Any = None, *, tolerance: float = 1e-9) -> tuple[np.ndarray, float]:
    """Return the visits of states without a horizon, from below, and what they may lack together.

        d(s) = sum over t of gamma^t P(s_t = s),   t = 0, 1, ...

    As `occupancy(...).states`, but without `largest`, so that mass may go on many steps in one pass over states in
    breadth-first order.

    Args:
        policy, tolerance: as for `occupancy`.
    Returns:
        (S,) float64, and the bound; it is above `tolerance` only where all that is left has less than 1e-280 in each
        state.
    Raises:
        UndefinedMeasure: gamma is 1. ParameterError: the policy is wrong.
    Cost: O(S A) a pass; at most ln(1 / tolerance) / (1 - gamma) passes, in breadth-first order a tenth of them and
        fewer.
    """
    walk = Walk(mdp if mdp.horizon is None else mdp.with_horizon(None), policy, None)
    started, visits, left = walk.discounted(tolerance)
    return started + visits.sum(axis=1), left


def discounted_arrivals(mdp: TabularMDP, policy: Any = None, *, tolerance: float = 1e-9) -> tuple[np.ndarray, float]:
    """Return the visits of states without a horizon, in terminal states and the end by arrival; and what they may lack
    together.

        d(s) = sum over t of gamma^t P(s_t = s), times 1 - gamma where s is terminal or the end, which is never left

    Args, cost, errors: as for `discounted_visits`.
    Returns:
        (S + 1,) float64, entry S for the end; and the bound.
    """
    walk = Walk(mdp if mdp.horizon is None else mdp.with_horizon(None), policy, None)
    started, visits, left = walk.discounted(tolerance)
    executed = walk.executed(started, visits)
    result = np.append(started + visits.sum(axis=1), 0.0)
    over = np.flatnonzero(~walk.live)
    arrived = mdp.gamma * mdp.dynamics.pushed(executed)[:, 0]
    np.add.at(arrived, mdp.start_states, mdp.start_probabilities)
    result[over] = arrived[over]
    if mdp.has_ends:
        is_end = np.zeros(mdp.num_states + 1)
        is_end[-1] = 1.0
        result[-1] = mdp.gamma * float((executed * mdp.dynamics.expected(is_end)).sum())
    return result, left


def support(mdp: TabularMDP, policy: Any = None) -> np.ndarray:
    """Return the states that a policy may be in at some step, however rarely: (S,) bool, without terminal ones.

    Args:
        policy: as for `occupancy`.
    Raises:
        ParameterError: the policy is wrong.
    Cost: O(S A); with transitions as a matrix that for each step to the last state that is met.
    """
    return support_with_ends(mdp, policy)[:-1] & ~np.asarray(mdp.terminal)


def support_with_ends(mdp: TabularMDP, policy: Any = None) -> np.ndarray:
    """As `support`, with terminal states, and the end as one more: (S + 1,) bool."""
    walk = Walk(mdp, policy, 1)
    started, is_visited = walk.after_the_start()
    is_visited = (is_visited > 0).astype(np.float64)
    mdp.dynamics.support(walk.later, is_visited)
    is_visited[~walk.live] = 0.0
    live = (is_visited > 0).any(axis=1) | (started > 0)
    executed = walk.executed((started > 0).astype(np.float64), is_visited) > 0
    arrived = mdp.dynamics.pushed(executed.astype(np.float64))[:, 0] > 0
    arrived[mdp.starts] = True
    is_end = np.append(np.zeros(mdp.num_states), 1.0)
    ends = mdp.has_ends and bool((mdp.dynamics.expected(is_end)[executed] > 0).any())
    return np.append(np.where(walk.live, live, arrived), ends)


class Walk:
    """Distributions of a policy's states, one step after the other.

    Pairs (state, previous action) under sticky actions.
    """

    def __init__(self, mdp: TabularMDP, policy: Any, horizon: int | None):
        steps = mdp.horizon if horizon is None else horizon
        if steps is not None and (isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1):
            raise ParameterError(f"horizon is {steps!r}; expected a whole number of steps, at least 1")
        if steps is None and mdp.gamma == 1.0:
            raise UndefinedMeasure(
                f"{mdp}: visits may be infinite, as gamma is 1 and there is no horizon; give one, or gamma < 1"
            )
        self.mdp, self.horizon = mdp, None if steps is None else int(steps)
        self.live = ~np.asarray(mdp.terminal)
        table = PolicyTable.of(mdp, policy)
        self.first = PolicyStep(self.live, table.first, mdp.chance.first)
        self.later = PolicyStep(self.live, table.later, mdp.chance)
        self.width = mdp.width

    def after_the_start(self) -> tuple[np.ndarray, np.ndarray]:
        """((S,), (S, W)): under sticky actions where play starts, and where it is a step later.

        Otherwise nothing, and where it starts.

        That is where the rules of later steps hold. Without states where play ends.
        """
        start = next(self.distributions())[0].mass
        started, now = np.zeros(len(start)), np.zeros((len(start), self.width))
        if self.mdp.is_sticky:
            started += start[:, 0]
            self._push(start, True, now)
        else:
            now += start
        started[~self.live] = now[~self.live] = 0.0
        return started, now

    def executed(self, started: np.ndarray, visits: np.ndarray) -> np.ndarray:
        """(S, A): how masses execute the actions: started (S,) under the rules of the first step, visits (S, W) of
        later ones."""
        later = self.later.chance.executed(visits, chosen_mass(self.later.policy, visits))
        first = started[:, None]
        return later + self.first.chance.executed(first, chosen_mass(self.first.policy, first))

    def discounted(self, tolerance: float) -> tuple[np.ndarray, np.ndarray, float]:
        """((S,), (S, W), bound): discounted visits, under sticky actions those of the first step apart; what they may
        lack."""
        started, waiting = self.after_the_start()
        gamma = self.mdp.gamma
        waiting *= gamma if self.mdp.is_sticky else 1.0
        visits, before = np.zeros_like(waiting), math.inf
        while True:
            left = self.mdp.dynamics.settle(self.later, gamma, _LEAST, waiting, visits) / (1 - gamma)
            if left <= tolerance or left >= before:
                return started, visits, left
            before = left

    def distributions(self) -> Iterator[tuple["Nodes", float]]:
        """(distribution, probability that play goes on) at t = 0, 1, ...; T of them with a horizon.

        Each is overwritten by later ones.
        """
        states = self.mdp.num_states
        start = np.zeros((states, 1))
        np.add.at(start[:, 0], self.mdp.start_states, self.mdp.start_probabilities)
        yield Nodes(start, True), float(start[self.live].sum())
        after, now = np.zeros((states, self.width)), np.zeros((states, self.width))
        alive = self._push(start, True, now)
        t = 1
        while self.horizon is None or t < self.horizon:
            yield Nodes(now, False), alive
            alive = self._push(now, False, after)
            now, after = after, now
            t += 1

    def record(self, nodes: "Nodes", executed: bool, scale: float, total: np.ndarray, largest: np.ndarray) -> None:
        """Add the pairs (state, action) of one step."""
        play = self.first if nodes.first else self.later
        weights = (play.chance if executed else Chance()).triple
        kernels.record(self.live, play.policy, weights, nodes.mass, scale, total, largest)

    def _push(self, now: np.ndarray, first: bool, after: np.ndarray) -> float:
        return self.mdp.dynamics.move(self.first if first else self.later, now, after)


@dataclass(frozen=True, eq=False)
class Nodes:
    """Where a policy is at one step.

    Attributes:
        mass: (S, 1), or under sticky actions after the first step (S, A), by the previously executed action.
        first: whether it is the first step, without a previous action.
    """

    mass: np.ndarray
    first: bool


# Standard occupancy ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StandardOccupancy:
    """Optimal values of the learner's discount, and where one is.

    Attributes:
        states: (S,) weights that sum to 1; 0 for terminal states.
        q: (S, A) optimal values without a horizon; under sticky actions of executing an action.
    """

    states: np.ndarray
    q: np.ndarray


def standard_occupancy(mdp: TabularMDP, gamma: float, episode: int) -> StandardOccupancy:
    """The mean of the undiscounted occupancies of uniform play and of optimal play over episodes of some steps.

    Args:
        gamma: the learner's discount, of the values that optimal play follows; its ties are chosen alike.
    """
    solution = value_iteration(mdp.with_gamma(gamma).with_horizon(None))
    best = solution.optimal_actions(max(1e-8, 4 * solution.error_bound))
    plain, total = mdp.with_gamma(1.0), np.zeros(mdp.num_states)
    for policy in (None, best / best.sum(axis=1, keepdims=True)):
        visits = occupancy(plain, policy, horizon=episode).states
        total += visits / (2 * visits.sum())
    return StandardOccupancy(total, solution.q)


def drawn(weights: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """(count,) different places, drawn by nine parts of weights (N,) and one of uniform chance, in random order."""
    share = 0.9 * weights / weights.sum() + 0.1 / len(weights)
    return np.random.default_rng(seed).choice(len(weights), count, replace=False, p=share / share.sum())
