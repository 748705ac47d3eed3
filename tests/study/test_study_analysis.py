"""From result files to tables, models and comparisons, over runs whose results are formulas."""

import re
import shutil

import numpy as np
import pandas as pd
import pytest

import fake_training
from edits import edited_json
from pharos import study
from pharos.errors import ParameterError
from pharos.study import tables
from pharos.study import worker as _worker
from pharos.study.figures import returns_table
from pharos.study.tables import _last_return, _number, _row_of_measures
from refusals import failing

MEASURES = ["sum_of_reciprocal_gaps", "diameter"]
SPECIFICATION = fake_training.specification(
    "formulas",
    steps=1000,
    evaluations=20,
    hardness={"measures": MEASURES, "budget": 5},
    environments=[
        *(f"simple_grid/{size}x{size}-{kind}" for size in (4, 6) for kind in ("plain", "decoy")),
        *("frozen_lake/4x4", "frozen_lake/8x8"),
        *({"name": "frozen_lake", "parameters": {"size": size, "seed": 0}} for size in (5, 6)),
    ],
    observations=["vector", "simple_image"],
    agents=["dqn", "ppo", "q_learning"],
    seeds=3,
)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """(specification, folder) of a study whose runs are over."""
    folder = tmp_path_factory.mktemp("study")
    for run in SPECIFICATION.runs:
        assert fake_training.attempt(run, folder) == "finished"
    return SPECIFICATION, folder


@pytest.fixture(scope="module")
def rows(done):
    return study.table(*done)


@pytest.fixture(scope="module")
def measured(done):
    return study.hardness_table(*done)


@pytest.fixture(scope="module")
def cells(rows, measured):
    return study.cells(rows, measured)


@pytest.mark.long
def test_there_is_a_row_for_each_finished_run_with_the_numbers_of_its_file(done, rows):
    found, folder = done
    assert sorted(rows["id"]) == sorted(run.id for run in found.runs)
    results = fake_training.results(folder)
    for row in rows.to_dict("records")[::7]:
        assert row["cumulative_regret"] == results[row["id"]]["result"]["cumulative_regret"]
        assert row["seed"] == results[row["id"]]["config"]["seed"]


@pytest.mark.long
def test_a_study_without_results_says_what_to_do(done, tmp_path):
    with pytest.raises(ParameterError, match="no run of 'formulas' is finished; execute `pharos study run`"):
        study.table(done[0], tmp_path)


def test_runs_that_are_missing_or_failed_are_no_rows(tmp_path):
    first, second = SPECIFICATION.runs[:2]
    fake_training.attempt(first, tmp_path)
    (tmp_path / "partial" / second.id).mkdir(parents=True)
    _worker.write_failure(tmp_path / "partial" / second.id, second.config, second.id, "no", 1.0)
    _worker.publish_run(tmp_path / "partial" / second.id, tmp_path, second.id)
    assert list(study.table(SPECIFICATION, tmp_path)["id"]) == [first.id]


@pytest.mark.long
def test_curves_hold_every_evaluation_of_every_run(done):
    points = study.curves(*done)
    assert len(points) == len(done[0].runs) * 20
    one = points[points["id"] == done[0].runs[5].id]
    assert list(one["step"]) == list(range(50, 1001, 50))
    assert (one["cumulative_expected_regret"].diff().dropna() >= 0).all()


@pytest.mark.long
def test_a_cell_is_the_mean_over_seeds(rows, cells):
    assert len(cells) == 8 * (2 * 2 + 1) and set(cells["seeds"]) == {3}
    cell = cells.iloc[17]
    same = rows[(rows[tables.CELL] == cell[tables.CELL]).all(axis=1)]
    assert len(same) == 3
    assert cell["cumulative_regret"] == pytest.approx(same["cumulative_regret"].mean())
    assert cell["return_deviation"] == pytest.approx(np.std(same["return"]))


def test_one_seed_has_no_deviation_and_one_run_a_task_no_interval(rows):
    alone = rows[rows["seed"] == 0]
    cells = study.cells(alone)
    assert set(cells["seeds"]) == {1} and set(cells["steps"]) == set(rows["steps"])
    assert cells["return_deviation"].isna().all()
    assert "pm" not in returns_table(cells, "frozen_lake") and "$" in returns_table(cells, "frozen_lake")
    assert "pm" in returns_table(study.cells(rows), "frozen_lake")
    known, unknown = (study.intervals(part, resamples=20) for part in (rows, alone))
    assert known["lower"].notna().all() and unknown["lower"].isna().all() and unknown["iqm"].notna().all()


