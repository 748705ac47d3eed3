"""Tabular Q-learning: the compiled loop against its twin, restarts, and what it learns on small instances."""

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive.learning import q_learning
from pharos.agents import QLearning
from pharos.errors import ParameterError, UnknownName
from pharos.mdp import random_actions, sticky_actions
from strategies import FEW, deterministic_mdps, examples, general_mdps, outcome_mdps, probabilities


@pytest.mark.slow
@examples(
    60,
    st.one_of(deterministic_mdps(), outcome_mdps(FEW), general_mdps()),
    probabilities,
    probabilities,
    st.integers(0, 2**32),
    st.booleans(),
    st.sampled_from([0.0, 0.5, 1.0]),
    st.sampled_from(["linear", "exponential"]),
    st.integers(1, 5),
    st.sampled_from([0.0, 0.5]),
    st.integers(0, 3),
)
def test_the_compiled_loop_does_what_its_twin_does(
    mdp, sticky, random, seed, sees, exponent, schedule, limit, noise, delay
):
    mdp = random_actions(sticky_actions(mdp, sticky), random)
    options = {
        "visits_exponent": exponent,
        "sees_previous_action": sees,
        "exploration_schedule": schedule,
        "initial_q": 0.5,
    }
    payment = {"reward_noise": noise, "reward_delay": delay}
    agent = QLearning(mdp, total_steps=80, seed=seed, time_limit=limit, **payment, **options)
    word, noise_word = agent.word[0], agent.noise_word[0]
    agent.learn(30).learn(50)
    table, total, episodes = q_learning(mdp, word, 80, 80, agent.options, limit, noise, delay, noise_word)
    expected = np.full_like(agent.q, 0.5)
    for (key, action), value in table.items():
        expected[key[0] * (mdp.num_actions + 1) + key[1] if sees else key, action] = value
    np.testing.assert_allclose(agent.q, expected, rtol=1e-12, atol=1e-14)
    assert agent.episodes == episodes
    assert agent.sum_of_returns == pytest.approx(total)


def mdp_of(name, **chance):
    env = pharos.make(name)
    mdp = pharos.build(env).mdp(gamma=1.0).with_horizon(env.max_episode_steps)
    mdp = sticky_actions(mdp, chance.get("sticky", 0.0))
    return random_actions(mdp, chance.get("random", 0.0))


@pytest.mark.parametrize(
    "name", ["simple_grid/4x4-plain", "simple_grid/8x8-decoy", "frozen_lake/4x4", "frozen_lake/8x8"]
)
def test_small_instances_are_solved(name):
    mdp = mdp_of(name)
    agent = QLearning(mdp, total_steps=300_000, seed=1, initial_q=1.0, visits_exponent=0.6, learning_rate=0.01)
    agent.learn(300_000)
    optimal = pharos.value_iteration(mdp).value_at_start
    assert pharos.evaluate_policy(mdp, agent.policy_table()).value_at_start == pytest.approx(optimal, abs=1e-12)


def test_values_converge_to_those_of_value_iteration():
    mdp = mdp_of("frozen_lake/4x4").with_gamma(0.9).with_horizon(None)
    agent = QLearning(mdp, total_steps=1, gamma=0.9, visits_exponent=0.7, learning_rate=0.0, time_limit=100, seed=3)
    agent.learn(400_000)
    np.testing.assert_allclose(agent.q.max(axis=1)[0], pharos.value_iteration(mdp).v[0], atol=1e-2)


@pytest.mark.long
def test_an_agent_that_sees_previous_actions_has_a_policy_for_each():
    mdp = mdp_of("simple_grid/4x4-plain", sticky=0.25)
    agent = QLearning(mdp, total_steps=50_000, seed=0, sees_previous_action=True, initial_q=1.0).learn(50_000)
    policy = agent.policy_table()
    assert policy.shape == (mdp.num_states, mdp.num_actions + 1, mdp.num_actions)
    assert (policy.sum(axis=2) == 1).all()
    assert pharos.evaluate_policy(mdp, policy).value_at_start > 0.99


def test_an_agent_goes_on_from_what_was_stored():
    mdp = mdp_of("frozen_lake/4x4", random=0.1)
    whole = QLearning(mdp, total_steps=5000, seed=7).learn(5000)
    first = QLearning(mdp, total_steps=5000, seed=7).learn(1234)
    stored = {name: array.copy() for name, array in first.state().items()}
    second = QLearning(mdp, total_steps=5000, seed=99)
    second.restore(stored)
    second.learn(5000 - 1234)
    assert (second.q == whole.q).all()
    assert second.sum_of_returns == whole.sum_of_returns
    assert not (QLearning(mdp, total_steps=5000, seed=8).learn(5000).q == whole.q).all()


def test_what_belongs_to_another_mdp_is_refused():
    small, large = mdp_of("frozen_lake/4x4"), mdp_of("frozen_lake/8x8")
    with pytest.raises(ParameterError, match="another MDP"):
        QLearning(large, total_steps=1).restore(QLearning(small, total_steps=1).state())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learning_rate": 1.5}, "from 0 to 1"),
        ({"learning_rate": 0}, "nothing is learnt"),
        ({"gamma": -1}, "gamma is -1"),
        ({"exploration_schedule": "cosine"}, "'linear' or 'exponential'"),
        ({"exploration_schedule": "exponential", "exploration_final_eps": 0}, "above 0"),
        ({"initial_q": float("inf")}, "finite"),
    ],
)
def test_hyperparameters_out_of_range_are_refused(options, message):
    with pytest.raises(ParameterError, match=message):
        QLearning(mdp_of("frozen_lake/4x4"), total_steps=10, **options)


def test_unknown_hyperparameters_are_refused():
    with pytest.raises(UnknownName, match="did you mean 'learning_rate'"):
        QLearning(mdp_of("frozen_lake/4x4"), total_steps=10, learning_rat=0.1)
