"""An MDP with chance, written out: nodes, choices and their outcomes.

Nodes. Without sticky actions the states, and the implicit end. Under sticky actions the pairs (state, previously
executed action) that can be reached, and the start states without a previous action. A target is a state, reached with
any previous action.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # whose `sparse` is loaded on first use

from pharos.mdp.action_sets import stand_ins
from pharos.mdp.tabular import TabularMDP


@dataclass
class ExpandedMDP:
    """An MDP with chance written out: N nodes, A choices each.

    Attributes:
        matrix: (N A, N) CSR, probabilities.
        underlying: (N,) the state of each node, S for the implicit end.
        previous: (N,) the previously executed action, A for none, -1 if it does not matter.
        starts: [(node, probability)] of the first step.
        num_actions: A.
        is_restart: (N,) bool, nodes in which episodes end, if a restart leads to one of several start states: all of
            them lead to the same nodes with the same probabilities, by every choice.
    """

    matrix: "scipy.sparse.csr_matrix"
    underlying: np.ndarray
    previous: np.ndarray
    starts: list[tuple[int, float]]
    num_actions: int
    num_targets: int
    is_restart: np.ndarray

    @cached_property
    def table(self) -> np.ndarray | None:
        """(N, A), the only node that each choice leads to, or None if some choice has several outcomes."""
        matrix = self.matrix
        is_single = matrix.nnz == matrix.shape[0] and (np.diff(matrix.indptr) == 1).all() and (matrix.data == 1.0).all()
        return matrix.indices.reshape(-1, self.num_actions).astype(np.int64) if is_single else None

    def expected(self, values: np.ndarray) -> np.ndarray:
        """(N, A): the mean of values (N,) over the outcomes of each choice."""
        if self.table is not None:
            return values[self.table]
        return np.asarray(self.matrix @ values).reshape(-1, self.num_actions)

    def largest(self, values: np.ndarray) -> np.ndarray:
        """(N, A): the largest of values (N,) over the nodes that a choice may lead to."""
        if self.table is not None:
            return values[self.table]
        return np.maximum.reduceat(values[self.matrix.indices], self.matrix.indptr[:-1]).reshape(-1, self.num_actions)

    def successors(self, nodes: np.ndarray, choices: np.ndarray) -> np.ndarray:
        """The nodes that some of the choices (n, A) bool in nodes (n,) may lead to, some of them several times."""
        which, actions = np.nonzero(choices)
        if self.table is not None:
            return self.table[nodes[which], actions]
        return np.asarray(self.matrix[nodes[which] * self.num_actions + actions].indices)

    def rewards(self, mdp: TabularMDP) -> np.ndarray:
        """(N, A): the expected reward of each choice, in the MDP that is written out."""
        rewards = np.vstack([mdp.rewards, np.zeros((1, mdp.num_actions))])
        rewards[:-1][np.asarray(mdp.terminal)] = 0.0
        executed = rewards[np.minimum(self.underlying, mdp.num_states)]
        chance = mdp.chance.at(np.minimum(self.underlying, mdp.num_states - 1))
        return chance.chosen_values(executed, self.previous, mean_of_actions(executed)[:, None])

    @cached_property
    def reversed(self) -> tuple[np.ndarray, np.ndarray]:
        """(first, previous) of the graph of all transitions that some choice may take."""
        size = len(self.underlying)
        rows = np.repeat(np.arange(size * self.num_actions) // self.num_actions, np.diff(self.matrix.indptr))
        graph = scipy.sparse.csr_matrix((np.ones(len(rows), np.int8), (self.matrix.indices, rows)), shape=(size, size))
        return graph.indptr, graph.indices

    @cached_property
    def _recurrent_class(self) -> np.ndarray:
        """(N,) the recurrent class of each node, from 0 on, of nodes that lead to each other alone, -1 for none."""
        first, previous = self.reversed
        size = len(self.underlying)
        graph = scipy.sparse.csr_matrix((np.ones(len(previous), np.int8), previous, first), shape=(size, size))
        number, component = scipy.sparse.csgraph.connected_components(graph, connection="strong")
        into = np.repeat(np.arange(size), np.diff(first))
        leaves = component[previous] != component[into]
        is_recurrent = np.ones(number, np.bool_)
        is_recurrent[component[previous[leaves]]] = False
        return np.asarray(np.where(is_recurrent, np.cumsum(is_recurrent) - 1, -1)[component])

    @cached_property
    def is_connected(self) -> bool:
        """Whether every target that has a node can be reached from every node: each recurrent class has all targets.

        So from every node the uniform policy surely reaches every target.
        """
        inside = np.flatnonzero(self._recurrent_class >= 0)
        pairs = np.unique(self._recurrent_class[inside] * np.int64(self.num_targets) + self.underlying[inside])
        return bool(pairs.size == np.unique(self.underlying).size * (self._recurrent_class.max() + 1))

    @cached_property
    def crude_upper(self) -> float:
        """Proven, far too large upper bound on the expected time of any target: H / q^H.

        A shortest path of at most H edges, each of probability q or more, succeeds with probability q^H or more. H is
        the length of paths by way of one node, to which all others lead. Infinite if there is none.
        """
        if not self.is_connected or self._recurrent_class.max() > 0:
            return math.inf
        home = int(self._recurrent_class.argmax())
        size = len(self.underlying)
        coo = self.matrix.tocoo()
        best = scipy.sparse.coo_matrix((coo.data, (coo.row // self.num_actions, coo.col)), shape=(size, size))
        order = np.lexsort((-best.data, best.col, best.row))
        row, col, data = best.row[order], best.col[order], best.data[order]
        first = np.ones(len(row), np.bool_)
        first[1:] = (row[1:] != row[:-1]) | (col[1:] != col[:-1])
        graph = scipy.sparse.csr_matrix((np.ones(int(first.sum())), (row[first], col[first])), shape=(size, size))
        steps = 0
        for each in (graph, graph.T.tocsr()):
            distances = scipy.sparse.csgraph.dijkstra(each, indices=home, unweighted=True)
            steps += int(distances[np.isfinite(distances)].max())
        exponent = -steps * math.log(float(data[first].min()))
        return steps * math.exp(exponent) if exponent < 690 else math.inf

    @staticmethod
    def of(mdp: TabularMDP, restart: bool) -> "ExpandedMDP":
        """The MDP written out. restart: an action in a terminal state leads back to the start."""
        num_states, num_actions = mdp.num_states, mdp.num_actions
        width = mdp.policy_width  # node s (A + 1) + b, b = A: no previous action
        terminal = np.asarray(mdp.terminal)
        executed, ends = outcome_matrix(
            mdp, terminal
        )  # (S A, S + ends): outcome of executing an action in a live state
        # Nodes.
        size = num_states + ends
        nodes = size * width
        live = np.zeros(size, np.bool_)
        live[:num_states] = ~terminal
        owner, previous = np.repeat(np.arange(size), width), np.tile(np.arange(width), size) - (width == 1)
        starts = [
            (int(s) * width + width - 1, float(p))
            for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True)
            if p > 0
        ]
        # Probabilities of executing each action, for each node and choice.
        node = np.flatnonzero(live[owner])
        choice, chooser = np.tile(np.eye(num_actions), (node.size, 1)), np.repeat(node, num_actions)
        if mdp.available is not None:
            choice = np.eye(num_actions)[stand_ins(mdp.available)[owner[node]].ravel()]
        weights = executed_actions(mdp, choice, owner[chooser], previous[chooser])
        counts = np.zeros((nodes, num_actions), np.int64)
        counts[node] = np.diff(weights.indptr).reshape(-1, num_actions)
        weights = scipy.sparse.csr_matrix(
            (weights.data, weights.indices, np.append(0, counts.cumsum())), shape=(counts.size, weights.shape[1])
        )
        # Transitions of live nodes, and transitions of terminal states and of the end.
        matrix = weights @ nodes_of_outcomes(executed, num_actions, width)
        matrix = scipy.sparse.csr_matrix(matrix + _restarts(owner, live, starts, num_actions, nodes, restart))
        matrix.sum_duplicates()
        is_restart = ~live[owner] if restart and len(starts) > 1 else np.zeros(nodes, np.bool_)
        expanded = ExpandedMDP(matrix, owner, previous, starts, num_actions, size, is_restart)
        return expanded.reachable() if width > 1 else expanded

    def reachable(self) -> "ExpandedMDP":
        """The expanded MDP on the nodes that some choices reach from the start."""
        first, previous = self.reversed
        size = len(self.underlying)
        graph = scipy.sparse.csr_matrix(
            (np.ones(len(previous), np.int8), previous, first), shape=(size, size)
        ).T.tocsr()
        is_reached = np.zeros(size, np.bool_)
        for node, _ in self.starts:
            is_reached[scipy.sparse.csgraph.breadth_first_order(graph, node, return_predecessors=False)] = True
        nodes = np.flatnonzero(is_reached)
        index = np.full(size, -1)
        index[nodes] = np.arange(nodes.size)
        rows = (nodes[:, None] * self.num_actions + np.arange(self.num_actions)).ravel()
        matrix = scipy.sparse.csr_matrix(self.matrix[rows][:, nodes])
        starts = [(int(index[node]), p) for node, p in self.starts]
        return ExpandedMDP(
            matrix,
            self.underlying[nodes],
            self.previous[nodes],
            starts,
            self.num_actions,
            self.num_targets,
            self.is_restart[nodes],
        )


def mean_of_actions(values: np.ndarray) -> np.ndarray:
    """(N,): the mean of values (N, A) over actions, added up in their order."""
    total = values[:, 0].copy()
    for action in range(1, values.shape[1]):
        total += values[:, action]
    return total / values.shape[1]


def executed_actions(
    mdp: TabularMDP, policy: np.ndarray, owner: np.ndarray, previous: np.ndarray
) -> "scipy.sparse.csr_matrix":
    """(N, S A) CSR: the probability that each action is executed in the state of a node.

    Args:
        policy: (N, A) probabilities of choosing each action. owner: (N,) states. previous: (N,) as of `Chance.weights`.
    """
    nodes, num_actions = policy.shape
    columns = owner[:, None] * num_actions + np.arange(num_actions)
    entries = (
        mdp.chance.at(owner).weights(policy, previous).ravel(),
        columns.ravel(),
        np.arange(nodes + 1) * num_actions,
    )
    matrix = scipy.sparse.csr_matrix(entries, shape=(nodes, mdp.num_states * num_actions))
    matrix.eliminate_zeros()
    return matrix


def nodes_of_outcomes(outcomes: "scipy.sparse.csr_matrix", num_actions: int, width: int) -> "scipy.sparse.csr_matrix":
    """(S A, E W) CSR of outcomes (S A, E): each leads to the node of its state and of the action that was executed."""
    if width == 1:
        return outcomes
    coo = outcomes.tocoo()
    nodes = coo.col.astype(np.int64) * width + coo.row % num_actions
    return scipy.sparse.csr_matrix((coo.data, (coo.row, nodes)), shape=(outcomes.shape[0], outcomes.shape[1] * width))


def outcome_matrix(mdp: TabularMDP, terminal: np.ndarray) -> "tuple[scipy.sparse.csr_matrix, bool]":
    """(S A, S + 1 or S) outcomes of executing actions, rows of terminal states empty. Also whether the end is among
    them."""
    matrix = mdp.dynamics.matrix(~terminal)
    ends = bool((matrix.indices == mdp.num_states).any())
    if not ends:
        matrix = scipy.sparse.csr_matrix(
            (matrix.data, matrix.indices, matrix.indptr), shape=(matrix.shape[0], mdp.num_states)
        )
    return matrix, ends


def _restarts(
    owner: np.ndarray, live: np.ndarray, starts: list[tuple[int, float]], num_actions: int, nodes: int, restart: bool
) -> "scipy.sparse.csr_matrix":
    """(N A, N): transitions of terminal states and of the end."""
    ended = np.flatnonzero(~live[owner])
    if restart:
        rows = np.repeat((ended[:, None] * num_actions + np.arange(num_actions)).ravel(), len(starts))
        columns = np.tile([node for node, _ in starts], ended.size * num_actions)
        data = np.tile([p for _, p in starts], ended.size * num_actions)
    else:
        rows = (ended[:, None] * num_actions + np.arange(num_actions)).ravel()
        columns = np.repeat(ended, num_actions)
        data = np.ones(rows.size)
    return scipy.sparse.csr_matrix((data, (rows, columns)), shape=(nodes * num_actions, nodes))
