"""Pocket cube: the 2x2x2 cube of Rubik and Nichols. Source: Jaap Scherphuis's page of it; Kociemba's notation."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import Environment, Kind, Layer, Look, one_of, parameter
from pharos.errors import ParameterError

# Places of the seven corners that move, by their faces: up, down, left, right, front, back. The eighth, down back left,
# is never turned, and with it the cube stays as it lies.
URF, UFL, ULB, UBR, DFR, DLF, DRB, DBL = range(8)
MOVING = 7
# A clockwise quarter turn of a face: the place from which each place gets its corner, and the twist that it adds
QUARTERS = {
    "U": ((UBR, URF, UFL, ULB, DFR, DLF, DRB), (0, 0, 0, 0, 0, 0, 0)),
    "R": ((DFR, UFL, ULB, URF, DRB, DLF, UBR), (2, 0, 0, 1, 1, 0, 2)),
    "F": ((UFL, DLF, ULB, UBR, URF, DFR, DRB), (1, 2, 0, 0, 2, 1, 0)),
}
TURNS = {face + sign: (face, times) for face in QUARTERS for sign, times in (("", 1), ("2", 2), ("'", 3))}
METRICS = {"half": tuple(TURNS), "quarter": tuple(turn for turn in TURNS if not turn.endswith("2"))}
FAR = "F R2 U' F' U2 F U R2 U F U'"  # 11 turns, or 14 quarter turns, from the solved cube

FACES = "URFDLB"  # their colours are the values 1 to 6 of the layer
CORNERS = ("URF", "UFL", "ULB", "UBR", "DFR", "DLF", "DRB", "DBL")  # faces clockwise, from above or below
# Where the stickers of each place lie on the net: (row, column) for each of its faces, in that order
NET = (
    ((1, 3), (2, 4), (2, 3)),
    ((1, 2), (2, 2), (2, 1)),
    ((0, 2), (2, 0), (2, 7)),
    ((0, 3), (2, 6), (2, 5)),
    ((4, 3), (3, 3), (3, 4)),
    ((4, 2), (3, 1), (3, 2)),
    ((5, 3), (3, 5), (3, 6)),
    ((5, 2), (3, 7), (3, 0)),
)


def _scramble(env: object, name: str, value: object) -> str:
    """The turns, separated by single spaces."""
    turns = value.replace(",", " ").split() if isinstance(value, str) else []
    if not turns or set(turns) - set(TURNS):
        raise ParameterError(f"PocketCube: {name}={value!r}; expected turns, each one of {' '.join(TURNS)}")
    return " ".join(turns)


SCRAMBLE = Kind("turns such as U R2 F'", _scramble)


@dataclass(frozen=True, kw_only=True)
class PocketCube(Environment):
    """Turn the faces of a cube of 2 x 2 x 2 corners until each face has one colour.

    Rules    The corner down back left stays where it is, so the faces up, right and front turn. Turning
             one of the others is the same as turning the face opposite to it, and the whole cube.
    State    which corner is in each of the seven other places (up right front, up front left, up left back, up back
             right, down front right, down left front, down right back), and how each is twisted: clockwise thirds.
    Start    the solved cube after the turns of `scramble`, or a position drawn by `seed`.
    Actions  U, U2, U', R, R2, R', F, F2, F': the face up, right or front, turned clockwise by a quarter, a half, or
             three quarters. With `metric=quarter` without the half turns.
    Reward   -1 a turn, so that the undiscounted optimal return is minus the least number of turns.
    Ends     when each face has one colour.
    Limit    50 turns. 11 are enough for every position, 14 quarter turns.
    Ours     start and limit.
    Source   Jaap Scherphuis, "Mini Cube, the 2x2x2 Rubik's Cube". Names of faces and places as in H. Kociemba's
             two-phase algorithm.

    All 7! ways to place the seven corners can be had, with all twists that sum to a multiple of three: 7! * 3^6 =
    3,674,160 states. The solved one, which ends the episode, cuts none of them off: no node of a connected graph does
    that looks the same from every node.

    Attributes:
        metric: "half", in which half turns are one action, or "quarter", in which they are two.
        scramble: turns that lead from the solved cube to the start, such as "U R2 F'". None stands for turns to a
            position as far from it as any, in both metrics.
        seed: draws the start, each position but the solved one with the same probability.
    """

    metric: str = parameter("half", kind=one_of(*METRICS))
    scramble: str | None = parameter(None, kind=SCRAMBLE)
    seed: int | None = parameter(None, kind=int, low=0)

    name = "pocket_cube"
    version = 1
    max_episode_steps = 50
    layers = {
        "stickers": Layer(
            tuple(FACES),
            ((236, 236, 236), (196, 40, 44), (38, 150, 74), (240, 208, 50), (238, 128, 32), (44, 84, 190)),
            shape="block",
        )
    }

    look = Look(color="#CC79A7")
    instances = {
        "half": {"metric": "half"},
        "quarter": {"metric": "quarter"},
        "half-4": {"metric": "half", "scramble": "R U2 F' U"},
        "quarter-4": {"metric": "quarter", "scramble": "R U F' U"},
    }
    hyperparameters = {  # chosen by hand
        "q_learning": {"default": {"initial_q": 0.0}},
        "dqn": {"default": {"buffer_size": 100000, "target_update_interval": 1000, "exploration_final_eps": 0.02}},
    }

    @property
    def actions(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the turns that the metric counts as one."""
        return METRICS[self.metric]

    def validate(self) -> None:
        if self.scramble is not None and self.seed is not None:
            raise ParameterError("PocketCube: scramble was given with seed; expected one of them")
        if self.scramble is not None and self.is_terminal(self.initial_state()):
            raise ParameterError(f"PocketCube: scramble={self.scramble!r} leads to the solved cube; expected another")

    def variables(self):
        return {"corners": [range(MOVING)] * MOVING, "twists": [range(3)] * MOVING}

    def initial_state(self):
        if self.seed is not None:
            rng = np.random.Generator(np.random.PCG64(self.seed))
            while True:
                twists = [int(3 * draw) for draw in rng.random(MOVING - 1)]
                state = (*np.argsort(rng.random(MOVING)).tolist(), *twists, -sum(twists) % 3)
                if not self.is_terminal(state):
                    return state
        state = (*range(MOVING), *[0] * MOVING)
        for turn in (FAR if self.scramble is None else self.scramble).split():
            face, times = TURNS[turn]
            for _ in range(times):
                state = _turned(state, *QUARTERS[face])
        return state

    @cached_property
    def moves(self) -> np.ndarray:
        """(A, 2, 7) int64: the place from which each place gets its corner, and the twist that it adds."""
        tables = []
        for turn in self.actions:
            face, times = TURNS[turn]
            turned = (*range(MOVING), *[0] * MOVING)
            for _ in range(times):
                turned = _turned(turned, *QUARTERS[face])
            tables.append(np.reshape(turned, (2, MOVING)))
        return np.array(tables)

    @cached_property
    def stickers(self) -> np.ndarray:
        """(8, 3, 3) int64: for each place and each of its faces row and column on the net, and the colour, 1 to 6, that
        the corner which belongs there has on it when the cube is solved.
        """
        return np.array([[(*NET[i][k], 1 + FACES.index(CORNERS[i][k])) for k in range(3)] for i in range(len(CORNERS))])

    def transition(self, state, action, out):
        for i in range(MOVING):
            place = self.moves[action, 0, i]
            out[i] = state[place]
            out[MOVING + i] = (state[MOVING + place] + self.moves[action, 1, i]) % 3

    def is_terminal(self, state):
        for i in range(MOVING):
            if state[i] != i or state[MOVING + i] != 0:
                return False
        return True

    def reward(self, state, action, next_state):
        return -1.0

    def grid(self):
        return 6, 8

    def draw(self, state, planes):
        for i in range(MOVING + 1):
            corner, twist = (DBL, 0) if i == DBL else (state[i], state[MOVING + i])
            for k in range(3):
                row, column = self.stickers[i, (k + twist) % 3, 0], self.stickers[i, (k + twist) % 3, 1]
                planes[0, row, column] = self.stickers[corner, k, 2]


def _turned(state: tuple[int, ...], source: tuple[int, ...], twist: tuple[int, ...]) -> tuple[int, ...]:
    twists = ((state[MOVING + place] + added) % 3 for place, added in zip(source, twist, strict=True))
    return (*(state[place] for place in source), *twists)
