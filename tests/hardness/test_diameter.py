"""The diameter of deterministic MDPs: against all pairs, theory, and its own intervals."""

import importlib
import math
import time
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st

from naive.hardness import distances
from patience import PATIENCE
from pharos import TabularMDP, hardness, random_actions
from pharos.errors import ParameterError
from pharos.hardness import sum_sweep
from pharos.hardness.interval import BudgetClock
from pharos.hardness.sum_sweep import Graph
from pharos.kernels import graph as kernels
from pharos.system import compiling
from strategies import examples


@st.composite
def deterministic_mdps(draw, max_states=24, ends=True):
    num_states = draw(st.integers(1, max_states))
    num_actions = draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    low = -1 if ends else 0
    if draw(st.booleans()):  # narrow steps make long distances
        table = np.arange(num_states)[:, None] + rng.integers(-2, 3, (num_states, num_actions))
        table = np.clip(table, low, num_states - 1)
    else:
        table = rng.integers(low, num_states, (num_states, num_actions))
    if ends and draw(st.booleans()):
        table[rng.random(num_states) < 0.2] = -1
    return TabularMDP.from_arrays(table, np.zeros(table.shape), initial=int(rng.integers(num_states)))


@examples(150, deterministic_mdps(), st.booleans())
def test_the_diameter_is_the_largest_distance_between_any_two_states(mdp, restart):
    d = distances(mdp, restart=restart)
    found = hardness.diameter(mdp, restart=restart)
    assert found.exact and found.counted
    assert found.lower == found.upper == d.max()
    assert found.unreachable_pairs == np.isinf(d).sum()
    assert found.finite_part == d[np.isfinite(d)].max()


@examples(60, deterministic_mdps(), st.booleans())
def test_the_start_eccentricity_is_the_largest_distance_from_the_start(mdp, restart):
    d = distances(mdp, restart=restart)
    assert hardness.start_eccentricity(mdp, restart=restart) == d[mdp.initial].max()


def strongly_connected(rng, num_states, num_actions):
    """A random cycle through all states, and random edges."""
    order = rng.permutation(num_states)
    table = rng.integers(0, num_states, (num_states, num_actions))
    table[order, 0] = np.roll(order, 1)
    return TabularMDP.from_arrays(table, np.zeros(table.shape), initial=int(order[0]))


