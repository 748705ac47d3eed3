"""Taxi: fetch a passenger and bring him where he wants to go. Source: Dietterich (2000); Gymnasium's Taxi-v4."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import CELLS, Cell, Environment, Layer, Look, parameter, store
from pharos.errors import ParameterError

ROW, COLUMN, PASSENGER, DESTINATION, UNDECIDED = range(5)
DOWN, UP, RIGHT, LEFT, PICK_UP, SET_DOWN = range(6)

# Of Gymnasium's map: the places R, G, Y and B, and the cells that have a wall to their right.
LANDMARKS = ((0, 0), (0, 4), (4, 0), (4, 3))
WALLS = ((0, 1), (1, 1), (3, 0), (3, 2), (4, 0), (4, 2))
PLACES = (
    *((214, 68, 58), (74, 164, 84), (226, 190, 62), (66, 108, 216), (60, 180, 190), (190, 120, 70)),
    *((150, 90, 190), (230, 140, 60), (120, 120, 120)),
)
MOST_LANDMARKS = len(PLACES)

CAB = (".######.", "########", "#.####.#", "########", "1######1", "########", "########", ".#....#.")
RIDER = ("...##...", "...##...", "..####..", "...##...", "...##...", "..#..#..", "........", "........")


@dataclass(frozen=True, kw_only=True)
class Taxi(Environment):
    """Drive a taxi over a square town: fetch the passenger at a landmark, and set him down at another one.

    State    (row, column) of the taxi, the landmark where the passenger is (or their number: in the taxi), his
             destination, and whether he may still change his mind.
    Start    the taxi anywhere, the passenger at a landmark, his destination another one, each with the same
             probability.
    Actions  down, up, right, left, pick up, set down, numbered as in Gymnasium. Walls stop the taxi.
    Chance   rainy: a move that no wall stops goes its way with `rainy_probability`, else to its left or right, with the
             same probability, if walls do not stop that.
             fickle: the first time that the taxi changes its cell with the passenger in it, he takes another
             destination with `fickle_probability`, each with the same probability.
    Reward   -1 a step, -10 for picking up or setting down if that is impossible, 20 for setting him down at his
             destination. He can be set down at landmarks only.
    Ends     when he is set down at his destination.
    Limit    200 steps on 5 x 5 cells, as in Gymnasium, 8 for each cell.
    Ours     sizes. Gymnasium draws before the first step whether he will change his mind, and hides it. Here it is
             drawn when it shows, which is the same in law, and the state says whether that is still to come.
    Source   Gymnasium Taxi-v4; Dietterich (2000), "Hierarchical Reinforcement Learning with the MAXQ Value Function
             Decomposition", JAIR 13.

    Attributes:
        size: of the town. 5 has Gymnasium's landmarks and walls, others have landmarks in the corners and no walls.
        landmarks: own ones, from 2 to 9 cells (row, column). As text: "0,0; 0,4; 4,0".
        walls: own ones, cells (row, column) with a wall to their right. As text likewise.
        rainy, fickle: the two kinds of chance.
        rainy_probability: of going the intended way in the rain.
        fickle_probability: of another destination.
    """

    size: int = parameter(5, low=2)
    landmarks: tuple[Cell, ...] = parameter(None, kind=CELLS)
    walls: tuple[Cell, ...] = parameter(None, kind=CELLS)
    rainy: bool = parameter(False)
    fickle: bool = parameter(False)
    rainy_probability: float = parameter(0.8, low=0.0, high=1.0)
    fickle_probability: float = parameter(0.3, low=0.0, high=1.0)

    name = "taxi"
    actions = ("down", "up", "right", "left", "pick up", "set down")
    version = 1
    numbered_by = ("row", "column", "passenger", "destination")
    layers = {
        "walls": Layer("|", (150, 150, 150), ("..####..",) * 8),
        "landmarks": Layer(tuple("RGYBCPOMW"), PLACES),
        "destination": Layer("D", (230, 120, 200), shape="goal"),
        "taxi": Layer("T", (240, 200, 60), CAB),
        "passenger": Layer(("p", "q"), ((30, 60, 160), (150, 40, 150)), RIDER),
    }
    motion_layers = {"occupied": Layer("!", (80, 200, 120), ("########", *("........",) * 7))}

    look = Look(ground="tiles", color="#BCBD22")
    instances = {
        "5x5": {},
        "5x5-rainy": {"rainy": True},
        "5x5-fickle": {"fickle": True},
        "5x5-rainy-fickle": {"rainy": True, "fickle": True},
        "10x10": {"size": 10},
    }
    foreign_parameters = {"is_rainy": "write rainy=true", "fickle_passenger": "write fickle=true"}
    hyperparameters = {  # chosen by hand
        "q_learning": {"default": {"initial_q": 0.0}},
        "dqn": {"default": {"learning_rate": 0.001, "target_update_interval": 250, "exploration_final_eps": 0.02}},
    }

    @property
    def height(self) -> int:
        """Rows of the town."""
        return self.size

    @property
    def width(self) -> int:
        """Columns of the town."""
        return self.size

    def validate(self) -> None:
        last = self.size - 1
        for name, own, other in (
            ("landmarks", LANDMARKS, ((0, 0), (0, last), (last, 0), (last, last))),
            ("walls", WALLS, ()),
        ):
            if getattr(self, name) is None:
                store(self, name, own if self.size == 5 else other)
        if not 2 <= len(set(self.landmarks)) == len(self.landmarks) <= MOST_LANDMARKS:
            raise ParameterError(
                f"Taxi: landmarks={self.landmarks}; expected 2 to {MOST_LANDMARKS} cells, each another one"
            )

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        return (3 if self.rainy else 1) * (len(self.landmarks) if self.fickle else 1)

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return 8 * self.size**2

    def variables(self):
        places = len(self.landmarks)
        return {
            "row": range(self.size),
            "column": range(self.size),
            "passenger": range(places + 1),
            "destination": range(places),
            "undecided": range(2 if self.fickle else 1),
        }

    def initial_states(self):
        places = range(len(self.landmarks))
        states = [
            (row, column, passenger, destination, int(self.fickle))
            for row in range(self.size)
            for column in range(self.size)
            for passenger in places
            for destination in places
            if passenger != destination
        ]
        return [(state, 1 / len(states)) for state in states]

    @cached_property
    def landmark_rows(self) -> np.ndarray:
        """(L,) int64."""
        return np.array([row for row, _ in self.landmarks], np.int64)

    @cached_property
    def landmark_columns(self) -> np.ndarray:
        """(L,) int64."""
        return np.array([column for _, column in self.landmarks], np.int64)

    @cached_property
    def wall_right(self) -> np.ndarray:
        """(size, size) int64: 1 if something stops the taxi on its way to the right."""
        walls = np.zeros((self.size, self.size), np.int64)
        walls[:, -1] = 1
        for cell in self.walls:
            walls[cell] = 1
        return walls

    def probability(self, state, action, outcome):
        slip, destination = parts_of(self, outcome)
        chance = 1.0
        way = action
        if self.rainy and action < PICK_UP and not is_stopped(self, state, action):
            way = turned(action, slip)
            chance = self.rainy_probability if slip == 0 else (1 - self.rainy_probability) / 2
        elif slip > 0:
            return 0.0
        places = len(self.landmark_rows)
        is_deciding = state[UNDECIDED] == 1 and state[PASSENGER] == places
        if is_deciding and way < PICK_UP and not is_stopped(self, state, way):
            return chance * (
                1 - self.fickle_probability if destination == 0 else self.fickle_probability / (places - 1)
            )
        return chance if destination == 0 else 0.0

    def transition(self, state, action, outcome, out):
        places = len(self.landmark_rows)
        if action == PICK_UP:
            if state[PASSENGER] < places and is_at(self, state, state[PASSENGER]):
                out[PASSENGER] = places
            return
        if action == SET_DOWN:
            if state[PASSENGER] == places:
                for place in range(places):
                    if is_at(self, state, place):
                        out[PASSENGER] = place
            return
        slip, destination = parts_of(self, outcome)
        if is_stopped(self, state, action):
            return
        way = turned(action, slip)
        if is_stopped(self, state, way):
            return
        out[ROW] = state[ROW] + (way == DOWN) - (way == UP)
        out[COLUMN] = state[COLUMN] + (way == RIGHT) - (way == LEFT)
        if state[PASSENGER] == places:
            out[UNDECIDED] = 0
            out[DESTINATION] = (state[DESTINATION] + destination) % places

    def is_terminal(self, state):
        return state[PASSENGER] == state[DESTINATION]

    def reward(self, state, action, next_state):
        if action < PICK_UP:
            return -1.0
        if next_state[PASSENGER] == state[PASSENGER]:
            return -10.0
        return 20.0 if next_state[PASSENGER] == next_state[DESTINATION] else -1.0

    def grid(self):
        return self.size, 2 * self.size - 1

    def draw(self, state, planes):
        for row in range(self.size):
            for column in range(self.size - 1):
                planes[0, row, 2 * column + 1] = self.wall_right[row, column]
        places = len(self.landmark_rows)
        for place in range(places):
            planes[1, self.landmark_rows[place], 2 * self.landmark_columns[place]] = place + 1
        goal = state[DESTINATION]
        planes[2, self.landmark_rows[goal], 2 * self.landmark_columns[goal]] = 1
        planes[3, state[ROW], 2 * state[COLUMN]] = 1
        place = state[PASSENGER]
        row = state[ROW] if place == places else self.landmark_rows[place]
        column = state[COLUMN] if place == places else self.landmark_columns[place]
        planes[4, row, 2 * column] = 1 + state[UNDECIDED]

    def draw_motion(self, state, planes):
        if state[PASSENGER] == len(self.landmark_rows):  # else the passenger may stand where the taxi is
            planes[0, state[ROW], 2 * state[COLUMN]] = 1


def parts_of(self, outcome):
    """Which way the rain turns a move (see `turned`), and how many destinations further the passenger wants to go."""
    if self.rainy:
        return outcome % 3, outcome // 3
    return 0, outcome


def is_at(self, state, place):
    return state[ROW] == self.landmark_rows[place] and state[COLUMN] == self.landmark_columns[place]


def turned(action, slip):
    """The way that a move takes: its own, to its left, to its right."""
    if slip == 0:
        return action
    if action == DOWN:
        return RIGHT if slip == 1 else LEFT
    if action == UP:
        return LEFT if slip == 1 else RIGHT
    if action == RIGHT:
        return UP if slip == 1 else DOWN
    return DOWN if slip == 1 else UP


def is_stopped(self, state, way):
    row, column = state[ROW], state[COLUMN]
    if way == DOWN:
        return row == self.size - 1
    if way == UP:
        return row == 0
    if way == RIGHT:
        return self.wall_right[row, column] == 1
    return column == 0 or self.wall_right[row, column - 1] == 1
