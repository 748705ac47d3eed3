"""The files of a build with chance.

While the build goes on, possible outcomes are appended one after another, with a code for each state and action, whose
vector in the palette says how many there are and how likely they are. Where there are more vectors than codes, the
probabilities are spelled out, once and for all. outcome_parts.py makes the files of the finished build from these.
"""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from pharos.kernels import outcomes as kernels
from pharos.state_space.checks import states_to_check
from pharos.state_space.files import GrowingFile
from pharos.state_space.journal import Journal, Position
from pharos.state_space.manifest import (
    ARRAYS,
    CODES,
    INDEX_TYPES,
    MOST_CODES,
    OFFSETS,
    PALETTE,
    PARTS,
    PROBABILITIES,
    STATES,
    TERMINAL,
    successors_name,
)
from pharos.state_space.outcome_parts import OutcomeParts
from pharos.state_space.plan import Plan
from pharos.state_space.stored_outcomes import check_outcome_rules
from pharos.state_space.table import Block
from pharos.system.packed_indices import dtype_of

_SLOTS = 1 << 17  # of the table of the palette: twice as many as codes


class OutcomeJournal(Journal):
    """See `Journal`.

    Attributes:
        palette: (capacity, K) uint64, the bits of the vectors found; None where probabilities are spelled out.
    """

    def __init__(self, path: Path, plan: Plan):
        super().__init__(path, plan)
        self._num_actions, self._most = plan.env.num_actions, int(plan.env.outcomes)
        self.palette: np.ndarray | None = np.zeros((min(256, MOST_CODES), self._most), np.uint64)
        self._vectors = 0
        self._table = np.full(_SLOTS, -1, np.int32)
        self._failure: BaseException | None = None

    def _names(self, arrays: dict[str, Any]) -> tuple[str, ...]:
        self._indices = successors_name(arrays, PARTS)
        if PARTS[PROBABILITIES] in arrays:
            self.palette = None
        return tuple(self._dtypes())

    @property
    def _successors_name(self) -> str:
        return PARTS[self._indices]

    def _dtypes(self) -> dict[str, str]:
        dtypes = {STATES: "<u8", self._successors_name: INDEX_TYPES[self._indices]}
        if self.palette is None:
            return {**dtypes, PARTS[OFFSETS]: "<i8", PARTS[PROBABILITIES]: "<f8", TERMINAL: "|u1"}
        return {**dtypes, PARTS[CODES]: "<u2", PARTS[PALETTE]: "<f8", TERMINAL: "|u1"}

    def _check_rules(self, position: Position) -> None:
        """The same, of outcomes; and the palette of a build that goes on."""
        if self.palette is not None:
            vectors = np.fromfile(self.path / PARTS[PALETTE], "<u8").reshape(-1, self._most)
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
        """What the files hold of the first `states` states."""
        palette = None if self.palette is None else self.palette[: self._vectors]
        rows = states * self._num_actions
        return OutcomeParts(self.path, rows, self._num_actions, self._most, self._indices, palette)

    # Appending -------------------------------------------------------------------------------------------------------

    def _write(self, states: np.ndarray, block: Block, at: Position) -> None:
        if self._failure:  # files have no gaps
            raise self._failure
        try:
            self._write_outcomes(states, block, at)
        except BaseException as error:
            self._failure = error
            raise

    def _write_outcomes(self, states: np.ndarray, block: Block, at: Position) -> None:
        bits = np.ascontiguousarray(block.probabilities).view(np.uint64)
        counts = np.empty(len(bits) * self._num_actions, np.int64)
        following, likely = np.empty(bits.size, self.index_dtype), np.empty(bits.size, np.uint64)
        size = kernels.possible(block.successors, bits, self._num_actions, following, likely, counts)
        num_vectors = self._vectors
        codes = self._encoded(likely[:size], counts)
        if codes is None and self.palette is not None:
            self._spell_out(num_vectors)
        files = self._files
        files[STATES].append(states)
        if codes is None:
            before = files[PARTS[PROBABILITIES]].bytes // 8
            files[PARTS[OFFSETS]].append(before + np.cumsum(counts))
            files[PARTS[PROBABILITIES]].append(likely[:size])
        else:
            assert self.palette is not None
            files[PARTS[CODES]].append(codes)
            files[PARTS[PALETTE]].append(self.palette[num_vectors : self._vectors])
        self._append_successors(following[:size])
        files[TERMINAL].append(np.packbits(block.terminal, bitorder="little"))
        self._written = self._entries(at)

    def _encoded(self, likely: np.ndarray, counts: np.ndarray) -> np.ndarray | None:
        """(rows,) uint16, the number in the palette of each row's probabilities; None where there are too many."""
        codes = np.empty(len(counts), np.uint16)
        row = first = 0
        while self.palette is not None:
            arrays = self.palette, self._vectors, self._table, codes
            row, first, self._vectors = kernels.encode(likely, counts, row, first, *arrays)
            if row == len(counts):
                return codes
            if len(self.palette) >= MOST_CODES:
                return None
            larger = np.zeros((min(2 * len(self.palette), MOST_CODES), self._most), np.uint64)
            larger[: len(self.palette)] = self.palette
            self.palette = larger
        return None

    def _spell_out(self, num_vectors: int) -> None:
        """From codes to probabilities, and where the rows begin.

        num_vectors: vectors of the palette that are in its file.
        Runs in the thread that writes, between two chunks.
        """
        assert self._written is not None
        self._vectors = num_vectors
        parts = self._parts(self._written["num_expanded"])
        for name in (OFFSETS, PROBABILITIES):
            self._files[PARTS[name]] = GrowingFile(self.path / PARTS[name])  # closed with the others, come what may
        offsets, probabilities = (self._files[PARTS[name]] for name in (OFFSETS, PROBABILITIES))
        offsets.append(np.zeros(1, np.int64))
        for part in parts.parts():
            offsets.append(part.first + np.cumsum(part.counts))
            probabilities.append(parts.likely(part))
        self.palette = None
        arrays = {name: {"dtype": dtype, **self._files[name].entry()} for name, dtype in self._dtypes().items()}
        self._written = {**self._written, "arrays": arrays}
        self.commit(complete=False)
        for name in (CODES, PALETTE):
            self._drop(PARTS[name])

    # The end ---------------------------------------------------------------------------------------------------------

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
    """Remove what a process left that was killed between the end of its build and its own."""
    for name in PARTS.values():
        with contextlib.suppress(OSError):
            (folder / name).unlink(missing_ok=True)
