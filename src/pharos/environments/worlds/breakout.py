"""Breakout: keep the ball in play with the paddle and take the bricks down. Source: the pharos paper, section 3.3."""

from dataclasses import dataclass

from pharos.environments.base import Environment, Layer, Look, Scenery, parameter
from pharos.environments.worlds import ARCADE

BALL_ROW, BALL_COLUMN, BALL_RIGHT, BALL_DOWN, PADDLE, BRICKS = range(6)  # bricks follow, row by row
LEFT, STAY, RIGHT = range(3)

# Complex images, after the Atari 2600 game: wide pixels, the colours of its palette; bricks begin in row 1
ROW_COLORS = ((66, 72, 200), (200, 72, 72), (198, 108, 58), (180, 122, 48), (162, 162, 42), (72, 160, 72))
WIDE_BRICK = ("#" * 16,) * 11 + ("." * 16,)
WIDE_PADDLE = ("." * 16,) * 2 + ("#" * 16,) * 5 + ("." * 16,) * 5
WIDE_TRAIL = ("." * 16,) * 4 + ("." * 6 + "#" * 4 + "." * 6,) * 4 + ("." * 16,) * 4
WIDE_BALL = ("." * 16,) * 3 + ("." * 6 + "#" * 4 + "." * 6,) * 6 + ("." * 16,) * 3

