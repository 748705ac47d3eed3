"""The files of a build: states, successors and terminal bits, appended in the background, committed at checkpoints.

Data first, then the manifest that describes it: whatever kills the process, the last manifest is true, and the same
command goes on from there.

Chance. During the build, possible outcomes are appended one after another, with a code for each state and action. The
code's vector in the palette has the number of outcomes and their probabilities. If there are more vectors than
codes, the probabilities are spelled out, once and for all. `OutcomeParts` makes the files of the finished build from
these: rows are padded to equal length if little of that would be padding, and codes take one byte if that
suffices.
"""

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pharos.errors import DiskFull
from pharos.kernels import outcomes as kernels
from pharos.rules import pack_states
from pharos.state_space.manifest import (
    ARRAYS,
    CODES,
    INDEX_TYPES,
    INT40_VERSION,
    MOST_CODES,
    OFFSETS,
    PALETTE,
    PART_NAMES,
    PROBABILITIES,
    STATES,
    SUCCESSORS,
    SUCCESSORS40,
    TERMINAL,
    GrowingFile,
    Plan,
    cannot_write,
    successors_name,
    write_manifest,
)
from pharos.state_space.stored import check_outcome_rules, check_rules, states_to_check
from pharos.state_space.table import BranchBlock
from pharos.system.arrays import OutcomesOfState, as_stored, dtype_of, from_stored

COPIED_BYTES = 1 << 22  # of a file that are copied at a time


@dataclass
class Position:
    """Position of a search: how many states are expanded and numbered.

    Attributes:
        first: states expanded. count: states numbered. level_end: states up to the end of the current level.
        depth: levels finished, the start states' own level not counted. terminals: terminal states among those
            expanded.
    """

    first: int = 0
    count: int = 0
    level_end: int = 0
    depth: int = -1
    terminals: int = 0

    def progress(self) -> np.ndarray:
        """The position as an array for kernels: (first, count, level_end, depth, no fault)."""
        return np.array([self.first, self.count, self.level_end, self.depth, 0], np.int64)

    def take(self, progress: np.ndarray) -> None:
        """Move to the position at which a kernel stopped."""
        self.first, self.count, self.level_end, self.depth = (int(value) for value in progress[:4])

    def to_dict(self) -> dict[str, int]:
        """The position as entries of the manifest."""
        return {
            "num_states": self.count,
            "num_expanded": self.first,
            "num_terminal_states": self.terminals,
            "depth": self.depth,
            "level_end": self.level_end,
        }

    @staticmethod
    def of_manifest(manifest: dict[str, Any]) -> "Position":
        """The position of the last checkpoint, from its manifest."""
        names = ("num_expanded", "num_states", "level_end", "depth", "num_terminal_states")
        return Position(*(manifest[name] for name in names))


