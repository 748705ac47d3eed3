"""Solvers against explicit matrices, and against theorems."""

import re

import numpy as np
import pytest
from hypothesis import strategies as st

from naive import mdp as naive_mdp
from pharos.errors import DivergenceError, ParameterError, PrecisionError
from pharos.mdp import BEST, TabularMDP, random_actions, sticky_actions
from pharos.solvers import evaluate_policy, uniform_policy, uniform_value, value_iteration, worst_value
from pharos.solvers.fixed_point import Backup
from pharos.solvers.policy_iteration import PolicyIteration
from refusals import refusal
from strategies import deterministic_mdps, examples, probabilities, small_mdps

# Rounding of the twins, which solve linear systems in floats. Bounds are held against exact fractions in
# test_error_bounds.py.
TWIN = 1e-9


def as_pairs(mdp, solution):
    """Values of (s, b), b = 0 .. A - 1; (S, A)."""
    return solution.v if mdp.is_sticky else np.repeat(solution.v[:, None], mdp.num_actions, axis=1)


def assert_near(mdp, solution, truth, allowed):
    """Values of all pairs and at the start are those of the nodes of the explicit matrices."""
    _, _, start = naive_mdp.augmented(mdp)
    assert np.abs(as_pairs(mdp, solution) - naive_mdp.by_state(mdp, truth)[:, :-1]).max() <= allowed
    assert abs(solution.value_at_start - start @ truth) <= allowed


@pytest.mark.long
@pytest.mark.parametrize(("solve", "sign"), [(value_iteration, 1), (worst_value, -1)])
@examples(150, small_mdps())
def test_optimal_and_worst_values_are_those_of_the_explicit_matrices(solve, sign, mdp):
    P, R, _ = naive_mdp.augmented(mdp)
    solution = solve(mdp)
    assert solution.error_bound <= 1e-6
    assert_near(mdp, solution, naive_mdp.optimal_values(P, R, mdp.gamma, sign), solution.error_bound + TWIN)


@pytest.mark.long
@examples(150, small_mdps(), st.integers(1, 6))
def test_values_with_a_horizon_are_those_of_backward_induction(mdp, horizon):
    P, R, _ = naive_mdp.augmented(mdp)
    solution = value_iteration(mdp.with_horizon(horizon))
    assert solution.error_bound < 1e-10
    assert_near(mdp, solution, naive_mdp.finite_values(P, R, mdp.gamma, horizon), TWIN)