def test_hardness_is_that_of_the_report_and_kept_in_the_folder(done, measured, cells):
    from pharos import hardness, make

    mdp = tables.build_mdp("frozen_lake", {"size": 8}, {"sticky": 0.0, "random": 0.0}, 0.99)
    report = hardness.report(mdp, ["diameter", "sum_of_reciprocal_gaps"], horizon=make("frozen_lake").max_episode_steps)
    row = measured[measured["instance"] == "frozen_lake/8x8"].iloc[0]
    assert row["diameter"] == report["diameter"].value["lower"]
    assert row["sum_of_reciprocal_gaps"] == pytest.approx(report["sum_of_reciprocal_gaps"].value)
    assert row["num_states"] == 64 and row["notes"] == ""
    assert len(list(done[1].glob("hardness/*.json"))) == 8
    assert set(cells.loc[cells["instance"] == "frozen_lake/8x8", "diameter"]) == {row["diameter"]}


def test_an_interval_enters_as_its_geometric_mean_and_only_if_it_has_an_upper_end():
    assert _number({"lower": 4.0, "upper": 9.0, "exact": False}, False)["value"] == 6
    assert _number({"lower": 7.0, "upper": 7.0, "exact": True}, True)["value"] == 7
    assert "only a lower bound of 4" in _number({"lower": 4.0, "upper": None, "exact": False}, False)["why"]
    assert _number(float("inf"), True) == {"value": None, "why": "it is infinite"}
    assert _number({"value": 3.5, "k_min": 2}, True)["value"] == 3.5


def test_a_measure_that_does_not_exist_under_chance_is_that_without_and_noted():
    own = {"num_states": 16, "measures": {"a": {"why": "no chance, please"}, "b": {"value": 2.0, "exact": True}}}
    plain = {"num_states": 16, "measures": {"a": {"value": 3.0, "exact": True}, "b": {"value": 1.0, "exact": True}}}
    row = _row_of_measures(["a", "b", "c"], own, plain)
    assert (row["a"], row["b"]) == (3.0, 2.0) and np.isnan(row["c"])
    assert row["notes"] == "a: without chance, because no chance, please; c: none, because it is undefined"


def test_a_proven_interval_enters_where_it_is_narrow():
    plain = {"num_states": 16, "measures": {"a": {"value": 3.0, "exact": True}}}
    narrow, wide = ({"value": 6.0, "lower": low, "upper": 36 / low, "exact": False} for low in (4.5, 4.0))
    row = _row_of_measures(["a"], {"num_states": 16, "measures": {"a": narrow}}, plain)
    assert row["a"] == 6 and row["notes"] == "a: geometric mean of the proven interval 4.5 to 8"
    row = _row_of_measures(["a"], {"num_states": 16, "measures": {"a": wide}}, plain)
    assert row["a"] == 3 and row["notes"] == "a: without chance, because only 4 to 9 is proven within the budget"


def test_a_measure_that_fails_is_noted_and_tried_again_next_time(tmp_path, monkeypatch):
    spec = fake_training.specification(hardness={"measures": ["diameter"]}, seeds=1)
    with monkeypatch.context() as patched:
        patched.setattr("pharos.hardness.report", failing(ZeroDivisionError("a bug")))
        found = study.hardness_table(spec, tmp_path)
    assert found["notes"].item() == "diameter: none, because ZeroDivisionError: a bug"
    assert study.hardness_table(spec, tmp_path)["diameter"].item() == 7


def test_the_return_is_the_mean_over_episodes_that_ended_in_the_last_tenth():
    curve = pd.DataFrame({"episodes": np.arange(20) ** 2, "mean_return": np.arange(20.0)})
    weights = np.diff(np.arange(20) ** 2)[-2:]
    assert _last_return(curve) == pytest.approx((18 * weights[0] + 19 * weights[1]) / weights.sum())
    curve.loc[18:, "mean_return"] = np.nan  # no episode ended there: the last ones that did
    curve.loc[18:, "episodes"] = 17**2
    assert np.isfinite(_last_return(curve))
    assert np.isnan(_last_return(curve.assign(mean_return=np.nan)))


@pytest.mark.slow
def test_every_model_with_enough_rows_is_fitted_and_the_others_are_named(cells):
    found = study.models(cells, measures=MEASURES)
    looks, classes = ("simple_image", "vector"), ("frozen_lake", "simple_grid")
    parts = [*(("representation", each) for each in looks), *(("class", each) for each in classes)]
    assert [(fit.model, fit.subset) for fit in found.fits] == [("single", "all"), *parts]
    assert found.get("single", "all").num_rows == 16
    assert found.class_r_squared > 0.5 and found.leave_one_class_out is not None
    few = study.models(cells[cells["instance"].isin(["frozen_lake/4x4", "simple_grid/4x4-plain"])], measures=MEASURES)
    assert any("the class model of frozen_lake has 2 rows; needs at least" in note for note in few.notes)


