"""What an agent has learnt is evaluated exactly on the states that it reaches; estimates agree within their
confidence."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from pharos.errors import ParameterError
from pharos.training import Task, evaluate_agent, train
from refusals import refusal
from strategies import examples

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


@pytest.mark.long
@examples(
    60,
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["simple_grid/4x4-decoy", "frozen_lake/8x8"])
@pytest.mark.parametrize("setting", [{"horizon": 7}, {"gamma": 0.9, "horizon": None}, {"gamma": 0.0, "horizon": None}])
@pytest.mark.parametrize("chance", CHANCE)
def test_estimates_agree_in_every_setting(name, setting, chance):
    task = Task.of(name, **setting, **chance)
    for seed in range(5):
        policy = linear(task, seed, sharp=False)
        exact = evaluate_agent(policy, task)
        estimate = evaluate_agent(policy, task, max_states=0, episodes=1000, seed=seed)
        assert abs(estimate.value - exact.value) <= estimate.error_bound + exact.error_bound


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


@pytest.mark.parametrize("chance", CHANCE)
@pytest.mark.parametrize("setting", [{"horizon": 6}, {"gamma": 0.9, "horizon": None}])
@pytest.mark.parametrize("sharp", [True, False])
@pytest.mark.parametrize("sees_previous", [True, False])
def test_policies_that_see_observations_have_the_values_of_their_table_wherever_they_get(
    chance, setting, sharp, sees_previous
):
    task = Task.of("frozen_lake/4x4", **chance, **setting)
    sees_previous = sees_previous and task.mdp.is_sticky
    policy, states = linear(task, 3, sharp), task.space.states()
    table, options = table_of(task, policy), {"observation": "vector"}
    if sees_previous:
        observation, options["previous_action"] = pharos.observe(task.env, "vector")(states), True
        previous = np.concatenate([np.eye(4), np.zeros((1, 4))])
        seen = [np.hstack([np.tile(observation[s], (5, 1)), previous]).astype(np.float32) for s in range(len(states))]
        table = np.stack([policy(each) for each in seen])
    found = pharos.evaluate_policy(task.mdp, policy, 1e-9, **options)
    expected = pharos.evaluate_policy(task.mdp, table, 1e-9)
    assert found.value_at_start == pytest.approx(expected.value_at_start, abs=1e-7)
    assert found.v.shape == expected.v.shape
    for mine, whole in ((found.v, expected.v), (found.q, expected.q)):
        known = ~np.isnan(mine)
        np.testing.assert_allclose(mine[known], whole[known], atol=1e-7)
    if task.mdp.is_sticky:
        assert np.isnan(found.v).any()  # the start after some action
    else:
        assert found.v[task.mdp.start_states] == pytest.approx(found.value_at_start)
    assert 1 <= found.states_reached <= len(states)


def test_a_policy_is_asked_only_where_it_gets():
    space = pharos.build(pharos.make("breakout", height=8, columns=4))
    mdp, asked = space.mdp(gamma=0.9), []

    def policy(observations):
        asked.extend(row.tobytes() for row in observations)
        return np.ones(len(observations), np.int64)

    found = pharos.evaluate_policy(mdp, policy, observation="vector")
    expected = pharos.evaluate_policy(mdp, np.ones(mdp.num_states, np.int64))
    assert found.value_at_start == pytest.approx(expected.value_at_start, abs=1e-6)
    assert len(asked) == len(set(asked)) == found.states_reached < mdp.num_states / 10


def test_a_short_horizon_is_no_longer_asked_about():
    task = Task.of("simple_grid/8x8-plain", horizon=3)
    found = evaluate_agent(lambda seen: np.full((len(seen), 4), 0.25), task)
    assert found.states == 6  # at most two steps from the corner
    assert found.value == pytest.approx(task.uniform.value_at_start)


@pytest.mark.parametrize("chance", [{}, {"random": 0.1}, {"sticky": 0.25}])
@pytest.mark.parametrize("gamma", [0.0, 0.1, 0.5])
def test_steps_that_no_longer_matter_are_not_asked_about(chance, gamma):
    length = math.ceil(math.log(1e-10) / math.log(gamma)) + 20 if gamma else 20
    task = Task.of("simple_grid", {"height": 1, "width": length}, gamma=gamma, horizon=None, **chance)
    found = evaluate_agent(lambda seen: np.full(len(seen), task.env.actions.index("right")), task)
    exact = pharos.evaluate_policy(task.mdp, np.full(length, task.env.actions.index("right")), 1e-12)
    assert found.exact
    assert abs(found.value - exact.value_at_start) <= found.error_bound + exact.error_bound
    assert found.states < (length - 10) * (4 if chance.get("sticky") else 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dqn", "ppo"])
@pytest.mark.parametrize("observation", ["vector", "simple_image"])
def test_models_of_stable_baselines_are_policies(name, observation):
    from pharos.agents.sb3 import make_model, vector_environment

    task = Task.of("frozen_lake/4x4", random=0.1, observation=observation)
    model = make_model(name, vector_environment(task, 1, 0), {}, seed=0)
    found = pharos.evaluate_policy(task.mdp, model, observation=observation)
    assert found.value_at_start == pytest.approx(evaluate_agent(model, task).value, abs=2e-6)
    greedy = evaluate_agent(model, task, deterministic=True).value
    observed = task.space.states()
    seen = pharos.observe(task.env, observation)(observed)
    if name == "dqn":
        assert greedy == pytest.approx(found.value_at_start, abs=2e-6)
    else:
        assert greedy != pytest.approx(found.value_at_start, abs=1e-6)
    actions = np.array([int(model.predict(_as_trained(model, each), deterministic=True)[0]) for each in seen])
    assert greedy == pytest.approx(pharos.evaluate_policy(task.mdp, actions).value_at_start, abs=2e-6)
    other = "vector" if observation == "simple_image" else "one_hot"
    with pytest.raises(ParameterError, match="name the observation it was trained on"):
        pharos.evaluate_policy(task.mdp, model, observation=other)


def _as_trained(model, observation):
    moved = observation.ndim == 3 and observation.shape != model.observation_space.shape
    return observation.transpose(2, 0, 1) if moved else observation


def test_what_cannot_be_observed_is_refused():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=0.9)
    policy = linear(Task.of("frozen_lake/4x4"), 0, True)
    given = pharos.TabularMDP.from_arrays([[0, -1]], [[0.0, 1.0]])
    assert "nothing to observe" in refusal(ParameterError, pharos.evaluate_policy, given, policy, observation="vector")
    with pytest.raises(ParameterError, match="its values belong to no state"):
        pharos.evaluate_policy(mdp, policy, observation="vector", previous_action=True)
    with pytest.raises(ParameterError, match="name the observation"):
        pharos.evaluate_policy(mdp, np.zeros(mdp.num_states, int), deterministic=True)
    undiscounted = pharos.evaluate_policy(mdp.with_gamma(1.0), policy, observation="vector")
    assert 0 <= undiscounted.value_at_start <= 1


@pytest.mark.long
@examples(40, st.integers(0, 10**6))
def test_the_most_probable_action_of_a_table_is_that_of_its_rows(seed):
    task = Task.of("frozen_lake/4x4")
    table = np.random.default_rng(seed).dirichlet(np.ones(4), task.mdp.num_states)
    greedy = evaluate_agent(table.argmax(axis=1), task)
    assert evaluate_agent(table, task, deterministic=True).value == greedy.value
    indices = Task.of("frozen_lake/4x4", observation="index")
    found = evaluate_agent(lambda seen: table[seen], indices, deterministic=True)
    assert found.value == pytest.approx(greedy.value)


def test_a_q_learner_is_a_policy():
    learner = train("q_learning", "frozen_lake/4x4", steps=2000).agent
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=0.9)
    found = pharos.evaluate_policy(mdp, learner)
    np.testing.assert_array_equal(found.v, pharos.evaluate_policy(mdp, learner.policy_table()).v)


def test_tables_are_agents_too():
    task = Task.of("frozen_lake/4x4")
    table = np.full((task.mdp.num_states, 4), 0.25)
    assert evaluate_agent(table, task).value == pytest.approx(task.uniform.value_at_start)


@pytest.mark.parametrize(
    ("agent", "message"),
    [
        (3, "expected a policy table"),
        (lambda seen: np.full(len(seen), 9), "expected 0 to 3"),
        (lambda seen: np.zeros((len(seen), 2)), "expected (1, 4) probabilities"),
        (lambda seen: np.full((len(seen), 4), 0.5), "sum to 2; expected 1"),
        (lambda seen: np.full((len(seen), 4), np.nan), "probabilities"),
    ],
)
def test_what_is_no_policy_is_refused(agent, message):
    assert message in refusal(ParameterError, evaluate_agent, agent, Task.of("frozen_lake/4x4"))


def test_a_task_without_a_horizon_has_total_rewards_or_a_discount():
    assert Task.of("frozen_lake/4x4", horizon=None).conventions == {"gamma": 1.0, "horizon": None, "time_limit": 100}
    assert Task.of("frozen_lake/4x4", horizon=None).reference.optimal == 1.0
    assert Task.of("frozen_lake/4x4").horizon == 100


@pytest.mark.parametrize("chance", CHANCE)
@pytest.mark.parametrize("sharp", [True, False])
def test_tables_of_large_spaces_are_looked_up_where_they_are_reached(chance, sharp):
    task = Task.of("frozen_lake/8x8", **chance)
    table = table_of(task, linear(task, 5, sharp))
    whole = evaluate_agent(table, task)
    parts = evaluate_agent(table, task, max_states=task.mdp.num_states - 1)
    assert whole.states == task.mdp.num_states
    assert parts.value == pytest.approx(whole.value, abs=1e-9) or not parts.exact
    if not chance:
        assert parts.exact and parts.states < whole.states
    if task.mdp.is_sticky:
        triple = np.repeat(np.atleast_2d(table if table.ndim == 2 else np.eye(4)[table])[:, None], 5, axis=1)
        pairs = evaluate_agent(triple, task, max_states=63)
        assert pairs.value == pytest.approx(whole.value, abs=max(1e-9, pairs.error_bound))
    assert "the policy has shape" in refusal(ParameterError, evaluate_agent, np.zeros((3, 3), int), task, max_states=10)