@pytest.mark.long
@examples(150, small_mdps(), st.data())
def test_values_of_any_stochastic_policy_are_those_of_the_linear_system(mdp, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    looks_back = mdp.is_sticky and data.draw(st.booleans())
    shape = (mdp.num_states, mdp.num_actions + 1, mdp.num_actions) if looks_back else (mdp.num_states, mdp.num_actions)
    policy = rng.dirichlet(np.ones(mdp.num_actions), shape[:-1])
    pairs = policy if looks_back else np.repeat(policy[:, None], mdp.num_actions + 1, axis=1)
    P, R, _ = naive_mdp.augmented(mdp)
    everywhere = np.concatenate([pairs.reshape(-1, mdp.num_actions), np.eye(mdp.num_actions)[:1]])
    solution = evaluate_policy(mdp, policy)
    assert_near(mdp, solution, naive_mdp.values_of(P, R, mdp.gamma, everywhere), solution.error_bound + TWIN)


@pytest.mark.long
@examples(150, deterministic_mdps(), st.integers(0, 2**32))
def test_a_deterministic_policy_on_a_deterministic_mdp_is_evaluated_exactly(mdp, seed):
    actions = np.random.default_rng(seed).integers(mdp.num_actions, size=mdp.num_states)
    exact = evaluate_policy(mdp, actions)
    P, R, _ = naive_mdp.augmented(mdp)
    pairs = np.append(np.repeat(actions, mdp.num_actions + 1), 0)
    truth = naive_mdp.values_of(P, R, mdp.gamma, np.eye(mdp.num_actions)[pairs])
    assert exact.error_bound < 1e-10
    assert np.abs(exact.v - naive_mdp.by_state(mdp, truth)[:, -1]).max() <= exact.error_bound + TWIN


@pytest.mark.long
@examples(150, small_mdps())
def test_the_greedy_policy_of_the_solution_attains_its_value(mdp):
    solution = value_iteration(mdp, 1e-9)
    attained = evaluate_policy(mdp, solution.policy, 1e-9)
    loss = 2 * mdp.gamma * solution.error_bound / (1 - mdp.gamma)
    assert (np.abs(attained.v - solution.v) <= loss + attained.error_bound + solution.error_bound).all()


@pytest.mark.long
@examples(150, deterministic_mdps())
def test_sticky_actions_with_probability_zero_change_nothing(mdp):
    plain, sticky = value_iteration(mdp), value_iteration(sticky_actions(mdp, 0.0))
    assert (plain.v == sticky.v).all()


@pytest.mark.long
@examples(150, deterministic_mdps())
def test_random_actions_with_probability_one_give_the_uniform_policy(mdp):
    randomized = value_iteration(random_actions(mdp, 1.0))
    uniform = evaluate_policy(mdp, uniform_policy(mdp))
    for each in (randomized, uniform_value(mdp)):
        assert np.abs(each.v - uniform.v).max() <= randomized.error_bound + uniform.error_bound


@pytest.mark.long
@examples(150, small_mdps())
def test_uniform_value_is_that_of_the_uniform_policy(mdp):
    direct, policy = uniform_value(mdp), evaluate_policy(mdp, uniform_policy(mdp))
    assert np.abs(direct.v - policy.v).max() <= direct.error_bound + policy.error_bound
    assert abs(direct.value_at_start - policy.value_at_start) <= direct.error_bound + policy.error_bound


@pytest.mark.long
@examples(150, deterministic_mdps(rewards=st.sampled_from([0.0, 0.5, 1.0])), probabilities)
def test_values_grow_with_gamma_where_no_reward_is_negative(mdp, p):
    low, high = (value_iteration(random_actions(mdp.with_gamma(gamma), p)) for gamma in (0.5, 0.9))
    assert (low.v <= high.v + low.error_bound + high.error_bound).all()


@pytest.mark.long
@examples(150, small_mdps(), st.sampled_from([0.5, 2.0, 10.0]))
def test_scaling_rewards_scales_values(mdp, scale):
    one, scaled = value_iteration(mdp), value_iteration(mdp.with_rewards(scale * mdp.rewards))
    assert np.abs(scale * one.v - scaled.v).max() <= scale * one.error_bound + scaled.error_bound


@pytest.mark.long
@examples(150, deterministic_mdps(ends=False), probabilities)
def test_shifting_all_rewards_shifts_values_by_a_geometric_series(mdp, p):
    endless = TabularMDP.from_arrays(mdp.next_states, mdp.rewards, gamma=mdp.gamma)
    shifted = random_actions(endless.with_rewards(mdp.rewards + 1.0), p)
    one, two = value_iteration(random_actions(endless, p)), value_iteration(shifted)
    assert np.abs(one.v + 1 / (1 - mdp.gamma) - two.v).max() <= one.error_bound + two.error_bound + TWIN


@pytest.mark.long
@examples(150, deterministic_mdps(ends=False))
def test_a_closed_part_of_an_mdp_has_the_same_values_alone(mdp):
    reached = {0}
    for _ in range(mdp.num_states):
        reached |= {int(t) for s in reached for t in mdp.next_states[s]}
    part = np.array(sorted(reached))
    number = {int(s): i for i, s in enumerate(part)}
    inside = np.array([[number[int(t)] for t in row] for row in mdp.next_states[part]])
    alone = value_iteration(TabularMDP.from_arrays(inside, mdp.rewards[part], gamma=mdp.gamma))
    whole = value_iteration(mdp)
    assert np.abs(alone.v - whole.v[part]).max() <= alone.error_bound + whole.error_bound


@pytest.mark.long
@examples(150, small_mdps(), st.integers(0, 2**32))
def test_backups_contract_in_the_maximum_norm(mdp, seed):
    backup = Backup(mdp, BEST)
    rng = np.random.default_rng(seed)
    x, y = (rng.normal(size=backup.zeros().shape) for _ in range(2))
    x[-1] = y[-1] = 0
    before, after = np.abs(x - y).max(), np.abs(backup(x, np.empty_like(x)) - backup(y, np.empty_like(y))).max()
    assert after <= mdp.gamma * before + 1e-12


@pytest.mark.long
@examples(150, small_mdps())
def test_a_finer_tolerance_moves_values_by_less_than_the_bounds(mdp):
    coarse, fine = value_iteration(mdp, 1e-2), value_iteration(mdp, 1e-9)
    assert np.abs(coarse.v - fine.v).max() <= coarse.error_bound + fine.error_bound
    assert np.abs(coarse.q - fine.q).max() <= coarse.error_bound + fine.error_bound + TWIN


@pytest.mark.slow
def test_an_established_solver_finds_the_same_values(quantecon):
    rng = np.random.default_rng(0)
    next_states = rng.integers(0, 500, size=(500, 3))
    rewards = rng.normal(size=(500, 3))
    dense = np.zeros((500, 3, 500))
    np.put_along_axis(dense, next_states[:, :, None], 1.0, axis=2)
    theirs = quantecon.markov.DiscreteDP(rewards, dense, 0.95).solve(method="policy_iteration").v
    ours = value_iteration(TabularMDP.from_arrays(next_states, rewards, gamma=0.95))
    assert np.abs(theirs - ours.v).max() <= ours.error_bound + TWIN


def test_all_steps_are_the_values_for_every_number_of_steps_to_go():
    ring = TabularMDP.from_arrays([[1], [2], [0]], [[0.0], [0.0], [1.0]], gamma=1.0, horizon=6)
    steps = value_iteration(ring, keep_all=True).all_steps
    assert steps.tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 1], [1, 1, 1], [1, 1, 2], [1, 2, 2], [2, 2, 2]]


