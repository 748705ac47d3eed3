"""The promise of solvers: every value is within `error_bound` of the true one.

Held against exact fractions, without slack.
"""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy import sparse

from naive import exact as naive_exact
from pharos import hardness
from pharos.errors import ParameterError, PrecisionError
from pharos.mdp import (
    Matrices,
    TabularMDP,
    mdp_within,
    random_actions,
    sticky_actions,
)
from pharos.solvers import evaluate_policy, uniform_value, value_iteration, worst_value
from pharos.solvers.policy_iteration import PolicyIteration
from refusals import refusal
from strategies import acyclic_mdps, examples, hard_mdps


def finest(solve, *arguments):
    """The solution to the finest tolerance that 64-bit floats reach."""
    for exponent in range(-13, 40):
        try:
            solution = solve(*arguments, 10.0**exponent)
        except PrecisionError:
            continue
        assert solution.error_bound <= 10.0**exponent
        return solution
    raise AssertionError("no tolerance was met")


def largest_error(solution, truth):
    found = solution.v if solution.mdp.is_sticky else solution.v[:, None]
    return naive_exact.largest_error(found, truth)


def drawn_policy(mdp, seed):
    """Probabilities of a state, or of it and the previous action under sticky actions."""
    shape = (mdp.num_states, mdp.num_actions + 1) if mdp.is_sticky else (mdp.num_states,)
    return np.random.default_rng(seed).dirichlet(np.ones(mdp.num_actions), shape)


def assert_policy_is_within_its_bound(mdp, policy, normalise=False):
    """Evaluated as finely as can be, against exact fractions of what is given, or of its rows with a sum of 1."""
    solution = finest(evaluate_policy, mdp, policy)
    exact = naive_exact.exact(policy if mdp.is_sticky else policy[:, None])
    exact = exact / exact.sum(axis=-1, keepdims=True) if normalise else exact
    assert largest_error(solution, naive_exact.values_of(mdp, exact)) <= Fraction(solution.error_bound)


@pytest.mark.slow
@examples(150, hard_mdps())
def test_optimal_and_worst_values_are_within_their_bounds(mdp):
    for solve, sign in ((value_iteration, 1), (worst_value, -1)):
        solution, truth = finest(solve, mdp), naive_exact.extreme_values(mdp, sign)
        assert largest_error(solution, truth) <= Fraction(solution.error_bound)
        if mdp.is_sticky or not mdp.is_random:
            action_values = naive_exact.action_values(mdp, truth)
            assert naive_exact.largest_error(solution.q, action_values) <= Fraction(solution.error_bound)


@pytest.mark.slow
@examples(150, hard_mdps())
def test_values_of_uniform_play_are_within_their_bound(mdp):
    solution = finest(uniform_value, mdp)
    nothing = naive_exact.exact(np.zeros((mdp.num_states, 1, mdp.num_actions)))
    assert largest_error(solution, naive_exact.values_of(solution.mdp, nothing)) <= Fraction(solution.error_bound)


@pytest.mark.long
@examples(150, hard_mdps(), st.integers(0, 2**32))
def test_values_of_a_stochastic_policy_are_within_their_bound(mdp, seed):
    assert_policy_is_within_its_bound(mdp, drawn_policy(mdp, seed))


@pytest.mark.long
@examples(150, hard_mdps(), st.integers(0, 2**32), st.sampled_from([1.0, 1 + 8e-7, 1 - 8e-7]))
def test_rows_that_nearly_sum_to_1_are_normalised_and_the_bound_counts_it(mdp, seed, factor):
    """Those of a softmax in float32, and rows that somebody multiplied."""
    policy = drawn_policy(mdp, seed).astype(np.float32)
    policy = policy if factor == 1 else policy.astype(np.float64) * factor
    assert_policy_is_within_its_bound(mdp, policy, normalise=True)


