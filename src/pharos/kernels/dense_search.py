"""Searches from 512 nodes at once in graphs whose levels are few and wide, and what follows for neighbouring nodes.

A graph is given as in `kernels.graph`: next_states (S, A), -1 leads to the end, node S; a node that ends the episode
leads to `start`, or nowhere where that is -1.
"""

import numpy as np
from numba import njit

WORDS = 8  # of 64 sources: a cache line


@njit(cache=True, nogil=True)
def dense_search_backward(next_states, ends, start, sources, origins, front, coming, active, arriving, largest):
    """largest[i] = the largest distance to sources[i] of a node that leads there; at most 512 sources, a bit for each.

    Every node asks, level by level, what its successors have reached: one cache line read for each edge on a level
    where the successor has news, none written but its own. A node that leads to all sources asks no more.
    origins, front, coming: (N, 8) uint64, active, arriving: (N,) bool; zero before.
    Returns the number of lines read from successors.
    Source: Then et al. (2014), bit-parallel search; Beamer, Asanovic and Patterson (2012), asking in place of telling.
    """
    num_states, num_actions = next_states.shape
    all_sources, news = np.zeros(WORDS, np.uint64), np.zeros(WORDS, np.uint64)
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
            missing = np.uint64(0)
            for w in range(WORDS):
                missing |= all_sources[w] & ~origins[v, w]
            if not missing:
                continue
            is_end = v == num_states or ends[v]
            heard = False
            for a in range(1 if is_end else num_actions):
                u = _successor(next_states, start, v, a, is_end)
                if u >= 0 and active[u]:
                    reads += 1
                    if heard:
                        for w in range(WORDS):
                            coming[v, w] |= front[u, w]
                    else:
                        for w in range(WORDS):
                            coming[v, w] = front[u, w]
                        heard = True
            if heard:
                added = np.uint64(0)
                for w in range(WORDS):
                    new = coming[v, w] & ~origins[v, w]
                    coming[v, w] = new
                    origins[v, w] |= new
                    news[w] |= new
                    added |= new
                if added:
                    arriving[v] = goes_on = True
        for i in range(len(sources)):
            if news[i // 64] >> np.uint64(i % 64) & np.uint64(1):
                largest[i] = level
        front, coming = coming, front
        active, arriving = arriving, active
    return reads


@njit(cache=True, nogil=True)
def spread_out(next_states, ends, order, blocked, limit):
    """The first nodes of `order`, at most `limit`, none of them a successor of one before; blocked (N,) bool, zero."""
    chosen = np.empty(limit, order.dtype)
    count = 0
    for i in range(len(order)):
        v = order[i]
        if count == limit:
            break
        if blocked[v]:
            continue
        chosen[count] = v
        count += 1
        if v < len(next_states) and not ends[v]:
            for a in range(next_states.shape[1]):
                u = next_states[v, a]
                if u >= 0 and u != v:
                    blocked[u] = True
    return chosen[:count]


@njit(cache=True, nogil=True)
def num_successors(next_states, ends, num_nodes):
    """(N,) uint8: how many different nodes other than itself each node leads to, at most 255."""
    num_states, num_actions = next_states.shape
    counts = np.ones(num_nodes, np.uint8)
    for v in range(num_states):
        if ends[v]:
            continue
        different = 0
        for a in range(num_actions):
            u = next_states[v, a]
            is_new = u != v
            for b in range(a):
                is_new = is_new and next_states[v, b] != u
            different += is_new
        counts[v] = min(different, 255)
    return counts


@njit(cache=True, nogil=True)
def lower_along_edges(next_states, ends, start, in_upper, out_upper):
    """One pass of in(v) <= 1 + in(u) and out(u) <= 1 + out(v) over the edges (u, v); whether a bound got lower."""
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


@njit(cache=True, nogil=True)
def _successor(next_states, start, v, a, is_end):
    """The node that v leads to by a; -1 where that is an end which leads nowhere."""
    if is_end:
        return start
    u = np.int64(next_states[v, a])
    return u if u >= 0 else len(next_states)
