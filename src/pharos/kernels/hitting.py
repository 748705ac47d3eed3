"""Least expected hitting times on explicit choices: nodes, A actions each, row n A + a of a sparse matrix (first, node, weight).

hardness/_stochastic_diameter.py says what is computed and why the bounds hold. `goal` (N,) bool marks the nodes of the target.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def backward_order(first, previous, goal, order, distance):
    """Nodes by their distance to the goal on the reversed graph: distance (N,), -1 where there is no path; returns how many."""
    distance[:] = -1
    tail = 0
    for n in range(len(goal)):
        if goal[n]:
            distance[n] = 0
            order[tail] = n
            tail += 1
    head = 0
    while head < tail:
        n = order[head]
        head += 1
        for i in range(first[n], first[n + 1]):
            m = previous[i]
            if distance[m] < 0:
                distance[m] = distance[n] + 1
                order[tail] = m
                tail += 1
    return tail


@njit(cache=True, nogil=True)
def sweep_in_place(rows, common, goal, order, count, j):
    """j(n) = 1 + min_a sum p j, in place in the order given; the largest change. j is 0 at the goal.

    What all actions of a node have in common is in its row of `common`, the rest in `rows` of each action.
    """
    first, node, weight = rows
    always, always_node, always_weight = common
    num_actions = (len(first) - 1) // len(goal)
    change = 0.0
    for i in range(count):
        n = order[i]
        if goal[n]:
            continue
        best = np.inf
        for row in range(n * num_actions, (n + 1) * num_actions):
            total = 0.0
            for k in range(first[row], first[row + 1]):
                total += weight[k] * j[node[k]]
            best = min(best, total)
        best += 1.0
        for k in range(always[n], always[n + 1]):
            best += always_weight[k] * j[always_node[k]]
        change = max(change, abs(best - j[n]))
        j[n] = best
    return change


@njit(cache=True, nogil=True)
def residuals(rows, common, goal, order, count, j, policy):
    """(largest T j - j, largest j - T j, largest j) over nodes that are not the goal; policy[n] = the action that attains T j."""
    first, node, weight = rows
    always, always_node, always_weight = common
    num_actions = (len(first) - 1) // len(goal)
    above, below, largest = 0.0, 0.0, 0.0
    for i in range(count):
        n = order[i]
        if goal[n]:
            continue
        best, choice = np.inf, 0
        for a in range(num_actions):
            row = n * num_actions + a
            total = 0.0
            for k in range(first[row], first[row + 1]):
                total += weight[k] * j[node[k]]
            if total < best:
                best, choice = total, a
        best += 1.0
        for k in range(always[n], always[n + 1]):
            best += always_weight[k] * j[always_node[k]]
        policy[n] = choice
        above = max(above, best - j[n])
        below = max(below, j[n] - best)
        largest = max(largest, j[n])
    return above, below, largest


@njit(cache=True, nogil=True)
def almost_surely(first, node, num_actions, goal, sure, found):
    """sure[n]: some policy leads from n to the goal with probability 1. A greatest fixed point over least ones (de Alfaro 1999)."""
    size = len(goal)
    sure[:] = True
    while True:
        found[:] = goal
        grew = True
        while grew:
            grew = False
            for n in range(size):
                if found[n] or not sure[n]:
                    continue
                for a in range(num_actions):
                    row = n * num_actions + a
                    stays, hits = True, False
                    for i in range(first[row], first[row + 1]):
                        m = node[i]
                        stays = stays and sure[m]
                        hits = hits or found[m]
                    if stays and hits:
                        found[n] = True
                        grew = True
                        break
        same = True
        for n in range(size):
            if sure[n] != found[n]:
                same = False
            sure[n] = found[n]
        if same:
            return
