"""Optimal values, worst values and values of uniform play.

Sweeps of one range of states after another, with a bound of each: for values that memory does not hold at once.

A range is swept a few times while its values and transitions are in memory, and left alone once its bound is met. Two
ranges of `breakout/12x8x1` are read 14 times and four 20 times, where plain sweeps read everything 33 times; they take
the backups of 46 and 67 sweeps.

The bound. Let state s of a range have been backed up last at some time. If no entry has changed by more than p since
(its own range in that sweep, others afterwards), then |T x - x|(s) <= rho p + e, with e the rounding of a backup: that
is the residual of the range. The error of all values is at most the largest residual / (1 - rho), as |x - x*| <=
|T x - x| + rho |x - x*|. So a range whose (rho p + e) / (1 - rho) is within the tolerance need not be swept again
before others have changed by more. Sums of changes are rounded up, so that p is no less than what it stands for; the
margin of the bound is for the rounding of its own computation.

Values of a given policy: on its functional graph where everything is deterministic, else by iteration.
"""

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator
from typing import Protocol, TypeAlias, TypedDict, Unpack, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from pharos.errors import DivergenceError, ParameterError
from pharos.mdp import (
    BEST,
    STEPS,
    WORST,
    PolicyTable,
    Selection,
    TabularMDP,
    mass_of,
    random_actions,
    require_mdp,
    whole_number,
)
from pharos.solvers.convergence import Convergence
from pharos.solvers.fixed_point import (
    MARGIN,
    Backup,
    FixedPoint,
    backward_induction,
    chain_bound,
    fixed_point,
    largest_of,
    within_residual,
)
from pharos.solvers.policy_iteration import chain, chain_values
from pharos.solvers.solution import Solution
from pharos.system import memory
from pharos.system.compiling import Stopwatch
from pharos.system.memory import kept_array
from pharos.system.workers import usable_workers

# Rows of values in a file that are read in one go.
_ROWS = 1 << 22
# Between two copies of values to their file.
_SECONDS = 600.0


class SolvingOptions(TypedDict, total=False):
    """Options of `value_iteration`, described there."""

    horizon: int | None
    keep_all: bool
    progress: Callable[[int, float], None] | None
    values: str | os.PathLike | None
    processes: int | str
    checkpoint: str | os.PathLike | None
    threads: int
    dtype: DTypeLike
    blocks: int


@runtime_checkable
class TableAgent(Protocol):
    """An agent with a policy over the states."""

    def policy_table(self) -> np.ndarray:
        """(S,) actions, or probabilities, as `evaluate_policy` takes them."""


TablePolicy: TypeAlias = ArrayLike | Callable[[np.ndarray], ArrayLike] | TableAgent
"""A policy over states, as `evaluate_policy` takes it."""


