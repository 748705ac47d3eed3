"""The study's statistics against their formulas, and against fits done another way."""

import math

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from pharos.errors import ParameterError
from pharos.study import (
    aggregate_r_squared,
    fit,
    fit_models,
    leave_one_class_out_r_squared,
    paper_regressions,
    paper_returns,
)
from pharos.study.profiles import THRESHOLDS, improvements, other_winners, profiles, regret_differences


def study_table(noise: float, seed: int = 0, num_instances: int = 12) -> pd.DataFrame:
    """regret = 2 + 3 [image] - 1 [lake] + 0.5 log H + 0.25 log gaps - 0.125 log D + noise."""
    rng = np.random.default_rng(seed)
    rows = []
    for environment in ("grid", "lake"):
        for _ in range(num_instances):
            horizon, gaps, diameter = np.exp(rng.normal(size=3))
            for observation in ("image", "vector"):
                regret = 2 + 3 * (observation == "image") - (environment == "lake")
                regret += 0.5 * np.log(horizon) + 0.25 * np.log(gaps) - 0.125 * np.log(diameter) + noise * rng.normal()
                rows.append((environment, observation, horizon, gaps, diameter, regret))
    names = ["environment", "observation", "effective_horizon", "sum_of_reciprocal_gaps", "diameter", "regret"]
    return pd.DataFrame(rows, columns=names)


def test_a_table_made_by_a_linear_model_gives_its_coefficients_back():
    single = fit_models(study_table(noise=0.0))[0][0]
    assert single.r_squared == pytest.approx(1)
    estimates = single.coefficients["estimate"]
    logs = {"effective_horizon": 0.5, "sum_of_reciprocal_gaps": 0.25, "diameter": -0.125}
    expected = {f"np.log({name})": slope for name, slope in logs.items()}
    expected |= {"C(observation)[T.vector]": -3, "C(environment)[T.lake]": -1}
    assert estimates[[*expected]].to_dict() == pytest.approx(expected)


def test_there_is_one_model_in_all_one_a_representation_and_one_a_class():
    fits, _ = fit_models(study_table(noise=0.5))
    models = ["single", "representation", "representation", "class", "class"]
    assert [f.model for f in fits] == models
    assert [f.subset for f in fits] == ["all", "image", "vector", "grid", "lake"]


def test_cross_validated_r_squared_is_that_of_leaving_each_row_out_and_fitting_again():
    table = study_table(noise=1.0, num_instances=5)
    found = fit(table, "single", "all", ["observation", "environment", "diameter"])
    is_one = np.stack([table["observation"] == "vector", table["environment"] == "lake"], axis=1)
    design = np.column_stack([np.ones(len(table)), is_one, np.log(table["diameter"])])
    regret = table["regret"].to_numpy()
    press = 0.0
    for i in range(len(table)):
        others = np.arange(len(table)) != i
        coefficients, *_ = np.linalg.lstsq(design[others], regret[others], rcond=None)
        press += (regret[i] - design[i] @ coefficients) ** 2
    assert found.cross_validated_r_squared == pytest.approx(1 - press / ((regret - regret.mean()) ** 2).sum())


def test_collinear_predictors_are_dropped_and_named():
    table = study_table(noise=0.5)
    table["diameter"] = table["effective_horizon"] ** 2
    assert fit_models(table)[0][0].dropped == ("diameter",)


def test_aggregate_r_squared_of_one_fit_is_its_own():
    single = fit_models(study_table(noise=0.5))[0][0]
    assert aggregate_r_squared([single]) == pytest.approx(single.r_squared)


def test_regrets_that_are_all_the_same_leave_nothing_to_explain():
    table = study_table(noise=0.5)
    table.loc[table["environment"] == "lake", "regret"] = 0.25
    fits, notes = fit_models(table)
    assert [each.subset for each in fits] == ["all", "image", "vector", "grid"]
    assert [note[:48] for note in notes] == ["the class model of lake has nothing to explain: "]
    same = table.assign(regret=0.25)
    assert "single model of all has nothing to explain: the regret is 0.25 in all" in fit_models(same)[1][0]
    assert np.isnan(leave_one_class_out_r_squared(same))


