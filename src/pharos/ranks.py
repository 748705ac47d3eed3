"""Several processes that compute one thing together: ranks, and their exchange of arrays.

Rank 0 is the one that the user sees: it alone reads and writes files, reports and raises the errors of all. The others
run a function that answers it. Messages go by MPI (extra `mpi`: mpi4py), among ranks that `mpiexec` has started. Tests
run ranks as threads.

Halos are borders of ranges of rows, one range for each rank: the rows of other ranks that a rank reads. Their values
come in messages from those ranks alone that have some of them. They travel while the ranks compute: the values of the
high rows of a range, all but the lowest eighth, may be sent before the values of the low rows are known.
"""

import ctypes
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

import numpy as np

from pharos import errors
from pharos.errors import MissingExtra, ParameterError, PharosError
from pharos.system import compiling
from pharos.system.workers import check_processes

MOST_NUMBERS = 3  # most numbers that a rank sends to all others with the header of an exchange
_ROWS_AT_ONCE = 1 << 20  # most rows that rank 0 sends to each rank in one exchange


class RankFailed(PharosError):
    """Another rank failed, or died. The message says which one and why."""


class Rank(ABC):
    """One of `size` processes that compute together.

    Attributes:
        rank: its number. size: how many there are. neighbors: how many of them are on this machine.
        needs_progress: whether messages move on only while this process calls `progress`, or waits.
    """

    rank: int
    size: int
    neighbors: int
    needs_progress: bool = False

    @abstractmethod
    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Send parts[q] to each rank q, and return what each of them has sent here, in their order.

        All ranks call it together. All parts have one dtype, and one shape behind the first axis.

        Raises:
            RankFailed: a rank failed or died, in place of answering.
        """

    # Point to point: arrays that move while the ranks compute ---------------------------------------------------------

    @abstractmethod
    def send(self, to: int, array: np.ndarray) -> None:
        """Begin to send an array to a rank, which begins to receive one of this shape and dtype, now or later.

        Nobody changes the array before `finish`. Arrays from one rank to another arrive in
        the order in which they are sent.
        """

    @abstractmethod
    def receive(self, source: int, into: np.ndarray) -> None:
        """Begin to receive an array into `into`, C-contiguous. Its content is undefined until `finish`."""

    def progress(self) -> None:  # noqa: B027
        """Let pending messages move on: to be called now and then while this process computes."""

    @abstractmethod
    def finish(self) -> None:
        """Wait until this rank has received all pending arrays, and may change those that it sent.

        Exchanges may stand before it: after one, the others have begun to send what they began before it.

        Raises:
            RankFailed: a rank failed or died, in place of sending.
        """

    @abstractmethod
    def fail(self, error: BaseException) -> None:
        """Abort: every exchange and message of the other ranks, pending or later, raises."""

    def scatter(self, parts: Sequence[np.ndarray] | None, like: np.ndarray) -> np.ndarray:
        """Send parts[q] from rank 0 to each rank q, and return it there. `like` is an array of that type."""
        return self.exchange(parts or [like[:0]] * self.size)[0]

    def scatter_rows(self, array: np.ndarray | None, cuts: np.ndarray, into: np.ndarray) -> None:
        """Send rank q the rows [cuts[q], cuts[q + 1]) of an array that rank 0 alone has, into its first rows."""
        for first in range(0, int(np.diff(cuts).max()), _ROWS_AT_ONCE):
            parts = None
            if array is not None:
                stops = np.minimum(cuts[:-1] + first + _ROWS_AT_ONCE, cuts[1:])
                parts = [np.array(array[cuts[q] + first : max(stops[q], 0)]) for q in range(self.size)]
            rows = self.scatter(parts, into)
            into[first : first + len(rows)] = rows

    def broadcast(self, array: np.ndarray | None, like: np.ndarray) -> np.ndarray:
        """The array of rank 0, at all ranks."""
        return self.scatter(None if array is None else [array] * self.size, like)

    def gather(self, array: np.ndarray) -> list[np.ndarray]:
        """The arrays of all ranks, in their order, at rank 0, elsewhere empty arrays."""
        return self.exchange([array if rank == 0 else array[:0] for rank in range(self.size)])

    def allgather(self, array: np.ndarray) -> list[np.ndarray]:
        """The arrays of all ranks, in their order, at all of them."""
        return self.exchange([array] * self.size)

    def allgather_numbers(self, *numbers: float) -> np.ndarray:
        """(P, K) float64: a few numbers (at most `MOST_NUMBERS`) of each rank, at all of them."""
        return np.array(self.allgather(np.array(numbers, np.float64)))


class Alone(Rank):
    """The only rank: this process alone."""

    rank, size, neighbors = 0, 1, 1

    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [part.copy() for part in parts]

    def send(self, to: int, array: np.ndarray) -> None:
        raise ValueError("there is no other rank")

    def receive(self, source: int, into: np.ndarray) -> None:
        raise ValueError("there is no other rank")

    def finish(self) -> None:
        """Return at once: there are no messages."""

    def fail(self, error: BaseException) -> None:
        """Do nothing: no other rank waits."""


def text_of(error: BaseException) -> str:
    """Text of an error, to be sent to other ranks, see `error_of`."""
    return f"{type(error).__name__}\n{error}"


def error_of(text: str, rank: int) -> PharosError:
    """The error of another rank, from its text: of the same class if pharos.errors has it, else a RankFailed."""
    name, _, message = text.partition("\n")
    kind = getattr(errors, name, None)
    # those whose first argument is no message cannot be made of one
    if isinstance(kind, type) and issubclass(kind, PharosError) and "__init__" not in vars(kind):
        return kind(message)
    return RankFailed(f"rank {rank}: {f'{name}: {message}'.strip().splitlines()[0]}")


# Halos ----------------------------------------------------------------------------------------------------------------


_LOW_SHARE = 8  # one part in so many of a range is sent last


def cuts_of(num_rows: int, ranks: int) -> np.ndarray:
    """Bounds (P + 1,) int64 of the ranges of P ranks, which share the rows evenly."""
    return np.array([num_rows * i // ranks for i in range(ranks + 1)])


class Halo:
    """The rows outside a rank's range that it reads.

    Attributes:
        rows: (H,) int64, ascending.
        of_rank: for each rank, the slice of `rows` that lies in its range.
        wanted: for each rank, the rows of this one that it reads, int64, counted from the first row of this one.
        low: this rank's rows before that are its low ones, counted from its first. All if nobody reads high ones.
    """

    def __init__(self, rank: Rank, rows: np.ndarray, cuts: np.ndarray):
        """All ranks make theirs together, in one exchange."""
        borders = np.searchsorted(rows, cuts)
        self.rows = rows
        self.of_rank = [slice(borders[q], borders[q + 1]) for q in range(rank.size)]
        self.wanted = rank.exchange([rows[part] - cuts[q] for q, part in enumerate(self.of_rank)])
        self._rank = rank
        lows = np.diff(cuts) // _LOW_SHARE
        self.low = int(lows[rank.rank])
        if not any((rows >= self.low).any() for rows in self.wanted):
            self.low = int(cuts[rank.rank + 1] - cuts[rank.rank])
        self._low_borders = np.searchsorted(rows, cuts[:-1] + lows)  # index of each rank's first high row in `rows`
        self._received: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def is_boundary(self, num_rows: int) -> np.ndarray:
        """Whether some other rank reads each row of this one, (n,) bool."""
        result = np.zeros(num_rows, np.bool_)
        for rows in self.wanted:
            result[rows] = True
        return result

    # While messages travel: receive, then send all or high and low ones, then finish --------------------------------

    def receive(self, like: np.ndarray, in_two: bool = False) -> None:
        """Begin to receive values of the halo, rows like the rows of `like`, in one message from each rank, or in
        two."""
        received = self._received
        if received is None or received.dtype != like.dtype or received.shape[1:] != like.shape[1:]:
            self._received = received = np.empty((len(self), *like.shape[1:]), like.dtype)
        for source, part in enumerate(self.of_rank):
            middle = int(self._low_borders[source])
            for piece in (slice(middle, part.stop), slice(part.start, middle)) if in_two else (part,):
                if piece.stop > piece.start:
                    self._rank.receive(source, received[piece])

    def send(self, values: np.ndarray) -> None:
        """Begin to send the values that others read, from values (n or more, ...) of this rank's rows."""
        self._send(values, 0, len(values))

    def send_high(self, values: np.ndarray) -> None:
        """Begin to send the values of the high rows that others read."""
        self._send(values, self.low, len(values))

    def send_low(self, values: np.ndarray) -> None:
        """Begin to send the values of the low rows that others read, after the high ones."""
        self._send(values, 0, self.low)

    def finish(self, into: np.ndarray) -> None:
        """Wait for the values (H, ...) of the halo, if some are to be received, and write them to `into`."""
        self._rank.finish()
        if self._received is not None:
            into[...] = self._received

    def _send(self, values: np.ndarray, start: int, stop: int) -> None:
        for to, rows in enumerate(self.wanted):
            first, last = np.searchsorted(rows, [start, stop])
            if last > first:
                self._rank.send(to, values[rows[first:last]])


