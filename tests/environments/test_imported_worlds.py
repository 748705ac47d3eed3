"""Imported MDPs as environments: what is true of the table is true of what is stepped, trained on, drawn and built."""

import json
import zlib
from collections import Counter

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import fake_training
import pharos
from command_line import answer, run
from pharos import drawing, importers, training
from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import TabularMDP
from pharos.observations import recorded
from pharos.system import distinct_rows, storage
from refusals import refusal

# In state 0, action 0 goes to 1 or ends with 0.25; action 1 goes to 1 or 2; 2 is terminal. State 3 is never reached.
P = np.array(
    [
        [[0.0, 0.75, 0.0, 0.0], [0.0, 0.5, 0.5, 0.0]],
        [[0.5, 0.25, 0.25, 0.0], [0.0, 0.0, 1.0, 0.0]],
        [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]],
        [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    ]
)
R = np.array([[1.0, 0.25], [0.5, -1.0], [0.0, 0.0], [9.0, 9.0]])


def in_every_form():
    """The same MDP with chance, kept as matrices and as both layouts of outcomes."""
    general = TabularMDP.from_matrices(P, R, gamma=0.9, ends=True)
    successors = np.where(P > 0, np.arange(4), -1)
    likely = np.concatenate([P, 1 - P.sum(axis=2, keepdims=True)], axis=2)
    ends = np.concatenate([successors, np.full((4, 2, 1), -1)], axis=2)
    outcomes = TabularMDP.from_outcomes(ends, likely, R, gamma=0.9)
    return {"matrices": general, "outcomes": outcomes}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    place = tmp_path_factory.mktemp("imported")
    shown = np.arange(4 * 2 * 3 * 3, dtype=np.uint8).reshape(4, 2, 3, 3)
    return {
        name: importers.save(mdp, place / name, actions=("stay", "go"), time_limit=20, observations=shown)
        for name, mdp in in_every_form().items()
    }


def test_rules_say_what_the_table_says(folders):
    for folder in folders.values():
        env = pharos.make(str(folder))
        assert env.actions == ("stay", "go") and env.max_episode_steps == 20
        assert env.has_chance and env.components.size.tolist() == [5]
        for s in range(4):
            for a in range(2):
                went = np.zeros(5)
                for k in range(env.outcomes):
                    went[env.next_state((s,), a, k)[0]] += env.probability((s,), a, k)
                assert went == pytest.approx([*P[s, a], 1 - P[s, a].sum()])
                assert env.reward((s,), a, (0,)) == R[s, a]
        assert [env.is_terminal((s,)) for s in range(5)] == [False, False, True, False, True]


def test_each_form_of_a_table_is_the_same_environment(folders):
    one, other = (pharos.make(str(folder)) for folder in folders.values())
    for s in range(5):
        for a in range(2):
            reached = [
                {env.next_state((s,), a, k)[0]: p for k in range(env.outcomes) if (p := env.probability((s,), a, k))}
                for env in (one, other)
            ]
            assert reached[0] == pytest.approx(reached[1], abs=1e-12)


@pytest.mark.long
def test_built_spaces_have_the_values_of_the_table(folders):
    mdp = in_every_form()["matrices"]
    space = pharos.build(pharos.make(str(folders["matrices"])), progress=False)
    assert space.num_states == 4  # three that can be reached, and the end
    found = pharos.value_iteration(space.mdp(gamma=0.9), 1e-10)
    assert found.value_at_start == pytest.approx(pharos.value_iteration(mdp, 1e-10).value_at_start, abs=2e-10)


@pytest.mark.long
def test_steps_of_many_environments_have_the_probabilities_of_the_table(folders):
    env = pharos.make_vec(pharos.make(str(folders["matrices"])), 4000, autoreset_mode="DISABLED", time_limit=None)
    env.reset(seed=3)
    _, rewards, terminated, _, info = env.step(np.zeros(4000, np.int64))
    share = (info["state"][:, 0] == 1).mean()
    assert abs(share - 0.75) < 4 * np.sqrt(0.75 * 0.25 / 4000)
    assert (terminated == (info["state"][:, 0] == 4)).all() and (rewards == 1.0).all()


