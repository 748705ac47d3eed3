"""MiniGrid: rooms with doors and keys, boxes, lava and a goal, for a player who turns and walks.

Source: Chevalier-Boisvert et al. (2023), "Minigrid & Miniworld", and the package minigrid 3.2.0.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np

from pharos.environments.base import Environment, one_of, parameter, store
from pharos.environments.mini_grid.layouts import COLOR_LETTERS, FLOOR, GOAL, KINDS, LAVA, PLAYER, WALL, GridLayout
from pharos.environments.mini_grid.look import LAYERS, LOOK
from pharos.errors import ParameterError

OPEN, CLOSED, LOCKED = range(3)  # doors
KEY, BALL, BOX = range(3)  # things
FREE, WON, LOST, BLOCKED, DOOR = range(5)  # cells; DOOR + i has door number i
DOOR_LETTERS, THING_LETTERS = "ODL", "KAB"
CELL_KINDS = {FLOOR: FREE, WALL: BLOCKED, GOAL: WON, LAVA: LOST}


@dataclass(frozen=True)
class Level:
    """A layout as numbers: cells, doors, things and the player, parsed from its text and checked.

    Attributes:
        start: (row, column, direction) of the player.
        cells: (rows, columns) int64: FREE, WON, LOST, BLOCKED, or DOOR + the number of a door.
        door_conditions, door_colors: of each door at the start, as numbers of `COLOR_LETTERS`.
        things: (n, 4) int64: row, column, KEY, BALL or BOX, and colour of each.
        target_door, target_thing: what pays, -1 for none.
    """

    start: tuple[int, int, int]
    cells: np.ndarray
    door_conditions: np.ndarray
    door_colors: np.ndarray
    things: np.ndarray
    target_door: int
    target_thing: int


def level_of(layout: GridLayout) -> Level:
    """The numbers of a layout. ParameterError if its text is none, or if the player can walk out of the grid."""
    rows = [re.findall("..", row) for row in layout.rows]
    cells = np.full((len(rows), len(rows[0])), FREE, np.int64)
    starts: list[tuple[int, int, int]] = []
    doors: list[str] = []
    things: list[tuple[int, int, int, int, str]] = []
    # Cells, player, doors and things, by their two letters
    for row, texts in enumerate(rows):
        for column, text in enumerate(texts):
            if text in CELL_KINDS:
                cells[row, column] = CELL_KINDS[text]
            elif text in PLAYER:
                starts.append((row, column, PLAYER.index(text)))
            elif text[0] in DOOR_LETTERS and text[1] in COLOR_LETTERS:
                cells[row, column] = DOOR + len(doors)
                doors.append(text)
            elif text[0] in THING_LETTERS and text[1] in COLOR_LETTERS:
                things.append((row, column, THING_LETTERS.index(text[0]), COLOR_LETTERS.index(text[1]), text))
            else:
                raise ParameterError(
                    f"MiniGrid: level has {text!r} at row {row}, column {column}; expected .. ## GG ~~ >> vv << ^^, or "
                    f"one of {' '.join(DOOR_LETTERS + THING_LETTERS)} and one of {' '.join(COLOR_LETTERS)}"
                )
    # One player, a goal or target, and no way out of the grid
    if len(starts) != 1:
        raise ParameterError(f"MiniGrid: level has {len(starts)} players; expected one of {' '.join(PLAYER)}")
    door, thing = _target(layout.target, doors, [text for *_, text in things])
    if door < 0 and thing < 0 and not (cells == WON).any():
        raise ParameterError("MiniGrid: level has neither a goal GG nor a target; expected one of them")
    _check_walls(cells, starts[0][:2])
    return Level(
        start=starts[0],
        cells=cells,
        door_conditions=np.array([DOOR_LETTERS.index(text[0]) for text in doors], np.int64),
        door_colors=np.array([COLOR_LETTERS.index(text[1]) for text in doors], np.int64),
        things=np.array([numbers[:4] for numbers in things], np.int64).reshape(-1, 4),
        target_door=door,
        target_thing=thing,
    )


def layout_rows(text: object) -> tuple[str, ...]:
    """The rows of a level as text, in capitals except the player. ParameterError if their lengths differ."""
    rows = tuple(text.upper().replace("VV", "vv").replace("/", " ").split()) if isinstance(text, str) else ()
    if not rows or len(set(map(len, rows))) > 1 or len(rows[0]) % 2 or len(rows[0]) < 6 or len(rows) < 3:
        raise ParameterError(
            f'MiniGrid: level={text!r}; expected at least 3 rows, separated by "/", of equally many cells, at least 3, '
            f"of two characters each"
        )
    return rows


def _target(target: str | None, doors: list[str], things: list[str]) -> tuple[int, int]:
    """(door, thing): number of the target, -1 for none."""
    if target is None:
        return -1, -1
    matches = [(i, -1) for i, text in enumerate(doors) if text == target and text[0] != "O"]
    matches += [(-1, i) for i, text in enumerate(things) if text == target]
    if len(matches) != 1:
        names = sorted({*things, *(text for text in doors if text[0] != "O")})
        raise ParameterError(
            f"MiniGrid: target={target!r} is {len(matches)} of the closed doors and things of the level; "
            f"expected one of {', '.join(names) or 'none'} that is there once"
        )
    return matches[0]


def _check_walls(cells: np.ndarray, start: tuple[int, int]) -> None:
    """ParameterError if the player can come to the border of the grid, through doors of any condition."""
    region, frontier = {start}, [start]
    while frontier:
        row, column = frontier.pop()
        if not (0 < row < len(cells) - 1 and 0 < column < cells.shape[1] - 1):
            raise ParameterError(f"MiniGrid: level has a way out at row {row}, column {column}; close it with ##")
        for cell in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if cell not in region and cells[cell] != BLOCKED:
                region.add(cell)
                frontier.append(cell)


ROW, COLUMN, DIRECTION, DOORS = range(4)  # the condition of each door, then row and column of each thing
LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE = range(6)
LOOKS_RIGHT, LOOKS_DOWN, LOOKS_LEFT, LOOKS_UP = range(4)
CARRIED = 0  # the column in row 0 of what is carried; boxes that were opened are in the last: nobody sees the corners

INSTANCES: dict[str, dict[str, Any]] = {
    **{f"empty-{n}x{n}": {"kind": "empty", "size": n} for n in (5, 6, 8, 16)},
    **{f"empty-random-{n}x{n}": {"kind": "empty_random", "size": n} for n in (5, 6)},
    "four-rooms": {"kind": "four_rooms"},
    **{f"door-key-{n}x{n}": {"kind": "door_key", "size": n} for n in (5, 6, 8, 16)},
    "unlock": {"kind": "unlock"},
    "unlock-pickup": {"kind": "unlock_pickup"},
    **{
        f"key-corridor-s{n}r{rows}": {"kind": "key_corridor", "size": n, "rows": rows}
        for n, rows in ((3, 1), (3, 2), (3, 3), (4, 3), (5, 3), (6, 3))
    },
    **{f"lava-gap-s{n}": {"kind": "lava_gap", "size": n} for n in (5, 6, 7)},
    **{
        f"{what}-crossing-s{n}n{crossings}": {"kind": f"{what}_crossing", "size": n, "crossings": crossings}
        for what in ("lava", "simple")
        for n, crossings in ((9, 1), (9, 2), (9, 3), (11, 5))
    },
    **{
        f"multi-room-n{rooms}-s{n}": {"kind": "multi_room", "size": n, "rooms": rooms}
        for n, rooms in ((4, 2), (5, 4), (5, 6), (10, 6))
    },
    **{f"dist-shift{i}": {"kind": "dist_shift", "strip": strip} for i, strip in ((1, 2), (2, 5))},
}


@dataclass(frozen=True, kw_only=True)
class MiniGrid(Environment):
    """Walk through rooms to the goal, or to what has to be opened or picked up.

    Rules    As in the package minigrid. The player turns by a quarter, or steps forward onto floor, a goal, lava or an
             open door. It picks up what lies before it, one thing at a time, and drops it onto floor. To toggle opens
             and closes a door, unlocks and opens a locked one with a key of its colour in hand, and opens a box, which
             is empty and vanishes.
    State    (row, column, direction, condition of each door, row and column of each thing). Directions are right,
             down, left, up. Doors are open, closed or locked. A thing at (0, 0) is carried, and a box in
             the other corner of row 0 is gone.
    Actions  left, right, forward, pickup, drop, toggle, numbered as in minigrid. Its seventh, done, does nothing.
    Reward   1 on reaching a goal, opening the door or picking up the thing that is the target, otherwise 0. Minigrid
             pays 1 - 0.9 t / max_steps at step t, which is not of a state: a discount says it better. So do
             `importers.minigrid` and BRIDGE.
    Ends     with that reward, or in lava.
    Limit    the max_steps of minigrid.
    Ours     The layouts equal minigrid 3.2.0 for the same seed, and are drawn without it. Other sizes and other levels
             are possible.
    Source   Chevalier-Boisvert et al. (2023).

    Attributes:
        kind: of the layout: empty, empty_random (start anywhere), four_rooms, door_key, unlock, unlock_pickup,
            key_corridor, lava_gap, lava_crossing, simple_crossing, multi_room, dist_shift. None stands for empty.
        size: cells on a side, walls included: of the grid, of a room (unlock, unlock_pickup, key_corridor), or of the
            largest room (multi_room, on 25 x 25 cells). The grid of dist_shift is size - 2 high. None: the
            size in minigrid.
        seed: of the layout, as for minigrid's `reset`. None stands for 0.
        rows: of rooms, in key_corridor. None stands for 3.
        rooms: how many, in multi_room. None stands for 6.
        crossings: obstacles to cross, in lava_crossing and simple_crossing. None stands for 1.
        strip: the row of the second strip of lava, in dist_shift. None stands for 2.
        level: a layout of one's own, in place of the above: two characters a cell (see layouts.py), rows
            separated by "/" or line ends, with walls around.
        target: of a level: what to pick up, such as "BR" for the red box, or which door to open, such as "LY"; None:
            only goals.
    """

    kind: str | None = parameter(None, kind=one_of(*KINDS))
    size: int | None = parameter(None, kind=int, low=3, high=100)
    seed: int | None = parameter(None, kind=int, low=0)
    rows: int | None = parameter(None, kind=int)
    rooms: int | None = parameter(None, kind=int)
    crossings: int | None = parameter(None, kind=int)
    strip: int | None = parameter(None, kind=int)
    level: str | None = None
    target: str | None = None

    name = "mini_grid"
    actions = ("left", "right", "forward", "pickup", "drop", "toggle")
    version = 1
    layers = LAYERS
    look = LOOK
    instances = INSTANCES
    hyperparameters = {  # chosen by hand: goals are far, and most actions do nothing
        "q_learning": {"default": {"gamma": 0.97}},
        "dqn": {
            "default": {
                "gamma": 0.97,
                "learning_rate": 0.001,
                "target_update_interval": 1000,
                "exploration_fraction": 0.5,
                "exploration_final_eps": 0.05,
            }
        },
        "ppo": {"default": {"gamma": 0.97, "n_steps": 128, "batch_size": 256, "ent_coef": 0.02}},
    }

    def validate(self) -> None:
        options = {name: getattr(self, name) for name in ("size", "seed", "rows", "rooms", "crossings", "strip")}
        if self.level is not None:
            others = [name for name, value in {"kind": self.kind, **options}.items() if value is not None]
            if others:
                raise ParameterError(f"MiniGrid: level was given with {', '.join(others)}; expected a level alone")
            store(self, "level", "/".join(layout_rows(self.level)))
            store(self, "target", None if self.target is None else str(self.target).upper())
        else:
            if self.target is not None:
                raise ParameterError(f"MiniGrid: target={self.target!r} goes with level=...; a kind has its own")
            store(self, "kind", self.kind or "empty")
            for name, value in options.items():
                store(self, name, self._completed(name, value))
        _ = self.parsed

    def _completed(self, name: str, value: int | None) -> int | None:
        """The default of the kind in place of None. ParameterError if the kind takes other values, or none."""
        declared = KINDS[str(self.kind)].parameters
        if name not in declared:
            if value is None:
                return None
            raise ParameterError(
                f"MiniGrid: {name}={value} has no effect with kind={self.kind!r}; it takes {', '.join(declared)}"
            )
        bounds = declared[name]
        value = bounds.default if value is None else value
        high = bounds.high(self.size or 0) if bounds.high else None
        if value < bounds.low or (high is not None and value > high) or (bounds.odd and value % 2 == 0):
            words = f"{'an odd' if bounds.odd else 'an'} integer of at least {bounds.low}"
            raise ParameterError(
                f"MiniGrid: {name}={value}; expected {words}{'' if high is None else f' and at most {high}'} "
                f"with kind={self.kind!r}"
            )
        return value

    # The layout, as text and as numbers -------------------------------------------------------------------------------

    @cached_property
    def layout(self) -> GridLayout:
        """The grid as text, as `level` takes it, and the target."""
        if self.level is not None:
            return GridLayout(layout_rows(self.level), self.target)
        recipe = KINDS[str(self.kind)]
        return recipe.draw(**{name: getattr(self, name) for name in recipe.parameters})

    @cached_property
    def parsed(self) -> Level:
        """The grid as numbers."""
        return level_of(self.layout)

    cells = property(attrgetter("parsed.cells"))  # these five as in `Level`
    door_colors = property(attrgetter("parsed.door_colors"))
    things = property(attrgetter("parsed.things"))
    target_door = property(attrgetter("parsed.target_door"))
    target_thing = property(attrgetter("parsed.target_thing"))

    @property
    def width(self) -> int:
        """Columns of the grid."""
        return self.cells.shape[1]

    @property
    def num_doors(self) -> int:
        """Doors of the layout."""
        return len(self.door_colors)

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        if self.level is not None:
            return 4 * self.cells.size
        return KINDS[str(self.kind)].max_steps(self.size or 0, self.rooms or 0)

    def __str__(self) -> str:
        arguments = ", ".join(f"{name}={value!r}" for name, value in self.parameters.items() if value is not None)
        return f"MiniGrid({arguments})"

    # The rules --------------------------------------------------------------------------------------------------------

    def variables(self):
        height, width = self.cells.shape
        declared: dict[str, Any] = {"row": range(1, height - 1), "column": range(1, width - 1), "direction": range(4)}
        if self.num_doors:
            declared["doors"] = [range(3 if condition == LOCKED else 2) for condition in self.parsed.door_conditions]
        if len(self.things):
            declared["things"] = [[range(height - 1), range(width)] for _ in self.things]
        return declared

    def initial_state(self):
        return (*self.parsed.start, *self.parsed.door_conditions.tolist(), *self.things[:, :2].ravel().tolist())

    def transition(self, state, action, out):
        direction = state[DIRECTION]
        if action == LEFT:
            out[DIRECTION] = (direction + 3) % 4
            return
        if action == RIGHT:
            out[DIRECTION] = (direction + 1) % 4
            return
        row = state[ROW] + (direction == LOOKS_DOWN) - (direction == LOOKS_UP)  # the cell ahead
        column = state[COLUMN] + (direction == LOOKS_RIGHT) - (direction == LOOKS_LEFT)
        cell = self.cells[row, column]
        first, count = DOORS + self.num_doors, len(self.things)
        ahead = thing_at(state, first, count, row, column)
        carried = thing_at(state, first, count, 0, CARRIED)
        if action == FORWARD:
            is_way = cell < BLOCKED or (cell >= DOOR and state[DOORS + cell - DOOR] == OPEN)
            if ahead < 0 and is_way:
                out[ROW] = row
                out[COLUMN] = column
        elif action == PICKUP:
            if ahead >= 0 and carried < 0:
                out[first + 2 * ahead] = 0
                out[first + 2 * ahead + 1] = CARRIED
        elif action == DROP:
            if ahead < 0 and carried >= 0 and cell == FREE:
                out[first + 2 * carried] = row
                out[first + 2 * carried + 1] = column
        elif cell >= DOOR:
            door = cell - DOOR
            if state[DOORS + door] != LOCKED:
                out[DOORS + door] = CLOSED if state[DOORS + door] == OPEN else OPEN
            elif carried >= 0 and is_key(self.things[carried], self.door_colors[door]):
                out[DOORS + door] = OPEN
        elif ahead >= 0 and self.things[ahead, 2] == BOX:
            out[first + 2 * ahead] = 0
            out[first + 2 * ahead + 1] = self.width - 1

    def is_terminal(self, state):
        return self.cells[state[ROW], state[COLUMN]] == LOST or is_won(
            self.cells, self.num_doors, self.target_door, self.target_thing, state
        )

    def reward(self, state, action, next_state):
        return float(is_won(self.cells, self.num_doors, self.target_door, self.target_thing, next_state))

    def grid(self):
        return self.cells.shape

    def draw(self, state, planes):
        height, width = self.cells.shape
        for row in range(height):
            for column in range(width):
                cell = self.cells[row, column]
                if WON <= cell < DOOR:
                    planes[cell - WON, row, column] = 1
                elif cell >= DOOR:
                    planes[3, row, column] = 1 + 3 * self.door_colors[cell - DOOR] + state[DOORS + cell - DOOR]
        for i in range(len(self.things)):
            row, column = state[DOORS + self.num_doors + 2 * i], state[DOORS + self.num_doors + 2 * i + 1]
            if row == 0 and column == CARRIED:  # seen in the player's cell
                row, column = state[ROW], state[COLUMN]
            if row > 0:
                planes[4, row, column] = 1 + 3 * self.things[i, 3] + self.things[i, 2]
        planes[5, state[ROW], state[COLUMN]] = 1 + state[DIRECTION]


def thing_at(state, first, count, row, column):
    """The thing that is there; -1: none."""
    for i in range(count):
        if state[first + 2 * i] == row and state[first + 2 * i + 1] == column:
            return i
    return -1


def is_key(thing, color):
    return thing[2] == KEY and thing[3] == color


def is_won(cells, num_doors, target_door, target_thing, state):
    if cells[state[ROW], state[COLUMN]] == WON:
        return True
    if target_door >= 0 and state[DOORS + target_door] == OPEN:
        return True
    place = DOORS + num_doors + 2 * target_thing
    return target_thing >= 0 and state[place] == 0 and state[place + 1] == CARRIED
