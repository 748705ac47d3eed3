"""Bellman backups in place, over flat arrays, and the orders of states in which they converge soonest.

mdp/dynamics.py says what they mean, solvers/ proves their bounds.

Common arguments: transitions: see kernels/outcomes.py; table, palette: see mdp/rewards.py; v (S + 1,) float64, under
sticky actions (S + 1, A) by the previously executed action, with row S 0, so that index -1 reads 0; weights: (chosen,
previous, uniform), if some actions are not available and chance depends on that with first_chosen and the sets (S,
A) bool behind (`uniform` with the sets): means are over the available ones then, and a step after one that is not is
as the first one; choice: 1.0 maximises, -1.0 minimises, (S,) integers are the actions of a policy; actions: A zeros,
see `actions_of`. Each sweep goes from the last state to the first, of an order (S,) or, if that is None, of their
numbers, and returns the largest change of an entry.

Topological orders, in which each state comes before those that it may lead to: (S,) states, or None for the order of
their numbers. Source: Kahn (1962). live (S,) bool: states whose transitions count; what leads to -1 leads nowhere.
Strongly connected components, in topological order, are numbered in end_components.py.
"""

import numpy as np
from numba import types, uint64

from pharos.kernels.interpreted import interpreted_first, overload
from pharos.kernels.kernel_cache import inlined, kernel
from pharos.kernels.outcomes import expectation, fetch_values, outcome, outcome_numbers, size_of

# Orders ---------------------------------------------------------------------------------------------------------------


def state_at(order, i):
    """The state at index i of an order, or i itself if the order is None."""


@overload(state_at)
def _state_at(order, i):
    if isinstance(order, types.NoneType):
        return lambda order, i: i
    return lambda order, i: order[i]


@interpreted_first()
@kernel(makes_arrays=False)
def is_increasing(transitions, live, age):
    """(s, a, t) of the first transition of a live state s to a state t whose age (S,) is not larger, or (-1, -1, -1).

    age None: the number of the state.
    """
    num_states, num_actions = size_of(transitions)
    for s in range(num_states):
        if live[s]:
            for a in range(num_actions):
                for k in outcome_numbers(transitions, s, a):
                    t, _ = outcome(transitions, s, a, k)
                    if t >= 0 and state_at(age, t) <= state_at(age, s):
                        return s, a, np.int64(t)
    return -1, -1, -1


@interpreted_first()
@kernel
def topological_order(transitions, live):
    """States in topological order, without the states of cycles and all that these lead to.

    Cost: two passes over the transitions, and 16 bytes a state.
    """
    num_states, num_actions = size_of(transitions)
    waiting = np.zeros(num_states, np.int64)  # edges from states that are not done yet
    for s in range(num_states):
        if live[s]:
            for a in range(num_actions):
                for k in outcome_numbers(transitions, s, a):
                    t, _ = outcome(transitions, s, a, k)
                    if t >= 0:
                        waiting[t] += 1
    order = np.empty(num_states, np.int64)
    # states that no other one leads to come first
    tail = 0
    for s in range(num_states):
        if waiting[s] == 0:
            order[tail] = s
            tail += 1
    # a state follows when all edges into it are done
    head = 0
    while head < tail:
        s = order[head]
        head += 1
        if not live[s]:
            continue
        for a in range(num_actions):
            for k in outcome_numbers(transitions, s, a):
                t, _ = outcome(transitions, s, a, k)
                if t >= 0:
                    waiting[t] -= 1
                    if waiting[t] == 0:
                        order[tail] = t
                        tail += 1
    return order[:tail]


@interpreted_first()
@kernel
def longest_path(transitions, live, order):
    """Edges of the longest path, given a topological order. Cost: one pass over the transitions, and 4 bytes a
    state."""
    num_states, num_actions = size_of(transitions)
    length = np.zeros(num_states, np.int32)
    longest = 0
    for i in range(num_states - 1, -1, -1):
        s = state_at(order, i)
        if live[s]:
            edges = 0
            for a in range(num_actions):
                for k in outcome_numbers(transitions, s, a):
                    t, _ = outcome(transitions, s, a, k)
                    if t >= 0:
                        edges = max(edges, length[t] + 1)
            length[s] = edges
            longest = max(longest, edges)
    return longest