# MPI ------------------------------------------------------------------------------------------------------------------


# Environment variables of (rank, size) set by launchers: MPICH's and Intel's, Open MPI's, MVAPICH's.
_LAUNCHERS = (
    ("PMI_RANK", "PMI_SIZE"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
    ("MV2_COMM_WORLD_RANK", "MV2_COMM_WORLD_SIZE"),
)
_FAILED = -1
_VALUE_TAGS, _NOTICE = 0, 1  # tags of messages
_RANK_LOOKS = 100  # tests of pending messages before other processes get the processor
_BANNER = "=   BAD TERMINATION OF ONE OF YOUR APPLICATION PROCESSES"  # of MPICH, between lines of =
_STARTED = "PHAROS_STARTED"  # variable of processes that pharos itself has started under mpiexec

T = TypeVar("T")


def check_ranks(num_states: int, ranks: int) -> None:
    """Raise a ParameterError if there are more ranks than states."""
    if ranks > max(num_states, 1):
        raise ParameterError(f"{ranks} processes for {num_states} states; expected at most one for each state")


def run_spmd(processes: int | str, program: Callable[[Rank], T]) -> T:
    """The result of `program(rank)` at this rank, while the other ranks run it, too.

    Args:
        processes: 1 for this process alone, or "mpi" for the processes that `mpiexec` has started, all of which make
            this call.
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
    """Start the same program `size` times by `mpiexec`, and end with its exit code and its standard output.

    Raises:
        MissingExtra: there is no mpi4py, or no `mpiexec` beside this Python or in PATH. ParameterError: this process
        has been started so already, and does not know its number. RankFailed: a process that it started was killed.
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
    code, output = _end_of([launcher, "-n", str(size), sys.executable, *sys.orig_argv[1:]])
    text, banner, _ = output.partition(_BANNER)
    sys.stdout.write(re.sub(r"\s*=*\s*$", "", text) if banner else text)
    sys.stdout.flush()
    if banner:
        raise RankFailed(
            f"one of the {size} processes that {launcher} has started was killed (exit code {code}), by a user or for "
            f"want of memory; the same command goes on from what is written"
        )
    sys.exit(code)


def _end_of(command: Sequence[str]) -> tuple[int, str]:
    """(exit code, standard output) of a launcher, which ends with this process. Interrupts are left to its processes.

    MPICH's says on standard output that a process was killed, and in its exit code by which signal.
    """
    process = subprocess.Popen(command, stdout=subprocess.PIPE, preexec_fn=_end_with_parent)
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        signal.signal(signal.SIGINT, lambda *_: None)
        signal.signal(signal.SIGTERM, lambda *_: process.terminate())
        output, _ = process.communicate()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    code = process.returncode
    return code if code >= 0 else 128 - code, output.decode(errors="replace")


def _end_with_parent() -> None:
    """Have Linux end this process when its parent is gone, however that ended."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM, 0, 0, 0)  # PR_SET_PDEATHSIG


def launched() -> tuple[int, int]:
    """(rank, size) of this process among the processes that a launcher has started, (0, 1) if none has.

    MPI is not loaded.
    """
    for rank, size in _LAUNCHERS:
        if os.environ.get(rank, "").isdigit() and os.environ.get(size, "").isdigit():
            return int(os.environ[rank]), int(os.environ[size])
    return 0, 1


def mpi_rank() -> Rank:
    """The rank of this process among those that the launcher started.

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
    """The rank of this process under MPI."""

    needs_progress = True

    def __init__(self, library: Any):
        self._library = library
        self._world = library.COMM_WORLD.Dup()
        self.rank, self.size = self._world.Get_rank(), self._world.Get_size()
        self.neighbors = self._world.Split_type(library.COMM_TYPE_SHARED).Get_size()
        compiling.announces = compiling.announces and self.rank == 0
        self._is_over = False  # somebody failed: nobody waits for this rank any more
        self._requests: list[Any] = []
        self._kept: list[np.ndarray] = []  # arrays of pending messages
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
        """Number of rows that each rank sends here. Every collective call begins with it, so that all learn who failed.

        numbers: to be sent to all ranks. Theirs are in `_numbers` (P, NUMBERS) then.
        """
        received = self._headers(rows, numbers)
        failed = np.flatnonzero(received == _FAILED)
        if len(failed):
            self._is_over = True
            raise error_of(self._world.bcast(None, root=int(failed[0])), int(failed[0]))
        return received

    def _headers(self, rows: np.ndarray, numbers: Sequence[float] = ()) -> np.ndarray:
        """Exchange headers: numbers of rows, or _FAILED, and `numbers`. Returns the first entry of each rank's."""
        sent, received = np.zeros((2, self.size, 1 + MOST_NUMBERS), np.int64)
        sent[:, 0] = rows
        sent[:, 1 : 1 + len(numbers)] = np.array(numbers, np.float64).view(np.int64)
        self._world.Alltoall(sent, received)
        self._numbers = received[:, 1:].copy().view(np.float64)
        return received[:, 0].copy()

    def send(self, to: int, array: np.ndarray) -> None:
        self._kept.append(np.ascontiguousarray(array))
        self._requests.append(self._world.Isend(self._kept[-1], to, _VALUE_TAGS))

    def receive(self, source: int, into: np.ndarray) -> None:
        self._kept.append(into)
        self._requests.append(self._world.Irecv(into, source, _VALUE_TAGS))

    def progress(self) -> None:
        self._library.Request.Testall(self._requests)

    def finish(self) -> None:
        looks = 0
        while not self._library.Request.Testall(self._requests):
            looks += 1
            if looks % _RANK_LOOKS == 0:
                time.sleep(0)
                if self._world.Iprobe(self._library.ANY_SOURCE, _NOTICE):
                    self._counts(np.zeros(self.size, np.int64))  # raises, as at the failed rank and all others
        self._requests.clear()
        self._kept.clear()

    def fail(self, error: BaseException) -> None:
        if self._is_over:
            return
        self._is_over = True
        for rank in range(self.size):  # wake those that wait for a message of this rank
            if rank != self.rank:
                self._requests.append(self._world.Isend(np.zeros(0), rank, _NOTICE))
        received = self._headers(np.full(self.size, _FAILED))
        first = min([*np.flatnonzero(received == _FAILED), self.rank])
        self._world.bcast(text_of(error) if first == self.rank else None, root=first)
