"""The effective horizon: published analyses, its definition by brute force, and theory."""

import importlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive.horizon import analysis
from pharos import hardness
from pharos.errors import ParameterError, PrecisionError, UndefinedMeasure
from pharos.hardness.effective_horizon import LargeHorizon, NodeHorizon, horizon_fields
from pharos.hardness.steps import OPTIMAL_TIE
from pharos.mdp import (
    TabularMDP,
    mdp_within,
    random_actions,
    states_within,
    sticky_actions,
)
from refusals import refusal
from strategies import FEW, deterministic_mdps, examples, general_mdps, outcome_mdps

BRIDGE = Path(__file__).parents[1] / "data" / "bridge"


PUBLISHED = [("key-corridor-s3r1", 100), ("freeway_10_fs30", 10), ("maze_easy_l0_30_fs1", 30)]


def key_corridor():
    return bridge_mdp("key-corridor-s3r1", 100)


def bridge_mdp(name, horizon):
    with np.load(BRIDGE / f"{name}.npz", allow_pickle=False) as arrays:
        return TabularMDP.from_arrays(arrays["transitions"], arrays["rewards"], gamma=1.0, horizon=horizon)


def published(analysis, name="key-corridor-s3r1"):
    return json.loads((BRIDGE / f"{name}{analysis}.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name, horizon", PUBLISHED)
def test_published_analyses_are_reproduced(name, horizon):
    mdp = bridge_mdp(name, horizon)
    found, expected = hardness.effective_horizon(mdp), published("_analyzed", name)
    results = expected["effective_horizon_results"]
    assert found.k_min == expected["min_k"]
    assert found.effective_planning_window == expected["epw"]
    assert found.value == pytest.approx(expected["effective_horizon"], rel=1e-12)
    assert found.ks == results["ks"]
    assert found.ms == results["ms"]
    assert found.vars == pytest.approx(results["vars"], rel=1e-8)
    assert found.gaps == pytest.approx([math.inf if gap is None else gap for gap in results["gaps"]], rel=1e-8)
    omega, occupancies = hardness.covering(mdp), expected["min_occupancy_results"]
    assert omega.omega_max == pytest.approx(occupancies["min_state_action_occupancy"], rel=1e-6)
    assert omega.omega_sum == pytest.approx(occupancies["min_sum_state_action_occupancy"], rel=1e-6)


@pytest.mark.slow
def test_returns_of_key_corridor_are_the_published_ones():
    found = hardness.effective_horizon(key_corridor())
    assert found.random_return == pytest.approx(0.0032357130, abs=5e-11)
    assert (found.optimal_return, found.worst_return) == (1.0, 0.0)


@pytest.mark.long
@pytest.mark.parametrize("name, horizon", PUBLISHED)
def test_published_analyses_with_sticky_actions_are_reproduced(name, horizon):
    found = hardness.effective_horizon(sticky_actions(bridge_mdp(name, horizon), 0.25))
    expected = published("_analyzed_sticky_0.25", name)
    assert found.num_states == expected["num_states"]
    assert found.k_min == expected["min_k"]
    assert found.effective_planning_window == expected["epw"]
    assert found.greedy_returns == pytest.approx(expected["greedy_returns"], rel=1e-8)
    assert found.optimal_return == pytest.approx(expected["optimal_return"], rel=1e-12)
    assert found.random_return == pytest.approx(expected["random_return"], rel=1e-8)
    assert found.worst_return == expected["worst_return"]


# Rewards that floats hold exactly, so that ties are ties in whatever order sums are taken.
exact = st.sampled_from([-1.0, 0.0, 0.5, 1.0])


@pytest.mark.slow
@examples(
    60,
    st.one_of(
        deterministic_mdps(max_states=4, max_actions=2, rewards=exact),
        general_mdps(max_states=3, max_actions=2),
        outcome_mdps(FEW),
    ),
    st.sampled_from([{}, {"sticky": 0.25}, {"random": 0.5}, {"sticky": 0.25, "random": 0.5}]),
    st.integers(1, 5),
)
def test_it_is_what_its_definition_says(mdp, chance, steps):
    mdp = random_actions(sticky_actions(mdp, chance.get("sticky", 0.0)), chance.get("random", 0.0))
    found = hardness.effective_horizon(mdp, horizon=steps)
    k_min, window, value, lists = analysis(mdp, steps)
    assert 1 <= found.k_min <= steps
    if mdp.next_states is not None:  # else sums of thirds: which ties are exact depends on their order
        assert (found.k_min, found.effective_planning_window) == (k_min, window)
        assert found.ks == [k for k, _ in lists]
        assert found.ms == pytest.approx([m for _, m in lists], rel=1e-5)
        assert found.value == pytest.approx(value, rel=1e-5)


@pytest.mark.long
@examples(150, deterministic_mdps(max_states=6, max_actions=3), st.integers(1, 7))
def test_the_compiled_analysis_is_the_other_one(mdp, steps):
    one = horizon_fields(NodeHorizon.of_steps(mdp, steps))
    other = horizon_fields(LargeHorizon(mdp, steps, OPTIMAL_TIE))
    assert one.keys() == other.keys()
    for name in one:
        assert one[name] == pytest.approx(other[name], rel=1e-12, abs=1e-12), name


@pytest.mark.long
def test_the_compiled_analysis_of_key_corridor_is_the_published_one():
    found = horizon_fields(LargeHorizon(key_corridor(), 100, OPTIMAL_TIE))
    expected = published("_analyzed")
    assert (found["k_min"], found["effective_planning_window"]) == (expected["min_k"], expected["epw"])
    assert found["ms"] == expected["effective_horizon_results"]["ms"]
    assert found["value"] == pytest.approx(expected["effective_horizon"], rel=1e-12)


@pytest.mark.long
def test_larger_games_are_analysed_by_the_compiled_one(monkeypatch):
    mdp = pharos.build(pharos.make("frozen_lake/8x8")).mdp(gamma=1.0)
    expected = hardness.effective_horizon(mdp, horizon=30)
    monkeypatch.setattr(importlib.import_module("pharos.hardness.effective_horizon"), "LARGEST_WRITTEN_TABLE", 0)
    assert hardness.effective_horizon(mdp, horizon=30) == expected


def lock(length):
    """A combination lock: action 0 goes on, action 1 goes back to the start; the end pays 1."""
    states = np.arange(length)
    return TabularMDP.from_arrays(
        np.stack([np.append(states[1:], -1), np.zeros(length, int)], axis=1),
        np.stack([(states == length - 1) * 1.0, np.zeros(length)], axis=1),
        gamma=1.0,
    )


def test_a_longer_combination_lock_needs_a_longer_look():
    values = [hardness.effective_horizon(lock(length), horizon=length).value for length in (2, 3, 5, 7, 9)]
    assert values == sorted(values)
    assert values[0] < values[-1]


def test_a_game_of_one_step_needs_one_look():
    bandit = TabularMDP.from_arrays([[-1, -1]], [[1.0, 0.0]], gamma=1.0)
    found = hardness.effective_horizon(bandit, horizon=1)
    assert (found.value, found.k_min, found.effective_planning_window) == (1.0, 1, 1)


def test_greedy_returns_lie_between_worst_and_best_and_reach_it_from_k_min_on():
    for chance in (0.0, 0.2):
        mdp = random_actions(pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=1.0), chance)
        found = hardness.effective_horizon(mdp, horizon=30)
        for k, value in enumerate(found.greedy_returns, start=1):
            assert found.worst_return - 1e-12 <= value <= found.optimal_return + 1e-12
            if k >= found.k_min:
                assert value == pytest.approx(found.optimal_return, abs=1e-3)


