"""One program that all ranks run together, from its first line to its last."""

from collections.abc import Callable
from typing import TypeVar

from pharos.errors import ParameterError
from pharos.ranks.loop import loop
from pharos.ranks.mpi import mpi_rank
from pharos.ranks.processes import processes
from pharos.ranks.rank import Rank

MOST = 1024  # processes of a machine that anybody may mean

T = TypeVar("T")


def check_number(size: int | str) -> None:
    """ParameterError unless it is a number of processes of this machine, or "mpi"."""
    if size != "mpi" and (not isinstance(size, int) or isinstance(size, bool) or not 1 <= size <= MOST):
        raise ParameterError(f"processes is {size!r}; expected a whole number from 1 to {MOST}, or 'mpi'")


def check_ranks(num_states: int, ranks: int) -> None:
    """Raise ParameterError where there are more ranks than states."""
    if ranks > max(num_states, 1):
        raise ParameterError(f"{ranks} processes for {num_states} states; expected at most one for each state")


def together(size: int | str, program: Callable[[Rank], T], capacity: int) -> T:
    """What `program(rank)` returns, at this rank, while the others run it, too.

    Args:
        size: as `build` takes `processes`: processes of this machine, forked from this one; or "mpi", those that make
            this call.
        capacity: bytes that a rank sends in an exchange, at most.
    Raises:
        Whatever the program raises on any of them. RankFailed: one of them died.
    """
    check_number(size)
    if size == "mpi":
        rank = mpi_rank()
        try:
            return program(rank)
        except BaseException as error:
            rank.fail(error)
            raise
    if size == 1:
        with loop(1, lambda rank: None) as rank:
            return program(rank)
    assert isinstance(size, int)
    with processes(size, lambda rank: _ignored(program(rank)), capacity) as rank:
        return program(rank)


def _ignored(result: object) -> None:
    """The result of another rank, which nobody asks for."""
