"""The table of the states that a search has found: in memory beside all states, or on disk.

Both forms number states by `find_or_number`. kernels/hash_table.py has the layout of the table on disk.
"""

import contextlib
import mmap
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pharos.kernels import hash_table as kernels
from pharos.kernels.hash_table import fill, fill_more, fill_range, insert_missing, slots_of
from pharos.state_space.manifest import cannot_write
from pharos.system import memory as machine
from pharos.system.arrays import INT32_STATES
from pharos.system.memory import huge_pages, mapped_file, reserved_states, reserved_table

LOAD = 0.5  # the table in memory grows beyond this share of used slots
FULLEST = 0.8  # the same, if memory has no room for a table of twice the size
SLOTS = 1 << 16  # a table has a multiple of them
PARALLEL_FILL = 1 << 16  # states that are worth sharing between threads when the table grows
LEFT_OVER = 1 << 12  # states that may pass the end of a part of the table, which are a handful


class BranchBlock(NamedTuple):
    """Rows of a search: results of expanding some states, by B branches each: actions, or outcomes of actions.

    See `rules.Expansion`.

    Attributes:
        successors: (rows, B) indices. terminal: (rows,) uint8. probabilities: (rows, B), of no rows without chance.
    """

    successors: np.ndarray
    terminal: np.ndarray
    probabilities: np.ndarray

    def rows(self, start: int, stop: int) -> "BranchBlock":
        """The rows [start, stop)."""
        return BranchBlock(self.successors[start:stop], self.terminal[start:stop], self.probabilities[start:stop])


