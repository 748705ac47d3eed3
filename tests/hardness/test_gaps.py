"""Suboptimality gaps against explicit matrices, and against theory."""

import dataclasses
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive.gaps import naive_gaps
from pharos import hardness
from pharos.errors import ParameterError, PrecisionError
from pharos.hardness.gaps import resolved_gaps, same_outcomes
from pharos.mdp import (
    TabularMDP,
    random_actions,
    states_within,
    sticky_actions,
)
from strategies import deterministic_mdps, examples, small_mdps

TOLERANCE = 1e-7


@pytest.mark.long
@examples(150, small_mdps())
def test_gaps_are_those_of_the_explicit_matrices(mdp):
    result = hardness.gaps(mdp, pharos.value_iteration(mdp, 1e-9), tie_tolerance=TOLERANCE)
    positive, regularized = naive_gaps(mdp, TOLERANCE)
    assert result.count == len(positive)
    assert math.isclose(result.sum_of_reciprocals, sum(1 / gap for gap in positive), rel_tol=1e-5)
    assert math.isclose(result.regularized, regularized, rel_tol=1e-6)
    assert math.isclose(result.minimal, min(positive, default=math.inf), rel_tol=1e-5)
    assert result.lower <= result.sum_of_reciprocals <= result.upper
    assert result.histogram.sum() == result.count
    for number, low, high in zip(result.histogram, result.edges, result.edges[1:], strict=False):
        assert number == sum(low <= gap < high for gap in positive) or any(
            abs(gap / edge - 1) < 1e-6 for gap in positive for edge in (low, high)
        )


@pytest.mark.slow
@examples(80, small_mdps(), st.integers(1, 4))
def test_gaps_with_a_horizon_are_those_of_every_step(mdp, horizon):
    mdp = mdp.with_horizon(horizon)
    result = hardness.gaps(mdp, tie_tolerance=TOLERANCE)
    positive, regularized = naive_gaps(mdp, TOLERANCE, horizon)
    assert result.count == len(positive)
    assert math.isclose(result.sum_of_reciprocals, sum(1 / gap for gap in positive), rel_tol=1e-6)
    assert math.isclose(result.regularized, regularized, rel_tol=1e-6)


@examples(50, deterministic_mdps(), st.sampled_from([0.5, 2.0, 8.0]))
def test_scaling_rewards_scales_gaps(mdp, scale):
    gaps = hardness.gaps(mdp, tie_tolerance=TOLERANCE)
    scaled = hardness.gaps(mdp.with_rewards(mdp.rewards * scale), tie_tolerance=TOLERANCE * scale)
    assert scaled.count == gaps.count
    assert math.isclose(scaled.sum_of_reciprocals * scale, gaps.sum_of_reciprocals, rel_tol=1e-6)


@examples(50, deterministic_mdps(), st.sampled_from([0.25, 0.5]))
def test_random_actions_shrink_what_a_choice_is_worth(mdp, p):
    """With gamma = 0 a gap is the difference of rewards, times the probability that the choice is executed."""
    mdp = mdp.with_gamma(0.0)
    plain, random = hardness.gaps(mdp), hardness.gaps(random_actions(mdp, p))
    assert math.isclose(random.sum_of_reciprocals * (1 - p), plain.sum_of_reciprocals, rel_tol=1e-9)
    assert math.isclose(hardness.sum_of_reciprocal_gaps(sticky_actions(mdp, 0.0)), plain.sum_of_reciprocals)


def test_gaps_of_a_bandit_are_the_differences_of_its_arms():
    bandit = TabularMDP.from_arrays([[-1, -1, -1, -1]], [[1.0, 0.75, 0.5, 1.0]])
    result = hardness.gaps(bandit)
    assert result.sum_of_reciprocals == pytest.approx(1 / 0.25 + 1 / 0.5)
    assert result.regularized == pytest.approx(2 / 0.1 + 1 / 0.35 + 1 / 0.6)
    assert hardness.minimal_gap(bandit) == pytest.approx(0.25)
    assert (result.count, result.ties) == (2, 2)


