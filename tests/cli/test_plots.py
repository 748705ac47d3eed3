"""Plots: what is drawn is what the results say."""

import importlib
from dataclasses import dataclass

import matplotlib
import numpy as np
import pytest
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from PIL import Image

import pharos
from pharos import hardness, plots
from pharos.errors import FileFormatError, ParameterError
from pharos.plots.instances import _label
from pharos.plots.regret import _label as run_label
from pharos.plots.regret import _labels as run_labels
from pharos.plots.style import thousands
from pharos.training import Task, read_curve, train
from refusals import refusal
from strategies import examples


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    place = tmp_path_factory.mktemp("runs")
    for chance in (0.0, 0.1):
        for seed in range(3):
            options = {"steps": 2000, "evaluation_interval": 200, "out": place / f"{chance}-{seed}"}
            train("q_learning", "frozen_lake/4x4", seed=seed, random=chance, **options)
    return sorted(place.iterdir())


LEARNING = "Q-learning on Frozen lake 4x4, 2 k steps"


def shown(axis):
    """Values that a map has drawn, NaN where there is no colour."""
    return axis.get_images()[0].get_array().filled(np.nan)


def lines(axis):
    return {line.get_label(): line for line in axis.get_lines() if not line.get_label().startswith("_")}


def test_seeds_become_one_line_with_their_mean(folders):
    left, right = plots.regret(folders[:3]).axes
    curves = [read_curve(folder) for folder in folders[:3]]
    drawn = lines(left)[LEARNING]
    np.testing.assert_allclose(drawn.get_ydata(), np.mean([curve["normalized_regret"] for curve in curves], axis=0))
    assert drawn.get_xdata().tolist() == curves[0]["step"].tolist()
    realised = lines(right)[LEARNING].get_ydata()
    np.testing.assert_allclose(realised, np.mean([curve["cumulative_realised_regret"] for curve in curves], axis=0))
    assert len(left.collections) == 1  # the interval


def test_runs_that_differ_in_more_than_the_seed_are_told_apart(folders):
    left, _ = plots.regret(folders).axes
    assert len(lines(left)) == 2
    assert any("random=0.1" in label for label in lines(left))


def test_curves_with_rewards_in_another_unit_are_named_and_without_a_common_step_refused(tmp_path, folders):
    options = {"steps": 2000, "evaluation_interval": 200, "scale_rewards": "range"}
    train("q_learning", "frozen_lake/4x4", out=tmp_path / "unit", **options)
    left, _ = plots.regret([folders[0], tmp_path / "unit"]).axes
    assert any("scale_rewards=range" in line.get_label() for line in left.lines)
    for name, step in (("a", 100), ("b", 99)):
        with pharos.Run("frozen_lake/4x4", steps=300, seed=step, out=tmp_path / name) as run:
            run.evaluate(step, np.zeros(16, int))
    said = refusal(ParameterError, plots.regret, [tmp_path / "a", tmp_path / "b"])
    assert "no evaluated step in common" in said


def test_regret_needs_runs(tmp_path):
    assert "at least one folder" in refusal(ParameterError, plots.regret, [])
    assert "expected the folder of a run" in refusal(FileFormatError, plots.regret, [tmp_path])


def test_a_value_map_shows_values_in_their_cells_and_arrows_of_optimal_actions():
    space = pharos.build(pharos.make("simple_grid", height=2, width=3))
    solution = pharos.value_iteration(space.mdp(gamma=0.5))
    axis = plots.value_map(space, solution, title="grid").axes[0]
    np.testing.assert_allclose(shown(axis), [[0.25, 0.5, 1.0], [0.5, 1.0, np.nan]])  # the goal has no colour
    arrows = {(tuple(text.xy), tuple(text.xyann)) for text in axis.texts if isinstance(text, Annotation)}
    centred = {(0, 1), (1, 1), (2, 0)}  # where one action is best its arrow lies in the middle; two go out from there
    middles = {tuple(np.add(start, end) / 2) for end, start in arrows} & centred
    starts = [start for end, start in arrows if tuple(np.add(start, end) / 2) not in centred] + sorted(middles)
    assert [text.get_text() for text in axis.texts if not isinstance(text, Annotation)] == ["1"]
    assert sorted(starts) == [(0, 0), (0, 0), (0, 1), (1, 0), (1, 0), (1, 1), (2, 0)]


