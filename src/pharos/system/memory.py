"""Memory that this process may still take, and arrays for which it may be too small.

Large arrays lie in reserved address space: memory is taken as they are written, in huge pages, and never copied to
grow. Those that may be larger than memory are mapped files, of which the system keeps in memory what is used.

Kept arrays are files of NumPy (.npy), mapped while they are worked on: they need no memory of their own, and outlive
the process. They are for results that stay valid when an interruption leaves them half updated: values that are swept,
bounds that are tightened. Nobody else may write into such a file meanwhile: it is locked as long as its array is in
use.
"""

import contextlib
import errno
import itertools
import math
import mmap
import os
import sys
import tempfile
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from pharos.errors import DiskFull, FileFormatError, FolderLocked, ParameterError
from pharos.system import storage
from pharos.system.arrays import PackedIndices

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

R = TypeVar("R")
LEAST_MEMORY = 1 << 24  # bytes that a build needs
_PROC, _GROUPS = Path("/proc"), Path("/sys/fs/cgroup")


def available_memory() -> int:
    """Free bytes of the machine's memory, or of a control group that this process is in (Slurm, containers) if that
    is less.

    The cache of files counts as free: the system drops it when memory is needed.
    """
    free = 1 << 62
    with contextlib.suppress(OSError, StopIteration, ValueError), open(_PROC / "meminfo") as file:
        free = next(int(line.split()[1]) * 1024 for line in file if line.startswith("MemAvailable"))
    for limit, used, statistics in _groups():
        with contextlib.suppress(OSError, ValueError):  # such as "max", no limit
            left = int(limit.read_text()) - int(used.read_text())
            free = min(free, left + _of_files(statistics))
    return max(free, 0)


def _groups() -> Iterator[tuple[Path, Path, Path]]:
    """(limit, usage, statistics) of the groups of this process and those around them. The root, too, which may be a
    container's.
    """
    with contextlib.suppress(OSError, ValueError):
        for line in (_PROC / "self" / "cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers == "":
                root, names = _GROUPS, ("memory.max", "memory.current")
            elif "memory" in controllers.split(","):
                root, names = _GROUPS / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")
            else:
                continue
            folder = root / path.lstrip("/")
            for group in (folder, *folder.parents):
                if group.is_relative_to(root):
                    yield group / names[0], group / names[1], group / "memory.stat"


def _of_files(statistics: Path) -> int:
    with contextlib.suppress(OSError, ValueError):
        entries = dict(line.split() for line in statistics.read_text().splitlines())
        return sum(int(entries.get(f"total_{name}", entries.get(name, 0))) for name in ("inactive_file", "active_file"))
    return 0


# Large arrays ---------------------------------------------------------------------------------------------------------


# Bytes that are always taken from memory; beyond them, the share of what is free that one array may take.
SMALL_BYTES, MEMORY_SHARE = 1 << 26, 4
# The same of values, all of which are read and written in each sweep.
SHARE_OF_VALUES = 1.5
_BYTES_AT_ONCE = 1 << 24
# Rows of a mapped array that are swept while the next ones are read.
RANGE_ROWS = 1 << 22
# Rows of one that memory has no room for: they are read at a time, into one of two arrays.
PIECE = 1 << 19
# Advice of Linux 5.4 that Python has no name for: these pages may go first.
_COLD = 20


def reserved_states(num_words: int) -> np.ndarray:
    """(rows, W) uint64, zeros."""
    for rows in (1 << 32, 1 << 30, 1 << 28, 1 << 26):
        try:
            return huge_pages(rows * num_words, np.dtype("<u8")).reshape(-1, num_words)
        except (OSError, ValueError):
            continue
    raise MemoryError("no address space for 2^26 states; set a larger ulimit -v")


def reserved_table() -> np.ndarray:
    """(N,) zero bytes of reserved address space, in which the table grows. Empty if there is no address space."""
    for size in (1 << 35, 1 << 33, 1 << 31):
        with contextlib.suppress(OSError, ValueError):
            return huge_pages(size, np.dtype("|u1"))
    return np.empty(0, np.uint8)


def huge_pages(length: int, dtype: np.dtype) -> np.ndarray:
    """An array of zeros in huge pages, if the system has them."""
    if not hasattr(mmap, "MAP_PRIVATE"):
        return np.zeros(min(length, 1 << 28), dtype)
    no_reserve = 0x4000 if sys.platform == "linux" else 0  # MAP_NORESERVE, which Python names from 3.13 on
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | no_reserve
    memory = mmap.mmap(-1, length * dtype.itemsize, flags=flags)
    if hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):
            memory.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(memory, dtype)


