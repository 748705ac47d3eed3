"""Rows of which many are equal, such as the screens of states: the distinct ones in deflated chunks, and an index.

A chunk holds up to `rows_in_chunk` distinct rows as bytes, little-endian. Each row after the first of a chunk is stored
as its bytewise exclusive or with the first one: screens of one game differ in a few places, so that most bytes are 0.
The chunk is then deflated (zlib, RFC 1950).
"""

import math
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from pharos.errors import FileFormatError
from pharos.system import storage

CHUNK_BYTES = 1 << 20
"""Size of a chunk before it is deflated: the least that is read for one row."""
CACHED_BYTES = 1 << 26
COMPRESSION_LEVEL = 6


class DistinctRows:
    """N rows of one shape and type, of which only the distinct ones are kept. They are read like an array, a chunk at a
    time.

    `rows[3]` and `rows[[3, 5]]` are fresh arrays.

    Attributes:
        index: (N,) integers, the number of each row among the distinct ones, -1 for a row of zeros.
        shape: (N, *shape of a row). dtype: of the entries.
        num_distinct: D.
        rows_in_chunk: distinct rows of a chunk. The last one may have fewer.
        name: of their file, for messages.
    Raises:
        FileFormatError: a chunk that is looked at is damaged.
    """

    def __init__(
        self,
        index: np.ndarray,
        row_shape: Sequence[int],
        dtype: npt.DTypeLike,
        num_distinct: int,
        rows_in_chunk: int,
        chunk: Callable[[int], bytes],
        name: str = "rows",
    ):
        self.name, self.index, self.dtype = name, index, np.dtype(dtype)
        self.shape = (len(index), *row_shape)
        self.num_distinct, self.rows_in_chunk = num_distinct, rows_in_chunk
        self.chunk = chunk
        self._cache: OrderedDict[int, np.ndarray] = OrderedDict()

    def __len__(self) -> int:
        return len(self.index)

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def num_chunks(self) -> int:
        """Number of chunks of the distinct rows."""
        return -(-self.num_distinct // self.rows_in_chunk)

    def __getitem__(self, rows: int | slice | np.ndarray) -> np.ndarray:
        return self.distinct(self.index[rows])

    def distinct(self, numbers: npt.ArrayLike) -> np.ndarray:
        """Distinct rows by their numbers: of one number, or of an array (M,)."""
        if np.ndim(numbers) == 0:
            return self.distinct(np.array([numbers]))[0]
        numbers = np.asarray(numbers, np.int64)
        out = np.zeros((len(numbers), *self.shape[1:]), self.dtype)
        chunks = numbers // self.rows_in_chunk
        for chunk in np.unique(chunks[numbers >= 0]).tolist():
            here = np.flatnonzero(chunks == chunk)
            out[here] = self._rows(chunk)[numbers[here] - chunk * self.rows_in_chunk]
        return out

    def blocks(self) -> Iterator[np.ndarray]:
        """Yield the distinct rows, chunk by chunk."""
        for chunk in range(self.num_chunks):
            yield self._rows(chunk)

    def with_zeros(self, count: int) -> "DistinctRows":
        """These rows, and so many rows of zeros after them."""
        return self.with_index(np.concatenate([self.index.astype(np.int64), np.full(count, -1)])) if count else self

    def with_index(self, index: np.ndarray) -> "DistinctRows":
        """Rows of the same distinct ones, by another index."""
        sizes = self.num_distinct, self.rows_in_chunk
        return DistinctRows(index, self.shape[1:], self.dtype, *sizes, self.chunk, self.name)

    def _rows(self, chunk: int) -> np.ndarray:
        if chunk in self._cache:
            self._cache.move_to_end(chunk)
            return self._cache[chunk]
        count = min(self.rows_in_chunk, self.num_distinct - chunk * self.rows_in_chunk)
        try:
            rows = inflate_rows(self.chunk(chunk), (count, *self.shape[1:]), self.dtype)
        except ValueError as error:
            raise error if isinstance(error, FileFormatError) else FileFormatError(f"{self.name}: {error}") from None
        self._cache[chunk] = rows
        while len(self._cache) > 1 and sum(each.nbytes for each in self._cache.values()) > CACHED_BYTES:
            self._cache.popitem(last=False)
        return rows


class RowCollector:
    """Rows that arrive one after another, kept once each and deflated as soon as a chunk is full.

    Args:
        shape, dtype: of a row.
    """

    def __init__(self, shape: Sequence[int], dtype: npt.DTypeLike):
        self.shape, self.dtype = tuple(shape), np.dtype(dtype).newbyteorder("<")
        size = math.prod(self.shape) * self.dtype.itemsize
        self.rows_in_chunk = max(1, CHUNK_BYTES // max(1, size))
        self.chunks: list[bytes] = []
        self.pending: list[np.ndarray] = []
        self._numbers: dict[str, int] = {}

    @property
    def num_distinct(self) -> int:
        """Number of distinct rows so far."""
        return len(self._numbers)

    def add(self, row: npt.ArrayLike, digest: str = "") -> int:
        """Number of a row among the distinct ones. It is kept if it is new. digest: `row_digest(row)`, if known."""
        array = np.ascontiguousarray(row, self.dtype)
        digest = digest or row_digest(array)
        number = self._numbers.get(digest)
        if number is None:
            number = self._numbers[digest] = len(self._numbers)
            self.pending.append(array.copy())
            if len(self.pending) == self.rows_in_chunk:
                self.chunks.append(deflate_rows(np.stack(self.pending)))
                self.pending = []
        return number

    def digests(self, since: int) -> list[str]:
        """Digests of the distinct rows from this number on."""
        return list(self._numbers)[since:]

    def packed_pending(self) -> bytes:
        """The distinct rows that fill no chunk yet."""
        return deflate_rows(np.stack(self.pending)) if self.pending else b""

    def resume(self, chunks: Sequence[bytes], pending: bytes, digests: Sequence[str]) -> None:
        """Add what another collector had added since.

        Args:
            chunks: that became full since. pending: `packed_pending` of that time. digests: of the rows that were new.
        Raises:
            ValueError: they do not fit.
        """
        self.chunks += chunks
        for digest in digests:
            self._numbers[digest] = len(self._numbers)
        rest = self.num_distinct - len(self.chunks) * self.rows_in_chunk
        self.pending = [*inflate_rows(pending, (rest, *self.shape), self.dtype)] if rest else []

    def rows(self, index: np.ndarray) -> DistinctRows:
        """Rows (N, ...) of an index (N,) into the distinct ones."""
        chunks = [*self.chunks, *([self.packed_pending()] if self.pending else [])]
        return DistinctRows(index, self.shape, self.dtype, self.num_distinct, self.rows_in_chunk, chunks.__getitem__)


def row_digest(row: np.ndarray) -> str:
    """XXH3-128 of the bytes of a row."""
    return storage.digest_of_bytes(np.ascontiguousarray(row).data.cast("B"))


def blocks(rows: np.ndarray | DistinctRows) -> Iterator[np.ndarray]:
    """Yield parts of an array, or of distinct rows, that together hold all entries but zeros of an end."""
    if isinstance(rows, DistinctRows):
        yield from rows.blocks()
    else:
        yield rows


def stretch(rows: np.ndarray | DistinctRows) -> np.ndarray:
    """(C,) uint8, the largest integer for each channel that keeps images (N, H, W, C) below 256."""
    largest = np.max([block.max(axis=tuple(range(block.ndim - 1))) for block in blocks(rows)], axis=0)
    return (255 // np.maximum(largest, 1)).astype(np.uint8)


def collect_rows(rows: npt.ArrayLike) -> DistinctRows:
    """The rows of an array (N, ...), the distinct ones in the order in which they appear first."""
    array = np.asarray(rows)
    collector = RowCollector(array.shape[1:], array.dtype)
    index = np.fromiter((collector.add(row) for row in array), np.int64, len(array))
    return collector.rows(index)


def shorten_rows(rows: DistinctRows, count: int) -> DistinctRows:
    """The same rows, if only the first `count` distinct ones occur in them, with chunks of these alone."""
    full, rest = divmod(count, rows.rows_in_chunk)
    last = [deflate_rows(rows.distinct(np.arange(full * rows.rows_in_chunk, count)))] if rest else []
    chunks = [*map(rows.chunk, range(full)), *last]
    return DistinctRows(rows.index, rows.shape[1:], rows.dtype, count, rows.rows_in_chunk, chunks.__getitem__)


def deflate_rows(rows: np.ndarray) -> bytes:
    """A chunk of rows (M, ...)."""
    flat = np.ascontiguousarray(rows).reshape(len(rows), -1).view(np.uint8)
    differences = flat.copy()
    differences[1:] ^= flat[0]
    return zlib.compress(differences.tobytes(), COMPRESSION_LEVEL)


def inflate_rows(chunk: bytes, shape: Sequence[int], dtype: np.dtype) -> np.ndarray:
    """The rows of a chunk.

    Raises:
        ValueError: it does not hold exactly these.
    """
    size = math.prod(shape) * dtype.itemsize
    machine = zlib.decompressobj()
    try:
        data = machine.decompress(chunk, size + 1)
    except zlib.error as error:
        raise ValueError(f"a chunk of rows cannot be read: {error}") from None
    if len(data) != size or not machine.eof:
        raise ValueError(f"a chunk of rows has {len(data)} bytes or more; expected {size}")
    flat = np.frombuffer(bytearray(data), np.uint8).reshape(shape[0], -1)
    flat[1:] ^= flat[0]
    return flat.view(dtype).reshape(tuple(shape))
