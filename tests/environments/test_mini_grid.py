"""MiniGrid against the package minigrid, side by side: layouts by seed, states, rewards and ends of walks, and all
states that `importers.minigrid` finds."""

import warnings

import gymnasium
import minigrid  # noqa: F401  (registers its environments)
import numpy as np
import pytest
from hypothesis import strategies as st
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Ball, Box, Door, Goal, Key, Lava, Wall
from minigrid.minigrid_env import MiniGridEnv

import pharos
from naive import builder as naive_builder
from pharos import importers
from pharos.drawing import planes_of
from pharos.errors import ParameterError
from strategies import examples

pytestmark = pytest.mark.long  # with each class compiled and walked through in full

# Named instance -> what minigrid calls it
IDS = {
    **{f"empty-{n}x{n}": f"Empty-{n}x{n}-v0" for n in (5, 6, 8, 16)},
    **{f"empty-random-{n}x{n}": f"Empty-Random-{n}x{n}-v0" for n in (5, 6)},
    "four-rooms": "FourRooms-v0",
    **{f"door-key-{n}x{n}": f"DoorKey-{n}x{n}-v0" for n in (5, 6, 8, 16)},
    "unlock": "Unlock-v0",
    "unlock-pickup": "UnlockPickup-v0",
    **{f"key-corridor-s3r{r}": f"KeyCorridorS3R{r}-v0" for r in (1, 2)},
    **{f"key-corridor-s{n}r3": f"KeyCorridorS{n}R3-v0" for n in (3, 4, 5, 6)},
    **{f"lava-gap-s{n}": f"LavaGapS{n}-v0" for n in (5, 6, 7)},
    **{f"lava-crossing-{size}": f"LavaCrossing{size.upper()}-v0" for size in ("s9n1", "s9n2", "s9n3", "s11n5")},
    **{f"simple-crossing-{size}": f"SimpleCrossing{size.upper()}-v0" for size in ("s9n1", "s9n2", "s9n3", "s11n5")},
    "multi-room-n2-s4": "MultiRoom-N2-S4-v0",
    "multi-room-n4-s5": "MultiRoom-N4-S5-v1",
    "multi-room-n6-s5": "MultiRoom-N4-S5-v0",  # so misnamed there
    "multi-room-n6-s10": "MultiRoom-N6-v0",
    "dist-shift1": "DistShift1-v0",
    "dist-shift2": "DistShift2-v0",
}
ONE_OF_EACH_KIND = {
    *("empty-5x5", "empty-random-6x6", "four-rooms", "door-key-6x6", "unlock", "unlock-pickup", "key-corridor-s3r2"),
    *("lava-gap-s6", "lava-crossing-s9n2", "simple-crossing-s9n3", "multi-room-n4-s5", "dist-shift2"),
}
ALL = [pytest.param(name, marks=() if name in ONE_OF_EACH_KIND else pytest.mark.slow) for name in IDS]
DRAWN = [name for name in IDS if not name.startswith(("empty-5", "empty-6", "empty-8", "empty-16", "dist"))]
LETTER = {"blue": "B", "green": "G", "grey": "E", "purple": "P", "red": "R", "yellow": "Y"}
COLOR = {letter: color for color, letter in LETTER.items()}


