"""Loss of an agent without memory by observations that several states share.

A deterministic memoryless policy chooses an action for each observation. The best one is looked for by branch and
bound: some observations get an action, all other states choose freely, and the optimal value of this relaxed MDP is an
upper bound. Policies that choose alike wherever states look alike are lower bounds. Finding the best one is NP-hard
(Littman 1994), so the search may end with an interval.
"""

import heapq
import itertools
import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP, executed_actions, lacking
from pharos.solvers import Solution, evaluate_policy, value_iteration

LOSS_WIDTH = 1e-7
# Improvements of one policy, and steps of its occupancy
MOST_MEMORYLESS_IMPROVEMENTS, MOST_STEPS = 20, 400
# States times actions of relaxed problems: larger ones get one bound from above, the optimum
MOST_PAIRS = 2_000_000


@dataclass(frozen=True)
class MemorylessLoss:
    """Optimal value minus the value of the best deterministic memoryless policy on an observation, at the start.

    Attributes:
        lower, upper: proven bounds of the loss, in units of return.
        exact: whether they differ by rounding and tolerance alone.
        policies: how many policies, and relaxed problems, were solved.
    """

    lower: float
    upper: float
    exact: bool
    policies: int = 0


def memoryless_loss(
    mdp: TabularMDP, classes: np.ndarray, *, optimal: Solution | None = None, budget: float = 10.0
) -> MemorylessLoss:
    """Bound V*(start) - max over policies on observations of V(start).

    If some actions are not available, policies take what is available in all states that look alike.

    Args:
        mdp: discounted or with a horizon, as `value_iteration` takes it, with random actions, but no sticky ones.
        classes: (S,) the number of the observation of each state, as `observation_classes` gives it.
        optimal: the solution of `mdp`, if there is one.
        budget: seconds after which the bounds so far are returned.
    Raises:
        ParameterError: actions are sticky, or no action is available in all states that look alike.
    Cost: up to `budget`, and one solution of the MDP and one policy beyond it.
    Source: Littman (1994), "Memoryless policies: theoretical limitations and practical results".
    """
    if mdp.is_sticky:
        raise ParameterError(
            f"{mdp}: under sticky actions a policy without memory does not know the state; leave them out"
        )
    optimal = optimal or value_iteration(mdp, LOSS_WIDTH)
    search = _PolicySearch(mdp, np.asarray(classes), time.monotonic() + budget)
    lower, upper = search.bounds(optimal)
    best, error = float(optimal.value_at_start), optimal.error_bound
    lower_loss = max(0.0, best - error - upper)
    upper_loss = max(lower_loss, best + error - lower)
    return MemorylessLoss(lower_loss, upper_loss, upper_loss - lower_loss <= 10 * (LOSS_WIDTH + error), search.solved)


