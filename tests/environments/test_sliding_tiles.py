"""Sliding tiles: rules against a tray of a dictionary; starts; how many positions need how many moves, as published."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive import environments as naive
from pharos.drawing import text_drawing
from pharos.errors import ParameterError
from pharos.observations import render
from refusals import refusal
from solution_lengths import solution_lengths
from strategies import examples

# Positions that need 0, 1, 2, ... moves, blank in a corner when solved: sequences of the On-Line Encyclopedia of
# Integer Sequences, by H. Pfoertner (2003) and others; 2x2 by hand.
COUNTS = {
    (2, 2): (1, 2, 2, 2, 2, 2, 1),
    (2, 3): (1, 2, 3, 5, 6, 7, 10, 12, 12, 16, 23, 25, 28, 39, 44, 40, 29, 21, 18, 12, 6, 1),  # A090034
    (2, 4): (  # A090035
        *(1, 2, 3, 6, 10, 14, 19, 28, 42, 61, 85, 119, 161, 215, 293, 396, 506, 632, 788, 985, 1194, 1414, 1664),
        *(1884, 1999, 1958, 1770, 1463, 1076, 667, 361, 190, 88, 39, 19, 7, 1),
    ),
    (3, 3): (  # A089473, Reinefeld (1993)
        *(1, 2, 4, 8, 16, 20, 39, 62, 116, 152, 286, 396, 748, 1024, 1893, 2512, 4485, 5638, 9529, 10878, 16993),
        *(17110, 23952, 20224, 24047, 15578, 14560, 6274, 3910, 760, 221, 2),
    ),
}
COUNTS_OF_2X5 = (  # A090036
    *(1, 2, 3, 6, 11, 19, 30, 44, 68, 112, 176, 271, 411, 602, 851, 1232, 1783, 2530, 3567, 4996, 6838, 9279, 12463),
    *(16597, 21848, 28227, 35682, 44464, 54597, 65966, 78433, 91725, 104896, 116966, 126335, 131998, 133107, 128720),
    *(119332, 106335, 91545, 75742, 60119, 45840, 33422, 23223, 15140, 9094, 5073, 2605, 1224, 528, 225, 75, 20, 2),
)
# Korf and Schultze (2005), table 1, as corrected in A151943: positions within reach, and the most moves that one needs
RADIUS = {(2, 2): 6, (2, 3): 21, (2, 4): 36, (3, 3): 31, (2, 5): 55}


@st.composite
def trays(draw):
    rows, columns = draw(st.sampled_from([(2, 2), (2, 3), (3, 2), (3, 3), (2, 5), (4, 4)]))
    return {"rows": rows, "columns": columns, "seed": draw(st.integers(0, 1000))}


@pytest.mark.long
@examples(100, trays(), st.lists(st.sampled_from(["up", "right", "down", "left"]), max_size=60))
def test_tiles_slide_like_those_of_its_twin(parameters, actions):
    env = pharos.make("sliding_tiles", **parameters)
    state = tuple(env.initial_state())
    twin = naive.SlidingTiles(state, parameters["columns"])
    for name in actions:
        state = env.next_state(state, env.actions.index(name))
        reward, terminated = twin.step(name)
        assert state == twin.state()
        assert (env.reward(state, 0, state), env.is_terminal(state)) == (reward, terminated)
        if terminated:
            return


def naive_counts(rows, columns):
    """The positions that need 0, 1, ... moves, by breadth-first search from the solved one; and all of them."""
    tiles = (*range(1, rows * columns), 0)
    frontier, seen, counts = [tiles], {tiles}, []
    while frontier:
        counts.append(len(frontier))
        reached = set()
        for position in frontier:
            for action in naive.OFFSETS:
                twin = naive.SlidingTiles(position, columns)
                twin.step(action)
                reached.add(twin.state())
        frontier = list(reached - seen)
        seen |= reached
    return tuple(counts), seen


@pytest.mark.parametrize("tray", [(2, 2), (2, 3), (3, 2)])
def test_starts_are_solvable_and_drawn_from_all_positions(tray):
    rows, columns = tray
    counts, positions = naive_counts(rows, columns)
    assert len(positions) == math.factorial(rows * columns) // 2
    assert COUNTS.get(tray, counts) == counts
    assert len(counts) - 1 == RADIUS[min(tray), max(tray)]
    solved = (*range(1, rows * columns), 0)
    assert pharos.make("sliding_tiles", rows=rows, columns=columns).initial_state() in positions - {solved}
    drawn = {
        pharos.make("sliding_tiles", rows=rows, columns=columns, seed=seed).initial_state()
        for seed in range(20 * len(positions) if len(positions) < 100 else 400)
    }
    assert drawn <= positions - {solved}
    assert len(drawn) == len(positions) - 1 or len(drawn) > 200


def test_exactly_the_positions_that_can_be_solved_are_taken_as_a_start():
    _, positions = naive_counts(2, 2)
    for number in range(4**4):
        tiles = tuple(number // 4**i % 4 for i in range(4))
        if tiles in positions and tiles != (1, 2, 3, 0):
            assert pharos.make("sliding_tiles/2x2", start=tiles).initial_state() == tiles
        else:
            assert "SlidingTiles: start=" in refusal(ParameterError, pharos.make, "sliding_tiles/2x2", start=tiles)


@pytest.mark.long
@pytest.mark.parametrize("tray", sorted(COUNTS))
def test_as_many_positions_need_as_many_moves_as_published(tray):
    """Every position is within reach, the solved one included, though it ends the episode."""
    env = pharos.make("sliding_tiles", rows=tray[0], columns=tray[1])
    space = pharos.build(env, progress=False)
    lengths = solution_lengths(space)
    assert tuple(np.bincount(lengths)) == COUNTS[tray]
    assert len(COUNTS[tray]) - 1 == RADIUS[tray]
    assert space.num_states == sum(COUNTS[tray]) == math.factorial(env.cells) // 2
    hardest = pharos.make(env.name, rows=tray[0], columns=tray[1], start=space.state(int(lengths.argmax())))
    undiscounted = pharos.build(hardest, progress=False).mdp(gamma=1.0)
    assert pharos.value_iteration(undiscounted, horizon=env.max_episode_steps).value_at_start == -RADIUS[tray]


@pytest.mark.long
def test_the_named_hardest_start_needs_31_moves():
    """One of the two that A089473 prints."""
    env = pharos.make("sliding_tiles/3x3-hardest")
    space = pharos.build(env, progress=False)
    assert env.max_episode_steps > 31 == solution_lengths(space)[0]


@pytest.mark.long
def test_the_tray_of_two_by_five_has_1814400_positions_and_radius_55():
    space = pharos.build(pharos.make("sliding_tiles/2x5"), progress=False)
    assert space.num_states == 1_814_400
    assert tuple(np.bincount(solution_lengths(space))) == COUNTS_OF_2X5
    assert len(COUNTS_OF_2X5) - 1 == RADIUS[2, 5]


def test_the_fifteen_puzzle_takes_one_word():
    from pharos.rules import layout_of

    assert layout_of(pharos.make("sliding_tiles", rows=4, columns=4).components).num_words == 1


@pytest.mark.long
def test_no_two_positions_share_an_image():
    env = pharos.make("sliding_tiles/2x2")
    _, positions = naive_counts(2, 2)
    for kind in ("simple_image", "complex_image"):
        assert len({render(env, state, kind).tobytes() for state in positions}) == 12
    large = pharos.make("sliding_tiles", rows=6, columns=6)
    assert len(np.unique(render(large, large.initial_state(), "simple_image"))) > 3
    assert len(set(text_drawing(large, large.initial_state()))) == 36 + 1
