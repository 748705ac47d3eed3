"""Images with motion tell the state: it is read back from them, on named instances too large to look at every state.

Simple images of Breakout, Freeway and 2048: any state that their variables can say; of MiniGrid: states that a long
random walk meets. A complex image tells what lies in each cell, as far as a cell can hold it: so it tells what a simple
image tells.
"""

from itertools import product

import numpy as np
import pytest

import pharos
from pharos.drawing import planes_of
from pharos.environments.mini_grid import mini_grid
from pharos.environments.worlds.freeway import NUM_COLORS
from pharos.observations import observe
from pharos.observations.images import num_values
from worlds import random_states

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
    states = random_states(env, 60)
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


# Complex images: cell by cell -----------------------------------------------------------------------------------------


def any_values(env, layers, _row, _column):
    """Whatever the layers can show, in any combination."""
    return list(product(*(range(1 + num_values(layer)) for layer in layers)))


def in_a_lane(env, layers, row, _column):
    """A car of its lane's colour or the player, each with its timer; never both: a hit sends the player back."""
    assert env.restart_on_hit
    timers = [1 + num_values(layer) for layer in layers][3:]
    fixed = row in (0, env.num_cars + 1)
    color = (row - 1) % NUM_COLORS
    colors = () if fixed else (1 + color, 1 + color + NUM_COLORS)
    cars = [(0, car, 0, timer, 0) for car in colors for timer in range(1, timers[0])]
    players = [(0, 0, 1, 0, timer) for timer in range(1, timers[1])]
    return [(int(fixed), *each[1:]) for each in [(0,) * 5, *cars, *players]]


def on_a_floor(env, layers, row, column):
    """Of Sokoban: a box or the player, on a target or not; nothing moves on a wall."""
    walls, targets = (plane[row, column] for plane in still(env)[:2])
    if walls:
        return [(walls, targets, 0, 0)]
    return [(0, targets, *moving) for moving in ((0, 0), (1 + targets, 0), (0, 1))]


def in_a_room(env, layers, row, column):
    """Of MiniGrid: a door open, shut or locked; a thing; the player, and what he carries."""
    goal, lava, walls, door, *_ = (int(plane[row, column]) for plane in still(env))
    if walls:
        return [(goal, lava, walls, 0, 0, 0)]
    doors = [0] if not door else [1 + 3 * ((door - 1) // 3) + state for state in range(3)]
    things = [0, *(1 + 3 * env.things[:, 3] + env.things[:, 2]).tolist()] if len(env.things) else [0]
    return [(goal, lava, 0, *moving) for moving in product(doors, things, range(5))]


def still(env):
    """What lies there at the start."""
    return planes_of(env, env.initial_states()[0][0])


HELD = {
    "breakout": any_values,
    "sliding_tiles": any_values,
    "pocket_cube": any_values,
    "game_2048": any_values,
    "freeway": in_a_lane,
    "sokoban": on_a_floor,
    "mini_grid": in_a_room,
}
"""Class -> what a cell can hold: a list of a value for each layer."""
LARGE = [name for name in pharos.list_environments() if "/" in name and name.split("/")[0] in HELD]


def blocks(made, row, column, held):
    """(N, pixels) of a cell, for each combination (N, L) of what it holds."""
    picture, top, left, sprite, place, color, keep = made._tables
    ground = picture[top[row] : top[row + 1], left[column] : left[column + 1]]
    height, width = ground.shape[:2]
    out = np.broadcast_to(ground.astype(np.int64), (len(held), *ground.shape)).copy()
    for layer, value in sorted({(i, int(v)) for i in range(held.shape[1]) for v in held[:, i] if v}):
        number = sprite[layer, row, value]
        if number >= 0:
            at, pixels = held[:, layer] == value, slice(first := place[number, height, width], first + height * width)
            out[at] = color[pixels].reshape(height, width, -1) + (
                out[at] * keep[pixels].reshape(height, width, 1).astype(np.int64) >> 8
            )
    return out.reshape(len(held), -1)


@pytest.mark.parametrize(
    "name", [name if name == "breakout/12x8x1" else pytest.param(name, marks=pytest.mark.long) for name in LARGE]
)
def test_complex_images_tell_what_each_cell_holds(name):
    """No two combinations that a cell can hold look alike there, and cells share no pixel."""
    env = pharos.make(name)
    made = observe(env, "complex_image", motion=True)
    made._drawing._compiled = made._drawing._interpret
    layers = list(made._drawing.layers.values())
    rows, columns = env.grid()
    can_hold, looked_at = {}, set()
    for row, column in product(range(rows), range(columns)):
        held = np.array(sorted(set(HELD[env.name](env, layers, row, column))))
        can_hold[row, column] = {tuple(each) for each in held.tolist()}
        picture, top, left, sprite, *_ = made._tables
        ground = picture[top[row] : top[row + 1], left[column] : left[column + 1]]
        key = (ground.shape, ground.tobytes(), sprite[:, row].tobytes(), held.tobytes())
        if key not in looked_at:
            looked_at.add(key)
            assert len(np.unique(blocks(made, row, column, held), axis=0)) == len(held), (row, column)
    for state in walked(env, 300):  # those combinations are all that are met, and these are the pixels
        planes = np.zeros((len(layers), rows, columns), np.uint8)
        made._drawing._draw(state, planes)
        (image,) = made(np.array([state]))
        for row, column in product(range(rows), range(columns)):
            here = planes[:, row, column]
            assert tuple(here.tolist()) in can_hold[row, column]
            if here.any():
                part = image[top[row] : top[row + 1], left[column] : left[column + 1]]
                assert (blocks(made, row, column, here[None].astype(np.int64))[0] == part.ravel()).all()


def walked(env, steps):
    """Some states of a random walk."""
    rng, state = np.random.default_rng(0), tuple(env.initial_states()[0][0])
    for step in range(steps):
        if step % 25 == 0:
            yield tuple(map(int, state))
        action = int(rng.integers(env.num_actions))
        possible = [k for k in range(env.outcomes) if env.probability(state, action, k) > 0]
        state = env.next_state(state, action, int(rng.choice(possible)))
        if env.is_terminal(state):
            state = tuple(env.initial_states()[0][0])
