"""Values by several processes: each sweeps a range of the states, and gets the values of its halo from the others.

Each rank has a `Part` (mdp/reachability.py). A sweep goes in place over its own states, from the last to the first,
with the values that the halo had after the sweep before. Messages bring the values after it, and a reduction the
largest change. So every new entry is a backup of entries that are old or already new, which is all that the error bound
of fixed_point.py asks for: it holds with the largest change of all. Values cross the border of a range once a sweep, so
there are more sweeps than in one process: a Breakout of 2.4 million states takes 33 in one, 38 in two, 55 in four, 111
in sixteen.

Sweeps of a horizon are not in place, and the same to the last bit whatever the number of ranks: each state is backed up
by one rank, from the same values in the same order.

Messages travel while ranks sweep. A sweep of a horizon begins with the states that others read, sends them, and goes on
with the rest. In place the order is what makes sweeps few, and must stay: along it values come from the halo to the
states that others read in a single sweep. So what others read of the high states of a range, all but its lowest eighth,
is sent once these are done, and the rest in the end, which changes no value. Other orders hide more, for more sweeps:
on that Breakout in 2, 4 and 16 ranks the states that read no halo before the others take 89, 212 and 278, the states
that others read before the rest 240, 231 and 284, and a halo that is one sweep older 49, 96 and 208.

All ranks run the same loop and see the same numbers, so they stop after the same sweep without a coordinator.

`SolverCheckpoint` keeps the values so far in a file, so that a solve that was killed goes on from there.
`shared_solution` runs the solve on all ranks and makes its Solution.
"""

import contextlib
import time
import warnings
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import Part, Selection, TabularMDP, runs_between, runs_of, shares_of
from pharos.ranks import Halo, Rank, check_ranks, cuts_of, run_spmd
from pharos.solvers.convergence import Convergence
from pharos.solvers.fixed_point import Backup, bound_of_steps, largest_of, within_residual
from pharos.solvers.solution import Solution, Solving
from pharos.system import storage
from pharos.system.compiling import Stopwatch
from pharos.system.workers import check_processes, usable_workers

# Values so far --------------------------------------------------------------------------------------------------------


WRITE_SECONDS = 60.0
_WRITING_SHARE = 20  # of the time of solving, at most one part in so many is spent on writing
_HEADER = 5  # float64: sweeps, two numbers, rows, columns
_DIGEST = 32  # characters of a digest; two follow, of the header and of the values


class SolverCheckpoint:
    """File of the values of all ranks, so far. The first rank reads and writes it.

    A file holds the values of one question: its name is a digest of the MDP, of the selection of actions and of
    `question`. It does not depend on the number of ranks, and is removed once the question is answered.

    Attributes:
        numbers: those that `keep` was given beside the values.
    """

    def __init__(self, folder: Path | None, question: str, seconds: float = WRITE_SECONDS):
        """
        folder: None to keep nothing. question: the setting of the solve, but for the MDP and the selection of actions.
        """
        self._folder, self._question, self._seconds = folder, question, seconds
        self._next = time.monotonic() + seconds
        self._path: Path | None = None
        self.numbers = (0.0, 0.0)

    def start(self, backup: "RankedBackup") -> int:
        """Set the values to the file's, if there is one. Returns the sweeps that they took."""
        if self._folder is None:
            return 0
        name = storage.digest_of_json([self._question, backup.mdp.num_states, backup.mdp.width, backup.fingerprint()])
        self._path = self._folder / f"{name}.values"
        header, whole = np.zeros(_HEADER), None
        if backup.rank.rank == 0:
            header, whole = self._read((backup.mdp.num_states + 1, backup.x.shape[1]))
        header = backup.rank.broadcast(header if backup.rank.rank == 0 else None, header)
        if header[0] > 0:
            backup.scatter(whole)
            self.numbers = float(header[1]), float(header[2])
        self._next = time.monotonic() + self._seconds
        return int(header[0])

    def is_due(self, backup: "RankedBackup") -> bool:
        """Whether the first rank finds that it is time to write."""
        return backup.rank.rank == 0 and self._folder is not None and time.monotonic() > self._next

    def keep(self, backup: "RankedBackup", sweeps: int, numbers: tuple[float, float] = (0.0, 0.0)) -> None:
        """Write the values of all ranks."""
        began = time.monotonic()
        whole = backup.gathered(backup.x)
        if whole is not None and self._path is not None:
            header = np.array([sweeps, *numbers, *whole.shape], np.float64).tobytes()
            values = np.ascontiguousarray(whole).data.cast("B")
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                with storage.replacing(self._path) as file:
                    file.write(header + (storage.digest_of_bytes(header) + storage.digest_of_bytes(values)).encode())
                    file.write(values)
            except OSError as error:
                self._folder = None  # from now on nothing is due; the last file stays
                warnings.warn(
                    f"{self._path}: {error.strerror or error}; values are not kept any more, solving goes on",
                    stacklevel=2,
                )
        now = time.monotonic()
        self._next = now + max(self._seconds, _WRITING_SHARE * (now - began))

    def finish(self, backup: "RankedBackup") -> None:
        """Remove the file, as the question is answered."""
        if backup.rank.rank == 0 and self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)

    def _read(self, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray | None]:
        """(header, values) of the file. Zeros and None if there is none, or not a whole one."""
        nothing = np.zeros(_HEADER), None
        assert self._path is not None
        try:
            storage.check_regular(self._path)
            with open(self._path, "rb") as file:
                data, digests = file.read(8 * _HEADER), file.read(2 * _DIGEST).decode(errors="replace")
            begin = 8 * _HEADER + 2 * _DIGEST
            if digests[:_DIGEST] != storage.digest_of_bytes(data):
                return nothing
            header = np.frombuffer(data)
            if tuple(header[3:5]) != shape or self._path.stat().st_size != begin + 8 * shape[0] * shape[1]:
                return nothing
            whole = np.memmap(self._path, np.float64, "r", begin, shape)
        except OSError:
            return nothing
        is_whole = storage.digest_of_bytes(whole.data.cast("B")) == digests[_DIGEST:]
        return (header.copy(), whole) if is_whole else nothing


