"""The Gymnasium environment: the conformance tests of Gymnasium, agreement with the tabulated MDP, chance, limits,
errors.
"""

import itertools
import json
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import pharos
from pharos.drawing import human
from pharos.errors import MissingExtra, ParameterError
from pharos.interaction import GymEnv
from pharos.observations import NO_ACTION, observe
from refusals import refusal

SMALL = {
    "pharos/SimpleGrid-v0": {"height": 3, "width": 4, "rewards": (((1, 1), 0.1),), "penalties": (((0, 2), -0.5),)},
    "pharos/FrozenLake-v0": {"size": 4},
    "pharos/Freeway-v0": {"num_cars": 3, "lane_length": 4, "player_speed": 2},
    "pharos/Breakout-v0": {"height": 7, "columns": 4},
}


@pytest.mark.long
@pytest.mark.parametrize("env_id", SMALL)
@pytest.mark.parametrize(
    "options", [{}, {"sticky": 0.25, "previous_action": True}, {"random": 0.3, "remaining_time": True}]
)
def test_gymnasiums_checker_finds_nothing_to_say(env_id, options):
    check_env(gymnasium.make(env_id, **SMALL[env_id], **options).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", SMALL)
def test_gymnasiums_checker_finds_nothing_to_say_about_rendering(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    check_env(gymnasium.make(env_id, **SMALL[env_id]).unwrapped)


@pytest.mark.parametrize("env_id", SMALL)
def test_the_picture_is_the_one_for_people(env_id):
    env = gymnasium.make(env_id, render_mode="rgb_array", **SMALL[env_id])
    env.action_space.seed(0)
    env.reset(seed=0)
    frames = gymnasium.wrappers.RenderCollection(env)
    frames.reset(seed=0)
    for _ in range(5):
        frames.step(env.action_space.sample())
    pictures = frames.render()
    assert len(pictures) == 6
    assert (pictures[-1] == human(env.unwrapped.environment, env.unwrapped.state)).all()
    assert any((one != other).any() for one, other in itertools.pairwise(pictures))


def test_a_window_shows_each_state_and_closes(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    env = GymEnv("frozen_lake", size=4, render_mode="human")
    env.reset(seed=0)
    for action in (1, 1, 2):
        env.step(action)
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
        assert (shown == human(env.environment, env.state)).all()
        assert env.render() is None
    env.close()
    assert not pygame.display.get_init()


def test_without_pygame_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert "pharos-rl[play]" in refusal(MissingExtra, GymEnv, "frozen_lake", size=4, render_mode="human")


@pytest.fixture(scope="module")
def breakout(tmp_path_factory):
    return pharos.build(pharos.make("breakout", height=7, columns=4), tmp_path_factory.mktemp("breakout") / "space")


@pytest.fixture(scope="module")
def freeway(tmp_path_factory):
    env = pharos.make("freeway", num_cars=3, lane_length=4, player_speed=2, car_speeds=(1, 2, 3))
    return pharos.build(env, tmp_path_factory.mktemp("freeway") / "space")


@pytest.mark.long
@pytest.mark.parametrize("name", ["breakout", "freeway"])
@pytest.mark.parametrize("chance", [{}, {"sticky": 0.3}, {"random": 0.2}, {"sticky": 0.3, "random": 0.2}])
def test_a_walk_agrees_with_the_table_at_every_step(name, chance, request):
    space = request.getfixturevalue(name)
    rewards = space.mdp().rewards
    env = GymEnv(space.environment, space=space, observation="index", **chance)
    rng = np.random.default_rng(1)
    index, info = env.reset(seed=1)
    for _ in range(2000):
        previous = index
        index, reward, terminated, truncated, info = env.step(rng.integers(env.action_space.n))
        executed = info["executed_action"]
        assert index == info["index"] == space.successors[previous, executed]
        assert tuple(info["state"]) == space.state(index)
        assert reward == rewards[previous, executed]
        assert terminated == space.is_terminal(index)
        if terminated or truncated:
            index, info = env.reset()
            assert index in space.start_states


def executed_counts(env, steps, seed):
    """How often the executed action was (chosen, previous and not chosen), by previous action; no matter where."""
    rng = np.random.default_rng(seed)
    counts = np.zeros((3, 3, 3), np.int64)  # previous, chosen, executed
    env.reset(seed=seed)
    previous = None
    for _ in range(steps):
        chosen = int(rng.integers(3))
        _, _, terminated, truncated, info = env.step(chosen)
        executed = info["executed_action"]
        if previous is not None:
            counts[previous, chosen, executed] += 1
        previous = executed
        if terminated or truncated:
            env.reset()
            previous = None
    return counts


@pytest.mark.long
@pytest.mark.parametrize(("sticky", "random"), [(0.25, 0.0), (0.0, 0.4), (0.5, 0.5), (1.0, 0.5), (0.0, 1.0)])
def test_the_first_executed_action_has_the_distribution_of_the_tabular_mdp(sticky, random, breakout):
    chance = pharos.random_actions(pharos.sticky_actions(breakout.mdp(), sticky), random).chance
    simulator = GymEnv(breakout.environment, sticky=sticky, random=random).simulator
    numbers = (np.arange(30_000) + 0.5) / 30_000
    share = np.mean([simulator.executed(1, NO_ACTION, u) == 1 for u in numbers])
    assert share == pytest.approx(chance.first_chosen + chance.first_uniform / 3, abs=1e-4)


@pytest.mark.parametrize(("sticky", "random"), [(0.25, 0.0), (0.0, 0.4), (0.25, 0.4), (1.0, 0.0), (0.0, 1.0)])
def test_the_executed_action_has_the_distribution_of_the_tabular_mdp(sticky, random, breakout):
    from scipy.stats import chi2

    chance = pharos.random_actions(pharos.sticky_actions(breakout.mdp(), sticky), random).chance
    env = GymEnv(breakout.environment, sticky=sticky, random=random)
    assert (chance.chosen, chance.previous, chance.uniform) == pytest.approx(env.simulator.chance)
    counts = executed_counts(env, 20_000, seed=3)
    statistic, freedom = 0.0, 0
    for previous, chosen in np.ndindex(3, 3):
        probabilities = np.full(3, chance.uniform / 3)
        probabilities[chosen] += chance.chosen
        probabilities[previous] += chance.previous
        expected = probabilities * counts[previous, chosen].sum()
        possible = probabilities > 1e-12
        assert counts[previous, chosen][~possible].sum() == 0
        statistic += ((counts[previous, chosen] - expected)[possible] ** 2 / expected[possible]).sum()
        freedom += possible.sum() - 1
    assert chi2.sf(statistic, max(freedom, 1)) > 1e-3 or statistic == 0


def test_the_first_action_of_an_episode_is_executed_under_sticky_actions():
    env = GymEnv("breakout", sticky=1.0)
    for seed in range(20):
        env.reset(seed=seed)
        assert env.step(2)[-1]["executed_action"] == 2
        assert env.step(0)[-1]["executed_action"] == 2  # ever since
    env = GymEnv("breakout", sticky=1.0, initial_previous_action=1)  # as in the Arcade Learning Environment
    env.reset(seed=0)
    assert env.step(2)[-1]["executed_action"] == 1


def test_the_same_seed_gives_the_same_episode():
    def episode(seed):
        env = gymnasium.make("pharos/Freeway-v0", num_cars=4, sticky=0.3, random=0.1)
        observation, _ = env.reset(seed=seed)
        actions = np.random.default_rng(0).integers(3, size=100)
        return [observation.tolist(), *((step[0].tolist(), *step[1:4]) for step in map(env.step, actions))]

    assert episode(5) == episode(5)
    assert episode(5) != episode(6)


def test_an_episode_is_truncated_at_the_time_limit():
    for limit, expected in ((7, 7), ("default", 1000)):
        env = GymEnv("freeway", time_limit=limit)
        env.reset(seed=0)
        steps = [env.step(0) for _ in range(expected)]
        assert [truncated for *_, truncated, _ in steps] == [False] * (expected - 1) + [True]
        assert not any(terminated for _, _, terminated, _, _ in steps)
    env = GymEnv("freeway", time_limit=None)
    env.reset(seed=0)
    assert not any(env.step(0)[3] for _ in range(3000))


def test_gymnasiums_max_episode_steps_is_a_limit_too():
    env = gymnasium.make("pharos/Freeway-v0", max_episode_steps=5)
    env.reset(seed=0)
    assert [env.step(0)[3] for _ in range(5)] == [False] * 4 + [True]


@pytest.mark.long
def test_an_episode_starts_where_the_options_say(breakout):
    env = GymEnv(breakout.environment, space=breakout, observation="index")
    terminal = int(np.flatnonzero(breakout.terminal)[0])
    for i in (5, breakout.num_states // 2, terminal):
        index, info = env.reset(options={"state": breakout.state(i)})
        assert index == i == info["index"]
        assert env.state == breakout.state(i) == tuple(info["state"])
    _, reward, terminated, _, info = env.step(0)  # after the end nothing changes
    assert (reward, terminated, tuple(info["state"]), info["index"]) == (0.0, True, breakout.state(terminal), terminal)
    with pytest.raises(ParameterError, match="ball_row = 7; expected 0 to 6"):
        env.reset(options={"state": (7, *breakout.state(0)[1:])})
    assert "expected 13 integers" in refusal(ParameterError, env.reset, options={"state": (1, 2)})


def test_what_was_handed_out_is_not_overwritten_and_may_be_changed():
    env = GymEnv("breakout")
    observation, info = env.reset(seed=0)
    kept = observation.copy(), info["state"].copy()
    info["state"][:] = 0
    observation[:] = 0
    first, _, _, _, info = env.step(1)
    env.reset(seed=0)
    again, _, _, _, info_again = env.step(1)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(info["state"], info_again["state"])
    np.testing.assert_array_equal(env.reset(seed=0)[0], kept[0])


def test_the_previous_action_and_the_remaining_time_are_appended_to_a_vector():
    env = GymEnv("breakout", sticky=0.5, previous_action=True, remaining_time=True, time_limit=10)
    observation, _ = env.reset(seed=0)
    size = len(env.environment.components)
    assert observation.shape == env.observation_space.shape == (size + 3 + 1,)
    np.testing.assert_array_equal(observation[size:], [0, 0, 0, 1])
    for k in range(1, 11):
        observation, _, _, truncated, info = env.step(k % 3)
        expected = np.zeros(3)
        expected[info["executed_action"]] = 1
        np.testing.assert_allclose(observation[size:], [*expected, 1 - k / 10], atol=1e-6)
    assert truncated
    assert "without a time limit" in refusal(ParameterError, GymEnv, "breakout", remaining_time=True, time_limit=None)


def test_the_previous_action_and_the_remaining_time_stand_beside_other_observations():
    env = GymEnv("breakout", observation="one_hot", previous_action=True, remaining_time=True, time_limit=4)
    observation, _ = env.reset(seed=0)
    assert observation["previous_action"] == 3 and observation["remaining_time"] == [1.0]
    observation, _, _, _, info = env.step(2)
    assert observation["previous_action"] == info["executed_action"] == 2
    assert observation["remaining_time"] == [0.75]
    assert env.observation_space.contains(observation)
    check_env(GymEnv("breakout", observation="one_hot", previous_action=True, sticky=0.25), skip_render_check=True)


def test_a_spec_survives_the_way_through_json():
    env = gymnasium.make("pharos/SimpleGrid-v0", height=5, rewards="2,2:0.1", observation="one_hot", sticky=0.25)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.environment == env.unwrapped.environment
    assert again.observation_space == env.observation_space
    assert json.loads(env.spec.to_json())["kwargs"]["sticky"] == 0.25


def test_any_named_instance_can_be_made_through_gymnasium():
    env = gymnasium.make("pharos/Environment-v0", environment="breakout/12x10x1")
    assert env.unwrapped.environment == pharos.make("breakout/12x10x1")


@pytest.mark.long
@pytest.mark.parametrize("env_id", ["pharos/Breakout-v0", "pharos:pharos/Breakout-v0"])
def test_gymnasium_finds_the_environments_in_a_fresh_process(env_id):
    heavy = "'numba', 'scipy', 'pandas', 'matplotlib', 'torch', 'stable_baselines3', 'pygame'"
    start = "" if ":" in env_id else "import pharos"
    check = f"assert not [name for name in ({heavy},) if name in sys.modules]"
    made = f"gymnasium.make({env_id!r}, height=9)"
    code = f"import sys, gymnasium\n{start}\n{check}\nprint({made}.reset(seed=0)[1]['state'][0])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["3"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sticky": 1.5}, "sticky=1.5; expected a finite number from 0 to 1"),
        ({"random": "often"}, "random='often'; expected a finite number from 0 to 1"),
        ({"time_limit": 0}, "time_limit is 0; expected a number of steps"),
        ({"initial_previous_action": 3}, "initial_previous_action is 3; expected None or an action from 0 to 2"),
        ({"heigth": 12}, "did you mean 'height'"),
        ({"render_mode": "html"}, "render_mode is 'html'; expected None or one of"),
        ({"observation": "vektor"}, "did you mean 'vector'"),
    ],
)
def test_wrong_options_are_named(options, message):
    assert message in refusal(ParameterError, GymEnv, "breakout", **options)


