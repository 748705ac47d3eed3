"""Arrays in files of NumPy (.npy), mapped while they are worked on: they need no memory of their own, and outlive the
process.

They are for what may be left in the middle and is as good as ever: values that are swept, bounds that are tightened.
Nobody else may write into such a file meanwhile: it is locked as long as its array is in use.
"""

import contextlib
import mmap
import os
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import DTypeLike

from pharos.errors import FileFormatError, FolderLocked, ParameterError
from pharos.system import storage
from pharos.system.large_arrays import append_zeros

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def kept_array(path: str | os.PathLike, shape: tuple[int, ...], dtype: DTypeLike, what: str = "values") -> np.ndarray:
    """The array of a file: what is there, or zeros in a new one.

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
    """A file of zeros, its room on the disk taken: a full disk would kill the process later."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with storage.replacing(path, durable=False) as file:
        np.lib.format.write_array_header_1_0(file, {"descr": dtype.str, "fortran_order": False, "shape": shape})
        append_zeros(file, dtype.itemsize * int(np.prod(shape, dtype=np.int64)))


@contextlib.contextmanager
def _locked(path: Path, file: BinaryIO, what: str) -> Iterator[contextlib.ExitStack]:
    """The file held, by a claim beside it where the file system has no locks (`storage.lock`); what gives that back."""
    with contextlib.ExitStack() as claim:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderLocked(f"{path}: its {what} are in use; choose another file, or wait") from error
        except OSError as error:
            if not storage.has_no_locks(error):
                raise
            claim.enter_context(storage.claim(path.with_name(f"{path.name}.claim"), FolderLocked, f"using {what}"))
        yield claim


def _checked_offset(path: Path, file: BinaryIO, shape: tuple[int, ...], dtype: np.dtype, what: str) -> int:
    """Where the array begins."""
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