@pytest.mark.long
@examples(60, st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 3), st.integers(0, 40))
def test_every_budget_gives_an_interval_that_holds_the_diameter_and_larger_budgets_narrower_ones(
    seed, size, num_actions, most
):
    mdp = strongly_connected(np.random.default_rng(seed), size, num_actions)
    true = distances(mdp).max()
    width = math.inf
    for searches in (0, most // 2, most, math.inf):
        found = hardness.diameter(mdp, budget=hardness.Budget(searches=searches))
        assert found.lower <= true <= found.upper
        assert found.upper - found.lower <= width
        assert found.exact == (found.lower == found.upper)
        width = found.upper - found.lower
    assert width == 0


def ring(length, starts=0):
    table = ((np.arange(length) + 1) % length)[:, None]
    return TabularMDP.from_arrays(table, np.zeros((length, 1)), initial=starts)


@pytest.mark.parametrize("size", [1, 2, 5, 100])
def test_a_ring_has_diameter_one_less_than_its_states(size):
    assert hardness.diameter(ring(size)).upper == size - 1


@pytest.mark.parametrize("size", [2, 5, 100])
def test_a_path_walked_both_ways_has_the_diameter_of_its_length(size):
    s = np.arange(size)
    table = np.clip(np.stack([s - 1, s + 1], axis=1), 0, size - 1)
    assert hardness.diameter(TabularMDP.from_arrays(table, np.zeros(table.shape), initial=size // 2)).upper == size - 1


def test_a_complete_graph_has_diameter_one():
    table = np.tile(np.arange(7), (7, 1))
    assert hardness.diameter(TabularMDP.from_arrays(table, np.zeros(table.shape))).upper == 1


def test_a_terminal_state_leads_to_the_start_in_one_step():
    table = [[1], [2], [-1]]  # state 2 is terminal, as its whole row is -1
    mdp = TabularMDP.from_arrays(table, np.zeros((3, 1)))
    assert hardness.diameter(mdp).upper == 2
    without = hardness.diameter(mdp, restart=False)
    assert (without.lower, without.upper, without.unreachable_pairs, without.finite_part) == (math.inf, math.inf, 3, 2)
    assert "infinite" in str(without)


@pytest.mark.long
def test_the_default_budget_is_not_spent_on_counting_the_pairs_of_an_infinite_diameter(monkeypatch):
    monkeypatch.setattr(sum_sweep, "COUNTING", 0.0)
    size = 5000
    forward = TabularMDP.from_arrays(np.minimum(np.arange(size) + 1, size - 1)[:, None], np.zeros((size, 1)))
    known, counted = hardness.diameter(forward), hardness.diameter(forward, budget=PATIENCE)
    assert known.exact and known.upper == counted.upper == math.inf and not known.counted
    assert 1 <= known.unreachable_pairs <= counted.unreachable_pairs == size * (size - 1) // 2
    assert known.finite_part <= counted.finite_part == size - 1 and counted.counted


def test_the_implicit_end_is_a_state_on_the_way_back_to_the_start():
    """A reward: state 2 is not terminal, its action ends."""
    mdp = TabularMDP.from_arrays([[1], [2], [-1]], [[0], [0], [1]])
    assert hardness.diameter(mdp).upper == 3  # 0 -> 1 -> 2 -> end, and 1 -> 2 -> end -> 0


def test_a_general_mdp_without_chance_is_the_deterministic_one():
    P = np.eye(3)[[[1, 0], [2, 0], [0, 2]]]
    assert hardness.diameter(TabularMDP.from_matrices(P, np.zeros((3, 2)))).upper == 2


def test_progress_is_reported_and_ends_with_the_result():
    seen = []
    mdp = strongly_connected(np.random.default_rng(0), 500, 2)
    found = hardness.diameter(mdp, progress=seen.append)
    assert seen[-1].lower == seen[-1].upper == found.upper
    assert all(p.lower <= found.upper <= p.upper for p in seen)


def test_wrong_options_are_named():
    mdp = TabularMDP.from_arrays([[0]], [[0.0]])
    with pytest.raises(ParameterError, match="tolerance is 0"):
        hardness.diameter(mdp, tolerance=0)
    with pytest.raises(ParameterError, match=r"budget of -1 .*seconds"):
        hardness.diameter(mdp, budget=-1)


# Clocks: products of an autonomous clock with a walker ----------------------------------------------------------------


def clocked(period, rows, blocked, ending=None):
    """A walker on `rows` rows beside a clock of `period` phases; where blocked[phase, row] it falls back to row 0.

    ending (period, rows) bool: where an episode ends.
    """
    phase, row = np.divmod(np.arange(period * rows), rows)
    ends = np.zeros(period * rows, bool) if ending is None else ending.ravel()
    table = np.empty((period * rows, 3), np.int64)
    for a in range(3):
        target = np.clip(row + (a - 1), 0, rows - 1)
        ahead = (phase + 1) % period
        target = np.where(blocked[ahead, target], 0, target)
        table[:, a] = ahead * rows + target
    # only what the start reaches, numbered in the order of discovery
    order, found = [0], {0: 0}
    for s in order:
        for t in table[s]:
            if not ends[s] and int(t) not in found:
                found[int(t)] = len(order)
                order.append(int(t))
    following = [[found[int(s if ends[s] else t)] for t in table[s]] for s in order]
    return TabularMDP.from_arrays(following, np.zeros((len(order), 3)), terminal=ends[order])


@pytest.mark.slow
@examples(60, st.integers(0, 2**32 - 1), st.integers(8, 60), st.integers(1, 9), st.floats(0, 0.6))
def test_clocked_spaces_have_the_largest_distance_too(seed, period, rows, density):
    blocked = np.random.default_rng(seed).random((period, rows)) < density
    blocked[:, 0] = False
    mdp = clocked(period, rows, blocked)
    found = hardness.diameter(mdp)
    assert found.exact and found.upper == distances(mdp).max()


def test_a_clock_with_layers_of_many_words_is_followed():
    period, rows = 300, 90
    found = hardness.diameter(clocked(period, rows, np.zeros((period, rows), bool)))
    assert "clock" in found.method
    # the walker crosses 89 rows in 89 steps, and misses the other end one step before
    assert (found.lower, found.upper) == (period + rows - 2, period + rows - 2)


def test_following_a_clock_may_read_each_entry_of_the_table_200_times(monkeypatch):
    limits = []
    monkeypatch.setattr(kernels, "last_gap", lambda *arguments: limits.append(arguments[-1]) or (-3, 0))
    mdp = clocked(30, 9, np.zeros((30, 9), bool))
    hardness.diameter(mdp)
    assert limits == [200 * mdp.next_states.size + 10**8]


@pytest.mark.long
@examples(
    150, st.integers(0, 2**32 - 1), st.integers(3, 40), st.integers(2, 9), st.floats(0, 0.6), st.sampled_from([1, 8])
)
def test_a_clock_that_restarts_hide_gives_the_largest_distance_to_every_target(seed, period, rows, density, words):
    rng = np.random.default_rng(seed)
    blocked = rng.random((period, rows)) < density
    ending = rng.random((period, rows)) < rng.choice([0.05, 0.3])
    ending[:, -1] |= rng.random() < 0.5
    blocked[:, 0] = ending[:, 0] = False
    mdp = clocked(period, rows, blocked, ending)
    d = distances(mdp)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sum_sweep, "_SHORTEST", 2)
        patch.setattr(sum_sweep, "_ROUNDS", 100)
        patch.setattr(sum_sweep, "_WORDS", (1, words))
        graph = Graph.of(mdp, restart=True)
        clock = sum_sweep.HiddenClock.of(graph, d[:, mdp.initial].astype(int), d[mdp.initial].astype(int))
        found = hardness.diameter(mdp)
    assert (found.lower, found.upper) == (d.max(), d.max())
    if clock is not None:
        for best in (0, int(np.median(d.max(axis=0))), int(d.max())):
            targets = rng.permutation(len(d))
            largest, _ = clock.largest_to(graph, targets, best)
            assert (largest == np.maximum(d.max(axis=0)[targets], best)).all()


@pytest.mark.long
def test_one_round_of_a_hidden_clock_closes_what_searches_one_by_one_do_not():
    rng = np.random.default_rng(0)
    blocked = rng.random((90, 6)) < 0.4
    blocked[:, 0] = False
    ending = np.zeros((90, 6), bool)
    ending[:, -1] = True
    mdp = clocked(90, 6, blocked, ending)
    found = hardness.diameter(mdp)
    assert "restarts hide" in found.method
    assert (found.lower, found.upper) == (distances(mdp).max(),) * 2


def test_a_graph_takes_four_bytes_a_node():
    assert Graph.of(ring(5, 0), restart=True).dtype == np.int32


# Start eccentricity ---------------------------------------------------------------------------------------------------


def test_every_start_state_counts_where_a_state_is_out_of_reach_of_one():
    """From state 9 nothing is reached."""
    table = np.append(np.arange(1, 10), 9)[:, None]
    mdp = TabularMDP.from_arrays(table, np.zeros((10, 1)), initial=[0, 9])
    assert hardness.start_eccentricity(mdp, restart=False) == math.inf
    assert hardness.start_eccentricity(mdp.with_initial(0), restart=False) == 9


@pytest.mark.long
def test_the_distance_from_several_start_states_is_its_mean():
    """To the state before a start: 9 steps from it, and 4 from the other."""
    found = hardness.start_eccentricity_interval(ring(10, [0, 5]))
    assert found.exact
    assert found.lower <= 6.5 <= found.upper <= 6.5 * (1 + 1e-15)
    assert hardness.start_eccentricity(random_actions(ring(10, [0, 5]), 0.5)) == pytest.approx(6.5, rel=1e-6)


@pytest.mark.long
@examples(100, deterministic_mdps(), st.data())
def test_the_start_eccentricity_is_the_largest_mean_distance(mdp, data):
    starts = data.draw(st.lists(st.integers(0, mdp.num_states - 1), min_size=1, max_size=4))
    mdp = mdp.with_initial(starts)
    d = distances(mdp.with_initial(0), restart=False)[sorted(starts)]
    found = hardness.start_eccentricity_interval(mdp, restart=False)
    assert found.exact
    if np.isinf(d).any():
        assert found.lower == found.upper == math.inf
        pairs = [(np.isinf(row).sum(), row[np.isfinite(row)].max()) for row in d if np.isinf(row).any()]
        assert (found.unreachable_pairs, found.finite_part) in pairs
        assert found.counted == (len(set(starts)) == 1)
    else:
        expected = Fraction(int(d.sum(axis=0).max()), len(starts))
        assert Fraction(found.lower) <= expected <= Fraction(found.upper)


def test_states_out_of_reach_are_counted_by_both_searches(monkeypatch):
    mdp = TabularMDP.from_arrays([[1, 1], [0, 1], [0, 2], [3, 3]], np.ones((4, 2)))
    found = hardness.start_eccentricity_interval(mdp)
    monkeypatch.setattr(
        importlib.import_module("pharos.hardness.diameter"), "needs_more_than_memory", lambda graph: True
    )
    assert (
        str(found) == str(hardness.start_eccentricity_interval(mdp)) == "infinite (2 unreachable pairs; else up to 1)"
    )


def test_the_interval_of_a_mean_distance_holds_its_exact_fraction():
    """Round a ring; starts that are likelier than others stand there several times."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        length = int(rng.integers(3, 40))
        starts = rng.integers(0, length, rng.integers(2, 9))
        expected = max(Fraction(sum((t - int(s)) % length for s in starts), len(starts)) for t in range(length))
        found = hardness.start_eccentricity_interval(ring(length, starts))
        assert found.exact and Fraction(found.lower) <= expected <= Fraction(found.upper)


def test_seconds_of_compiling_are_not_taken_from_a_budget(monkeypatch):
    """Else a value is exact on one machine and an interval on a slower one, where nothing is compiled yet."""
    spending = BudgetClock(hardness.Budget(seconds=0.01), None)
    time.sleep(0.02)
    assert spending.is_over
    monkeypatch.setattr(compiling, "_total", compiling.seconds() + PATIENCE)
    assert not spending.is_over


def test_a_budget_that_ends_between_start_states_leaves_an_interval():
    found = hardness.start_eccentricity_interval(ring(10, [0, 5]), budget=hardness.Budget(searches=1))
    assert not found.exact and "1 of 2 start states" in found.note
    assert found.lower <= 6.5 <= found.upper
