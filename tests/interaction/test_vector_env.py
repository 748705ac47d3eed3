"""Vector environments: agreement with the table, the interpreted twin and Gymnasium's own; autoreset, seeds, chance,
SB3.
"""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.stats import chisquare

import pharos
from pharos.errors import ParameterError
from pharos.interaction import GymEnv, make_vec
from pharos.rules import InterpretedStepping
from refusals import refusal

SMALL = {
    "simple_grid": {"height": 3, "width": 4, "rewards": (((1, 1), 0.1),), "penalties": (((0, 2), -0.5),)},
    "frozen_lake": {"size": 4},
    "freeway": {"num_cars": 3, "lane_length": 4, "player_speed": 2, "car_speeds": (1, 2, 3)},
    "breakout": {"height": 7, "columns": 4},
}
CHANCES = [{}, {"sticky": 0.3}, {"random": 0.2}, {"sticky": 0.3, "random": 0.2}]
MODES = list(AutoresetMode)


@pytest.fixture(params=SMALL, scope="module")
def space(request, tmp_path_factory):
    env = pharos.make(request.param, **SMALL[request.param])
    return pharos.build(env, tmp_path_factory.mktemp(request.param) / "space")


@pytest.fixture(scope="module")
def breakout(tmp_path_factory):
    return pharos.build(pharos.make("breakout", height=7, columns=4), tmp_path_factory.mktemp("one") / "space")


