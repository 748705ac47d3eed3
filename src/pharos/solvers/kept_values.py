"""Values in a file, which is mapped while they are swept: they need no memory of their own, and outlive the process.

What a solve needs of them is nothing: its bound holds from any values on (see fixed_point.py). So a file that was left
in the middle of a sweep is as good as any, and the next solve goes on from there. What must not happen is that somebody
else writes into it meanwhile; the file is locked as long as its values are in use.
"""

import mmap
import os
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pharos import storage
from pharos.errors import FileFormatError, FolderLocked, ParameterError
from pharos.large_arrays import append_zeros

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

# Rows that are read in one go.
_BLOCK = 1 << 22


def kept_values(path: str | os.PathLike, shape: tuple[int, int]) -> np.ndarray:
    """(S + 1, W) float64 mapped from a file of NumPy (.npy): what is there, or zeros in a new one.

    Values that are not finite count as 0, and so does the last row, which is the end.

    Raises:
        FileFormatError: the file holds something else. FolderLocked: its values are in use. ParameterError:
        the file cannot be made.
    """
    path = Path(path)
    try:
        if not path.exists():
            _make(path, shape)
        with open(path, "r+b") as file:
            _lock(path, file)
            offset = _checked_offset(path, file, shape)
            mapping = mmap.mmap(file.fileno(), 0)  # it holds the lock, too
    except OSError as error:
        raise ParameterError(f"{path}: cannot be used for values: {error.strerror}; choose another file") from error
    x = np.frombuffer(mapping, np.float64, offset=offset).reshape(shape)
    for start in range(0, len(x), _BLOCK):
        block = x[start : start + _BLOCK]
        if not np.isfinite(block).all():
            block[~np.isfinite(block)] = 0.0
    x[-1] = 0.0
    return x


def _make(path: Path, shape: tuple[int, int]) -> None:
    """A file of zeros, its room on the disk taken: a full disk would kill the process later."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with storage.replacing(path, durable=False) as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
        append_zeros(file, 8 * shape[0] * shape[1])


def _lock(path: Path, file: BinaryIO) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise FolderLocked(f"{path}: its values are in use; choose another file, or wait") from error


def _checked_offset(path: Path, file: BinaryIO, shape: tuple[int, int]) -> int:
    """Where the values begin."""
    try:
        np.lib.format.read_magic(file)
        file_shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except ValueError as error:
        raise FileFormatError(f"{path}: is no file of values; choose another name, or delete it") from error
    offset = file.tell()
    whole = offset + 8 * shape[0] * shape[1] == os.path.getsize(path)
    if file_shape != shape or dtype != np.dtype("<f8") or is_fortran or not whole:
        raise FileFormatError(
            f"{path}: holds {dtype} of shape {file_shape}; expected float64 of shape {shape}, the values of this MDP: "
            "choose another name, or delete it"
        )
    return offset
