"""Diameters by symmetry: one search for each orbit of states that renaming takes into each other."""

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive.hardness import distances
from pharos import TabularMDP, hardness
from pharos.hardness.sum_sweep import orbits
from pharos.kernels import graph
from strategies import examples
from without_end import without_end

pytestmark = pytest.mark.long  # with each class compiled


@st.composite
def covers(draw):
    """(table, sheets): random steps between a few places, each of which also turns a wheel; turning it further is a
    symmetry. Where `broken`, one entry is another."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    places, sheets, num_actions = draw(st.integers(1, 6)), draw(st.integers(1, 20)), draw(st.integers(1, 3))
    to, turn = (rng.integers(0, n, (places, num_actions)) for n in (places, sheets))
    wheel = np.arange(sheets)[:, None, None]
    table = (to * sheets + (turn + wheel) % sheets).swapaxes(0, 1).reshape(-1, num_actions)
    names = rng.permutation(len(table))
    renamed = np.empty_like(table)
    renamed[names] = names[table]
    if draw(st.booleans()):
        renamed[rng.integers(len(table)), rng.integers(num_actions)] = rng.integers(-1, len(table))
    return renamed


@examples(100, covers(), st.booleans())
def test_the_diameter_is_the_largest_distance_with_symmetries_and_with_broken_ones(table, restart):
    mdp = TabularMDP.from_arrays(table, np.zeros(table.shape))
    assert hardness.diameter(mdp, restart=restart).upper == distances(mdp, restart=restart).max()


@examples(100, covers(), st.integers(0, 2**32 - 1))
def test_a_map_is_found_exactly_where_there_is_one_and_keeps_every_step(table, seed):
    size = len(table)
    s, t = np.random.default_rng(seed).integers(0, size, 2)
    image, preimage = np.zeros(size, np.int64), np.zeros(size, np.int64)
    ends = (table == -1).all(axis=1)
    queue = np.empty(size, np.int64)
    found, steps = graph.symmetry(table, ends, -1, s, t, image, preimage, queue)
    naive, waiting = {s: t}, [s]  # follow the same words of actions from both
    agree = True
    while waiting:
        u = waiting.pop()
        for v, y in zip(table[u], table[naive[u]], strict=True):
            agree &= (v < 0) == (y < 0) and (v < 0 or naive.get(v, y) == y)
            if v >= 0 and v not in naive:
                naive[v] = y
                waiting.append(v)
    agree &= len(naive) == size and len(set(naive.values())) == size
    assert found == agree
    if found:
        images = image - 1
        assert images.tolist() == [naive[u] for u in range(size)]
        np.testing.assert_array_equal(np.where(table < 0, -1, images[table]), table[images])
    graph.forget(image, preimage, queue, steps)
    assert (image == 0).all() and (preimage == 0).all()


@pytest.mark.parametrize("bits", [7, 10])
def test_a_cube_of_many_dimensions_takes_one_orbit(bits):
    corners = np.arange(2**bits)
    table = corners[:, None] ^ (1 << np.arange(bits))
    found = hardness.diameter(TabularMDP.from_arrays(table, np.zeros(table.shape)))
    assert (found.lower, found.upper, found.exact) == (bits, bits, True)
    assert found.method == "searches from one state of each of 1 orbits of symmetries"


def test_the_8_puzzle_without_an_end_has_the_published_diameter_of_31():
    """Its orbits are the nine cells of the blank: the tiles may be renamed."""
    found = hardness.diameter(without_end(pharos.build(pharos.make("sliding_tiles/3x3"), progress=False)))
    assert (found.lower, found.upper, found.exact) == (31, 31, True)
    assert "9 orbits" in found.method and found.searches < 20


def test_a_puzzle_with_an_end_has_no_symmetries():
    space = pharos.build(pharos.make("sliding_tiles/2x3"), progress=False)
    assert "orbits" not in hardness.diameter(space.mdp(gamma=0.9)).method


def test_where_no_map_is_found_no_orbits_are_numbered():
    table = np.minimum(np.arange(1000)[:, None] + 1, 999)
    assert orbits(table, np.zeros(1000, np.bool_), -1, 0, lambda: False) is None
