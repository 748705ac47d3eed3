"""Diameter under chance: against value iteration on explicit matrices, theory, and published values."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive_hitting
import pharos
from pharos import hardness
from pharos.hardness.travel import TravelBounds
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from strategies import deterministic_mdps, general_mdps

some = st.sampled_from([0.0, 0.25, 0.5])


@st.composite
def chancy_mdps(draw):
    """Small MDPs with chance: sticky, random, both, general matrices, several start states."""
    mdp = draw(st.one_of(deterministic_mdps(max_states=4, max_actions=2), general_mdps(max_states=3, max_actions=2)))
    return random_actions(sticky_actions(mdp, draw(some)), draw(some))


@settings(max_examples=60, deadline=None)
@given(chancy_mdps(), st.booleans())
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


@pytest.mark.parametrize("workers", [2, 5])
def test_results_do_not_depend_on_the_number_of_threads(workers, monkeypatch):
    mdp = random_actions(pharos.build(pharos.make("frozen_lake/8x8")).mdp(), 0.1)
    monkeypatch.setattr("pharos.hardness.stochastic_diameter.usable_workers", lambda _: 1)
    expected = hardness.diameter(mdp)
    monkeypatch.setattr("pharos.hardness.stochastic_diameter.usable_workers", lambda _: workers)
    found = hardness.diameter(mdp)
    assert (found.lower, found.upper, found.searches) == (expected.lower, expected.upper, expected.searches)


@settings(max_examples=40, deadline=None)
@given(chancy_mdps(), st.booleans())
def test_start_eccentricities_are_those_of_the_explicit_matrices(mdp, restart):
    mdp = random_actions(mdp, 0.25)
    expected = naive_hitting.start_eccentricity(mdp, restart)
    assert hardness.start_eccentricity(mdp, restart=restart) == pytest.approx(expected, rel=1e-5)


@settings(max_examples=30, deadline=None)
@given(chancy_mdps(), st.integers(0, 5))
def test_the_interval_holds_the_value_for_every_budget(mdp, searches):
    mdp = random_actions(mdp, 0.25)
    expected, _ = naive_hitting.diameter(mdp, True)
    found = hardness.diameter(mdp, budget=hardness.Budget(searches=searches))
    assert found.lower <= expected * (1 + 1e-9)
    assert expected <= found.upper * (1 + 1e-9)
    if not found.exact:
        assert "budget" in found.note


@settings(max_examples=30, deadline=None)
@given(chancy_mdps())
def test_bounds_from_a_hub_hold_for_every_target(mdp):
    mdp = random_actions(mdp, 0.25)
    times, reached, state, _ = naive_hitting.hitting_times(mdp, True)
    nodes = naive_hitting.nodes_that_count(mdp, reached, state)
    states = np.unique(state[nodes])
    largest = np.full((mdp.num_states + 1, mdp.num_states + 1), -math.inf)
    for n in nodes:
        largest[state[n]] = np.maximum(largest[state[n]], times[n])
    if not np.isfinite(largest[np.ix_(states, states)]).all():
        return  # such an MDP is not bounded from hubs
    bounds = TravelBounds(mdp, True)
    size = mdp.num_states + naive_hitting.any_end(mdp)
    for hub in states:
        found = bounds.times_from(hub, np.maximum(largest[:size, hub], 0.0))
        assert (found[states] >= largest[hub, states] * (1 - 1e-9)).all()


@settings(max_examples=30, deadline=None)
@given(chancy_mdps())
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
    """Colosseum's continuous simple grid of 16 x 16 with a lazy probability of 0.065: 32.08537, to its tolerance of 1e-3."""
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
