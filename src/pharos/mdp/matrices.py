"""Dynamics with any number of outcomes, and the forms in which users write them."""

from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp.compiled import swept
from pharos.mdp.dynamics import BellmanEquation, Dynamics, Order, Outcomes, as_indices
from pharos.mdp.tabular_arrays import as_array

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


class Matrices(Dynamics):
    """Any number of outcomes, as a sparse matrix.

    Attributes:
        transitions: (S A, S) CSR float64, row s A + a; what a row lacks to 1 is the probability that the episode ends,
            but for 4 (n + 2) units of 2^-53 where rows have n entries: as much as their own rounding may lack.
    """

    def __init__(self, transitions: "csr_matrix", num_actions: int, entries: int = 0):
        """`entries`: of the longest row of which these were made, where rounding of its entries was added up."""
        from scipy import sparse

        self.transitions = sparse.csr_matrix(transitions)
        if not self.transitions.data.all():
            self.transitions = self.transitions.copy()
            self.transitions.eliminate_zeros()
        self.num_states, self.num_actions = transitions.shape[1], num_actions
        counts = np.diff(self.transitions.indptr)
        sums = np.asarray(self.transitions.sum(axis=1)).ravel()
        self.operations = max(int(counts.max(initial=0)), entries) + 1
        self.mass = max(1.0, float(sums.max(initial=0.0)) * (1 + self.operations * 2.0**-53))
        lacking = 1 - sums
        self._ends = np.where(lacking > 4 * (self.operations + 1) * 2.0**-53, lacking, 0.0)
        self.has_ends = bool(self._ends.any())
        self.is_deterministic = bool(((counts == 0) | ((counts == 1) & (sums == 1.0))).all())
        self._table: np.ndarray | None = None
        self._columns_by_action: Any = None

    @property
    def _by_action(self) -> "csr_matrix":
        """(S A, S A): the transitions into pairs of a next state and the action that led there."""
        from scipy import sparse

        if self._columns_by_action is None:
            matrix = self.transitions
            action = np.repeat(np.arange(len(matrix.indptr) - 1) % self.num_actions, np.diff(matrix.indptr))
            columns = matrix.indices.astype(np.int64) * self.num_actions + action
            size = matrix.shape[0]
            self._columns_by_action = sparse.csr_matrix((matrix.data, columns, matrix.indptr), shape=(size, size))
        return self._columns_by_action

    def arrays(self) -> dict[str, np.ndarray]:
        matrix = self.transitions
        names = ("transitions_data", "transitions_indices", "transitions_indptr")
        return dict(zip(names, (matrix.data, matrix.indices, matrix.indptr), strict=True))

    def lazy(self, p: float) -> "Matrices":
        from scipy import sparse

        rows = np.arange(self.transitions.shape[0])
        stays = sparse.csr_matrix((np.full(len(rows), p), (rows, rows // self.num_actions)), self.transitions.shape)
        result = Matrices(((1.0 - p) * self.transitions + stays).tocsr(), self.num_actions, self.operations + 2)
        result.laziness = 1.0 - (1.0 - self.laziness) * (1.0 - p)
        return result

    def deterministic_table(self) -> np.ndarray | None:
        if self._table is None and self.is_deterministic:
            table = np.full(self.num_states * self.num_actions, -1, np.int64)
            table[np.diff(self.transitions.indptr) > 0] = self.transitions.indices
            self._table = as_indices(table.reshape(self.num_states, self.num_actions), self.num_states)
        return self._table

    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        by_action = x.ndim > 1 and x.shape[1] > 1
        matrix = self._by_action if by_action else self.transitions
        ends: Any = self._ends
        rows = self._rows(states)
        if rows is not None:
            matrix, ends = matrix[rows], ends[rows]
        trailing = x.shape[2:]
        flat = x[:-1].reshape((matrix.shape[1], -1) if trailing else (matrix.shape[1],))
        result = matrix @ flat
        last = x[-1] if x.ndim > 1 else x[-1:]
        result = np.asarray(result).reshape(-1, self.num_actions, *trailing)
        if last.any():
            result = result + ends.reshape(-1, self.num_actions, *(1,) * len(trailing)) * last
        return result

    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        matrix = self._by_action if width > 1 else self.transitions
        return np.asarray(matrix.T @ mass.ravel()).reshape(self.num_states, width)

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        rows = np.asarray(states) * self.num_actions + actions
        part = self.transitions[rows]
        which = np.repeat(np.arange(len(rows)), np.diff(part.indptr))
        following, probabilities = part.indices.astype(np.int64), part.data
        ended = np.flatnonzero(self._ends[rows])
        if len(ended):
            which = np.append(which, ended)
            following = np.append(following, np.full(len(ended), self.num_states))
            probabilities = np.append(probabilities, self._ends[rows][ended])
            order = np.argsort(which, kind="stable")
            which, following, probabilities = which[order], following[order], probabilities[order]
        return Outcomes(which, following, probabilities)

    def sweep_once(self, equation: BellmanEquation, x: np.ndarray, order: Order) -> None:
        swept(self._edges(np.empty(0)), self.num_actions, equation, x, order.states)

    def _edges(self, live: np.ndarray) -> Any:
        matrix = self.transitions  # what rows lack to 1 ends, and the end has no value
        return matrix.indices, matrix.indptr, None, matrix.data, (self.num_states, self.num_actions), 0

    def restricted_to(self, states: np.ndarray) -> "Matrices":
        """These states alone; what leads out of them ends."""
        return Matrices(self.transitions[self._rows(states)][:, states].tocsr(), self.num_actions, self.operations)

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "Matrices":
        transitions = self.to_classes(classes, len(representatives))[self._rows(representatives)]
        return Matrices(transitions, self.num_actions, self.operations)

    def _rows(self, states: Any) -> np.ndarray | None:
        """The rows of some states; None: all."""
        if isinstance(states, slice) and states == slice(None):
            return None
        chosen = np.arange(self.num_states)[states]
        return (chosen[:, None] * self.num_actions + np.arange(self.num_actions)).ravel()


def transitions_of(P: Any) -> tuple["csr_matrix", int]:
    """((S A, S) CSR float64 with rows s A + a, A), from any form that `TabularMDP.from_matrices` takes.

    Raises:
        ParameterError: the shape does not fit, or entries or their sums are no probabilities.
    """
    from scipy import sparse

    if isinstance(P, list | tuple) and len(P) and sparse.issparse(P[0]):
        num_states, num_actions = P[0].shape[0], len(P)
        stacked = sparse.vstack([sparse.csr_matrix(matrix) for matrix in P]).tocsr()
        order = (np.arange(num_actions)[None, :] * num_states + np.arange(num_states)[:, None]).ravel()
        matrix = stacked[order]
    elif sparse.issparse(P):
        matrix = sparse.csr_matrix(P, dtype=np.float64)
        num_states = matrix.shape[1]
        num_actions = matrix.shape[0] // max(num_states, 1)
    else:
        dense = as_array(P, "P", np.float64)
        if dense.ndim != 3 or dense.shape[0] != dense.shape[2]:
            raise ParameterError(f"P has shape {dense.shape}; expected (states, actions, states)")
        num_states, num_actions = dense.shape[:2]
        matrix = sparse.csr_matrix(dense.reshape(num_states * num_actions, num_states))
    if matrix.shape != (num_states * num_actions, num_states) or not num_actions:
        raise ParameterError(f"P has shape {matrix.shape}; expected (states * actions, states)")
    matrix = matrix.astype(np.float64)
    matrix.sum_duplicates()
    if not (np.isfinite(matrix.data).all() and (matrix.data >= 0).all()):
        raise ParameterError("P has entries that are negative, NaN or infinite; expected probabilities")
    sums = np.asarray(matrix.sum(axis=1)).ravel()
    if (sums > 1 + 1e-9).any():
        row = int(np.argmax(sums))
        raise ParameterError(
            f"P of state {row // num_actions}, action {row % num_actions} sums to {sums[row]}; expected at most 1"
        )
    return matrix, num_actions


def expected_rewards(P: Any, R: Any, num_states: int, num_actions: int) -> np.ndarray:
    """(S, A) expected rewards, from (S, A); from (S,), alike for every action; or from (S, A, S) with a dense P.

    What is none of these comes back as it is.
    """
    rewards = as_array(R, "R", np.float64)
    if rewards.shape == (num_states, num_actions, num_states) and isinstance(P, np.ndarray | list | tuple):
        probabilities = np.asarray(P)
        if probabilities.dtype != object and probabilities.shape == rewards.shape:
            return (probabilities * rewards).sum(axis=2)
    if rewards.shape == (num_states,):
        return np.repeat(rewards[:, None], num_actions, axis=1)
    return rewards