def test_wrong_use_is_named():
    env = GymEnv("breakout")
    assert "call reset() before" in refusal(gymnasium.error.ResetNeeded, env.step, 0)
    env.reset(seed=0)
    assert "action 3; expected 0 to 2" in refusal(ParameterError, env.step, 3)
    assert "action -1; expected 0 to 2" in refusal(ParameterError, env.step, -1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("observation", "options"),
    (("vector", {}), ("simple_image", {}), ("simple_image", {"scale": 8}), ("simple_image", {"grey": True})),
    ids=str,
)
@pytest.mark.parametrize("name", ("breakout", "freeway", "frozen_lake", "simple_grid"))
def test_what_a_step_returns_is_of_its_state_and_stays_so(name, observation, options):
    """The step draws and writes by itself; nothing that it returned changes later."""
    env = GymEnv(name, observation=observation, observation_options=options, sticky=0.3, random=0.1)
    of_state = observe(env.environment, observation, **options)
    random = np.random.default_rng(0)
    given, info = env.reset(seed=1)
    kept = [(given, info["state"], given.copy(), info["state"].copy())]
    for _ in range(300):
        given, _, terminated, truncated, info = env.step(int(random.integers(env.action_space.n)))
        kept.append((given, info["state"], given.copy(), info["state"].copy()))
        if terminated or truncated:
            given, info = env.reset()
            kept.append((given, info["state"], given.copy(), info["state"].copy()))
    for given, state, given_then, state_then in kept:
        assert (given == given_then).all() and (state == state_then).all()
        assert given.dtype == env.observation_space.dtype and (given == of_state.one(state)).all()
    assert len({state.tobytes() for _, state, _, _ in kept}) > 10


