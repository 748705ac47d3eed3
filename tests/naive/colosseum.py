"""Colosseum's diameters by its own iterations, in the precision and with the stops that its printed digits show.

It sums in single precision, each product in double and each sum rounded, and stops when no entry changes by 0.001; in
episodes also by 0.01, once a target adds less than a step to those before it.
"""

from collections import deque

import numpy as np
from numba import njit
from scipy import sparse

STOPS = (1e-3, 1e-2)
ULPS = 8  # roundings of single precision that the order of its sums leaves open


def law(env):
    """(states, P (S A, S) sparse, start distribution (S,)), by the interpreted rules."""
    starts = dict(env.initial_states())
    numbers = {state: i for i, state in enumerate(starts)}
    rows, columns, probabilities = [], [], []
    for state in (queue := list(starts)):
        for action in range(env.num_actions):
            for outcome in range(env.outcomes):
                probability = env.probability(state, action, outcome)
                if probability == 0:
                    continue
                following = env.next_state(state, action, outcome)
                if following not in numbers:
                    numbers[following] = len(numbers)
                    queue.append(following)
                rows.append(numbers[state] * env.num_actions + action)
                columns.append(numbers[following])
                probabilities.append(probability)
    size = len(numbers)
    P = sparse.csr_matrix((probabilities, (rows, columns)), shape=(size * env.num_actions, size))
    P.sum_duplicates()
    rho = np.zeros(size)
    rho[: len(starts)] = list(starts.values())
    return queue, P, rho


def farthest(P, rho):
    """The twelve states that are farthest from the start states, by the mean number of edges."""
    size = P.shape[1]
    actions = P.shape[0] // size
    successors = [P.indices[P.indptr[s * actions] : P.indptr[(s + 1) * actions]] for s in range(size)]
    mean = np.zeros(size)
    for start in np.flatnonzero(rho):
        distance, queue = {int(start): 0}, deque([int(start)])
        while queue:
            state = queue.popleft()
            for following in successors[state]:
                if int(following) not in distance:
                    distance[int(following)] = distance[state] + 1
                    queue.append(int(following))
        mean += rho[start] * np.array([distance[s] for s in range(size)])
    return np.argsort(-mean, kind="stable")[:12]


def episodic_diameter(P, rho, horizon, targets, stop, kind):
    """Colosseum's number by its iteration: backwards through the time-indexed states that can be reached, until no
    entry changes by `stop`, for each of the targets; the largest.
    """
    size = P.shape[1]
    reached = np.zeros((horizon, size), bool)
    reached[0] = rho > 0
    for h in range(1, horizon):
        reached[h] = P.T @ np.repeat(reached[h - 1], P.shape[0] // size).astype(float) > 0
    arrays = P.indptr, P.indices, P.data.astype(kind), rho.astype(kind), reached
    return max(_times_to(*arrays, int(target), stop) for target in targets)


@njit
def _times_to(indptr, indices, data, rho, reached, target, stop):
    """The largest, over states, of the least positive entry. Compiled: it sweeps up to 30,000 times."""
    horizon, size = reached.shape
    actions = (len(indptr) - 1) // size
    times, total = np.zeros((horizon, size), data.dtype), np.zeros(1, data.dtype)  # an element rounds what it is given
    change = np.inf
    while change >= stop:
        change = 0.0
        before = times.copy()
        total[0] = 0
        for state in range(size):
            total[0] += rho[state] * (1.0 + times[0, state])
        times[-1] = total[0]
        for h in range(horizon - 2, -1, -1):
            for state in range(size):
                if not reached[h, state] or state == target:
                    continue
                least = np.inf
                for row in range(state * actions, (state + 1) * actions):
                    there = 0.0
                    total[0] = 0
                    for k in range(indptr[row], indptr[row + 1]):
                        if indices[k] == target:
                            there = data[k]
                        else:
                            total[0] = total[0] + data[k] * (1.0 + times[h + 1, indices[k]])
                    total[0] = total[0] + there
                    least = min(least, total[0])
                times[h, state] = least
        change = np.abs(times - before).max()
    largest = 0.0
    for state in range(size):
        least = np.inf
        for h in range(horizon):
            if times[h, state] > 0:
                least = min(least, times[h, state])
        largest = max(largest, least)
    return largest


def diameter(P, targets, stop=STOPS[0]):
    """Colosseum's number without episodes: single precision, until no entry changes by `stop`, for each target."""
    size, at = P.shape[1], np.arange(len(targets))
    single, times = P.astype(np.float32), np.zeros((size, len(targets)), np.float32)
    stopped = np.full(len(targets), np.nan, np.float32)
    while np.isnan(stopped).any():
        before, times = times, 1 + (single @ times).reshape(size, -1, len(targets)).min(axis=1)
        times[targets, at] = 0
        ends = (abs(times - before).max(axis=0) < stop) & np.isnan(stopped)
        stopped[ends] = times.max(axis=0)[ends]
    return stopped.max()


def diameter_in_place(P, order, stop=STOPS[0]):
    """The same, where a sweep already sees what it has changed, state by state in this order: small state spaces."""
    single = P.astype(np.float32)
    return max(
        _swept_in_place(single.indptr, single.indices, single.data, order, target, stop) for target in range(len(order))
    )


@njit
def _swept_in_place(indptr, indices, data, order, target, stop):
    size = len(order)
    actions = (len(indptr) - 1) // size
    times, change = np.zeros(size, np.float32), np.inf
    while change >= stop:
        change = 0.0
        for state in order:
            if state == target:
                continue
            least = np.inf
            for row in range(state * actions, (state + 1) * actions):
                total = np.float32(1)
                for k in range(indptr[row], indptr[row + 1]):
                    total += data[k] * times[indices[k]]
                least = min(least, total)
            change = max(change, abs(least - times[state]))
            times[state] = least
    return times.max()


def order_of_discovery(env, starts, lazy, random):
    """The states in Colosseum's order: depth first; of each action its own next state, and then those that chance adds.

    Args:
        env: the same without `p_lazy` and `p_rand`.
        lazy, random: whether they are above 0.
    """
    order, expanded = {}, set()
    stack = list(reversed([(start, 0) for start in starts]))
    while stack:
        state, action = stack.pop()
        if (action == 0 and state in expanded) or action == env.num_actions:
            continue
        expanded.add(state)
        moves = [env.next_state(state, taken) for taken in range(env.num_actions)]
        others = [move for taken, move in enumerate(moves) if taken != action] * random
        following = [moves[action], *[state] * lazy, *others]
        for found in (state, *following):
            order.setdefault(found, len(order))
        stack += [(state, action + 1), *[(found, 0) for found in reversed(following)]]
    return list(order)


def within_ulps(found, printed, ulps=ULPS):
    return abs(np.float32(found) - np.float32(printed)) <= ulps * np.spacing(np.float32(printed))
