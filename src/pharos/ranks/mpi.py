"""Ranks that `mpiexec` has started (extra `mpi`: mpi4py), and how one program runs on all of them."""

import importlib.util
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

import numpy as np

from pharos.errors import MissingExtra, ParameterError
from pharos.ranks.rank import NUMBERS, Alone, Rank, error_of, text_of

# (rank, size) as launchers tell their processes: MPICH's and Intel's, Open MPI's, MVAPICH's.
_LAUNCHERS = (
    ("PMI_RANK", "PMI_SIZE"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
    ("MV2_COMM_WORLD_RANK", "MV2_COMM_WORLD_SIZE"),
)
_FAILED = -1
_VALUES, _NOTICE = 0, 1  # tags of messages
_LOOKS = 100  # at messages that have not come before others get the processor
_STARTED = "PHAROS_STARTED"  # variable of processes that pharos itself has started under mpiexec

T = TypeVar("T")


def check_processes(processes: int | str) -> None:
    """ParameterError unless it is 1, or "mpi"."""
    if processes != "mpi" and (processes != 1 or isinstance(processes, bool)):
        raise ParameterError(
            f"processes is {processes!r}; expected 1, or 'mpi' in a program that `mpiexec -n 8 python PROGRAM` starts; "
            "`pharos build` and `pharos solve` take --processes 8"
        )


def check_ranks(num_states: int, ranks: int) -> None:
    """Raise ParameterError where there are more ranks than states."""
    if ranks > max(num_states, 1):
        raise ParameterError(f"{ranks} processes for {num_states} states; expected at most one for each state")


def run_spmd(processes: int | str, program: Callable[[Rank], T]) -> T:
    """Return what `program(rank)` returns at this rank, while the others run it, too.

    Args:
        processes: 1 for this process alone; or "mpi", those that `mpiexec` has started, all of which make this call.
    Raises:
        Whatever the program raises on any of them.
    """
    check_processes(processes)
    rank = mpi_rank() if processes == "mpi" else Alone()
    try:
        return program(rank)
    except BaseException as error:
        rank.fail(error)
        raise


def start_under_mpiexec(size: int) -> NoReturn:
    """Replace this process by `mpiexec`, which starts the same program `size` times.

    Raises:
        MissingExtra: there is no mpi4py, or no `mpiexec` beside this Python or in PATH. ParameterError: this process
        has been started so already, and does not know its number.
    """
    beside = os.path.dirname(sys.executable)
    launcher = shutil.which("mpiexec", path=beside) or shutil.which("mpiexec")
    if launcher is None or importlib.util.find_spec("mpi4py") is None:
        raise MissingExtra(f"--processes {size}", "mpi4py and an MPI library with mpiexec", "mpi")
    if _STARTED in os.environ:
        raise ParameterError(
            f"{launcher}: tells processes neither their number nor how many there are; "
            f"write mpiexec -n {size} pharos ..., with --processes mpi"
        )
    os.environ[_STARTED] = str(size)
    os.execv(launcher, [launcher, "-n", str(size), sys.executable, *sys.orig_argv[1:]])


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
        raise MissingExtra("running under mpiexec", "mpi4py and an MPI library", "mpi") from None
    except RuntimeError as error:  # mpi4py is there, and no library
        reason = str(error).partition("\n")[0]
        raise ParameterError(
            f"mpi4py: {reason}; expected an MPI library: pip install mpich, or the cluster's"
        ) from None
    return _Mpi(MPI)


class _Mpi(Rank):
    needs_progress = True

    def __init__(self, library: Any):
        self._library = library
        self._world = library.COMM_WORLD.Dup()
        self.rank, self.size = self._world.Get_rank(), self._world.Get_size()
        self.neighbors = self._world.Split_type(library.COMM_TYPE_SHARED).Get_size()
        self._is_over = False  # somebody failed: nobody waits for this rank any more
        self._requests: list[Any] = []
        self._kept: list[np.ndarray] = []  # what is on its way
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

    def allgather_numbers(self, *numbers: float) -> np.ndarray:
        self._counts(np.zeros(self.size, np.int64), numbers)
        return self._numbers[:, : len(numbers)]

    def _counts(self, rows: np.ndarray, numbers: Sequence[float] = ()) -> np.ndarray:
        """How many rows each rank sends here. All that ranks do together begins with it, so that all learn who failed.

        numbers: to be told to all; theirs are `_numbers` (P, NUMBERS) then.
        """
        received = self._headers(rows, numbers)
        failed = np.flatnonzero(received == _FAILED)
        if len(failed):
            self._is_over = True
            raise error_of(self._world.bcast(None, root=int(failed[0])), int(failed[0]))
        return received

    def _headers(self, rows: np.ndarray, numbers: Sequence[float] = ()) -> np.ndarray:
        sent, received = np.zeros((2, self.size, 1 + NUMBERS), np.int64)
        sent[:, 0] = rows
        sent[:, 1 : 1 + len(numbers)] = np.array(numbers, np.float64).view(np.int64)
        self._world.Alltoall(sent, received)
        self._numbers = received[:, 1:].copy().view(np.float64)
        return received[:, 0].copy()

    def send(self, to: int, array: np.ndarray) -> None:
        self._kept.append(np.ascontiguousarray(array))
        self._requests.append(self._world.Isend(self._kept[-1], to, _VALUES))

    def receive(self, source: int, into: np.ndarray) -> None:
        self._kept.append(into)
        self._requests.append(self._world.Irecv(into, source, _VALUES))

    def progress(self) -> None:
        self._library.Request.Testall(self._requests)

    def finish(self) -> None:
        looks = 0
        while not self._library.Request.Testall(self._requests):
            looks += 1
            if looks % _LOOKS == 0:
                time.sleep(0)
                if self._world.Iprobe(self._library.ANY_SOURCE, _NOTICE):
                    self._counts(np.zeros(self.size, np.int64))  # raises: who failed comes to it, and so do the others
        self._requests.clear()
        self._kept.clear()

    def fail(self, error: BaseException) -> None:
        if self._is_over:
            return
        self._is_over = True
        for rank in range(self.size):  # those who wait for a message of this one
            if rank != self.rank:
                self._requests.append(self._world.Isend(np.zeros(0), rank, _NOTICE))
        received = self._headers(np.full(self.size, _FAILED))
        first = min([*np.flatnonzero(received == _FAILED), self.rank])
        self._world.bcast(text_of(error) if first == self.rank else None, root=first)
