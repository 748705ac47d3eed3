"""The statistics of benchmarks/agreement.py, beside SciPy's and statsmodels' own."""

import numpy as np
import pandas as pd
import pytest
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.weightstats import CompareMeans, DescrStatsW

from benchmark_modules import benchmark


@pytest.fixture(scope="module")
def agreement():
    return benchmark("agreement")


def runs(values, instance):
    cell = {"environment": "e", "instance": instance, "chance": "plain", "observation": "vector", "agent": "dqn"}
    return pd.DataFrame([{**cell, "steps": 10, "normalized_regret": value} for value in values])


def test_the_tests_are_those_of_the_field(agreement):
    rng = np.random.default_rng(0)
    samples = {name: (rng.normal(0.3, 0.05, 30), rng.normal(0.3 + shift, 0.05, 60)) for name, shift in
               (("same", 0.0), ("near", 0.01), ("far", 0.2))}  # fmt: skip
    sb3 = pd.concat([runs(theirs, name) for name, (theirs, _) in samples.items()])
    batched = pd.concat([runs(ours, name) for name, (_, ours) in samples.items()])
    table = agreement.compared(sb3, batched).set_index("instance")
    for name, (theirs, ours) in samples.items():
        means = CompareMeans(DescrStatsW(ours), DescrStatsW(theirs))
        p, *_ = means.ttost_ind(-agreement.MARGIN, agreement.MARGIN, usevar="unequal")
        assert table.loc[name, "p_tost"] == pytest.approx(p, rel=1e-6)
        interval = means.tconfint_diff(alpha=0.1, usevar="unequal")
        assert table.loc[name, ["lower_90", "upper_90"]].tolist() == pytest.approx(interval, rel=1e-6)
    corrected = multipletests(table["p_ks"], method="holm")[1]
    assert table["p_ks_holm"].tolist() == pytest.approx(corrected.tolist())
    assert table["differs"].tolist() == [False, False, True] and not table.loc["far", "equivalent"]


def test_runs_that_are_all_alike_are_equivalent_and_cells_of_one_engine_are_left_out(agreement):
    same = agreement.compared(runs([0.5, 0.5], "a"), pd.concat([runs([0.5, 0.5], "a"), runs([0.1], "b")]))
    assert same["instance"].tolist() == ["a"] and same["equivalent"].all()
    assert not agreement.compared(runs([0.5, 0.5], "a"), runs([0.9, 0.9], "a"))["equivalent"].any()


def test_both_studies_have_the_same_cells(agreement):
    studies = agreement.compared_studies()
    both = [studies[engine].runs for engine in ("sb3", "batched")]
    cells = [{(run.instance, run.chance, run.configuration.observation, run.configuration.agent) for run in each}
             for each in both]  # fmt: skip
    assert cells[0] == cells[1] and len(cells[0]) == 16
    assert {run.engine for run in both[1]} == {"batched"} and not {a.id for a in both[0]} & {b.id for b in both[1]}


@pytest.mark.long
def test_as_many_runs_as_needed_show_equal_means_with_the_power_that_is_said(agreement):
    deviation, generator = 0.1, np.random.default_rng(0)
    runs_sb3 = round(agreement.runs_needed(deviation) / agreement.RESERVE)
    shown = 0
    for _ in range(400):
        theirs, ours = (generator.normal(0.5, deviation, n) for n in (runs_sb3, 2 * runs_sb3))
        shown += agreement.compared(runs(theirs, "i"), runs(ours, "i"))["p_tost"].item() < 0.05
    assert shown / 400 == pytest.approx(agreement.POWER, abs=0.06)
