"""The effective horizon straight from its definition, on explicit matrices: the slow twin of
pharos.hardness.effective_horizon."""

import math

import numpy as np

from naive.mdp import absorbing


def analysis(mdp, steps):
    """k_min, window, H and its lists, by dictionaries over (step, node) and loops over everything."""
    P, R, start = absorbing(mdp)
    size, num_actions = R.shape

    def q_of(value):
        table = [None] * steps
        after = None
        for t in reversed(range(steps)):
            table[t] = R.copy() if after is None else R + P @ after
            after = value(t, table[t])
        return table

    best = q_of(lambda t, q: q.max(axis=1))
    worst = q_of(lambda t, q: q.min(axis=1))
    explored = q_of(lambda t, q: q.mean(axis=1).clip(worst[t].min(axis=1), best[t].max(axis=1)))
    optimal = [q >= q.max(axis=1, keepdims=True) - 1e-4 for q in best]

    def onwards(q):
        return [R + P @ q[t + 1].max(axis=1) if t + 1 < steps else R for t in range(steps)]

    def equal(x, y):
        return abs(x - y) < 1e-11

    def first_greedy(q):
        for k in range(1, steps + 1):
            met, fails = set(np.flatnonzero(start)), False
            for t in range(steps):
                following = set()
                for n in met:
                    for a in range(num_actions):
                        if equal(q[t][n, a], q[t][n].max()):
                            fails |= not optimal[t][n, a]
                            following |= set(np.flatnonzero(P[n, a]))
                met = following
            if not fails:
                return k
            q = onwards(q)
        return steps

    lists, found = [], float(steps)
    q, k = explored, 1
    variance = [(explored[t] - worst[t]) * (best[t] - worst[t]) for t in range(steps)]
    while k < found:
        met, fails, most = set(np.flatnonzero(start)), False, 1
        for t in range(steps):
            following = set()
            for n in met:
                top = q[t][n].max()
                second = max((q[t][n, a] for a in range(num_actions) if not optimal[t][n, a]), default=-math.inf)
                fails |= equal(top, second) or second > top
                if not fails and second > -math.inf:
                    wanted = 16 * variance[t][n].max() / (top - second) ** 2 * math.log(2 * steps * num_actions**k)
                    most = max(most, math.ceil(wanted - 1e-6 * wanted))
                for a in range(num_actions):
                    if q[t][n, a] > second + 1e-11:
                        following |= set(np.flatnonzero(P[n, a]))
            met = following
        if not fails:
            lists.append((k, most))
            found = min(found, k + (math.log(most) / math.log(num_actions) if num_actions > 1 else 0.0))
        q, k = onwards(q), k + 1
        largest = [variance[t].max(axis=1) for t in range(steps)]
        variance = [
            np.array([[largest[t + 1][P[n, a] > 0].max() for a in range(num_actions)] for n in range(size)])
            if t + 1 < steps
            else np.zeros_like(R)
            for t in range(steps)
        ]
    return first_greedy(explored), first_greedy([R] * steps), found, lists
