"""The built-in classes: rules against plain twins and Gymnasium, parameters, names, drawings, golden games."""

import json
import random
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from hypothesis import strategies as st

import golden_games
import pharos
from naive import builder as naive_builder
from naive import environments as naive
from pharos.drawing import episode, text_drawing
from pharos.environments import Environment, catalog, named_instances, register
from pharos.environments.built_in import BUILT_IN
from pharos.errors import ParameterError, UnknownName
from refusals import refusal
from strategies import examples

GRIDS = ("simple_grid", "frozen_lake")
SMALL = (  # beside them, spaces of at most 120 states
    *("cliff_walking", "cliff_walking/4x12", "cliff_walking/4x12-slippery"),
    *("corner_grid", "corner_grid/8x8", "corner_grid/8x8-random", "memory_chain", "memory_chain/length-10"),
    *("river_swim", *(f"river_swim/{name}" for name in ("strehl-littman", "osband", "colosseum"))),
    *("deep_sea", "deep_sea/10x10", "deep_sea/10x10-stochastic", "endless_sea", "endless_sea/10x10"),
    *("umbrella_chain", "umbrella_chain/length-10", "discounting_chain/delays-10"),
    *("delayed_choice", "delayed_choice/length-8", "delayed_choice/noisy"),
    *("game_2048/2x2", "game_2048/2x2-to-32"),
    *("sliding_tiles/2x2", "sokoban", "sokoban/corridor", "sokoban/corner"),
    *(f"mini_grid/{name}" for name in ("empty-5x5", "empty-6x6", "empty-random-5x5", "empty-random-6x6")),
    *(f"mini_grid/{name}" for name in ("lava-gap-s5", "lava-gap-s6", "lava-gap-s7", "multi-room-n2-s4")),
    *(f"mini_grid/{what}-crossing-{name}" for what in ("lava", "simple") for name in ("s9n3", "s11n5")),
)
ALL = pharos.list_environments()
# Each class is compiled: the paper's four and one with chance by `make test`, the others by `make test-long`.
COMPILED = [
    pytest.param(
        name, marks=() if name.split("/")[0] in (*GRIDS, "freeway", "breakout", "cliff_walking") else pytest.mark.long
    )
    for name in ALL
]


def assert_plays_like(env, twin, actions):
    """Environment and twin agree on every state, reward and end of a game; the game stops at its end."""
    state = tuple(env.initial_state())
    assert state == twin.state()
    for action in actions:
        name = env.actions[action(state) if callable(action) else action]
        following = env.next_state(state, env.actions.index(name))
        reward, terminated = twin.step(name)
        assert following == twin.state(), (state, name)
        assert env.reward(state, env.actions.index(name), following) == reward, (state, name)
        assert bool(env.is_terminal(following)) == terminated, (state, name)
        state = following
        if terminated:
            return


# Rules against their twins ------------------------------------------------------------------------------------------

actions_of_four = st.lists(st.integers(0, 3), max_size=60)


@st.composite
def grids(draw):
    height, width = draw(st.integers(1, 5)), draw(st.integers(2, 5))
    cells = [(row, column) for row in range(height) for column in range(width)][1:]
    chosen = draw(st.permutations(cells))
    goal, *others = chosen
    values = st.floats(-2, 2, allow_nan=False)
    rewards = tuple((cell, draw(values)) for cell in others[:2])
    penalties = tuple((cell, draw(st.floats(-2, -0.01))) for cell in others[2:5])
    return {"height": height, "width": width, "goal": goal, "rewards": rewards, "penalties": penalties}


@examples(150, grids(), actions_of_four)
def test_simple_grid_walks_like_its_twin(parameters, actions):
    assert_plays_like(pharos.make("simple_grid", **parameters), naive.simple_grid(**parameters), actions)


