"""Losses of a policy state by state: the performance difference lemma, and the definition by a walk."""

import numpy as np
import pytest
from hypothesis import strategies as st

from pharos.hardness import occupancy
from pharos.mdp import TabularMDP
from pharos.policies import state_losses
from pharos.solvers import evaluate_policy, value_iteration
from strategies import examples, small_mdps


@pytest.mark.long
@examples(60, small_mdps(), st.integers(0, 2**32 - 1))
def test_losses_of_all_states_sum_to_the_regret(mdp, seed):
    mdp = mdp.with_horizon(None)
    policy = np.random.default_rng(seed).dirichlet(np.ones(mdp.num_actions), mdp.num_states)
    optimal, own = value_iteration(mdp), evaluate_policy(mdp, policy)
    first = policy[mdp.start_states] if mdp.is_sticky else None
    losses = state_losses(optimal, occupancy(mdp, policy).visits, first)
    expected = optimal.value_at_start - own.value_at_start
    within = 1e-6 + (optimal.error_bound + own.error_bound) / (1 - mdp.gamma)
    assert losses.shape == (mdp.num_states,) and (losses >= -within).all()
    assert losses.sum() == pytest.approx(expected, abs=within)


@pytest.mark.long
def test_a_state_loses_its_gap_as_often_as_it_is_visited():
    """State 0 pays 1 or nothing and goes on to state 1, which pays 1 or nothing and ends."""
    mdp = TabularMDP.from_arrays([[1, 1], [-1, -1]], [[1.0, 0.0], [1.0, 0.0]], gamma=0.5)
    optimal = value_iteration(mdp)
    always_second = occupancy(mdp, np.array([1, 1])).visits
    assert state_losses(optimal, always_second) == pytest.approx([1.0, 0.5])
    assert state_losses(optimal, occupancy(mdp, np.array([0, 1])).visits) == pytest.approx([0.0, 0.5])
    assert state_losses(optimal, np.zeros((2, 2))).tolist() == [0.0, 0.0]
