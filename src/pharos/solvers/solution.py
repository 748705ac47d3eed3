"""Solution: values, policy, and the error bound that holds for them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pharos.mdp import TabularMDP


@dataclass(frozen=True, eq=False)
class Solution:
    """Values of the optimal policy, or of a given one.

    Attributes:
        mdp: what was solved.
        error_bound: every entry of `v` and `q` is within this of the true value (proven; in units of return).
        sweeps, seconds: what it took.
        gamma, horizon: of the values; with a horizon they are those of the first step, with all steps to go.
        kind: "optimal", "worst" or "policy".
    Under sticky actions values belong to pairs: `v` is (S, A), the value of (state, previously executed action), and `q` is
    (S, A), the value of executing an action. Otherwise `v` is (S,), and `q` (S, A) is the value of choosing an action.
    """

    mdp: TabularMDP
    error_bound: float
    sweeps: int
    seconds: float
    gamma: float
    horizon: int | None
    kind: str
    _v: np.ndarray | None  # (S,) where not sticky
    _q: np.ndarray | None  # (S, A) value of executing, where sticky
    _v_next: np.ndarray | None = None  # (S,) values with one step less to go, with a horizon
    _policy: np.ndarray | None = None  # of a given policy: (S, A) or (S, B, A) probabilities, or (S,) actions
    all_steps: np.ndarray | None = None

    @cached_property
    def v(self) -> np.ndarray:
        """(S,) values; (S, A) under sticky actions."""
        if self._v is not None:
            return self._v
        assert self._q is not None
        chance, q = self.mdp.chance, self._q
        choice = self._choice(q)  # (S,), or (S, A) where the policy looks at the previous action
        if choice.ndim == 1:
            choice = choice[:, None]
        return chance.previous * q + choice + chance.uniform * q.mean(axis=1, keepdims=True)

    @property
    def q(self) -> np.ndarray:
        """(S, A) action values; computed anew by each call where they are not stored."""
        if self._q is not None:
            return self._q
        executed = self.q_of(slice(None))
        if not self.mdp.is_random:
            return executed
        chance = self.mdp.chance
        return chance.chosen * executed + chance.uniform * executed.mean(axis=1, keepdims=True)

    def q_of(self, states: Any) -> np.ndarray:
        """(N, A), the values of executing each action in some states (indices or a slice)."""
        if self._q is not None:
            return self._q[states]
        v = self._v_next if self._v_next is not None else self._v
        assert v is not None
        rewards = self.mdp.reward_table.rows(states)
        if self.mdp.transitions is not None:
            following = (self.mdp.transitions @ v).reshape(self.mdp.num_states, self.mdp.num_actions)[states]
            return rewards + self.gamma * following
        assert self.mdp.next_states is not None
        table = self.mdp.next_states[states]
        return rewards + self.gamma * np.where(table >= 0, v[table], 0.0)

    @cached_property
    def policy(self) -> np.ndarray:
        """The policy: for "optimal" and "worst" (S,) greedy actions, the first among equals; else the one given."""
        if self._policy is not None:
            return self._policy
        sign = -1 if self.kind == "worst" else 1
        actions = np.empty(self.mdp.num_states, np.int64)
        for start in range(0, self.mdp.num_states, 1 << 20):
            block = slice(start, min(start + (1 << 20), self.mdp.num_states))
            actions[block] = np.argmax(sign * self.q_of(block), axis=1)
        return actions

    def optimal_actions(self, tie_tolerance: float = 1e-6) -> np.ndarray:
        """(S, A) bool: actions whose value is within `tie_tolerance` of the best."""
        q = self.q
        return q >= q.max(axis=1, keepdims=True) - tie_tolerance

    @property
    def value_at_start(self) -> float:
        """The expected value of an episode's first state."""
        starts, probabilities = self.mdp.start_states, self.mdp.start_probabilities
        if self._v is not None:
            return float(probabilities @ self._v[starts])
        assert self._q is not None
        chance, q = self.mdp.chance, self._q[starts]
        if self.kind == "policy":
            assert self._policy is not None
            policy = self._policy[starts]
            no_previous = (
                policy if policy.ndim == 2 else policy[:, -1] if policy.shape[1] > q.shape[1] else policy.mean(axis=1)
            )
            first = (no_previous * q).sum(axis=1)
        else:
            first = -(-q).max(axis=1) if self.kind == "worst" else q.max(axis=1)
        return float(probabilities @ (chance.first_chosen * first + chance.first_uniform * q.mean(axis=1)))

    def conventions(self) -> dict[str, Any]:
        """What the values mean, JSON-able."""
        return {"gamma": self.gamma, "horizon": self.horizon, "kind": self.kind, "error_bound": self.error_bound}

    def _choice(self, q: np.ndarray) -> np.ndarray:
        """chosen * (value of what the policy chooses), for each state (and previous action where it looks at it)."""
        chosen = self.mdp.chance.chosen
        if self.kind == "optimal":
            return chosen * q.max(axis=1)
        if self.kind == "worst":
            return chosen * q.min(axis=1)
        assert self._policy is not None
        if self._policy.ndim == 2:
            return chosen * (self._policy * q).sum(axis=1)
        return chosen * (self._policy[:, : q.shape[1]] * q[:, None, :]).sum(axis=2)

    def __repr__(self) -> str:
        return (
            f"Solution({self.kind}, value_at_start={self.value_at_start:.6g}, error_bound={self.error_bound:.2g}, "
            f"sweeps={self.sweeps}, seconds={self.seconds:.2f})"
        )
