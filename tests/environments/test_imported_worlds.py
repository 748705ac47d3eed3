"""Imported MDPs as environments: what is true of the table is true of what is stepped, trained on, drawn and built."""

import json
from collections import Counter

import gymnasium
import numpy as np
import pytest

import fake_training
import pharos
from command_line import answer, run
from pharos import drawing, importers, training
from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import TabularMDP
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
