"""The outcomes that a build has found, as its files hold them until it ends, and the files that they become.

The rows s A + a lie one after another, possible outcomes alone. In the end they are padded to equal length where little
of that would be padding, and codes take one byte where that suffices.
"""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pharos.kernels import outcomes as kernels
from pharos.state_space.files import GrowingFile, cannot_write
from pharos.state_space.manifest import CODES, INDEX_TYPES, OFFSETS, PALETTE, PARTS, PROBABILITIES
from pharos.system.outcome_rows import OutcomesOfState
from pharos.system.packed_indices import as_stored, dtype_of, from_stored

MOST_PADDING = (3, 10)
"""The share of (S, A, K) that may be padding, as a fraction."""

ENTRIES = 1 << 18  # of rows of K, as many as are copied at a time


class Part(NamedTuple):
    """Some rows: the number of the first one, and that of its first outcome; then R rows of N outcomes in all.

    counts (R,); codes (R,), None where probabilities are spelled out; successors (N,).
    """

    row: int
    first: int
    counts: np.ndarray
    codes: np.ndarray | None
    successors: np.ndarray


@dataclass
class OutcomeParts:
    """What the files of a build that goes on hold of outcomes.

    Attributes:
        folder: where they are. rows: how many, A for each state. most_declared: the most outcomes that a row may have.
        indices: the file of the finished build that its successors will be in, of INDEX_TYPES.
        palette: (P, K) uint64, bits of the vectors; None where probabilities are spelled out.
    """

    folder: Path
    rows: int
    num_actions: int
    most_declared: int
    indices: str
    palette: np.ndarray | None

    def parts(self) -> Iterator[Part]:
        """All rows, some at a time."""
        for row, first, codes, counts in self._counts():
            yield self._part(row, first, codes, counts)

    def _counts(self) -> Iterator[tuple[int, int, np.ndarray | None, np.ndarray]]:
        """(row, first, codes, counts) of each `Part`."""
        sizes = np.zeros(0, np.int64) if self.palette is None else (self.palette != 0).sum(axis=1)
        first, step = 0, max(1, ENTRIES // self.most_declared // self.num_actions) * self.num_actions
        for row in range(0, self.rows, step):
            rows = min(step, self.rows - row)
            codes = None
            if self.palette is None:
                counts = np.diff(np.fromfile(self.folder / PARTS[OFFSETS], "<i8", rows + 1, offset=8 * row))
            else:
                codes = np.fromfile(self.folder / PARTS[CODES], "<u2", rows, offset=2 * row)
                counts = sizes[codes]
            yield row, first, codes, counts
            first += int(counts.sum())

    def _part(self, row: int, first: int, codes: np.ndarray | None, counts: np.ndarray) -> Part:
        entries = int(counts.sum())
        dtype = dtype_of(INDEX_TYPES[self.indices])
        place = first * dtype.itemsize
        stored = np.fromfile(self.folder / PARTS[self.indices], dtype, entries, offset=place)
        successors = np.asarray(from_stored(stored))
        return Part(row, first, counts, codes, successors)

    def likely(self, part: Part) -> np.ndarray:
        """(N,) uint64, the bits of the probabilities of its outcomes."""
        if self.palette is None:
            entries = len(part.successors)
            return np.fromfile(self.folder / PARTS[PROBABILITIES], "<u8", entries, offset=8 * part.first)
        assert part.codes is not None
        vectors = self.palette[part.codes]
        return vectors[vectors != 0]

    def most(self) -> int:
        """K, the most possible outcomes of a row."""
        if self.palette is not None:
            return int((self.palette != 0).sum(axis=1).max())
        return max(int(counts.max()) for _, _, _, counts in self._counts())

    def finish(self, written: dict[str, dict[str, Any]]) -> tuple[dict[str, dict[str, Any]], int]:
        """Write the files of a finished build: name -> what the manifest says of it; and K, the most outcomes of a row.

        Args:
            written: the same of the files that there are.
        """
        most = self.most()
        successors, index_type = self.indices, INDEX_TYPES[self.indices]
        num_entries = written[PARTS[successors]]["bytes"] // dtype_of(index_type).itemsize
        is_dense = MOST_PADDING[1] * (self.rows * most - num_entries) <= MOST_PADDING[0] * self.rows * most
        dtypes = {successors: index_type}
        if not is_dense:
            dtypes[OFFSETS] = "<i8"
        if self.palette is None:
            dtypes[PROBABILITIES] = "<f8"
        else:
            dtypes |= {CODES: "|u1" if len(self.palette) <= 256 else "<u2", PALETTE: "<f8"}
        stay = {successors, OFFSETS, PROBABILITIES} if not is_dense else set()
        stay |= {CODES} if dtypes.get(CODES) == "<u2" else set()
        stay &= {name for name in dtypes if PARTS[name] in written}
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
            _link(self.folder / PARTS[name], self.folder / name)
        return {
            name: {"dtype": dtype, **files[name].entry()} if name in files else written[PARTS[name]]
            for name, dtype in dtypes.items()
        }, most

    def _fill(self, files: dict[str, GrowingFile], dtypes: dict[str, str], most: int, is_dense: bool) -> None:
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
                files[PROBABILITIES].append(_padded(self.likely(part), part.counts, most, fill_with_first=False))
            if CODES in files and part.codes is not None:
                files[CODES].append(part.codes.astype(dtypes[CODES]))

    def of_states(self, states: np.ndarray) -> dict[int, OutcomesOfState]:
        """The outcomes of some states, ascending."""
        outcomes = {}
        for row, first, codes, counts in self._counts():
            for state in states[
                (states >= row // self.num_actions) & (states < (row + len(counts)) // self.num_actions)
            ]:
                place = int(state) * self.num_actions - row
                here = slice(place, place + self.num_actions)
                before = first + int(counts[:place].sum())
                part = self._part(row + place, before, None if codes is None else codes[here], counts[here])
                ends = np.cumsum(part.counts)[:-1]
                likely = np.split(self.likely(part).view(np.float64), ends)
                outcomes[int(state)] = list(zip(np.split(part.successors, ends), likely, strict=True))
        return outcomes


def _padded(values: np.ndarray, counts: np.ndarray, most: int, *, fill_with_first: bool) -> np.ndarray:
    out = np.empty((len(counts), most), values.dtype)
    kernels.padded(values, counts, fill_with_first, out)
    return out


def _link(source: Path, target: Path) -> None:
    """The same file by another name; a copy, where the file system has no such names."""
    try:
        os.link(source, target)
    except OSError:
        try:
            shutil.copyfile(source, target)
            with open(target, "rb+") as file:
                os.fsync(file.fileno())
        except OSError as error:
            raise cannot_write(target, error) from error
