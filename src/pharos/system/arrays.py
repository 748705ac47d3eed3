"""Indices of states, and outcomes of actions, as files and memory hold them.

Indices that take five bytes each: 40 bits, if 32 are too few and 64 a waste.

A number n from -2^39 to 2^39 - 1 is n mod 2^40, little-endian (two's complement), so that -1, the end of an episode, is
five bytes of 255. NumPy has no such type: `PackedIndices` is an array of them to those who read rows, and
kernels/outcomes.py the same to compiled loops. docs/decisions/0017-indices-of-40-bits.md has the measurements.

Outcomes: two layouts, two ways to keep probabilities, and one way to read (`OutcomeRows`). Row s A + a belongs to
action a in state s. Nobody else asks which layout it is. kernels/outcomes.py says the same to compiled loops.
"""

from collections.abc import Callable, Iterator
from functools import cached_property
from types import EllipsisType
from typing import NoReturn, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from pharos.errors import ParameterError

UNIT_ROUNDOFF = 2.0**-53
"""Largest relative error of one rounding to 64-bit floats."""

INT40 = "<i5"
"""What manifests call the type, after the names that NumPy gives to others."""

PACKED = np.dtype([("low", "<u4"), ("high", "i1")])
"""An entry, as NumPy sees its five bytes."""

INT32_STATES, INT40_STATES = 2**31 - 1, 2**39 - 1
"""States that indices of 32 and of 40 bits can number."""

Where = int | np.integer | slice | np.ndarray | tuple[int | slice | np.ndarray | EllipsisType, ...]
"""What an array is indexed by."""

# Entries that are unpacked at a time.
_ENTRIES_AT_ONCE = 1 << 20


class PackedIndices:
    """An array of indices of 40 bits, which reads as one of int64: what is asked for is unpacked, and nothing else.

    `indices[s]`, `indices[first:last]`, `indices[rows, columns]` are arrays of int64, or numbers, and
    `np.asarray(indices)` all of them, in 8 bytes each. Compiled loops read the entries without a copy.

    Attributes:
        packed: the same, of type `PACKED`, in C order. It may be a memory map.
        shape, ndim, size: of the array. dtype: int64, what its entries are read as. nbytes: what they take, 5 each.
    """

    dtype = np.dtype(np.int64)

    def __init__(self, packed: np.ndarray):
        self.packed = packed if packed.flags.c_contiguous else np.ascontiguousarray(packed)

    @staticmethod
    def empty(shape: int | tuple[int, ...]) -> "PackedIndices":
        """An array to write to."""
        return PackedIndices(np.empty(shape, PACKED))

    @staticmethod
    def of(values: object) -> "PackedIndices":
        """These integers, packed."""
        return PackedIndices(packed(np.asarray(values)))

    @property
    def shape(self) -> tuple[int, ...]:
        return self.packed.shape

    @property
    def ndim(self) -> int:
        return self.packed.ndim

    @property
    def size(self) -> int:
        return self.packed.size

    @property
    def nbytes(self) -> int:
        return self.packed.nbytes

    def __len__(self) -> int:
        return len(self.packed)

    def __getitem__(self, where: Where) -> np.ndarray:
        return unpacked(self.packed[where])

    def __setitem__(self, where: Where, values: object) -> None:
        self.packed[where] = packed(np.asarray(values))

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        return unpacked(self.packed).astype(dtype or np.int64, copy=False)

    def __repr__(self) -> str:
        return f"PackedIndices(shape={self.shape})"

    def reshape(self, shape: int | tuple[int, ...], *others: int) -> "PackedIndices":
        """The same entries in another shape. Nothing is copied."""
        return PackedIndices(self.packed.reshape(shape if isinstance(shape, tuple) else (shape, *others)))

    def rows(self, start: int, stop: int) -> "PackedIndices":
        """Entries [start, stop) of the first axis. Nothing is copied."""
        return PackedIndices(self.packed[start:stop])


Indices = np.ndarray | PackedIndices
"""An array of indices, of any width."""


def packed(values: np.ndarray) -> np.ndarray:
    """Integers from -2^39 to 2^39 - 1 in five bytes each, an array of type `PACKED` and of the same shape."""
    entries = np.empty(values.shape, PACKED)
    entries["low"] = values.astype(np.uint32)  # the lower bits of negative numbers, too
    entries["high"] = values >> 32
    return entries