# Sweeps of ranks ------------------------------------------------------------------------------------------------------


_EXCHANGED_ROWS = 1 << 20  # of values that a rank sends to the first in one exchange
_FINGERPRINT_BLOCK = 1 << 16  # states whose fingerprint is taken in one go
_GAP = 64  # states between two runs of those that others read, from which on they are two
_MESSAGE_CHECKS = 8  # how often in a sweep of a large range messages are looked after
_SPLITMIX = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)  # of splitmix64


class RankedBackup:
    """One rank's part of the Bellman backup T of an MDP under a selection of actions.

    Attributes:
        part: the states of this rank. backup: T on them. Its factor and its rounding belong to the whole MDP.
        x: (n + H + 1, W) values, see mdp/reachability.py. previous: the values before the last sweep of a horizon.
        first: (R, 2) runs of its states that sweeps of a horizon begin with: those that others read, short gaps filled.
    """

    def __init__(self, mdp: TabularMDP, select: Selection, rank: Rank):
        check_ranks(mdp.num_states, rank.size)
        self.mdp, self.rank = mdp, rank
        self.cuts = cuts_of(mdp.num_states, rank.size)
        self.part = Part.of(mdp, *map(int, self.cuts[rank.rank : rank.rank + 2]))
        self.part.dynamics.workers = max(1, usable_workers(None) // rank.neighbors)
        self.backup = backup = Backup(self.part, self.part.selection(select))
        names = ("factor", "operations", "largest_reward", "rounding_of_rewards")
        numbers = np.max(rank.allgather(np.array([getattr(backup, name) for name in names], np.float64)), axis=0)
        vars(backup).update(zip(names, numbers.tolist(), strict=True))
        self._halo = Halo(rank, self.part.halo, self.cuts)
        self.first = runs_of(self._halo.is_boundary(len(self.part)), _GAP)
        pieces = min(_MESSAGE_CHECKS, 1 + (len(self.part) >> 16)) if rank.needs_progress else 1
        self._rest = shares_of(runs_between(self.first, len(self.part)), pieces)
        self._high = shares_of(np.array([[self._halo.low, len(self.part)]]), pieces)[::-1]
        self.x = self.part.zeros()

    @cached_property
    def previous(self) -> np.ndarray:
        return self.part.zeros()

    def sweep(self) -> float:
        """Replace the values of this rank's states by their backups, in place. Return the largest change.

        Messages stay under way until `share`.
        """
        halo, x, change = self._halo, self.x, 0.0
        halo.receive(x, in_two=True)
        for ((start, stop),) in self._high:
            change = _larger(change, self.backup.sweep(x, (int(start), int(stop))))
            self.rank.progress()
        halo.send_high(x)
        change = _larger(change, self.backup.sweep(x, (0, halo.low)))
        halo.send_low(x)
        return change

    def plain_sweep(self) -> None:
        """Replace the values of this rank's states by backups of the old values, which are kept as `previous`."""
        halo, x, new = self._halo, self.x, self.previous
        dynamics, equation = self.part.dynamics, self.backup.equation
        halo.receive(new)
        with np.errstate(over="ignore", invalid="ignore"):
            dynamics.backup(equation, x, new, self.first)
            halo.send(new)
            for runs in self._rest:
                dynamics.backup(equation, x, new, runs)
                self.rank.progress()
        self.x, self.previous = new, x

    def share(self, *numbers: float) -> np.ndarray:
        """Get the values of the halo after a sweep. Returns (P, K), the numbers of each rank."""
        every = self.rank.allgather_numbers(*numbers)  # while messages travel
        self._halo.finish(self.x[len(self.part) : -1])
        return every

    # Values of all ranks, at the first ------------------------------------------------------------------------------

    def gathered(self, x: np.ndarray) -> np.ndarray | None:
        """(S + 1, W) values of the states of all ranks, at the first rank, None at the others."""
        is_first = self.rank.rank == 0
        whole = np.zeros((self.mdp.num_states + 1 if is_first else 0, x.shape[1]))
        own = x[: len(self.part)]
        for first in range(0, int(np.diff(self.cuts).max()), _EXCHANGED_ROWS):
            for start, rows in zip(self.cuts, self.rank.gather(own[first : first + _EXCHANGED_ROWS]), strict=False):
                if is_first:
                    whole[start + first : start + first + len(rows)] = rows
        return whole if is_first else None

    def scatter(self, whole: np.ndarray | None) -> None:
        """Set the values of all ranks, halos included, to the values of the first rank, (S + 1, W)."""
        self.rank.scatter_rows(whole, self.cuts, self.x)
        self._halo.receive(self.x)
        self._halo.send(self.x)
        self._halo.finish(self.x[len(self.part) : -1])

    def fingerprint(self) -> str:
        """Digest of the equation, whatever the number of ranks: of one backup of values drawn by state number."""
        part, equation = self.part, self.backup.equation
        x = self.part.zeros()
        numbers = np.concatenate([np.arange(part.start, part.stop), part.halo])
        x[:-1] = (_mixed_numbers(numbers)[:, None] >> np.uint64(12)) * 2.0**-52
        total = 0
        for start in range(0, len(part), _FINGERPRINT_BLOCK):
            states = slice(start, min(start + _FINGERPRINT_BLOCK, len(part)))
            q = equation.rewards.rows(states) + equation.gamma * part.dynamics.expected(x, states)
            for kind, values in enumerate((q, equation.value(q, states))):
                bits = np.ascontiguousarray(values).view(np.uint64).reshape(len(values), -1)
                position = (part.start + np.arange(states.start, states.stop, dtype=np.uint64)[:, None]) * np.uint64(
                    2 * bits.shape[1]
                )
                position = position + np.uint64(2) * np.arange(bits.shape[1], dtype=np.uint64) + np.uint64(kind)
                total += int(np.add.reduce(_mixed_numbers(bits ^ _mixed_numbers(position)), axis=None, dtype=np.uint64))
        totals = self.rank.allgather(np.array([total % 2**64], np.uint64))
        return f"{sum(int(each[0]) for each in totals) % 2**64:016x}"


def _larger(one: float, other: float) -> float:
    """The larger of two numbers, NaN if one is NaN."""
    return float(np.maximum(one, other))


def _mixed_numbers(numbers: np.ndarray) -> np.ndarray:
    """Whole numbers as uint64, mixed by splitmix64."""
    with np.errstate(over="ignore"):
        z = numbers.astype(np.uint64) + np.uint64(_SPLITMIX[0])
        z = (z ^ (z >> np.uint64(30))) * np.uint64(_SPLITMIX[1])
        z = (z ^ (z >> np.uint64(27))) * np.uint64(_SPLITMIX[2])
    return z ^ (z >> np.uint64(31))


def ranked_fixed_point(
    backup: RankedBackup,
    tolerance: float,
    checkpoint: SolverCheckpoint,
    progress: Callable[[int, float], None] | None,
) -> tuple[float, int]:
    """Sweep until the proven bound is at most the tolerance. Returns (bound, sweeps).

    Raises:
        ParameterError: gamma is 1. PrecisionError: 64-bit floats cannot reach the tolerance.
    """
    mdp, rho = backup.mdp, backup.backup.factor
    if mdp.gamma == 1.0:
        raise ParameterError(
            f"{mdp}: gamma is 1 and there is no horizon, which several processes cannot solve; "
            "expected processes=1, a horizon, or gamma < 1"
        )
    of_first = progress if backup.rank.rank == 0 else None
    convergence = Convergence(mdp, backup.backup, tolerance, of_first)
    convergence.sweeps = checkpoint.start(backup)
    while True:
        change = backup.sweep()
        largest = largest_of(backup.x[: len(backup.part)])
        numbers = backup.share(change, largest, checkpoint.is_due(backup))
        change, largest, is_due = map(float, numbers.max(axis=0))
        rounding = backup.backup.rounding(largest + change)
        if convergence.is_met(backup.backup.bound(change, rounding)):
            return convergence.bound, convergence.sweeps
        convergence.check(rho * change > rounding, backup.backup.patience)
        if is_due:
            checkpoint.keep(backup, convergence.sweeps)


def ranked_induction(
    backup: RankedBackup,
    horizon: int,
    checkpoint: SolverCheckpoint,
    progress: Callable[[int, float], None] | None,
) -> tuple[float, np.ndarray]:
    """Compute the values with `horizon` steps to go, in `backup.x`. Return (bound, values with one step less)."""
    step = checkpoint.start(backup)
    bound, largest = checkpoint.numbers if step else (0.0, 0.0)
    before = backup.x.copy()
    while step < horizon:
        backup.plain_sweep()
        before, step = backup.previous, step + 1
        bound = backup.backup.factor * bound + backup.backup.rounding(largest)
        bound += backup.mdp.residual.deviation(backup.mdp.gamma, largest)
        wants = checkpoint.is_due(backup) and step < horizon
        numbers = backup.share(largest_of(backup.x[: len(backup.part)]), wants)
        largest, is_due = map(float, numbers.max(axis=0))
        if progress is not None and backup.rank.rank == 0:
            progress(step, bound)
        if is_due:
            checkpoint.keep(backup, step, (bound, largest))
    return bound_of_steps(backup.mdp, horizon, bound, largest), before


# Distributed ----------------------------------------------------------------------------------------------------------


def shared_solution(
    mdp: TabularMDP,
    select: Selection,
    solving: Solving,
    checkpoint_seconds: float = WRITE_SECONDS,
) -> Solution:
    """Solution of an MDP under a selection of actions, by several processes. Under MPI the others get None.

    Args:
        checkpoint_seconds: between two checkpoints.
    """
    check_processes(solving.processes)
    watch = Stopwatch()
    horizon, progress = solving.horizon, solving.progress
    folder = None if solving.checkpoint is None else Path(solving.checkpoint)
    if folder is not None and folder.exists() and not folder.is_dir():
        raise ParameterError(f"checkpoint {folder}: is a file; expected a folder")

    def program(rank: Rank) -> tuple[float, int, np.ndarray, np.ndarray] | None:
        question = f"{mdp.gamma!r} {mdp.chance} horizon {horizon}" + (f" {mdp.residual}" if any(mdp.residual) else "")
        file = SolverCheckpoint(folder, question, checkpoint_seconds)
        backup = RankedBackup(mdp, select, rank)
        if horizon is None:
            bound, sweeps = ranked_fixed_point(backup, solving.tolerance, file, progress)
            next_x = x = backup.gathered(backup.x)
        else:
            sweeps = horizon
            bound, before = ranked_induction(backup, horizon, file, progress)
            x, next_x = backup.gathered(backup.x), backup.gathered(before)
        file.finish(backup)
        return None if x is None or next_x is None else (bound, sweeps, x, next_x)

    answer = run_spmd(solving.processes, program)
    if answer is None:
        return cast(Any, None)
    bound, sweeps, x, next_x = answer
    if horizon is None:
        bound = within_residual(mdp, bound, x)
    return Solution(mdp, bound, sweeps, watch.seconds, horizon, select, x, next_x)