@require_mdp
def value_iteration(  # noqa: PLR0913
    mdp: TabularMDP,
    tolerance: float = 1e-6,
    *,
    horizon: int | None = None,
    keep_all: bool = False,
    progress: Callable[[int, float], None] | None = None,
    values: str | os.PathLike | None = None,
    processes: int | str = 1,
    checkpoint: str | os.PathLike | None = None,
    threads: int = 1,
    dtype: DTypeLike = "float64",
    blocks: int = 1,
) -> Solution:
    """The optimal values of an MDP.

    V*(s) = max_a q(s, a), q(s, a) = r(s, a) + gamma E V*(next); with chance, see `random_actions` and `sticky_actions`.

    Args:
        tolerance: every value is within this of the optimal one, proven; in units of return. With a horizon values are
            exact up to rounding, whatever the tolerance.
        horizon: number of steps to go, instead of the MDP's own; backward induction then, without keeping the steps.
        keep_all: with a horizon, keep the values of every step as `all_steps`, (T + 1, S), under sticky actions (T + 1,
            S, A): row t has t steps to go.
        progress: called after each sweep with its number and the bound so far.
        values: a file (.npy) that holds the values while they are computed, in place of memory, and afterwards; what
            it holds already is where the sweeps begin, so that a solve that was killed goes on. Large ones that memory
            has room for are swept there, and copied to the file every ten minutes and in the end, whatever ends it.
            None: memory, or where that has little room a file without a name.
        dtype: "float32" stores values in half of the memory; the bound counts what that costs, so that a tolerance
            below 1.2e-7 max |V| / (1 - gamma) is out of reach. For one process, and no horizon.
        blocks: ranges of states that are swept one after another, each some times in a row and as long as its own bound
            is not met: values and transitions are read fewer times, for more backups, which pays where memory holds a
            range at a time. Where gamma is below 1 and transitions are in arrays; else it does not matter.

        Cost only:
        processes: 1; or "mpi": those that `mpiexec` has started, all of which make this call, and sweep a range of the
            states each; the first gets the Solution, the others None. Values depend on it
            within the tolerance; those of a horizon do not.
        checkpoint: a folder for the values so far, once a minute, so that the same call goes on where one was killed,
            with any number of processes.
        threads: that share the states of a sweep in this process, where no action is sticky and transitions are in
            arrays. Values depend on which is first, within the tolerance.
    Returns:
        A Solution of kind "optimal".
    Raises:
        DivergenceError: gamma is 1, there is no horizon, and the value may be infinite.
        PrecisionError: 64-bit floats cannot reach the tolerance, or hold the values.
        ParameterError: several processes, and gamma = 1 without a horizon. RankFailed: another rank failed.
    Cost: O(S A) a sweep, 0.5 to 2 ns for each state and action on game graphs; memory 8 bytes a state (8 A under sticky
        actions). Where gamma is so near 1 that sweeps would be many: strongly connected components one after another
        where none has half of the states (48 bytes a state); policy iteration, on the graph of the policy where nothing
        is left to chance (56 bytes a state then); by a Krylov method whose operator is a sweep else (10 vectors
        of values); and by elimination where that fails and nodes (states, under sticky actions pairs with the previous
        action) times actions are up to 2 million (up to 500 MB then), or nodes are up to 3000.
    Source: Bellman (1957); in place: Puterman (1994), section 6.3.3; the sticky equation: the pharos paper, appendix A.
    """
    options: SolvingOptions = {"horizon": horizon, "keep_all": keep_all, "progress": progress, "values": values}
    options |= {"processes": processes, "checkpoint": checkpoint, "threads": threads, "dtype": dtype, "blocks": blocks}
    return solution_of(mdp, BEST, tolerance, **options)


@require_mdp
def worst_value(mdp: TabularMDP, tolerance: float = 1e-6, **options: Unpack[SolvingOptions]) -> Solution:
    """The values of the worst policy: as `value_iteration`, with its options, minimising."""
    return solution_of(mdp, WORST, tolerance, **options)


@require_mdp
def uniform_value(mdp: TabularMDP, tolerance: float = 1e-6, **options: Unpack[SolvingOptions]) -> Solution:
    """The values of the uniformly random policy: every action is replaced by a uniform one, so nothing is chosen.

    The options are those of `value_iteration`.
    """
    return solution_of(random_actions(mdp, 1.0), BEST, tolerance, **options)


def solution_of(  # noqa: PLR0913
    mdp: TabularMDP,
    select: Selection,
    tolerance: float,
    *,
    horizon: int | None = None,
    keep_all: bool = False,
    progress: Callable[[int, float], None] | None = None,
    values: str | os.PathLike | None = None,
    processes: int | str = 1,
    checkpoint: str | os.PathLike | None = None,
    threads: int = 1,
    dtype: DTypeLike = "float64",
    blocks: int = 1,
) -> Solution:
    """Solution under a selection of actions: a fixed point, or by backward induction where there is a horizon."""
    check_tolerance(tolerance)
    horizon, dtype = checked_horizon(mdp, horizon), checked_dtype(dtype)
    is_shared = is_distributed(processes, checkpoint)
    if dtype == np.float32 and (horizon is not None or is_shared):
        raise ParameterError("dtype='float32' is for one process and no horizon; expected 'float64' here")
    if not (isinstance(blocks, int | np.integer) and 1 <= blocks <= MOST_BLOCKS):
        raise ParameterError(f"blocks is {blocks!r}; expected a whole number from 1 to {MOST_BLOCKS}")
    if is_shared:
        from pharos.solvers.ranked import shared_solution  # which few need

        if keep_all:
            raise ParameterError("keep_all: several processes keep the last step alone; expected processes=1")
        if values is not None:
            raise ParameterError("values: several processes keep theirs in a folder; expected checkpoint=FOLDER")
        return shared_solution(mdp, select, tolerance, horizon, processes, checkpoint, progress)
    watch = Stopwatch()
    steps = None
    if horizon is None:
        mapped = None if values is None else _kept_values(values, (mdp.num_states + 1, mdp.width), dtype)
        with _in_memory(mapped, progress) as (x, report):
            if blocks > 1 and can_be_swept_by_blocks(mdp):
                result = blocked_fixed_point(
                    Backup(mdp, select, usable_workers(threads), dtype), tolerance, blocks, report, x
                )
            else:
                result = fixed_point(mdp, select, tolerance, report, x, usable_workers(threads), dtype)
        next_x = result.x if mapped is None else mapped
        result = result._replace(x=next_x, bound=within_residual(mdp, result.bound, next_x))
    elif values is not None:
        raise ParameterError(f"values={str(values)!r}: a file keeps values without a horizon; found {horizon} steps")
    else:
        result, next_x, steps = backward_induction(mdp, select, horizon, keep_all)
    if steps is not None:
        steps = mdp.without_width(steps[:, :-1])
    return Solution(mdp, result.bound, result.sweeps, watch.seconds, horizon, select, result.x, next_x, steps)