class _PolicySearch:
    """Branch and bound over the observations that states share.

    Attributes:
        solved: how many problems and policies were solved.
        sets: (C, A) bool, the actions that are available in all states of an observation.
    """

    def __init__(self, mdp: TabularMDP, classes: np.ndarray, deadline: float):
        self.mdp, self.deadline, self.solved = mdp, deadline, 0
        self.live = ~np.asarray(mdp.terminal)
        self.classes = classes
        self.count = int(classes.max()) + 1
        self.is_shared = np.bincount(classes[self.live], minlength=self.count) > 1
        self.is_small = mdp.num_states * mdp.num_actions <= MOST_PAIRS
        self.sets = np.ones((self.count, mdp.num_actions), np.bool_)
        if mdp.available is not None:
            np.logical_and.at(self.sets, classes, mdp.available)
        if not self.sets.any(axis=1).all():
            states = np.flatnonzero(classes == np.flatnonzero(~self.sets.any(axis=1))[0])
            raise ParameterError(
                f"{mdp}: states {', '.join(map(str, states[:5].tolist()))} look alike, and no action is available in "
                f"all of them; expected an observation that tells their actions apart"
            )

    def bounds(self, optimal: Solution) -> tuple[float, float]:
        """(lower, upper) bound of the value of the best policy at the start."""
        free = np.full(self.count, -1)
        lower, conflict = self.rounded(optimal, free)
        upper = optimal.value_at_start + optimal.error_bound
        order = itertools.count()
        heap = [(-upper, next(order), free, conflict)]
        while heap:
            bound, _, fixed, conflict = heapq.heappop(heap)
            upper = -bound
            if upper <= lower + LOSS_WIDTH:
                return lower, max(lower, upper)
            if conflict < 0 or not self.is_small or time.monotonic() > self.deadline:
                return lower, upper
            for action in np.flatnonzero(self.sets[conflict]):
                child = fixed.copy()
                child[conflict] = action
                solution = value_iteration(self.relaxed(child), LOSS_WIDTH)
                self.solved += 1
                above = min(upper, solution.value_at_start + solution.error_bound)
                if above > lower + LOSS_WIDTH:
                    value, next_conflict = self.rounded(solution, child)
                    lower = max(lower, value)
                    heapq.heappush(heap, (-above, next(order), child, next_conflict))
        return lower, lower + LOSS_WIDTH

    def relaxed(self, fixed: np.ndarray) -> TabularMDP:
        """The MDP in which all actions act as the fixed one in states whose observation has one."""
        mdp, actions = self.mdp, np.arange(self.mdp.num_actions)
        fixed_actions = np.where(self.live, fixed[self.classes], -1)
        executed = np.where(fixed_actions[:, None] < 0, actions, fixed_actions[:, None])
        rows = np.arange(mdp.num_states)[:, None]
        setting: dict[str, Any] = {"gamma": mdp.gamma, "initial": mdp.initial, "horizon": mdp.horizon}
        table = mdp.dynamics.deterministic_table()
        if table is not None and not mdp.is_random:
            rewards = mdp.rewards[rows, executed]
            return TabularMDP.from_arrays(table[rows, executed], rewards, terminal=mdp.terminal, **setting)
        matrix, rewards = self.transitions
        pairs = (rows * mdp.num_actions + executed).ravel()
        part = matrix[pairs]
        return TabularMDP.from_matrices(part, rewards[rows, executed], ends=lacking(part), **setting)

    @cached_property
    def transitions(self) -> tuple[Any, np.ndarray]:
        """Transitions and rewards by chosen action, random actions included: (S A, S) probabilities, (S, A) rewards."""
        mdp, choices = self.mdp, np.eye(self.mdp.num_actions)
        matrix, rewards = mdp.dynamics.matrix()[:, : mdp.num_states], mdp.rewards
        if not mdp.is_random:
            return matrix, rewards
        owner = np.repeat(np.arange(mdp.num_states), mdp.num_actions)
        choices = np.tile(choices, (mdp.num_states, 1))
        mixed = executed_actions(mdp, choices, owner, np.zeros_like(owner)) @ matrix
        weights = mdp.chance.at(owner).weights(choices)
        return mixed, (weights * rewards[owner]).sum(axis=1).reshape(rewards.shape)

    def rounded(self, solution: Solution, fixed: np.ndarray) -> tuple[float, int]:
        """(value at the start of a memoryless policy near the solution, the observation to branch on or -1 for none).

        The policy takes in each observation the action with the largest value over its states, weighted by how much an
        optimal one is there. It is then improved by its own values and visits.
        """
        policy = np.asarray(solution.q).argmax(axis=1)
        visits = self.visits(policy)
        weights = visits + 1e-12 * self.live
        actions = self.best(solution.q, weights, fixed)
        lost = self.lost(solution.q, weights, actions, fixed)
        conflict = int(lost.argmax()) if lost.max() > 0 else -1
        value, policies = -np.inf, set()
        for _ in range(MOST_MEMORYLESS_IMPROVEMENTS):
            evaluated = evaluate_policy(self.mdp, actions[self.classes], LOSS_WIDTH)
            self.solved += 1
            value = max(value, evaluated.value_at_start - evaluated.error_bound)
            policies.add(actions.tobytes())
            if time.monotonic() > self.deadline:
                break
            weights = self.visits(actions[self.classes]) + 1e-3 * weights
            actions = self.best(evaluated.q, weights, np.full(self.count, -1))
            if actions.tobytes() in policies:
                break
        return value, conflict

    def best(self, q: np.ndarray, weights: np.ndarray, fixed: np.ndarray) -> np.ndarray:
        """(C,): for each observation the action with the largest weighted value. Fixed actions stay."""
        actions = np.where(self.sets, self.sums(np.asarray(q), weights), -np.inf).argmax(axis=1)
        return np.where(fixed < 0, actions, fixed)

    def lost(self, q: np.ndarray, weights: np.ndarray, actions: np.ndarray, fixed: np.ndarray) -> np.ndarray:
        """(C,): the weighted value that each observation loses by its one action, 0 if the action is fixed."""
        q = np.asarray(q)
        gaps = q.max(axis=1) - q[np.arange(len(q)), actions[self.classes]]
        lost = np.bincount(self.classes, np.where(self.live, weights * gaps, 0.0), minlength=self.count)
        return np.where((fixed < 0) & self.is_shared & (lost > 0), lost, 0.0)

    def sums(self, q: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(C, A): the sum over the states of each observation of weight times value."""
        weights = np.where(self.live, weights, 0.0)
        q = np.where(np.isfinite(q), q, 0.0)  # of actions that are not available it is -inf
        columns = (np.bincount(self.classes, weights * q[:, a], minlength=self.count) for a in range(q.shape[1]))
        return np.stack(list(columns), axis=1)

    def visits(self, policy: np.ndarray) -> np.ndarray:
        """(S,): how often a policy is in each state after its first steps, discounted."""
        mdp = self.mdp
        mass = np.zeros(mdp.num_states)
        mass[mdp.start_states] = mdp.start_probabilities
        visits, rows = np.zeros(mdp.num_states), np.arange(mdp.num_states)
        for _ in range(min(MOST_STEPS, mdp.horizon or MOST_STEPS)):
            mass[~self.live] = 0.0
            visits += mass
            if mass.sum() < 1e-9 or time.monotonic() > self.deadline:
                break
            executed = np.zeros((mdp.num_states, mdp.num_actions))
            executed[rows, policy] = mass
            mass = mdp.gamma * mdp.dynamics.push_forward(executed)[:, 0]
        return visits
