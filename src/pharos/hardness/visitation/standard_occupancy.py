"""Where measures of representations look: half the visits of uniform play, half those of optimal play."""

from dataclasses import dataclass

import numpy as np

from pharos.hardness.visitation.occupancy import occupancy
from pharos.mdp import TabularMDP
from pharos.solvers import value_iteration


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
