"""The toolbox of statistics: each function beside SciPy, a slow plain twin or theory; and numbers as they were."""

import doctest
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from naive import benchmark as naive
from pharos import statistics
from pharos.benchmark.scores import frontier
from pharos.errors import ParameterError
from pharos.statistics import (
    bootstrap_interval,
    class_weights,
    fieller_interval,
    holm,
    improvement_error,
    interquartile_interval,
    interquartile_mean,
    mean_interval,
    mean_of_means,
    percentiles,
    permutation_p_value,
    probability_of_improvement,
    r_squared,
    ranks,
    spearman,
    standard_error,
    student_interval,
    welch_p_value,
)
from strategies import examples

GOLDEN = json.loads((Path(__file__).parent / "data" / "statistics.json").read_text())
NUMBERS = st.floats(-100, 100)
RUNS = st.lists(NUMBERS, min_size=2, max_size=6).map(np.array)
STRATA = st.lists(RUNS, min_size=1, max_size=4)
P_VALUES = st.lists(st.floats(0, 1), min_size=1, max_size=8)


def strata(seed):
    rng = np.random.default_rng(seed)
    return [np.round(rng.beta(2 + seed, 5, number), 2 + 9 * (number > 4)) for number in (5, 9, 4, 12)]


def outputs():
    """Outputs on fixed numbers, by name."""
    ours, theirs, levels = strata(0), strata(1), np.array([1.0, 2.0, 4.0, 8.0])
    weights = [0.3] * 8
    rng = np.random.default_rng(5)
    curves = [rng.random((7, number)) for number in (3, 2, 6)]
    rng = np.random.default_rng(7)
    classes = np.repeat(np.arange(6), 5)
    y = rng.random(30) + classes / 6
    x = y + 0.3 * rng.normal(size=30)
    p = np.random.default_rng(8).random(12) ** 3
    p[[2, 7]], p[4] = np.nan, p[5]
    rng = np.random.default_rng(9)
    nearly_tied = rng.integers(0, 5, (4, 9)) * (1 + rng.uniform(-1, 1, (4, 9)) * 1e-15)

    def improvement(*drawn, axis=-1):
        return probability_of_improvement(drawn[:4], drawn[4:], axis)

    def rungs(seed):
        rng = np.random.default_rng(seed)
        return [np.clip(rng.normal(mean, 0.2, 5), 0, 1) for mean in np.sort(rng.random(4))]

    difference = float(mean_of_means(*ours) - mean_of_means(*theirs))
    error = standard_error([*ours, *theirs], [0.25] * 8)
    crossings = [frontier(levels, rungs(seed)) for seed in range(20)]
    probability = probability_of_improvement(ours, theirs)
    return {
        "bootstrap of interquartile means": bootstrap_interval(ours, interquartile_mean, resamples=200),
        "bootstrap of mean curves": bootstrap_interval(curves, mean_of_means, resamples=200, seed=3, confidence=0.9),
        "bootstrap of improvements": bootstrap_interval([*ours, *theirs], improvement, resamples=100),
        "interquartile mean": interquartile_mean(*ours),
        "interquartile mean and interval": interquartile_interval(ours, (0.0, 1.0)),
        "mean and interval": mean_interval(ours),
        "standard error of Welch": standard_error([*ours, *theirs], weights),
        "p-value of Welch": welch_p_value(difference, *error),
        "improvement and interval": student_interval(float(probability), *improvement_error(ours, theirs), (0.0, 1.0)),
        "probability of improvement": probability,
        "frontiers": [end for each in crossings for end in (each.value, each.low, each.high)],
        "holm": holm(p),
        "R2": r_squared(y, y - x),
        "R2 of classes that weigh alike": r_squared(y, y - x, classes),
        "weights of classes": class_weights(classes),
        "ranks": ranks(nearly_tied),
        "spearman": spearman(x, y),
        "percentiles": percentiles(p, 2.5, 50, 97.5),
        "p-value of permutations": [permutation_p_value(value, p) for value in (0.1, 0.5, 2.0)],
    }


def test_numbers_are_as_they_were_when_each_package_computed_its_own():
    """To the last bit on the machine that wrote the file; others may sum in another order."""
    found = {name: np.ravel(np.asarray(value, float)) for name, value in outputs().items()}
    assert found.keys() == GOLDEN.keys()
    for name, expected in GOLDEN.items():
        np.testing.assert_allclose(found[name], expected, rtol=1e-12, atol=1e-14, err_msg=name)


