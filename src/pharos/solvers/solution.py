"""Solution: values of a policy, the policy, and their error bound."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pharos.mdp import Selection, TabularMDP, available_choices

# States whose greedy actions are worked out in one go.
_GREEDY_BLOCK = 1 << 20


@dataclass(frozen=True, eq=False)
class Solution:
    """Values of the optimal policy, or of a given one.

    Attributes:
        mdp: what was solved.
        error_bound: every entry of `v` and `q` is within this of the true value (proven; in units of return). If the
            probabilities of the MDP were rounded, also of the true value of each MDP within its `residual`; that part
            may exceed the tolerance.
        sweeps, seconds: cost of the solve; compiling is not among the seconds.
        horizon: number of steps to go of the values; or None.
        select: which action is chosen: the best one, the worst one, or the action of a policy.
        x: (S + 1, W) float64, or float32 if it was asked for: values of (state, previously executed action), W = A
            under sticky actions, else 1; row S, the end, is 0.
        next_x: the values of next states: x, or with a horizon those with one step less to go.
        proper: of total rewards, the policy: (S,) actions, or (S, A + 1) if it must look at the previous action; greedy
            ones may go round in a circle, as every state of it has the same value.
        all_steps: with a horizon, if they were kept: (T + 1, S), or (T + 1, S, A), row t with t steps to go.

    Under sticky actions values belong to pairs: `v` is (S, A), the value of (state, previously executed action), and
    `q` is (S, A), the value of executing an action. Otherwise `v` is (S,), and `q` (S, A) is the value of choosing an
    action.
    """

    mdp: TabularMDP
    error_bound: float
    sweeps: int
    seconds: float
    horizon: int | None
    select: Selection
    x: np.ndarray
    next_x: np.ndarray
    all_steps: np.ndarray | None = None
    proper: np.ndarray | None = None

    @property
    def gamma(self) -> float:
        """The discount of the values."""
        return self.mdp.gamma

    @property
    def kind(self) -> str:
        """ "optimal", "worst" or "policy"."""
        return self.select.kind

    @property
    def v(self) -> np.ndarray:
        """(S,) values; (S, A) under sticky actions."""
        return self.mdp.without_width(self.x[:-1])

    @property
    def q(self) -> np.ndarray:
        """(S, A) action values, of choosing; of executing under sticky actions. Computed anew by each call.

        Of actions that are not available -inf (inf in the solution of the worst policy), which no choice takes.
        """
        executed = self.q_of(slice(None))
        values = executed if self.mdp.is_sticky else self.mdp.chance.choice(executed, executed)
        if self.mdp.available is None:
            return values
        return np.where(self.mdp.available, values, np.inf if self.kind == "worst" else -np.inf)

    def q_of(self, states: np.ndarray | slice) -> np.ndarray:
        """(N, A), the values of executing each action in some states (indices or a slice).

        An action that is not available has the value of the first one that is, as which it acts.
        """
        next_values = self.mdp.dynamics.expected(self.next_x, states).astype(np.float64, copy=False)
        next_values = self.mdp.acting(next_values, states)
        return self.mdp.reward_table.rows(states) + self.mdp.gamma * next_values

    @cached_property
    def policy(self) -> np.ndarray:
        """The policy: for "optimal" and "worst" (S,) greedy actions, the first among equals; else the one given.

        Of total rewards (gamma 1, no horizon) it ends almost surely, unless it stays in a component in which nothing is
        paid; under sticky actions that may take (S, A + 1) actions, by the previous action.
        """
        if self.proper is not None:
            return self.proper
        policy_table = self.given_policy
        if policy_table is not None:
            return policy_table
        actions = np.empty(self.mdp.num_states, np.int64)
        for start in range(0, self.mdp.num_states, _GREEDY_BLOCK):
            block = slice(start, min(start + _GREEDY_BLOCK, self.mdp.num_states))
            greedy = self.select.policy(self.q_of(block)).table
            sets = None if self.mdp.available is None else self.mdp.available[block]
            actions[block] = available_choices(greedy, sets)
        return actions

    @property
    def given_policy(self) -> np.ndarray | None:
        """The policy that was evaluated: (S,) actions, (S, A) or (S, A + 1, A) probabilities; else None."""
        return getattr(self.select, "table", None)

    def optimal_actions(self, tie_tolerance: float = 1e-6) -> np.ndarray:
        """(S, A) bool: actions whose value is within `tie_tolerance` of the best."""
        q = self.q
        return q >= q.max(axis=1, keepdims=True) - tie_tolerance

    @property
    def value_at_start(self) -> float:
        """The expected value of an episode's first state."""
        return self.value_from(self.mdp.start_states, self.mdp.start_probabilities)

    def value_from(self, starts: np.ndarray, probabilities: np.ndarray) -> float:
        """The expected value of an episode's first state, drawn from other states or probabilities (N,)."""
        if not self.mdp.is_sticky:
            return float(probabilities @ self.v[starts])
        q = self.q_of(starts)
        chance = self.mdp.chance.first.at(starts)
        return float(probabilities @ chance.choice(q, self.select.first_value(q, starts))[:, 0])

    def conventions(self) -> dict[str, Any]:
        """Discount, horizon, kind and error bound of the values, JSON-able."""
        return {"gamma": self.gamma, "horizon": self.horizon, "kind": self.kind, "error_bound": self.error_bound}

    def __repr__(self) -> str:
        return (
            f"Solution({self.kind}, value_at_start={self.value_at_start:.6g}, error_bound={self.error_bound:.2g}, "
            f"sweeps={self.sweeps}, seconds={self.seconds:.2f})"
        )
