"""Indices of states that take five bytes each, in files and in memory: 40 bits, where 32 are too few and 64 a waste.

A number n from -2^39 to 2^39 - 1 is n mod 2^40, little-endian (two's complement), so that -1, the end of an episode, is
five bytes of 255. NumPy has no such type: `PackedIndices` is an array of them to those who read rows, and
kernels/outcomes.py the same to compiled loops. docs/decisions/0017-indices-of-40-bits.md has the measurements.
"""

from collections.abc import Iterator
from types import EllipsisType

import numpy as np
from numpy.typing import DTypeLike

INT40 = "<i5"
"""What manifests call the type, after the names that NumPy gives to others."""

PACKED = np.dtype([("low", "<u4"), ("high", "i1")])
"""An entry, as NumPy sees its five bytes."""

INT32_STATES, INT40_STATES = 2**31 - 1, 2**39 - 1
"""States that indices of 32 and of 40 bits can number."""

Where = int | np.integer | slice | np.ndarray | tuple[int | slice | np.ndarray | EllipsisType, ...]
"""What an array is indexed by."""

# Entries that are unpacked at a time.
_BLOCK = 1 << 20


class PackedIndices:
    """An array of indices of 40 bits, which reads as one of int64: what is asked for is unpacked, and nothing else.

    `indices[s]`, `indices[first:last]`, `indices[rows, columns]` are arrays of int64, or numbers; `np.asarray(indices)`
    all of them, in 8 bytes each. Compiled loops read the entries where they are.

    Attributes:
        packed: the same, of type `PACKED`, in C order; may be a memory map.
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
        """From integers."""
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
        """The same entries in another shape; nothing is copied."""
        return PackedIndices(self.packed.reshape(shape if isinstance(shape, tuple) else (shape, *others)))

    def rows(self, start: int, stop: int) -> "PackedIndices":
        """Entries [start, stop) of the first axis; nothing is copied."""
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


def as_array(indices: object) -> Indices:
    """What is no `PackedIndices` as an array of NumPy."""
    return indices if isinstance(indices, PackedIndices) else np.asarray(indices)


def blocks_of(indices: Indices) -> Iterator[tuple[int, np.ndarray]]:
    """(first row, some rows), from the first one on: some million entries at a time, unpacked where they are packed."""
    rows = max(1, _BLOCK * len(indices) // max(1, indices.size))
    for first in range(0, len(indices), rows):
        yield first, np.asarray(indices[first : first + rows])


def rows_of(indices: Indices, start: int, stop: int) -> Indices:
    """Rows [start, stop), where they are: nothing is copied."""
    return indices.rows(start, stop) if isinstance(indices, PackedIndices) else indices[start:stop]


def room_for_indices(shape: tuple[int, ...], num_states: int) -> Indices:
    """An array to write to, of the least bytes that can number so many states: int32, or packed."""
    return np.empty(shape, np.int32) if num_states <= INT32_STATES else PackedIndices.empty(shape)


def holds_end(indices: Indices) -> bool:
    """Whether an entry is -1."""
    return any(bool((rows == -1).any()) for _, rows in blocks_of(indices))


# Files ----------------------------------------------------------------------------------------------------------------


def dtype_of(name: str) -> np.dtype:
    """The type of NumPy in which the numbers of a file are read, by what a manifest calls it."""
    return PACKED if name == INT40 else np.dtype(name)


def as_stored(indices: np.ndarray, name: str) -> np.ndarray:
    """Indices as a file of some type holds them."""
    return packed(indices) if name == INT40 else indices


def from_stored(stored: np.ndarray) -> Indices:
    """What a file holds, to those who read indices."""
    return PackedIndices(stored) if stored.dtype == PACKED else stored