def package(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # there is a newer MultiRoom-N4-S5, with other rooms
        env = gymnasium.make(f"MiniGrid-{IDS[name]}", disable_env_checker=True).unwrapped
    env.gen_obs = dict  # partial views take most of a step, and nothing here looks at them
    return env


def ours(name, seed):
    return pharos.make(f"mini_grid/{name}", **({"seed": seed} if name in DRAWN else {}))


def text_of(thing):
    """A cell of minigrid in the letters of our layouts."""
    if thing is None:
        return ".."
    if thing.type in ("wall", "goal", "lava"):
        return {"wall": "##", "goal": "GG", "lava": "~~"}[thing.type]
    if thing.type == "door":
        return ("O" if thing.is_open else "L" if thing.is_locked else "D") + LETTER[thing.color]
    return {"key": "K", "ball": "A", "box": "B"}[thing.type] + LETTER[thing.color]


def rows_of(env):
    """The grid of minigrid with its player, as text."""
    cells = np.array([text_of(thing) for thing in env.grid.grid]).reshape(env.height, env.width)
    column, row = env.agent_pos
    assert cells[row, column] in ("..", "GG", "~~") or cells[row, column][0] == "O"
    cells[row, column] = (">>", "vv", "<<", "^^")[env.agent_dir]
    return tuple("".join(row) for row in cells)


def state_of(env, objects):
    """The state of minigrid as our vector of integers; `objects` are its doors and its things, each in our order."""
    doors, things = objects
    state = [int(env.agent_pos[1]), int(env.agent_pos[0]), env.agent_dir]
    state += [0 if door.is_open else 2 if door.is_locked else 1 for door in doors]
    for thing in things:
        column, row = (int(part) for part in thing.cur_pos)
        is_there = column >= 0 and env.grid.get(column, row) is thing
        state += (0, 0) if thing is env.carrying else (row, column) if is_there else (0, env.width - 1)
    return tuple(state)


def objects_of(env):
    doors = [thing for thing in env.grid.grid if thing is not None and thing.type == "door"]
    return doors, [thing for thing in env.grid.grid if thing is not None and thing.type in ("key", "ball", "box")]


def assert_plays_like(env, twin, actions, seed):
    """Both agree on every state, reward and end of one episode from a reset; the number of its steps."""
    twin.reset(seed=seed)
    objects = objects_of(twin)
    state = tuple(env.initial_state())
    assert state == state_of(twin, objects)
    for t, action in enumerate(actions, start=1):
        following = env.next_state(state, int(action))
        _, reward, terminated, truncated, _ = twin.step(int(action))
        assert following == state_of(twin, objects), (state, action)
        assert env.reward(state, int(action), following) * (1 - 0.9 * (t / env.max_episode_steps)) == reward
        assert bool(env.is_terminal(following)) == terminated, (state, action)
        assert truncated == (t >= env.max_episode_steps)
        state = following
        if terminated or truncated:
            break
    return t


def walk(name, steps, longest):
    """Random steps, a new seed and so a new layout for every episode."""
    twin, rng, seed = package(name), np.random.default_rng(0), 0
    while steps > 0:
        actions = rng.choice(6, size=min(steps, longest), p=[0.15, 0.15, 0.35, 0.15, 0.05, 0.15])
        steps -= assert_plays_like(ours(name, seed), twin, actions, seed)
        seed += 1


def test_every_instance_has_its_counterpart():
    assert list(pharos.environments.MiniGrid.instances) == list(IDS)


@pytest.mark.parametrize("name", ALL)
def test_a_seed_means_the_layout_of_minigrid(name):
    env = package(name)
    for seed in range(25 if name in DRAWN else 1):
        env.reset(seed=seed)
        assert ours(name, seed).layout.rows == rows_of(env), seed
        assert ours(name, seed).max_episode_steps == env.max_steps


@pytest.mark.parametrize("name", ALL)
def test_random_walks_are_those_of_minigrid(name):
    walk(name, 2_000, 200)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(ONE_OF_EACH_KIND))
def test_long_random_walks_are_those_of_minigrid(name):
    walk(name, 100_000, 2_000)


def assert_same_states(env, mdp):
    """A bijection of our states that do not end the episode and those of `mdp` keeps successors, rewards and ends."""
    start = tuple(env.initial_state())
    numbers, queue = {start: 0}, [start]
    for state in queue:
        for action in range(env.num_actions):
            following = env.next_state(state, action)
            expected = int(mdp.next_states[numbers[state], action])
            assert env.reward(state, action, following) == mdp.rewards[numbers[state], action]
            assert bool(env.is_terminal(following)) == (expected < 0)
            if expected >= 0 and following not in numbers:
                numbers[following] = expected
                queue.append(following)
            assert expected < 0 or numbers[following] == expected
    assert len(numbers) == len(set(numbers.values())) == mdp.num_states


# States that do not end the episode, of seed 3. Those of `unlock-pickup`, 17,164, and of `key-corridor-s3r2`, 4,688,
# were compared once: they take three minutes.
COUNTS = {"empty-5x5": 32, "lava-gap-s5": 16, "key-corridor-s3r1": 156, "empty-random-6x6": 60, "dist-shift1": 112}
COUNTS |= {"door-key-5x5": 260, "simple-crossing-s9n3": 112, "lava-crossing-s9n2": 128, "multi-room-n2-s4": 60}
COUNTS |= {"unlock": 1024}


@pytest.mark.parametrize("name", COUNTS)
def test_the_states_are_those_that_the_importer_finds(name):
    mdp = importers.minigrid(f"MiniGrid-{IDS[name]}", seed=3)
    assert mdp.num_states == COUNTS[name]
    assert_same_states(ours(name, 3), mdp)


# Other sizes, and levels of one's own -------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [5, 8, 11])
def test_four_rooms_of_other_sizes_are_those_that_minigrid_would_draw(size):
    env = package("four-rooms")
    env.width = env.height = size
    for seed in range(10):
        env.reset(seed=seed)
        assert pharos.make("mini_grid", kind="four_rooms", size=size, seed=seed).layout.rows == rows_of(env)


