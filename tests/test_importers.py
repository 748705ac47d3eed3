"""Importers: BRIDGE's files, Gymnasium's tables, folders; what is wrong gets one line, and nothing is unpickled."""

import json
import pickle
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from typer.testing import CliRunner

import pharos
from pharos import exporters, hardness, importers
from pharos.cli import app
from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from strategies import small_mdps

BRIDGE = Path(__file__).parent / "data" / "bridge"
CORRIDOR = BRIDGE / "key-corridor-s3r1.npz"


def same(one, other):
    assert (one.rewards == other.rewards).all()
    assert (np.asarray(one.terminal) == np.asarray(other.terminal)).all()
    assert one.start_states.tolist() == other.start_states.tolist()
    np.testing.assert_allclose(one.start_probabilities, other.start_probabilities)
    assert (one.gamma, one.horizon) == (other.gamma, other.horizon)
    if one.transitions is None:
        assert (one.next_states == other.next_states).all()
    else:
        assert abs(one.transitions - other.transitions).max() == 0


def test_a_file_of_bridge_has_its_published_values():
    mdp = importers.bridge(CORRIDOR, horizon=100)
    assert (mdp.num_states, mdp.num_actions, mdp.gamma, mdp.horizon) == (168, 6, 1.0, 100)
    assert pharos.value_iteration(mdp).value_at_start == 1.0
    found = pharos.solvers.uniform_value(mdp).value_at_start
    assert found == pytest.approx(0.0032357130, abs=5e-11)
    assert importers.bridge(BRIDGE / "empty-16x16-distance-shaped.npz", horizon=100).num_states > 100


@pytest.mark.parametrize(
    ("name", "horizon"),
    [("freeway_10_fs30", 10), ("MiniGrid-Empty-5x5-v0", 100), ("pong_20_fs30_analyzed", 20), ("consolidated", None)],
)
def test_horizons_are_told_by_names(tmp_path, name, horizon):
    file = tmp_path / f"{name}.npz"
    np.savez(file, transitions=np.array([[-1, 0]]), rewards=np.array([[1.0, 0.0]]))
    if horizon is None:
        with pytest.raises(ParameterError, match="does not tell the horizon"):
            importers.bridge(file)
        assert importers.bridge(file, horizon=7).horizon == 7
        inside = tmp_path / "MiniGrid-X" / "consolidated.npz"
        inside.parent.mkdir()
        inside.write_bytes(file.read_bytes())
        assert importers.bridge(inside).horizon == 100
    else:
        assert importers.bridge(file).horizon == horizon
        with pytest.raises(ParameterError, match=f"contradicts its name, which says {horizon}"):
            importers.bridge(file, horizon=horizon + 1)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"rewards": np.zeros((1, 2))}, "lacks transitions"),
        ({"transitions": np.zeros((2, 2), int), "rewards": np.zeros((2, 3))}, "expected numbers of shape"),
        ({"transitions": np.zeros((2, 2)), "rewards": np.zeros((2, 2))}, "expected integers"),
        ({"transitions": np.full((2, 2), 2), "rewards": np.zeros((2, 2))}, "expected a state from 0 to 1"),
        ({"transitions": np.full((2, 2), -2), "rewards": np.zeros((2, 2))}, "expected a state from 0 to 1"),
        ({"transitions": np.zeros((2, 2), int), "rewards": np.full((2, 2), np.nan)}, "expected a finite number"),
        ({"transitions": np.array([[{}]]), "rewards": np.zeros((1, 1))}, "without unpickling"),
    ],
)
def test_spoilt_files_of_bridge_are_refused_in_one_line(tmp_path, members, message):
    file = tmp_path / "spoilt.npz"
    np.savez(file, **members)
    with pytest.raises(FileFormatError, match=message) as caught:
        importers.bridge(file, horizon=5)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


def test_what_is_no_npz_is_refused_and_never_run(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "exploded",))

    (tmp_path / "pickle.npz").write_bytes(pickle.dumps(Bomb()))
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "cut.npz").write_bytes(CORRIDOR.read_bytes()[:5000])
    for name in ("pickle", "text", "cut"):
        with pytest.raises(FileFormatError, match="cannot be read"):
            importers.bridge(tmp_path / f"{name}.npz", horizon=5)
    assert not (tmp_path / "exploded").exists()