@pytest.mark.slow
def test_a_given_policy_has_arrows_as_long_as_its_probabilities():
    space = pharos.build(pharos.make("simple_grid", height=2, width=2))
    policy = np.tile([0.0, 0.75, 0.25, 0.0], (4, 1))  # up, right, down, left
    axis = plots.value_map(space, pharos.evaluate_policy(space.mdp(gamma=0.5), policy)).axes[0]
    lengths = {tuple(np.subtract(t.xy, t.xyann).round(6).tolist()) for t in axis.texts if isinstance(t, Annotation)}
    assert lengths == {(0.295, 0.0), (0.0, 0.165)}  # 0.1 + 0.26 times the probability
    uniform = plots.value_map(space, pharos.evaluate_policy(space.mdp(gamma=0.5), np.full((4, 4), 0.25))).axes[0]
    assert not any(isinstance(text, Annotation) for text in uniform.texts)
    assert len(uniform.get_lines()) == 3  # a dot in each cell where the episode goes on


def test_plots_can_stand_beside_each_other(folders):
    figure = Figure()
    axes = figure.subplots(1, 4)
    space = pharos.build(pharos.make("simple_grid"))
    assert plots.regret(folders[:1], axes=axes[:2]) is figure
    assert plots.growth({"grid": space}, axes=axes[2]) is figure
    assert plots.value_map(space, pharos.value_iteration(space.mdp()), axes=axes[3]) is figure
    assert lines(axes[0]) and lines(axes[2]) and axes[3].get_images()


def test_drawing_leaves_the_settings_of_matplotlib_alone(folders):
    before = dict(matplotlib.rcParams)
    plots.regret(folders)
    assert dict(matplotlib.rcParams) == before


def test_regret_that_cannot_be_normalised_is_drawn_in_units_of_return(tmp_path, monkeypatch):
    run = train("q_learning", "simple_grid", height=1, width=2, horizon=1, steps=200, out=tmp_path / "run")
    left, _ = plots.regret([run.folder]).axes
    assert left.get_ylabel() == "normalised regret"
    curve = read_curve(run.folder)
    curve["normalized_regret"] = np.nan  # as where playing at random is optimal
    monkeypatch.setattr(importlib.import_module("pharos.plots.regret"), "read_curve", lambda folder: curve)
    left, _ = plots.regret([run.folder]).axes
    assert left.get_ylabel() == "expected regret"
    (drawn,) = (line for label, line in lines(left).items() if label.startswith("Q-learning on Simple grid"))
    np.testing.assert_allclose(drawn.get_ydata(), curve["expected_regret"])


@examples(25, st.integers(1, 5), st.integers(2, 5))
def test_a_grid_grows_by_its_diagonals(height, width):
    space = pharos.build(pharos.make("simple_grid", height=height, width=width))
    counts = plots.states_by_depth(space)
    diagonals = [sum(row + column == d for row in range(height) for column in range(width)) for d in range(20)]
    assert counts.tolist() == [count for count in diagonals if count]
    assert counts.sum() == space.num_states and len(counts) == space.depth + 1


def test_growth_shows_the_states_within_each_distance():
    space = pharos.build(pharos.make("frozen_lake/8x8"))
    axis = plots.growth({"lake": space}).axes[0]
    drawn = lines(axis)["lake: 64 states"]
    assert drawn.get_ydata().tolist() == plots.states_by_depth(space).cumsum().tolist()
    assert "at least one" in refusal(ParameterError, plots.growth, {})


@pytest.mark.slow
def test_policies_play_beside_each_other(tmp_path):
    task = Task.of("frozen_lake/4x4")
    optimal = pharos.value_iteration(task.space.mdp(gamma=0.9)).policy

    def never(seen):
        return np.zeros(len(seen), np.int64)

    agents = {"best": optimal, "left": never, "random": np.full((task.mdp.num_states, 4), 0.25)}
    path = plots.policies(task, agents, tmp_path / "play.gif", steps=9)
    with Image.open(path) as gif:
        frames, (width, height) = gif.n_frames, gif.size
    with Image.open(plots.policies(task, {"best": optimal}, tmp_path / "one.gif", steps=9)) as one:
        assert one.n_frames == 7  # six steps to the goal
        assert (one.height, 3 * one.width + 2 * 12) == (height, width)
    assert 8 <= frames <= 10  # "left" never ends; a GIF merges frames that are alike
    with pytest.raises(ParameterError, match=r"expected \(16,\) actions or \(16, 4\) probabilities"):
        plots.policies(task, {"of pairs": np.zeros((16, 5), int)}, tmp_path / "play.gif")
    assert "ends in .gif" in refusal(ParameterError, plots.policies, task, agents, tmp_path / "play.png")
    assert "at least one" in refusal(ParameterError, plots.policies, task, {}, tmp_path / "play.gif")


