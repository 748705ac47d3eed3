"""Least expected hitting times on explicit choices: nodes, A actions each, row n A + a of a sparse matrix (first, node,
weight).

hardness/hitting/hitting_times.py says what is computed and why the bounds hold.
`goal` (N,) bool marks the nodes of the target,
`alike` (N,) bool nodes that all have the same rows, such as those in which episodes end: what holds for the first of
them is not worked out again for the others.
"""

import numpy as np
from numba import njit

# Half the distance from 1 to the next float: the relative rounding error of one operation.
UNIT = 2.0**-53


@njit(cache=True, nogil=True)
def backward_order(first, previous, goal, order, distance):
    """Nodes by their distance to the goal on the reversed graph: distance (N,), -1 where there is no path; returns how
    many."""
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
def sweep_in_place(rows, common, alike, goal, order, count, j):
    """j(n) = 1 + min_a sum p j, in place in the order given; the largest change. j is 0 at the goal.

    What all actions of a node have in common is in its row of `common`, the rest in `rows` of each action.
    """
    first, node, weight = rows
    always, always_node, always_weight = common
    num_actions = (len(first) - 1) // len(goal)
    change, of_alike = 0.0, -1.0
    for i in range(count):
        n = order[i]
        if goal[n]:
            continue
        if alike[n] and of_alike >= 0:
            change = max(change, abs(of_alike - j[n]))
            j[n] = of_alike
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
        if alike[n]:
            of_alike = best
    return change


@njit(cache=True, nogil=True)
def sweep_with_mode(rows, common, alike, goal, order, count, j, mode):
    """As `sweep_in_place`, and mode(n) = sum p mode under the actions that are best for j, in place as well.

    Returns (largest change of j, sum f f, sum f g, sum g g): f, what j has gained, g, what mode has lost in the sweep.
    """
    first, node, weight = rows
    always, always_node, always_weight = common
    num_actions = (len(first) - 1) // len(goal)
    change, of_alike, mode_of_alike = 0.0, -1.0, 0.0
    ff, fg, gg = 0.0, 0.0, 0.0
    for i in range(count):
        n = order[i]
        if goal[n]:
            continue
        if alike[n] and of_alike >= 0:
            change = max(change, abs(of_alike - j[n]))
            j[n], mode[n] = of_alike, mode_of_alike
            continue
        best, choice = np.inf, n * num_actions
        for row in range(n * num_actions, (n + 1) * num_actions):
            total = 0.0
            for k in range(first[row], first[row + 1]):
                total += weight[k] * j[node[k]]
            if total < best:
                best, choice = total, row
        best += 1.0
        left = 0.0
        for k in range(first[choice], first[choice + 1]):
            left += weight[k] * mode[node[k]]
        for k in range(always[n], always[n + 1]):
            best += always_weight[k] * j[always_node[k]]
            left += always_weight[k] * mode[always_node[k]]
        f, g = best - j[n], mode[n] - left
        change = max(change, abs(f))
        ff += f * f
        fg += f * g
        gg += g * g
        j[n], mode[n] = best, left
        if alike[n]:
            of_alike, mode_of_alike = best, left
    return change, ff, fg, gg


@njit(cache=True, nogil=True)
def residuals(rows, common, alike, goal, order, count, j, policy):
    """(bound of T j - j, bound of j - T j, largest j) over nodes that are not the goal; policy[n] = the action that
    attains T j.

    T j(n) - j(n) = 1 + min_a sum_m p(m | n, a) (j(m) - j(n)): written with differences, no rounding error grows with j
    itself.
    Both bounds count all rounding: `operations` says how many units in the last place one sum may be off.
    """
    first, node, weight = rows
    always, always_node, always_weight = common
    num_actions = (len(first) - 1) // len(goal)
    above, below, largest, first_alike = 0.0, 0.0, 0.0, -1
    for i in range(count):
        n = order[i]
        if goal[n]:
            continue
        here = j[n]
        if alike[n]:
            if first_alike >= 0 and here == j[first_alike]:
                policy[n] = policy[first_alike]
                continue
            first_alike = n
        shared, size = 0.0, 1.0
        for k in range(always[n], always[n + 1]):
            step = always_weight[k] * (j[always_node[k]] - here)
            shared += step
            size += abs(step)
        shared += 1.0
        best, least, most, choice = np.inf, np.inf, np.inf, 0
        for a in range(num_actions):
            row = n * num_actions + a
            total, own = 0.0, size
            for k in range(first[row], first[row + 1]):
                step = weight[k] * (j[node[k]] - here)
                total += step
                own += abs(step)
            error = operations(num_actions, first[row + 1] - first[row] + always[n + 1] - always[n]) * UNIT * own
            total += shared
            least, most = min(least, total - error), min(most, total + error)
            if total < best:
                best, choice = total, a
        policy[n] = choice
        above = max(above, most)
        below = max(below, -least)
        largest = max(largest, here)
    return above, below, largest


