"""Importers: BRIDGE's files, Gymnasium's tables, folders; what is wrong gets one line, and nothing is unpickled."""

import json
import pickle
import re
from fractions import Fraction
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import xxhash

import pharos
from command_line import run
from pharos import exporters, hardness, importers
from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from refusals import refusal
from strategies import examples, small_mdps

BRIDGE = Path(__file__).parents[1] / "data" / "bridge"
CORRIDOR = BRIDGE / "key-corridor-s3r1.npz"


def same(one, other):
    assert (one.rewards == other.rewards).all()
    assert (np.asarray(one.terminal) == np.asarray(other.terminal)).all()
    assert one.start_states.tolist() == other.start_states.tolist()
    np.testing.assert_allclose(one.start_probabilities, other.start_probabilities)
    assert (one.gamma, one.horizon) == (other.gamma, other.horizon)
    assert type(one.dynamics) is type(other.dynamics)
    arrays, others = one.dynamics.arrays(), other.dynamics.arrays()
    assert arrays.keys() == others.keys()
    assert all((array == others[name]).all() for name, array in arrays.items())


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
        assert "does not tell the horizon" in refusal(ParameterError, importers.bridge, file)
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
    said = refusal(FileFormatError, importers.bridge, file, horizon=5)
    assert message in said and str(file) in said


def test_what_is_no_npz_is_refused_and_never_run(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "exploded",))

    (tmp_path / "pickle.npz").write_bytes(pickle.dumps(Bomb()))
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "cut.npz").write_bytes(CORRIDOR.read_bytes()[:5000])
    for name in ("pickle", "text", "cut"):
        assert "cannot be read" in refusal(FileFormatError, importers.bridge, tmp_path / f"{name}.npz", horizon=5)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("model.nm", "`pharos import prism {} --out FOLDER`"),
        ("model.prism", "`pharos import prism {} --out FOLDER`"),
        ("model.drn", "`pharos import prism {} --out FOLDER`"),
        ("tiger.pomdp", "importers.matrices(P, R)"),
        ("P.mat", "importers.matrices(P, R)"),
        ("P.csv", "importers.matrices(P, R)"),
        ("notes.txt", "importers.matrices(P, R)"),
    ],
)
def test_another_file_as_a_target_gets_the_command_that_imports_it(name, advice, tmp_path):
    file = tmp_path / name
    file.write_text("mdp\n")
    for done in (run("hardness", file), run("solve", file)):
        assert done.exit_code == 1 and len(done.stderr.strip().splitlines()) == 1
        assert advice.format(file) in done.stderr and "pickle" not in done.stderr
    done = run("train", file, "--agent", "q_learning", "--steps", 10)
    assert done.exit_code == 2 and advice.format(file) in done.stderr


def test_screens_come_one_a_state(tmp_path):
    file = tmp_path / "screens.npz"
    screens = np.arange(2 * 3 * 4 * 3, dtype=np.uint8).reshape(2, 3, 4, 3)
    np.savez(file, transitions=np.zeros((3, 1), int), screens=screens, screen_mapping=np.array([1, 0, 1]))
    assert (importers.bridge_screens(file) == screens[[1, 0, 1]]).all()
    np.savez(file, transitions=np.zeros((3, 1), int), screens=screens, screen_mapping=np.array([1, 0, 2]))
    assert "names a screen that is not there" in refusal(FileFormatError, importers.bridge_screens, file)


@pytest.mark.long
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
    assert message in refusal(FileFormatError, importers.gymnasium, table)


@pytest.mark.slow
@examples(50, small_mdps())
def test_folders_give_back_what_was_saved(tmp_path_factory, mdp):
    folder = tmp_path_factory.mktemp("mdp") / "kept"
    if mdp.is_sticky or mdp.is_random:
        assert "without sticky or random actions" in refusal(ParameterError, importers.save, mdp, folder)
        return
    importers.save(mdp, folder)
    same(importers.load(folder), mdp)


