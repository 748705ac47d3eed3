"""2048: rules, states and values against a plain twin that shares no code, and against what others have published."""

from collections import defaultdict
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from strategies import examples

pytestmark = pytest.mark.long  # with each class compiled and walked through in full

# The twin: boards are tuples of rows of face values (0: empty); chance is in fractions -----------------------------


def merged(line):
    """A line of tiles slid to its beginning, and what that pays."""
    tiles, out, paid = [tile for tile in line if tile], [], 0
    while tiles:
        if tiles[1:2] == tiles[:1]:
            out.append(2 * tiles[0])
            paid += out[-1]
            tiles = tiles[2:]
        else:
            out.append(tiles.pop(0))
    return out + [0] * (len(line) - len(out)), paid


def turned(board):
    """A quarter turn counterclockwise."""
    return tuple(zip(*board, strict=True))[::-1]


def slid(board, action):
    """(board, points) of a move; the board is turned so that tiles slide to the left, and turned back."""
    turns = ("left", "up", "right", "down").index(action)
    for _ in range(turns):
        board = turned(board)
    lines = [merged(row) for row in board]
    board = tuple(tuple(line) for line, _ in lines)
    for _ in range(-turns % 4):
        board = turned(board)
    return board, sum(paid for _, paid in lines)


CLOCKWISE = ("up", "right", "down", "left")


def played(board, action):
    """(board, points) of the first action, clockwise from `action`, that moves something; None where none does."""
    first = CLOCKWISE.index(action)
    for other in CLOCKWISE[first:] + CLOCKWISE[:first]:
        if slid(board, other)[0] != board:
            return slid(board, other)
    return None


def with_new_tile(board):
    """Board -> probability."""
    empty = [(y, x) for y, row in enumerate(board) for x, tile in enumerate(row) if not tile]
    law = {}
    for place in empty:
        for tile, probability in ((2, Fraction(9, 10)), (4, Fraction(1, 10))):
            rows = [list(row) for row in board]
            rows[place[0]][place[1]] = tile
            law[tuple(map(tuple, rows))] = probability / len(empty)
    return law


def starts(rows, columns):
    law = defaultdict(Fraction)
    for board, p in with_new_tile(((0,) * columns,) * rows).items():
        for full, q in with_new_tile(board).items():
            law[full] += p * q
    return law


def images(board):
    """All rotations and mirror images of the shape of the board."""
    found = set()
    for form in (board, board[::-1]):
        for _ in range(4):
            found.add(form)
            form = turned(form)
    return {form for form in found if len(form) == len(board)}


def is_over(board, target):
    return target in {tile for row in board for tile in row} or played(board, "up") is None


def reachable(rows, columns, target, canonical):
    """All boards that a game can meet."""
    form = (lambda board: max(images(board))) if canonical else (lambda board: board)
    found = {form(board) for board in starts(rows, columns)}
    waiting = list(found)
    while waiting:
        board = waiting.pop()
        if is_over(board, target):
            continue
        for after in {slid(board, action)[0] for action in CLOCKWISE} - {board}:
            for following in map(form, with_new_tile(after)):
                if following not in found:
                    found.add(following)
                    waiting.append(following)
    return found


def optimum(rows, columns, target, pays_score):
    """(exact expected return of optimal play, board -> that from there on), by expectimax."""

    @cache
    def value(board):
        if is_over(board, target):
            return Fraction(0)
        best = Fraction(-1)
        for action in CLOCKWISE:
            after, paid = slid(board, action)
            if after != board:
                made = target in {tile for row in after for tile in row}
                expected = sum(p * value(following) for following, p in with_new_tile(after).items())
                best = max(best, (paid if pays_score else int(made)) + expected)
        return best

    return sum(p * value(board) for board, p in starts(rows, columns).items()), value


def board_of(env, state):
    faces = [0 if tile == 0 else 2**tile for tile in state]
    return tuple(tuple(faces[row * env.columns : (row + 1) * env.columns]) for row in range(env.rows))


def assert_values_are(solution, space, exact):
    """Of all states, within the bound that the solution promises."""
    for index in range(space.num_states):
        difference = Fraction(float(solution.v[index])) - exact(board_of(space.environment, space.state(index)))
        assert abs(difference) <= Fraction(solution.error_bound)


# Rules --------------------------------------------------------------------------------------------------------------


@st.composite
def boards(draw):
    rows, columns = draw(st.sampled_from([(1, 2), (1, 5), (2, 2), (3, 2), (2, 3), (3, 3), (3, 4), (4, 4)]))
    tile = st.sampled_from((0, 0, 0, 1, 1, 1, 2, 2, 3, 4, rows * columns))
    return rows, columns, draw(st.tuples(*[tile] * (rows * columns)))


@examples(150, boards(), st.booleans(), st.sampled_from([None, 8, 16]))
def test_every_outcome_is_that_of_the_twin(drawn, canonical, target):
    rows, columns, state = drawn
    target = target if rows * columns > 2 else None
    env = pharos.make("game_2048", rows=rows, columns=columns, target=target, canonical=canonical)
    board = board_of(env, state)
    assert env.age(state) == sum(map(sum, board))
    assert env.is_terminal(state) == is_over(board, target)
    if is_over(board, target):
        return
    for action, name in enumerate(env.actions):
        after, paid = played(board, name)
        expected, found = defaultdict(Fraction), defaultdict(float)
        for following, p in with_new_tile(after).items():
            expected[max(images(following)) if canonical else following] += p
        for outcome in range(env.outcomes):
            p = env.probability(state, action, outcome)
            if p > 0:
                following = env.next_state(state, action, outcome)
                assert env.reward(state, action, following) == paid
                assert env.age(following) - env.age(state) in (2, 4)
                found[board_of(env, following)] += p
        assert found.keys() == expected.keys()
        assert all(found[key] == pytest.approx(float(p), abs=1e-15) for key, p in expected.items())


