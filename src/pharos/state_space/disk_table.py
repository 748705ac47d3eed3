"""The table of states on disk, for state spaces whose table does not fit in memory.

kernels/hash_table.py has its layout.
"""

import contextlib
import mmap
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pharos.kernels import hash_table as kernels
from pharos.kernels.hash_table import slots_of
from pharos.state_space.files import cannot_write
from pharos.system.memory import mapped_file

LOAD = 0.7  # the table grows beyond this share of used slots
LEAST = 1 << 16  # slots of the smallest table
_AROUND = 1 << 19  # bytes that the system may bring along with a page (large folios)


class DiskTable:
    """The table, in a file without a name: it is gone with the process, whatever becomes of it.

    Attributes:
        capacity: states that it can hold before it must grow.
    """

    def __init__(self, folder: Path, num_words: int, window: int, states: int):
        """An empty table with room for a number of states, of which about `window` bytes are in this process's memory
        at a time.
        """
        self.folder, self.num_words, self.window = folder, num_words, window
        slots = LEAST
        while slots * LOAD < states:
            slots *= 2
        self._open(slots)

    def _open(self, slots: int) -> None:
        try:
            self._mapping = mapped_file(self.folder, slots * (self.num_words + 1) * 8)
        except OSError as error:
            raise cannot_write(self.folder / "the table of states", error) from error
        self.entries = np.frombuffer(self._mapping, np.uint64).reshape(slots, self.num_words + 1)
        self.capacity = int(slots * LOAD)
        self._touched = 0

    def take_over(self, table: np.ndarray, states: np.ndarray) -> None:
        """Fill it from the table in memory."""
        self._sweep(len(table), lambda low, high: kernels.place_from_memory(self.entries, table, states, low, high))

    def fill(self, states: np.ndarray, first: int) -> None:
        """Add states (n, W) that are not there yet, with indices first, first + 1, ..."""
        buckets, order = np.empty(len(states), np.int64), np.empty(len(states), np.int32)
        slots_of(states, kernels.BUCKETS, buckets)
        size = kernels.sort_by_bucket(-1 - buckets, 0, order)
        self._sweep(size, lambda low, high: kernels.place(self.entries, states, order, low, high, first))

    def grow(self, states: int) -> None:
        """Make room for a number of states."""
        slots = len(self.entries)
        while slots * LOAD < states:
            slots *= 2
        if slots == len(self.entries):
            return
        old, mapping = self.entries, self._mapping
        self._open(slots)
        self._sweep(len(old), lambda low, high: kernels.place_again(self.entries, old, low, high), also=mapping)

    def look_up(self, keys: np.ndarray, indices: np.ndarray, first: int, order: np.ndarray, slots: np.ndarray) -> int:
        """Find candidates, or enter them as new; returns how many of `order` were looked up."""
        size = kernels.sort_by_bucket(indices, first, order)
        self._sweep(size, lambda low, high: kernels.look_up(self.entries, keys, order, low, high, indices, slots))
        return size

    def settle(self, size: int, indices: np.ndarray, order: np.ndarray, slots: np.ndarray) -> None:
        """Give what was new its numbers."""
        self._sweep(size, lambda low, high: kernels.settle(self.entries, order, low, high, indices, slots))

    def _sweep(self, size: int, work: Callable[[int, int], None], also: mmap.mmap | None = None) -> None:
        """Do work(low, high) for parts of range(size), in order of slots, so that a part touches no more than the
        window.
        """
        each = min(_AROUND, self.entries.nbytes // max(size, 1) + 64)  # bytes that one of them may touch
        step = max(1, self.window // each)
        for low in range(0, size, step):
            high = min(low + step, size)
            work(low, high)
            self._touched += (high - low) * each
            if self._touched >= self.window:
                for mapping in filter(None, (self._mapping, also)):
                    _let_go(mapping)
                self._touched = 0


def _let_go(mapping: mmap.mmap) -> None:
    """Take the pages of the file out of this process's memory; they are written when the system sees fit."""
    if hasattr(mmap, "MADV_DONTNEED"):
        with contextlib.suppress(OSError):
            mapping.madvise(mmap.MADV_DONTNEED)
