"""Breadth-first searches from many nodes at once, one bit each, on a graph as in graph.py.

Source: Then et al. (2014), "The more the merrier: efficient multi-source graph traversal" (MS-BFS). Dense searches
start from 512 nodes at once, in graphs whose levels are few and wide.
"""

import numpy as np

from pharos.kernels.graph import is_new_edge
from pharos.kernels.kernel_cache import kernel


@kernel
def search_from_many(table, reverse, start, sources, origins, front, coming, queue, other, largest):
    """Search from up to 64 W sources at once, along the edges or against them.

    table, reverse: as `graph.search` has them.

    origins, front, coming: (N, W) uint64, zero before. front and coming are zero again afterwards, origins[v] has the
    bits of the sources that reach v. queue, other: (N,) scratch. largest (len(sources),): their eccentricities among
    what they reach. Returns (pairs reached, table entries read).
    """
    if reverse is not None:
        first, previous, restarting = reverse
    if table is not None:
        next_states, ends = table
        num_states, num_actions = next_states.shape
    width = origins.shape[1]
    # level 0: each source has reached itself
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
        # pass the new bits of each node of this level on to its neighbours
        for i in range(count):
            u = queue[i]
            if reverse is not None:
                reads += first[u + 1] - first[u]
                for j in range(first[u], first[u + 1]):
                    size = _push(u, previous[j], origins, front, coming, other, size)
                if u == start:
                    reads += len(restarting)
                    for j in range(len(restarting)):
                        size = _push(u, restarting[j], origins, front, coming, other, size)
            if table is not None:
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


@kernel
def _push(u, v, origins, front, coming, other, size):
    """Pass the bits of u that v lacks on to v. v joins the next level, of `size` nodes, once. Returns its size."""
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


@kernel
def _settle(queue, count, other, size, origins, front, coming, level, largest, width):
    """Make the next level the current one. Record it as the eccentricity of every source that reached something.

    Returns the pairs (source, node) reached on the next level.
    """
    for i in range(count):
        for w in range(width):
            front[queue[i], w] = 0
    pairs = 0
    # 64 sources at a time: move their new bits, count them, and see which sources go on
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


@kernel
def _ones(x):
    """Number of bits of a word x that are 1."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


# Dense searches -------------------------------------------------------------------------------------------------------


WORDS = 8  # of 64 sources: a cache line


@kernel
def dense_search_backward(next_states, ends, start, sources, origins, front, coming, active, arriving, largest):
    """largest[i] = the largest distance to sources[i] of a node that leads there, for at most 512 sources, a bit for
    each.

    Every node reads, level by level, what its successors have reached: one cache line for each edge on a level where
    the successor has new bits. It writes its own alone. A node that leads to all sources reads no more.
    origins, front, coming: (N, 8) uint64, active, arriving: (N,) bool, zero before.
    Returns the number of lines read from successors.
    Source: Then et al. (2014), bit-parallel search; Beamer, Asanovic and Patterson (2012), bottom-up steps.
    """
    num_states, num_actions = next_states.shape
    all_sources, news = np.zeros(WORDS, np.uint64), np.zeros(WORDS, np.uint64)
    # level 0: each source has reached itself
    for i in range(len(sources)):
        bit = np.uint64(1) << np.uint64(i % 64)
        origins[sources[i], i // 64] |= bit
        front[sources[i], i // 64] |= bit
        active[sources[i]] = True
        all_sources[i // 64] |= bit
        largest[i] = 0
    level, reads, goes_on = 0, 0, True
    while goes_on:
        level += 1
        goes_on = False
        news[:] = 0
        for v in range(len(origins)):
            arriving[v] = False
            # skip a node that already leads to all sources
            missing = np.uint64(0)
            for w in range(WORDS):
                missing |= all_sources[w] & ~origins[v, w]
            if not missing:
                continue
            # join the bits of all successors that were new on the last level
            is_end = v == num_states or ends[v]
            has_bits = False
            for a in range(1 if is_end else num_actions):
                u = _successor(next_states, start, v, a, is_end)
                if u >= 0 and active[u]:
                    reads += 1
                    if has_bits:
                        for w in range(WORDS):
                            coming[v, w] |= front[u, w]
                    else:
                        for w in range(WORDS):
                            coming[v, w] = front[u, w]
                        has_bits = True
            # keep those that are new to v; they go on at the next level
            if has_bits:
                added = np.uint64(0)
                for w in range(WORDS):
                    new = coming[v, w] & ~origins[v, w]
                    coming[v, w] = new
                    origins[v, w] |= new
                    news[w] |= new
                    added |= new
                if added:
                    arriving[v] = goes_on = True
        # a source that reached a new node has one at this distance
        for i in range(len(sources)):
            if news[i // 64] >> np.uint64(i % 64) & np.uint64(1):
                largest[i] = level
        front, coming = coming, front
        active, arriving = arriving, active
    return reads


@kernel
def spread_out(next_states, ends, order, blocked, limit):
    """The first nodes of `order`, at most `limit`, none of them a successor of one before. blocked: (N,) bool, zero."""
    selection = np.empty(limit, order.dtype)
    count = 0
    for i in range(len(order)):
        v = order[i]
        if count == limit:
            break
        if blocked[v]:
            continue
        selection[count] = v
        count += 1
        if v < len(next_states) and not ends[v]:
            for a in range(next_states.shape[1]):
                u = next_states[v, a]
                if u >= 0 and u != v:
                    blocked[u] = True
    return selection[:count]


@kernel
def num_successors(next_states, ends, num_nodes):
    """(N,) uint8: how many different nodes other than itself each node leads to, at most 255."""
    num_states, num_actions = next_states.shape
    counts = np.ones(num_nodes, np.uint8)
    for v in range(num_states):
        if ends[v]:
            continue
        different = 0
        for a in range(num_actions):
            different += is_new_edge(next_states, v, a)
        counts[v] = min(different, 255)
    return counts


@kernel
def lower_along_edges(next_states, ends, start, in_upper, out_upper):
    """One pass of in(v) <= 1 + in(u) and out(u) <= 1 + out(v) over the edges (u, v). Return whether a bound got
    lower."""
    num_states, num_actions = next_states.shape
    lowered = False
    for u in range(len(in_upper)):
        is_end = u == num_states or ends[u]
        for a in range(1 if is_end else num_actions):
            v = _successor(next_states, start, u, a, is_end)
            if v < 0:
                continue
            if in_upper[v] - 1 > in_upper[u]:
                in_upper[v] = in_upper[u] + 1
                lowered = True
            if out_upper[u] - 1 > out_upper[v]:
                out_upper[u] = out_upper[v] + 1
                lowered = True
    return lowered


@kernel
def _successor(next_states, start, v, a, is_end):
    """The node that v leads to by a: `start`, or -1, if v is an end, and node S if a ends the episode."""
    if is_end:
        return start
    u = np.int64(next_states[v, a])
    return u if u >= 0 else len(next_states)