def test_a_value_map_refuses_what_is_no_grid():
    space = pharos.build(pharos.make("freeway", num_cars=1, lane_length=3))
    with pytest.raises(ParameterError, match="expected row and column alone"):
        plots.value_map(space, pharos.value_iteration(space.mdp()))
    grid = pharos.build(pharos.make("simple_grid", height=2, width=3))
    with pytest.raises(ParameterError, match="belong to pairs"):
        plots.value_map(grid, pharos.value_iteration(pharos.sticky_actions(grid.mdp(), 0.5)))


@pytest.mark.long
def test_the_plane_places_instances_by_their_measures():
    names = ("simple_grid/4x4-plain", "frozen_lake/8x8")
    reports = {name: hardness.report(pharos.build(pharos.make(name)).mdp()) for name in names}
    axis = plots.hardness_plane(reports).axes[0]
    texts = {text.get_text(): text.xy for text in axis.texts}
    report = reports["frozen_lake/8x8"]
    assert texts["8x8"] == pytest.approx((report["diameter"].value["upper"], report["sum_of_reciprocal_gaps"].value))
    assert "lacks 'depth'" in refusal(ParameterError, plots.hardness_plane, reports, visitation="depth")
    assert "at least one" in refusal(ParameterError, plots.hardness_plane, {})


@pytest.mark.long
@examples(20, st.lists(st.floats(1, 1e6), min_size=2, max_size=8))
def test_names_in_the_plane_are_each_drawn_once(values):
    axis = Figure().subplots()
    axis.set(xscale="log", yscale="log", xlim=(0.5, 2e6), ylim=(0.5, 2e6))
    points = {f"x/{i}": (value, value) for i, value in enumerate(values)}
    _label(axis, points)
    assert {text.get_text(): text.xy for text in axis.texts} == {str(i): (v, v) for i, v in enumerate(values)}
    first, second = axis.texts[:2]
    if values[0] == values[1]:  # of two in one place, the names do not cover each other
        assert (first.xyann, first.get_ha()) != (second.xyann, second.get_ha())


@pytest.mark.parametrize(
    ("value", "text"), [(0.5, "0.5"), (500, "500"), (12_000, "12k"), (3e6, "3M"), (2e10, "2e10"), (0, "0")]
)
def test_large_numbers_on_axes_are_short(value, text):
    assert thousands(value) == text


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".png", ".pdf", ".svg"])
def test_figures_are_written_by_their_ending(tmp_path, ending):
    space = pharos.build(pharos.make("simple_grid"))
    figure = plots.value_map(space, pharos.value_iteration(space.mdp()))
    assert plots.save(figure, tmp_path / f"map{ending}").stat().st_size > 1000
    assert "ends in .png" in refusal(ParameterError, plots.save, figure, tmp_path / "map.bmp")
    assert "no such folder" in refusal(ParameterError, plots.save, figure, tmp_path / "nowhere" / "map.png")


@dataclass(frozen=True, kw_only=True)
class Keys(pharos.Environment):
    """A row of three cells with a key in the first one: the goal, on the right, opens with it."""

    name = "keys"
    actions = ("left", "right")

    def variables(self):
        return {"row": range(1), "column": range(3), "key": range(2)}

    def initial_state(self):
        return (0, 1, 0)

    def transition(self, state, action, out):
        out[1] = min(max(state[1] + 2 * action - 1, 0), 2)
        if out[1] == 0:
            out[2] = 1

    def is_terminal(self, state):
        return state[1] == 2 and state[2] == 1

    def reward(self, state, action, next_state):
        return 1.0 if next_state[1] == 2 and next_state[2] == 1 else 0.0

    def grid(self):
        return 1, 3


@pytest.mark.long
def test_a_value_map_of_states_with_more_variables_is_a_slice():
    space = pharos.build(Keys(), progress=False)
    solution = pharos.value_iteration(space.mdp(gamma=0.5))
    with pytest.raises(ParameterError, match=r"a state has row, column, key; .* such as --fix key=0"):
        plots.value_map(space, solution)
    for key, expected in ((0, [0.25, 0.125]), (1, [0.5, 1.0])):
        cells = [1, 2] if key == 0 else [0, 1]
        drawn = shown(plots.value_map(space, solution, fix={"key": key}).axes[0])
        np.testing.assert_allclose(drawn[0, cells], expected)
    assert "no state has key=7" in refusal(ParameterError, plots.value_map, space, solution, fix={"key": 7})
    with pytest.raises(ParameterError, match="unknown component of keys to fix 'kee'; did you mean 'key'"):
        plots.value_map(space, solution, fix={"kee": 1})
    start = plots.value_map(space, solution, rest="start").axes[0]
    np.testing.assert_allclose(shown(start)[0, 1:], [0.25, 0.125])