def test_measures_that_are_unknown_are_left_out_and_named(cells):
    found = study.models(cells.assign(diameter=np.nan), measures=["effective_horizon", "diameter"])
    assert "effective_horizon is known for no instance: the models leave it out" in found.notes
    assert "diameter is known for no instance: the models leave it out" in found.notes
    some = cells.copy()
    some.loc[some["instance"] == "frozen_lake/4x4", "diameter"] = np.nan
    found = study.models(some, measures=["sum_of_reciprocal_gaps", "diameter"])
    assert "2 of 16 cells have no positive diameter: left out" in found.notes


def test_classes_that_a_model_has_not_seen_need_a_model():
    rows = [("a", 1.0, 2.0), ("a", 2.0, 1.0), ("b", 1.5, 3.0), ("b", 2.5, 2.0)]
    cells = pd.DataFrame(rows, columns=["environment", "cumulative_regret", "diameter"])
    cells = cells.assign(agent="ppo", observation="vector", instance=list("wxyz"), chance="plain")
    found = study.models(cells, agent="ppo", regret="cumulative_regret", measures=["diameter"])
    assert (found.fits, found.leave_one_class_out) == ([], None)
    assert "the class model of a has 2 rows; needs at least 4 for its 1 predictor: run more" in " ".join(found.notes)


def test_a_class_with_as_many_observations_as_rows_has_no_model():
    rows = [(name, task, look) for name, tasks in (("a", "xyz"), ("b", "w")) for task in tasks for look in "12345"]
    cells = pd.DataFrame(rows, columns=["environment", "instance", "observation"])
    rng = np.random.default_rng(0)
    cells = cells.assign(agent="dqn", chance="plain", normalized_regret=rng.random(20), diameter=1.0)
    found = study.models(cells, agent="dqn", regret="normalized_regret", measures=["diameter"])
    assert [fit.subset for fit in found.fits if fit.model == "class"] == ["a"]
    assert "the class model of b has 5 rows; needs at least 7 for its 4 predictors: run more" in " ".join(found.notes)


def test_the_models_without_rows_are_a_note():
    empty = pd.DataFrame({"agent": ["ppo"], "observation": ["vector"], "cumulative_regret": [1.0]})
    assert study.models(empty).notes[-1] == "no cell of dqn has all measures: there are no models"


def test_agents_whose_returns_are_linear_in_each_other_agree_perfectly(cells):
    made, gaps = cells.copy(), cells["sum_of_reciprocal_gaps"]
    made["return"] = np.where(made["agent"] == "dqn", 2 * gaps + 1, gaps)
    r, n = study.agreement(made, "return")
    assert r == pytest.approx(1) and n == 16
    assert study.agreement(cells[cells["agent"] == "dqn"], "return") is None


def test_the_correlation_of_the_returns_that_the_paper_prints_is_069():
    assert study.paper_agreement() == pytest.approx(0.685, abs=0.001)


def test_intervals_hold_their_value_and_there_is_one_for_each_class_agent_and_observation(rows):
    found = study.intervals(rows, resamples=100)
    assert len(found) == 2 * 5
    assert ((found["lower"] <= found["iqm"]) & (found["iqm"] <= found["upper"])).all()


def test_a_mean_curve_weighs_tasks_alike_and_equal_runs_leave_no_doubt():
    same = np.tile(np.arange(4.0), (5, 1))
    mean, lower, upper = study.mean_curve([same, np.zeros((2, 4))])
    assert (mean == np.arange(4) / 2).all() and np.allclose(lower, mean) and np.allclose(upper, mean)
    rng = np.random.default_rng(0)
    mean, lower, upper = study.mean_curve([rng.normal(size=(40, 1))], resamples=4000)
    assert (upper - lower)[0] == pytest.approx(2 * 1.96 / np.sqrt(40), rel=0.25)


