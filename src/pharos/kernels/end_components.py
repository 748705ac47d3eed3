"""End components: sets of nodes, each with some of its choices, in which play can stay for ever and go from any to any.

Common arguments: transitions: see kernels/outcomes.py. Node n = s W + b is the state s after the executed action b; W =
A under sticky actions, else 1. A choice a of a node executes a, its b or any action, as the weights (chosen, previous,
uniform) have it, and an executed action e leads from s to nodes t W + e, or t if W is 1. With first_chosen and the
sets of available actions behind the weights, a b that is not available counts as none, and a uniform action is one that
is. allowed (N, A) bool: the choices that count. count (N,) integers: how many a node has.

Strongly connected components are found along allowed choices. A choice that may lead out of the component of its node,
or to the end, is no choice of an end component: it is removed, and the rest is looked at again, until nothing changes.
Source: de Alfaro (1997), "Formal verification of probabilistic systems", section 3.3; Tarjan (1972); components
with one number for each node: Pearce (2016), "A space-efficient algorithm for finding strongly connected components".
"""

import numpy as np
from numba import types

from pharos.kernels.bellman import set_has
from pharos.kernels.interpreted import interpreted_first, overload
from pharos.kernels.kernel_cache import kernel
from pharos.kernels.outcomes import outcome, outcome_numbers, size_of


def weights_after(weights, s, b):
    """(chosen, previous, uniform) weights of a step in state s after the executed action b."""


@overload(weights_after, jit_options={"forceinline": True})
def _weights_after(weights, s, b):
    if isinstance(weights, types.UniTuple):
        return lambda weights, s, b: weights

    def as_sets_have_it(weights, s, b):
        if set_has(weights, s, b):
            return weights[0], weights[1], weights[2]
        return weights[3], 0.0, 1.0 - weights[3]

    return as_sets_have_it


@kernel
def may_execute(weights, allowed, count, n, s, b, e):
    """Whether an allowed choice of node n = s W + b may execute e; if allowed is (S,), whether s leads on."""
    if allowed.ndim == 1:  # known as this is compiled
        return allowed[n]
    if count[n] == 0:
        return False
    chosen_weight, previous_weight, uniform_weight = weights_after(weights, s, b)
    return (
        (uniform_weight > 0.0 and set_has(weights, s, e))
        or (chosen_weight > 0.0 and allowed[n, e])
        or (previous_weight > 0.0 and b == e)
    )


@interpreted_first()
@kernel
def number_components(transitions, weights, allowed, count, component, path, waiting):
    """component[n] = the number of the strongly connected component of n, in topological order. Returns how many.

    A component has a smaller number than those that it leads to. Of states whose choices all count, weights and count
    are None, and allowed (S,) bool: which of them lead on. component, path, waiting (N,) integers. The last two are
    scratch.
    Cost: one look at each transition, in the order of a depth-first search, and 9 bytes a node on top.
    """
    num_states, num_actions = size_of(transitions)
    num_nodes = len(component)
    width = 1 if allowed.ndim == 1 else num_nodes // num_states
    action = np.empty(num_nodes, np.int32)  # of the nodes on the path: the action to go on with
    branch = np.empty(num_nodes, np.int32)
    is_root = np.empty(num_nodes, np.bool_)  # whether a node of the path is the first one seen of its component
    component[:] = 0
    number, last = 1, num_nodes  # numbers of nodes on the way go up from 1, numbers of finished components down from N
    tail = 0
    for start in range(num_nodes):
        depth = -1
        next_node = np.int64(start)
        while component[start] == 0 or depth >= 0:
            # a new node: put it on the path, with the next number
            if component[next_node] == 0:
                depth += 1
                path[depth], action[depth], branch[depth], is_root[depth] = next_node, 0, 0, True
                component[next_node] = number
                number += 1
            n = np.int64(path[depth])
            s = n // width
            next_node = n
            # look on at its transitions; a smaller number than its own shows a way back to an earlier node
            e, k = np.int64(action[depth]), np.int64(branch[depth])
            while e < num_actions and next_node == n:
                if not may_execute(weights, allowed, count, n, s, n - s * width, e):
                    e, k = e + 1, np.int64(0)
                    continue
                while k < len(outcome_numbers(transitions, s, e)):
                    t, _ = outcome(transitions, s, e, k)
                    if t >= 0:
                        m = np.int64(t) * width + (e if width > 1 else 0)
                        if component[m] == 0:
                            next_node = m  # and look at this transition again, when it is finished
                            break
                        if component[m] < component[n]:
                            component[n] = component[m]
                            is_root[depth] = False
                    k += 1
                else:
                    e, k = e + 1, np.int64(0)
            action[depth], branch[depth] = e, k
            if next_node != n:
                continue
            # all transitions done: a root closes its component, other nodes wait for their root
            if is_root[depth]:
                number -= 1
                while tail > 0 and component[waiting[tail - 1]] >= component[n]:
                    tail -= 1
                    component[waiting[tail]] = last
                    number -= 1
                component[n] = last
                last -= 1
            else:
                waiting[tail] = n
                tail += 1
            depth -= 1
    # numbers go down from N: shift them to begin at 0
    for n in range(num_nodes):
        component[n] -= last + 1
    return num_nodes - last


@interpreted_first()
@kernel
def remove_leaving(transitions, weights, component, allowed, count, leaves):
    """Remove choices that may end, or lead to another component or to a node without choices. Returns how many.

    leaves (A,) bool is scratch. One pass, from the last node to the first.
    """
    num_states, num_actions = size_of(transitions)
    width = len(component) // num_states
    removed = 0
    for n in range(len(component) - 1, -1, -1):
        if count[n] == 0:
            continue
        s, b = n // width, n % width
        chosen_weight, previous_weight, uniform_weight = weights_after(weights, s, b)
        leaves_by_any = False
        for e in range(num_actions):
            leaves[e] = False
            if may_execute(weights, allowed, count, n, s, b, e):
                for k in outcome_numbers(transitions, s, e):
                    t, _ = outcome(transitions, s, e, k)
                    m = np.int64(t) * width + (e if width > 1 else 0)
                    if t < 0 or component[m] != component[n] or count[m] == 0:
                        leaves[e] = True
                        leaves_by_any = True
                        break
        always = (uniform_weight > 0.0 and leaves_by_any) or (previous_weight > 0.0 and leaves[b])
        for a in range(num_actions):
            if allowed[n, a] and (always or (chosen_weight > 0.0 and leaves[a])):
                allowed[n, a] = False
                count[n] -= 1
                removed += 1
    return removed