def large_zeros(shape: tuple[int, ...], dtype: DTypeLike, share: float = MEMORY_SHARE) -> np.ndarray:
    """An array of zeros: in memory, or, if it would take more than 1 / share of what is free, a mapped file.

    The file is in the cache's folder and has no name: it is gone with the array, whatever becomes of the process.
    Reading and writing in order, or near the last position, costs little more there than in memory.

    Raises:
        DiskFull: the file cannot be written.
    """
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    if fits(size, share):
        return np.zeros(shape, dtype)
    folder = storage.cache_directory()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return np.frombuffer(mapped_file(folder, size), dtype).reshape(shape)
    except OSError as error:
        raise DiskFull(
            f"{folder}: {size / 2**30:.1f} GiB of scratch, which memory has no room for: {error.strerror}; "
            "free room on the disk, or set PHAROS_CACHE_DIR to a folder on another one"
        ) from error


def fits(size: int, share: float = MEMORY_SHARE) -> bool:
    """Whether so many bytes are at most 1 / share of what is free, or few."""
    return size <= SMALL_BYTES or size <= available_memory() / share


def mapped_file(folder: Path, size: int) -> mmap.mmap:
    """A file of zeros without a name, its room on the disk taken: a mapped file that finds the disk full when it is
    written kills the process. OSError if that room is missing.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        append_zeros(file, size)
        return mmap.mmap(file.fileno(), size)


def append_zeros(file: BinaryIO, size: int) -> None:
    """Append so many zero bytes to what was written, their room on the disk taken. OSError if it cannot be."""
    file.flush()
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), file.tell(), size)
    else:
        for start in range(0, size, _BYTES_AT_ONCE):
            file.write(bytes(min(_BYTES_AT_ONCE, size - start)))
        file.flush()


def ranges_from_the_end(rows: object, low: int, high: int, have_room: bool = False) -> Iterator[tuple[int, int]]:
    """Ranges [start, stop) that make up [low, high), the last one first: how rows are swept from the last to the first.

    Rows in memory are one range. Of a mapped array, `RANGE_ROWS` rows are swept while the system reads the rows before
    them: it reads ahead by itself from the first byte to the last, but not the other way round. If the rows fill
    memory, unless these `have_room` in it, those that were swept go before anything else: values, which may be mapped
    as well, are needed all the time.
    """
    rows = rows.packed if isinstance(rows, PackedIndices) else rows
    if not isinstance(rows, np.memmap):
        yield low, high
        return
    fills_memory = not have_room and 2 * rows.nbytes > available_memory()
    for stop in range(high, low, -RANGE_ROWS):
        start = max(stop - RANGE_ROWS, low)
        _advise(rows, max(start - RANGE_ROWS, low), start, getattr(mmap, "MADV_WILLNEED", None))
        yield start, stop
        if fills_memory and sys.platform == "linux":
            _advise(rows, start, stop, _COLD)


def rows_with_room(rows: object, low: int, high: int) -> int:
    """The row below which memory has room for rows [low, high) of an array: `high`, but for mapped files."""
    if sys.platform != "linux" or not isinstance(rows, np.memmap) or not isinstance(_mapping_of(rows), mmap.mmap):
        return high
    room = available_memory() * 3 // 4 // rows.strides[0]
    return high if high - low <= room else min(max(low, low + room - 4 * PIECE), high)


def pieces_from_the_end(rows: R, low: int, high: int, border: int) -> Iterator[tuple[R | np.ndarray, int, int]]:
    """(array, start, stop): ranges that make up [low, high), the last one first, each with an array that has its rows.

    They are the ranges of `ranges_from_the_end` as far as `border`, see `rows_with_room`. Rows from there on are read
    into memory of this process, the next ones while some are swept, and leave nothing in memory of the system: pages of
    files that come and go cost more than sweeps.
    """
    border = room = min(max(low, border), high)
    with contextlib.ExitStack() as stack:
        # Rows from the border on: a thread reads the next piece while the caller works on this one
        try:
            file = stack.enter_context(_UncachedFile(rows)) if border < high else None
        except OSError:  # it has another name now, or none
            file, border = None, high
        if file is not None:
            pool = stack.enter_context(ThreadPoolExecutor(1))
            cuts = [*range(high, border, -PIECE), border]
            coming = pool.submit(file.read, cuts[1], cuts[0], 0)
            for i, (stop, start) in enumerate(itertools.pairwise(cuts)):
                array = coming.result()
                if start > border:
                    coming = pool.submit(file.read, cuts[i + 2], start, (i + 1) % 2)
                yield array, start, stop
    # Rows below the border: the mapped array itself
    for start, stop in ranges_from_the_end(rows, low, border, have_room=border == room):
        yield rows, start, stop


class _UncachedFile:
    """The file of a mapped array, read past the memory of the system if that is possible."""

    def __init__(self, rows: object):
        assert isinstance(rows, np.memmap), "arrays in memory have room"
        self._rows, self._row = rows, rows.strides[0]
        mapping = _mapping_of(rows)
        assert mapping is not None
        begin = rows.offset // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY  # of the mapping, in the file
        self._offset = begin + rows.ctypes.data - np.frombuffer(mapping, np.uint8).ctypes.data
        path = str(rows.filename)
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_DIRECT)
        except OSError:  # such as a file system in memory
            self._file = os.open(path, os.O_RDONLY)
        size = PIECE * self._row + 2 * mmap.PAGESIZE
        self._memory = [huge_pages(size, np.dtype(np.uint8)) for _ in range(2)]

    def __enter__(self) -> "_UncachedFile":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def read(self, start: int, stop: int, which: int) -> np.ndarray:
        """An array of the shape of the mapped one that has the rows [start, stop), and nothing around them."""
        memory, first = self._memory[which], self._offset + start * self._row
        begin = first // mmap.PAGESIZE * mmap.PAGESIZE
        wanted, done = first + (stop - start) * self._row - begin, 0
        while done < wanted:
            left = -(-(wanted - done) // mmap.PAGESIZE) * mmap.PAGESIZE
            count = os.preadv(self._file, [memory[done : done + left].data], begin + done)
            if count == 0:
                raise OSError(errno.EIO, "the file became shorter", str(self._rows.filename))
            done += count
        os.posix_fadvise(self._file, begin, wanted, os.POSIX_FADV_DONTNEED)
        address = memory.ctypes.data + first - begin - start * self._row
        return np.asarray(_Rows(self._rows, memory, address))


class _Rows:
    """Array interface of an array that begins before its memory: only the rows that lie in it may be read."""

    def __init__(self, like: np.memmap, memory: np.ndarray, address: int):
        self._memory = memory
        self.__array_interface__ = {**like.__array_interface__, "data": (address, True)}


def _mapping_of(array: np.memmap) -> mmap.mmap | None:
    return getattr(array, "_mmap", None)


def _advise(array: np.memmap, start: int, stop: int, advice: int | None) -> None:
    """`madvise` on some rows of a mapped array: needed soon, so that the system reads them meanwhile, or not needed."""
    mapping = _mapping_of(array)
    if start < stop and isinstance(mapping, mmap.mmap) and advice is not None:
        row = array.strides[0]
        first = start * row // mmap.PAGESIZE * mmap.PAGESIZE
        with contextlib.suppress(OSError, ValueError):
            mapping.madvise(advice, first, stop * row - first)


# Kept arrays ----------------------------------------------------------------------------------------------------------


def kept_array(path: str | os.PathLike, shape: tuple[int, ...], dtype: DTypeLike, what: str = "values") -> np.ndarray:
    """The array of a file, mapped: its contents, or zeros in a new file.

    Args:
        what: it holds, for errors.
    Raises:
        FileFormatError: the file holds something else. FolderLocked: it is in use. ParameterError: it cannot be made.
    """
    path, dtype = Path(path), np.dtype(dtype)
    try:
        if not path.exists():
            _make(path, shape, dtype)
        storage.check_regular(path)
        with open(path, "r+b") as file, _locked(path, file, what) as claim:
            offset = _checked_offset(path, file, shape, dtype, what)
            mapping = mmap.mmap(file.fileno(), 0)  # it holds the lock, too
            weakref.finalize(mapping, claim.pop_all().close)
    except OSError as error:
        raise ParameterError(f"{path}: cannot be used for {what}: {error.strerror}; choose another file") from error
    return np.frombuffer(mapping, dtype, offset=offset).reshape(shape)


def _make(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> None:
    """Write a file of zeros, its room on the disk taken: a full disk would kill the process later."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with storage.replacing(path, durable=False, follow=True) as file:
        np.lib.format.write_array_header_1_0(file, {"descr": dtype.str, "fortran_order": False, "shape": shape})
        append_zeros(file, dtype.itemsize * int(np.prod(shape, dtype=np.int64)))