def test_states_that_cannot_be_reached_do_not_count():
    next_states, rewards = [[-1, -1], [-1, -1]], [[1.0, 0.0], [1.0, 0.5]]
    assert hardness.sum_of_reciprocal_gaps(TabularMDP.from_arrays(next_states, rewards)) == pytest.approx(1.0)
    both = TabularMDP.from_arrays(next_states, rewards, initial=np.array([0.5, 0.5]))
    assert hardness.sum_of_reciprocal_gaps(both) == pytest.approx(3.0)


def test_an_mdp_without_gaps_has_an_infinite_minimal_gap():
    mdp = TabularMDP.from_arrays([[-1, -1]], [[1.0, 1.0]])
    assert hardness.minimal_gap(mdp) == math.inf
    assert hardness.sum_of_reciprocal_gaps(mdp) == 0.0
    assert hardness.gaps(mdp).to_dict()["minimal"] is None


def test_a_tie_tolerance_within_the_error_of_the_solution_is_refused():
    mdp = pharos.build(pharos.make("simple_grid", height=3, width=3)).mdp()
    solution = pharos.value_iteration(mdp, 1e-3)
    if solution.error_bound == 0:
        pytest.fail("the test needs a solution with an error")
    with pytest.raises(PrecisionError, match="twice the error bound"):
        hardness.gaps(mdp, solution, tie_tolerance=solution.error_bound)


def test_a_solution_of_another_mdp_or_policy_is_refused():
    mdp = TabularMDP.from_arrays([[-1, -1]], [[1.0, 0.0]])
    other = TabularMDP.from_arrays([[-1, 1], [-1, -1]], [[1.0, 0.0], [0.0, 0.0]])
    with pytest.raises(ParameterError, match="expected the optimal one"):
        hardness.gaps(mdp, pharos.value_iteration(other))
    with pytest.raises(ParameterError, match="expected the optimal one"):
        hardness.gaps(mdp, pharos.evaluate_policy(mdp, np.array([0])))


def test_sums_of_many_gaps_are_those_of_exact_sums():
    """Over several blocks, with gaps that differ by 9 orders of magnitude."""
    rng = np.random.default_rng(0)
    rewards = 10.0 ** rng.uniform(-6, 3, (40_000, 3))
    mdp = TabularMDP.from_arrays(np.full(rewards.shape, -1), rewards, gamma=0.0, initial=np.full(40_000, 1 / 40_000))
    result = hardness.gaps(mdp, tie_tolerance=1e-6)
    gaps = rewards.max(axis=1, keepdims=True) - rewards
    positive = gaps[gaps > result.tie_tolerance]
    assert result.count == positive.size and result.minimal == positive.min()
    assert result.sum_of_reciprocals == pytest.approx(math.fsum(1 / positive), rel=1e-14)
    assert result.regularized == pytest.approx(math.fsum((1 / (gaps + 0.1)).ravel()), rel=1e-14)
    numbers, _ = np.histogram(positive, result.edges)
    assert (result.histogram == numbers).all()


def test_a_gap_beyond_floats_is_counted():
    mdp = TabularMDP.from_arrays([[-1, -1]], [[1.5e308, -1.5e308]], gamma=0.0)
    result = hardness.gaps(mdp, pharos.value_iteration(mdp.with_rewards([[1.0, 0.0]])))
    assert result.count == 1 and result.histogram.tolist() == [1]


# Proofs ---------------------------------------------------------------------------------------------------------------


def exact_gaps(mdp):
    """All gaps of a deterministic MDP without chance, of reachable live states, by policy iteration in exact
    fractions."""
    gamma, table, rewards = Fraction(mdp.gamma), mdp.next_states, mdp.rewards
    size, policy = len(table), [0] * len(table)
    while True:
        v = [value_of_chain(s, table, rewards, policy, gamma) for s in range(size)]
        q = [
            [Fraction(r) + gamma * (v[t] if t >= 0 else 0) for r, t in zip(rewards[s], table[s], strict=True)]
            for s in range(size)
        ]
        better = [policy[s] if q[s][policy[s]] == max(q[s]) else q[s].index(max(q[s])) for s in range(size)]
        if better == policy:
            break
        policy = better
    reached = np.flatnonzero(states_within(mdp) & ~mdp.terminal)
    return [max(q[s]) - each for s in reached for each in q[s]]