def test_models_fitted_per_class_explain_at_least_as_much_together_as_one_for_all_without_class_effects():
    table = study_table(noise=1.0)
    one = fit(table, "single", "all", ["observation", "effective_horizon", "sum_of_reciprocal_gaps", "diameter"])
    per_class = [f for f in fit_models(table)[0] if f.model == "class"]
    assert aggregate_r_squared(per_class) >= one.r_squared


def test_predicting_an_unseen_class_is_perfect_where_classes_do_not_differ():
    table = study_table(noise=0.0)
    table["regret"] += table["environment"] == "lake"
    assert leave_one_class_out_r_squared(table) == pytest.approx(1)


@pytest.mark.parametrize("seed", range(30))  # in some of them 1 - leverage is below 0 by rounding, in others above
def test_a_row_that_alone_determines_a_coefficient_has_no_influence_and_no_warning(seed):
    rng = np.random.default_rng(seed)
    alone = np.arange(9) == 4
    rows = pd.DataFrame({"regret": rng.random(9), "diameter": 1 + rng.random(9), "gaps": np.where(alone, 5.0, 1.0)})
    found = fit(rows, "single", "all", ["diameter", "gaps"])
    assert (np.isnan(found.influence) == alone).all()


@pytest.mark.parametrize("function", [fit_models, leave_one_class_out_r_squared])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="diameter"), "no column 'diameter'"),
        (lambda t: t.assign(diameter=0.0), "values <= 0"),
        (lambda t: t.assign(regret=np.nan), "not finite"),
    ],
)
def test_unusable_tables_get_a_clear_error(function, change, message):
    with pytest.raises(ParameterError, match=message):
        function(change(study_table(noise=0.5)))


def test_too_few_rows_have_no_model_and_a_line_says_so():
    fits, notes = fit_models(study_table(noise=0.5).iloc[:5])
    assert not fits and "the single model of all has 5 rows; needs at least" in notes[0]


def test_the_papers_tables_hold_every_printed_block():
    returns = paper_returns()
    assert len(returns) == 336
    assert set(returns["environment"]) == {"simple_grid", "frozen_lake", "freeway", "breakout"}
    assert list(paper_regressions()["r_squared"])[:5] == ["0.09", "0.3", "0.6", "0.48", "0.96"]


def test_a_performance_profile_is_the_share_of_runs_above_each_score():
    scores = {"a": [0.0, 0.5, 1.0], "b": [0.25, 0.75]}
    same = {"environment": "lake", "chance": "plain", "agent": "dqn", "observation": "vector"}
    rows = [{**same, "instance": name, "normalized_regret": 1 - each} for name in scores for each in scores[name]]
    shares = [np.mean([(np.array(task) > tau).mean() for task in scores.values()]) for tau in THRESHOLDS]
    assert profiles(pd.DataFrame(rows), resamples=50)["share"].tolist() == pytest.approx(shares)


