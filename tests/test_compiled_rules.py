"""Compiled rules: what Numba compiles, the private cache of machine code, damage, and many actions."""

import hashlib
import os
import pickle
import warnings
from dataclasses import dataclass

import numpy as np
import pytest

import pharos
from pharos import Environment
from pharos.hardness import diameter
from pharos.interaction.gym_env import GymEnv
from pharos.interaction.vector_env import make_vec
from pharos.rules import reason_of
from pharos.rules.kernel_cache import private_folder


def corridor_class(**rules):
    """A class of its own, with the same rules as the others: what one process compiled, the next finds."""

    def variables(self):
        return {"position": range(self.length)}

    def transition(self, state, action, out):
        out[0] = min(max(state[0] + 2 * action - 1, 0), self.length - 1)

    def is_terminal(self, state):
        return state[0] == self.length - 1

    def reward(self, state, action, next_state):
        return float(next_state[0] == self.length - 1)

    members = {
        "__annotations__": {"length": int},
        "length": 5,
        "name": "corridor",
        "actions": ("left", "right"),
        "variables": variables,
        "initial_state": lambda self: (0,),
        "transition": transition,
        "is_terminal": is_terminal,
        "reward": reward,
        **rules,
    }
    return dataclass(frozen=True, kw_only=True)(type("Corridor", (Environment,), members))


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def files_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*.nb[ci]")}


@pytest.mark.slow
def test_a_truth_is_a_reward(cache, tmp_path):
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


@pytest.mark.slow
def test_rules_that_mention_a_private_attribute_run_interpreted(cache, tmp_path):
    def reward(self, state, action, next_state):
        return 1.0 + self._bonus

    env = corridor_class(reward=reward, _bonus=0.5)()
    space = pharos.build(env, tmp_path / "space")
    with pytest.warns(RuntimeWarning, match="Corridor: Numba cannot compile its rules.*_bonus"):
        assert space.mdp().rewards[0].tolist() == [1.5, 1.5]


# The cache -----------------------------------------------------------------------------------------------------------


def build_and_step(folder):
    env = corridor_class()()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        space = pharos.build(env, folder)
        gym = GymEnv(env)
        gym.reset(seed=0)
        gym.step(1)
    return space


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage", [lambda data: b"", lambda data: data[: len(data) // 2], lambda data: data[:-1] + b"x"]
)
def test_a_damaged_file_is_compiled_again(cache, tmp_path, damage):
    build_and_step(tmp_path / "first")
    before = files_of(cache)
    assert before
    for path, data in before.items():
        path.write_bytes(damage(data))
    space = build_and_step(tmp_path / "second")
    assert space.num_states == 5
    after = files_of(cache)
    assert set(after) == set(before)
    for path, data in after.items():
        assert data != damage(before[path]), "it is still the damaged one"
    build_and_step(tmp_path / "third")
    assert files_of(cache) == after, "what was mended is read"


@pytest.mark.slow
def test_the_folder_of_compiled_rules_is_private(cache, tmp_path):
    build_and_step(tmp_path / "space")
    assert (cache / "compiled").stat().st_mode & 0o777 == 0o700


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no users to tell apart")
def test_a_folder_that_others_can_write_to_is_not_read(cache, tmp_path):
    build_and_step(tmp_path / "first")
    os.rename(cache / "compiled", cache / "planted")
    os.mkdir(cache / "compiled")
    for path in (cache / "planted").iterdir():
        data = pickle.dumps(Planted(str(tmp_path / "it ran")))
        (cache / "compiled" / path.name).write_bytes(hashlib.sha256(data).digest() + data)
    os.chmod(cache / "compiled", 0o777)
    private_folder.cache_clear()
    with pytest.warns(
        RuntimeWarning, match=r"compiled can be written to by other users; .*compiled-\d+ is used instead"
    ):
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


# Many actions --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
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