def value_of_chain(s, table, rewards, policy, gamma):
    """The value of s under a policy: a path, and then a cycle or the end."""
    seen, paid = {}, []
    while s >= 0 and s not in seen:
        seen[s] = len(paid)
        paid.append(Fraction(rewards[s, policy[s]]))
        s = int(table[s, policy[s]])
    value = Fraction(0)
    if s >= 0:
        cycle = paid[seen[s] :]
        value = sum((gamma**i * r for i, r in enumerate(cycle)), Fraction(0)) / (1 - gamma ** len(cycle))
        paid = paid[: seen[s]]
    for r in reversed(paid):
        value = r + gamma * value
    return value


def check_against_exact(mdp, result):
    """The intervals hold the sums over all gaps that are not 0, and what says exact is exact."""
    positive = [gap for gap in exact_gaps(mdp) if gap]
    total = sum((1 / gap for gap in positive), Fraction(0))
    smallest = min(positive, default=math.inf)
    summed, minimal = result.certified_sum, result.certified_minimal
    assert Fraction(summed.lower) <= total
    assert math.isinf(summed.upper) or total <= Fraction(summed.upper)
    assert minimal.lower <= smallest <= minimal.upper
    if summed.exact:
        assert len(positive) == result.count
        assert abs(Fraction(summed.value) - total) <= Fraction(summed.upper) * Fraction(1, 10**6)
    if result.unresolved:
        assert not summed.exact and not minimal.exact and minimal.lower == 0
    return positive, total


tiny = st.sampled_from([0.0, 1.0, 1.0 + 2.0**-40, 2.0**-30, 2.0**-38, 2.0**-45, 2.0**-70, 1e12, 1e12 + 2.0**-10, -1.0])


@pytest.mark.long
@examples(300, deterministic_mdps(rewards=tiny), st.sampled_from([0.0, 0.5, 0.99, 1 - 2.0**-13, 1 - 2.0**-20]))
def test_intervals_of_gaps_hold_the_exact_fractions(mdp, gamma):
    """Gaps below 1e-9, values of 1e12 and more, gamma near 1."""
    mdp = mdp.with_gamma(gamma)
    solution = hardness.Problem(mdp).solution
    for result in (hardness.gaps(mdp, solution), resolved_gaps(mdp, solution)):
        check_against_exact(mdp, result)


@pytest.mark.long
def test_small_gaps_of_a_grid_are_gaps_not_ties():
    mdp = pharos.build(pharos.make("simple_grid", height=20, width=20)).mdp(gamma=0.5)
    result = hardness.gaps(mdp)
    positive, total = check_against_exact(mdp, result)
    assert min(positive) == 0.5**38 and not result.unresolved
    assert float(total) == pytest.approx(1.8325e12, rel=1e-4)
    assert result.count == len(positive)
    assert result.upper - result.lower <= 0.01 * result.upper


def test_a_gap_near_the_error_of_the_values_is_no_tie_that_is_proven():
    """A gap of 3e-9, and values to 1e-9: it was infinite, and exact."""
    mdp = TabularMDP.from_arrays([[0, 0]], [[1.0, 1.0 - 3e-9]], gamma=0.9)
    solution = pharos.value_iteration(mdp, 1e-9)
    off = solution.x + np.array([[1e-9], [0.0]])
    for bound in (1e-9, 1.4e-9):
        coarse = dataclasses.replace(solution, x=off, next_x=off, error_bound=bound)
        result = hardness.gaps(mdp, coarse)
        assert result.count == (bound == 1e-9)
        assert not result.certified_minimal.exact and not result.certified_sum.exact
        assert result.certified_minimal.lower <= 3e-9 <= result.certified_minimal.upper
        assert result.lower <= 1 / 3e-9 <= result.upper
    finer = resolved_gaps(mdp, coarse)
    assert finer.count == 1 and not finer.unresolved
    assert finer.minimal == pytest.approx(3e-9, rel=1e-4)


def test_equal_floats_are_no_proof_of_a_tie():
    """1 and 1 + 2^-70: the difference is lost in rounding, so that nothing is proven."""
    table = np.append(np.arange(1, 71), -1)
    both = np.stack([np.full(71, -1), table], axis=1)
    both[1:, 0] = table[1:]
    rewards = np.zeros((71, 2))
    rewards[0], rewards[70] = 1.0, 2.0
    mdp = TabularMDP.from_arrays(both, rewards, gamma=0.5)
    result = hardness.gaps(mdp)
    positive, _ = check_against_exact(mdp, result)
    assert positive == [Fraction(1, 2**69)]
    assert result.unresolved == 1 and result.upper == math.inf


