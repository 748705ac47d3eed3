"""Total rewards against rational numbers and every policy, published values, and textbooks."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive import goals as naive
from pharos.errors import DivergenceError
from pharos.mdp import BEST, TabularMDP
from pharos.solvers.goals import swept_goals
from pharos.solvers.values import uniform_value, worst_value
from strategies import deterministic_mdps, examples, outcome_table, small_mdps

VECTORS = [[1.0], [0.5, 0.5], [0.25, 0.75], [1e-12, 1 - 1e-12], [1 / 3, 1 / 3, 1 / 3]]


@st.composite
def mdps_with_cycles(draw, rewards=(-1.0, 0.0, 0.0, 1.0, 0.1)):
    """MDPs of up to five states, most of whose choices lead to a state, so that there are cycles and components."""
    num_states, num_actions = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    states = st.sampled_from([*range(num_states), *range(num_states), -1])
    lists = [[(draw(states), p) for p in draw(st.sampled_from(VECTORS))] for _ in range(num_states * num_actions)]
    paid = np.array([draw(st.sampled_from(rewards)) for _ in lists]).reshape(num_states, num_actions)
    mdp = TabularMDP.from_arrays(np.zeros(paid.shape, int), paid, gamma=1.0)
    return replace(mdp, dynamics=outcome_table(lists, num_actions, True, False, 3), terminal=np.zeros(num_states, bool))


def tolerance_of(values):
    """What floats allow for values of 1e12 and more."""
    return float(max(1e-6, *(1e-12 * abs(value) for value in values), 0.0))


def check(mdp, solve, sign):
    expected = naive.best_values(mdp, sign)
    tolerance = tolerance_of((expected or {}).values())
    if expected is None:
        with pytest.raises(DivergenceError):
            solve(mdp, tolerance)
        return
    solution = solve(mdp, tolerance)
    v = solution.x[:-1]
    for (s, b), value in expected.items():
        assert abs(v[s, b or 0] - value) <= solution.error_bound
    # the policy attains it, and so ends, or stays where nothing is paid
    again = pharos.evaluate_policy(mdp, solution.policy, tolerance)
    assert np.abs(again.x - solution.x).max() <= again.error_bound + solution.error_bound
    # values of actions are as accurate
    if not mdp.is_sticky:
        q = solution.q
        best = sign * (sign * q).max(axis=1)
        assert np.abs(best - solution.v)[~mdp.terminal].max(initial=0.0) <= 2 * solution.error_bound


@pytest.mark.long
@examples(700, mdps_with_cycles(), st.sampled_from([1, -1]))
def test_values_are_those_of_the_best_policy_of_all(mdp, sign):
    check(mdp, pharos.value_iteration if sign > 0 else worst_value, sign)


@pytest.mark.long
@examples(200, mdps_with_cycles(rewards=(0.0, 0.0, 1.0)))
def test_rewards_of_one_sign(mdp):
    check(mdp, pharos.value_iteration, 1)
    check(mdp, worst_value, -1)


@pytest.mark.long
@examples(200, small_mdps(max_states=3))
def test_every_kind_of_mdp_and_chance(mdp):
    mdp = mdp.with_gamma(1.0)
    if mdp.num_actions ** (mdp.num_states * mdp.width) <= 300:
        check(mdp, pharos.value_iteration, 1)


@pytest.mark.long
@examples(200, mdps_with_cycles(), st.data())
def test_values_of_policies(mdp, data):
    actions = np.array([data.draw(st.integers(0, mdp.num_actions - 1)) for _ in range(mdp.num_states)])
    nodes = naive.written_out(mdp)
    expected = naive.values_of({n: choices[actions[n[0]]] for n, choices in nodes.items()})
    tolerance = tolerance_of(expected.values())
    if len(expected) < len(nodes):
        with pytest.raises(DivergenceError):
            pharos.evaluate_policy(mdp, actions, tolerance)
        return
    solution = pharos.evaluate_policy(mdp, actions, tolerance)
    for (s, _), value in expected.items():
        assert abs(solution.v[s] - value) <= solution.error_bound


# Examples of the page -------------------------------------------------------------------------------------------------


def test_a_cycle_of_one_and_minus_one_has_no_value():
    with pytest.raises(DivergenceError, match="state 0 by action 0, state 1 by action 0"):
        pharos.value_iteration(TabularMDP.from_arrays([[1], [0]], [[1.0], [-1.0]], gamma=1.0))


@pytest.mark.parametrize("last", [-1.0, -2.0])
def test_beside_an_exit_it_has_one(last):
    mdp = TabularMDP.from_arrays([[1, -1], [0, -1]], [[1.0, 0.0], [last, 0.0]], gamma=1.0)
    solution = pharos.value_iteration(mdp)
    assert solution.v == pytest.approx([1.0, 0.0], abs=solution.error_bound)
    assert solution.policy.tolist() == [0, 1]
    with pytest.raises(DivergenceError, match="no upper limit"):
        pharos.value_iteration(mdp.with_rewards([[1.0 - last, 0.0], [last, 0.0]]))


def test_a_cycle_whose_floats_do_not_cancel_is_infinite():
    # 0.1 + 0.2 - 0.3 is 2.8e-17 in the numbers that the floats are
    mdp = TabularMDP.from_arrays([[1, -1], [2, -1], [0, -1]], [[0.1, 0], [0.2, 0], [-0.3, 0]], gamma=1.0)
    with pytest.raises(DivergenceError):
        pharos.value_iteration(mdp)
    assert pharos.value_iteration(mdp.with_rewards([[0.25, 0], [0.5, 0], [-0.75, 0]])).v == pytest.approx(
        [0.75, 0.5, 0]
    )


# Published values -----------------------------------------------------------------------------------------------------


def haddad_monmege(length, p):
    """The chain of Haddad and Monmege (2018), figure 3: the goal with probability p, after some 2^length steps."""
    size = 2 * length + 1
    P = np.zeros((1, size, size))
    R = np.zeros((size, 1))
    middle = length
    P[0, middle, middle - 1], P[0, middle, middle + 1] = 1 - p, p
    for i in range(1, length):
        P[0, middle - i, middle - i - 1], P[0, middle - i, middle] = 0.5, 0.5
        P[0, middle + i, middle + i + 1], P[0, middle + i, middle] = 0.5, 0.5
    P[0, 0, 0] = P[0, -1, -1] = 1.0
    R[size - 2, 0] = 0.5
    return TabularMDP.from_matrices(list(P), R, gamma=1.0, initial=middle)


@pytest.mark.parametrize("length", [20, 30])
def test_haddad_monmege(length):
    solution = pharos.value_iteration(haddad_monmege(length, 0.7))
    assert abs(solution.value_at_start - 0.7) <= solution.error_bound <= 1e-6


def grid():
    """The 4 x 4 grid of Sutton and Barto (2018), example 4.1."""
    next_states = np.empty((16, 4), int)
    for s in range(16):
        row, column = divmod(s, 4)
        for a, (down, right) in enumerate([(-1, 0), (0, 1), (1, 0), (0, -1)]):
            next_states[s, a] = 4 * min(max(row + down, 0), 3) + min(max(column + right, 0), 3)
    rewards, terminal = -np.ones((16, 4)), np.zeros(16, bool)
    for s in (0, 15):
        next_states[s], rewards[s], terminal[s] = s, 0.0, True
    return TabularMDP.from_arrays(next_states, rewards, gamma=1.0, initial=1, terminal=terminal)


def test_the_grid_of_the_textbook():
    expected = [0, -14, -20, -22, -14, -18, -20, -20, -20, -20, -18, -14, -22, -20, -14, 0]
    for solution in (uniform_value(grid()), pharos.evaluate_policy(grid(), np.full((16, 4), 0.25))):
        assert np.abs(solution.v - expected).max() <= solution.error_bound < 1e-10
    assert pharos.value_iteration(grid()).v.tolist() == [0, -1, -2, -3, -1, -2, -3, -2, -2, -3, -2, -1, -3, -2, -1, 0]


def test_the_world_of_four_by_three():
    """Russell and Norvig (2021), figure 16.3: utilities of the world with a wall, for -0.04 a step."""
    cells = [(x, y) for y in (1, 2, 3) for x in (1, 2, 3, 4) if (x, y) != (2, 2)]
    ends = {(4, 3): 1.0, (4, 2): -1.0}
    moves = [(0, 1), (1, 0), (0, -1), (-1, 0)]

    def after(cell, move):
        to = (cell[0] + move[0], cell[1] + move[1])
        return to if to in cells else cell

    P, R = np.zeros((4, 11, 11)), np.zeros((11, 4))
    for s, cell in enumerate(cells):
        for a in range(4):
            for turn, p in ((0, 0.8), (1, 0.1), (-1, 0.1)):
                to = cell if cell in ends else after(cell, moves[(a + turn) % 4])
                P[a, s, cells.index(to)] += p
                R[s, a] += p * ends.get(to, 0.0) if cell not in ends else 0.0
            R[s, a] -= 0.04 * (cell not in ends)
    solution = pharos.value_iteration(TabularMDP.from_matrices(list(P), R, gamma=1.0))
    utilities = [0.705, 0.655, 0.611, 0.388, 0.762, 0.660, 0.0, 0.812, 0.868, 0.918, 0.0]
    assert np.abs(solution.v - utilities).max() <= 0.0005 + solution.error_bound
    assert solution.error_bound < 1e-12


def test_the_slippery_lake_without_a_limit():
    mdp = pharos.build(pharos.make("frozen_lake", slippery=True)).mdp(gamma=1.0).with_horizon(None)
    solution = pharos.value_iteration(mdp)
    assert solution.value_at_start == pytest.approx(14 / 17, abs=1e-9)


@pytest.mark.long
def test_whole_rewards_without_chance_are_exact():
    mdp = pharos.build(pharos.make("taxi")).mdp(gamma=1.0)
    solution = pharos.value_iteration(mdp)
    assert solution.error_bound == 0.0
    assert solution.value_at_start == pytest.approx(7.93, abs=1e-12)
    assert (solution.v == np.round(solution.v)).all()
    assert (solution.optimal_actions(0.0) == solution.optimal_actions(0.5)).all()  # so every tie is one


@pytest.mark.long
@examples(200, deterministic_mdps())
def test_paths_of_deterministic_mdps(mdp):
    mdp = mdp.with_gamma(1.0)
    check(mdp, pharos.value_iteration, 1)
    check(mdp, worst_value, -1)


def test_a_cycle_of_a_thousand_states_is_decided_exactly():
    # the rewards of the cycle are decimals, so that their sum is no whole multiple of what floats of it hold
    rng = np.random.default_rng(0)
    rewards = np.zeros((1000, 2))
    rewards[:, 0] = rng.integers(-100, 100, 1000) / 1000
    rewards[-1, 0] = 0.0
    total = sum(map(Fraction, rewards[:, 0].tolist()))
    next_states = np.stack([(np.arange(1000) + 1) % 1000, np.full(1000, -1)], axis=1)
    rewards[-1, 0] = -float(total)
    mdp = TabularMDP.from_arrays(next_states, rewards, gamma=1.0)
    left = total - Fraction(float(total))
    if left > 0:
        with pytest.raises(DivergenceError, match="no upper limit"):
            pharos.value_iteration(mdp)
    else:
        assert np.isfinite(pharos.value_iteration(mdp).v).all()
    rewards[-1, 0] = np.nextafter(rewards[-1, 0], -np.inf)
    assert np.isfinite(pharos.value_iteration(mdp.with_rewards(rewards)).v).all()
    rewards[-1, 0] += 1e-9
    with pytest.raises(DivergenceError, match="no upper limit"):
        pharos.value_iteration(mdp.with_rewards(rewards))


@pytest.mark.long
@examples(50, mdps_with_cycles(rewards=(-1.0, -0.5, 0.25)))
def test_sweeps_prove_the_same(mdp):
    goals = swept_goals(mdp, BEST, 1e-6, None)
    if goals is not None:
        solution = pharos.value_iteration(mdp)
        assert np.abs(goals.v - solution.v).max() <= goals.error.max() + solution.error_bound
