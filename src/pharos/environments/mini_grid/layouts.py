"""Layouts of MiniGrid: for each kind, the grid that the package minigrid draws for a seed, drawn again without it.

Cells are text, two characters each: ".." floor, "##" wall, "GG" goal, "~~" lava, a door (D closed, L locked, O open), a
key K, a ball A or a box B with the first letter of its colour behind it (E is grey), and the player, ">>", "vv", "<<"
or "^^" by where it looks. A cell is named (column, row) here.

Numbers are drawn from NumPy's PCG64, as Gymnasium seeds it, in the order in which minigrid 3.2.0 asks for them, so a
seed means the same layout here and there, which tests/environments/test_mini_grid.py compares.

Source: Chevalier-Boisvert et al. (2023), "Minigrid & Miniworld", and the behaviour of the package.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pharos.errors import ParameterError

FLOOR, WALL, GOAL, LAVA = "..", "##", "GG", "~~"
PLAYER = (">>", "vv", "<<", "^^")
COLOR_LETTERS = "BGEPRY"  # blue, green, grey, purple, red, yellow: the order in which minigrid draws them
RIGHT, DOWN, LEFT, UP = range(4)
AHEAD = ((1, 0), (0, 1), (-1, 0), (0, -1))
FREE_CELL_ATTEMPTS = 1000  # at a free cell of a room; minigrid gives up after as many
CONNECTIONS = 5000  # likewise, at doors that connect all rooms

Place = tuple[int, int]


class GridLayout(NamedTuple):
    """A grid, row by row, and the target: a thing to pick up or a door to open, such as "BR", or None for goals
    only."""

    rows: tuple[str, ...]
    target: str | None = None


class Canvas:
    """A grid under construction, at first all floor, with the position of the player."""

    def __init__(self, width: int, height: int, seed: int | None = None):
        self.rng = np.random.Generator(np.random.PCG64(seed))
        self.width, self.height = width, height
        self.cells = np.full((width, height), FLOOR)
        self.player: Place = (-1, -1)
        self.direction = RIGHT

    def integer(self, low: int, high: int) -> int:
        """Random integer in low, ..., high - 1."""
        return int(self.rng.integers(low, high))

    def color(self) -> str:
        """Random one of the six colours."""
        return COLOR_LETTERS[self.integer(0, len(COLOR_LETTERS))]

    def walls_around(self, left: int, top: int, width: int, height: int) -> None:
        """Draw walls along the outline of a rectangle."""
        right, bottom = left + width - 1, top + height - 1
        self.cells[left : right + 1, [top, bottom]] = WALL
        self.cells[[left, right], top : bottom + 1] = WALL

    def free_cell(self, corner: Place, size: Place, *, away: bool = False, attempts: float = math.inf) -> Place:
        """Random cell of floor in a rectangle without the player. With `away`, not beside the player either."""
        left, top = corner
        right, bottom = min(left + size[0], self.width), min(top + size[1], self.height)
        tried = 0
        while tried <= attempts:
            tried += 1
            column, row = self.integer(left, right), self.integer(top, bottom)
            distance = abs(column - self.player[0]) + abs(row - self.player[1])
            if self.cells[column, row] == FLOOR and distance >= (2 if away else 1):
                return column, row
        raise ParameterError(
            f"MiniGrid: this seed finds no free cell in {FREE_CELL_ATTEMPTS} attempts; choose another seed"
        )

    def put_player(self, corner: Place = (0, 0), size: Place | None = None, attempts: float = math.inf) -> None:
        """Put the player onto a random free cell, with a random direction."""
        self.player = (-1, -1)
        self.player = self.free_cell(corner, size or (self.width, self.height), attempts=attempts)
        self.direction = self.integer(0, 4)

    def layout(self, target: str | None = None) -> GridLayout:
        """The drawn grid, with the player in it."""
        self.cells[self.player] = PLAYER[self.direction]
        return GridLayout(tuple("".join(row) for row in self.cells.T), target)


class Rooms(Canvas):
    """Rooms of `size` x `size` cells, walls included and shared. Places for doors are drawn, but no doors yet."""

    def __init__(self, columns: int, rows: int, size: int, seed: int | None):
        pitch = size - 1
        super().__init__(columns * pitch + 1, rows * pitch + 1, seed)
        self.columns, self.rows, self.size = columns, rows, size
        self.doorways: dict[tuple[int, int, int], Place] = {}  # (column, row, side) of a room -> cell
        self.doors: set[tuple[int, int, int]] = set()
        self.locked: set[Place] = set()  # rooms
        for row in range(rows):
            for column in range(columns):
                self.walls_around(*self.corner(column, row), size, size)
        for row in range(rows):
            for column in range(columns):
                left, top = self.corner(column, row)
                if column < columns - 1:
                    self._doorway(column, row, RIGHT, (left + pitch, self.integer(top + 1, top + pitch)))
                if row < rows - 1:
                    self._doorway(column, row, DOWN, (self.integer(left + 1, left + pitch), top + pitch))
        self.player = (columns // 2 * pitch + size // 2, rows // 2 * pitch + size // 2)

    def _doorway(self, column: int, row: int, side: int, cell: Place) -> None:
        self.doorways[column, row, side] = self.doorways[self.across(column, row, side)] = cell

    def corner(self, column: int, row: int) -> Place:
        """The top-left cell of a room."""
        return column * (self.size - 1), row * (self.size - 1)

    def across(self, column: int, row: int, side: int) -> tuple[int, int, int]:
        """The shared side, as the neighbouring room and its side."""
        return column + AHEAD[side][0], row + AHEAD[side][1], (side + 2) % 4

    def add_door(self, column: int, row: int, side: int, *, locked: bool = False) -> str:
        """Add a door of a random colour, and return the colour."""
        color = self.color()
        self.cells[self.doorways[column, row, side]] = ("L" if locked else "D") + color
        self.doors |= {(column, row, side), self.across(column, row, side)}
        if locked:
            self.locked.add((column, row))
        return color

    def add_thing(self, column: int, row: int, letter: str, color: str | None = None) -> str:
        """Put a key K, ball A or box B on a random cell of a room. Return it with its colour, drawn if none is
        passed."""
        thing = letter + (color or self.color())
        size = (self.size, self.size)
        self.cells[self.free_cell(self.corner(column, row), size, away=True, attempts=FREE_CELL_ATTEMPTS)] = thing
        return thing

    def remove_wall(self, column: int, row: int, side: int) -> None:
        """Join a room with the one above or below it."""
        left, top = self.corner(column, row)
        self.cells[left + 1 : left + self.size - 1, top if side == UP else top + self.size - 1] = FLOOR
        self.doors |= {(column, row, side), self.across(column, row, side)}

    def put_player_into(self, column: int, row: int) -> None:
        """Put the player into a room, with floor or a wall in front."""
        while True:
            self.put_player(self.corner(column, row), (self.size, self.size), attempts=FREE_CELL_ATTEMPTS)
            ahead = AHEAD[self.direction]
            if self.cells[self.player[0] + ahead[0], self.player[1] + ahead[1]] in (FLOOR, WALL):
                return

    def connect(self) -> None:
        """Add doors between rooms until every room is reachable. Locked rooms get no further doors."""
        start = (self.player[0] // (self.size - 1), self.player[1] // (self.size - 1))
        for _ in range(CONNECTIONS + 1):
            if len(self._reachable(start)) == self.rows * self.columns:
                return
            column, row, side = self.integer(0, self.columns), self.integer(0, self.rows), self.integer(0, 4)
            neighbour = self.across(column, row, side)[:2]
            free = (column, row, side) in self.doorways and (column, row, side) not in self.doors
            if free and not {(column, row), neighbour} & self.locked:
                self.add_door(column, row, side)
        raise ParameterError("MiniGrid: this seed connects the rooms in no way; choose another seed")

    def _reachable(self, start: Place) -> set[Place]:
        reachable, frontier = {start}, [start]
        while frontier:
            room = frontier.pop()
            for side in range(4):
                if (*room, side) in self.doors:
                    neighbour = self.across(*room, side)[:2]
                    if neighbour not in reachable:
                        reachable.add(neighbour)
                        frontier.append(neighbour)
        return reachable


# The kinds ------------------------------------------------------------------------------------------------------------


def _walled(width: int, height: int, seed: int | None) -> Canvas:
    """An empty room with the player in its top-left corner and the goal in the opposite one."""
    canvas = Canvas(width, height, seed)
    canvas.walls_around(0, 0, width, height)
    canvas.cells[width - 2, height - 2] = GOAL
    canvas.player = (1, 1)
    return canvas


def empty(size: int) -> GridLayout:
    return _walled(size, size, None).layout()


def empty_random(size: int, seed: int) -> GridLayout:
    canvas = _walled(size, size, seed)
    canvas.put_player()
    return canvas.layout()


def dist_shift(size: int, strip: int) -> GridLayout:
    canvas = _walled(size, size - 2, None)
    canvas.cells[size - 2, size - 4], canvas.cells[size - 2, 1] = FLOOR, GOAL
    canvas.cells[3 : size - 3, [1, strip]] = LAVA
    return canvas.layout()


def four_rooms(size: int, seed: int) -> GridLayout:
    canvas = Canvas(size, size, seed)
    canvas.walls_around(0, 0, size, size)
    middle = size // 2
    canvas.cells[middle, : 2 * middle] = canvas.cells[: 2 * middle, middle] = WALL
    gaps = (
        (middle, canvas.integer(1, middle)),
        (canvas.integer(1, middle), middle),
        (canvas.integer(middle + 1, 2 * middle), middle),
        (middle, canvas.integer(middle + 1, 2 * middle)),
    )
    for gap in gaps:
        canvas.cells[gap] = FLOOR
    canvas.put_player()
    canvas.cells[canvas.free_cell((0, 0), (size, size))] = GOAL
    return canvas.layout()


def door_key(size: int, seed: int) -> GridLayout:
    canvas = _walled(size, size, seed)
    wall = canvas.integer(2, size - 2)
    canvas.cells[wall, :] = WALL
    canvas.put_player((0, 0), (wall, size))
    canvas.cells[wall, canvas.integer(1, size - 2)] = "LY"
    canvas.cells[canvas.free_cell((0, 0), (wall, size))] = "KY"
    return canvas.layout()


def lava_gap(size: int, seed: int) -> GridLayout:
    canvas = _walled(size, size, seed)
    column, row = canvas.integer(2, size - 2), canvas.integer(1, size - 1)
    canvas.cells[column, 1 : size - 1] = LAVA
    canvas.cells[column, row] = FLOOR
    return canvas.layout()


def crossing(size: int, crossings: int, seed: int, obstacle: str) -> GridLayout:
    """Straight obstacles across the room, and one opening in each, along a path that crosses them in random order."""
    canvas = _walled(size, size, seed)
    lines = [(side, line) for side in (RIGHT, DOWN) for line in range(2, size - 2, 2)]
    canvas.rng.shuffle(lines)  # type: ignore[arg-type]
    columns = sorted(line for side, line in lines[:crossings] if side == RIGHT)
    rows = sorted(line for side, line in lines[:crossings] if side == DOWN)
    canvas.cells[1:-1, rows] = obstacle
    canvas.cells[columns, 1:-1] = obstacle
    path = [RIGHT] * len(columns) + [DOWN] * len(rows)
    canvas.rng.shuffle(path)
    columns, rows = [0, *columns, size - 1], [0, *rows, size - 1]
    i, j = 0, 0
    for side in path:
        if side == RIGHT:
            opening = columns[i + 1], int(canvas.rng.choice(range(rows[j] + 1, rows[j + 1])))
            i += 1
        else:
            opening = int(canvas.rng.choice(range(columns[i] + 1, columns[i + 1]))), rows[j + 1]
            j += 1
        canvas.cells[opening] = FLOOR
    return canvas.layout()


def lava_crossing(size: int, crossings: int, seed: int) -> GridLayout:
    return crossing(size, crossings, seed, LAVA)


def simple_crossing(size: int, crossings: int, seed: int) -> GridLayout:
    return crossing(size, crossings, seed, WALL)


def unlock(size: int, seed: int) -> GridLayout:
    canvas = Rooms(2, 1, size, seed)
    color = canvas.add_door(0, 0, RIGHT, locked=True)
    canvas.add_thing(0, 0, "K", color)
    canvas.put_player_into(0, 0)
    return canvas.layout("L" + color)


def unlock_pickup(size: int, seed: int) -> GridLayout:
    canvas = Rooms(2, 1, size, seed)
    box = canvas.add_thing(1, 0, "B")
    canvas.add_thing(0, 0, "K", canvas.add_door(0, 0, RIGHT, locked=True))
    canvas.put_player_into(0, 0)
    return canvas.layout(box)


def key_corridor(size: int, rows: int, seed: int) -> GridLayout:
    canvas = Rooms(3, rows, size, seed)
    for row in range(1, rows):
        canvas.remove_wall(1, row, UP)
    row = canvas.integer(0, rows)
    color = canvas.add_door(2, row, LEFT, locked=True)
    ball = canvas.add_thing(2, row, "A")
    canvas.add_thing(0, canvas.integer(0, rows), "K", color)
    canvas.put_player_into(1, rows // 2)
    canvas.connect()
    return canvas.layout(ball)


# A chain of rooms of random sizes -------------------------------------------------------------------------------------

SMALLEST_ROOM, TRIES, CHAINS = 4, 8, 5_000
MULTI_ROOM_SIDE = 25


class Room(NamedTuple):
    """A rectangle, walls included, and where one comes in."""

    left: int
    top: int
    width: int
    height: int
    side: int
    entry: Place


def multi_room(size: int, rooms: int, seed: int) -> GridLayout:
    side = MULTI_ROOM_SIDE
    canvas = Canvas(side, side, seed)
    canvas.integer(rooms, rooms + 1)  # how many
    chain: list[Room] = []
    for _ in range(CHAINS):
        drawn = _chain(canvas, size, rooms)
        chain = drawn if len(drawn) > len(chain) else chain
        if len(chain) == rooms:
            break
    else:
        raise ParameterError(
            f"MiniGrid: none of {CHAINS} chains of rooms={rooms} fits into {side} x {side} cells; "
            f"lower rooms or size, or choose another seed"
        )
    before = ""
    for number, room in enumerate(chain):
        canvas.walls_around(*room[:4])
        if number > 0:
            colors = COLOR_LETTERS.replace(before, "") if before else COLOR_LETTERS
            before = colors[canvas.integer(0, len(colors))]
            canvas.cells[room.entry] = "D" + before
    canvas.put_player(chain[0][:2], chain[0][2:4])
    canvas.cells[canvas.free_cell(chain[-1][:2], chain[-1][2:4])] = GOAL
    return canvas.layout()


def _chain(canvas: Canvas, size: int, rooms: int) -> list[Room]:
    """A chain of rooms, as many as fit, at most `rooms`, each entered from the one before."""
    entry = (canvas.integer(0, canvas.width - 2), canvas.integer(0, canvas.width - 2))
    first = _room(canvas, size, LEFT, entry, is_first=True)
    chain = [first] if _fits(canvas, first, []) else []
    tries = TRIES if chain else 0
    while tries > 0 and len(chain) < rooms:
        tries -= 1
        side, entry = _exit(canvas, chain[-1])
        room = _room(canvas, size, (side + 2) % 4, entry)
        if _fits(canvas, room, chain[:-1]):
            chain.append(room)
            tries = TRIES
    return chain


def _exit(canvas: Canvas, room: Room) -> tuple[int, Place]:
    """A side of a room other than the side with its entry, and a cell there."""
    sides = [side for side in range(4) if side != room.side]
    side = sides[canvas.integer(0, 3)]
    if side in (RIGHT, LEFT):
        column = room.left + (room.width - 1 if side == RIGHT else 0)
        return side, (column, room.top + canvas.integer(1, room.height - 1))
    row = room.top + (room.height - 1 if side == DOWN else 0)
    return side, (room.left + canvas.integer(1, room.width - 1), row)


def _room(canvas: Canvas, size: int, side: int, entry: Place, *, is_first: bool = False) -> Room:
    """A room of random size with its entry on a side. The first has it in its corner."""
    width, height = canvas.integer(SMALLEST_ROOM, size + 1), canvas.integer(SMALLEST_ROOM, size + 1)
    left, top = entry
    if not is_first:
        if side in (RIGHT, LEFT):
            left = entry[0] - width + 1 if side == RIGHT else entry[0]
            top = canvas.integer(entry[1] - height + 2, entry[1])
        else:
            left = canvas.integer(entry[0] - width + 2, entry[0])
            top = entry[1] - height + 1 if side == DOWN else entry[1]
    return Room(left, top, width, height, side, entry)


def _fits(canvas: Canvas, room: Room, others: list[Room]) -> bool:
    if min(room.left, room.top) < 0 or room.left + room.width > canvas.width or room.top + room.height >= canvas.height:
        return False
    return all(
        room.left + room.width < other.left
        or other.left + other.width <= room.left
        or room.top + room.height < other.top
        or other.top + other.height <= room.top
        for other in others
    )


class Range(NamedTuple):
    """Range of a parameter: default, lowest and highest value (a function of the size), and whether it must be odd."""

    default: int
    low: int
    high: Callable[[int], int] | None = None
    odd: bool = False


class Recipe(NamedTuple):
    """A kind of layouts.

    Attributes:
        draw: function of the parameters below, by name, that returns the layout.
        parameters: name -> what it may be, with "seed" if something is drawn.
        max_steps: the time limit of minigrid, by size and number of rooms.
    """

    draw: Callable[..., GridLayout]
    parameters: dict[str, Range]
    max_steps: Callable[[int, int], int]


def _recipe(draw: Callable[..., GridLayout], max_steps: Callable[[int, int], int], **parameters: Range) -> Recipe:
    return Recipe(draw, {**parameters, "seed": Range(0, 0)}, max_steps)


_CROSSINGS = {"size": Range(9, 5, odd=True), "crossings": Range(1, 0, lambda size: size - 3)}
KINDS = {
    "empty": Recipe(empty, {"size": Range(8, 4)}, lambda size, _: 4 * size**2),
    "empty_random": _recipe(empty_random, lambda size, _: 4 * size**2, size=Range(6, 4)),
    "four_rooms": _recipe(four_rooms, lambda size, _: 100, size=Range(19, 5)),
    "door_key": _recipe(door_key, lambda size, _: 10 * size**2, size=Range(8, 5)),
    "unlock": _recipe(unlock, lambda size, _: 8 * size**2, size=Range(6, 4)),
    "unlock_pickup": _recipe(unlock_pickup, lambda size, _: 8 * size**2, size=Range(6, 4)),
    "key_corridor": _recipe(key_corridor, lambda size, _: 30 * size**2, size=Range(6, 3), rows=Range(3, 1)),
    "lava_gap": _recipe(lava_gap, lambda size, _: 4 * size**2, size=Range(7, 5)),
    "lava_crossing": _recipe(lava_crossing, lambda size, _: 4 * size**2, **_CROSSINGS),
    "simple_crossing": _recipe(simple_crossing, lambda size, _: 4 * size**2, **_CROSSINGS),
    "multi_room": _recipe(multi_room, lambda _, rooms: 20 * rooms, size=Range(10, 4), rooms=Range(6, 1)),
    "dist_shift": Recipe(
        dist_shift,
        {"size": Range(9, 7), "strip": Range(2, 2, lambda size: size - 4)},
        lambda size, _: 4 * size * (size - 2),
    ),
}
