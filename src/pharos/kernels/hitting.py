"""Kernels for least expected hitting times: sweeps, certified residuals, and bounds by short ways between neighbours.

Nodes have A actions each, row n A + a of a sparse matrix (first, node, weight). hardness/hitting_times.py says
what is computed and why the bounds hold. `goal` (N,) bool marks the nodes of the target, `shares_rows` (N,) bool nodes
that all have the same rows, such as those in which episodes end: what holds for the first of them is not worked out
again for the others.

Ways back bound the expected times between neighbouring states, for all pairs at once; from them follow bounds from a
hub to each target, and closer ones through the nodes around the target: hardness/stochastic_diameter.py proves all.
Outcome i stands for the aim to go from its state to node[i] by choosing action[i].
"""

import heapq
from typing import NamedTuple

import numpy as np

from pharos.kernels.interpreted import interpreted_first
from pharos.kernels.kernel_cache import kernel

# Half the distance from 1 to the next float: the relative rounding error of one operation.
UNIT = 2.0**-53


class Rows(NamedTuple):
    """The rows of N nodes with A actions each, split into what all actions of a node have in common and the rest.

    Attributes:
        first, node, weight: row n A + a, the rest of action a of node n.
        always, always_node, always_weight: row n, what its actions have in common.
        shares_rows: (N,) bool, see above.
    """

    first: np.ndarray
    node: np.ndarray
    weight: np.ndarray
    always: np.ndarray
    always_node: np.ndarray
    always_weight: np.ndarray
    shares_rows: np.ndarray


@interpreted_first()
@kernel
def backward_order(first, previous, goal, order, distance):
    """Order nodes by their distance to the goal, by a search on the reversed graph; returns how many reach it.

    order (N,): these nodes, the goal first; distance (N,): in steps, -1 if there is no path.
    """
    distance[:] = -1
    # level 0: the nodes of the goal
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


@interpreted_first()
@kernel(makes_arrays=False)
def sweep_in_place(rows, goal, order, j, mode):
    """One sweep of j(n) = 1 + min_a sum p j, in place over the nodes of `order`; j is 0 at the goal.

    If mode is not None, also mode(n) = sum p mode under the action that is best for j.
    Returns (largest change of j, sum f f, sum f g, sum g g): f, what j has gained, g, what mode has lost in the sweep.
    """
    first, node, weight, always, always_node, always_weight, shares_rows = rows
    num_actions = (len(first) - 1) // len(goal)
    change, shared_value, shared_mode = 0.0, -1.0, 0.0
    ff, fg, gg = 0.0, 0.0, 0.0
    for n in order:
        if goal[n]:
            continue
        # the same rows as an earlier node: the same values
        if shares_rows[n] and shared_value >= 0:
            change = max(change, abs(shared_value - j[n]))
            j[n] = shared_value
            if mode is not None:
                mode[n] = shared_mode
            continue
        # the best action, by the part of the sum that differs between actions
        best, choice = np.inf, n * num_actions
        for row in range(n * num_actions, (n + 1) * num_actions):
            total = 0.0
            for k in range(first[row], first[row + 1]):
                total += weight[k] * j[node[k]]
            if total < best:
                best, choice = total, row
        best += 1.0
        # mode under this action, and the common part of both sums
        new_mode = 0.0
        if mode is not None:
            for k in range(first[choice], first[choice + 1]):
                new_mode += weight[k] * mode[node[k]]
        for k in range(always[n], always[n + 1]):
            best += always_weight[k] * j[always_node[k]]
            if mode is not None:
                new_mode += always_weight[k] * mode[always_node[k]]
        # store both, and add up how far they moved
        f = best - j[n]
        change = max(change, abs(f))
        j[n] = best
        if shares_rows[n]:
            shared_value = best
        if mode is not None:
            g = mode[n] - new_mode
            ff += f * f
            fg += f * g
            gg += g * g
            mode[n] = new_mode
            if shares_rows[n]:
                shared_mode = new_mode
    return change, ff, fg, gg


