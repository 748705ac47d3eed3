"""Bellman backups in place, over flat arrays. mdp/dynamics.py says what they mean, solvers/ proves their bounds.

Common arguments: transitions: see kernels/outcomes.py; table, palette: see mdp/rewards.py; v (S + 1,) float64,
under sticky actions (S + 1, A) by the previously executed action, with row S 0, so that index -1 reads 0; weights:
(chosen, previous, uniform); choice: 1.0 maximises, -1.0 minimises, (S,) integers are the actions of a policy; actions:
a tuple of A zeros, whose length the compiler knows, so that the loops over actions are unrolled (a third faster). Each
sweep goes from the last state to the first, of an order (S,) or, where that is None, of their numbers, and returns the
largest change of an entry.
"""

import numpy as np
from numba import njit, types, uint64

from pharos.kernels.interpreted import interpreted_first, overload
from pharos.kernels.outcomes import expectation, fetch_values, size_of
from pharos.kernels.paths import state_at

UNROLLED = 128  # actions
# States between the one whose values are fetched and the one that is backed up: memory has that long to answer.
AHEAD = 32


def actions_of(num_actions: int) -> "tuple[int, ...] | np.ndarray":
    """The argument `actions`: a tuple of A zeros; an array where unrolled loops would take minutes to compile."""
    return (0,) * num_actions if num_actions <= UNROLLED else np.zeros(num_actions, np.int8)


def reward_at(table, palette, s, a):
    """The reward of (s, a): a palette's colour, or the entry itself."""


@overload(reward_at)
def _reward_at(table, palette, s, a):
    if table.dtype.name == "uint8":
        return lambda table, palette, s, a: palette[table[uint64(s), uint64(a)]]
    return lambda table, palette, s, a: table[uint64(s), uint64(a)]


def _backup(transitions, table, palette, gamma, uniform, choice, v, actions, s):
    """(1 - uniform) q(s, what is chosen) + uniform mean_a q(s, a)."""


@overload(_backup, jit_options={"forceinline": True})
def _backup_of(transitions, table, palette, gamma, uniform, choice, v, actions, s):
    if isinstance(choice, types.Float):

        def of_extreme(transitions, table, palette, gamma, uniform, choice, v, actions, s):
            best = -np.inf
            if uniform > 0.0:
                total = 0.0
                for a in range(len(actions)):
                    q = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
                    best = max(best, choice * q)
                    total += q
                return (1.0 - uniform) * (choice * best) + uniform * total / len(actions)
            for a in range(len(actions)):
                q = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
                best = max(best, choice * q)
            return choice * best

        return of_extreme

    def of_policy(transitions, table, palette, gamma, uniform, choice, v, actions, s):
        chosen = np.int64(choice[s])
        q = reward_at(table, palette, s, chosen) + gamma * expectation(transitions, v, s, chosen)
        if uniform > 0.0:
            total = 0.0
            for a in range(len(actions)):
                total += reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
            return (1.0 - uniform) * q + uniform * total / len(actions)
        return q

    return of_policy


@interpreted_first()
@njit(cache=True, nogil=True)
def optimal_sweep(transitions, table, palette, gamma, uniform, choice, v, actions, order, start, stop):
    """v[s] = (1 - uniform) q(s, what is chosen) + uniform mean_a q(s, a), in place, for places [start, stop)."""
    change = 0.0
    for i in range(stop - 1, start - 1, -1):
        if i >= start + AHEAD:
            fetch_values(transitions, v, actions, state_at(order, i - AHEAD))
        s = state_at(order, i)
        value = _backup(transitions, table, palette, gamma, uniform, choice, v, actions, s)
        change = max(change, abs(value - v[uint64(s)]))
        v[uint64(s)] = value
    return change


@interpreted_first()
@njit(cache=True, nogil=True)
def optimal_backup(transitions, table, palette, gamma, uniform, choice, v, out, actions, runs):
    """out[s] = the backup of v for s of some runs (R, 2), not in place: what threads and ranks share, and horizons
    need."""
    for i in range(len(runs)):
        stop = runs[i, 1]
        for s in range(runs[i, 0], stop):
            if s + AHEAD < stop:
                fetch_values(transitions, v, actions, s + AHEAD)
            out[uint64(s)] = _backup(transitions, table, palette, gamma, uniform, choice, v, actions, s)


@njit(forceinline=True)
def _sticky_values(transitions, table, palette, gamma, choice, v, actions, q, s):
    """q[a] = r(s, a) + gamma v(next, a). Returns (that of what is chosen, their sum)."""
    total = 0.0
    for a in range(len(actions)):
        q[a] = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
        total += q[a]
    return _chosen(choice, q, actions, s), total


def _chosen(choice, q, actions, s):
    """The entry of q (A,) that is chosen."""


@overload(_chosen, jit_options={"forceinline": True})
def _chosen_of(choice, q, actions, s):
    if not isinstance(choice, types.Float):
        return lambda choice, q, actions, s: q[choice[s]]

    def extreme(choice, q, actions, s):
        best = -np.inf
        for a in range(len(actions)):
            best = max(best, choice * q[a])
        return choice * best

    return extreme


