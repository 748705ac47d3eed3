"""Distances by several processes: those of one search, whatever the number."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pharos
from pharos.errors import ParameterError
from pharos.hardness import start_eccentricity
from pharos.hardness.distances import ranked_search
from pharos.hardness.distances.ranked_search import FAR, ranked_distances
from pharos.hardness.distances.transition_graph import Graph
from pharos.mdp import TabularMDP, sticky_actions
from rank_threads import out_of_order, threads
from strategies import deterministic_mdps


def ring(num_states=60):
    """Steps around a ring, and a jump ahead."""
    states = np.arange(num_states)
    following = np.stack([(states + 1) % num_states, np.where(states % 9 == 0, (states + 25) % num_states, states)], 1)
    return TabularMDP.from_arrays(following, np.zeros((num_states, 2)))


def searched(graph, source, backward):
    """By the search of one process."""
    distance = np.empty(graph.num_nodes, np.int32)
    search = graph.search_backward if backward else graph.search_forward
    count, largest, _ = search(source, distance)
    return np.where(distance < 0, FAR, distance), count, largest


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(
    mdp=st.one_of(deterministic_mdps(max_states=9), st.just(ring())),
    size=st.integers(1, 5),
    restart=st.booleans(),
    backward=st.booleans(),
    seed=st.integers(0, 2**32),
    data=st.data(),
)
def test_distances_do_not_depend_on_ranks(mdp, size, restart, backward, seed, data):
    graph = Graph.of(mdp, restart)
    if graph is None:
        return
    source = data.draw(st.integers(0, graph.num_nodes - 1))
    expected, count, largest = searched(graph, source, backward)
    with threads(ranked_search, out_of_order(seed)):
        found = ranked_distances(graph, source, size, backward=backward)
    assert (found.distances == expected).all()
    assert (found.reached, found.largest) == (count, largest)


@pytest.mark.long
def test_processes_find_the_eccentricity(tmp_path):
    mdp = pharos.build(pharos.make("breakout", height=7, columns=5, brick_rows=1), tmp_path, progress=False).mdp()
    for restart in (True, False):
        assert start_eccentricity(mdp, restart=restart, processes=3) == start_eccentricity(mdp, restart=restart)


def test_what_several_processes_do_not_search_is_said():
    mdp = ring()
    with pytest.raises(ParameterError, match="has chance, under which one process searches; expected processes=1"):
        start_eccentricity(sticky_actions(mdp, 0.5), processes=2)
    with pytest.raises(ParameterError, match="has 2 start states; expected processes=1"):
        start_eccentricity(mdp.with_initial([0, 3]), restart=False, processes=2)
    with pytest.raises(ParameterError, match="expected a whole number from 1 to 1024"):
        start_eccentricity(mdp, processes=-2)