@examples(150, st.integers(2, 7), st.integers(0, 50), st.sampled_from([0.6, 0.8, 1.0]), actions_of_four)
def test_frozen_lake_walks_like_its_twin_on_random_maps(size, seed, frozen_probability, actions):
    env = pharos.make("frozen_lake", size=size, seed=seed, frozen_probability=frozen_probability)
    rows = ["".join("FSHG"[tile] for tile in row) for row in env.tiles]
    assert_plays_like(env, naive.frozen_lake(rows), actions)
    assert_plays_like(pharos.make("frozen_lake", map="/".join(rows)), naive.frozen_lake(rows), actions)


@st.composite
def roads(draw):
    return {
        "num_cars": draw(st.integers(1, 6)),
        "lane_length": draw(st.integers(2, 7)),
        "player_speed": draw(st.integers(1, 3)),
        "car_speeds": tuple(draw(st.lists(st.integers(1, 5), min_size=1, max_size=7))),
        "directions": tuple(draw(st.lists(st.sampled_from([1, -1]), min_size=1, max_size=3))),
        "restart_on_hit": draw(st.booleans()),
        "hit_penalty": draw(st.sampled_from([0.0, 0.5, 1.0])),
    }


@pytest.mark.slow
@examples(200, roads(), st.lists(st.sampled_from([0, 1, 1, 1, 2]), max_size=150))
def test_freeway_plays_like_its_twin(parameters, actions):
    assert_plays_like(pharos.make("freeway", **parameters), naive.Freeway(**parameters), actions)


@st.composite
def courts(draw):
    extra, brick_rows = draw(st.integers(0, 1)), draw(st.integers(1, 3))
    return {
        "height": brick_rows + draw(st.integers(4, 8)),
        "columns": draw(st.integers(max(2, 1 + 2 * extra), 7)),
        "brick_rows": brick_rows,
        "extra_paddle_width": extra,
        "respawn": draw(st.booleans()),
    }


@pytest.mark.long
@examples(200, courts(), st.floats(0, 1), st.randoms(use_true_random=False))
def test_breakout_plays_like_its_twin(parameters, skill, rng):
    env = pharos.make("breakout", **parameters)
    assert_plays_like(env, naive.Breakout(**parameters), [breakout_player(env, skill, rng)] * 400)


def breakout_player(env, skill, rng):
    """Follows the ball with probability `skill`, otherwise moves at random."""

    def action(state):
        _, ball, right, _, paddle, *_ = state
        if rng.random() > skill:
            return rng.randrange(3)
        target = min(max(ball + 2 * right - 1, 0), env.columns - 1) - env.extra_paddle_width
        return 1 + (target > paddle) - (target < paddle)

    return action


def test_the_breakout_player_clears_the_wall_and_meets_it_again():
    env, rng = pharos.make("breakout", height=8, columns=5), random.Random(0)
    player, start = breakout_player(env, 0.97, rng), env.initial_state()
    games = [episode(env, player, start, steps=1500) for _ in range(50)]
    assert max(sum(reward for _, _, reward in game) for game in games) > env.num_bricks


# Frozen lake against Gymnasium --------------------------------------------------------------------------------------


def gymnasium_law(size, slippery):
    """Gymnasium's P, (S, A, S): probability of each next state; and whether each state ends the episode."""
    env = gymnasium.make("FrozenLake-v1", map_name=f"{size}x{size}", is_slippery=slippery).unwrapped
    table, rewards = np.zeros((2, size * size, 4, size * size))
    for state, action in np.ndindex(size * size, 4):
        for probability, following, reward, _ in env.P[state][action]:
            table[state, action, following] += probability
            rewards[state, action, following] = reward
    ends = np.array([letter in b"GH" for letter in env.desc.ravel()])
    env.close()
    return table, rewards, ends


def our_law(env):
    """(S, A, S) zeros and ones of the deterministic lake, states numbered row by row."""
    num_states = env.height * env.width
    table, rewards = np.zeros((2, num_states, 4, num_states))
    for index, action in np.ndindex(num_states, 4):
        state = divmod(index, env.width)
        following = env.next_state(state, action)
        to = following[0] * env.width + following[1]
        table[index, action, to] = 1
        rewards[index, action, to] = env.reward(state, action, following)
    ends = np.array([bool(env.is_terminal(divmod(index, env.width))) for index in range(num_states)])
    return table, rewards, ends


