"""Grid world: walk from the top-left corner to the goal. Source: the pharos paper, section 3.3."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import CELL, VALUED_CELLS, Cell, Environment, Layer, Look, parameter, store
from pharos.errors import ParameterError

ROW, COLUMN = range(2)
UP, RIGHT, DOWN, LEFT = range(4)
OPEN, REWARD_CELL, GOAL = range(3)

PLAIN = {f"{n}x{n}-plain": {"height": n, "width": n} for n in (4, 6, 8)}
DECOY = {f"{n}x{n}-decoy": {"height": n, "width": n, "rewards": (((n // 2, n // 2), 0.1),)} for n in (4, 6, 8)}
INSTANCES = {name: parameters for pair in zip(DECOY.items(), PLAIN.items(), strict=True) for name, parameters in pair}


@dataclass(frozen=True, kw_only=True)
class SimpleGrid(Environment):
    """Walk over a grid of `height` x `width` cells.

    State    (row, column), counted from the top-left corner, where every episode starts.
    Actions  up, right, down, left. Walking into a wall changes nothing and pays nothing.
    Reward   1 on reaching the goal, the value of a reward or penalty cell on entering it, otherwise 0.
    Ends     on reaching the goal or a reward cell. Penalty cells are walked over.
    Limit    4 (height + width) steps.
    Ours     the paper prints neither the rewards nor their cells. We read each pair of blocks of its table as `decoy`
             (a nearer reward cell worth 0.1) and `plain` (the goal alone).
    Source   the pharos paper, section 3.3 and appendix B.

    Attributes:
        height, width: of the grid, at least 1, and at least two cells.
        goal: (row, column). None stands for the bottom-right corner. As text: "3,3".
        rewards: further cells that end the episode, ((row, column), value) each. As text: "2,2:0.1; 0,3:0.5".
        penalties: cells that cost on every entry, ((row, column), value) each with value < 0. As text likewise.
    """

    height: int = parameter(4, low=1)
    width: int = parameter(4, low=1)
    goal: Cell = parameter(None, kind=CELL)
    rewards: tuple[tuple[Cell, float], ...] = parameter((), kind=VALUED_CELLS)
    penalties: tuple[tuple[Cell, float], ...] = parameter((), kind=VALUED_CELLS)

    name = "simple_grid"
    actions = ("up", "right", "down", "left")
    version = 1
    layers = {
        "penalty": Layer("x", (200, 72, 72)),
        "reward": Layer("r", (214, 186, 92)),
        "goal": Layer("G", (236, 236, 236)),
        "agent": Layer("A", (66, 72, 200)),
    }

    look = Look(ground="tiles", color="#0072B2")
    instances = INSTANCES
    paper_instances = tuple(INSTANCES)
    hyperparameters = {
        # Returns of three steps: without them one seed in five, with vectors, stays with the decoy of 8x8
        # (docs/evidence/agents.md).
        "dqn": {
            "default": {
                "gamma": 0.95,
                "learning_rate": 0.001,
                "n_steps": 3,
                "n_envs": 4,
                "train_freq": 1,
                "learning_starts": 5000,
                "target_update_interval": 250,
                "exploration_fraction": 0.5,
                "exploration_final_eps": 0.02,
            }
        }
    }

    def validate(self) -> None:
        if self.height * self.width < 2:
            raise ParameterError(f"SimpleGrid: height={self.height}, width={self.width}; expected at least two cells")
        if self.goal is None:
            store(self, "goal", (self.height - 1, self.width - 1))
        if self.goal == (0, 0):
            raise ParameterError("SimpleGrid: goal=(0, 0); expected another cell than the start")
        contents = {(0, 0): "the start", self.goal: "the goal"}
        for name in ("rewards", "penalties"):
            for place, value in getattr(self, name):
                if place in contents:
                    raise ParameterError(
                        f"SimpleGrid: {name} has {place}, which is {contents[place]}; expected another cell"
                    )
                if name == "penalties" and value >= 0:
                    raise ParameterError(f"SimpleGrid: penalties has {value} at {place}; expected a value below 0")
                contents[place] = f"already among the {name}"

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
        for place, _ in self.rewards:
            kinds[place] = REWARD_CELL
        kinds[self.goal] = GOAL
        return kinds

    @cached_property
    def cell_values(self) -> np.ndarray:
        """(height, width) float64: reward of entering each cell."""
        values = np.zeros((self.height, self.width))
        for place, value in (*self.rewards, *self.penalties):
            values[place] = value
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
