"""Several processes that compute one thing together: ranks, and how they exchange arrays."""

from pharos.ranks.loop import loop
from pharos.ranks.mpi import launched, mpi_rank
from pharos.ranks.processes import processes
from pharos.ranks.rank import Rank, RankFailed
from pharos.ranks.together import check_number, together

__all__ = ["Rank", "RankFailed", "check_number", "launched", "loop", "mpi_rank", "processes", "together"]