@interpreted_first()
@njit(cache=True, nogil=True)
def sticky_sweep(transitions, table, palette, gamma, weights, choice, v, actions, q, order, start, stop):
    """v[s, b] = chosen q(s, what is chosen) + previous q(s, b) + uniform mean_a q(s, a), in place.

    v (S + 1, A); q (A,) scratch; for places [start, stop).
    """
    chosen, previous, uniform = weights
    change = 0.0
    for i in range(stop - 1, start - 1, -1):
        if i >= start + AHEAD:
            fetch_values(transitions, v, actions, state_at(order, i - AHEAD))
        s = state_at(order, i)
        best, total = _sticky_values(transitions, table, palette, gamma, choice, v, actions, q, s)
        shared = chosen * best + uniform * total / len(actions)
        for b in range(len(actions)):
            value = shared + previous * q[b]
            change = max(change, abs(value - v[uint64(s), b]))
            v[uint64(s), b] = value
    return change


@interpreted_first()
@njit(cache=True, nogil=True)
def sticky_backup(transitions, table, palette, gamma, weights, choice, v, out, actions, runs):
    """out[s, b] = the backup of v for s of some runs (R, 2), not in place."""
    chosen, previous, uniform = weights
    q = np.empty(len(actions))
    for i in range(len(runs)):
        stop = runs[i, 1]
        for s in range(runs[i, 0], stop):
            if s + AHEAD < stop:
                fetch_values(transitions, v, actions, s + AHEAD)
            best, total = _sticky_values(transitions, table, palette, gamma, choice, v, actions, q, s)
            shared = chosen * best + uniform * total / len(actions)
            for b in range(len(actions)):
                out[uint64(s), b] = shared + previous * q[b]


@interpreted_first()
@njit(cache=True, nogil=True)
def policy_sweep(transitions, table, palette, gamma, chosen, uniform, policy, v, order, start, stop):
    """v[s] = sum_a (chosen policy[s, a] + uniform / A) q(s, a), in place; policy (S, A): probabilities of choosing."""
    _, num_actions = size_of(transitions)
    each = uniform / num_actions
    change = 0.0
    for i in range(stop - 1, start - 1, -1):
        s = state_at(order, i)
        value = 0.0
        for a in range(num_actions):
            q = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
            value += (chosen * policy[s, a] + each) * q
        change = max(change, abs(value - v[s]))
        v[s] = value
    return change


@interpreted_first()
@njit(cache=True, nogil=True)
def sticky_policy_sweep(transitions, table, palette, gamma, weights, policy, v, q, order, start, stop):
    """v[s, b] = sum_a (chosen policy[s, b, a] + uniform / A) q(s, a) + previous q(s, b), in place.

    v (S + 1, A). policy (S, B, A): B is A, or 1 where the previous action does not matter. q (A,) scratch.
    """
    _, num_actions = size_of(transitions)
    chosen, previous, uniform = weights
    each = uniform / num_actions
    looks_back = policy.shape[1] > 1
    change = 0.0
    for i in range(stop - 1, start - 1, -1):
        s = state_at(order, i)
        for a in range(num_actions):
            q[a] = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
        shared = 0.0
        for b in range(num_actions):
            if b == 0 or looks_back:
                shared = 0.0
                for a in range(num_actions):
                    shared += (chosen * policy[s, b, a] + each) * q[a]
            value = shared + previous * q[b]
            change = max(change, abs(value - v[s, b]))
            v[s, b] = value
    return change


@interpreted_first()
@njit(cache=True, nogil=True)
def chain_values(successor, reward, gamma, v, order):
    """Exact values on the graph of a deterministic policy: successor (S,), -1 ends; reward (S,); v gets the values.

    Every walk runs into the end, into a state already done, or into a new cycle, whose value is the geometric series of
    its rewards. order (S,) is scratch. Returns a state on a cycle whose value is infinite (gamma = 1), or -1.
    """
    num_states = len(successor)
    mark = np.zeros(num_states, np.int64)  # 0 new, i + 1 on the walk at place i, -1 done
    for start in range(num_states):
        if mark[start] != 0:
            continue
        length = 0
        s = start
        while s >= 0 and mark[s] == 0:
            order[length] = s
            length += 1
            mark[s] = length
            s = successor[s]
        last = length
        if s >= 0 and mark[s] > 0:  # a new cycle: places mark[s] - 1 to length - 1
            first = mark[s] - 1
            total = 0.0
            factor = 1.0
            for i in range(first, length):
                total += factor * reward[order[i]]
                factor *= gamma
            if factor == 1.0:
                for i in range(first, length):
                    if reward[order[i]] != 0.0:
                        return s
                v[s] = 0.0
            else:
                v[s] = total / (1.0 - factor)
            mark[s] = -1
            for i in range(length - 1, first, -1):
                t = order[i]
                v[t] = reward[t] + gamma * v[successor[t]]
                mark[t] = -1
            last = first
        for i in range(last - 1, -1, -1):
            t = order[i]
            v[t] = reward[t] + (gamma * v[successor[t]] if successor[t] >= 0 else 0.0)
            mark[t] = -1
    return -1
