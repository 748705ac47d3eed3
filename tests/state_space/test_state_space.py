"""build, load and StateSpace: Algorithm 1, its files, and what can go wrong."""

import importlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import pharos
from children import exit_code
from naive import builder as naive_builder
from pharos.environments import Environment
from pharos.errors import (
    ParameterError,
    RuleError,
    StateSpaceCorrupted,
    StateSpaceError,
    StateSpaceMismatch,
    StateSpaceTooLarge,
)
from refusals import refusal
from strategies import examples
from worlds import Row, TableWorld, table_worlds

building = importlib.import_module("pharos.state_space.build")
search = importlib.import_module("pharos.state_space.search")

SMALL = (
    pharos.make("simple_grid", height=5, width=3, penalties=(((1, 1), -1.0),)),
    pharos.make("simple_grid/8x8-decoy"),
    pharos.make("breakout", height=6, columns=4),
    pharos.make("breakout", height=6, columns=4, brick_rows=1, extra_paddle_width=1),
    pharos.make("breakout", height=5, columns=5, brick_rows=1, respawn=False),
)


@pytest.fixture
def folder(tmp_path) -> Path:
    return tmp_path / "space"


def build(env: Environment, folder: Path, **options) -> pharos.StateSpace:
    return pharos.build(env, folder, **{"progress": False, **options})


def assert_equals_naive(space, env):
    naive = naive_builder.build(env)
    assert [tuple(state) for state in space.states().tolist()] == naive.states
    assert space.successors.tolist() == naive.successors
    assert space.terminal.tolist() == naive.terminal
    assert space.num_terminal_states == sum(naive.terminal)
    assert space.depth == naive.depth
    assert space.start_states.tolist() == list(range(len(naive.start_probabilities)))
    assert space.start_probabilities.tolist() == naive.start_probabilities


@pytest.mark.parametrize("env", SMALL, ids=str)
def test_build_numbers_states_as_algorithm_1_does(env, folder):
    assert_equals_naive(build(env, folder), env)


@pytest.mark.slow
@examples(60, table_worlds())
def test_build_agrees_with_algorithm_1_on_random_environments(env):
    with tempfile.TemporaryDirectory() as folder:
        space = build(env, Path(folder) / "space")
        assert_equals_naive(space, env)
        indices = np.arange(space.num_states)
        assert space.indices(space.states()).tolist() == indices.tolist()


def test_a_state_of_several_words_is_found_by_every_one_of_them(folder):
    env = TableWorld(num_positions=50, lows="0,0,0", sizes=f"{2**62},{2**62},2", seed=4)
    space = build(env, folder)
    assert space.layout.num_words == 4
    for i in range(space.num_states):
        state = space.state(i)
        assert space.index(state) == i
        for component in (1, 2):
            other = list(state)
            other[component] ^= 1
            assert "not reachable" in refusal(ParameterError, space.index, other)


# StateSpace ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def breakout(tmp_path_factory) -> pharos.StateSpace:
    return build(pharos.make("breakout", height=6, columns=4), tmp_path_factory.mktemp("breakout") / "space")


def test_load_gives_back_what_build_gave(breakout):
    loaded = pharos.load(breakout.folder)
    assert loaded.environment == breakout.environment
    assert loaded.parameters == breakout.environment.parameters
    assert (loaded.num_states, loaded.num_actions, loaded.depth) == (4620, 3, breakout.depth)
    assert (loaded.successors == breakout.successors).all()
    assert (loaded.states() == breakout.states()).all()


def test_a_finished_folder_is_loaded_and_not_built_again(breakout, monkeypatch):
    monkeypatch.setattr(search, "Search", None)
    again = build(breakout.environment, breakout.folder)
    assert (again.successors == breakout.successors).all()


def test_index_is_the_inverse_of_state(breakout):
    for i in (0, 1, 777, breakout.num_states - 1):
        state = breakout.state(i)
        assert isinstance(state, tuple) and all(type(value) is int for value in state)
        assert breakout.index(state) == i
        assert breakout.is_terminal(i) is bool(breakout.environment.is_terminal(state))


