"""`mini_grid_empty` and `mini_grid_rooms`: Colosseum's published diameters, and its layouts of a seed.

Colosseum iterates in single precision and stops when no entry changes by 0.001 (by 0.01 in episodes, once a target adds
less than a step to those before it), so what it prints lies below the exact number. Twins that stop as it does give
what it prints; pharos gives the exact number, to which the twins converge.
"""

import math

import numpy as np
import pytest
from scipy import sparse

import pharos
from naive.colosseum import STOPS, diameter, episodic_diameter, farthest, law, within_ulps
from pharos import TabularMDP, hardness
from pharos.drawing import text_drawing
from pharos.hardness.diameter import colosseum_diameter

pytestmark = pytest.mark.long  # with each class compiled and walked through in full

# size, p_lazy, p_rand, n_starting_states -> printed, all with seed 0;
# n_rooms, room_size, p_lazy, p_rand, seed -> printed, all with two start states
EPISODIC = {
    (6, 0.1, 0.05, 3): 16.600589752197266,
    (6, 0.35, 0.0, 5): 52.685142517089844,
    (6, 0.0, 0.0, 3): 11.666666984558105,
    (8, 0.02, 0.4, 3): 83.5987777709961,
    (8, 0.0, 0.3, 3): 46.404510498046875,
    (10, 0.1, 0.0, 5): 23.599802017211914,
    (10, 0.0, 0.3, 3): 64.3434066772461,
    (4, 3, 0.0, 0.001, 0): 16.025672912597656,
    (4, 3, 0.15, 0.0, 0): 25.142902374267578,
    (4, 3, 0.15, 0.0, 2): 70.6382827758789,
    (4, 4, 0.0, 0.0, 0): 20.5,
    (4, 4, 0.01, 0.1, 2): 49.68860626220703,
    (9, 3, 0.01, 0.1, 0): 46.987674713134766,
    (9, 3, 0.05, 0.0, 2): 47.17371368408203,
    (9, 3, 0.1, 0.0, 0): 35.200687408447266,
    (9, 3, 0.1, 0.0, 2): 93.2818832397461,
}
CONTINUOUS = {
    (8, 0.7, 0.0, 3): 59.996017,
    (10, 0.02, 0.7, 3): 79.23573,
    (10, 0.1, 0.21, 3): 31.011705,
    (12, 0.05, 0.495, 3): 55.483757,
    (12, 0.1, 0.395, 3): 48.555496,
    (12, 0.3, 0.0, 3): 37.141914,
    (12, 0.7, 0.0, 3): 86.66201,
    (14, 0.1, 0.6, 3): 86.7276,
    (9, 3, 0.5, 0.0, 0): 51.9982,
    (9, 5, 0.3, 0.0, 0): 54.284725,
    (9, 5, 0.4, 0.3, 0): 98.76637,
    (9, 5, 0.5, 0.0, 0): 75.997345,
    (16, 3, 0.4, 0.1, 0): 64.1765,
}


def made(row):
    *sizes, p_lazy, p_rand, last = row
    chance = {"p_lazy": p_lazy, "p_rand": p_rand}
    if len(sizes) == 1:
        return pharos.make("mini_grid_empty", size=sizes[0], n_starting_states=last, **chance)
    n_rooms, room_size = sizes
    return pharos.make(
        "mini_grid_rooms", n_rooms=n_rooms, room_size=room_size, n_starting_states=2, seed=last, **chance
    )


