"""Breadth-first searches from many nodes at once, one bit each, on a graph as in graph.py.

Both searches begin alike; as a function of its own that beginning makes them a quarter slower.

Source: Then et al. (2014), "The more the merrier: efficient multi-source graph traversal" (MS-BFS).
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def search_forward_from_many(next_states, ends, start, sources, origins, front, coming, queue, other, largest):
    """Searches from up to 64 W sources.

    origins, front, coming: (N, W) uint64, zero before; front and coming are zero again afterwards, origins[v] has the
    bits of the sources that reach v. queue, other: (N,) scratch. largest (len(sources),): their eccentricities among
    what they reach. Returns (pairs reached, table entries read).
    """
    num_states, num_actions = next_states.shape
    width = origins.shape[1]
    for i in range(len(sources)):
        bit = np.uint64(1) << np.uint64(i % 64)
        origins[sources[i], i // 64] |= bit
        front[sources[i], i // 64] |= bit
        queue[i] = sources[i]
        largest[i] = 0
    count = len(sources)
    level, pairs, reads = 0, 0, 0
    while count:
        level += 1
        size = 0
        for i in range(count):
            u = queue[i]
            if u == num_states or ends[u]:
                if start >= 0:
                    size = _push(u, start, origins, front, coming, other, size)
                continue
            reads += num_actions
            for a in range(num_actions):
                v = next_states[u, a]
                if v < 0:
                    v = num_states
                size = _push(u, v, origins, front, coming, other, size)
        pairs += _settle(queue, count, other, size, origins, front, coming, level, largest, width)
        queue, other = other, queue
        count = size
    return pairs, reads


@njit(cache=True, nogil=True)
def search_backward_from_many(
    first, previous, restarting, start, sources, origins, front, coming, queue, other, largest
):
    """As `search_forward_from_many`, against the direction of the edges."""
    width = origins.shape[1]
    for i in range(len(sources)):
        bit = np.uint64(1) << np.uint64(i % 64)
        origins[sources[i], i // 64] |= bit
        front[sources[i], i // 64] |= bit
        queue[i] = sources[i]
        largest[i] = 0
    count = len(sources)
    level, pairs, reads = 0, 0, 0
    while count:
        level += 1
        size = 0
        for i in range(count):
            v = queue[i]
            reads += first[v + 1] - first[v]
            for j in range(first[v], first[v + 1]):
                size = _push(v, previous[j], origins, front, coming, other, size)
            if v == start:
                reads += len(restarting)
                for j in range(len(restarting)):
                    size = _push(v, restarting[j], origins, front, coming, other, size)
        pairs += _settle(queue, count, other, size, origins, front, coming, level, largest, width)
        queue, other = other, queue
        count = size
    return pairs, reads


@njit(cache=True, nogil=True)
def _push(u, v, origins, front, coming, other, size):
    """Pass the bits of u that v lacks on to v; v joins the `size` nodes of the next level once. Returns its size."""
    waiting, adds = np.uint64(0), np.uint64(0)
    for w in range(origins.shape[1]):
        waiting |= coming[v, w]
        new = front[u, w] & ~origins[v, w]
        adds |= new
        coming[v, w] |= new
    if adds and not waiting:
        other[size] = v
        size += 1
    return size


@njit(cache=True, nogil=True)
def _settle(queue, count, other, size, origins, front, coming, level, largest, width):
    """Make the next level the current one; note it as the eccentricity of every source that found something."""
    for i in range(count):
        for w in range(width):
            front[queue[i], w] = 0
    pairs = 0
    for w in range(width):
        any_new = np.uint64(0)
        for i in range(size):
            v = other[i]
            new = coming[v, w]
            coming[v, w] = 0
            front[v, w] = new
            origins[v, w] |= new
            any_new |= new
            pairs += _ones(new)
        for k in range(min(64, len(largest) - 64 * w)):
            if any_new >> np.uint64(k) & np.uint64(1):
                largest[64 * w + k] = level
    return pairs


@njit(cache=True, nogil=True)
def _ones(x):
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