@pytest.mark.parametrize("size", [4, 8])
def test_frozen_lake_has_the_transitions_rewards_and_limit_of_gymnasium(size):
    table, rewards, ends = our_law(pharos.make("frozen_lake", size=size))
    expected_table, expected_rewards, expected_ends = gymnasium_law(size, slippery=False)
    assert (ends == expected_ends).all()
    spec = gymnasium.spec("FrozenLake-v1" if size == 4 else "FrozenLake8x8-v1")
    assert pharos.make("frozen_lake", size=size).max_episode_steps == spec.max_episode_steps
    assert (table[~ends] == expected_table[~ends]).all()
    assert (rewards[~ends] == expected_rewards[~ends]).all()


@pytest.mark.parametrize("size", [4, 8])
def test_slippery_frozen_lake_has_every_entry_of_gymnasium(size):
    """In the order of Gymnasium's P, outcome by outcome: probability, next state, reward and end."""
    env = pharos.make("frozen_lake", size=size, slippery=True)
    theirs = gymnasium.make("FrozenLake-v1", map_name=f"{size}x{size}", is_slippery=True).unwrapped
    assert (env.outcomes, env.max_episode_steps) == (3, 100 if size == 4 else 200)
    for index, by_action in theirs.P.items():
        state = divmod(index, size)
        if env.is_terminal(state):
            continue
        for action, expected in by_action.items():
            assert len(expected) == env.outcomes
            for outcome, (probability, place, reward, ended) in enumerate(expected):
                following = env.next_state(state, action, outcome)
                assert abs(env.probability(state, action, outcome) - probability) < 1e-16  # they have (1 - 1 / 3) / 2
                assert following[0] * size + following[1] == place
                assert env.reward(state, action, following) == reward
                assert env.is_terminal(following) == ended
    theirs.close()


@pytest.mark.parametrize(("size", "expected"), [(4, 0.8235294117647058), (8, 1.0)])
def test_slippery_frozen_lake_is_solved_as_quantecon_solves_it(size, expected, tmp_path, quantecon):
    """From Gymnasium's P, by QuantEcon's policy iteration; without discount the 4x4 lake is worth 14/17."""
    table, rewards, _ = gymnasium_law(size, slippery=True)
    space = pharos.build(pharos.make("frozen_lake", size=size, slippery=True), tmp_path / "space", progress=False)
    mdp = space.mdp(gamma=0.99)
    theirs = quantecon.markov.DiscreteDP((table * rewards).sum(axis=2), table, 0.99).solve(method="policy_iteration")
    solution = pharos.value_iteration(mdp, 1e-9)
    cells = [row * size + column for row, column in space.states()]
    np.testing.assert_allclose(solution.v, theirs.v[cells], rtol=0, atol=solution.error_bound + 1e-12)
    if size == 4:
        assert abs(solution.value_at_start - 0.5420) < 5e-5
    reached = pharos.value_iteration(space.mdp(gamma=1.0).with_horizon(20_000))
    assert abs(reached.value_at_start - expected) < 1e-6


@pytest.mark.parametrize("size", [4, 8])
def test_slippery_ice_is_four_thirds_of_uniform_minus_a_third_of_the_opposite_action(size):
    """The formula of random_actions(p) with p = 4/3 and the opposite action: a law, but no mixture for any p in [0,
    1].
    """
    table, _, ends = our_law(pharos.make("frozen_lake", size=size))
    opposite = table[:, [2, 3, 0, 1]]
    uniform = table.mean(axis=1, keepdims=True)
    slippery, _, _ = gymnasium_law(size, slippery=True)
    np.testing.assert_allclose((4 / 3 * uniform - opposite / 3)[~ends], slippery[~ends], atol=1e-12)


