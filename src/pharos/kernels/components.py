"""Strongly connected components: sets of states each of which can come to each other, in topological order.

transitions: see kernels/outcomes.py; live (S,) bool: states whose transitions count. What leads to -1 leads nowhere.
Source: Tarjan (1972); with one number for each state: Pearce (2016), "A space-efficient algorithm for finding strongly
connected components".
"""

import numpy as np
from numba import njit

from pharos.kernels.bellman import optimal_sweep
from pharos.kernels.outcomes import outcome, outcomes_of, size_of


@njit(cache=True, nogil=True)
def number_components(transitions, live, component, path, waiting):
    """component[s] = the number of the component of s, in topological order. Returns how many there are.

    A component has a smaller number than those that it leads to. component, path, waiting (S,) integers; the last two
    are scratch.
    Cost: one look at each transition, in the order of a depth-first search; 9 bytes a state on top.
    """
    num_states, num_actions = size_of(transitions)
    action = np.empty(num_states, np.int32)  # of the states on the path, where to go on looking
    branch = np.empty(num_states, np.int32)
    is_root = np.empty(num_states, np.bool_)  # whether a state of the path is the first one seen of its component
    component[:] = 0
    number, last = 1, num_states  # numbers of states on the way go up from 1, those of finished components down from S
    tail = 0
    for start in range(num_states):
        depth = -1
        following = start
        while component[start] == 0 or depth >= 0:
            if component[following] == 0:
                depth += 1
                path[depth], action[depth], branch[depth], is_root[depth] = following, 0, 0, True
                component[following] = number
                number += 1
            s = np.int64(path[depth])
            following = s
            if live[s]:
                a, k = np.int64(action[depth]), np.int64(branch[depth])
                while a < num_actions and following == s:
                    while k < len(outcomes_of(transitions, s, a)):
                        t, _ = outcome(transitions, s, a, k)
                        if t >= 0 and component[t] == 0:
                            following = np.int64(t)  # and look at this transition again, when it is finished
                            break
                        if t >= 0 and component[t] < component[s]:
                            component[s] = component[t]
                            is_root[depth] = False
                        k += 1
                    else:
                        a, k = a + 1, np.int64(0)
                action[depth], branch[depth] = a, k
            if following != s:
                continue
            if is_root[depth]:
                number -= 1
                while tail > 0 and component[waiting[tail - 1]] >= component[s]:
                    tail -= 1
                    component[waiting[tail]] = last
                    number -= 1
                component[s] = last
                last -= 1
            else:
                waiting[tail] = s
                tail += 1
            depth -= 1
    for s in range(num_states):
        component[s] -= last + 1
    return num_states - last


@njit(cache=True, nogil=True)
def component_order(transitions, live, component, first, is_cyclic, order):
    """order (S,) = the states by component, ascending in each; those of component c from first[c] to first[c + 1].

    is_cyclic[c] = whether a state of c can be visited again. first (C + 1,) of zeros.
    """
    num_states, num_actions = size_of(transitions)
    count = len(is_cyclic)
    for s in range(num_states):
        first[component[s]] += 1
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
                for k in outcomes_of(transitions, s, a):
                    t, _ = outcome(transitions, s, a, k)
                    is_cyclic[c] |= t == s
    for c in range(count, 0, -1):
        first[c] = first[c - 1]
    first[0] = 0


@njit(cache=True, nogil=True)
def joined(first, is_cyclic, least):
    """(starts (G + 1,) in the order, whether each group has a cycle): neighbouring components put together.

    Those without a cycle as many as there are; those with one, and whatever comes next, until they have `least` states.
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


@njit(cache=True, nogil=True)
def settle(
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
    settled,
    most,
    before,
):
    """Sweep group by group, from the last to the first, each until it changes by at most `target`, or by its rounding.

    starts, has_cycle: as `joined` makes them; settled: a change that is no more than rounding, relative to the values.
    most: backups, after which each group that is left is swept once. before: the largest absolute value so
    far. See kernels/bellman.py for the rest.
    """
    for group in range(len(has_cycle) - 1, -1, -1):
        change, largest = np.inf, before
        while change > max(target, settled * largest):
            start, stop = starts[group], starts[group + 1]
            change = optimal_sweep(transitions, table, palette, gamma, uniform, choice, v, actions, order, start, stop)
            largest += change  # at least as large as the values
            most -= stop - start
            if most < 0 or not has_cycle[group]:
                break
