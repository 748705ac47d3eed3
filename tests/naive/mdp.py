"""MDPs written out in full, and solved by linear algebra: the slow twin of pharos.mdp and pharos.solvers."""

import itertools
from dataclasses import replace

import numpy as np

from pharos.mdp import Lazy, OutcomeTable


def augmented(mdp):
    """The MDP as explicit matrices (P, R, start), over its own states with every kind of chance written out.

    States are pairs (s, b): b is the previously executed action, or A for none. P[(s, b), a, (t, x)], R[(s, b), a].
    A pair has index s (A + 1) + b; one more state, the last, is the end.
    """
    num_states, num_actions = mdp.num_states, mdp.num_actions
    size = num_states * (num_actions + 1) + 1
    P = np.zeros((size, num_actions, size))
    R = np.zeros((size, num_actions))
    P[-1, :, -1] = 1
    for s, b, a in itertools.product(range(num_states), range(num_actions + 1), range(num_actions)):
        i = s * (num_actions + 1) + b
        for x, p in enumerate(executed(mdp, b)[a]):
            R[i, a] += p * mdp.rewards[s, x]
            for t, probability in outcomes(mdp, s, x):
                j = size - 1 if t < 0 else t * (num_actions + 1) + x
                P[i, a, j] += p * probability
    start = np.zeros(size)
    start[mdp.start_states * (num_actions + 1) + num_actions] = mdp.start_probabilities
    return P, R, start


def executed(mdp, b):
    """(A chosen, A executed) probabilities where b was executed before, or nothing, where it is A."""
    A, chance = mdp.num_actions, mdp.chance
    if b == A:
        return np.eye(A) * chance.first_chosen + (1 - chance.first_chosen) / A
    joint = np.eye(A) * chance.chosen + chance.uniform / A
    joint[:, b] += chance.previous
    return joint


def is_over(mdp):
    """(N,) whether an episode has ended at a node of `augmented`: terminal states and the end."""
    return np.append(np.repeat(np.asarray(mdp.terminal), mdp.num_actions + 1), True)


def absorbing(mdp):
    """The same as `augmented`, where terminal states and the end are never left and pay nothing."""
    P, R, start = augmented(mdp)
    for n in np.flatnonzero(is_over(mdp)):
        P[n], R[n] = np.eye(len(P))[n], 0.0
    return P, R, start


def matrix_of(mdp):
    """(S, A, S) the probability of each next state; what a row lacks to 1 ends the episode."""
    P = np.zeros((mdp.num_states, mdp.num_actions, mdp.num_states))
    for s, a in np.ndindex(P.shape[:2]):
        for t, p in outcomes(mdp, s, a):
            if t >= 0:
                P[s, a, t] += p
    return P


def outcomes(mdp, s, x):
    """[(next state or -1, probability)] of executing x in s."""
    if isinstance(mdp.dynamics, Lazy):
        p = mdp.dynamics.laziness
        moves = outcomes(replace(mdp, dynamics=mdp.dynamics.tables), s, x)
        return [(s, p), *((t, (1 - p) * probability) for t, probability in moves)]
    if isinstance(mdp.dynamics, OutcomeTable):
        return listed(mdp.dynamics, s, x)
    if mdp.transitions is None:
        return [(int(mdp.next_states[s, x]), 1.0)]
    row = mdp.transitions[s * mdp.num_actions + x].toarray().ravel()
    return [(-1, 1 - row.sum()), *((t, row[t]) for t in np.flatnonzero(row))]


def listed(dynamics, s, x):
    """The same of an OutcomeTable, entry by entry; what leads to the same state stays apart."""
    row, k = s * dynamics.num_actions + x, dynamics.num_outcomes
    first, last = (row * k, (row + 1) * k) if dynamics.offsets is None else dynamics.offsets[row : row + 2]
    states = dynamics.successors.ravel()[first:last]
    if dynamics.palette is None:
        weights = dynamics.probabilities.ravel()[first:last]
    else:
        weights = dynamics.palette[dynamics.codes[s, x]][: last - first]
    return [(int(t), float(p)) for t, p in zip(states, weights, strict=True) if p > 0]


def values_of(P, R, gamma, policy):
    """Values of a policy (N, A) by one linear solve."""
    chain = np.einsum("ia,iaj->ij", policy, P)
    return np.linalg.solve(np.eye(len(P)) - gamma * chain, (policy * R).sum(axis=1))


def optimal_values(P, R, gamma, sign=1):
    """Optimal (or worst) values by policy iteration."""
    policy = np.zeros(len(P), int)
    for _ in range(1000):
        v = values_of(P, R, gamma, np.eye(P.shape[1])[policy])
        q = R + gamma * P @ v
        better = np.argmax(sign * q, axis=1)
        improved = sign * (q[np.arange(len(q)), better] - q[np.arange(len(q)), policy]) > 1e-12
        if not improved.any():
            return v
        policy = np.where(improved, better, policy)
    raise AssertionError("policy iteration did not settle")


def finite_values(P, R, gamma, horizon, sign=1):
    """Optimal (or worst) values with `horizon` steps to go."""
    v = np.zeros(len(P))
    for _ in range(horizon):
        v = sign * (sign * (R + gamma * P @ v)).max(axis=1)
    return v


def by_state(mdp, v):
    """Values of the pairs as (S, A + 1); the last column: no previous action."""
    return v[:-1].reshape(mdp.num_states, mdp.num_actions + 1)
