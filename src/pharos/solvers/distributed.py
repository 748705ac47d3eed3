"""Solving that several processes share: who takes part, and the Solution that comes of it."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import Selection, TabularMDP
from pharos.ranks import Rank, check_processes, run_spmd
from pharos.solvers.checkpoint import SECONDS, Checkpoint
from pharos.solvers.ranked import RankedBackup, ranked_fixed_point, ranked_induction
from pharos.solvers.solution import Solution
from pharos.system.compiling import Stopwatch


@dataclass(frozen=True)
class DistributedOptions:
    """Who sweeps, and how.

    Attributes:
        processes: 1; or "mpi": those that `mpiexec` has started, all of which make the call.
        checkpoint: a folder for the values so far; None to keep none.
        checkpoint_seconds: between two of them.
    """

    processes: int | str = 1
    checkpoint: str | os.PathLike | None = None
    checkpoint_seconds: float = SECONDS

    def __post_init__(self) -> None:
        check_processes(self.processes)

    @property
    def is_wanted(self) -> bool:
        """Whether this is anything else than one process as ever."""
        return self.processes != 1 or self.checkpoint is not None


def shared_solution(
    mdp: TabularMDP,
    select: Selection,
    tolerance: float,
    horizon: int | None,
    sharing: DistributedOptions,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The values of what is chosen, by several processes. Under MPI the first gets them, and the others None."""
    watch = Stopwatch()
    folder = None if sharing.checkpoint is None else Path(sharing.checkpoint)
    if folder is not None and folder.exists() and not folder.is_dir():
        raise ParameterError(f"checkpoint {folder}: is a file; expected a folder")

    def program(rank: Rank) -> tuple[float, int, np.ndarray, np.ndarray] | None:
        what = f"{mdp.gamma!r} {mdp.chance} horizon {horizon}"
        checkpoint = Checkpoint(folder, what, sharing.checkpoint_seconds)
        backup = RankedBackup(mdp, select, rank)
        if horizon is None:
            bound, sweeps = ranked_fixed_point(backup, tolerance, checkpoint, progress)
            following = x = backup.gathered(backup.x)
        else:
            sweeps = horizon
            bound, before = ranked_induction(backup, horizon, checkpoint, progress)
            x, following = backup.gathered(backup.x), backup.gathered(before)
        checkpoint.finish(backup)
        return None if x is None or following is None else (bound, sweeps, x, following)

    answer = run_spmd(sharing.processes, program)
    if answer is None:
        return cast(Any, None)
    bound, sweeps, x, following = answer
    return Solution(mdp, bound, sweeps, watch.seconds, horizon, select, x, following)
