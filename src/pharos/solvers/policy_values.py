"""Values of a given policy: on its functional graph where everything is deterministic, else by iteration."""

import os
from typing import Any

import numpy as np

from pharos.errors import DivergenceError
from pharos.mdp import PolicyTable, TabularMDP, mass_of, require_mdp
from pharos.solvers.distributed import DistributedOptions
from pharos.solvers.fixed_point import MARGIN, Backup, chain_bound
from pharos.solvers.policy_iteration import chain, chain_values
from pharos.solvers.solution import Solution
from pharos.solvers.values import check_tolerance, checked_horizon, solution_of
from pharos.system.compiling import Stopwatch


@require_mdp
def evaluate_policy(
    mdp: TabularMDP,
    policy: Any,
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
    if hasattr(policy, "policy_table"):
        policy = policy.policy_table()
    watch = Stopwatch()
    select = PolicyTable.of(mdp, policy)
    sharing = DistributedOptions(processes, checkpoint)
    if select.actions is not None and mdp.is_deterministic and horizon is None and not sharing.is_wanted:
        return _on_its_graph(mdp, select, watch)
    return solution_of(mdp, select, tolerance, horizon, sharing=sharing)


def evaluate_apart(
    mdp: TabularMDP, policy: np.ndarray, part: np.ndarray, start_probabilities: np.ndarray
) -> list[tuple[float, float]]:
    """(value at the start, its error bound) of each part of an MDP with a horizon, to the bits that it has alone.

    Args:
        mdp: of parts that never meet, such as copies of one MDP.
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
        """(P,) of the entries (S, ...) of its states."""
        of_states: np.ndarray = entries.reshape(len(part), -1).max(axis=1)
        return np.maximum.reduceat(of_states[order], begins)

    rewards, factors = largest(np.abs(mdp.reward_table.array)), np.full(len(begins), backup.factor)
    if select.actions is None:
        sums = largest(select.probabilities.sum(axis=2)).tolist()
        factors = np.array([backup.factor_of(mass_of(each, mdp.num_actions)) for each in sums])
    x = before = backup.zeros()
    bounds, sizes = np.zeros(len(begins)), np.zeros(len(begins))
    for _ in range(checked_horizon(mdp, None) or 0):
        before, x = x, backup(x)
        bounds = factors * bounds + backup.rounding_of(rewards, sizes)
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
