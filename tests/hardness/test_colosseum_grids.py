"""`mini_grid_empty` and `mini_grid_rooms`: Colosseum's published diameters, and its layouts of a seed.

Colosseum iterates in single precision and stops when no entry changes by 0.001 (by 0.01 in episodes, once a target adds
less than a step to those before it), so what it prints lies below the exact number. Twins that stop as it does give
what it prints; pharos gives the exact number, to which the twins converge.
"""

import numpy as np
import pytest
from scipy import sparse

import pharos
from naive.colosseum import STOPS, diameter, episodic_diameter, farthest, law, within_ulps
from pharos import TabularMDP, hardness
from pharos.drawing import text_drawing
from pharos.errors import ParameterError
from pharos.hardness.diameter import colosseum_diameter

pytestmark = pytest.mark.long  # with each class compiled and walked through in full

# size, p_lazy, p_rand, n_starting_states -> printed, all with seed 0
EPISODIC = {
    (6, 0.1, 0.05, 3): 16.600589752197266,
    (6, 0.35, 0.0, 5): 52.685142517089844,
    (6, 0.0, 0.0, 3): 11.666666984558105,
    (8, 0.02, 0.4, 3): 83.5987777709961,
    (8, 0.0, 0.3, 3): 46.404510498046875,
    (10, 0.1, 0.0, 5): 23.599802017211914,
    (10, 0.0, 0.3, 3): 64.3434066772461,
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
}


# n_rooms, room_size, p_lazy, p_rand, seed -> printed, all with two start states
ROOMS_EPISODIC = {
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
ROOMS_CONTINUOUS = {
    (9, 3, 0.5, 0.0, 0): 51.9982,
    (9, 5, 0.3, 0.0, 0): 54.284725,
    (9, 5, 0.4, 0.3, 0): 98.76637,
    (9, 5, 0.5, 0.0, 0): 75.997345,
    (16, 3, 0.4, 0.1, 0): 64.1765,
}


def some(published, quick):
    return [pytest.param(row, id=str(row), marks=() if row[0] <= quick else pytest.mark.slow) for row in published]


def made(row):
    size, p_lazy, p_rand, n = row
    return pharos.make("mini_grid_empty", size=size, p_lazy=p_lazy, p_rand=p_rand, n_starting_states=n)


def made_of_rooms(row):
    n_rooms, room_size, p_lazy, p_rand, seed = row
    options = {"p_lazy": p_lazy, "p_rand": p_rand, "n_starting_states": 2, "seed": seed}
    return pharos.make("mini_grid_rooms", n_rooms=n_rooms, room_size=room_size, **options)


def mdp_of(P, rho, **kwargs):
    return TabularMDP.from_matrices(P, np.zeros((P.shape[1], P.shape[0] // P.shape[1])), initial=rho, **kwargs)


@pytest.mark.parametrize("row", some(EPISODIC, 6))
def test_the_episodic_diameter_is_that_of_colosseum(row):
    assert_episodic_diameter(made(row), EPISODIC[row])


@pytest.mark.parametrize("row", some(ROOMS_EPISODIC, 4))
def test_the_episodic_diameter_of_rooms_is_that_of_colosseum(row):
    assert_episodic_diameter(made_of_rooms(row), ROOMS_EPISODIC[row])


def assert_episodic_diameter(env, printed):
    _, P, rho = law(env)
    horizon = env.max_episode_steps
    exact = colosseum_diameter(mdp_of(P, rho), horizon=horizon)
    targets = farthest(P, rho)
    assert any(within_ulps(episodic_diameter(P, rho, horizon, targets, stop, np.float32), printed) for stop in STOPS)
    assert episodic_diameter(P, rho, horizon, targets, 1e-10, np.float64) == pytest.approx(exact, rel=1e-9)
    assert printed <= exact * (1 + 1e-7)


@pytest.mark.parametrize("row", some(CONTINUOUS, 8))
def test_the_diameter_without_episodes_is_that_of_colosseum(row):
    """Sweeps towards all targets that look up in the left half: the others are their mirror images and turns."""
    states, P, rho = law(made(row))
    targets = np.array([i for i, (_, column, way) in enumerate(states) if way == 0 and column < (row[0] + 1) // 2])
    found = hardness.diameter(mdp_of(P, rho, gamma=1.0))
    printed = CONTINUOUS[row]
    assert within_ulps(diameter(P, targets), printed)
    assert found.exact and found.lower * (1 + 1e-7) >= printed


@pytest.mark.parametrize("row", some(ROOMS_CONTINUOUS, 4))
def test_the_diameter_of_rooms_without_episodes_is_that_of_colosseum(row):
    states, P, rho = law(made_of_rooms(row))
    targets = np.array([i for i, (_, _, way) in enumerate(states) if way == 0])
    found = hardness.diameter(mdp_of(P, rho, gamma=1.0))
    printed = ROOMS_CONTINUOUS[row]
    assert within_ulps(diameter(P, targets), printed)
    assert found.exact and found.lower * (1 + 1e-7) >= printed


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


@pytest.mark.parametrize(
    ("name", "parameters", "words"),
    [
        ("mini_grid_empty", {"size": 2}, "size=2"),
        ("mini_grid_empty", {"p_lazy": 1.0}, "p_lazy=1.0; expected a finite number from 0 to 0.9999"),
        ("mini_grid_rooms", {"n_rooms": 5}, "n_rooms=5; expected a square number"),
        ("mini_grid_rooms", {"room_size": 2, "n_starting_states": 17}, "from 1 to 16"),
    ],
)
def test_a_wrong_parameter_is_named(name, parameters, words):
    with pytest.raises(ParameterError) as error:
        pharos.make(name, **parameters)
    assert words in str(error.value)
