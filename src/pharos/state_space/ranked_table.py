"""The table of states and the search, shared by several processes: the work of each rank.

A *superstep* expands a block of states, in four exchanges. Each rank has an even part of the block's rows, and owns the
states whose hash falls to it (kernels/hash_table.py).

1. Each rank expands its rows, and asks the owners of the successors for their numbers, with the index of each in the
   block: row x branches + branch, the order in which one process would meet them.
2. An owner keeps the first of the indices that lead to a new state, and sends it to the rank whose row that is in.
3. Each rank counts the new states in its rows. With the sum of the ranks before it, they have the numbers that one
   process would give them. It sends these to the owners.
4. Owners answer.

So numbers, and all files, are the same whatever the number of ranks. Rank 0 distributes states and collects rows.

Rank 0 runs the search and writes the files. While the frontier is narrow (Freeway: 148 thousand levels of 9 states) it
works alone, as exchanges would cost more than the states. Once it is wide, or the table does not fit, all ranks share
the table and expand blocks together. The memory for it is then the sum over ranks.
"""

import contextlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import StateSpaceError
from pharos.kernels import hash_table
from pharos.ranks import Rank, mpi_rank
from pharos.rules import rules_of
from pharos.state_space.journal import Journal, Position
from pharos.state_space.manifest import Plan
from pharos.state_space.progress import BuildCallback
from pharos.state_space.search import EMPTY_TABLE, Options, Search
from pharos.state_space.table import BranchBlock, MemoryTable
from pharos.system.memory import huge_pages

SUPERSTEP_ROWS = 1 << 16  # of a rank in a superstep, at most
SUPERSTEP_SUCCESSORS = 1 << 20  # of a rank's rows, at most
_END, _TAKE, _EXPAND = range(3)
_COUNTS_HEADER = np.zeros(4, np.int64)
_INT32 = np.dtype(np.int32)


