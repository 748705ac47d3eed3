"""What an agent has learnt is evaluated exactly on the states that it reaches; estimates agree within their confidence."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pharos
from pharos.errors import ParameterError
from pharos.experiments import Task, evaluate_agent

CHANCE = [{}, {"random": 0.2}, {"sticky": 0.25}, {"sticky": 0.25, "random": 0.2}]


def table_of(task, policy):
    """(S, A) answers of a function of observations."""
    return policy(pharos.observe(task.env, task.observation)(task.space.states()))


def linear(task, seed, sharp):
    """A policy that depends on the observation in some way: softmax of a random linear map; `sharp`: its maximum."""
    weights = np.random.default_rng(seed).normal(size=(64, task.env.num_actions))

    def policy(observations):
        scores = 5 * observations.reshape(len(observations), -1) @ weights[: observations[0].size]
        if sharp:
            return scores.argmax(axis=1)
        scores = np.exp(scores - scores.max(axis=1, keepdims=True))
        return scores / scores.sum(axis=1, keepdims=True)

    return policy


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["simple_grid/4x4-decoy", "frozen_lake/4x4", "frozen_lake/8x8"]),
    st.sampled_from(CHANCE),
    st.sampled_from([{}, {"horizon": 7}, {"gamma": 0.9, "horizon": None}]),
    st.integers(0, 1000),
    st.booleans(),
)
def test_the_value_on_reached_states_is_the_value_on_all(name, chance, setting, seed, sharp):
    task = Task.of(name, **chance, **setting)
    policy = linear(task, seed, sharp)
    found = evaluate_agent(policy, task)
    expected = pharos.evaluate_policy(task.mdp, table_of(task, policy), 1e-9).value_at_start
    assert found.exact
    assert found.value == pytest.approx(expected, abs=2e-6)
    assert found.states <= task.mdp.num_states * (task.mdp.num_actions + 1)


@pytest.mark.parametrize("chance", CHANCE)
@pytest.mark.parametrize("sharp", [True, False])
def test_estimates_agree_with_exact_values_within_their_confidence(chance, sharp):
    task = Task.of("frozen_lake/4x4", **chance)
    outside = 0
    for seed in range(20):
        policy = linear(task, seed, sharp)
        exact = evaluate_agent(policy, task)
        estimate = evaluate_agent(policy, task, max_states=0, episodes=400, seed=seed)
        assert not estimate.exact and estimate.episodes == 400
        outside += abs(estimate.value - exact.value) > estimate.error_bound + 1e-9
    assert outside == 0  # 20 intervals that hold with 99 % each, and are wider than needed


@pytest.mark.parametrize("chance", CHANCE)
def test_a_policy_that_sees_the_previous_action_is_evaluated_on_pairs(chance):
    task = Task.of("frozen_lake/4x4", previous_action=True, **chance)
    repeat = 0.7

    def policy(observations):
        previous = observations[:, -4:]
        return repeat * previous + (1 - repeat * previous.sum(axis=1, keepdims=True)) / 4

    exact = evaluate_agent(policy, task)
    estimate = evaluate_agent(policy, task, max_states=0, episodes=20_000)
    assert exact.exact
    assert exact.value == pytest.approx(estimate.value, abs=estimate.error_bound)


def test_the_optimal_policy_has_the_optimal_value_and_reaches_few_states():
    task = Task.of("simple_grid/8x8-plain", gamma=0.95, horizon=None)
    best = {tuple(task.space.state(s)): a for s, a in enumerate(task.optimal.policy)}
    observed = pharos.observe(task.env, "vector")(task.space.states())
    actions = {row.tobytes(): best[tuple(task.space.state(s))] for s, row in enumerate(observed)}
    found = evaluate_agent(lambda seen: np.array([actions[row.tobytes()] for row in seen]), task)
    assert found.value == pytest.approx(task.optimal.value_at_start, abs=1e-6)
    assert found.states == 14


def test_tables_are_agents_too():
    task = Task.of("frozen_lake/4x4")
    table = np.full((task.mdp.num_states, 4), 0.25)
    assert evaluate_agent(table, task).value == pytest.approx(task.uniform.value_at_start)


@pytest.mark.parametrize(
    ("agent", "message"),
    [
        (3, "expected a policy table"),
        (lambda seen: np.full(len(seen), 9), "expected 0 to 3"),
        (lambda seen: np.zeros((len(seen), 2)), r"expected \(1, 4\) probabilities"),
        (lambda seen: np.full((len(seen), 4), 0.5), "sum to 2; expected 1"),
        (lambda seen: np.full((len(seen), 4), np.nan), "probabilities"),
    ],
)
def test_what_is_no_policy_is_refused(agent, message):
    with pytest.raises(ParameterError, match=message):
        evaluate_agent(agent, Task.of("frozen_lake/4x4"))


def test_a_task_needs_a_horizon_or_a_discount():
    with pytest.raises(ParameterError, match="give a horizon"):
        Task.of("frozen_lake/4x4", horizon=None)
    assert Task.of("frozen_lake/4x4").horizon == 100
