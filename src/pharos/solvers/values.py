"""Optimal values, worst values and values of uniform play.

Values of a given policy: on its functional graph if everything is deterministic, else by iteration.
"""

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from typing import Protocol, TypeAlias, Unpack, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from pharos.errors import DivergenceError
from pharos.mdp import (
    BEST,
    WORST,
    PolicyTable,
    Selection,
    TabularMDP,
    mass_of,
    random_actions,
    require_mdp,
    uniform_choice,
)
from pharos.solvers.convergence import precision_error
from pharos.solvers.fixed_point import (
    ROUNDING_MARGIN,
    Backup,
    backward_induction,
    chain_bound,
    fixed_point,
    within_residual,
)
from pharos.solvers.policy_iteration import chain, chain_values
from pharos.solvers.solution import Solution, Solving, SolvingOptions
from pharos.system import memory
from pharos.system.compiling import Stopwatch
from pharos.system.memory import kept_array
from pharos.system.records import takes

# Rows of values in a file that are read in one go.
_FILE_ROWS = 1 << 22
# Between two copies of values to their file.
_SECONDS = 600.0


@runtime_checkable
class TableAgent(Protocol):
    """An agent with a policy over the states."""

    def policy_table(self) -> np.ndarray:
        """(S,) actions, or probabilities, as `evaluate_policy` takes them."""


TablePolicy: TypeAlias = ArrayLike | Callable[[np.ndarray], ArrayLike] | TableAgent
"""A policy over states, as `evaluate_policy` takes it."""


@require_mdp
@takes(Solving)
def value_iteration(mdp: TabularMDP, tolerance: float | Solving = 1e-6, **options: Unpack[SolvingOptions]) -> Solution:
    """The optimal values of an MDP.

    V*(s) = max_a q(s, a), q(s, a) = r(s, a) + gamma E V*(next); with chance, see `random_actions` and `sticky_actions`.

    With gamma 1 and no horizon V* is the total reward: the supremum over policies whose expected sums of positive and
    of negative rewards are not both infinite. `policy` then reaches the end almost surely, wherever that is optimal.

    Args:
        tolerance: every value is proven to be within this of the optimal one, in units of return. With a horizon values
            are exact up to rounding, whatever the tolerance. Or all options as one `Solving`.
        options: other fields of `Solving`: horizon, keep_all, progress, values, processes, checkpoint, threads, dtype.
    Returns:
        A Solution of kind "optimal".
    Raises:
        DivergenceError: gamma is 1, there is no horizon, and from some state the value is infinite or no policy has
            one. The states and actions of the cycle are named.
        PrecisionError: 64-bit floats cannot reach the tolerance, or hold the values.
        ParameterError: options that do not go together, see `Solving`, or several processes and gamma = 1 without a
            horizon. RankFailed: another rank failed.
    Cost: O(S A) a sweep, 0.5 to 2 ns for each state and action on game graphs. Memory 8 bytes a state (8 A under sticky
        actions). If gamma is so near 1 that sweeps would be many: strongly connected components one after another
        if none has half of the states (48 bytes a state). Otherwise policy iteration: on the graph of the policy if
        nothing is left to chance (56 bytes a state then), else by a Krylov method whose operator is a sweep (10 vectors
        of values), and by elimination if that fails and nodes (states, under sticky actions pairs with the previous
        action) times actions are up to 2 million (up to 500 MB then), or nodes are up to 3000.
    Source: Bellman (1957); in place: Puterman (1994), section 6.3.3; the sticky equation: the pharos paper, appendix A.
    """
    return _solution(mdp, BEST, Solving.of(mdp, tolerance, options))


@require_mdp
@takes(Solving)
def worst_value(mdp: TabularMDP, tolerance: float | Solving = 1e-6, **options: Unpack[SolvingOptions]) -> Solution:
    """The values of the worst policy: as `value_iteration`, with its options, minimising."""
    return _solution(mdp, WORST, Solving.of(mdp, tolerance, options))


@require_mdp
@takes(Solving)
def uniform_value(mdp: TabularMDP, tolerance: float | Solving = 1e-6, **options: Unpack[SolvingOptions]) -> Solution:
    """The values of the uniformly random policy: every action is replaced by a uniform one, so nothing is chosen.

    The options are the same as for `value_iteration`.
    """
    return _solution(random_actions(mdp, 1.0), BEST, Solving.of(mdp, tolerance, options))


def _solution(mdp: TabularMDP, select: Selection, solving: Solving) -> Solution:
    """Solution under a selection of actions: a fixed point, or by backward induction if there is a horizon."""
    if solving.is_distributed:
        from pharos.solvers.ranked import shared_solution  # which few need

        return shared_solution(mdp, select, solving)
    watch = Stopwatch()
    if solving.horizon is not None:
        result, next_x, steps = backward_induction(mdp, select, solving.horizon, solving.keep_all)
        steps = None if steps is None else mdp.without_width(steps[:, :-1])
        return Solution(
            mdp, result.bound, result.sweeps, watch.seconds, solving.horizon, select, result.x, next_x, steps
        )
    if mdp.gamma == 1.0 and mdp.order() is None:
        return _until_the_end(mdp, select, solving, watch)
    mapped = None
    if solving.values is not None:
        mapped = _kept_values(solving.values, (mdp.num_states + 1, mdp.width), solving.dtype)
    backup = Backup(mdp, select, solving.threads, solving.dtype)
    with _in_memory(mapped, solving.progress) as (x, report):
        result = fixed_point(backup, solving.tolerance, report, x)
    x = result.x if mapped is None else mapped
    bound = within_residual(mdp, result.bound, x)
    return Solution(mdp, bound, result.sweeps, watch.seconds, None, select, result.x, x)


