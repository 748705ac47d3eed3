"""Several frames in one image, and entries that mean nothing: what environments show, and what policies are worth."""

import itertools

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import command_line
import pharos
from naive import mdp as naive_mdp
from pharos import training
from pharos.errors import ParameterError
from pharos.interaction import GymEnv, make_sb3_vec, make_vec
from pharos.mdp import PolicyTable
from pharos.observations import aliasing, history_aliasing, observation_classes, observe
from pharos.policies import Evaluation
from pharos.policies.value import QueriedHistories, estimate
from pharos.training import Task, evaluate_agent
from refusals import refusal

BREAKOUT = pharos.make("breakout", height=6, columns=3, brick_rows=1)
WORDS = ["height=6", "columns=3", "brick_rows=1"]
LAKE = pharos.make("frozen_lake/4x4")
SLIPPERY = pharos.make("frozen_lake", slippery=True)
IMAGES = {"simple_image": {"frames": 3}, "complex_image": {"frames": 2, "size": (24, 24), "grey": True}}


def stack_of(env, name, states, options):
    """The frames of the last k states of an episode, one by one, by the observation without `frames`."""
    k = options["frames"]
    options = {key: value for key, value in options.items() if key != "frames"}
    if name == "simple_image":  # more planes may need a larger scale
        options["scale"] = observe(env, name, frames=k).space.shape[1] // env.grid()[0]
    one = observe(env, name, **options)
    last = [states[0]] * k + list(states[1:])
    axis = 0 if name == "simple_image" else 2
    return np.concatenate([one(np.array([state]))[0] for state in last[-k:]], axis=axis)


@pytest.mark.long
@pytest.mark.parametrize("name", IMAGES)
def test_single_and_vector_environments_show_the_last_frames(name):
    options = {"observation": name, "observation_options": IMAGES[name], "time_limit": 9}
    single = GymEnv(BREAKOUT, **options)
    modes = ("NEXT_STEP", "SAME_STEP", "DISABLED")
    rng = np.random.default_rng(0)
    seen, info = single.reset(seed=1)
    states = [tuple(info["state"])]
    for _ in range(40):
        np.testing.assert_array_equal(seen, stack_of(BREAKOUT, name, states, IMAGES[name]))
        assert single.observation_space.contains(seen)
        seen, _, terminated, truncated, info = single.step(int(rng.integers(3)))
        states.append(tuple(info["state"]))
        if terminated or truncated:
            np.testing.assert_array_equal(seen, stack_of(BREAKOUT, name, states, IMAGES[name]))
            np.testing.assert_array_equal(single.step(0)[0], seen) if terminated else None
            seen, info = single.reset()
            states = [tuple(info["state"])]
    spaces = (None, pharos.build(BREAKOUT, progress=False))
    for mode, space in itertools.product(modes, spaces if name == "simple_image" else spaces[:1]):
        env = make_vec(BREAKOUT, 3, autoreset_mode=mode, seed=2, space=space, **options)
        seen, _ = env.reset()
        episodes = [[tuple(state)] for state in env.states.tolist()]
        ended = 0
        for _ in range(40):
            for i in range(3):
                np.testing.assert_array_equal(seen[i], stack_of(BREAKOUT, name, episodes[i], IMAGES[name]))
            over = np.zeros(3, bool) if mode != "NEXT_STEP" else env._ended.copy()
            seen, _, terminated, truncated, info = env.step(rng.integers(3, size=3))
            done, now = terminated | truncated, env.states
            for i in range(3):
                if mode == "SAME_STEP" and done[i]:
                    last = env._stepper.states(env._stepper.final[[i]])[0]
                    expected = stack_of(BREAKOUT, name, [*episodes[i], tuple(last)], IMAGES[name])
                    np.testing.assert_array_equal(info["final_obs"][i], expected)
                    over[i] = True
                episodes[i] = [*(() if over[i] else episodes[i]), tuple(now[i])]
            ended += over.sum()
            if mode == "DISABLED" and done.any():
                seen, _ = env.reset(options={"reset_mask": done})
                for i in np.flatnonzero(done):
                    episodes[i] = [tuple(env.states[i])]
                ended += done.sum()
        assert ended > 5


def test_frames_have_shapes_that_networks_take():
    assert observe(BREAKOUT, "simple_image", frames=2).space.shape == (6, 12, 6)  # scaled, so that channels are fewest
    assert observe(LAKE, "complex_image", frames=4).space.shape == (84, 84, 12)
    assert observe(LAKE, "complex_image", frames=4, channels_first=True, grey=True).space.shape == (4, 84, 84)
    for wrong in (0, -1, 17, True, 2.5, "many"):
        assert "frames is" in refusal(ParameterError, observe, LAKE, "complex_image", frames=wrong)
    with pytest.raises(ParameterError, match="more than rows or columns"):
        observe(LAKE, "complex_image", frames=16, size=(20, 20))
    seen = {"observation": "simple_image", "observation_options": {"frames": 2}}
    env = make_sb3_vec("breakout", 2, height=6, columns=3, **seen)
    assert env.reset().shape == (2, 6, 12, 6)


