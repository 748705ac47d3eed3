"""Rewards that are paid late or with noise: what is paid adds up to what is earned, and nothing else changes."""

import gymnasium
import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive.learning import paid
from pharos.agents import QLearning
from pharos.errors import ParameterError
from pharos.interaction import GymEnv, make_sb3_vec, make_vec
from pharos.interaction.simulator import RewardChannel
from pharos.solvers import value_iteration
from pharos.training import ChanceSetting, RunConfig, Task
from refusals import refusal
from strategies import examples

GRID = pharos.make("simple_grid", height=3, width=3, rewards=(((0, 1), 0.25), ((1, 0), -0.5)))
SLIPPERY = pharos.make("frozen_lake", slippery=True)
BOTH = {"reward_noise": 0.5, "reward_delay": 2}


@examples(
    100, st.lists(st.lists(st.integers(-3, 3), min_size=1, max_size=8), min_size=1, max_size=4), st.integers(0, 9)
)
def test_what_is_paid_in_an_episode_is_what_was_earned(episodes, delay):
    payment = RewardChannel(ChanceSetting(reward_delay=delay), 1)
    for episode in episodes:
        received = []
        for t, earned in enumerate(episode):
            ended = t == len(episode) - 1
            received.append(payment.pay(np.array([float(earned)]), np.array([True]), np.array([ended]))[0])
            assert received[-1] == paid(episode[: t + 1], delay, ended)
        assert sum(received) == sum(episode)


@pytest.mark.slow
@pytest.mark.parametrize("env", [GRID, SLIPPERY], ids=["grid", "slippery"])
@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_many_environments_pay_late_and_walk_as_before(env, mode):
    options = {"autoreset_mode": mode.upper(), "seed": 3, "time_limit": 7}
    plain, late = make_vec(env, 6, **options), make_vec(env, 6, reward_delay=3, **options)
    seen = [each.reset()[0] for each in (plain, late)]
    rng, sums, ends = np.random.default_rng(0), np.zeros((2, 6)), 0
    due = [[] for _ in range(6)]
    for _ in range(150):
        actions = rng.integers(env.num_actions, size=6)
        steps = [each.step(actions) for each in (plain, late)]
        np.testing.assert_array_equal(steps[0][0], steps[1][0])
        np.testing.assert_array_equal(steps[0][1], steps[1][4]["earned_reward"])
        done = steps[0][2] | steps[0][3]
        for i in range(6):
            if steps[0][4]["executed_action"][i] >= 0 or done[i]:
                due[i].append(steps[0][1][i])
                assert steps[1][1][i] == paid(due[i], 3, done[i])
            else:
                assert steps[1][1][i] == 0.0
            if done[i]:
                due[i] = []
        sums += [steps[0][1], steps[1][1]]
        np.testing.assert_allclose(sums[:, done][0], sums[:, done][1], rtol=0, atol=1e-12)
        ends += done.sum()
        if mode == "disabled" and done.any():
            for each in (plain, late):
                each.reset(options={"reset_mask": done})
    assert ends > 50
    assert seen[0].shape == (6, len(env.components))


def test_noise_has_mean_0_and_its_deviation_and_moves_nothing():
    n, deviation = 4000, 0.5
    options = {"seed": 1, "sticky": 0.25, "autoreset_mode": "DISABLED", "time_limit": None}
    plain, noisy = make_vec(GRID, n, **options), make_vec(GRID, n, reward_noise=deviation, **options)
    plain.reset(), noisy.reset()
    drawn = []
    for action in (1, 2, 0, 3):
        one, two = plain.step(np.full(n, action)), noisy.step(np.full(n, action))
        np.testing.assert_array_equal(one[4]["state"], two[4]["state"])
        drawn.append(two[1] - one[1])
        ended = one[2]
        for each in (plain, noisy):
            each.reset(options={"reset_mask": ended}) if ended.any() else None
    z = np.concatenate(drawn) / deviation
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / z.size)
    assert abs((z**3).mean()) < 4 * np.sqrt(15 / z.size)
    assert abs((z**4).mean() - 3) < 4 * np.sqrt(96 / z.size)
    for one, two in ((0, 1), (1, 2)):
        assert abs(np.corrcoef(drawn[one], drawn[two])[0, 1]) < 4 / np.sqrt(n)


def test_one_seed_gives_one_noise_in_single_and_vector_environments():
    single, many = GymEnv(SLIPPERY, time_limit=9, **BOTH), make_vec(SLIPPERY, 3, time_limit=9, **BOTH)
    actions = np.random.default_rng(2).integers(4, size=100)
    for seed in (4, 5):
        single.reset(seed=seed)
        many.reset(seed=[7, seed, 8])
        over = False
        for action in actions:
            if over:
                many.step(np.zeros(3, int))
                single.reset()
                over = False
                continue
            mine = single.step(action)
            rest = many.step(np.array([0, action, 0]))
            assert mine[1] == rest[1][1]
            assert mine[4]["earned_reward"] == rest[4]["earned_reward"][1]
            over = mine[2] or mine[3]