def test_the_examples_of_docstrings_are_true():
    result = doctest.testmod(statistics)
    assert result.attempted >= 15 and not result.failed


# Aggregates -----------------------------------------------------------------------------------------------------------


@examples(50, STRATA)
def test_the_interquartile_mean_is_scipys_trimmed_mean_of_all_runs(strata):
    expected = stats.trim_mean(np.concatenate(strata), 0.25)
    assert interquartile_mean(*strata) == pytest.approx(expected, abs=1e-12)
    assert interquartile_interval(strata)[0] == pytest.approx(expected, abs=1e-12)
    columns = [np.stack([each, 2 * each], axis=1) for each in strata]  # runs along another axis
    np.testing.assert_allclose(interquartile_mean(*columns, axis=0), [expected, 2 * expected], atol=1e-12)


def test_the_interquartile_mean_is_the_mean_of_the_middle_half():
    assert interquartile_mean(np.arange(8.0)) == np.arange(2, 6).mean()


@examples(50, STRATA)
def test_the_mean_of_means_weighs_strata_alike(strata):
    assert mean_of_means(*strata) == pytest.approx(naive.mean(map(naive.mean, strata)), abs=1e-12)


@examples(50, STRATA, STRATA)
def test_the_probability_of_improvement_is_that_of_mann_and_whitney(ours, theirs):
    number = min(len(ours), len(theirs))
    ours, theirs = ours[:number], theirs[:number]
    u = [stats.mannwhitneyu(x, y).statistic / (len(x) * len(y)) for x, y in zip(ours, theirs, strict=True)]
    assert probability_of_improvement(ours, theirs) == pytest.approx(np.mean(u))
    assert probability_of_improvement(ours, theirs) + probability_of_improvement(theirs, ours) == pytest.approx(1)
    assert probability_of_improvement(ours, ours) == 0.5


@pytest.mark.slow
def test_the_error_of_an_improvement_is_the_spread_of_its_estimates():
    """Runs drawn anew 2,000 times: the mean of the squared errors is their variance, within 6 %."""
    rng = np.random.default_rng(0)
    estimates, errors = [], []
    for _ in range(2000):
        ours, theirs = [rng.normal(0.3, 1, 20), rng.random(20)], [rng.normal(0, 1, 25), rng.random(15)]
        estimates.append(float(probability_of_improvement(ours, theirs)))
        errors.append(improvement_error(ours, theirs)[0])
    assert np.mean(np.square(errors)) == pytest.approx(np.var(estimates), rel=0.06)


# Student's intervals --------------------------------------------------------------------------------------------------


@examples(50, STRATA)
def test_the_standard_error_of_a_mean_of_means_is_that_of_plain_python(strata):
    if sum(naive.variance(each) for each in strata) < 1e-9:
        assert standard_error(strata, [1.0] * len(strata))[0] < 1e-4
        return
    error, degrees = standard_error(strata, [1 / len(strata)] * len(strata))
    assert (error, degrees) == pytest.approx(naive.error_of_mean(strata))
    value, low, high = mean_interval(strata)
    half = stats.t.ppf(0.975, degrees) * error
    assert (value - low, high - value) == pytest.approx((half, half), abs=1e-9)


@examples(50, RUNS, RUNS)
def test_two_strata_of_opposite_weight_are_welchs_test(x, y):
    if min(naive.variance(x), naive.variance(y)) < 1e-3:
        return
    welch = stats.ttest_ind(x, y, equal_var=False)
    difference, error = float(x.mean() - y.mean()), standard_error([x, y], [1.0, -1.0])
    p = welch_p_value(difference, *error)
    assert p == pytest.approx(welch.pvalue, rel=1e-6, abs=1e-12)
    _, low, high = student_interval(difference, *error)
    assert (low, high) == pytest.approx(tuple(welch.confidence_interval()), rel=1e-6, abs=1e-9)
    assert (low <= 0 <= high) == (p >= 0.05) or p == pytest.approx(0.05)


def test_one_run_has_no_interval_and_equal_runs_are_a_point():
    assert all(map(math.isnan, standard_error([np.array([1.0]), np.array([1.0, 2.0])], [0.5, 0.5])))
    assert all(map(math.isnan, mean_interval([]) + interquartile_interval([])))
    assert mean_interval([np.full(3, 0.1), np.full(2, 0.1)]) == (0.1, 0.1, 0.1)
    assert welch_p_value(0.0, 0.0, math.inf) == 1.0 and welch_p_value(0.1, 0.0, math.inf) == 0.0
    assert student_interval(0.9, 0.2, 5.0, (0.0, 1.0))[2] == 1.0


