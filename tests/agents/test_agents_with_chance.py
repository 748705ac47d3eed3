"""Agents and policies on worlds whose rules have chance: what they learn, and what it is worth."""

import itertools

import numpy as np
import pytest

import pharos
from naive import mdp as naive_mdp
from pharos import training
from pharos.training import Task, evaluate_agent
from worlds import ChanceWorld

CLIFF = {"height": 3, "width": 4, "slippery": True}


@pytest.fixture(scope="module")
def task() -> Task:
    return Task.of(pharos.make("cliff_walking", **CLIFF), sticky=0.2)


@pytest.mark.long
def test_q_learning_learns_and_its_regret_is_exact():
    run = training.train("q_learning", pharos.make("cliff_walking", **CLIFF), steps=60_000, seed=0)
    result = run.result
    assert result["exact"] and result["value_uniform"] < result["final_value"] <= result["value_optimal"]
    assert result["normalized_regret"] < 0.5 and result["final_regret"] < 0.1 * abs(result["value_optimal"])


SMALL = {
    "dqn": {"learning_starts": 100, "buffer_size": 2000, "exploration_fraction": 0.5, "learning_rate": 0.002},
    "ppo": {"n_envs": 4, "n_steps": 64, "batch_size": 64, "n_epochs": 2, "learning_rate": 0.002},
}


@pytest.mark.long
@pytest.mark.parametrize("agent", SMALL)
def test_networks_learn_and_their_regret_is_that_of_the_policy_read_off_them(agent, tmp_path):
    """The last policy, asked in every state and solved by an independent route, is worth what the run says."""
    pytest.importorskip("torch")
    env = pharos.make("cliff_walking", height=2, width=3, slippery=True)
    run = training.train(
        agent, env, steps=800, seed=1, evaluation_interval=400, horizon=20, hyperparameters=SMALL[agent], out=tmp_path
    )
    result = run.result
    assert result["exact"]
    policy, task = run.agent, Task(env, horizon=20)
    chosen = np.asarray(policy.action_probabilities(pharos.observe(env, "vector")(task.space.states())))
    chosen = chosen / chosen.sum(axis=1, keepdims=True)
    P, R, start = naive_mdp.augmented(task.mdp)
    rows = np.append(np.repeat(chosen, env.num_actions + 1, axis=0), chosen[:1], axis=0)
    value, best = np.zeros(len(P)), np.zeros(len(P))
    for _ in range(task.horizon_steps):
        value = (rows * (R + P @ value)).sum(axis=1)
        best = (R + P @ best).max(axis=1)
    low, high = task.return_range
    rounding = 20 * env.num_actions * 2.0**-22 * (high - low)  # of probabilities in single precision, at each step
    assert result["final_value"] == pytest.approx(start @ value, abs=rounding)
    assert result["value_optimal"] == pytest.approx(start @ best, abs=1e-6)
    assert result["final_regret"] == pytest.approx(start @ (best - value), abs=rounding + 1e-6)
    assert result["value_worst"] <= result["final_value"] <= result["value_optimal"]
    assert run.curve[-1]["expected_regret"] == pytest.approx(result["final_regret"], abs=1e-9)


@pytest.mark.long
def test_policies_over_observations_are_worth_what_their_tables_are(task):
    policy = np.random.default_rng(0).dirichlet(np.ones(4), task.space.num_states)
    vectors = pharos.observe(task.env, "vector")(task.space.states())
    number = {row.tobytes(): i for i, row in enumerate(vectors)}

    def seeing(seen):
        return np.stack([policy[number[row.tobytes()]] for row in seen])

    exact = evaluate_agent(seeing, task)
    assert exact.exact
    table = pharos.evaluate_policy(task.mdp, policy)
    assert abs(exact.value - table.value_at_start) <= exact.error_bound + table.error_bound
    estimated = evaluate_agent(seeing, task, max_states=2)
    assert not estimated.exact
    assert abs(estimated.value - table.value_at_start) <= estimated.error_bound + table.error_bound


@pytest.mark.long
@pytest.mark.parametrize("setting", [{"horizon": 3}, {"gamma": 0.5, "horizon": None}])
def test_the_range_of_returns_holds_every_sequence_of_actions_and_outcomes(setting):
    task = Task.of(ChanceWorld(num_positions=20, seed=7, num_starts=2), **setting)
    low, high = task.return_range
    mdp, steps = task.space.mdp(), task.horizon_steps or 5
    returns = []
    for actions in itertools.product(range(2), repeat=steps):
        paths = {(int(start), 0.0) for start in mdp.start_states}
        for step, action in enumerate(actions):
            paths = {
                (following, total + task.gamma**step * float(mdp.rewards[s, action]))
                for s, total in paths
                for following in mdp.dynamics.outcomes(np.array([s]), np.array([action])).states.tolist()
            }
        returns += [total for _, total in paths]
    if task.horizon_steps == 3:
        assert (low, high) == pytest.approx((min(returns), max(returns)), abs=1e-9)
    else:
        later = 3 * 0.5**5 / 0.5  # at most, of what is paid after these steps
        assert min(returns) - later <= low <= min(returns) + later
        assert max(returns) - later <= high <= max(returns) + later