def rows_of_rank(plan: Plan) -> int:
    """Number of rows that a rank expands in a superstep, at most: a multiple of 8."""
    return min(SUPERSTEP_ROWS, max(8, SUPERSTEP_SUCCESSORS // plan.branches // 8 * 8))


class Owner:
    """The states that one rank owns, and their numbers.

    Attributes:
        table: the states, in the order in which this rank received them. numbers: (capacity,) int64, of each.
        count: how many there are.
    """

    def __init__(self, env: Environment, rank: Rank, num_words: int, most: int, memory: int | None):
        """
        most: states that a superstep may add. memory: bytes that they may take. None for this rank's part of what there
            is.
        """
        self._env, self._rank = env, rank
        if memory is not None:
            memory = memory * (num_words + 1) // (num_words + 2)  # the rest is for the numbers
        self.table = MemoryTable(num_words, most, memory, share=2 * rank.neighbors)
        self.numbers = huge_pages(len(self.table.states), np.dtype(np.int64))
        self.count = 0

    def claim(self, candidates: np.ndarray, block_indices: np.ndarray) -> np.ndarray:
        """Entries of candidates. New ones wait for their numbers. `block_indices`: their indices in the block."""
        if self.table.is_full(self.count):
            self._grow()
        entries = np.empty(len(candidates), np.int64)
        arrays = self.table.slots, self.table.states, self.numbers
        self.count = hash_table.claim_entries(*arrays, self.count, candidates, block_indices, entries)
        return entries

    def _grow(self) -> None:
        if not self.table.fits(self.count, _INT32):
            raise StateSpaceError(
                f"{self._env}: the table of states does not fit in the memory of {self._rank.size} processes; "
                f"expected more memory, or more processes on more machines, or --processes 1, whose table may be on "
                f"disk; the same command resumes"
            )
        self.table.grow(self.count, _INT32, None, 1)

    def release(self) -> None:
        """Free the memory."""
        self.table.release()
        self.numbers = self.numbers[:0].copy()


class RankedTable:
    """One rank's part of the table. All ranks but rank 0 run `answer`, rank 0 calls the other methods.

    A header announces each step to the others: (step, first, rows, count). A superstep expands states [first, first +
    rows) when `count` are numbered.
    """

    def __init__(self, plan: Plan, rank: Rank, memory: int | None):
        self.rank, self.branches, self.num_words = rank, plan.branches, plan.layout.num_words
        self.rules = rules_of(plan.env).exploration
        rows = rows_of_rank(plan)
        self.rows = rows * rank.size
        self.owner = Owner(plan.env, rank, self.num_words, self.rows * self.branches, memory)
        self._keys = np.empty((rows * self.branches, self.num_words), np.uint64)
        self._indices = np.empty(len(self._keys), np.int64)
        self._order = np.empty(len(self._keys), np.int64)
        self._terminal = np.empty(rows, np.uint8)
        self._probabilities = np.empty((rows if plan.env.has_chance else 0, self.branches))

    def close(self) -> None:
        """Free the memory, and end processes that run rules."""
        self.owner.release()
        self.rules.close()

    # Rank 0 -----------------------------------------------------------------------------------------------------------

    def take(self, states: np.ndarray) -> None:
        """Send states that are numbered already to their owners. State i has number i."""
        for first in range(0, len(states), len(self._indices)):
            part = np.array(states[first : first + len(self._indices)], np.uint64)
            self._send_header(_TAKE, first, len(part), first)
            numbers = np.arange(first, first + len(part))
            self._indices[: len(part)] = -1
            order, counts = self._routed(part)
            self._take(self._parts(part[order], counts), self._parts(numbers[order], counts))

    def expand(self, states: np.ndarray, first: int, count: int) -> tuple[BranchBlock, np.ndarray]:
        """Expand states [first, first + rows), in order, when `count` are numbered.

        Returns:
            (successors int64, terminal, probabilities) of the rows, and the new states, numbered from `count` on.
        """
        self._send_header(_EXPAND, first, len(states), count)
        cuts = self._cuts(len(states))
        parts = [states[cuts[i] : cuts[i + 1]] for i in range(self.rank.size)]
        block, new = self._superstep(self.rank.scatter(parts, states[:0]), first, cuts, count)
        rows = [np.concatenate(self.rank.gather(array)) for array in block]
        return BranchBlock(*rows), np.concatenate(self.rank.gather(new))

    def _send_header(self, *header: int) -> None:
        """Announce a step to the other ranks."""
        self.rank.broadcast(np.array(header, np.int64), _COUNTS_HEADER)

    # The others -------------------------------------------------------------------------------------------------------

    def answer(self) -> None:
        """Run the steps that rank 0 announces, until the end."""
        no_states = np.empty((0, self.num_words), np.uint64)
        while True:
            step, first, rows, count = map(int, self.rank.broadcast(None, _COUNTS_HEADER))
            if step == _END:
                return
            if step == _TAKE:
                self._take([no_states] * self.rank.size, [np.empty(0, np.int64)] * self.rank.size)
                continue
            states = self.rank.scatter(None, no_states)
            block, new = self._superstep(states, first, self._cuts(rows), count)
            for array in (*block, new):
                self.rank.gather(array)

    # All --------------------------------------------------------------------------------------------------------------

    def _take(self, states: list[np.ndarray], numbers: list[np.ndarray]) -> None:
        """Exchange numbered states by owner. Enter the states that this rank owns."""
        for keys, number in zip(self.rank.exchange(states), self.rank.exchange(numbers), strict=True):
            for start in range(0, len(keys), self.rows * self.branches):
                part = slice(start, start + self.rows * self.branches)
                entries = self.owner.claim(keys[part], np.zeros(len(keys[part]), np.int64))
                self.owner.numbers[entries] = number[part]

    def _cuts(self, rows: int) -> list[int]:
        """Bounds of the rows of each rank: rank q has [cuts[q], cuts[q + 1])."""
        return [rows * i // self.rank.size for i in range(self.rank.size + 1)]

    def _superstep(
        self, states: np.ndarray, first: int, cuts: list[int], count: int
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """Expand the rows of this rank in a superstep, see the head of this file.

        Returns:
            (successors, terminal, probabilities) of the rows, and the new states in them.
        """
        rank, owner, branches = self.rank, self.owner, self.branches
        row, size = cuts[rank.rank], len(states) * branches
        keys, indices = self._keys[:size], self._indices[:size]
        terminal, probabilities = self._terminal[: len(states)], self._probabilities[: len(states)]
        # 1. expand the rows, and send the successors to their owners
        self.rules.expand_and_find(states, 0, len(states), 0, keys, indices, terminal, probabilities, EMPTY_TABLE)
        order, counts = self._routed(keys)
        candidates = rank.exchange(self._parts(keys[order], counts))
        block_indices = rank.exchange(self._parts(order + row * branches, counts))
        before = owner.count
        entries = owner.claim(np.concatenate(candidates), np.concatenate(block_indices))
        # 2. the first index of each new state that this rank owns goes to the rank whose row it is in
        fresh = np.arange(before, owner.count)
        first_indices = -1 - owner.numbers[fresh]
        by_index = np.argsort(first_indices)
        first_indices = first_indices[by_index]
        bounds = np.searchsorted(first_indices, np.array(cuts) * branches)
        wins = rank.exchange([first_indices[bounds[i] : bounds[i + 1]] for i in range(rank.size)])
        wins = [each - row * branches for each in wins]
        # 3. number the new states in the rows of this rank, and send the numbers to the owners
        is_new = np.zeros(size, bool)
        for each in wins:
            is_new[each] = True
        counts_of_new = rank.allgather(np.array([np.count_nonzero(is_new)]))
        numbers = count + int(sum(each[0] for each in counts_of_new[: rank.rank])) + np.cumsum(is_new) - 1
        owner.numbers[fresh[by_index]] = np.concatenate(rank.exchange([numbers[each] for each in wins]))
        # 4. owners answer with the numbers of all successors
        lengths = np.cumsum([len(each) for each in candidates])[:-1]
        answers = rank.exchange(np.split(owner.numbers[entries], lengths))
        successors = first + row + indices
        successors[order] = np.concatenate(answers)
        return (successors.reshape(-1, branches), terminal, probabilities), keys[is_new]

    def _routed(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(candidates to look up, sorted by owner, number of each owner's)."""
        counts = np.empty(self.rank.size, np.int64)
        hash_table.route(keys, self._indices[: len(keys)], self.rank.size, self._order, counts)
        return self._order[: counts.sum()], counts

    def _parts(self, array: np.ndarray, counts: np.ndarray) -> list[np.ndarray]:
        """The array cut into parts of these lengths, one for each rank."""
        return np.split(array, np.cumsum(counts)[:-1])


def end(rank: Rank) -> None:
    """Announce the end of the search to the other ranks."""
    rank.broadcast(np.array([_END, 0, 0, 0], np.int64), _COUNTS_HEADER)


def answer(plan: Plan, rank: Rank, memory: int | None) -> None:
    """Part of all ranks but rank 0 in a search, until its end."""
    table = RankedTable(plan, rank, memory)
    try:
        table.answer()
    finally:
        table.close()


@contextlib.contextmanager
def rank_of_build(plan: Plan, memory: int | None) -> Iterator[Rank]:
    """Context of this process's rank among the ranks of `mpiexec`. All but rank 0 do their part of the search on
    entry."""
    rank = mpi_rank()
    try:
        if rank.rank > 0:
            answer(plan, rank, memory)
        yield rank
        if rank.rank == 0:
            end(rank)
    except BaseException as error:
        rank.fail(error)
        raise


# Ranked search --------------------------------------------------------------------------------------------------------


WORTH_RANKS = 10_000
"""A frontier of this many states is worth sharing between processes."""


class RankedSearch(Search):
    """The search of rank 0. The other ranks run `answer`."""

    def __init__(
        self,
        plan: Plan,
        journal: Journal,
        options: Options,
        report: BuildCallback,
        rank: Rank,
        wide: int = WORTH_RANKS,
    ):
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
        """Share the table with all ranks from now on."""
        self._is_shared = True

    def _expand_chunk_beyond_memory(self, pool: ThreadPoolExecutor) -> None:
        position = self.position
        if self._queue.first < 0:
            self._distribute_states()
        if self._needs_wide_indices(self.chunk * self.branches):
            self._widen_indices(pool)
        block, base, new = self._block(), position.first, []
        # a superstep at a time, up to a chunk
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

    def _distribute_states(self) -> None:
        """Send the numbered states to their owners. From here on this rank keeps those that wait to be expanded."""
        self.journal.finish_writes()
        self.table.release()
        self._blocks, self._spare, self._ahead = [], [], None
        self.chunk = self._shared.rows
        self._shared.take(self.journal.stored_states(self.position.count))
        self._queue.first, self._queue.stored = self.position.first, self.position.count


class Queue:
    """The states that wait to be expanded: in the file up to some number, then in memory.

    Attributes:
        first: the number of the next one, -1 before there is one. stored: states that are read from the file.
    """

    def __init__(self, journal: Journal):
        self._journal = journal
        self._waiting: deque[np.ndarray] = deque()
        self.first, self.stored = -1, 0

    def add(self, states: np.ndarray) -> None:
        """Append new states (n, W), in the order of their numbers."""
        if len(states):
            self._waiting.append(states)

    def next(self, rows: int) -> np.ndarray:
        """The next states (rows, W)."""
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


def pass_levels(position: Position, successors: np.ndarray, num_new: int) -> None:
    """Move a position on by rows of successors, among which are `num_new` new states, and count finished levels.

    As states are numbered in the order in which rows lead to them, the number of states known after a row is 1 + the
    highest number so far.
    """
    first, rows = position.first, len(successors)
    highest = np.maximum.accumulate(successors.max(axis=1))
    last_end = first  # end of the last level that was finished; `first` before there is one
    while last_end < position.level_end <= first + rows:
        last_end = position.level_end
        position.level_end = max(position.count, int(highest[last_end - 1 - first]) + 1)
        position.depth += 1
    position.first, position.count = first + rows, position.count + num_new
