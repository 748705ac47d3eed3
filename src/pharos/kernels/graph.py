"""Breadth-first searches on the graph of a deterministic MDP, forward on its table and backward on a reversed copy.

Nodes are the S states and, where some transition is -1, one more: node S, the implicit end of an episode. `ends` (S,)
bool marks states whose row is not followed (terminal states). With `start` >= 0 every such state and node S lead to
`start` in one step, without that edge being stored; with `start` = -1 they lead nowhere.

Distances are in steps, -1 where there is no path. `queue` is scratch of one entry a node; after a search it holds the
nodes found, in the order of their distance.
"""

import numpy as np
from numba import njit

from pharos.kernels.outcomes import outcome, outcomes_of, size_of


@njit(cache=True, nogil=True)
def search_forward(next_states, ends, start, source, distance, queue):
    """distance[v] = steps from `source` to v. Returns (nodes found, largest distance, sum of distances)."""
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


@njit(cache=True, nogil=True)
def search_backward(first, previous, restarting, start, source, distance, queue):
    """distance[v] = steps from v to `source`. Returns (nodes found, largest distance, sum of distances).

    first (N + 1,), previous: the reversed graph (`reversed_graph`); restarting: the nodes that lead to `start`.
    """
    distance[:] = -1
    distance[source] = 0
    queue[0] = source
    head, tail = 0, 1
    total = 0
    while head < tail:
        v = queue[head]
        head += 1
        total += distance[v]
        d = distance[v] + 1
        for i in range(first[v], first[v + 1]):
            u = previous[i]
            if distance[u] < 0:
                distance[u] = d
                queue[tail] = u
                tail += 1
        if v == start:
            for i in range(len(restarting)):
                u = restarting[i]
                if distance[u] < 0:
                    distance[u] = d
                    queue[tail] = u
                    tail += 1
    return tail, distance[queue[tail - 1]], total


@njit(cache=True, nogil=True)
def count_predecessors(next_states, ends, first):
    """first[v + 1] = distinct predecessors of v other than v, by rows that are followed. `first` is zero before."""
    num_states, num_actions = next_states.shape
    for u in range(num_states):
        if ends[u]:
            continue
        for a in range(num_actions):
            if _is_new_edge(next_states, u, a):
                v = next_states[u, a]
                first[(num_states if v < 0 else v) + 1] += 1


@njit(cache=True, nogil=True)
def fill_predecessors(next_states, ends, first, previous):
    """previous[first[v] : first[v + 1]] = predecessors of v. `first` comes shifted by one place and leaves in place."""
    num_states, num_actions = next_states.shape
    for u in range(num_states):
        if ends[u]:
            continue
        for a in range(num_actions):
            if _is_new_edge(next_states, u, a):
                v = next_states[u, a]
                w = (num_states if v < 0 else v) + 1
                previous[first[w]] = u
                first[w] += 1