class MemoryTable:
    """All states, and a hash table of their indices.

    Attributes:
        states: (capacity, W) uint64, in the order of discovery.
        slots: index of a state, or -1, see kernels/hash_table.py.
        forgotten: number of states that the table leaves out, as the search does not come to them again.
    """

    def __init__(self, num_words: int, margin: int, memory: int | None, share: int = 1):
        """
        Args:
            margin: states that a kernel may add between two looks at the room.
            memory: bytes that states and table may take. None for as much as there is.
            share: how many processes share what there is.
        """
        self.states = reserved_states(num_words)
        self.slots = np.empty(0, np.int32)
        self._space = reserved_table()
        self._margin, self._memory, self._share = margin, memory, share
        self._load = LOAD
        self.forgotten = 0

    @property
    def room(self) -> int:
        """States that table and array of states can hold."""
        return min(int(len(self.slots) * self._load) + self.forgotten, len(self.states))

    def is_full(self, count: int) -> bool:
        """Whether the table must grow before a kernel goes on from `count` states."""
        return count + self._margin > self.room

    def fits(self, count: int, dtype: np.dtype, forgotten: int = 0) -> bool:
        """Whether memory holds a table with room for more states, and the states."""
        return count + self._margin <= len(self.states) and self._size_for(count, dtype, forgotten) is not None

    def _size_for(self, count: int, dtype: np.dtype, forgotten: int) -> tuple[int, float] | None:
        """(slots, share of them that may be used) of a larger table. None if it would hold hardly more states.

        It has room for about twice as many states, or is fuller and as large as memory allows.
        """
        memory, bytes_of_state = self._limit(count), self.states.shape[1] * 8
        slots = self._slots_for(count - forgotten)
        if slots * dtype.itemsize + (int(slots * LOAD) + forgotten) * bytes_of_state <= memory:
            return slots, LOAD
        bytes_of_slot = dtype.itemsize + FULLEST * bytes_of_state
        slots = int((memory - forgotten * bytes_of_state) / bytes_of_slot) // SLOTS * SLOTS
        enough = slots * FULLEST >= 1.1 * (count - forgotten) + self._margin
        return (slots, FULLEST) if enough else None

    def _limit(self, count: int) -> int:
        """Bytes for table and states: as asked for, or the free ones and those that they have already."""
        if self._memory is not None:
            return self._memory
        return machine.available_memory() // self._share + self.slots.nbytes + count * self.states.shape[1] * 8

    def grow(
        self,
        count: int,
        dtype: np.dtype,
        pool: ThreadPoolExecutor | None,
        workers: int,
        parts: list[np.ndarray] | None = None,
    ) -> None:
        """Replace the table by a larger one, see `fits`, filled from the array of states.

        parts: indices of the only states that are wanted, part by part. None: all.
        """
        self.forgotten = 0 if parts is None else count - sum(map(len, parts))
        size = self._size_for(count, dtype, self.forgotten) or (self._slots_for(count - self.forgotten), LOAD)
        slots = max(size[0], len(self.slots) if parts is not None else 0)
        self._load = size[1]
        # the new table, in the place of the old one if that can grow
        self.slots = np.empty(0, dtype)  # free the old one first, if it cannot grow in its place
        if self._space.nbytes < slots * dtype.itemsize:
            self._space = huge_pages(slots, dtype)
        self.slots = self._space.view(dtype)[:slots]
        if parts is not None:
            self.slots.fill(-1)
            for part in parts:
                fill_more(self.slots, self.states, part.astype(np.int64))
            return
        # fill it by one thread, or by several, a part of the slots each
        if pool is None or workers == 1 or count < PARALLEL_FILL:
            self._fill(count)
            return
        cuts = [slots * i // workers for i in range(workers + 1)]
        left_over = np.empty((workers, LEFT_OVER), np.int64)

        def fill_part(i: int) -> int:
            self.slots[cuts[i] : cuts[i + 1]].fill(-1)
            return fill_range(self.slots, self.states, count, cuts[i], cuts[i + 1], left_over[i])

        left = [*pool.map(fill_part, range(workers))]
        if max(left) > left_over.shape[1]:  # only if a bad hash crowds the end of a part
            self._fill(count)
            return
        # states that found no slot in their part
        for i, over in enumerate(left):
            fill_more(self.slots, self.states, left_over[i, :over])

    def find_or_number(
        self, keys: np.ndarray, indices: np.ndarray, successors: np.ndarray, progress: np.ndarray
    ) -> None:
        """Number the successors that are new, in their order.

        Args:
            keys: (rows * B, W) uint64, successors by B branches. indices: (rows * B,), their indices, or -1 - slot from
                which to search on.
            successors: (rows, B), gets the indices. progress: see kernels/hash_table.py. It goes on by these rows.
        """
        insert_missing(self.slots, self.states, keys, indices, successors, progress)

    def release(self) -> None:
        """Free the memory, also if a traceback keeps this table alive."""
        self.states, self.slots = self.states[:0].copy(), self.slots[:0].copy()
        self._space = self._space[:0].copy()

    def _fill(self, count: int) -> None:
        self.slots.fill(-1)
        fill(self.slots, self.states, count)

    def _slots_for(self, count: int) -> int:
        slots = SLOTS
        while slots * LOAD < 1.4 * count + self._margin:
            slots *= 2
        return slots


class SpilledTable:
    """The table on disk, and memory for a chunk of the frontier.

    Attributes:
        rows: of a chunk: as many as half of the memory holds. The table takes a quarter at a time.
        states: those that the chunk numbers and that are not in the file yet. keys, indices: of its candidates.
        appended: states that are in the file. The first of `states` has this number.
    """

    def __init__(self, path: Path, num_words: int, branches: int, memory: int, count: int, has_chance: bool = False):
        self.rows = rows_of_chunk(memory, num_words, branches, has_chance)
        candidates = self.rows * branches
        self.states, self.keys = (np.empty((candidates, num_words), np.uint64) for _ in range(2))
        self.indices, self._slots = np.empty(candidates, np.int64), np.empty(candidates, np.int64)
        self._order = np.empty(candidates, np.int32)
        self.appended = count
        probabilities = np.empty((self.rows if has_chance else 0, branches))
        self._block = BranchBlock(np.empty((0, branches), np.int32), np.empty(self.rows, np.uint8), probabilities)
        self._table = DiskTable(path, num_words, memory // 4, 2 * count)

    def fill(self, states: np.ndarray) -> None:
        """Enter states (N, W), numbered from 0 on, into the empty table, a chunk at a time."""
        for start in range(0, len(states), self.rows):
            self._table.fill(np.array(states[start : start + self.rows], np.uint64), start)

    def take_over(self, table: MemoryTable) -> None:
        """Copy the states of the table in memory into the empty one on disk."""
        self._table.take_over(table.slots, table.states)

    def block(self, dtype: np.dtype) -> BranchBlock:
        """The block for the rows of the chunk, with successors of this type."""
        successors = self._block.successors
        if len(successors) != self.rows or successors.dtype != dtype:
            self._block = self._block._replace(successors=np.empty((self.rows, successors.shape[1]), dtype))
        return self._block

    def find_or_number(
        self, keys: np.ndarray, indices: np.ndarray, successors: np.ndarray, progress: np.ndarray
    ) -> None:
        """Number the successors that are new, in their order, see `MemoryTable.find_or_number`.

        indices: -1 - bucket, or the own row of a terminal state.
        """
        first, count = int(progress[0]), int(progress[1])
        self._table.grow(count + len(keys))
        looked_up = self._table.look_up(keys, indices, first, self._order, self._slots)
        from pharos.kernels import hash_table

        hash_table.number_states(keys, indices, successors, self.states, self.appended, progress)
        self._table.assign_numbers(looked_up, indices, self._order, self._slots)


def rows_of_chunk(memory: int, num_words: int, branches: int, has_chance: bool = False) -> int:
    """Rows of a chunk, whose candidates take half of the memory: a multiple of 8, as terminal bits fill whole bytes."""
    candidate = 2 * 8 * num_words + 8 + 8 + 8 + 4  # words here and as a state, index, slots, a successor, order
    candidate += 24 * has_chance  # a probability, and once more with its successor when it is written
    bytes_of_a_row = branches * candidate + 8 * num_words + 1
    rows = max(memory // 2 // bytes_of_a_row // 1024, 1) * 1024
    return max(8, min(rows, INT32_STATES // branches // 8 * 8))


# The table on disk ----------------------------------------------------------------------------------------------------


DISK_LOAD = 0.7  # the table on disk grows beyond this share of used slots
LEAST_SLOTS = 1 << 16  # slots of the smallest table
_AROUND = 1 << 19  # bytes that the system may bring along with a page (large folios)


class DiskTable:
    """The table on disk, in a file without a name: it is gone with the process, whatever becomes of it.

    Attributes:
        capacity: states that it can hold before it must grow.
    """

    def __init__(self, folder: Path, num_words: int, window: int, states: int):
        """An empty table with room for a number of states, of which about `window` bytes are in this process's memory
        at a time.
        """
        self.folder, self.num_words, self.window = folder, num_words, window
        slots = LEAST_SLOTS
        while slots * DISK_LOAD < states:
            slots *= 2
        self._open(slots)

    def _open(self, slots: int) -> None:
        try:
            self._mapping = mapped_file(self.folder, slots * (self.num_words + 1) * 8)
        except OSError as error:
            raise cannot_write(self.folder / "the table of states", error) from error
        self.entries = np.frombuffer(self._mapping, np.uint64).reshape(slots, self.num_words + 1)
        self.capacity = int(slots * DISK_LOAD)
        self._touched = 0

    def take_over(self, table: np.ndarray, states: np.ndarray) -> None:
        """Fill the table from the one in memory."""
        self._sweep(len(table), lambda low, high: kernels.place_from_memory(self.entries, table, states, low, high))

    def fill(self, states: np.ndarray, first: int) -> None:
        """Add states (n, W) that are not there yet, with indices first, first + 1, ..."""
        buckets, order = np.empty(len(states), np.int64), np.empty(len(states), np.int32)
        slots_of(states, kernels.BUCKETS, buckets)
        size = kernels.sort_by_bucket(-1 - buckets, 0, order)
        self._sweep(size, lambda low, high: kernels.place(self.entries, states, order, low, high, first))

    def grow(self, states: int) -> None:
        """Grow the table until it can hold a number of states."""
        slots = len(self.entries)
        while slots * DISK_LOAD < states:
            slots *= 2
        if slots == len(self.entries):
            return
        old, mapping = self.entries, self._mapping
        self._open(slots)
        self._sweep(len(old), lambda low, high: kernels.place_again(self.entries, old, low, high), also=mapping)

    def look_up(self, keys: np.ndarray, indices: np.ndarray, first: int, order: np.ndarray, slots: np.ndarray) -> int:
        """Find candidates, or enter them as new. Returns how many of `order` were looked up."""
        size = kernels.sort_by_bucket(indices, first, order)
        self._sweep(size, lambda low, high: kernels.look_up(self.entries, keys, order, low, high, indices, slots))
        return size

    def assign_numbers(self, size: int, indices: np.ndarray, order: np.ndarray, slots: np.ndarray) -> None:
        """Write the numbers of new states into their entries."""
        self._sweep(size, lambda low, high: kernels.assign_numbers(self.entries, order, low, high, indices, slots))

    def _sweep(self, size: int, work: Callable[[int, int], None], also: mmap.mmap | None = None) -> None:
        """Call work(low, high) for parts of range(size), in order of slots. A part touches no more than the window."""
        entry_bytes = min(_AROUND, self.entries.nbytes // max(size, 1) + 64)  # bytes that an entry may touch
        step = max(1, self.window // entry_bytes)
        for low in range(0, size, step):
            high = min(low + step, size)
            work(low, high)
            self._touched += (high - low) * entry_bytes
            if self._touched >= self.window:
                for mapping in filter(None, (self._mapping, also)):
                    _release_pages(mapping)
                self._touched = 0


def _release_pages(mapping: mmap.mmap) -> None:
    """Release the pages of the file from this process's memory. They are written when the system sees fit."""
    if hasattr(mmap, "MADV_DONTNEED"):
        with contextlib.suppress(OSError):
            mapping.madvise(mmap.MADV_DONTNEED)
