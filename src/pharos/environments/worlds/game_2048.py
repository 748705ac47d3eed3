"""2048: slide and merge tiles while new ones appear by chance. Source: the game by Gabriele Cirulli (2014)."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from pharos.environments.base import Environment, Layer, Look, one_of, parameter
from pharos.errors import ParameterError

UP, RIGHT, DOWN, LEFT = range(4)
TWO, FOUR = range(1, 3)
FOURS = 0.1  # of the tiles that appear

GLYPHS = "123456789ABCDEFGH"  # the exponents of tiles
TILE_COLORS = (
    *((238, 228, 218), (237, 224, 200), (242, 177, 121), (245, 149, 99), (246, 124, 95), (246, 94, 59)),
    *((237, 207, 114), (237, 204, 97), (237, 200, 80), (237, 197, 63), (237, 194, 46), (120, 180, 120)),
    *((90, 160, 140), (70, 140, 160), (60, 110, 170), (70, 80, 160), (60, 58, 50)),
)


@dataclass(frozen=True, kw_only=True)
class Game2048(Environment):
    """Slide the tiles of a board of `rows` x `columns` cells to one side. Equal ones merge into their sum.

    State    the tile in each cell, row by row, as its exponent: 0 for an empty cell, 1 for 2, 2 for 4, and so on.
             canonical: boards that are rotations or mirror images of each other are one state, the one that is the
             largest when read row by row.
    Start    two tiles, drawn as those that appear.
    Actions  up, right, down, left: the way that all tiles slide. A tile merges once a move, those nearest to that side
             first. An action that would move nothing executes the next one clockwise that moves something.
    Chance   after each move a tile appears in an empty cell, each with the same probability: 2 (90 %) or 4 (10 %).
             Outcome 2 i puts a 2 into the i-th empty cell in reading order, outcome 2 i + 1 a 4.
    Reward   objective="score": the sum of the tiles that a move makes, as the game counts it. objective="target": 1 for
             making the target, else 0.
    Ends     when no tile can move, or when the target is made.
    Limit    none in the game, here half of a bound on the sum of tiles of a board, which no game outlives.
    Ours     what an impossible move does, and boards of other sizes.
    Source   Cirulli (2014), 2048.

    Every move adds what appears to the sum of the tiles, the age of a state: so no state is visited twice.

    Attributes:
        rows, columns: of the board, at least 1, and 2 to 16 cells together.
        target: the tile that ends the game, a power of two from 8 on. None for an open end.
        objective: "score" or "target".
        canonical: whether rotations and mirror images are one state. Their values are the same.
    """

    rows: int = parameter(3, low=1)
    columns: int = parameter(3, low=1)
    target: int | None = parameter(None, kind=int, low=8)
    objective: str = parameter("score", kind=one_of("score", "target"))
    canonical: bool = parameter(True)

    name = "game_2048"
    actions = ("up", "right", "down", "left")
    version = 1
    layers = {"tiles": Layer(tuple(GLYPHS), TILE_COLORS, shape="power")}

    look = Look(color="#E8A33D")
    instances = {
        **{f"{rows}x{columns}": {"rows": rows, "columns": columns} for rows, columns in ((2, 2), (2, 3), (3, 3))},
        "2x2-to-32": {"rows": 2, "columns": 2, "target": 32, "objective": "target"},
        **{f"3x3-to-{target}": {"target": target, "objective": "target"} for target in (64, 256, 512, 1024)},
    }
    hyperparameters = {  # chosen by hand
        "q_learning": {"default": {"initial_q": 0.0}},
        "dqn": {"default": {"buffer_size": 100000, "target_update_interval": 1000, "exploration_final_eps": 0.02}},
    }

    def validate(self) -> None:
        if not 2 <= self.cells <= 16:
            raise ParameterError(
                f"Game2048: rows={self.rows}, columns={self.columns} are {self.cells} cells; expected 2 to 16"
            )
        if self.target is None and self.objective == "target":
            raise ParameterError("Game2048: objective='target' without a target; add target=64, say")
        if self.target is not None and (self.target & (self.target - 1) or self.target > 2 ** (self.cells + 1)):
            raise ParameterError(
                f"Game2048: target={self.target}; expected a power of two up to {2 ** (self.cells + 1)}, the largest "
                f"tile on {self.cells} cells"
            )

    @property
    def cells(self) -> int:
        """Cells of the board."""
        return self.rows * self.columns

    @property
    def goal(self) -> int:
        """The exponent of the target; one that no tile has where there is none."""
        return self.cells + 2 if self.target is None else self.target.bit_length() - 1

    @property
    def pays_score(self) -> bool:
        """Whether the reward of a move is the sum of the tiles that it makes."""
        return self.objective == "score"

    @cached_property
    def lengths(self) -> np.ndarray:
        """(4,) int64: the length of the lines along which an action moves tiles."""
        return np.array([self.rows, self.columns] * 2)

    @cached_property
    def lines(self) -> np.ndarray:
        """(4, cells) int64: the cells of each line of an action, from the side to which tiles slide, line by line."""
        board = np.arange(self.cells).reshape(self.rows, self.columns)
        return np.stack([board.T.ravel(), board[:, ::-1].ravel(), board[::-1].T.ravel(), board.ravel()])

    @cached_property
    def mirrors(self) -> np.ndarray:
        """(2 or 3, cells) int64: reflections that generate all symmetries of the board; cell i changes with [i]."""
        board = np.arange(self.cells).reshape(self.rows, self.columns)
        return np.stack([board[::-1].ravel(), board[:, ::-1].ravel(), *[board.T.ravel()] * (self.rows == self.columns)])

    @cached_property
    def symmetries(self) -> np.ndarray:
        """(G, cells) int64: bit b of g says whether mirror b is applied; then cell i has the tile of [g, i]."""
        turned = [np.arange(self.cells)]
        for mirror in self.mirrors if self.canonical else ():
            turned += [cells[mirror] for cells in turned]
        return np.stack(turned)

    @cached_property
    def sums(self) -> np.ndarray:
        """(18,) int64: face value of an empty cell and of each tile, by exponent."""
        return np.array([0, *(2**e for e in range(1, len(GLYPHS) + 1))])

    @cached_property
    def scores(self) -> np.ndarray:
        """(18,) int64: score of making each tile from tiles of 2, by exponent."""
        return np.array([0, *((e - 1) * 2**e for e in range(1, len(GLYPHS) + 1))])

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        return 2 * (self.cells - 1)

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return 2 ** (self.cells + 1)

    def variables(self):
        return {"tiles": [[range(min(self.goal, self.cells + 1) + 1)] * self.columns] * self.rows}

    def initial_states(self):
        starts = []
        for first, second in ((i, j) for i, j in product(range(self.cells), repeat=2) if i != j):
            for one, two in product((TWO, FOUR), repeat=2):
                board = np.zeros(self.cells, int)
                board[first], board[second] = one, two
                likely = (FOURS if one == FOUR else 1 - FOURS) * (FOURS if two == FOUR else 1 - FOURS)
                start = max(tuple(board[cells].tolist()) for cells in self.symmetries)
                starts.append((start, likely / self.cells / (self.cells - 1)))
        return starts

    def probability(self, state, action, outcome):
        _, empty = executed(self, state, action)
        if outcome >= 2 * empty:
            return 0.0
        return (FOURS if outcome % 2 else 1 - FOURS) / empty

    def transition(self, state, action, outcome, out):
        way, _ = executed(self, state, action)
        slide(self, state, way, out)
        empty = 0
        for cell in range(self.cells):
            if out[cell] == 0:
                if empty == outcome // 2:
                    out[cell] = FOUR if outcome % 2 else TWO
                    break
                empty += 1
        turn(self, out)

    def is_terminal(self, state):
        _, empty = executed(self, state, UP)
        return empty == 0 or is_made(self, state)

    def reward(self, state, action, next_state):
        if not self.pays_score:
            return 1.0 if is_made(self, next_state) else 0.0
        appears = total(self, self.sums, next_state) - total(self, self.sums, state)
        paid = total(self, self.scores, next_state) - total(self, self.scores, state)
        return float(paid - 4 if appears == 4 else paid)  # a 4 that appears has not been made

    def age(self, state):
        return total(self, self.sums, state)

    def grid(self):
        return self.rows, self.columns

    def draw(self, state, planes):
        for cell in range(self.cells):
            planes[0, cell // self.columns, cell % self.columns] = state[cell]


def total(self, values, board):
    """The sum over cells of the value of what is there, by its exponent."""
    found = 0
    for cell in range(self.cells):
        found += values[board[cell]]
    return found


def is_made(self, board):
    """Whether the target is there."""
    for cell in range(self.cells):
        if board[cell] == self.goal:
            return True
    return False


def room(self, state, action):
    """How many cells are empty when the tiles have slid; 0 where none of them moves."""
    length, empty, moves = self.lengths[action], 0, False
    for start in range(0, self.cells, length):
        last, gap = 0, False
        for i in range(start, start + length):
            tile = state[self.lines[action, i]]
            if tile == 0 or tile == last:
                empty += 1
                moves = moves or tile > 0
                gap, last = gap or tile == 0, last if tile == 0 else 0
            else:
                moves, last = moves or gap, tile
    return empty if moves else 0


def executed(self, state, action):
    """(action that is executed: the first one clockwise that moves something; how many cells are empty then)."""
    empty = room(self, state, action)
    for _ in range(3):
        if empty == 0:
            action = (action + 1) % 4
            empty = room(self, state, action)
    return action, empty


def slide(self, state, action, out):
    """Write the board with all tiles at one side."""
    length = self.lengths[action]
    for start in range(0, self.cells, length):
        free, last = start, 0
        for i in range(start, start + length):
            tile = state[self.lines[action, i]]
            if tile == 0:
                continue
            if tile == last:
                out[self.lines[action, free - 1]], last = tile + 1, 0
            else:
                out[self.lines[action, free]], last = tile, tile
                free += 1
        for i in range(free, start + length):
            out[self.lines[action, i]] = 0


def turn(self, board):
    """Put a board into the one of its symmetric forms that is the largest when read row by row."""
    best = 0
    for g in range(1, len(self.symmetries)):
        for i in range(self.cells):
            here, there = board[self.symmetries[g, i]], board[self.symmetries[best, i]]
            if here != there:
                best = g if here > there else best
                break
    for b in range(len(self.mirrors)):
        if best >> b & 1:
            for cell in range(self.cells):
                other = self.mirrors[b, cell]
                if cell < other:
                    tile = board[cell]
                    board[cell] = board[other]
                    board[other] = tile
