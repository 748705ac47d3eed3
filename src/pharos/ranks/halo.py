"""Ranges of rows, one for each rank, and their borders: the rows of other ranks that a rank reads."""

import numpy as np

from pharos.ranks.rank import Rank


def cuts_of(num_rows: int, ranks: int) -> np.ndarray:
    """(P + 1,) int64: where the ranges of P ranks begin and end, which share the rows evenly."""
    return np.array([num_rows * i // ranks for i in range(ranks + 1)])


class Halo:
    """The rows outside of a rank's range that it reads.

    Attributes:
        rows: (H,) int64, ascending.
        of_rank: for each rank, the slice of `rows` that lies in its range.
        wanted: for each rank, the rows of this one that it reads, int64, counted from the first row of this one.
    """

    def __init__(self, rank: Rank, rows: np.ndarray, cuts: np.ndarray):
        """All ranks make theirs together, in one exchange."""
        borders = np.searchsorted(rows, cuts)
        self.rows = rows
        self.of_rank = [slice(borders[q], borders[q + 1]) for q in range(rank.size)]
        self.wanted = rank.exchange([rows[part] - cuts[q] for q, part in enumerate(self.of_rank)])

    def __len__(self) -> int:
        return len(self.rows)
