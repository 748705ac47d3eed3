"""Graphs (see graph.py) that contain a clock: every edge leads from one layer of nodes to the next, and round again."""

import numpy as np
from numba import njit

from pharos.kernels.interpreted import interpreted_first


@interpreted_first()
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
def search_in_step(
    next_states, ends, order, layer_first, position, targets, layer, offset, away, home, best, scratch, visits, largest
):
    """Searches backward from many targets at once, a bit each, that stand in the same layer at the same time.

    Every edge leads from layer j to layer j + 1 modulo P; states that end lead nowhere. So a tick reads one layer,
    where searches that keep step by their levels read as many as they have targets in different layers. From a node v
    there is another way to target i, of home[v] + away[i] steps.

    order (N,): the nodes by layer, layer_first (P + 1,), position (N,): place of a node in its layer. Target i joins at
    tick offset[i], ascending from 0; `layer` is that of the first. scratch (2, widest layer, words) uint64; visits
    (N, words) uint64, zero before: by place in `order`, the targets that a node reaches.
    Returns table entries read. largest[i], `best` before, becomes the largest over all nodes of the lesser of both
    ways to target i, where that is more.
    """
    num_actions = next_states.shape[1]
    num_layers, words, num_targets = len(layer_first) - 1, visits.shape[1], len(targets)
    farthest = np.int64(home.max())
    last = np.int64(0)
    for i in range(num_targets):
        last = max(last, offset[i] + away[i] + farthest)
    joined, reads = 0, np.int64(0)
    for tick in range(last + 1):
        low, width = layer_first[layer], layer_first[layer + 1] - layer_first[layer]
        current, coming = scratch[tick % 2], scratch[1 - tick % 2]
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
        while joined < num_targets and offset[joined] == tick:
            coming[position[targets[joined]], joined // 64] |= np.uint64(1) << np.uint64(joined % 64)
            joined += 1
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
    unseen = np.zeros((farthest + 1, words), np.uint64)
    for place in range(len(order)):
        for w in range(words):
            unseen[home[order[place]], w] |= ~visits[place, w]
    for i in range(num_targets):
        steps = farthest
        while steps > 0 and not unseen[steps, i // 64] >> np.uint64(i % 64) & np.uint64(1):
            steps -= 1
        if unseen[steps, i // 64] >> np.uint64(i % 64) & np.uint64(1):
            largest[i] = max(largest[i], steps + away[i])
    return reads


@njit(cache=True, nogil=True)
def _gcd(a, b):
    while b:
        a, b = b, a % b
    return a
