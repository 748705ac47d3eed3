"""Diameter under chance: against value iteration on explicit matrices, theory, and published values."""

import math
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse.linalg
from hypothesis import strategies as st

import pharos
from naive import hitting as naive_hitting
from patience import PATIENCE
from pharos import hardness
from pharos.errors import UndefinedMeasure
from pharos.hardness.hitting_times import HittingBounds, HittingTimes, factors_of, multiplications
from pharos.hardness.interval import Budget, BudgetClock
from pharos.hardness.stochastic_diameter import HubBounds, _Diameter
from pharos.kernels import hitting
from pharos.mdp import ExpandedMDP, TabularMDP, random_actions, sticky_actions
from strategies import deterministic_mdps, examples, general_mdps, outcome_mdps

some = st.sampled_from([0.0, 0.25, 0.5])


@st.composite
def chancy_mdps(draw):
    """Small MDPs with chance: sticky, random, both, general matrices, several outcomes, several start states."""
    small = deterministic_mdps(max_states=4, max_actions=2), general_mdps(max_states=3, max_actions=2)
    mdp = draw(st.one_of(*small, outcome_mdps()))
    return random_actions(sticky_actions(mdp, draw(some)), draw(some))


@pytest.mark.long
@examples(60, chancy_mdps(), st.booleans())
def test_diameters_are_those_of_the_explicit_matrices(mdp, restart):
    if mdp.is_deterministic and len(mdp.start_states) == 1:
        mdp = random_actions(mdp, 0.25)
    found = hardness.diameter(mdp, restart=restart)
    expected, finite = naive_hitting.diameter(mdp, restart)
    assert found.exact
    assert math.isinf(found.upper) == math.isinf(expected)
    if mdp.is_sticky and math.isinf(expected):
        return  # states that are not reached have no pairs: the finite parts are not comparable
    assert found.finite_part == pytest.approx(finite, rel=1e-5)
    if math.isfinite(expected):
        assert found.lower <= expected * (1 + 1e-9) and expected <= found.upper * (1 + 1e-9)


