"""An MDP with chance, written out: nodes, choices and where they may lead.

Nodes. Without sticky actions the states, and the implicit end. Under sticky actions the pairs (state, previously
executed action) that can be reached, and the start states without a previous action; a target is a state, reached with
any previous action.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from pharos.mdp import TabularMDP


@dataclass
class ExpandedMDP:
    """An MDP with chance written out: N nodes, A choices each.

    Attributes:
        matrix: (N A, N) CSR, probabilities.
        underlying: (N,) the state of each node; S for the implicit end.
        previous: (N,) the previously executed action, A for none; -1 where it does not matter.
        starts: [(node, probability)] of the first step.
        num_actions: A.
        alike: (N,) bool, nodes that all lead to the same nodes with the same probabilities, whatever is chosen: those
            in which episodes end, where a restart leads to one of several start states.
    """

    matrix: Any
    underlying: np.ndarray
    previous: np.ndarray
    starts: list[tuple[int, float]]
    num_actions: int
    num_targets: int
    alike: np.ndarray

    @cached_property
    def reversed(self) -> tuple[np.ndarray, np.ndarray]:
        """(first, previous) of the graph of all transitions that some choice may take."""
        size = len(self.underlying)
        rows = np.repeat(np.arange(size * self.num_actions) // self.num_actions, np.diff(self.matrix.indptr))
        graph = sparse.csr_matrix((np.ones(len(rows), np.int8), (self.matrix.indices, rows)), shape=(size, size))
        return graph.indptr, graph.indices

    @cached_property
    def _recurrent_class(self) -> np.ndarray:
        """(N,) its recurrent class, nodes that lead to each other and to no others, from 0 on; -1: none."""
        first, previous = self.reversed
        size = len(self.underlying)
        graph = sparse.csr_matrix((np.ones(len(previous), np.int8), previous, first), shape=(size, size))
        number, component = csgraph.connected_components(graph, connection="strong")
        into = np.repeat(np.arange(size), np.diff(first))
        leaves = component[previous] != component[into]
        is_recurrent = np.ones(number, np.bool_)
        is_recurrent[component[previous[leaves]]] = False
        return np.asarray(np.where(is_recurrent, np.cumsum(is_recurrent) - 1, -1)[component])

    @cached_property
    def is_connected(self) -> bool:
        """Whether every target that is met at all can be reached from every node: each recurrent class has all.

        So from every node every target is surely reached, by whoever chooses at random.
        """
        inside = np.flatnonzero(self._recurrent_class >= 0)
        pairs = np.unique(self._recurrent_class[inside] * np.int64(self.num_targets) + self.underlying[inside])
        return bool(pairs.size == np.unique(self.underlying).size * (self._recurrent_class.max() + 1))

    @cached_property
    def crude_upper(self) -> float:
        """Proven, and far too large: a shortest path of at most H edges succeeds with probability q^H or more.

        So the expected time is at most H / q^H. H is that by way of one node, which all others lead to; infinite where
        there is none.
        """
        if not self.is_connected or self._recurrent_class.max() > 0:
            return math.inf
        home = int(self._recurrent_class.argmax())
        size = len(self.underlying)
        coo = self.matrix.tocoo()
        best = sparse.coo_matrix((coo.data, (coo.row // self.num_actions, coo.col)), shape=(size, size))
        order = np.lexsort((-best.data, best.col, best.row))
        row, col, data = best.row[order], best.col[order], best.data[order]
        first = np.ones(len(row), np.bool_)
        first[1:] = (row[1:] != row[:-1]) | (col[1:] != col[:-1])
        graph = sparse.csr_matrix((np.ones(int(first.sum())), (row[first], col[first])), shape=(size, size))
        steps = 0
        for each in (graph, graph.T.tocsr()):
            distances = csgraph.dijkstra(each, indices=home, unweighted=True)
            steps += int(distances[np.isfinite(distances)].max())
        exponent = -steps * math.log(float(data[first].min()))
        return steps * math.exp(exponent) if exponent < 690 else math.inf


def choices_of(mdp: TabularMDP, restart: bool) -> ExpandedMDP:
    """The MDP written out, with the restart convention."""
    num_states, num_actions = mdp.num_states, mdp.num_actions
    terminal = np.asarray(mdp.terminal)
    executed, ends = outcomes_of(mdp, terminal)  # (S A, S + ends): outcome of executing an action in a live state
    size = num_states + ends
    states = np.arange(size)
    live = np.zeros(size, np.bool_)
    live[:num_states] = ~terminal
    chance = mdp.chance
    if mdp.is_sticky:
        # node s (A + 1) + b, b = A: no previous action
        width = num_actions + 1
        nodes = size * width
        coo = executed.tocoo()
        arrived = coo.col * width + coo.row % num_actions
        outcome = sparse.csr_matrix((coo.data, (coo.row, arrived)), shape=(num_states * num_actions, nodes))
        owner, previous = np.repeat(states, width), np.tile(np.arange(width), size)
    else:
        width, nodes = 1, size
        outcome, owner, previous = executed, states, np.full(size, -1)
    starts = [
        (int(s) * width + (num_actions if width > 1 else 0), float(p))
        for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True)
        if p > 0
    ]
    weights = _weights(chance, (num_states, num_actions), owner, previous, live[owner])
    matrix = weights @ outcome
    matrix = matrix + _restarts(owner, live, starts, num_actions, nodes, restart)
    matrix = sparse.csr_matrix(matrix)
    matrix.sum_duplicates()
    alike = ~live[owner] if restart and len(starts) > 1 else np.zeros(nodes, np.bool_)
    choices = ExpandedMDP(matrix, owner, previous, starts, num_actions, size, alike)
    return reachable(choices) if mdp.is_sticky else choices


def outcomes_of(mdp: TabularMDP, terminal: np.ndarray) -> tuple[Any, bool]:
    """(S A, S + 1 or S) outcomes of executing actions, rows of terminal states empty; whether the end is among them."""
    matrix = mdp.dynamics.matrix(~terminal)
    ends = bool((matrix.indices == mdp.num_states).any())
    if not ends:
        matrix = sparse.csr_matrix(
            (matrix.data, matrix.indices, matrix.indptr), shape=(matrix.shape[0], mdp.num_states)
        )
    return matrix, ends


def _weights(chance: Any, shape: tuple[int, int], owner: np.ndarray, previous: np.ndarray, live: np.ndarray) -> Any:
    """(N A, S A): the probability that choosing a in a node executes x in its state.

    previous (N,): A for none, -1 where it does not matter.
    """
    num_states, num_actions = shape
    node = np.flatnonzero(live)
    choice = np.tile(np.eye(num_actions), (node.size, 1))
    data = chance.weights(choice, np.repeat(previous[node], num_actions))
    n, x = np.nonzero(data)
    rows = (node[:, None] * num_actions + np.arange(num_actions)).ravel()[n]
    columns = np.repeat(owner[node], num_actions)[n] * num_actions + x
    return sparse.csr_matrix((data[n, x], (rows, columns)), shape=(owner.size * num_actions, num_states * num_actions))


def _restarts(
    owner: np.ndarray, live: np.ndarray, starts: list[tuple[int, float]], num_actions: int, nodes: int, restart: bool
) -> Any:
    """(N A, N): what terminal states and the end lead to."""
    ended = np.flatnonzero(~live[owner])
    if restart:
        rows = np.repeat((ended[:, None] * num_actions + np.arange(num_actions)).ravel(), len(starts))
        columns = np.tile([node for node, _ in starts], ended.size * num_actions)
        data = np.tile([p for _, p in starts], ended.size * num_actions)
    else:
        rows = (ended[:, None] * num_actions + np.arange(num_actions)).ravel()
        columns = np.repeat(ended, num_actions)
        data = np.ones(rows.size)
    return sparse.csr_matrix((data, (rows, columns)), shape=(nodes * num_actions, nodes))


def reachable(choices: ExpandedMDP) -> ExpandedMDP:
    """The nodes that can be reached from the start, by whatever is chosen."""
    first, previous = choices.reversed
    size = len(choices.underlying)
    graph = sparse.csr_matrix((np.ones(len(previous), np.int8), previous, first), shape=(size, size)).T.tocsr()
    is_reached = np.zeros(size, np.bool_)
    for node, _ in choices.starts:
        is_reached[csgraph.breadth_first_order(graph, node, return_predecessors=False)] = True
    nodes = np.flatnonzero(is_reached)
    place = np.full(size, -1)
    place[nodes] = np.arange(nodes.size)
    rows = (nodes[:, None] * choices.num_actions + np.arange(choices.num_actions)).ravel()
    matrix = sparse.csr_matrix(choices.matrix[rows][:, nodes])
    starts = [(int(place[node]), p) for node, p in choices.starts]
    return ExpandedMDP(
        matrix,
        choices.underlying[nodes],
        choices.previous[nodes],
        starts,
        choices.num_actions,
        choices.num_targets,
        choices.alike[nodes],
    )
