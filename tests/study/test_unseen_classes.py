"""Statistics of predictors on classes that they have not seen, each against a plain twin or a simulated truth."""

import numpy as np
import pandas as pd
import pytest

from pharos import study
from pharos.errors import ParameterError
from pharos.prediction.pairs import Pairs
from pharos.statistics import percentiles, permutation_p_value, r_squared, spearman
from pharos.study import PredictedCells, leave_one_class_out
from pharos.study import cross_validation as held_out
from pharos.study.predictions import late
from pharos.study.specification import specification
from pharos.training import CELL


def design(classes=5, instances=3, predictors=2, seed=0):
    rng = np.random.default_rng(seed)
    number = np.repeat(np.arange(classes), instances * 2)
    x = rng.normal(size=(len(number), predictors)) + number[:, None]
    y = x @ np.arange(1, predictors + 1) + 3 * rng.normal(size=len(number))
    return x, y, number, np.repeat(np.arange(classes * instances), 2)


def plainly(x, y, blocks, classes):
    """Each block by weighted normal equations over the other rows, one row at a time."""
    found = []
    for i in range(len(y)):
        rest = [j for j in range(len(y)) if blocks[j] != blocks[i]]
        size = {c: sum(classes[j] == c for j in rest) for c in classes}
        rows = [np.array([1.0, *x[j]]) for j in rest]
        left = sum(np.outer(row, row) / size[classes[j]] for row, j in zip(rows, rest, strict=True))
        right = sum(row * y[j] / size[classes[j]] for row, j in zip(rows, rest, strict=True))
        found.append(np.array([1.0, *x[i]]) @ np.linalg.solve(left, right))
    return np.array(found)


def test_left_out_classes_and_mdps_are_predicted_by_all_other_rows():
    x, y, classes, mdps = design()
    x, y, classes, mdps = x[:-3], y[:-3], classes[:-3], mdps[:-3]  # classes of different sizes
    for blocks in (classes, mdps):
        np.testing.assert_allclose(held_out.class_predictions(x, y, blocks, classes), plainly(x, y, blocks, classes))


def test_partial_correlations_do_not_order_what_differs_by_rounding():
    rng = np.random.default_rng(3)
    values = rng.integers(0, 6, (2, 30)).astype(float)
    nearly, y = values[0] * (1 + rng.uniform(-1, 1, 30) * 1e-15), rng.normal(size=30)
    partial = [
        held_out.partial_correlation(x, y, values[1][:, None], np.arange(30) % 5, np.ones((1, 5), int))
        for x in (values[0], nearly)
    ]
    np.testing.assert_array_equal(*partial)


def test_samples_of_classes_count_each_as_often_as_it_was_drawn():
    """As if its rows stood there again, and were left out together."""
    x, y, classes, _ = design()
    counts = np.array([[1, 1, 1, 1, 1], [2, 0, 1, 1, 1], [0, 3, 1, 0, 1]])
    scores, rho = held_out.held_out(x, y, classes, counts)
    for count, score, correlation in zip(counts, scores, rho, strict=True):
        rows = np.concatenate([np.flatnonzero(classes == c) for c in range(5) for _ in range(count[c])])
        weights = np.concatenate([np.full(count[c] * 6, 1.0) for c in range(5)])
        predicted = np.empty(len(rows))
        for c in np.flatnonzero(count):
            out = classes[rows] == c
            line = np.linalg.lstsq(np.column_stack([np.ones((~out).sum()), x[rows[~out]]]), y[rows[~out]])[0]
            predicted[out] = np.column_stack([np.ones(out.sum()), x[rows[out]]]) @ line
        aims = y[rows]
        expected = 1 - weights @ (aims - predicted) ** 2 / (weights @ (aims - aims.mean()) ** 2)
        assert score == pytest.approx(expected)
        assert correlation == pytest.approx(spearman(predicted, aims))