def test_folders_that_were_changed_are_refused(tmp_path):
    mdp = importers.bridge(CORRIDOR, horizon=100)
    folder = importers.save(mdp, tmp_path / "kept")
    rewards = np.load(folder / "rewards.npy")
    np.save(folder / "rewards.npy", rewards + 1)
    assert "rewards.npy was changed" in refusal(FileFormatError, importers.load, folder)
    (folder / "rewards.npy").unlink()
    assert "no such file" in refusal(FileFormatError, importers.load, folder)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("years of work")
    assert "holds no imported MDP" in refusal(ParameterError, importers.save, mdp, tmp_path / "other")


@pytest.mark.long
def test_an_imported_file_and_folder_are_targets(tmp_path):
    done = run("import", "bridge", CORRIDOR, "--horizon", 100, "--out", tmp_path / "kc", "--json")
    assert json.loads(done.stdout)["num_states"] == 168
    for target in ([CORRIDOR, "--horizon", 100], [tmp_path / "kc"]):
        answer = json.loads(
            run("hardness", *target, "--measures", "effective_horizon,covering", "--budget", "inf", "--json").stdout
        )
        assert answer["measures"]["effective_horizon"]["value"] == 16.0
        assert answer["measures"]["covering"]["omega_max"] == pytest.approx(3.62514e-7, rel=1e-5)
        assert answer["conventions"]["gamma"] == 1.0
    solved = json.loads(run("solve", tmp_path / "kc", "--json").stdout)
    assert (solved["value_at_start"], solved["horizon"]) == (1.0, 100)
    assert run("solve", CORRIDOR).exit_code == 2  # its name here does not tell the horizon


# Exporters -----------------------------------------------------------------------------------------------------------


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
    assert "deterministic" in refusal(ParameterError, exporters.bridge, random_actions(mdp, 0.1), tmp_path / "x.npz")


@examples(60, small_mdps())
def test_tables_come_back_with_the_same_values(mdp):
    if mdp.is_sticky:
        assert "sticky" in refusal(ParameterError, exporters.gym_p, mdp)
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


