"""Cliff walking: the short way along the edge or the long way round. Source: Sutton and Barto (2018), example 6.6."""

from dataclasses import dataclass

from pharos.environments.base import Environment, Layer, Look, parameter

ROW, COLUMN = range(2)
UP, RIGHT, DOWN, LEFT = range(4)

FALL, STEP = -100.0, -1.0
SLIPPERY = "write slippery=true"


@dataclass(frozen=True, kw_only=True)
class CliffWalking(Environment):
    """Walk from the bottom left to the bottom right of a grid. Between the two the bottom row is a cliff.

    State    (row, column), counted from the top-left corner.
    Actions  up, right, down, left, numbered as in Gymnasium. Walking into a wall changes nothing.
    Chance   if it is slippery, an action is executed as itself or as one of the two perpendicular ones, 1/3 each.
    Reward   -1 a step. A fall over the cliff pays -100 and leads back to the start.
    Ends     on reaching the goal.
    Limit    none in Gymnasium, here 25 steps for each cell of the longer side.
    Ours     size and limit.
    Source   Gymnasium CliffWalking-v1; Sutton and Barto (2018), "Reinforcement Learning", example 6.6.

    Attributes:
        height, width: of the grid, at least 2 and 3.
        slippery: whether actions slip.
    """

    height: int = parameter(4, low=2)
    width: int = parameter(12, low=3)
    slippery: bool = parameter(False)

    name = "cliff_walking"
    actions = ("up", "right", "down", "left")
    version = 1
    numbered_by = ("row", "column")
    layers = {
        "cliff": Layer("x", (96, 66, 58)),
        "goal": Layer("G", (236, 236, 236)),
        "agent": Layer("A", (66, 72, 200)),
    }

    look = Look(ground="tiles", color="#7F7F7F")
    instances = {
        "4x12": {},
        "4x12-slippery": {"slippery": True},
        "8x24": {"height": 8, "width": 24},
        "8x24-slippery": {"height": 8, "width": 24, "slippery": True},
    }
    foreign_parameters = {"is_slippery": SLIPPERY}
    hyperparameters = {
        "q_learning": {"default": {"initial_q": 0.0}},  # by hand: hopeful, as every step costs
        # searched with 100,000 steps: at random one in 26 episodes meets the end, so exploration is long
        "dqn": {
            "default": {
                "n_envs": 8,
                "train_freq": 1,
                "n_steps": 5,
                "learning_rate": 0.0034,
                "gamma": 0.95,
                "learning_starts": 2000,
                "target_update_interval": 1000,
                "exploration_fraction": 0.7,
                "exploration_final_eps": 0.013,
            }
        },
    }

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        return 3 if self.slippery else 1

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return 25 * max(self.height, self.width)

    def variables(self):
        return {"row": range(self.height), "column": range(self.width)}

    def initial_state(self):
        return (self.height - 1, 0)

    def probability(self, state, action, outcome):
        return 1 / 3 if self.slippery else 1.0

    def transition(self, state, action, outcome, out):
        row, column = cell_ahead(self, state, action, outcome)
        out[ROW] = row
        out[COLUMN] = 0 if is_cliff(self, row, column) else column

    def is_terminal(self, state):
        return state[ROW] == self.height - 1 and state[COLUMN] == self.width - 1

    def reward(self, state, action, next_state, outcome):
        if outcome < 0:  # without effect
            return STEP
        row, column = cell_ahead(self, state, action, outcome)
        return FALL if is_cliff(self, row, column) else STEP

    def grid(self):
        return self.height, self.width

    def draw(self, state, planes):
        planes[0, self.height - 1, 1 : self.width - 1] = 1
        planes[1, self.height - 1, self.width - 1] = 1
        planes[2, state[ROW], state[COLUMN]] = 1


def cell_ahead(self, state, action, outcome):
    """(row, column) of the cell that a step leads to, over the cliff or not."""
    way = (action + outcome - 1) % 4 if self.slippery else action
    row = min(max(state[ROW] + (way == DOWN) - (way == UP), 0), self.height - 1)
    column = min(max(state[COLUMN] + (way == RIGHT) - (way == LEFT), 0), self.width - 1)
    return row, column


def is_cliff(self, row, column):
    """Whether a cell of the bottom row lies between start and goal."""
    return row == self.height - 1 and 0 < column < self.width - 1