def test_what_was_recorded_is_observed_and_drawn(folders):
    env = pharos.make(str(folders["outcomes"]))
    seen = pharos.observe(env, "recorded")
    shown = np.arange(4 * 2 * 3 * 3, dtype=np.uint8).reshape(4, 2, 3, 3)
    assert seen.space == gymnasium.spaces.Box(0, 255, (2, 3, 3), np.uint8)
    assert (seen(np.array([[2], [4], [0]])) == np.stack([shown[2], 0 * shown[0], shown[0]])).all()
    stretched = pharos.observe(env, "recorded", stretch=True)(np.array([[3]]))[0]
    assert (stretched == shown[3] * (255 // shown.max(axis=(0, 1, 2)))).all()
    assert (drawing.human(env, (1,))[::200, ::200][:2] == shown[1]).all()
    assert drawing.text_drawing(env, (3,)) == "3"
    assert (drawing.human(env, (4,)) == 0).all()
    assert pharos.observe(env, "one_hot")(np.array([[3]])).tolist() == [[0, 0, 0, 1, 0]]


def test_an_environment_without_recordings_says_so(tmp_path):
    env = importers.environment(importers.save(in_every_form()["matrices"], tmp_path / "plain"))
    with pytest.raises(ParameterError, match=r"has no recorded observations.*use 'one_hot'"):
        pharos.observe(env, "recorded")
    assert env.actions == ("0", "1") and env.max_episode_steps == 1000
    assert drawing.human(env, (2,)).shape[2] == 3


def test_a_table_in_memory_becomes_an_environment_by_what_it_holds(monkeypatch, tmp_path):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    mdp = in_every_form()["outcomes"]
    assert importers.environment(mdp) == importers.environment(in_every_form()["outcomes"])
    assert importers.environment(mdp) != importers.environment(mdp.with_rewards(R + (R != 0)))
    assert "importers.environment(mdp)" in refusal(ParameterError, pharos.make_vec, mdp)


def test_folders_that_changed_are_another_environment_or_none(folders, tmp_path):
    mdp = in_every_form()["matrices"]
    folder = importers.save(mdp, tmp_path / "kept")
    env = pharos.make(str(folder))
    importers.save(mdp.with_gamma(0.5), folder)
    assert "holds another MDP than it did" in refusal(ParameterError, pharos.make, "imported", **env.parameters)
    np.save(folder / "transitions_data.npy", np.load(folder / "transitions_data.npy") * 0.5)
    with pytest.raises(FileFormatError, match=r"transitions_data\.npy was changed"):
        _ = pharos.make(str(folder)).outcomes
    with pytest.raises(ParameterError, match="expected 4 images"):
        importers.save(mdp, folder, observations=np.zeros((3, 2, 2, 3), np.uint8))
    assert "expected 2 names" in refusal(ParameterError, importers.save, mdp, folder, actions=("one",))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_states", "4"),
        ("num_actions", 0),
        ("horizon", 0.5),
        ("time_limit", -1),
        ("actions", ["one"]),
        ("actions", 7),
    ],
)
def test_manifests_that_say_what_no_mdp_has_are_refused_in_one_line(name, value, tmp_path):
    folder = importers.save(in_every_form()["matrices"], tmp_path / "kept")
    path = folder / "manifest.json"
    manifest = {key: value for key, value in json.loads(path.read_text()).items() if key != "digest"}
    path.write_text(json.dumps(manifest))
    assert pharos.make(str(folder)).num_actions == 2
    path.write_text(json.dumps(manifest | {name: value}))
    for words in (("render",), ("train", "--steps", 10), ("count",)):
        done = run(words[0], folder, *words[1:])
        assert done.exit_code in (1, 2) or (words[0] == "count" and name in ("time_limit", "actions"))
        assert len(done.stderr.strip().splitlines()) == (done.exit_code != 0)  # none where it is a traceback


def test_an_imported_world_without_a_folder_is_refused():
    assert "imported: folder is ''" in refusal(ParameterError, pharos.make, "imported")


def test_observations_raise_the_version_and_nothing_else_does(folders, tmp_path):
    plain = importers.save(in_every_form()["matrices"], tmp_path / "plain", actions=("stay", "go"))
    files = [path / "manifest.json" for path in (plain, *folders.values())]
    assert [json.loads(file.read_text())["format_version"] for file in files] == [1, 6, 6]
    assert importers.load(folders["matrices"]).rewards.tolist() == R.tolist()


def sealed_with(folder, **changes):
    """Change entries of a folder's manifest, and seal it again, as whoever hands over a folder can."""
    path = folder / "manifest.json"
    path.write_text(json.dumps(storage.sealed(json.loads(path.read_text()) | changes)))


