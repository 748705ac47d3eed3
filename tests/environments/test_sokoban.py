"""Sokoban: rules against sets of cells, solutions by hand and by breadth-first search, levels of files and of seeds."""

import pytest
from hypothesis import strategies as st

import pharos
from naive import environments as naive
from pharos.drawing import text_drawing
from pharos.errors import ParameterError
from refusals import refusal
from strategies import examples

pytestmark = pytest.mark.long  # with each class compiled and walked through in full

# Levels with a solution by hand: the steps by their first letters
SOLVED_BY_HAND = {"corridor": "rrr", "corner": "rdldr", "two-rooms": "rrrurd"}
# Least steps, and states within reach
FACTS = {
    "corridor": (3, 6),
    "corner": (5, 66),
    "two-rooms": (6, 273),
    "pillar": (19, 2889),
    "random-1": (8, 374),
    "random-2": (11, 3432),
}
BOXOBAN = """; 0
##########
##########
#     ####
# $.. ####
#  #    ##
#@ # $  ##
# $   # ##
#  .#$. ##
##########
##########

; 7
##########
##.   .###
# $ $ @###
##########
"""


@examples(
    60, st.integers(0, 200), st.integers(1, 3), st.lists(st.sampled_from(["up", "right", "down", "left"]), max_size=60)
)
def test_boxes_are_pushed_like_those_of_its_twin(seed, boxes, actions):
    env = pharos.make("sokoban", seed=seed, boxes=boxes)
    state, twin = tuple(env.initial_state()), naive.Sokoban(env.text)
    for name in actions:
        following = env.next_state(state, env.actions.index(name))
        reward, terminated = twin.step(name)
        placed = frozenset(tuple(env.cells[i].tolist()) for i, is_box in enumerate(following[2:]) if is_box)
        assert (following[:2], placed) == twin.state()
        assert env.reward(state, 0, following) == pytest.approx(reward, abs=1e-12)
        assert env.is_terminal(following) == terminated
        state = following
        if terminated:
            return


@pytest.mark.parametrize("level", SOLVED_BY_HAND)
def test_a_level_is_solved_by_hand(level):
    env, total = pharos.make(f"sokoban/{level}"), 0.0
    state = env.initial_state()
    for letter in SOLVED_BY_HAND[level]:
        assert not env.is_terminal(state)
        action = "urdl".index(letter)
        following = env.next_state(state, action)
        total += env.reward(state, action, following)
        state = following
    assert env.is_terminal(state)
    assert total == pytest.approx(10 + len(env.targets) - 0.1 * len(SOLVED_BY_HAND[level]))


@pytest.mark.parametrize("level", FACTS)
def test_the_optimal_return_is_that_of_a_shortest_solution(level):
    """10 and 1 for each box that is not on a target at the start, less 0.1 a step; boxes that change places are one
    state."""
    env = pharos.make(f"sokoban/{level}")
    assert naive.Sokoban(env.text).solution() == FACTS[level]
    steps, states = FACTS[level]
    assert len(SOLVED_BY_HAND.get(level, [0] * steps)) == steps
    space = pharos.build(env, progress=False)
    assert space.num_states == states
    solution = pharos.value_iteration(space.mdp(gamma=1.0), horizon=env.max_episode_steps)
    assert solution.value_at_start == pytest.approx(10 + env.text.count("$") - 0.1 * steps, abs=1e-9)


@pytest.mark.slow
def test_the_storehouse_takes_36_steps():
    space = pharos.build(pharos.make("sokoban/storehouse"), progress=False)
    assert space.num_states == 1_601_116
    solution = pharos.value_iteration(space.mdp(gamma=1.0), horizon=space.environment.max_episode_steps)
    assert solution.value_at_start == pytest.approx(10 + 4 - 3.6)


def test_levels_are_read_from_a_file_of_boxoban(tmp_path):
    file = tmp_path / "000.txt"
    file.write_text(BOXOBAN)
    env = pharos.make("sokoban", level=str(file))
    assert env == pharos.make("sokoban", level=f"{file}:0")
    assert text_drawing(env, env.initial_state()).splitlines()[2:8] == [
        "#.....####",
        "#.$xx.####",
        "#..#....##",
        "#@.#.$..##",
        "#.$...#.##",
        "#..x#$x.##",
    ]
    assert env.floor.shape == (10, 10) and len(env.cells) == 34
    seventh = pharos.make("sokoban", level=f"{file}:7")
    assert seventh.level == "##########/##.---.###/#-$-$-@###/##########"
    assert pharos.make("sokoban", **seventh.parameters) == seventh
    assert "the file has no level 3" in refusal(ParameterError, pharos.make, "sokoban", level=f"{file}:3")


