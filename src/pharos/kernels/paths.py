"""The longest way through a graph without cycles, by topological order. Source: Kahn (1962)."""

import numpy as np
from numba import njit

from pharos.kernels.outcomes import outcome, outcomes_of, size_of


@njit(cache=True, nogil=True)
def longest_path_of_table(transitions, live):
    """Edges of the longest path through transitions (see kernels/outcomes.py) from live (S,) states alone.

    Returns -1 where there is a cycle.

    Cost: two passes over the table; 24 bytes a state.
    """
    num_states, num_actions = size_of(transitions)
    waiting = np.zeros(num_states, np.int64)  # edges from states that are not done yet
    for s in range(num_states):
        if live[s]:
            for a in range(num_actions):
                for i in outcomes_of(transitions, s, a):
                    t, _ = outcome(transitions, s, a, i)
                    if t >= 0:
                        waiting[t] += 1
    length = np.zeros(num_states, np.int64)
    queue = np.empty(num_states, np.int64)
    tail = 0
    for s in range(num_states):
        if waiting[s] == 0:
            queue[tail] = s
            tail += 1
    head, longest = 0, 0
    while head < tail:
        s = queue[head]
        head += 1
        longest = max(longest, length[s])
        if not live[s]:
            continue
        for a in range(num_actions):
            for i in outcomes_of(transitions, s, a):
                t, _ = outcome(transitions, s, a, i)
                if t >= 0:
                    length[t] = max(length[t], length[s] + 1)
                    waiting[t] -= 1
                    if waiting[t] == 0:
                        queue[tail] = t
                        tail += 1
    return longest if tail == num_states else -1


@njit(cache=True, nogil=True)
def longest_path(first, following, num_states):
    """As `longest_path_of_table`: the successors of s are following[first[s] : first[s + 1]].

    Entries of num_states and more lead to nothing.
    """
    waiting = np.zeros(num_states, np.int64)
    for i in range(len(following)):
        if following[i] < num_states:
            waiting[following[i]] += 1
    length = np.zeros(num_states, np.int64)
    queue = np.empty(num_states, np.int64)
    tail = 0
    for s in range(num_states):
        if waiting[s] == 0:
            queue[tail] = s
            tail += 1
    head, longest = 0, 0
    while head < tail:
        s = queue[head]
        head += 1
        longest = max(longest, length[s])
        for i in range(first[s], first[s + 1]):
            t = following[i]
            if t < num_states:
                length[t] = max(length[t], length[s] + 1)
                waiting[t] -= 1
                if waiting[t] == 0:
                    queue[tail] = t
                    tail += 1
    return longest if tail == num_states else -1