@pytest.mark.long
@examples(15, st.integers(2, 5), st.integers(1, 3), st.integers(0, 10**6))
def test_the_other_solver_of_expected_steps_agrees(num_states, num_actions, seed):
    """Without terminal states the diameter is the largest of the least expected costs of 1 a step."""
    probabilities = np.random.default_rng(seed).dirichlet(np.full(num_states, 0.3), (num_states, num_actions))
    mdp = TabularMDP.from_matrices(probabilities, np.zeros((num_states, num_actions)), axes="SAS")
    bounds = [pharos.reach(mdp, [s], costs=np.ones(mdp.rewards.shape)).least_cost for s in range(num_states)]
    diameter = hardness.diameter(mdp, restart=False)
    assert diameter.lower <= max(each.upper.max() for each in bounds) * (1 + 1e-9)
    assert max(each.lower.max() for each in bounds) <= diameter.upper * (1 + 1e-9)
    assert diameter.exact and max(each.upper.max() for each in bounds) == pytest.approx(diameter.upper, rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("workers", [2, 5])
def test_results_do_not_depend_on_the_number_of_threads(workers, monkeypatch):
    mdp = random_actions(pharos.build(pharos.make("frozen_lake/8x8")).mdp(), 0.1)
    monkeypatch.setattr("pharos.hardness.stochastic_diameter.usable_workers", lambda _: 1)
    expected = hardness.diameter(mdp)
    monkeypatch.setattr("pharos.hardness.stochastic_diameter.usable_workers", lambda _: workers)
    found = hardness.diameter(mdp)
    assert (found.lower, found.upper, found.searches) == (expected.lower, expected.upper, expected.searches)


@pytest.mark.long
@examples(40, chancy_mdps(), st.booleans())
def test_start_eccentricities_are_those_of_the_explicit_matrices(mdp, restart):
    mdp = random_actions(mdp, 0.25)
    expected = naive_hitting.start_eccentricity(mdp, restart)
    assert hardness.start_eccentricity(mdp, restart=restart) == pytest.approx(expected, rel=1e-5)


@examples(30, chancy_mdps(), st.integers(0, 5))
def test_the_interval_holds_the_value_for_every_budget(mdp, searches):
    mdp = random_actions(mdp, 0.25)
    expected, _ = naive_hitting.diameter(mdp, True)
    found = hardness.diameter(mdp, budget=hardness.Budget(searches=searches))
    assert found.lower <= expected * (1 + 1e-9)
    assert expected <= found.upper * (1 + 1e-9)
    if not found.exact:
        assert "budget" in found.note


def largest_times(mdp):
    """(states that count, (S + 1, S + 1) largest expected time from s to e over previous actions; -inf elsewhere)."""
    times, reached, state, _ = naive_hitting.hitting_times(mdp, True)
    nodes = naive_hitting.nodes_that_count(mdp, reached, state)
    largest = np.full((mdp.num_states + 1, mdp.num_states + 1), -math.inf)
    for n in nodes:
        largest[state[n]] = np.maximum(largest[state[n]], times[n])
    return np.unique(state[nodes]), largest


@examples(30, chancy_mdps())
def test_bounds_from_a_hub_hold_for_every_target(mdp):
    mdp = random_actions(mdp, 0.25)
    states, largest = largest_times(mdp)
    if not np.isfinite(largest[np.ix_(states, states)]).all():
        return  # such an MDP is not bounded from hubs
    bounds = HubBounds(mdp, True)
    size = mdp.num_states + naive_hitting.any_end(mdp)
    for hub in states:
        found = bounds.times_from(hub, np.maximum(largest[:size, hub], 0.0))
        assert (found[states] >= largest[hub, states] * (1 - 1e-9)).all()


@pytest.mark.long
@examples(150, chancy_mdps(), st.sampled_from([0.05, 0.25]))
def test_bounds_through_the_nodes_around_a_target_hold_and_never_grow(mdp, chance):
    mdp = random_actions(mdp, chance)
    states, largest = largest_times(mdp)
    if not np.isfinite(largest[np.ix_(states, states)]).all():
        return
    bounds = HubBounds(mdp, True)
    size = mdp.num_states + naive_hitting.any_end(mdp)
    for hub in states:
        to_hub = np.maximum(largest[:size, hub], 0.0)
        away = bounds.times_from(hub, to_hub)
        for around in (1, 2, 3, 100, 100):
            some = np.flatnonzero(np.arange(len(away)) % 5 != around % 5)
            shorter = bounds.shortened(to_hub, away, some, around, lambda: False)
            assert (shorter <= away).all()
            assert (np.delete(shorter, some) == np.delete(away, some)).all()
            assert (shorter[states] >= largest[hub, states] * (1 - 1e-9)).all()
            away = shorter


@pytest.mark.long
@pytest.mark.parametrize("chance", [lambda mdp: random_actions(mdp, 0.1), lambda mdp: sticky_actions(mdp, 0.25)])
def test_where_a_slip_leads_on_the_interval_is_narrow_and_few_targets_are_solved(chance):
    mdp = chance(pharos.build(pharos.make("breakout", height=6, columns=4)).mdp())
    little = hardness.diameter(mdp, budget=hardness.Budget(searches=40))
    found = hardness.diameter(mdp)
    start = hardness.start_eccentricity_interval(mdp)
    assert found.exact and found.searches < 200  # of 4,620
    assert little.lower <= found.upper and found.lower <= little.upper < 1.3 * little.lower
    assert start.exact and start.upper <= found.upper * (1 + 1e-9)


@pytest.mark.long
def test_a_few_long_ways_bound_the_targets_that_a_slip_leads_far_away_from():
    """A ball flies 40 steps up and down: bounds by short ways alone are 8,000 times too large."""
    mdp = random_actions(pharos.build(pharos.make("breakout", height=24, columns=5, brick_rows=1)).mdp(), 0.1)
    little = hardness.diameter(mdp, budget=hardness.Budget(searches=5))
    found = hardness.diameter(mdp)
    assert found.exact and found.searches < 300  # of 17,145
    assert found.lower / 1.3 < little.lower <= found.upper and found.lower <= little.upper < 1.3 * found.upper


@examples(30, chancy_mdps())
def test_spaces_too_large_for_a_look_at_each_target_have_the_same_diameter(mdp):
    mdp = random_actions(mdp, 0.25)
    expected, _ = naive_hitting.diameter(mdp, True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pharos.hardness.stochastic_diameter.MANY", -1)
        found = hardness.diameter(mdp)
    if math.isinf(expected):
        assert math.isinf(found.lower) and (found.exact or not found.counted)
    else:
        assert found.exact and found.upper == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("chance", [lambda mdp: random_actions(mdp, 0.1), lambda mdp: sticky_actions(mdp, 0.25)])
def test_few_targets_settle_a_grid_and_the_interval_squeezes(chance):
    mdp = chance(pharos.build(pharos.make("simple_grid", height=30, width=30)).mdp())
    intervals = []
    found = hardness.diameter(mdp, progress=lambda p: intervals.append((p.lower, p.upper)))
    assert found.exact and found.searches < 90
    assert all(low <= found.lower and high >= found.upper * (1 - 1e-9) for low, high in intervals)
    little = hardness.diameter(mdp, budget=hardness.Budget(searches=3))
    assert not little.exact and little.upper < 3 * little.lower
    more = hardness.diameter(mdp, budget=hardness.Budget(searches=25))
    assert little.lower <= more.lower and more.upper < little.upper


def ring(length, lazy):
    """One action: on with probability 1 - lazy, else stay."""
    matrix = np.zeros((length, 1, length))
    for s in range(length):
        matrix[s, 0, (s + 1) % length] += 1 - lazy
        matrix[s, 0, s] += lazy
    return TabularMDP.from_matrices(matrix, np.zeros((length, 1)))


@pytest.mark.parametrize("lazy", [0.1, 0.5, 0.9])
def test_every_step_of_a_lazy_ring_takes_longer(lazy):
    assert hardness.diameter(ring(9, lazy)).upper == pytest.approx(8 / (1 - lazy), rel=1e-6)


def test_a_lazy_grid_has_the_published_diameter():
    """Colosseum's continuous simple grid of 16 x 16 with a lazy probability of 0.065: 32.08537, to its tolerance of
    1e-3."""
    size, lazy = 16, 0.065
    matrix = np.zeros((size * size, 4, size * size))
    for row in range(size):
        for column in range(size):
            for action, (down, right) in enumerate(((-1, 0), (0, 1), (1, 0), (0, -1))):
                there = min(max(row + down, 0), size - 1) * size + min(max(column + right, 0), size - 1)
                matrix[row * size + column, action, there] += 1 - lazy
                matrix[row * size + column, action, row * size + column] += lazy
    found = hardness.diameter(TabularMDP.from_matrices(matrix, np.zeros((size * size, 4))))
    assert found.upper == pytest.approx(30 / (1 - lazy), rel=1e-6)
    assert found.upper == pytest.approx(32.08537, abs=1e-3)


def test_chance_that_never_acts_changes_nothing():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp()
    plain = hardness.diameter(mdp).upper
    assert hardness.diameter(random_actions(mdp, 0.0)).upper == plain
    assert hardness.diameter(sticky_actions(mdp, 0.0)).upper == plain


@pytest.mark.parametrize("p", [0.1, 0.3])
def test_chance_can_only_make_the_way_longer(p):
    mdp = pharos.build(pharos.make("frozen_lake/8x8")).mdp()
    plain = hardness.diameter(mdp).upper
    assert hardness.diameter(random_actions(mdp, p)).upper > plain
    assert hardness.diameter(sticky_actions(mdp, p)).upper > plain


def test_a_report_under_chance_has_a_diameter():
    report = hardness.report(
        sticky_actions(pharos.build(pharos.make("simple_grid")).mdp(), 0.25), "diameter,start_eccentricity"
    )
    assert report["diameter"].value["exact"]
    assert report["start_eccentricity"].value < report["diameter"].value["upper"] + 1e-9


def test_progress_shows_bounds_that_squeeze():
    seen = []
    mdp = random_actions(pharos.build(pharos.make("frozen_lake/8x8")).mdp(), 0.2)
    found = hardness.diameter(mdp, progress=seen.append)
    assert seen[-1].candidates == 0
    assert all(each.lower <= found.upper <= each.upper * (1 + 1e-9) for each in seen)


@pytest.mark.parametrize(("enough", "seconds"), [(math.inf, PATIENCE), (0.0, 0)])
def test_a_target_that_is_not_the_farthest_or_beyond_the_budget_costs_no_linear_system(enough, seconds, monkeypatch):
    problem = HittingTimes(ExpandedMDP.of(ring(50, 0.9), restart=True))
    monkeypatch.setattr(problem, "_factored", lambda _: pytest.fail("solves a linear system"))
    j, count, _ = problem.open(0)
    bounds = problem.solve(j, count, 1e-12, enough, BudgetClock(hardness.Budget(seconds=seconds), None))
    assert not bounds.meets(1e-12) and bounds.lower <= 490 <= bounds.upper


@pytest.mark.parametrize("shape", [(400,), (30, 30), (150, 8), (9, 9, 9), (6, 6, 5, 5), None])
def test_the_cost_of_a_linear_solve_is_known_before_it_begins(shape):
    """Multiplications by the factors that SuperLU finds: of walks on grids, and of one that leads anywhere."""
    if shape is None:
        walk = np.random.default_rng(0).integers(0, 600, (600, 3))
    else:
        cells = np.indices(shape).reshape(len(shape), -1)
        moves = (cells + sign * np.eye(len(shape), dtype=int)[:, [k]] for k in range(len(shape)) for sign in (-1, 1))
        walk = np.stack([np.ravel_multi_index(each, shape, mode="clip") for each in moves], axis=1)
    choices = ExpandedMDP.of(random_actions(TabularMDP.from_arrays(walk, np.zeros(walk.shape), gamma=0.9), 0.9), False)
    problem = HittingTimes(choices)
    _, count, _ = problem.open(0)
    _, factors = problem._factored(count)
    columns, rows = np.diff(factors.factors.L.tocsc().indptr), np.diff(factors.factors.U.tocsr().indptr)
    counted = float(columns.astype(float) @ rows)
    assert counted / 4 <= multiplications(problem._layers(count)) <= 40 * counted
    assert not problem._outlasts(count, BudgetClock(Budget(seconds=PATIENCE), None))
    assert problem._outlasts(count, BudgetClock(Budget(seconds=counted * 1e-11), None))


def test_the_farthest_target_so_far_makes_the_guess_for_the_next():
    """Every step of a lazy ring takes ten."""
    mdp = ring(20, 0.9)
    search = _Diameter(mdp, True, ExpandedMDP.of(mdp, restart=True), 1e-6, BudgetClock(hardness.Budget(), None))
    search.run()
    assert search.targets.initial_scale == pytest.approx(10, rel=1e-3)


# Large hitting times --------------------------------------------------------------------------------------------------


def combination_lock(length, wrong=0.5):
    """`length` right actions in a row; anything else leads back to the start. A wrong one is executed with probability
    wrong / 2."""
    following = [[i + 1, 0] for i in range(length)] + [[0, 0]]
    plain = TabularMDP.from_arrays(following, np.zeros((length + 1, 2)), gamma=0.9)
    return random_actions(plain, wrong)


def time_to_open(length):
    """E[steps] = sum over k = 1, ..., length of (4 / 3)^k, where the right action is executed with probability 3 /
    4."""
    return sum(Fraction(4, 3) ** k for k in range(1, length + 1))


@pytest.mark.slow
@pytest.mark.parametrize("length", [10, 40, 60, 70, 75, 80, 90, 100, 110, 120])
def test_hitting_times_beyond_the_digits_of_a_float_are_proven(length):
    truth = time_to_open(length)
    diameter = hardness.diameter(combination_lock(length))
    assert diameter.exact
    assert Fraction(diameter.lower) <= truth <= Fraction(diameter.upper)
    assert diameter.upper - diameter.lower <= 2e-6 * diameter.upper
    start = hardness.start_eccentricity_interval(combination_lock(length))
    assert start.exact
    assert Fraction(start.lower) <= truth <= Fraction(start.upper)


@pytest.mark.long
@pytest.mark.parametrize("length", [130, 150, 300])
def test_where_floats_prove_no_closer_bounds_an_interval_comes_before_the_budget_ends(length):
    truth = time_to_open(length)
    diameter = hardness.diameter(combination_lock(length), budget=PATIENCE)
    assert not diameter.exact and "64-bit floats" in diameter.note
    assert Fraction(diameter.lower) <= truth <= Fraction(diameter.upper)
    start = hardness.start_eccentricity_interval(combination_lock(length), budget=PATIENCE)
    assert not start.exact and "64-bit floats" in start.note
    assert Fraction(start.lower) <= truth <= Fraction(start.upper)
    with pytest.raises(UndefinedMeasure, match="between"):
        hardness.start_eccentricity(combination_lock(length))


@pytest.mark.parametrize(("width", "truth"), [(24, 520457582.872), (28, 14083681318.474), (36, 10312830586529.5)])
def test_long_lakes_have_the_diameter_of_sixty_digits(width, truth):
    """Truth: policy iteration with 60 digits, to the digits given."""
    rows = "H" * width, "S" + "F" * (width - 2) + "G", "H" * width
    lake = pharos.build(pharos.make("frozen_lake", map="/".join(rows))).mdp()
    found = hardness.diameter(random_actions(lake, 0.8))
    assert found.exact
    assert found.lower <= truth * (1 + 1e-12) and truth * (1 - 1e-12) <= found.upper


def test_residuals_count_their_rounding():
    """Of any J, one float a node or the sum of two, in exact fractions; probabilities are multiples of 2^-20."""
    rng = np.random.default_rng(0)
    matrix = rng.multinomial(2**20, np.full(6, 1 / 6), (6, 2)) / 2**20
    times = HittingTimes(ExpandedMDP.of(TabularMDP.from_matrices(matrix, np.zeros((6, 2))), restart=False))
    count, size = times.distances(0), len(times.goal)
    arguments = (times.rows, times.goal, times.order[:count])

    def changes(j):
        """T J - J of the nodes 1 to 5; node 0 is the target."""
        steps = (
            [sum(Fraction(p) * (j[m] - j[n]) for m, p in enumerate(row)) for row in matrix[n]] for n in range(1, 6)
        )
        return [1 + min(each) for each in steps]

    for _ in range(60):
        high = rng.random(size) * 10.0 ** rng.integers(0, 12)
        low = rng.uniform(-1, 1, size) * high * 2.0**-54
        high[times.goal] = low[times.goal] = 0.0
        above, below, _ = hitting.residual_bounds(*arguments, high, None, times.policy, None)
        exact = changes([Fraction(float(value)) for value in high])
        assert -Fraction(below) <= min(exact) and max(exact) <= Fraction(above)
        residual, error = np.zeros(size), np.zeros(size)
        hitting.residual_bounds(*arguments, high, low, times.policy, (residual, error))
        exact = changes([Fraction(float(one)) + Fraction(float(two)) for one, two in zip(high, low, strict=True)])
        for n, change in enumerate(exact, start=1):
            assert abs(change - Fraction(float(residual[n]))) <= Fraction(float(error[n]))


@st.composite
def rare_rows(draw, max_states=4, max_actions=2):
    """(S, A) of (state, rare state, k): an action leads to the rare state with probability 2^-k, else to the other
    one."""
    num_states, num_actions = draw(st.integers(2, max_states)), draw(st.integers(1, max_actions))
    state = st.integers(0, num_states - 1)
    outcome = st.tuples(state, state, st.sampled_from([1, 4, 12, 20, 30, 40, 50]))
    row = st.lists(outcome, min_size=num_actions, max_size=num_actions)
    return draw(st.lists(row, min_size=num_states, max_size=num_states))


@pytest.mark.long
@examples(150, rare_rows())
def test_intervals_hold_the_hitting_times_of_exact_fractions(rows):
    """Probabilities are exact in binary, down to 2^-50, so hitting times go up to 1e45."""
    num_states, num_actions = len(rows), len(rows[0])
    matrix = np.zeros((num_states, num_actions, num_states))
    for s, a in np.ndindex(num_states, num_actions):
        state, rare, k = rows[s][a]
        matrix[s, a, state] += 1 - 2.0**-k
        matrix[s, a, rare] += 2.0**-k
    times = naive_hitting.exact_hitting_times(matrix)
    truth = max(times[s][e] for s in range(num_states) for e in range(num_states) if s != e)
    mdp = TabularMDP.from_matrices(matrix, np.zeros((num_states, num_actions)), axes="SAS")
    found = hardness.diameter(mdp, budget=PATIENCE)
    start = hardness.start_eccentricity_interval(mdp, budget=PATIENCE)
    for interval, value in ((found, truth), (start, max(times[0]))):
        if value == math.inf:
            assert interval.lower == interval.upper == math.inf
        else:
            assert math.isfinite(interval.lower) and Fraction(interval.lower) <= value
            assert interval.upper == math.inf or value <= Fraction(interval.upper)
            assert not interval.exact or interval.upper - interval.lower <= 2e-6 * interval.upper
            assert value > 1e13 or interval.exact


def many_starts(size, starts, slips):
    """A walk with chance over half of the states, by leaps into the other half; starts in any of the first `starts`."""
    state, half = np.arange(size), size // 2
    ways = [np.stack([(state + step) % size, state], axis=1) for step in (1, half)]
    successors = np.where((state >= half)[:, None, None], state[:, None, None], np.stack(ways, axis=1))
    chances = np.broadcast_to([1 - slips, slips], successors.shape).copy()
    initial = np.where(state < starts, 1.0 / starts, 0.0)
    return TabularMDP.from_outcomes(successors, chances, np.zeros((size, 2)), terminal=state >= half, initial=initial)


def test_states_in_which_episodes_end_are_one_unknown_of_linear_systems():
    choices = ExpandedMDP.of(many_starts(40, 10, 0.2), True)
    targets = HittingTimes(choices)
    for target in (3, 25):
        j, count, _ = targets.open(target)
        targets.bounds(j, count)
        inner, factors = targets._factored(count)
        assert inner.size == 39 and len(factors.first) == 20 + (target == 25)


@pytest.mark.parametrize("starts", [1, 2, 10])
def test_episodes_that_end_in_many_states_and_start_in_many_are_those_of_the_matrices(starts):
    mdp = many_starts(30, starts, 0.2)
    expected, _ = naive_hitting.diameter(mdp, True)
    assert hardness.diameter(mdp).upper == pytest.approx(expected, rel=1e-6)
    expected = naive_hitting.start_eccentricity(mdp, True)
    assert hardness.start_eccentricity(mdp) == pytest.approx(expected, rel=1e-6)


def slippery_torus(size, slips):
    """Steps in four directions, each of which may go to either side instead: (S, A, K) outcomes."""
    row, column = np.divmod(np.arange(size * size), size)
    ahead = [(row + down) % size * size + (column + right) % size for down, right in ((-1, 0), (0, 1), (1, 0), (0, -1))]
    around = np.stack(ahead, axis=1)
    successors = np.stack([np.roll(around, turn, axis=1) for turn in (0, 1, -1)], axis=2)
    chances = np.broadcast_to([1 - 2 * slips, slips, slips], successors.shape).copy()
    return TabularMDP.from_outcomes(successors, chances, np.zeros(successors.shape[:2]))


def test_one_hub_bounds_a_world_with_slips_and_settles_how_far_the_start_is_from_all():
    mdp = slippery_torus(12, 0.1)
    little = hardness.diameter(mdp, budget=hardness.Budget(searches=1))
    assert little.upper < 3 * little.lower  # ways back are by the most probable outcome, not by a slip
    found = hardness.start_eccentricity_interval(mdp)
    assert found.exact and found.searches <= 30  # of 144
    assert found.upper == pytest.approx(little.lower, rel=1e-6)  # every state is like every other
    cut = hardness.start_eccentricity_interval(mdp, budget=hardness.Budget(searches=2))
    assert not cut.exact and cut.lower <= found.lower and found.upper <= cut.upper < 3 * cut.lower


def test_hitting_times_of_random_graphs_take_sweeps_where_factors_would_fill_in(monkeypatch):
    rng = np.random.default_rng(0)
    successors, chances = rng.integers(0, 3000, (3000, 2, 3)), rng.dirichlet(np.ones(3), (3000, 2))
    targets = HittingTimes(ExpandedMDP.of(TabularMDP.from_outcomes(successors, chances, np.zeros((3000, 2))), True))
    monkeypatch.setattr(HittingTimes, "_factored", None)
    j, count, _ = targets.open(7)
    bounds = targets.solve(j, count, 1e-6, 0.0, BudgetClock(hardness.Budget(), None))
    assert bounds.meets(1e-6)


@pytest.mark.long
def test_the_hardness_of_blackjack_is_exact():
    mdp = pharos.build("blackjack").mdp()
    found = hardness.diameter(mdp, budget=PATIENCE)
    assert found.exact and found.upper == pytest.approx(38114.81866, rel=1e-6)
    found = hardness.start_eccentricity_interval(mdp, budget=PATIENCE)
    assert found.exact and found.upper == pytest.approx(38112.81866, rel=1e-6)


def test_attempts_that_fail_a_million_times_take_few_sweeps():
    """A row of 20 cells, each step of which leads on or back to the first by a coin: 2^20 - 2 steps.

    A sweep alone brings the first cell one step nearer to it.
    """
    cells = np.arange(20)
    successors = np.stack([np.minimum(cells + 1, 19), np.zeros(20, int)], axis=1)[:, None, :]
    mdp = TabularMDP.from_outcomes(successors, np.full((20, 1, 2), 0.5), np.zeros((20, 1)))
    targets = HittingTimes(ExpandedMDP.of(mdp, restart=True))
    j, count, _ = targets.open(19)
    bounds = targets.sweep(j, count, 400, 0.0, BudgetClock(Budget(), None))
    assert bounds.lower <= 2**20 - 2 <= bounds.upper
    assert bounds.apart < 1e-3


@pytest.mark.parametrize("next_states", [[[0, 0]], [[1, 1], [0, 0]]])
@pytest.mark.parametrize("many", [0, 10**9])
def test_actions_that_are_repeated_for_ever_may_all_lead_everywhere(next_states, many, monkeypatch):
    monkeypatch.setattr("pharos.hardness.stochastic_diameter.MANY", many)
    mdp = TabularMDP.from_arrays(np.array(next_states), np.zeros((len(next_states), 2)))
    found = hardness.diameter(sticky_actions(mdp, 1.0), restart=False)
    assert found.exact
    assert found.lower <= len(next_states) - 1 <= found.upper < math.inf
    assert found.unreachable_pairs == 0


@pytest.mark.long
def test_a_target_without_an_upper_bound_so_far_is_not_ruled_out():
    """Sweeps leave negative times of the end for a while, of which infinity is no multiple to go by."""
    weights = [
        [[1e-6, 0, 1, 1e-6], [1e-6, 1, 1, 0], [0, 2, 1e-6, 1e-6]],
        [[0, 1e-6, 0, 1], [1, 0, 0, 0], [1e-6, 0, 2, 0]],
        [[1, 0, 2, 1], [0, 2, 1, 1], [0, 1e-6, 1, 0]],
    ]
    matrix = np.array(weights) / np.sum(weights, axis=2, keepdims=True)
    mdp = TabularMDP.from_matrices(
        matrix[..., :3], np.zeros((3, 3)), axes="SAS", ends=1 - matrix[..., :3].sum(axis=2)
    ).with_initial([1, 2])
    mdp = sticky_actions(replace(mdp, start_probabilities=np.array([1 / 6, 5 / 6])), 1.0)
    found = hardness.start_eccentricity_interval(mdp)
    assert found.exact
    truth = 4.333330166673335  # by elimination in fractions
    assert found.lower <= truth * (1 + 1e-9)
    assert truth <= found.upper * (1 + 1e-9)


def test_where_no_upper_bound_is_known_there_is_none_of_times_of_0():
    assert HittingBounds(0.5, math.inf, 0.0).upper == math.inf


def test_an_improper_policy_is_told_before_the_linear_algebra_prints_messages_about_it(monkeypatch, capfd):
    """Two nodes stay where they are: 1 - P is singular, for which SuperLU complains on the terminal."""
    rng = np.random.default_rng(0)
    matrix = scipy.sparse.random(60, 61, 0.08, "csr", rng=rng).tolil()
    matrix[:, 60] = 0.1
    for stays in (10, 40):
        matrix[stays, :], matrix[stays, stays] = 0.0, 1.0
    matrix = scipy.sparse.csr_matrix(matrix)
    matrix = scipy.sparse.csr_matrix(scipy.sparse.diags(1 / np.asarray(matrix.sum(axis=1)).ravel()) @ matrix)
    choices = SimpleNamespace(matrix=matrix, num_actions=1, is_restart=np.zeros(61, np.bool_))
    policy, inner = np.zeros(61, np.int64), np.arange(60)
    assert factors_of(choices, policy, np.setdiff1d(inner, (10, 40))) is not None
    monkeypatch.setattr(scipy.sparse.linalg, "splu", None)  # is not called
    assert factors_of(choices, policy, inner) is None
    assert capfd.readouterr() == ("", "")