class Journal:
    """The files of one build.

    Attributes:
        path: the folder.
        appended: number of states that were appended, or wait to be.
        last_checkpoint: time of the last commit, `time.perf_counter()`.
    """

    def __init__(self, path: Path, plan: Plan):
        self.path, self.plan = path, plan
        self.appended = 0
        self.last_checkpoint = time.perf_counter()
        self._indices = SUCCESSORS  # a key of INDEX_TYPES
        self._files: dict[str, GrowingFile] = {}
        self._writes: list[Future] = []
        self._written: dict[str, Any] | None = None  # counts and files of the next checkpoint, consistent
        self._writer: ThreadPoolExecutor

    def open(self, manifest: dict[str, Any] | None) -> Position:
        """Open the files, at the start states or at the last checkpoint. Returns the position of the search."""
        arrays = manifest["arrays"] if manifest else {}
        names = self._names(arrays)
        for name in {*ARRAYS, *PART_NAMES.values()} - set(names):
            (self.path / name).unlink(missing_ok=True)  # left by a process that was killed while it replaced some files
        for name in names:
            self._files[name] = GrowingFile(self.path / name, arrays.get(name))
        if manifest is None:
            states = pack_states(self.plan.layout, np.array(self.plan.starts[0], np.int64))
            position = Position(count=len(states), level_end=len(states))
            self._files[STATES].append(states)
        else:
            position = Position.of_manifest(manifest)
            self._check_rules(position)
        self.appended = position.count
        self._written = self._entries(position)
        return position

    def _names(self, arrays: dict[str, Any]) -> tuple[str, ...]:
        """Names of the files of a build, at its start or at a checkpoint with these arrays."""
        self._indices = successors_name(arrays)
        return STATES, self._successors_name, TERMINAL

    @property
    def index_dtype(self) -> np.dtype:
        """Type of the successors while they are in memory."""
        return np.dtype(np.int32 if self._indices == SUCCESSORS else np.int64)

    @property
    def _successors_name(self) -> str:
        """Name of the file of successors."""
        return self._indices

    def stored_states(self, count: int) -> np.ndarray:
        """States (count, W) uint64 in the file, a memory map."""
        return np.memmap(self.path / STATES, "<u8", "r", shape=(count, self.plan.layout.num_words))

    def read_states(self, start: int, out: np.ndarray) -> None:
        """Read the states from number `start` on into out (n, W)."""
        words = self.plan.layout.num_words
        out[:] = np.fromfile(self.path / STATES, "<u8", len(out) * words, offset=8 * words * start).reshape(-1, words)

    # Appending --------------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Context in which a thread writes in the background."""
        with ThreadPoolExecutor(1) as self._writer:
            yield

    def append(self, states: np.ndarray, block: BranchBlock, position: Position) -> None:
        """Append in the background, while the next chunk is expanded. At most two chunks wait.

        Counts and checksums are noted by the thread that writes, once a chunk is in all files: whatever interrupts the
        main thread, and wherever, a checkpoint finds counts and files that belong together.
        """
        while len(self._writes) > 1:
            self._writes.pop(0).result()
        self._writes.append(self._writer.submit(self._write, states, block, Position(**vars(position))))
        self.appended = position.count

    def _write(self, states: np.ndarray, block: BranchBlock, at: Position) -> None:
        self._files[STATES].append(states)
        self._append_successors(block.successors)
        self._files[TERMINAL].append(np.packbits(block.terminal, bitorder="little"))
        self._written = self._entries(at)

    def _append_successors(self, successors: np.ndarray) -> None:
        self._files[self._successors_name].append(as_stored(successors, INDEX_TYPES[self._indices]))

    def finish_writes(self) -> None:
        """Wait until everything appended is in the files."""
        while self._writes:
            self._writes.pop(0).result()

    def widen(self, position: Position) -> None:
        """Replace the file of successors by one of 40-bit indices. The old one is deleted once this is committed."""
        self.finish_writes()
        narrow, self._indices = self._successors_name, SUCCESSORS40
        old = self._files[narrow]
        self._files[self._successors_name] = GrowingFile(self.path / self._successors_name)
        for _, entries in number_blocks(old, np.dtype("<i4")):
            self._append_successors(entries)
        self._written = self._entries(position)
        self.commit(complete=False)
        self._drop(narrow)

    def _drop(self, name: str) -> None:
        """Close and delete a file that no manifest names any more."""
        file = self._files.pop(name)
        file.close()
        file.path.unlink()

    # Committing -------------------------------------------------------------------------------------------------------

    def checkpoint(self, *, complete: bool) -> None:
        """Commit everything appended."""
        self.finish_writes()
        self.commit(complete=complete)

    def commit(self, *, complete: bool, written: dict[str, Any] | None = None) -> None:
        """Commit the written data: data first, then the manifest that describes it.

        Args:
            written: entries of the manifest. None for the entries of the thread that writes.
        """
        written = written or self._written
        if written is None:
            return
        for file in self._files.values():
            file.sync()
        manifest = {
            "format": "pharos state space",
            "format_version": INT40_VERSION if self._indices == SUCCESSORS40 else self.plan.format_version,
            "complete": complete,
            **self.plan.identity,
            "num_actions": self.plan.env.num_actions,
            "initial": [[i, float(p)] for i, p in enumerate(self.plan.starts[1])],
            **written,
        }
        write_manifest(self.path, manifest)
        self.last_checkpoint = time.perf_counter()

    def commit_after_failure(self) -> None:
        """Commit what is in the files, whatever went wrong elsewhere."""
        with contextlib.suppress(DiskFull):
            wait(self._writes)
            self.commit(complete=False)

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            file.close()

    def _dtypes(self) -> dict[str, str]:
        """The types of the arrays, by the names of their files."""
        return {STATES: "<u8", self._successors_name: INDEX_TYPES[self._indices], TERMINAL: "|u1"}

    def _entries(self, position: Position) -> dict[str, Any]:
        """Entries of the manifest at a position: counts and arrays."""
        arrays = {name: {"dtype": dtype, **self._files[name].entry()} for name, dtype in self._dtypes().items()}
        return {**position.to_dict(), "arrays": arrays}

    def _check_rules(self, position: Position) -> None:
        """Raise StateSpaceMismatch if the stored transitions come from other rules."""
        if position.first == 0:
            return
        shape = (position.first, self.plan.env.num_actions)
        dtype = dtype_of(INDEX_TYPES[self._indices])
        successors = from_stored(np.memmap(self.path / self._successors_name, dtype, "r", shape=shape))
        bits = np.memmap(self.path / TERMINAL, "|u1", "r")
        check_rules(self.path, self.plan.env, self.plan.layout, self.stored_states(position.count), successors, bits)


