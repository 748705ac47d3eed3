"""Pictures of states: every environment can be drawn, and what is drawn is where the planes say."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from PIL import Image

from pharos import Layer, drawing, make
from pharos.cli.render import Game
from pharos.drawing import SHAPES, episode, human, letter_color, planes_of, text_drawing
from pharos.errors import ParameterError, UnknownName
from pharos.observations import RENDERERS, render
from refusals import refusal
from worlds import Row

ENVIRONMENTS = ["simple_grid/6x6-decoy", "frozen_lake/8x8", "freeway/16x7-speed2", "breakout/12x8x3"]


def start_of(env):
    return tuple(env.initial_states()[0][0])


def cells_of(picture, cell):
    """(rows, columns, cell, cell, 3): a picture without its margin, cut into cells."""
    margin = cell // 2
    court = picture[margin:-margin, margin:-margin]
    rows, columns = court.shape[0] // cell, court.shape[1] // cell
    return court.reshape(rows, cell, columns, cell, 3).swapaxes(1, 2)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_environment_can_be_drawn_in_every_state_of_an_episode(name):
    env = make(name)
    rng = np.random.default_rng(0)
    for state, _, _ in episode(env, lambda _: rng.integers(env.num_actions), start_of(env), steps=30):
        picture = human(env, state)
        rows, columns = env.grid()
        assert picture.dtype == np.uint8
        assert picture.shape[0] <= 720 and picture.shape[1] <= 960
        assert picture.shape[0] * (columns + 1) == picture.shape[1] * (rows + 1)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_only_the_cells_whose_planes_differ_look_different(name):
    env = make(name)
    rng = np.random.default_rng(1)
    states = [state for state, _, _ in episode(env, lambda _: rng.integers(env.num_actions), start_of(env), steps=40)]
    for before, after in itertools.pairwise(states):
        differs = (planes_of(env, before) != planes_of(env, after)).any(axis=0)
        drawn = cells_of(human(env, before, cell=16), 16) != cells_of(human(env, after, cell=16), 16)
        np.testing.assert_array_equal(drawn.any(axis=(2, 3, 4)), differs)


def test_the_ball_is_white_and_the_bricks_are_red():
    env = make("breakout", height=8, columns=6)
    cells = cells_of(human(env, start_of(env), cell=32), 32)
    assert (cells[3, 2, 16, 16] > 220).all()
    red, green, blue = cells[1, 0, 16, 16].tolist()
    assert red > 2 * green and red > 2 * blue
    assert (cells[5, 0] < 40).all()


def test_cars_look_where_they_go():
    env = make("freeway", num_cars=2, lane_length=3)
    cells = cells_of(human(env, start_of(env), cell=64), 64)
    right, left = cells[1, 0].astype(int), cells[2, 0].astype(int)
    yellow = (255, 246, 190)
    assert (right[:, 32:] == yellow).all(axis=2).any() and not (right[:, :32] == yellow).all(axis=2).any()
    assert (left[:, :32] == yellow).all(axis=2).any() and not (left[:, 32:] == yellow).all(axis=2).any()


def test_text_is_the_drawing_of_the_environment():
    env = make("frozen_lake")
    assert text_drawing(env, (0, 0)) == "A...\n.O.O\n...O\nO..G"
    assert drawing.colored_text(env, (0, 0)).plain.replace(" ", "") == text_drawing(env, (0, 0))


@dataclass(frozen=True, kw_only=True)
class Lamp(Row):
    """A switch: on, dim or off."""

    length: int = 3

    name, variable = "lamp", "light"
    actions = ("press",)
    layers = {
        "lamp": Layer((".", "*"), ((90, 80, 10), (250, 240, 90)), (("#.", ".#"), ("15", "9."))),
        "frame": Layer("+", (0, 0, 255)),
    }

    def transition(self, state, action, out):
        out[0] = (state[0] + 1) % 3

    def reward(self, state, action, next_state):
        return 0.5

    def grid(self):
        return 1, 2

    def draw(self, state, planes):
        planes[0, 0, 0] = state[0]
        planes[1, 0, 1] = 1


def test_a_sprite_for_each_value_and_shades_from_light_to_dark():
    dim, bright = (cells_of(human(Lamp(), (light,), cell=8), 8)[0, 0] for light in (1, 2))
    assert dim[0, 0].tolist() == dim[7, 7].tolist() == [90, 80, 10]
    assert dim[0, 7].tolist() == dim[7, 0].tolist() != [90, 80, 10]  # the ground shows through
    assert bright[0, 7].tolist() == [250, 240, 90]
    assert bright[0, 0].sum() > bright[0, 7].sum() > bright[7, 0].sum()
    assert letter_color((100, 100, 100), "#") == letter_color((100, 100, 100), "5") == (100, 100, 100)
    assert letter_color((100, 100, 100), "1") == (224, 224, 224)
    assert letter_color((100, 100, 100), "9") == (20, 20, 20)


def test_an_episode_ends_with_the_state_it_reaches():
    assert episode(Lamp(), lambda _: 0, (0,), steps=2) == [((0,), 0, 0.5), ((1,), 0, 0.5), ((2,), -1, 0.0)]
    lake = make("frozen_lake")
    fell = episode(lake, lambda state: 2 if state == (0, 0) else 1, (0, 0), steps=50)
    assert [state for state, _, _ in fell] == [(0, 0), (0, 1), (1, 1)]


def test_episodes_draw_the_outcomes_of_chance_in_the_rules():
    """The first card of a hit at blackjack, from a total of 4: 400 seeds, each card near its probability."""
    env, start = make("blackjack/plain"), (4, 2, 0, 0, 0)
    seen = np.zeros(10)
    for seed in range(400):
        (total, *_), _, _ = episode(env, lambda _: 1, start, steps=1, seed=seed)[-1]
        seen[0 if total == 15 else total - 5] += 1
    likely = np.array([1 / 13] * 9 + [4 / 13])
    assert (abs(seen - 400 * likely) < 4 * np.sqrt(400 * likely)).all()
    again = [episode(env, lambda _: 1, start, steps=9, seed=7) for _ in range(2)]
    assert again[0] == again[1]


@pytest.mark.parametrize(("glyph", "text"), [("1", "2"), ("6", "64"), ("A", "1024"), ("H", "131072")])
def test_tiles_of_2048_are_written_as_powers_of_two(glyph, text):
    """With as many dark columns, gaps included, as three for each digit and one between digits."""
    color = np.array((200.0, 200.0, 200.0))
    dark = (SHAPES["power"](color, 8 * len(text), glyph)[..., 0] == 24).any(axis=0)
    first, last = np.flatnonzero(dark)[[0, -1]]
    scale = 8 * len(text) // max(8, 4 * len(text) + 1)
    assert (4 * len(text) - 3) * scale <= last - first + 1 <= (4 * len(text) - 1) * scale
    small = SHAPES["power"](color, 4, glyph)
    np.testing.assert_array_equal(small, SHAPES["lettered"](color, 4, glyph))


def test_a_number_of_the_unit_interval_stands_for_an_outcome():
    env = make("cliff_walking/4x12-slippery")
    drawn = [env.drawn_outcome((3, 0), 1, u) for u in (0.0, 0.3, 0.34, 0.6, 0.67, 1 - 2**-53)]
    assert drawn == [0, 0, 1, 1, 2, 2]
    assert make("cliff_walking/4x12").drawn_outcome((3, 0), 1, 0.9) == 0


@pytest.mark.long
@pytest.mark.parametrize(("rows", "columns"), [(3, 3), (2, 3), (1, 3), (3, 2), (3, 1)])
def test_planes_of_three_columns_are_no_colors(rows, columns):
    env = make("game_2048", rows=rows, columns=columns, canonical=False)
    state = (1, 2, *[0] * (rows * columns - 2))
    plane = np.array(state).reshape(rows, columns) > 0
    picture = render(env, state, "simple_image")
    assert picture.shape == (rows, columns, 3)
    assert ((picture > 0) == plane[..., None]).all() and (picture[..., 0] == picture[..., 2]).all()


def test_an_episode_and_a_game_draw_outcomes_that_are_possible_by_their_seed():
    env = make("taxi", size=3, rainy=True)
    start = (1, 1, 0, 1, 0)

    def driven(seed):
        return [state for state, _, _ in episode(env, lambda _: 0, start, steps=40, seed=seed)]

    assert driven(1) == driven(1) != driven(2)
    moved = {following[:2] for seed in range(60) for following in [driven(seed)[1]]}
    assert moved == {(2, 1), (1, 0), (1, 2)}  # down, or to either side
    games = [Game(env, start, seed) for seed in (1, 1, 2)]
    for game in games:
        for _ in range(30):
            game.press("down")
            game.press("up")
    states = [[state for state, _, _ in game.history] for game in games]
    assert states[0] == states[1] != states[2]
    for game in games:  # every step is one that the rules know
        for (state, action, reward), (following, _, _) in zip(game.history, game.history[1:], strict=False):
            possible = [k for k in range(env.outcomes) if env.probability(state, action, k) > 0]
            assert following in [env.next_state(state, action, k) for k in possible]
            assert reward == env.reward(state, action, following)


def test_observations_can_be_plugged_in(monkeypatch):
    monkeypatch.setitem(RENDERERS, "dot", lambda env, state: np.full((2, 3), 7, np.uint8))
    picture = render(Lamp(), (0,), "dot")
    assert picture.shape == (2, 3, 3) and (picture == 7).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["freeway", "breakout"])
def test_images_that_agents_see_are_drawn_for_people(name):
    env = make(name)
    state = env.initial_states()[0][0]
    rows, columns = env.grid()
    planes = render(env, state, "simple_image")
    assert planes.shape == (rows, len(env.layers) * (columns + 1) - 1, 3)
    for number, plane in enumerate(planes_of(env, state)):
        left = number * (columns + 1)
        assert ((planes[:, left : left + columns, 0] > 0) == (plane > 0)).all()
    assert render(env, state, "complex_image").shape == (84, 84, 3)
    assert render(env, state, "complex_image", size=(60, 90), grey=True).shape == (60, 90, 3)
    assert "no image" in refusal(ParameterError, render, env, state, "vector")
    assert "option of observation" in refusal(UnknownName, render, env, state, "complex_image", colour=1)
    assert "takes no options" in refusal(ParameterError, render, env, state, "human", size=3)


def test_what_cannot_be_drawn_is_said():
    assert "did you mean 'human'" in refusal(UnknownName, render, Lamp(), (0,), "humen")
    assert "light = 3; expected 0 to 2" in refusal(ParameterError, human, Lamp(), (3,))
    assert "2 components; expected 1" in refusal(ParameterError, human, Lamp(), (0, 0))
    assert "must define grid()" in refusal(ParameterError, human, Row(), (0,))


def test_png_holds_the_picture_and_a_caption_below(tmp_path):
    picture = human(make("simple_grid"), (1, 2))
    with Image.open(drawing.save_png(tmp_path / "a.png", picture)) as read:
        np.testing.assert_array_equal(np.asarray(read), picture)
    with Image.open(drawing.save_png(tmp_path / "b.png", picture, caption="step 3")) as read:
        written = np.asarray(read)
    np.testing.assert_array_equal(written[: len(picture)], picture)
    assert written[len(picture) :].max() > 200
    assert drawing.image(picture).size == (picture.shape[1], picture.shape[0])


def test_small_pictures_are_enlarged_by_a_whole_factor(tmp_path):
    small = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    with Image.open(drawing.save_png(tmp_path / "a.png", small, at_least=10)) as read:
        np.testing.assert_array_equal(np.asarray(read), small.repeat(4, axis=0).repeat(4, axis=1))


def test_gif_has_the_frames_their_time_and_their_colours(tmp_path):
    env = make("frozen_lake")
    states = [(0, 0), (1, 0), (2, 0), (2, 1)]
    pictures = [human(env, state) for state in states]
    with Image.open(drawing.save_gif(tmp_path / "a.gif", pictures, frames_per_second=10)) as read:
        assert read.n_frames == 4
        assert read.info["loop"] == 0
        for number, picture in enumerate(pictures):
            read.seek(number)
            assert read.info["duration"] == (1100 if number == 3 else 100)
            off = np.abs(np.asarray(read.convert("RGB")).astype(int) - picture).max(axis=2)
            assert (off > 24).mean() < 0.01  # a palette of 256 colours
