"""Scores: exact at both ends, as plain Python finds them, and honest where the ladder or the seeds end."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy import stats

from naive import benchmark as naive
from pharos.benchmark import score
from pharos.benchmark.scores import ConfidenceInterval, equal_seeds, frontier
from pharos.errors import ParameterError
from small_benchmark import CORE, LEVELS, RUNGS, constant, drawn, results, small_suite
from strategies import examples

SUITE = small_suite()
REGRETS = st.lists(st.lists(st.floats(0, 1), min_size=3, max_size=3), min_size=4, max_size=4)


def test_optimal_play_scores_1_and_lies_beyond_every_frontier():
    for rounding in (0.0, -1e-12):
        found = score(constant(rounding), SUITE)
        for each in (found.core, found.final, found.iqm, found.axes["noise"].score, *found.tasks.values()):
            assert (each.value, each.low, each.high) == (1.0, 1.0, 1.0)
        assert found.optimality_gap.value == 0.0
        assert found.axes["noise"].frontier == ConfidenceInterval(8.0, 8.0, math.inf, "above")
        assert not found.preliminary and not found.below_random


def test_uniform_play_scores_0_before_every_frontier():
    found = score(constant(1.0 + 1e-9), SUITE)
    for each in (found.core, found.final, found.iqm, found.axes["noise"].score, *found.tasks.values()):
        assert (each.value, each.low, each.high) == (0.0, 0.0, 0.0)
    assert found.optimality_gap.value == pytest.approx(1.0, abs=1e-6)
    assert found.axes["noise"].frontier == ConfidenceInterval(1.0, -math.inf, 1.0, "below")


@pytest.mark.parametrize("seed", range(3))
def test_scores_are_those_of_plain_python(seed):
    agent = drawn(seed)
    found = score(agent, SUITE)
    runs = {name: [naive.run_score(curve) for curve in curves.tolist()] for name, curves in agent.curves.items()}
    for interval, tasks in (
        (found.core, [runs[name] for name in CORE]),
        (found.axes["noise"].score, [runs[name] for name in RUNGS]),
        *((found.tasks[name], [runs[name]]) for name in (*CORE, *RUNGS)),
    ):
        error, degrees = naive.error_of_mean(tasks)
        value = naive.mean(naive.mean(task) for task in tasks)
        half = stats.t.ppf(0.975, degrees) * error
        assert interval.value == pytest.approx(value, abs=1e-12)
        assert (interval.low, interval.high) == pytest.approx((max(0, value - half), min(1, value + half)), abs=1e-9)
    regrets = [[1 - run for run in runs[name]] for name in RUNGS]
    level, censored = naive.crossing(LEVELS, [naive.mean(own) for own in regrets])
    edge = found.axes["noise"].frontier
    assert (edge.value, edge.censored) == (pytest.approx(level), censored)
    assert edge.low == pytest.approx(naive.crossing_of_limit(LEVELS, regrets, 1), abs=4 / 256)
    assert edge.high == pytest.approx(naive.crossing_of_limit(LEVELS, regrets, -1), abs=4 / 256)


def test_the_mean_over_the_run_is_clipped_as_a_whole():
    curve = [[-0.5, 1.5], [1.5, 1.7]]
    found = score(results({**dict.fromkeys(CORE, curve), **dict.fromkeys(RUNGS, curve)}), SUITE)
    assert found.core.value == pytest.approx((0.5 + 0.0) / 2)
    assert found.final.value == 0.0
    assert found.optimality_gap.value == pytest.approx((0.5 + 1.6) / 2)


def test_below_random_is_what_the_whole_interval_says():
    agent = drawn()
    curves = {**agent.curves, "core-a": 1.3 + 0.01 * agent.curves["core-a"], "core-b": agent.curves["core-b"] + 0.51}
    assert agent.curves["core-b"].mean() + 0.51 > 1.0
    assert score(replace(agent, curves=curves), SUITE).below_random == ("core-a",)


@pytest.mark.long
@examples(50, REGRETS)
def test_frontier_is_that_of_plain_python_within_its_interval(regrets):
    found = frontier(np.array(LEVELS), [np.array(own) for own in regrets])
    level, censored = naive.crossing(LEVELS, [naive.mean(own) for own in regrets])
    near = abs(np.array(naive.increasing([naive.mean(own) for own in regrets])) - 0.5).min() < 1e-9
    assert near or (found.value, found.censored) == (pytest.approx(level, abs=1e-6), censored)
    assert found.low <= found.value <= found.high


@examples(50, REGRETS, st.integers(0, 3), st.floats(0, 1))
def test_less_regret_on_any_rung_moves_the_frontier_no_nearer(regrets, rung, share):
    levels, arrays = np.array(LEVELS), [np.array(own) for own in regrets]
    before = frontier(levels, arrays)
    arrays[rung] = arrays[rung] * share
    after = frontier(levels, arrays)
    order = {"below": -1, "": 0, "above": 1}
    assert after.value >= before.value - 1e-9
    assert order[after.censored] >= order[before.censored] or abs(after.value - before.value) < 1e-9


@pytest.mark.parametrize(
    ("means", "value", "censored"),
    [
        ((0.1, 0.2, 0.3, 0.4), 8.0, "above"),
        ((0.6, 0.7, 0.8, 0.9), 1.0, "below"),
        ((0.5, 0.7, 0.8, 0.9), 1.0, ""),
        ((0.1, 0.2, 0.3, 0.5), 8.0, ""),
        ((0.0, 0.5, 0.5, 0.5), 2.0, ""),
        ((0.25, 0.75, 0.25, 0.75), 2.0, ""),
        ((0.0, 0.0, 1.0, 1.0), 3.0, ""),
    ],
)
def test_frontiers_at_the_ends_and_with_ties(means, value, censored):
    found = frontier(np.array(LEVELS), [np.full(5, mean) for mean in means])
    assert (found.value, found.censored) == (pytest.approx(value), censored)


def test_an_end_of_the_interval_beyond_the_ladder_is_infinite():
    rungs = [np.full(5, 0.1), np.full(5, 0.2), np.full(5, 0.3), np.array([0.2, 0.9, 0.5, 0.7, 0.6])]
    found = frontier(np.array(LEVELS), rungs)
    assert not found.censored and 4.0 < found.low < found.value < 8.0 and found.high == math.inf
    assert str(found) == f"{found.value:.3g} ({found.low:.3g} or more)"
    assert frontier(np.array([3.0]), [np.array([0.2, 0.21])]) == ConfidenceInterval(3.0, 3.0, math.inf, "above")


def test_one_seed_has_values_without_intervals():
    found = score(drawn(seeds=1), SUITE)
    assert found.preliminary and not found.below_random
    for each in (found.core, found.iqm, found.optimality_gap, found.axes["noise"].frontier, *found.tasks.values()):
        assert math.isfinite(each.value) and math.isnan(each.low) and math.isnan(each.high)
    assert str(ConfidenceInterval(0.5)) == "0.500"


def test_intervals_as_text():
    assert str(ConfidenceInterval(9.42, 8.3, 10.81)) == "9.42 (8.3 to 10.8)"
    assert str(ConfidenceInterval(1.0, -math.inf, 2.0, "below")) == "< 1.000 (2 or less)"
    assert str(ConfidenceInterval(math.nan, -math.inf, math.inf, "above")) == "not comparable"
    assert ConfidenceInterval(8.0, 7.0, math.inf, "above").text(ends=False) == "> 8"


def test_order_of_tasks_and_seeds_changes_nothing():
    agent, backwards = drawn(), small_suite(core=CORE[::-1])
    curves = {name: agent.curves[name] for name in reversed(agent.curves)}
    again = score(replace(agent, curves=curves), backwards)
    assert replace(again, tasks=dict(again.tasks)) == score(agent, SUITE)
    shuffled = score(replace(agent, curves={name: own[::-1] for name, own in agent.curves.items()}), SUITE)
    assert shuffled.core.value == pytest.approx(again.core.value, abs=1e-15)
    assert shuffled.core.low == pytest.approx(again.core.low, abs=1e-14)


def test_missing_tasks_are_said_and_make_it_preliminary():
    found = score(drawn(tasks=CORE[:2]), SUITE)
    assert found.missing == (CORE[2], *RUNGS) and found.preliminary and not found.axes
    assert score(drawn(seeds=9), SUITE).preliminary and not score(drawn(), SUITE).preliminary
    whole = drawn()
    ladders = score(replace(whole, curves={name: whole.curves[name] for name in RUNGS}), SUITE)
    assert math.isnan(ladders.core.value) and math.isnan(ladders.iqm.value) and ladders.missing == CORE
    assert ladders.axes == score(whole, SUITE).axes


def test_results_of_another_suite_are_refused_by_name():
    with pytest.raises(ParameterError, match=r"results of mine are of suite small with digest cdcdcdcdcdcd; expected"):
        score(drawn(agent="mine", digest="cd" * 32), SUITE)


def test_what_is_not_a_number_is_refused():
    with pytest.raises(ParameterError, match="core-a"):
        drawn(worse=math.nan)


def test_equal_curves_count_only_where_something_is_learnt_step_by_step():
    """A world that every sound agent solves before its first policy says nothing about seeds."""
    at_once = np.array([[1.0, 0.0, 0.0], [1.0, 1e-12, 0.0], [1.0, 0.0, 0.0]])
    slowly = np.array([[1.0, 0.5, 0.0]] * 3)
    assert not equal_seeds({"bandit": at_once[[0, 2]]}) and not equal_seeds({"fixed": np.full((3, 3), 0.3)})
    assert equal_seeds({"bandit": at_once, "lake": slowly}).startswith("all seeds have the same curve on 1 of 1 task,")
    assert not equal_seeds({"lake": slowly + np.array([[0.0], [0.1], [0.2]]) * [0, 1, 1]})
