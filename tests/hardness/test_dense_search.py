"""Searches from 512 nodes at once where levels are few and wide: distances, what follows along edges, nearly equal
eccentricities."""

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive.hardness import distances
from pharos import TabularMDP, hardness
from pharos.hardness.sum_sweep import Graph
from pharos.kernels import many_searches
from solution_lengths import solution_lengths
from strategies import examples


@st.composite
def graphs(draw):
    """(graph, its distances): some nodes end the episode, some actions lead to the implicit end."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    num_states, num_actions = draw(st.integers(2, 75)), draw(st.integers(1, 3))
    table = rng.integers(draw(st.sampled_from([-1, 0])), num_states, (num_states, num_actions))
    table[rng.random(num_states) < draw(st.sampled_from([0.0, 0.1]))] = -1
    mdp = TabularMDP.from_arrays(table, np.zeros(table.shape), initial=int(rng.integers(num_states)))
    restart = draw(st.booleans())
    return Graph.of(mdp, restart), distances(mdp, restart=restart)


@pytest.mark.long
@examples(60, graphs())
def test_the_largest_distance_to_each_source_is_found(drawn):
    graph, distance = drawn
    sources = np.arange(graph.num_nodes, dtype=graph.dtype)
    bits = [np.zeros((graph.num_nodes, many_searches.WORDS), np.uint64) for _ in range(3)]
    flags = [np.zeros(graph.num_nodes, np.bool_) for _ in range(2)]
    largest = np.empty(len(sources), np.int64)
    many_searches.dense_search_backward(graph.next_states, graph.ends, graph.start, sources, *bits, *flags, largest)
    np.testing.assert_array_equal(largest, np.where(np.isfinite(distance), distance, 0).max(axis=0))


@pytest.mark.long
@examples(60, graphs(), st.integers(0, 2**32 - 1))
def test_bounds_that_follow_along_edges_hold_and_are_the_least_of_all_paths(drawn, seed):
    """From exact values of a few nodes: in(v) <= in(u) + d(u, v) and out(v) <= d(v, u) + out(u), and no less."""
    graph, distance = drawn
    unknown = np.iinfo(graph.dtype).max
    known = np.random.default_rng(seed).random(graph.num_nodes) < 0.2
    for_in, for_out = np.minimum(distance.max(axis=0), 1000), np.minimum(distance.max(axis=1), 1000)
    in_upper, out_upper = (np.where(known, exact, unknown).astype(graph.dtype) for exact in (for_in, for_out))
    expected_in = np.min(np.where(known, for_in, np.inf)[:, None] + distance, axis=0)
    expected_out = np.min(distance + np.where(known, for_out, np.inf)[None, :], axis=1)
    while many_searches.lower_along_edges(graph.next_states, graph.ends, graph.start, in_upper, out_upper):
        pass
    for found, expected in ((in_upper, expected_in), (out_upper, expected_out)):
        np.testing.assert_array_equal(found, np.where(np.isfinite(expected), expected, unknown).astype(graph.dtype))


@pytest.mark.long
@examples(50, graphs(), st.integers(1, 20))
def test_nodes_that_are_spread_out_are_no_successors_of_those_before(drawn, limit):
    graph, distance = drawn
    order = np.arange(graph.num_nodes, dtype=graph.dtype)[::-1].copy()
    blocked = np.zeros(graph.num_nodes, np.bool_)
    chosen = many_searches.spread_out(graph.next_states, graph.ends, order, blocked, limit)
    ended = np.append(graph.ends, [True] * graph.has_end)
    for i, v in enumerate(chosen):
        assert not any(distance[u, v] == 1 and not ended[u] and v < len(graph.ends) for u in chosen[:i])
    assert len(chosen) == limit or len(chosen) > 0
    num_successors = [len({t for t in row if t != s}) for s, row in enumerate(graph.next_states.tolist())]
    counted = many_searches.num_successors(graph.next_states, graph.ends, graph.num_nodes)
    assert counted[: len(graph.ends)][~graph.ends].tolist() == np.array(num_successors)[~graph.ends].tolist()


@pytest.mark.long
def test_the_diameter_of_a_small_tray_is_the_largest_of_all_distances():
    space = pharos.build(pharos.make("sliding_tiles/2x3"), progress=False)
    mdp = space.mdp(gamma=0.9)
    found = hardness.diameter(mdp)
    assert found.exact
    assert found.upper == distances(mdp).max()


@pytest.mark.long
def test_a_puzzle_of_nearly_equal_eccentricities_takes_searches_from_a_quarter_of_its_states():
    """The solved position leads to the start alone, so the largest distance is one more than that from the start; all
    others are known to be no larger from those whose blank is in the middle."""
    space = pharos.build(pharos.make("sliding_tiles/2x4"), progress=False)
    found = hardness.diameter(space.mdp(gamma=0.9), budget=hardness.Budget(searches=space.num_states // 4))
    assert found.exact
    assert found.upper == 1 + space.depth
    assert solution_lengths(space).max() == 36 < found.upper
