"""Rewards that are means of several: where they are exact, and how far off the others may be, in every bound.

Held against exact fractions of what was given, without slack.
"""

import importlib
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import pharos
from naive import exact as naive_exact
from pharos import hardness
from pharos.errors import PrecisionError
from pharos.mdp import (
    Part,
    TabularMDP,
    lazy_actions,
    mdp_within,
    minimize,
    ranged_rewards,
)
from pharos.mdp.rewards import Rewards
from pharos.policies import TableAnswers, table_values, walk_values
from pharos.solvers import evaluate_policy, value_iteration, worst_value
from pharos.solvers.fixed_point import Backup
from strategies import deterministic_mdps, examples, outcome_mdps, with_chance
from worlds import Row

rules = importlib.import_module("pharos.rules.rules")

LAZINESS = st.sampled_from([2.0**-40, 0.1, 1 / 3, 0.9, 1 - 2.0**-40])
PAY = st.sampled_from([1e12, -1e12, 100.0, -11.111, 0.7, 1e-3, 5e-324, 0.0])
GAMMAS = st.sampled_from([0.0, 0.9, 0.99, 1 - 2.0**-20, 1 - 2.0**-30])


def finest(solve, *arguments):
    """The solution to the finest tolerance that 64-bit floats reach."""
    for exponent in range(-13, 60):
        try:
            return solve(*arguments, 10.0**exponent)
        except PrecisionError:
            continue
    raise AssertionError("no tolerance was met")


def assert_bounded(solution, truth):
    found = solution.v if solution.mdp.is_sticky else solution.v[:, None]
    assert naive_exact.largest_error(found, truth) <= Fraction(solution.error_bound)


def assert_values_are_within_their_bounds(mdp, given, seed):
    """Values of an MDP against fractions of what was given: best, worst, a policy, and with horizons."""
    drawn = np.random.default_rng(seed)
    assert_bounded(finest(value_iteration, mdp), naive_exact.extreme_values(given))
    assert_bounded(finest(worst_value, mdp), naive_exact.extreme_values(given, -1))
    shape = (mdp.num_states, mdp.num_actions + 1) if mdp.is_sticky else (mdp.num_states, 1)
    policy = drawn.integers(mdp.num_actions, size=shape)
    rows = naive_exact.exact(np.eye(mdp.num_actions)[policy])
    solution = finest(evaluate_policy, mdp, policy if mdp.is_sticky else policy[:, 0])
    assert_bounded(solution, naive_exact.values_of(given, rows))
    if mdp.chance.is_none:
        v = naive_exact.exact(np.zeros((mdp.num_states, 1)))
        for horizon in (1, 2, 3):
            v = naive_exact.action_values(given, v).max(axis=1)[:, None]
            assert_bounded(value_iteration(mdp, horizon=horizon), v)


# Lazy actions ---------------------------------------------------------------------------------------------------------


@st.composite
def lazy_mdps_as_given(draw):
    """(MDP with actions that are lazy up to three times, and any chance of choosing; the same in fractions)."""
    mdp = draw(st.one_of(deterministic_mdps(max_states=3, ends=False), outcome_mdps(("dense, palette",))))
    terminal = np.asarray(mdp.terminal)
    rewards = draw(hnp.arrays(np.float64, mdp.rewards.shape, elements=PAY)) * ~terminal[:, None]
    mdp = mdp.with_rewards(rewards).with_gamma(draw(GAMMAS))
    lazy, given = mdp, naive_exact.AsGiven(mdp, naive_exact.exact(mdp.rewards))
    for p in draw(st.lists(LAZINESS, min_size=1, max_size=3)):
        staying = draw(hnp.arrays(np.float64, mdp.rewards.shape, elements=PAY)) * ~terminal[:, None]
        lazy, given = lazy_actions(lazy, p, staying=staying), given.lazy(p, staying)
    lazy = draw(with_chance(st.just(lazy)))
    return lazy, naive_exact.AsGiven(lazy, given.rewards, given.laziness, mdp)


@pytest.mark.long
@examples(150, lazy_mdps_as_given(), st.integers(0, 2**32))
def test_values_of_lazy_actions_are_within_their_bounds(drawn, seed):
    assert_values_are_within_their_bounds(*drawn, seed)