@examples(40, small_mdps())
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
    grid = (
        "simple_grid",
        f"height={4 + ('bridge', 'drn', 'gym').index(format)}",
    )  # one that no other process builds at the same time
    done = run("export", *grid, "--format", format, "--out", tmp_path / name, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["bytes"] == (tmp_path / name).stat().st_size
    assert run("export", *grid, "--format", format, "--out", tmp_path / "grid.txt").exit_code == 2
    assert run("export", *grid, "--format", "prism", "--out", tmp_path / name).exit_code == 2


@pytest.mark.long
def test_matrices_are_mdps():
    mdp = importers.matrices(np.full((2, 1, 2), 0.5), np.array([[1.0], [0.0]]), gamma=0.5)
    assert isinstance(mdp, TabularMDP)
    assert pharos.value_iteration(mdp, 1e-9).v == pytest.approx([1.5, 0.5])
    assert hardness.diameter(sticky_actions(mdp, 0.5)).upper == pytest.approx(2.0)


# Damage and harm -----------------------------------------------------------------------------------------------------


def edited_manifest(folder, **changes):
    """Change the manifest of a folder; its digest stays."""
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.fixture
def imported(tmp_path):
    return importers.save(importers.bridge(CORRIDOR, horizon=100), tmp_path / "imported")


@pytest.mark.parametrize(
    "changes", [{"gamma": 0.99}, {"horizon": 99}, {"horizon": None}, {"source": "elsewhere"}, {"arrays": 0.5}]
)
def test_every_entry_of_a_manifest_counts(changes, imported):
    edited_manifest(imported, **changes)
    with pytest.raises(FileFormatError, match=r"manifest\.json: was changed after it was written; import it again"):
        importers.load(imported)


def test_folders_of_older_versions_are_read(imported):
    expected = importers.load(imported)
    path = imported / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["digest"]
    path.write_text(json.dumps(manifest))
    same(importers.load(imported), expected)
    for changes, message in (
        ({"arrays": 0.5}, "arrays is 0.5; expected a checksum for each array"),
        ({"arrays": {"../secret": "0"}}, "its arrays are ../secret"),
        ({"num_states": 10**15}, "rewards have shape"),
        ({"gamma": "high"}, "damaged"),
        ({"gamma": 7}, "damaged: gamma is 7"),
        ({"horizon": 0.5}, "damaged: horizon is 0.5"),
        ({"format_version": 4}, "format version 4; this pharos reads versions 1, 2, 3"),
        ({"format_version": 3}, "expected .*, outcome_rewards"),
        ({"format_version": 2}, "expected .*, observations"),
    ):
        path.write_text(json.dumps(manifest | changes))
        said = refusal(FileFormatError, importers.load, imported)
        assert re.search(message, said) and str(imported) in said


def resealed(folder):
    """Make the checksums of an older folder right, as somebody would who means harm."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest.pop("digest", None)
    for name in manifest["arrays"]:
        manifest["arrays"][name] = xxhash.xxh3_128_hexdigest((folder / f"{name}.npy").read_bytes())
    path.write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("next_states", np.full((168, 6), 168)),
        ("next_states", np.full((168, 6), -2)),
        ("next_states", np.zeros((168, 6))),
        ("next_states", np.zeros((168, 5), int)),
        ("rewards", np.full((168, 6), np.nan)),
        ("rewards", np.array([["a"]])),
        ("terminal", np.ones(168, bool)),
        ("start_states", np.array([-1])),
        ("start_states", np.array([168])),
        ("start_states", np.array([0.5])),
        ("start_probabilities", np.array([1e30])),
        ("start_probabilities", np.array([np.nan])),
    ],
)
def test_arrays_with_right_checksums_and_wrong_content_are_refused(name, array, imported):
    np.save(imported / f"{name}.npy", array)
    resealed(imported)
    assert str(imported) in refusal(FileFormatError, importers.load, imported)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("transitions_indices", lambda array: array + 1),
        ("transitions_indices", lambda array: array - 1),
        ("transitions_indptr", lambda array: array * 3),
        ("transitions_indptr", lambda array: array[::-1].copy()),
        ("transitions_data", lambda array: array + np.nan),
        ("transitions_data", lambda array: array[:-1]),
    ],
)
def test_matrices_with_right_checksums_and_wrong_content_are_refused(name, change, tmp_path):
    folder = importers.save(importers.matrices(np.full((3, 2, 3), 1 / 3), np.ones((3, 2))), tmp_path / "imported")
    np.save(folder / f"{name}.npy", change(np.load(folder / f"{name}.npy")))
    resealed(folder)
    refusal(FileFormatError, importers.load, folder)


def test_an_array_header_that_promises_more_than_there_is_ends_in_one_line(imported):
    path = imported / "rewards.npy"
    path.write_bytes(path.read_bytes().replace(b"(168, 6), ", b"(10**9,6),").replace(b"'<f8'", b"'<f8'"))
    for data in (path.read_bytes(), path.read_bytes()[:40], b"", b"\x93NUMPY\x01\x00\x10\x00" + b"(" * 16):
        path.write_bytes(data)
        resealed(imported)
        assert "rewards.npy: cannot be read" in refusal(FileFormatError, importers.load, imported)


@pytest.mark.long
def test_no_bit_of_a_compressed_file_of_bridge_ends_in_a_traceback(tmp_path):
    data, expected = CORRIDOR.read_bytes(), importers.bridge(CORRIDOR, horizon=100)
    file = tmp_path / "damaged.npz"
    rng = np.random.default_rng(0)
    refused = 0
    headers = np.concatenate([np.arange(60), np.arange(len(data) - 250, len(data))])
    for place in (*headers.tolist(), *rng.choice(len(data), 200).tolist()):
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        try:
            same(importers.bridge(file, horizon=100), expected)
        except FileFormatError as error:
            refused += 1
            assert str(file) in str(error) and "\n" not in str(error)
    assert refused > 50


def test_a_name_with_a_horizon_beyond_reason_is_refused_at_once(tmp_path):
    file = tmp_path / "a_1000000000_fs3.npz"
    np.savez(file, transitions=np.array([[-1, 0]]), rewards=np.array([[1.0, 0.0]]))
    assert "its name says 1000000000 steps; expected at most 100000" in refusal(ParameterError, importers.bridge, file)


class Fickle(gymnasium.Env):
    """Chance that is not in the table: now and then an action leads elsewhere, or pays something else."""

    P = {s: {a: [(1.0, (s + a) % 5, 0.0, False)] for a in range(2)} for s in range(5)}

    def __init__(self, what="nothing"):
        self.what = what

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return 0, {}

    def step(self, action):
        _, following, reward, ended = self.P[self.s][action][0]
        if self.s == 3 and action == 1 and self.np_random.random() < 0.1:
            following = 2 if self.what == "state" else following
            reward = 1.0 if self.what == "reward" else reward
            ended = self.what == "end"
        self.s = following
        return following, reward, ended, False, {}


def test_chance_that_is_not_in_the_table_is_noticed():
    assert importers.gymnasium(Fickle()).num_states == 5
    for what in ("state", "reward", "end"):
        with pytest.raises(FileFormatError, match=r"in state 3, action 1 led to state . with reward .*does not hold"):
            importers.gymnasium(Fickle(what))
    with pytest.raises(FileFormatError, match=r"fickle_passenger=True.*is another MDP"):
        importers.gymnasium(gymnasium.make("Taxi-v4", fickle_passenger=True))


def test_an_environment_that_is_imported_is_left_as_it_was():
    env = gymnasium.make("Taxi-v4")
    env.reset(seed=3)
    state, rng = env.unwrapped.s, env.unwrapped.np_random.bit_generator.state
    importers.gymnasium(env)
    assert env.unwrapped.s == state and env.unwrapped.np_random.bit_generator.state == rng


@pytest.mark.parametrize("start", [[0.5] * 5, [1.0], [np.nan, 1, 0, 0, 0], "start"])
def test_a_start_that_is_no_distribution_is_refused(start):
    env = Fickle()
    env.initial_state_distrib = start
    assert "initial_state_distrib is no distribution" in refusal(FileFormatError, importers.gymnasium, env)


# A table is no environment -------------------------------------------------------------------------------------------


def test_a_table_is_not_trained_on_or_stepped():
    mdp = importers.bridge(CORRIDOR, horizon=100)
    with pytest.raises(ParameterError, match=r"a table; expected an Environment: pharos\.importers\.environment"):
        pharos.train("q_learning", mdp, steps=10)
    with pytest.raises(
        ParameterError, match=r"expected a name or a pharos Environment: pharos\.importers\.environment"
    ):
        pharos.make_vec(mdp, 2)


@pytest.mark.parametrize("verb", [["train", "--agent", "q_learning", "--steps", 10], ["render"], ["play"], ["build"]])
def test_commands_that_need_an_environment_say_what_to_do_with_a_file(verb, tmp_path):
    out = ["--out", tmp_path / "out.png"] if verb[0] == "render" else []
    done = run(verb[0], CORRIDOR, *verb[1:], *out)
    assert done.exit_code in (1, 2)
    assert "pharos import bridge" in done.stderr or verb == ["play"]  # which needs a terminal first
    assert "delete" not in done.stderr and "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("other", [0, 1])
def test_means_of_rewards_that_nearly_cancel_are_within_their_bound(other):
    """Of a table of Gymnasium, whose products and sums float64 rounds; both outcomes end in one state, or in two."""
    row = [(0.3, 0, 7e6, True), (0.7, other, -3e6, True)]
    mdp = importers.gymnasium({0: {0: row}, 1: {0: [(1.0, 1, 0.0, True)]}}, gamma=0.9)
    truth = sum(Fraction(p) * Fraction(reward) for p, _, reward, _ in row)
    solution = pharos.value_iteration(mdp)
    assert 0 < abs(Fraction(float(solution.v[0])) - truth) <= Fraction(solution.error_bound)
    exact = importers.gymnasium({0: {0: [(1.0, 0, 7e6, True)]}}, gamma=0.9)
    assert exact.reward_table.rounding == 0 and pharos.value_iteration(exact).v[0] == 7e6


def test_toy_text_keeps_the_names_of_its_documentation(tmp_path):
    lake = importers.gymnasium(gymnasium.make("FrozenLake-v1"))
    assert lake.names.actions == ("left", "down", "right", "up")
    assert lake.names.state(6) == "row=1 column=2"
    taxi = gymnasium.make("Taxi-v4").unwrapped
    names = importers.gymnasium(taxi, check=False).names
    assert names.actions[4:] == ("pickup", "dropoff")
    for s in (0, 123, 499):
        assert [int(column[s]) for column in names.variables.values()] == [int(value) for value in taxi.decode(s)]
    assert importers.gymnasium({0: {0: [(1.0, 0, 0.0, True)]}}).names is None
    words = ("import", "gymnasium", "FrozenLake-v1", "--no-check", "--out", tmp_path / "lake", "--initial")
    assert "--initial is 'a'" in run(*words, "a").stderr
    assert run(*words, "4,6").exit_code == 0
    assert importers.load(tmp_path / "lake").start_states.tolist() == [4, 6]
    done = run("import", "gymnasium", "CliffWalking-v1", "--out", tmp_path / "cliff", "--no-check")
    assert done.exit_code == 0
    assert pharos.make(str(tmp_path / "cliff")).actions == ("up", "right", "down", "left")
    # the way along the cliff: up, eleven times right, and down
    rows = json.loads(run("solve", tmp_path / "cliff", "--print-policy", "--json").stdout)["policy_rows"]
    assert [row["name"] for row in rows] == ["up", *["right"] * 11, "down"]
    assert rows[0]["variables"] == {"row": 3, "column": 0}


def test_a_table_comes_back_from_json_and_large_rewards_do_not_fit_a_file_of_bridge(tmp_path):
    mdp = pharos.build("frozen_lake/4x4").mdp()
    table = json.loads(json.dumps(exporters.gym_p(mdp)))
    assert importers.gymnasium(table, gamma=mdp.gamma).num_states == mdp.num_states
    twice = {**table, "00": table["0"]}  # of which one would be lost
    assert "has no P[0]" in refusal(FileFormatError, importers.gymnasium, twice)
    large = TabularMDP.from_arrays([[1], [1]], [[1e39], [0.0]])
    assert "are larger than 3.4e38" in refusal(ParameterError, exporters.bridge, large, tmp_path / "x.npz")
    importers.save(mdp.with_horizon(5), tmp_path / "five")
    said = run("export", tmp_path / "five", "--format", "gym", "--out", tmp_path / "t.json").output
    assert "5 steps: not in the file" in " ".join(said.split())


def test_limits_hold_for_the_folder_of_an_imported_mdp_too(tmp_path):
    mdp = TabularMDP.from_arrays([[1], [2], [2]], [[1.0], [1.0], [0.0]])
    importers.save(mdp, tmp_path / "three")
    for words, said in (
        (("--max-states", 2), "has 3 states; expected at most 2"),
        (("--memory", "foo"), "--memory 'foo'; expected a size"),
    ):
        assert said in run("solve", tmp_path / "three", *words).output
    assert run("solve", tmp_path / "three", "--max-states", 3).exit_code == 0
