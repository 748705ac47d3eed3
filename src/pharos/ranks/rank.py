"""Rank: one of several processes that run the same program, and exchange arrays.

Rank 0 is the one that the user sees: it alone reads and writes files, reports and raises the errors of all. The others
run a function that answers it. MPI carries what they exchange (mpi.py); tests run ranks as threads.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from pharos import errors
from pharos.errors import PharosError

NUMBERS = 3  # that a rank tells all others in one go, at most
_ROWS = 1 << 20  # that rank 0 sends to each in one exchange


class RankFailed(PharosError):
    """Another rank failed, or died; the message says which one and why."""


class Rank(ABC):
    """One of `size` processes.

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

        All ranks call it together; all parts have one dtype, and one shape behind the first axis.

        Raises:
            RankFailed: a rank failed or died, in place of answering.
        """

    # From one to one: arrays that move while the ranks compute -------------------------------------------------------

    @abstractmethod
    def send(self, to: int, array: np.ndarray) -> None:
        """Begin to send an array to a rank, which begins to receive one of this shape and dtype, now or later.

        Nobody changes the array before `finish`. What one rank sends to another arrives in that order.
        """

    @abstractmethod
    def receive(self, source: int, into: np.ndarray) -> None:
        """Begin to receive an array, C-contiguous: until `finish` nobody knows what is in it."""

    def progress(self) -> None:  # noqa: B027
        """Let what was begun move on: to be called now and then while this process computes."""

    @abstractmethod
    def finish(self) -> None:
        """Wait until this rank has received all that it began to, and may change what it sent.

        Exchanges may stand before it: after one, the others have begun to send what they began before it.

        Raises:
            RankFailed: a rank failed or died, in place of sending.
        """

    @abstractmethod
    def fail(self, error: BaseException) -> None:
        """Abort: every exchange and message of the other ranks, pending or later, raises."""

    def scatter(self, parts: Sequence[np.ndarray] | None, like: np.ndarray) -> np.ndarray:
        """Rank 0 sends parts[q] to each rank q, which gets it; `like` is an array of that type for the others."""
        return self.exchange(parts or [like[:0]] * self.size)[0]

    def scatter_rows(self, whole: np.ndarray | None, cuts: np.ndarray, into: np.ndarray) -> None:
        """Rank 0 sends rank q the rows [cuts[q], cuts[q + 1]) of an array that it alone has, into its first rows."""
        for first in range(0, int(np.diff(cuts).max()), _ROWS):
            parts = None
            if whole is not None:
                stops = np.minimum(cuts[:-1] + first + _ROWS, cuts[1:])
                parts = [np.array(whole[cuts[q] + first : max(stops[q], 0)]) for q in range(self.size)]
            rows = self.scatter(parts, into)
            into[first : first + len(rows)] = rows

    def broadcast(self, array: np.ndarray | None, like: np.ndarray) -> np.ndarray:
        """What rank 0 has sent."""
        return self.scatter(None if array is None else [array] * self.size, like)

    def gather(self, array: np.ndarray) -> list[np.ndarray]:
        """At rank 0 what each rank gave, in their order; elsewhere empty arrays."""
        return self.exchange([array if rank == 0 else array[:0] for rank in range(self.size)])

    def allgather(self, array: np.ndarray) -> list[np.ndarray]:
        """What each rank gave, in their order, at all of them."""
        return self.exchange([array] * self.size)

    def allgather_numbers(self, *numbers: float) -> np.ndarray:
        """(P, K) float64: a few numbers (at most `NUMBERS`) of each rank, at all of them."""
        return np.array(self.allgather(np.array(numbers, np.float64)))


class Alone(Rank):
    """The only rank."""

    rank, size, neighbors = 0, 1, 1

    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [part.copy() for part in parts]

    def send(self, to: int, array: np.ndarray) -> None:
        raise ValueError("there is no other rank")

    def receive(self, source: int, into: np.ndarray) -> None:
        raise ValueError("there is no other rank")

    def finish(self) -> None:
        """Nothing is on its way."""

    def fail(self, error: BaseException) -> None:
        """Nobody waits."""


def text_of(error: BaseException) -> str:
    """An error as text, to be sent to other ranks; see `error_of`."""
    return f"{type(error).__name__}\n{error}"


def error_of(text: str, rank: int) -> PharosError:
    """The error of another rank: of the same class, where that is one of pharos.errors; a RankFailed otherwise."""
    name, _, message = text.partition("\n")
    kind = getattr(errors, name, None)
    # those whose first argument is no message cannot be made of one
    if isinstance(kind, type) and issubclass(kind, PharosError) and "__init__" not in vars(kind):
        return kind(message)
    return RankFailed(f"rank {rank}: {f'{name}: {message}'.strip().splitlines()[0]}")
