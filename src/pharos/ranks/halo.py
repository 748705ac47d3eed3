"""Ranges of rows, one for each rank, and their borders: the rows of other ranks that a rank reads.

Values of a halo come in messages from those ranks alone that have some of it. They travel while the ranks compute: the
values of the high rows of a range, all but the lowest eighth, may be sent before those of the low ones are known.
"""

import numpy as np

from pharos.ranks.rank import Rank

_LOW = 8  # one part in so many of a range is sent last


def cuts_of(num_rows: int, ranks: int) -> np.ndarray:
    """(P + 1,) int64: where the ranges of P ranks begin and end, which share the rows evenly."""
    return np.array([num_rows * i // ranks for i in range(ranks + 1)])


class Halo:
    """The rows outside of a rank's range that it reads.

    Attributes:
        rows: (H,) int64, ascending.
        of_rank: for each rank, the slice of `rows` that lies in its range.
        wanted: for each rank, the rows of this one that it reads, int64, counted from the first row of this one.
        low: this rank's rows before that are its low ones, counted from its first; all where nobody reads high ones.
    """

    def __init__(self, rank: Rank, rows: np.ndarray, cuts: np.ndarray):
        """All ranks make theirs together, in one exchange."""
        borders = np.searchsorted(rows, cuts)
        self.rows = rows
        self.of_rank = [slice(borders[q], borders[q + 1]) for q in range(rank.size)]
        self.wanted = rank.exchange([rows[part] - cuts[q] for q, part in enumerate(self.of_rank)])
        self._rank = rank
        lows = np.diff(cuts) // _LOW
        self.low = int(lows[rank.rank])
        if not any((rows >= self.low).any() for rows in self.wanted):
            self.low = int(cuts[rank.rank + 1] - cuts[rank.rank])
        self._low_borders = np.searchsorted(rows, cuts[:-1] + lows)  # where the high rows of each rank begin in `rows`
        self._received: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def is_boundary(self, num_rows: int) -> np.ndarray:
        """(n,) bool: whether some other rank reads a row of this one."""
        result = np.zeros(num_rows, np.bool_)
        for rows in self.wanted:
            result[rows] = True
        return result

    # While messages travel: receive, then send all or high and low ones, then finish --------------------------------

    def receive(self, like: np.ndarray, in_two: bool = False) -> None:
        """Begin to receive values of the halo, rows as those of `like`; in one message from each rank, or in two."""
        received = self._received
        if received is None or received.dtype != like.dtype or received.shape[1:] != like.shape[1:]:
            self._received = received = np.empty((len(self), *like.shape[1:]), like.dtype)
        for source, part in enumerate(self.of_rank):
            middle = int(self._low_borders[source])
            for piece in (slice(middle, part.stop), slice(part.start, middle)) if in_two else (part,):
                if piece.stop > piece.start:
                    self._rank.receive(source, received[piece])

    def send(self, values: np.ndarray) -> None:
        """Begin to send what others read of the values (n or more, ...) of this rank's rows."""
        self._send(values, 0, len(values))

    def send_high(self, values: np.ndarray) -> None:
        """The same, of the high rows alone."""
        self._send(values, self.low, len(values))

    def send_low(self, values: np.ndarray) -> None:
        """The same, of the low rows, which come second."""
        self._send(values, 0, self.low)

    def finish(self, into: np.ndarray) -> None:
        """Wait for the values of the halo (H, ...), where some were to be received."""
        self._rank.finish()
        if self._received is not None:
            into[...] = self._received

    def _send(self, values: np.ndarray, start: int, stop: int) -> None:
        for to, rows in enumerate(self.wanted):
            first, last = np.searchsorted(rows, [start, stop])
            if last > first:
                self._rank.send(to, values[rows[first:last]])