def _kept_values(path: str | os.PathLike, shape: tuple[int, int], dtype: DTypeLike = np.float64) -> np.ndarray:
    """(S + 1, W) values mapped from a file of NumPy (.npy): those that it holds, or zeros in a new file.

    A bound holds from any values on (see fixed_point.py), so a file left in the middle of a sweep is a good start.
    Values that are not finite count as 0, and so does the last row, which is the end.

    Raises:
        FileFormatError: the file holds something else. FolderLocked: its values are in use. ParameterError:
        the file cannot be made.
    """
    x = kept_array(path, shape, dtype)
    for start in range(0, len(x), _ROWS):
        block = x[start : start + _ROWS]
        if not np.isfinite(block).all():
            block[~np.isfinite(block)] = 0.0
    x[-1] = 0.0
    return x


@contextlib.contextmanager
def _in_memory(
    mapped: np.ndarray | None, progress: Callable[[int, float], None] | None
) -> Iterator[tuple[np.ndarray | None, Callable[[int, float], None] | None]]:
    """(values to sweep, progress callback of the sweeps).

    Large values that memory has room for are swept there, as pages of a file that change are written again and again,
    and copied to their file every ten minutes, where that costs little, and in the end, whatever ends it.
    """
    if mapped is None or mapped.nbytes <= memory.SMALL or not memory.fits(mapped.nbytes, memory.SHARE_OF_VALUES):
        yield mapped, progress
        return
    x, due = np.array(mapped), time.monotonic() + _SECONDS

    def report(sweeps: int, bound: float) -> None:
        nonlocal due
        if time.monotonic() >= due:
            began = time.monotonic()
            mapped[:] = x
            due = time.monotonic() + max(_SECONDS, 20 * (time.monotonic() - began))
        if progress is not None:
            progress(sweeps, bound)

    try:
        yield x, report
    finally:
        mapped[:] = x


def is_distributed(processes: int | str, checkpoint: str | os.PathLike | None) -> bool:
    """Whether several processes or a checkpoint are requested (`True` is no number of processes)."""
    return processes != 1 or processes is True or checkpoint is not None


def check_tolerance(tolerance: float) -> None:
    """ParameterError where a tolerance is not a positive number."""
    if not (isinstance(tolerance, int | float | np.floating) and np.isfinite(tolerance) and tolerance > 0):
        raise ParameterError(f"tolerance is {tolerance!r}; expected a positive number, in units of return")


def checked_dtype(dtype: DTypeLike) -> np.dtype:
    """The dtype, float64 or float32; ParameterError for others."""
    try:
        kind = np.dtype(dtype)
    except TypeError:
        kind = np.dtype(object)
    if kind not in (np.float64, np.float32):
        raise ParameterError(f"dtype is {dtype!r}; expected 'float64' or 'float32'")
    return kind


def checked_horizon(mdp: TabularMDP, horizon: int | None) -> int | None:
    """The horizon to use: the one given, else the MDP's own."""
    if horizon is None:
        return mdp.horizon
    return whole_number(horizon, "horizon", STEPS)


