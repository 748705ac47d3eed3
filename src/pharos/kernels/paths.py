"""States in an order in which each comes before those that it may lead to, and the longest way through them.

transitions: see kernels/outcomes.py; what leads to -1 leads nowhere. live (S,) bool: states whose transitions count.
An order is (S,) states, or None for that of their numbers. Source: Kahn (1962), topological order.
"""

import numpy as np
from numba import njit, types

from pharos.kernels.interpreted import interpreted_first, overload
from pharos.kernels.outcomes import outcome, outcomes_of, size_of


def state_at(order, i):
    """The state at place i."""


@overload(state_at)
def _state_at(order, i):
    if isinstance(order, types.NoneType):
        return lambda order, i: i
    return lambda order, i: order[i]


@interpreted_first()
@njit(cache=True, nogil=True)
def is_increasing(transitions, live, age):
    """(s, a, t) of the first transition of a live state s to a state t whose age (S,) is not larger, or (-1, -1, -1).

    age None: the number of the state.
    """
    num_states, num_actions = size_of(transitions)
    for s in range(num_states):
        if live[s]:
            for a in range(num_actions):
                for k in outcomes_of(transitions, s, a):
                    t, _ = outcome(transitions, s, a, k)
                    if t >= 0 and state_at(age, t) <= state_at(age, s):
                        return s, a, np.int64(t)
    return -1, -1, -1


@interpreted_first()
@njit(cache=True, nogil=True)
def topological_order(transitions, live):
    """The order; where there is a cycle, it lacks the states of the cycle and all that they lead to.

    Cost: two passes over the transitions; 16 bytes a state.
    """
    num_states, num_actions = size_of(transitions)
    waiting = np.zeros(num_states, np.int64)  # edges from states that are not done yet
    for s in range(num_states):
        if live[s]:
            for a in range(num_actions):
                for k in outcomes_of(transitions, s, a):
                    t, _ = outcome(transitions, s, a, k)
                    if t >= 0:
                        waiting[t] += 1
    order = np.empty(num_states, np.int64)
    tail = 0
    for s in range(num_states):
        if waiting[s] == 0:
            order[tail] = s
            tail += 1
    head = 0
    while head < tail:
        s = order[head]
        head += 1
        if not live[s]:
            continue
        for a in range(num_actions):
            for k in outcomes_of(transitions, s, a):
                t, _ = outcome(transitions, s, a, k)
                if t >= 0:
                    waiting[t] -= 1
                    if waiting[t] == 0:
                        order[tail] = t
                        tail += 1
    return order[:tail]


@interpreted_first()
@njit(cache=True, nogil=True)
def longest_path(transitions, live, order):
    """Edges of the longest path of states in such an order. Cost: one pass over the transitions; 4 bytes a state."""
    num_states, num_actions = size_of(transitions)
    length = np.zeros(num_states, np.int32)
    longest = 0
    for i in range(num_states - 1, -1, -1):
        s = state_at(order, i)
        if live[s]:
            edges = 0
            for a in range(num_actions):
                for k in outcomes_of(transitions, s, a):
                    t, _ = outcome(transitions, s, a, k)
                    if t >= 0:
                        edges = max(edges, length[t] + 1)
            length[s] = edges
            longest = max(longest, edges)
    return longest
