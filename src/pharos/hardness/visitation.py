"""Visits of policies and the time that they take: occupancy, exploration, covering, mixing.

Occupancy measures: how often a policy is in a state and takes an action. Source: Puterman (1994), section 6.9. Measures
of representations weigh states by `standard_occupancy`: half the visits of uniform play, half the visits of optimal
play.

Exploration time: how long uniform play takes to find a large reward, the cost of exploration without any learning.
Covering: how long random play takes to see everything. Source: Laidlaw, Russell and Dragan (2023), appendix. The bound
on the covering length: Even-Dar and Mansour (2003).

Mixing time: how many steps until a policy has forgotten its start. The distribution mismatch coefficient: how much
rarer an exploring policy visits the states of the optimal policy.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy  # whose `sparse` is loaded on first use

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.gaps import optimal_solution
from pharos.hardness.interval import EXACT_WIDTH, Interval, fields_of, finite
from pharos.hardness.steps import steps_of
from pharos.kernels import occupancy as kernels
from pharos.mdp import (
    STEPS_EXPECTED,
    Chance,
    ExpandedMDP,
    PolicyStep,
    PolicyTable,
    TabularMDP,
    require_mdp,
    uniform_choice,
    whole_number,
)
from pharos.solvers import Solution, TablePolicy, value_iteration
from pharos.system.compiling import Stopwatch

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

_STEPS_MEMORY = 8 << 30  # bytes that all steps together may take
_LEAST = 1e-280  # mass that is not worth a step: smaller numbers lose their digits, and take a hundred times longer


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Occupancy measure of a policy: expected visits of pairs of a state and an action.

    Attributes:
        visits: (S, A) float64, the sum over t of gamma^t mu_t(s, a), t = 0, 1, ...
        largest: (S, A) float64, the maximum over t of mu_t(s, a), without discount.
        steps: t that were gone through.
        error_bound: the entries of `visits` lack no more than this together. 0 with a horizon.
        by_step: (T, S, A), mu_t(s, a), if all were asked for, else None.
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
    policy: TablePolicy | None = None,
    *,
    horizon: int | None = None,
    executed: bool = False,
    keep_all: bool = False,
    tolerance: float = 1e-9,
    progress: Callable[[str], object] | None = None,
) -> Occupancy:
    """Return the occupancy measure of a policy.

        mu_t(s, a) = P(s_t = s, a_t = a),   visits(s, a) = sum over t of gamma^t mu_t(s, a),   t = 0, 1, ...

    Terminal states have no visits, as episodes end there. The expected return is the sum of
    visits(s, a) r(s, a) over executed actions.

    Args:
        policy: as for `evaluate_policy`: (S,) actions, (S, A) probabilities, under sticky actions also one for each
            previous action. Default: uniform.
        horizon: T, steps t = 0, ..., T - 1. Default: the MDP's. If it has none, until what is left is within
            `tolerance`.
        executed: whether a_t is the action that is executed, after chance. Otherwise the action that the policy
            chooses.
        keep_all: whether to keep mu_t for all t, with a horizon.
        tolerance: of the sum of all visits, without a horizon.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Raises:
        UndefinedMeasure: gamma is 1 and there is no horizon, so that visits may be infinite.
        ParameterError: the policy or an option is wrong, or all steps would take more than 8 GiB.
    Cost: O(S A) a step and O(S A) memory. Without a horizon about ln(1 / tolerance) / (1 - gamma) steps. 100 steps on
        the 2.4 million states of `breakout/12x8x1` take 0.8 s.
    Source: Puterman (1994), section 6.9; Laidlaw, Russell and Dragan (2023) for mu_t.
    """
    walk = Propagation(mdp, policy, horizon)
    shape = (mdp.num_states, mdp.num_actions)
    if keep_all and walk.horizon is None:
        raise ParameterError("keep_all is for episodes of T steps: give a horizon")
    if keep_all and 8 * walk.horizon * mdp.num_states * mdp.num_actions > _STEPS_MEMORY:  # type: ignore[operator]
        raise ParameterError(
            f"{walk.horizon} steps of {mdp.num_states} states need more than {_STEPS_MEMORY >> 30} GiB; "
            "leave out keep_all"
        )
    if not tolerance > 0:
        raise ParameterError(f"tolerance is {tolerance!r}; expected a number above 0")
    total, largest = np.zeros(shape), np.zeros(shape)
    by_step, scale, steps, left, report = [], 1.0, 0, 0.0, progress or str
    for now, first, alive in walk.distributions():
        report(f"visits of step {steps}")
        if walk.horizon is None:
            left = scale * alive / (1 - mdp.gamma)
            if left <= tolerance:
                break
        walk.record(now, first, executed, scale, total, largest)
        if keep_all:
            each = np.zeros(shape)
            walk.record(now, first, executed, 1.0, each, np.zeros(shape))
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


def discounted_visits(
    mdp: TabularMDP, policy: TablePolicy | None = None, *, tolerance: float = 1e-9
) -> tuple[np.ndarray, float]:
    """Return discounted state visits without a horizon, from below, and a bound on the mass that was cut off.

        d(s) = sum over t of gamma^t P(s_t = s),   t = 0, 1, ...

    As `occupancy(...).states`, but without `largest`, so that mass may go on many steps in one pass over states in
    breadth-first order.

    Args:
        policy, tolerance: as for `occupancy`.
    Returns:
        (S,) float64, and the bound. It is above `tolerance` only if all that is left has less than 1e-280 in each
        state.
    Raises:
        UndefinedMeasure: gamma is 1. ParameterError: the policy is wrong.
    Cost: O(S A) a pass, at most ln(1 / tolerance) / (1 - gamma) passes, in breadth-first order a tenth of them and
        fewer.
    """
    walk = Propagation(mdp if mdp.horizon is None else mdp.with_horizon(None), policy, None)
    started, visits, left = walk.discounted(tolerance)
    return started + visits.sum(axis=1), left


def discounted_arrivals(
    mdp: TabularMDP,
    policy: TablePolicy | None = None,
    *,
    tolerance: float = 1e-9,
    report: Callable[[str], object] = str,
) -> tuple[np.ndarray, float]:
    """Return discounted state visits and a bound on the mass that was cut off. Terminal states count on arrival.

        d(s) = sum over t of gamma^t P(s_t = s), times 1 - gamma if s is terminal or the end, which is never left

    Args, cost, errors: as for `discounted_visits`.
    Returns:
        (S + 1,) float64, entry S for the end, and the bound.
    """
    walk = Propagation(mdp if mdp.horizon is None else mdp.with_horizon(None), policy, None)
    started, visits, left = walk.discounted(tolerance, report)
    executed = walk.executed(started, visits)
    result = np.append(started + visits.sum(axis=1), 0.0)
    over = np.flatnonzero(~walk.live)
    arrived = mdp.gamma * mdp.dynamics.push_forward(executed)[:, 0]
    np.add.at(arrived, mdp.start_states, mdp.start_probabilities)
    result[over] = arrived[over]
    if mdp.has_ends:
        is_end = np.zeros(mdp.num_states + 1)
        is_end[-1] = 1.0
        result[-1] = mdp.gamma * float((executed * mdp.dynamics.expected(is_end)).sum())
    return result, left


def support_with_ends(mdp: TabularMDP, policy: TablePolicy | None = None) -> np.ndarray:
    """Return the states that a policy may be in at some step, however rarely, the end as one more: (S + 1,) bool.

    Args:
        policy: as for `occupancy`.
    Raises:
        ParameterError: the policy is wrong.
    Cost: O(S A). With transitions as a matrix, O(S A) for each step to the last state that is met.
    """
    walk = Propagation(mdp, policy, 1)
    started, is_visited = walk.after_the_start()
    is_visited = (is_visited > 0).astype(np.float64)
    mdp.dynamics.support(walk.later, is_visited)
    is_visited[~walk.live] = 0.0
    live = (is_visited > 0).any(axis=1) | (started > 0)
    executed = walk.executed((started > 0).astype(np.float64), is_visited) > 0
    arrived = mdp.dynamics.push_forward(executed.astype(np.float64))[:, 0] > 0
    arrived[mdp.starts] = True
    is_end = np.append(np.zeros(mdp.num_states), 1.0)
    ends = mdp.has_ends and bool((mdp.dynamics.expected(is_end)[executed] > 0).any())
    return np.append(np.where(walk.live, live, arrived), ends)


class Propagation:
    """Distributions of a policy's states, one step after the other.

    Pairs (state, previous action) under sticky actions.
    """

    def __init__(self, mdp: TabularMDP, policy: TablePolicy | None, horizon: int | None):
        steps = mdp.horizon if horizon is None else whole_number(horizon, "horizon", STEPS_EXPECTED)
        if steps is None and mdp.gamma == 1.0:
            raise UndefinedMeasure(
                f"{mdp}: visits may be infinite, as gamma is 1 and there is no horizon; give one, or gamma < 1"
            )
        self.mdp, self.horizon = mdp, steps
        self.live = ~np.asarray(mdp.terminal)
        table = PolicyTable.of(mdp, policy)
        self.first = PolicyStep(self.live, table.first, mdp.chance.first)
        self.later = PolicyStep(self.live, table.later, mdp.chance)
        self.width = mdp.width

    def after_the_start(self) -> tuple[np.ndarray, np.ndarray]:
        """((S,), (S, W)): under sticky actions the mass of the start, and the mass one step later. Otherwise 0, and the
        start.

        The second is the first mass that moves by the rules of later steps. Without states in which play ends.
        """
        start = next(self.distributions())[0]
        started, now = np.zeros(len(start)), np.zeros((len(start), self.width))
        if self.mdp.is_sticky:
            started += start[:, 0]
            self._push(start, True, now)
        else:
            now += start
        started[~self.live] = now[~self.live] = 0.0
        return started, now

    def executed(self, started: np.ndarray, visits: np.ndarray) -> np.ndarray:
        """(S, A): the mass that executes each action: of started (S,) by the rules of the first step, of visits (S, W)
        by the rules of later steps."""
        later = self.later.chance.executed(visits, self.later.policy)
        return later + self.first.chance.executed(started[:, None], self.first.policy)

    def discounted(
        self, tolerance: float, report: Callable[[str], object] = str
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """((S,), (S, W), bound): discounted visits of the first step, under sticky actions alone, visits of the others,
        and a bound on the visits that are missing."""
        started, waiting = self.after_the_start()
        gamma = self.mdp.gamma
        waiting *= gamma if self.mdp.is_sticky else 1.0
        visits, before = np.zeros_like(waiting), math.inf
        while True:
            left = self.mdp.dynamics.accumulate_visits(self.later, gamma, _LEAST, waiting, visits) / (1 - gamma)
            report(f"visits are known to {left:.2g}")
            if left <= tolerance or left >= before:
                return started, visits, left
            before = left

    def distributions(self) -> Iterator[tuple[np.ndarray, bool, float]]:
        """(mass, whether it is the first step, probability that play goes on) at t = 0, 1, ..., up to T with a horizon.

        mass is (S, 1), or under sticky actions after the first step (S, A), by the previously executed action. Each is
        overwritten by later ones.
        """
        states = self.mdp.num_states
        start = np.zeros((states, 1))
        np.add.at(start[:, 0], self.mdp.start_states, self.mdp.start_probabilities)
        yield start, True, float(start[self.live].sum())
        after, now = np.zeros((states, self.width)), np.zeros((states, self.width))
        alive = self._push(start, True, now)
        t = 1
        while self.horizon is None or t < self.horizon:
            yield now, False, alive
            alive = self._push(now, False, after)
            now, after = after, now
            t += 1

    def record(
        self, mass: np.ndarray, first: bool, executed: bool, scale: float, total: np.ndarray, largest: np.ndarray
    ) -> None:
        """Add the mass of pairs (state, action) of one step to `total`, times `scale`, and raise `largest` to it."""
        step = self.first if first else self.later
        weights = (step.chance if executed else Chance()).for_kernels
        kernels.record(self.live, step.policy, weights, mass, scale, total, largest)

    def _push(self, now: np.ndarray, first: bool, after: np.ndarray) -> float:
        return self.mdp.dynamics.step_distribution(self.first if first else self.later, now, after)


# Standard occupancy ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StandardOccupancy:
    """Optimal values of the learner's discount, and weights of states.

    Attributes:
        states: (S,) weights that sum to 1, 0 for terminal states.
        q: (S, A) optimal values without a horizon. Under sticky actions, of executing an action.
    """

    states: np.ndarray
    q: np.ndarray


def standard_occupancy(
    mdp: TabularMDP, gamma: float, episode: int, report: Callable[[str], object] = str
) -> StandardOccupancy:
    """The mean of the undiscounted occupancies of uniform play and of optimal play over episodes of some steps.

    Args:
        gamma: the learner's discount, of the values that optimal play follows. Its ties are chosen alike.
        report: called with a line for each sweep of values and each step of play.
    """

    def report_sweep(sweeps: int, _bound: float) -> None:
        report(f"sweep {sweeps} of the learner's values")

    solution = value_iteration(mdp.with_gamma(gamma).with_horizon(None), progress=report_sweep)
    best = solution.optimal_actions(max(1e-8, 4 * solution.error_bound))
    plain, total = mdp.with_gamma(1.0), np.zeros(mdp.num_states)
    for policy in (None, best / best.sum(axis=1, keepdims=True)):
        visits = occupancy(plain, policy, horizon=episode, progress=report).states
        total += visits / (2 * visits.sum())
    return StandardOccupancy(total, solution.q)


def drawn_indices(weights: np.ndarray, count: int) -> np.ndarray:
    """(count,) different indices, drawn by nine parts of weights (N,) and one of uniform chance, in random order."""
    share = 0.9 * weights / weights.sum() + 0.1 / len(weights)
    return np.random.default_rng(0).choice(len(weights), count, replace=False, p=share / share.sum())


# Exploration ----------------------------------------------------------------------------------------------------------


LARGE = 0.5  # of the largest reward


@dataclass(frozen=True)
class ExplorationTime:
    """Expected time until uniform play finds a large reward.

    Attributes:
        steps: expected, over one episode after another. Infinite if it never does.
        episodes: expected, the one in which it happens included: 1 / probability.
        probability: that an episode has one.
        threshold: a reward above it is large.
        horizon: steps of an episode.
    """

    steps: float
    episodes: float
    probability: float
    threshold: float
    horizon: int

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {**vars(self), "value": self.steps, "log10_episodes": float(np.log10(self.episodes))}

    def __str__(self) -> str:
        return f"{self.steps:.6g} steps, {self.episodes:.6g} episodes"


@require_mdp
def exploration_time(
    mdp: TabularMDP, *, horizon: int | None = None, progress: Callable[[str], object] | None = None
) -> ExplorationTime:
    """Return the expected steps, and episodes, after which uniform play has executed an action with a large reward.

    With p the probability that an episode meets one, and l the expected steps of an episode up to its end or to there:
    1 / p episodes, and l / p steps, by Wald's identity. A reward r(s, a) is large above half of the largest one; if
    rewards are costs alone, above the middle between the smallest and the largest.

    Args:
        horizon: steps of an episode. Default: the MDP's.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Raises:
        UndefinedMeasure: there are no episodes, or all rewards are costs of one size.
    Cost: O(S A) a step.
    Source: pharos. Goal-finding by random walk is as in Koenig and Simmons (1996).
    """
    steps = steps_of("exploration_time", mdp, horizon)
    rewards, live = mdp.rewards, ~np.asarray(mdp.terminal)
    threshold = LARGE * float(rewards.max(initial=0.0))
    if not threshold > 0:  # costs alone: from the largest on
        counts = np.broadcast_to(live[:, None], rewards.shape)
        costs = rewards[counts if mdp.available is None else counts & mdp.available]
        low, high = float(costs.min(initial=0.0)), float(costs.max(initial=-np.inf))
        if not low < high:
            raise UndefinedMeasure(f"exploration_time: all rewards are {low:g}, so none is large")
        threshold = low + LARGE * (high - low)
    is_large = rewards > threshold
    mass = np.zeros((mdp.num_states, 1))
    np.add.at(mass[:, 0], mdp.start_states, mdp.start_probabilities)
    probability = length = 0.0
    chance, play, report = mdp.chance.first, uniform_choice(mdp)[:, None], progress or str
    for t in range(steps):
        report(f"step {t} of {steps}")
        mass[~live] = 0.0
        total = mass.sum(axis=1, keepdims=True)
        length += float(total.sum())
        executed = chance.executed(mass, play)
        probability += float(executed[is_large].sum())
        executed[is_large] = 0.0
        if not executed.any():
            break
        mass = mdp.dynamics.push_forward(executed, mdp.width)
        chance = mdp.chance
    probability = min(probability, 1.0)
    if probability <= 0.0:
        return ExplorationTime(math.inf, math.inf, 0.0, threshold, steps)
    return ExplorationTime(length / probability, 1 / probability, probability, threshold, steps)


# Covering -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Covering:
    """Ingredients of the covering length.

    Attributes:
        omega_max: min over the pairs (s, a) that can be met of max over t of mu_t(s, a).
        omega_sum: the same with the sum over t.
        length_bound: ln(2 S A) / omega_max, episodes after which random play has covered all pairs with probability
            1/2.
        num_states: S, the states that can be met.
        conventions: horizon and exploration policy.
    """

    omega_max: float
    omega_sum: float
    length_bound: float
    num_states: int
    conventions: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return fields_of(self, "conventions")

    def __str__(self) -> str:
        return f"omega {self.omega_max:.6g} (sum {self.omega_sum:.6g}), length at most {self.length_bound:.6g} episodes"


@require_mdp
def covering(
    mdp: TabularMDP, *, horizon: int | None = None, progress: Callable[[str], object] | None = None
) -> Covering:
    """Return how rarely random play meets the rarest state and action.

        mu_t(s, a) = P(s_t = s, a_t = a) for uniform play from the start;  L <= ln(2 S A) / min over s, a of max over t
        of mu_t(s, a); if actions are not available everywhere, S A is the number of pairs that there are

    Pairs run over the states that can be met within T steps and are not terminal, under sticky actions over pairs
    (state, previously executed action), and a start without one.

    Args:
        horizon: T. Default: the MDP's.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Raises:
        UndefinedMeasure: there is no horizon.
    Cost: O(S A) for each of the T steps, and O(S) memory, under sticky actions O(S A). 200 steps on the 2.4 million
        states of `breakout/12x8x1` take 1.4 s.
    Source: Laidlaw, Russell and Dragan (2023), section 3 and appendix; the bound: Even-Dar and Mansour (2003).
    """
    steps = steps_of("covering", mdp, horizon)
    largest, total, pairs = _occupied(mdp, steps, progress or str)
    states = len(total)
    if not states:
        raise UndefinedMeasure("covering: every start state is terminal, so that nothing is played")
    omega_max, omega_sum = float(largest.min()), float(total.min())
    length = math.log(2 * pairs) / omega_max
    return Covering(omega_max, omega_sum, length, states, {"horizon": steps, "exploration": "uniform"})


def _occupied(mdp: TabularMDP, steps: int, report: Callable[[str], object]) -> tuple[np.ndarray, np.ndarray, int]:
    """(max over t, sum over t) of the probability of each action in each node that uniform play meets and that is not
    terminal, and the number of these pairs."""
    walk = Propagation(mdp, None, steps)
    largest, total = np.zeros((mdp.num_states, walk.width)), np.zeros((mdp.num_states, walk.width))
    alone = np.zeros((0, 1))  # under sticky actions a start has no previous action: nodes of their own
    for t, (now, first, _) in enumerate(walk.distributions()):
        report(f"step {t} of {steps}")
        if first and mdp.is_sticky:
            alone = now.copy()
            continue
        np.maximum(largest, now, out=largest)
        total += now
    sizes = np.full(mdp.num_states, mdp.num_actions) if mdp.available is None else mdp.available.sum(axis=1)
    sizes = sizes[walk.live, None]
    alone = alone[walk.live] / sizes if len(alone) else np.empty((0, 1))
    most, often = (np.append(each[walk.live] / sizes, alone) for each in (largest, total))
    counts = np.append(np.broadcast_to(sizes, (len(sizes), walk.width)), sizes[:, 0] if len(alone) else [])
    is_met = often > 0
    return most[is_met], often[is_met], int(counts[is_met].sum())


# Mixing ---------------------------------------------------------------------------------------------------------------


MOST_NODES = 4096
DISTANCE_ROUNDING = 1e-12  # of a distance, that a tie with epsilon is one


@dataclass(frozen=True)
class MixingTime:
    """Mixing time of a policy: steps until it has forgotten its start.

    Attributes:
        value: t_mix in steps, infinite if the chain does not converge.
        period: of the recurrent class, 0 if there are several.
        distance: the total variation distance at t_mix.
        conventions: epsilon, restart, policy, nodes.
    """

    value: float
    period: int
    distance: float
    conventions: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, with None for an infinite time."""
        value = {"value": finite(self.value), "infinite": math.isinf(self.value)}
        return {**value, **fields_of(self, "value", "conventions"), **self.conventions}

    def __str__(self) -> str:
        if math.isfinite(self.value):
            return f"{self.value:.0f}"
        return f"infinite (period {self.period})" if self.period else "infinite (several recurrent classes)"


