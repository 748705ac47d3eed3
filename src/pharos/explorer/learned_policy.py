"""Learnt policy of a run: its table, its value, and its losses."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP
from pharos.policies import PolicyAnswers, PolicyLike, Sight, TabularAgent, evaluate_policy
from pharos.solvers import Solution
from pharos.state_space import StateSpace

OPTIMAL, UNIFORM, LEARNT = "optimal", "uniform", "learnt"  # the policies, by name
ASKED_EVERYWHERE = 200_000  # states and, where it matters, previous actions; above, a policy is asked where it gets to


@dataclass(frozen=True, eq=False)
class Learnt:
    """A policy to look at.

    Attributes:
        policy: a table, or what sees observations.
        name: for people.
        observation, observation_options, previous_action: what it sees, where it is no table.
        facts: what is known of it, such as the regret of its run: name -> text.
    """

    policy: PolicyLike
    name: str = "learnt"
    observation: Any = "vector"
    observation_options: Mapping[str, Any] = field(default_factory=dict)
    previous_action: bool = False
    facts: Mapping[str, str] = field(default_factory=dict)

    def solution(self, mdp: TabularMDP, space: StateSpace | None) -> Solution:
        """Its values; NaN where it does not get to and was not asked.

        Raises:
            ParameterError: it does not fit the MDP, or its values belong to no state, as it sees more than the state.
        """
        policy = self.policy.policy_table() if isinstance(self.policy, TabularAgent) else self.policy
        if isinstance(policy, np.ndarray):
            return evaluate_policy(mdp, policy)
        if space is None or space.environment is None:
            raise ParameterError("a policy of observations needs an environment that is known; give it as a table")
        sight = Sight(space, space.environment, self.observation, dict(self.observation_options), self.previous_action)
        width = mdp.policy_width
        options = {"observation": self.observation, "observation_options": self.observation_options}
        if sight.frames > 1 or mdp.num_states * width > ASKED_EVERYWHERE or (self.previous_action and width == 1):
            return evaluate_policy(mdp, policy, **options, previous_action=self.previous_action)
        answers = PolicyAnswers(policy, mdp, sight)
        table = answers.of(np.arange(mdp.num_states * width))
        return evaluate_policy(mdp, table.reshape(mdp.num_states, width, -1) if width > 1 else table)


def probabilities(solution: Solution, states: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """(N, A) what a given policy does in states after executing actions (N,), A where there was none before."""
    table, num_actions = np.asarray(solution.given_policy), solution.mdp.num_actions
    if table.ndim == 1:
        return np.eye(num_actions)[table[states]]
    return table[states] if table.ndim == 2 else table[states, previous]
