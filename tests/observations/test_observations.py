"""Observations: pure functions of the state, batched, with their spaces; user-defined ones are checked."""

import re
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import strategies as st

import pharos
from patience import PATIENCE
from pharos import importers, observations
from pharos.errors import ParameterError, UnknownName
from refusals import refusal
from strategies import examples
from worlds import random_states

SMALL = {
    "simple_grid": {"height": 3, "width": 4, "rewards": (((1, 1), 0.1),), "penalties": (((0, 2), -0.5),)},
    "frozen_lake": {"size": 4},
    "freeway": {"num_cars": 3, "lane_length": 4, "player_speed": 2},
    "breakout": {"height": 7, "columns": 4},
}
PAGE = (Path(__file__).parents[2] / "docs" / "observations.md").read_text()


@pytest.fixture(params=SMALL, scope="module")
def env(request):
    return pharos.make(request.param, **SMALL[request.param])


def test_a_vector_is_the_state_normalized_by_its_ranges(env):
    states = random_states(env, 200)
    vector = observations.observe(env, "vector")
    found = vector(states)
    components = env.components
    expected = (states - components.low) / np.maximum(components.size - 1, 1)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=0)
    assert vector.names == components.names
    assert all(vector.space.contains(row) for row in found)
    np.testing.assert_array_equal(vector.one(states[7]), found[7])


@examples(20, seed=st.integers(0, 2**32 - 1))
def test_different_states_have_different_vectors_and_one_hots(seed):
    env = pharos.make("breakout", height=7, columns=4)
    states = np.unique(random_states(env, 300, seed), axis=0)
    for name in ("vector", "one_hot"):
        assert len(np.unique(observations.observe(env, name)(states), axis=0)) == len(states)


def test_a_one_hot_has_one_one_for_each_component(env):
    states = random_states(env, 50)
    one_hot = observations.observe(env, "one_hot")
    found = one_hot(states)
    assert (found.sum(axis=1) == len(env.components)).all()
    marked = [one_hot.names[i] for i in np.flatnonzero(found[3])]
    assert marked == [f"{name}={value}" for name, value in zip(env.components.names, states[3], strict=True)]


@pytest.mark.slow
def test_an_index_is_the_number_of_the_state_in_its_space(tmp_path):
    env = pharos.make("breakout", height=7, columns=4)
    space = pharos.build(env, tmp_path / "space")
    index = observations.observe(env, "index", state_space=space)
    some = np.arange(0, space.num_states, 97)
    np.testing.assert_array_equal(index(space.states(some)), some)
    assert index.space == spaces.Discrete(space.num_states)
    with pytest.raises(ParameterError, match=r"needs the built state space: .*state_space=pharos\.build"):
        observations.observe(env, "index")
    with pytest.raises(ParameterError, match="belongs to Breakout"):
        observations.observe(pharos.make("breakout", height=8, columns=4), "index", state_space=space)


@pytest.mark.slow
@pytest.mark.parametrize("name", observations.names())
def test_every_observation_keeps_its_space_and_sees_each_state_alone(name, tmp_path):
    assert f"| `{name}` |" in PAGE, f"docs/observations.md: the table has no row for {name}"
    mdp = pharos.TabularMDP.from_arrays(np.array([[1, 2], [2, -1], [0, 1]]), np.ones((3, 2)), gamma=0.9)
    shown = np.arange(3 * 6 * 7 * 3, dtype=np.uint8).reshape(3, 6, 7, 3)
    importers.save(mdp, tmp_path / "imported", observations=shown)
    worlds = [pharos.make("simple_grid", **SMALL["simple_grid"]), pharos.make(str(tmp_path / "imported"))]
    num_worlds = 0
    for i, env in enumerate(worlds):
        space = pharos.build(env, tmp_path / f"space-{i}", progress=False)
        try:
            observation = observations.observe(env, name, state_space=space)
        except ParameterError:
            continue  # the world has no such observation
        num_worlds += 1
        assert (observation.name, observation.env) == (name, env)
        states = space.states(np.arange(space.num_states))
        batch = observation(states)
        assert batch.shape == (len(states), *observation.space.shape)
        for state, row in zip(states, batch, strict=True):
            assert observation.space.contains(row), f"{observation}: of state {state.tolist()} it is {row!r}"
            assert (observation.one(state) == row).all(), "one state alone looks as in a batch"
        expected = batch.copy()
        batch[...] = 1 - batch
        assert (observation(states) == expected).all(), "a batch is a fresh array: whoever gets it may write to it"
        for wrong in (states + 1000, states - 1000, states.astype(np.float64), states[:, 1:], states[0]):
            assert str(env) in refusal(ParameterError, observation, wrong), (
                "compiled code would read or write elsewhere"
            )
        assert str(env) in refusal(ParameterError, observation.one, states[0] + 1000)
    assert num_worlds, f"no world of this test has {name}: add one to `worlds`"


def ball(env, states):
    return states[:, :2] / [env.height, env.columns]


def test_a_users_function_of_states_is_an_observation():
    env = pharos.make("breakout")
    seen = observations.observe(env, (ball, spaces.Box(0, 1, (2,), np.float32)))
    states = random_states(env, 10)
    np.testing.assert_allclose(seen(states), ball(env, states), rtol=1e-6)
    assert seen(states).dtype == np.float32
    assert seen.name == "ball"


