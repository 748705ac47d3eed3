"""Rules as decision trees: at each node one component of the state is read, and its value says where to go on; a leaf
says what is written.

A tree is five arrays. component (nodes,): what a node reads; UNKNOWN; or LEAF - l for leaf l. first_child (nodes,):
where its children begin in children, one for each value from the lowest on, -1 where nobody has been. first_write
(leaves + 1,): leaf l writes written[first_write[l] : first_write[l + 1]] = (component, value). says (leaves,): what the
leaf returns. Node b is the root of branch b (an action, or an outcome of one), node B that of `is_terminal`.
"""

from pathlib import Path

import numpy as np

from pharos.system import compiling

compiling.prepare(Path(__file__).parent)

from numba import njit  # noqa: E402

UNKNOWN, LEAF = -1, -2


@njit(cache=True, nogil=True)
def leaf_of(component, first_child, children, low, root, state):
    """The leaf that a state (D,) comes to, or -1."""
    node = root
    while component[node] >= 0:
        c = component[node]
        node = children[first_child[node] + state[c] - low[c]]
        if node < 0:
            return -1
    return LEAF - component[node]


@njit(cache=True, nogil=True)
def follow(
    component,
    first_child,
    children,
    first_write,
    written,
    says,
    low,
    states,
    rows,
    branches,
    out,
    ended,
    likely,
    missing,
):
    """Successors of states[rows] (N, D) to out (N B, D) and whether they are terminal to ended (N,); how likely the
    branches are to likely (N, B), which has no rows without chance.

    missing (rows, 2) gets (row, root) of the first tree of each row that does not know. Returns how many.
    """
    count = 0
    for i in rows:
        state = states[i]
        leaf = leaf_of(component, first_child, children, low, branches, state)
        if leaf < 0:
            missing[count, 0], missing[count, 1] = i, branches
            count += 1
            continue
        ended[i] = says[leaf] != 0
        for b in range(branches):
            following = out[i * branches + b]
            following[:] = state
            if ended[i]:
                continue
            leaf = leaf_of(component, first_child, children, low, b, state)
            if leaf < 0:
                missing[count, 0], missing[count, 1] = i, b
                count += 1
                break
            if len(likely) > 0:
                likely[i, b] = says[leaf]
            for k in range(first_write[leaf], first_write[leaf + 1]):
                following[written[k, 0]] = written[k, 1]
    return count


@njit(cache=True, nogil=True)
def say(component, first_child, children, first_write, written, says, low, states, following, rows, out, missing):
    """What the leaves of the pairs (state, next state) return to out (N, A); `missing` as above, root a being that of
    action a.
    """
    count, width = 0, states.shape[1]
    pair = np.empty(2 * width, np.int64)
    for i in rows:
        pair[:width] = states[i]
        for a in range(out.shape[1]):
            pair[width:] = following[i, a]
            leaf = leaf_of(component, first_child, children, low, a, pair)
            if leaf < 0:
                missing[count, 0], missing[count, 1] = i, a
                count += 1
                break
            out[i, a] = says[leaf]
    return count
