"""Shards: the files of a state space as ranges in several folders, which an earlier pharos wrote; they are read on.

The folder of the space has its manifest and `shards.json`, a list of folders. Each of these has a range of every file,
under the file's own name, and `shard.json`: the digest of the manifest, the shard's number and the count. Ranges begin
at multiples of 1 MiB, so that they can be mapped side by side as the one array that they are.
"""

import ctypes
import mmap
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import ParameterError, StateSpaceCorrupted, StateSpaceError, StateSpaceMismatch
from pharos.state_space.manifest import check_lengths
from pharos.system import storage

SHARDS, SHARD = "shards.json", "shard.json"
_FIXED, _SHARED, _READ = 0x10, 0x01, 0x01  # MAP_FIXED, MAP_SHARED, PROT_READ


def check_files(folder: Path, manifest: dict[str, Any]) -> None:
    """StateSpaceCorrupted where a file is missing, or shorter than what was committed; of shards see `parts_of`."""
    if not (folder / SHARDS).exists():
        return check_lengths(folder, manifest)
    for name in manifest["arrays"]:
        parts_of(folder, manifest, name)


def parts_of(folder: Path, manifest: dict[str, Any], name: str) -> list[Path]:
    """The files whose bytes, in this order, are a file of a state space: itself, or its ranges in shards.

    Raises:
        StateSpaceError: a shard is missing. StateSpaceMismatch: one is of another build. StateSpaceCorrupted: the list
        of shards, or a range, is not what was written.
    """
    listed = folder / SHARDS
    if (folder / name).exists() or not listed.exists():
        return [folder / name]
    record = storage.read_json(listed, StateSpaceCorrupted)
    names = record.get("folders") if isinstance(record, dict) else None
    if not isinstance(names, list) or not names or not all(isinstance(each, str) for each in names):
        raise StateSpaceCorrupted(f"{listed}: expected a list of folders under `folders`")
    shards = [folder / each for each in names]
    for number, shard in enumerate(shards):
        which = f"{shard}: shard {number} of {len(shards)} of {folder}"
        if not (shard / SHARD).exists():
            raise StateSpaceError(
                f"{which} is missing (no {SHARD}); mount its disk, or write where it is into {listed}"
            )
        record = storage.read_json(shard / SHARD, StateSpaceCorrupted)
        expected = {"digest": manifest["digest"], "number": number, "count": len(shards)}
        if not isinstance(record, dict) or expected.items() - record.items():
            raise StateSpaceMismatch(f"{which} is another one, or of another build, says its {SHARD}; mount its disk")
    parts = [shard / name for shard in shards]
    sizes = [part.stat().st_size if part.exists() else 0 for part in parts]
    if sum(sizes) != manifest["arrays"][name]["bytes"]:
        raise StateSpaceCorrupted(
            f"{folder}: {name} has {sum(sizes)} bytes in its shards; expected {manifest['arrays'][name]['bytes']}: "
            "one was truncated or replaced"
        )
    return [part for part, size in zip(parts, sizes, strict=True) if size] or [folder / name]


def mapped(parts: Sequence[Path], dtype: str | np.dtype) -> np.ndarray:
    """(N,) read-only: the numbers in files, mapped one behind the other.

    Raises:
        ParameterError: there are several, and this system cannot map them so.
    """
    if len(parts) == 1:
        return np.memmap(parts[0], dtype, "r")
    if sys.platform not in ("linux", "darwin"):
        raise ParameterError(
            f"{parts[0]}: shards are read on Linux and macOS; put the files together: cat shard-*/NAME > NAME"
        )
    sizes = [part.stat().st_size for part in parts]
    memory = mmap.mmap(-1, sum(sizes), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=mmap.PROT_READ)
    whole = np.frombuffer(memory, np.uint8)
    library = ctypes.CDLL(None, use_errno=True)
    library.mmap.restype = ctypes.c_void_p
    library.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_longlong]
    place = whole.ctypes.data
    for part, size in zip(parts, sizes, strict=True):  # in the place of what was reserved; goes when `memory` goes
        with open(part, "rb") as file:
            if library.mmap(place, size, _READ, _SHARED | _FIXED, file.fileno(), 0) != place:
                error = ctypes.get_errno()
                raise OSError(error, os.strerror(error), str(part))
        place += size
    return whole.view(dtype)


def blocks_of(parts: Sequence[Path], size: int) -> Iterator[bytes]:
    """The bytes of files in blocks of `size`, which may begin in one and end in another."""
    left = bytearray()
    for part in parts:
        with open(part, "rb") as file:
            while data := file.read(size - len(left)):
                left += data
                if len(left) == size:
                    yield bytes(left)
                    left.clear()
    if left:
        yield bytes(left)
