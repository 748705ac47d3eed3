"""Backward passes for the effective horizons of deterministic MDPs, and tail bounds of means, for GORP.

next_states (S, A), -1 if the episode ends. rewards (S, A) float64. An episode that has ended is worth 0.

Tails bound the probability that each of several means of m samples is the largest, from bounds on their tails. Each
distribution is cut into 100 parts of equal probability. `low` and `high` enclose the part. For N rows of n means:
lower[i, a] = sum over parts of 1/100 prod over b != a of P(mean b < low), upper the same with P(mean b <= high).
"""

import math

import numpy as np
from numba import prange

from pharos.kernels.interpreted import interpreted_first
from pharos.kernels.kernel_cache import kernel


@kernel(parallel=True)
def step_values(next_states, rewards, tie, best, worst, explored, best_now, worst_now, explored_now, optimal, variance):
    """One step backwards: the values of optimal, worst and uniform play, and two inputs of the simple bound.

    best, worst, explored (S,): of the step after. *_now (S,): of this step. optimal (S,) unsigned: bit a where Q*(s, a)
    is within `tie` of the best. variance (S,): max over a of (Q^e - Q^w) (Q* - Q^w).
    """
    num_actions = next_states.shape[1]
    for s in prange(len(next_states)):
        # backups of all three, and the variance
        high, low, total = -math.inf, math.inf, 0.0
        spread = 0.0
        for a in range(num_actions):
            t, r = next_states[s, a], rewards[s, a]
            b = r + (best[t] if t >= 0 else 0.0)
            w = r + (worst[t] if t >= 0 else 0.0)
            e = r + (explored[t] if t >= 0 else 0.0)
            high, low = max(high, b), min(low, w)
            total = e if a == 0 else total + e
            product = (e - w) * (b - w)
            if a == 0 or product > spread:
                spread = product
        # actions that are optimal up to ties
        mask = np.uint64(0)
        for a in range(num_actions):
            t = next_states[s, a]
            if rewards[s, a] + (best[t] if t >= 0 else 0.0) >= high - tie:
                mask |= np.uint64(1) << np.uint64(a)
        best_now[s], worst_now[s] = high, low
        explored_now[s] = min(max(total / num_actions, low), high)
        optimal[s] = mask
        variance[s] = spread


@interpreted_first()
@kernel(parallel=True)
def lookahead(next_states, rewards, gamma, after, now):
    """now (S,) = max over a of r(s, a) + gamma after(next state)."""
    for s in prange(len(next_states)):
        high = -math.inf
        for a in range(next_states.shape[1]):
            t = next_states[s, a]
            high = max(high, rewards[s, a] + (gamma * after[t] if t >= 0 else 0.0))
        now[s] = high


@interpreted_first()
@kernel(parallel=True)
def largest_after(next_states, after, now):
    """now (S,) = max over a of after(next state), at least 0."""
    for s in prange(len(next_states)):
        high = 0.0
        for a in range(next_states.shape[1]):
            t = next_states[s, a]
            if t >= 0:
                high = max(high, after[t])
        now[s] = high


@kernel(parallel=True)
def greedy_return(next_states, rewards, after, policy_value, now):
    """now (S,) = min over the actions greedy in r + after(next state) of r + policy_value(next state)."""
    for s in prange(len(next_states)):
        high, low = -math.inf, math.inf
        for a in range(next_states.shape[1]):
            t, r = next_states[s, a], rewards[s, a]
            q = r + (after[t] if t >= 0 else 0.0)
            if q >= high:
                value = r + (policy_value[t] if t >= 0 else 0.0)
                low = min(low, value) if q == high else value
                high = q
        now[s] = low


@kernel
def step_along(next_states, rewards, after, optimal, variance, log, near, nodes, n, next_nodes, is_visited, hardest):
    """Go one step on from nodes[:n] along greedy actions (`near` False), or all that are better than any not optimal.

    after (S,): Q(s, a) = r(s, a) + after(next state). is_visited (S,) bool, all False before and after. hardest
    (3,): 16 variance log / gap^2 of the node that has the largest, the first among equals, and its gap and variance.
    Returns how many states `next_nodes` holds, -1 if an action that is not optimal may be taken.
    """
    num_actions = next_states.shape[1]
    count, at, fails = 0, -1, False
    hardest[:] = 0.0
    for i in range(n):
        s = nodes[i]
        # the best action, and the best of those that are not optimal
        top, second = -math.inf, -math.inf
        for a in range(num_actions):
            t = next_states[s, a]
            q = rewards[s, a] + (after[t] if t >= 0 else 0.0)
            top = max(top, q)
            if not (optimal[s] >> a) & 1:
                second = max(second, q)
        if second == top:
            fails = True
            break
        # the samples that this gap needs; keep the node that needs most
        gap = top - second
        needed = 0.0 if second == -math.inf else 16 * variance[s] / gap**2 * log
        if at < 0 or needed > hardest[0] or (needed == hardest[0] and s < at):
            hardest[0], hardest[1], hardest[2] = needed, gap, variance[s]
            at = s
        # next states by the actions that are taken
        for a in range(num_actions):
            t = next_states[s, a]
            if t < 0 or is_visited[t]:
                continue
            q = rewards[s, a] + after[t]
            if q > second if near else q == top:
                is_visited[t] = True
                next_nodes[count] = t
                count += 1
    # reset the marks
    for j in range(count):
        is_visited[next_nodes[j]] = False
    return -1 if fails else count


# Tails ----------------------------------------------------------------------------------------------------------------


MASS_PARTS = 100


@kernel
def _below(distance, m, width, variance):
    """Upper bound on P(mean <= expectation - distance) (Bernstein's inequality)."""
    if distance <= 0:
        return 1.0
    if distance == math.inf or variance + width * distance == 0:
        return 0.0
    return math.exp(-(distance**2) * m / 2 / (variance + width * distance / 3))


@kernel
def _quantile(probability, m, width, variance):
    """The distance beyond which Bernstein's inequality leaves no more than this probability."""
    if width == 0 or variance == 0:
        return 0.0
    if probability <= 0:
        return math.inf
    bits = -math.log(probability)
    return (width * bits / m + math.sqrt(18 * variance / m * bits + (width * bits / m) ** 2)) / 3


@kernel
def bernstein(means, widths, m, lower, upper):
    """Tail bounds for means of samples in intervals of length `widths` (N, n). Writes lower and upper (N, n).

    The variance of a sample is at most (best - mean) (mean - worst), which is in `upper` before.
    """
    n = means.shape[1]
    variances = np.empty(n)
    for row in range(len(means)):
        variances[:] = upper[row]
        lower[row] = 0.0
        upper[row] = 0.0
        for a in range(n):
            for part in range(MASS_PARTS):
                # the part of mean a, and the chance of each other mean to be below it
                high = means[row, a] + _quantile(1 - (part + 1) / MASS_PARTS, m, widths[row, a], variances[a])
                low = means[row, a] - _quantile(part / MASS_PARTS, m, widths[row, a], variances[a])
                least = most = 1 / MASS_PARTS
                for b in range(n):
                    if b != a:
                        most *= _below(means[row, b] - high, m, widths[row, b], variances[b])
                        least *= 1 - _below(low - means[row, b], m, widths[row, b], variances[b])
                lower[row, a] += least
                upper[row, a] += most
