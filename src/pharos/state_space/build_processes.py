"""Who builds a state space together: this process alone, processes that it forks, or those that mpiexec has started."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

from pharos.ranks import Rank, check_number, mpi_rank, processes
from pharos.state_space.journal import Journal
from pharos.state_space.plan import Plan
from pharos.state_space.progress import Progress
from pharos.state_space.ranked_search import RankedSearch
from pharos.state_space.ranked_table import answer, bytes_of_exchange, end, warm
from pharos.state_space.search import Options, Search


@dataclass(frozen=True)
class BuildProcesses:
    """Those who build together.

    Attributes:
        size: processes that are forked for the search, this one among them. rank: of this process, under MPI.
    """

    size: int = 1
    rank: Rank | None = None

    @property
    def is_first(self) -> bool:
        """Whether this process has the files."""
        return self.rank is None or self.rank.rank == 0

    @contextlib.contextmanager
    def search(self, plan: Plan, journal: Journal, options: Options, report: Progress) -> Iterator[Search]:
        """The search of the first one."""
        if self.rank is not None:
            yield RankedSearch(plan, journal, options, report, self.rank)
        elif self.size == 1:
            yield Search(plan, journal, options, report)
        else:
            warm(plan)
            memory = None if options.memory is None else options.memory // self.size
            with processes(self.size, lambda rank: answer(plan, rank, memory), bytes_of_exchange(plan)) as rank:
                yield RankedSearch(plan, journal, replace(options, memory=memory), report, rank)
                end(rank)


@contextlib.contextmanager
def crew_of(size: int | str, plan: Plan, memory: int | None) -> Iterator[BuildProcesses]:
    """The crew of a build; under MPI those who are not the first have done their part when they get theirs.

    Args:
        size: as `build` takes `processes`.
    """
    if size != "mpi":
        check_number(size)
        yield BuildProcesses(int(size))
        return
    rank = mpi_rank()
    try:
        if rank.rank > 0:
            answer(plan, rank, memory)
        yield BuildProcesses(rank=rank)
        if rank.rank == 0:
            end(rank)
    except BaseException as error:
        rank.fail(error)
        raise