def _until_the_end(mdp: TabularMDP, select: Selection, solving: Solving, watch: Stopwatch) -> Solution:
    """Solution of total rewards: gamma is 1, there is no horizon, and states can be visited again."""
    from pharos.solvers.goals import total_reward  # which few need

    backup = Backup(mdp, select, dtype=solving.dtype)
    goals = total_reward(mdp, select, solving.tolerance, solving.progress)
    x = backup.zeros()
    x[:-1] = goals.v.reshape(mdp.num_states, mdp.width)
    largest = float(np.abs(goals.v).max(initial=0.0))
    rounding = 0.0 if goals.is_exact and not backup.is_single else backup.rounding(largest)
    bound = (float(goals.error.max(initial=0.0)) + rounding) * ROUNDING_MARGIN
    if not bound <= solving.tolerance and not any(mdp.residual):
        raise precision_error(mdp, bound, solving.tolerance, backup.is_single)
    if solving.values is not None:
        mapped = _kept_values(solving.values, x.shape, solving.dtype)
        mapped[:] = x
        x = mapped
    proper = None if isinstance(select, PolicyTable) else goals.policy_table(mdp)
    return Solution(mdp, bound, goals.improvements, watch.seconds, None, select, x, x, proper=proper)


def _kept_values(path: str | os.PathLike, shape: tuple[int, int], dtype: DTypeLike = np.float64) -> np.ndarray:
    """(S + 1, W) values mapped from a file of NumPy (.npy): those that it holds, or zeros in a new file.

    A bound holds from any values on (see fixed_point.py), so a file left in the middle of a sweep is a good start.
    Values that are not finite count as 0, and so does the last row, which is the end.

    Raises:
        FileFormatError: the file holds something else. FolderLocked: its values are in use. ParameterError:
        the file cannot be made.
    """
    x = kept_array(path, shape, dtype)
    for start in range(0, len(x), _FILE_ROWS):
        block = x[start : start + _FILE_ROWS]
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
    and copied to their file every ten minutes, if that costs little, and in the end, whatever ends it.
    """
    if mapped is None or mapped.nbytes <= memory.SMALL_BYTES or not memory.fits(mapped.nbytes, memory.SHARE_OF_VALUES):
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


# Policy values --------------------------------------------------------------------------------------------------------


@require_mdp
@takes(Solving)
def evaluate_policy(
    mdp: TabularMDP,
    policy: TablePolicy,
    tolerance: float | Solving = 1e-6,
    **options: Unpack[SolvingOptions],
) -> Solution:
    """The values of a policy over states. `pharos.evaluate_policy` also takes policies that see observations.

    V(s) = sum_a pi(a | s) q(s, a), q(s, a) = r(s, a) + gamma E V(next); chance acts between what the policy chooses and
    what is executed, see `random_actions` and `sticky_actions`.

    Args:
        policy: (S,) integers, an action for each state, or (S, A) probabilities. Under sticky actions also (S, A + 1)
            integers or (S, A + 1, A) probabilities, for each previously executed action and, last, for none. Or a
            function from an array of state indices to either, or an agent with such a `policy_table()`.
        tolerance: every value is within this of the true one, proven. Or all options as one `Solving`.
        options: as `value_iteration` takes them.
    Returns:
        A Solution of kind "policy". A deterministic policy on a deterministic MDP is evaluated on its functional graph,
        in O(S), exactly up to rounding, whatever the tolerance.
    Raises:
        ParameterError: the policy has the wrong shape, or its rows are not probabilities.
        DivergenceError: gamma is 1, there is no horizon, and the policy goes on for ever while something is paid.
        PrecisionError: 64-bit floats cannot reach the tolerance, or hold the values.
    Source: Puterman (1994), section 6.1.
    """
    solving = Solving.of(mdp, tolerance, options)
    if isinstance(policy, TableAgent):
        policy = policy.policy_table()
    watch = Stopwatch()
    select = PolicyTable.of(mdp, policy)
    is_plain = not solving.is_distributed and solving.values is None and solving.dtype == "float64"
    if select.actions is not None and mdp.is_deterministic and solving.horizon is None and is_plain:
        return _on_its_graph(mdp, select, watch)
    return _solution(mdp, select, solving)


def evaluate_parts(
    mdp: TabularMDP, policy: np.ndarray, part: np.ndarray, start_probabilities: np.ndarray
) -> list[tuple[float, float]]:
    """(value at the start, its error bound) of each part of an MDP with a horizon, to the bits that it has alone.

    Args:
        mdp: disjoint parts without transitions between them, such as copies of one MDP.
        policy: as `evaluate_policy` takes actions, or probabilities.
        part: (S,) the part of each state, 0 to P - 1. Each has states, and as many starts.
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
    for _ in range(mdp.horizon or 0):
        before, x = x, backup(x, before)
        bounds = factors * bounds + backup.rounding_of(rewards, sizes) + mdp.residual.deviation(mdp.gamma, sizes)
        sizes = largest(np.abs(x[:-1]))
    starts = mdp.start_states[np.argsort(part[mdp.start_states], kind="stable")].reshape(len(begins), -1)
    solution = Solution(mdp, 0.0, 0, 0.0, mdp.horizon, select, x, before)
    values = [solution.value_from(states, start_probabilities) for states in starts]
    return list(zip(values, (bounds * ROUNDING_MARGIN).tolist(), strict=True))


@require_mdp
def uniform_policy(mdp: TabularMDP) -> np.ndarray:
    """(S, A) probabilities, all 1 / A. If some actions are not available, 1 over the number of available ones."""
    return uniform_choice(mdp)


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
