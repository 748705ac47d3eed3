"""The paper's findings, on cells whose truth is known."""

import importlib
import itertools
import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import strategies as st
from scipy import stats

from pharos import study
from strategies import examples

_findings = importlib.import_module("pharos.study.findings")

CLASSES = ("simple_grid", "frozen_lake", "breakout", "freeway")
MEASURES = ("effective_horizon", "sum_of_reciprocal_gaps", "diameter")


def made(image_harder=0.0, slopes=(1.0, 1.0, 1.0, 1.0), image_slope=1.0, noise=0.1, instances=6, seed=0, ppo=0.0):
    """Cells of DQN (and PPO): regret grows with log diameter by a slope for each class; images cost `image_harder`
    more."""
    random = np.random.default_rng(seed)
    rows = []
    for environment, slope in zip(CLASSES, slopes, strict=True):
        for instance in range(instances):
            for chance in ("plain", "sticky 0.25"):
                measures = dict(zip(MEASURES, np.exp(random.normal(0, 1, 3)), strict=True))
                for observation in ("vector", "simple_image"):
                    is_image = observation == "simple_image"
                    signal = slope * math.log(measures["diameter"]) * (image_slope if is_image else 1.0)
                    for agent in ("dqn", "ppo"):
                        regret = 5 + signal + is_image * image_harder + noise * random.normal()
                        rows.append(
                            {
                                "environment": environment,
                                "instance": f"{environment}/{instance}",
                                "chance": chance,
                                "agent": agent,
                                "observation": observation,
                                "cumulative_regret": regret,
                                "normalized_regret": regret / 10,
                                "return": -regret + (ppo * random.normal() if agent == "ppo" else 0.0),
                                **measures,
                            }
                        )
    return pd.DataFrame(rows)


def verdicts(cells, **options):
    found = study.findings(cells, study.models(cells), resamples=200, **options)
    return {(row.finding, row.of): row for row in found.itertuples()}


OBSERVATION = "the harder observation of DQN"
LEARNER = "the learner with more regret"


@pytest.mark.long
@pytest.mark.parametrize(
    ("shift", "ours", "grids", "games"), ((1, "image", "agrees", "disagrees"), (-1, "vector", "disagrees", "agrees"))
)
def test_the_harder_observation_is_found_in_each_class(shift, ours, grids, games):
    found = verdicts(made(image_harder=shift))
    for environment in CLASSES:
        row = found[OBSERVATION, environment]
        assert row.ours == ours and row.p < 0.001
        assert row.verdict == (grids if environment in ("simple_grid", "frozen_lake") else games)


@pytest.fixture(scope="module")
def without_effect():
    """Verdicts on 25 data sets in which nothing has an effect: noise of each cell, and noise that both observations of
    a task share, as nothing else than the task decides on it."""
    found = []
    for seed in range(25):
        cells = made(slopes=(0, 0, 0, 0), noise=0.1, seed=seed)
        random = np.random.default_rng(seed)
        shared = {key: random.normal() for key in cells.groupby(["instance", "chance"]).groups}
        cells["cumulative_regret"] += [shared[row.instance, row.chance] for row in cells.itertuples()]
        found.append(verdicts(cells))
    return found


@pytest.mark.long
def test_equal_observations_are_undecided_as_often_as_the_level_says(without_effect):
    decided = [
        row.verdict != "undecided"
        for found in without_effect
        for (finding, _), row in found.items()
        if finding == OBSERVATION
    ]
    assert len(decided) == 100 and sum(decided) <= 14  # 5 expected


@pytest.mark.long
def test_one_model_that_explains_much_disagrees_with_the_paper():
    name = ("one model explains next to nothing", "all")
    assert verdicts(made())[name].verdict == "disagrees"
    row = verdicts(made(slopes=(0, 0, 0, 0), seed=3))[name]
    assert row.verdict == "agrees" and row.p > 0.05


@pytest.mark.long
def test_slopes_of_their_own_are_needed_where_they_differ():
    by_class, by_representation = (f"models by {model} explain more than one" for model in ("class", "representation"))
    alike, classes, images = verdicts(made()), verdicts(made(slopes=(1, -1, 2, 0))), verdicts(made(image_slope=-1.0))
    assert alike[by_class, "all"].verdict == alike[by_representation, "all"].verdict == "undecided"
    assert classes[by_class, "all"].verdict == "agrees" and classes[by_representation, "all"].verdict == "undecided"
    assert images[by_representation, "all"].verdict == "agrees"