@require_mdp
def mixing_time(
    mdp: TabularMDP,
    policy: TablePolicy | None = None,
    *,
    epsilon: float = 0.25,
    restart: bool = True,
    lazy: bool = False,
    progress: Callable[[str], object] | None = None,
) -> MixingTime:
    """Return the mixing time of the Markov chain of a policy.

        t_mix = min t with max over s of 1/2 sum over s' of |P^t(s, s') - mu(s')| <= epsilon,   mu P = mu

    Args:
        policy: as for `evaluate_policy`. Default: uniform.
        epsilon: in (0, 1/2).
        restart: an action in a terminal state leads back to the start, as for the diameter.
        lazy: of the chain (I + P) / 2, which has no period.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Returns:
        A MixingTime, infinite if the chain has a period or several recurrent classes.
    Raises:
        UndefinedMeasure: there are more than 4096 nodes (states, under sticky actions pairs with the previous action).
        ParameterError: an option or the policy is wrong.
    Cost: 2 log2(t_mix) products of N x N matrices.
    Source: Kearns and Singh (2002); Levin, Peres and Wilmer (2009), "Markov chains and mixing times", section 4.5.
    """
    if isinstance(epsilon, bool) or not isinstance(epsilon, int | float | np.floating) or not 0 < epsilon < 0.5:
        raise ParameterError(f"epsilon is {epsilon!r}; expected a number between 0 and 1/2")
    if mdp.num_states > 100 * MOST_NODES:  # too many to be written out, even if few can be reached
        raise UndefinedMeasure(_too_large_for_matrix(mdp.num_states))
    choices = ExpandedMDP.of(mdp, restart).reachable()
    size = len(choices.underlying)
    if size > MOST_NODES:
        raise UndefinedMeasure(_too_large_for_matrix(size))
    table = PolicyTable.of(mdp, policy)
    inside = np.minimum(choices.underlying, mdp.num_states - 1)
    actions = table.probabilities[inside, choices.previous if table.looks_back else 0]
    chain = scipy.sparse.csr_matrix(choices.matrix.multiply(actions.reshape(-1, 1)))
    owner = scipy.sparse.csr_matrix(
        (np.ones(chain.shape[0]), (np.repeat(np.arange(size), mdp.num_actions), np.arange(chain.shape[0])))
    )
    chain = scipy.sparse.csr_matrix(owner @ chain)
    if mdp.is_sticky:
        chain = _without_previous(chain, choices.underlying, np.append(np.asarray(mdp.terminal), True))
        size = chain.shape[0]
    chain.eliminate_zeros()
    if lazy:
        chain = scipy.sparse.csr_matrix((chain + scipy.sparse.identity(size)) / 2)
    conventions = {
        "epsilon": float(epsilon),
        "restart": restart,
        "lazy": lazy,
        "policy": "uniform" if policy is None else "given",
        "nodes": size,
    }
    period = _period(chain)
    if period != 1:
        return MixingTime(math.inf, period, 1.0, conventions)
    steps, distance = _mixing_time(chain.toarray(), float(epsilon), progress or str)
    return MixingTime(float(steps), 1, distance, conventions)