@interpreted_first()
@kernel(makes_arrays=False)
def residual_bounds(rows, goal, order, high, low, policy, residuals):
    """(bound of T j - j, bound of j - T j, largest j) over nodes of `order` but the goal; T is one Bellman step.

    j = high; or j = high + low, two floats a node, so that j may be 1e16 times its differences. policy[n] = the action
    that attains T j. residuals: two arrays (N,), T j - j, and by how much it may be off; None if low is.

    T j(n) - j(n) = 1 + min_a sum_m p(m | n, a) (j(m) - j(n)): written with differences, no rounding error grows with j
    itself. Both bounds count all rounding: `rounding_units` says how many units in the last place one sum may be off.
    The error of a difference of two pairs is a unit of the difference and eight units of a unit of the numbers.
    """
    first, node, weight, always, always_node, always_weight, shares_rows = rows
    num_actions = (len(first) - 1) // len(goal)
    above, below, largest, twin = 0.0, 0.0, 0.0, -1
    if low is not None:
        residual, error = residuals
    for n in order:
        if goal[n]:
            continue
        # the same rows and value as an earlier node: the same result
        if shares_rows[n]:
            if twin >= 0 and high[n] == high[twin] and (low is None or low[n] == low[twin]):
                policy[n] = policy[twin]
                if low is not None:
                    residual[n], error[n] = residual[twin], error[twin]
                continue
            twin = n
        value, correction = high[n], 0.0 if low is None else low[n]
        # the part of the sum that all actions have in common; size and scale bound its rounding
        shared, size, scale = 0.0, 1.0, 0.0
        for k in range(always[n], always[n + 1]):
            step = always_weight[k] * _difference(high, low, always_node[k], value, correction)
            shared += step
            size += abs(step)
            if low is not None:
                scale += always_weight[k] * (abs(high[always_node[k]]) + abs(value))
        shared += 1.0
        # each action's sum, and the interval that rounding leaves for the minimum
        best, least, most, choice = np.inf, np.inf, np.inf, 0
        for a in range(num_actions):
            row = n * num_actions + a
            total, magnitude, extent = 0.0, size, scale
            for k in range(first[row], first[row + 1]):
                step = weight[k] * _difference(high, low, node[k], value, correction)
                total += step
                magnitude += abs(step)
                if low is not None:
                    extent += weight[k] * (abs(high[node[k]]) + abs(value))
            slack = (
                rounding_units(num_actions, first[row + 1] - first[row] + always[n + 1] - always[n]) * UNIT * magnitude
            )
            if low is not None:
                slack += 8 * UNIT * UNIT * extent
            total += shared
            least, most = min(least, total - slack), min(most, total + slack)
            if total < best:
                best, choice = total, a
                if low is not None:
                    residual[n], error[n] = best, slack
        policy[n] = choice
        above = max(above, most)
        below = max(below, -least)
        largest = max(largest, value)
    return above, below, largest


@kernel
def rounding_units(num_actions, terms):
    """Units in the last place by which a sum of `terms` products may be off, relative to the sum of their sizes.

    One for each product, difference and addition; num_actions + 8 for a probability, itself a sum over the actions that
    chance may execute; 9 for what `common` left out.
    """
    return terms + num_actions + 24


@kernel(makes_arrays=False)
def _difference(high, low, m, value, correction):
    """(high[m] + low[m]) - (value + correction), to a unit of the difference; high[m] - value if low is None.

    The rounding error of high[m] - value is computed exactly, and added to the difference of the small parts.
    """
    total = high[m] - value
    if low is None:
        return total
    part = total - high[m]
    rounding = (high[m] - (total - part)) - (value + part)
    return total + (rounding + (low[m] - correction))


