"""Breadth-first searches, eccentricities, periods and symmetries of the graph of a deterministic MDP.

Nodes are the S states and, if some transition is -1, one more: node S, the implicit end of an episode. `ends` (S,)
bool marks states whose row is not followed (terminal states). With `start` >= 0 every such state and node S lead to
`start` in one step, without that edge being stored. With `start` = -1 they lead nowhere.

Searches go forward on the table of next states and backward on a reversed copy. Distances are in steps, -1 if there
is no path. `queue` is scratch of one entry a node. After a search it holds the nodes found, in the order of their
distance.

Distance sweeps need neither queue nor reversed copy: they pass over the table in order. distance (N,) holds 0 at the
source and `far`, the largest number of its type, elsewhere, and upper bounds from then on. They are the distances once
a sweep changes nothing, as none can be lowered along an edge then. Breadth-first search numbers a state before those
that it leads to, so that most paths are followed in one sweep.

A graph with a clock is periodic: every edge leads from one of P layers of nodes to the next, and round again.
Symmetries of a deterministic table are maps of the states onto each other under which every action does the same.
"""

import numpy as np

from pharos.kernels.interpreted import interpreted_first
from pharos.kernels.kernel_cache import kernel
from pharos.kernels.outcomes import outcome, outcome_numbers, size_of


@interpreted_first()
@kernel
def search(table, reverse, start, source, distance, queue):
    """distance[v] = steps from `source` to v by the table, or from v to `source` by the reversed graph.

    table: (next_states, ends), or None. reverse, if table is None: (first, previous) of `reversed_graph`, and the
    nodes that lead to `start`. Returns (nodes found, largest distance, sum of distances).
    """
    if reverse is not None:
        first, previous, restarting = reverse
    if table is not None:
        next_states, ends = table
        num_states, num_actions = next_states.shape
    distance[:] = -1
    distance[source] = 0
    queue[0] = source
    head, tail = 0, 1
    total = 0
    while head < tail:
        u = queue[head]
        head += 1
        total += distance[u]
        d = distance[u] + 1
        # backward: stored predecessors of u, and at `start` the states that restart there
        if reverse is not None:
            for i in range(first[u], first[u + 1]):
                v = previous[i]
                if distance[v] < 0:
                    distance[v] = d
                    queue[tail] = v
                    tail += 1
            if u == start:
                for i in range(len(restarting)):
                    v = restarting[i]
                    if distance[v] < 0:
                        distance[v] = d
                        queue[tail] = v
                        tail += 1
        # forward: an end leads to `start` alone, other states to their successors
        if table is not None:
            if u == num_states or ends[u]:
                if start >= 0 and distance[start] < 0:
                    distance[start] = d
                    queue[tail] = start
                    tail += 1
                continue
            for a in range(num_actions):
                v = next_states[u, a]
                if v < 0:
                    v = num_states
                if distance[v] < 0:
                    distance[v] = d
                    queue[tail] = v
                    tail += 1
    return tail, distance[queue[tail - 1]], total


@interpreted_first()
@kernel
def fill_predecessors(next_states, ends, first, previous):
    """previous[first[v] : first[v + 1]] = distinct predecessors of v other than v, by rows that are followed.

    `first` is shifted by one place before: first[v + 1] is the beginning of v. The call moves it to the end of v. If
    `previous` is None, the call counts only: first (zero before) becomes the number of predecessors, one place ahead.
    """
    num_states, num_actions = next_states.shape
    for u in range(num_states):
        if ends[u]:
            continue
        for a in range(num_actions):
            if is_new_edge(next_states, u, a):
                v = next_states[u, a]
                w = (num_states if v < 0 else v) + 1
                if previous is not None:
                    previous[first[w]] = u
                first[w] += 1


@kernel
def is_new_edge(next_states, u, a):
    """Whether action a leads from u to another node, to which no action before it leads."""
    v = next_states[u, a]
    if v == u:
        return False
    for b in range(a):
        if next_states[u, b] == v:
            return False
    return True


def reversed_graph(next_states, ends, num_nodes):
    """(first, previous) of the reversed graph by a counting sort, without loops and repeated edges.

    Cost: two passes over the table, one entry an edge and one a node, of 4 bytes below 2^31 edges, else 8.
    """
    small = next_states.size < 2**31
    counts = np.zeros(num_nodes + 2, np.int32 if small else np.int64)
    fill_predecessors(next_states, ends, counts[1:], None)
    first = np.cumsum(counts, dtype=counts.dtype)  # first[v + 1]: beginning of v; the fill moves it to its end
    previous = np.empty(first[-1], next_states.dtype)
    fill_predecessors(next_states, ends, first[:-1], previous)
    return first[:-1], previous


