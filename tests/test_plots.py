"""Plots: what is drawn is what the results say."""

import numpy as np
import pytest

import pharos
from pharos import hardness, plots
from pharos.errors import FileFormatError, ParameterError
from pharos.experiments import read_curve, train


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    place = tmp_path_factory.mktemp("runs")
    for chance in (0.0, 0.1):
        for seed in range(3):
            out = place / f"{chance}-{seed}"
            train(
                "q_learning", "frozen_lake/4x4", steps=2000, evaluation_interval=200, seed=seed, random=chance, out=out
            )
    return sorted(place.iterdir())


def lines(axis):
    return {line.get_label(): line for line in axis.get_lines() if not line.get_label().startswith("_")}


def test_seeds_become_one_line_with_their_mean(folders):
    left, right = plots.regret(folders[:3]).axes
    curves = [read_curve(folder) for folder in folders[:3]]
    drawn = lines(left)["q_learning"]
    np.testing.assert_allclose(drawn.get_ydata(), np.mean([curve["normalized_regret"] for curve in curves], axis=0))
    assert drawn.get_xdata().tolist() == curves[0]["step"].tolist()
    realised = lines(right)["q_learning"].get_ydata()
    np.testing.assert_allclose(realised, np.mean([curve["cumulative_realised_regret"] for curve in curves], axis=0))
    assert len(left.collections) == 1  # the interval


def test_runs_that_differ_in_more_than_the_seed_are_told_apart(folders):
    left, _ = plots.regret(folders).axes
    assert len(lines(left)) == 2
    assert any("random=0.1" in label for label in lines(left))


def test_regret_needs_runs(tmp_path):
    with pytest.raises(ParameterError, match="at least one folder"):
        plots.regret([])
    with pytest.raises(FileFormatError, match="expected the folder of a run"):
        plots.regret([tmp_path])


def test_a_value_map_shows_values_in_their_cells_and_arrows_of_optimal_actions():
    space = pharos.build(pharos.make("simple_grid", height=2, width=3))
    solution = pharos.value_iteration(space.mdp(gamma=0.5))
    axis = plots.value_map(space, solution, title="grid").axes[0]
    shown = axis.get_images()[0].get_array()
    np.testing.assert_allclose(shown, [[0.25, 0.5, 1.0], [0.5, 1.0, 0.0]])
    arrows = {(tuple(text.xy), tuple(text.xyann)) for text in axis.texts}
    starts = [start for _, start in arrows]
    assert sorted(starts) == [(0, 0), (0, 0), (0, 1), (1, 0), (1, 0), (1, 1), (2, 0)]


def test_a_value_map_refuses_what_is_no_grid():
    space = pharos.build(pharos.make("freeway", num_cars=1, lane_length=3))
    with pytest.raises(ParameterError, match="expected row and column alone"):
        plots.value_map(space, pharos.value_iteration(space.mdp()))
    grid = pharos.build(pharos.make("simple_grid", height=2, width=3))
    with pytest.raises(ParameterError, match="belong to pairs"):
        plots.value_map(grid, pharos.value_iteration(pharos.sticky_actions(grid.mdp(), 0.5)))


def test_the_plane_places_instances_by_their_measures():
    names = ("simple_grid/4x4-plain", "frozen_lake/8x8")
    reports = {name: hardness.report(pharos.build(pharos.make(name)).mdp()) for name in names}
    axis = plots.hardness_plane(reports).axes[0]
    texts = {text.get_text(): text.xy for text in axis.texts}
    report = reports["frozen_lake/8x8"]
    assert texts["8x8"] == pytest.approx((report["diameter"].value["upper"], report["sum_of_reciprocal_gaps"].value))
    with pytest.raises(ParameterError, match="lacks 'depth'"):
        plots.hardness_plane(reports, visitation="depth")
    with pytest.raises(ParameterError, match="at least one"):
        plots.hardness_plane({})


@pytest.mark.parametrize("ending", [".png", ".pdf", ".svg"])
def test_figures_are_written_by_their_ending(tmp_path, ending):
    space = pharos.build(pharos.make("simple_grid"))
    figure = plots.value_map(space, pharos.value_iteration(space.mdp()))
    assert plots.save(figure, tmp_path / f"map{ending}").stat().st_size > 1000
    with pytest.raises(ParameterError, match=r"ends in \.png"):
        plots.save(figure, tmp_path / "map.bmp")
    with pytest.raises(ParameterError, match="no such folder"):
        plots.save(figure, tmp_path / "nowhere" / "map.png")
