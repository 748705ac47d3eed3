"""The environmental value norm and covering: explicit matrices, published values, theory."""

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_effective_horizon import key_corridor

import pharos
from naive.mdp import absorbing, augmented, is_over, optimal_values
from pharos import hardness
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.value_norm import certified_value_norm
from pharos.mdp import TabularMDP, random_actions
from refusals import refusal
from strategies import deterministic_mdps, examples, small_mdps

ANALYZED = Path(__file__).parents[1] / "data" / "bridge" / "key-corridor-s3r1_analyzed.json"


def reached(P, start):
    """Nodes that can be met, by whatever is chosen."""
    met = start > 0
    while True:
        more = met | (P[met].sum(axis=(0, 1)) > 0)
        if (more == met).all():
            return met
        met = more


def naive_norm(mdp):
    P, R, start = augmented(mdp)
    v = optimal_values(P, R, mdp.gamma)
    mean = P @ v
    variance = np.maximum((P * (v[None, None, :] - mean[:, :, None]) ** 2).sum(axis=2), 0)
    return math.sqrt(variance[reached(P, start) & ~is_over(mdp)].max(initial=0.0))


@pytest.mark.long
@examples(150, small_mdps())
def test_the_norm_is_that_of_the_explicit_matrices(mdp):
    assert hardness.environmental_value_norm(mdp) == pytest.approx(naive_norm(mdp), rel=1e-5, abs=2e-6)


@examples(30, deterministic_mdps())
def test_the_norm_of_a_deterministic_mdp_is_zero(mdp):
    assert hardness.environmental_value_norm(mdp) == 0.0


def test_the_norm_of_a_coin_is_its_deviation():
    """One action leads to a state worth 1 with probability 0.3, else to the end: sqrt(0.3 x 0.7)."""
    matrix = np.zeros((2, 1, 2))
    matrix[0, 0, 1] = 0.3
    mdp = TabularMDP.from_matrices(matrix, np.array([[0.0], [1.0]]), gamma=0.5, ends=True)
    assert hardness.environmental_value_norm(mdp) == pytest.approx(math.sqrt(0.21))


@pytest.mark.slow
@examples(100, small_mdps(), st.integers(1, 6))
def test_covering_is_that_of_the_explicit_matrices(mdp, steps):
    P, _, start = absorbing(mdp)
    width, over = mdp.num_actions + 1, is_over(mdp)
    now, seen = start.copy(), []
    for _ in range(steps):
        seen.append(now)
        now = np.einsum("i,iaj->j", now, P) / mdp.num_actions
    seen = np.array(seen)
    if not mdp.is_sticky:  # the previous action does not matter
        seen = np.column_stack([seen[:, :-1].reshape(steps, -1, width).sum(axis=2), seen[:, -1]])
        over = np.append(mdp.terminal, True)
    met = (seen.sum(axis=0) > 0) & ~over
    if not met.any():
        assert "every start state is terminal" in refusal(UndefinedMeasure, hardness.covering, mdp, horizon=steps)
        return
    found = hardness.covering(mdp, horizon=steps)
    assert found.omega_max == pytest.approx(seen.max(axis=0)[met].min() / mdp.num_actions)
    assert found.omega_sum == pytest.approx(seen.sum(axis=0)[met].min() / mdp.num_actions)
    assert found.num_states == met.sum()
    assert found.length_bound == pytest.approx(math.log(2 * met.sum() * mdp.num_actions) / found.omega_max)


def test_the_published_occupancies_of_key_corridor_are_reproduced():
    expected = json.loads(ANALYZED.read_text())["min_occupancy_results"]
    found = hardness.covering(key_corridor())
    assert found.omega_max == pytest.approx(expected["min_state_action_occupancy"], rel=1e-8)
    assert found.omega_sum == pytest.approx(expected["min_sum_state_action_occupancy"], rel=1e-8)


def test_chance_cannot_make_random_play_different():
    """Uniform play stays uniform when a uniform action is executed instead."""
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp()
    plain, random = (hardness.covering(each, horizon=30) for each in (mdp, random_actions(mdp, 0.3)))
    assert random.omega_max == pytest.approx(plain.omega_max)


def test_covering_needs_a_horizon():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp()
    assert "give a horizon" in refusal(UndefinedMeasure, hardness.covering, mdp)
    assert "whole number" in refusal(ParameterError, hardness.covering, mdp, horizon=-3)


