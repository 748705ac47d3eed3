"""Values so far, in a file, so that who is killed while solving with several processes goes on from there."""

import contextlib
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.system import storage

if TYPE_CHECKING:
    from pharos.solvers.ranked import RankedBackup

SECONDS = 60.0
_SHARE = 20  # of the time of solving, at most one part in so many is spent on writing
_HEADER = 5  # float64: sweeps, two numbers, rows, columns
_DIGEST = 32  # characters of a digest; two follow, of the header and of the values


class Checkpoint:
    """Where ranks keep their values; the first one reads and writes.

    A file holds what one question has come to: its name is a digest of the MDP, of what is chosen and of the rest. It
    does not depend on the number of ranks, and is removed once the question is answered.

    Attributes:
        numbers: what `keep` was given beside the values.
    """

    def __init__(self, folder: Path | None, what: str, seconds: float = SECONDS):
        """
        folder: None to keep nothing. what: the question, but for the MDP and what is chosen.
        """
        self._folder, self._what, self._seconds = folder, what, seconds
        self._next = time.monotonic() + seconds
        self._path: Path | None = None
        self.numbers = (0.0, 0.0)

    def start(self, backup: "RankedBackup") -> int:
        """Set the values to those of the file, where there is one. Returns the sweeps that they took."""
        if self._folder is None:
            return 0
        name = storage.digest_of_json([self._what, backup.mdp.num_states, backup.mdp.width, backup.fingerprint()])
        self._path = self._folder / f"{name}.values"
        header, whole = np.zeros(_HEADER), None
        if backup.rank.rank == 0:
            header, whole = self._read((backup.mdp.num_states + 1, backup.x.shape[1]))
        header = backup.rank.broadcast(header if backup.rank.rank == 0 else None, header)
        if header[0] > 0:
            backup.scatter(whole)
            self.numbers = float(header[1]), float(header[2])
        self._next = time.monotonic() + self._seconds
        return int(header[0])

    def is_due(self, backup: "RankedBackup") -> bool:
        """Whether the first rank finds that it is time to write."""
        return backup.rank.rank == 0 and self._folder is not None and time.monotonic() > self._next

    def keep(self, backup: "RankedBackup", sweeps: int, numbers: tuple[float, float] = (0.0, 0.0)) -> None:
        """Write the values of all ranks."""
        began = time.monotonic()
        whole = backup.gathered(backup.x)
        if whole is not None and self._path is not None:
            header = np.array([sweeps, *numbers, *whole.shape], np.float64).tobytes()
            values = np.ascontiguousarray(whole).data.cast("B")
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                with storage.replacing(self._path) as file:
                    file.write(header + (storage.digest_of_bytes(header) + storage.digest_of_bytes(values)).encode())
                    file.write(values)
            except OSError as error:
                self._folder = None  # which is as if nothing were due; the last file stays
                warnings.warn(
                    f"{self._path}: {error.strerror or error}; values are not kept any more, solving goes on",
                    stacklevel=2,
                )
        now = time.monotonic()
        self._next = now + max(self._seconds, _SHARE * (now - began))

    def finish(self, backup: "RankedBackup") -> None:
        """The question is answered."""
        if backup.rank.rank == 0 and self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)

    def _read(self, shape: tuple[int, int]) -> tuple[np.ndarray, Any]:
        """(header, values) of the file; zeros and None where there is none, or not a whole one."""
        nothing = np.zeros(_HEADER), None
        assert self._path is not None
        try:
            with open(self._path, "rb") as file:
                data, digests = file.read(8 * _HEADER), file.read(2 * _DIGEST).decode(errors="replace")
            begin = 8 * _HEADER + 2 * _DIGEST
            if digests[:_DIGEST] != storage.digest_of_bytes(data):
                return nothing
            header = np.frombuffer(data)
            if tuple(header[3:5]) != shape or self._path.stat().st_size != begin + 8 * shape[0] * shape[1]:
                return nothing
            whole = np.memmap(self._path, np.float64, "r", begin, shape)
        except OSError:
            return nothing
        is_whole = storage.digest_of_bytes(whole.data.cast("B")) == digests[_DIGEST:]
        return (header.copy(), whole) if is_whole else nothing