# Backups --------------------------------------------------------------------------------------------------------------


UNROLLED_ACTIONS = 128  # actions
# States between the one whose values are fetched and the one that is backed up: memory has that long to answer.
FETCHED_AHEAD = 32


def actions_of(num_actions: int, unrolled: bool) -> "tuple[int, ...] | np.ndarray":
    """The argument `actions`, A zeros: an array, or, if sweeps are unrolled (`is_unrolled`), a tuple.

    The compiler knows a tuple's length and unrolls the loops over actions: sweeps are 3 to 4 times as fast, and each
    number of actions is compiled by itself (minutes, for more than UNROLLED_ACTIONS).
    """
    return (0,) * num_actions if num_actions <= UNROLLED_ACTIONS and unrolled else np.zeros(num_actions, np.int8)


def reward_at(table, palette, s, a):
    """The reward of (s, a): a palette's colour, or the entry itself."""


@overload(reward_at)
def _reward_at(table, palette, s, a):
    if table.dtype.name == "uint8":
        return lambda table, palette, s, a: palette[table[uint64(s), uint64(a)]]
    return lambda table, palette, s, a: table[uint64(s), uint64(a)]


def set_has(weights, s, a):
    """Whether action a is available in state s, by weights with sets behind. True if they have none."""


@overload(set_has, jit_options={"forceinline": True})
def _set_has(weights, s, a):
    if isinstance(weights, types.Float | types.UniTuple):
        return lambda weights, s, a: True
    last = len(weights) - 1
    return lambda weights, s, a: weights[last][uint64(s), uint64(a)]


def set_size(weights, s, actions):
    """The number of actions that are available in state s, of the entries of `actions`."""


@overload(set_size, jit_options={"forceinline": True})
def _set_size(weights, s, actions):
    if isinstance(weights, types.Float | types.UniTuple):
        return lambda weights, s, actions: len(actions)

    last = len(weights) - 1

    def counted(weights, s, actions):
        count = 0
        for a in range(len(actions)):
            if weights[last][uint64(s), uint64(a)]:
                count += 1
        return count

    return counted


def as_first(weights, choice_value, mean):
    """The value of a step as the first one, from the value of the choice and the mean over available actions."""


@overload(as_first, jit_options={"forceinline": True})
def _as_first(weights, choice_value, mean):
    if isinstance(weights, types.UniTuple):
        return lambda weights, choice_value, mean: choice_value
    return lambda weights, choice_value, mean: weights[3] * choice_value + (1.0 - weights[3]) * mean


def weight_of(uniform):
    """The weight of a uniform action, without the sets."""


@overload(weight_of, jit_options={"forceinline": True})
def _weight_of(uniform):
    return (lambda uniform: uniform) if isinstance(uniform, types.Float) else (lambda uniform: uniform[0])


def _backup(transitions, table, palette, gamma, uniform, choice, v, actions, s):
    """(1 - uniform) q(s, choice) + uniform mean_a q(s, a): the backup of v at s."""