def test_returns_are_those_of_the_solvers():
    mdp = sticky_actions(pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=1.0), 0.25).with_horizon(20)
    found = hardness.effective_horizon(mdp)
    assert found.optimal_return == pytest.approx(pharos.value_iteration(mdp).value_at_start, rel=1e-12)


def test_it_needs_a_horizon_and_room():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp()
    assert "give a horizon" in refusal(UndefinedMeasure, hardness.effective_horizon, mdp)
    assert "whole number of steps" in refusal(ParameterError, hardness.effective_horizon, mdp, horizon=0)
    assert "GiB" in refusal(UndefinedMeasure, hardness.effective_horizon, mdp, horizon=10**12)


def test_a_report_with_a_horizon_has_it_and_one_without_says_what_is_missing():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp()
    report = hardness.report(mdp, "effective_horizon", horizon=20, keep=False)
    assert report["effective_horizon"].value["k_min"] >= 1
    assert "give a horizon" in hardness.report(mdp, "effective_horizon", keep=False)["effective_horizon"].undefined


@pytest.mark.long
@examples(
    60,
    st.one_of(
        deterministic_mdps(max_states=6, max_actions=2, rewards=exact),
        general_mdps(max_states=4, max_actions=2),
        outcome_mdps(FEW),
    ),
    st.sampled_from([{}, {"sticky": 0.25}, {"random": 0.5}]),
    st.integers(1, 4),
)
def test_states_that_no_episode_meets_do_not_matter(mdp, chance, steps):
    mdp = random_actions(sticky_actions(mdp, chance.get("sticky", 0.0)), chance.get("random", 0.0))
    whole, part = (horizon_fields(NodeHorizon.of_steps(each, steps)) for each in (mdp, mdp_within(mdp, steps)))
    for name in whole:
        assert part[name] == pytest.approx(whole[name], rel=1e-9, abs=1e-12), name
    if not chance and mdp.next_states is not None:
        whole, part = (horizon_fields(LargeHorizon(each, steps, OPTIMAL_TIE)) for each in (mdp, mdp_within(mdp, steps)))
        assert part == whole