# (height, columns, paddle width): first the paper's table, then the drawings of its appendix B
PAPER_SIZES = tuple(
    (height, columns, width) for width in (1, 3) for height, columns in ((12, 10), (12, 8), (16, 8), (20, 8), (24, 8))
)
DRAWN_SIZES = ((14, 8, 1), (14, 10, 3), (20, 10, 1), (20, 10, 3), (24, 10, 3))
INSTANCES = {
    f"{height}x{columns}x{width}": {"height": height, "columns": columns, "extra_paddle_width": (width - 1) // 2}
    for height, columns, width in (*PAPER_SIZES, *DRAWN_SIZES)
}
INSTANCES |= {  # 923,305,259 and 1,083,934,871 states
    f"{height}x10x1-3rows": {"height": height, "columns": 10, "brick_rows": 3} for height in (20, 30)
}
INSTANCES["6x4x1"] = {"height": 6, "columns": 4}  # 4,620 states, for examples and pages

# found by searches on courts of 11 x 7 and 10 x 8 under three kinds of chance, docs/agents.md
VECTOR_SETTINGS = {
    "learning_rate": 0.00036,
    "gamma": 0.99,
    "n_steps": 5,
    "learning_starts": 5000,
    "target_update_interval": 10000,
    "exploration_fraction": 0.1,
    "exploration_final_eps": 0.005,
}


@dataclass(frozen=True, kw_only=True)
class Breakout(Environment):
    """A ball, a paddle and `brick_rows` rows of bricks on a court of `height` x `columns` cells.

    Rules    The ball moves one cell diagonally at each step. Side walls and the ceiling turn it within the step. Row 0
             is free, so the ball can run above the bricks, which fill rows 1 to `brick_rows`. A ball that meets a
             brick breaks it, stays in its cell for that step and turns back vertically. The paddle lies in the bottom
             row and moves first, by at most one cell. A ball is hit by the paddle in the row above it: when the paddle
             lies ahead of the ball, the ball bounces, one column on in its row, and goes up onwards. When the paddle
             lies straight below the ball but not ahead, its edge turns the ball back, one column towards where it
             came from. So the player steers by where the paddle is hit, whatever its width, and can reach every brick.
    State    (ball row, ball column, ball goes right, ball goes down, leftmost cell of the paddle, bricks row by row).
    Start    ball below the middle of the bricks, going down to the right, paddle in the middle, all bricks there.
    Actions  left, stay, right.
    Reward   1 a brick, otherwise 0.
    Ends     when the ball reaches the bottom row, without `respawn` also when no brick is left.
    Respawn  when no brick is left, all come back as the paddle next hits the ball.
    Limit    1000 steps.
    Ours     the paper prints height, columns and extra paddle width. Brick rows, respawn, angles and limit are ours.
    Source   the pharos paper, section 3.3 and appendix B.

    Attributes:
        height: rows of the court, at least brick_rows + 4.
        columns: at least 2 and at least as wide as the paddle.
        brick_rows: at least 1.
        extra_paddle_width: cells on each side of the paddle's middle. The paddle is 1 + 2 * extra_paddle_width wide.
        respawn: whether cleared bricks come back.
    """

    height: int = parameter(12, low=lambda env: env.brick_rows + 4)
    columns: int = parameter(8, low=lambda env: max(2, env.paddle_width))
    brick_rows: int = parameter(2, low=1)
    extra_paddle_width: int = parameter(0, low=0)
    respawn: bool = parameter(True)

    name = "breakout"
    actions = ("left", "stay", "right")
    version = 2
    max_episode_steps = 1000
    layers = {
        "bricks": Layer("#", (200, 72, 72)),
        "paddle": Layer("=", (66, 158, 130)),
        "ball": Layer("o", (236, 236, 236)),
    }
    motion_layers = {"ball_trail": Layer(".", (190, 190, 190), WIDE_TRAIL)}

    look = Look(
        ground="court",
        color="#009E73",
        scenery=Scenery(
            cell=(12, 16),
            margin=(16, 8, 4, 8),
            ground="walls",
            sprites={"bricks": WIDE_BRICK, "paddle": WIDE_PADDLE, "ball": WIDE_BALL},
            row_colors={"bricks": ROW_COLORS},
        ),
    )
    instances = INSTANCES
    paper_instances = tuple(INSTANCES)[: len(PAPER_SIZES)]
    first_version = 2
    hyperparameters = {**ARCADE, "dqn": {**ARCADE["dqn"], "vector": VECTOR_SETTINGS}}

    @property
    def paddle_width(self) -> int:
        """Cells of the paddle."""
        return 1 + 2 * self.extra_paddle_width

    @property
    def num_bricks(self) -> int:
        """Bricks at the start."""
        return self.brick_rows * self.columns

    def variables(self):
        return {
            "ball_row": range(self.height),
            "ball_column": range(self.columns),
            "ball_goes_right": range(2),
            "ball_goes_down": range(2),
            "paddle": range(self.columns - self.paddle_width + 1),
            "bricks": [[range(2)] * self.columns] * self.brick_rows,
        }

    def initial_state(self):
        ball = (self.brick_rows + 1, (self.columns - 1) // 2, 1, 1)
        return (*ball, (self.columns - self.paddle_width) // 2, *[1] * self.num_bricks)

    def transition(self, state, action, out):
        row = state[BALL_ROW]
        if row == self.height - 1:
            return  # the ball is lost
        column, right, down, paddle = state[BALL_COLUMN], state[BALL_RIGHT], state[BALL_DOWN], state[PADDLE]
        if action == LEFT and paddle > 0:
            paddle -= 1
        elif action == RIGHT and paddle < self.columns - self.paddle_width:
            paddle += 1
        out[PADDLE] = paddle

        if column == 0:
            right = 1
        elif column == self.columns - 1:
            right = 0
        if row == 0:
            down = 1
        ahead_row = row + 2 * down - 1
        ahead_column = column + 2 * right - 1

        if ahead_row == self.height - 1:
            if paddle <= ahead_column < paddle + self.paddle_width:
                down = 0
            elif paddle <= column < paddle + self.paddle_width:
                right = 1 - right
                down = 0
                ahead_column = min(max(column + 2 * right - 1, 0), self.columns - 1)
            if down == 0:
                ahead_row = row
                if self.respawn and no_brick_is_left(self.num_bricks, state):
                    for i in range(self.num_bricks):
                        out[BRICKS + i] = 1
        elif 1 <= ahead_row <= self.brick_rows:
            brick = BRICKS + (ahead_row - 1) * self.columns + ahead_column
            if state[brick] == 1:
                out[brick] = 0
                down = 1 - down
                ahead_row, ahead_column = row, column

        out[BALL_ROW] = ahead_row
        out[BALL_COLUMN] = ahead_column
        out[BALL_RIGHT] = right
        out[BALL_DOWN] = down

    def is_terminal(self, state):
        if state[BALL_ROW] == self.height - 1:
            return True
        return not self.respawn and no_brick_is_left(self.num_bricks, state)

    def reward(self, state, action, next_state):
        stayed = state[BALL_ROW] == next_state[BALL_ROW] and state[BALL_COLUMN] == next_state[BALL_COLUMN]
        return 1.0 if stayed and state[BALL_ROW] < self.height - 2 else 0.0  # in the row below it met the paddle

    def grid(self):
        return self.height, self.columns

    def draw(self, state, planes):
        for i in range(self.num_bricks):
            planes[0, 1 + i // self.columns, i % self.columns] = state[BRICKS + i]
        for i in range(self.paddle_width):
            planes[1, self.height - 1, state[PADDLE] + i] = 1
        planes[2, state[BALL_ROW], state[BALL_COLUMN]] = 1

    def draw_motion(self, state, planes):
        # the cell from which the ball goes as it does; if that lies in a wall, the one beside it
        row = min(max(state[BALL_ROW] - 2 * state[BALL_DOWN] + 1, 0), self.height - 1)
        column = min(max(state[BALL_COLUMN] - 2 * state[BALL_RIGHT] + 1, 0), self.columns - 1)
        planes[0, row, column] = 1


def no_brick_is_left(num_bricks, state):
    for i in range(num_bricks):
        if state[BRICKS + i] == 1:
            return False
    return True