@interpreted_first()
@kernel
def almost_surely(first, node, rows, goal, sure, attractor, policy):
    """sure[n] = whether some policy leads from n to the goal with probability 1.

    Node n has the rows rows[n] to rows[n + 1]. policy (N,), unless it is None: a row of each sure node beyond the goal,
    such that all of them together lead there. A greatest fixed point over least ones. attractor (N,) bool is scratch.
    Source: de Alfaro (1999).
    """
    size = len(goal)
    sure[:] = True
    while True:
        # least fixed point: nodes with an action that may enter the attractor and never leaves `sure`
        attractor[:] = goal
        grew, backward = True, True
        while grew:
            grew = False
            backward = not backward
            for i in range(size):
                n = size - 1 - i if backward else i
                if attractor[n] or not sure[n]:
                    continue
                for row in range(rows[n], rows[n + 1]):
                    stays, hits = True, False
                    for k in range(first[row], first[row + 1]):
                        m = node[k]
                        stays = stays and sure[m]
                        hits = hits or attractor[m]
                    if stays and hits:
                        attractor[n] = True
                        grew = True
                        if policy is not None:
                            policy[n] = row
                        break
        # nodes outside the attractor are not sure; those that need them may now fail, too
        same = True
        for n in range(size):
            if sure[n] != attractor[n]:
                same = False
            sure[n] = attractor[n]
        if same:
            return


@interpreted_first()
@kernel
def proper_policy(first, node, weight, num_actions, goal, order, policy):
    """policy[n] for n in `order`: an action that may lead nearer to the goal and never out of these nodes.

    So the goal is reached surely. order: nodes by distance to the goal; all of them surely reach it. The action most
    likely to lead nearer is taken.
    """
    sure, nearer = goal.copy(), goal.copy()
    for n in order:
        sure[n] = True
    # grow the set of nodes that have an action, from the goal on
    grew = True
    while grew:
        grew = False
        for n in order:
            if nearer[n]:
                continue
            # among the actions that stay in these nodes, the one most likely to enter the set
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


# Ways back ------------------------------------------------------------------------------------------------------------


NO_WAY = 255  # steps of a way back if there is none nearby
# More than the rounding error of a sum of probabilities.
MASS_ROUNDING = 1e-12
# The distance from 1 to the next float.
EPSILON = 2.0**-52


class OutcomeLists(NamedTuple):
    """The outcomes of executing each action in each of N states, M in all.

    Attributes:
        first: (N + 1,) state x has the outcomes numbered first[x] to first[x + 1].
        action, node, prob: (M,) if action[i] is executed (-1: any), it leads to node[i] with probability prob[i].
        owner: (M,) the state of each.
    """

    first: np.ndarray
    action: np.ndarray
    node: np.ndarray
    prob: np.ndarray
    owner: np.ndarray


class ExecutionWeights(NamedTuple):
    """Weights of the executed action.

    Attributes:
        now, before, uniform: of the choice, of the previously executed action, and of each action.
        first_now, first_uniform: the same if there is no previous action.
        num_previous: number of previous actions that are told apart, 0 if they do not matter.
        num_actions: A.
    """

    now: float
    before: float
    uniform: float
    first_now: float
    first_uniform: float
    num_previous: int
    num_actions: int


class Ways(NamedTuple):
    """Ways back to node[i], for outcomes i, from the other outcomes j of its state; as long as it has outcomes.

    Attributes:
        square: (M,) where the entries of outcome i in `steps` begin; -1: it has none.
        steps: uint8, at square[i] + j the length of the way from outcome j of the state; NO_WAY if there is none.
        start: (M,) where the ways of outcome i in `way` begin; (0,) before the ways are written.
        way: the outcomes along the ways whose length is not NO_WAY, one way after another.
    """

    square: np.ndarray
    steps: np.ndarray
    start: np.ndarray
    way: np.ndarray


@kernel(makes_arrays=False)
def _probability(executed, choice, previous, execution):
    """Probability that the action `executed` is executed if `choice` is chosen.

    executed = -1: whatever is executed. previous = -1: on the first step, or if it does not matter.
    """
    if executed < 0:
        return 1.0
    if previous < 0:
        return execution.first_uniform + (execution.first_now if executed == choice else 0.0)
    now, before = execution.now, execution.before
    return execution.uniform + (now if executed == choice else 0.0) + (before if executed == previous else 0.0)


@interpreted_first()
@kernel
def outcomes_into(node, num_nodes):
    """(first, outcome): outcomes that lead to node n are outcome[first[n]:first[n + 1]]; a counting sort."""
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