def test_where_tiles_are_the_same_by_threes_those_nearest_to_the_side_merge():
    env = pharos.make("game_2048", rows=1, columns=5, canonical=False)
    assert env.next_state((1, 1, 1, 2, 2), 3, 0) == (2, 1, 3, 1, 0)
    assert env.next_state((1, 1, 1, 2, 2), 1, 3) == (0, 2, 1, 2, 3)
    assert env.next_state((1, 2, 1, 2, 0), 0, 0) == env.next_state((1, 2, 1, 2, 0), 1, 0) == (1, 1, 2, 1, 2)


def test_making_the_target_pays_once_and_ends_the_game():
    env = pharos.make("game_2048/2x2-to-32", target=8)
    following = env.next_state((2, 2, 1, 0), 3, 0)
    assert (env.reward((2, 2, 1, 0), 3, following), env.is_terminal(following)) == (1.0, True)
    assert env.reward((2, 1, 2, 0), 1, env.next_state((2, 1, 2, 0), 1, 0)) == 0.0


# States -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "columns", "target", "canonical"),
    [
        *((2, 2, None, True), (2, 2, None, False), (2, 2, 32, True)),
        *(pytest.param(2, 3, 16, canonical, marks=pytest.mark.slow) for canonical in (True, False)),
    ],
)
def test_states_are_those_that_the_twin_meets(rows, columns, target, canonical):
    env = pharos.make("game_2048", rows=rows, columns=columns, target=target, canonical=canonical)
    space = pharos.build(env, progress=False)
    expected = reachable(rows, columns, target, canonical)
    assert {board_of(env, space.state(i)) for i in range(space.num_states)} == expected
    assert space.num_states == len(expected)


def test_two_by_two_to_32_has_the_57_states_of_lees_miller():
    """Lees-Miller (2017), "Counting States by Exhaustive Enumeration": up to symmetry, 59 with one won and one lost."""
    space = pharos.build("game_2048/2x2-to-32", progress=False)
    assert space.num_states - space.num_terminal_states == 57


def test_two_by_two_to_8_has_the_70_states_of_lees_miller_where_boards_are_not_turned():
    """Lees-Miller (2018), "Optimal Play with Markov Decision Processes": with one won and one lost state."""
    space = pharos.build(pharos.make("game_2048/2x2-to-32", target=8, canonical=False), progress=False)
    assert space.num_states - space.num_terminal_states + 2 == 70


@pytest.mark.slow
def test_two_by_three_has_the_states_of_the_twin():
    space = pharos.build("game_2048/2x3", progress=False)
    assert space.num_states == len(reachable(2, 3, None, True)) == 21_752


# Values -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("target", "objective"), [(None, "score"), (32, "target"), (16, "target"), (16, "score")])
def test_values_of_two_by_two_are_those_of_expectimax_in_fractions(target, objective):
    env = pharos.make("game_2048", rows=2, columns=2, target=target, objective=objective)
    space = pharos.build(env, progress=False)
    solution = pharos.value_iteration(space.mdp(gamma=1.0))
    at_start, exact = optimum(2, 2, target, objective == "score")
    assert abs(Fraction(solution.value_at_start) - at_start) <= Fraction(solution.error_bound)
    assert_values_are(solution, space, exact)


@pytest.mark.parametrize(("target", "percent"), [(8, 100), (16, 96), (32, 8)])
def test_two_by_two_is_won_as_often_as_lees_miller_says(target, percent):
    """Lees-Miller (2018), "Optimal Play with Markov Decision Processes": 1.00, around 0.96, 0.08."""
    space = pharos.build(pharos.make("game_2048/2x2-to-32", target=target), progress=False)
    assert round(100 * pharos.value_iteration(space.mdp(gamma=1.0)).value_at_start) == percent


def test_boards_that_are_images_of_each_other_have_the_same_value():
    values = {}
    for canonical in (True, False):
        env = pharos.make("game_2048/2x2", canonical=canonical)
        space = pharos.build(env, progress=False)
        v = pharos.value_iteration(space.mdp(gamma=1.0)).v
        values[canonical] = {board_of(env, space.state(i)): v[i] for i in range(space.num_states)}
    assert len(values[False]) > 6 * len(values[True])
    for board, value in values[False].items():
        assert values[True][max(images(board))] == pytest.approx(value, abs=1e-9)


@pytest.mark.slow
def test_three_by_three_reaches_64_with_certainty():
    """900,000 states. 128 is the first tile of 3x3 that even optimal play can miss: docs/evidence/worlds.md."""
    space = pharos.build("game_2048/3x3-to-64", progress=False)
    solution = pharos.value_iteration(space.mdp(gamma=1.0))
    assert abs(solution.value_at_start - 1) <= solution.error_bound
    assert (space.ages == np.where(space.states() > 0, 2 ** space.states(), 0).sum(axis=1)).all()


# What instances there are -------------------------------------------------------------------------------------------


def test_starts_are_two_tiles_as_they_appear():
    env = pharos.make("game_2048/2x3", canonical=False)
    law = defaultdict(float)
    for state, p in env.initial_states():
        law[board_of(env, state)] += p
    expected = starts(2, 3)
    assert law.keys() == expected.keys()
    assert all(law[board] == pytest.approx(float(p), abs=1e-15) for board, p in expected.items())
