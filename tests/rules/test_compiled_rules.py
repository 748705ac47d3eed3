"""Compiled rules: what Numba compiles, the private cache of machine code, damage, and many actions."""

import hashlib
import itertools
import os
import pickle
import shutil
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import pharos
from pharos.hardness import diameter
from pharos.interaction.gym_env import GymEnv
from pharos.interaction.vector_env import make_vec
from pharos.rules import reason_of
from pharos.rules.compiled import exploration_kernels, interaction_kernels
from pharos.rules.compiler import numeric_attributes
from pharos.rules.exploration import no_ages
from pharos.system.compiling import private_folder
from worlds import Corridor


def corridor_class(**rules):
    """A class of its own, with the same rules as the others: what one process compiled, the next finds."""
    return dataclass(frozen=True, kw_only=True)(type("Corridor", (Corridor,), rules))


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def files_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*.nb[ci]")}


def build_and_step(folder):
    env = corridor_class()()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        space = pharos.build(env, folder)
        gym = GymEnv(env)
        gym.reset(seed=0)
        gym.step(1)
        space.mdp()
    return space


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A cache that a build, a step and an MDP filled."""
    folder = tmp_path_factory.mktemp("filled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PHAROS_CACHE_DIR", str(folder / "cache"))
        build_and_step(folder / "space")
    return folder / "cache"


@pytest.mark.long
def test_a_truth_is_a_reward(cache, filled, tmp_path):
    shutil.copytree(filled, cache)
    env = corridor_class()()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert pharos.check_environment(env).compiled
        space = pharos.build(env, tmp_path / "space")
    assert space.mdp().rewards[3].tolist() == [0.0, 1.0]


def test_the_reason_names_the_signature_that_is_missing():
    message = (
        "Failed in nopython mode pipeline (step: nopython frontend)\n"
        "No implementation of function Function(<class 'float'>) found for signature:\n \n >>> float(unicode_type)\n \n"
        'There are 2 candidates\n\nFile "coins.py", line 12:\n'
    )
    assert "found for signature: float(unicode_type)" in reason_of(ValueError(message))
    assert '(File "coins.py", line 12)' in reason_of(ValueError(message))
    coloured = "\x1b[1m\x1b[1mFailed in nopython mode pipeline\x1b[0m\n\x1b[1m\x1b[31m" + message + "\x1b[0m"
    assert reason_of(ValueError(coloured)) == reason_of(ValueError(message))


@pytest.mark.long
def test_rules_that_mention_a_private_attribute_run_interpreted(cache, tmp_path):
    def reward(self, state, action, next_state):
        return 1.0 + self._bonus

    env = corridor_class(reward=reward, _bonus=0.5)()
    space = pharos.build(env, tmp_path / "space")
    with pytest.warns(RuntimeWarning, match="Corridor: Numba cannot compile its rules.*_bonus"):
        assert space.mdp().rewards[0].tolist() == [1.5, 1.5]


@pytest.mark.long
@pytest.mark.parametrize("outcomes", [pytest.param(1, marks=pytest.mark.long), 2])
def test_what_numba_says_of_a_rule_is_the_reason(cache, tmp_path, outcomes):
    """A parameter that is a word is not handed to compiled rules."""

    def transition(self, state, action, *rest):
        rest[-1][0] = min(state[0] + self.word.count("o"), 4)

    def probability(self, state, action, outcome):
        return 0.5

    parts = {"probability": probability, "outcomes": 2} if outcomes == 2 else {}
    env = corridor_class(transition=transition, word="no", **parts)()
    with pytest.warns(RuntimeWarning, match="Corridor: Numba cannot compile its rules.*word"):
        assert pharos.build(env, tmp_path / "space").num_states == 5


# The cache -----------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_damaged_files_are_compiled_again(cache, filled, tmp_path):
    shutil.copytree(filled, cache)
    before = files_of(cache)
    ways = (lambda data: b"", lambda data: data[: len(data) // 2], lambda data: data[:-1] + b"x")
    damaged = {path: damage(before[path]) for path, damage in zip(sorted(before), itertools.cycle(ways), strict=False)}
    assert len(damaged) == len(before) >= len(ways)
    for path, data in damaged.items():
        path.write_bytes(data)
    space = build_and_step(tmp_path / "second")
    assert space.num_states == 5
    after = files_of(cache)
    assert set(after) == set(before)
    for path, data in after.items():
        assert data != damaged[path], "it is still the damaged one"
    build_and_step(tmp_path / "third")
    assert files_of(cache) == after, "what was mended is read"


@pytest.mark.long
def test_the_folder_of_compiled_rules_is_private(filled):
    assert (filled / "compiled").stat().st_mode & 0o777 == 0o700


def test_kernels_do_not_depend_on_rules_that_they_do_not_call():
    def places(cls=None, **rules):
        cls = cls or corridor_class(**rules)
        names = numeric_attributes(cls())[0]
        explored, played = exploration_kernels(cls, names, 1, 2), interaction_kernels(cls, names, 2)
        kernels = {**explored._asdict(), **played._asdict()}
        assert kernels.pop("ages_of") is no_ages and kernels.pop("mark_available") is None
        return {name: kernel._cache.path for name, kernel in kernels.items()}

    def reward(self, state, action, next_state):
        return 2.0 * (next_state[0] == self.length - 1)

    def draw(self, state, planes):
        planes[0, 0, 0] = self.length

    def changed(**rules):
        return {name for name, path in places(**rules).items() if path != before[name]}

    class Heir(corridor_class()):
        """It inherits all rules."""

    before = places()
    assert places(Heir) == before
    drawings = {"step_and_draw_one", "draw_simple", "draw_complex", "draw_planes"}
    assert changed() == set()
    assert changed(reward=reward) == {"rewards_of", "step_one", "step_many", "step_and_draw_one"}
    assert changed(draw=draw) == drawings
    others = set(before) - drawings - {"rewards_of", "outcome_one"} | {"step_and_draw_one"}
    assert changed(is_terminal=lambda self, state: state[0] >= self.length - 1) == others


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no users to tell apart")
def test_a_folder_that_others_can_write_to_is_not_read(cache, filled, tmp_path):
    shutil.copytree(filled / "compiled", cache / "planted")
    os.mkdir(cache / "compiled")
    for path in (cache / "planted").iterdir():
        data = pickle.dumps(Planted(str(tmp_path / "it ran")))
        (cache / "compiled" / path.name).write_bytes(hashlib.sha256(data).digest() + data)
    os.chmod(cache / "compiled", 0o777)
    private_folder.cache_clear()
    instead = r"compiled can be written to by other users; .*compiled-\d+ is used instead"
    with pytest.warns(RuntimeWarning, match=instead):
        pharos.build(corridor_class()(), tmp_path / "second")
    assert not (tmp_path / "it ran").exists()
    assert files_of(cache / f"compiled-{os.getuid()}")


class Planted:
    """Unpickled, it makes a folder."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no users to tell apart")