def test_the_limit_of_memory_is_what_is_free_in_the_container(monkeypatch):
    monkeypatch.setattr("pharos.system.memory.available_memory", lambda: 100)
    with pytest.raises(UndefinedMeasure, match=r"more than 0\.0, 60% of the free memory"):
        LargeHorizon(TabularMDP.from_arrays([[0, 0]], [[0.0, 1.0]]), 4, OPTIMAL_TIE)


@pytest.mark.slow
def test_a_freeway_is_analysed_for_the_states_that_an_episode_meets():
    mdp = pharos.build(pharos.make("freeway", num_cars=8, lane_length=7)).mdp(gamma=1.0)
    met = int(states_within(mdp, 99).sum())
    found = hardness.effective_horizon(mdp, horizon=100)
    assert found.num_states == met < mdp.num_states / 5
    assert found.optimal_return == pharos.value_iteration(mdp.with_horizon(100)).value_at_start


@pytest.mark.long
@pytest.mark.parametrize("less", [0.0, 5e-5, 2e-4])
def test_actions_that_rounding_or_less_than_the_tie_tolerance_tells_apart_are_both_optimal(less):
    """0.1 + 0.2 is more than 0.3 by rounding. Random play prefers 0.3 at once; that is optimal unless it is 1e-4
    less."""
    mdp = TabularMDP.from_arrays(
        [[1, 2], [3, 3], [3, 3], [3, 3]], [[0.1, 0.3 - less], [0.2, 0.0], [0.0, 0.0], [0.0, 0.0]]
    )
    expected = 1 if less < OPTIMAL_TIE else 2
    assert 0.1 + 0.2 > 0.3
    assert horizon_fields(NodeHorizon.of_steps(mdp, 2))["k_min"] == expected
    assert horizon_fields(LargeHorizon(mdp, 2, OPTIMAL_TIE))["k_min"] == expected


@pytest.mark.parametrize("function", [hardness.effective_horizon, hardness.gorp_bound])
def test_returns_whose_squares_are_no_floats_are_refused(function):
    mdp = TabularMDP.from_arrays([[0, 1], [1, 1]], [[1e308, 0.0], [0.0, 0.0]], gamma=1.0)
    assert "returns of 50 steps may pass 1e+150" in refusal(PrecisionError, function, mdp, horizon=50)
