"""Long-run averages against rational numbers and every policy, published values, theorems and textbooks."""


import numpy as np
import pytest
from hypothesis import strategies as st
from test_total_reward import mdps_with_cycles

import pharos
from naive import average as naive
from strategies import deterministic_mdps, examples, small_mdps

CHAINS = mdps_with_cycles(rewards=(-1.0, 0.0, 1.0, 0.1, 3.0))


def is_within(bounds, exact):
    """Whether exact numbers {state: number} are within the bounds, and these near enough."""
    return all(bounds.lower[s] <= x <= bounds.upper[s] for s, x in exact.items())


def by_state(mdp, of_node, sign=1, action=None):
    """{state: number} of an episode's first step, from {node: number}; the best choice, or an action."""
    result = {}
    for s in np.flatnonzero(~np.asarray(mdp.terminal)).tolist():
        choices = naive.first_steps(mdp, s)
        numbers = [sum(p * of_node[m] for m, p in after.items()) for _, after in choices]
        result[s] = sign * max(sign * x for x in numbers) if action is None else numbers[action[s]]
    return result


def check(mdp, policy, sign):
    expected = naive.best_gains(mdp, sign) | {None: 0}
    tolerance = 1e-6
    result = pharos.average_reward(mdp, policy, tolerance=tolerance)
    assert is_within(result.gain, by_state(mdp, expected, sign))
    assert (result.gain.upper - result.gain.lower).max() <= 2 * tolerance
    # the policy attains it
    again = pharos.average_reward(mdp, result.policy, tolerance=tolerance)
    assert np.abs(again.gain.lower - result.gain.lower).max() <= 3 * tolerance


@examples(300, CHAINS, st.sampled_from([("optimal", 1), ("worst", -1)]))
def test_gains_are_those_of_the_best_policy_of_all(mdp, kind):
    check(mdp, *kind)


@examples(200, deterministic_mdps(max_states=4))
def test_cycles(mdp):
    check(mdp, None, 1)


@pytest.mark.long
@examples(200, small_mdps(max_states=3))
def test_every_kind_of_mdp_and_chance(mdp):
    if mdp.num_actions ** (mdp.num_states * mdp.width) <= 300:
        check(mdp, None, 1)


def check_policy(mdp, actions):
    gain, bias = naive.gains_and_biases(naive.chain_of(mdp, actions))
    result = pharos.average_reward(mdp, actions)
    exact = by_state(mdp, gain, action=actions)
    assert is_within(result.gain, exact)
    assert is_within(result.bias, bias_by_state(mdp, bias, exact, actions))
    assert (result.gain.upper - result.gain.lower).max() <= 2e-6


def bias_by_state(mdp, bias, gain, actions):
    steps = {s: naive.first_steps(mdp, s)[actions[s]] for s in gain}
    return {s: r - gain[s] + sum(p * bias[m] for m, p in after.items()) for s, (r, after) in steps.items()}


@examples(300, CHAINS, st.data())
def test_gain_and_bias_of_policies(mdp, data):
    check_policy(mdp, np.array([data.draw(st.integers(0, mdp.num_actions - 1)) for _ in range(mdp.num_states)]))


@pytest.mark.long
@examples(200, small_mdps(max_states=3), st.data())
def test_gain_and_bias_of_policies_under_every_chance(mdp, data):
    check_policy(mdp, np.array([data.draw(st.integers(0, mdp.num_actions - 1)) for _ in range(mdp.num_states)]))