@pytest.mark.parametrize("factor", [1.0, 1 + 8e-7])
def test_over_a_thousand_steps_a_softmax_in_float32_gains_nothing_by_its_rounding(factor):
    rewards = np.array([[700.0, 0.0, 1.0], [0.0, 350.0, 2.0]])
    mdp = TabularMDP.from_arrays([[0, 1, 1], [0, 1, 0]], rewards, gamma=1.0, horizon=1000)
    scores = np.exp(np.array([[1.0, 0.3, -2.0], [0.5, 0.1, 0.9]], np.float32))
    policy = (scores / scores.sum(axis=1, keepdims=True)).astype(np.float64) * factor
    rows = naive_exact.exact(policy) / naive_exact.exact(policy).sum(axis=1, keepdims=True)
    v = [Fraction(0), Fraction(0)]
    for _ in range(1000):
        ahead = [
            sum(p * (Fraction(r) + v[t]) for p, r, t in zip(rows[s], rewards[s], mdp.next_states[s], strict=True))
            for s in range(2)
        ]
        v = [Fraction(round(each * 2**300), 2**300) for each in ahead]
    solution = evaluate_policy(mdp, policy)
    as_given = 1000 * float(max(abs(policy.sum(axis=1) - 1))) * 350
    assert abs(Fraction(float(solution.v[0])) - v[0]) <= Fraction(solution.error_bound) + Fraction(1, 2**200)
    assert solution.error_bound < as_given / 100  # what was lacking, or too much, weighed more
    assert solution.value_at_start <= value_iteration(mdp).value_at_start


@pytest.mark.long
@examples(150, hard_mdps(), st.integers(0, 2**32))
def test_values_of_a_deterministic_policy_are_within_their_bound(mdp, seed):
    actions = np.random.default_rng(seed).integers(mdp.num_actions, size=mdp.num_states)
    solution = evaluate_policy(mdp, actions, 1e40)
    written_out = naive_exact.exact(np.eye(mdp.num_actions)[actions])[:, None]
    assert largest_error(solution, naive_exact.values_of(mdp, written_out)) <= Fraction(solution.error_bound)


@pytest.mark.long
@examples(150, acyclic_mdps(), st.integers(0, 2**32))
def test_one_pass_gives_the_values_of_mdps_that_visit_no_state_twice(drawn, seed):
    """By the age of the states, and without it at gamma = 1."""
    plain, age = drawn
    for mdp in [plain.with_age(age)] + [plain] * (plain.gamma == 1.0):
        for solve, sign in ((value_iteration, 1), (worst_value, -1)):
            solution = finest(solve, mdp)
            assert solution.sweeps == 1
            assert largest_error(solution, naive_exact.extreme_values(mdp, sign)) <= Fraction(solution.error_bound)
        assert_policy_is_within_its_bound(mdp, drawn_policy(mdp, seed))


@pytest.mark.long
def test_the_bound_of_one_pass_counts_the_longest_path_and_not_the_discount():
    length, gamma = 1000, 1 - 1e-9
    path = TabularMDP.from_arrays([[i + 1] for i in range(length - 1)] + [[-1]], np.full((length, 1), 0.1), gamma=gamma)
    truth = sum(Fraction(0.1) * Fraction(gamma) ** t for t in range(length))
    solution = value_iteration(path.with_age(np.arange(length)), 1e-8)
    assert Fraction(1, 10**12) < abs(Fraction(float(solution.v[0])) - truth) <= Fraction(solution.error_bound)
    with pytest.raises(PrecisionError, match="raise the tolerance"):  # rounding / (1 - gamma)
        value_iteration(path, 1e-8)


def test_ages_are_checked():
    path = TabularMDP.from_arrays([[1, 2], [2, 2], [2, 2]], [[1.0, 0.0], [1.0, 1.0], [0.0, 0.0]], terminal=[0, 0, 1])
    assert value_iteration(path.with_age([5, 7, 8]).with_gamma(1.0)).value_at_start == 2.0
    with pytest.raises(ParameterError, match="state 1, of age 8, leads by action 0 to state 2, of age 8"):
        path.with_age([5, 8, 8])
    assert "age has shape (2,)" in refusal(ParameterError, path.with_age, [1, 2])
    assert mdp_within(path.with_age([5, 7, 8]).with_initial(1), 1).age is None


@pytest.mark.parametrize("gamma", [0.999, 0.9998, 1 - 1e-5, 1 - 1e-7])
@pytest.mark.parametrize("solve", [value_iteration, worst_value, uniform_value])
def test_the_bound_of_a_general_mdp_counts_the_rounding_of_its_values(solve, gamma):
    one = TabularMDP.from_matrices(np.ones((1, 1, 1)), [[0.7]], gamma=gamma)
    truth = Fraction(0.7) / (1 - Fraction(gamma))
    solution = finest(lambda tolerance: solve(one, tolerance))
    assert abs(Fraction(float(solution.v[0])) - truth) <= Fraction(solution.error_bound)