@pytest.mark.long
def test_intervals_over_classes_cover_the_rank_correlation():
    """Classes differ in the predictor and by a part that it does not tell; the truth is that of 20,000 classes."""

    def world(rng, number):
        classes = np.repeat(np.arange(number), 7)
        x = 1.5 * rng.normal(size=number)[classes] + rng.normal(size=len(classes))
        return x, x + 0.8 * rng.normal(size=number)[classes] + 0.5 * rng.normal(size=len(classes)), classes

    rng = np.random.default_rng(0)
    truth = spearman(*world(rng, 20_000)[:2])
    covered = []
    for seed in range(200):
        x, y, classes = world(rng, 26)
        counts = held_out.resampled_classes(26, 200, seed)
        low, high = np.percentile(held_out.held_out(x[:, None], y, classes, counts)[1], (2.5, 97.5))
        covered.append(low <= truth <= high)
    assert 0.91 <= np.mean(covered) <= 0.98


def test_permutations_give_each_class_the_predictors_of_another():
    x, y, classes, _ = design(classes=4)
    places = list(range(6)) * 4
    scores, rho = held_out.permuted_classes(x, y, classes, places, 3, seed=5)
    rng = np.random.default_rng(5)
    orders = [np.arange(4), *(rng.permutation(4) for _ in range(3))]
    for order, score, correlation in zip(orders, scores, rho, strict=True):
        other = np.concatenate([x[classes == order[c]] for c in range(4)])
        predicted = held_out.class_predictions(other, y, classes, classes)
        assert score == pytest.approx(r_squared(y, y - predicted, classes))
        assert correlation == pytest.approx(spearman(predicted, y))


def test_without_a_relation_p_values_are_uniform():
    """At most a tenth of them below a tenth, but for chance: 60 data sets without any relation."""
    rng = np.random.default_rng(1)
    classes, places = np.repeat(np.arange(8), 4), list(range(4)) * 8
    found = []
    for i in range(60):
        x, y = rng.normal(size=(32, 1)) + rng.normal(size=8)[classes][:, None], rng.normal(size=32)
        y = y + rng.normal(size=8)[classes]
        rho = held_out.permuted_classes(x, y, classes, places, 99, i)[1]
        found.append(permutation_p_value(rho[0], rho[1:]))
    assert np.mean(np.array(found) <= 0.1) <= 0.1 + 3 * np.sqrt(0.09 / 60)
    assert 0.35 < np.mean(found) < 0.65


def test_calibration_is_the_line_of_outcomes_on_predictions():
    predicted, classes = np.arange(12.0), np.repeat([0, 1, 2], 4)
    assert held_out.calibration(2 * predicted - 1, predicted, classes) == pytest.approx((2, -1))