def test_undiscounted_values_of_an_mdp_without_cycles_are_exact():
    path = TabularMDP.from_arrays([[1, 2], [2, -1], [-1, -1]], [[1, 2], [3, 0.5], [4, 1]], gamma=1.0)
    assert value_iteration(path).v.tolist() == [8.0, 7.0, 4.0]


def test_undiscounted_values_that_are_infinite_are_refused():
    ring = TabularMDP.from_arrays([[1], [0]], [[1.0], [1.0]], gamma=1.0)
    assert "give a horizon" in refusal(DivergenceError, value_iteration, ring)
    assert "cycle through state" in refusal(DivergenceError, evaluate_policy, ring, np.array([0, 0]))


def test_a_tolerance_below_what_floats_can_reach_is_refused():
    ring = TabularMDP.from_arrays([[1], [0]], [[1.0], [0.3]], gamma=0.999)
    assert "raise the tolerance" in refusal(PrecisionError, value_iteration, ring, 1e-15)


def test_linear_systems_that_are_too_large_are_never_solved_directly_however_many_sweeps_are_left():
    """2 million nodes times actions at most; under sticky actions nodes are pairs. Of two sweeps the second changes as
    much as the first. What failed is tried again after four times as many."""
    size, actions = 5000, 21
    table = np.tile((np.arange(size) + 1)[:, None] % size, actions)
    slow = TabularMDP.from_arrays(table, np.ones((size, actions)), gamma=1 - 1e-12)
    for mdp, expected in ((random_actions(slow, 0.5), True), (sticky_actions(slow, 0.5), False)):
        decision = PolicyIteration(mdp, BEST)
        assert [decision.is_worth_it(sweeps, 1.0, 1e-6) for sweeps in (128, 256, 512)] == [False, True, True]
        decision.fail()
        assert not decision.is_direct
        decision.fail()
        assert [decision.is_worth_it(sweeps, 1.0, 1e-6) for sweeps in (1024, 2048)] == [False, True]
        assert decision.is_direct == expected


@pytest.mark.parametrize("tolerance", [0, -1, float("nan"), "small"])
def test_a_tolerance_must_be_a_positive_number(tolerance):
    assert "tolerance" in refusal(ParameterError, value_iteration, TabularMDP.from_arrays([[0]], [[0.0]]), tolerance)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (np.array([0, 0, 0]), "3 rows"),
        (np.array([0, 7]), "chooses action 7"),
        (np.array([[0.5, 0.6], [1, 0]]), "sum to 1"),
        (np.array([[np.nan, 1], [1, 0]]), "sum to 1"),
        (np.ones((2, 3)) / 3, "shape"),
        (np.array([0, -1]), r"chooses action -1 at \(1,\); expected 0 to 1"),
        (np.array([[0, 1, 0], [1, 0, 1]]), r"shape \(2, 3\); expected \(2,\) actions$"),
        (np.full((2, 3, 2), 0.5), r"shape \(2, 3, 2\); expected \(2, 2\) probabilities"),
        (np.array([[1, 0], [1.5, -0.5]]), "sum to 1"),
        (np.array([[0.5, 0.5 + 1e-5], [0.3, 0.3]]), r"row \(1,\)"),
        (np.array([[0.5, 0.5 + 1e-5], [1, 0]]), r"row \(0,\)"),
    ],
)
def test_a_policy_that_is_none_gets_a_clear_error(policy, message):
    mdp = TabularMDP.from_arrays([[0, 1], [1, 0]], [[0.0, 1.0], [0.0, 0.0]])
    assert re.search(message, refusal(ParameterError, evaluate_policy, mdp, policy))


def test_rounding_of_probabilities_is_no_error():
    mdp = TabularMDP.from_arrays([[0, 1], [1, 0]], [[0.0, 1.0], [0.0, 0.0]])
    rounded, policy = np.array([[0.5, 0.5 + 1e-8], [1, 0]]), np.array([[0.5, 0.5], [1, 0]])
    assert np.abs(evaluate_policy(mdp, rounded).v - evaluate_policy(mdp, policy).v).max() < 1e-4


def test_under_sticky_actions_a_policy_may_look_at_the_previous_action():
    mdp = sticky_actions(TabularMDP.from_arrays([[0, 1], [1, 0]], [[0.0, 1.0], [2.0, 0.0]], gamma=0.5), 0.25)
    actions = np.array([[0, 1, 0], [1, 1, 0]])
    by_number, by_row = evaluate_policy(mdp, actions), evaluate_policy(mdp, np.eye(2)[actions])
    assert (by_number.v == by_row.v).all() and by_number.value_at_start == by_row.value_at_start
    for wrong in (actions[:, :2], np.eye(2)[actions][:, :2], np.eye(2, dtype=int)[actions]):
        with pytest.raises(ParameterError, match=r"expected .* or \(2, 3"):
            evaluate_policy(mdp, wrong)