def test_folders_of_an_earlier_pharos_show_what_they_recorded(tmp_path):
    folder = importers.save(in_every_form()["matrices"], tmp_path / "old")
    shown = np.arange(4 * 2 * 3 * 3, dtype=np.uint8).reshape(4, 2, 3, 3)
    np.save(folder / "observations.npy", shown)
    arrays = json.loads((folder / "manifest.json").read_text())["arrays"]
    arrays["observations"] = storage.digest_of_file(folder / "observations.npy")
    sealed_with(folder, format_version=2, observations="image", arrays=arrays)
    seen = pharos.observe(pharos.make(str(folder)), "recorded")
    assert (seen(np.array([[2], [4], [0]])) == np.stack([shown[2], 0 * shown[0], shown[0]])).all()
    grey = pharos.observe(pharos.make(str(folder)), "recorded", grey=True)(np.array([[2], [4]]))
    assert grey.shape == (2, 2, 3, 1) and (grey[1] == 0).all()


def test_equal_observations_are_stored_once_and_read_a_chunk_at_a_time(monkeypatch, tmp_path):
    monkeypatch.setattr(distinct_rows, "CHUNK_BYTES", 2 * 18)
    shown = np.random.default_rng(0).integers(256, size=(4, 2, 3, 3), dtype=np.uint8)
    shown[3] = shown[0]
    folder = importers.save(in_every_form()["matrices"], tmp_path / "chunks", observations=shown)
    stored = json.loads((folder / "manifest.json").read_text())["observation_rows"]
    assert (stored["rows"], stored["rows_in_chunk"], len(stored["bytes"])) == (3, 2, 2)
    assert np.load(folder / "observation_index.npy").tolist() == [0, 1, 2, 0]
    data = (folder / "observations.bin").read_bytes()
    (folder / "observations.bin").write_bytes(data[:-1] + b"?")  # in the second chunk
    rows = pharos.make(str(folder)).recorded
    assert (rows[[3, 1]] == shown[[3, 1]]).all() and (rows[0] == shown[0]).all()
    assert "observations.bin was changed" in refusal(FileFormatError, rows.__getitem__, 2)
    (folder / "observations.bin").unlink()
    assert "observations.bin: no such file" in refusal(FileFormatError, lambda: pharos.make(str(folder)).recorded)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"rows": 4}, "expected 4 rows"),
        ({"rows": 3, "shape": [2, 3, 4]}, "expected 72"),
        ({"rows": 3, "shape": [2, 3, 2]}, "expected 36"),
        ({"rows": 2}, "expected one row from 0 to 1 a state"),
        ({"rows": "3"}, "observation_rows is"),
        ({"shape": [2, -3, 3]}, "observation_rows is"),
        ({"shape": [1 << 40, 1 << 40, 3]}, "larger than its chunk can hold"),
        ({"dtype": "|O"}, "observation_rows is"),
        ({"bytes": [1 << 40]}, "was changed"),
        ({"checksums": None}, "its observations are damaged"),
    ],
)
def test_recordings_that_do_not_fit_their_files_are_refused_in_one_line(entry, message, tmp_path):
    shown = np.random.default_rng(0).integers(256, size=(4, 2, 3, 3), dtype=np.uint8)
    shown[3] = shown[0]
    folder = importers.save(in_every_form()["matrices"], tmp_path / "kept", observations=shown)
    stored = json.loads((folder / "manifest.json").read_text())["observation_rows"]
    stored |= {"rows_in_chunk": 3} | entry
    sealed_with(folder, observation_rows=stored)
    assert message in refusal(FileFormatError, lambda: pharos.make(str(folder)).recorded[np.arange(4)])


def test_a_chunk_that_inflates_beyond_its_rows_is_read_no_further(tmp_path):
    shown = np.zeros((4, 2, 3, 3), np.uint8)
    folder = importers.save(in_every_form()["matrices"], tmp_path / "bomb", observations=shown)
    bomb = zlib.compress(bytes(1 << 24))
    (folder / "observations.bin").write_bytes(bomb)
    stored = json.loads((folder / "manifest.json").read_text())["observation_rows"]
    stored |= {"bytes": [len(bomb)], "checksums": [storage.digest_of_bytes(bomb)]}
    sealed_with(folder, observation_rows=stored)
    said = refusal(FileFormatError, lambda: pharos.make(str(folder)).recorded[0])
    assert "a chunk of rows has 19 bytes or more; expected 18" in said and "observations.bin" in said