def by_task(cells):
    """One row a task: DQN's regret, the mean over observations and the difference between them."""
    rows = cells[cells["agent"] == "dqn"]
    wide = rows.pivot_table(
        index=["environment", "instance", "chance", *MEASURES], columns="observation", values="cumulative_regret"
    ).reset_index()
    return wide.assign(regret=(wide["simple_image"] + wide["vector"]) / 2, more=wide["simple_image"] - wide["vector"])


LOGS = " + ".join(f"np.log({name})" for name in MEASURES)


@pytest.mark.slow
def test_the_test_of_slopes_is_that_of_an_analysis_of_variance():
    """Against statsmodels' comparison of the nested models, written as one formula each, a row for each task."""
    import statsmodels.formula.api as smf
    from statsmodels.stats.anova import anova_lm

    cells = made(slopes=(1, 0.9, 1.1, 1), noise=1.0)
    rows = by_task(cells)
    found = verdicts(cells)
    small = smf.ols(f"regret ~ C(environment) + {LOGS}", rows).fit()
    large = smf.ols(f"regret ~ C(environment) * ({LOGS})", rows).fit()
    expected = anova_lm(small, large)["Pr(>F)"].iloc[1]
    assert found["models by class explain more than one", "all"].p == pytest.approx(expected, rel=1e-6)
    expected = smf.ols(f"more ~ C(environment) + {LOGS}", rows).fit().f_pvalue
    assert found["models by representation explain more than one", "all"].p == pytest.approx(expected, rel=1e-6)
    assert found["one model explains next to nothing", "all"].p == pytest.approx(small.f_pvalue, rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("finding", ("one model explains next to nothing", "models by class explain more than one"))
def test_a_task_seen_twice_is_one_piece_of_evidence(finding):
    """Images repeat what vectors told: the p-value is that of the vectors alone."""
    cells = made(slopes=(0.1, 0, 0.2, 0), noise=1.0)
    vectors = cells[cells["observation"] == "vector"]
    twice = pd.concat([vectors, vectors.assign(observation="simple_image")])
    assert verdicts(twice)[finding, "all"].p == pytest.approx(verdicts(vectors)[finding, "all"].p, rel=1e-6)


@pytest.mark.long
def test_tests_without_effect_are_significant_as_often_as_the_level_says(without_effect):
    """2.5 of 50 expected."""
    names = ("one model explains next to nothing", "models by class explain more than one")
    significant = sum(found[name, "all"].p < 0.05 for found in without_effect for name in names)
    assert significant <= 8


def test_regret_that_only_the_class_explains_is_said_to_be_so():
    cells = made(slopes=(0, 0, 0, 0), noise=0.1)
    cells["cumulative_regret"] += cells["environment"].map(CLASSES.index)
    row = verdicts(cells)["one model explains next to nothing", "all"]
    assert row.verdict == "disagrees, mostly by class" and "measures add 0.00" in row.evidence


def test_standard_errors_of_the_models_count_a_task_once():
    import statsmodels.formula.api as smf

    cells = made(noise=1.0, image_harder=0.5)
    rows, models = by_task(cells), study.models(cells)
    expected = smf.ols(f"regret ~ C(environment) + {LOGS}", rows).fit()
    single = models.get("single", "all").coefficients
    for name in (*(f"np.log({measure})" for measure in MEASURES), "C(environment)[T.freeway]"):
        assert single.loc[name, "estimate"] == pytest.approx(expected.params[name])
        assert single.loc[name, "standard_error"] == pytest.approx(expected.bse[name])
        assert single.loc[name, "p_value"] == pytest.approx(expected.pvalues[name])
        assert single.loc[name, ["lower", "upper"]].tolist() == pytest.approx(expected.conf_int().loc[name].tolist())
    paired = stats.ttest_rel(rows["vector"], rows["simple_image"])
    assert single.loc["C(observation)[T.vector]", "p_value"] == pytest.approx(paired.pvalue)


def test_r_squared_outside_leaves_out_the_whole_task():
    cells = made(noise=1.0, instances=3)
    rows = cells[cells["agent"] == "dqn"].reset_index(drop=True)
    single = study.models(cells).get("single", "all")
    press = 0.0
    for task in set(single.tasks):
        inside = np.array([other == task for other in single.tasks])
        coefficients, *_ = np.linalg.lstsq(single.design[~inside], single.actual[~inside], rcond=None)
        press += ((single.actual[inside] - single.design[inside] @ coefficients) ** 2).sum()
    total = ((rows["cumulative_regret"] - rows["cumulative_regret"].mean()) ** 2).sum()
    assert single.cross_validated_r_squared == pytest.approx(1 - press / total)


@pytest.mark.long
def test_where_tasks_differ_in_their_observations_errors_are_clustered():
    cells = made(noise=1.0)
    lacking = cells.drop(cells[(cells["observation"] == "vector") & (cells["agent"] == "dqn")].index[:3])
    coefficients = study.models(lacking).get("single", "all").coefficients
    assert np.isfinite(coefficients["standard_error"]).all()
    assert verdicts(lacking)["one model explains next to nothing", "all"].evidence.startswith("F(6, 38)")


@pytest.mark.long
def test_vectors_that_hardness_explains_better_are_found():
    name = ("hardness explains vectors better than images", "all")
    assert verdicts(made(image_slope=0.0, noise=0.3))[name].verdict == "agrees"
    assert verdicts(made(noise=0.3))[name].verdict == "undecided"


@pytest.mark.slow
def test_agreement_has_fishers_interval():
    row = verdicts(made(ppo=1.5))["DQN and PPO find the same hard", "all"]
    cells = made(ppo=1.5)
    wide = cells.pivot_table(index=["instance", "chance", "observation"], columns="agent", values="return")
    expected = stats.pearsonr(wide["dqn"], wide["ppo"])
    low, high = expected.confidence_interval()
    wide = cells.pivot_table(index=["instance", "chance", "observation"], columns="agent", values="normalized_regret")
    assert row.evidence.startswith(
        f"of returns {low:.2f} to {high:.2f} (95 %, 96 cells); of normalised regret r = "
        f"{stats.pearsonr(wide['dqn'], wide['ppo'])[0]:.2f};"
    )
    assert row.verdict == ("agrees" if high >= 0.81 else "disagrees")


def test_what_is_not_there_is_no_data():
    cells = made()
    grids = cells[
        (cells["environment"] == "simple_grid") & (cells["observation"] == "vector") & (cells["agent"] == "dqn")
    ]
    found = verdicts(grids)
    assert found[OBSERVATION, "freeway"].verdict == found[OBSERVATION, "simple_grid"].verdict == "no data"
    assert found["models by class explain more than one", "all"].verdict == "no data"
    assert found["DQN and PPO find the same hard", "all"].verdict == "no data"
    assert len(found) == 13


def test_the_power_of_an_f_test_is_the_published_one():
    """Two predictors, f2 = 0.15, power 0.95: 107 observations (an example of the manual of G*Power)."""
    r_squared = 0.15 / 1.15
    assert _findings._power_of_f(2, 106 - 3, r_squared) < 0.95 <= _findings._power_of_f(2, 107 - 3, r_squared)
    assert _findings._power_of_f(3, 20, 0.0) == pytest.approx(0.05)


def test_the_power_of_a_difference_is_that_of_the_normal_approximation():
    assert _findings._power_of_mean(0.0, 1.0, 50) == pytest.approx(0.05, abs=1e-4)
    number = round((1.959964 + 0.841621) ** 2 * math.pi / 3 * 4)  # of 80 %, for half a deviation
    assert _findings._power_of_mean(0.5, 1.0, number) == pytest.approx(0.8, abs=0.01)


@pytest.mark.long
def test_each_finding_says_with_what_power_it_could_have_been_found():
    found = study.findings(made(), study.models(made()), resamples=50)
    tested = found[found["finding"] != LEARNER]
    assert tested["power"].between(0.04, 1.0).all()
    few = made(instances=2)
    fewer = study.findings(few, study.models(few), resamples=50)
    both = found.merge(fewer, on=["finding", "of"], suffixes=("", "_few"))
    known = both[both["power_few"].notna() & both["finding"].str.startswith(("models by class", "one model"))]
    assert len(known) and (known["power_few"] < known["power"]).all()


@pytest.mark.parametrize(("shift", "ours", "grids"), ((2, "table", "disagrees"), (-2, "DQN", "agrees")))
def test_a_table_is_compared_with_dqn_on_vectors(shift, ours, grids):
    cells = made()
    table = cells[(cells["agent"] == "dqn") & (cells["observation"] == "vector")].assign(
        agent="q_learning", observation="index"
    )
    table["normalized_regret"] += shift
    found = verdicts(pd.concat([cells, table]))
    row = found[LEARNER, "simple_grid"]
    assert (row.ours, row.verdict, found[LEARNER, "freeway"].verdict) == (
        ours, grids, "agrees" if grids == "disagrees" else "disagrees"
    )  # fmt: skip
    assert row.lower == pytest.approx(shift) == row.upper


def test_classes_that_lack_an_observation_are_no_data():
    cells = made()
    cells = cells[(cells["environment"] != "freeway") | (cells["observation"] == "vector")]
    assert verdicts(cells)["models by class explain more than one", "all"].verdict == "no data"


@pytest.mark.parametrize("number", (6, 10, 18, 44))
def test_the_interval_of_a_difference_holds_what_the_signed_rank_test_does_not_exclude(number):
    differences = np.random.default_rng(number).normal(0.3, 1, number)
    (effect, lower, upper), p = _findings._signed_ranks(differences)
    assert lower < effect < upper
    assert p == pytest.approx(stats.wilcoxon(differences, method="exact").pvalue, rel=1e-9)
    for inside, outside in ((lower + 1e-6, lower - 1e-6), (upper - 1e-6, upper + 1e-6)):
        assert stats.wilcoxon(differences - inside, method="exact").pvalue > 0.05
        assert stats.wilcoxon(differences - outside, method="exact").pvalue <= 0.05


def test_five_differences_have_no_interval():
    assert _findings._signed_ranks(np.arange(1.0, 6.0)) == ((3.0, -math.inf, math.inf), 0.0625)


@pytest.mark.parametrize("paper", ("image", "vector"))
def test_a_verdict_has_the_sign_of_the_effect_beside_it(paper):
    """More tasks in which vectors are slightly harder, but clearly less regret with them: images have more regret."""
    cells = made(instances=16)[lambda rows: rows["agent"] == "dqn"]
    environment = {"image": "simple_grid", "vector": "freeway"}[paper]
    differences = np.concatenate([-np.arange(1, 18), np.arange(18, 33)]) / 1000
    for name, regret in (("vector", 0.5), ("simple_image", 0.5 + differences)):
        cells.loc[(cells["environment"] == environment) & (cells["observation"] == name), "normalized_regret"] = regret
    assert np.median(differences) < 0 < np.mean(differences)
    row = verdicts(cells)[OBSERVATION, environment]
    assert row.p < 0.05 and 0 < row.lower < row.effect < row.upper
    assert (row.ours, row.verdict) == ("image", "agrees" if paper == "image" else "disagrees")


@pytest.mark.long
@examples(300, st.lists(st.integers(-4, 9), min_size=1, max_size=24))
def test_the_signed_rank_test_its_effect_and_its_interval_agree(integers):
    """With ties and zeros too: significant if and only if the interval excludes 0, and then on the effect's side."""
    differences = np.array(integers) / 8
    (effect, lower, upper), p = _findings._signed_ranks(differences)
    assert lower <= effect <= upper and 0 < p <= 1
    assert (p < 0.05) == (lower > 0 or upper < 0)
    if p < 0.05:
        assert (effect > 0) == (lower > 0)
    mirrored, same = _findings._signed_ranks(-differences)
    assert same == p and mirrored == (-effect, -upper, -lower)


def test_the_signed_rank_test_is_exact_on_all_signs():
    """Of all 2^9 signs of nine differences each is as likely: the share with as small a sum of ranks, both sides."""
    sizes = np.array([0.3, 1.1, 0.2, 0.7, 2.0, 0.5, 0.9, 1.3, 0.1])
    signs = np.array(list(itertools.product((-1, 1), repeat=9)))
    sums = np.where(signs > 0, stats.rankdata(sizes), 0).sum(axis=1)
    for row, total in list(zip(signs, sums, strict=True))[::37]:
        share = np.mean((sums <= min(total, 45 - total)) | (sums >= max(total, 45 - total)))
        assert _findings._signed_ranks(row * sizes)[1] == pytest.approx(share)


@pytest.mark.long
def test_the_interval_of_a_share_covers_as_often_as_it_says():
    random, added, free, share = np.random.default_rng(0), 4, 40, 0.3
    held = []
    for statistic in random.noncentral_f(added, free, share / (1 - share) * (added + free + 1), 500):
        effect, lower, upper = _findings._share(statistic, added, free)
        held.append(lower <= share <= upper)
        assert 0 <= lower <= upper <= 1 and effect == pytest.approx(added * statistic / (added * statistic + free))
        assert (lower > 0) == (stats.f.sf(statistic, added, free) < 0.025)
    assert 0.925 < np.mean(held) < 0.975


def test_every_verdict_of_an_interval_is_told_by_its_ends():
    for row in verdicts(made(image_harder=1)).values():
        if row.verdict in ("agrees", "disagrees") and row.finding == OBSERVATION:
            assert row.lower > 0 or row.upper < 0
        assert math.isnan(row.effect) == (row.verdict == "no data")
