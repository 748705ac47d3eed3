"""Distances of a graph by sweeps over its table in order: no queue, no reversed copy. Arguments: see graph.py.

distance (N,) holds 0 at the source and `far`, the largest number of its type, elsewhere, and upper bounds from then on;
they are the distances once a sweep changes nothing, as none can be lowered along an edge then. Breadth-first search
numbers a state before those that it leads to, so that most ways are followed in one sweep.
"""

from numba import njit


@njit(cache=True, nogil=True)
def lower_backward(next_states, ends, start, distance, far, first, stop):
    """distance[u] = min(distance[u], 1 + the least distance of its successors), for rows [first, stop), last one first.

    Returns how many it lowered; -1 where a distance reaches `far`.
    """
    num_states, num_actions = next_states.shape
    lowered = 0
    for u in range(stop - 1, first - 1, -1):
        least = far
        if ends[u]:
            if start >= 0:
                least = distance[start]
        else:
            for a in range(num_actions):
                v = next_states[u, a]
                least = min(least, distance[num_states if v < 0 else v])
        if least + 1 < distance[u]:
            distance[u] = least + 1
            lowered += 1
        elif least + 1 == far and distance[u] == far:
            return -1
    return lowered


@njit(cache=True, nogil=True)
def lower_forward(next_states, ends, start, distance, far, first, stop):
    """distance[v] = min(distance[v], distance[u] + 1) for the successors v of rows u in [first, stop), first one first.

    Returns how many it lowered; -1 where a distance reaches `far`.
    """
    num_states, num_actions = next_states.shape
    lowered = 0
    for u in range(first, stop):
        d = distance[u] + 1
        if d > far or (ends[u] and start < 0):
            continue
        for a in range(1 if ends[u] else num_actions):
            v = start if ends[u] else next_states[u, a]
            v = num_states if v < 0 else v
            if d < distance[v]:
                distance[v] = d
                lowered += 1
            elif d == far and distance[v] == far:
                return -1
    return lowered


@njit(cache=True, nogil=True)
def summary(distance, far):
    """(Nodes found, largest distance among them, their sum)."""
    reach, largest, total = 0, 0, 0
    for v in range(len(distance)):
        d = distance[v]
        if d < far:
            reach += 1
            total += d
            largest = max(largest, d)
    return reach, largest, total