@pytest.mark.long
def test_the_error_of_an_interquartile_mean_is_that_of_resamples():
    rng = np.random.default_rng(0)
    tasks = [rng.beta(*shape, 40) for shape in ((2, 5), (5, 1), (0.5, 0.5), (9, 9))]
    _, low, high = interquartile_interval(tasks)
    resampled = [
        stats.trim_mean(np.concatenate([rng.choice(task, len(task)) for task in tasks]), 0.25) for _ in range(2000)
    ]
    assert (high - low) / (2 * 1.98) == pytest.approx(np.std(resampled), rel=0.12)


@pytest.mark.slow
def test_intervals_of_ten_skewed_runs_cover_the_mean():
    rng = np.random.default_rng(0)
    failing = [
        np.where(rng.random(20_000) < share, 0.0, rng.beta(10, 2, 20_000)) for share in (0.0, 0.1, 0.3, 0.5, 0.9)
    ]
    truth = np.mean([runs.mean() for runs in failing])
    found = [mean_interval([rng.choice(runs, 10) for runs in failing]) for _ in range(2000)]
    assert 0.93 <= np.mean([low <= truth <= high for _, low, high in found]) <= 0.97


@pytest.mark.long
@examples(50, st.lists(st.lists(st.floats(0, 1), min_size=3, max_size=3), min_size=4, max_size=4), st.floats(0.2, 0.8))
def test_the_interval_of_a_crossing_is_that_of_plain_python(regrets, target):
    if min(map(naive.variance, regrets)) < 1e-6:
        return
    levels = [1.0, 2.0, 4.0, 8.0]
    low, high = fieller_interval(np.array(levels), [np.array(each) for each in regrets], target)
    ends = sorted(naive.crossing_of_limit(levels, regrets, sign, target) for sign in (1, -1))
    assert (low, high) == (pytest.approx(ends[0], abs=1e-9), pytest.approx(ends[1], abs=1e-9))


def test_a_noisy_last_level_opens_no_interval_that_levels_below_exclude():
    levels = np.array([7, 15, 31, 63, 127, 255, 511.0])
    rungs = [[0.03, 0.07, 0.03], [0.8, 0.77, 0.9], [1, 1, 0.67], [1, 0.53, 1], [0.8, 0.8, 0.6], [1, 1, 1], [1, 1, 0.7]]
    low, high = fieller_interval(levels, [np.array(each) for each in rungs], 0.5)
    assert 7 < low < 15 and low < high < 15  # 0.8, 0.77, 0.9 at level 15: its lower limit is 0.65
    turned = [1.0 - np.array(each) for each in rungs[::-1]]  # the same seen from the other end
    ends = fieller_interval(-levels[::-1], turned, 0.5)
    assert ends == (pytest.approx(-high), pytest.approx(-low))


def test_ends_of_the_interval_of_a_crossing_are_where_students_interval_ends_at_the_target():
    """Between levels of few and many runs, one without spread; SciPy's interval of a mean at a level itself."""
    rng, levels = np.random.default_rng(0), np.array([1.0, 2.0, 5.0])
    for _ in range(20):
        rungs = [rng.uniform(0.1, 0.3, 3), np.full(4, 0.45), rng.uniform(0.7, 0.9, 9)]
        low, high = fieller_interval(levels, rungs, 0.5)
        assert 1.0 <= low <= high <= 5.0
        for end, side in ((low, 1), (high, -1)):
            left = 0 if end < 2.0 else 1
            share = (end - levels[left]) / (levels[left + 1] - levels[left])
            weights = {left: 1.0 - share, left + 1: share}
            error = standard_error([rungs[i] for i in weights], list(weights.values()))
            mean = sum(weight * rungs[i].mean() for i, weight in weights.items())
            assert student_interval(mean, *error)[2 if side > 0 else 1] == pytest.approx(0.5, abs=1e-12)
    runs = np.array([0.2, 0.4, 0.3, 0.35])
    upper = stats.t.interval(0.95, 3, runs.mean(), stats.sem(runs))[1]
    low, high = fieller_interval(levels[:2], [runs, np.full(2, 1.0)], upper + 1e-9)
    assert low == pytest.approx(1.0, abs=1e-6) and low > 1.0
    assert fieller_interval(levels[:2], [runs, np.full(2, 1.0)], upper - 1e-9)[0] == -math.inf