@kernel(makes_arrays=False)
def _search_back(y, outcomes, into, room):
    """Search backward from y, along outcomes: the nodes by their distance to y are queue[:result].

    room: (levels (N,) uint8: distance + 1, zero before and after; queue: as many nodes as it holds; via (N,): the
    outcome aimed at first on the way from each node, the most probable one of those that lead to the same node).
    """
    levels, queue, via = room
    node, prob, owner = outcomes.node, outcomes.prob, outcomes.owner
    into_first, into_outcome = into
    levels[y] = 1
    queue[0] = y
    head, tail = 0, 1
    while head < tail and tail < len(queue) and levels[queue[head]] < NO_WAY:
        n = queue[head]
        head += 1
        for k in range(into_first[n], into_first[n + 1]):
            x = owner[into_outcome[k]]
            if levels[x] == 0 and tail < len(queue):
                levels[x] = levels[n] + 1
                via[x] = into_outcome[k]
                queue[tail] = x
                tail += 1
            elif levels[x] == levels[n] + 1 and node[via[x]] == n and prob[into_outcome[k]] > prob[via[x]]:
                via[x] = into_outcome[k]
    return tail


@interpreted_first()
@kernel(makes_arrays=False)
def ways_back(low, high, outcomes, into, ways, room):
    """Shortest ways back to node[i], for outcomes i into nodes low..high, from the other outcomes of its state.

    If `start` is empty their lengths are written to `steps`: NO_WAY if the nodes nearest to node[i] do not include the
    outcome's. Else the ways are written to `way`. into: see `outcomes_into`; room: see `_search_back`.
    """
    first, node, owner = outcomes.first, outcomes.node, outcomes.owner
    into_first, into_outcome = into
    square, steps, start, way = ways
    levels, queue, via = room
    for y in range(low, high):
        size = _search_back(y, outcomes, into, room)
        # each outcome i into y, and each other outcome j of the same state
        for k in range(into_first[y], into_first[y + 1]):
            i = into_outcome[k]
            x = owner[i]
            if square[i] < 0:
                continue
            at = start[i] if len(start) > 0 else 0
            for j in range(first[x + 1] - first[x]):
                n = node[first[x] + j]
                if len(start) == 0:
                    steps[square[i] + j] = levels[n] - 1 if levels[n] > 0 else NO_WAY
                elif steps[square[i] + j] != NO_WAY:
                    while n != y:
                        way[at] = via[n]
                        at += 1
                        n = node[via[n]]
        # reset the nodes that the search visited
        for k in range(size):
            levels[queue[k]] = 0


@interpreted_first()
@kernel(makes_arrays=False)
def keep_near(outcomes, execution, ways, limit, length):
    """Drop the longest ways back until the expected steps on the way back are at most `limit`, for every outcome.

    Lengths of dropped ones become NO_WAY; length[i] becomes the sum of the lengths of the ways that are left. Returns
    the largest expected number of steps.
    """
    first, action, node, prob, owner = outcomes
    square, steps, _, _ = ways
    largest = 0.0
    for i in range(len(node)):
        low, high = first[owner[i]], first[owner[i] + 1]
        length[i] = 0
        while square[i] >= 0:
            # expected steps on ways back, the largest over the previously executed action
            worst = 0.0
            for previous in range(-1, execution.num_previous):
                total = 0.0
                for j in range(low, high):
                    if steps[square[i] + j - low] != NO_WAY:
                        chance = prob[j] * _probability(action[j], action[i], previous, execution)
                        total += chance * steps[square[i] + j - low]
                worst = max(worst, total)
            if worst <= limit:
                largest = max(largest, worst)
                break
            # too many: drop all ways of the greatest length, and try again
            farthest = 0
            for j in range(low, high):
                if steps[square[i] + j - low] != NO_WAY:
                    farthest = max(farthest, steps[square[i] + j - low])
            for j in range(low, high):
                if steps[square[i] + j - low] == farthest:
                    steps[square[i] + j - low] = NO_WAY
        # the room that the ways which are left take
        if square[i] >= 0:
            for j in range(low, high):
                if steps[square[i] + j - low] != NO_WAY:
                    length[i] += steps[square[i] + j - low]
    return largest