@overload(_backup, jit_options={"forceinline": True})
def _backup_of(transitions, table, palette, gamma, uniform, choice, v, actions, s):
    if isinstance(choice, types.Float):

        def of_extreme(transitions, table, palette, gamma, uniform, choice, v, actions, s):
            best, weight = -np.inf, weight_of(uniform)
            if weight > 0.0:
                total = 0.0
                for a in range(len(actions)):
                    q = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
                    best = max(best, choice * q)
                    if set_has(uniform, s, a):
                        total += q
                return (1.0 - weight) * (choice * best) + weight * total / set_size(uniform, s, actions)
            for a in range(len(actions)):
                q = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
                best = max(best, choice * q)
            return choice * best

        return of_extreme

    def of_policy(transitions, table, palette, gamma, uniform, choice, v, actions, s):
        action = np.int64(choice[s])
        q = reward_at(table, palette, s, action) + gamma * expectation(transitions, v, s, action)
        weight = weight_of(uniform)
        if weight > 0.0:
            total = 0.0
            for a in range(len(actions)):
                if set_has(uniform, s, a):
                    total += reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
            return (1.0 - weight) * q + weight * total / set_size(uniform, s, actions)
        return q

    return of_policy


@interpreted_first()
@kernel(makes_arrays=False)
def optimal_sweep(transitions, table, palette, gamma, uniform, choice, v, actions, order, start, stop):
    """v[s] = (1 - uniform) q(s, choice) + uniform mean_a q(s, a), in place, for indices [start, stop) of the order."""
    change = 0.0
    for i in range(stop - 1, start - 1, -1):
        if i >= start + FETCHED_AHEAD:
            fetch_values(transitions, v, actions, state_at(order, i - FETCHED_AHEAD))
        s = state_at(order, i)
        value = _backup(transitions, table, palette, gamma, uniform, choice, v, actions, s)
        change = max(change, abs(value - v[uint64(s)]))
        v[uint64(s)] = value
    return change


@interpreted_first()
@kernel(makes_arrays=False)
def optimal_backup(transitions, table, palette, gamma, uniform, choice, v, out, actions, runs):
    """out[s] = the backup of v for s of some runs (R, 2), not in place: for threads, ranks and horizons."""
    for i in range(len(runs)):
        stop = runs[i, 1]
        for s in range(runs[i, 0], stop):
            if s + FETCHED_AHEAD < stop:
                fetch_values(transitions, v, actions, s + FETCHED_AHEAD)
            out[uint64(s)] = _backup(transitions, table, palette, gamma, uniform, choice, v, actions, s)


@inlined
def _sticky_values(transitions, table, palette, gamma, weights, choice, v, actions, q, s):
    """q[a] = r(s, a) + gamma v(next, a). Returns (q of the choice, sum of q of available actions)."""
    total = 0.0
    for a in range(len(actions)):
        q[a] = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
        if set_has(weights, s, a):
            total += q[a]
    act_as_first(weights, q, actions, s)
    return _choice_value(choice, q, actions, s), total


def act_as_first(weights, q, actions, s):
    """Replace entries of q (A,) of actions that are not available by the entry of the first one that is."""


@overload(act_as_first, jit_options={"forceinline": True})
def _act_as_first(weights, q, actions, s):
    if isinstance(weights, types.UniTuple):
        return lambda weights, q, actions, s: None

    def replaced(weights, q, actions, s):
        first = 0
        while not set_has(weights, s, first):
            first += 1
        for a in range(len(actions)):
            if not set_has(weights, s, a):
                q[a] = q[first]

    return replaced


def _choice_value(choice, q, actions, s):
    """The entry of q (A,) that `choice` takes: the best, the worst, or the entry of the policy's action."""


@overload(_choice_value, jit_options={"forceinline": True})
def _choice_value_of(choice, q, actions, s):
    if not isinstance(choice, types.Float):
        return lambda choice, q, actions, s: q[choice[s]]

    def extreme(choice, q, actions, s):
        best = -np.inf
        for a in range(len(actions)):
            best = max(best, choice * q[a])
        return choice * best

    return extreme


