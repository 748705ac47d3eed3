"""Values near gamma = 1: what policy iteration finds in each of its ways is proven like the rest."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st
from test_error_bounds import finest, largest_error

from naive import exact as naive_exact
from pharos.errors import PrecisionError
from pharos.mdp import BEST, TabularMDP, random_actions
from pharos.solvers import evaluate_policy, policy_iteration, value_iteration, worst_value
from pharos.solvers.policy_iteration import PolicyIteration
from strategies import examples, hard_mdps

nearly_1 = st.sampled_from([0.9999, 1 - 1e-6, 1 - 1e-9])


def ring(length, gamma, reward=30.0):
    """A cycle that pays once a round; a second action stays and pays nothing."""
    table = np.stack([(np.arange(length) + 1) % length, np.arange(length)], axis=1)
    rewards = np.zeros((length, 2))
    rewards[length // 3, 0], rewards[:, 0] = reward, rewards[:, 0] + 0.1
    return TabularMDP.from_arrays(table, rewards, gamma=gamma)


def test_rounding_that_stops_sweeps_is_said_soon():
    """Sweeps alone would move rounding errors about a cycle for a million sweeps or for ever."""
    sweeps = []

    def count(number, _):
        sweeps.append(number)
        assert number < 2000

    with pytest.raises(PrecisionError, match="raise the tolerance"):
        value_iteration(ring(377, 1 - 1e-6), 1e-9, progress=count)


def test_values_of_a_long_cycle_are_as_good_as_one_backup_allows():
    """Within twelve units in the last place, a step, over 1 / (1 - gamma) steps."""
    gamma = 1 - 1e-6
    mdp = ring(377, gamma)
    largest = float(value_iteration(mdp, 1.0).v.max())
    solution = value_iteration(mdp, 12 * 2.0**-53 * largest / (1 - gamma))
    truth = evaluate_policy(mdp, np.zeros(377, int))
    assert np.abs(solution.v - truth.v).max() <= solution.error_bound + truth.error_bound
    assert solution.sweeps < 300


@pytest.mark.long
def test_large_systems_are_solved_inexactly_and_agree_with_sweeps():
    """A random walk with a goal, of more nodes than are solved directly at once."""
    size = 60
    cells = np.arange(size * size).reshape(size, size)
    moves = [np.roll(cells, step, axis).ravel() for step in (1, -1) for axis in (0, 1)]
    table = np.stack(moves, axis=1)
    rewards = np.zeros(table.shape)
    rewards[size * size // 2] = 1.0
    mdp = random_actions(TabularMDP.from_arrays(table, rewards, gamma=0.9999), 0.5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy_iteration, "MOST_CHOICES", 0)
        solution = value_iteration(mdp, 1e-6)
        patch.setattr(PolicyIteration, "is_worth_it", lambda *_: False)
        swept = value_iteration(mdp, 1e-2)
    assert np.abs(solution.v - swept.v).max() <= solution.error_bound + swept.error_bound
    assert solution.error_bound <= 1e-6 and solution.sweeps < swept.sweeps


@pytest.mark.long
@pytest.mark.parametrize("size", [300, 5000])  # by direct solves, and by Krylov steps
def test_progress_is_told_while_equations_are_solved_so_that_a_budget_can_end_them(size):
    mdp, sweeps = random_actions(ring(size, 0.5), 0.5).with_gamma(0.999999), []
    value_iteration(mdp, 1e-3, progress=lambda sweep, _: sweeps.append(sweep))
    assert sweeps == sorted(sweeps) and len(sweeps) > len(set(sweeps))

    class Spent(Exception):
        pass

    def end_within(sweep, _):
        if sweeps.append(sweep) or len(sweeps) > len(set(sweeps)):
            raise Spent

    sweeps.clear()
    with pytest.raises(Spent):
        value_iteration(mdp, 1e-3, progress=end_within)


def test_what_is_tried_depends_on_the_operator_and_its_size():
    chain, walk = ring(100, 0.5), random_actions(ring(100, 0.5), 0.5)
    large = random_actions(ring(5000, 0.5), 0.5)
    ways = [(PolicyIteration(mdp, BEST).is_chain, PolicyIteration(mdp, BEST).is_direct) for mdp in (chain, walk, large)]
    assert ways == [(True, True), (False, True), (False, False)]


@pytest.fixture(scope="module", params=["exactly", "inexactly"])
def attempts_at_once(request):
    """To the end of this file: policy iteration is tried after two sweeps, four, eight, ...; inexactly: without any
    system solved directly."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("FIRST_ATTEMPT", "FIRST_INEXACT"):
            patch.setattr(policy_iteration, name, 2)
        if request.param == "inexactly":
            patch.setattr(policy_iteration, "DIRECTLY", 0)
            patch.setattr(policy_iteration, "MOST_INEXACT", 20)
        yield request.param


@pytest.mark.long
@examples(30, mdp=hard_mdps(), gamma=nearly_1)
def test_values_near_gamma_1_are_within_their_bound_whatever_way_finds_them(attempts_at_once, mdp, gamma):
    mdp = mdp.with_gamma(gamma)
    for solve, sign in ((value_iteration, 1), (worst_value, -1)):
        solution, truth = finest(solve, mdp), naive_exact.extreme_values(mdp, sign)
        assert largest_error(solution, truth) <= Fraction(solution.error_bound)
