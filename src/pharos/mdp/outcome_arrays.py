"""Arrays of outcomes as users write them, checked, and as `OutcomeTable` holds them: compactly."""

from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp.dynamics import as_indices
from pharos.mdp.tabular_arrays import as_array

# The share of a dense table that may be padding before successors are kept one row after another.
MOST_PADDING = 0.3
# Vectors of probabilities that codes of one and of two bytes tell apart.
FEW, MANY = 1 << 8, 1 << 16
# What the probabilities of a row may lack to 1, or have beyond it.
SUM_TOLERANCE = 1e-9


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


def check_outcome_arrays(
    successors: np.ndarray,
    shape: tuple[int, int],
    *,
    offsets: np.ndarray | None = None,
    codes: np.ndarray | None = None,
    palette: np.ndarray | None = None,
    probabilities: np.ndarray | None = None,
) -> None:
    """ParameterError unless the arrays are those of an OutcomeTable of (S, A) rows."""
    rows = shape[0] * shape[1]
    if successors.dtype.kind not in "iu" or not (
        (successors.ndim == 1 and offsets is not None) or (successors.ndim == 3 and successors.shape[:2] == shape)
    ):
        raise ParameterError(
            f"successors have shape {successors.shape} and type {successors.dtype}; expected integers of shape {shape} "
            "and the outcomes, or one axis with offsets"
        )
    if offsets is not None:
        fits = offsets.shape == (rows + 1,) and offsets.dtype.kind in "iu"
        if not fits or offsets[0] != 0 or offsets[-1] != len(successors) or (offsets[1:] <= offsets[:-1]).any():
            raise ParameterError(f"offsets do not cut {len(successors)} successors into {rows} rows of one or more")
    outside = (successors < -1) | (successors >= shape[0])
    if outside.any():
        raise ParameterError(f"a successor is {successors[outside][0]}; expected a state below {shape[0]}, or -1")
    if palette is None:
        assert probabilities is not None
        vectors = _as_rows(probabilities, successors, offsets)
    else:
        assert codes is not None
        _check_codes(codes, palette, shape)
        vectors = palette
    sums = vectors.sum(axis=1)
    possible = vectors > 0
    if not ((vectors >= 0).all() and (np.abs(sums - 1) <= SUM_TOLERANCE).all()):
        raise ParameterError("a vector of probabilities has entries below 0, or does not sum to 1")
    if not possible[:, 0].all() or (possible[:, 1:] > possible[:, :-1]).any():
        raise ParameterError("a vector of probabilities has zeros before others; expected them last")
    counts = possible.sum(axis=1)
    each = counts if codes is None else counts[codes.reshape(-1)]
    if offsets is not None:
        if (each != np.diff(offsets)).any():
            raise ParameterError("a row has another number of successors than of probabilities")
    elif (
        (successors != successors[..., :1]).reshape(rows, -1) & (np.arange(successors.shape[2]) >= each[:, None])
    ).any():
        raise ParameterError("what is impossible is not the first successor of its row again")


def _check_codes(codes: np.ndarray, palette: np.ndarray, shape: tuple[int, int]) -> None:
    if codes.shape != shape or codes.dtype.kind != "u" or palette.ndim != 2 or palette.dtype != np.float64:
        raise ParameterError(
            f"codes have shape {codes.shape} and type {codes.dtype}, the palette {palette.shape} and {palette.dtype}; "
            f"expected {shape}, unsigned, and vectors of float64"
        )
    if codes.max(initial=0) >= len(palette):
        raise ParameterError(f"a code is {codes.max()}; expected less than {len(palette)}, the size of the palette")


def _as_rows(probabilities: np.ndarray, successors: np.ndarray, offsets: np.ndarray | None) -> np.ndarray:
    """(S A, K), zeros last, of probabilities in the shape of successors."""
    if probabilities.shape != successors.shape or probabilities.dtype != np.float64:
        raise ParameterError(
            f"probabilities have shape {probabilities.shape} and type {probabilities.dtype}; expected "
            f"{successors.shape} and float64"
        )
    if offsets is None:
        return probabilities.reshape(-1, probabilities.shape[2])
    counts = np.diff(offsets)
    vectors = np.zeros((len(counts), int(counts.max())))
    vectors[np.arange(vectors.shape[1]) < counts[:, None]] = probabilities
    return vectors


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
