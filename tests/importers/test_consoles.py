"""Atari and Procgen as tables: BRIDGE's published tables, fresh episodes of the games, and the search by layers."""

import errno
import os
import signal
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import pharos
from command_line import answer, run
from patience import wait_for
from pharos import exporters, hardness, importers
from pharos.errors import FolderLocked, MissingExtra, ParameterError, StateSpaceTooLarge, UnknownName
from pharos.importers import consoles, layers
from pharos.system import storage
from refusals import failing, refusal
from toy_console import ToyConsole, naive_layers

BRIDGE = Path(__file__).parents[1] / "data" / "bridge"
TOY = {"game": "toy", "version": 1}


def explored(horizon, folder=None, *, make=ToyConsole, max_states=10_000, workers=1, settles=False, identity=TOY):
    return layers.explored(
        make, identity, horizon=horizon, max_states=max_states, folder=folder, workers=workers, settles=settles
    )


def parts(found):
    """All that an import keeps of layers, as bytes."""
    chunks = [found.screens.chunk(i) for i in range(found.screens.num_chunks)]
    return found.next_states.tobytes(), found.rewards.tobytes(), found.screens.index.tobytes(), chunks, found.sizes


@pytest.mark.parametrize("horizon", [1, 2, 6])
def test_layers_are_those_of_plain_python(horizon):
    found = explored(horizon)
    next_states, rewards, screens = naive_layers(horizon)
    assert (found.next_states == next_states).all() and (found.rewards == rewards).all()
    assert (found.screens[np.arange(len(screens))] == screens).all()
    assert sum(found.sizes) == len(next_states) and found.num_steps == rewards.size


@pytest.mark.long
def test_two_processes_share_a_layer_and_find_the_same():
    assert parts(explored(6, workers=2)) == parts(explored(6))


@pytest.mark.parametrize("broken_at", [0, 2, 4])
def test_a_search_that_was_interrupted_goes_on_from_its_last_layer(broken_at, monkeypatch, tmp_path):
    class Interrupted(Exception):
        pass

    expand = layers.Player.expand

    def interrupted(self, task, states):
        if task.depth == broken_at:
            raise Interrupted
        return expand(self, task, states)

    monkeypatch.setattr(layers.Player, "expand", interrupted)
    with pytest.raises(Interrupted):
        explored(6, tmp_path)
    monkeypatch.undo()
    resumed = explored(6, tmp_path)
    assert parts(resumed) == parts(explored(6))
    sizes = explored(6).sizes
    assert resumed.num_steps == 3 * sum(sizes[broken_at:])


def test_a_disk_that_is_full_leaves_the_layers_that_were_finished(monkeypatch, tmp_path):
    with monkeypatch.context() as disk, pytest.raises(OSError, match="No space left"):
        disk.setattr(os, "fsync", failing(errno.ENOSPC, 9, os.fsync))
        explored(6, tmp_path)
    stored = len(list(tmp_path.glob("layer-*.npz")))
    resumed, whole = explored(6, tmp_path), explored(6)
    assert parts(resumed) == parts(whole)
    assert 1 < stored < 5 and resumed.num_steps <= whole.num_steps - 3 * sum(whole.sizes[: stored - 1])


def test_layers_of_a_longer_horizon_serve_a_shorter_one(tmp_path):
    explored(7, tmp_path)
    for horizon in (5, 1):
        found = explored(horizon, tmp_path)
        assert parts(found) == parts(explored(horizon)) and found.num_steps == 0
    bonus = partial(ToyConsole, bonus=5.0)
    settled = explored(5, tmp_path, make=bonus, settles=True)
    assert parts(settled) == parts(explored(5, make=bonus, settles=True))
    last = np.arange(len(settled.next_states)) >= sum(settled.sizes[:-1])
    goes_on = naive_layers(6)[0][: len(last)] >= 0
    assert (settled.rewards - naive_layers(5)[1] == 5.0 * (last[:, None] & goes_on)).all()


def test_damaged_layers_are_searched_again_and_foreign_ones_refused(tmp_path):
    explored(6, tmp_path)
    file = tmp_path / "layer-00003.npz"
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    found = explored(6, tmp_path)
    assert parts(found) == parts(explored(6)) and found.num_steps == 3 * sum(found.sizes[3:])
    said = refusal(ParameterError, explored, 6, tmp_path, identity={**TOY, "version": 2})
    assert "holds layers of another import (version 1, now 2); delete it" in said
    with storage.lock(tmp_path):
        assert "importing" in refusal(FolderLocked, explored, 6, tmp_path)