@interpreted_first()
@kernel(makes_arrays=False)
def attempt_costs(begin, end, outcomes, execution, ways, costs, once):
    """new[i] = constant + the expected cost of the outcomes that happen if outcome i is aimed at.

    Another outcome costs the sum of `value` along its way back to node[i], if there is one, else `times` of the node
    that it leads to. The largest expectation over the previously executed action counts. Returns the largest increase.
    `once`: also for outcomes without any way back, which depend on no values: they are worked out in one pass and stay
    as they are. costs: (constant; times (N,); value, new (M,): of the attempts, before and after this pass).
    """
    first, action, node, prob, owner = outcomes
    square, steps, start, way = ways
    constant, times, value, new = costs
    increase, mean = 0.0, 0.0
    for i in range(begin, end):
        low, high = first[owner[i]], first[owner[i] + 1]
        if square[i] < 0 and not once:
            continue
        # whatever is chosen: of all outcomes only this one does not lead elsewhere
        if square[i] < 0 and action[i] < 0:
            if i in (low, begin):
                mean = 0.0
                for j in range(low, high):
                    mean += prob[j] * times[node[j]]
            new[i] = constant + max(mean - prob[i] * times[node[i]], 0.0) + (high - low + 2) * EPSILON * mean
            increase = max(increase, new[i] - value[i])
            continue
        # an outcome that stays is on no shortest way, so that no sum takes its entry
        if node[i] == owner[i]:
            continue
        # expected cost, by the outcomes j that may happen: a way back, or giving up
        worst = 0.0
        for previous in range(-1, execution.num_previous):
            total = constant
            at = start[i]
            for j in range(low, high):
                chance = prob[j] * _probability(action[j], action[i], previous, execution)
                if square[i] >= 0 and steps[square[i] + j - low] != NO_WAY:
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


@interpreted_first()
@kernel
def times_from(hub, first, node, cost, leak):
    """(N,) least t with t(hub) = 0, t(y) = (t(x) + cost[i]) / (1 - leak[i]) over outcomes i from x to y (Dijkstra).

    leak[i]: probability that the attempt at outcome i is given up. If that is almost 1, 1 - leak is no more than the
    rounding of a sum of probabilities, which is taken off.
    """
    bound = np.full(len(first) - 1, np.inf)
    done = np.zeros(len(bound), np.bool_)
    bound[hub] = 0.0
    heap = [(0.0, hub)]
    while len(heap) > 0:
        time, x = heapq.heappop(heap)
        if done[x]:
            continue
        done[x] = True
        for i in range(first[x], first[x + 1]):
            y = node[i]
            remainder = 1 - leak[i] - MASS_ROUNDING
            if not done[y] and remainder > 0:
                candidate = (time + cost[i]) / remainder
                if candidate < bound[y]:
                    bound[y] = candidate
                    heapq.heappush(heap, (candidate, y))
    return bound


# Vicinities -----------------------------------------------------------------------------------------------------------


# Most predecessors of a node to go back from. All states in which episodes end are predecessors of a start state.
CROWD = 64
# Turns that a lost step costs among the nodes on the way to a target, and turns that are kept: ways that lose more
# steps at once are not gone.
DETOUR, MOST_TURNS = 2, 32
# No way from the hub leads to a node.
NEVER = 1 << 30
# Part of a bound that a sweep must gain for another one to follow.
LEAST_GAIN = 1e-3
# More than the relative rounding of costs and leaks after all sweeps: some units in the last place for each update.
UPDATES = 1 + 1e-9