def test_levels_without_headings_are_counted_from_0(tmp_path):
    file = tmp_path / "mine.txt"
    file.write_text("Two of mine\n\n#####\n#@$.#\n#####\n\n  ####\n###  #\n#@ $.#\n######\n")
    assert pharos.make("sokoban", level=f"{file}:0").level == "#####/#@$.#/#####"
    assert pharos.make("sokoban", level=f"{file}:1").level == "--####/###--#/#@-$.#/######"
    assert len(pharos.make("sokoban", level=f"{file}:1").cells) == 6


ONE, TWO, THREE = "#####\n#@$.#\n#####", "######\n#@ $.#\n######", "#######\n#@  $.#\n#######"


@pytest.mark.parametrize(
    "text",
    [
        f"; 1\n\n{ONE}\n\n; 2\n\n{TWO}\n\n; 3\n{THREE}\n",  # Microban: a blank line after the number
        f"; 1\n{ONE}\n; 2\n{TWO}\n; 3\n{THREE}",  # nothing between levels
        f"Level 1\n{ONE}\nTitle: first\nAuthor: somebody\n\nlevel 2\n; 'two'\n{TWO}\n\nLevel 3\n\n{THREE}\n",
        f"A pack of 3 levels\n\n'1'\n{ONE}\n\n'2'\n{TWO}\n-----\n'3'\n{THREE}\n",
    ],
)
def test_a_pack_gives_the_level_whose_number_was_asked_for(text, tmp_path):
    file = tmp_path / "pack.xsb"
    file.write_text(text)
    for number, level in ((1, ONE), (2, TWO), (3, THREE)):
        assert pharos.make("sokoban", level=f"{file}:{number}").level == level.replace("\n", "/").replace(" ", "-")
    message = refusal(ParameterError, pharos.make, "sokoban", level=f"{file}:4")
    assert "the file has no level 4; it has 3, numbered 1 to 3" in message


@pytest.mark.parametrize(
    "between", ["\n\n", "\n; first\n", "\nTitle: first\n\n", "\n \t\n", "\n-----\n", "\nsomething else\n"]
)
def test_any_line_that_is_no_row_ends_a_level(between, tmp_path):
    file = tmp_path / "pack.sok"
    file.write_text(f"{ONE}{between}{TWO}{between}{THREE}\n")
    for number, level in enumerate((ONE, TWO, THREE)):
        assert pharos.make("sokoban", level=f"{file}:{number}").level == level.replace("\n", "/").replace(" ", "-")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            f"{ONE}\n; 1\n\n{TWO}\n; 2\n",
            "line 1 begins a level without a number; expected a line '; N' before",
        ),
        (f"; 1\n{ONE}\n\n; 2 'two'\n{TWO}\n\n; 3\n{THREE}\n", "line 7 begins a level without a number"),
        (f"; 1\n{ONE}\n\n{TWO}\n", "line 6 begins a level without a number"),
        (f"; 1\n; 2\n{TWO}\n", "line 2 begins a number without a level"),
        (f"; 1\n{ONE}\n; 2\n", "line 5 begins a number without a level"),
        (f"; 1\n{ONE}\n; 1\n{TWO}\n", "line 5: two levels have the number 1"),
        ("5#|#@$.#|5#\n", "line 1 has run lengths or other letters, '5#|#@$.#|5#'; expected rows of #-@$.+*"),
        (f"{ONE}\n\n#####\n#p b.#\n#####\n", "line 6 has run lengths or other letters, '#p b.#'"),
        ("4#\n#@$.\n", "line 1 has run lengths"),
        ("nothing\n", "; it has none"),
    ],
)
def test_a_pack_whose_numbers_are_not_clear_is_refused(text, message, tmp_path):
    file = tmp_path / "pack.txt"
    file.write_text(text)
    for number in (0, 1, 2):
        assert message in refusal(ParameterError, pharos.make, "sokoban", level=f"{file}:{number}")


def test_a_level_without_walls_around_it_ends_at_its_edge():
    env = pharos.make("sokoban", level="@$.")
    state = env.initial_state()
    assert [env.next_state(state, action) for action in (0, 2, 3)] == [state] * 3
    assert env.is_terminal(env.next_state(state, 1))


def test_random_levels_can_be_solved_and_are_the_same_on_every_machine():
    levels = {pharos.make("sokoban", seed=seed).text for seed in range(12)}
    assert len(levels) == 12
    for level in sorted(levels)[:6]:
        assert naive.Sokoban(level).solution()[0]
    assert pharos.make("sokoban", seed=2).text == "#######/#@-#-.#/#-.$--#/#--$--#/#-#---#/#--##-#/#######"