@njit(cache=True, nogil=True)
def residuals_of_pairs(rows, common, alike, goal, order, count, high, low, policy, residual, error):
    """As `residuals`, for j = high + low: two floats a node, so that j may be 1e16 times its differences.

    residual, error (N,): T j - j, and by how much it may be off. The error of a difference of two such numbers is a
    unit of the difference and eight units of a unit of the numbers.
    """
    first, node, weight = rows
    always, always_node, always_weight = common
    num_actions = (len(first) - 1) // len(goal)
    above, below, first_alike = 0.0, 0.0, -1
    for i in range(count):
        n = order[i]
        if goal[n]:
            continue
        if alike[n]:
            if first_alike >= 0 and high[n] == high[first_alike] and low[n] == low[first_alike]:
                policy[n], residual[n], error[n] = policy[first_alike], residual[first_alike], error[first_alike]
                continue
            first_alike = n
        shared, size, scale = 0.0, 1.0, 0.0
        for k in range(always[n], always[n + 1]):
            m = always_node[k]
            step = always_weight[k] * _difference(high[m], low[m], high[n], low[n])
            shared += step
            size += abs(step)
            scale += always_weight[k] * (abs(high[m]) + abs(high[n]))
        shared += 1.0
        best, least, most, choice = np.inf, np.inf, np.inf, 0
        for a in range(num_actions):
            row = n * num_actions + a
            total, own, reach = 0.0, size, scale
            for k in range(first[row], first[row + 1]):
                m = node[k]
                step = weight[k] * _difference(high[m], low[m], high[n], low[n])
                total += step
                own += abs(step)
                reach += weight[k] * (abs(high[m]) + abs(high[n]))
            terms = first[row + 1] - first[row] + always[n + 1] - always[n]
            off = operations(num_actions, terms) * UNIT * own + 8 * UNIT * UNIT * reach
            total += shared
            least, most = min(least, total - off), min(most, total + off)
            if total < best:
                best, choice = total, a
                error[n] = off
        policy[n], residual[n] = choice, best
        above = max(above, most)
        below = max(below, -least)
    return above, below


@njit(cache=True, nogil=True)
def operations(num_actions, terms):
    """Units in the last place by which a sum of so many products may be off, relative to the sum of their sizes.

    One for each product, difference and addition; num_actions + 8 for a probability, itself a sum over the actions that
    chance may execute; 9 for what `common` left out.
    """
    return terms + num_actions + 24


@njit(cache=True, nogil=True)
def _difference(high, low, other_high, other_low):
    """(high + low) - (other_high + other_low), to a unit of the difference."""
    total = high - other_high
    part = total - high
    rest = (high - (total - part)) - (other_high + part)
    return total + (rest + (low - other_low))


@njit(cache=True, nogil=True)
def almost_surely(first, node, num_actions, goal, sure, attractor):
    """sure[n]: some policy leads from n to the goal with probability 1. A greatest fixed point over least ones (de
    Alfaro 1999)."""
    size = len(goal)
    sure[:] = True
    while True:
        attractor[:] = goal
        grew = True
        while grew:
            grew = False
            for n in range(size):
                if attractor[n] or not sure[n]:
                    continue
                for a in range(num_actions):
                    row = n * num_actions + a
                    stays, hits = True, False
                    for i in range(first[row], first[row + 1]):
                        m = node[i]
                        stays = stays and sure[m]
                        hits = hits or attractor[m]
                    if stays and hits:
                        attractor[n] = True
                        grew = True
                        break
        same = True
        for n in range(size):
            if sure[n] != attractor[n]:
                same = False
            sure[n] = attractor[n]
        if same:
            return


@njit(cache=True, nogil=True)
def proper_policy(first, node, weight, num_actions, goal, order, count, sure, policy):
    """policy[n] of order[:count]: an action that may lead nearer to the goal and never out of these nodes; so it surely
    arrives.

    order: nodes by distance to the goal; all of them surely reach it. The most probable way nearer is taken. sure (N,)
        is scratch.
    """
    sure[:] = False
    for i in range(count):
        sure[order[i]] = True
    nearer = goal.copy()
    grew = True
    while grew:
        grew = False
        for i in range(count):
            n = order[i]
            if nearer[n]:
                continue
            best = 0.0
            for a in range(num_actions):
                row = n * num_actions + a
                stays, chance = True, 0.0
                for k in range(first[row], first[row + 1]):
                    stays = stays and sure[node[k]]
                    if nearer[node[k]]:
                        chance += weight[k]
                if stays and chance > best:
                    best = chance
                    policy[n] = a
            if best > 0:
                nearer[n] = True
                grew = True