@pytest.mark.long
@pytest.mark.parametrize("chance", CHANCES)
@pytest.mark.parametrize("tabulated", [False, True])
def test_a_walk_agrees_with_the_table_at_every_step(space, chance, tabulated):
    rewards = space.mdp().rewards
    vec = make_vec(space.environment, 7, space=space if tabulated else None, time_limit=60, **chance)
    rng = np.random.default_rng(0)
    vec.reset(seed=3)
    ended = np.zeros(7, bool)
    for _ in range(300):
        before = space.indices(vec.states)
        actions = rng.integers(vec.single_action_space.n, size=7)
        _, reward, terminated, truncated, info = vec.step(actions)
        after = space.indices(vec.states)
        executed = info["executed_action"]
        assert (executed[ended] == -1).all()
        going = ~ended
        assert (executed[going] == actions[going]).all() or chance
        np.testing.assert_array_equal(after[going], space.successors[before[going], executed[going]])
        np.testing.assert_array_equal(reward[going], rewards[before[going], executed[going]])
        np.testing.assert_array_equal(terminated[going], space.terminal[after[going]])
        assert not reward[ended].any() and not terminated[ended].any()
        assert (after[ended] == space.indices(vec.simulator.start_states)[0]).all()
        ended = terminated | truncated


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("chance", CHANCES)
def test_rules_table_and_interpreted_twin_walk_the_same_way(space, mode, chance):
    options = {"autoreset_mode": mode, "time_limit": 25, "seed": 5, **chance}
    compiled = make_vec(space.environment, 5, **options)
    table = make_vec(space.environment, 5, space=space, **options)
    twin = make_vec(space.environment, 5, **options)
    twin._stepper._step_many = InterpretedStepping(twin.environment).step_many
    walks = (compiled, table, twin)
    first = [walk.reset()[0] for walk in walks]
    np.testing.assert_array_equal(first[0], first[1])
    rng = np.random.default_rng(1)
    for _ in range(120):
        actions = rng.integers(compiled.single_action_space.n, size=5)
        steps = [walk.step(actions) for walk in walks]
        for other in steps[1:]:
            for mine, theirs in zip(steps[0][:4], other[:4], strict=True):
                np.testing.assert_array_equal(mine, theirs)
            np.testing.assert_array_equal(steps[0][4]["executed_action"], other[4]["executed_action"])
        done = steps[0][2] | steps[0][3]
        if mode == AutoresetMode.DISABLED and done.any():
            assert "reset_mask" in refusal(gymnasium.error.ResetNeeded, compiled.step, actions)
            for walk in walks:
                walk.reset(options={"reset_mask": done})


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("extras", [{}, {"previous_action": True, "remaining_time": True}])
def test_gymnasiums_own_vector_environment_does_the_same(name, mode, extras):
    def make_one():
        return GymEnv(name, time_limit=20, **extras, **SMALL[name])

    own = SyncVectorEnv([make_one] * 4, autoreset_mode=mode)
    vec = make_vec(name, 4, time_limit=20, autoreset_mode=mode, **extras, **SMALL[name])
    assert vec.observation_space == own.observation_space and vec.action_space == own.action_space
    np.testing.assert_array_equal(vec.reset(seed=0)[0], own.reset(seed=0)[0])
    rng = np.random.default_rng(2)
    for _ in range(100):
        actions = rng.integers(vec.single_action_space.n, size=4)
        mine, theirs = vec.step(actions), own.step(actions)
        for a, b in zip(mine[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        assert ("final_obs" in mine[4]) == ("final_obs" in theirs[4])
        if "final_obs" in mine[4]:
            np.testing.assert_array_equal(mine[4]["_final_obs"], theirs[4]["_final_obs"])
            for i in np.flatnonzero(mine[4]["_final_obs"]):
                np.testing.assert_array_equal(mine[4]["final_obs"][i], theirs[4]["final_obs"][i])
                last, expected = mine[4]["final_info"], theirs[4]["final_info"]
                np.testing.assert_array_equal(last["state"][i], expected["state"][i])
                assert last["executed_action"][i] == expected["executed_action"][i]
        done = mine[2] | mine[3]
        if mode == AutoresetMode.DISABLED and done.any():
            options = {"reset_mask": done}
            np.testing.assert_array_equal(vec.reset(options=options)[0], own.reset(options=options)[0])


@pytest.mark.slow
@pytest.mark.parametrize(("sticky", "random"), [(0.3, 0.0), (0.0, 0.4), (0.25, 0.2)])
@pytest.mark.parametrize("tabulated", [False, True])
def test_executed_actions_follow_the_chance(breakout, sticky, random, tabulated):
    n = 40_000
    space = breakout if tabulated else None
    vec = make_vec(breakout.environment, n, sticky=sticky, random=random, space=space, seed=11)
    vec.reset()
    zero, two = np.zeros(n, np.int64), np.full(n, 2)
    first = vec.step(zero)[4]["executed_action"]
    chosen, stuck, uniform = vec.simulator.chance
    kept = pharos.random_actions(pharos.sticky_actions(breakout.mdp(), sticky), random).chance.first_chosen
    expected = np.array([kept, 0, 0]) + (1 - kept) / 3
    counts = np.bincount(first, minlength=3)
    assert (counts[expected == 0] == 0).all()
    assert chisquare(counts[expected > 0], n * expected[expected > 0]).pvalue > 1e-3 or (expected == 1).any()
    second = vec.step(two)[4]["executed_action"]
    for previous in np.unique(first):
        among = second[first == previous]
        expected = np.full(3, uniform / 3)
        expected[2] += chosen
        expected[previous] += stuck
        counts = np.bincount(among, minlength=3)
        assert (counts[expected == 0] == 0).all()
        assert chisquare(counts[expected > 0], len(among) * expected[expected > 0]).pvalue > 1e-3


def test_the_same_seed_gives_the_same_walk_and_another_seed_another():
    def walk(seed, n=6):
        vec = make_vec("breakout", n, sticky=0.5)
        seen = [vec.reset(seed=seed)[0]]
        rng = np.random.default_rng(0)
        actions = rng.integers(3, size=(50, 6))[:, :n]
        return np.array(seen + [vec.step(row)[0] for row in actions])

    np.testing.assert_array_equal(walk(1), walk(1))
    np.testing.assert_array_equal(walk(1)[:, :3], walk([1, 2, 3, 7, 8, 9])[:, :3])
    np.testing.assert_array_equal(walk(1)[:, :3], walk(1, 3))
    assert (walk(1) != walk(100)).any()


def test_episodes_start_in_the_states_given(breakout):
    states = breakout.states(np.arange(4))
    for space in (None, breakout):
        vec = make_vec(breakout.environment, 4, space=space)
        vec.reset(options={"state": states})
        np.testing.assert_array_equal(vec.states, states)
        vec.reset(options={"state": states[2]})
        np.testing.assert_array_equal(vec.states, states[[2] * 4])
    assert "expected one, or 4" in refusal(ParameterError, vec.reset, options={"state": states[:2]})


def test_observations_are_fresh_arrays_of_the_space(space):
    for observation in ("vector", "simple_image", "one_hot", "index"):
        for given in (None, space)[observation == "index" :]:
            vec = make_vec(space.environment, 3, observation=observation, space=given)
            before, _ = vec.reset(seed=0)
            kept = before.copy()
            after = vec.step(np.zeros(3, np.int64))[0]
            assert vec.observation_space.contains(before) and vec.observation_space.contains(after)
            np.testing.assert_array_equal(before, kept)


def test_gymnasium_makes_it_by_name():
    vec = gymnasium.make_vec("pharos/Breakout-v0", num_envs=3, vectorization_mode="vector_entry_point", height=8)
    assert vec.environment == pharos.make("breakout", height=8)
    assert vec.observation_space.shape[0] == 3
    limited = gymnasium.make_vec("pharos/FrozenLake-v0", num_envs=2, max_episode_steps=3)
    limited.reset(seed=0)
    assert [limited.step(np.array([0, 0]))[3].all() for _ in range(3)] == [False, False, True]


def test_bad_input_is_refused_in_one_line():
    vec = make_vec("breakout", 2)
    assert "call reset" in refusal(gymnasium.error.ResetNeeded, vec.step, [0, 0])
    vec.reset(seed=0)
    assert "action 3 of environment 1; expected 0 to 2" in refusal(ParameterError, vec.step, np.array([0, 3]))
    assert "expected (2,) integers" in refusal(ParameterError, vec.step, np.array([0.0, 1.0]))
    assert "expected one integer, or 2" in refusal(ParameterError, vec.reset, seed=[1, 2, 3])
    assert "reset_mask" in refusal(ParameterError, vec.reset, options={"reset_mask": np.array([1, 0])})
    assert "num_envs is 0" in refusal(ParameterError, make_vec, "breakout", 0)
    assert "autoreset_mode is 'never'" in refusal(ParameterError, make_vec, "breakout", 2, autoreset_mode="never")


def test_stable_baselines_gets_what_it_needs_at_the_ends_of_episodes():
    from pharos.interaction.sb3_env import make_sb3_vec

    vec = make_sb3_vec("frozen_lake", 3, size=4, time_limit=5, seed=1)
    plain = make_vec("frozen_lake", 3, size=4, time_limit=5, autoreset_mode="SAME_STEP")
    plain.reset()
    vec.reset()
    rng = np.random.default_rng(0)
    length, returns, kinds = np.zeros(3), np.zeros(3), set()
    for _ in range(300):
        actions = rng.integers(4, size=3)
        observation, reward, done, infos = vec.step(actions)
        _, _, terminated, truncated, info = plain.step(actions)
        length, returns = length + 1, returns + reward
        np.testing.assert_array_equal(done, terminated | truncated)
        for i in range(3):
            if not done[i]:
                assert infos[i] == {}
                continue
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])
            assert infos[i]["TimeLimit.truncated"] == (truncated[i] and not terminated[i])
            assert (infos[i]["episode"]["l"], infos[i]["episode"]["r"]) == (length[i], returns[i])
            assert not observation[i].any()
            kinds.add(infos[i]["TimeLimit.truncated"])
            length[i] = returns[i] = 0
    assert kinds == {True, False}


