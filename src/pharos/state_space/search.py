"""The search for reachable states: breadth-first, in the order of discovery, by one thread or by several.

While the frontier is wide, threads compute successors and look up those that the table has, a piece ahead of the one
thread that numbers the new ones in order: so states are numbered as one thread would number them. While it is narrow
(Freeway: 148 thousand levels of 9 states) one thread does everything. If memory ends, the table goes to disk, and
states stay in their file. docs/decisions has the measurements.
"""

import time
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import StateSpaceTooLarge
from pharos.rules import rules_of
from pharos.state_space.journal import Journal, OutcomeJournal, Position
from pharos.state_space.manifest import Plan
from pharos.state_space.progress import BuildCallback, BuildProgress
from pharos.state_space.table import BranchBlock, MemoryTable, SpilledTable
from pharos.system import compiling
from pharos.system import memory as machine
from pharos.system.arrays import INT32_STATES, INT40_STATES
from pharos.system.workers import usable_workers

# States expanded between two looks at the clock; a multiple of 8, so that terminal bits fill whole bytes.
CHUNK = 1 << 16
# Successors of a chunk, if there are very many actions; with chance, whose probabilities are kept beside them.
CHUNK_SUCCESSORS = 1 << 26
CHUNK_OUTCOMES = 1 << 21
# Pieces of a chunk: threads expand one while the one before is numbered.
PIECES = 4
# A frontier of this many states is worth sharing between threads.
WIDE_FOR_THREADS = 1 << 13
# States that one thread expands before it looks at the width of the frontier again.
NARROW_LEVEL_STATES = 2048
# Number of states from which on a table drops those that a class with an age has left behind; ages computed at a time.
WORTH_FORGETTING = 1 << 16
FORGETTING_BLOCK = 1 << 18
# A table that holds nothing, in which the slot of a state is its bucket.
EMPTY_TABLE = np.full(1 << 16, -1, np.int32)


@dataclass(frozen=True)
class Options:
    """Arguments of `build` that a search needs, see there."""

    max_states: int | None
    memory: int | None
    workers: int | None
    checkpoint_seconds: float


@dataclass
class Piece:
    """A piece of a wide frontier: arrays that threads write, for the thread that numbers the states."""

    keys: np.ndarray
    indices: np.ndarray
    terminal: np.ndarray
    probabilities: np.ndarray
    first: int = 0
    stop: int = 0
    futures: list[Future] = field(default_factory=list)