def test_profiles_and_improvements_compare_what_has_runs_on_the_same_tasks():
    rows = [
        {"environment": "lake", "instance": instance, "chance": "plain", "agent": "dqn", "observation": observation,
         "normalized_regret": regret + 0.01 * seed}
        for instance in ("a", "b") for seed in range(3)
        for observation, regret in (("vector", 0.2), ("simple_image", 0.5))
    ]  # fmt: skip
    rows.append({**rows[0], "observation": "index", "instance": "c"})
    runs = pd.DataFrame(rows)
    (row,) = improvements(runs, resamples=50).itertuples()
    assert (row.ours, row.theirs, row.tasks) == ("dqn, simple_image", "dqn, vector", 2)
    assert (row.probability, row.lower, row.upper) == (0.0, 0.0, 0.0)
    table = profiles(runs, resamples=50)
    assert set(table["observation"]) == {"vector", "simple_image", "index"}
    seen = table[(table["observation"] == "vector")]
    assert (seen["lower"] <= seen["share"]).all() and (seen["share"] <= seen["upper"]).all()
    assert seen.loc[seen["score"] < 0.75, "share"].min() == 1.0 and seen.loc[seen["score"] > 0.81, "share"].max() == 0.0
    assert table.loc[table["observation"] == "index", ["lower", "upper"]].isna().all(axis=None)  # one run
    alone = pd.concat([runs.iloc[:-1], runs.iloc[:1].assign(instance="c"), runs.iloc[3:4].assign(instance="c")])
    (row,) = improvements(alone, resamples=50).itertuples()  # on a third task both have one run
    assert row.tasks == 3 and row.probability == 0.0 and math.isnan(row.lower) and math.isnan(row.upper)
    assert improvements(runs.assign(normalized_regret=np.nan)).empty and profiles(runs.iloc[:0]).empty


def runs_of(**regrets):
    """Runs of agents on a vector: name -> ((regrets of a task), ...), with returns 1 - regret."""
    rows = [
        {"agent": agent, "observation": "vector", "instance": f"world/{task}", "chance": "plain"}
        | {"environment": "world", "normalized_regret": regret, "return": 1 - regret}
        for agent, tasks in regrets.items()
        for task, own in enumerate(tasks)
        for regret in own
    ]
    return pd.DataFrame(rows)


def test_the_difference_of_two_agents_on_a_task_is_that_of_welchs_test():
    ours, theirs = [0.1, 0.2, 0.25], [0.4, 0.7, 0.5, 0.45]
    row = regret_differences(runs_of(a=[ours], b=[theirs])).iloc[0]
    test = scipy.stats.ttest_ind(ours, theirs, equal_var=False)
    interval = test.confidence_interval(0.95)
    assert (row["ours"], row["theirs"], row["tasks"]) == (("a", "vector"), ("b", "vector"), 1)
    assert row["difference"] == pytest.approx(np.mean(ours) - np.mean(theirs))
    assert (row["lower"], row["upper"]) == pytest.approx((interval.low, interval.high))
    assert row["adjusted"] == row["p_value"] == pytest.approx(test.pvalue)


def test_differences_are_means_over_common_tasks_and_corrected_for_their_number():
    runs = runs_of(a=[[0.1, 0.2], [0.3, 0.4], [9.0, 9.1]], b=[[0.5, 0.6], [0.6, 0.8]], c=[[0.15, 0.2], [0.3, 0.45]])
    table = regret_differences(runs)
    assert table["tasks"].tolist() == [2, 2, 2]
    assert table["difference"].tolist() == pytest.approx([-0.375, -0.025, 0.35])
    assert (table["adjusted"] >= table["p_value"]).all() and table["adjusted"].max() == table["p_value"].max()
    assert table["adjusted"].min() == pytest.approx(3 * table["p_value"].min())
    assert np.isnan(regret_differences(runs_of(a=[[0.1]], b=[[0.2, 0.3]]))["adjusted"]).all()  # one run says nothing


def test_tasks_whose_highest_return_is_not_of_the_least_regret_are_named():
    runs = runs_of(a=[[0.1, 0.2], [0.3]], b=[[0.5], [0.6]])
    assert len(other_winners(runs)) == 0 and other_winners(runs).attrs["tasks"] == 2
    played = runs.assign(**{"return": [1.0, 2.0, 5.0, 9.0, 4.0]})
    (row,) = other_winners(played).to_dict("records")
    assert (row["instance"], row["most"], row["least"]) == ("world/0", ("b", "vector"), ("a", "vector"))
    assert (row["most_return"], row["least_return"]) == (9.0, 1.5)
    assert (row["most_regret"], row["least_regret"]) == pytest.approx((0.5, 0.15))
