"""Bounds of expected times between neighbouring states, for all pairs at once (hardness/hitting/travel.py).

Outcomes: state x has those numbered first[x] to first[x + 1]: outcome i happens with probability prob[i] when action[i]
is executed (-1: any action), and leads to node[i]. Outcome i stands for the aim to go from x to node[i] by choosing
action[i].
"""

import heapq

import numpy as np
from numba import njit

# There is no way back nearby.
NONE = 255
# More than the rounding error of a sum of probabilities.
ROUNDING = 1e-12
# The distance from 1 to the next float.
EPSILON = 2.0**-52


@njit(cache=True, nogil=True)
def _execution(executed, chosen, previous, weights):
    """Probability that `executed` is executed; previous = -1: on the first step, or where it does not matter."""
    if executed < 0:
        return 1.0
    now, before, uniform, first_now, first_uniform = weights
    if previous < 0:
        return first_uniform + (first_now if executed == chosen else 0.0)
    return uniform + (now if executed == chosen else 0.0) + (before if executed == previous else 0.0)


@njit(cache=True, nogil=True)
def outcomes_into(node, num_nodes):
    """(first, outcome): which outcomes lead to each node, by a counting sort."""
    first = np.zeros(num_nodes + 2, np.int64)
    for i in range(len(node)):
        first[node[i] + 2] += 1
    for n in range(num_nodes + 1):
        first[n + 1] += first[n]
    outcome = np.empty(len(node), np.int64)
    for i in range(len(node)):
        outcome[first[node[i] + 1]] = i
        first[node[i] + 1] += 1
    return first[:-1], outcome


@njit(cache=True, nogil=True)
def _search_back(y, outcomes, owner, into, ball, levels, queue, via):
    """Nodes by their distance to y: queue[:result]; levels[n] = distance + 1, via[n] = the outcome aimed at first, the
    most probable one of those that lead to the same node. Ends with `ball` nodes."""
    _, _, node, prob = outcomes
    into_first, into_outcome = into
    levels[y] = 1
    queue[0] = y
    head, tail = 0, 1
    while head < tail and tail < ball and levels[queue[head]] < NONE:
        n = queue[head]
        head += 1
        for k in range(into_first[n], into_first[n + 1]):
            x = owner[into_outcome[k]]
            if levels[x] == 0 and tail < ball:
                levels[x] = levels[n] + 1
                via[x] = into_outcome[k]
                queue[tail] = x
                tail += 1
            elif levels[x] == levels[n] + 1 and node[via[x]] == n and prob[into_outcome[k]] > prob[via[x]]:
                via[x] = into_outcome[k]
    return tail


@njit(cache=True, nogil=True)
def steps_back(low, high, outcomes, owner, into, square, steps, ball, levels, queue, via):
    """For outcomes i that lead to nodes low..high: steps[square[i] + j] of a shortest way from outcome j of its state
    to node[i].

    NONE where the `ball` nodes nearest to node[i] do not include it. levels (N,) uint8 is zero before and after.
    """
    first, _, node, _ = outcomes
    into_first, into_outcome = into
    for y in range(low, high):
        size = _search_back(y, outcomes, owner, into, ball, levels, queue, via)
        for k in range(into_first[y], into_first[y + 1]):
            i = into_outcome[k]
            x = owner[i]
            if square[i] >= 0:
                for j in range(first[x + 1] - first[x]):
                    there = levels[node[first[x] + j]]
                    steps[square[i] + j] = there - 1 if there > 0 else NONE
        for k in range(size):
            levels[queue[k]] = 0


@njit(cache=True, nogil=True)
def ways_back(low, high, outcomes, owner, into, square, steps, start, way, ball, levels, queue, via):
    """Write the outcomes along those ways, outcome after outcome: way[start[i]] on."""
    first, _, node, _ = outcomes
    into_first, into_outcome = into
    for y in range(low, high):
        size = _search_back(y, outcomes, owner, into, ball, levels, queue, via)
        for k in range(into_first[y], into_first[y + 1]):
            i = into_outcome[k]
            x = owner[i]
            if square[i] >= 0:
                at = start[i]
                for j in range(first[x + 1] - first[x]):
                    n = node[first[x] + j]
                    if steps[square[i] + j] != NONE:
                        while n != y:
                            way[at] = via[n]
                            at += 1
                            n = node[via[n]]
        for k in range(size):
            levels[queue[k]] = 0