def unpacked(entries: np.ndarray) -> np.ndarray:
    """The int64 of some entries of type `PACKED`, or of one."""
    return (entries["high"].astype(np.int64) << 32) | entries["low"]


def as_index_array(indices: object) -> Indices:
    """Indices as an array of NumPy. `PackedIndices` stay as they are."""
    return indices if isinstance(indices, PackedIndices) else np.asarray(indices)


T = TypeVar("T")


def read_only(array: T) -> T:
    """An array as kernels read it: a view that cannot be written to, so that all are of one type. All else stays as it
    is."""
    if not isinstance(array, np.ndarray) or not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def index_blocks(indices: Indices) -> Iterator[tuple[int, np.ndarray]]:
    """(first row, some rows), from the first one on: some million entries at a time, unpacked if they are packed."""
    rows = max(1, _ENTRIES_AT_ONCE * len(indices) // max(1, indices.size))
    for first in range(0, len(indices), rows):
        yield first, np.asarray(indices[first : first + rows])


def index_rows(indices: Indices, start: int, stop: int) -> Indices:
    """View of rows [start, stop): nothing is copied."""
    return indices.rows(start, stop) if isinstance(indices, PackedIndices) else indices[start:stop]


def room_for_indices(shape: tuple[int, ...], num_states: int) -> Indices:
    """An uninitialised array of the smallest type that numbers so many states: int32, or packed."""
    return np.empty(shape, np.int32) if num_states <= INT32_STATES else PackedIndices.empty(shape)


def holds_end(indices: Indices) -> bool:
    """Whether an entry is -1."""
    return any(bool((rows == -1).any()) for _, rows in index_blocks(indices))


# Files ----------------------------------------------------------------------------------------------------------------


def dtype_of(name: str) -> np.dtype:
    """The type of NumPy for the numbers of a file, by the name that a manifest gives it."""
    return PACKED if name == INT40 else np.dtype(name)


def as_stored(indices: np.ndarray, name: str) -> np.ndarray:
    """Indices as a file of some type holds them."""
    return packed(indices) if name == INT40 else indices


def from_stored(stored: np.ndarray) -> Indices:
    """Indices that read as integers, of the array that a file holds: `PackedIndices` if its type is `PACKED`."""
    return PackedIndices(stored) if stored.dtype == PACKED else stored


# Outcomes of actions --------------------------------------------------------------------------------------------------


SUM_TOLERANCE = 1e-9
"""By how much the probabilities of the outcomes of an action may sum to something else than 1."""


def rounding_of_sums(most: int) -> float:
    """Difference to 1 that the sum of at most so many rounded probabilities may have: 4 (n + 2) units of 2^-53."""
    return 4 * (most + 2) * 2.0**-53


OutcomesOfState = list[tuple[np.ndarray, np.ndarray]]
"""For each action the next states and their probabilities, possible outcomes alone."""


class OutcomeRows:
    """Possible outcomes of executing actions, for S states, A actions and at most K outcomes of each pair.

    Attributes:
        successors: (S, A, K) int32, int64 or `PackedIndices`. -1 if the episode ends. Impossible outcomes repeat the
            first one. Or (N,), the rows one after another.
        offsets: (S A + 1,) index of the first entry of each row. None if successors are (S, A, K).
        codes: (S, A) uint8 or uint16, which vector of the palette has the probabilities. None without a palette.
        palette: (P, K) float64, the probabilities of possible outcomes in their order, then zeros. None without one.
        probabilities: float64 in the shape of successors. None if there is a palette.
    """

    NAMES = ("successors", "offsets", "codes", "palette", "probabilities")

    def __init__(
        self,
        successors: Indices,
        *,
        offsets: Indices | None = None,
        codes: Indices | None = None,
        palette: Indices | None = None,
        probabilities: Indices | None = None,
    ):
        """Keep arrays as files hold them: nothing is copied, so they may be memory maps.

        Raises:
            ParameterError: there is neither a palette with codes, nor probabilities.
        """
        if (palette is None) != (codes is None) or (palette is None) == (probabilities is None):
            raise ParameterError("outcomes take codes with a palette, or probabilities; found both or neither")
        self.successors = as_index_array(successors)
        self.offsets, self.codes, self.palette, self.probabilities = (
            None if array is None else np.asarray(array) for array in (offsets, codes, palette, probabilities)
        )

    @cached_property
    def num_outcomes(self) -> int:
        """K, the most outcomes of a row."""
        if self.offsets is None:
            return self.successors.shape[2]
        return int(np.diff(self.offsets).max()) if self.palette is None else self.palette.shape[1]

    @property
    def by_name(self) -> dict[str, Indices]:
        """The arrays that there are, by name."""
        return {name: array for name in self.NAMES if (array := getattr(self, name)) is not None}

    @property
    def flat(self) -> Indices:
        """(N,) successors, row after row."""
        return self.successors.reshape(-1)

    def begins(self, rows: np.ndarray) -> np.ndarray:
        """(R,) positions of the first outcomes of some rows among the successors."""
        return rows * self.num_outcomes if self.offsets is None else self.offsets[rows].astype(np.int64)

    def entry_indices(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(index in `rows`, index among the successors) of all entries of some rows."""
        first = self.begins(rows)
        counts = self.begins(rows + 1) - first
        which = np.repeat(np.arange(len(rows)), counts)
        return which, np.arange(len(which)) + np.repeat(first - (np.cumsum(counts) - counts), counts)

    def possible(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(index in `rows`, next state, probability) of all possible outcomes of some rows, in order."""
        codes = None if self.codes is None else self.codes.reshape(-1)[rows]
        palette, probabilities = np.asarray(self.palette), np.asarray(self.probabilities)  # one of which is there
        if self.offsets is None:
            vectors = probabilities.reshape(-1, self.num_outcomes)[rows] if codes is None else palette[codes]
            which, k = np.nonzero(vectors)
            return which, self.successors.reshape(-1, self.num_outcomes)[rows][which, k], vectors[which, k]
        which, indices = self.entry_indices(rows)
        if codes is None:
            return which, self.flat[indices], probabilities[indices]
        first = np.searchsorted(which, np.arange(len(rows)))
        return which, self.flat[indices], palette[codes[which], np.arange(len(which)) - first[which]]

    def of_states(self, states: np.ndarray, num_actions: int) -> dict[int, OutcomesOfState]:
        """The outcomes of some states."""
        rows = (states[:, None] * num_actions + np.arange(num_actions)).ravel()
        which, successors, probabilities = self.possible(rows)
        ends = np.searchsorted(which, np.arange(1, len(rows)))
        pairs = list(zip(np.split(successors, ends), np.split(probabilities, ends), strict=True))
        return {int(s): pairs[i * num_actions : (i + 1) * num_actions] for i, s in enumerate(states)}


class WrongOutcomes(ValueError):
    """Arrays are no outcomes.

    Attributes:
        name: of the array that is wrong.
    """

    def __init__(self, name: str, why: str):
        super().__init__(why)
        self.name = name


class OutcomeCheck:
    """Validation of outcomes from files that anybody may have written, a block of states at a time.

    Attributes:
        most: the outcomes that a row may have, at most. least: the least index of a next state, -1 if episodes may
            end without one.
    """

    def __init__(self, stored: OutcomeRows, shape: tuple[int, int], most: int, least: int):
        """Check the ends of the offsets and the palette. WrongOutcomes if they are wrong. shape: (S, A)."""
        self.stored, self.most, self.least = stored, most, least
        self.num_states, self.num_actions = shape
        offsets, size = stored.offsets, stored.successors.size
        if offsets is not None and (offsets[0] != 0 or offsets[-1] != size):
            self._refuse("offsets", f"begins with {offsets[0]} and ends with {offsets[-1]}; expected 0 and {size}")
        self._sizes_of_palette = np.zeros(0, np.int64)
        if stored.palette is not None:
            self._sizes_of_palette = self._sizes(stored.palette, "palette", lambda row: f"vector {row}")

    def block(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """(number of outcomes, next state of the first outcome) of each row of states [start, stop).

        Raises:
            WrongOutcomes: they are no outcomes. The first row that is wrong is named.
        """
        stored, rows, counts = self.stored, np.arange(start * self.num_actions, stop * self.num_actions), None
        # Codes: each names a vector of the palette, whose length is the number of outcomes
        if stored.codes is not None:
            codes = stored.codes[start:stop].ravel()
            if codes.max() >= len(self._sizes_of_palette):
                row, last = int((codes >= len(self._sizes_of_palette)).argmax()), len(self._sizes_of_palette) - 1
                self._refuse("codes", f"{self._pair(rows[row])} has the code {codes[row]}; expected 0 to {last}")
            counts = self._sizes_of_palette[codes]
        # Offsets: rows have as many entries as outcomes, within the array
        begins = stored.begins(np.append(rows, rows[-1] + 1))
        lengths = np.diff(begins)
        if stored.offsets is not None:
            wrong = (lengths < 1) | (lengths > self.most) if counts is None else lengths != counts
            if wrong.any():
                row = int(wrong.argmax())
                expected = f"1 to {self.most}" if counts is None else f"{counts[row]}"
                self._refuse("offsets", f"{self._pair(rows[row])} has {lengths[row]} outcomes; expected {expected}")
            if begins[0] < 0 or begins[-1] > stored.successors.size:
                text = f"{self._pair(rows[0])} begins at {begins[0]}; expected 0 to {stored.successors.size}"
                self._refuse("offsets", text)
        # Next states and probabilities
        next_states = np.asarray(stored.flat[int(begins[0]) : int(begins[-1])])  # unpacked, if indices are packed
        self._check_range(next_states, np.repeat(rows, lengths))
        if counts is None:
            probabilities = np.zeros((len(rows), self.most))
            probabilities[np.arange(self.most) < lengths[:, None]] = np.asarray(stored.probabilities).reshape(-1)[
                begins[0] : begins[-1]
            ]
            counts = self._sizes(probabilities, "probabilities", lambda row: self._pair(rows[row]))
            if stored.offsets is not None and (counts != lengths).any():
                row = int((counts != lengths).argmax())
                self._refuse("probabilities", f"{self._pair(rows[row])} has an outcome of probability 0")
        # Padding of rows of equal length
        first = next_states[begins[:-1] - begins[0]]
        if stored.offsets is None:
            padding = np.arange(self.most) >= counts[:, None]
            wrong = (padding & (next_states.reshape(padding.shape) != first[:, None])).any(axis=1)
            if wrong.any():
                pair = self._pair(rows[int(wrong.argmax())])
                self._refuse("successors", f"{pair} has padding that does not repeat its first outcome")
        return counts, first

    def _sizes(self, probabilities: np.ndarray, name: str, source: Callable[[int], str]) -> np.ndarray:
        """(R,) how many of the probabilities (R, K) of each row are not 0. They come first and sum to 1."""
        with np.errstate(invalid="ignore", over="ignore"):
            possible = probabilities > 0
            total = np.cumsum(probabilities, axis=1)[:, -1]
            good = (probabilities >= 0).all(axis=1) & (abs(total - 1) <= SUM_TOLERANCE)
        good &= (possible[:, 1:] <= possible[:, :-1]).all(axis=1)
        if not good.all():
            row = int((~good).argmax())
            shown = ", ".join(map(str, probabilities[row, :8].tolist())) + (", ..." if self.most > 8 else "")
            expected = "expected positive ones that sum to 1, then 0"
            self._refuse(name, f"{source(row)} has the probabilities {shown}; {expected}")
        return np.asarray(possible.sum(axis=1))

    def _check_range(self, next_states: np.ndarray, rows: np.ndarray) -> None:
        if next_states.min() < self.least or next_states.max() >= self.num_states:
            j = int(((next_states < self.least) | (next_states >= self.num_states)).argmax())
            expected = f"expected {self.least} to {self.num_states - 1}"
            s, a = divmod(int(rows[j]), self.num_actions)
            self._refuse("successors", f"action {a} leads from state {s} to state {next_states[j]}; {expected}")

    def _pair(self, row: int) -> str:
        s, a = divmod(int(row), self.num_actions)
        return f"action {a} in state {s}"

    def _refuse(self, name: str, why: str) -> NoReturn:
        raise WrongOutcomes(name, why)
