"""Rank: one of several processes that run the same program, and exchange arrays.

Rank 0 is the one that the user sees: it alone reads and writes files, reports and raises the errors of all. The others
run a function that answers it. Three ways of running them differ in `exchange` alone:

    loop        threads of one process, for tests
    processes   forked processes of one machine, through shared memory
    mpi_rank    what `mpiexec -n P` started, on one machine or on many
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from pharos import errors
from pharos.errors import PharosError


class RankFailed(PharosError):
    """Another rank failed, or died; the message says which one and why."""


class Rank(ABC):
    """One of `size` processes.

    Attributes:
        rank: its number. size: how many there are. neighbors: how many of them are on this machine.
    """

    rank: int
    size: int
    neighbors: int

    @abstractmethod
    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Send parts[q] to each rank q, and return what each of them has sent here, in their order.

        All ranks call it together; all parts have one dtype, and one shape behind the first axis.

        Raises:
            RankFailed: a rank failed or died, in place of answering.
        """

    @abstractmethod
    def fail(self, error: BaseException) -> None:
        """Tell the others, who wait in an exchange or come to one, that this rank gives up."""

    def scatter(self, parts: Sequence[np.ndarray] | None, like: np.ndarray) -> np.ndarray:
        """Rank 0 sends parts[q] to each rank q, which gets it; `like` is an array of that type for the others."""
        return self.exchange(parts or [like[:0]] * self.size)[0]

    def broadcast(self, array: np.ndarray | None, like: np.ndarray) -> np.ndarray:
        """What rank 0 has sent."""
        return self.scatter(None if array is None else [array] * self.size, like)

    def gather(self, array: np.ndarray) -> list[np.ndarray]:
        """At rank 0 what each rank gave, in their order; elsewhere empty arrays."""
        return self.exchange([array if rank == 0 else array[:0] for rank in range(self.size)])

    def gather_all(self, array: np.ndarray) -> list[np.ndarray]:
        """What each rank gave, in their order, at all of them."""
        return self.exchange([array] * self.size)


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
