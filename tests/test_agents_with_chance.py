"""Agents and policies on worlds whose rules have chance: what they learn, and what it is worth."""

import itertools

import numpy as np
import pytest

import pharos
from chance_worlds import ChanceWorld
from pharos import experiments
from pharos.experiments import Task, evaluate_agent

CLIFF = {"height": 3, "width": 4, "slippery": True}


@pytest.fixture(scope="module")
def task() -> Task:
    return Task.of(pharos.make("cliff_walking", **CLIFF), sticky=0.2)


def test_q_learning_learns_and_its_regret_is_exact():
    run = experiments.train("q_learning", pharos.make("cliff_walking", **CLIFF), steps=60_000, seed=0)
    result = run.result
    assert result["exact"] and result["value_uniform"] < result["final_value"] <= result["value_optimal"]
    assert result["normalized_regret"] < 0.5 and result["final_regret"] < 0.1 * abs(result["value_optimal"])


@pytest.mark.slow
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
