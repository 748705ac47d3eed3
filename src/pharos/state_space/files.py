"""Files that grow by appending, with a checksum for every block; room on the disk; one builder at a time."""

import contextlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from pharos.errors import DiskFull, StateSpaceCorrupted, StateSpaceLocked
from pharos.state_space.manifest import AGAIN, CHECKSUM_BYTES, MANIFEST, digest_of
from pharos.system import storage

# Appended bytes that are sent on to the disk together, while the search goes on.
SENT_BYTES = 1 << 20


class GrowingFile:
    """A file that is appended to, its length, and one checksum for every CHECKSUM_BYTES of it."""

    def __init__(self, path: Path, committed: dict[str, Any] | None = None):
        self.path = path
        self.bytes = 0
        self.checksums: list[str] = []
        self._partial = xxhash.xxh3_128()
        self._partial_bytes = 0
        self._failure: DiskFull | None = None
        self._unsynced: DiskFull | None = None
        self._sent = 0  # bytes that the system was asked to write out
        try:
            self._file = open(path, "r+b" if committed else "w+b", buffering=0)  # noqa: SIM115
        except OSError as error:
            raise cannot_write(path, error) from error
        if committed:
            try:
                self._take_over(committed)
            except BaseException:
                self.close()
                raise

    def _take_over(self, committed: dict[str, Any]) -> None:
        """Cut what was written after the last checkpoint; verify what was committed."""
        self._file.truncate(committed["bytes"])
        self._file.seek(0)
        while block := self._file.read(CHECKSUM_BYTES):
            self._note(memoryview(block))
        self._sent = self.bytes
        if self.entry()["checksums"] != committed["checksums"] or self.bytes != committed["bytes"]:
            raise StateSpaceCorrupted(
                f"{self.path}: does not match the checksums of its last checkpoint: it was changed; {AGAIN}"
            )

    def append(self, rows: np.ndarray) -> None:
        """Append the bytes of an array; DiskFull where the disk has no room, and ever after: a file has no gaps."""
        if self._failure:
            raise self._failure
        data = np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data
        written = 0
        try:
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            self._failure = cannot_write(self.path, error)
            raise self._failure from error
        self._note(data)
        if self.bytes - self._sent >= SENT_BYTES:
            storage.write_out(self._file.fileno(), self._sent, self.bytes - self._sent)
            self._sent = self.bytes

    def _note(self, data: memoryview) -> None:
        self.bytes += len(data)
        while len(data):
            size = min(len(data), CHECKSUM_BYTES - self._partial_bytes)
            self._partial.update(data[:size])
            self._partial_bytes += size
            data = data[size:]
            if self._partial_bytes == CHECKSUM_BYTES:
                self.checksums.append(self._partial.hexdigest())
                self._partial, self._partial_bytes = xxhash.xxh3_128(), 0

    def entry(self) -> dict[str, Any]:
        """What the manifest says of the file."""
        partial = [self._partial.hexdigest()] if self._partial_bytes else []
        return {"bytes": self.bytes, "checksums": self.checksums + partial}

    def sync(self) -> None:
        """Wait until everything appended is on the disk; a second try after a failure would not tell the truth."""
        if self._unsynced:
            raise self._unsynced
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            self._unsynced = cannot_write(self.path, error)
            raise self._unsynced from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def cannot_write(path: Path, error: OSError) -> DiskFull:
    """The error for a write that failed."""
    free = shutil.disk_usage(path.parent).free
    return DiskFull(
        f"{path}: cannot write ({error.strerror}; {free / 2**20:.0f} MiB free); what was committed is kept: "
        f"free room on the disk, or build in another folder, and the same command resumes"
    )


def lock(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Hold the folder for this process; StateSpaceLocked where another one builds there. See `storage.lock`."""
    return storage.lock(folder, StateSpaceLocked, "building")


def write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Replace the manifest in one step: it is the commit point of everything else in the folder."""
    manifest = {**manifest, "digest": digest_of(json.loads(json.dumps(manifest)))}
    path = folder / MANIFEST
    try:
        storage.replace_file(path, json.dumps(manifest, indent=1))
        (folder / (MANIFEST + ".tmp")).unlink(missing_ok=True)  # of an older pharos that was killed
    except OSError as error:
        raise cannot_write(path, error) from error