@pytest.mark.long
def test_intervals_of_a_crossing_cover_it():
    """Normal runs about 0.05, 0.3, 0.7, 0.95: the crossing of 0.5 is halfway between the second and the third level."""
    rng, levels = np.random.default_rng(0), np.array([1.0, 2.0, 4.0, 8.0])
    intervals = [
        fieller_interval(levels, [rng.normal(mean, 0.15, 5) for mean in (0.05, 0.3, 0.7, 0.95)], 0.5)
        for _ in range(2000)
    ]
    assert 0.94 <= np.mean([low <= 3.0 <= high for low, high in intervals]) <= 0.97


def test_the_interval_of_a_crossing_of_exact_means_is_the_crossing_and_of_one_run_nothing():
    means = (0.0, 0.25, 0.75, 1.0)
    assert fieller_interval(np.arange(4.0), [np.full(2, mean) for mean in means], 0.5) == (1.5, 1.5)
    assert all(map(math.isnan, fieller_interval(np.arange(4.0), [np.array([mean]) for mean in means], 0.5)))


# Bootstrap ------------------------------------------------------------------------------------------------------------


def interval(tasks, **options):
    return bootstrap_interval(tasks, interquartile_mean, **options)


def test_an_interval_contains_the_estimate_and_shrinks_with_more_runs():
    rng = np.random.default_rng(1)
    few = [rng.normal(size=5), rng.normal(size=5)]
    (lower, upper), ends = interval(few), interval([rng.normal(size=80), rng.normal(size=80)])
    assert lower <= interquartile_mean(*few) <= upper
    assert ends[1] - ends[0] < upper - lower


def test_intervals_are_scipys_to_the_last_digit():
    for seed, confidence in ((0, 0.95), (7, 0.8)):
        expected = stats.bootstrap(
            strata(seed),
            interquartile_mean,
            n_resamples=300,
            method="percentile",
            confidence_level=confidence,
            random_state=np.random.default_rng(seed),
        ).confidence_interval
        options = {"confidence": confidence, "resamples": 300, "seed": seed}
        assert interval(strata(seed), **options) == pytest.approx((expected.low, expected.high), abs=1e-15)


def test_an_interval_of_equal_results_is_a_point():
    assert interval([np.full(5, 0.25), np.full(3, 0.25)]) == (0.25, 0.25)


@pytest.mark.slow
def test_the_interval_is_that_of_resampling_each_task_by_a_loop():
    """The twin of the vectorised bootstrap; both ends within four standard errors of such a quantile."""
    rng = np.random.default_rng(3)
    tasks = [rng.normal(size=5), rng.normal(2, 3, size=4), np.array([7.0, 7.0])]
    draws = [interquartile_mean(*(rng.choice(task, len(task)) for task in tasks)) for _ in range(4000)]
    for end, tail in zip(interval(tasks, resamples=4000), (0.025, 0.975), strict=True):
        near = np.quantile(draws, [max(0, tail - 0.014), min(1, tail + 0.014)])
        assert near[0] <= end <= near[1]


def test_runs_are_drawn_whole():
    runs = np.random.default_rng(0).normal(size=(5, 3))
    twice = np.concatenate([runs, runs], axis=1).T  # (6 points, 5 runs): points 3 to 5 repeat 0 to 2
    lower, upper = bootstrap_interval([twice], lambda task, axis: task.mean(axis=axis), resamples=50)
    assert (lower[:3] == lower[3:]).all() and (upper[:3] == upper[3:]).all() and (lower < upper).all()
    lower, upper = bootstrap_interval([np.zeros((2, 4)), np.full((2, 2), 8.0)], mean_of_means)
    assert lower.tolist() == upper.tolist() == [4.0, 4.0]


@pytest.mark.parametrize("numbers", [(1,), (1, 1, 1, 1, 1), (5, 1), (1, 40, 40)])
def test_a_task_of_one_run_leaves_no_interval_as_it_leaves_no_standard_error(numbers):
    """Its run might have been any other: resamples of five such tasks all agree, which says nothing of the mean."""
    tasks = [np.arange(3.0 * number).reshape(3, number) for number in numbers]
    ends = bootstrap_interval(tasks, mean_of_means, resamples=20)
    assert all(end.shape == (3,) and np.isnan(end).all() for end in ends)
    assert np.isnan(interval([task[0] for task in tasks])).all()
    assert math.isnan(mean_interval([task[0] for task in tasks])[1])
    two = [np.concatenate([task, task + 1], axis=1) for task in tasks]
    lower, upper = bootstrap_interval(two, mean_of_means, resamples=200)
    assert (lower < upper).all()