def test_values_are_drawn_over_any_two_variables():
    space = pharos.build(pharos.make("freeway", num_cars=1, lane_length=3))
    solution = pharos.value_iteration(space.mdp(gamma=0.9))
    with pytest.raises(ParameterError, match=r"say which two to draw over, such as --over \w+,\w+"):
        plots.value_map(space, solution)
    names = space.component_names
    figure = plots.value_map(space, solution, over=names[:2], rest="start")
    axis, states = figure.axes[0], space.states()
    slice = np.all(states[:, 2:] == states[0, 2:], axis=1)
    low = states[slice, :2].min(axis=0)
    expected = np.full_like(shown(axis), np.nan)
    for s in np.flatnonzero(slice & ~solution.mdp.terminal):
        expected[tuple(states[s, :2] - low)] = solution.v[s]
    np.testing.assert_array_equal(shown(axis), expected)
    assert (
        np.isfinite(shown(axis)).any()
        and axis.get_ylabel() == names[0]
        and axis.get_xlabel().startswith(names[1] + "\n")
    )
    taken = {letter for text in axis.texts for letter in text.get_text()}
    assert taken & {action[0] for action in space.environment.actions}
    with pytest.raises(ParameterError, match="unknown component of freeway to draw over 'cra'"):
        plots.value_map(space, solution, over=(names[0], "cra"))
    with pytest.raises(ParameterError, match="expected two components"):
        plots.value_map(space, solution, over=(names[0], names[0]))


def test_a_value_map_frames_the_start():
    space = pharos.build(pharos.make("simple_grid", height=2, width=3))
    axis = plots.value_map(space, pharos.value_iteration(space.mdp())).axes[0]
    (frame,) = [patch for patch in axis.patches if patch.get_width() == pytest.approx(0.92)]
    assert frame.get_xy() == pytest.approx((-0.46, -0.46))


def config_of(**other):
    usual = {
        "agent": "dqn",
        "observation": "vector",
        "environment": "frozen_lake",
        "parameters": pharos.make("frozen_lake").parameters,
        "chance": {"sticky": 0.0, "random": 0.0},
        "gamma": 1.0,
        "horizon": 100,
        "steps": 20000,
        "hyperparameters": {"gamma": 0.9, "batch_size": 32},
    }
    return {**usual, **other}


def test_legends_have_no_empty_fields_and_say_units():
    configs = [
        config_of(),
        config_of(agent="q_learning", observation="", environment="taxi", parameters={}, steps=300000),
        config_of(parameters=pharos.make("frozen_lake/8x8").parameters, chance={"sticky": 0.25, "random": 0.0}),
        config_of(parameters=pharos.make("frozen_lake", size=6, seed=3).parameters),
        config_of(hyperparameters={"gamma": 0.99, "batch_size": 32}),
    ]
    labels = [run_label(config, configs) for config in configs]
    assert labels == [
        "DQN (vector) on Frozen lake 4x4, 20 k steps, no chance, gamma=0.9",
        "Q-learning on Taxi, 300 k steps, no chance, gamma=0.9",
        "DQN (vector) on Frozen lake 8x8, 20 k steps, sticky=0.25, gamma=0.9",
        "DQN (vector) on Frozen lake size=6 seed=3, 20 k steps, no chance, gamma=0.9",
        "DQN (vector) on Frozen lake 4x4, 20 k steps, no chance, gamma=0.99",
    ]
    alone = config_of(agent="q_learning", observation="", environment="taxi", parameters={}, steps=300000)
    assert run_labels([alone]) == ["Q-learning on Taxi, 300 k steps"]


def test_an_imported_mdp_has_the_name_of_its_folder_in_legends():
    parameters = {"folder": "/tmp/door-key", "digest": "0" * 32}
    config = config_of(agent="q_learning", observation="", environment="imported", parameters=parameters)
    assert run_labels([config]) == ["Q-learning on door-key, 20 k steps"]


def test_no_two_groups_of_runs_have_one_label():
    changes = [{}, {"gamma": 0.9, "horizon": None}, {"evaluation_interval": 5}, {"agent": "ppo"}]
    assert run_labels([config_of(**each) for each in changes]) == [
        "DQN (vector) on Frozen lake 4x4, 20 k steps, discount 1, 100 steps an episode",
        "DQN (vector) on Frozen lake 4x4, 20 k steps, discount 0.9, no horizon",
        "DQN (vector) on Frozen lake 4x4, 20 k steps, discount 1, 100 steps an episode (3)",
        "PPO (vector) on Frozen lake 4x4, 20 k steps",
    ]


def test_the_legend_of_regret_lies_below_the_curves(folders):
    figure = plots.regret(folders)
    assert [axis.get_legend() for axis in figure.axes] == [None, None]
    assert len(figure.legends[0].get_texts()) == 3
