"""Chance in the rules: what is built of a class with outcomes, against a plain enumeration and against matrices."""

import importlib

import numpy as np
import pytest
from hypothesis import given, settings

import naive
import pharos
from chance_worlds import ChanceWorld, chance_worlds

search = importlib.import_module("pharos.state_space.search")
table = importlib.import_module("pharos.state_space.table")
rules = importlib.import_module("pharos.rules.rules")
rules_traced = importlib.import_module("pharos.rules.traced")


def build(env, folder, **options) -> pharos.StateSpace:
    return pharos.build(env, folder, progress=False, **options)


def matrices_of(env) -> tuple[naive.NaiveOutcomes, np.ndarray, np.ndarray]:
    """The twin, and its probabilities (S, A, S) and expected rewards (S, A)."""
    twin = naive.build_outcomes(env)
    size = len(twin.states)
    P, R = np.zeros((size, env.num_actions, size)), np.zeros((size, env.num_actions))
    for s, state in enumerate(twin.states):
        for a in range(env.num_actions):
            for following, probability in twin.outcomes[s][a]:
                P[s, a, following] += probability
                if not twin.terminal[s]:
                    R[s, a] += probability * env.reward(state, a, twin.states[following])
    return twin, P, R


def assert_agrees(space: pharos.StateSpace, env) -> None:
    twin, P, R = matrices_of(env)
    assert [tuple(state) for state in space.states().tolist()] == twin.states
    assert (space.terminal == twin.terminal).all()
    assert space.depth == max(twin.levels)
    stored = space.outcomes.of_states(np.arange(space.num_states), env.num_actions)
    for s, rows in enumerate(twin.outcomes):
        for (successors, probabilities), expected in zip(stored[s], rows, strict=True):
            assert list(zip(successors.tolist(), probabilities.tolist(), strict=True)) == expected
    mdp = space.mdp(gamma=0.9)
    np.testing.assert_allclose(mdp.dynamics.matrix().toarray()[:, :-1], P.reshape(-1, len(P)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(mdp.rewards, R, rtol=1e-12, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(env=chance_worlds())
def test_build_agrees_with_a_plain_enumeration_on_random_worlds(env, tmp_path_factory):
    assert_agrees(build(env, tmp_path_factory.mktemp("space") / "space"), env)


# Every engine, thread and block gives the same files -----------------------------------------------------------------

WORLD = ChanceWorld(num_positions=3000, seed=1, vectors=0, end_share=0.05)


def files_of(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict[str, bytes]:
    return files_of(build(WORLD, tmp_path_factory.mktemp("undisturbed") / "space", workers=1).folder)


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 256)
    monkeypatch.setattr(search, "WIDE", 50)


def test_files_do_not_depend_on_threads_or_blocks(tmp_path, undisturbed, small_blocks):
    folder = build(WORLD, tmp_path / "space", workers=3, checkpoint_seconds=0.0).folder
    assert files_of(folder) == undisturbed


def test_files_do_not_depend_on_where_the_table_is(tmp_path, undisturbed, small_blocks, monkeypatch):
    monkeypatch.setattr(table.MemoryTable, "fits", lambda *_: False)
    folder = build(WORLD, tmp_path / "space", workers=2, checkpoint_seconds=0.0).folder
    assert files_of(folder) == undisturbed


@pytest.mark.parametrize("traced", (True, False))
def test_files_do_not_depend_on_the_engine(traced, tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(rules, "compiled_or_none", lambda *_: None)
    if not traced:
        monkeypatch.setattr(rules_traced.TracedRules, "branches", lambda self, states: None)
    space = build(WORLD, tmp_path / "space", workers=2)
    assert files_of(space.folder) == undisturbed
    interpreted = space.mdp().rewards
    monkeypatch.undo()
    assert (space.mdp().rewards == interpreted).all()
