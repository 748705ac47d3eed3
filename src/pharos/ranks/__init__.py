"""Several processes that compute one thing together: ranks, and how they exchange arrays."""

from pharos.ranks.halo import Halo, cuts_of
from pharos.ranks.loop import loop
from pharos.ranks.mpi import launched, mpi_rank
from pharos.ranks.processes import processes
from pharos.ranks.rank import Rank, RankFailed
from pharos.ranks.together import check_number, check_ranks, together

_shared = """
    Halo Rank RankFailed check_number check_ranks cuts_of launched loop mpi_rank processes together
"""