def test_too_many_states_say_which_horizon_fits(tmp_path):
    sizes = explored(7).sizes
    most = sum(sizes[:4])
    said = refusal(StateSpaceTooLarge, explored, 7, tmp_path, max_states=most)
    assert f"toy: more than {most} states at depth 4" in said and f"layers: {', '.join(map(str, sizes[:4]))})" in said
    assert f"--horizon 4 fits, with {most} states" in said
    fits = explored(4, tmp_path, max_states=most)
    assert len(fits.next_states) == most and parts(fits) == parts(explored(4))


# Atari ----------------------------------------------------------------------------------------------------------------


def canonical(next_states, rewards):
    """Table and rewards, renumbered breadth first from state 0; and the states in that order."""
    order, place = [0], {0: 0}
    for state in order:
        for target in next_states[state].tolist():
            if target >= 0 and target not in place:
                place[target] = len(order)
                order.append(target)
    numbers = np.array([place.get(s, -1) for s in range(len(next_states))] + [-1])
    return numbers[next_states[order]].tolist(), rewards[order].tolist(), np.array(order)


def table_of(mdp):
    return np.asarray(mdp.dynamics.deterministic_table(), np.int64)


@pytest.fixture(scope="module")
def freeway(tmp_path_factory):
    pytest.importorskip("ale_py")
    out = tmp_path_factory.mktemp("atari") / "freeway"
    return answer("import", "atari", "freeway", "--out", out), out


@pytest.mark.long
def test_freeway_is_the_published_table_of_bridge(freeway, tmp_path):
    said, out = freeway
    assert (said["num_states"], said["num_raw_states"], said["num_merged_states"]) == (197, 399, 202)
    assert said["layers"] == [1, 3, 5, 8, 14, 20, 42, 70, 93, 143] and said["num_distinct_observations"] == 175
    mdp, published = importers.load(out), importers.bridge(BRIDGE / "freeway_10_fs30.npz")
    ours, theirs = (canonical(table_of(each), each.rewards) for each in (mdp, published))
    assert len(ours[0]) == 197 and ours[:2] == theirs[:2]
    assert hardness.effective_horizon(mdp).value == 8
    file = exporters.bridge(mdp, tmp_path / "freeway_10_fs30.npz")
    written = importers.bridge(file)
    assert canonical(table_of(written), written.rewards)[:2] == theirs[:2]
    screens = importers.bridge_screens(file)
    assert (screens == pharos.make(str(out)).recorded[np.arange(197)]).all()
    assert not (out / ".building").exists()


@pytest.mark.long
@pytest.mark.parametrize("game", ["freeway", "pong", "breakout"])
def test_fresh_episodes_of_a_game_walk_through_its_table(game):
    """The game is played here through Gymnasium's environment of ale-py, without any saved state."""
    pytest.importorskip("ale_py")
    import ale_py
    import gymnasium

    gymnasium.register_envs(ale_py)
    mdp, recording = importers.atari(game, horizon=4, frame_skip=15)
    title = "".join(word.title() for word in game.split("_"))
    env = gymnasium.make(f"ALE/{title}-v5", frameskip=15, repeat_action_probability=0.0)
    table, rng = table_of(mdp), np.random.default_rng(0)
    assert [name.lower() for name in env.unwrapped.get_action_meanings()] == list(recording.actions)
    for _ in range(20):
        screen, info = env.reset(seed=0)
        state, lives = 0, info["lives"]
        for step in range(4):
            assert (recording.observations[state] == screen).all()
            action = int(rng.integers(mdp.num_actions))
            screen, reward, terminated, _, info = env.step(action)
            assert mdp.rewards[state, action] == reward
            state = table[state, action]
            if state < 0:
                assert terminated or info["lives"] < lives or step == 3
                break
            assert not terminated and info["lives"] == lives
    env.close()