def test_ours_stands_beside_each_number_of_the_paper_that_the_study_has(done, cells):
    found = study.compare(cells, done[0].runs, [study.models(cells, measures=MEASURES)])
    returns = found.returns
    assert len(returns) == len(study.paper_returns())
    known = returns[returns["ours"].notna()]
    blocks = {*(("simple_grid", i) for i in (1, 2, 3, 4)), ("frozen_lake", 1), ("frozen_lake", 2)}
    assert set(zip(known["environment"], known["instance"], strict=True)) == blocks
    assert set(known["randomization"]) == {"none"} and len(known) == 6 * 4
    line = known[(known["environment"] == "simple_grid") & (known["instance"] == 1)]
    line = line[(line["agent"] == "DQN") & (line["observation"] == "image")].iloc[0]
    cell = cells[(cells["instance"] == "simple_grid/4x4-decoy") & (cells["agent"] == "dqn")]
    assert line["ours"] == cell[cell["observation"] == "simple_image"]["return"].item()
    assert line["difference"] == line["ours"] - 0.10
    fits = found.regressions.set_index(["model", "subset"])
    assert fits.loc[("single (Eq. 7)", "all"), "paper"] == 0.09
    assert np.isfinite(fits.loc[("class", "frozen_lake"), "ours_cumulative"])
    assert np.isnan(fits.loc[("class", "freeway"), "ours_cumulative"])
    assert fits.loc[("agents", "correlation of DQN and PPO performance"), "paper"] == 0.81


def test_instances_are_those_blocks_of_the_papers_tables_that_print_their_parameters():
    from pharos import make
    from pharos.environments import named_instances

    printed = study.paper_returns().drop_duplicates(["environment", "instance"])
    by_number = {
        (environment, study.paper_instance(environment, make(name).parameters)): make(name).parameters
        for name, (environment, _) in named_instances().items()
    }
    for row in printed.itertuples():
        words = dict(part.split("=") for part in row.parameters_as_printed.replace(",", ";").split(";"))
        words = {name.strip(): int(value) for name, value in words.items()}
        ours = by_number[row.environment, row.instance]
        if row.environment == "frozen_lake":
            assert ours["size"] == words["height"] == words["width"]
            continue
        renamed = {"lane length": "lane_length", "n cars": "num_cars", "player speed": "player_speed"}
        renamed["extra paddle width"] = "extra_paddle_width"
        assert {renamed.get(name, name): value for name, value in words.items()}.items() <= ours.items()


def test_kept_hardness_that_was_edited_cut_or_swapped_is_measured_again(tmp_path):
    lakes = {"environments": ["frozen_lake/4x4", "frozen_lake/8x8"], "seeds": 1}
    spec = fake_training.specification(hardness={"measures": ["diameter"]}, **lakes)
    expected = list(study.hardness_table(spec, tmp_path)["diameter"])
    one, two = sorted((tmp_path / "hardness").glob("*.json"))
    texts = one.read_text(), two.read_text()
    one.write_text(texts[1]), two.write_text(texts[0])
    assert list(study.hardness_table(spec, tmp_path)["diameter"]) == expected
    for file in (one, two):
        file.write_text(re.sub('"value": (7|15)[.]0', '"value": 9.0', file.read_text()))
    assert list(study.hardness_table(spec, tmp_path)["diameter"]) == expected
    one.write_text(texts[0][:80])
    assert list(study.hardness_table(spec, tmp_path)["diameter"]) == expected


@pytest.mark.long
def test_runs_with_estimates_say_so_with_the_half_width_of_their_regret(done, tmp_path):
    spec, folder = done
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    run = spec.runs[0]
    file = tmp_path / "runs" / run.id / "curve.parquet"
    curve = pd.read_parquet(file)
    estimated = np.arange(len(curve)) % 2 == 0
    curve.assign(exact=~estimated, error_bound=0.25).to_parquet(file)
    rows = study.table(spec, tmp_path)
    row = rows[rows["id"] == run.id].iloc[0]
    between, last = np.diff(curve["episodes"]), curve["episodes"].iloc[-1]
    assert not row["exact"]
    assert row["half_width"] == pytest.approx((between * 0.25 * estimated[:-1]).sum() / last / 0.9)
    assert rows[rows["id"] != run.id]["exact"].all() and (rows[rows["id"] != run.id]["half_width"] == 0).all()
    cells = study.cells(rows)
    assert cells["exact"].tolist().count(False) == 1
    cell = cells[~cells["exact"]].iloc[0]
    assert cell["half_width"] == pytest.approx(row["half_width"] / 3)  # three seeds


@pytest.mark.long
def test_records_of_absurd_numbers_are_damaged(done, tmp_path):
    spec, folder = done
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    changes = ({"seconds": 1e308}, {"regret": -1e300}, {"seconds": -1}, {"regret": True})
    for run, change in zip(spec.runs, changes, strict=False):
        with edited_json(tmp_path / "runs" / run.id / "run.json") as record:
            record["seconds"] = change.get("seconds", record["seconds"])
            record["result"]["cumulative_regret"] = change.get("regret", 1.0)
    with pytest.warns(RuntimeWarning, match="4 runs left out"):
        assert len(study.table(spec, tmp_path)) == len(spec.runs) - 4
