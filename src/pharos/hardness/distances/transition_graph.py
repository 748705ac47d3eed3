"""The graph of a deterministic MDP, and searches on it forward and backward.

Layers of a graph that contains a clock: every edge leads from one layer of nodes to the next, and round again.
"""

from typing import Any, NamedTuple

import numpy as np

from pharos.kernels import graph as kernels
from pharos.mdp import TabularMDP
from pharos.system.packed_indices import Indices


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


# Layers ---------------------------------------------------------------------------------------------------------------


# Nodes of a layer beyond which layers are not narrow: a set of them no longer fits into a core's cache.
WIDE = 1024


class Layers(NamedTuple):
    """The nodes of a graph by layer.

    Attributes:
        order: (N,) nodes by layer. first: (P + 1,) where each layer begins in it.
        position: (N,) int32, the place of a node in its layer.
    """

    order: np.ndarray
    first: np.ndarray
    position: np.ndarray

    @staticmethod
    def of(layer: np.ndarray, widths: np.ndarray, dtype: Any) -> "Layers":
        """
        Args:
            layer: (N,) that of each node. widths: (P,) how many nodes each has. dtype: of nodes.
        """
        first = np.concatenate([[0], np.cumsum(widths)])
        order = np.argsort(layer, kind="stable").astype(dtype)
        position = np.empty(len(layer), np.int32)
        position[order] = np.arange(len(layer)) - np.repeat(first[:-1], widths)
        return Layers(order, first, position)

    @property
    def number(self) -> int:
        """P."""
        return len(self.first) - 1

    @property
    def widest(self) -> int:
        """Nodes of the largest layer."""
        return int(np.diff(self.first).max())