def _without_previous(chain: "csr_matrix", underlying: np.ndarray, ended: np.ndarray) -> "csr_matrix":
    """The chain in which an episode that has ended does not remember the previous action."""
    label = np.where(ended[underlying], underlying, len(ended) + np.arange(len(underlying)))
    _, first, index = np.unique(label, return_index=True, return_inverse=True)
    membership = scipy.sparse.csr_matrix((np.ones(len(index)), (np.arange(len(index)), index)))
    return scipy.sparse.csr_matrix(chain[first] @ membership)


def _too_large_for_matrix(nodes: int) -> str:
    return (
        f"mixing_time: {nodes} nodes are more than the {MOST_NODES} whose matrix fits; a smaller instance "
        f"would define it"
    )


def _period(chain: "csr_matrix") -> int:
    """The period of the recurrent class, 0 if there are several."""
    count, labels = scipy.sparse.csgraph.connected_components(chain, directed=True, connection="strong")
    rows, columns = chain.nonzero()
    leaves = np.zeros(count, np.bool_)
    leaves[labels[rows][labels[rows] != labels[columns]]] = True
    closed = np.flatnonzero(~leaves)
    if len(closed) != 1:
        return 0
    recurrent = np.flatnonzero(labels == closed[0])
    inner = chain[recurrent][:, recurrent]
    order, before = scipy.sparse.csgraph.breadth_first_order(inner, 0)
    level = np.zeros(len(recurrent), np.int64)
    for node in order[1:]:
        level[node] = level[before[node]] + 1
    rows, columns = inner.nonzero()
    return int(np.gcd.reduce(level[rows] + 1 - level[columns]))


