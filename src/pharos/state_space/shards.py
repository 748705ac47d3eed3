"""Shards: the files of a finished state space as byte ranges on several disks, and read as the one array that they are.

A shard is a folder with a range of each file, under the file's own name, and `shard.json`: which build it is of, and
its number. Borders are multiples of 1 MiB, so that ranges can be mapped side by side; concatenated they are the files,
byte for byte. The folder of the state space keeps its manifest, and `shards.json`, which says where they are.
"""

import contextlib
import ctypes
import mmap
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pharos.errors import ParameterError, StateSpaceCorrupted, StateSpaceError, StateSpaceMismatch
from pharos.state_space.files import cannot_write
from pharos.state_space.manifest import check_lengths
from pharos.system import storage

SHARDS, SHARD = "shards.json", "shard.json"
BORDER = 1 << 20  # a multiple of the pages of all machines
_COPIED = 1 << 24
_FIXED, _SHARED, _READ = 0x10, 0x01, 0x01  # MAP_FIXED, MAP_SHARED, PROT_READ


class Range(NamedTuple):
    """Bytes [start, stop) of a file of a state space, and the file that holds them."""

    path: Path
    start: int
    stop: int


def borders_of(size: int, shards: int) -> list[int]:
    """(shards + 1,) where the ranges of a file of `size` bytes begin and end."""
    return [size * k // shards // BORDER * BORDER for k in range(shards)] + [size]


# Reading --------------------------------------------------------------------------------------------------------------


def ranges_of(folder: Path, manifest: dict[str, Any], name: str) -> list[Range]:
    """Where the bytes of a file are: in the folder, or in its shards, in order.

    Raises:
        StateSpaceError: a shard is missing. StateSpaceMismatch: one is of another build. StateSpaceCorrupted: the list
        of shards, or one of them, is not what was written.
    """
    size = manifest["arrays"][name]["bytes"]
    folders = shard_folders(folder)
    if not folders or (folder / name).exists():
        return [Range(folder / name, 0, size)]
    borders = borders_of(size, len(folders))
    for number, shard in enumerate(folders):
        _check_shard(folder, manifest, shard, number, len(folders))
    ranges = [Range(each / name, borders[k], borders[k + 1]) for k, each in enumerate(folders)]
    return [each for each in ranges if each.start < each.stop] or ranges[:1]


def check_files(folder: Path, manifest: dict[str, Any]) -> None:
    """StateSpaceCorrupted where a file is missing, or shorter than what was committed; of shards see `ranges_of`."""
    if not shard_folders(folder):
        return check_lengths(folder, manifest)
    for name in manifest["arrays"]:
        ranges_of(folder, manifest, name)


def shard_folders(folder: Path) -> list[Path]:
    """The folders of the shards of a state space, in order; none where its files are in its own folder."""
    path = folder / SHARDS
    if not path.exists():
        return []
    record = storage.read_json(path, StateSpaceCorrupted)
    folders = record.get("folders") if isinstance(record, dict) else None
    if not isinstance(folders, list) or not folders or not all(isinstance(each, str) for each in folders):
        raise StateSpaceCorrupted(f"{path}: expected a list of folders under `folders`")
    return [folder / each for each in folders]


def _check_shard(folder: Path, manifest: dict[str, Any], shard: Path, number: int, count: int) -> None:
    which = f"{shard}: shard {number} of {count} of {folder}"
    if not (shard / SHARD).exists():
        raise StateSpaceError(
            f"{which} is missing (no {SHARD}); mount its disk, or write where it is into {folder / SHARDS}"
        )
    record = storage.read_json(shard / SHARD, StateSpaceCorrupted)
    digest = record.get("digest") if isinstance(record, dict) else None
    if digest != manifest["digest"]:
        raise StateSpaceMismatch(
            f"{which} is of another build: its digest is {str(digest)[:16]}, expected {manifest['digest'][:16]}; "
            f"mount the right disk, or choose another folder"
        )
    if (record.get("number"), record.get("count")) != (number, count):
        raise StateSpaceMismatch(
            f"{which} is shard {record.get('number')} of {record.get('count')} in its own words; "
            f"expected shards in their order in {folder / SHARDS}"
        )
    wrong = [name for name, size in _sizes(manifest, number, count).items() if _length(shard / name) != size]
    if wrong:
        raise StateSpaceCorrupted(
            f"{which}: {wrong[0]} has {_length(shard / wrong[0])} bytes; "
            f"expected {_sizes(manifest, number, count)[wrong[0]]}: it was truncated or replaced"
        )


def _sizes(manifest: dict[str, Any], number: int, count: int) -> dict[str, int]:
    """The bytes of each file that a shard holds."""
    borders = {name: borders_of(entry["bytes"], count) for name, entry in manifest["arrays"].items()}
    return {name: each[number + 1] - each[number] for name, each in borders.items()}


def _length(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def mapped(ranges: Sequence[Range], dtype: str | np.dtype) -> np.ndarray:
    """(N,) read-only: the numbers in ranges of bytes, mapped one behind the other.

    Raises:
        ParameterError: there are several, and this system cannot map them so.
    """
    if len(ranges) == 1:
        return np.memmap(ranges[0].path, dtype, "r")
    if sys.platform not in ("linux", "darwin"):
        raise ParameterError(
            f"{ranges[0].path}: shards are read on Linux and macOS; put the files together: cat shard-*/NAME > NAME"
        )
    size = ranges[-1].stop
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=mmap.PROT_READ)
    whole = np.frombuffer(memory, np.uint8)
    library = ctypes.CDLL(None, use_errno=True)
    library.mmap.restype = ctypes.c_void_p
    library.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_longlong]
    for each in ranges:  # in the place of what was reserved; all of it goes when `memory` goes
        with open(each.path, "rb") as file:
            place = whole.ctypes.data + each.start
            at = library.mmap(place, each.stop - each.start, _READ, _SHARED | _FIXED, file.fileno(), 0)
            if at != place:
                error = ctypes.get_errno()
                raise OSError(error, os.strerror(error), str(each.path))
    return whole.view(dtype)


