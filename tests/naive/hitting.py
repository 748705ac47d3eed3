"""Least expected hitting times by value iteration on explicit matrices: the slow twin of
pharos.hardness.stochastic_diameter."""

import itertools
import math
from fractions import Fraction

import numpy as np

from naive.mdp import augmented, outcomes

FAR = 1e12  # stands for infinity inside of the iteration


def hitting_times(mdp, restart):
    """(times (N, S + 1): from node n to state e, column S the end; reachable nodes; state of each node; starts
    (N,))."""
    P, _, start = augmented(mdp)
    num_states, width = mdp.num_states, mdp.num_actions + 1
    size = len(P)
    state = np.append(np.repeat(np.arange(num_states), width), num_states)
    over = np.append(np.repeat(mdp.terminal, width), True)
    for n in np.flatnonzero(over):
        P[n] = start if restart else np.eye(size)[n]
    reached = start > 0
    while True:
        more = reached | (P[reached].sum(axis=(0, 1)) > 0)
        if (more == reached).all():
            break
        reached = more
    times = np.empty((size, num_states + 1))
    for target in range(num_states + 1):
        goal = state == target
        sure, change = goal.astype(float), 1.0  # largest probability of ever arriving
        while change > 1e-13:
            new = np.where(goal, 1.0, (P @ sure).max(axis=1))
            change, sure = np.abs(new - sure).max(), new
        lost = sure < 1 - 1e-9
        j, change = np.where(lost, FAR, 0.0), 1.0
        while change > 1e-12 * max(1.0, j[~lost].max(initial=0.0)):
            new = np.where(goal, 0.0, np.where(lost, FAR, 1 + (P @ j).min(axis=1)))
            change, j = np.abs(new - j).max(), new
        times[:, target] = np.where(lost, math.inf, j)
    return times, reached, state, start


def nodes_that_count(mdp, reached, state):
    """Nodes that the maximum runs over: one a state without sticky actions, else the reachable pairs and starts."""
    width = mdp.num_actions + 1
    ends = any_end(mdp)
    if mdp.is_sticky:
        return np.flatnonzero(reached & ((state < mdp.num_states) | ends))
    first = np.arange(mdp.num_states) * width  # the previous action does not matter: take any node
    return np.append(first, len(state) - 1) if ends else first


def any_end(mdp):
    """Whether a state that is not terminal leads to the implicit end."""
    pairs = ((s, a) for s in np.flatnonzero(~mdp.terminal) for a in range(mdp.num_actions))
    return any(t < 0 and p > 1e-12 for s, a in pairs for t, p in outcomes(mdp, s, a))


def diameter(mdp, restart):
    """(largest hitting time between different states, or inf; largest finite one)."""
    times, reached, state, _ = hitting_times(mdp, restart)
    nodes = nodes_that_count(mdp, reached, state)
    targets = range(mdp.num_states + any_end(mdp))
    found = [times[n, e] for n in nodes for e in targets if state[n] != e]
    return max(found, default=0.0), max((t for t in found if math.isfinite(t)), default=0.0)


def start_eccentricity(mdp, restart):
    """The largest expected time from the start to a state."""
    times, _, _, start = hitting_times(mdp, restart)
    targets = range(mdp.num_states + any_end(mdp))
    first = start > 0
    return max(float(times[first, e] @ start[first]) for e in targets)


def exact_hitting_times(matrix):
    """[s][e] least expected steps from s to e, as exact fractions or inf; matrix (S, A, S). Every policy, one after the
    other."""
    num_states, num_actions, _ = matrix.shape
    best = [[math.inf] * num_states for _ in range(num_states)]
    rows = [[[Fraction(float(p)) for p in matrix[s, a]] for a in range(num_actions)] for s in range(num_states)]
    for policy in itertools.product(range(num_actions), repeat=num_states):
        chain = [rows[s][a] for s, a in enumerate(policy)]
        for goal in range(num_states):
            for s, time in enumerate(_times_of(chain, goal)):
                best[s][goal] = min(best[s][goal], time)
    return best


def _times_of(chain, goal):
    """Expected steps to the goal from each state of a chain of fractions."""
    size = len(chain)
    reaches = {goal}  # those from which the goal can be reached
    while more := {s for s in range(size) if s not in reaches and any(chain[s][t] for t in reaches)}:
        reaches |= more
    sure = set(reaches)  # and what cannot be reached from them cannot be missed
    while bad := {s for s in sure - {goal} if any(chain[s][t] for t in range(size) if t not in sure)}:
        sure -= bad
    inner = sorted(sure - {goal})
    table = [[(s == t) - chain[s][t] for t in inner] + [Fraction(1)] for s in inner]
    for i in range(len(inner)):
        pivot = next(k for k in range(i, len(inner)) if table[k][i])
        table[i], table[pivot] = table[pivot], table[i]
        table[i] = [x / table[i][i] for x in table[i]]
        for k in range(len(inner)):
            if k != i and table[k][i]:
                table[k] = [x - table[k][i] * y for x, y in zip(table[k], table[i], strict=True)]
    result = [math.inf] * size
    result[goal] = Fraction(0)
    for s, row in zip(inner, table, strict=True):
        result[s] = row[-1]
    return result