@interpreted_first()
@kernel(makes_arrays=False)
def sticky_sweep(transitions, table, palette, gamma, weights, choice, v, actions, q, order, start, stop):
    """v[s, b] = chosen q(s, choice) + previous q(s, b) + uniform mean_a q(s, a), in place.

    v (S + 1, A), and q (A,) as scratch, for indices [start, stop) of the order.
    """
    chosen_weight, previous_weight, uniform_weight = weights[0], weights[1], weights[2]
    change = 0.0
    for i in range(stop - 1, start - 1, -1):
        if i >= start + FETCHED_AHEAD:
            fetch_values(transitions, v, actions, state_at(order, i - FETCHED_AHEAD))
        s = state_at(order, i)
        best, total = _sticky_values(transitions, table, palette, gamma, weights, choice, v, actions, q, s)
        shared = chosen_weight * best + uniform_weight * total / set_size(weights, s, actions)
        for b in range(len(actions)):
            value = shared + previous_weight * q[b]
            if not set_has(weights, s, b):
                value = as_first(weights, best, total / set_size(weights, s, actions))
            change = max(change, abs(value - v[uint64(s), b]))
            v[uint64(s), b] = value
    return change


@interpreted_first()
@kernel(makes_arrays=False)
def sticky_backup(transitions, table, palette, gamma, weights, choice, v, out, actions, q, runs):
    """out[s, b] = the backup of v for s of some runs (R, 2), not in place, with terms as in `sticky_sweep`."""
    chosen_weight, previous_weight, uniform_weight = weights[0], weights[1], weights[2]
    for i in range(len(runs)):
        stop = runs[i, 1]
        for s in range(runs[i, 0], stop):
            if s + FETCHED_AHEAD < stop:
                fetch_values(transitions, v, actions, s + FETCHED_AHEAD)
            best, total = _sticky_values(transitions, table, palette, gamma, weights, choice, v, actions, q, s)
            shared = chosen_weight * best + uniform_weight * total / set_size(weights, s, actions)
            for b in range(len(actions)):
                out[uint64(s), b] = shared + previous_weight * q[b]
                if not set_has(weights, s, b):
                    out[uint64(s), b] = as_first(weights, best, total / set_size(weights, s, actions))


@inlined
def _policy_value(transitions, table, palette, gamma, weights, policy, v, actions, s):
    """sum_a (chosen policy[s, a] + uniform / A) q(s, a): the backup of v at s."""
    chosen_weight, uniform_share = weights[0], weights[2] / set_size(weights, s, actions)
    value = 0.0
    for a in range(len(actions)):
        q = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
        value += (chosen_weight * policy[s, a] + (uniform_share if set_has(weights, s, a) else 0.0)) * q
    return value


@interpreted_first()
@kernel(makes_arrays=False)
def policy_sweep(transitions, table, palette, gamma, weights, policy, v, actions, order, start, stop):
    """v[s] = sum_a (chosen policy[s, a] + uniform / A) q(s, a), in place. policy (S, A): probabilities of choosing."""
    change = 0.0
    for i in range(stop - 1, start - 1, -1):
        s = state_at(order, i)
        value = _policy_value(transitions, table, palette, gamma, weights, policy, v, actions, s)
        change = max(change, abs(value - v[s]))
        v[s] = value
    return change


@interpreted_first()
@kernel(makes_arrays=False)
def policy_backup(transitions, table, palette, gamma, weights, policy, v, out, actions, runs):
    """out[s] = the backup of v for s of some runs (R, 2), not in place, with terms as in `policy_sweep`."""
    for i in range(len(runs)):
        for s in range(runs[i, 0], runs[i, 1]):
            out[s] = _policy_value(transitions, table, palette, gamma, weights, policy, v, actions, s)