# What Gymnasium's tools ask for -------------------------------------------------------------------------------------


def steps_until_truncated(env):
    """Steps of the same action until the episode is truncated; None where 200 are not."""
    env.reset(seed=0)
    for step in range(1, 201):
        if env.step(0)[3]:
            return step
    return None


@pytest.mark.parametrize(
    ("name", "arguments", "limit"),
    [
        ("pharos/SimpleGrid-v0", {}, 32),
        ("pharos/SimpleGrid-v0", {"height": 20, "width": 20}, 160),
        ("pharos/SimpleGrid-4x4-plain-v0", {}, 32),
        ("pharos/SimpleGrid-v0", {"time_limit": 50}, 50),
        ("pharos/SimpleGrid-v0", {"time_limit": None}, None),
        ("pharos/SimpleGrid-v0", {"max_episode_steps": 9}, 9),
    ],
)
def test_the_specification_says_the_limit_at_which_episodes_are_truncated(name, arguments, limit):
    env = gymnasium.make(name, **arguments)
    assert env.spec.max_episode_steps == limit
    assert steps_until_truncated(env) == limit
    again = gymnasium.make(env.spec)
    assert again.spec.max_episode_steps == limit
    assert steps_until_truncated(again) == limit


def test_the_specification_of_a_vector_environment_says_its_limit():
    vec = gymnasium.make_vec("pharos/SimpleGrid-v0", num_envs=2, height=20, width=20)
    assert vec.spec.max_episode_steps == 160
    assert gymnasium.make_vec("pharos/SimpleGrid-v0", num_envs=2, time_limit=7).spec.max_episode_steps == 7