@pytest.mark.parametrize("pay, p, staying", [(100.0, 0.9, -11.111), (1e12, 1 - 2.0**-40, 1e-3), (1e-3, 0.1, 1e12)])
def test_rewards_of_different_size_are_mixed_without_cancellation(pay, p, staying):
    mdp = lazy_actions(TabularMDP.from_arrays([[0]], [[pay]], gamma=0.99), p, staying=[[staying]])
    truth = (1 - Fraction(p)) * Fraction(pay) + Fraction(p) * Fraction(staying)
    error = abs(Fraction(float(mdp.rewards[0, 0])) - truth)
    assert 0 < error <= Fraction(mdp.reward_table.rounding)
    terms = (1 - p) * abs(pay) + p * abs(staying)
    assert mdp.reward_table.rounding <= 4.1 * 2.0**-53 * terms
    assert_bounded(finest(value_iteration, mdp), np.array([[truth / (1 - Fraction(0.99))]], object))
    assert_bounded(value_iteration(mdp, horizon=1), np.array([[truth]], object))


@pytest.mark.long
@examples(200, st.data(), LAZINESS)
def test_a_mean_of_two_rewards_lies_between_them_and_equal_pairs_stay_equal(data, p):
    own, other = (data.draw(hnp.arrays(np.float64, (7, 3), elements=PAY)) for _ in range(2))
    mixed = Rewards.from_array(own).mixed(Rewards.from_array(other), p)
    assert (mixed.array >= np.minimum(own, other)).all() and (mixed.array <= np.maximum(own, other)).all()
    assert (mixed.array == own)[own == other].all()
    assert len(mixed.palette) <= len(set(zip(own.ravel(), other.ravel(), strict=True)))
    truth = (1 - Fraction(p)) * naive_exact.exact(own) + Fraction(p) * naive_exact.exact(other)
    assert naive_exact.largest_error(mixed.array, truth) <= Fraction(mixed.rounding)
    assert Rewards.from_array(own).mixed(Rewards.from_array(own), p).rounding == 0.0


def test_a_hundred_small_chances_of_staying_that_round_to_none_are_counted():
    """State 0 loses 1 on its way to state 1, which earns 1 each step; 1 - (1 - 2^-54)^2 is 0 in floats."""
    mdp = TabularMDP.from_arrays([[1], [1]], [[-1.0], [1.0]], gamma=1.0, horizon=2)
    truth = Fraction(1)
    for _ in range(100):
        mdp, truth = lazy_actions(mdp, 2.0**-54), truth * (1 - Fraction(2.0**-54))
    solution = value_iteration(mdp)
    error = abs(Fraction(float(solution.v[0])) - (-1 + truth - (1 - truth)))
    assert 90 * Fraction(2.0**-53) < error <= Fraction(solution.error_bound)
    near = mdp_within(mdp, 2)
    assert near is mdp and mdp.dynamics.restricted_to(np.arange(2)).operations == mdp.dynamics.operations
    assert Part.of(mdp, 0, 2).dynamics.operations == mdp.dynamics.operations


# Means over outcomes --------------------------------------------------------------------------------------------------


@st.composite
def means_as_given(draw):
    """(MDP of two outcomes that pay differently, the same in fractions), from outcomes or matrices."""
    shape = draw(st.tuples(st.integers(2, 3), st.integers(1, 2)))
    weights = draw(hnp.arrays(np.float64, shape, elements=st.sampled_from([0.3, 1 / 3, 0.7, 0.999])))
    chances = np.stack([weights, 1 - weights], axis=2)
    pairs = st.sampled_from([(7e6, -3e6), (-3e6, 7e6), (1e12, -1e12), (0.1, 0.1), (1e12, 0.0)])
    paid = np.array([draw(pairs) for _ in range(weights.size)]).reshape(*shape, 2)
    states = np.stack([np.zeros(shape, int), np.ones(shape, int)], axis=2)
    gamma = draw(GAMMAS)
    if draw(st.booleans()):
        mdp = TabularMDP.from_outcomes(states, chances, paid, gamma=gamma)
    else:
        P, R = np.zeros((*shape, shape[0])), np.zeros((*shape, shape[0]))
        P[..., :2], R[..., :2] = chances, paid
        mdp = TabularMDP.from_matrices(P, R, gamma=gamma, axes="SAS")
    means = (naive_exact.exact(chances) * naive_exact.exact(paid)).sum(axis=2)
    return mdp, naive_exact.AsGiven(mdp, means)