@given(
    values=arrays(
        st.sampled_from([np.uint8, np.int16, np.float32, np.float64, np.bool_]),
        st.tuples(st.integers(1, 9), st.just(2)),
    ),
    in_chunk=st.integers(1, 4),
)
def test_collected_rows_are_those_of_the_array(values, in_chunk):
    collector = distinct_rows.RowCollector(values.shape[1:], values.dtype)
    collector.rows_in_chunk = in_chunk
    index = np.array([collector.add(row) for row in values])
    rows = collector.rows(index)
    assert rows[np.arange(len(values))].tobytes() == values.tobytes()
    assert rows.num_distinct == len({row.tobytes() for row in values})
    few = int(index[: len(values) // 2].max(initial=0)) + 1
    short = distinct_rows.shorten_rows(rows.with_index(index[: len(values) // 2]), few)
    assert short[np.arange(len(values) // 2)].tobytes() == values[: len(values) // 2].tobytes()
    assert short.num_distinct == few and short.num_chunks == -(-few // in_chunk)


# What agents see ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def screens(tmp_path_factory):
    """Screens (4, 24, 16, 3) of an MDP, and its folder."""
    shown = np.random.default_rng(0).integers(256, size=(4, 24, 16, 3), dtype=np.uint8)
    place = tmp_path_factory.mktemp("screens") / "kept"
    return shown, importers.save(in_every_form()["outcomes"], place, time_limit=6, observations=shown)


@pytest.mark.parametrize("name", ["grey", "gray"])
def test_grey_is_luminance_and_size_averages_areas(name, screens):
    shown, folder = screens
    env, states = pharos.make(str(folder)), np.arange(4)[:, None]
    luminance = shown @ np.array([0.299, 0.587, 0.114])
    grey = pharos.observe(env, "recorded", **{name: True})
    assert grey.space.shape == (24, 16, 1) and abs(grey(states)[..., 0] - luminance).max() <= 1
    small = pharos.observe(env, "recorded", size=(12, 8))
    areas = shown.reshape(4, 12, 2, 8, 2, 3).mean(axis=(2, 4))
    assert small.space.shape == (12, 8, 3) and abs(small(states) - areas).max() <= 1
    both = pharos.observe(env, "recorded", **{name: True}, size=8)
    assert both.space == gymnasium.spaces.Box(0, 255, (8, 8, 1), np.uint8)
    assert (both(np.array([[4]])) == 0).all() and (both(states)[1] == both.one(np.array([1]))).all()


def test_a_table_of_looks_and_looks_one_by_one_are_the_same(screens, monkeypatch):
    _, folder = screens
    options, states = {"grey": True, "size": 8}, np.array([[3], [4], [0], [3]])
    kept = pharos.observe(pharos.make(str(folder)), "recorded", **options)(states)
    monkeypatch.setattr(recorded, "LARGEST_TABLE", 0)
    assert (pharos.observe(pharos.make(str(folder)), "recorded", **options)(states) == kept).all()


@pytest.mark.long
def test_frames_are_the_last_screens_of_an_episode(screens):
    shown, folder = screens
    env = pharos.GymEnv(str(folder), observation="recorded", observation_options={"frames": 3})
    seen, info = env.reset(seed=1)
    history = [shown[0]] * 3
    assert (seen == np.concatenate(history, axis=2)).all() and seen.shape == (24, 16, 9)
    for step in range(40):
        seen, _, terminated, truncated, info = env.step(step % 2)
        state = int(info["state"][0])
        history = [*history[1:], shown[state] if state < 4 else np.zeros_like(shown[0])]
        assert (seen == np.concatenate(history, axis=2)).all()
        if terminated or truncated:
            env.reset()
            history = [shown[0]] * 3


@pytest.mark.parametrize(
    ("shown", "options", "message"),
    [
        (np.zeros((4, 3)), {"grey": True}, "grey, size and frames are for recorded images"),
        (np.zeros((4, 3)), {"frames": 2}, "grey, size and frames are for recorded images"),
        (np.zeros((4, 5, 5, 3), np.uint8), {"size": 0}, "size is 0"),
        (np.zeros((4, 5, 5, 3), np.uint8), {"size": (5, 5, 5)}, "size is (5, 5, 5)"),
        (np.zeros((4, 5, 5, 3), np.uint8), {"size": "84"}, "size is '84'"),
        (np.zeros((4, 5, 5, 3), np.uint8), {"frames": 4}, "more than rows or columns"),
    ],
)
def test_options_for_images_are_refused_where_there_are_none(shown, options, message, tmp_path):
    folder = importers.save(in_every_form()["matrices"], tmp_path / "kept", observations=shown)
    assert message in refusal(ParameterError, pharos.observe, pharos.make(str(folder)), "recorded", **options)


@pytest.mark.long
def test_the_batched_engine_trains_on_stacked_grey_screens(screens):
    _, folder = screens
    result = pharos.train(
        "dqn",
        str(folder),
        steps=60,
        observation="recorded",
        observation_options={"grey": True, "size": 36, "frames": 2},
        hyperparameters={"learning_starts": 20, "buffer_size": 50},
    )
    assert np.isfinite(result.result["normalized_regret"])


def test_count_says_states_transitions_and_depth_and_keeps_nothing(folders, monkeypatch, tmp_path):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    for folder in folders.values():
        told = answer("count", folder)
        del told["seconds"], told["target"]
        expected = {"states": 4, "reachable_states": 3, "terminal_states": 1, "actions": 2, "transitions": 8}
        assert told.pop("compiling_seconds") >= 0
    assert told == {f"num_{name}": number for name, number in expected.items()} | {"depth": 1}
    assert run("count", folders["matrices"]).stdout.startswith(f"{folders['matrices']}: 4 states (1 terminal, 1 never")
    assert run("count", folders["matrices"], "--max-states", 3).exit_code == 1
    file = tmp_path / "nameless.npz"
    np.savez(file, transitions=np.array([[1, 0], [-1, 1]]), rewards=np.zeros((2, 2)))
    assert "2 states (0 terminal), 2 actions, 4 transitions, depth 1" in run("count", file).stdout


@pytest.mark.long
def test_count_of_an_environment_uses_the_cache_or_leaves_nothing_there(monkeypatch, tmp_path):
    kept = answer("build", "simple_grid")
    counted, folder = answer("count", "simple_grid"), answer("count", kept["folder"])
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    anew = answer("count", "simple_grid")
    assert counted["num_states"] == anew["num_states"] == folder["num_states"] == kept["num_states"] == 16
    assert counted["num_transitions"] == anew["num_transitions"] == 15 * 4
    assert not [path for path in tmp_path.iterdir() if path.name != "compiled"]
    assert run("count", "simple_grid", "--max-states", 3).exit_code == 1


@pytest.mark.long
def test_what_was_learnt_on_a_folder_is_evaluated_on_it(folders, tmp_path):
    learnt = answer("train", folders["matrices"], "--steps", 200, "--interval", 200, "--out", tmp_path / "run")
    assert learnt["config"]["environment"] == "imported"
    listed = answer("observations", folders["matrices"])["observations"]
    assert listed[-1]["observation"] == "recorded" and listed[-1]["num_observations"] == 4
    found = answer("evaluate", folders["matrices"], "--policy", tmp_path / "run")
    config = learnt["config"]  # the run's own setting, not that of the table
    assert (found["gamma"], found["horizon"]) == (config["gamma"], config["horizon"]) != (0.9, None)
    mdp = in_every_form()["matrices"].with_gamma(config["gamma"]).with_horizon(config["horizon"])
    assert found["optimal_value_at_start"] == pytest.approx(pharos.value_iteration(mdp).value_at_start, abs=2e-6)
    same = answer("evaluate", folders["matrices"], "--policy", tmp_path / "run", "--gamma", 1, "--horizon", 20)
    assert found["regret"] == pytest.approx(learnt["final_regret"], abs=4e-6)
    assert same["regret"] == pytest.approx(learnt["final_regret"], abs=4e-6)


@pytest.mark.long
def test_a_study_has_imported_worlds_beside_others(folders, tmp_path):
    worlds = [str(folders["matrices"]), "simple_grid"]
    runs = fake_training.specification("mixed", environments=worlds, seeds=1, steps=200).runs
    assert [each.config["environment"] for each in runs] == ["imported", "simple_grid"]
    assert runs[0].config["parameters"]["folder"] == str(folders["matrices"])
    (result, _) = training.train_configs([each.config for each in runs])
    assert result.result["exact"] and result.result["conventions"]["time_limit"] == 20


# From Gymnasium ------------------------------------------------------------------------------------------------------


class Coin(gymnasium.Env):
    """One state, two sides that pay 0 or 1; the table says how likely, the steps do what `heads` says."""

    action_space, observation_space = gymnasium.spaces.Discrete(1), gymnasium.spaces.Discrete(1)
    P = {0: {0: [(0.5, 0, 0.0, False), (0.5, 0, 1.0, False)]}}

    def __init__(self, heads=0.5):
        self.heads = heads

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, float(self.np_random.random() < self.heads), False, False, {}


def test_frequencies_that_are_not_those_of_the_table_are_refused():
    assert importers.gymnasium(Coin()).rewards == 0.5
    with pytest.raises(FileFormatError, match=r"in state 0, action 0 .* but its table P\[0\]\[0\] gives them 0.5, 0.5"):
        importers.gymnasium(Coin(heads=0.6))
    assert importers.gymnasium(Coin(heads=0.6), check=False).rewards == 0.5


@pytest.mark.long
def test_an_imported_world_pays_the_reward_of_the_outcome_that_is_drawn(tmp_path):
    """Gymnasium's slippery cliff walk from its start: -100 for slipping over the cliff, -1 for being stopped."""
    answer("import", "gymnasium", "CliffWalking-v1", "--option", "is_slippery=true", "--out", tmp_path)
    env, table = pharos.make(str(tmp_path)), gymnasium.make("CliffWalking-v1", is_slippery=True).unwrapped.P
    for s, action in ((36, 1), (36, 2), (13, 0), (46, 1)):
        law = Counter()
        for k in range(env.outcomes):
            following = env.next_state((s,), action, k)
            law[following[0], float(env.reward_of((s,), action, following, k))] += env.probability((s,), action, k)
        expected = Counter()
        for p, following, reward, ended in table[s][action]:
            expected[48 if ended else following, reward] += p
        assert {key: p for key, p in law.items() if p} == pytest.approx(dict(expected), abs=1e-12)
    mdp = importers.load(tmp_path)
    np.testing.assert_allclose(env.rewards[:48], mdp.rewards, rtol=0, atol=0)
    assert mdp.rewards[36, 1] == pytest.approx(-34)
    envs = pharos.make_vec(env, 3000, seed=0)
    envs.reset(seed=0)
    _, rewards, _, _, info = envs.step(np.ones(3000, np.int64))
    assert set(rewards[info["state"][:, 0] == 36]) == {-100.0, -1.0}


def test_outcomes_that_are_not_those_of_the_mdp_are_refused(tmp_path):
    lake = gymnasium.make("FrozenLake-v1")
    mdp, outcomes = importers.gymnasium(lake), importers.gymnasium_outcomes(lake)
    with pytest.raises(ParameterError, match="rewards of the MDP as their means"):
        importers.save(mdp, tmp_path / "a", outcomes=outcomes._replace(rewards=outcomes.rewards + 1))
    with pytest.raises(ParameterError, match="of each of 64 rows"):
        importers.save(mdp, tmp_path / "a", outcomes=outcomes._replace(offsets=outcomes.offsets[:-1]))
    assert importers.gymnasium_outcomes(gymnasium.make("FrozenLake-v1", is_slippery=False)) is None


def test_import_gymnasium_keeps_the_time_limit_and_refuses_what_has_no_table(tmp_path):
    done = run(
        "import", "gymnasium", "FrozenLake-v1", "--option", "is_slippery=false", "--out", tmp_path / "l", "--json"
    )
    assert json.loads(done.stdout)["num_states"] == 16
    assert pharos.make(str(tmp_path / "l")).max_episode_steps == 100
    done = run("import", "gymnasium", "Blackjack-v1", "--out", tmp_path / "b")
    assert done.exit_code == 1 and "pharos has it as `blackjack`" in done.stderr and "\n" not in done.stderr.strip()
    for words in (("Nothing-v9",), ("FrozenLake-v1", "--option", "snow=true")):
        done = run("import", "gymnasium", *words, "--out", tmp_path / "n")
        assert done.exit_code == 2 and "cannot make it" in done.stderr


def test_a_fickle_taxi_is_refused_by_name():
    env = gymnasium.make("Taxi-v4", fickle_passenger=True)
    with pytest.raises(FileFormatError, match=r"in state \d+, action \d led to state \d+.*`taxi fickle=true`"):
        importers.gymnasium(env)