def test_a_bootstrap_of_nothing_and_of_what_is_not_finite_is_refused():
    for nothing in ([], [np.arange(3.0), np.array([])]):
        with pytest.raises(ParameterError, match="at least one run of each task"):
            interval(nothing)
    with pytest.raises(ParameterError, match="finite"):
        interval([np.array([0.0, np.nan])])


def test_a_statistic_that_is_not_defined_for_a_resample_has_no_interval():
    def spread(runs, axis):
        return np.where(np.ptp(runs, axis=axis) > 0, np.ptp(runs, axis=axis), np.nan)

    assert np.isnan(bootstrap_interval([np.arange(2.0)], spread, resamples=50)).all()


def test_percentiles_are_of_finite_values():
    values = np.random.default_rng(0).normal(size=50)
    holes = np.concatenate([values, [np.nan, np.inf, -np.inf]])
    np.testing.assert_array_equal(percentiles(holes, 5, 95), np.percentile(values, [5, 95]))
    assert np.isnan(percentiles(np.full(3, np.nan), 5, 95)).all()


# Tests ----------------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 9), min_size=1, max_size=20), st.integers(0, 9))
def test_the_p_value_of_permutations_counts_the_observed_order_among_them(permuted, value):
    expected = (1 + sum(each >= value for each in permuted)) / (1 + len(permuted))
    holes = np.array([*permuted, np.nan], float)
    assert permutation_p_value(value, holes) == expected
    assert np.isnan(permutation_p_value(np.nan, holes)) and np.isnan(permutation_p_value(value, holes[-1:]))


@given(P_VALUES)
def test_holm_is_that_of_plain_python(p_values):
    assert holm(p_values).tolist() == pytest.approx(naive.holm(p_values))


def test_holm_passes_over_what_is_not_a_number():
    """By hand: 0.005 x 4, 0.01 x 3, 0.03 x 2, and no less than those before."""
    np.testing.assert_allclose(holm([0.01, 0.04, math.nan, 0.03, 0.005]), [0.03, 0.06, np.nan, 0.06, 0.02])
    assert holm([]).shape == (0,) and np.isnan(holm([math.nan])).all()


# Fits and ranks -------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 3), min_size=1, max_size=12))
def test_classes_weigh_alike(numbers):
    classes = np.unique(numbers, return_inverse=True)[1]
    sums = np.bincount(classes, class_weights(classes))
    np.testing.assert_allclose(sums, 1 / len(sums))


def test_r_squared_is_that_of_a_line_and_of_rows_repeated_until_classes_have_one_size():
    rng = np.random.default_rng(0)
    x, y, classes = rng.normal(size=12), rng.normal(size=12), np.repeat([0, 1, 2], [2, 4, 6])
    line = stats.linregress(x, y)
    assert r_squared(y, y - line.intercept - line.slope * x) == pytest.approx(line.rvalue**2)
    repeated = np.repeat(np.arange(12), 12 // np.bincount(classes)[classes])
    assert r_squared(y, y - x, classes) == pytest.approx(r_squared(y[repeated], (y - x)[repeated]))
    assert np.isnan(r_squared(np.ones(3), x[:3])) and np.isnan(r_squared(np.ones(3), x[:3], classes[:3]))


def test_ranks_are_those_of_scipy_with_ties_joined_that_differ_by_rounding():
    rng = np.random.default_rng(3)
    values = rng.integers(0, 6, (40, 30)) * rng.choice([1e-12, 1.0, 1e12], (40, 1))
    np.testing.assert_array_equal(ranks(values), stats.rankdata(values, axis=1))
    nearly = values * (1 + rng.uniform(-1, 1, values.shape) * 1e-15)
    np.testing.assert_array_equal(ranks(nearly), stats.rankdata(values, axis=1))
    assert (stats.rankdata(nearly, axis=1) != stats.rankdata(values, axis=1)).any()
    y = rng.normal(size=30)
    assert spearman(nearly[0], y) == spearman(values[0], y)


def test_spearmans_correlation_is_scipys():
    rng = np.random.default_rng(4)
    for _ in range(20):
        x, y = rng.integers(0, 5, 12).astype(float), rng.normal(size=12)
        assert spearman(x, y) == pytest.approx(stats.spearmanr(x, y).statistic)
    assert np.isnan(spearman(np.ones(5), y[:5])) and np.isnan(spearman(y[:2], y[:2]))