@kernel
def shorten(targets, outcomes, into, execution, hub, sweeps, room):
    """new[z] for z in targets: the least of bound[z] and (bound[x] + c(x)) / (1 - l(x)) over x around z.

    c(x): expected steps from x until z is reached or the nodes around z are left, and then to the hub; l(x):
    probability that they are left. hardness/stochastic_diameter.py proves the bound.

    hub: (steps (N,), the fewest from the hub to each node; times, bound (N,), expected steps from each node to the hub
    and from the hub to it, at most; new (N,)). into: see `outcomes_into`. room: (index, queue, pushed, turns: see
    `_around`; cost, leak: (nodes, previous actions + 1), c(x) and l(x) after each previously executed action, the last
    for none). x is reached with any of those, so c(x) is the largest.
    """
    first, action, node, prob, owner = outcomes
    now, before, uniform, first_now, first_uniform, num_previous, num_actions = execution
    steps, times, bound, new = hub
    index, queue, pushed, _, cost, leak = room
    none = cost.shape[1] - 1
    by_cost, by_leak = np.zeros(num_actions), np.zeros(num_actions)
    for z in targets:
        # the nodes around z; at first each of them gives up at once: c = times, l = 1, and 0 at z
        size, count = _around(z, owner, into, steps, room)
        guess = min(bound[z], 1e300)
        for i in range(size):
            cost[i], leak[i] = times[queue[i]], 1.0
        cost[0], leak[0] = 0.0, 0.0
        for _ in range(sweeps):
            gained = 0.0
            for i in range(1, size):
                x = queue[i]
                by_cost[:], by_leak[:] = 0.0, 0.0
                # expected c and l of the next node: of outcomes of any action, by action, and of all actions
                always_cost, always_leak, all_cost, all_leak = 1.0, 0.0, 0.0, 0.0
                for j in range(first[x], first[x + 1]):
                    p, a = index[node[j]], action[j]
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
                # the action with the least total time, if giving up costs the present bound of z
                best = 0
                for a in range(1, num_actions):
                    if by_cost[a] + by_leak[a] * guess < by_cost[best] + by_leak[best] * guess:
                        best = a
                # new c and l after each previous action b; none (-1) stands last; kept if the total falls
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
            if gained <= LEAST_GAIN * guess:
                break
        # the best node x to come from, with the rounding of all sums on top
        least = bound[z]
        for i in range(1, size):
            remainder = 1 - leak[i].max() * UPDATES - MASS_ROUNDING
            if remainder > 0:
                least = min(least, (bound[queue[i]] + cost[i].max() * UPDATES) / remainder * (1 + 8 * EPSILON))
        new[z] = least
        for i in range(count):
            index[pushed[i, 0]] = 0


@kernel
def _around(z, owner, into, steps, room):
    """Collect nodes on the way to z, those on short ways from the hub first; returns (size, count of `pushed`).

    queue[:size]: the nodes, as many as the queue holds; index[n], int32: the index of n in it, plus one; -1 while it
    waits; zero before, and the caller makes it so again. A node of which z is k steps away, and that lies on a way from
    the hub to z that is s steps longer than the shortest one, comes k + DETOUR s-th: its steps to z count, and those
    lost. A queue of buckets: `turns` has the first node of each of the next MOST_TURNS turns, `pushed` are (node, the
    next of its turn).
    """
    index, queue, pushed, turns, _, _ = room
    into_first, into_outcome = into
    turns[:] = -1
    pushed[0, 0], pushed[0, 1], turns[0] = z, -1, 0
    index[z] = -1
    size, count, turn, idle = 0, 1, 0, 0
    while idle <= MOST_TURNS and size < len(queue):
        # the next node of this turn; the search ends after MOST_TURNS turns without any
        at = turns[turn % MOST_TURNS]
        if at < 0:
            turn += 1
            idle += 1
            continue
        idle = 0
        turns[turn % MOST_TURNS] = pushed[at, 1]
        n = pushed[at, 0]
        queue[size] = n
        size += 1
        index[n] = size
        # push its predecessors, later by DETOUR turns for each step that they lose
        if into_first[n + 1] - into_first[n] > CROWD:
            continue
        for k in range(into_first[n], into_first[n + 1]):
            x = owner[into_outcome[k]]
            lost = 1 + steps[x] - steps[n]
            if index[x] == 0 and 0 <= lost < (MOST_TURNS - 1) // DETOUR and count < len(pushed):
                then = (turn + 1 + DETOUR * lost) % MOST_TURNS
                pushed[count, 0], pushed[count, 1] = x, turns[then]
                turns[then] = count
                index[x] = -1
                count += 1
    return size, count


def steps_from(hub, first, node):
    """(N,) int32: the fewest steps in which outcomes lead from the hub to each node, NEVER if none do."""
    steps, is_hub = np.empty(len(first) - 1, np.int32), np.zeros(len(first) - 1, np.bool_)
    is_hub[hub] = True
    backward_order(first, node, is_hub, np.empty(len(first) - 1, np.int64), steps)
    steps[steps < 0] = NEVER
    return steps
