"""The values of many policies of one small MDP: evaluated at once, as one policy of as many copies of it.

A policy is asked in all states in one go, and what it reaches is found, and evaluated, with what the others reach.
`evaluate_seeing` gives the same values one by one, to the bit, and those of larger MDPs.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pharos import solvers
from pharos.mdp import Rewards, Table, TabularMDP
from pharos.policies.evaluation import Evaluation
from pharos.policies.query import TableAnswers

MOST_ROWS = 1 << 16  # pairs of a state and what came before, so that all of them may be reached
MOST_TOGETHER = 1 << 18  # of all copies


def is_small_table(mdp: TabularMDP) -> bool:
    """Whether policies of the MDP can be evaluated together: it has a horizon, few states, and one next state each."""
    rows = mdp.num_states * (mdp.num_actions + 1 if mdp.is_sticky else 1)
    is_small = mdp.horizon is not None and rows <= MOST_ROWS and not mdp.laziness
    return is_small and mdp.dynamics.deterministic_table() is not None


def table_values(mdp: TabularMDP, policies: Sequence[np.ndarray]) -> list[Evaluation]:
    """The values from the start of N policies, (S, A) probabilities each, in an MDP of which `is_small_table` holds.

    Cost: one walk through what is reached and one backward induction for all, in some groups where they are large.
    """
    rows = mdp.num_states * (mdp.num_actions + 1 if mdp.is_sticky else 1)
    size = max(1, MOST_TOGETHER // rows)
    return [each for first in range(0, len(policies), size) for each in _values(mdp, policies[first : first + size])]


def _values(mdp: TabularMDP, policies: Sequence[np.ndarray]) -> list[Evaluation]:
    number = len(policies)
    answers = TableAnswers(np.concatenate(policies), _copies(mdp, number))
    answers.reach(None, mdp.horizon)
    rows = answers.rows
    states = np.unique(rows // answers.width) if mdp.is_sticky else rows
    values = solvers.evaluate_apart(*answers.reached_mdp(), states // mdp.num_states, mdp.start_probabilities)
    counts = np.bincount(rows // (answers.width * mdp.num_states), minlength=number).tolist()
    return [Evaluation(value, True, bound, count) for (value, bound), count in zip(values, counts, strict=True)]


def whole_values(mdp: TabularMDP, policies: Sequence[np.ndarray]) -> list[Evaluation]:
    """The same for policies (S,) of actions, which are evaluated in all states, as tables are."""
    size = max(1, MOST_TOGETHER // (mdp.num_states * mdp.width))
    evaluations = []
    for first in range(0, len(policies), size):
        group = policies[first : first + size]
        part = np.repeat(np.arange(len(group)), mdp.num_states)
        values = solvers.evaluate_apart(_copies(mdp, len(group)), np.concatenate(group), part, mdp.start_probabilities)
        evaluations += [Evaluation(value, True, bound, mdp.num_states) for value, bound in values]
    return evaluations


def _copies(mdp: TabularMDP, number: int) -> TabularMDP:
    """The MDP beside itself: state s of copy i has the number i S + s."""
    table, rewards = np.asarray(mdp.dynamics.deterministic_table(), np.int64), mdp.reward_table
    first = np.arange(number) * mdp.num_states
    following = np.where(table < 0, -1, table + first[:, None, None]).reshape(-1, mdp.num_actions)
    return replace(
        mdp,
        dynamics=Table(following),
        reward_table=Rewards(np.tile(rewards.table, (number, 1)), rewards.palette),
        terminal=np.tile(np.asarray(mdp.terminal), number),
        start_states=(mdp.start_states + first[:, None]).ravel(),
        start_probabilities=np.tile(mdp.start_probabilities / number, number),
        folder=None,
        age=None,
        staying=None,
    )