def mdp_of(P, rho, **kwargs):
    return TabularMDP.from_matrices(P, np.zeros((P.shape[1], P.shape[0] // P.shape[1])), initial=rho, **kwargs)


@pytest.mark.parametrize("row", EPISODIC, ids=str)
def test_the_episodic_diameter_is_that_of_colosseum(row):
    assert_episodic_diameter(made(row), EPISODIC[row])


def assert_episodic_diameter(env, printed, stop=1e-10):
    _, P, rho = law(env)
    horizon, targets = env.max_episode_steps, farthest(P, rho)
    exact = colosseum_diameter(mdp_of(P, rho), horizon=horizon)
    assert any(within_ulps(episodic_diameter(P, rho, horizon, targets, each, np.float32), printed) for each in STOPS)
    assert episodic_diameter(P, rho, horizon, targets, stop, np.float64) == pytest.approx(exact, rel=10 * stop)
    assert printed <= exact * (1 + 1e-7)


@pytest.mark.parametrize("row", CONTINUOUS, ids=str)
def test_the_diameter_without_episodes_is_that_of_colosseum(row):
    """Sweeps towards all targets that look up, without rooms those in the left half: the others are their mirror images
    and turns."""
    states, P, rho = law(made(row))
    half = (row[0] + 1) // 2 if len(row) == 4 else math.inf
    targets = np.array([i for i, (_, column, way) in enumerate(states) if way == 0 and column < half])
    found = hardness.diameter(mdp_of(P, rho, gamma=1.0))
    assert within_ulps(diameter(P, targets), CONTINUOUS[row])
    assert found.exact and found.lower * (1 + 1e-7) >= CONTINUOUS[row]


@pytest.mark.slow
def test_a_built_state_space_has_the_same_diameters():
    env = made((6, 0.1, 0.05, 3))
    _, P, rho = law(env)
    mdp, other = pharos.build(env, progress=False).mdp(gamma=1.0), mdp_of(P, rho, gamma=1.0)
    horizon = env.max_episode_steps
    assert colosseum_diameter(mdp, horizon=horizon) == pytest.approx(colosseum_diameter(other, horizon=horizon))
    assert hardness.diameter(mdp).upper == pytest.approx(hardness.diameter(other).upper)


def test_p_rand_is_random_actions():
    """So a state space without it serves every `p_rand`."""
    plain, chance = (law(made((4, 0.25, p_rand, 2))) for p_rand in (0.0, 0.3))
    assert plain[0] == chance[0]
    rewards = np.array([[made((4, 0, 0, 2)).reward(s, 0, s)] * 3 for s in plain[0]])
    wrapped = pharos.random_actions(TabularMDP.from_matrices(plain[1], rewards, initial=plain[2], gamma=0.9), 0.3)
    native = TabularMDP.from_matrices(chance[1], rewards, initial=chance[2], gamma=0.9)
    one, other = pharos.value_iteration(wrapped), pharos.value_iteration(native)
    assert (abs(one.v - other.v) <= one.error_bound + other.error_bound).all()


# Layouts as Colosseum draws them ------------------------------------------------------------------------------------


def test_rooms_have_one_opening_in_the_middle_of_each_wall():
    env = pharos.make("mini_grid_rooms", n_rooms=9, room_size=4)
    assert text_drawing(env, env.initial_state()).replace("v", ".") == ROOMS


ROOMS = """\
.G..#....#....
..............
....#....#....
....#....#....
##.####.####.#
....#....#....
..............
....#....#....
....#....#....
##.####.####.#
....#....#....
..............
....#....#....
....#....#...."""


@pytest.mark.parametrize("seed", range(6))
def test_goal_and_starts_lie_on_opposite_sides_or_in_different_corner_rooms(seed):
    env = pharos.make("mini_grid_empty", size=7, n_starting_states=4, seed=seed)
    cells = {state[:2] for state, _ in env.initial_states()}
    assert len(cells) == 4
    sides = [(axis, end) for axis in (0, 1) for end in (0, 6) if all(cell[axis] == end for cell in cells)]
    assert any(env.goal[axis] == 6 - end for axis, end in sides)
    rooms = pharos.make("mini_grid_rooms", n_rooms=9, room_size=3, n_starting_states=5, seed=seed)
    corners = {(row // 4, column // 4) for (row, column, _), _ in rooms.initial_states()}
    goal = (rooms.goal[0] // 4, rooms.goal[1] // 4)
    assert len(corners) == 1 and goal not in corners
    assert {*corners, goal} <= {(0, 0), (0, 2), (2, 0), (2, 2)}


@pytest.mark.parametrize("name", ["mini_grid_empty", "mini_grid_rooms"])
def test_the_limit_is_the_farthest_state_from_the_side_or_room_of_the_start_and_one_more(name):
    env = pharos.make(name)
    states, P, _ = law(env)
    numbers = {state: i for i, state in enumerate(states)}
    top = len(env.is_free) - 1
    possible = {numbers[top - y, x, direction] for x, y, direction in env.drawn.possible_starts}
    distances = sparse.csgraph.dijkstra(
        sum(P[action :: env.num_actions] for action in range(env.num_actions)), unweighted=True, indices=list(possible)
    )
    assert env.max_episode_steps == distances.max() + 1
