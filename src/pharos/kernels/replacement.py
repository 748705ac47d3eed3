"""Replacement paths: distances from one node where another one must not be passed, for all others at once.

A graph is a table (S, A) of next nodes without ends, from whose node `source` all are within reach.
Source: dominators of a graph without cycles, each the nearest common one of all predecessors (Aho, Hopcroft and Ullman,
1976); where a node is not passed by all shortest paths, its loss changes nothing.
"""

import numpy as np
from numba import njit

FAR = np.iinfo(np.int32).max


@njit(cache=True, nogil=True)
def dominators(table, source, distance, queue, dominator):
    """dominator[v] = the last node before v, `source` included, that all shortest paths from `source` to v pass.

    distance (S,) from the source; queue (S,): the nodes by distance; dominator: -1 before.
    """
    dominator[source] = source
    for i in range(len(queue)):
        u = queue[i]
        for a in range(table.shape[1]):
            v = table[u, a]
            if distance[v] != distance[u] + 1:
                continue
            d = np.int64(u)
            if dominator[v] >= 0:
                e = np.int64(dominator[v])
                while d != e:
                    if distance[d] < distance[e]:
                        d, e = e, d
                    d = np.int64(dominator[d])
            dominator[v] = d


@njit(cache=True, nogil=True)
def longest_detour(first, previous, source, distance, dominator, may_fall, child, sibling, mark, nodes, detour, limit):
    """The largest distance from `source` to a node v where a node x, neither of the two, must not be passed.

    Only x that all shortest paths to v pass, and that may_fall (S,) bool. first, previous: the reversed graph, see
    graph.py. child, sibling, mark: (S,), -1 before; nodes, detour: (S,) scratch.
    Returns (that distance, -1 where there is no such x, FAR where there is no way or more than `limit` edges would be
    read; x).

    Nodes whose shortest paths all pass x are its offspring in the tree of dominators. A shortest way round x enters
    them from a node that is none, whose distance x does not change, and then stays.
    """
    for v in range(len(dominator)):
        if v != source:
            sibling[v] = child[dominator[v]]
            child[dominator[v]] = v
    largest, where, reads = -1, -1, 0
    for x in range(len(dominator)):
        if x == source or child[x] < 0 or not may_fall[x]:
            continue
        size, head = 0, -1
        u = x
        while True:
            c = child[u]
            while c >= 0:
                mark[c] = x
                nodes[size] = c
                size += 1
                c = sibling[c]
            head += 1
            if head == size:
                break
            u = nodes[head]
        for i in range(size):
            detour[nodes[i]] = FAR
        lowered = True
        while lowered:
            lowered = False
            for i in range(size):
                v = nodes[i]
                reads += first[v + 1] - first[v]
                for j in range(first[v], first[v + 1]):
                    w = previous[j]
                    if w == x:
                        continue
                    steps = detour[w] if mark[w] == x else distance[w]
                    if steps != FAR and steps + 1 < detour[v]:
                        detour[v] = steps + 1
                        lowered = True
            if reads > limit:
                return FAR, x
        for i in range(size):
            if detour[nodes[i]] > largest:
                largest, where = detour[nodes[i]], x
    return largest, where
