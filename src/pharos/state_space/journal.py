"""The files of a build: states, successors and terminal bits are appended in the background, and committed at
checkpoints.

Data first, then the manifest that speaks of it: whatever kills the process, the last manifest is true, and the same
command goes on from there.
"""

import contextlib
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import DiskFull
from pharos.rules import pack
from pharos.state_space.files import GrowingFile, write_manifest
from pharos.state_space.manifest import (
    ARRAYS,
    INDEX_TYPES,
    INT40_VERSION,
    PARTS,
    STATES,
    SUCCESSORS,
    SUCCESSORS40,
    TERMINAL,
    Plan,
    successors_name,
)
from pharos.state_space.stored import check_rules
from pharos.state_space.table import Block
from pharos.system.packed_indices import as_stored, dtype_of, from_stored

BLOCK_BYTES = 1 << 22  # of a file that are copied at a time


@dataclass
class Position:
    """Where a search stands.

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
        """As kernels take it: (first, count, level_end, depth, no fault)."""
        return np.array([self.first, self.count, self.level_end, self.depth, 0], np.int64)

    def take(self, progress: np.ndarray) -> None:
        """Go on to where a kernel stopped."""
        self.first, self.count, self.level_end, self.depth = (int(value) for value in progress[:4])

    def to_dict(self) -> dict[str, int]:
        """The entries of the manifest."""
        return {
            "num_states": self.count,
            "num_expanded": self.first,
            "num_terminal_states": self.terminals,
            "depth": self.depth,
            "level_end": self.level_end,
        }

    @staticmethod
    def of_manifest(manifest: dict[str, Any]) -> "Position":
        """The position of the last checkpoint."""
        names = ("num_expanded", "num_states", "level_end", "depth", "num_terminal_states")
        return Position(*(manifest[name] for name in names))


class Journal:
    """The files of one build.

    Attributes:
        path: the folder.
        appended: states handed over to the files.
        last_checkpoint: time of the last commit, `time.perf_counter()`.
    """

    def __init__(self, path: Path, plan: Plan):
        self.path, self.plan = path, plan
        self.appended = 0
        self.last_checkpoint = time.perf_counter()
        self._indices = SUCCESSORS  # of INDEX_TYPES
        self._files: dict[str, GrowingFile] = {}
        self._writes: list[Future] = []
        self._written: dict[str, Any] | None = None  # what a checkpoint commits: counts and files that belong together
        self._writer: ThreadPoolExecutor

    def open(self, manifest: dict[str, Any] | None) -> Position:
        """Open the files, at the start states or at the last checkpoint; returns where the search stands."""
        arrays = manifest["arrays"] if manifest else {}
        names = self._names(arrays)
        for name in {*ARRAYS, *PARTS.values()} - set(names):
            (self.path / name).unlink(missing_ok=True)  # left by a process killed while it made other files of some
        for name in names:
            self._files[name] = GrowingFile(self.path / name, arrays.get(name))
        if manifest is None:
            states = pack(self.plan.layout, np.array(self.plan.starts[0], np.int64))
            position = Position(count=len(states), level_end=len(states))
            self._files[STATES].append(states)
        else:
            position = Position.of_manifest(manifest)
            self._check_rules(position)
        self.appended = position.count
        self._written = self._entries(position)
        return position

    def _names(self, arrays: dict[str, Any]) -> tuple[str, ...]:
        """The files of a build, at the start or where it stopped with these arrays."""
        self._indices = successors_name(arrays)
        return STATES, self._successors_name, TERMINAL

    @property
    def index_dtype(self) -> np.dtype:
        """Of the successors while they are in memory."""
        return np.dtype(np.int32 if self._indices == SUCCESSORS else np.int64)

    @property
    def _successors_name(self) -> str:
        """Their file."""
        return self._indices

    def stored_states(self, count: int) -> np.ndarray:
        """(count, W) uint64, a memory map."""
        return np.memmap(self.path / STATES, "<u8", "r", shape=(count, self.plan.layout.num_words))

    def read_states(self, start: int, out: np.ndarray) -> None:
        """Read the states from number `start` on into out (n, W)."""
        words = self.plan.layout.num_words
        out[:] = np.fromfile(self.path / STATES, "<u8", len(out) * words, offset=8 * words * start).reshape(-1, words)

    # Appending --------------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """While a thread writes in the background."""
        with ThreadPoolExecutor(1) as self._writer:
            yield

    def append(self, states: np.ndarray, block: Block, position: Position) -> None:
        """Append in the background, while the next chunk is expanded; at most two chunks wait.

        Counts and checksums are noted by the thread that writes, once a chunk is in all files: whatever interrupts the
        main thread, and wherever, a checkpoint finds counts and files that belong together.
        """
        while len(self._writes) > 1:
            self._writes.pop(0).result()
        self._writes.append(self._writer.submit(self._write, states, block, Position(**vars(position))))
        self.appended = position.count

    def _write(self, states: np.ndarray, block: Block, at: Position) -> None:
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
        """From indices of 32 to those of 40 bits: a new file; the old one goes once this is committed."""
        self.finish_writes()
        narrow, self._indices = self._successors_name, SUCCESSORS40
        old = self._files[narrow]
        self._files[self._successors_name] = GrowingFile(self.path / self._successors_name)
        for _, entries in blocks_of(old, np.dtype("<i4")):
            self._append_successors(entries)
        self._written = self._entries(position)
        self.commit(complete=False)
        self._drop(narrow)

    def _drop(self, name: str) -> None:
        """A file that nothing speaks of any more."""
        file = self._files.pop(name)
        file.close()
        file.path.unlink()

    # Committing -------------------------------------------------------------------------------------------------------

    def checkpoint(self, *, complete: bool) -> None:
        """Commit everything appended."""
        self.finish_writes()
        self.commit(complete=complete)

    def commit(self, *, complete: bool, written: dict[str, Any] | None = None) -> None:
        """Commit what was written: data first, then the manifest that speaks of it.

        Args:
            written: what the manifest says of it; None for what the thread that writes noted.
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
        arrays = {name: {"dtype": dtype, **self._files[name].entry()} for name, dtype in self._dtypes().items()}
        return {**position.to_dict(), "arrays": arrays}

    def _check_rules(self, position: Position) -> None:
        """StateSpaceMismatch where the stored transitions are those of other rules."""
        if position.first == 0:
            return
        shape = (position.first, self.plan.env.num_actions)
        dtype = dtype_of(INDEX_TYPES[self._indices])
        successors = from_stored(np.memmap(self.path / self._successors_name, dtype, "r", shape=shape))
        bits = np.memmap(self.path / TERMINAL, "|u1", "r")
        check_rules(self.path, self.plan.env, self.plan.layout, self.stored_states(position.count), successors, bits)


def blocks_of(file: GrowingFile, dtype: np.dtype, entries: int | None = None) -> Iterator[tuple[int, np.ndarray]]:
    """(first, some of the numbers in a file, from the first one on), in their order.

    Args:
        entries: of a block, at most; None for BLOCK_BYTES.
    """
    size = file.bytes // dtype.itemsize
    most = entries or max(1, BLOCK_BYTES // dtype.itemsize)
    for first in range(0, size, most):
        shape = (min(most, size - first),)
        yield first, np.memmap(file.path, dtype, "r", offset=first * dtype.itemsize, shape=shape)
