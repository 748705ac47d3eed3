"""How often policies are in states, and what they lose there."""

from typing import TYPE_CHECKING

import numpy as np

from pharos.explorer.learned_policy import OPTIMAL, UNIFORM
from pharos.hardness import discounted_visits, occupancy

if TYPE_CHECKING:
    from pharos.explorer.exploration import Exploration


class Visits:
    """How often policies are in states, discounted, from the start: d(s) = sum over t of gamma^t P(s_t = s)."""

    def __init__(self, exploration: "Exploration"):
        self.exploration, self._known = exploration, dict[str, np.ndarray]()

    def pairs(self, policy: str) -> np.ndarray:
        """(S, A) visits of a state in which the policy chooses an action."""
        mdp = self.exploration.mdp
        table = self._table(policy)
        if mdp.is_sticky:
            return occupancy(mdp, table).visits
        visits = self.of(policy)
        if table is None:
            return np.repeat(visits[:, None] / mdp.num_actions, mdp.num_actions, axis=1)
        return visits[:, None] * (np.eye(mdp.num_actions)[table] if table.ndim == 1 else table)

    def of(self, policy: str) -> np.ndarray:
        """(S,) visits of states; kept for the next time."""
        if policy not in self._known:
            self._known[policy] = discounted_visits(self.exploration.mdp, self._table(policy))[0]
        return self._known[policy]

    def losses(self, policy: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(S,) each: what is lost in states, visits, and the action chosen most.

            loss(s) = sum over a of visits(s, a) gap(s, a), which sums to V* minus the value of the policy at the start

        Source: the performance difference lemma, Kakade and Langford (2002).
        """
        world = self.exploration
        mdp, pairs = world.mdp, self.pairs(policy)
        states = np.flatnonzero(pairs.any(axis=1))
        executed = world.solutions[OPTIMAL].q_of(states)
        gaps = executed.max(axis=1, keepdims=True) - executed
        lost = np.zeros(mdp.num_states)
        lost[states] = mdp.chance.chosen * (pairs[states] * gaps).sum(axis=1)
        if mdp.is_sticky:  # the first step, which has no action before
            first = np.flatnonzero(mdp.start_probabilities > 0)
            starts, weights = mdp.start_states[first], mdp.start_probabilities[first]
            q = world.solutions[OPTIMAL].q_of(starts)
            chances = world.chances(policy, starts, world.chosen_values(OPTIMAL, starts))
            more = (mdp.chance.first_chosen - mdp.chance.chosen) * chances * (q.max(axis=1, keepdims=True) - q)
            np.add.at(lost, starts, weights * more.sum(axis=1) * ~mdp.terminal[starts])
        visits = pairs.sum(axis=1)
        return lost, visits, pairs.argmax(axis=1)

    def _table(self, policy: str) -> np.ndarray | None:
        """The policy as solvers take it; None for the uniform one. Where it was not asked, it does anything."""
        if policy == UNIFORM:
            return None
        table = np.asarray(self.exploration.solutions[policy].policy)
        if table.dtype.kind != "f" or not np.isnan(table).any():
            return table
        return np.where(np.isnan(table), 1 / self.exploration.mdp.num_actions, table)