@inlined
def _sticky_policy_values(transitions, table, palette, gamma, weights, policy, v, actions, q, values, s):
    """values[b] = sum_a (chosen policy[s, b, a] + uniform / A) q(s, a) + previous q(s, b), with q (A,) as scratch."""
    chosen_weight, previous_weight, uniform_weight = weights[0], weights[1], weights[2]
    uniform_share = uniform_weight / set_size(weights, s, actions)
    looks_back = policy.shape[1] > 1
    for a in range(len(actions)):
        q[a] = reward_at(table, palette, s, a) + gamma * expectation(transitions, v, s, a)
    # the mean under the policy, once if it does not depend on the previous action b
    shared, choice_value, total = 0.0, 0.0, 0.0
    for b in range(len(actions)):
        if b == 0 or looks_back:
            shared, choice_value, total = 0.0, 0.0, 0.0
            for a in range(len(actions)):
                has = set_has(weights, s, a)
                shared += (chosen_weight * policy[s, b, a] + (uniform_share if has else 0.0)) * q[a]
                choice_value += policy[s, b, a] * q[a]
                total += q[a] if has else 0.0
        values[b] = shared + previous_weight * q[b]
        if not set_has(weights, s, b):
            values[b] = as_first(weights, choice_value, total / set_size(weights, s, actions))


@interpreted_first()
@kernel(makes_arrays=False)
def sticky_policy_sweep(transitions, table, palette, gamma, weights, policy, v, actions, q, values, order, start, stop):
    """v[s, b] = sum_a (chosen policy[s, b, a] + uniform / A) q(s, a) + previous q(s, b), in place.

    v (S + 1, A). policy (S, B, A): B is A, or 1 if the previous action does not matter. q, values (A,) scratch.
    """
    change = 0.0
    for i in range(stop - 1, start - 1, -1):
        s = state_at(order, i)
        _sticky_policy_values(transitions, table, palette, gamma, weights, policy, v, actions, q, values, s)
        for b in range(len(q)):
            change = max(change, abs(values[b] - v[s, b]))
            v[s, b] = values[b]
    return change


@interpreted_first()
@kernel(makes_arrays=False)
def sticky_policy_backup(transitions, table, palette, gamma, weights, policy, v, out, actions, q, runs):
    """out[s, b] = the backup of v for s of some runs (R, 2), not in place, with terms as in `sticky_policy_sweep`."""
    for i in range(len(runs)):
        for s in range(runs[i, 0], runs[i, 1]):
            _sticky_policy_values(transitions, table, palette, gamma, weights, policy, v, actions, q, out[s], s)


@interpreted_first()
@kernel
def solve_chain(successor, reward, gamma, v, order):
    """Exact values on the graph of a deterministic policy: successor (S,), -1 ends, reward (S,). v gets the values.

    Every walk runs into the end, into a state already done, or into a new cycle, whose value is the geometric series of
    its rewards. order (S,) is scratch. Returns a state on a cycle whose value is infinite (gamma = 1), or -1.
    """
    num_states = len(successor)
    mark = np.zeros(num_states, np.int64)  # 0 new, i + 1 on the walk at index i, -1 done
    for start in range(num_states):
        if mark[start] != 0:
            continue
        # walk to the end, to a state already done, or back into this walk
        length = 0
        s = start
        while s >= 0 and mark[s] == 0:
            order[length] = s
            length += 1
            mark[s] = length
            s = successor[s]
        last = length
        if s >= 0 and mark[s] > 0:  # a new cycle: indices mark[s] - 1 to length - 1
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
        # the walk before the cycle, or all of it, backwards
        for i in range(last - 1, -1, -1):
            t = order[i]
            v[t] = reward[t] + (gamma * v[successor[t]] if successor[t] >= 0 else 0.0)
            mark[t] = -1
    return -1


# Components -----------------------------------------------------------------------------------------------------------


@kernel(makes_arrays=False)
def component_order(transitions, live, component, first, is_cyclic, order):
    """order (S,) = the states by component, ascending in each, the states of component c from first[c] to first[c + 1].

    is_cyclic[c] = whether a state of c can be visited again. first (C + 1,): zero before.
    """
    num_states, num_actions = size_of(transitions)
    count = len(is_cyclic)
    for s in range(num_states):
        first[component[s]] += 1
    # counting sort: sizes, then the beginning of each component; several states form a cycle
    total = 0
    for c in range(count + 1):
        size = first[c]
        is_cyclic[min(c, count - 1)] |= size > 1
        first[c] = total
        total += size
    for s in range(num_states):
        c = component[s]
        order[first[c]] = s
        first[c] += 1
        if live[s] and not is_cyclic[c]:
            for a in range(num_actions):
                for k in outcome_numbers(transitions, s, a):
                    t, _ = outcome(transitions, s, a, k)
                    is_cyclic[c] |= t == s
    # `first` points to the ends now: shift it back
    for c in range(count, 0, -1):
        first[c] = first[c - 1]
    first[0] = 0