def test_a_reset_forgets_what_is_due_and_the_end_pays_nothing_more():
    env = GymEnv("simple_grid", height=3, width=3, penalties=(((1, 0), -0.5),), reward_delay=5)
    right, down = (GRID.actions.index(name) for name in ("right", "down"))
    env.reset(seed=0)
    _, reward, *_, info = env.step(down)
    assert (reward, info["earned_reward"]) == (0.0, -0.5)
    env.reset()
    assert sum(env.step(action)[1] for action in (right, right, down, down)) == 1.0
    assert env.step(0)[1] == 0.0  # after the end


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("reward_noise", each) for each in (-1, float("inf"), True)),
        *(("reward_delay", each) for each in (-1, 1.5, True)),
    ],
)
def test_what_cannot_be_paid_is_refused(option, value):
    for make in (GymEnv, Task):
        assert option in refusal(ParameterError, make, GRID, **{option: value})


# Runs -----------------------------------------------------------------------------------------------------------------


def test_values_regret_and_returns_are_of_what_is_earned(tmp_path):
    """With exploration for ever the steps of the agents are the same, whatever they are paid."""
    always = {"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0}
    options = {"steps": 3000, "hyperparameters": always, "evaluation_interval": 1500}
    runs = [
        pharos.train("q_learning", GRID, out=tmp_path / str(i), **chance, **options)
        for i, chance in enumerate([{}, {"reward_noise": 1.0}, {"reward_delay": 2}, {**BOTH, "lazy": 0.0}])
    ]
    for run in runs[1:]:
        for name in ("value_optimal", "value_uniform", "mean_return", "episodes", "cumulative_realised_regret"):
            assert run.result[name] == runs[0].result[name], name
        assert run.result["exact"]
    assert len({RunConfig.from_dict(run.config).id for run in runs}) == 4
    assert runs[3].config["chance"] == {"sticky": 0.0, "random": 0.0, **BOTH}
    assert RunConfig.from_dict(runs[3].config).task().chance == ChanceSetting(**BOTH)


def test_q_learning_goes_on_from_what_is_due():
    mdp = pharos.build(GRID).mdp(gamma=0.9).with_horizon(7)
    whole, first, second = (QLearning(mdp, total_steps=500, seed=3, reward_noise=0.3, reward_delay=4) for _ in range(3))
    second.restore({name: array.copy() for name, array in first.learn(123).state().items()})
    assert (whole.learn(500).q == second.learn(377).q).all()


def test_q_learning_finds_the_optimal_policy_under_noise():
    mdp = pharos.build(GRID).mdp(gamma=0.9)
    options = {"visits_exponent": 0.7, "learning_rate": 0.001, "gamma": 0.9, "exploration_final_eps": 0.5}
    agent = QLearning(mdp, total_steps=300_000, seed=0, time_limit=30, reward_noise=0.5, **options).learn(300_000)
    assert abs(agent.q[mdp.start_states].max() - value_iteration(mdp).value_at_start) < 0.1


@pytest.mark.long
def test_dqn_and_ppo_are_paid_late_and_measured_by_what_they_earn():
    for agent, options in (("dqn", {"learning_starts": 50, "buffer_size": 1000}), ("ppo", {"n_steps": 64})):
        run = pharos.train(agent, GRID, steps=256, hyperparameters=options, evaluation_interval=128, **BOTH)
        assert run.result["exact"]
        assert run.result["value_optimal"] == Task(GRID).reference.optimal
        quarters = 4 * run.result["mean_return"] * run.result["episodes"]  # what is paid is not of that kind
        assert quarters == pytest.approx(round(quarters), abs=1e-6)


def test_the_batched_engine_says_what_it_lacks():
    pytest.importorskip("torch")
    with pytest.raises(ParameterError, match="the engine sb3 has"):
        pharos.train("dqn", GRID, steps=50, engine="batched", observation_options={"irrelevant": 2})


def test_vecenvs_of_stable_baselines3_say_what_was_earned():
    env = make_sb3_vec(GRID, 4, seed=0, time_limit=6, **BOTH)
    plain = make_sb3_vec(GRID, 4, seed=0, time_limit=6)
    env.reset(), plain.reset()
    for step in range(40):
        actions = np.full(4, step % 4)
        rewards = env.step(actions)[1]
        expected = plain.step(actions)[1]
        np.testing.assert_array_equal(env.earned, expected)
        np.testing.assert_array_equal(plain.earned, expected)
        assert (rewards != expected).all()


def test_gymnasium_makes_them():
    env = gymnasium.make("pharos/SimpleGrid-v0", height=3, width=3, reward_delay=1, lazy=0.1)
    assert env.unwrapped.simulator.lazy == 0.1
    env.reset(seed=0)
    assert "earned_reward" in env.step(0)[4]
