"""Arrays of outcomes as users write them, checked, and as `OutcomeTable` holds them: compactly."""

from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp.dynamics import as_indices
from pharos.mdp.tabular_arrays import as_array
from pharos.system.outcome_rows import SUM_TOLERANCE

# The share of a dense table that may be padding before successors are kept one row after another.
MOST_PADDING = 0.3
# Vectors of probabilities that codes of one and of two bytes tell apart.
FEW, MANY = 1 << 8, 1 << 16


def checked_outcomes(successors: Any, probabilities: Any) -> tuple[np.ndarray, np.ndarray]:
    """Both as arrays (S, A, K), the probabilities as float64.

    Raises:
        ParameterError: a shape or type is wrong, an index is outside, or a row holds no probabilities; the first such
            entry is named.
    """
    table, chances = as_array(successors, "successors"), as_array(probabilities, "probabilities")
    if table.ndim != 3 or table.size == 0 or table.dtype.kind not in "iu":
        raise ParameterError(
            f"successors have shape {table.shape} and type {table.dtype}; expected integers of shape "
            "(states, actions, outcomes)"
        )
    if chances.shape != table.shape or chances.dtype.kind not in "iufb":
        raise ParameterError(
            f"probabilities have shape {chances.shape} and type {chances.dtype}; expected numbers of shape "
            f"{table.shape}, one for each successor"
        )
    chances = chances.astype(np.float64, copy=False)
    wrong = ~((chances >= 0) & (chances <= 1 + SUM_TOLERANCE))  # also NaN
    if wrong.any():
        s, a, k = map(int, np.argwhere(wrong)[0])
        raise ParameterError(f"probabilities[{s}, {a}, {k}] is {chances[s, a, k]}; expected a number from 0 to 1")
    sums = chances.sum(axis=2)
    wrong = ~(np.abs(sums - 1) <= SUM_TOLERANCE)
    if wrong.any():
        s, a = map(int, np.argwhere(wrong)[0])
        raise ParameterError(
            f"the probabilities of state {s}, action {a} sum to {sums[s, a]}; expected 1: give the end of the episode, "
            "successor -1, the rest"
        )
    wrong = (table < -1) | (table >= len(table))
    if wrong.any():
        s, a, k = map(int, np.argwhere(wrong)[0])
        raise ParameterError(
            f"successors[{s}, {a}, {k}] is {table[s, a, k]}; expected a state from 0 to {len(table) - 1}, or -1 for "
            "the end"
        )
    return table, chances


def compact_outcomes(
    successors: np.ndarray, probabilities: np.ndarray, *, most_padding: float = MOST_PADDING, most_vectors: int = MANY
) -> dict[str, Any]:
    """What an `OutcomeTable` is made of, from (S, A, K) arrays: possible ones alone, in their order."""
    num_states, num_actions, _ = successors.shape
    possible = probabilities > 0
    counts = possible.sum(axis=2)
    if not possible[..., : counts.min()].all() or (possible[..., 1:] > possible[..., :-1]).any():
        order = np.argsort(~possible, axis=2, kind="stable")  # possible ones first
        successors, probabilities, possible = (
            np.take_along_axis(each, order, axis=2) for each in (successors, probabilities, possible)
        )
    width = int(counts.max())
    successors, probabilities, possible = (each[..., :width] for each in (successors, probabilities, possible))
    result: dict[str, Any] = {"num_actions": num_actions}
    ragged = counts.sum() < (1 - most_padding) * num_states * num_actions * width
    if ragged:
        result["offsets"] = np.concatenate([[0], np.cumsum(counts.ravel())])
        result["successors"] = as_indices(successors[possible], num_states)
    else:
        result["successors"] = as_indices(np.where(possible, successors, successors[..., :1]), num_states)
    codes, palette = _palette(np.ascontiguousarray(probabilities).reshape(-1, width), most_vectors)
    if palette is None:
        result["probabilities"] = probabilities[possible] if ragged else np.ascontiguousarray(probabilities)
    else:
        result.update(codes=codes.reshape(num_states, num_actions), palette=palette)
    return result


def _palette(vectors: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray | None]:
    """(codes (N,), the distinct ones (P, K) in the order in which they appear) of vectors (N, K).

    None where they are more than `most`.
    """
    from pharos.kernels import partition

    vectors = vectors + 0.0  # -0.0 and 0.0 are one number
    numbers, count = partition.numbered_rows(vectors)
    if count > most:
        return numbers, None
    palette = np.empty((count, vectors.shape[1]))
    palette[numbers] = vectors
    return numbers.astype(np.uint8 if count <= FEW else np.uint16), palette