# What policies are worth ----------------------------------------------------------------------------------------------


def by_pixels(num_actions, seed=0):
    """A policy that looks at every pixel of its stack: probabilities by a hash of it."""

    def policy(seen):
        keys = [np.random.SeedSequence([seed, *row.tobytes()[:4096]]).generate_state(num_actions) for row in seen]
        weights = np.array(keys, float) + 1
        return weights / weights.sum(axis=1, keepdims=True)

    return policy


@pytest.mark.long
@pytest.mark.parametrize("chance", [{}, {"sticky": 0.25}, {"random": 0.2, "lazy": 0.3}])
@pytest.mark.parametrize("env", [LAKE, SLIPPERY], ids=["lake", "slippery"])
def test_a_policy_of_two_frames_is_worth_what_the_mdp_of_histories_says(env, chance):
    """The twin goes through all (state before, state, previous action) forwards, for 6 steps."""
    task = Task(env, observation="simple_image", observation_options={"frames": 2}, horizon=6, **chance)
    policy, mdp = by_pixels(env.num_actions), task.mdp
    states = [tuple(state) for state in task.space.states().tolist()]
    found = evaluate_agent(policy, task)
    mass, value = {}, 0.0
    for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True):
        mass[int(s), int(s), env.num_actions] = float(p)
    asked = {}
    for _ in range(6):
        after = {}
        for (before, s, b), p in mass.items():
            if (before, s) not in asked:
                both = [states[before], states[s]]
                asked[before, s] = policy(stack_of(env, "simple_image", both, {"frames": 2})[None])[0]
            previous = np.array([b]) if mdp.is_sticky else None
            weights = mdp.chance.weights(asked[before, s][None], previous)[0]
            for a, weight in enumerate(weights):
                value += p * weight * mdp.rewards[s, a]
                for t, q in naive_mdp.outcomes(mdp, s, a):
                    if t >= 0 and not mdp.terminal[t]:
                        key = (s, t, a if mdp.is_sticky else env.num_actions)
                        after[key] = after.get(key, 0.0) + p * weight * q
        mass = after
    assert found.exact
    assert found.value == pytest.approx(value, abs=found.error_bound + 1e-12)
    assert found.states == len(asked)


@pytest.mark.slow
def test_beyond_a_limit_the_value_is_estimated_over_histories():
    task = Task(SLIPPERY, observation="simple_image", observation_options={"frames": 2}, horizon=8)
    policy = by_pixels(4, seed=3)
    exact, estimated = evaluate_agent(policy, task), evaluate_agent(policy, task, max_states=3)
    assert exact.exact
    assert not estimated.exact
    assert abs(exact.value - estimated.value) <= estimated.error_bound
    answers = QueriedHistories(policy, task.mdp, task.observer)
    low, high = task.return_range
    value, width = estimate(answers, (low, high), 20_000, np.random.default_rng(0))
    assert abs(value - exact.value) <= width


def test_frames_go_with_no_values_of_states():
    mdp = pharos.build(LAKE).mdp(gamma=0.9)
    options = {"observation": "simple_image", "observation_options": {"frames": 2}}
    assert "values belong to no state" in refusal(ParameterError, pharos.evaluate_policy, mdp, by_pixels(4), **options)
    task = Task(LAKE, previous_action=True, **options)
    assert "several frames and the previous action" in refusal(ParameterError, evaluate_agent, by_pixels(4), task)


# What is told ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_states_are_shared_by_histories_that_look_alike():
    """By a walk through all histories in Python."""
    space = pharos.build(BREAKOUT, progress=False)
    states = [tuple(state) for state in space.states().tolist()]
    one = observe(BREAKOUT, "simple_image")
    pictures = [image.tobytes() for image in one(space.states())]
    for k in (2, 3):
        starts = [(int(s),) * k for s in space.start_states]
        queue, seen = list(starts), {}
        met = set(starts)
        for history in queue:
            seen.setdefault(tuple(pictures[s] for s in history), set()).add(history[-1])
            if not space.terminal[history[-1]]:
                for a in range(3):
                    after = (*history[1:], space.index(BREAKOUT.next_state(states[history[-1]], a)))
                    if after not in met:
                        met.add(after)
                        queue.append(after)
        counts = history_aliasing(space, observe(BREAKOUT, "simple_image", frames=k))
        assert counts.num_observations == len(seen)
        assert counts.num_sharing == len(set().union(*(ends for ends in seen.values() if len(ends) > 1), set()))
        assert counts == aliasing(space, observe(BREAKOUT, "simple_image", frames=k))
    assert counts.num_sharing < aliasing(space, one).num_sharing
    with pytest.raises(ParameterError, match="more than 10 histories of 2 states"):
        history_aliasing(space, observe(BREAKOUT, "simple_image", frames=2), most=10)
    with pytest.raises(ParameterError, match="no function of the state"):
        observation_classes(space, observe(BREAKOUT, "simple_image", frames=2))


# Entries that mean nothing --------------------------------------------------------------------------------------------


