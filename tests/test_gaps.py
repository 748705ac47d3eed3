"""Suboptimality gaps against explicit matrices, and against theory."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pharos
from naive_gaps import naive_gaps
from pharos import hardness
from pharos.errors import ParameterError, PrecisionError
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from strategies import deterministic_mdps, small_mdps

TOLERANCE = 1e-7


@settings(max_examples=150, deadline=None)
@given(small_mdps())
def test_gaps_are_those_of_the_explicit_matrices(mdp):
    result = hardness.gaps(mdp, pharos.value_iteration(mdp, 1e-9), tie_tolerance=TOLERANCE)
    positive, regularized = naive_gaps(mdp, TOLERANCE)
    assert result.count == len(positive)
    assert math.isclose(result.sum_of_reciprocals, sum(1 / gap for gap in positive), rel_tol=1e-5)
    assert math.isclose(result.regularized, regularized, rel_tol=1e-6)
    assert math.isclose(result.minimal, min(positive, default=math.inf), rel_tol=1e-5)
    assert result.lower <= result.sum_of_reciprocals <= result.upper
    assert result.histogram.sum() == result.count
    for number, low, high in zip(result.histogram, result.edges, result.edges[1:], strict=False):
        assert number == sum(low <= gap < high for gap in positive) or any(
            abs(gap / edge - 1) < 1e-6 for gap in positive for edge in (low, high)
        )


@settings(max_examples=80, deadline=None)
@given(small_mdps(), st.integers(1, 4))
def test_gaps_with_a_horizon_are_those_of_every_step(mdp, horizon):
    mdp = mdp.with_horizon(horizon)
    result = hardness.gaps(mdp, tie_tolerance=TOLERANCE)
    positive, regularized = naive_gaps(mdp, TOLERANCE, horizon)
    assert result.count == len(positive)
    assert math.isclose(result.sum_of_reciprocals, sum(1 / gap for gap in positive), rel_tol=1e-6)
    assert math.isclose(result.regularized, regularized, rel_tol=1e-6)


@settings(max_examples=50, deadline=None)
@given(deterministic_mdps(), st.sampled_from([0.5, 2.0, 8.0]))
def test_scaling_rewards_scales_gaps(mdp, scale):
    gaps = hardness.gaps(mdp, tie_tolerance=TOLERANCE)
    scaled = hardness.gaps(mdp.with_rewards(mdp.rewards * scale), tie_tolerance=TOLERANCE * scale)
    assert scaled.count == gaps.count
    assert math.isclose(scaled.sum_of_reciprocals * scale, gaps.sum_of_reciprocals, rel_tol=1e-6)


@settings(max_examples=50, deadline=None)
@given(deterministic_mdps(), st.sampled_from([0.25, 0.5]))
def test_random_actions_shrink_what_a_choice_is_worth(mdp, p):
    """With gamma = 0 a gap is the difference of rewards, times the probability that the choice is executed."""
    mdp = mdp.with_gamma(0.0)
    plain, random = hardness.gaps(mdp), hardness.gaps(random_actions(mdp, p))
    assert math.isclose(random.sum_of_reciprocals * (1 - p), plain.sum_of_reciprocals, rel_tol=1e-9)
    assert math.isclose(hardness.sum_of_reciprocal_gaps(sticky_actions(mdp, 0.0)), plain.sum_of_reciprocals)


def test_gaps_of_a_bandit_are_the_differences_of_its_arms():
    bandit = TabularMDP.from_arrays([[-1, -1, -1, -1]], [[1.0, 0.75, 0.5, 1.0]])
    result = hardness.gaps(bandit)
    assert result.sum_of_reciprocals == pytest.approx(1 / 0.25 + 1 / 0.5)
    assert result.regularized == pytest.approx(2 / 0.1 + 1 / 0.35 + 1 / 0.6)
    assert hardness.minimal_gap(bandit) == pytest.approx(0.25)
    assert (result.count, result.ties) == (2, 2)


def test_states_that_cannot_be_reached_do_not_count():
    next_states, rewards = [[-1, -1], [-1, -1]], [[1.0, 0.0], [1.0, 0.5]]
    assert hardness.sum_of_reciprocal_gaps(TabularMDP.from_arrays(next_states, rewards)) == pytest.approx(1.0)
    both = TabularMDP.from_arrays(next_states, rewards, initial=np.array([0.5, 0.5]))
    assert hardness.sum_of_reciprocal_gaps(both) == pytest.approx(3.0)


def test_an_mdp_without_gaps_has_an_infinite_minimal_gap():
    mdp = TabularMDP.from_arrays([[-1, -1]], [[1.0, 1.0]])
    assert hardness.minimal_gap(mdp) == math.inf
    assert hardness.sum_of_reciprocal_gaps(mdp) == 0.0
    assert hardness.gaps(mdp).to_dict()["minimal"] is None


def test_a_tie_tolerance_within_the_error_of_the_solution_is_refused():
    mdp = pharos.build(pharos.make("simple_grid", height=3, width=3)).mdp()
    solution = pharos.value_iteration(mdp, 1e-3)
    if solution.error_bound == 0:
        pytest.fail("the test needs a solution with an error")
    with pytest.raises(PrecisionError, match="twice the error bound"):
        hardness.gaps(mdp, solution, tie_tolerance=solution.error_bound)


def test_a_solution_of_another_mdp_or_policy_is_refused():
    mdp = TabularMDP.from_arrays([[-1, -1]], [[1.0, 0.0]])
    other = TabularMDP.from_arrays([[-1, 1], [-1, -1]], [[1.0, 0.0], [0.0, 0.0]])
    with pytest.raises(ParameterError, match="expected the optimal one"):
        hardness.gaps(mdp, pharos.value_iteration(other))
    with pytest.raises(ParameterError, match="expected the optimal one"):
        hardness.gaps(mdp, pharos.evaluate_policy(mdp, np.array([0])))
