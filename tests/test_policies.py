"""Policies asked in the states that they reach: on any kind of MDP, what they reach has the values of the whole."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pharos.mdp import TabularMDP
from pharos.policies import TableAnswers, evaluate_seeing
from pharos.solvers import evaluate_policy
from strategies import small_mdps


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(small_mdps(), st.integers(0, 10**6), st.sampled_from([None, 3]))
def test_what_a_policy_reaches_has_the_values_of_the_whole_mdp(mdp, seed, horizon):
    mdp, rng = mdp.with_horizon(horizon), np.random.default_rng(seed)
    table = rng.dirichlet(np.ones(mdp.num_actions), mdp.num_states)
    table[rng.random(len(table)) < 0.5] = np.eye(mdp.num_actions)[0]
    answers = TableAnswers(table, mdp)
    assert answers.reach()
    reached, policy = answers.reached_mdp()
    assert reached.num_states <= mdp.num_states
    whole, part = evaluate_policy(mdp, table, 1e-9), evaluate_policy(reached, policy, 1e-9)
    assert abs(whole.value_at_start - part.value_at_start) <= whole.error_bound + part.error_bound


@pytest.mark.parametrize("seed", range(3))
def test_an_estimate_on_a_general_mdp_holds_the_value(seed):
    rng = np.random.default_rng(seed)
    matrix = 0.9 * rng.dirichlet(np.ones(4), (4, 2))
    mdp = TabularMDP.from_matrices(matrix, rng.random((4, 2)), gamma=1.0, horizon=5)
    table = np.full((4, 2), 0.5)
    estimate = evaluate_seeing(table, mdp, None, lambda: (0.0, 5.0), max_states=0, episodes=2000, seed=seed)
    assert not estimate.exact and estimate.episodes == 2000
    assert abs(estimate.value - evaluate_policy(mdp, table).value_at_start) <= estimate.error_bound