def number_blocks(file: GrowingFile, dtype: np.dtype) -> Iterator[tuple[int, np.ndarray]]:
    """Blocks of at most COPIED_BYTES of the numbers in a file: pairs (index of the first one, array), in order."""
    size = file.bytes // dtype.itemsize
    block_size = max(1, COPIED_BYTES // dtype.itemsize)
    for first in range(0, size, block_size):
        shape = (min(block_size, size - first),)
        yield first, np.memmap(file.path, dtype, "r", offset=first * dtype.itemsize, shape=shape)


# Outcomes of a build with chance --------------------------------------------------------------------------------------


MOST_PADDING_RATIO = (3, 10)
"""The share of (S, A, K) that may be padding, as a fraction."""

ENTRIES = 1 << 18  # of rows of K, as many as are copied at a time


class JournalRows(NamedTuple):
    """Rows of outcomes: number of the first row, number of its first outcome, then R rows of N outcomes in all.

    counts: (R,). codes: (R,), None if probabilities are spelled out. successors: (N,).
    """

    row: int
    first: int
    counts: np.ndarray
    codes: np.ndarray | None
    successors: np.ndarray


@dataclass
class OutcomeParts:
    """The outcomes in the files of an unfinished build.

    Attributes:
        folder: that holds them. rows: how many, A for each state. most_declared: the most outcomes that a row may have.
        indices: the file of the finished build that its successors will be in, of INDEX_TYPES.
        palette: (P, K) uint64, bits of the vectors. None if probabilities are spelled out.
    """

    folder: Path
    rows: int
    num_actions: int
    most_declared: int
    indices: str
    palette: np.ndarray | None

    def parts(self) -> Iterator[JournalRows]:
        """All rows of outcomes, some at a time."""
        for row, first, codes, counts in self._counts():
            yield self._part(row, first, codes, counts)

    def _counts(self) -> Iterator[tuple[int, int, np.ndarray | None, np.ndarray]]:
        """(row, first, codes, counts) of each `JournalRows`."""
        sizes = np.zeros(0, np.int64) if self.palette is None else (self.palette != 0).sum(axis=1)
        first, step = 0, max(1, ENTRIES // self.most_declared // self.num_actions) * self.num_actions
        for row in range(0, self.rows, step):
            rows = min(step, self.rows - row)
            codes = None
            if self.palette is None:
                counts = np.diff(np.fromfile(self.folder / PART_NAMES[OFFSETS], "<i8", rows + 1, offset=8 * row))
            else:
                codes = np.fromfile(self.folder / PART_NAMES[CODES], "<u2", rows, offset=2 * row)
                counts = sizes[codes]
            yield row, first, codes, counts
            first += int(counts.sum())

    def _part(self, row: int, first: int, codes: np.ndarray | None, counts: np.ndarray) -> JournalRows:
        entries = int(counts.sum())
        dtype = dtype_of(INDEX_TYPES[self.indices])
        first_byte = first * dtype.itemsize
        stored = np.fromfile(self.folder / PART_NAMES[self.indices], dtype, entries, offset=first_byte)
        successors = np.asarray(from_stored(stored))
        return JournalRows(row, first, counts, codes, successors)

    def bits(self, part: JournalRows) -> np.ndarray:
        """Bits (N,) uint64 of the probabilities of the outcomes of some rows."""
        if self.palette is None:
            entries = len(part.successors)
            return np.fromfile(self.folder / PART_NAMES[PROBABILITIES], "<u8", entries, offset=8 * part.first)
        assert part.codes is not None
        vectors = self.palette[part.codes]
        return vectors[vectors != 0]

    def most(self) -> int:
        """Largest number of possible outcomes of a row, K."""
        if self.palette is not None:
            return int((self.palette != 0).sum(axis=1).max())
        return max(int(counts.max()) for _, _, _, counts in self._counts())

    def finish(self, written: dict[str, dict[str, Any]]) -> tuple[dict[str, dict[str, Any]], int]:
        """Write the files of a finished build. Returns (entries of the manifest by file name, most outcomes of a row).

        Args:
            written: entries of the files of the unfinished build.
        """
        most = self.most()
        successors, index_type = self.indices, INDEX_TYPES[self.indices]
        num_entries = written[PART_NAMES[successors]]["bytes"] // dtype_of(index_type).itemsize
        # form of the rows: padded to K, or with offsets; palette and codes, or probabilities
        is_dense = MOST_PADDING_RATIO[1] * (self.rows * most - num_entries) <= MOST_PADDING_RATIO[0] * self.rows * most
        dtypes = {successors: index_type}
        if not is_dense:
            dtypes[OFFSETS] = "<i8"
        if self.palette is None:
            dtypes[PROBABILITIES] = "<f8"
        else:
            dtypes |= {CODES: "|u1" if len(self.palette) <= 256 else "<u2", PALETTE: "<f8"}
        # files of the build that have this form already are linked, the others written anew
        stay = {successors, OFFSETS, PROBABILITIES} if not is_dense else set()
        stay |= {CODES} if dtypes.get(CODES) == "<u2" else set()
        stay &= {name for name in dtypes if PART_NAMES[name] in written}
        files: dict[str, GrowingFile] = {}
        try:
            for name in dtypes.keys() - stay:
                files[name] = GrowingFile(self.folder / name)
            self._fill(files, dtypes, most, is_dense)
            for file in files.values():
                file.sync()
        finally:
            for file in files.values():
                file.close()
        for name in stay:
            _link(self.folder / PART_NAMES[name], self.folder / name)
        return {
            name: {"dtype": dtype, **files[name].entry()} if name in files else written[PART_NAMES[name]]
            for name, dtype in dtypes.items()
        }, most

    def _fill(self, files: dict[str, GrowingFile], dtypes: dict[str, str], most: int, is_dense: bool) -> None:
        """Write the new files, some rows at a time."""
        if OFFSETS in files:
            files[OFFSETS].append(np.zeros(1, np.int64))
        if self.palette is not None:
            files[PALETTE].append(self.palette[:, :most])
        successors = next(iter(dtypes))
        for part in self.parts():
            if is_dense:
                rows = _padded(part.successors, part.counts, most, fill_with_first=True)
                files[successors].append(as_stored(rows, dtypes[successors]))
            if OFFSETS in files:
                files[OFFSETS].append(part.first + np.cumsum(part.counts))
            if PROBABILITIES in files:
                files[PROBABILITIES].append(_padded(self.bits(part), part.counts, most, fill_with_first=False))
            if CODES in files and part.codes is not None:
                files[CODES].append(part.codes.astype(dtypes[CODES]))

    def of_states(self, states: np.ndarray) -> dict[int, OutcomesOfState]:
        """Outcomes of `states`, which are ascending, by state."""
        outcomes = {}
        for row, first, codes, counts in self._counts():
            for state in states[
                (states >= row // self.num_actions) & (states < (row + len(counts)) // self.num_actions)
            ]:
                index = int(state) * self.num_actions - row
                rows = slice(index, index + self.num_actions)
                first_outcome = first + int(counts[:index].sum())
                part = self._part(row + index, first_outcome, None if codes is None else codes[rows], counts[rows])
                ends = np.cumsum(part.counts)[:-1]
                probabilities = np.split(self.bits(part).view(np.float64), ends)
                outcomes[int(state)] = list(zip(np.split(part.successors, ends), probabilities, strict=True))
        return outcomes


def _padded(values: np.ndarray, counts: np.ndarray, most: int, *, fill_with_first: bool) -> np.ndarray:
    """Rows (R, most) of values (N,), padded by their first value or by zeros."""
    out = np.empty((len(counts), most), values.dtype)
    kernels.padded(values, counts, fill_with_first, out)
    return out


def _link(source: Path, target: Path) -> None:
    """Give a file another name. Copy it if the file system has no hard links."""
    if target.is_symlink():
        target.unlink()
    try:
        os.link(source, target)
    except OSError:
        try:
            shutil.copyfile(source, target)
            with open(target, "rb+") as file:
                os.fsync(file.fileno())
        except OSError as error:
            raise cannot_write(target, error) from error


_SLOTS = 1 << 17  # of the table of the palette: twice as many as codes


class OutcomeJournal(Journal):
    """The files of one build with chance, see `Journal`.

    Attributes:
        palette: (capacity, K) uint64, the bits of the vectors found. None if probabilities are spelled out.
    """

    def __init__(self, path: Path, plan: Plan):
        super().__init__(path, plan)
        self._num_actions, self._most = plan.env.num_actions, int(plan.env.outcomes)
        self.palette: np.ndarray | None = np.zeros((min(256, MOST_CODES), self._most), np.uint64)
        self._vectors = 0
        self._table = np.full(_SLOTS, -1, np.int32)
        self._failure: BaseException | None = None

    def _names(self, arrays: dict[str, Any]) -> tuple[str, ...]:
        self._indices = successors_name(arrays, PART_NAMES)
        if PART_NAMES[PROBABILITIES] in arrays:
            self.palette = None
        return tuple(self._dtypes())

    @property
    def _successors_name(self) -> str:
        return PART_NAMES[self._indices]

    def _dtypes(self) -> dict[str, str]:
        dtypes = {STATES: "<u8", self._successors_name: INDEX_TYPES[self._indices]}
        if self.palette is None:
            return {**dtypes, PART_NAMES[OFFSETS]: "<i8", PART_NAMES[PROBABILITIES]: "<f8", TERMINAL: "|u1"}
        return {**dtypes, PART_NAMES[CODES]: "<u2", PART_NAMES[PALETTE]: "<f8", TERMINAL: "|u1"}

    def _check_rules(self, position: Position) -> None:
        """Load the palette of the build. StateSpaceMismatch if stored outcomes come from other rules."""
        if self.palette is not None:
            vectors = np.fromfile(self.path / PART_NAMES[PALETTE], "<u8").reshape(-1, self._most)
            self._vectors = len(vectors)
            self.palette = np.zeros((max(len(self.palette), self._vectors), self._most), np.uint64)
            self.palette[: self._vectors] = vectors
            kernels.enter(self.palette, self._vectors, self._table)
        if position.first:
            outcomes = self._parts(position.first).of_states(states_to_check(position.first))
            bits = np.memmap(self.path / TERMINAL, "|u1", "r")
            states = self.stored_states(position.count)
            check_outcome_rules(self.path, self.plan.env, self.plan.layout, states, outcomes, bits)

    def _parts(self, states: int) -> OutcomeParts:
        """The outcomes of the first `states` states in the files."""
        palette = None if self.palette is None else self.palette[: self._vectors]
        rows = states * self._num_actions
        return OutcomeParts(self.path, rows, self._num_actions, self._most, self._indices, palette)

    # Appending --------------------------------------------------------------------------------------------------------

    def _write(self, states: np.ndarray, block: BranchBlock, at: Position) -> None:
        if self._failure:  # files have no gaps
            raise self._failure
        try:
            self._write_outcomes(states, block, at)
        except BaseException as error:
            self._failure = error
            raise

    def _write_outcomes(self, states: np.ndarray, block: BranchBlock, at: Position) -> None:
        # possible outcomes alone, with the bits of their probabilities
        bits = np.ascontiguousarray(block.probabilities).view(np.uint64)
        counts = np.empty(len(bits) * self._num_actions, np.int64)
        successors, probability_bits = np.empty(bits.size, self.index_dtype), np.empty(bits.size, np.uint64)
        size = kernels.possible(block.successors, bits, self._num_actions, successors, probability_bits, counts)
        num_vectors = self._vectors
        # codes in the palette; with more vectors than codes, probabilities from now on
        codes = self._encoded(probability_bits[:size], counts)
        if codes is None and self.palette is not None:
            self._spell_out(num_vectors)
        files = self._files
        files[STATES].append(states)
        if codes is None:
            before = files[PART_NAMES[PROBABILITIES]].bytes // 8
            files[PART_NAMES[OFFSETS]].append(before + np.cumsum(counts))
            files[PART_NAMES[PROBABILITIES]].append(probability_bits[:size])
        else:
            assert self.palette is not None
            files[PART_NAMES[CODES]].append(codes)
            files[PART_NAMES[PALETTE]].append(self.palette[num_vectors : self._vectors])
        self._append_successors(successors[:size])
        files[TERMINAL].append(np.packbits(block.terminal, bitorder="little"))
        self._written = self._entries(at)

    def _encoded(self, bits: np.ndarray, counts: np.ndarray) -> np.ndarray | None:
        """Codes (rows,) uint16 of the rows' probabilities in the palette. None if there are more vectors than codes.

        bits: of the probabilities of all outcomes. counts: (rows,) outcomes of each row.
        """
        codes = np.empty(len(counts), np.uint16)
        row = first = 0
        while self.palette is not None:
            arrays = self.palette, self._vectors, self._table, codes
            row, first, self._vectors = kernels.encode(bits, counts, row, first, *arrays)
            if row == len(counts):
                return codes
            if len(self.palette) >= MOST_CODES:
                return None
            larger = np.zeros((min(2 * len(self.palette), MOST_CODES), self._most), np.uint64)
            larger[: len(self.palette)] = self.palette
            self.palette = larger
        return None

    def _spell_out(self, num_vectors: int) -> None:
        """Replace the codes in the files by probabilities and the offsets of rows.

        num_vectors: vectors of the palette that are in its file.
        Runs in the thread that writes, between two chunks.
        """
        assert self._written is not None
        self._vectors = num_vectors
        parts = self._parts(self._written["num_expanded"])
        for name in (OFFSETS, PROBABILITIES):
            self._files[PART_NAMES[name]] = GrowingFile(
                self.path / PART_NAMES[name]
            )  # closed with the others, come what may
        offsets, probabilities = (self._files[PART_NAMES[name]] for name in (OFFSETS, PROBABILITIES))
        offsets.append(np.zeros(1, np.int64))
        for part in parts.parts():
            offsets.append(part.first + np.cumsum(part.counts))
            probabilities.append(parts.bits(part))
        self.palette = None
        arrays = {name: {"dtype": dtype, **self._files[name].entry()} for name, dtype in self._dtypes().items()}
        self._written = {**self._written, "arrays": arrays}
        self.commit(complete=False)
        for name in (CODES, PALETTE):
            self._drop(PART_NAMES[name])

    # The end ----------------------------------------------------------------------------------------------------------

    def checkpoint(self, *, complete: bool) -> None:
        super().checkpoint(complete=False)
        if not complete:
            return
        assert self._written is not None
        arrays = self._written["arrays"]
        finished, most = self._parts(self._written["num_expanded"]).finish(arrays)
        written = {
            **self._written,
            "num_outcomes": most,
            "num_transitions": arrays[self._successors_name]["bytes"] // dtype_of(INDEX_TYPES[self._indices]).itemsize,
            "arrays": {STATES: arrays[STATES], **finished, TERMINAL: arrays[TERMINAL]},
        }
        self.commit(complete=True, written=written)
        self._written = None  # nothing is left to commit
        for name in [name for name in self._files if name not in ARRAYS]:
            self._drop(name)


def remove_parts(folder: Path) -> None:
    """Remove the files of a build in progress that are left if a process completed it and was killed then."""
    for name in PART_NAMES.values():
        with contextlib.suppress(OSError):
            (folder / name).unlink(missing_ok=True)