def test_actions_have_meanings():
    env = gymnasium.make("pharos/Breakout-v0", height=8, columns=4)
    assert env.unwrapped.get_action_meanings() == ["left", "stay", "right"]
    assert pharos.make_vec("frozen_lake", 2).get_action_meanings() == ["left", "down", "right", "up"]


@pytest.mark.long
def test_the_observation_index_builds_its_state_space_so_that_a_specification_survives_json(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    env = gymnasium.make("pharos/FrozenLake-v0", observation="index")
    assert env.observation_space.n == 16
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.observation_space == env.observation_space
    assert env.reset(seed=1)[0] == again.reset(seed=1)[0] == 0


@pytest.mark.long
def test_the_observation_index_says_what_to_do_where_there_are_too_many_states(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("pharos.interaction.simulator.LARGEST_INDEX", 5)
    with pytest.raises(ParameterError, match=r"builds at most 5 states; build it yourself and give space=pharos.build"):
        gymnasium.make("pharos/FrozenLake-v0", observation="index")


def test_a_named_instance_has_an_id_of_its_own():
    env = gymnasium.make("pharos/Breakout-12x8x1-v0")
    assert env.unwrapped.environment == pharos.make("breakout/12x8x1")
    assert gymnasium.make("pharos/Breakout-12x8x1-v0", brick_rows=1).unwrapped.environment.brick_rows == 1