@pytest.mark.parametrize("p", [0.0, 0.3, 1.0])
def test_under_the_uniform_policy_slippery_ice_and_random_actions_are_the_same(p):
    table, _, ends = our_law(pharos.make("frozen_lake"))
    slippery, _, _ = gymnasium_law(4, slippery=True)
    randomized = (1 - p) * table + p * table.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(randomized.mean(axis=1)[~ends], slippery.mean(axis=1)[~ends], atol=1e-12)


def test_no_random_actions_come_nearer_to_slippery_ice_than_a_sixth():
    table, _, ends = our_law(pharos.make("frozen_lake"))
    slippery, _, _ = gymnasium_law(4, slippery=True)
    uniform = table.mean(axis=1, keepdims=True)
    shares = np.linspace(0, 1, 301)
    distances = [abs(((1 - p) * table + p * uniform - slippery)[~ends]).max() for p in shares]
    assert min(distances) == pytest.approx(1 / 6)
    assert shares[int(np.argmin(distances))] == pytest.approx(2 / 3)


def test_random_maps_are_solvable_reproducible_and_differ():
    maps, again = (
        [pharos.make("frozen_lake", size=6, seed=seed, frozen_probability=0.6).tiles for seed in range(20)]
        for _ in range(2)
    )
    assert all((a == b).all() for a, b in zip(maps, again, strict=True))
    assert len({tiles.tobytes() for tiles in maps}) > 15
    for tiles in maps:  # "S" to "G" by label propagation, another way than the environment's own search
        reached = tiles == 1
        for _ in range(36):
            grown = np.pad(reached, 1)
            grown = grown[:-2, 1:-1] | grown[2:, 1:-1] | grown[1:-1, :-2] | grown[1:-1, 2:] | reached
            reached = grown & (tiles != 2)
        assert reached[tiles == 3].all()


def test_a_random_map_is_the_same_on_every_machine():
    tiles = pharos.make("frozen_lake", size=5, seed=1, frozen_probability=0.7).tiles
    assert "/".join("".join("FSHG"[tile] for tile in row) for row in tiles) == "SFFFH/FFFHF/HFFFF/FHFFH/FFHFG"


# Freeway and Breakout: what their docstrings promise ----------------------------------------------------------------


def test_freeway_moves_the_player_only_at_every_speed_th_step():
    env = pharos.make("freeway", num_cars=4, lane_length=9, player_speed=3, car_speeds=50)
    state, rows = env.initial_state(), []
    for _ in range(7):
        state = env.next_state(state, 1)
        rows.append(state[0])
    assert rows == [4, 4, 4, 3, 3, 3, 2]


@pytest.mark.parametrize(("restart", "row"), [(True, 4), (False, 4), (False, 3)])
def test_freeway_hit_sends_the_player_back(restart, row):
    env = pharos.make("freeway", num_cars=3, lane_length=5, car_speeds=1, directions=1, restart_on_hit=restart)
    lane = row - 1  # the player goes up from `row` into this lane, where the car arrives in the middle column
    cars = [0, 0, 0]
    cars[lane - 1] = env.column - 1
    state = (row, 0, *cars, 0, 0, 0)
    following = env.next_state(state, 1)
    assert following[0] == (env.start_row if restart else row)
    assert env.reward(state, 1, following) == -1.0


@pytest.mark.long
def test_freeway_clock_counts_the_states():
    """All cars together are a clock with lane_length * lcm(periods) phases; rows and hits do the rest."""
    env = pharos.make("freeway", num_cars=3, lane_length=4, car_speeds="1,2,3")
    report = pharos.check_environment(env)
    assert report.complete
    assert report.num_states <= 4 * 6 * (3 + 2)
    states = naive_builder.build(env).states
    assert len({state[2:] for state in states}) == 4 * 6
    assert len(states) == report.num_states