def test_ties_between_ways_round_are_proven():
    """Right and down are equally good in a grid, and bumping into two walls is equally bad."""
    for gamma in (0.5, 0.99):
        result = hardness.gaps(pharos.build(pharos.make("simple_grid", height=6, width=5)).mdp(gamma=gamma))
        assert result.ties > result.count / 2 and not result.unresolved
        assert result.certified_sum.exact
    lake = random_actions(TabularMDP.from_arrays([[1, 1, 0], [1, 1, 1]], [[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]), 0.5)
    result = hardness.gaps(lake)
    assert result.count == 1 and not result.unresolved


def test_a_wide_interval_counts_the_whole_error_at_either_end():
    """Of a bandit with arms of 1 and 0.5: 1 / (gap + error) and 1 / (gap - error), where a gap is known to twice the
    bound."""
    mdp = TabularMDP.from_arrays([[0, 0]], [[1.0, 0.5]], gamma=0.5)
    solution = pharos.value_iteration(mdp, 0.1)
    error = 2 * solution.error_bound
    result = hardness.gaps(mdp, solution)
    gap = result.minimal
    assert error > 0.01
    assert result.lower == pytest.approx(1 / (gap + error), rel=1e-9)
    assert result.upper == pytest.approx(1 / (gap - error), rel=1e-9)


@pytest.mark.parametrize("shift", [-1.0, 1.0])
def test_the_interval_holds_the_truth_where_values_are_off_by_all_of_their_bound(shift):
    """The value of the best arm is off by the bound in one direction, that of the other in the other."""
    mdp = TabularMDP.from_arrays([[1, 2], [-1, -1], [-1, -1]], [[0.0, 0.0], [1.0, 1.0], [0.5, 0.5]], gamma=0.5)
    solution = pharos.value_iteration(mdp, 1e-6)
    bound = 0.01
    x = solution.x.copy()
    x[1:3, 0] += np.array([shift, -shift]) * bound / 0.5  # Q of state 0 is off by the bound
    off = dataclasses.replace(solution, x=x, next_x=x, error_bound=bound)
    result = hardness.gaps(mdp, off)
    assert result.lower <= 4.0 <= result.upper
    minimal = result.certified_minimal
    assert minimal.lower <= 0.25 <= minimal.upper
    regularized = result.certified_regularized
    assert regularized.lower <= 5 / 0.1 + 1 / (0.25 + 0.1) <= regularized.upper


def gaps_of_every_step(table, rewards, gamma, horizon):
    """All gaps above 0, in exact fractions, of the states that each step may be in."""
    exact = [[Fraction(float(reward)) for reward in row] for row in rewards]
    (size, actions), reached = table.shape, [{0}]
    for _ in range(horizon - 1):
        reached.append({int(t) for s in reached[-1] for t in table[s]})
    values, gaps = [Fraction(0)] * size, []
    for states in reversed(reached):
        q = [[exact[s][a] + Fraction(gamma) * values[table[s, a]] for a in range(actions)] for s in range(size)]
        values = [max(row) for row in q]
        gaps += [values[s] - q[s][a] for s in states for a in range(actions) if q[s][a] < values[s]]
    return values, gaps


@pytest.mark.parametrize("gamma", [0.5, 0.9, 1.0])
def test_intervals_of_gaps_of_every_step_hold_the_exact_fractions(gamma):
    rng = np.random.default_rng(0)
    table, rewards, horizon = rng.integers(0, 4, (4, 3)), 0.1 + rng.random((4, 3)), 6
    mdp = TabularMDP.from_arrays(table, rewards, gamma=gamma, horizon=horizon)
    result = hardness.gaps(mdp)
    _, gaps = gaps_of_every_step(table, rewards, gamma, horizon)
    assert (result.count, result.unresolved) == (len(gaps), 0)
    assert Fraction(result.lower) <= sum(1 / gap for gap in gaps) <= Fraction(result.upper)
    assert Fraction(result.certified_minimal.lower) <= min(gaps) <= Fraction(result.certified_minimal.upper)
    assert result.error >= 2 * pharos.value_iteration(mdp).error_bound > 0


@pytest.mark.long
@examples(100, st.integers(0, 2**32 - 1), st.sampled_from([1.0, 0.25, 2.0**20]), st.sampled_from([1, 6, 40]))
def test_whole_rewards_without_discount_have_exact_values_and_every_tie_is_proven(seed, unit, horizon):
    rng = np.random.default_rng(seed)
    table, rewards = rng.integers(0, 5, (5, 3)), unit * rng.integers(-2, 3, (5, 3))
    mdp = TabularMDP.from_arrays(table, rewards, gamma=1.0, horizon=horizon)
    values, gaps = gaps_of_every_step(table, rewards, 1.0, horizon)
    solution, result = pharos.value_iteration(mdp), hardness.gaps(mdp)
    assert solution.error_bound == 0 and [Fraction(float(v)) for v in solution.v] == values
    assert pharos.evaluate_policy(mdp, solution.policy).error_bound == 0
    assert (result.count, result.unresolved) == (len(gaps), 0)
    assert result.certified_sum.exact
    assert result.sum_of_reciprocals == pytest.approx(float(sum((1 / gap for gap in gaps), Fraction(0))), rel=1e-12)


def test_rewards_that_are_no_sums_of_halves_have_an_error():
    mdp = TabularMDP.from_arrays([[0, 1], [1, 0]], [[0.1, 0.2], [0.3, 0.7]], gamma=1.0, horizon=20)
    assert pharos.value_iteration(mdp).error_bound > 0
    large = TabularMDP.from_arrays([[0, 1], [1, 0]], [[2.0**53, 1.0], [1.0, 0.0]], gamma=1.0, horizon=2)
    assert pharos.value_iteration(large).error_bound > 0


@pytest.mark.parametrize("seed", range(5))
def test_two_actions_have_the_same_outcomes_where_their_rows_and_rewards_are_the_same(seed):
    rng = np.random.default_rng(seed)
    rows = np.array([[0.5, 0.25, 0.25], [0.25, 0.5, 0.25], [0.5, 0.5, 0.0], [0.5, 0.25, 0.0], [0.0, 0.0, 1.0]])
    matrix, rewards = rows[rng.integers(0, 5, (3, 6))], rng.integers(0, 2, (3, 6)).astype(float)
    mdp = TabularMDP.from_matrices(matrix, rewards, ends=True)
    state, action, other = (each.ravel() for each in np.indices((3, 6, 6)))
    expected = (matrix[state, action] == matrix[state, other]).all(axis=1)
    expected &= rewards[state, action] == rewards[state, other]
    assert (same_outcomes(mdp, state, rewards[state], action, other) == expected).all()


def test_a_tolerance_of_ones_own_is_part_of_what_is_asked_for():
    mdp = TabularMDP.from_arrays([[-1, -1, -1]], [[1.0, 0.9, 0.5]])
    result = hardness.gaps(mdp, tie_tolerance=0.2)
    assert (result.count, result.ties, result.unresolved) == (1, 2, 0)
    assert result.certified_sum.exact


def test_pairs_that_cannot_be_reached_do_not_count_where_every_action_is_repeated():
    """A grid whose first action goes on for ever; each pair that can be reached stands in one row of gaps of 0."""
    mdp = sticky_actions(pharos.build(pharos.make("simple_grid")).mdp(), 1.0)
    starts, pairs = len(mdp.starts), naive_pairs(mdp)
    result = hardness.gaps(mdp)
    first = exact_first_gaps(mdp)
    assert result.regularized == pytest.approx(10.0 * mdp.num_actions * len(pairs) + (1 / (first + 0.1)).sum())
    assert starts == 1


def naive_pairs(mdp):
    """Pairs (state, previously executed action) that are met when the first action is repeated for ever."""
    pairs = set()
    for action in range(mdp.num_actions):
        s = int(mdp.start_states[0])
        while not mdp.terminal[s]:
            s = int(mdp.next_states[s, action])
            if s < 0 or (s, action) in pairs:
                break
            pairs.add((s, action))
    return pairs


def exact_first_gaps(mdp):
    """(A,) gaps of the start, where the first action is repeated for ever."""
    q = pharos.value_iteration(mdp, 1e-12).q[int(mdp.start_states[0])]
    return q.max() - q
