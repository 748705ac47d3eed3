"""Runs: some rows of a range, as a few contiguous stretches of it."""

import itertools

import numpy as np


def runs_of(is_in: np.ndarray, gap: int = 1) -> np.ndarray:
    """(R, 2) int64: where the stretches of rows begin and end that are in, (n,) bool; ascending.

    gap: stretches with fewer rows than that between them are one.
    """
    change = np.flatnonzero(np.diff(np.concatenate([[False], is_in, [False]]).astype(np.int8)))
    starts, stops = change[::2], change[1::2]
    is_apart = starts[1:] - stops[:-1] >= gap
    return np.stack([np.append(starts[:1], starts[1:][is_apart]), np.append(stops[:-1][is_apart], stops[-1:])], axis=1)


def runs_between(runs: np.ndarray, num_rows: int) -> np.ndarray:
    """(R, 2): the stretches of the other rows."""
    edges = np.concatenate([[0], runs.reshape(-1), [num_rows]]).reshape(-1, 2)
    return edges[edges[:, 1] > edges[:, 0]]


def count_of(runs: np.ndarray) -> int:
    """How many rows there are in runs (R, 2)."""
    return int((runs[:, 1] - runs[:, 0]).sum())


def rows_of(runs: np.ndarray) -> np.ndarray:
    """(N,) int64: the rows of runs (R, 2), ascending."""
    return np.concatenate([np.zeros(0, np.int64), *(np.arange(start, stop) for start, stop in runs.tolist())])


def shares_of(runs: np.ndarray, shares: int) -> list[np.ndarray]:
    """The runs (R, 2) in as many parts of as many rows each, up to one; in order, without empty ones."""
    before = np.concatenate([[0], np.cumsum(runs[:, 1] - runs[:, 0])])
    cuts = [int(before[-1]) * i // shares for i in range(shares + 1)]
    parts = []
    for low, high in itertools.pairwise(cuts):
        if high > low:
            first, last = np.searchsorted(before, low, "right") - 1, np.searchsorted(before, high, "left")
            part = runs[first:last].copy()
            part[0, 0] += low - before[first]
            part[-1, 1] -= before[last] - high
            parts.append(part)
    return parts