@pytest.mark.parametrize("extra", [0, 1])
def test_breakout_lets_the_player_choose_the_way_of_the_ball(extra):
    """Wherever the paddle can reach both cells, the ball goes up onwards or back, as the player likes."""
    env = pharos.make("breakout", height=10, columns=9, extra_paddle_width=extra)
    bricks = [1] * env.num_bricks
    ways = set()
    for left_end in range(env.columns - env.paddle_width + 1):
        state = (env.height - 2, 4, 1, 1, left_end, *bricks)
        following = env.next_state(state, 1)
        if not env.is_terminal(following):
            ways.add((following[1], following[2], following[3]))
    assert ways == {(5, 1, 0), (3, 0, 0)}


@pytest.mark.parametrize(("height", "columns"), [(7, 4), (8, 4), (8, 5), (9, 5), (10, 4)])
def test_breakout_can_break_every_brick(height, columns):
    env = pharos.make("breakout", height=height, columns=columns, brick_rows=2)
    seen = naive_builder.build(env).states
    assert min(sum(state[5:]) for state in seen) == 0
    assert not any(row in (1, 2) and bricks[(row - 1) * columns + column] for row, column, _, _, _, *bricks in seen)


def test_breakout_without_respawn_ends_with_the_last_brick():
    env = pharos.make("breakout", height=6, columns=3, brick_rows=1, respawn=False)
    last = (2, 0, 1, 0, 1, 0, 1, 0)  # the ball below and left of the only brick, going up to the right
    following = env.next_state(last, 1)
    assert env.reward(last, 1, following) == 1.0
    assert env.is_terminal(following)
    back = pharos.make("breakout", height=6, columns=3, brick_rows=1)
    assert not back.is_terminal(back.next_state(last, 1))


def test_a_terminal_breakout_state_stays_as_it_is():
    env = pharos.make("breakout", height=6, columns=3, brick_rows=1)
    lost = (5, 0, 1, 1, 1, 1, 1, 1)
    assert env.is_terminal(lost)
    assert env.next_state(lost, 0) == lost
    assert env.reward(lost, 0, lost) == 0.0


# Names and parameters -----------------------------------------------------------------------------------------------


def test_every_row_block_of_the_papers_tables_has_a_name():
    blocks = {
        "simple_grid": 6,
        "frozen_lake": 2,
        "freeway": 10 + 1,  # and a small one for examples
        "breakout": 10 + 5 + 3,  # five more are drawn in appendix B; ours: 0.9 and 1.1 billion states, and a small one
    }
    names = list(named_instances())
    assert {name: sum(n.startswith(name + "/") for n in names) for name in blocks} == blocks
    for cars, length in ((16, 7), (20, 5), (20, 11), (25, 9), (25, 13)):
        for speed in (1, 2):
            env = pharos.make(f"freeway/{cars}x{length}-speed{speed}")
            assert (env.num_cars, env.lane_length, env.player_speed) == (cars, length, speed)
    for name in names:
        if name.startswith("breakout/"):
            env = pharos.make(name)
            size = f"breakout/{env.height}x{env.columns}x{env.paddle_width}"
            assert name == (size if env.brick_rows == 2 else f"{size}-{env.brick_rows}rows")


@pytest.mark.parametrize("name", ALL)
def test_parameters_survive_json(name):
    env = pharos.make(name)
    again = pharos.make(env.name, **json.loads(json.dumps(env.parameters)))
    assert again == env
    assert hash(again) == hash(env)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPILED)
def test_every_environment_keeps_the_contract(name):
    report = pharos.check_environment(pharos.make(name), max_states=120)
    assert report.compiled
    assert report.complete or not (name.split("/")[0] in GRIDS or name in SMALL)
    assert not any("another name" in note for note in report.notes)