@pytest.mark.parametrize("i", (-1, 4620))
def test_there_is_no_state_beyond_the_last(breakout, i):
    for method in (breakout.state, breakout.is_terminal):
        assert "does not exist; expected 0 to 4619" in refusal(ParameterError, method, i)


def test_states_that_are_none_of_the_space_are_refused(breakout):
    state = list(breakout.state(0))
    known = set(map(tuple, breakout.states().tolist()))
    unreachable = next(s for s in ((row, *state[1:]) for row in range(6)) if s not in known)
    for wrong, why in (
        ([99, *state[1:]], "is not reachable"),
        ([-1, *state[1:]], "is not reachable"),
        ([state[0] + 0.5, *state[1:]], "integers"),
        (state[:-1], "has 13 components"),
        (unreachable, "is not reachable"),
    ):
        assert why in refusal(ParameterError, breakout.index, wrong)


def test_components_are_named(breakout):
    assert breakout.component_names[:6] == (
        "ball_row",
        "ball_column",
        "ball_goes_right",
        "ball_goes_down",
        "paddle",
        "bricks[0,0]",
    )


def test_without_a_folder_the_users_cache_is_used(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    env = pharos.make("simple_grid")
    space = pharos.build(env, progress=False)
    assert space.folder.parent == tmp_path / "spaces"
    monkeypatch.setattr(search, "Search", None)
    assert pharos.build(env).folder == space.folder
    other = building.cached_folder(pharos.make("simple_grid", height=5))
    assert other != space.folder


def test_a_callback_hears_of_the_end(folder):
    heard = []
    build(pharos.make("breakout", height=6, columns=4), folder, progress=heard.append)
    assert (heard[-1].num_states, heard[-1].num_expanded, heard[-1].depth) == (4620, 4620, 93)
    assert [done.finished for done in heard] == [False] * (len(heard) - 1) + [True]


# Folders -------------------------------------------------------------------------------------------------------------


GRID = pharos.make("simple_grid", height=6, width=7)


def test_a_folder_with_other_things_in_it_is_refused(folder):
    folder.mkdir()
    (folder / "thesis.tex").write_text("mine")
    with pytest.raises(ParameterError, match="is not empty and holds no state space; choose another folder"):
        build(GRID, folder)
    assert [path.name for path in folder.iterdir()] == ["thesis.tex"]


def test_a_file_is_no_folder(folder):
    folder.write_text("mine")
    for path in (folder, folder / "inside"):
        assert "folder" in refusal(ParameterError, build, GRID, path)
    assert folder.read_text() == "mine"


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path):
    def attempt():
        os.umask(0o022)
        if os.geteuid() == 0:
            os.seteuid(65534)
        try:
            build(GRID, tmp_path / "closed")
        except ParameterError as error:
            os._exit(7 if "cannot be written to: Permission denied" in str(error) else 1)
        os._exit(0)

    build(GRID, tmp_path / "compiled")  # so that the child compiles nothing
    for folder in (tmp_path, *tmp_path.parents[: len(tmp_path.relative_to(tempfile.gettempdir()).parts)]):
        folder.chmod(0o755)
    (tmp_path / "closed").mkdir(mode=0o555)
    assert exit_code(attempt) == 7