def blocks_of_ranges(ranges: Sequence[Range], size: int) -> Iterator[bytes]:
    """The bytes of ranges in blocks of `size`, which may begin in one and end in another."""
    left = bytearray()
    for each in ranges:
        with open(each.path, "rb") as file:
            while data := file.read(size - len(left)):
                left += data
                if len(left) == size:
                    yield bytes(left)
                    left.clear()
    if left:
        yield bytes(left)


# Writing --------------------------------------------------------------------------------------------------------------


def shard(folder: Path, manifest: dict[str, Any], folders: Sequence[Path]) -> None:
    """Move the files of a finished state space into shards; one that was killed goes on, and nothing is lost meanwhile.

    Files go once all shards are on their disks.

    Raises:
        ParameterError: a folder cannot be used. DiskFull: that of a shard has no room.
    """
    chosen = [Path(os.path.abspath(each)) for each in folders]
    if len(set(chosen)) < len(chosen) or Path(os.path.abspath(folder)) in chosen:
        raise ParameterError("shards: a folder is given twice, or is that of the state space; expected one for each")
    there = [Path(os.path.abspath(each)) for each in shard_folders(folder)]
    if there and there != chosen:
        raise ParameterError(
            f"{folder}: is in shards already: {', '.join(map(str, there))}; expected these, or none; "
            f"cat their files in this order into {folder} and delete {SHARDS} to have it in one folder"
        )
    if not there:
        for number, target in enumerate(chosen):
            _write_shard(folder, manifest, target, number, len(chosen))
        storage.replace_json(folder / SHARDS, {"format": "pharos shards", "folders": [str(each) for each in chosen]})
    for name in manifest["arrays"]:
        (folder / name).unlink(missing_ok=True)


def _write_shard(folder: Path, manifest: dict[str, Any], target: Path, number: int, count: int) -> None:
    if (target / SHARD).exists():
        with contextlib.suppress(StateSpaceCorrupted):
            return _check_shard(folder, manifest, target, number, count)
    elif target.is_dir() and any(each.name not in manifest["arrays"] for each in target.iterdir()):
        raise ParameterError(f"{target}: is not empty and holds no shard; choose another folder")
    name = ""
    try:
        target.mkdir(parents=True, exist_ok=True)
        for name, entry in manifest["arrays"].items():
            borders = borders_of(entry["bytes"], count)
            with open(folder / name, "rb") as source, open(target / name, "wb", buffering=0) as file:
                source.seek(borders[number])
                left = borders[number + 1] - borders[number]
                while left:
                    data = memoryview(source.read(min(left, _COPIED)))
                    left -= len(data)
                    while data:
                        data = data[file.write(data) :]
                os.fsync(file.fileno())
        record = {"format": "pharos shard", "digest": manifest["digest"], "number": number, "count": count}
        storage.replace_json(target / SHARD, {**record, "environment": manifest["environment"]})
    except OSError as error:
        if not target.is_dir():
            raise ParameterError(f"{target}: cannot be made a folder: {error.strerror}; choose another one") from error
        raise cannot_write(target / name, error) from error
