"""Losses of a policy state by state, which sum to its regret."""

import numpy as np

from pharos.solvers import Solution


def state_losses(optimal: Solution, visits: np.ndarray, first: np.ndarray | None = None) -> np.ndarray:
    """Return what a policy loses in each state. The sum over states is V* minus the value of the policy at the start.

        loss(s) = chosen * sum over a of visits(s, a) gap(s, a),   gap(s, a) = max over b of q(s, b) - q(s, a)

    where q is the optimal value of executing an action, and `chosen` the probability that a chosen action is executed.

    Args:
        optimal: of the MDP, without a horizon.
        visits: (S, A) discounted visits of a state in which the policy chooses an action, as `hardness.occupancy` has.
        first: (N, A) probabilities of each choice on the first step in `mdp.start_states`, for sticky actions alone:
            there is no previous action then, so a chosen one is executed with another probability.
    Returns:
        (S,) float64, at least 0, in units of return, within the errors of `optimal` and `visits`.
    Cost: O(S A).
    Source: the performance difference lemma, Kakade and Langford (2002), Approximately optimal approximate
        reinforcement learning, lemma 6.1.
    """
    mdp = optimal.mdp
    states = np.flatnonzero(visits.any(axis=1))
    losses = np.zeros(mdp.num_states)
    losses[states] = mdp.chance.chosen * (visits[states] * _gaps(optimal, states)).sum(axis=1)
    if first is not None:
        is_start = mdp.start_probabilities > 0
        starts, weights = mdp.start_states[is_start], mdp.start_probabilities[is_start]
        more = (mdp.chance.first_chosen - mdp.chance.chosen) * first[is_start] * _gaps(optimal, starts)
        np.add.at(losses, starts, weights * more.sum(axis=1) * ~mdp.terminal[starts])
    return losses


def _gaps(optimal: Solution, states: np.ndarray) -> np.ndarray:
    """(N, A) gaps of executing each action in some states."""
    q = optimal.q_of(states)
    return q.max(axis=1, keepdims=True) - q
