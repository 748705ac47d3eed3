"""Probabilities and costs of reaching a target, against every policy in rational numbers, and published values."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st
from test_total_reward import haddad_monmege, mdps_with_cycles

import pharos
from naive import goals as naive
from pharos.errors import ParameterError, UnknownName
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from strategies import examples


@pytest.mark.long
@examples(300, mdps_with_cycles(rewards=(0.0, 0.0, 1.0, 0.1)), st.sets(st.integers(0, 4), min_size=1), st.booleans())
def test_they_are_those_of_the_best_and_the_worst_policy(mdp, target, is_random):
    mdp = random_actions(mdp, 0.25) if is_random else mdp
    target = {t for t in target if t < mdp.num_states} or {0}
    result = pharos.reach(mdp, sorted(target))
    expected = naive.reaching(mdp, target)
    for (s, _), (high, low, least, largest) in expected.items():
        pairs = (
            (result.maximum, high),
            (result.minimum, low),
            (result.least_cost, least),
            (result.largest_cost, largest),
        )
        for bounds, value in pairs:
            assert bounds.lower[s] <= value <= bounds.upper[s]
            assert math.isinf(value) or bounds.upper[s] - bounds.lower[s] <= 2e-6 + 1e-14 * value  # floats of 1e12
    for s in target:
        assert result.maximum.lower[s] == result.minimum.upper[s] == 1
        assert result.least_cost.upper[s] == result.largest_cost.upper[s] == 0


@pytest.mark.long
@examples(60, mdps_with_cycles(rewards=(0.0, 1.0, 0.1)), st.sets(st.integers(0, 4), min_size=1))
def test_their_policies_attain_them(mdp, target):
    target = sorted({t for t in target if t < mdp.num_states} or {0})
    result = pharos.reach(mdp, target)
    arrived = np.append(result.target, False).astype(float)
    over = result.stopped.terminal[:, None]
    entering = result.stopped.with_rewards(np.where(over, 0.0, mdp.dynamics.expected(arrived)))
    for bounds in (result.maximum, result.minimum):
        worth = pharos.evaluate_policy(entering, bounds.policy, 1e-6)
        expected = np.where(result.target, 1.0, worth.v)
        assert (expected >= bounds.lower - worth.error_bound - 1e-6).all()
        assert (expected <= bounds.upper + worth.error_bound + 1e-6).all()
    for bounds in (result.least_cost, result.largest_cost):
        if np.isfinite(bounds.upper).all():
            tolerance = max(1e-6, 1e-12 * bounds.upper.max())
            worth = pharos.evaluate_policy(result.stopped, bounds.policy, tolerance)
            assert np.abs(worth.v - bounds.upper).max() <= worth.error_bound + 2 * tolerance


def test_haddad_monmege():
    mdp = haddad_monmege(20, 0.7)
    result = pharos.reach(mdp, [mdp.num_states - 1])
    for bounds in (result.maximum, result.minimum):
        assert bounds.lower[20] <= 0.7 <= bounds.upper[20] < bounds.lower[20] + 1e-6
    assert result.least_cost.lower[20] == math.inf


def herman(size):
    """The ring of Herman (1990): who equals the neighbour on the left holds a token, and draws; others copy it."""
    P = np.ones((2**size, 2**size))
    bits = np.arange(2**size)[:, None] >> np.arange(size) & 1
    left = np.roll(bits, 1, axis=1)
    for i in range(size):
        follows = bits[None, :, i] == left[:, i, None]
        P *= np.where((bits == left)[:, i, None], 0.5, follows)
    return TabularMDP.from_matrices([P], np.zeros((2**size, 1)), gamma=1.0), (bits == left).sum(axis=1) == 1


@pytest.mark.parametrize(("size", "steps"), [(3, 4 / 3), (5, 16 / 5), (7, 48 / 7), (9, 12)])
def test_the_ring_of_herman_is_stable_after_the_published_number_of_steps(size, steps):
    mdp, is_stable = herman(size)
    bounds = pharos.reach(mdp, is_stable, costs=np.ones((2**size, 1))).largest_cost
    assert bounds.lower.max() <= steps * (1 + 1e-15) and steps * (1 - 1e-15) <= bounds.upper.max()
    assert (bounds.upper - bounds.lower).max() < 1e-9


def costs():
    """[fast] pays 3 and arrives with 1/2, [slow] pays 4 and arrives, [wait] pays nothing."""
    return TabularMDP.from_outcomes(
        [[[1, 0], [1, 1], [0, 0]], [[1, 1]] * 3],
        [[[0.5, 0.5], [1.0, 0.0], [1.0, 0.0]], [[1.0, 0.0]] * 3],
        [[3.0, 4.0, 0.0], [0.0] * 3],
        terminal=[False, True],
    )


def test_a_cost_that_must_arrive():
    # the worst value, of a policy that never arrives, is 0; Rmin=? [F "done"] of Storm is 4
    result = pharos.reach(costs(), "terminal")
    assert result.least_cost.lower[0] <= 4 <= result.least_cost.upper[0] < 4 + 1e-9
    assert result.largest_cost.lower[0] == result.largest_cost.upper[0] == math.inf
    assert (result.maximum.upper[0], result.minimum.upper[0]) == (pytest.approx(1), pytest.approx(0, abs=1e-9))
    of_steps = pharos.reach(costs(), [1], costs=[[1.0, 1.0, 1.0], [0.0] * 3])
    assert of_steps.least_cost.upper[0] == pytest.approx(1)


def test_under_sticky_actions_they_are_those_of_a_start():
    # 0 goes on to 1 by action 0, which is repeated with 1/2; there action 1 arrives, and action 0 falls off
    mdp = TabularMDP.from_arrays([[1, 0], [-1, 2], [2, 2]], np.zeros((3, 2)), terminal=[0, 0, 1])
    result = pharos.reach(sticky_actions(mdp, 0.5), [2])
    assert result.maximum.upper == pytest.approx([0.5, 1.0, 1.0])
    assert result.minimum.upper == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def test_the_end_without_a_state_counts_by_name_alone():
    mdp = TabularMDP.from_arrays([[-1, 1], [1, 1]], [[1.0, 1.0], [0.0, 0.0]], terminal=[0, 1])
    assert pharos.reach(mdp, "terminal").minimum.lower[0] == pytest.approx(1)
    assert pharos.reach(mdp, [1]).minimum.upper[0] == pytest.approx(0, abs=1e-9)


def test_refusals():
    with pytest.raises(UnknownName, match="goal"):
        pharos.reach(costs(), "goal")
    for target in ([2], [-1], [0.5], [True]):
        with pytest.raises(ParameterError, match="indices of states from 0 to 1"):
            pharos.reach(costs(), target)
    with pytest.raises(ParameterError, match="numbers >= 0"):
        pharos.reach(costs(), [1], costs=-np.ones((2, 3)))
    with pytest.raises(ParameterError, match="both signs"):
        pharos.reach(costs().with_rewards([[1.0, -1.0, 0.0], [0.0] * 3]), [1]).least_cost  # noqa: B018
