"""Pilots: the beginning of a run, and what it and the prediction say together."""

import csv
import math
import re
from pathlib import Path

import numpy as np
import pytest

import pharos
from benchmark_modules import benchmark
from pharos.agents import primary_predictors
from pharos.errors import ParameterError
from pharos.prediction import pilot
from pharos.prediction.pilot import PILOT_SHARES, Plane, cut, pilot_regret, plane
from pharos.training import Task

PAGE = (Path(__file__).parents[2] / "docs" / "prediction.md").read_text(encoding="utf-8")


def epsilon(settings, step, steps):
    """The exploration of a DQN, linear over a fraction of its steps."""
    first, last = settings["exploration_initial_eps"], settings["exploration_final_eps"]
    return first + (last - first) * min(1.0, step / (settings["exploration_fraction"] * steps))


@pytest.mark.parametrize("share", PILOT_SHARES)
@pytest.mark.parametrize("fraction", [0.05, 0.25, 0.3, 1.0])
def test_a_cut_run_explores_as_the_beginning_of_the_whole_one(share, fraction):
    whole = {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.05, "exploration_fraction": fraction}
    settings = cut(whole, share)
    assert settings["exploration_fraction"] <= 1
    for step in np.linspace(0, share * 1000, 20):
        assert epsilon(settings, step, share * 1000) == pytest.approx(epsilon(whole, step, 1000))
    assert cut({"n_steps": 64}, share) == {"n_steps": 64}


def test_a_plane_gives_back_a_plane_and_weighs_classes_alike():
    rng = np.random.default_rng(0)
    classes, x = np.repeat(["a", "b", "c", "d"], [2, 9, 4, 5]), rng.random((20, 2))
    exact = Plane(classes, x, 0.1 + 0.5 * x[:, 0] + 0.25 * x[:, 1])
    assert exact.value(0.4, 0.8) == pytest.approx(0.5) and exact.value(-9.0, 0.0) == 0.0
    assert exact.calibration.half_width() < 1e-12
    level = Plane(classes, np.zeros((20, 2)), np.array([1.0, 2.0, *rng.random(9), *[3.0] * 9]))
    means = [level.calibration.observed[classes == name].mean() for name in "abcd"]
    assert level.value(0.0, 0.0) == pytest.approx(np.mean(means))
    assert level.calibration.predicted[0] == pytest.approx(np.mean(means[1:]))  # of the other classes


@pytest.mark.parametrize("agent", primary_predictors())
def test_published_pilots_are_those_of_the_page(agent):
    with pilot.PILOTS_FILE.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["agent"] == agent]
    assert len(rows) == 196 and len({row["environment"] for row in rows}) == 28
    widths = [plane(agent, share).calibration.half_width() for share in PILOT_SHARES]
    said = re.search("± ([0-9., and]+) for " + agent.upper(), " ".join(PAGE.split()))[1]
    assert [float(each) for each in re.findall("[0-9.]+", said)] == [round(width, 2) for width in widths]
    assert all(0.7 < plane(agent, share).calibration.coverage() < 0.9 for share in PILOT_SHARES)


@pytest.mark.long
def test_a_pilot_and_the_prediction_are_put_together():
    options = {"length": 5, "agent": "ppo", "steps": 5120, "common": True}
    alone, both = (pharos.predict("river_swim", **options, pilot=share) for share in (None, 0.5))
    (measure,), (cell,) = alone.cells, both.cells
    so_far = pilot_regret("ppo", Task.of("river_swim", {"length": 5}), 5120, both.hyperparameters, 0.5)
    assert cell.pilot == so_far and math.isnan(measure.pilot)
    assert cell.value == plane("ppo", 0.5).value(so_far, measure.value)
    assert both.half_width == plane("ppo", 0.5).calibration.half_width() and not both.orders
    assert both.predictor == "network_policy_regret and a pilot of 2,560 steps"


def test_other_shares_and_networks_have_no_calibration():
    with pytest.raises(ParameterError, match=r"pilot is 0.2; expected one of 0.1, 0.25, 0.5"):
        pharos.predict("river_swim", pilot=0.2)
    with pytest.raises(ParameterError, match="expected no networks"):
        pharos.predict("river_swim", pilot=0.1, networks=["mlp8"])


def test_the_share_at_equal_cost_is_that_at_which_both_cost_the_same():
    costs = benchmark("pilot_cost")
    row = {"begin": "2", "thousand_steps": "0.5", "evaluation": "0.25", "measure_30000": "7.5", "measure_600000": "1"}
    share = costs.share_at_equal_cost(row, 30_000)
    assert 2 + share * (0.5 * 30 + 0.25 * 30) == pytest.approx(7.5)
    assert costs.share_at_equal_cost(row, 600_000) == 0  # less than it takes to begin
    assert costs.share_at_equal_cost({**row, "measure_30000": "47"}, 30_000) == pytest.approx(2)


def test_the_score_of_a_pilot_lies_between_those_of_its_neighbours():
    costs, pilots = benchmark("pilot_cost"), {0.1: 0.2, 0.5: 0.8, 1.0: 0.9}
    assert [costs.r_squared_at(share, pilots) for share in pilots] == [0.2, 0.8, 0.9]
    assert costs.r_squared_at(0.2, pilots) == pytest.approx(0.35)
    assert costs.r_squared_at(0.01, pilots) == 0.2 and costs.r_squared_at(3, pilots) == 0.9


def test_scores_of_pilots_are_those_of_the_page():
    cells = benchmark("prediction_cells")
    for agent, words, values in cells.r_squared_of_pilots(cells.CELLS_FILE):
        texts = [f"{value:.2f}" for value in values] + [""] * (len(cells.SHARES) - len(values))
        assert f"| {agent.upper()} | {words} | {' | '.join(texts)} |" in PAGE