@pytest.mark.parametrize("reward", [0.7, 0.1, 0.3])
def test_the_bound_counts_the_rounding_of_values_where_sweeps_alone_find_them(reward, monkeypatch):
    """Linear systems leave less of an error than their bound allows; sweeps alone stop where rounding stops them."""
    monkeypatch.setattr(PolicyIteration, "is_worth_it", lambda *_: False)
    one = TabularMDP.from_matrices(np.ones((1, 1, 1)), [[reward]], gamma=0.99)
    truth = Fraction(reward) / (1 - Fraction(0.99))
    solution = finest(lambda tolerance: value_iteration(one, tolerance))
    assert abs(Fraction(float(solution.v[0])) - truth) <= Fraction(solution.error_bound)


def test_a_tolerance_beyond_floats_is_refused_for_matrices_as_for_tables():
    for gamma, tolerance in ((0.999, 1e-12), (0.9998, 1e-10), (1 - 1e-7, 1e-5)):
        for one in (
            TabularMDP.from_matrices(np.ones((1, 1, 1)), [[0.7]], gamma=gamma),
            TabularMDP.from_arrays([[0]], [[0.7]], gamma=gamma),
        ):
            assert "raise the tolerance" in refusal(PrecisionError, value_iteration, one, tolerance)


def test_a_report_on_a_general_mdp_near_gamma_1_gives_no_value_with_a_false_bound():
    one = TabularMDP.from_matrices(np.ones((1, 1, 1)), [[0.7]], gamma=0.9998)
    problem = hardness.Problem(one)
    truth = Fraction(0.7) / (1 - Fraction(0.9998))
    assert abs(Fraction(float(problem.solution.v[0])) - truth) <= Fraction(problem.solution.error_bound)


def test_rounding_adds_up_over_the_steps_of_a_horizon():
    one = TabularMDP.from_arrays([[0]], [[0.1]], gamma=1.0, horizon=1000)
    solution = value_iteration(one)
    error = abs(Fraction(float(solution.v[0])) - 1000 * Fraction(0.1))
    assert Fraction(1, 10**12) < error <= Fraction(solution.error_bound)


def test_rounding_adds_up_along_a_path_at_gamma_1():
    length = 1000
    path = TabularMDP.from_arrays([[i + 1] for i in range(length - 1)] + [[-1]], np.full((length, 1), 0.1), gamma=1.0)
    error = 1000 * Fraction(0.1) - Fraction(float(value_iteration(path).v[0]))
    assert Fraction(1, 10**12) < abs(error) <= Fraction(value_iteration(path).error_bound)
    by_matrix = TabularMDP.from_matrices(np.eye(length, k=1)[:, None], np.full((length, 1), 0.1), gamma=1.0, ends=True)
    assert abs(error) <= Fraction(value_iteration(by_matrix).error_bound)


@pytest.mark.slow
def test_rounding_counts_every_operation_of_a_backup():
    actions = 300  # whose values are added up one after the other
    one = TabularMDP.from_arrays(np.zeros((1, actions), int), np.full((1, actions), 0.1), gamma=0.0)
    solution = uniform_value(one, 1e-9)
    error = abs(Fraction(float(solution.v[0])) - Fraction(0.1))
    assert 2 * Fraction(2.0**-53) < error <= Fraction(solution.error_bound)
    solution = evaluate_policy(one, np.full((1, actions), 1 / actions), 1e-9)
    error = abs(Fraction(float(solution.v[0])) - Fraction(0.1) * Fraction(1 / actions) * actions)
    assert error <= Fraction(solution.error_bound)


def test_probabilities_that_sum_to_more_than_1_over_gamma_give_no_false_bound():
    one = TabularMDP.from_matrices(np.ones((1, 1, 1)), [[1.0]], gamma=1 - 1e-10)
    grows = replace(one, dynamics=Matrices(sparse.csr_matrix([[1 + 9e-10]]), 1))
    for solve in (value_iteration, worst_value, uniform_value):  # the value is infinite
        assert "1 / gamma" in refusal(PrecisionError, solve, grows, 1e30)
    for policy in ([0], [[1.0]]):
        assert "1 / gamma" in refusal(PrecisionError, evaluate_policy, grows, np.array(policy), 1e30)


@pytest.mark.slow
@pytest.mark.parametrize("actions", [65, 1001])
def test_any_number_of_actions_is_solved(actions):
    rewards = np.arange(float(actions))[None].repeat(2, axis=0)
    mdp = TabularMDP.from_arrays(np.full((2, actions), 1), rewards, gamma=0.5)
    for chosen in (mdp, sticky_actions(mdp, 0.25), random_actions(mdp, 0.0)):
        solution = value_iteration(chosen)
        assert abs(solution.value_at_start - 2 * (actions - 1)) <= solution.error_bound
    worst = worst_value(mdp)
    assert np.abs(worst.v).max() <= worst.error_bound
    assert abs(uniform_value(mdp).v[0] - (actions - 1)) <= 1e-6