def _mixing_time(chain: np.ndarray, epsilon: float, report: Callable[[str], object]) -> tuple[int, float]:
    """(t_mix, distance there): squares until it is near enough, then bisection by the squares on the way."""
    size = len(chain)
    epsilon += DISTANCE_ROUNDING
    system = chain.T - np.eye(size)  # of which one equation follows from the others
    system[-1] = 1.0
    stationary = np.linalg.solve(system, np.append(np.zeros(size - 1), 1.0))

    def distance(power: np.ndarray) -> float:
        return float(0.5 * np.abs(power - stationary).sum(axis=1).max())

    if distance(np.eye(size)) <= epsilon:
        return 0, distance(np.eye(size))
    powers = [chain]
    while distance(powers[-1]) > epsilon:
        report(f"more than {2 ** (len(powers) - 1):,} steps")
        powers.append(powers[-1] @ powers[-1])
        if len(powers) > 60:
            raise UndefinedMeasure("mixing_time: the chain takes more than 2^60 steps")
    steps, power = 0, np.eye(size)  # the largest t that is not near enough, and P^t
    for i in range(len(powers) - 2, -1, -1):
        report(f"between {steps + 1:,} and {steps + 2 ** (i + 1):,} steps")
        further = power @ powers[i]
        if distance(further) > epsilon:
            steps, power = steps + 2**i, further
    return steps + 1, distance(power @ chain)