def test_screens_come_one_a_state(tmp_path):
    file = tmp_path / "screens.npz"
    screens = np.arange(2 * 3 * 4 * 3, dtype=np.uint8).reshape(2, 3, 4, 3)
    np.savez(file, transitions=np.zeros((3, 1), int), screens=screens, screen_mapping=np.array([1, 0, 1]))
    assert (importers.bridge_screens(file) == screens[[1, 0, 1]]).all()
    np.savez(file, transitions=np.zeros((3, 1), int), screens=screens, screen_mapping=np.array([1, 0, 2]))
    with pytest.raises(FileFormatError, match="names a screen that is not there"):
        importers.bridge_screens(file)


@pytest.mark.parametrize(
    ("name", "options", "value"),
    [
        ("FrozenLake-v1", {"is_slippery": False}, 0.99**5),
        ("FrozenLake-v1", {"is_slippery": True}, None),
        ("CliffWalking-v1", {}, None),
        ("Taxi-v4", {}, None),
    ],
)
def test_tables_of_gymnasium_have_the_values_of_their_matrices(name, options, value):
    env = gymnasium.make(name, **options)
    mdp = importers.gymnasium(env, gamma=0.99)
    table = env.unwrapped.P
    v = np.zeros(len(table))
    for _ in range(3000):
        v = (
            np.array(
                [
                    max(sum(p * (r + 0.99 * v[t] * (not end)) for p, t, r, end in table[s][a]) for a in table[s])
                    for s in table
                ]
            )
            if len(table) < 100
            else _sweep(table, v)
        )
    start = np.asarray(env.unwrapped.initial_state_distrib)
    found = pharos.value_iteration(mdp, 1e-9).value_at_start
    assert found == pytest.approx(float(start @ v), abs=1e-6)
    if value is not None:
        assert found == pytest.approx(value)
    assert (mdp.transitions is None) == (not options.get("is_slippery", False))


def _sweep(table, v):
    """The same for larger tables, whose actions have one outcome each."""
    states, actions = len(table), len(table[0])
    flat = [table[s][a][0] for s in range(states) for a in range(actions)]
    following = np.array([t for _, t, _, _ in flat]).reshape(states, actions)
    paid = np.array([r for _, _, r, _ in flat]).reshape(states, actions)
    going = np.array([not end for _, _, _, end in flat]).reshape(states, actions)
    return (paid + 0.99 * v[following] * going).max(axis=1)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (3, "has no table"),
        ({0: {0: [(0.5, 0, 0.0, False)]}}, "sum to 0.5"),
        ({0: {0: [(1.0, 5, 0.0, False)]}}, "a state below 1"),
        ({0: {0: [(1.0, 0, float("nan"), False)]}}, "finite reward"),
    ],
)
def test_spoilt_tables_are_refused(table, message):
    with pytest.raises(FileFormatError, match=message):
        importers.gymnasium(table)


@settings(max_examples=50, deadline=None)
@given(small_mdps())
def test_folders_give_back_what_was_saved(tmp_path_factory, mdp):
    folder = tmp_path_factory.mktemp("mdp") / "kept"
    if mdp.is_sticky or mdp.is_random:
        with pytest.raises(ParameterError, match="without sticky or random actions"):
            importers.save(mdp, folder)
        return
    importers.save(mdp, folder)
    same(importers.load(folder), mdp)


def test_folders_that_were_changed_are_refused(tmp_path):
    mdp = importers.bridge(CORRIDOR, horizon=100)
    folder = importers.save(mdp, tmp_path / "kept")
    rewards = np.load(folder / "rewards.npy")
    np.save(folder / "rewards.npy", rewards + 1)
    with pytest.raises(FileFormatError, match=r"rewards\.npy was changed"):
        importers.load(folder)
    (folder / "rewards.npy").unlink()
    with pytest.raises(FileFormatError, match="no such file"):
        importers.load(folder)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("years of work")
    with pytest.raises(ParameterError, match="holds no imported MDP"):
        importers.save(mdp, tmp_path / "other")


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_an_imported_file_and_folder_are_targets(tmp_path):
    done = run("import", "bridge", CORRIDOR, "--horizon", 100, "--out", tmp_path / "kc", "--json")
    assert json.loads(done.stdout)["num_states"] == 168
    for target in ([CORRIDOR, "--horizon", 100], [tmp_path / "kc"]):
        answer = json.loads(run("hardness", *target, "--measures", "effective_horizon,covering", "--json").stdout)
        assert answer["measures"]["effective_horizon"]["value"] == 16.0
        assert answer["measures"]["covering"]["omega_max"] == pytest.approx(3.62514e-7, rel=1e-5)
        assert answer["conventions"]["gamma"] == 1.0
    solved = json.loads(run("solve", tmp_path / "kc", "--json").stdout)
    assert (solved["value_at_start"], solved["horizon"]) == (1.0, 100)
    assert run("solve", CORRIDOR).exit_code == 2  # its name here does not tell the horizon


