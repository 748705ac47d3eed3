"""Dynamics with any number of outcomes, from a sparse matrix, and the forms in which users write them."""

from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp.outcome_table import OutcomeTable
from pharos.mdp.tabular_arrays import as_array

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


class Matrices(OutcomeTable):
    """A table of outcomes, row after row, that was given as a sparse matrix, and is kept in files as one.

    Attributes:
        transitions: (S A, S) CSR float64, row s A + a; what a row lacks to 1 is the probability that the episode ends,
            but for 4 (n + 2) units of 2^-53 where rows have n entries: as much as their own rounding may lack.
    """

    def __init__(self, transitions: "csr_matrix", num_actions: int):
        if not transitions.data.all():
            transitions = transitions.copy()
            transitions.eliminate_zeros()
        self.transitions = transitions
        counts = np.diff(transitions.indptr)
        lacking = 1 - np.asarray(transitions.sum(axis=1)).ravel()
        ending = np.flatnonzero(lacking > 4 * (int(counts.max(initial=0)) + 2) * 2.0**-53)
        places, offsets = transitions.indptr[ending + 1], transitions.indptr
        successors, probabilities = transitions.indices, transitions.data
        if len(ending):
            successors = np.insert(successors, places, -1)
            probabilities = np.insert(probabilities, places, lacking[ending])
            offsets = offsets + np.searchsorted(ending, np.arange(len(offsets)))
        super().__init__(successors, num_actions, offsets=offsets, probabilities=probabilities)

    def arrays(self) -> dict[str, np.ndarray]:
        matrix = self.transitions
        names = ("transitions_data", "transitions_indices", "transitions_indptr")
        return dict(zip(names, (matrix.data, matrix.indices, matrix.indptr), strict=True))


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