class Own(MiniGridEnv):
    """A level of text in the package, with its rules for a door to be opened or a thing to be picked up."""

    def __init__(self, rows, target):
        size = {"width": len(rows[0]) // 2, "height": len(rows), "max_steps": 2 * len(rows) * len(rows[0])}
        super().__init__(mission_space=MissionSpace(mission_func=lambda: ""), **size)
        self.rows, self.target, self.gen_obs = rows, target, dict

    def _gen_grid(self, width, height):
        self.grid, self.wanted = Grid(width, height), None
        for row, column in np.ndindex(height, width):
            text = self.rows[row][2 * column : 2 * column + 2]
            if text in (">>", "vv", "<<", "^^"):
                self.agent_pos, self.agent_dir = (column, row), (">>", "vv", "<<", "^^").index(text)
            elif (thing := made(text)) is not None:
                self.put_obj(thing, column, row)
                self.wanted = thing if text == self.target else self.wanted

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        picked = action == self.actions.pickup and self.wanted is not None and self.carrying is self.wanted
        if picked or (action == self.actions.toggle and isinstance(self.wanted, Door) and self.wanted.is_open):
            reward, terminated = self._reward(), True
        return observation, reward, terminated, truncated, info


def made(text):
    if text[0] in "ODL":
        return Door(COLOR[text[1]], is_open=text[0] == "O", is_locked=text[0] == "L")
    if text[0] in "KAB":
        return {"K": Key, "A": Ball, "B": Box}[text[0]](COLOR[text[1]])
    return {"..": lambda: None, "##": Wall, "GG": Goal, "~~": Lava}[text]()


@st.composite
def levels(draw):
    """Five by four cells of anything, and a target where there is a thing or a door once."""
    cell = st.sampled_from(["..", "..", "..", "##", "~~", "OR", "DB", "LR", "LB", "KR", "KB", "AR", "BB", "BR"])
    cells = draw(st.lists(cell, min_size=20, max_size=20))
    cells[draw(st.integers(0, 19))] = "GG"
    cells[draw(st.integers(0, 19))] = draw(st.sampled_from([">>", "vv", "<<", "^^"]))
    once = [text for text in cells if text[0] in "DLKAB" and cells.count(text) == 1]
    target = draw(st.sampled_from([None, *once]))
    rows = ["".join(["##", *cells[5 * i : 5 * i + 5], "##"]) for i in range(4)]
    return ["##" * 7, *rows, "##" * 7], target if "GG" in cells or target else "GG"


@examples(150, levels(), st.lists(st.sampled_from([0, 1, 2, 2, 3, 3, 4, 5, 5]), min_size=1, max_size=80))
def test_levels_of_ones_own_are_played_as_by_minigrid(level, actions):
    rows, target = level
    if target == "GG":
        with pytest.raises(ParameterError, match="neither a goal GG nor a target"):
            pharos.make("mini_grid", level="/".join(rows))
        return
    env = pharos.make("mini_grid", level="/".join(rows), target=target)
    assert_plays_like(env, Own(rows, target), actions, seed=0)


def test_a_level_may_be_written_on_lines_and_in_small_letters():
    text = """
        ##########
        ##>>ky..##
        ##..drgg##
        ##########
    """
    env = pharos.make("mini_grid", level=text)
    assert env.level == "##########/##>>KY..##/##..DRGG##/##########"
    assert env == pharos.make("mini_grid", level=env.level)
    assert env.initial_state() == (1, 1, 0, 1, 1, 2)


def test_a_layout_is_the_same_on_every_machine():
    assert pharos.make("mini_grid/door-key-5x5").layout.rows == FIRST_DOOR_KEY
    assert pharos.make("mini_grid/unlock-pickup").layout == (FIRST_UNLOCK_PICKUP, "BP")


FIRST_DOOR_KEY = ("##########", "##..LY..##", "##KY##..##", "##<<##GG##", "##########")
FIRST_UNLOCK_PICKUP = (
    "######################",
    "##........##....BP..##",
    "##........##........##",
    "##....^^KG##........##",
    "##........LG........##",
    "######################",
)


# What an agent sees -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["door-key-5x5", "key-corridor-s3r1"])
def test_no_two_states_look_alike(name):
    """What is carried is seen in the player's cell, and a box that was opened is not."""
    env = pharos.make(f"mini_grid/{name}")
    states = naive_builder.build(env).states
    assert len({planes_of(env, state).tobytes() for state in states}) == len(states)


def played(env, words):
    state = env.initial_state()
    for word in words.split():
        state = env.next_state(state, env.actions.index(word))
    return state


def test_the_player_carries_one_thing_and_opens_with_its_colour_only():
    env = pharos.make("mini_grid", level="############/##KR>>KYLY##/##..GG....##/############")
    assert played(env, "pickup left left pickup")[4:] == (1, 1, 0, 0)  # the red key stays where it is
    assert played(env, "pickup forward toggle forward") == (1, 4, 0, 0, 1, 1, 0, 0)
    env = pharos.make("mini_grid", level="##########/##KR>>LY##/##GG....##/##########")
    assert played(env, "left left pickup left left toggle forward") == (1, 2, 0, 2, 0, 0)


# Parameters ---------------------------------------------------------------------------------------------------------


def test_defaults_are_those_of_minigrid():
    assert pharos.make("mini_grid") == pharos.make("mini_grid", kind="empty", size=8)
    assert str(pharos.make("mini_grid", kind="key_corridor")) == "MiniGrid(kind='key_corridor', size=6, seed=0, rows=3)"
