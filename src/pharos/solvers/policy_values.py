"""Values of a given policy: exact where everything is deterministic, else by iteration with a proven bound."""

import time
from typing import Any

import numpy as np

from pharos.errors import DivergenceError, ParameterError
from pharos.mdp import TabularMDP
from pharos.solvers.solution import Solution
from pharos.solvers.values import check_tolerance, checked_horizon, iterate, rounding


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

    V(s) = sum_a pi(a | s) q(s, a), q(s, a) = r(s, a) + gamma E V(next); chance acts between what the policy chooses and what is
    executed, see `random_actions` and `sticky_actions`.

    Args:
        policy: (S,) integers, an action for each state; or (S, A) probabilities. Under sticky actions also (S, A + 1)
            integers or (S, A + 1, A) probabilities, for each previously executed action and, last, for none; or a function
            from an array of state indices to either. Or a policy that sees observations: a model of Stable-Baselines3, or,
            with `observation`, a function of a batch of observations that returns (N, A) probabilities or (N,) actions.
        tolerance: every value is within this of the true one, proven.
        horizon: number of steps to go, instead of the MDP's own.
        observation: what the policy sees, a name or an Observation; of models "vector" when not given.
        seeing: further options of policies that see observations: `observation_options`, a dictionary; `previous_action`, whether
            they see it, under sticky actions; `deterministic`, whether the most probable action is taken.
    Returns:
        A Solution of kind "policy". A deterministic policy on a deterministic MDP is evaluated on its functional graph, in
        O(S), exactly up to rounding. A policy that sees observations is asked only in the states that it reaches from the
        start; values elsewhere are NaN.
    Raises:
        ParameterError: the policy has the wrong shape, or its rows are not probabilities; or it sees observations, and the MDP
            was not made from a state space.
        DivergenceError: gamma is 1, there is no horizon, and the value is or may be infinite.
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
    if callable(policy):
        policy = policy(np.arange(mdp.num_states))
    given = np.asarray(policy)
    began = time.perf_counter()
    if given.dtype.kind in "iu" and given.ndim == 1 and mdp.is_deterministic and horizon is None:
        _check_actions(mdp, given)
        return _chain(mdp, given, began)
    probabilities = _probabilities(mdp, given)
    if horizon is None and mdp.gamma == 1.0:
        raise DivergenceError(
            f"{mdp}: gamma is 1 and there is no horizon, so the value may be infinite; give one, or gamma < 1"
        )
    backup = _Backup(mdp, probabilities)
    if horizon is not None:
        x, before, bound = backup.x, backup.x, 0.0
        for _ in range(horizon):
            before, x = x, backup.backup(x)
            bound = mdp.gamma * bound + rounding(mdp, x)
        sweeps = horizon
    else:
        bound, sweeps = iterate(backup.sweep, mdp, backup.x, tolerance)
        x, before = backup.x, None
    v, q = (None, x[:-1]) if mdp.is_sticky else (x[:-1], None)
    v_next = before[:-1] if before is not None and not mdp.is_sticky else None
    seconds = time.perf_counter() - began
    return Solution(
        mdp, bound, sweeps, seconds, mdp.gamma, horizon, "policy", v, q, _v_next=v_next, _policy=probabilities
    )


def uniform_policy(mdp: TabularMDP) -> np.ndarray:
    """(S, A) probabilities, all 1 / A."""
    return np.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions)


def _chain(mdp: TabularMDP, actions: np.ndarray, began: float) -> Solution:
    from pharos.kernels.bellman import chain_values

    assert mdp.next_states is not None
    rows = np.arange(mdp.num_states)
    table = mdp.reward_table
    reward = table.palette[table.table[rows, actions]] if len(table.palette) else table.table[rows, actions]
    v = np.empty(mdp.num_states)
    successor = mdp.next_states[rows, actions].astype(np.int64)
    infinite = chain_values(successor, reward, mdp.gamma, v, np.empty(mdp.num_states, np.int64))
    if infinite >= 0:
        raise DivergenceError(
            f"{mdp}: gamma is 1, there is no horizon, and the policy goes round in a cycle through state {infinite} that pays; "
            f"give a horizon, or gamma < 1"
        )
    longest = mdp.num_states if mdp.gamma == 1.0 else 1 / (1 - mdp.gamma)
    bound = rounding(mdp, v) * longest
    return Solution(mdp, bound, 1, time.perf_counter() - began, mdp.gamma, None, "policy", v, None, _policy=actions)


