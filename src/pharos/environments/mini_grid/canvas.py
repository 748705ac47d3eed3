"""A grid of MiniGrid while it is being drawn: floor, walls, rooms, doors, things and the player.

Cells are text, two characters each: ".." floor, "##" wall, "GG" goal, "~~" lava, a door (D closed, L locked, O open), a
key K, a ball A or a box B with the first letter of its colour behind it (E is grey), and the player, ">>", "vv", "<<"
or "^^" by where it looks. A cell is named (column, row) here.

Numbers are drawn from NumPy's PCG64, as Gymnasium seeds it, in the order in which minigrid 3.2.0 asks for them.
"""

import math
from typing import NamedTuple

import numpy as np

from pharos.errors import ParameterError

FLOOR, WALL, GOAL, LAVA = "..", "##", "GG", "~~"
PLAYER = (">>", "vv", "<<", "^^")
COLORS = "BGEPRY"  # blue, green, grey, purple, red, yellow: the order in which minigrid draws them
RIGHT, DOWN, LEFT, UP = range(4)
AHEAD = ((1, 0), (0, 1), (-1, 0), (0, -1))
ATTEMPTS = 1000  # at a free cell of a room; minigrid gives up after as many
CONNECTIONS = 5000  # likewise, at doors that connect all rooms

Place = tuple[int, int]


class Layout(NamedTuple):
    """A grid, row by row, and what is to be picked up or opened in it, such as "BR"; None: only goals are."""

    rows: tuple[str, ...]
    target: str | None = None


class Canvas:
    """A grid that is being drawn, and where the player stands; made of floor alone."""

    def __init__(self, width: int, height: int, seed: int | None = None):
        self.rng = np.random.Generator(np.random.PCG64(seed))
        self.width, self.height = width, height
        self.cells = np.full((width, height), FLOOR)
        self.player: Place = (-1, -1)
        self.direction = RIGHT

    def integer(self, low: int, high: int) -> int:
        """One of low, ..., high - 1."""
        return int(self.rng.integers(low, high))

    def color(self) -> str:
        """One of the six colours."""
        return COLORS[self.integer(0, len(COLORS))]

    def walls_around(self, left: int, top: int, width: int, height: int) -> None:
        """The outline of a rectangle."""
        right, bottom = left + width - 1, top + height - 1
        self.cells[left : right + 1, [top, bottom]] = WALL
        self.cells[[left, right], top : bottom + 1] = WALL

    def free_cell(self, corner: Place, size: Place, *, away: bool = False, attempts: float = math.inf) -> Place:
        """A cell of floor in a rectangle without the player; with `away` none beside the player either."""
        left, top = corner
        right, bottom = min(left + size[0], self.width), min(top + size[1], self.height)
        tried = 0
        while tried <= attempts:
            tried += 1
            column, row = self.integer(left, right), self.integer(top, bottom)
            distance = abs(column - self.player[0]) + abs(row - self.player[1])
            if self.cells[column, row] == FLOOR and distance >= (2 if away else 1):
                return column, row
        raise ParameterError(f"MiniGrid: this seed finds no free cell in {ATTEMPTS} attempts; choose another seed")

    def put_player(self, corner: Place = (0, 0), size: Place | None = None, attempts: float = math.inf) -> None:
        """The player onto a free cell, looking anywhere."""
        self.player = (-1, -1)
        self.player = self.free_cell(corner, size or (self.width, self.height), attempts=attempts)
        self.direction = self.integer(0, 4)

    def layout(self, target: str | None = None) -> Layout:
        """What was drawn, with the player in it."""
        self.cells[self.player] = PLAYER[self.direction]
        return Layout(tuple("".join(row) for row in self.cells.T), target)


class Rooms(Canvas):
    """Rooms of `size` x `size` cells, walls included and shared; places for doors are drawn, but no doors yet."""

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
        """The same side, seen from the neighbouring room."""
        return column + AHEAD[side][0], row + AHEAD[side][1], (side + 2) % 4

    def add_door(self, column: int, row: int, side: int, *, locked: bool = False) -> str:
        """A door of a random colour; its colour."""
        color = self.color()
        self.cells[self.doorways[column, row, side]] = ("L" if locked else "D") + color
        self.doors |= {(column, row, side), self.across(column, row, side)}
        if locked:
            self.locked.add((column, row))
        return color

    def add_thing(self, column: int, row: int, letter: str, color: str | None = None) -> str:
        """A key K, a ball A or a box B somewhere in a room; with its colour, which is drawn unless given."""
        thing = letter + (color or self.color())
        size = (self.size, self.size)
        self.cells[self.free_cell(self.corner(column, row), size, away=True, attempts=ATTEMPTS)] = thing
        return thing

    def remove_wall(self, column: int, row: int, side: int) -> None:
        """Join a room with the one above or below it."""
        left, top = self.corner(column, row)
        self.cells[left + 1 : left + self.size - 1, top if side == UP else top + self.size - 1] = FLOOR
        self.doors |= {(column, row, side), self.across(column, row, side)}

    def put_player_into(self, column: int, row: int) -> None:
        """The player into a room, with floor or a wall before it."""
        while True:
            self.put_player(self.corner(column, row), (self.size, self.size), attempts=ATTEMPTS)
            ahead = AHEAD[self.direction]
            if self.cells[self.player[0] + ahead[0], self.player[1] + ahead[1]] in (FLOOR, WALL):
                return

    def connect(self) -> None:
        """Doors between rooms, until every room can be reached; locked rooms get no further ones."""
        start = (self.player[0] // (self.size - 1), self.player[1] // (self.size - 1))
        for _ in range(CONNECTIONS + 1):
            if len(self._reached(start)) == self.rows * self.columns:
                return
            column, row, side = self.integer(0, self.columns), self.integer(0, self.rows), self.integer(0, 4)
            neighbour = self.across(column, row, side)[:2]
            free = (column, row, side) in self.doorways and (column, row, side) not in self.doors
            if free and not {(column, row), neighbour} & self.locked:
                self.add_door(column, row, side)
        raise ParameterError("MiniGrid: this seed connects the rooms in no way; choose another seed")

    def _reached(self, start: Place) -> set[Place]:
        reached, frontier = {start}, [start]
        while frontier:
            room = frontier.pop()
            for side in range(4):
                if (*room, side) in self.doors:
                    neighbour = self.across(*room, side)[:2]
                    if neighbour not in reached:
                        reached.add(neighbour)
                        frontier.append(neighbour)
        return reached
