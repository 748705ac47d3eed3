"""Ranks that `mpiexec` has started (extra `mpi`: mpi4py)."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from pharos.errors import MissingExtra, ParameterError
from pharos.ranks.rank import Rank, error_of, text_of

# (rank, size) as launchers tell their processes: MPICH's and Intel's, Open MPI's, MVAPICH's.
_LAUNCHERS = (
    ("PMI_RANK", "PMI_SIZE"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
    ("MV2_COMM_WORLD_RANK", "MV2_COMM_WORLD_SIZE"),
)
_FAILED = -1


def launched() -> tuple[int, int]:
    """(rank, size) of this process among those that a launcher has started; (0, 1) where none has. Nothing of MPI is
    loaded.
    """
    for rank, size in _LAUNCHERS:
        if os.environ.get(rank, "").isdigit() and os.environ.get(size, "").isdigit():
            return int(os.environ[rank]), int(os.environ[size])
    return 0, 1


def mpi_rank() -> Rank:
    """This process among those that the launcher started.

    Raises:
        MissingExtra: mpi4py is not installed. ParameterError: there is no MPI library, or another one.
    """
    try:
        from mpi4py import MPI
    except ImportError:
        raise MissingExtra("building under mpiexec", "mpi4py and an MPI library", "mpi") from None
    except RuntimeError as error:  # mpi4py is there, and no library
        reason = str(error).partition("\n")[0]
        raise ParameterError(
            f"mpi4py: {reason}; expected an MPI library: pip install mpich, or the cluster's"
        ) from None
    return _Mpi(MPI)


class _Mpi(Rank):
    def __init__(self, library: Any):
        self._library = library
        self._world = library.COMM_WORLD.Dup()
        self.rank, self.size = self._world.Get_rank(), self._world.Get_size()
        self.neighbors = self._world.Split_type(library.COMM_TYPE_SHARED).Get_size()
        self._is_over = False  # somebody failed: nobody waits for this rank any more
        size = launched()[1]
        if size > 1 and size != self.size:
            raise ParameterError(
                f"mpiexec started {size} processes, and mpi4py sees {self.size}: it was built for another MPI "
                f"library; expected mpi4py beside the library whose mpiexec is used"
            )

    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        rows = np.array([len(part) for part in parts], np.int64)
        received = self._counts(rows)
        width = int(np.prod(parts[0].shape[1:], dtype=np.int64))
        sent = np.concatenate([np.ascontiguousarray(part) for part in parts])
        into = np.empty((int(received.sum()), *parts[0].shape[1:]), sent.dtype)
        self._world.Alltoallv([sent, rows * width], [into, received * width])
        return np.split(into, np.cumsum(received)[:-1])

    def _counts(self, rows: np.ndarray) -> np.ndarray:
        """How many rows each rank sends here."""
        received = np.empty(self.size, np.int64)
        self._world.Alltoall(rows, received)
        failed = np.flatnonzero(received == _FAILED)
        if len(failed):
            self._is_over = True
            raise error_of(self._world.bcast(None, root=int(failed[0])), int(failed[0]))
        return received

    def fail(self, error: BaseException) -> None:
        if self._is_over:
            return
        self._is_over = True
        received = np.empty(self.size, np.int64)
        self._world.Alltoall(np.full(self.size, _FAILED, np.int64), received)
        first = min([*np.flatnonzero(received == _FAILED), self.rank])
        self._world.bcast(text_of(error) if first == self.rank else None, root=first)
