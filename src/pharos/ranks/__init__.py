"""Several processes that compute one thing together: ranks, and how they exchange arrays."""

from pharos.ranks.halo import Halo, cuts_of
from pharos.ranks.mpi import check_processes, check_ranks, launched, mpi_rank, run_spmd, start_under_mpiexec
from pharos.ranks.rank import Rank, RankFailed

_shared = """
    Halo Rank RankFailed check_processes check_ranks cuts_of launched mpi_rank run_spmd start_under_mpiexec
"""
