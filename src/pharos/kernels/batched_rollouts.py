"""Proximal policy optimisation of W runs at once: advantages, minibatches, the clipped loss with its gradients.

Sources: Schulman et al. (2016), generalised advantages; Schulman et al. (2017). Each function does for every run what
Stable-Baselines3 does for one.
"""

import numpy as np
from numba import float32, njit

from pharos.kernels.batched_worlds import SHUFFLE
from pharos.kernels.philox import below, philox


@njit(cache=True, nogil=True)
def advantages(rewards, values, begins, last_values, ends, gammas, lambdas, out):
    """out (W, T, E) = generalised advantages of rollouts of T steps.

    rewards, values, begins (W, T, E) float32: begins is 1 where a step is the first of an episode; last_values (W, E)
    of the states after the rollout, ends (W, E) whether the last step ended an episode; gammas, lambdas (W,).
    """
    num_steps, copies = rewards.shape[1], rewards.shape[2]
    for i in range(rewards.shape[0]):
        gamma, both = float32(gammas[i]), float32(gammas[i] * lambdas[i])
        for e in range(copies):
            advantage = float32(0.0)
            goes_on, following = float32(0.0 if ends[i, e] else 1.0), last_values[i, e]
            for t in range(num_steps - 1, -1, -1):
                delta = rewards[i, t, e] + gamma * following * goes_on - values[i, t, e]
                advantage = delta + both * goes_on * advantage
                out[i, t, e] = advantage
                goes_on, following = float32(1.0) - begins[i, t, e], values[i, t, e]


@njit(cache=True, nogil=True)
def shuffle(keys, step, draw, order):
    """order (W, M) = a permutation of 0 .. M-1 for each run (Fisher and Yates)."""
    number = order.shape[1]
    for i in range(order.shape[0]):
        for j in range(number):
            order[i, j] = j
        for j in range(number - 1, 0, -1):
            other = below(philox(j, draw, step, SHUFFLE, keys[i])[0], j + 1)
            order[i, j], order[i, other] = order[i, other], order[i, j]


@njit(cache=True, nogil=True)
def gather(order, first, sources, targets):
    """targets (W, B) of five arrays = the entries order[:, first : first + B] of sources (W, M).

    The arrays: states, or histories with one more axis, actions, logarithms of probabilities, advantages, returns.
    """
    for i in range(targets[0].shape[0]):
        for b in range(targets[0].shape[1]):
            at = order[i, first + b]
            targets[0][i, b] = sources[0][i, at]
            targets[1][i, b] = sources[1][i, at]
            targets[2][i, b] = sources[2][i, at]
            targets[3][i, b] = sources[3][i, at]
            targets[4][i, b] = sources[4][i, at]


@njit(cache=True, nogil=True)
def normalize(advantages):
    """Each run's (W, B) less its mean, by its standard deviation + 1e-8; B >= 2."""
    number = advantages.shape[1]
    for i in range(advantages.shape[0]):
        mean, squares = 0.0, 0.0
        for b in range(number):
            mean += advantages[i, b]
        mean /= number
        for b in range(number):
            squares += (advantages[i, b] - mean) ** 2
        scale = np.sqrt(squares / (number - 1)) + 1e-8
        for b in range(number):
            advantages[i, b] = (advantages[i, b] - mean) / scale


@njit(cache=True, nogil=True)
def clipped_loss(scores, values, minibatch, clip_ranges, entropy_weights, value_weights, dscores, dvalues, loss, kl):
    """The loss of PPO (W,), its gradients, and the approximate divergence from the old policy (W,).

    scores (W, B, A), values (W, B, 1) float32; dscores and dvalues alike.
    minibatch: (actions, old logarithms of probabilities, advantages, returns), (W, B) each.
    """
    actions, old, advantage, returns = minibatch
    number, num_actions = scores.shape[1], scores.shape[2]
    log_p = np.empty(num_actions)
    for i in range(scores.shape[0]):
        total, divergence = 0.0, 0.0
        low, high = 1.0 - clip_ranges[i], 1.0 + clip_ranges[i]
        for b in range(number):
            best, mass = scores[i, b].max(), 0.0
            for a in range(num_actions):
                log_p[a] = scores[i, b, a] - best
                mass += np.exp(log_p[a])
            mass, entropy = np.log(mass), 0.0
            for a in range(num_actions):
                log_p[a] -= mass
                entropy -= np.exp(log_p[a]) * log_p[a]
            gained = log_p[actions[i, b]] - old[i, b]
            ratio = np.exp(gained)
            divergence += (ratio - 1.0) - gained
            free = advantage[i, b] * ratio
            bound = advantage[i, b] * min(max(ratio, low), high)
            error = values[i, b, 0] - returns[i, b]
            total += -min(free, bound) - entropy_weights[i] * entropy + value_weights[i] * error * error
            of_log_p = -free / number if free <= bound else 0.0
            dvalues[i, b, 0] = value_weights[i] * 2.0 * error / number
            for a in range(num_actions):
                p = np.exp(log_p[a])
                of_entropy = entropy_weights[i] * p * (log_p[a] + entropy) / number
                dscores[i, b, a] = of_log_p * ((1.0 if a == actions[i, b] else 0.0) - p) + of_entropy
        loss[i], kl[i] = total / number, divergence / number