@interpreted_first()
@kernel
def bound_eccentricities(from_pivot, to_pivot, out_pivot, in_pivot, out_lower, out_upper, in_lower, in_upper):
    """Tighten the bounds of all eccentricities from a search in both directions from one pivot p.

    out(v) = max over w of d(v, w) <= d(v, p) + out(p), and >= d(v, p). in(v) = max over w of d(w, v) likewise.
    from_pivot[v] = d(p, v), to_pivot[v] = d(v, p). out_pivot, in_pivot: the eccentricities of p.
    """
    for v in range(len(from_pivot)):
        to, away = to_pivot[v], from_pivot[v]
        out_lower[v] = max(out_lower[v], to)
        in_lower[v] = max(in_lower[v], away)
        out_upper[v] = min(out_upper[v], to + out_pivot)
        in_upper[v] = min(in_upper[v], away + in_pivot)


@interpreted_first()
@kernel
def open_eccentricities(out_lower, out_upper, in_lower, in_upper, best):
    """Summary of the nodes whose eccentricity may exceed `best`: how many are open, and the node to search from next.

    Returns (open out, open in, node of the largest upper bound out, the same in, open node in the middle): the middle
    is the least sum of lower bounds. Ties of upper bounds go to the larger lower bound.
    """
    num_out, num_in = 0, 0
    far_out, far_in, middle = -1, -1, -1
    for v in range(len(out_lower)):
        is_open = False
        # out(v) may exceed `best`: keep the node of the largest bound
        if out_upper[v] > best:
            num_out += 1
            is_open = True
            if (
                far_out < 0
                or out_upper[v] > out_upper[far_out]
                or (out_upper[v] == out_upper[far_out] and out_lower[v] > out_lower[far_out])
            ):
                far_out = v
        # the same for in(v)
        if in_upper[v] > best:
            num_in += 1
            is_open = True
            if (
                far_in < 0
                or in_upper[v] > in_upper[far_in]
                or (in_upper[v] == in_upper[far_in] and in_lower[v] > in_lower[far_in])
            ):
                far_in = v
        # a node near to all others, by its lower bounds, tightens the bounds of many
        if is_open and (middle < 0 or out_lower[v] + in_lower[v] < out_lower[middle] + in_lower[middle]):
            middle = v
    return num_out, num_in, far_out, far_in, middle


@interpreted_first("n")
@kernel
def onwards(transitions, nodes, n, next_nodes, is_visited):
    """States that nodes[:n] lead to and that were not visited before. Returns how many.

    next_nodes (S,): the first entries get them. is_visited: (S,) bool.
    """
    count = 0
    for i in range(n):
        for a in range(size_of(transitions)[1]):
            for j in outcome_numbers(transitions, nodes[i], a):
                t, _ = outcome(transitions, nodes[i], a, j)
                if t >= 0 and not is_visited[t]:
                    is_visited[t] = True
                    next_nodes[count] = t
                    count += 1
    return count


# Distance sweeps ------------------------------------------------------------------------------------------------------


@kernel
def lower_backward(next_states, ends, start, distance, far, first, stop):
    """distance[u] = min(distance[u], 1 + the least distance of its successors), for rows [first, stop), last one first.

    Returns how many it lowered, -1 if a distance reaches `far`.
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


@kernel
def lower_forward(next_states, ends, start, distance, far, first, stop):
    """distance[v] = min(distance[v], distance[u] + 1) for the successors v of rows u in [first, stop), first one first.

    Returns how many it lowered, -1 if a distance reaches `far`.
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


@kernel
def summary(distance, far):
    """(nodes found, largest distance among them, sum of their distances)."""
    reach, largest, total = 0, 0, 0
    for v in range(len(distance)):
        d = distance[v]
        if d < far:
            reach += 1
            total += d
            largest = max(largest, d)
    return reach, largest, total


# Clocks ---------------------------------------------------------------------------------------------------------------


@interpreted_first()
@kernel
def period(next_states, ends, start, level, has_end):
    """Greatest common divisor of level(u) + 1 - level(v) over all edges (u, v), that is, of the lengths of all cycles.

    level[v] = distance from some node to v. The graph must be strongly connected. 0 if there is no edge.
    """
    num_states, num_actions = next_states.shape
    divisor = np.int64(0)
    # the edge from node S, the end, to `start`
    if start >= 0 and has_end:
        divisor = np.int64(level[num_states]) + 1 - level[start]
    for u in range(num_states):
        if ends[u]:
            if start >= 0:
                divisor = _gcd(divisor, np.int64(level[u]) + 1 - level[start])
        else:
            for a in range(num_actions):
                v = next_states[u, a]
                if v < 0:
                    v = num_states
                divisor = _gcd(divisor, np.int64(level[u]) + 1 - level[v])
        if divisor == 1 or divisor == -1:
            break
    return abs(divisor)