# Exporters --------------------------------------------------------------------------------------------------------------


def test_bridge_files_come_back(tmp_path):
    mdp = pharos.build(pharos.make("frozen_lake/8x8")).mdp(gamma=1.0).with_horizon(200)
    back = importers.bridge(exporters.bridge(mdp, tmp_path / "lake_200_fs1.npz"))
    assert back.horizon == 200
    for horizon in (10, 14, 200):
        one, other = (pharos.value_iteration(each.with_horizon(horizon)).value_at_start for each in (mdp, back))
        assert one == other
    moved = mdp.with_initial(5)
    back = importers.bridge(exporters.bridge(moved, tmp_path / "moved_200_fs1.npz"))
    assert pharos.value_iteration(back).value_at_start == pharos.value_iteration(moved).value_at_start
    with pytest.raises(ParameterError, match="deterministic"):
        exporters.bridge(random_actions(mdp, 0.1), tmp_path / "x.npz")


@settings(max_examples=60, deadline=None)
@given(small_mdps())
def test_tables_come_back_with_the_same_values(mdp):
    if mdp.is_sticky:
        with pytest.raises(ParameterError, match="sticky"):
            exporters.gym_p(mdp)
        return
    table = exporters.gym_p(mdp)
    back = importers.gymnasium(table, gamma=mdp.gamma)
    v = pharos.value_iteration(mdp, 1e-9).v
    np.testing.assert_allclose(pharos.value_iteration(back, 1e-9).v[: mdp.num_states], v, atol=1e-6)


def read_drn(path):
    """(start, P, R) of a DRN file, by its own words."""
    lines = path.read_text().splitlines()
    states = int(lines[lines.index("@nr_states") + 1])
    body = lines[lines.index("@model") + 1 :]
    rows, start = [], None
    for line in body:
        words = line.split()
        if words[0] == "state":
            rows.append([])
            start = int(words[1]) if "init" in words else start
        elif words[0] == "action":
            rows[-1].append((float(words[2].strip("[]")), {}))
        else:
            rows[-1][-1][1][int(words[0])] = float(words[2])
    assert len(rows) == states
    assert sum(map(len, rows)) == int(lines[lines.index("@nr_choices") + 1])
    return start, rows


@settings(max_examples=40, deadline=None)
@given(small_mdps())
def test_storms_format_says_the_same_values(tmp_path_factory, mdp):
    if mdp.is_sticky:
        return
    start, rows = read_drn(exporters.drn(mdp, tmp_path_factory.mktemp("drn") / "mdp.drn"))
    v = np.zeros(len(rows))
    for _ in range(4000):
        new = np.array([max(r + sum(p * v[t] for t, p in targets.items()) for r, targets in row) for row in rows])
        if np.abs(new - v).max() < 1e-12:
            break
        v = new
    assert all(abs(sum(targets.values()) - 1) < 1e-9 for row in rows for _, targets in row)
    assert v[start] == pytest.approx(pharos.value_iteration(mdp, 1e-9).value_at_start, abs=1e-6)


@pytest.mark.parametrize(("format", "name"), [("bridge", "grid.npz"), ("drn", "grid.drn"), ("gym", "grid.json")])
def test_export_writes_the_format_that_is_asked_for(tmp_path, format, name):
    done = run("export", "simple_grid", "--format", format, "--out", tmp_path / name, "--json")
    assert json.loads(done.stdout)["bytes"] == (tmp_path / name).stat().st_size
    assert run("export", "simple_grid", "--format", format, "--out", tmp_path / "grid.txt").exit_code == 2
    assert run("export", "simple_grid", "--format", "prism", "--out", tmp_path / name).exit_code == 2


def test_matrices_are_mdps():
    mdp = importers.matrices(np.full((2, 1, 2), 0.5), np.array([[1.0], [0.0]]), gamma=0.5)
    assert isinstance(mdp, TabularMDP)
    assert pharos.value_iteration(mdp, 1e-9).v == pytest.approx([1.5, 0.5])
    assert hardness.diameter(sticky_actions(mdp, 0.5)).upper == pytest.approx(2.0)
