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
from pharos.state_space.checks import check_rules
from pharos.state_space.files import GrowingFile, write_manifest
from pharos.state_space.manifest import (
    FORMAT_VERSION,
    STATES,
    SUCCESSORS,
    TERMINAL,
    WIDE_SUCCESSORS,
    successors_name,
)
from pharos.state_space.plan import Plan

WIDENED_ROWS = 1 << 16  # rows of successors that are copied at a time


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
        path: the folder. index_dtype: of the successors.
        appended: states handed over to the files.
        last_checkpoint: time of the last commit, `time.perf_counter()`.
    """

    def __init__(self, path: Path, plan: Plan):
        self.path, self.plan = path, plan
        self.index_dtype: np.dtype = np.dtype("<i4")
        self.appended = 0
        self.last_checkpoint = time.perf_counter()
        self._successors_name = SUCCESSORS
        self._files: dict[str, GrowingFile] = {}
        self._writes: list[Future] = []
        self._written: dict[str, Any] | None = None  # what a checkpoint commits: counts and files that belong together
        self._writer: ThreadPoolExecutor

    def open(self, manifest: dict[str, Any] | None) -> Position:
        """Open the files, at the start states or at the last checkpoint; returns where the search stands."""
        arrays = manifest["arrays"] if manifest else {}
        self._successors_name = successors_name(arrays)
        if manifest:
            self.index_dtype = np.dtype(arrays[self._successors_name]["dtype"])
        names = (STATES, self._successors_name, TERMINAL)
        for name in {STATES, SUCCESSORS, WIDE_SUCCESSORS, TERMINAL} - set(names):
            (self.path / name).unlink(missing_ok=True)  # left by a process killed while it widened the indices
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

    def stored_states(self, count: int) -> np.ndarray:
        """(count, W) uint64, a memory map."""
        return np.memmap(self.path / STATES, "<u8", "r", shape=(count, self.plan.layout.num_words))

    def read_states(self, start: int, out: np.ndarray) -> None:
        """Read the states from number `start` on into out (n, W)."""
        words = self.plan.layout.num_words
        out[:] = np.fromfile(self.path / STATES, "<u8", len(out) * words, offset=8 * words * start).reshape(-1, words)

    # Appending -------------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """While a thread writes in the background."""
        with ThreadPoolExecutor(1) as self._writer:
            yield

    def append(self, states: np.ndarray, successors: np.ndarray, terminal: np.ndarray, position: Position) -> None:
        """Append in the background, while the next chunk is expanded; at most two chunks wait.

        Counts and checksums are noted by the thread that writes, once a chunk is in all files: whatever interrupts the
        main thread, and wherever, a checkpoint finds counts and files that belong together.
        """
        files, name, at = self._files, self._successors_name, Position(**vars(position))

        def write() -> None:
            files[STATES].append(states)
            files[name].append(successors)
            files[TERMINAL].append(np.packbits(terminal, bitorder="little"))
            self._written = self._entries(at)

        while len(self._writes) > 1:
            self._writes.pop(0).result()
        self._writes.append(self._writer.submit(write))
        self.appended = position.count

    def finish_writes(self) -> None:
        """Wait until everything appended is in the files."""
        while self._writes:
            self._writes.pop(0).result()

    def widen(self, position: Position) -> None:
        """From int32 to int64 indices: a new file of successors; the old file goes once this is committed."""
        self.finish_writes()
        num_actions = self.plan.env.num_actions
        old = self._files[self._successors_name]
        wide = GrowingFile(self.path / WIDE_SUCCESSORS)
        for start in range(0, position.first, WIDENED_ROWS):
            shape = (min(WIDENED_ROWS, position.first - start), num_actions)
            rows = np.memmap(old.path, "<i4", "r", offset=4 * start * num_actions, shape=shape)
            wide.append(rows.astype("<i8"))
        self._files[WIDE_SUCCESSORS] = wide
        self._successors_name, self.index_dtype = WIDE_SUCCESSORS, np.dtype("<i8")
        self._written = self._entries(position)
        self.commit(complete=False)
        del self._files[SUCCESSORS]
        old.close()
        old.path.unlink()

    # Committing ------------------------------------------------------------------------------------------------------

    def checkpoint(self, *, complete: bool) -> None:
        """Commit everything appended."""
        self.finish_writes()
        self.commit(complete=complete)

    def commit(self, *, complete: bool) -> None:
        """Commit what was written: data first, then the manifest that speaks of it."""
        if self._written is None:
            return
        written = self._written
        for file in self._files.values():
            file.sync()
        manifest = {
            "format": "pharos state space",
            "format_version": FORMAT_VERSION,
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

    def _entries(self, position: Position) -> dict[str, Any]:
        dtypes = {STATES: "<u8", self._successors_name: self.index_dtype.str, TERMINAL: "|u1"}
        arrays = {name: {"dtype": dtypes[name], **self._files[name].entry()} for name in dtypes}
        return {**position.to_dict(), "arrays": arrays}

    def _check_rules(self, position: Position) -> None:
        """StateSpaceMismatch where the stored transitions are those of other rules."""
        if position.first == 0:
            return
        shape = (position.first, self.plan.env.num_actions)
        successors = np.memmap(self.path / self._successors_name, self.index_dtype, "r", shape=shape)
        bits = np.memmap(self.path / TERMINAL, "|u1", "r")
        check_rules(self.path, self.plan.env, self.plan.layout, self.stored_states(position.count), successors, bits)