@kernel
def last_gap(next_states, ends, start, order, layer_first, position, current, coming, max_reads):
    """Largest k such that some node does not yet reach its whole layer in exactly k steps.

    Every edge leads from layer j to layer j + 1 modulo P. order (N,): the nodes by layer, layer_first (P + 1,),
    position (N,): index of a node in its layer. current, coming: (widest layer, words) uint64 scratch.
    Returns (gap, table entries read). The gap is -1 if layers are single nodes, -2 if it is at least P, -3 if
    `max_reads` were not enough.

    f(j) = first k for which every node of layer j reaches layer j + k whole. f(j) <= f(j + 1) + 1. So going down from a
    layer whose f is known, layers that cannot pass the best gap so far are skipped.
    """
    num_states, num_actions = next_states.shape
    num_layers = len(layer_first) - 1
    gap, bound, reads = -1, num_layers + 2, 0
    for back in range(num_layers):
        origin = (num_layers - back) % num_layers
        bound += 1
        if bound - 1 <= gap:
            continue
        # bit i of current[p]: node i of the origin reaches node p of the layer at hand; at first itself alone
        width = layer_first[origin + 1] - layer_first[origin]
        words = (width + 63) // 64
        last_word = ~np.uint64(0) if width % 64 == 0 else (np.uint64(1) << np.uint64(width % 64)) - np.uint64(1)
        current[:width, :words] = 0
        for i in range(width):
            current[i, i // 64] = np.uint64(1) << np.uint64(i % 64)
        k, full = 0, width == 1
        layer = origin
        while not full:
            if k >= num_layers:
                return -2, reads
            if reads > max_reads:
                return -3, reads
            # pass the bits on along the edges to the next layer
            next_layer = layer + 1 if layer + 1 < num_layers else 0
            next_width = layer_first[next_layer + 1] - layer_first[next_layer]
            coming[:next_width, :words] = 0
            for i in range(layer_first[layer], layer_first[layer + 1]):
                u = order[i]
                p = position[u]
                if u == num_states or ends[u]:
                    q = position[start]
                    for w in range(words):
                        coming[q, w] |= current[p, w]
                    continue
                for a in range(num_actions):
                    v = next_states[u, a]
                    q = position[num_states if v < 0 else v]
                    for w in range(words):
                        coming[q, w] |= current[p, w]
            reads += words * num_actions * (layer_first[layer + 1] - layer_first[layer])
            # f is known when every node of the layer is reached by all nodes of the origin
            full = True
            for q in range(next_width):
                for w in range(words):
                    if coming[q, w] != (last_word if w == words - 1 else ~np.uint64(0)):
                        full = False
                        break
                if not full:
                    break
            current, coming = coming, current
            layer = next_layer
            k += 1
        bound = k
        gap = max(gap, k - 1)
    return gap, reads


@kernel
def search_in_step(
    next_states, ends, order, layer_first, position, targets, layer, offset, away, home, best, scratch, visits, largest
):
    """Search backward from many targets at once, a bit each, so that all searches stand in the same layer at each tick.

    Every edge leads from layer j to layer j + 1 modulo P. States that end lead nowhere. So a tick reads one layer,
    whereas searches that keep step by their levels read as many as they have targets in different layers. From a node v
    there is another way to target i, of home[v] + away[i] steps.

    order (N,): the nodes by layer, layer_first (P + 1,), position (N,): index of a node in its layer. Target i joins at
    tick offset[i], ascending from 0. `layer` is the layer of the first. scratch: (2, widest layer, words) uint64.
    visits (N, words) uint64, zero before: by index in `order`, the targets that a node reaches.
    Returns table entries read. largest[i], `best` before, becomes the largest over all nodes of the lesser of both
    ways to target i, if that is more.
    """
    num_actions = next_states.shape[1]
    num_layers, words, num_targets = len(layer_first) - 1, visits.shape[1], len(targets)
    farthest = np.int64(home.max())
    # the tick after which no search can beat the other way
    last = np.int64(0)
    for i in range(num_targets):
        last = max(last, offset[i] + away[i] + farthest)
    joined, reads = 0, np.int64(0)
    for tick in range(last + 1):
        low, width = layer_first[layer], layer_first[layer + 1] - layer_first[layer]
        current, coming = scratch[tick % 2], scratch[1 - tick % 2]
        # targets that the nodes of this layer reach by an edge into the layer of the last tick
        for p in range(width):
            u = order[low + p]
            for w in range(words):
                coming[p, w] = 0
            if tick > 0 and not ends[u]:
                for a in range(num_actions):
                    q = position[next_states[u, a]]
                    for w in range(words):
                        coming[p, w] |= current[q, w]
        reads += num_actions * width
        # targets of this layer that join now
        while joined < num_targets and offset[joined] == tick:
            coming[position[targets[joined]], joined // 64] |= np.uint64(1) << np.uint64(joined % 64)
            joined += 1
        # nodes that reach a target for the first time: their distance is the time since it joined
        for p in range(width):
            for w in range(words):
                new = coming[p, w] & ~visits[low + p, w]
                visits[low + p, w] |= new
                if new and tick > best:
                    for i in range(64 * w, min(64 * w + 64, num_targets)):
                        if new >> np.uint64(i % 64) & np.uint64(1):
                            steps = min(np.int64(tick - offset[i]), np.int64(home[order[low + p]] + away[i]))
                            largest[i] = max(largest[i], steps)
        layer = layer - 1 if layer else num_layers - 1
    # nodes that the searches did not reach have the other way alone: the farthest of them counts
    unseen = np.zeros((farthest + 1, words), np.uint64)
    for index in range(len(order)):
        for w in range(words):
            unseen[home[order[index]], w] |= ~visits[index, w]
    for i in range(num_targets):
        steps = farthest
        while steps > 0 and not unseen[steps, i // 64] >> np.uint64(i % 64) & np.uint64(1):
            steps -= 1
        if unseen[steps, i // 64] >> np.uint64(i % 64) & np.uint64(1):
            largest[i] = max(largest[i], steps + away[i])
    return reads


@kernel
def _gcd(a, b):
    """Greatest common divisor, but for its sign."""
    while b:
        a, b = b, a % b
    return a


# Symmetries -----------------------------------------------------------------------------------------------------------


@interpreted_first("queue")
@kernel
def symmetry(next_states, ends, start, s, t, image, preimage, queue):
    """Find the map f with f(s) = t and f(next_states[u, a]) = next_states[f(u), a]. There is at most one.

    All states must be within reach of s. A state that ends the episode is mapped to such a one, the end (-1) to
    itself, and so is `start` if states lead there as they end. image, preimage: (S,), zero before. Afterwards, as far
    as queue[:steps], image[u] = f(u) + 1 and preimage[f(u)] = u + 1. Returns (whether there is such a map, steps).
    """
    num_states, num_actions = next_states.shape
    image[s], preimage[t], queue[0] = t + 1, s + 1, s
    head, tail, restarts = 0, 1, False
    while head < tail:
        u = queue[head]
        head += 1
        x = image[u] - 1
        # u and its image x must both end the episode, or neither
        if ends[u] != ends[x]:
            return False, tail
        if ends[u]:
            restarts = start >= 0
            continue
        for a in range(num_actions):
            # their successors determine the map further, or contradict it
            v, y = next_states[u, a], next_states[x, a]
            if v < 0 or y < 0:
                if v != y:
                    return False, tail
                restarts = start >= 0
            elif image[v] == 0 and preimage[y] == 0:
                image[v], preimage[y], queue[tail] = y + 1, v + 1, v
                tail += 1
            elif image[v] != y + 1:
                return False, tail
    return tail == num_states and (not restarts or image[start] == start + 1), tail


@interpreted_first("steps")
@kernel
def forget(image, preimage, queue, steps):
    """Set image and preimage back to zero in all entries that `symmetry` wrote."""
    for i in range(steps):
        preimage[image[queue[i]] - 1] = 0
        image[queue[i]] = 0


@kernel
def join(orbit, image):
    """Unite the orbits of u and its image, for every u, by union-find. Returns how many orbits there are.

    orbit (S,): a smaller state of the same orbit, or itself.
    """
    for u in range(len(orbit)):
        a, b = u, image[u] - 1
        # roots of both orbits, halving the paths to them; the smaller root stands for both
        while orbit[a] != a:
            orbit[a] = orbit[orbit[a]]
            a = orbit[a]
        while orbit[b] != b:
            orbit[b] = orbit[orbit[b]]
            b = orbit[b]
        orbit[max(a, b)] = min(a, b)
    count = 0
    for u in range(len(orbit)):
        count += orbit[u] == u
    return count
