"""The forms in which transition probabilities and expected rewards are written: dense, sparse, one matrix for each action."""

from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


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
        dense = np.asarray(P, np.float64)
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
    """(S, A), or what R is where it is none of the forms: (S, A); (S,) for every action alike; (S, A, S) with a dense P."""
    rewards = np.asarray(R, np.float64)
    if rewards.shape == (num_states, num_actions, num_states) and isinstance(P, np.ndarray | list | tuple):
        probabilities = np.asarray(P)
        if probabilities.dtype != object and probabilities.shape == rewards.shape:
            return (probabilities * rewards).sum(axis=2)
    if rewards.shape == (num_states,):
        return np.repeat(rewards[:, None], num_actions, axis=1)
    return rewards