def test_long_cycles_that_nearly_cancel_are_within_the_bound():
    length = 4001
    rewards = np.where(np.arange(length) % 2, -0.7, 0.7)[:, None]
    cycle = TabularMDP.from_arrays([[(i + 1) % length] for i in range(length)], rewards, gamma=1 - 1e-9)
    solution = evaluate_policy(cycle, np.zeros(length, int))
    gamma = Fraction(1 - 1e-9)
    total = Fraction(0)
    for reward in reversed(rewards[:, 0].tolist()):
        total = Fraction(reward) + gamma * total
        total = Fraction(total.numerator * 2**400 // total.denominator, 2**400)
    truth = total / (1 - gamma**length)
    assert abs(Fraction(float(solution.v[0])) - truth) <= Fraction(solution.error_bound)


@pytest.mark.parametrize("kind", ["plain", "random", "sticky", "general"])
def test_a_discount_near_1_is_answered_at_once(kind):
    rng = np.random.default_rng(0)
    table = TabularMDP.from_arrays(rng.integers(0, 6, (6, 3)), rng.random((6, 3)), gamma=0.999999)
    mdp = {
        "plain": table,
        "random": random_actions(table, 0.1),
        "sticky": sticky_actions(table, 0.25),
        "general": TabularMDP.from_matrices(rng.dirichlet(np.ones(6), (6, 3)), rng.random((6, 3)), gamma=0.999999),
    }[kind]
    for solve in (value_iteration, worst_value, uniform_value):
        solution = solve(mdp, 0.01)
        assert solution.sweeps <= 200
    solution = value_iteration(mdp, 0.01)
    assert largest_error(solution, naive_exact.extreme_values(mdp)) <= Fraction(solution.error_bound) <= Fraction(0.01)
    assert evaluate_policy(mdp, np.full((6, 3), 1 / 3), 0.01).sweeps <= 200
    assert "raise the tolerance or lower gamma" in refusal(PrecisionError, value_iteration, mdp, 1e-6)


def test_a_discount_of_1_up_to_the_last_bit_is_refused_at_once():
    for ring in (
        TabularMDP.from_arrays([[1], [0]], [[1.0], [0.0]], gamma=1 - 1.2e-16),
        TabularMDP.from_matrices(np.array([[[0.0, 1.0]], [[1.0, 0.0]]]), [[1.0], [0.0]], gamma=1 - 1.2e-16),
        random_actions(TabularMDP.from_arrays([[1], [0]], [[1.0], [0.0]], gamma=1 - 1.2e-16), 0.5),
    ):
        assert "lower gamma" in refusal(PrecisionError, value_iteration, ring)


@pytest.mark.parametrize("solve", [value_iteration, worst_value, uniform_value])
def test_values_beyond_the_largest_float_are_an_error(solve):
    ring = TabularMDP.from_arrays([[1], [0]], [[1e308], [1e308]], gamma=0.99)
    assert "1.8e308" in refusal(PrecisionError, solve, ring, 1e300)
    assert "1.8e308" in refusal(PrecisionError, solve, ring, horizon=50)
    assert "1.8e308" in refusal(PrecisionError, evaluate_policy, ring, np.array([0, 0]))
    assert "1.8e308" in refusal(PrecisionError, evaluate_policy, ring, np.ones((2, 1)), horizon=50)


def test_a_state_that_leads_to_itself_may_be_visited_again_at_gamma_1():
    waits = TabularMDP.from_arrays([[0, -1]], [[0.0, 1.0]], gamma=1.0)
    by_matrix = TabularMDP.from_matrices(np.array([[[1.0], [0.0]]]), [[0.0, 1.0]], gamma=1.0, ends=True)
    for mdp in (waits, by_matrix):
        solution = value_iteration(mdp)
        assert abs(solution.v[0] - 1.0) <= solution.error_bound and solution.policy.tolist() == [1]
    assert value_iteration(replace(waits, gamma=0.9), 1e-9).v[0] == 1.0


@pytest.mark.parametrize("solve", [value_iteration, worst_value])
def test_large_deterministic_mdps_near_gamma_1_are_solved_on_their_functional_graph(solve):
    rng = np.random.default_rng(1)
    size = 12_000
    mdp = TabularMDP.from_arrays(rng.integers(0, size, (size, 2)), rng.random((size, 2)), gamma=0.999999)
    solution = solve(mdp, 0.01)
    assert solution.error_bound <= 0.01
    assert solution.sweeps <= 1025
    attained = evaluate_policy(mdp, solution.policy)
    sign = 1 if solve is value_iteration else -1  # no policy is better than the best, or worse than the worst
    assert (sign * (attained.v - solution.v)).max() <= solution.error_bound + attained.error_bound


@pytest.mark.long
@pytest.mark.parametrize("neighbours", ["copies apart", "copies mixed at random"])
def test_large_mdps_with_chance_near_gamma_1_are_solved_by_sparse_systems(neighbours):
    # copies of each state: whichever copy an action leads to, the values are those of six states
    rng = np.random.default_rng(0)
    small = TabularMDP.from_arrays(rng.integers(0, 6, (6, 3)), rng.random((6, 3)), gamma=0.999999)
    copies = 600
    own = np.broadcast_to(np.arange(copies)[:, None, None], (copies, 6, 3))
    other = own if neighbours == "copies apart" else rng.integers(0, copies, own.shape)
    successors = (other * 6 + small.dynamics.deterministic_table()).reshape(-1, 3)
    large = TabularMDP.from_arrays(successors, np.tile(small.rewards, (copies, 1)), gamma=0.999999)

    def no_more_than(sweeps, _bound):
        assert sweeps <= 600

    for chance in (lambda mdp: random_actions(mdp, 0.1), lambda mdp: sticky_actions(mdp, 0.25)):
        truth = naive_exact.extreme_values(chance(small))
        solution = value_iteration(chance(large), 0.01, progress=no_more_than)
        values = solution.v.reshape(copies, 6, -1)
        bound = Fraction(solution.error_bound)
        assert bound <= Fraction(0.01)
        assert naive_exact.largest_error(values.min(axis=0), truth) <= bound
        assert naive_exact.largest_error(values.max(axis=0), truth) <= bound


def test_elimination_is_counted_entry_by_entry():
    from scipy import sparse

    from pharos.kernels import linear_algebra

    rng = np.random.default_rng(0)
    for size in (1, 2, 7, 30):
        pattern = rng.random((size, size)) < 3 / size
        pattern = pattern | pattern.T | np.eye(size, dtype=bool)
        matrix = sparse.csr_matrix(pattern)
        filled = pattern.copy()
        for pivot in range(size):  # what is eliminated joins all that it was joined to
            below = pivot + 1 + np.flatnonzero(filled[pivot + 1 :, pivot])
            filled[np.ix_(below, below)] = True
        counts = np.tril(filled, -1).sum(axis=0)
        assert linear_algebra.entries_of_factor(matrix.indptr, matrix.indices, 10**6).tolist() == counts.tolist()
        if counts.sum() > 5:
            assert linear_algebra.entries_of_factor(matrix.indptr, matrix.indices, 5).sum() > 5


@pytest.mark.parametrize("gamma", [0.9999, 0.999999, 0.99999999])
@pytest.mark.parametrize("tolerance", [1e-3, 1.0, 1e6])
def test_single_floats_end_near_gamma_1(gamma, tolerance):
    """State 0 pays 1 where it goes to the other and comes back; there is half of that to stay with."""
    mdp = TabularMDP.from_arrays([[1, 0], [0, 1]], [[1, 0], [0, 0.5]], gamma=gamma)
    try:
        solution = value_iteration(mdp, tolerance, dtype="float32")
    except PrecisionError:
        if tolerance > 2.0**-24 / (1 - gamma):  # not what storing in 32 bits alone costs
            with pytest.raises(PrecisionError):
                value_iteration(mdp, tolerance)
        return
    truth = naive_exact.extreme_values(mdp)
    assert largest_error(solution, truth) <= Fraction(solution.error_bound) <= Fraction(tolerance)


def test_the_bound_of_32_bit_values_holds_in_the_middle_between_two_of_them():
    """1 + 2^-24 is stored as 1, half a unit away: as much as storing ever rounds."""
    value = 1.0 + 2.0**-24
    solution = value_iteration(TabularMDP.from_arrays([[-1]], [[value]], gamma=0.0), 1e-6, dtype="float32")
    assert solution.v.dtype == np.float32
    error = abs(float(solution.v[0]) - value)
    assert error == 2.0**-24 <= solution.error_bound