@njit(cache=True, nogil=True)
def keep_near(outcomes, owner, weights, num_previous, square, steps, limit, length):
    """Forget the longest ways back, until the expected steps on the way back are at most `limit`; length[i]: of the
    ways that are kept.

    Returns the largest expected steps.
    """
    first, action, node, prob = outcomes
    largest = 0.0
    for i in range(len(node)):
        low, high = first[owner[i]], first[owner[i] + 1]
        length[i] = 0
        while square[i] >= 0:
            worst = 0.0
            for previous in range(-1, num_previous):
                total = 0.0
                for j in range(low, high):
                    if steps[square[i] + j - low] != NONE:
                        chance = prob[j] * _execution(action[j], action[i], previous, weights)
                        total += chance * steps[square[i] + j - low]
                worst = max(worst, total)
            if worst <= limit:
                largest = max(largest, worst)
                break
            farthest = 0
            for j in range(low, high):
                if steps[square[i] + j - low] != NONE:
                    farthest = max(farthest, steps[square[i] + j - low])
            for j in range(low, high):
                if steps[square[i] + j - low] == farthest:
                    steps[square[i] + j - low] = NONE
        if square[i] >= 0:
            for j in range(low, high):
                if steps[square[i] + j - low] != NONE:
                    length[i] += steps[square[i] + j - low]
    return largest


@njit(cache=True, nogil=True)
def attempt(
    begin, end, outcomes, owner, weights, num_previous, square, steps, start, way, own, times, value, new, once
):
    """new[i] = own + sum over what happens instead: along the way back, the sum of values; else times[there].

    The largest over the previously executed action. Returns the largest increase. `once`: also for outcomes without any
    way back, which depend on no values: they are worked out in one pass and stay as they are.
    """
    first, action, node, prob = outcomes
    increase, mean = 0.0, 0.0
    for i in range(begin, end):
        low, high = first[owner[i]], first[owner[i] + 1]
        if square[i] < 0 and not once:
            continue
        if square[i] < 0 and action[i] < 0:  # whatever is chosen: of all outcomes only this one does not lead elsewhere
            if i in (low, begin):
                mean = 0.0
                for j in range(low, high):
                    mean += prob[j] * times[node[j]]
            new[i] = own + max(mean - prob[i] * times[node[i]], 0.0) + (high - low + 2) * EPSILON * mean
            increase = max(increase, new[i] - value[i])
            continue
        if node[i] == owner[i]:  # an outcome that stays is on no shortest way, so that no sum takes its entry
            continue
        worst = 0.0
        for previous in range(-1, num_previous):
            total = own
            at = start[i]
            for j in range(low, high):
                chance = prob[j] * _execution(action[j], action[i], previous, weights)
                if square[i] >= 0 and steps[square[i] + j - low] != NONE:
                    back = 0.0
                    for _ in range(steps[square[i] + j - low]):
                        back += value[way[at]]
                        at += 1
                    total += chance * back
                elif node[j] != node[i] and chance > 0:
                    total += chance * times[node[j]]
            worst = max(worst, total)
        increase = max(increase, worst - value[i])
        new[i] = worst
    return increase


@njit(cache=True, nogil=True)
def times_from(hub, first, node, cost, leak):
    """(N,) least t with t(hub) = 0, t(y) = (t(x) + cost[i]) / (1 - leak[i]) over outcomes i from x to y, by Dijkstra's
    algorithm.

    Where almost all attempts are given up, 1 - leak is no more than the rounding of a sum of probabilities, which is
    taken off.
    """
    bound = np.full(len(first) - 1, np.inf)
    done = np.zeros(len(bound), np.bool_)
    bound[hub] = 0.0
    heap = [(0.0, hub)]
    while len(heap) > 0:
        so_far, x = heapq.heappop(heap)
        if done[x]:
            continue
        done[x] = True
        for i in range(first[x], first[x + 1]):
            y = node[i]
            remainder = 1 - leak[i] - ROUNDING
            if not done[y] and remainder > 0:
                there = (so_far + cost[i]) / remainder
                if there < bound[y]:
                    bound[y] = there
                    heapq.heappush(heap, (there, y))
    return bound
