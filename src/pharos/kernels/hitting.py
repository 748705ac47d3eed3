"""Least expected hitting times on explicit choices, and bounds of them by the ways between neighbouring states.

Nodes have A actions each, row n A + a of a sparse matrix (first, node, weight). hardness/hitting_times.py says
what is computed and why the bounds hold. `goal` (N,) bool marks the nodes of the target, `alike` (N,) bool nodes that
all have the same rows, such as those in which episodes end: what holds for the first of them is not worked out again
for the others.

Bounds of expected times between neighbouring states, for all pairs at once, and to each target from a hub, through the
nodes around the target, are those of hardness/stochastic_diameter.py. Outcomes: state x has those numbered first[x] to
first[x + 1]: outcome i happens with probability prob[i] when action[i] is executed (-1: any action), and leads to
node[i]. Outcome i stands for the aim to go from x to node[i] by choosing action[i].
"""

import heapq

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
def sweep_in_place(rows, common, alike, goal, order, count, j, mode):
    """j(n) = 1 + min_a sum p j, in place in the order given; j is 0 at the goal. And mode(n) = sum p mode under the
    actions that are best for j, unless mode is None.

    What all actions of a node have in common is in its row of `common`, the rest in `rows` of each action.
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
            j[n] = of_alike
            if mode is not None:
                mode[n] = mode_of_alike
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
        if mode is not None:
            for k in range(first[choice], first[choice + 1]):
                left += weight[k] * mode[node[k]]
        for k in range(always[n], always[n + 1]):
            best += always_weight[k] * j[always_node[k]]
            if mode is not None:
                left += always_weight[k] * mode[always_node[k]]
        f = best - j[n]
        change = max(change, abs(f))
        j[n] = best
        if alike[n]:
            of_alike = best
        if mode is not None:
            g = mode[n] - left
            ff += f * f
            fg += f * g
            gg += g * g
            mode[n] = left
            if alike[n]:
                mode_of_alike = left
    return change, ff, fg, gg


@njit(cache=True, nogil=True)
def residuals(rows, common, alike, goal, order, count, high, low, policy, residual, error):
    """(bound of T j - j, bound of j - T j, largest j) over nodes that are not the goal; policy[n] = the action that
    attains T j. j = high; or j = high + low, two floats a node, so that j may be 1e16 times its differences.

    T j(n) - j(n) = 1 + min_a sum_m p(m | n, a) (j(m) - j(n)): written with differences, no rounding error grows with j
    itself. Both bounds count all rounding: `operations` says how many units in the last place one sum may be off. The
    error of a difference of two pairs is a unit of the difference and eight units of a unit of the numbers.
    residual, error (N,): T j - j, and by how much it may be off; None where low is.
    """
    first, node, weight = rows
    always, always_node, always_weight = common
    num_actions = (len(first) - 1) // len(goal)
    above, below, largest, first_alike = 0.0, 0.0, 0.0, -1
    for i in range(count):
        n = order[i]
        if goal[n]:
            continue
        if alike[n]:
            if first_alike >= 0 and high[n] == high[first_alike] and (low is None or low[n] == low[first_alike]):
                policy[n] = policy[first_alike]
                if low is not None:
                    residual[n], error[n] = residual[first_alike], error[first_alike]
                continue
            first_alike = n
        here, under = high[n], 0.0 if low is None else low[n]
        shared, size, scale = 0.0, 1.0, 0.0
        for k in range(always[n], always[n + 1]):
            step = always_weight[k] * _difference(high, low, always_node[k], here, under)
            shared += step
            size += abs(step)
            if low is not None:
                scale += always_weight[k] * (abs(high[always_node[k]]) + abs(here))
        shared += 1.0
        best, least, most, choice = np.inf, np.inf, np.inf, 0
        for a in range(num_actions):
            row = n * num_actions + a
            total, own, reach = 0.0, size, scale
            for k in range(first[row], first[row + 1]):
                step = weight[k] * _difference(high, low, node[k], here, under)
                total += step
                own += abs(step)
                if low is not None:
                    reach += weight[k] * (abs(high[node[k]]) + abs(here))
            off = operations(num_actions, first[row + 1] - first[row] + always[n + 1] - always[n]) * UNIT * own
            if low is not None:
                off += 8 * UNIT * UNIT * reach
            total += shared
            least, most = min(least, total - off), min(most, total + off)
            if total < best:
                best, choice = total, a
                if low is not None:
                    residual[n], error[n] = best, off
        policy[n] = choice
        above = max(above, most)
        below = max(below, -least)
        largest = max(largest, here)
    return above, below, largest


@njit(cache=True, nogil=True)
def operations(num_actions, terms):
    """Units in the last place by which a sum of so many products may be off, relative to the sum of their sizes.

    One for each product, difference and addition; num_actions + 8 for a probability, itself a sum over the actions that
    chance may execute; 9 for what `common` left out.
    """
    return terms + num_actions + 24


@njit(cache=True, nogil=True)
def _difference(high, low, m, here, under):
    """(high[m] + low[m]) - (here + under), to a unit of the difference; without low and under where low is None."""
    total = high[m] - here
    if low is None:
        return total
    part = total - high[m]
    rest = (high[m] - (total - part)) - (here + part)
    return total + (rest + (low[m] - under))


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


# There is no way back nearby.
# Travel ---------------------------------------------------------------------------------------------------------------


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
def ways_back(low, high, outcomes, owner, into, square, steps, start, way, ball, levels, queue, via):
    """For outcomes i that lead to nodes low..high: steps[square[i] + j] of a shortest way from outcome j of its state
    to node[i], where way is None; else the outcomes along those ways that steps has, one after another: way[start[i]]
    on.

    NONE where the `ball` nodes nearest to node[i] do not include it. levels (N,) uint8 is zero before and after.
    """
    first, _, node, _ = outcomes
    into_first, into_outcome = into
    for y in range(low, high):
        size = _search_back(y, outcomes, owner, into, ball, levels, queue, via)
        for k in range(into_first[y], into_first[y + 1]):
            i = into_outcome[k]
            x = owner[i]
            if square[i] < 0:
                continue
            at = start[i] if way is not None else 0
            for j in range(first[x + 1] - first[x]):
                n = node[first[x] + j]
                if way is None:
                    steps[square[i] + j] = levels[n] - 1 if levels[n] > 0 else NONE
                elif steps[square[i] + j] != NONE:
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


# Predecessors beyond which a node is not gone back from: those of a start state are all states in which episodes end.
# Vicinities -----------------------------------------------------------------------------------------------------------


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


def steps_from(hub, first, node):
    """(N,) int32: the fewest steps in which outcomes lead from the hub to each node, LOST where none do."""
    steps, is_hub = np.empty(len(first) - 1, np.int32), np.zeros(len(first) - 1, np.bool_)
    is_hub[hub] = True
    backward_order(first, node, is_hub, np.empty(len(first) - 1, np.int64), steps)
    steps[steps < 0] = LOST
    return steps
