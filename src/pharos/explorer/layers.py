"""Breadth-first layers: the states whose shortest way from a start state has 0, 1, 2, ... steps."""

import numpy as np

from pharos.mdp import Dynamics, TabularMDP

BLOCK = 1 << 16  # states whose successors are looked at in one go
BARS = 200  # of the drawing of all layers


class Layers:
    """The layers of an MDP.

    Args:
        is_numbered: whether states are numbered layer by layer, as those of a state space are: then a layer is a range
            of numbers, and nothing is kept of each state.
    Attributes:
        counts: (L,) states of each layer.
    Cost: one read of the successors; 8 bytes a state while they are read.
    """

    def __init__(self, mdp: TabularMDP, *, is_numbered: bool):
        self._order: np.ndarray | None = None  # states, layer by layer, where their numbers are not in this order
        self._of_states: np.ndarray | None = None
        if is_numbered:
            ends = _ends(mdp.dynamics, len(mdp.starts))
        else:
            self._of_states = _distances(mdp)
            states = np.flatnonzero(self._of_states >= 0)
            self._order = states[np.argsort(self._of_states[states], kind="stable")]
            ends = np.cumsum(np.bincount(self._of_states[states]))
        self._ends = ends
        self.counts = np.diff(ends, prepend=0)

    def of(self, states: np.ndarray) -> np.ndarray:
        """(N,) the layers of states; -1 of those that no actions lead to."""
        if self._of_states is not None:
            return self._of_states[states]
        return np.searchsorted(self._ends, states, side="right")

    def states(self, layer: int) -> np.ndarray:
        """(N,) the states of a layer, ascending."""
        first, last = int(self._ends[layer - 1]) if layer else 0, int(self._ends[layer])
        return np.arange(first, last) if self._order is None else self._order[first:last]

    def bars(self) -> dict[str, list[int]]:
        """Numbers of states in at most BARS groups of consecutive layers: `first` layer and `count` of each group."""
        width = -(-len(self.counts) // BARS)
        first = np.arange(0, len(self.counts), width)
        return {"first": first.tolist(), "count": np.add.reduceat(self.counts, first).tolist()}


def _ends(dynamics: Dynamics, num_starts: int) -> np.ndarray:
    """(L,) the number after the last state of each layer; a layer ends where the one before leads to at most."""
    farthest = np.maximum.accumulate(_largest_successors(dynamics))
    ends = [num_starts]
    while ends[-1] < dynamics.num_states:
        after = int(farthest[ends[-1] - 1]) + 1
        if after <= ends[-1]:
            break
        ends.append(after)
    return np.array(ends)


def _largest_successors(dynamics: Dynamics) -> np.ndarray:
    result = np.empty(dynamics.num_states, np.int64)
    table = dynamics.deterministic_table()
    for start in range(0, dynamics.num_states, BLOCK):
        states = np.arange(start, min(start + BLOCK, dynamics.num_states))
        if table is not None:
            result[states] = table[start : states[-1] + 1].max(axis=1)
            continue
        actions = np.tile(np.arange(dynamics.num_actions), len(states))
        outcomes = dynamics.outcomes(np.repeat(states, dynamics.num_actions), actions)
        inside = np.where(outcomes.states < dynamics.num_states, outcomes.states, -1)
        largest = np.full(len(states), -1)
        np.maximum.at(largest, outcomes.which // dynamics.num_actions, inside)
        result[states] = largest
    return result


def _distances(mdp: TabularMDP) -> np.ndarray:
    """(S,) steps from a start state, -1 where there is no way."""
    result = np.full(mdp.num_states + 1, -1, np.int32)
    frontier, layer = mdp.starts, 0
    result[frontier] = 0
    live = ~np.append(np.asarray(mdp.terminal), True)
    while frontier.size:
        next_states = mdp.dynamics.successors_of(frontier[live[frontier]])
        frontier = next_states[(result[next_states] < 0) & (next_states < mdp.num_states)]
        layer += 1
        result[frontier] = layer
    return result[:-1]