@kernel
def joined_components(first, is_cyclic, least):
    """(starts (G + 1,) in the order, whether each group has a cycle): neighbouring components joined into groups.

    Components without a cycle are joined as long as they follow each other. A component with a cycle is joined by the
    next ones until the group has `least` states.
    """
    starts = np.empty(len(first), np.int64)
    has_cycle = np.empty(len(is_cyclic), np.bool_)
    groups = 0
    for c in range(len(is_cyclic)):
        if groups > 0:
            size = first[c] - starts[groups - 1]
            if (size < least) if has_cycle[groups - 1] else not is_cyclic[c]:
                continue
        starts[groups], has_cycle[groups] = first[c], is_cyclic[c]
        groups += 1
    starts[groups] = first[-1]
    return starts[: groups + 1], has_cycle[:groups]


@kernel(makes_arrays=False)
def sweep_groups(
    transitions,
    table,
    palette,
    gamma,
    uniform,
    choice,
    v,
    actions,
    order,
    starts,
    has_cycle,
    target,
    rounding,
    max_backups,
    largest_before,
):
    """Sweep group by group, from the last to the first, each until it changes by at most `target`, or by its rounding.

    starts, has_cycle: as from `joined_components`. rounding: a change that is no more than rounding, relative to the
    values. max_backups: after so many each group that is left is swept once. largest_before: the largest absolute value
    so far. The other arguments are the arguments of all backups.
    """
    for group in range(len(has_cycle) - 1, -1, -1):
        change, largest = np.inf, largest_before
        while change > max(target, rounding * largest):
            start, stop = starts[group], starts[group + 1]
            change = optimal_sweep(transitions, table, palette, gamma, uniform, choice, v, actions, order, start, stop)
            largest += change  # at least as large as the values
            max_backups -= stop - start
            if max_backups < 0 or not has_cycle[group]:
                break


# Longest paths --------------------------------------------------------------------------------------------------------


@interpreted_first()
@kernel(makes_arrays=False)
def lengthen_paths(next_states, rewards, ends, v, is_reached, action):
    """Make the longest paths so far longer by single steps, in place, from the last state to the first.

    v (S + 1,): what the path from each state to the end pays, if is_reached. Row S is the end. rewards (S, A) and v
    are whole numbers. action (S,): the first step of the path, -1 if it stops there. Rows of ends (S,) bool do not
    count.
    Returns how many it changed. Source: Bellman (1958), Ford (1956).
    """
    changed = 0
    num_states, num_actions = next_states.shape
    for s in range(num_states - 1, -1, -1):
        if ends[s]:
            continue
        for a in range(num_actions):
            t = next_states[s, a]
            if is_reached[t] and (not is_reached[s] or rewards[s, a] + v[t] > v[s]):
                v[s] = rewards[s, a] + v[t]
                is_reached[s] = True
                action[s] = a
                changed += 1
    return changed


@interpreted_first()
@kernel(makes_arrays=False)
def cycle_of(next_states, action, mark):
    """A state on a cycle of the steps (s, action[s]) with action[s] >= 0, or -1. mark (S,) integers is scratch."""
    num_states = len(action)
    mark[:] = 0
    for start in range(num_states):
        s = np.int64(start)
        while s >= 0 and mark[s] == 0:
            mark[s] = start + 1
            s = np.int64(next_states[s, action[s]]) if action[s] >= 0 else np.int64(-1)
        if s >= 0 and mark[s] == start + 1:
            return s
    return -1
