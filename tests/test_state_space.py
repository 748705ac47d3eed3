"""build, load and StateSpace: Algorithm 1, its files, and what can go wrong."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

import naive_builder
import pharos
from pharos.environment import Environment
from table_worlds import TableWorld, table_worlds

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
    return pharos.build(env, folder, progress=False, **options)


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


@given(table_worlds())
@settings(max_examples=60, deadline=None)
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
            with pytest.raises(pharos.errors.ParameterError, match="not reachable"):
                space.index(other)
