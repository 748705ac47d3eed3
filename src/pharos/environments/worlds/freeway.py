"""Freeway: cross many lanes of traffic without being hit. Source: the pharos paper, section 3.3."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import Environment, Layer, Look, Scenery, integers, parameter, store
from pharos.environments.worlds import ARCADE

PLAYER_ROW, PLAYER_TIMER, CARS = range(3)  # positions of the cars follow, then their timers
STAY, UP, DOWN = range(3)

SPEEDS = (1, 2, 3, 4, 5, 6, 7, 8, 11)  # least common multiple 9240
CAR_COLORS = ((200, 72, 72), (214, 186, 92), (66, 158, 130), (110, 140, 220), (186, 110, 190))
NUM_COLORS = len(CAR_COLORS)
CHICKEN = (  # in pictures for people
    "...##...",
    "...###..",
    "...#....",
    "#.####..",
    "######..",
    ".#####..",
    "..#.#...",
    ".##.##..",
)
WIDE_CAR = (  # in complex images, with wide pixels as on the Atari 2600
    "....................",
    "...9999.....9999....",
    "...9999.....9999....",
    ".###############....",
    ".#################..",
    ".####3333####9######",
    "3####3333####9######",
    "3####3333####9######",
    ".####3333####9######",
    ".#################..",
    ".###############....",
    "...9999.....9999....",
)
WIDE_CHICKEN = (
    ".........####.......",
    ".........######.....",
    ".........##88##77...",
    "..##.....######.....",
    "..####...####.......",
    "..############......",
    "....############....",
    "....############....",
    "......########......",
    "........####........",
    "........7..7........",
    "......777.777.......",
)
CLOCK = ("." * 20,) * 9 + ("#" * 20,) * 3  # below the car, or the player, whose timer it shows
MOST_SHOWN = 255  # values of a timer

PAPER = {
    f"{cars}x{length}-speed{speed}": {"num_cars": cars, "lane_length": length, "player_speed": speed}
    for cars, length in ((20, 11), (25, 13), (20, 5), (16, 7), (25, 9))
    for speed in (1, 2)
}
INSTANCES = {  # the small one, of 1,620 states, for examples and pages
    **PAPER,
    "5x5-speed1": {"num_cars": 5, "lane_length": 5, "player_speed": 1},
}


@dataclass(frozen=True, kw_only=True)
class Freeway(Environment):
    """Cross `num_cars` lanes of `lane_length` cells, one car in each, from the bottom to the top.

    Rules    The player stays in the middle column and moves up or down one row, at every `player_speed`-th step (the
             first included). What is chosen in between changes nothing. Then each car moves one cell in its direction
             at every `period`-th step, and enters its lane again at the other end. A player whose cell now holds a car
             is hit: back to the start row (`restart_on_hit`), or one row down, as in the Atari game. A player who is
             pushed down onto a car is hit by it only if they still meet at the end of the next step.
    State    (player row, player timer, column of each car from the top lane down, timer of each car). Row 0 is the
             goal, rows 1 to num_cars are the lanes, row num_cars + 1 is the start. A timer counts the steps since the
             last one at which its owner could move, from 0 to period - 1.
    Start    player in the start row, all cars in the leftmost column (as the paper draws them), all timers at 0.
    Actions  stay, up, down.
    Reward   1 on reaching the top row, -hit_penalty for a hit, otherwise 0.
    Ends     on reaching the top row.
    Limit    1000 steps.
    Ours     the paper prints num_cars, lane_length and player_speed. Speeds, directions, start, penalty and limit are
             ours. Its returns lie below zero, hence a penalty and a restart by default.
    Source   the pharos paper, section 3.3 and appendix B.

    All cars together are a clock with lane_length * lcm(periods) phases, which the player cannot influence. The states
    are at most that number times num_cars + 2 rows (times player_speed if it does not divide the clock).

    Attributes:
        num_cars: lanes, one car each, at least 1.
        lane_length: cells of a lane, at least 2. The player's column is lane_length // 2.
        player_speed: steps between two moves of the player. 1 is fastest.
        car_speeds: steps between two moves of each car (1 is fastest), from the top lane down, repeated as often as
            needed. None stands for (1, 2, 3, 4, 5, 6, 7, 8, 11). As text: "1,2,3".
        directions: 1 for a car that goes right, -1 for left, from the top lane down, repeated as often as needed. None
            stands for (1, -1). As text: "1,-1".
        restart_on_hit: whether a hit sends the player back to the start row, else one row down.
        hit_penalty: what a hit costs, at least 0.
    """

    num_cars: int = parameter(16, low=1)
    lane_length: int = parameter(7, low=2)
    player_speed: int = parameter(1, low=1)
    car_speeds: tuple[int, ...] = parameter(None, kind=integers("at least 1", lambda period: period >= 1))
    directions: tuple[int, ...] = parameter(
        None, kind=integers("1 (right) or -1 (left)", lambda direction: direction in (1, -1))
    )
    restart_on_hit: bool = parameter(True)
    hit_penalty: float = parameter(1.0, low=0.0)

    name = "freeway"
    actions = ("stay", "up", "down")
    version = 1
    max_episode_steps = 1000
    layers = {
        "kerb": Layer("=", (142, 142, 142)),
        "cars": Layer((*">" * NUM_COLORS, *"<" * NUM_COLORS), CAR_COLORS * 2, shape="car"),
        "player": Layer("@", (252, 252, 84), CHICKEN),
    }

    look = Look(
        ground="road",
        color="#D55E00",
        scenery=Scenery(
            cell=(12, 20),
            margin=(0, 0, 0, 0),
            ground="asphalt",
            sprites={
                "kerb": None,
                "cars": (WIDE_CAR,) * NUM_COLORS + (tuple(row[::-1] for row in WIDE_CAR),) * NUM_COLORS,
                "player": WIDE_CHICKEN,
            },
        ),
    )
    instances = INSTANCES
    paper_instances = tuple(PAPER)
    hyperparameters = ARCADE

    def validate(self) -> None:
        if self.car_speeds is None:
            store(self, "car_speeds", SPEEDS)
        if self.directions is None:
            store(self, "directions", (1, -1))

    @property
    def column(self) -> int:
        """The player's column."""
        return self.lane_length // 2

    @property
    def start_row(self) -> int:
        """The row below the lanes."""
        return self.num_cars + 1

    @property
    def motion_layers(self) -> dict[str, Layer]:  # type: ignore[override]
        """The timers: the later it is, the darker."""
        periods = {"car_timers": int(self.car_periods.max()), "player_timer": self.player_speed}
        return {name: clock(min(period, MOST_SHOWN)) for name, period in periods.items()}

    @cached_property
    def car_periods(self) -> np.ndarray:
        """(num_cars,) int64: steps between two moves of each car."""
        return np.resize(np.array(self.car_speeds, np.int64), self.num_cars)

    @cached_property
    def car_directions(self) -> np.ndarray:
        """(num_cars,) int64: 1 right, -1 left."""
        return np.resize(np.array(self.directions, np.int64), self.num_cars)

    def variables(self):
        return {
            "player_row": range(self.num_cars + 2),
            "player_timer": range(self.player_speed),
            "cars": [range(self.lane_length)] * self.num_cars,
            "car_timers": [range(int(period)) for period in self.car_periods],
        }

    def initial_state(self):
        return (self.start_row, 0, *[0] * (2 * self.num_cars))

    def transition(self, state, action, out):
        row = row_after_move(state[PLAYER_ROW], state[PLAYER_TIMER], action, self.start_row)
        timer = state[PLAYER_TIMER] + 1
        out[PLAYER_TIMER] = 0 if timer == self.player_speed else timer
        timers = CARS + self.num_cars
        for i in range(self.num_cars):
            timer = state[timers + i] + 1
            if timer == self.car_periods[i]:
                timer = 0
                position = state[CARS + i] + self.car_directions[i]
                if position == self.lane_length:
                    position = 0
                elif position < 0:
                    position = self.lane_length - 1
                out[CARS + i] = position
            out[timers + i] = timer
        if 1 <= row <= self.num_cars and out[CARS + row - 1] == self.column:
            row = self.start_row if self.restart_on_hit else row + 1
        out[PLAYER_ROW] = row

    def is_terminal(self, state):
        return state[PLAYER_ROW] == 0

    def reward(self, state, action, next_state):
        row = row_after_move(state[PLAYER_ROW], state[PLAYER_TIMER], action, self.start_row)
        if row == 0:
            return 1.0
        if row <= self.num_cars and next_state[CARS + row - 1] == self.column:
            return -self.hit_penalty
        return 0.0

    def grid(self):
        return self.num_cars + 2, self.lane_length

    def draw(self, state, planes):
        for column in range(self.lane_length):
            planes[0, 0, column] = 1
            planes[0, self.start_row, column] = 1
        for i in range(self.num_cars):
            goes_left = self.car_directions[i] < 0
            planes[1, 1 + i, state[CARS + i]] = 1 + i % NUM_COLORS + NUM_COLORS * goes_left
        planes[2, state[PLAYER_ROW], self.column] = 1

    def draw_motion(self, state, planes):
        timers = CARS + self.num_cars
        for i in range(self.num_cars):
            planes[0, 1 + i, state[CARS + i]] = 1 + min(state[timers + i], MOST_SHOWN - 1)
        planes[1, state[PLAYER_ROW], self.column] = 1 + min(state[PLAYER_TIMER], MOST_SHOWN - 1)


def clock(period: int) -> Layer:
    """A bar under a thing that grows from white to blue until the thing moves."""
    shades = np.linspace(255, 0, period).round().astype(int).tolist()
    return Layer((".",) * period, tuple((shade, shade, 255) for shade in shades), CLOCK)


def row_after_move(row, timer, action, start_row):
    """The player's row after `action`, before the cars move."""
    if timer == 0:
        if action == UP and row > 0:
            return row - 1
        if action == DOWN and 0 < row < start_row:
            return row + 1
    return row