@njit(cache=True, nogil=True)
def _is_new_edge(next_states, u, a):
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

    Cost: two passes over the table; one entry an edge and one a node, of 4 bytes below 2^31 edges, else 8.
    """
    small = next_states.size < 2**31
    counts = np.zeros(num_nodes + 2, np.int32 if small else np.int64)
    count_predecessors(next_states, ends, counts[1:])
    first = np.cumsum(counts, dtype=counts.dtype)  # first[v + 1] is where v begins: the fill moves it to where v ends
    previous = np.empty(first[-1], next_states.dtype)
    fill_predecessors(next_states, ends, first[:-1], previous)
    return first[:-1], previous


@njit(cache=True, nogil=True)
def bound_eccentricities(from_pivot, to_pivot, out_pivot, in_pivot, out_lower, out_upper, in_lower, in_upper):
    """Tighten the bounds of all eccentricities from a search in both directions from one pivot p.

    out(v) = max over w of d(v, w) <= d(v, p) + out(p), and >= d(v, p); in(v) = max over w of d(w, v) likewise.
    from_pivot[v] = d(p, v); to_pivot[v] = d(v, p); out_pivot, in_pivot: the eccentricities of p.
    """
    for v in range(len(from_pivot)):
        to, away = to_pivot[v], from_pivot[v]
        out_lower[v] = max(out_lower[v], to)
        in_lower[v] = max(in_lower[v], away)
        out_upper[v] = min(out_upper[v], to + out_pivot)
        in_upper[v] = min(in_upper[v], away + in_pivot)


@njit(cache=True, nogil=True)
def raise_lower(distance, lower):
    """lower[v] = max(lower[v], distance[v])."""
    for v in range(len(lower)):
        lower[v] = max(lower[v], distance[v])


@njit(cache=True, nogil=True)
def open_eccentricities(out_lower, out_upper, in_lower, in_upper, best):
    """Whose eccentricity may exceed `best`, and where to search next.

    Returns (open out, open in, node of the largest upper bound out, the same in, open node in the middle): the middle
    is the least sum of lower bounds; ties of upper bounds go to the larger lower bound.
    """
    num_out, num_in = 0, 0
    far_out, far_in, middle = -1, -1, -1
    for v in range(len(out_lower)):
        is_open = False
        if out_upper[v] > best:
            num_out += 1
            is_open = True
            if (
                far_out < 0
                or out_upper[v] > out_upper[far_out]
                or (out_upper[v] == out_upper[far_out] and out_lower[v] > out_lower[far_out])
            ):
                far_out = v
        if in_upper[v] > best:
            num_in += 1
            is_open = True
            if (
                far_in < 0
                or in_upper[v] > in_upper[far_in]
                or (in_upper[v] == in_upper[far_in] and in_lower[v] > in_lower[far_in])
            ):
                far_in = v
        if is_open and (middle < 0 or out_lower[v] + in_lower[v] < out_lower[middle] + in_lower[middle]):
            middle = v
    return num_out, num_in, far_out, far_in, middle


@njit(cache=True, nogil=True)
def search_forward_from_many(next_states, ends, start, sources, seen, front, coming, queue, other, largest):
    """Forward searches from up to 64 W sources at once, one bit each (Then et al. 2014, MS-BFS).

    seen, front, coming: (N, W) uint64, zero before; front and coming are zero again afterwards, seen[v] has the bits of
    the sources that reach v. queue, other: (N,) scratch. largest (len(sources),): their eccentricities among what they
    reach. Returns (pairs reached, table entries read).
    """
    num_states, num_actions = next_states.shape
    width = seen.shape[1]
    for i in range(len(sources)):
        bit = np.uint64(1) << np.uint64(i % 64)
        seen[sources[i], i // 64] |= bit
        front[sources[i], i // 64] |= bit
        queue[i] = sources[i]
        largest[i] = 0
    count = len(sources)
    level, pairs, reads = 0, 0, 0
    while count:
        level += 1
        found = 0
        for i in range(count):
            u = queue[i]
            if u == num_states or ends[u]:
                if start >= 0:
                    found = _push(u, start, seen, front, coming, other, found)
                continue
            reads += num_actions
            for a in range(num_actions):
                v = next_states[u, a]
                if v < 0:
                    v = num_states
                found = _push(u, v, seen, front, coming, other, found)
        pairs += _settle(queue, count, other, found, seen, front, coming, level, largest, width)
        queue, other = other, queue
        count = found
    return pairs, reads


@njit(cache=True, nogil=True)
def search_backward_from_many(first, previous, restarting, start, sources, seen, front, coming, queue, other, largest):
    """As `search_forward_from_many`, against the direction of the edges."""
    width = seen.shape[1]
    for i in range(len(sources)):
        bit = np.uint64(1) << np.uint64(i % 64)
        seen[sources[i], i // 64] |= bit
        front[sources[i], i // 64] |= bit
        queue[i] = sources[i]
        largest[i] = 0
    count = len(sources)
    level, pairs, reads = 0, 0, 0
    while count:
        level += 1
        found = 0
        for i in range(count):
            v = queue[i]
            reads += first[v + 1] - first[v]
            for j in range(first[v], first[v + 1]):
                found = _push(v, previous[j], seen, front, coming, other, found)
            if v == start:
                reads += len(restarting)
                for j in range(len(restarting)):
                    found = _push(v, restarting[j], seen, front, coming, other, found)
        pairs += _settle(queue, count, other, found, seen, front, coming, level, largest, width)
        queue, other = other, queue
        count = found
    return pairs, reads


@njit(cache=True, nogil=True)
def _ones(x):
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True, nogil=True)
def _push(u, v, seen, front, coming, other, found):
    """Pass the bits of u that v has not seen on to v; v joins the next level once."""
    waiting, adds = np.uint64(0), np.uint64(0)
    for w in range(seen.shape[1]):
        waiting |= coming[v, w]
        new = front[u, w] & ~seen[v, w]
        adds |= new
        coming[v, w] |= new
    if adds and not waiting:
        other[found] = v
        found += 1
    return found


@njit(cache=True, nogil=True)
def _settle(queue, count, other, found, seen, front, coming, level, largest, width):
    """Make the next level the current one; note it as the eccentricity of every source that found something."""
    for i in range(count):
        for w in range(width):
            front[queue[i], w] = 0
    pairs = 0
    for w in range(width):
        any_new = np.uint64(0)
        for i in range(found):
            v = other[i]
            new = coming[v, w]
            coming[v, w] = 0
            front[v, w] = new
            seen[v, w] |= new
            any_new |= new
            pairs += _ones(new)
        for k in range(min(64, len(largest) - 64 * w)):
            if any_new >> np.uint64(k) & np.uint64(1):
                largest[64 * w + k] = level
    return pairs


@njit(cache=True, nogil=True)
def period(next_states, ends, start, level, has_end):
    """Greatest common divisor of level(u) + 1 - level(v) over all edges (u, v), that is, of the lengths of all cycles.

    level[v] = distance from some node to v. The graph must be strongly connected. 0 where there is no edge.
    """
    num_states, num_actions = next_states.shape
    divisor = np.int64(0)
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


@njit(cache=True, nogil=True)
def _gcd(a, b):
    while b:
        a, b = b, a % b
    return a


@njit(cache=True, nogil=True)
def last_gap(next_states, ends, start, order, layer_first, position, current, coming, max_reads):
    """Largest k such that some node does not yet reach its whole layer in exactly k steps; -1 where layers are single
    nodes.

    Every edge leads from layer j to layer j + 1 modulo P. order (N,): the nodes by layer, layer_first (P + 1,),
    position (N,): place of a node in its layer. current, coming: (widest layer, words) uint64 scratch.
    Returns (gap, table entries read); the gap is -2 where it is at least P, -3 where `max_reads` were not enough.

    f(j) = first k for which every node of layer j reaches layer j + k whole; f(j) <= f(j + 1) + 1. So going down from a
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
            following = layer + 1 if layer + 1 < num_layers else 0
            coming_width = layer_first[following + 1] - layer_first[following]
            coming[:coming_width, :words] = 0
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
            full = True
            for q in range(coming_width):
                for w in range(words):
                    if coming[q, w] != (last_word if w == words - 1 else ~np.uint64(0)):
                        full = False
                        break
                if not full:
                    break
            current, coming = coming, current
            layer = following
            k += 1
        bound = k
        gap = max(gap, k - 1)
    return gap, reads


@njit(cache=True, nogil=True)
def mark_reachable(next_states, ends, reached, queue, tail):
    """reached[v] = True for all that can be reached; `queue` holds `tail` nodes that are marked already."""
    head = 0
    while head < tail:
        u = queue[head]
        head += 1
        if ends[u]:
            continue
        for a in range(next_states.shape[1]):
            v = next_states[u, a]
            if v >= 0 and not reached[v]:
                reached[v] = True
                queue[tail] = v
                tail += 1


@njit(cache=True, nogil=True)
def onwards(transitions, nodes, n, following, seen):
    """States that nodes[:n] lead to and that were not seen before; returns how many. seen (S,) bool."""
    count = 0
    for i in range(n):
        for a in range(size_of(transitions)[1]):
            for j in outcomes_of(transitions, nodes[i], a):
                t, _ = outcome(transitions, nodes[i], a, j)
                if t >= 0 and not seen[t]:
                    seen[t] = True
                    following[count] = t
                    count += 1
    return count
