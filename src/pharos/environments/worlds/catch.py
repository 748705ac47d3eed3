"""Catch: move a paddle below a falling ball. Source: bsuite; Mnih et al. (2014)."""

from dataclasses import dataclass

from pharos.environments.base import Environment, Layer, Look, parameter

BALL_ROW, BALL_COLUMN, PADDLE = range(3)


@dataclass(frozen=True, kw_only=True)
class Catch(Environment):
    """Move the paddle in the last row of `rows` x `columns` cells to where the ball falls.

    State    row and column of the ball, column of the paddle.
    Start    the ball in any column of the first row, each equally likely, the paddle in the middle.
    Actions  left, stay, right. The ball falls a row with each.
    Reward   1 for catching the ball, -1 for missing it, when it comes to the last row.
    Ends     when the ball is in the last row.
    Limit    the rows that it falls.
    Source   bsuite catch; Mnih, Heess, Graves and Kavukcuoglu (2014), "Recurrent Models of Visual Attention".

    Attributes:
        rows: of the court, at least 2.
        columns: of the court, at least 1.
    """

    rows: int = parameter(10, low=2, high=1000)
    columns: int = parameter(5, low=1, high=1000)

    name = "catch"
    actions = ("left", "stay", "right")
    version = 1
    layers = {"ball": Layer("o", (230, 140, 60)), "paddle": Layer("=", (66, 72, 200))}
    look = Look(color="#DDCC77")
    instances = {"10x5": {}}
    hyperparameters = {  # chosen by hand
        "q_learning": {"default": {"gamma": 0.99}},
        "dqn": {"default": {"gamma": 0.99, "learning_rate": 0.001, "target_update_interval": 250}},
    }

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return self.rows - 1

    def variables(self):
        return {"ball_row": range(self.rows), "ball_column": range(self.columns), "paddle": range(self.columns)}

    def initial_states(self):
        return [((0, column, self.columns // 2), 1 / self.columns) for column in range(self.columns)]

    def age(self, state):
        return state[BALL_ROW]

    def transition(self, state, action, out):
        out[BALL_ROW] = min(state[BALL_ROW] + 1, self.rows - 1)
        out[PADDLE] = min(max(state[PADDLE] + action - 1, 0), self.columns - 1)

    def is_terminal(self, state):
        return state[BALL_ROW] == self.rows - 1

    def reward(self, state, action, next_state):
        if next_state[BALL_ROW] < self.rows - 1:
            return 0.0
        return 1.0 if next_state[PADDLE] == next_state[BALL_COLUMN] else -1.0

    def grid(self):
        return self.rows, self.columns

    def draw(self, state, planes):
        planes[0, state[BALL_ROW], state[BALL_COLUMN]] = 1
        planes[1, self.rows - 1, state[PADDLE]] = 1
