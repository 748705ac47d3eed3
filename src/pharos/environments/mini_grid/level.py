"""A layout of MiniGrid as numbers: what its text says of cells, doors, things and the player; checked."""

import re
from dataclasses import dataclass

import numpy as np

from pharos.environments.mini_grid.canvas import COLORS, FLOOR, GOAL, LAVA, PLAYER, WALL, Layout
from pharos.errors import ParameterError

OPEN, CLOSED, LOCKED = range(3)  # doors
KEY, BALL, BOX = range(3)  # things
FREE, WON, LOST, BLOCKED, DOOR = range(5)  # cells; DOOR + i has door number i
DOOR_LETTERS, THING_LETTERS = "ODL", "KAB"
CELLS = {FLOOR: FREE, WALL: BLOCKED, GOAL: WON, LAVA: LOST}


@dataclass(frozen=True)
class Level:
    """Attributes:
    start: (row, column, direction) of the player.
    cells: (rows, columns) int64: FREE, WON, LOST, BLOCKED, or DOOR + the number of a door.
    door_conditions, door_colors: of each door at the start; numbers of `COLORS`.
    things: (n, 4) int64: row, column, KEY, BALL or BOX, and colour of each.
    target_door, target_thing: what pays; -1: none.
    """

    start: tuple[int, int, int]
    cells: np.ndarray
    door_conditions: np.ndarray
    door_colors: np.ndarray
    things: np.ndarray
    target_door: int
    target_thing: int


def level_of(layout: Layout) -> Level:
    """The numbers of a layout; ParameterError where its text is none, or the player can walk out of the grid."""
    rows = [re.findall("..", row) for row in layout.rows]
    cells = np.full((len(rows), len(rows[0])), FREE, np.int64)
    starts: list[tuple[int, int, int]] = []
    doors: list[str] = []
    things: list[tuple[int, int, int, int, str]] = []
    for row, texts in enumerate(rows):
        for column, text in enumerate(texts):
            if text in CELLS:
                cells[row, column] = CELLS[text]
            elif text in PLAYER:
                starts.append((row, column, PLAYER.index(text)))
            elif text[0] in DOOR_LETTERS and text[1] in COLORS:
                cells[row, column] = DOOR + len(doors)
                doors.append(text)
            elif text[0] in THING_LETTERS and text[1] in COLORS:
                things.append((row, column, THING_LETTERS.index(text[0]), COLORS.index(text[1]), text))
            else:
                raise ParameterError(
                    f"MiniGrid: level has {text!r} at row {row}, column {column}; expected .. ## GG ~~ >> vv << ^^, or "
                    f"one of {' '.join(DOOR_LETTERS + THING_LETTERS)} and one of {' '.join(COLORS)}"
                )
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
        door_colors=np.array([COLORS.index(text[1]) for text in doors], np.int64),
        things=np.array([numbers[:4] for numbers in things], np.int64).reshape(-1, 4),
        target_door=door,
        target_thing=thing,
    )


def rows_of(text: object) -> tuple[str, ...]:
    """The rows of a level as text, in capitals but for the player; ParameterError where they are of unequal length."""
    rows = tuple(text.upper().replace("VV", "vv").replace("/", " ").split()) if isinstance(text, str) else ()
    if not rows or len(set(map(len, rows))) > 1 or len(rows[0]) % 2 or len(rows[0]) < 6 or len(rows) < 3:
        raise ParameterError(
            f'MiniGrid: level={text!r}; expected at least 3 rows, separated by "/", of equally many cells, at least 3, '
            f"of two characters each"
        )
    return rows


def _target(target: str | None, doors: list[str], things: list[str]) -> tuple[int, int]:
    """(door, thing) that is the target; -1: none."""
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
    """ParameterError where the player can come to the border of the grid, through doors of any condition."""
    region, frontier = {start}, [start]
    while frontier:
        row, column = frontier.pop()
        if not (0 < row < len(cells) - 1 and 0 < column < cells.shape[1] - 1):
            raise ParameterError(f"MiniGrid: level has a way out at row {row}, column {column}; close it with ##")
        for cell in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if cell not in region and cells[cell] != BLOCKED:
                region.add(cell)
                frontier.append(cell)