@contextlib.contextmanager
def _locked(path: Path, file: BinaryIO, what: str) -> Iterator[contextlib.ExitStack]:
    """Lock the file, by a claim beside it if the file system has no locks (`storage.lock`). Yield that claim."""
    with contextlib.ExitStack() as claim:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderLocked(f"{path}: its {what} are in use; choose another file, or wait") from error
        except OSError as error:
            if not storage.has_no_locks(error):
                raise
            claim.enter_context(storage.hold_claim(path.with_name(f"{path.name}.claim"), FolderLocked, f"using {what}"))
        yield claim


def _checked_offset(path: Path, file: BinaryIO, shape: tuple[int, ...], dtype: np.dtype, what: str) -> int:
    """The byte of the file at which the array begins. FileFormatError if the file holds something else."""
    try:
        np.lib.format.read_magic(file)
        file_shape, is_fortran, file_dtype = np.lib.format.read_array_header_1_0(file)
    except Exception as error:  # the header is read as Python
        raise FileFormatError(f"{path}: is no file of {what}; choose another name, or delete it") from error
    offset = file.tell()
    whole = offset + dtype.itemsize * int(np.prod(shape, dtype=np.int64)) == os.path.getsize(path)
    if file_shape != shape or file_dtype != dtype or is_fortran or not whole:
        raise FileFormatError(
            f"{path}: holds {file_dtype} of shape {file_shape}; expected {dtype} of shape {shape}, the {what} of this "
            "MDP: choose another name, or delete it"
        )
    return offset
