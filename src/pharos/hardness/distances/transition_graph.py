"""The graph of a deterministic MDP, and searches on it forward and backward."""

from typing import Any

import numpy as np

from pharos.kernels import graph
from pharos.mdp import TabularMDP
from pharos.system.packed_indices import Indices

# Untyped, as starred arguments of compiled functions are not checked.
kernels: Any = graph


class Graph:
    """The graph of a deterministic MDP, with restart edges and the implicit end; see `pharos.kernels.graph`.

    Attributes:
        num_nodes: N, the states and, where some transition of a state that is not terminal is -1, the end.
        start: the node that terminal states lead to; -1: they lead nowhere.
        pivot: a start state, where searches begin.
    """

    def __init__(self, next_states: Indices, terminal: np.ndarray, start: int, pivot: int):
        self.next_states = next_states
        self.ends = np.ascontiguousarray(terminal, np.bool_)
        self.start, self.pivot = start, pivot
        self.has_end = _leads_to_end(next_states, self.ends)
        self.num_nodes = len(next_states) + self.has_end
        self.dtype = np.int32 if self.num_nodes < 2**31 else np.int64
        self.queue = np.empty(self.num_nodes, self.dtype)
        self._reversed: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    @staticmethod
    def of(mdp: TabularMDP, restart: bool) -> "Graph | None":
        """The graph of `mdp`; None where a choice or a restart has several outcomes."""
        if not mdp.chance.is_none:
            return None
        table = mdp.dynamics.deterministic_table()
        if table is None:
            return None
        restarts = restart and (bool(mdp.terminal.any()) or _leads_to_end(table, mdp.terminal))
        if restarts and len(mdp.start_states) > 1:
            return None
        pivot = int(mdp.start_states[0])
        return Graph(table, mdp.terminal, pivot if restarts else -1, pivot)

    @property
    def backward(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(first, previous, restarting): the reversed graph, made when it is first needed."""
        if self._reversed is None:
            restarting = np.empty(0, self.dtype)
            if self.start >= 0:
                ending = np.flatnonzero(self.ends)
                restarting = np.append(ending, [len(self.next_states)] * self.has_end).astype(self.dtype)
            self._reversed = (*kernels.reversed_graph(self.next_states, self.ends, self.num_nodes), restarting)
        return self._reversed

    def search_forward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """distance[v] = d(source, v); (nodes found, largest distance, sum of distances)."""
        return kernels.search_forward(self.next_states, self.ends, self.start, source, distance, self.queue)

    def search_backward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """distance[v] = d(v, source); (nodes found, largest distance, sum of distances)."""
        return kernels.search_backward(*self.backward, self.start, source, distance, self.queue)


def _leads_to_end(table: Indices, terminal: np.ndarray) -> bool:
    """Whether a row that is followed holds -1; in blocks, for tables that are larger than memory."""
    block = 1 << 20
    for low in range(0, len(table), block):
        rows = table[low : low + block]
        if rows.min(initial=0) >= 0:
            continue
        ending = (rows < 0).any(axis=1)
        if (ending & ~np.asarray(terminal[low : low + block])).any():
            return True
    return False