def test_irrelevant_entries_are_fair_coins_and_move_nothing():
    options = {"observation_options": {"irrelevant": 4}, "seed": 3, "time_limit": 20, "sticky": 0.25}
    env = make_vec(LAKE, 500, **options)
    plain = make_vec(LAKE, 500, **{**options, "observation_options": {}})
    seen, whole = env.reset()[0], plain.reset()[0]
    assert env.single_observation_space.shape == (6,)
    assert env.simulator.context.names[-1] == "irrelevant[3]"
    coins = []
    for step in range(40):
        np.testing.assert_array_equal(seen[:, :2], whole)
        coins.append(seen[:, 2:])
        actions = np.full(500, step % 4)
        seen, whole = env.step(actions)[0], plain.step(actions)[0]
    thrown = np.stack(coins)  # (40, 500, 4)
    assert set(np.unique(thrown)) == {0.0, 1.0}
    n = thrown.size
    assert abs(thrown.mean() - 0.5) < 4 * 0.5 / np.sqrt(n)
    for one, two in ((thrown[1:], thrown[:-1]), (thrown[:, 1:], thrown[:, :-1]), (thrown[..., 1:], thrown[..., :-1])):
        assert abs(np.corrcoef(one.ravel(), two.ravel())[0, 1]) < 4 / np.sqrt(one.size)


def test_one_seed_throws_the_same_coins_in_single_and_vector_environments():
    options = {"observation_options": {"irrelevant": 3}, "previous_action": True, "remaining_time": True}
    single, many = GymEnv(LAKE, **options), make_vec(LAKE, 2, **options)
    for seed in (1, 2):
        np.testing.assert_array_equal(single.reset(seed=seed)[0], many.reset(seed=[9, seed])[0][1])
        for action in (1, 1, 2):
            np.testing.assert_array_equal(single.step(action)[0], many.step(np.array([0, action]))[0][1])
    assert single.observation_space.shape == (2 + 3 + 4 + 1,)
    check_env(GymEnv(LAKE, **options), skip_render_check=True)


def test_a_policy_that_looks_at_coins_is_worth_that_of_its_mean():
    rng = np.random.default_rng(0)
    table = rng.dirichlet(np.ones(4), (16, 2, 2))

    def policy(seen):
        index = (seen[:, :2] * 3).round().astype(int) @ [4, 1]
        first, second = seen[:, 2:].astype(int).T
        return table[index, first, second]

    task = Task(SLIPPERY, observation_options={"irrelevant": 2}, horizon=10, sticky=0.2)
    found = evaluate_agent(policy, task)
    places = (task.space.states() @ [4, 1]).astype(int)
    expected = pharos.evaluate_policy(task.mdp, table.mean(axis=(1, 2))[places])
    assert isinstance(expected.select, PolicyTable)
    assert found.exact
    assert abs(found.value - expected.value_at_start) <= found.error_bound + expected.error_bound


def test_irrelevant_entries_alias_nothing_and_are_few():
    space = pharos.build(LAKE)
    assert aliasing(space, observe(LAKE, "vector", irrelevant=3)).num_sharing == 0
    for wrong in (-1, 11, True, "3"):
        assert "irrelevant is" in refusal(ParameterError, observe, LAKE, "vector", irrelevant=wrong)


# Runs -----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "observation", "options"),
    [
        ("dqn", "simple_image", {"frames": 2}),
        ("ppo", "simple_image", {"frames": 3}),
        ("dqn", "vector", {"irrelevant": 3}),
    ],
)
def test_runs_are_measured_exactly(agent, observation, options, tmp_path, monkeypatch):
    given = {"learning_starts": 50, "buffer_size": 1000} if agent == "dqn" else {"n_steps": 64}
    seen = {"observation": observation, "observation_options": options}
    setting = {"steps": 200, "hyperparameters": given, "evaluation_interval": 100, "horizon": 20}
    run = pharos.train(agent, BREAKOUT, out=tmp_path / "run", **seen, **setting)
    assert run.result["exact"]
    assert 0 <= run.result["final_regret"] <= run.result["value_optimal"] - Task(BREAKOUT, horizon=20).reference.worst
    assert run.config["observation_options"] == options
    evaluate = ["evaluate", "breakout", *WORDS, "--policy", tmp_path / "run", "--horizon", 20]
    answer = command_line.answer(*evaluate)
    assert (answer["exact"], answer["episodes"]) == (True, 0)
    assert answer["value_at_start"] == pytest.approx(run.result["final_value"], abs=1e-6)
    assert answer["regret"] == pytest.approx(run.result["final_regret"], abs=2e-6)
    if "frames" in options:
        monkeypatch.setattr(training, "evaluate_agent", lambda *_: Evaluation(0.5, False, 0.25, 9, 2000))
        told = command_line.run(*evaluate)  # whose lines are as long as the name of the folder lets them be
        assert "0.25 with a probability of 99 % (estimated from 2,000 episodes)" in " ".join(told.stdout.split())
    if "irrelevant" in options:
        batched = {"steps": 50, "engine": "batched", **seen}
        assert "batched engine" in refusal(ParameterError, pharos.train, agent, BREAKOUT, **batched)