def test_the_ceiling_is_the_share_of_variance_that_is_not_noise_over_seeds():
    """Cells of variance 1, five seeds of variance 1 each: 1 of 1.2."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(4000, 1)) + rng.normal(size=(4000, 5))
    classes = np.repeat(np.arange(4), 1000)
    found = held_out.ceiling(values.mean(axis=1), values.var(axis=1, ddof=1) / 5, classes)
    assert found == pytest.approx(1 / 1.2, abs=0.02)
    assert np.isnan(held_out.ceiling(values[:, 0], np.full(4000, np.nan), classes))


def test_partial_correlations_are_those_of_the_textbook():
    """(r_xy - r_xz r_yz) / sqrt((1 - r_xz^2) (1 - r_yz^2)), of ranks."""
    rng = np.random.default_rng(0)
    z = rng.normal(size=60)
    x, y = z + rng.normal(size=60), z + rng.normal(size=60)
    r = [spearman(*pair) for pair in ((x, y), (x, z), (y, z))]
    expected = (r[0] - r[1] * r[2]) / np.sqrt((1 - r[1] ** 2) * (1 - r[2] ** 2))
    classes = np.repeat(np.arange(6), 10)
    found = held_out.partial_correlation(x, y, z[:, None], classes, np.ones((1, 6), int))
    assert found[0] == pytest.approx(expected)


def test_pairs_of_observations_of_one_mdp_are_compared():
    rng = np.random.default_rng(0)
    x, y, mdps = rng.normal(size=24), rng.normal(size=24), np.repeat(np.arange(6), 4)
    right = number = 0
    for i in range(24):
        for j in range(i):
            if mdps[i] == mdps[j] and abs(y[i] - y[j]) > 0.05:
                number += 1
                right += (x[i] > x[j]) == (y[i] > y[j])
    pairs = Pairs.of(y, mdps)
    assert (len(pairs.first), pairs.agreement(x)) == (number, right / number)
    assert pairs.agreement(np.zeros(24)) == 0.5


def test_pairs_of_a_single_class_have_no_interval_over_classes():
    """However often it is drawn, its share is the same: an interval without width, which holds nothing but itself."""
    y, x, mdps = np.array([0.0, 1.0, 2.0, 0.5, 0.5]), np.array([0.0, 2.0, 1.0, 1.5, 0.7]), np.array([0, 0, 0, 1, 1])
    counts = np.array([[1, 1, 1], [2, 0, 1], [0, 2, 1]])
    pairs = Pairs.of(y, mdps)
    assert pairs.agreement(x) == pytest.approx(2 / 3)
    assert np.isnan(pairs.interval(x, np.array([0, 0, 0, 1, 1]), counts)).all()
    assert np.isnan(Pairs.of(np.zeros(5), mdps).interval(x, np.array([0, 0, 0, 1, 1]), counts)).all()
    low, high = Pairs.of(y, np.array([0, 0, 1, 1, 2])).interval(x, np.array([0, 0, 1, 1, 2]), counts)
    assert low < 0.1 and high > 0.9  # one of two pairs is in order, each in a class of its own


@pytest.mark.parametrize("classes", (2, 3, 4))
def test_intervals_over_classes_need_four(classes):
    """Three that differ, drawn from three, are those three: all samples would be one, and intervals without width."""
    x, y, number, mdps = design(classes=classes, predictors=1)
    counts = held_out.resampled_classes(classes, 200, 0)
    assert (counts.sum(axis=1) == classes).all() and ((counts > 0).sum(axis=1) >= 3).all()
    assert len(np.unique(counts, axis=0)) == {2: 0, 3: 0, 4: 13}[classes]  # (1, 1, 1, 1), and twelve of (2, 1, 1, 0)
    ends = [percentiles(each, 2.5, 97.5) for each in held_out.held_out(x, y, number, counts)]
    ends.append(Pairs.of(y, mdps).interval(x[:, 0], number, counts))
    for low, high in ends:
        assert low < high if classes == 4 else np.isnan([low, high]).all()


def test_predictions_that_differ_by_rounding_are_alike():
    """As for ranks: a difference within a billionth of the spread counts one half, one that is larger orders a pair."""
    y, mdps = np.array([0.0, 1.0, 0.0, 1.0]), np.array([0, 0, 1, 1])
    pairs = Pairs.of(y, mdps)
    for scale in (1e-6, 1.0, 1e12):
        x = scale * np.array([0.7, 0.7 + 5e-10, 0.2, 1.2])
        assert pairs.right(x).tolist() == [0.5, 1.0]
        assert pairs.right(x + scale * np.array([5e-9, 0, 0, 0])).tolist() == [0.0, 1.0]
        shuffled = pairs.permuted(x, np.array([0, 0, 1, 1]), mdps, ["a", "b", "a", "b"], 50, 0)
        assert set(shuffled) == {0.25, 0.75}
    assert np.isnan(pairs.only(np.zeros(2, bool)).agreement(np.zeros(0)))


def test_the_ceiling_of_agreement_is_that_of_a_predictor_that_knows_expectations():
    """4,000 pairs of cells; means of seeds are their expectations with normal noise."""
    rng = np.random.default_rng(0)
    truth, noise = rng.uniform(0, 5, 8000), rng.uniform(0.2, 1.5, 8000)
    y = truth + rng.normal(size=8000) * np.sqrt(noise)
    signs = np.sign(y[::2] - y[1::2])
    some = Pairs(np.arange(0, 8000, 2), np.arange(1, 8000, 2), signs)
    assert 0.7 < some.agreement(truth) < 0.9
    assert some.ceiling(y, noise) == pytest.approx(some.agreement(truth), abs=0.04)
    assert some.ceiling(y, np.zeros(8000)) == 1.0
    assert np.isnan(some.ceiling(y, np.full(8000, np.nan)))


def test_a_class_whose_instances_agree_counts_once():
    """One class, two observations: whatever the number of its instances, two names for them, so p is never small."""
    mdps = np.repeat(np.arange(20), 2)
    x = np.tile([0.0, 1.0], 20)
    pairs = Pairs.of(x, mdps)
    shuffled = pairs.permuted(x, np.zeros(40, int), mdps, ["vector", "image"] * 20, 200, 0)
    assert set(shuffled) == {0.0, 1.0}
    assert 0.4 < permutation_p_value(pairs.agreement(x), shuffled) < 0.6


@pytest.mark.slow
def test_mixed_models_find_the_slope_that_was_simulated_and_agree_with_least_squares_of_known_variances():
    rng = np.random.default_rng(3)
    classes = np.repeat(np.arange(12), 15)
    mdps = np.repeat(np.arange(36), 5)
    x = rng.normal(size=180) + rng.normal(size=12)[classes]
    z = (x - x.mean()) / x.std()
    y = 0.5 * z + rng.normal(size=12)[classes] + 0.5 * rng.normal(size=36)[mdps] + 0.3 * rng.normal(size=180)
    fit = leave_one_class_out.mixed_fit(x, y, classes, mdps)
    assert abs(fit.slope - 0.5) < 3 * fit.error
    assert fit.p_value < 1e-4
    same_class, same_mdp = np.equal.outer(classes, classes), np.equal.outer(mdps, mdps)
    covariance = fit.class_variance * same_class + fit.mdp_variance * same_mdp + fit.residual_variance * np.eye(180)
    design = np.column_stack([np.ones(180), z])
    weighted = np.linalg.solve(covariance, design)
    assert fit.slope == pytest.approx(np.linalg.solve(design.T @ weighted, weighted.T @ y)[1], rel=1e-4)
    assert fit.error == pytest.approx(np.sqrt(np.linalg.inv(design.T @ weighted)[1, 1]), rel=1e-3)
    assert leave_one_class_out.mixed_fit(x[:30], y[:30], classes[:30], mdps[:30]) is None  # two classes


def test_outcomes_are_means_over_evaluations_with_their_noise_over_seeds():
    of = {"environment": "a", "instance": "a/1", "chance": "plain", "agent": "dqn", "observation": "vector"}
    runs = pd.DataFrame(
        [
            {
                **of,
                "id": "x",
                "value_optimal": 1.0,
                "value_uniform": 0.0,
                "episodes": 10,
                "cumulative_realised_regret": 5,
                "normalized_realised_regret": 0.5,
            },
            {
                **of,
                "id": "y",
                "value_optimal": 1.0,
                "value_uniform": 0.0,
                "episodes": 20,
                "cumulative_realised_regret": 5,
                "normalized_realised_regret": 0.25,
            },
        ]
    )
    points = pd.DataFrame({"id": [*"xxxyyy"], "step": [0, 50, 100] * 2, "normalized_regret": [1, 0.5, 0, 1, 0.8, 0.6]})
    cell = study.outcomes(runs, points).iloc[0]
    assert cell["greedy"] == pytest.approx((0.5 + 0.8) / 2)
    assert cell["greedy_noise"] == pytest.approx(0.3**2 / 2 / 2)
    assert cell["steps_to_tenth"] == 1.0  # at the last step, and never
    assert cell["played"] == pytest.approx((0.5 + 0.25) / 2)
    assert (cell["cumulative"], cell["random_scale"]) == (5, 15)


def test_seeds_without_an_outcome_do_not_count_for_its_noise():
    of = {"environment": "a", "instance": "a/1", "chance": "plain", "agent": "dqn", "observation": "vector"}
    regrets, ends = (0.3, 0.5, np.nan), {"value_optimal": 1.0, "value_uniform": 0.0, "episodes": 1}
    runs = pd.DataFrame(
        [
            {**of, **ends, "id": str(i), "cumulative_realised_regret": each, "normalized_realised_regret": each}
            for i, each in enumerate(regrets)
        ]
    )
    points = pd.DataFrame({"id": ["0", "1", "2"], "step": [0, 0, 0], "normalized_regret": [0.5] * 3})
    cell = study.outcomes(runs, points).iloc[0]
    assert cell["played"] == pytest.approx(0.4) and cell["played_noise"] == pytest.approx(0.02 / 2)


def test_runs_that_had_begun_are_told():
    runs = pd.DataFrame({"id": [*"abc"], "began": ["2026-01-01T00:00:00Z", "2026-01-02T00:00:01Z", ""]})
    assert late(runs, {"date": "2026-01-02T00:00:00Z"}) == (1, 1)


def test_predictions_that_came_after_runs_are_no_predictions():
    from types import SimpleNamespace

    from pharos.study.report.model_sections import doubts

    about = PredictedCells([(pd.DataFrame(columns=CELL), {"date": "2026-01-02T00:00:00Z"})])
    results = SimpleNamespace(runs=pd.DataFrame({"id": ["a"], "began": ["2026-01-02T00:00:01Z"]}))
    assert doubts(results, about) == []
    results.runs["began"] = "2026-01-01T00:00:00Z"
    assert doubts(results, about) == ["not a prediction: 1 of 1 run had begun when the predictions were written"]


def test_each_run_is_held_to_the_date_of_its_own_prediction():
    cells = pd.DataFrame([["grid", "4x4", chance, "dqn", "vector"] for chance in ("plain", "random 0.1")], columns=CELL)
    runs = cells.assign(id=["a", "b"], began="2026-01-02T00:00:00Z")
    dates = ({"date": "2026-01-01T00:00:00Z"}, {"date": "2026-01-03T00:00:00Z"})
    parts = [(cells.iloc[[i]], about) for i, about in enumerate(dates)]
    assert PredictedCells.of(parts).late(runs) == (1, 0)
    assert PredictedCells.of(parts).cells.equals(cells)
    assert PredictedCells.of(parts[0]).parts == parts[:1]
    assert PredictedCells.of(None) is PredictedCells.of([]) is None
    assert PredictedCells.of(parts).late(runs.assign(began=["", "2026-01-04T00:00:00Z"])) == (0, 1)
    with pytest.raises(ParameterError, match="1 cell predicted twice, such as grid, 4x4, plain, dqn, vector; expected"):
        PredictedCells.of([*parts, parts[0]])


def test_settings_and_families_make_cells_of_their_own():
    block = {"environments": ["simple_grid/4x4-plain"], "agents": ["dqn"]}
    other = {
        **block,
        "environments": [{"name": "simple_grid/4x4-plain", "family": "mazes", "observations": ["one_hot"]}],
    }
    found = specification(
        {"name": "x", "seeds": 1, "blocks": [block, {**block, "setting": "tuned", "steps": 70_000}, other]}
    ).runs
    cells = [run.cell for run in found]
    assert [cell["agent"] for cell in cells] == ["dqn", "dqn tuned", "dqn"]
    assert [cell["environment"] for cell in cells] == ["simple_grid", "simple_grid", "mazes"]
    assert [cell["observation"] for cell in cells] == ["vector", "vector", "one_hot"]
    assert {run.config["agent"] for run in found} == {"dqn"}


def test_the_last_component_is_hidden_whatever_its_name():
    import pharos
    from pharos.observations import observe

    env = pharos.make("taxi")
    states = np.array([env.initial_states()[5][0]])
    whole, hidden = observe(env, "vector")(states), observe(env, "vector", hide=-1)(states)
    assert hidden[0, -1] == 0 and (hidden[0, :-1] == whole[0, :-1]).all()
    with pytest.raises(pharos.errors.ParameterError, match="-1 to -5"):
        observe(env, "vector", hide=5)