@pytest.mark.long
@pytest.mark.parametrize("observation", ["vector", "simple_image"])
def test_stable_baselines_trains_on_it(observation):
    from stable_baselines3 import PPO

    from pharos.interaction.sb3_env import make_sb3_vec

    policy = {"vector": "MlpPolicy", "simple_image": "MlpPolicy"}[observation]
    env = make_sb3_vec("simple_grid", 4, height=3, width=3, observation=observation, seed=0)
    model = PPO(policy, env, n_steps=16, batch_size=16, seed=0).learn(128)
    assert model.num_timesteps == 128
    assert model.ep_info_buffer


def test_a_discrete_observation_keeps_its_space(breakout):
    vec = make_vec(breakout.environment, 3, observation="index", space=breakout)
    assert vec.single_observation_space == spaces.Discrete(breakout.num_states)


def test_a_vector_environment_draws_each_of_its_environments():
    from pharos.drawing import human

    envs = gymnasium.make_vec("pharos/FrozenLake-v0", num_envs=3, size=4, render_mode="rgb_array")
    envs.reset(seed=0)
    envs.step(np.array([0, 1, 2]))
    pictures, states = envs.render(), envs.unwrapped.states
    assert len(pictures) == 3
    for picture, state in zip(pictures, states, strict=True):
        assert (picture == human(envs.unwrapped.environment, state.tolist())).all()
    with pytest.raises(ParameterError, match="render_mode is 'human'"):
        pharos.make_vec("frozen_lake", 2, size=4, render_mode="human")