@pytest.mark.long
@examples(100, means_as_given(), st.integers(0, 2**32))
def test_values_of_rewards_averaged_over_outcomes_are_within_their_bounds(drawn, seed):
    assert_values_are_within_their_bounds(*drawn, seed)


def test_outcomes_whose_rewards_cancel_leave_no_false_bound():
    mdp = TabularMDP.from_outcomes([[[0, -1]]], [[[0.3, 0.7]]], [[[7e6, -3e6]]], gamma=0.0)
    truth = Fraction(0.3) * 7000000 - Fraction(0.7) * 3000000
    solution = value_iteration(mdp, 1e-6)
    assert 2.0**-53 < abs(Fraction(float(solution.v[0])) - truth) <= Fraction(solution.error_bound)


@dataclass(frozen=True, kw_only=True)
class Bet(Row):
    """A place that is left in one case of three; staying pays 7e6 or takes 3e6, so that the mean nearly cancels."""

    length: int = 2
    name, variable = "bet", "place"
    actions = ("bet", "wait")
    layers = {}
    outcomes = 2

    def probability(self, state, action, outcome):
        return 0.3 if outcome == 0 else 0.7

    def transition(self, state, action, outcome, out):
        out[0] = outcome

    def is_terminal(self, state):
        return state[0] == 1

    def reward(self, state, action, next_state):
        return 5.0 if action == 1 else -3e6 if next_state[0] == 1 else 7e6


@pytest.mark.long
@pytest.mark.parametrize("engine", ["compiled", "interpreted"])
def test_means_by_the_rules_count_their_rounding(engine, monkeypatch, tmp_path):
    if engine == "interpreted":
        monkeypatch.setattr(rules, "compiled_or_none", lambda *_: None)
    space = pharos.build(Bet(), tmp_path / engine, progress=False)
    mdp = space.mdp(gamma=0.0)
    truth = Fraction(0.3) * 7000000 - Fraction(0.7) * 3000000
    assert 2.0**-53 < abs(Fraction(float(mdp.rewards[0, 0])) - truth) <= Fraction(mdp.reward_table.rounding)
    assert abs(Fraction(float(worst_value(mdp, 1e-3).v[0])) - min(truth, 5)) <= Fraction(worst_value(mdp).error_bound)
    assert mdp.rewards[0, 1] == 5.0  # alike in both outcomes, so no mean
    ranged = ranged_rewards(space)
    assert ranged.of(slice(0, 1)).rounding == ranged.rounding == mdp.reward_table.rounding


@pytest.mark.long
def test_rewards_that_are_given_have_no_rounding(tmp_path):
    assert TabularMDP.from_arrays([[0]], [[0.1]]).reward_table.rounding == 0.0
    for name in ("frozen_lake/4x4", "cliff_walking"):
        assert pharos.build(name, progress=False).mdp().reward_table.rounding == 0.0


# Where MDPs are made of others ----------------------------------------------------------------------------------------


@pytest.mark.long
def test_every_mdp_made_of_another_keeps_the_rounding_of_its_rewards():
    mdp = TabularMDP.from_outcomes([[[0]], [[1]]], [[[1.0]], [[1.0]]], [[[0.1]], [[3.0]]], gamma=0.9, horizon=5)
    rounding = mdp.reward_table.rounding
    assert rounding > 0
    answers = TableAnswers(np.ones((2, 1)), mdp)
    answers.reach(None, mdp.horizon)
    made = [mdp_within(mdp, 1), minimize(mdp).mdp, answers.reached_mdp()[0], Part.of(mdp, 0, 1), lazy_actions(mdp, 0.5)]
    assert [each.reward_table.rounding for each in made] == [rounding] * len(made)
    assert Backup(mdp, value_iteration(mdp).select).rounding(0.0) >= rounding
    assert table_values(mdp, [np.zeros(2, int)])[0].error_bound >= 5 * 0.9**4 * rounding
    assert walk_values([mdp], np.zeros_like)[0].error_bound >= 5 * 0.9**4 * rounding
    gaps = hardness.gaps(lazy_actions(mdp.with_horizon(None), 0.9, staying=[[1e12], [0.1]]))
    assert gaps.minimal == np.inf
