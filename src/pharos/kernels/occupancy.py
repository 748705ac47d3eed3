"""Distributions of states under a policy, moved one step forward.

transitions: see kernels/outcomes.py; live (S,) bool: states in which episodes go on; now, after (S, W) float64:
the distribution over states, W = 1, or over pairs (state, previously executed action), W = A; the one of the first step
has W = 1. policy (S, B, A) probabilities, B = 1 or, for policies that look at the previous action, A; weights: (chosen,
previous, uniform), with sets behind, see kernels/bellman.py.
"""

import numpy as np
from numba import types

from pharos.kernels.bellman import set_has, set_size
from pharos.kernels.interpreted import interpreted_first, overload
from pharos.kernels.kernel_cache import inlined, kernel
from pharos.kernels.outcomes import outcome, outcome_numbers, size_of


@inlined
def _mass(now, s):
    """Probability of being in s, whatever the previous action."""
    mass = 0.0
    for b in range(now.shape[1]):
        mass += now[s, b]
    return mass


def mass_as_first(policy, weights, now, s, a):
    """The mass by which a step after an action that is not available, as the first one, executes a more in s."""


@overload(mass_as_first, jit_options={"forceinline": True})
def _mass_as_first(policy, weights, now, s, a):
    if isinstance(weights, types.UniTuple):
        return lambda policy, weights, now, s, a: 0.0

    def in_sets(policy, weights, now, s, a):
        has, size = set_has(weights, s, a), set_size(weights, s, now[s])
        uniform = (1.0 - weights[3] - weights[2]) / size if has else 0.0
        mass = 0.0 if has else -weights[1] * now[s, a]
        for b in range(now.shape[1]):
            if not set_has(weights, s, b):
                p = policy[s, b if policy.shape[1] > 1 else 0, a]
                mass += now[s, b] * ((weights[3] - weights[0]) * p + uniform)
        return mass

    return in_sets


@inlined
def _execute(policy, weights, now, s, mass, executed):
    """executed[a] = the probability of being in s and executing a.

    For all actions at once: a call for each of them costs ten times the arithmetic.
    """
    chosen_weight, previous_weight, uniform_weight = weights[0], weights[1], weights[2]
    uniform_share = uniform_weight * mass / set_size(weights, s, executed)
    for a in range(len(executed)):
        if policy.shape[1] == 1:
            p = mass * policy[s, 0, a]
        else:
            p = 0.0
            for b in range(now.shape[1]):
                p += now[s, b] * policy[s, b, a]
        p = chosen_weight * p + (uniform_share if set_has(weights, s, a) else 0.0)
        if previous_weight > 0.0:
            p += previous_weight * now[s, a] + mass_as_first(policy, weights, now, s, a)
        executed[a] = p


@interpreted_first()
@kernel
def push(transitions, live, policy, weights, now, after):
    """after = the distribution one step later, without mass that has ended. Returns the mass of live states."""
    num_states, num_actions = size_of(transitions)
    after[:] = 0.0
    by_action = after.shape[1] > 1
    executed = np.empty(num_actions)
    for s in range(num_states):
        if not live[s]:
            continue
        mass = _mass(now, s)
        if mass == 0.0:
            continue
        # split the mass of s by executed actions, then by their outcomes
        _execute(policy, weights, now, s, mass, executed)
        for a in range(num_actions):
            for i in outcome_numbers(transitions, s, a):
                t, p = outcome(transitions, s, a, i)
                if t >= 0:
                    after[t, a if by_action else 0] += p * executed[a]
    # the mass that goes on
    total = 0.0
    for s in range(num_states):
        if live[s]:
            for b in range(after.shape[1]):
                total += after[s, b]
    return total


@interpreted_first()
@kernel
def count_visits(transitions, live, policy, weights, gamma, least, waiting, visits):
    """Count the mass that waits in each state as a visit, and move it on, from the first state to the last, in place.

    waiting (S, W): discounted mass that has come and has not moved on. visits (S, W): sum over t of gamma^t P(s_t = s),
    of the mass that has moved on. Masses below `least` stay. Returns the mass that waits in the end.
    """
    num_states, num_actions = size_of(transitions)
    by_action = waiting.shape[1] > 1
    leaving = np.empty(num_actions)
    for s in range(num_states):
        mass = 0.0
        for b in range(waiting.shape[1]):
            mass += waiting[s, b]
        if mass < least or not live[s]:
            continue
        # the mass of s becomes visits, and waits, discounted, in the next states
        _execute(policy, weights, waiting, s, mass, leaving)
        for b in range(waiting.shape[1]):
            visits[s, b] += waiting[s, b]
        waiting[s] = 0.0
        for a in range(num_actions):
            for i in outcome_numbers(transitions, s, a):
                t, p = outcome(transitions, s, a, i)
                if t >= 0 and live[t]:
                    waiting[t, a if by_action else 0] += p * (gamma * leaving[a])
    total = 0.0
    for s in range(num_states):
        for b in range(waiting.shape[1]):
            total += waiting[s, b]
    return total


@kernel
def support(transitions, live, policy, weights, reachable):
    """Add to `reachable` (S, W), 1 or 0, all pairs that episodes from its pairs may come to under the policy."""
    num_actions = size_of(transitions)[1]
    width = reachable.shape[1]
    by_action = width > 1
    alone = np.zeros_like(reachable)  # a row is 1 at one index while its node is looked at
    nodes = np.flatnonzero(reachable.reshape(-1) > 0.0)
    stack = np.empty(reachable.size, np.int64)
    stack[: len(nodes)] = nodes
    top = len(nodes)
    executed = np.empty(num_actions)
    # depth-first search: successors by all actions that may be executed in the pair (s, b)
    while top > 0:
        top -= 1
        s, b = divmod(stack[top], width)
        if not live[s]:
            continue
        alone[s, b] = 1.0
        _execute(policy, weights, alone, s, 1.0, executed)
        for a in range(num_actions):
            if executed[a] <= 0.0:
                continue
            c = a if by_action else 0
            for i in outcome_numbers(transitions, s, a):
                t, _ = outcome(transitions, s, a, i)
                if t >= 0 and live[t] and reachable[t, c] == 0.0:
                    reachable[t, c] = 1.0
                    stack[top] = t * width + c
                    top += 1
        alone[s, b] = 0.0


@kernel
def record(live, policy, weights, now, scale, total, largest):
    """total[s, a] += scale p, largest[s, a] = max(largest[s, a], p), p the probability of s and a by `weights`."""
    executed = np.empty(total.shape[1])
    for s in range(len(total)):
        if not live[s]:
            continue
        mass = _mass(now, s)
        if mass == 0.0:
            continue
        _execute(policy, weights, now, s, mass, executed)
        for a in range(total.shape[1]):
            p = executed[a]
            total[s, a] += scale * p
            largest[s, a] = max(largest[s, a], p)