@pytest.mark.slow
def test_raw_imports_keep_what_merging_would_merge():
    pytest.importorskip("ale_py")
    raw, recording = importers.atari("freeway", horizon=5, frame_skip=4, raw=True)
    merged, others = importers.atari("freeway", horizon=5, frame_skip=4)
    assert raw.num_states == recording.num_raw_states == sum(recording.layers) > merged.num_states
    again = pharos.mdp.minimize(raw, observations=recording.observations[np.arange(raw.num_states)])
    assert (table_of(again.mdp) == table_of(merged)).all() and (again.mdp.rewards == merged.rewards).all()
    assert (recording.observations[again.representatives] == others.observations[np.arange(merged.num_states)]).all()


@pytest.mark.long
def test_options_change_the_game_as_they_say():
    pytest.importorskip("ale_py")
    _, recording = importers.atari("freeway", horizon=1, frame_skip=4)
    _, later = importers.atari("freeway", horizon=1, frame_skip=4, noops=4)
    step = importers.atari("freeway", horizon=2, frame_skip=4, raw=True)[1].observations
    assert (later.observations[0] == step[1]).all() and (later.observations[0] != recording.observations[0]).any()
    assert importers.atari("freeway", horizon=1, frame_skip=1, all_actions=True)[0].num_actions == 18
    console = consoles.AtariGame("breakout", 30)
    state, lives, steps = console.load(console.start()), console.ale.lives(), 0
    ends = False
    while not ends and steps < 40:  # fire, then stand still
        _, ends = console.step(state, 1 if steps == 0 else 0)
        state, steps = console.load(console.save()), steps + 1
    assert ends and console.ale.lives() == lives - 1 and not console.ale.game_over()
    assert not consoles.AtariGame("breakout", 30, life_loss_ends=False).step(state, 0)[1]


@pytest.mark.long
def test_two_processes_and_a_kill_change_nothing_of_a_folder(tmp_path):
    pytest.importorskip("ale_py")
    words = ["import", "atari", "freeway", "--horizon", "5", "--frame-skip", "4"]
    answer(*words, "--out", tmp_path / "one")
    answer(*words, "--out", tmp_path / "two", "--workers", 2)
    manifests = [storage.read_json(tmp_path / name / "manifest.json") for name in ("one", "two")]
    assert manifests[0] == manifests[1]


