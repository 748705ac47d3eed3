"""Sliding tiles: the 8-puzzle, the 15-puzzle and their kin. Source: Korf and Schultze (2005)."""

import colorsys
from dataclasses import dataclass

import numpy as np

from pharos.environments.base import Color, Environment, Layer, Look, integers, parameter, store
from pharos.errors import ParameterError

UP, RIGHT, DOWN, LEFT = range(4)
BLANK = 0

NUMBERS = "123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def _color(i: int) -> Color:
    red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb(i * 0.381966 % 1, 0.5, 0.8))
    return red, green, blue


NUMBER_COLORS = tuple(map(_color, range(len(NUMBERS))))  # neighbours in the solved order differ in hue


@dataclass(frozen=True, kw_only=True)
class SlidingTiles(Environment):
    """Slide the numbered tiles of a tray of `rows` x `columns` cells until they lie in order.

    Rules    One cell is empty. An action moves this blank by one cell. The tile that lay there slides into its place.
             Against the edge of the tray nothing moves.
    State    the tile in each cell, row by row, 0 for the blank.
    Start    the tiles from the last to the first, then the blank. If this cannot be solved, with the tiles 1 and 2
             exchanged. Or another position (`start`), or one drawn by `seed`.
    Actions  up, right, down, left: the way of the blank.
    Reward   -1 a step, so that the undiscounted optimal return is minus the least number of moves.
    Ends     when the tiles lie in order, the blank in the last cell.
    Limit    20 steps a cell.
    Ours     start and limit.
    Source   Korf and Schultze (2005), "Large-scale parallel breadth-first search", AAAI.

    Half of the permutations are within reach of each other, (rows * columns)! / 2 states. The solved one, which ends
    the episode, cuts none of them off: its two neighbours are joined without it, by ten moves of the blank round the
    last 2 x 2 cells.

    Attributes:
        rows, columns: of the tray, at least 2, and at most 36 cells together.
        start: the tiles row by row, 0 for the blank. They must be solvable, and not solved. As text:
            "8,6,7,2,5,4,3,0,1".
        seed: draws the start, each solvable position but the solved one with the same probability.
    """

    rows: int = parameter(3, low=2)
    columns: int = parameter(3, low=2)
    start: tuple[int, ...] = parameter(None, kind=integers("a tile, or 0 for the blank", lambda tile: tile >= 0))
    seed: int | None = parameter(None, kind=int, low=0)

    name = "sliding_tiles"
    actions = ("up", "right", "down", "left")
    version = 1
    layers = {"tiles": Layer(tuple(NUMBERS), NUMBER_COLORS, shape="lettered")}

    look = Look(color="#8C564B")
    instances = {
        **{f"{rows}x{columns}": {"rows": rows, "columns": columns} for rows, columns in ((2, 2), (2, 3), (3, 3))},
        "3x3-hardest": {"start": (8, 6, 7, 2, 5, 4, 3, 0, 1)},
        **{f"{rows}x{columns}": {"rows": rows, "columns": columns} for rows, columns in ((2, 4), (2, 5), (3, 4))},
    }
    hyperparameters = {  # chosen by hand
        "q_learning": {"default": {"initial_q": 0.0}},
        "dqn": {"default": {"buffer_size": 100000, "target_update_interval": 1000, "exploration_final_eps": 0.02}},
    }

    @property
    def cells(self) -> int:
        """Cells of the tray."""
        return self.rows * self.columns

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return 20 * self.cells

    def validate(self) -> None:
        if self.cells > len(NUMBERS) + 1:
            raise ParameterError(
                f"SlidingTiles: rows={self.rows}, columns={self.columns} are {self.cells} cells; "
                f"expected at most {len(NUMBERS) + 1}"
            )
        if self.start is None:
            return
        if self.seed is not None:
            raise ParameterError("SlidingTiles: start was given with seed; expected one of them")
        store(self, "start", tuple(self.start))
        solved = (*range(1, self.cells), BLANK)
        if sorted(self.start) != list(range(self.cells)) or self.start == solved:
            raise ParameterError(
                f"SlidingTiles: start={self.start}; expected each of 0 to {self.cells - 1} once, and not in order"
            )
        if not _is_solvable(self.start, self.columns):
            raise ParameterError(f"SlidingTiles: start={self.start} cannot be solved; exchange two of its tiles")

    def variables(self):
        return {"cells": [[range(self.cells)] * self.columns] * self.rows}

    def initial_state(self):
        if self.start is not None:
            return self.start
        solved = (*range(1, self.cells), BLANK)
        rng = None if self.seed is None else np.random.Generator(np.random.PCG64(self.seed))
        while True:
            order = range(self.cells - 1, -1, -1) if rng is None else np.argsort(rng.random(self.cells)).tolist()
            tiles = tuple(order)
            if not _is_solvable(tiles, self.columns):
                tiles = tuple({1: 2, 2: 1}.get(tile, tile) for tile in tiles)
            if tiles != solved:
                return tiles

    def transition(self, state, action, out):
        blank = place_of_blank(state)
        row = blank // self.columns + (action == DOWN) - (action == UP)
        column = blank % self.columns + (action == RIGHT) - (action == LEFT)
        if 0 <= row < self.rows and 0 <= column < self.columns:
            tile = row * self.columns + column
            out[blank] = state[tile]
            out[tile] = BLANK

    def is_terminal(self, state):
        for i in range(self.cells - 1):
            if state[i] != i + 1:
                return False
        return True

    def reward(self, state, action, next_state):
        return -1.0

    def grid(self):
        return self.rows, self.columns

    def draw(self, state, planes):
        for i in range(self.cells):
            planes[0, i // self.columns, i % self.columns] = state[i]


def place_of_blank(state):
    i = 0
    while state[i] != BLANK:
        i += 1
    return i


def _is_solvable(tiles: tuple[int, ...], columns: int) -> bool:
    """Whether moves of the blank lead to the solved order: each is an exchange and a step of the blank, so both
    parities, of the permutation and of the way of the blank to the last cell, must agree (Johnson and Story, 1879)."""
    home = [(tile - 1) % len(tiles) for tile in tiles]
    inversions = sum(home[i] > home[j] for i in range(len(home)) for j in range(i + 1, len(home)))
    row, column = divmod(tiles.index(BLANK), columns)
    steps = len(tiles) // columns - 1 - row + columns - 1 - column
    return (inversions + steps) % 2 == 0