class Search:
    """One run of a build, from the start states or the last checkpoint to the end."""

    def __init__(self, plan: Plan, journal: Journal, options: Options, report: BuildCallback):
        self.plan, self.journal, self.options, self.report = plan, journal, options, report
        self.env: Environment = plan.env
        self.branches, self.num_words = plan.branches, plan.layout.num_words
        self.workers = usable_workers(options.workers)
        self._rules = rules_of(plan.env, workers=self.workers)
        self.rules, self.threads = self._rules.first_exploration, 1
        # states that are interpreted: all those of a small space, none if compiled rules are loaded
        self._interpreted = 0 if self._rules.is_ready else compiling.SMALL_STATES // 4 // self.branches // 8 * 8
        self.chunk = max(8, min(CHUNK, self._interpreted // 192 * 8))
        self.position = Position()
        margin = 32 * self.branches + len(self.plan.starts[0])
        self.table = MemoryTable(self.num_words, margin, options.memory)
        self.spilled: SpilledTable | None = None
        self._ahead: Piece | None = None  # expanded by threads, not numbered yet
        self._spare: list[Piece] = []
        self._blocks: list[BranchBlock] = []  # rows of a chunk, used in turn
        self._began = time.perf_counter()

    def run(self, manifest: dict[str, Any] | None) -> None:
        """Search to the end. If that fails, what is in the files is committed, and the same command resumes."""
        try:
            self.position = self.journal.open(manifest)
            self._take_stored_states()
            with ThreadPoolExecutor(self.workers) as pool, self.journal.writing():
                if self.in_memory:
                    self._grow_table(pool)
                while self.position.first < self.position.count:
                    if self._is_large():
                        self._compile()
                    if self.in_memory:
                        self._expand_chunk(pool)
                    else:
                        self._expand_chunk_beyond_memory(pool)
                    if time.perf_counter() - self.journal.last_checkpoint >= self.options.checkpoint_seconds:
                        self.journal.checkpoint(complete=False)
                self.journal.checkpoint(complete=True)
        except BaseException:
            self.journal.commit_after_failure()
            raise
        finally:
            self.journal.close()
            self.rules.close()
            self.spilled = None
            self.table.release()
        self._report(finished=True)

    def _is_large(self) -> bool:
        """Whether compiled rules are worth the time that they take to load or compile.

        At once for a class compiled in this process, after the first chunk for one on disk, else after many states.
        """
        first = self.position.first
        return not self.in_memory or first >= self._interpreted or (first > 0 and self._rules.is_kept)

    def _compile(self) -> None:
        """Continue with compiled rules, by larger chunks, and by several threads once those are worth their kernels."""
        if self.rules is self._rules.first_exploration:
            self.rules = self._rules.exploration
            max_branches = CHUNK_OUTCOMES if self.env.has_chance else CHUNK_SUCCESSORS
            self.chunk, self._blocks = min(CHUNK, max(8, max_branches // self.branches // 8 * 8)), []
        self.threads = self.rules.threads(self.workers)

    @property
    def in_memory(self) -> bool:
        """Whether this process's memory holds the table."""
        return self.spilled is None

    def _take_stored_states(self) -> None:
        """Load the states of the last checkpoint, onto disk if memory does not hold them."""
        stored = self.journal.stored_states(self.position.count)
        if self.table.fits(self.position.count, self.journal.index_dtype):
            self.table.states[: self.position.count] = stored
        else:
            self._spill(stored)

    # The table in memory ----------------------------------------------------------------------------------------------

    def _expand_chunk(self, pool: ThreadPoolExecutor) -> None:
        """Expand up to a chunk of states, then append their rows to the files."""
        position, table = self.position, self.table
        # more states than int32 can number: first make room for wider indices
        if self._needs_wide_indices(self.chunk * self.branches + 32 * self.branches):
            self._widen_indices(pool)
            if not self.in_memory:
                return
        base, last = position.first, position.first + self.chunk
        block = self._block()
        while position.first < min(last, position.count):
            if self._ahead is None and table.is_full(position.count):
                self._grow_table(pool)
                if not self.in_memory:
                    position.first -= (position.first - base) % 8  # what is appended has whole bytes of terminal bits
                    break
            # expand by one thread or by several, as wide as the frontier is now
            is_wide = self.threads > 1 and min(last, position.count) - position.first >= WIDE_FOR_THREADS
            if self._ahead or is_wide:
                self._expand_wide(pool, block, base)
            else:
                self._expand_narrow(block, base, last)
            self._check_size()
        # append the rows of the chunk
        block = block.rows(0, position.first - base)
        position.terminals += int(block.terminal.sum())
        self.journal.append(table.states[self.journal.appended : position.count], block, position)
        self._report()

    def _block(self) -> BranchBlock:
        """Arrays for the rows of a chunk. The journal lets two chunks wait, so the third one back is written."""
        if len(self._blocks) == 3 and self._blocks[0].successors.dtype == self.journal.index_dtype:
            self._blocks.append(self._blocks.pop(0))
        else:
            rows = np.empty((self.chunk, self.branches), self.journal.index_dtype)
            block = BranchBlock(rows, np.empty(self.chunk, np.uint8), self._probabilities(self.chunk))
            self._blocks = [*self._blocks, block][-3:]
        return self._blocks[-1]

    def _probabilities(self, rows: int) -> np.ndarray:
        """Array for the probabilities of the branches of some states. No rows without chance."""
        return np.empty((rows if self.env.has_chance else 0, self.branches))

    def _expand_narrow(self, block: BranchBlock, base: int, last: int) -> None:
        """Expand by one thread. With several threads it looks at the width of the frontier again after a while."""
        position, table = self.position, self.table
        stop = min(last, max(position.first + NARROW_LEVEL_STATES, position.count)) if self.threads > 1 else last
        progress = position.progress()
        self.rules.explore(table.states, *block, table.slots, base, stop, table.room, progress)
        position.take(progress)

    def _expand_wide(self, pool: ThreadPoolExecutor, block: BranchBlock, base: int) -> None:
        """Number the successors of the piece that threads have expanded, while they expand the next one."""
        position = self.position
        piece = self._ahead or self._expand_ahead(pool, position.first, position.first - base)
        assert piece is not None
        self._ahead = None
        # the piece that threads have expanded
        wait(piece.futures)
        for future in piece.futures:
            future.result()
        rows = piece.stop - piece.first
        row = piece.first - base
        # let them expand the next one
        if position.count - piece.stop >= WIDE_FOR_THREADS:
            next_row = (row + rows) % self.chunk
            self._ahead = self._expand_ahead(pool, piece.stop, next_row, reserved=rows * self.branches)
        # number the successors of this one meanwhile
        progress = position.progress()
        part = block.rows(row, row + rows)
        self.table.find_or_number(piece.keys, piece.indices, part.successors, progress)
        part.terminal[:] = piece.terminal[:rows]
        part.probabilities[:] = piece.probabilities[:rows]
        self._spare.append(piece)
        position.take(progress)

    def _expand_ahead(self, pool: ThreadPoolExecutor, first: int, row: int, reserved: int = 0) -> Piece | None:
        """Let threads expand a piece of the frontier, from state `first`, in row `row` of its chunk.

        None if the table has no room left beside `reserved` other states: it grows while nobody reads it.
        """
        table, piece_rows = self.table, -(-self.chunk // PIECES)
        room = (table.room - self.position.count - reserved) // self.branches
        rows = min(piece_rows, self.chunk - row, self.position.count - first, room)
        if rows < 1:
            return None
        piece = self._spare.pop() if self._spare else self._new_piece(piece_rows)
        cuts = [first + rows * i // self.threads for i in range(self.threads + 1)]
        piece.first, piece.stop = first, first + rows
        arrays = (first, piece.keys, piece.indices, piece.terminal, piece.probabilities, table.slots)
        piece.futures = [
            pool.submit(self.rules.expand_and_find, table.states, cuts[i], cuts[i + 1], *arrays)
            for i in range(self.threads)
        ]
        return piece

    def _new_piece(self, rows: int) -> Piece:
        keys = np.empty((rows * self.branches, self.num_words), np.uint64)
        return Piece(keys, np.empty(len(keys), np.int64), np.empty(rows, np.uint8), self._probabilities(rows))

    def _grow_table(self, pool: ThreadPoolExecutor) -> None:
        """Grow the table, on disk if memory is not enough."""
        count, dtype, parts = self.position.count, self.journal.index_dtype, self._reachable_states()
        if self.table.fits(count, dtype, 0 if parts is None else count - sum(map(len, parts))):
            self.table.grow(count, dtype, pool, self.workers, parts)
        else:
            self._spill()

    def _reachable_states(self) -> list[np.ndarray] | None:
        """Parts of the states that successors may still be, if the class has an age. None: all states.

        Those are the states older than the youngest one that waits to be expanded.
        """
        count = self.position.count
        if not self.env.has_age or count < WORTH_FORGETTING:
            return None
        # the youngest age among the states that wait
        states, slots = self.table.states.view(), self.table.slots
        states.flags.writeable = False
        ages = rules_of(self.env).ages
        first = max(self.position.first - 8, 0)  # the last ones may be expanded again
        waiting = (
            ages.block(states, i, min(i + FORGETTING_BLOCK, count)) for i in range(first, count, FORGETTING_BLOCK)
        )
        youngest = min(int(part.min()) for part in waiting)
        # states of the table that are older
        entries = slots if len(slots) else np.arange(count)
        parts = []
        for i in range(0, len(entries), FORGETTING_BLOCK):
            part = entries[i : i + FORGETTING_BLOCK]
            part = part[part >= 0]
            packed = states[part]
            packed.flags.writeable = False
            parts.append(part[ages.block(packed, 0, len(part)) > youngest])
        return parts

    def _needs_wide_indices(self, successors: int) -> bool:
        """Whether this many more states may be more than int32 can number."""
        starts = len(self.plan.starts[0])
        return self.journal.index_dtype.itemsize == 4 and self.position.count + successors + starts > INT32_STATES

    def _widen_indices(self, pool: ThreadPoolExecutor) -> None:
        """Replace indices of 32 bits by indices of 40 in the file, of 64 in the table."""
        self.journal.finish_writes()
        if self._ahead:  # its slots are in the old table: it is expanded again
            wait(self._ahead.futures)
            self._ahead = None
        self.journal.widen(self.position)
        if self.in_memory:
            self._grow_table(pool)

    # The table on disk ------------------------------------------------------------------------------------------------

    def _spill(self, stored: np.ndarray | None = None) -> None:
        """Continue with the table on disk, filled from the one in memory, or from the states of the last checkpoint."""
        memory = self.options.memory
        if memory is None:
            memory = max(machine.LEAST_MEMORY, machine.available_memory() // 2)
        count = self.position.count
        spilled = SpilledTable(self.journal.path, self.num_words, self.branches, memory, count, self.env.has_chance)
        if stored is not None:
            spilled.fill(stored)
        elif len(self.table.slots):
            spilled.take_over(self.table)
        else:
            spilled.fill(self.table.states[:count])
        self.spilled = spilled

    def _expand_chunk_beyond_memory(self, pool: ThreadPoolExecutor) -> None:
        """Expand a chunk: look up many successors at once, in the order of the table on disk, then number them."""
        position, spilled = self.position, self.spilled
        assert spilled is not None
        if self._needs_wide_indices(spilled.rows * self.branches):
            self._widen_indices(pool)
        self.journal.finish_writes()
        # the table in memory is not needed any more
        if len(self.table.states):
            self.table.release()
            self._blocks, self._spare = [], []
        base, last = position.first, position.first + spilled.rows
        block = spilled.block(self.journal.index_dtype)
        spilled.appended = self.journal.appended
        # expand, look up and number
        while position.first < min(last, position.count):
            first, rows = position.first, min(last, position.count) - position.first
            size = rows * self.branches
            part = block.rows(first - base, first - base + rows)
            keys, indices = spilled.keys[:size], spilled.indices[:size]
            self._expand_rows(pool, self._states(spilled, first, first + rows), keys, indices, part)
            progress = position.progress()
            spilled.find_or_number(keys, indices, part.successors, progress)
            position.take(progress)
            self._check_size()
        # append the rows of the chunk
        block = block.rows(0, position.first - base)
        position.terminals += int(block.terminal.sum())
        self.journal.append(spilled.states[: position.count - self.journal.appended], block, position)
        self._report()

    def _expand_rows(
        self, pool: ThreadPoolExecutor, states: np.ndarray, keys: np.ndarray, indices: np.ndarray, block: BranchBlock
    ) -> None:
        """Write the successors of states to keys, to indices -1 - bucket, or in terminal states their own row."""
        threads = self.threads if len(states) >= WIDE_FOR_THREADS else 1
        cuts = [len(states) * i // threads for i in range(threads + 1)]
        arrays = (0, keys, indices, block.terminal, block.probabilities, EMPTY_TABLE)
        if threads == 1:
            self.rules.expand_and_find(states, 0, len(states), *arrays)
            return
        futures = [
            pool.submit(self.rules.expand_and_find, states, cuts[i], cuts[i + 1], *arrays) for i in range(threads)
        ]
        wait(futures)
        for future in futures:
            future.result()

    def _states(self, spilled: SpilledTable, start: int, stop: int) -> np.ndarray:
        """States [start, stop), from their file and from memory."""
        states = np.empty((stop - start, self.num_words), np.uint64)
        in_file = max(0, min(stop, spilled.appended) - start)
        if in_file:
            self.journal.read_states(start, states[:in_file])
        states[in_file:] = spilled.states[start + in_file - spilled.appended : stop - spilled.appended]
        return states

    # Limits and reports -----------------------------------------------------------------------------------------------

    def _check_size(self) -> None:
        check_max_states(
            self.env, self.position.count, self.position.count - self.position.first, self.options.max_states
        )

    def _report(self, finished: bool = False) -> None:
        at, seconds = self.position, time.perf_counter() - self._began
        self.report(BuildProgress(at.count, at.first, at.depth, seconds, finished, self.spilled is not None))


def journal_of(path: Path, plan: Plan) -> Journal:
    """The journal of a build, with or without chance."""
    return OutcomeJournal(path, plan) if plan.env.has_chance else Journal(path, plan)


def check_max_states(env: Environment, count: int, left: int, max_states: int | None) -> None:
    """Raise StateSpaceTooLarge if there are more than `max_states` states, of which `left` are not expanded."""
    if count > INT40_STATES:
        raise StateSpaceTooLarge(f"{env} has more than {INT40_STATES} states, which indices of 40 bits cannot number")
    if max_states is None or count <= max_states:
        return
    if left == 0:
        raise StateSpaceTooLarge(
            f"{env} has {count} states, more than max_states={max_states}; raise it or choose a smaller instance"
        )
    raise StateSpaceTooLarge(
        f"{env} passed max_states={max_states}, {left} left to expand; raise it or choose a smaller instance"
    )
