"""Values of a given policy: on its functional graph where everything is deterministic, else by iteration."""

import time
from typing import Any

import numpy as np

from pharos.errors import DivergenceError, ParameterError
from pharos.mdp import PolicyTable, TabularMDP
from pharos.solvers.fixed_point import chain_bound
from pharos.solvers.policy_iteration import chain, chain_values
from pharos.solvers.solution import Solution
from pharos.solvers.values import check_tolerance, checked_horizon, solution_of


def evaluate_policy(
    mdp: TabularMDP,
    policy: Any,
    tolerance: float = 1e-6,
    *,
    horizon: int | None = None,
    observation: Any = None,
    **seeing: Any,
) -> Solution:
    """The values of a policy.

    V(s) = sum_a pi(a | s) q(s, a), q(s, a) = r(s, a) + gamma E V(next); chance acts between what the policy chooses and what
    is executed, see `random_actions` and `sticky_actions`.

    Args:
        policy: (S,) integers, an action for each state; or (S, A) probabilities. Under sticky actions also (S, A + 1)
            integers or (S, A + 1, A) probabilities, for each previously executed action and, last, for none; or a function
            from an array of state indices to either. Or a policy that sees observations: a model of Stable-Baselines3, or,
            with `observation`, a function of a batch of observations that returns (N, A) probabilities or (N,) actions.
        tolerance: every value is within this of the true one, proven.
        horizon: number of steps to go, instead of the MDP's own.
        observation: what the policy sees, a name or an Observation; of models "vector" when not given.
        seeing: further options of policies that see observations: `observation_options`, a dictionary; `previous_action`,
            whether they see it, under sticky actions; `deterministic`, whether the most probable action is taken.
    Returns:
        A Solution of kind "policy". A deterministic policy on a deterministic MDP is evaluated on its functional graph, in
        O(S), exactly up to rounding, whatever the tolerance. A policy that sees observations is asked only in the states that
        it reaches from the start; values elsewhere are NaN.
    Raises:
        ParameterError: the policy has the wrong shape, or its rows are not probabilities; or it sees observations, and the MDP
            was not made from a state space.
        DivergenceError: gamma is 1, there is no horizon, and the value is or may be infinite.
        PrecisionError: 64-bit floats cannot reach the tolerance, or hold the values.
    Source: Puterman (1994), section 6.1.
    """
    check_tolerance(tolerance)
    horizon = checked_horizon(mdp, horizon)
    if hasattr(policy, "policy_table"):
        policy = policy.policy_table()
    if observation is not None or hasattr(policy, "action_probabilities") or hasattr(policy, "predict"):
        from pharos.experiments.evaluation import evaluate_observing

        timed = mdp if horizon == mdp.horizon else mdp.with_horizon(horizon)
        return evaluate_observing(timed, policy, tolerance, observation=observation or "vector", **seeing)
    if seeing:
        raise ParameterError(f"{', '.join(seeing)} given for a policy that sees no observations; name the observation")
    began = time.perf_counter()
    select = PolicyTable.of(mdp, policy)
    if select.actions is not None and mdp.is_deterministic and horizon is None:
        return _on_its_graph(mdp, select, began)
    if horizon is None and mdp.gamma == 1.0:
        raise DivergenceError(
            f"{mdp}: gamma is 1 and there is no horizon, so the value may be infinite; give one, or gamma < 1"
        )
    return solution_of(mdp, select, tolerance, horizon)


def uniform_policy(mdp: TabularMDP) -> np.ndarray:
    """(S, A) probabilities, all 1 / A."""
    return np.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions)


def _on_its_graph(mdp: TabularMDP, select: PolicyTable, began: float) -> Solution:
    assert select.actions is not None
    successor, reward = chain(mdp, select.actions)
    x = np.zeros((mdp.num_states + 1, 1))
    x[:-1, 0], infinite = chain_values(mdp.gamma, successor, reward)
    if infinite >= 0:
        raise DivergenceError(
            f"{mdp}: gamma is 1, there is no horizon, and the policy goes round in a cycle through state {infinite} that pays; "
            f"give a horizon, or gamma < 1"
        )
    bound = chain_bound(mdp, select, x, successor, reward)
    return Solution(mdp, bound, 1, time.perf_counter() - began, None, select, x, x)
