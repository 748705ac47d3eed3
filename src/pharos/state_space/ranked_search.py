"""A search by several processes: the files of one process, whatever their number.

Rank 0 runs the search and writes the files. While the frontier is narrow (Freeway: 148 thousand levels of 9 states) it
works alone, as exchanges would cost more than the states. Once it is wide, or the table does not fit, all ranks share
the table and expand blocks together (ranked_table.py); what memory holds is then what all of them have.
"""

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pharos.ranks import Rank
from pharos.state_space.journal import Journal, Position
from pharos.state_space.plan import Plan
from pharos.state_space.progress import Progress
from pharos.state_space.ranked_table import RankedTable
from pharos.state_space.search import Options, Search

WIDE = 10_000
"""A frontier of this many states is worth sharing between processes."""


class RankedSearch(Search):
    """The search of rank 0; the other ranks run `answer`."""

    def __init__(self, plan: Plan, journal: Journal, options: Options, report: Progress, rank: Rank, wide: int = WIDE):
        super().__init__(plan, journal, options, report)
        self.threads = 1
        self._wide = wide
        self._shared = RankedTable(plan, rank, options.memory)
        self._is_shared = False
        self._queue = Queue(journal)

    def run(self, manifest: dict[str, Any] | None) -> None:
        try:
            super().run(manifest)
        finally:
            self._shared.close()

    @property
    def in_memory(self) -> bool:
        return not self._is_shared

    def _expand_chunk(self, pool: ThreadPoolExecutor) -> None:
        if self.position.count - self.position.first >= self._wide:
            self._spill()
        else:
            super()._expand_chunk(pool)

    def _spill(self, stored: np.ndarray | None = None) -> None:
        """From now on all ranks have the table."""
        self._is_shared = True

    def _expand_chunk_beyond_memory(self, pool: ThreadPoolExecutor) -> None:
        position = self.position
        if self._queue.first < 0:
            self._hand_out()
        if self._needs_wide_indices(self.chunk * self.branches):
            self._widen_indices(pool)
        block, base, new = self._block(), position.first, []
        while position.first < min(base + self.chunk, position.count):
            first, rows = position.first, min(base + self.chunk, position.count) - position.first
            part, states = self._shared.expand(self._queue.next(rows), first, position.count)
            for room, array in zip(block.rows(first - base, first - base + rows), part, strict=True):
                room[:] = array
            pass_levels(position, part.successors, len(states))
            self._queue.add(states)
            new.append(states)
            self._check_size()
        block = block.rows(0, position.first - base)
        position.terminals += int(block.terminal.sum())
        self.journal.append(np.concatenate(new), block, position)
        self._report()

    def _hand_out(self) -> None:
        """Give the owners the states that are there; from here on this rank keeps those that wait to be expanded."""
        self.journal.finish_writes()
        self.table.release()
        self._blocks, self._spare, self._ahead = [], [], None
        self.chunk = self._shared.rows
        self._shared.take(self.journal.stored_states(self.position.count))
        self._queue.first, self._queue.stored = self.position.first, self.position.count


class Queue:
    """The states that wait to be expanded: those of the file up to some number, then those found since.

    Attributes:
        first: the number of the next one; -1 before there is one. stored: states that are read from the file.
    """

    def __init__(self, journal: Journal):
        self._journal = journal
        self._waiting: deque[np.ndarray] = deque()
        self.first, self.stored = -1, 0

    def add(self, states: np.ndarray) -> None:
        """States (n, W) that were found, in the order of their numbers."""
        if len(states):
            self._waiting.append(states)

    def next(self, rows: int) -> np.ndarray:
        """(rows, W), the next ones."""
        states = np.empty((rows, self._journal.plan.layout.num_words), np.uint64)
        done = max(0, min(rows, self.stored - self.first))
        if done:
            self._journal.read_states(self.first, states[:done])
        while done < rows:
            part = self._waiting.popleft()
            size = min(len(part), rows - done)
            states[done : done + size] = part[:size]
            done += size
            if size < len(part):
                self._waiting.appendleft(part[size:])
        self.first += rows
        return states


def pass_levels(position: Position, successors: np.ndarray, new: int) -> None:
    """Go on by rows of successors, among which are `new` new states: as states are numbered in the order in which rows
    lead to them, those known after a row are 1 + the highest number so far.
    """
    first, rows = position.first, len(successors)
    highest = np.maximum.accumulate(successors.max(axis=1))
    passed = first  # rows whose end of a level was looked at
    while passed < position.level_end <= first + rows:
        passed = position.level_end
        position.level_end = max(position.count, int(highest[passed - 1 - first]) + 1)
        position.depth += 1
    position.first, position.count = first + rows, position.count + new