class _Backup:
    """Backups of one policy over an MDP of any kind; x has one row more for the end."""

    def __init__(self, mdp: TabularMDP, probabilities: np.ndarray):
        self.mdp = mdp
        chance = mdp.chance
        shape = (mdp.num_states + 1, mdp.num_actions) if mdp.is_sticky else (mdp.num_states + 1,)
        self.x = np.zeros(shape)
        self.weights = (chance.chosen, chance.previous, chance.uniform)
        if mdp.is_sticky:
            self.policy = probabilities if probabilities.ndim == 3 else probabilities[:, None, :]
            self.policy = np.ascontiguousarray(self.policy)
        else:
            self.policy = np.ascontiguousarray(chance.chosen * probabilities + chance.uniform / mdp.num_actions)

    def sweep(self) -> float:
        from pharos.kernels import bellman

        mdp, table = self.mdp, self.mdp.reward_table
        if mdp.transitions is not None:
            new = self.backup(self.x)
            change = float(np.abs(new - self.x).max())
            self.x[:] = new
            return change
        arguments = (mdp.next_states, table.table, table.palette, mdp.gamma)
        if mdp.is_sticky:
            return bellman.sticky_policy_sweep(*arguments, self.weights, self.policy, self.x)
        return bellman.policy_sweep(*arguments, self.policy, self.x)

    def backup(self, x: np.ndarray) -> np.ndarray:
        """The backup of x, not in place; NumPy on whole arrays."""
        mdp, chance = self.mdp, self.mdp.chance
        num_states, num_actions = mdp.num_states, mdp.num_actions
        out = np.zeros_like(x)
        if not mdp.is_sticky:
            out[:-1] = (self.policy * (mdp.rewards + mdp.gamma * self._expected(x))).sum(axis=1)
            return out
        q = x[:-1]
        seen = self.policy[:, :num_actions] if self.policy.shape[1] > 1 else self.policy
        choice = (seen * q[:, None, :]).sum(axis=2)  # (S, A) or (S, 1)
        v = np.zeros((num_states + 1, num_actions))
        v[:-1] = chance.chosen * choice + chance.previous * q + chance.uniform * q.mean(axis=1, keepdims=True)
        for a in range(num_actions):
            out[:-1, a] = mdp.rewards[:, a] + mdp.gamma * self._expected_after(a, v[:, a])
        return out

    def _expected(self, v: np.ndarray) -> np.ndarray:
        """(S, A): the expected value of the next state; v (S + 1,)."""
        mdp = self.mdp
        if mdp.transitions is not None:
            return (mdp.transitions @ v[:-1]).reshape(mdp.num_states, mdp.num_actions)
        assert mdp.next_states is not None
        return v[mdp.next_states]

    def _expected_after(self, a: int, v: np.ndarray) -> np.ndarray:
        """(S,): the expected value of the next state after executing a."""
        mdp = self.mdp
        if mdp.transitions is not None:
            return mdp.transitions[a :: mdp.num_actions] @ v[:-1]
        assert mdp.next_states is not None
        return v[mdp.next_states[:, a]]


def _check_actions(mdp: TabularMDP, actions: np.ndarray) -> None:
    if actions.shape[0] != mdp.num_states:
        raise ParameterError(
            f"the policy has {actions.shape[0]} rows; expected {mdp.num_states}, one for each state of {mdp}"
        )
    wrong = np.argwhere((actions < 0) | (actions >= mdp.num_actions))
    if len(wrong):
        where = tuple(map(int, wrong[0]))
        raise ParameterError(
            f"the policy chooses action {actions[where]} at {where}; expected 0 to {mdp.num_actions - 1}"
        )


def _probabilities(mdp: TabularMDP, given: np.ndarray) -> np.ndarray:
    """(S, A), or under sticky actions also (S, A + 1, A), probabilities."""
    num_states, num_actions = mdp.num_states, mdp.num_actions
    if given.dtype.kind in "iu":
        if given.ndim > 2 or (given.ndim == 2 and not (mdp.is_sticky and given.shape[1] == num_actions + 1)):
            raise ParameterError(
                f"the policy has shape {given.shape}; expected ({num_states},) actions"
                + (f" or ({num_states}, {num_actions + 1}) for each previous action and none" if mdp.is_sticky else "")
            )
        _check_actions(mdp, given)
        return np.eye(num_actions)[given]
    shapes = [(num_states, num_actions)] + ([(num_states, num_actions + 1, num_actions)] if mdp.is_sticky else [])
    if given.shape not in shapes:
        raise ParameterError(
            f"the policy has shape {given.shape}; expected {' or '.join(map(str, shapes))} probabilities"
        )
    sums = given.sum(axis=-1)
    if not (np.isfinite(given).all() and (given >= 0).all() and (np.abs(sums - 1) < 1e-6).all()):
        row = np.unravel_index(int(np.argmax(np.where(np.isfinite(sums), np.abs(sums - 1), np.inf))), sums.shape)
        raise ParameterError(
            f"the policy's row {tuple(map(int, row))} is {given[row]}; expected probabilities that sum to 1"
        )
    return given.astype(np.float64)
