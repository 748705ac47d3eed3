"""Grid world: walk from the top-left corner to the goal. Source: the pharos paper, section 3.3."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pharos.environments.base import Environment, Layer
from pharos.environments.parameters import integer, is_real, store
from pharos.errors import ParameterError

Cell = tuple[int, int]
ValuedCells = tuple[tuple[Cell, float], ...]

ROW, COLUMN = range(2)
UP, RIGHT, DOWN, LEFT = range(4)
OPEN, REWARD_CELL, GOAL = range(3)


@dataclass(frozen=True, kw_only=True)
class SimpleGrid(Environment):
    """Walk over a grid of `height` x `width` cells.

    State    (row, column), counted from the top-left corner, where every episode starts.
    Actions  up, right, down, left; walking into a wall changes nothing and pays nothing.
    Reward   1 on reaching the goal, the value of a reward or penalty cell on entering it, otherwise 0.
    Ends     on reaching the goal or a reward cell; penalty cells are walked over.
    Limit    4 (height + width) steps.
    Ours     the paper prints neither the rewards nor their cells. We read each pair of blocks of its table as `decoy`
             (a nearer reward cell worth 0.1) and `plain` (the goal alone).
    Source   the pharos paper, section 3.3 and appendix B.

    Attributes:
        height, width: of the grid; at least 1, and at least two cells.
        goal: (row, column); None stands for the bottom-right corner. As text: "3,3".
        rewards: further cells that end the episode, ((row, column), value) each. As text: "2,2:0.1; 0,3:0.5".
        penalties: cells that cost on every entry, ((row, column), value) each with value < 0. As text likewise.
    """

    height: int = 4
    width: int = 4
    goal: Any = None
    rewards: Any = ()
    penalties: Any = ()

    name = "simple_grid"
    actions = ("up", "right", "down", "left")
    version = 1
    layers = {
        "penalty": Layer("x", (200, 72, 72)),
        "reward": Layer("r", (214, 186, 92)),
        "goal": Layer("G", (236, 236, 236)),
        "agent": Layer("A", (66, 72, 200)),
    }

    def validate(self) -> None:
        height, width = integer(self, "height", 1), integer(self, "width", 1)
        if height * width < 2:
            raise ParameterError(f"SimpleGrid: height={height}, width={width}; expected at least two cells")
        goal = (height - 1, width - 1) if self.goal is None else self._cell("goal", self.goal)
        store(self, "goal", goal)
        taken = {(0, 0): "the start", goal: "the goal"}
        if goal == (0, 0):
            raise ParameterError("SimpleGrid: goal=(0, 0); expected another cell than the start")
        for name in ("rewards", "penalties"):
            cells = self._valued_cells(name)
            for cell, value in cells:
                if cell in taken:
                    raise ParameterError(
                        f"SimpleGrid: {name} has {cell}, which is {taken[cell]}; expected another cell"
                    )
                if name == "penalties" and value >= 0:
                    raise ParameterError(f"SimpleGrid: penalties has {value} at {cell}; expected a value below 0")
                taken[cell] = f"already among the {name}"
            store(self, name, cells)

    def variables(self):
        return {"row": range(self.height), "column": range(self.width)}

    def initial_state(self):
        return (0, 0)

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return 4 * (self.height + self.width)

    @cached_property
    def cell_kinds(self) -> np.ndarray:
        """(height, width) int64: OPEN (also penalty cells), REWARD_CELL or GOAL."""
        kinds = np.full((self.height, self.width), OPEN, np.int64)
        for cell, _ in self.rewards:
            kinds[cell] = REWARD_CELL
        kinds[self.goal] = GOAL
        return kinds

    @cached_property
    def cell_values(self) -> np.ndarray:
        """(height, width) float64: what entering a cell pays."""
        values = np.zeros((self.height, self.width))
        for cell, value in (*self.rewards, *self.penalties):
            values[cell] = value
        values[self.goal] = 1.0
        return values

    def transition(self, state, action, out):
        row = state[ROW] + (action == DOWN) - (action == UP)
        column = state[COLUMN] + (action == RIGHT) - (action == LEFT)
        out[ROW] = min(max(row, 0), self.height - 1)
        out[COLUMN] = min(max(column, 0), self.width - 1)

    def is_terminal(self, state):
        return self.cell_kinds[state[ROW], state[COLUMN]] != OPEN

    def reward(self, state, action, next_state):
        if state[ROW] == next_state[ROW] and state[COLUMN] == next_state[COLUMN]:
            return 0.0
        return self.cell_values[next_state[ROW], next_state[COLUMN]]

    def grid(self):
        return self.height, self.width

    def draw(self, state, planes):
        for row in range(self.height):
            for column in range(self.width):
                kind = self.cell_kinds[row, column]
                if kind == OPEN and self.cell_values[row, column] < 0:
                    planes[0, row, column] = 1
                if kind == REWARD_CELL:
                    planes[1, row, column] = 1
                if kind == GOAL:
                    planes[2, row, column] = 1
        planes[3, state[ROW], state[COLUMN]] = 1

    def _cell(self, name: str, found: Any) -> Cell:
        """A cell inside the grid, from (row, column) or "row,column"."""
        try:
            row, column = (int(part) for part in found.split(",")) if isinstance(found, str) else found
            inside = 0 <= row < self.height and 0 <= column < self.width and int(row) == row and int(column) == column
        except (TypeError, ValueError):
            inside = False
        if not inside:
            raise ParameterError(
                f"SimpleGrid: {name} has {found!r}; expected a cell (row, column) inside {self.height} x {self.width}"
            )
        return int(row), int(column)

    def _valued_cells(self, name: str) -> ValuedCells:
        """Cells with their values, from ((row, column), value) pairs or "row,column:value; ..."."""
        found = getattr(self, name)
        pairs: list[tuple[Any, Any]]
        try:
            if isinstance(found, str):
                texts = [part.split(":") for part in found.split(";") if part.strip()]
                pairs = [(cell, float(value)) for cell, value in texts]
            else:
                pairs = [(cell, value) for cell, value in found]
        except (TypeError, ValueError):
            pairs = [(None, None)]
        if not all(is_real(value) for _, value in pairs):
            raise ParameterError(
                f"SimpleGrid: {name}={found!r}; expected ((row, column), value) pairs, "
                f"or text such as '2,2:0.1; 0,3:0.5'"
            )
        return tuple((self._cell(name, cell), float(value)) for cell, value in pairs)