def test_text_forms_are_the_same_as_python_forms():
    text = pharos.make("simple_grid", goal="2,3", rewards="2,2:0.1; 0,3:0.5", penalties="1,1:-1")
    python = pharos.make(
        "simple_grid", goal=(2, 3), rewards=(((2, 2), 0.1), ((0, 3), 0.5)), penalties=(((1, 1), -1.0),)
    )
    assert text == python
    assert pharos.make("freeway", car_speeds="1,2", directions="-1").car_directions.tolist() == [-1] * 16
    assert pharos.make("frozen_lake", map="sf fg") == pharos.make("frozen_lake", map="SF/FG")


def test_a_misspelled_name_gets_a_suggestion():
    assert "breakout" in refusal(UnknownName, pharos.make, "brekout")
    assert "columns" in refusal(UnknownName, pharos.make, "breakout", colums=3)


def test_a_registered_class_is_made_by_name_and_built_in_names_are_kept(monkeypatch):
    class Registered(type(pharos.make("simple_grid"))):
        name = "my_grid"

    monkeypatch.setattr(catalog, "_REGISTERED", {})
    assert register(Registered) is Registered
    assert type(pharos.make("my_grid", height=3)) is Registered
    assert "my_grid" in pharos.list_environments()
    for wrong in (int, Environment, type(pharos.make("breakout"))):
        assert "register" in refusal(ParameterError, register, wrong)


MINE = """
from dataclasses import dataclass
from pharos.environments import SimpleGrid

@dataclass(frozen=True, kw_only=True)
class Mine(SimpleGrid):
    name = "mine"
"""


@pytest.mark.parametrize("written", ["my_rules:Mine", "my_rules.py:Mine", "{folder}/my_rules.py:Mine"])
def test_a_class_of_ones_own_file_is_made_by_its_path(tmp_path, monkeypatch, written):
    (tmp_path / "my_rules.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(catalog, "_REGISTERED", {})
    path = list(sys.path)
    env = pharos.make(written.format(folder=tmp_path), height=3)
    assert (env.name, env.height) == ("mine", 3)
    assert pharos.make("mine", height=3) == env
    assert sys.path == path
    sys.modules.pop("my_rules", None)


@pytest.mark.parametrize("path", ["no_such_module:Mine", "no_such.py:Mine", "my_rules.py:Yours", "json:loads", ":Mine"])
def test_a_path_that_leads_to_no_class_is_refused(tmp_path, monkeypatch, path):
    (tmp_path / "my_rules.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    refusal(ParameterError, pharos.make, path)


def test_built_in_classes_have_a_path_too():
    assert pharos.make("pharos.environments:Breakout") == pharos.make("breakout")


def test_listing_environments_loads_nothing_heavy():
    heavy = "{'numba', 'scipy', 'pandas', 'matplotlib', 'torch'}"
    code = f"import sys, pharos; pharos.list_environments(); pharos.make('freeway'); print({heavy} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "set()"


# Drawings and golden games ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_drawings_fill_the_declared_grid(name):
    env = pharos.make(name)
    rows, columns = env.grid()
    lines = text_drawing(env, env.initial_states()[0][0]).splitlines()
    assert len(lines) == rows
    assert {len(line) for line in lines} == {columns}


def test_later_layers_cover_earlier_ones():
    env = pharos.make("simple_grid", height=2, width=2)
    assert text_drawing(env, (0, 0)) == "A.\n.G"
    assert text_drawing(env, (1, 1)) == "..\n.A"


@pytest.mark.parametrize("game", golden_games.GAMES)
def test_golden_game_is_played_as_it_was_read(game):
    assert golden_games.played(game) == golden_games.file_of(game).read_text()


def test_every_class_has_pictures():
    page = (Path(__file__).parents[2] / "docs" / "worlds.md").read_text().partition("## Pictures\n")[2]
    rows = re.findall(r"^\| \*\*(\w+)\*\* ", page, re.MULTILINE)
    missing = [each.name for each in BUILT_IN if each.name not in rows]
    assert not missing, f"docs/worlds.md has no pictures of them: run python scripts/gallery.py {' '.join(missing)}"
    assert sorted(rows) == sorted(each.name for each in BUILT_IN)