# Mismatch -------------------------------------------------------------------------------------------------------------


@require_mdp
def distribution_mismatch(
    mdp: TabularMDP,
    policy: TablePolicy | None = None,
    solution: Solution | None = None,
    *,
    tolerance: float = 1e-9,
    progress: Callable[[str], object] | None = None,
) -> Interval:
    """Return the distribution mismatch coefficient of a policy.

        max over s with d*(s) > 0 of d*(s) / d(s),   d(s) = sum over t of gamma^t P(s_t = s),   t = 0, 1, ...

    over all states, terminal ones and the implicit end of an episode among them, which are never left. d* belongs to
    the optimal policy that takes the first of the best actions everywhere, d to `policy`, both from the start. The
    result is at least 1.

    Args:
        policy: as for `evaluate_policy`. Default: uniform.
        solution: the optimal solution of `mdp`. Default: solved here to an error of 1e-9, or what floats reach.
        tolerance: of the sums of d and of d*.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Returns:
        An interval: it is wide if d(s) is not much larger than `tolerance`, and infinite at the upper end if it
        is smaller.
    Raises:
        UndefinedMeasure: gamma is 1, or there is a horizon: the optimal policy then depends on the step.
        ParameterError: `solution` is not of this MDP, or an argument is wrong.
    Cost: two occupancy measures, each of at most ln(1e9) / (1 - gamma) passes over the table, in breadth-first order a
        tenth of them.
    Source: Kakade and Langford (2002); Agarwal, Kakade, Lee and Mahajan (2021), "On the theory of policy gradient
        methods", section 4.2.
    """
    watch = Stopwatch()
    if mdp.horizon is not None or mdp.gamma == 1.0:
        raise UndefinedMeasure(
            "distribution_mismatch is defined for discounted MDPs without a horizon: give gamma < 1 and no horizon"
        )
    solution = optimal_solution(mdp, solution)
    best, lacking = discounted_arrivals(mdp, solution.policy, tolerance=tolerance, report=progress or str)
    other, missing = discounted_arrivals(mdp, policy, tolerance=tolerance, report=progress or str)
    there = support_with_ends(mdp, solution.policy)
    # All numbers are sums of products, each of at most as many factors as there are steps that count.
    steps = mdp.num_states + 32 / (1 - mdp.gamma)
    rounding = 4 * (mdp.num_actions + mdp.dynamics.operations + 8) * steps * 2.0**-53
    one, two = best[there], other[there]
    with np.errstate(divide="ignore", invalid="ignore"):
        lower = float(np.nanmax(one / (two + missing), initial=0.0)) * (1 - rounding)
        upper = float(np.nanmax((one + lacking) / two, initial=0.0)) * (1 + rounding)
    # Both are distributions times 1 / (1 - gamma): somewhere d* is at least d.
    lower, upper = max(lower, 1.0), max(upper, 1.0)
    return Interval(
        lower,
        upper,
        exact=math.isfinite(upper) and upper - lower <= EXACT_WIDTH * upper,
        tolerance=EXACT_WIDTH,
        method="occupancy measures",
        conventions={"gamma": mdp.gamma, "policy": "uniform" if policy is None else "given"},
        note="" if math.isfinite(upper) else "the policy hardly ever reaches a state of the optimal policy",
        seconds=watch.seconds,
    )
