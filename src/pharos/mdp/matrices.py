"""Transition probabilities and rewards as users write them: arrays, lists of matrices, sparse matrices."""

from typing import TYPE_CHECKING, TypeGuard

import numpy as np
import numpy.typing as npt

from pharos.errors import ParameterError
from pharos.mdp.action_sets import filled, sets_of, stand_ins
from pharos.mdp.arguments import ROUNDED, Residual, array_argument, normalized_rows, rounding_hint
from pharos.mdp.rewards import Rewards, rounding_of_mean

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

AXES = ("SAS", "ASS")
"""Orders of the axes of an array of transitions, S states and A actions."""


def transitions_of(
    P: object,
    axes: str | None = None,
    ends: npt.ArrayLike = False,
    available: npt.ArrayLike | None = None,
    R: object = None,
) -> tuple["csr_matrix", int, np.ndarray, np.ndarray | None]:
    """((S A, S) CSR float64 with rows s A + a, A, |sum - 1| (S A,) of the rows divided by it, sets (S, A) or None).

    P has any form that `TabularMDP.from_matrices` takes. Rows of unavailable actions are those that they act as.

    Raises:
        ParameterError: the shape does not fit, or entries or their sums are no probabilities.
    """
    if axes not in (None, *AXES):
        raise ParameterError(f"axes is {axes!r}; expected 'SAS' or 'ASS', S states and A actions")
    matrix = by_rows(P, "P", axes)
    num_rows, num_states = matrix.shape
    num_actions = num_rows // num_states
    if not (np.isfinite(matrix.data).all() and (matrix.data >= 0).all()):
        raise ParameterError("P has entries that are negative, NaN or infinite; expected probabilities")
    if not isinstance(ends, bool | np.bool_):
        shares = array_argument(ends, "ends", np.float64)
        if shares.shape != (num_states, num_actions) or not ((shares >= 0) & (shares <= 1)).all():
            raise ParameterError(
                f"ends has shape {shares.shape}; expected True, False or probabilities ({num_states}, {num_actions})"
            )
        ends = shares
    sets = _sets(matrix, (num_states, num_actions), ends, available, R)
    if sets is not None:
        matrix = matrix[_acting_rows(sets)]
        ends = ends if isinstance(ends, bool | np.bool_) else filled(np.asarray(ends), sets)
    ends = ends if isinstance(ends, bool | np.bool_) else np.asarray(ends).ravel()

    def refuse(row: int, total: float) -> Exception:
        s, a = divmod(row, num_actions)
        reason = likely_reason(matrix, num_actions, row, total)
        return ParameterError(f"P of state {s}, action {a} sums to {total:.9g}; expected 1{reason}")

    rows = np.repeat(np.arange(num_rows), np.diff(matrix.indptr))
    may_end = bool(ends) if isinstance(ends, bool | np.bool_) else np.asarray(ends)
    matrix.data, residuals = normalized_rows(matrix.data, rows, num_rows, refuse, ends=may_end)
    return matrix, num_actions, residuals, sets


def _sets(
    matrix: "csr_matrix", shape: tuple[int, int], ends: npt.ArrayLike, available: npt.ArrayLike | None, R: object
) -> np.ndarray | None:
    """(S, A) bool, the actions that are available: as given, without those paid -inf and those whose row is empty."""
    rewards = R if isinstance(R, np.ndarray | list | tuple) and not is_list_of_matrices(R) else np.empty(0)
    sets = sets_of(available, array_argument(rewards, "R", np.float64) if len(rewards) else np.empty(0), shape)
    if available is not None or (isinstance(ends, bool | np.bool_) and ends):
        return sets
    has_row = (np.asarray(matrix.sum(axis=1)).ravel() > 0).reshape(shape)
    if not isinstance(ends, bool | np.bool_):
        has_row |= np.asarray(ends) > 0
    has_row |= ~has_row.any(axis=1, keepdims=True)
    if has_row.all():
        return sets
    return has_row if sets is None else sets & has_row


def _acting_rows(sets: np.ndarray) -> np.ndarray:
    """(S A,) the row s A + a that each row acts as."""
    return (np.arange(len(sets))[:, None] * sets.shape[1] + stand_ins(sets)).ravel()


def likely_reason(matrix: "csr_matrix", num_actions: int, row: int, total: float) -> str:
    """The likely reason why a row does not sum to 1, and what to do, for the end of a message."""
    num_rows, num_states = matrix.shape
    action = np.repeat(np.arange(num_rows) % num_actions, np.diff(matrix.indptr))
    columns = np.bincount(action * num_states + matrix.indices, matrix.data, minlength=num_rows)
    if (np.abs(columns - 1) <= ROUNDED).all():
        return ": its columns do; transpose the matrix of each action, whose rows are the states before the step"
    if total == 0:
        first = row // num_actions * num_actions
        if matrix.indptr[first] == matrix.indptr[first + num_actions]:
            return ": the state has no outcomes; if it is terminal, say ends=True"
        return ": the action is available, but its row is empty; say ends=True if it ends the episode"
    return rounding_hint(total) or (": if the rest ends the episode, say ends=True" if total < 1 else "")


def is_list_of_matrices(value: object) -> "TypeGuard[list[np.ndarray]]":
    """Whether it is a list or tuple of matrices, dense or sparse. Nested lists of numbers are an array."""
    return isinstance(value, list | tuple) and bool(value) and all(getattr(each, "ndim", 0) == 2 for each in value)


