"""Bellman backups in place, over flat arrays. solvers/ says what they mean and proves their bounds.

Common arguments: next_states (S, A), -1 where the episode ends; table, palette: see mdp/_rewards.py; v (S + 1,) float64 with
v[S] = 0, so that index -1 reads 0; weights: (chosen, previous, uniform); sign: 1 maximises, -1 minimises; actions: a tuple
of A zeros, whose length the compiler knows, so that the loops over actions are unrolled (a third faster). Each sweep goes
from the last state to the first and returns the largest change of an entry.
"""

import numpy as np
from numba import njit
from numba.extending import overload


def reward_at(table, palette, s, a):
    """The reward of (s, a): a palette's colour, or the entry itself."""


@overload(reward_at)
def _reward_at(table, palette, s, a):
    if table.dtype.name == "uint8":
        return lambda table, palette, s, a: palette[table[s, a]]
    return lambda table, palette, s, a: table[s, a]


@njit(forceinline=True)
def _backup(next_states, table, palette, gamma, uniform, sign, v, actions, s):
    """(1 - uniform) max_a q(s, a) + uniform mean_a q(s, a)."""
    best = -np.inf
    total = 0.0
    for a in range(len(actions)):
        q = reward_at(table, palette, s, a) + gamma * v[next_states[s, a]]
        best = max(best, sign * q)
        total += q
    if uniform > 0.0:
        return (1.0 - uniform) * (sign * best) + uniform * total / len(actions)
    return sign * best


@njit(cache=True, nogil=True)
def optimal_sweep(next_states, table, palette, gamma, uniform, sign, v, actions):
    """v[s] = (1 - uniform) max_a q(s, a) + uniform mean_a q(s, a), in place."""
    change = 0.0
    for s in range(len(next_states) - 1, -1, -1):
        value = _backup(next_states, table, palette, gamma, uniform, sign, v, actions, s)
        change = max(change, abs(value - v[s]))
        v[s] = value
    return change


@njit(cache=True, nogil=True)
def optimal_block(next_states, table, palette, gamma, uniform, sign, v, out, actions, start, stop):
    """out[s] = the backup of v for s in [start, stop), not in place: what threads share, and horizons need."""
    for s in range(start, stop):
        out[s] = _backup(next_states, table, palette, gamma, uniform, sign, v, actions, s)


@njit(forceinline=True)
def _sticky_backup(next_states, table, palette, gamma, weights, sign, q, actions, s, a):
    """r(s, a) + gamma V(next, a); V(t, b) = chosen max_x q(t, x) + previous q(t, b) + uniform mean q(t, .)."""
    chosen, previous, uniform = weights
    t = next_states[s, a]
    best = -np.inf
    total = 0.0
    for x in range(len(actions)):
        best = max(best, sign * q[t, x])
        total += q[t, x]
    following = chosen * sign * best + previous * q[t, a] + uniform * total / len(actions)
    return reward_at(table, palette, s, a) + gamma * following


@njit(cache=True, nogil=True)
def sticky_sweep(next_states, table, palette, gamma, weights, sign, q, actions):
    """q (S + 1, A), the values of executing an action, in place; row S is 0."""
    change = 0.0
    for s in range(len(next_states) - 1, -1, -1):
        for a in range(len(actions)):
            value = _sticky_backup(next_states, table, palette, gamma, weights, sign, q, actions, s, a)
            change = max(change, abs(value - q[s, a]))
            q[s, a] = value
    return change


@njit(cache=True, nogil=True)
def sticky_block(next_states, table, palette, gamma, weights, sign, q, out, actions, start, stop):
    """The same for states in [start, stop), not in place."""
    for s in range(start, stop):
        for a in range(len(actions)):
            out[s, a] = _sticky_backup(next_states, table, palette, gamma, weights, sign, q, actions, s, a)


@njit(cache=True, nogil=True)
def policy_sweep(next_states, table, palette, gamma, policy, v):
    """v[s] = sum_a policy[s, a] q(s, a), in place; policy (S, A): probabilities of executing."""
    num_states, num_actions = next_states.shape
    change = 0.0
    for s in range(num_states - 1, -1, -1):
        value = 0.0
        for a in range(num_actions):
            value += policy[s, a] * (reward_at(table, palette, s, a) + gamma * v[next_states[s, a]])
        change = max(change, abs(value - v[s]))
        v[s] = value
    return change


@njit(cache=True, nogil=True)
def sticky_policy_sweep(next_states, table, palette, gamma, weights, policy, q):
    """q of a policy under sticky actions, in place; policy (S, B, A): B is A, or 1 where the previous action is not seen."""
    num_states, num_actions = next_states.shape
    chosen, previous, uniform = weights
    seen = policy.shape[1] > 1
    change = 0.0
    for s in range(num_states - 1, -1, -1):
        for a in range(num_actions):
            t = next_states[s, a]
            b = a if seen else 0
            value = 0.0
            if t >= 0:
                for x in range(num_actions):
                    value += (chosen * policy[t, b, x] + uniform / num_actions) * q[t, x]
                value += previous * q[t, a]
            value = reward_at(table, palette, s, a) + gamma * value
            change = max(change, abs(value - q[s, a]))
            q[s, a] = value
    return change


@njit(cache=True, nogil=True)
def chain_values(successor, reward, gamma, v, order):
    """Exact values on the graph of a deterministic policy: successor (S,), -1 ends; reward (S,); v gets the values.

    Every walk runs into the end, into a state already done, or into a new cycle, whose value is the geometric series of its
    rewards. order (S,) is scratch. Returns a state on a cycle whose value is infinite (gamma = 1), or -1.
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