@pytest.mark.parametrize(("gamma", "value"), [(0.999, 1e5), (0.99, 1e6), (0.5, 1e9)])
def test_large_values_that_lie_close_together_have_their_deviation(gamma, value):
    """State 0 leads to 1 or 2 with probability 1/2 each; their values differ by 2 d, so the deviation is d."""
    matrix = np.zeros((3, 1, 3))
    matrix[0, 0, 1:] = 0.5
    matrix[1, 0, 1] = matrix[2, 0, 2] = 1.0
    deviation = 2.0**-10
    rewards = [[0.0], [value * (1 - gamma)], [(value + 2 * deviation) * (1 - gamma)]]
    mdp = TabularMDP.from_matrices(matrix, np.array(rewards), gamma=gamma)
    solution = pharos.value_iteration(mdp, value * 1e-11 / (1 - gamma))
    found = certified_value_norm(mdp, solution)
    rounding = 4 * value * 2.0**-53 / (1 - gamma)  # of the rewards, which are what the MDP is
    assert found.value == pytest.approx(deviation, abs=solution.error_bound + rounding)
    assert found.lower - rounding <= deviation <= found.upper + rounding


@pytest.mark.long
@examples(100, small_mdps(), st.sampled_from([1e-3, 1e-6]))
def test_the_interval_holds_the_norm_however_coarse_the_values_are(mdp, tolerance):
    found = certified_value_norm(mdp, pharos.value_iteration(mdp, tolerance))
    rounding = 1e-12  # of the twin, whose values are below 200
    assert found.lower - rounding <= naive_norm(mdp) <= found.upper + rounding


@pytest.mark.parametrize("reward", [1e160, 1e-170, 1e300, 1e-290])
def test_values_whose_squares_are_no_floats_have_their_deviation(reward):
    """One state leads to 1 and 2 with probability 1/2 each, worth `reward` and nothing."""
    table = [[[1, 2]], [[-1, -1]], [[-1, -1]]]
    mdp = TabularMDP.from_outcomes(table, [[[0.5, 0.5]], [[1, 0]], [[1, 0]]], [[0.0], [reward], [0.0]], gamma=0.5)
    found = certified_value_norm(mdp, pharos.value_iteration(mdp, tolerance=reward * 1e-9))
    assert found.lower <= reward / 2 <= found.upper <= reward * (0.5 + 1e-6)


@pytest.mark.long
@given(st.floats(2e-15, 1e-3), st.floats(0.1, 0.99))
def test_what_a_row_lacks_is_an_end_for_values_and_measures_alike(lack, gamma):
    """A state that pays 1 and goes on with what its row holds, written as a matrix and as outcomes."""
    stays = 1 - lack
    lack = float(1 - Fraction(stays))  # exact, as the row is what it holds
    rows = [[[0.0, stays]], [[1.0, 0.0]]]
    matrix = TabularMDP.from_matrices(rows, [[1.0], [0.0]], gamma=gamma, ends=[[lack], [0.0]])
    outcomes = TabularMDP.from_outcomes([[[1, -1]], [[0, 0]]], [[[stays, lack]], [[1, 0]]], [[1.0], [0.0]], gamma=gamma)
    assert matrix.has_ends == outcomes.has_ends == (lack > 0)
    truth = gamma * math.sqrt(lack * stays) / (1 - gamma**2 * stays)
    for mdp in (matrix, outcomes):
        assert hardness.diameter(mdp).upper == pytest.approx(2 / lack, rel=1e-7)
        found = certified_value_norm(mdp)
        assert found.lower - 1e-9 * truth <= truth <= found.upper + 1e-9 * truth


@pytest.mark.long
def test_what_the_rounding_of_a_row_lacks_is_no_end():
    thirds, tenths = [1 / 3] * 3, [0.1] * 10
    assert sum(tenths) < 1
    for row in (thirds, tenths):
        size = len(row)
        mdp = TabularMDP.from_matrices([[row]] * size, np.zeros((size, 1)))
        assert not mdp.has_ends and not pharos.lazy_actions(mdp, 0.3).has_ends
        assert not pharos.bisimulation.minimize(mdp).mdp.has_ends


@pytest.mark.long
@pytest.mark.parametrize("reward", [1e3, 1e9, 1e15])
def test_a_measure_answers_by_itself_however_large_the_values_are(reward):
    """An error of 1e-9 is beyond floats there; the interval says what was reached."""
    table = [[[1, 2]], [[0, 0]], [[0, 0]]]
    rewards = [[0.0], [reward], [0.0]]
    mdp = TabularMDP.from_outcomes(table, [[[0.5, 0.5]], [[1, 0]], [[1, 0]]], rewards, gamma=0.99)
    found = certified_value_norm(mdp)
    assert hardness.environmental_value_norm(mdp) == found.value
    assert found.lower <= reward / 2 <= found.upper <= reward * (0.5 + 1e-6)
    assert hardness.gaps(mdp).sum_of_reciprocals == 0 and hardness.distribution_mismatch(mdp).upper >= 1
