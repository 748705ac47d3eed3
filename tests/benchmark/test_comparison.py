"""Comparisons: antisymmetric, as plain Python and SciPy find them, and of error 5 % where nothing differs."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from command_line import run
from naive import benchmark as naive
from pharos.benchmark import AgentResults, compare, load_suite, power
from pharos.benchmark.comparison import frontier_difference, least_difference
from pharos.benchmark.scores import ConfidenceInterval
from pharos.errors import ParameterError
from small_benchmark import CORE, RUNGS, constant, drawn, small_suite

SUITE = small_suite()
OPPOSITE = {"better": "worse", "worse": "better", "not shown to differ": "not shown to differ"}


def compared(ours, theirs):
    return compare(ours, theirs, suite=SUITE)


@pytest.mark.parametrize("seeds", [(10, 10), (5, 8)])
def test_one_task_has_the_p_value_and_interval_of_welch(seeds):
    ours, theirs = (drawn(index, seeds=number) for index, number in enumerate(seeds))
    found = compared(ours, theirs)
    for name in (*CORE, *RUNGS):
        x, y = ([naive.run_score(curve) for curve in each.curves[name].tolist()] for each in (ours, theirs))
        welch = stats.ttest_ind(x, y, equal_var=False)
        one = found.tasks[name]
        assert one.p_value == pytest.approx(welch.pvalue)
        assert (one.interval.low, one.interval.high) == pytest.approx(tuple(welch.confidence_interval()))
        assert one.improvement.value == pytest.approx(naive.improvement(x, y))


def test_core_and_axes_are_those_of_plain_python():
    ours, theirs = drawn(0), drawn(1, worse=0.05)
    found = compared(ours, theirs)
    for one, names in ((found.core, CORE), (found.axes["noise"].score, RUNGS)):
        x, y = (
            [[naive.run_score(curve) for curve in each.curves[name].tolist()] for name in names]
            for each in (ours, theirs)
        )
        value = naive.mean(map(naive.mean, x)) - naive.mean(map(naive.mean, y))
        error, degrees = naive.error_of_mean([*x, *y])
        error *= 2  # of a mean over twice as many tasks
        assert one.interval.value == pytest.approx(value)
        assert one.p_value == pytest.approx(2 * stats.t.sf(abs(value) / error, degrees))
        assert one.improvement.value == pytest.approx(naive.mean(map(naive.improvement, x, y)))


def test_verdicts_and_antisymmetry():
    ours, theirs = drawn(0), drawn(1, worse=0.2)
    found, back = compared(ours, theirs), compared(theirs, ours)
    assert found.core.verdict == found.axes["noise"].score.verdict == "better"
    assert compared(drawn(0), drawn(1)).core.verdict == "not shown to differ"
    pairs = [(found.core, back.core), (found.axes["noise"].score, back.axes["noise"].score)]
    for one, other in [*pairs, *((found.tasks[name], back.tasks[name]) for name in found.tasks)]:
        assert one.interval.value == pytest.approx(-other.interval.value)
        assert (one.interval.low, one.interval.high) == pytest.approx((-other.interval.high, -other.interval.low))
        assert one.improvement.value == pytest.approx(1 - other.improvement.value)
        assert (one.p_value, one.adjusted) == pytest.approx((other.p_value, other.adjusted))
        assert one.verdict == OPPOSITE[other.verdict]
    one, other = (each.axes["noise"].frontier for each in (found, back))
    assert (one.value, one.low, one.high) == pytest.approx((-other.value, -other.high, -other.low))


def test_an_agent_with_itself_differs_in_nothing_and_certain_runs_do():
    agent = drawn()
    found = compared(agent, agent)
    assert found.core.interval.value == 0 and found.core.p_value == 1 and found.core.improvement.value == 0.5
    equal = compared(constant(0.3), constant(0.3)).core
    assert equal.p_value == 1 and equal.verdict == "not shown to differ" and equal.improvement.value == 0.5
    apart = compared(constant(0.2), constant(0.3)).core
    assert apart.p_value == 0 and apart.verdict == "better" and apart.interval.low == pytest.approx(0.1)


def test_one_seed_shows_nothing():
    found = compared(drawn(seeds=1), drawn(1, worse=0.5))
    for one in (found.core, found.axes["noise"].score, *found.tasks.values()):
        assert math.isnan(one.p_value) and math.isnan(one.interval.low) and one.verdict == "one seed"


def test_tasks_that_one_lacks_are_left_out_and_said():
    whole = drawn()
    found = compared(whole, drawn(1, tasks=(*CORE[:2], *RUNGS[1:])))
    assert found.left_out == (CORE[2], RUNGS[0]) and CORE[2] not in found.tasks
    alone = compared(replace(whole, curves={name: whole.curves[name] for name in CORE[:2]}), drawn(1))
    assert found.core == alone.core and not alone.axes
    assert compared(drawn(tasks=RUNGS), whole).core is None
    with pytest.raises(ParameterError, match="no task of small in common"):
        compared(drawn(tasks=CORE), drawn(tasks=RUNGS))


def test_results_of_another_suite_are_refused_by_name():
    with pytest.raises(ParameterError, match="results of theirs are of suite small with digest cdcdcdcdcdcd"):
        compared(drawn(), drawn(agent="theirs", digest="cd" * 32))


def test_differences_of_frontiers_beyond_the_ladder():
    inside, above = ConfidenceInterval(5.0, 4.0, 6.5), ConfidenceInterval(8.0, 7.0, math.inf, "above")
    assert frontier_difference(above, inside) == ConfidenceInterval(3.0, 3 - math.hypot(1, 1.5), math.inf, "above")
    assert frontier_difference(inside, above) == ConfidenceInterval(-3.0, -math.inf, -3 + math.hypot(1.5, 1), "below")
    both = frontier_difference(above, above)
    assert math.isnan(both.value) and (both.low, both.high) == (-math.inf, math.inf)
    below = ConfidenceInterval(1.0, -math.inf, 2.0, "below")
    assert frontier_difference(inside, below) == ConfidenceInterval(4.0, 4 - math.hypot(1, 1), math.inf, "above")


@pytest.mark.long
def test_an_agent_differs_from_itself_in_one_of_twenty_comparisons():
    found = [compared(drawn(2 * seed), drawn(2 * seed + 1)) for seed in range(1000)]
    for p_values in ([each.core.p_value for each in found], [each.axes["noise"].score.p_value for each in found]):
        assert 0.03 <= np.mean(np.array(p_values) < 0.05) <= 0.07


@pytest.mark.slow
def test_the_least_difference_is_found_in_four_of_five_comparisons():
    rng = np.random.default_rng(0)
    spread = np.array([0.02, 0.1, 0.2])
    difference = least_difference((spread / 3) ** 2, 5)
    draws = rng.normal(size=(2, 10_000, 3, 5)) * spread[:, None]
    value = draws[0].mean((1, 2)) - draws[1].mean((1, 2)) + difference
    parts = draws.var(axis=3, ddof=1) / 5 / 9
    total = parts.sum((0, 2))
    critical = stats.t.ppf(0.975, total**2 / (parts**2 / 4).sum((0, 2)))
    assert np.mean(abs(value) > critical * np.sqrt(total)) == pytest.approx(0.8, abs=0.02)


def test_power_of_own_runs():
    found = power(drawn(), suite=SUITE, difference=0.05)
    assert list(found) == ["core", "noise"]
    for each in found.values():
        least = [each.least_differences[seeds] for seeds in (3, 5, 10, 20)]
        assert least == sorted(least, reverse=True) and least[3] > 2.8 * each.standard_error
    scores = [[naive.run_score(curve) for curve in drawn().curves[name].tolist()] for name in CORE]
    assert found["core"].standard_error == pytest.approx(naive.error_of_mean(scores)[0])
    needed, variances = found["core"].seeds_needed, np.array([naive.variance(task) / 9 for task in scores])
    assert least_difference(variances, needed) <= 0.05 < least_difference(variances, needed - 1)
    assert power(constant(0.2), suite=SUITE, difference=0.05)["core"].seeds_needed == 2
    assert power(drawn(), suite=SUITE)["core"].seeds_needed is None
    assert power(drawn(), suite=SUITE, difference=1e-6)["core"].seeds_needed is None


def test_power_refuses_one_seed_and_no_difference():
    with pytest.raises(ParameterError, match="have one seed"):
        power(drawn(seeds=1), suite=SUITE)
    for difference in (0.0, -1.0, math.nan):
        with pytest.raises(ParameterError, match="expected a number above 0"):
            power(drawn(), suite=SUITE, difference=difference)


@pytest.mark.long
def test_commands_print_tables_and_json(tmp_path):
    suite, files = load_suite("v1"), []
    for agent, regret, seeds in (("mine", 0.2, 3), ("theirs", 0.4, 3), ("one", 0.4, 1)):
        rng = np.random.default_rng(seeds)
        curves = {task.name: rng.normal(regret, 0.02, (seeds, 15)) for task in suite.core}
        files.append(str(tmp_path / f"{agent}.safetensors"))
        AgentResults(agent, suite.name, suite.digest, tuple(range(seeds)), curves).write(files[-1])
    text = run("benchmark", "compare", *files, "--tasks").stdout
    assert text.count("better") == len(suite.core) + 1 and "mine against one" in text and "one seed has no" in text
    found = json.loads(run("benchmark", "compare", *files, "--json").stdout)["comparisons"]
    assert [each["theirs"] for each in found] == ["theirs", "one"] and found[0]["core"]["verdict"] == "better"
    assert found[1]["core"]["interval"]["low"] is None
    assert "seeds for 0.05" in run("benchmark", "power", files[0], "--difference", "0.05").stdout
    found = json.loads(run("benchmark", "power", files[0], "--json").stdout)
    assert found["seeds"] == 3 and found["scores"]["core"]["least_differences"]["10"] > 0
    assert run("benchmark", "compare", files[0]).exit_code == 2
