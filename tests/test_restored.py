"""Diameters of graphs that look the same from many states but for the one where the episode ends."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pharos
from naive_hardness import distances
from pharos import TabularMDP, hardness
from pharos.hardness.distances.restored import largest_distances, restored
from test_symmetry import covers

pytestmark = pytest.mark.long  # with each class compiled


def with_end(table, end, start):
    """The MDP in which `end` is terminal."""
    table = np.array(table)
    table[end] = end
    terminal = np.arange(len(table)) == end
    return TabularMDP.from_arrays(table, np.zeros(table.shape), initial=start, terminal=terminal)


@given(covers(), st.integers(0, 2**32 - 1))
@settings(max_examples=200, deadline=None)
def test_the_diameter_is_the_largest_distance_where_one_state_ends_the_episode(table, seed):
    end, start = np.random.default_rng(seed).integers(0, len(table), 2)
    if (table < 0).any():
        return
    mdp = with_end(table, end, start)
    assert hardness.diameter(mdp).upper == distances(mdp, restart=True).max()


@pytest.mark.parametrize("bits", [3, 6, 9])
def test_a_cube_of_many_dimensions_with_an_end_takes_a_detour(bits):
    corners = np.arange(2**bits)
    mdp = with_end(corners[:, None] ^ (1 << np.arange(bits)), 0, 2**bits - 1)
    found = hardness.diameter(mdp)
    assert found.exact and found.upper == distances(mdp, restart=True).max()
    assert found.searches < 10 and "the end alone" in found.method


def without(table, source, x):
    """The distances from a node where another one is not passed."""
    table = np.array(table)
    distance, level, steps = {source: 0}, [source], 0
    while level:
        steps += 1
        level = sorted({int(v) for u in level for v in table[u]} - distance.keys() - {x})
        distance.update(dict.fromkeys(level, steps))
    return distance


@given(st.integers(2, 12), st.integers(1, 3), st.integers(0, 2**32 - 1))
@settings(max_examples=100, deadline=None)
def test_detours_are_the_distances_without_a_node(size, turns, seed):
    """On Cayley graphs of a cyclic group: all look alike, and one of them ends the episode."""
    rng = np.random.default_rng(seed)
    table = (np.arange(size)[:, None] + np.append(1, rng.integers(1, size, turns))) % size
    mdp = with_end(table, int(rng.integers(size)), 0)
    space = restored(np.asarray(mdp.next_states), mdp.terminal, int(rng.integers(size)), lambda: False)
    if space is None:
        return
    assert (space.table == table).all() and (space.orbit == 0).all()
    ways = [without(table, 0, x) for x in range(1, size)]
    expected = max((max(way.values()) if len(way) == size - 1 else np.inf) for way in ways)
    whole = max(without(table, 0, -1).values())
    found = largest_distances(space, np.array([0]))
    assert found == (None if np.isinf(expected) else [max(expected, whole)])


@pytest.mark.parametrize(
    ("name", "diameter"),  # one more than the published numbers of moves, as the end leads to the start
    [("sliding_tiles/2x3", 22), ("sliding_tiles/3x3", 32), ("pocket_cube/half", 12), ("pocket_cube/quarter", 15)],
)
def test_puzzles_with_an_end_need_few_searches(name, diameter):
    found = hardness.diameter(pharos.build(pharos.make(name), progress=False).mdp(gamma=0.9))
    assert (found.lower, found.upper, found.exact) == (diameter, diameter, True)
    assert found.searches < 20