def test_the_folder_of_another_user_is_not_used(cache, monkeypatch):
    (cache / "compiled").mkdir(parents=True, mode=0o700)
    somebody = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: somebody)
    private_folder.cache_clear()
    with pytest.warns(RuntimeWarning, match=r"compiled belongs to another user .*compiled anew by every process"):
        assert private_folder(cache) is None
    private_folder.cache_clear()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no users to tell apart")
def test_a_folder_that_anybody_may_rename_or_link_is_not_used(cache, tmp_path, monkeypatch):
    cache.mkdir(exist_ok=True)
    cache.chmod(0o777)
    with pytest.warns(RuntimeWarning, match="compiled lies in a folder whose entries anybody can rename"):
        assert private_folder(cache) is None
    private_folder.cache_clear()
    cache.chmod(0o1777)  # as /tmp, where only the owner of an entry can
    assert private_folder(cache) == cache / "compiled"
    (cache / "compiled").rmdir()
    (tmp_path / "mine").mkdir(mode=0o700)
    (cache / "compiled").symlink_to(tmp_path / "mine")
    private_folder.cache_clear()
    assert private_folder(cache) == cache / "compiled"  # a link of one's own
    usual, somebody = Path.lstat, os.getuid() + 1
    fields = lambda path: (*usual(path)[:4], somebody, *usual(path)[5:])  # noqa: E731
    monkeypatch.setattr(Path, "lstat", lambda path: os.stat_result(fields(path)))
    private_folder.cache_clear()
    with pytest.warns(RuntimeWarning, match=rf"compiled belongs to another user \(number {somebody}\)"):
        private_folder(cache)
    private_folder.cache_clear()


# Many actions --------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_more_than_a_thousand_actions_are_solved(tmp_path):
    def transition(self, state, action, out):
        out[0] = (state[0] + action) % self.length

    members = {"actions": tuple(map(str, range(1200))), "transition": transition}
    env = corridor_class(**members)(length=30)
    space = pharos.build(env, tmp_path / "space")
    mdp = space.mdp(gamma=0.5)
    assert pharos.value_iteration(mdp).v[0] == 1.0
    sticky = pharos.value_iteration(pharos.sticky_actions(mdp, 0.25))
    assert sticky.v.shape == (30, 1200)
    assert pharos.value_iteration(mdp, horizon=3).v[0] == 1.0
    assert diameter(mdp).upper == 2.0  # from the terminal state, a step to the start comes first
    vec = make_vec(env, 3)
    vec.reset(seed=0)
    np.testing.assert_array_equal(vec.step(np.array([1, 31, 1199]))[4]["state"][:, 0], [1, 1, 29])