def test_a_registered_function_is_known_by_its_name():
    observations.register("ball", ball, lambda env: spaces.Box(0, 1, (2,), np.float32))
    assert "ball" in observations.names()
    assert observations.observe(pharos.make("breakout"), "ball").name == "ball"
    assert "'vector' is built in" in refusal(ParameterError, observations.register, "vector", ball, None)


@pytest.mark.parametrize(
    ("function", "space", "message"),
    [
        (ball, spaces.Box(0, 1, (3,), np.float32), r"has shape \(1, 2\) for 1 states; expected \(1, 3\)"),
        (ball, spaces.Box(0, 255, (2,), np.uint8), r"has dtype float64; expected uint8.*astype"),
        (lambda env, states: states[:, :1] + 9.0, spaces.Box(0, 1, (1,)), "which is not in its space"),
        (lambda env, states: np.zeros((len(states), 0)), spaces.Box(0, 1, (0,)), "has no entries"),
        (ball, spaces.Text(4), "expected a Box, Discrete"),
        (ball, "image", "expected a Box, Discrete"),
    ],
)
def test_a_users_function_that_does_not_keep_its_space_is_refused(function, space, message):
    assert re.search(message, refusal(ParameterError, observations.observe, pharos.make("breakout"), (function, space)))


def test_a_users_function_may_write_to_what_it_gets():
    def centred(env, states):
        states -= 1
        return states.astype(np.float32)

    env = pharos.GymEnv("frozen_lake/4x4", observation=(centred, spaces.Box(-1, 10, (2,), np.float32)))
    other = pharos.GymEnv("frozen_lake/4x4")
    assert env.reset(seed=0)[1]["state"].tolist() == other.reset(seed=0)[1]["state"].tolist() == [0, 0]
    for action in (1, 1, 2):
        assert env.step(action)[4]["state"].tolist() == other.step(action)[4]["state"].tolist()


@pytest.mark.parametrize(
    ("function", "space", "message"),
    [
        (lambda env, s: np.where(s[:, :1] > 1, np.nan, 0.5), spaces.Box(0, 1, (1,)), "is array\\(\\[nan\\]"),
        (lambda env, s: s.sum(1), spaces.Discrete(3), "expected one of its space Discrete"),
        (lambda env, s: s.sum(1, keepdims=True), spaces.MultiBinary(1), "expected one of its space MultiBinary"),
        (lambda env, s: s, spaces.MultiDiscrete([2, 2]), "expected one of its space MultiDiscrete"),
    ],
)
def test_values_that_no_network_could_read_are_refused_in_whichever_state(function, space, message):
    seen = observations.observe("frozen_lake/4x4", (function, space))
    assert seen(np.array([[0, 1], [1, 0]])).shape[0] == 2 and len(seen(np.empty((0, 2), np.int64))) == 0
    said = refusal(ParameterError, seen, np.array([[0, 0], [3, 3]]))
    assert re.search(message, said) and "of the state (3, 3)" in said


def test_unknown_names_and_options_suggest_the_nearest():
    env = pharos.make("breakout")
    assert "did you mean 'vector'" in refusal(UnknownName, observations.observe, env, "vectr")
    with pytest.raises(UnknownName, match="unknown option of observation 'vector' 'gray'"):
        observations.observe(env, "vector", gray=True)
    assert "expected one of vector" in refusal(ParameterError, observations.observe, env, 7)


def test_environments_may_be_given_by_name():
    assert observations.observe("breakout/12x8x1", "vector").env == pharos.make("breakout/12x8x1")
    with pytest.raises(ParameterError, match="env is 3; expected a pharos Environment, or a name"):
        observations.observe(3, "vector")


def test_what_is_seen_first_is_told_by_start_states_alone():
    chain = pharos.make("memory_chain", memory_length=2, num_bits=2)
    whole, once = observations.observe(chain, "one_hot"), observations.observe(chain, "one_hot", seen_first="bits")
    states = np.array([(step, query, *bits) for step in range(4) for query in range(2) for bits in np.ndindex(2, 2)])
    bits = np.array([name.startswith("bits") for name in once.names])
    first = states[:, 0] == 0
    expected = whole(states)
    expected[np.ix_(~first, bits)] = 0
    assert (once(states) == expected).all()
    assert once.space == whole.space
    one = observations.observe(chain, "one_hot", seen_first=["bits[1]"])(states)
    assert one[~first].sum(axis=1).tolist() == [3] * (~first).sum()
    with pytest.raises(ParameterError, match="one_hot of memory_chain: there is no 'bit' to hide; expected some of"):
        observations.observe(chain, "one_hot", seen_first="bit")
    with pytest.raises(ParameterError, match="one_hot of memory_chain: seen_first is 3; expected names"):
        observations.observe(chain, "one_hot", seen_first=3)


def test_without_memory_a_chain_whose_bit_is_seen_first_is_a_guess():
    """Every policy of the observation is worth 0, the optimum 1: aliased states, as the loss says."""
    space = pharos.build(pharos.make("memory_chain", memory_length=3), progress=False)
    once = observations.observe(space.environment, "one_hot", seen_first="bits")
    classes = observations.observation_classes(space, once)
    loss = observations.memoryless_loss(space.mdp(gamma=1.0), classes, budget=PATIENCE)
    assert loss.lower == pytest.approx(1) == loss.upper