# Blocks ---------------------------------------------------------------------------------------------------------------


MOST_BLOCKS = 4096
# Sweeps of a range at most before the next one; fewer once they change it by a tenth of what the first one did.
_REPEATS, _ENOUGH = 4, 0.1


def can_be_swept_by_blocks(mdp: TabularMDP) -> bool:
    """Whether a range of its states can be swept alone, and more than once."""
    return mdp.gamma < 1 and mdp.age is None


def blocked_fixed_point(
    backup: Backup[TabularMDP],
    tolerance: float,
    blocks: int,
    progress: Callable[[int, float], None] | None = None,
    x: np.ndarray | None = None,
) -> FixedPoint:
    """The fixed point of a backup, by sweeps of `blocks` ranges of the states.

    Args:
        progress: called with the number of rounds and the largest bound of a range.
        x: where to sweep, from any finite values; None: from zeros.
    Returns:
        Values and their bound; by `fixed_point`, of all ranges at once, where rounds would not end (near gamma = 1).
    Raises:
        PrecisionError: floats cannot reach the tolerance.
    """
    mdp = backup.mdp
    convergence = Convergence(mdp, backup, tolerance, progress)
    x = backup.zeros() if x is None else x
    cuts = [mdp.num_states * i // blocks for i in range(blocks + 1)]
    moved = np.full((blocks, blocks), math.inf)  # by how much range b has changed, at most, since range c was swept
    sweeps, largest = 0.0, largest_of(x)
    while True:
        for c in range(blocks - 1, -1, -1):
            if _bound(backup, moved[c], largest) <= tolerance:
                continue
            total, last, count = _swept(backup, x, (cuts[c], cuts[c + 1]), largest, tolerance)
            sweeps += count / blocks
            largest += total
            moved[:, c] = np.nextafter(moved[:, c] + total, math.inf)
            moved[c] = 0.0
            moved[c, c] = last
        largest = largest_of(x)
        if convergence.is_met(max(_bound(backup, each, largest) for each in moved)):
            return FixedPoint(x, convergence.bound, math.ceil(sweeps))
        if convergence.is_endless():
            return fixed_point(mdp, backup.select, tolerance, progress, x, backup.threads, backup.dtype)
        convergence.check(True, backup.patience)


def _swept(
    backup: Backup[TabularMDP], x: np.ndarray, part: tuple[int, int], largest: float, tolerance: float
) -> tuple[float, float, int]:
    """Sweep a range some times; return (change of its values in all, change in the last sweep, sweeps)."""
    total = first = change = 0.0
    count = 0
    while count < _REPEATS:
        count += 1
        change = backup.changed(backup.sweep(x, part), largest + total)
        total = math.nextafter(total + change, math.inf)
        first = first or change
        if change <= _ENOUGH * first or _bound(backup, np.array([change]), largest + total) <= tolerance:
            break
    return total, change, count


def _bound(backup: Backup[TabularMDP], moved: np.ndarray, largest: float) -> float:
    """Residual of a range whose inputs have changed by at most `moved`, divided by 1 - rho."""
    change = float(moved.max())
    return backup.bound(change, backup.rounding(backup.size(largest + change)))


# Policy values --------------------------------------------------------------------------------------------------------


@require_mdp
def evaluate_policy(
    mdp: TabularMDP,
    policy: TablePolicy,
    tolerance: float = 1e-6,
    *,
    horizon: int | None = None,
    processes: int | str = 1,
    checkpoint: str | os.PathLike | None = None,
) -> Solution:
    """The values of a policy over states; `pharos.evaluate_policy` also takes policies that see observations.

    V(s) = sum_a pi(a | s) q(s, a), q(s, a) = r(s, a) + gamma E V(next); chance acts between what the policy chooses and
    what is executed, see `random_actions` and `sticky_actions`.

    Args:
        policy: (S,) integers, an action for each state; or (S, A) probabilities. Under sticky actions also (S, A + 1)
            integers or (S, A + 1, A) probabilities, for each previously executed action and, last, for none; or a
            function from an array of state indices to either; or an agent with such a `policy_table()`.
        tolerance: every value is within this of the true one, proven.
        horizon: number of steps to go, instead of the MDP's own.
        processes, checkpoint: as `value_iteration` takes them.
    Returns:
        A Solution of kind "policy". A deterministic policy on a deterministic MDP is evaluated on its functional graph,
        in O(S), exactly up to rounding, whatever the tolerance.
    Raises:
        ParameterError: the policy has the wrong shape, or its rows are not probabilities.
        DivergenceError: gamma is 1, there is no horizon, and the value is or may be infinite.
        PrecisionError: 64-bit floats cannot reach the tolerance, or hold the values.
    Source: Puterman (1994), section 6.1.
    """
    check_tolerance(tolerance)
    horizon = checked_horizon(mdp, horizon)
    if isinstance(policy, TableAgent):
        policy = policy.policy_table()
    watch = Stopwatch()
    select = PolicyTable.of(mdp, policy)
    is_shared = is_distributed(processes, checkpoint)
    if select.actions is not None and mdp.is_deterministic and horizon is None and not is_shared:
        return _on_its_graph(mdp, select, watch)
    return solution_of(mdp, select, tolerance, horizon=horizon, processes=processes, checkpoint=checkpoint)


def evaluate_parts(
    mdp: TabularMDP, policy: np.ndarray, part: np.ndarray, start_probabilities: np.ndarray
) -> list[tuple[float, float]]:
    """(value at the start, its error bound) of each part of an MDP with a horizon, to the bits that it has alone.

    Args:
        mdp: disjoint parts without transitions between them, such as copies of one MDP.
        policy: as `evaluate_policy` takes actions, or probabilities.
        part: (S,) the part of each state, 0 to P - 1; each has states, and as many starts.
        start_probabilities: (N,) of the starts of each part.
    Cost: one backward induction of all of them, instead of P.
    """
    select = PolicyTable.of(mdp, policy)
    backup = Backup(mdp, select)
    order = np.argsort(part, kind="stable")
    begins = np.searchsorted(part[order], np.arange(part.max() + 1))

    def largest(entries: np.ndarray) -> np.ndarray:
        """(P,) maximum of the entries (S, ...) over the states of each part."""
        of_states: np.ndarray = entries.reshape(len(part), -1).max(axis=1)
        return np.maximum.reduceat(of_states[order], begins)

    rewards, factors = largest(np.abs(mdp.reward_table.array)), np.full(len(begins), backup.factor)
    if select.actions is None:
        sums = largest(select.probabilities.sum(axis=2)).tolist()
        factors = np.array([backup.factor_of(mass_of(each, mdp.num_actions)) for each in sums])
    x, before = backup.zeros(), backup.zeros()
    bounds, sizes = np.zeros(len(begins)), np.zeros(len(begins))
    for _ in range(checked_horizon(mdp, None) or 0):
        before, x = x, backup(x, before)
        bounds = factors * bounds + backup.rounding_of(rewards, sizes) + mdp.residual.deviation(mdp.gamma, sizes)
        sizes = largest(np.abs(x[:-1]))
    starts = mdp.start_states[np.argsort(part[mdp.start_states], kind="stable")].reshape(len(begins), -1)
    solution = Solution(mdp, 0.0, 0, 0.0, mdp.horizon, select, x, before)
    values = [solution.value_from(states, start_probabilities) for states in starts]
    return list(zip(values, (bounds * MARGIN).tolist(), strict=True))


@require_mdp
def uniform_policy(mdp: TabularMDP) -> np.ndarray:
    """(S, A) probabilities, all 1 / A."""
    return np.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions)


def _on_its_graph(mdp: TabularMDP, select: PolicyTable, watch: Stopwatch) -> Solution:
    assert select.actions is not None
    successor, reward = chain(mdp, select.actions)
    x = np.zeros((mdp.num_states + 1, 1))
    x[:-1, 0], infinite = chain_values(mdp.gamma, successor, reward)
    if infinite >= 0:
        raise DivergenceError(
            f"{mdp}: gamma is 1, there is no horizon, and the policy goes round in a cycle through state {infinite} "
            "that pays; give a horizon, or gamma < 1"
        )
    bound = chain_bound(mdp, select, x, successor, reward)
    return Solution(mdp, bound, 1, watch.seconds, None, select, x, x)
