"""Bounds of expected times to each target from a hub, through the nodes around the target; see
hardness/hitting/travel.py; kernels/travel.py says what outcomes are."""

import numpy as np
from numba import njit

from pharos.kernels.travel import EPSILON, ROUNDING

# Predecessors beyond which a node is not gone back from: those of a start state are all states in which episodes end.
CROWD = 64
# Turns that a lost step costs among the nodes on the way to a target, and turns that are kept: ways that lose more
# steps at once are not gone.
DETOUR, TURNS = 2, 32
# No way from the hub leads to a node.
LOST = 1 << 30
# Part of a bound that a sweep must gain for another one to follow.
GAIN = 1e-3
# More than the relative rounding of costs and leaks after all sweeps: some units in the last place for each update.
UPDATES = 1 + 1e-9


@njit(cache=True, nogil=True)
def shorten(targets, begin, end, graph, chance, times, bound, new, sweeps, room):
    """new[z] for z in targets[begin:end]: the least of bound[z] and (bound[x] + c(x)) / (1 - l(x)) over x around z.

    graph: (outcomes, owner, into, steps from the hub to each node (N,)); chance: (weights, previous actions, actions).
    times (N,): expected steps from each node to the hub, at most; bound (N,): from the hub to each node, at most.
    room: (place (N,) int32, zero before and after; queue, an entry for each node around z; pushed and turns, those of
    `_around`; cost and leak, one for each previously executed action as well, the last for none). x is reached with any
    of those, so c(x) is the largest.
    """
    outcomes, owner, into, steps = graph
    weights, num_previous, num_actions = chance
    place, queue, pushed, turns, cost, leak = room
    first, action, node, prob = outcomes
    none = cost.shape[1] - 1
    now, before, uniform, first_now, first_uniform = weights
    by_cost, by_leak = np.zeros(num_actions), np.zeros(num_actions)
    for k in range(begin, end):
        z = targets[k]
        size, count = _around(z, owner, into, steps, place, (queue, pushed, turns))
        guess = min(bound[z], 1e300)
        for i in range(size):
            cost[i], leak[i] = times[queue[i]], 1.0
        cost[0], leak[0] = 0.0, 0.0
        for _ in range(sweeps):
            gained = 0.0
            for i in range(1, size):
                x = queue[i]
                by_cost[:], by_leak[:] = 0.0, 0.0
                always_cost, always_leak, all_cost, all_leak = 1.0, 0.0, 0.0, 0.0
                for j in range(first[x], first[x + 1]):
                    p, a = place[node[j]], action[j]
                    then = a if num_previous > 0 and a >= 0 else none
                    c = prob[j] * (cost[p - 1, then] if p > 0 else times[node[j]])
                    left = prob[j] * (leak[p - 1, then] if p > 0 else 1.0)
                    if a < 0:
                        always_cost += c
                        always_leak += left
                    else:
                        by_cost[a] += c
                        by_leak[a] += left
                        all_cost += c
                        all_leak += left
                best = 0
                for a in range(1, num_actions):
                    if by_cost[a] + by_leak[a] * guess < by_cost[best] + by_leak[best] * guess:
                        best = a
                for b in range(-1, num_previous):
                    weight, others = (first_now, first_uniform) if b < 0 else (now, uniform)
                    c = always_cost + others * all_cost + weight * by_cost[best]
                    left = always_leak + others * all_leak + weight * by_leak[best]
                    if b >= 0:
                        c += before * by_cost[b]
                        left += before * by_leak[b]
                    then = b if b >= 0 else none
                    gain = cost[i, then] + leak[i, then] * guess - c - left * guess
                    if gain > 0:
                        cost[i, then], leak[i, then] = c, left
                        gained = max(gained, gain)
            if gained <= GAIN * guess:
                break
        least = bound[z]
        for i in range(1, size):
            remainder = 1 - leak[i].max() * UPDATES - ROUNDING
            if remainder > 0:
                least = min(least, (bound[queue[i]] + cost[i].max() * UPDATES) / remainder * (1 + 8 * EPSILON))
        new[z] = least
        for i in range(count):
            place[pushed[i, 0]] = 0


@njit(cache=True, nogil=True)
def _around(z, owner, into, steps, place, room):
    """Nodes on the way to z, those on short ways from the hub first: queue[:result], as many as it has room for;
    place[n]: where n stands, and one more.

    A node of which z is k steps away, and that lies on a way from the hub to z that is s steps longer than the shortest
    one, comes k + DETOUR s-th: its steps to z count, and those lost. `pushed` are (node, the next of its turn).
    """
    queue, pushed, turns = room
    into_first, into_outcome = into
    turns[:] = -1
    pushed[0, 0], pushed[0, 1], turns[0] = z, -1, 0
    place[z] = -1
    size, count, turn, idle = 0, 1, 0, 0
    while idle <= TURNS and size < len(queue):
        at = turns[turn % TURNS]
        if at < 0:
            turn += 1
            idle += 1
            continue
        idle = 0
        turns[turn % TURNS] = pushed[at, 1]
        n = pushed[at, 0]
        queue[size] = n
        size += 1
        place[n] = size
        if into_first[n + 1] - into_first[n] > CROWD:
            continue
        for k in range(into_first[n], into_first[n + 1]):
            x = owner[into_outcome[k]]
            lost = 1 + steps[x] - steps[n]
            if place[x] == 0 and 0 <= lost < (TURNS - 1) // DETOUR and count < len(pushed):
                then = (turn + 1 + DETOUR * lost) % TURNS
                pushed[count, 0], pushed[count, 1] = x, turns[then]
                turns[then] = count
                place[x] = -1
                count += 1
    return size, count


@njit(cache=True, nogil=True)
def steps_from(hub, first, node):
    """(N,) int32: the fewest steps in which outcomes lead from the hub to each node, LOST where none do."""
    steps = np.full(len(first) - 1, LOST, np.int32)
    queue = np.empty(len(first) - 1, np.int64)
    queue[0], steps[hub] = hub, 0
    head, tail = 0, 1
    while head < tail:
        x = queue[head]
        head += 1
        for i in range(first[x], first[x + 1]):
            if steps[node[i]] == LOST:
                steps[node[i]] = steps[x] + 1
                queue[tail] = node[i]
                tail += 1
    return steps
