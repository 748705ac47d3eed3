"""Images with motion tell the state: it is read back from them, on named instances too large to look at every state.

Breakout, Freeway and 2048: any state that their variables can say. MiniGrid: states that a long random walk meets.
"""

import numpy as np
import pytest

import pharos
from pharos.environments import mini_grid
from pharos.observations import observe

NAMES = [name for name in pharos.list_environments() if name.startswith(("breakout/", "freeway/", "game_2048/"))]
CORRIDOR = "mini_grid/key-corridor-s6r3"


def values_of(env, states):
    """(N, L, rows, columns) what `draw` and `draw_motion` wrote, from the pixels of images with motion."""
    made = observe(env, "simple_image", motion=True)
    made._drawing._compiled = made._drawing._interpret  # compiled kernels would take seconds to make
    images = made(states)
    size = images.shape[2] // env.grid()[0]
    pixels = images[:, :, ::size, ::size]
    assert (pixels.repeat(size, axis=2).repeat(size, axis=3) == images).all()
    values = np.zeros(pixels.shape, np.int64)
    for layer, shades in enumerate(made.shades):
        known = np.flatnonzero(np.diff(shades.astype(int), prepend=-1) != 0)  # values beyond the last look like it
        assert len(np.unique(shades[known])) == len(known)
        values[:, layer] = known[(pixels[:, layer, :, :, None] == shades[known]).argmax(axis=-1)]
    return values


def any_states(env, count, rng):
    return env.components.low + rng.integers(0, env.components.size, (count, len(env.components)))


def breakout(env, planes):
    bricks, paddle, ball, trail = planes
    (row, column), (before_row, before_column) = (np.argwhere(plane)[0] for plane in (ball, trail))
    down = before_row < row or before_row == row == 0  # a trail in a wall lies beside it
    right = before_column < column or before_column == column == 0
    first = np.flatnonzero(paddle[-1])[0]
    return (row, column, right, down, first, *bricks[1 : 1 + env.brick_rows].ravel())


def freeway(env, planes):
    _, cars, player, timers, clock = planes
    row, column = np.argwhere(player)[0]
    lanes = range(1, env.num_cars + 1)
    places = [int(np.flatnonzero(cars[lane])[0]) for lane in lanes]
    return (row, clock[row, column] - 1, *places, *(timers[i, at] - 1 for i, at in zip(lanes, places, strict=True)))


def game_2048(env, planes):
    return tuple(planes[0].ravel())


DECODERS = {"breakout": breakout, "freeway": freeway, "game_2048": game_2048}


@pytest.mark.parametrize("name", NAMES)
def test_any_state_is_read_back_from_its_image(name):
    env = pharos.make(name)
    states = any_states(env, 60, np.random.default_rng(0))
    for state, planes in zip(states, values_of(env, states), strict=True):
        assert tuple(map(int, DECODERS[env.name](env, planes))) == tuple(state.tolist())


def test_where_the_ball_is_at_a_wall_its_trail_still_tells_where_it_goes():
    env = pharos.make("breakout/12x8x1")
    states = np.array([(*place, right, down, 0, *[1] * 16) for place in [(0, 0), (0, 7), (11, 0), (11, 7), (5, 0)]
                       for right in (0, 1) for down in (0, 1)])  # fmt: skip
    decoded = [tuple(map(int, breakout(env, planes))) for planes in values_of(env, states)]
    assert decoded == [tuple(state) for state in states.tolist()]


def test_states_of_the_key_corridor_are_read_back():
    """The key and the ball are of one kind each; what lies in the player's cell is carried."""
    env = pharos.make(CORRIDOR)
    rng, state, states = np.random.default_rng(0), tuple(env.initial_state()), []
    carried = mini_grid.CARRIED
    for _ in range(4000):
        states.append(state)
        state = env.next_state(state, int(rng.integers(env.num_actions)))
        if env.is_terminal(state):
            states.append(state)
            state = tuple(env.initial_state())
    # the same with any door open or shut, and things anywhere on the floor
    doors = slice(mini_grid.DOORS, mini_grid.DOORS + env.num_doors)
    free = np.argwhere(env.cells == mini_grid.FREE)
    for i in range(400):
        changed = list(states[i * 10])
        changed[doors] = rng.integers(0, env.components.size[doors]).tolist()
        places = free[rng.permutation(len(free))[: len(env.things)]]
        if any(tuple(place) == tuple(changed[:2]) for place in places):
            continue
        changed[doors.stop :] = places.ravel().tolist()
        if i % 3 == 0:
            changed[doors.stop : doors.stop + 2] = [0, carried]
        states.append(tuple(changed))
    states = np.unique(np.array(states), axis=0)
    at_doors = [tuple(np.argwhere(env.cells == mini_grid.DOOR + door)[0]) for door in range(env.num_doors)]
    seen_as = 1 + 3 * env.things[:, 3] + env.things[:, 2]
    assert len(np.unique(seen_as)) == len(seen_as)
    for state, planes in zip(states, values_of(env, states), strict=True):
        player = tuple(np.argwhere(planes[5])[0])
        decoded = [*player, planes[5][player] - 1, *((planes[3][door] - 1) % 3 for door in at_doors)]
        for value in seen_as:
            place = np.argwhere(planes[4] == value)
            here = [tuple(each) for each in place]
            decoded += [0, carried] if here == [player] else [*here[0]]
        assert tuple(map(int, decoded)) == tuple(state.tolist())