def test_nothing_to_load(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        assert "no state space there" in refusal(StateSpaceError, pharos.load, path)


@pytest.mark.parametrize("name", ("states.bin", "successors.bin", "terminal.bin"))
def test_a_flipped_bit_is_found(name, folder):
    build(GRID, folder)
    content = bytearray((folder / name).read_bytes())
    content[len(content) // 2] ^= 4
    (folder / name).write_bytes(content)
    for attempt in (pharos.load, lambda path: build(GRID, path)):
        with pytest.raises(StateSpaceCorrupted, match=rf"{name}: block 0 .* does not match its checksum"):
            attempt(folder)


@pytest.mark.parametrize("name", ("states.bin", "successors.bin", "terminal.bin"))
@pytest.mark.parametrize("how", ("truncated", "extended", "removed"))
def test_a_file_of_another_length_is_found(name, how, folder):
    build(GRID, folder)
    content = (folder / name).read_bytes()
    if how == "removed":
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(content[:-1] if how == "truncated" else content + b"\0")
    for attempt in (pharos.load, lambda path: build(GRID, path)):
        assert f"{name}: expected {len(content)} bytes, found" in refusal(StateSpaceCorrupted, attempt, folder)


@pytest.mark.parametrize("name", ("states.bin", "successors.bin", "terminal.bin"))
def test_a_resumed_build_finds_a_flipped_bit(name, folder, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 8)
    with pytest.raises(StateSpaceTooLarge):
        build(GRID, folder, max_states=30)
    content = bytearray((folder / name).read_bytes())
    content[0] ^= 4
    (folder / name).write_bytes(content)
    assert f"{name}: does not match" in refusal(StateSpaceCorrupted, build, GRID, folder)


def test_a_resumed_build_finds_a_truncated_file(folder, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 8)
    with pytest.raises(StateSpaceTooLarge):
        build(GRID, folder, max_states=30)
    (folder / "successors.bin").write_bytes((folder / "successors.bin").read_bytes()[:-1])
    with pytest.raises(StateSpaceCorrupted, match=r"successors\.bin: expected \d+ bytes, found"):
        build(GRID, folder)


@pytest.mark.parametrize(
    "change",
    (
        lambda text: text.replace('"num_states": 42', '"num_states": 41'),
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[]",
        lambda text: "{}",
        lambda text: '{"format": "pharos state space", "format_version": 1}',
    ),
)
def test_a_changed_manifest_is_found(change, folder):
    build(GRID, folder)
    text = (folder / "manifest.json").read_text()
    assert change(text) != text
    (folder / "manifest.json").write_text(change(text))
    for attempt in (pharos.load, lambda path: build(GRID, path)):
        with pytest.raises(StateSpaceCorrupted, match=r"manifest\.json: .*; delete the folder and build again"):
            attempt(folder)


def test_a_manifest_that_is_no_text_is_found(folder):
    build(GRID, folder)
    (folder / "manifest.json").write_bytes(b"\xff\xfe\x00")
    assert "cannot be read" in refusal(StateSpaceCorrupted, pharos.load, folder)


def test_a_folder_of_another_format_version_is_refused(folder):
    build(GRID, folder)
    text = (folder / "manifest.json").read_text()
    (folder / "manifest.json").write_text(text.replace('"format_version": 1', '"format_version": 4'))
    assert "format version 4; this pharos reads versions 1 to 3" in refusal(StateSpaceMismatch, pharos.load, folder)


def test_a_folder_of_other_parameters_is_refused(folder):
    build(GRID, folder)
    for env in (pharos.make("simple_grid", height=7, width=6), pharos.make("breakout", height=6, columns=4)):
        assert "choose another folder, or delete this one" in refusal(StateSpaceMismatch, build, env, folder)
    assert pharos.load(folder).environment == GRID


class Walk(Row):
    """A walk along `length` cells; a base for environments that break the contract."""

    name = "walk"

    def reward(self, state, action, next_state):
        return float(next_state[0])


class RaisedVersion(Walk):
    version = 2


class OtherRules(Walk):
    def transition(self, state, action, out):
        out[0] = min(max(state[0] + 2 * action - 1, 0), self.length - 2)


class OtherEnd(Walk):
    def is_terminal(self, state):
        return state[0] == self.length - 1


@pytest.mark.long
def test_a_folder_of_another_version_of_the_rules_is_refused(folder):
    build(Walk(), folder)
    assert "with rules_version = 1; expected 2" in refusal(StateSpaceMismatch, build, RaisedVersion(), folder)


@pytest.mark.long
@pytest.mark.parametrize("other", (OtherRules(), OtherEnd()), ids=lambda env: type(env).__name__)
def test_a_folder_of_other_rules_is_refused_even_with_the_same_version(other, folder):
    build(Walk(), folder)
    with pytest.raises(StateSpaceMismatch, match=r"was built with other rules: from state .* raise `version`"):
        build(other, folder)


@dataclass(frozen=True, kw_only=True)
class OneOtherState(Walk):
    """The same rules, but for one state."""

    changed: int = 0

    @property
    def parameters(self):
        return {"length": self.length}

    def transition(self, state, action, out):
        out[0] = min(max(state[0] + 2 * action - 1, 0), self.length - 1) if state[0] != self.changed else 0


@pytest.mark.parametrize("sample", (1, 2, 31, 62))
def test_each_of_64_states_spread_over_the_file_is_checked(sample, folder):
    build(Walk(), folder)
    state = int(np.linspace(0, 999, 64)[sample])
    with pytest.raises(StateSpaceMismatch, match=rf"was built with other rules: from state \({state},\) they lead to"):
        pharos.load(folder, environment=OneOtherState(changed=state))


@pytest.mark.slow
def test_a_build_is_not_resumed_with_other_rules(folder, monkeypatch):
    class OtherStart(Walk):
        def transition(self, state, action, out):
            out[0] = min(max(state[0] + 3 * action - 1, 0), self.length - 1)

    monkeypatch.setattr(search, "CHUNK", 8)
    with pytest.raises(StateSpaceTooLarge):
        build(Walk(), folder, max_states=100)
    assert "was built with other rules" in refusal(StateSpaceMismatch, build, OtherStart(), folder)
    assert build(Walk(), folder).num_states == 1000


def test_edited_rules_get_another_folder_in_the_cache():
    folders = {
        building.cached_folder(env) for env in (Walk(), RaisedVersion(), OtherRules(), OtherEnd(), Walk(length=7))
    }
    assert len(folders) == 5


def test_a_space_of_an_unknown_class_can_be_loaded_and_takes_rewards_as_an_array(folder):
    build(Walk(length=5), folder)
    space = pharos.load(folder)
    assert space.environment is None
    assert space.parameters == {"length": 5}
    assert [space.state(i) for i in range(5)] == [(0,), (1,), (2,), (3,), (4,)]
    assert "pharos does not know the class 'walk'" in refusal(StateSpaceError, space.mdp)
    assert space.mdp(rewards=np.ones((5, 2))).rewards.sum() == 10


@pytest.mark.parametrize(
    ("options", "expected"),
    (
        ({"max_states": 0}, "max_states is 0; expected at least 1"),
        ({"memory": 1000}, "memory is 1000 bytes; expected at least 16 MiB"),
        ({"workers": 0}, "workers is 0; expected at least 1"),
    ),
)
def test_options_out_of_range_are_refused(options, expected, folder):
    assert expected in refusal(ParameterError, build, GRID, folder, **options)


# Rules that break the contract ---------------------------------------------------------------------------------------


class LeavesItsRange(Walk):
    def transition(self, state, action, out):
        out[0] = state[0] + 2 * action - 1 if state[0] > 0 else 1


class ReadsBeyondItsState(Walk):
    def transition(self, state, action, out):
        out[0] = min(max(state[0] + 2 * action - 1, 0), self.length - 1) + (state[3] if state[0] == 700 else 0)


class WritesBeyondItsState(Walk):
    def transition(self, state, action, out):
        out[0 if state[0] < 700 else 1] = min(max(state[0] + 2 * action - 1, 0), self.length - 1)


class EndsBeyondItsState(Walk):
    def is_terminal(self, state):
        return state[0] == 700 and state[1] == 0


class DividesByZero(Walk):
    def transition(self, state, action, out):
        out[0] = min(state[0] + 1 + 0 // (700 - state[0]), self.length - 1)


@pytest.mark.long
@pytest.mark.parametrize("workers", (1, 2))
@pytest.mark.parametrize("wide", (1, 1 << 13))
@pytest.mark.parametrize(
    ("env", "expected"),
    (
        (LeavesItsRange(), "action 'right' in state (999,) leads to cell = 1000; declared: 0 to 999"),
        (ReadsBeyondItsState(), "in state (700,) by action 'left' a rule raises IndexError"),
        (WritesBeyondItsState(), "in state (700,) by action 'left' a rule raises IndexError"),
        (EndsBeyondItsState(), "in state (700,) a rule raises IndexError"),
        (DividesByZero(), "in state (700,) by action 'left' a rule raises ZeroDivisionError"),
    ),
    ids=lambda value: type(value).__name__,
)
def test_a_rule_that_breaks_the_contract_is_named_with_state_and_action(
    env, expected, workers, wide, folder, monkeypatch
):
    monkeypatch.setattr(search, "WIDE_FOR_THREADS", wide)
    assert expected in refusal(RuleError, build, env, folder, workers=workers)


class WritesToItsState(Walk):
    def transition(self, state, action, out):
        state[0] = min(max(state[0] + 2 * action - 1, 0), self.length - 1)


@pytest.mark.long
def test_a_rule_that_writes_to_the_state_is_neither_compiled_nor_interpreted(folder):
    with (
        pytest.warns(RuntimeWarning, match="WritesToItsState: Numba cannot compile its rules"),
        pytest.raises(RuleError, match=r"in state \(0,\) by action 'left' a rule raises TypeError"),
    ):
        build(WritesToItsState(), folder)


def test_what_was_found_before_a_rule_failed_is_kept(folder, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 64)
    with pytest.raises(RuleError):
        build(DividesByZero(), folder)
    assert building.read_manifest(folder)["num_expanded"] == 640
    assert "in state (700,)" in refusal(RuleError, build, DividesByZero(), folder)


# Rewards -------------------------------------------------------------------------------------------------------------


def test_rewards_are_those_of_the_stored_transitions(breakout):
    rewards = breakout.mdp().rewards
    for i in range(0, breakout.num_states, 97):
        for action in range(3):
            following = breakout.state(int(breakout.successors[i, action]))
            expected = (
                0.0 if breakout.terminal[i] else breakout.environment.reward(breakout.state(i), action, following)
            )
            assert rewards[i, action] == expected


@pytest.mark.slow
def test_rewards_are_replaced_without_a_new_build(breakout, monkeypatch):
    monkeypatch.setattr(search, "Search", None)

    def only_the_second_action(self, state, action, next_state):
        return 2.5 * (action == 1) + (0 if next_state[0] else 1)

    mdp = breakout.mdp(gamma=0.9, rewards=only_the_second_action)
    going = ~breakout.terminal
    top = breakout.states(breakout.successors.ravel())[:, 0].reshape(mdp.rewards.shape) == 0
    assert (mdp.rewards[going] == np.array([0, 2.5, 0]) + top[going]).all()
    assert (mdp.rewards[breakout.terminal] == 0).all()
    array = np.random.default_rng(0).normal(size=(4620, 3))
    assert (breakout.mdp(rewards=array).rewards[going] == array[going]).all()
    assert breakout.mdp().rewards.sum() == pharos.load(breakout.folder).mdp().rewards.sum()


def test_rewards_of_the_wrong_shape_are_refused(breakout):
    with pytest.raises(ParameterError, match=r"rewards have shape \(4620,\); expected \(4620, 3\)"):
        breakout.mdp(rewards=np.zeros(4620))
    with pytest.raises(ParameterError, match=r"takes \(self, state, action, next_state\); found \(state, action\)"):
        breakout.mdp(rewards=lambda state, action: 0.0)


class PaysNothingWithoutLength(Walk):
    def reward(self, state, action, next_state):
        return np.nan if state[0] == 70 and action == 1 else 1.0


class PaysAPosition(Walk):
    def reward(self, state, action, next_state):
        return 1.0 / np.float64(state[0] - 70)


@pytest.mark.slow
@pytest.mark.parametrize("env", (PaysNothingWithoutLength(), PaysAPosition()), ids=lambda env: type(env).__name__)
def test_a_reward_that_is_no_number_is_refused_with_its_transition(env, folder):
    with pytest.raises(RuleError, match=r"reward of action '(left|right)' in state \(70,\) is (nan|inf)"):
        build(env, folder).mdp()