@pytest.mark.long
def test_a_killed_import_is_resumed_by_the_same_command(tmp_path):
    pytest.importorskip("ale_py")
    words = ["import", "atari", "freeway", "--horizon", "7", "--out", str(tmp_path / "killed")]
    process = subprocess.Popen([sys.executable, "-m", "pharos", *words], env=os.environ)
    wait_for((tmp_path / "killed" / ".building" / "layer-00002.npz").exists, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    answer(*words)
    answer(*words[:-1], tmp_path / "whole")
    kept, whole = (storage.read_json(tmp_path / name / "manifest.json") for name in ("killed", "whole"))
    assert kept == whole


def test_names_of_games_are_those_of_roms_or_of_gymnasium():
    pytest.importorskip("ale_py")
    assert [consoles.rom_name(each) for each in ("pong", "MsPacman", "ALE/MontezumaRevenge-v5")] == [
        "pong",
        "ms_pacman",
        "montezuma_revenge",
    ]
    assert "did you mean 'pacman'?" in refusal(UnknownName, importers.atari, "pacman2")
    done = run("import", "atari", "frewway", "--out", "nowhere")
    assert done.exit_code == 2 and "did you mean 'freeway'?" in done.stderr and not Path("nowhere").exists()


def test_a_rom_that_is_not_there_and_a_package_that_is_not_are_one_line(monkeypatch, tmp_path):
    ale_py = pytest.importorskip("ale_py")
    monkeypatch.setattr(ale_py.roms, "get_rom_path", lambda name: None)
    assert "brings no ROM of it" in refusal(ParameterError, importers.atari, "pong")
    monkeypatch.setitem(sys.modules, "ale_py", None)
    assert "pharos-rl[atari]" in refusal(MissingExtra, importers.atari, "pong")
    monkeypatch.setitem(sys.modules, "procgen", None)
    assert "pip install --no-deps procgen-mirror==0.10.7" in refusal(ParameterError, importers.procgen, "maze")
    parts_missing = SimpleNamespace(ProcgenGym3Env=failing(ModuleNotFoundError("No module named 'pycparser'")))
    monkeypatch.setitem(sys.modules, "procgen", parts_missing)
    assert "(No module named 'pycparser')" in refusal(ParameterError, importers.procgen, "maze")


@pytest.mark.parametrize(
    ("function", "options", "message"),
    [
        ("atari", {"horizon": 0}, "atari: horizon is 0"),
        ("atari", {"frame_skip": 1.5}, "atari: frame_skip is 1.5"),
        ("atari", {"noops": -1}, "atari: noops is -1"),
        ("procgen", {"level": -1}, "procgen: level is -1"),
        ("procgen", {"mode": "esay"}, "did you mean 'easy'?"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_loaded(function, options, message):
    game = {"atari": "pong", "procgen": "maze"}[function]
    assert message in refusal(ParameterError, getattr(importers, function), game, **options)


@pytest.mark.slow
def test_no_ops_that_end_the_game_are_refused():
    pytest.importorskip("ale_py")
    assert "ends after" in refusal(ParameterError, importers.atari, "skiing", horizon=1, frame_skip=1, noops=10_000)


def test_a_folder_with_something_else_is_refused_before_the_game_is_played(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    assert "is not empty" in refusal(ParameterError, consoles.building_folder, tmp_path)


# Procgen --------------------------------------------------------------------------------------------------------------


class StoredMaze:
    """The published table of a maze, with the interface of Procgen."""

    def __init__(self, **options):
        assert options["env_name"] == "maze" and options["start_level"] == 0 and options["num_levels"] == 1
        with np.load(BRIDGE / "maze_easy_l0_30_fs1.npz") as file:
            self.table, self.rewards = file["transitions"], file["rewards"]
        self.state, self.paid = 0, 0.0

    def callmethod(self, name, *values):
        if name == "get_state":
            return [self.state.to_bytes(4, "little")]
        self.state = int.from_bytes(values[0][0], "little")
        return None

    def act(self, actions):
        action = int(actions[0])
        self.paid, self.state = self.rewards[self.state, action], int(self.table[self.state, action])

    def observe(self):
        picture = np.full((1, 2, 2, 3), max(self.state, 0) % 256, np.uint8)
        picture[..., 0] = max(self.state, 0) // 256
        return [self.paid], {"rgb": picture}, [self.state < 0]


def test_a_stored_maze_played_as_procgen_is_gives_its_table_again(monkeypatch):
    monkeypatch.setitem(sys.modules, "procgen", SimpleNamespace(ProcgenGym3Env=StoredMaze))
    mdp, recording = importers.procgen("maze", level=0, mode="easy", horizon=30)
    published = importers.bridge(BRIDGE / "maze_easy_l0_30_fs1.npz")
    ours, theirs = (canonical(table_of(each), each.rewards) for each in (mdp, published))
    assert len(ours[0]) == 243 and ours[:2] == theirs[:2]
    assert recording.num_raw_states == recording.observations.num_distinct == 243
    skipped, _ = importers.procgen("maze", horizon=3, frame_skip=2, raw=True)
    for action in range(9):  # held for two steps, or until the end
        state, total = 0, 0.0
        for _ in range(2):
            if state >= 0:
                total += published.rewards[state, action]
                state = table_of(published)[state, action]
        assert skipped.rewards[0, action] == total and (table_of(skipped)[0, action] < 0) == (state < 0)


@pytest.mark.long
def test_a_maze_is_the_published_table_of_bridge():
    """If Procgen is installed; see the stored maze otherwise."""
    pytest.importorskip("procgen")
    mdp, recording = importers.procgen("maze", level=0, mode="easy", horizon=30)
    published = importers.bridge(BRIDGE / "maze_easy_l0_30_fs1.npz")
    ours, theirs = (canonical(table_of(each), each.rewards) for each in (mdp, published))
    assert len(ours[0]) == 243 and ours[:2] == theirs[:2]
    assert len(recording.actions) == 9
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from procgen import ProcgenGym3Env
    rng = np.random.default_rng(0)
    options = {"distribution_mode": "easy", "start_level": 0, "num_levels": 1, "rand_seed": 0, "num_threads": 0}
    for _ in range(20):
        env, state = ProcgenGym3Env(num=1, env_name="maze", **options), 0
        for step in range(30):
            assert (env.observe()[1]["rgb"][0] == recording.observations[state]).all()
            action = int(rng.integers(9))
            env.act(np.array([action]))
            reward, _, is_first = env.observe()
            assert reward[0] == mdp.rewards[state, action]
            state = table_of(mdp)[state, action]
            assert (state < 0) == bool(is_first[0]) or step == 29
            if state < 0:
                break
