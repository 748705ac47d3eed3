"""Policies asked in the states that they reach: on any kind of MDP, what they reach has the values of the whole."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive import exact
from pharos import evaluate_policy as evaluate_policy_of_any_kind
from pharos.errors import ParameterError
from pharos.mdp import TabularMDP, sticky_actions
from pharos.policies import TableAnswers, policy_value, walk_values
from pharos.policies.value import _half_width, steps_that_matter
from pharos.solvers import evaluate_policy
from refusals import failing
from strategies import examples, small_mdps


@pytest.mark.long
@examples(100, small_mdps(), st.integers(0, 10**6), st.sampled_from([None, 3]))
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
    mdp = TabularMDP.from_matrices(matrix, rng.random((4, 2)), gamma=1.0, horizon=5, ends=True)
    table = np.full((4, 2), 0.5)
    estimate = policy_value(table, mdp, None, lambda: (0.0, 5.0), max_states=0, episodes=2000, seed=seed)
    assert not estimate.exact and estimate.episodes == 2000
    assert abs(estimate.value - evaluate_policy(mdp, table).value_at_start) <= estimate.error_bound


def test_the_interval_of_an_estimate_is_that_of_maurer_and_pontil():
    """Theorem 4 on each side, with a risk of 0.005; returns 0, 1, 1 of [0, 1] have a variance of 1/3."""
    log = math.log(2 / 0.005)
    expected = math.sqrt(2 * (1 / 3) * log / 3) + 7 * log / (3 * 2)
    assert _half_width(np.array([0.0, 1.0, 1.0]), 0.0, 1.0) == pytest.approx(expected, rel=1e-14)
    assert expected == pytest.approx(8.14392, abs=1e-5)


@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_the_value_of_a_walk_is_within_its_bound(gamma):
    rewards = [[0.1], [0.2], [0.3]]
    mdp = TabularMDP.from_arrays([[1], [2], [-1]], rewards, gamma=gamma, horizon=3)
    (found,) = walk_values([mdp], np.zeros_like)
    truth = sum(Fraction(gamma) ** t * Fraction(reward) for t, (reward,) in enumerate(rewards))
    assert 0 < abs(Fraction(found.value) - truth) <= Fraction(found.error_bound)
    assert found.error_bound < 1e-14


def test_later_steps_than_those_that_matter_are_worth_no_more_than_the_bound_says():
    """After 32 steps along a chain that costs 1 a step, the policy leaves it for a state that pays 1 a step; it is not
    asked there, and under sticky actions some action is taken for its answer, which goes on along the chain."""
    steps = 32
    next_states = np.array([[(s + 1) % steps, steps] for s in range(steps)] + [[steps, steps]])
    next_states[steps - 1, 1] = 1
    rewards = np.where(np.arange(steps + 1)[:, None] < steps, [-1.0, 1.0], 1.0)
    rewards[steps - 1, 1] = -1.0
    mdp = sticky_actions(TabularMDP.from_arrays(next_states, rewards, gamma=0.5), 0.1)
    policy = np.zeros((steps + 1, 3, 2))
    policy[:, :, 0] = 1.0
    policy[:, 1], policy[steps - 1] = [0.0, 1.0], [0.0, 1.0]
    first = steps_that_matter(mdp)
    assert first[0] == steps
    answers = TableAnswers(policy, mdp)
    answers.reach(None, steps)
    solution = evaluate_policy(*answers.reached_mdp(), 1e-13)
    truth = exact.values_of(mdp, exact.exact(policy[:, :2]))[0, 0]  # no other action was executed before
    error = abs(Fraction(solution.value_at_start) - truth)
    assert Fraction(0.75 * first[1]) < error <= Fraction(solution.error_bound) + Fraction(first[1])
    value = policy_value(policy, mdp, None, None, max_states=steps)
    assert value.exact and abs(Fraction(value.value) - truth) <= Fraction(value.error_bound)


class RecurrentDistribution:
    """What sb3-contrib's recurrent policies have in place of `get_distribution(observations)`."""

    def get_distribution(self, observations, lstm_states, episode_starts):
        raise AssertionError


class RecurrentPPO:
    policy = RecurrentDistribution()
    predict = failing(AssertionError())


def test_a_policy_with_a_memory_is_refused_in_one_line(tmp_path):
    mdp = pharos.build("frozen_lake/4x4", tmp_path / "lake", progress=False).mdp()
    with pytest.raises(ParameterError, match=r"RecurrentPPO: its policy has a memory, .*frames=4") as caught:
        evaluate_policy_of_any_kind(mdp, RecurrentPPO(), observation="vector")
    assert "\n" not in str(caught.value)
