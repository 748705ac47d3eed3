"""Slow twins of the hardness measures: the definitions, on explicit matrices, for MDPs of a few states."""

import numpy as np


def distances(mdp, *, restart=True):
    """(N, N) distances between all nodes of a deterministic MDP (the end is one more where it occurs), by
    Floyd-Warshall."""
    table, terminal = mdp.next_states, mdp.terminal
    size = len(table) + bool((table[~terminal] == -1).any())
    d = np.full((size, size), np.inf)
    np.fill_diagonal(d, 0)
    (start,) = mdp.start_states
    for s in range(size):
        if s == len(table) or terminal[s]:
            if restart and s != start:
                d[s, start] = 1
        else:
            for t in table[s]:
                if t != s:
                    d[s, t] = 1  # -1 is the last node
    for k in range(size):
        d = np.minimum(d, d[:, k : k + 1] + d[k : k + 1, :])
    return d