def by_rows(value: object, name: str, axes: str | None) -> "csr_matrix":
    """(S A, S) CSR float64 with rows s A + a: a copy of an array, a list of matrices, or a sparse matrix.

    Args:
        axes: "SAS", "ASS", or None: a list has one matrix an action, an array is (S, A, S), and if both orders fit
            it must be said.
    """
    from scipy import sparse

    is_by_action = axes == "ASS"
    if is_list_of_matrices(value):
        is_by_action = axes != "SAS"
        shapes = {tuple(each.shape) for each in value}
        rows, columns = next(iter(shapes))
        num_states, num_actions = (rows, len(value)) if is_by_action else (len(value), rows)
        if len(shapes) > 1 or columns != num_states:
            expected = "one (states, states) matrix an action" if is_by_action else "one (actions, states) a state"
            raise ParameterError(
                f"{name} is a list of {len(value)} matrices of shape {', '.join(map(str, sorted(shapes)))}; expected "
                f"{expected}, or axes={'SAS' if is_by_action else 'ASS'!r}"
            )
        parts = [each if sparse.issparse(each) else array_argument(each, name, np.float64) for each in value]
        matrix = sparse.vstack([sparse.csr_matrix(part) for part in parts]).tocsr()
    elif sparse.issparse(value):
        matrix = sparse.csr_matrix(value, dtype=np.float64)
        num_states = matrix.shape[1]
        num_actions = matrix.shape[0] // max(num_states, 1)
    else:
        dense = array_argument(value, name, np.float64)
        shape = dense.shape
        if axes is None and dense.ndim == 3 and shape[0] == shape[1] == shape[2] > 1:
            raise ParameterError(
                f"{name} has shape {shape}, as many actions as states, so its axes may be (states, actions, states) or "
                f"(actions, states, states); say axes='SAS' or axes='ASS'"
            )
        order = "actions, states, states" if is_by_action else "states, actions, states"
        if dense.ndim != 3 or shape[1 if is_by_action else 0] != shape[2] or not dense.size:
            hint = "; say axes='ASS' for (actions, states, states)" if dense.ndim == 3 and shape[1] == shape[2] else ""
            raise ParameterError(f"{name} has shape {shape}; expected ({order}){hint if axes is None else ''}")
        num_states, num_actions = shape[2], shape[0 if is_by_action else 1]
        matrix = sparse.csr_matrix(dense.reshape(num_states * num_actions, num_states))
    if matrix.shape != (num_states * num_actions, num_states) or not num_actions:
        raise ParameterError(f"{name} has shape {matrix.shape}; expected (states * actions, states)")
    if is_by_action:
        matrix = matrix[(np.arange(num_actions) * num_states + np.arange(num_states)[:, None]).ravel()]
    matrix = matrix.astype(np.float64)
    matrix.sum_duplicates()
    return matrix


def expected_rewards(
    matrix: "csr_matrix",
    R: object,
    axes: str | None,
    num_actions: int,
    residuals: np.ndarray,
    sets: np.ndarray | None = None,
) -> tuple[Rewards | np.ndarray, Residual]:
    """((S, A) expected rewards, residual), from (S, A), from (S,), alike for every action, or from a reward for each
    transition, in any form of P, averaged over the probabilities.

    Other shapes are returned unchanged.
    """
    from scipy import sparse

    num_states = matrix.shape[1]
    shape = (num_states, num_actions)
    if sparse.issparse(R) and getattr(R, "shape", None) == shape:
        R = sparse.csr_matrix(R).toarray()
    if not sparse.issparse(R) and not is_list_of_matrices(R):
        R = array_argument(R, "R", np.float64)
    if not isinstance(R, np.ndarray) or R.ndim == 3:
        by_transition = by_rows(R, "R", axes)
        if by_transition.shape != matrix.shape:
            raise ParameterError(
                f"R has rewards for {by_transition.shape} rows and next states; expected {matrix.shape}, as P"
            )
        if sets is not None:
            by_transition = by_transition[_acting_rows(sets)]
        rows = np.repeat(np.arange(len(residuals)), np.diff(matrix.indptr))
        each = np.asarray(by_transition[rows, matrix.indices]).ravel()
        each[matrix.data == 0] = 0.0
        if not np.isfinite(each).all():
            s, a = divmod(int(rows[~np.isfinite(each)][0]), num_actions)
            raise ParameterError(f"R of state {s}, action {a} has a reward that is not finite; expected numbers")
        largest = np.zeros(len(residuals))
        np.maximum.at(largest, rows, np.abs(each))
        terms = matrix.data * each
        means, sizes = (np.bincount(rows, each, minlength=len(residuals)) for each in (terms, np.abs(terms)))
        rounding = rounding_of_mean(int(np.diff(matrix.indptr).max(initial=0)), float(sizes.max(initial=0.0)))
        return Rewards.from_array(means.reshape(shape), rounding), Residual.of(residuals, largest)
    if R.shape == (num_states,):
        R = np.repeat(R[:, None], num_actions, axis=1)
    if sets is not None and R.shape == shape:
        R = filled(R, sets)
    return R, Residual.of(residuals)


def lacking(matrix: "csr_matrix") -> np.ndarray:
    """(S, A) what the rows s A + a of a matrix lack to 1: argument `ends` for rows that are right as they are."""
    return np.clip(1 - np.asarray(matrix.sum(axis=1)), 0.0, 1.0).reshape(matrix.shape[1], -1)
