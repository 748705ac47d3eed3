"""`river_swim`, `endless_sea`, `corner_grid`: the published diameters of Colosseum's RiverSwim, DeepSea and SimpleGrid.

As in test_colosseum_grids.py: twins that round and stop as Colosseum does give what it prints, pharos gives the
exact number. Printed are the hardness reports that Colosseum's repository caches, seed 0.
"""

import itertools

import numpy as np
import pytest
from test_colosseum_grids import assert_episodic_diameter, mdp_of

import pharos
from naive.colosseum import diameter, diameter_in_place, law, order_of_discovery, within_ulps
from pharos import hardness

pytestmark = pytest.mark.long  # with each class compiled

# family, size, p_lazy, p_rand, start states -> printed
EPISODIC = {
    ("DeepSea", 5, 0.0, 0.0, 1): 5.0,
    ("DeepSea", 13, 0.0, 0.3, 1): 91.3880615234375,
    ("DeepSea", 25, 0.0, 0.0, 1): 25.0,
    ("RiverSwim", 10, 0.1715, 0.0, 1): 54.36714172363281,
    ("RiverSwim", 10, 0.3429, 0.0, 1): 437.802001953125,
    ("RiverSwim", 10, 0.4286, 0.0, 1): 1539.9072265625,
    ("RiverSwim", 10, 0.6, 0.0, 1): 38139.28125,
    ("RiverSwim", 10, 0.0, 0.0001, 1): 10.004501342773438,
    ("RiverSwim", 10, 0.0, 0.0858, 1): 14.838109016418457,
    ("RiverSwim", 10, 0.0, 0.5143, 1): 145.160888671875,
    ("RiverSwim", 40, 0.0, 0.0, 1): 40.0,
    ("RiverSwim", 11, 0.0, 0.0, 1): 11.0,
    ("RiverSwim", 17, 0.0, 0.0, 1): 17.0,
    ("SimpleGrid", 10, 0.2, 0.01, 1): 14.064387321472168,
    ("SimpleGrid", 10, 0.5, 0.0, 1): 73.42761993408203,
    ("SimpleGrid", 16, 0.01, 0.2, 1): 21.869474411010742,
    ("SimpleGrid", 16, 0.2, 0.2, 1): 34.03904724121094,
    ("SimpleGrid", 20, 0.4, 0.0, 1): 47.3147087097168,
}
CONTINUOUS = {
    ("DeepSea", 20, 0.0, 0.1, 1): 70.96274,
    ("DeepSea", 35, 0.0, 0.0, 1): 68.0,
    ("RiverSwim", 10, 0.0, 0.17, 1): 10.719861,
    ("RiverSwim", 10, 0.0, 0.26, 1): 11.924114,
    ("RiverSwim", 10, 0.0, 0.34, 1): 13.245402,
    ("RiverSwim", 10, 0.0, 0.51, 1): 17.303562,
    ("RiverSwim", 10, 0.0, 0.6, 1): 20.622755,
    ("RiverSwim", 25, 0.1, 0.0, 1): 26.666565,
    ("RiverSwim", 30, 0.1, 0.2, 1): 40.103657,
    ("RiverSwim", 80, 0.1, 0.01, 1): 88.658714,
    ("SimpleGrid", 5, 0.0, 0.34, 3): 11.644321,
    ("SimpleGrid", 5, 0.0, 0.43, 3): 13.298826,
    ("SimpleGrid", 5, 0.0, 0.6, 3): 18.318144,
    ("SimpleGrid", 5, 0.0, 0.0, 3): 8.0,
    ("SimpleGrid", 8, 0.0, 0.09, 3): 15.248339,
    ("SimpleGrid", 8, 0.0, 0.17, 3): 16.58723,
    ("SimpleGrid", 8, 0.0, 0.26, 3): 18.437819,
    ("SimpleGrid", 8, 0.0, 0.43, 3): 23.477747,
    ("SimpleGrid", 8, 0.0, 0.51, 3): 27.021412,
    ("SimpleGrid", 8, 0.0, 0.6, 3): 32.66654,
    ("SimpleGrid", 10, 0.2, 0.01, 1): 22.704338,
    ("SimpleGrid", 15, 0.2, 0.0, 1): 34.999672,
    ("SimpleGrid", 25, 0.3, 0.0, 1): 68.57021,
}


def made(family, size, p_lazy, p_rand, n):
    if family == "DeepSea":
        return pharos.make("endless_sea", size=size, p_rand=p_rand)
    if family == "RiverSwim":
        return pharos.make("river_swim/colosseum", length=size, p_lazy=p_lazy, p_rand=p_rand)
    return pharos.make("corner_grid", size=size, p_lazy=p_lazy, p_rand=p_rand, n_starting_states=n)


@pytest.mark.parametrize("row", EPISODIC, ids=str)
def test_episodic_diameters_are_those_of_colosseum(row):
    assert_episodic_diameter(made(*row), EPISODIC[row], stop=1e-8)


@pytest.mark.parametrize("row", CONTINUOUS, ids=str)
def test_diameters_without_episodes_are_those_of_colosseum(row):
    """Up to 270,000 numbers in its tables, Colosseum changes values in place, in the order in which it found the
    states; that depends on the order of the start states, which it shuffles.
    """
    family, size, p_lazy, p_rand, n = row
    env, printed = made(*row), CONTINUOUS[row]
    states, P, rho = law(env)
    exact = hardness.diameter(mdp_of(P, rho, gamma=1.0))
    assert exact.exact and exact.lower * (1 + 1e-7) >= printed
    if len(states) ** 2 * env.num_actions > 270_000:
        assert within_ulps(diameter(P, np.arange(len(states))), printed)
        return
    found = []
    for starts in itertools.permutations([state for state, _ in env.initial_states()]):
        order = order_of_discovery(made(family, size, 0.0, 0.0, n), starts, p_lazy > 0, p_rand > 0)
        found.append(diameter_in_place(P, np.array([states.index(state) for state in order])))
    assert any(within_ulps(number, printed) for number in found)
