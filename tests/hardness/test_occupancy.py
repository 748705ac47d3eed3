"""Occupancy measures: the explicit matrices, the expected return, published occupancies."""

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive import mdp as naive_mdp
from naive.mdp import augmented, is_over
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.visitation import occupancy
from pharos.mdp import random_actions, sticky_actions
from refusals import refusal
from strategies import examples, small_mdps


def policies(mdp, data):
    """None, a policy of states, or under sticky actions one that looks at the previous action; and (nodes, A) of it."""
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    size, actions = mdp.num_states, mdp.num_actions
    kind = data.draw(st.sampled_from(["uniform", "actions", "probabilities", "by previous action"]))
    if kind == "uniform":
        return None, np.full((size, actions + 1, actions), 1 / actions)
    if kind == "actions":
        chosen = rng.integers(actions, size=size)
        return chosen, np.repeat(np.eye(actions)[chosen][:, None], actions + 1, axis=1)
    if kind == "by previous action" and mdp.is_sticky:
        p = rng.dirichlet(np.ones(actions), (size, actions + 1))
        return p, p
    p = rng.dirichlet(np.ones(actions), size)
    return p, np.repeat(p[:, None], actions + 1, axis=1)


def explicit(mdp, policy, steps):
    """[(distribution of (s, b) (S, A + 1), chosen (S, A), executed (S, A)) at each step], by the matrices written
    out."""
    P, _, start = augmented(mdp)
    size, actions = mdp.num_states, mdp.num_actions
    flat = np.vstack([policy.reshape(-1, actions), np.full((1, actions), 1 / actions)])
    chain = np.einsum("ia,iaj->ij", flat, P)
    now, found = start * ~is_over(mdp), []
    for _ in range(steps):
        d = now[:-1].reshape(size, actions + 1)
        chosen = (d[:, :, None] * policy).sum(axis=1)
        executed = np.zeros((size, actions))
        for s, b in np.ndindex(size, actions + 1):
            executed[s] += d[s, b] * policy[s, b] @ naive_mdp.executed(mdp, b)
        found.append((d, chosen, executed))
        now = (now @ chain) * ~is_over(mdp)
    return found


@pytest.mark.long
@examples(120, small_mdps(), st.integers(1, 6), st.data())
def test_each_step_is_that_of_the_explicit_matrices(mdp, steps, data):
    policy, rows = policies(mdp, data)
    expected = explicit(mdp, rows, steps)
    for executed in (False, True):
        found = occupancy(mdp, policy, horizon=steps, executed=executed, keep_all=True)
        each = np.array([step[2 if executed else 1] for step in expected])
        np.testing.assert_allclose(found.by_step, each, atol=1e-12)
        np.testing.assert_allclose(found.largest, each.max(axis=0), atol=1e-12)
        np.testing.assert_allclose(found.visits, np.tensordot(mdp.gamma ** np.arange(steps), each, axes=1), atol=1e-12)
        assert (found.steps, found.error_bound) == (steps, 0.0)


@pytest.mark.long
@examples(120, small_mdps(), st.integers(1, 8) | st.none(), st.data())
def test_the_expected_return_is_the_reward_of_what_is_executed(mdp, horizon, data):
    policy, _ = policies(mdp, data)
    found = occupancy(mdp, policy, horizon=horizon, executed=True)
    given = pharos.solvers.uniform_policy(mdp) if policy is None else policy
    value = pharos.evaluate_policy(mdp, given, 1e-9, horizon=horizon).value_at_start
    assert (found.visits * mdp.rewards).sum() == pytest.approx(value, abs=1e-8)


@pytest.mark.slow
@examples(60, small_mdps(), st.data())
def test_chance_does_not_change_how_often_a_state_is_visited_by_actions_chosen_or_executed(mdp, data):
    policy, _ = policies(mdp, data)
    chosen, executed = (occupancy(mdp, policy, executed=each) for each in (False, True))
    np.testing.assert_allclose(chosen.states, executed.states, atol=1e-12)
    assert chosen.visits.sum() <= 1 / (1 - mdp.gamma) + 1e-9
    assert (chosen.visits[np.asarray(mdp.terminal)] == 0).all()


@pytest.mark.slow
def test_uniform_play_on_a_lake_is_the_same_with_random_actions():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp()
    plain, random = occupancy(mdp), occupancy(random_actions(mdp, 0.3), executed=True)
    np.testing.assert_allclose(plain.visits, random.visits, atol=1e-8)
    assert plain.error_bound <= 1e-9
    assert plain.to_dict()["visited_pairs"] == (plain.visits > 0).sum()


def test_what_has_no_finite_answer_is_told():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=1.0)
    assert "visits may be infinite" in refusal(UndefinedMeasure, occupancy, mdp)
    assert "give a horizon" in refusal(ParameterError, occupancy, mdp.with_gamma(0.9), keep_all=True)
    assert "whole number" in refusal(ParameterError, occupancy, mdp, horizon=0)
    assert "above 0" in refusal(ParameterError, occupancy, mdp.with_gamma(0.9), tolerance=0)
    assert "expected" in refusal(ParameterError, occupancy, sticky_actions(mdp, 0.5), np.zeros((3, 2)), horizon=4)
