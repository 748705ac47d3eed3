"""Frozen lake: reach the goal and do not fall into a hole. Source: Gymnasium's FrozenLake-v1; the pharos paper, 3.3."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import Environment, Layer, Look, parameter, store
from pharos.errors import ParameterError

ROW, COLUMN = range(2)
LEFT, DOWN, RIGHT, UP = range(4)
ICE, START, HOLE, GOAL = range(4)
LETTERS = "FSHG"

MAPS = {  # as in Gymnasium's FrozenLake-v1
    4: "SFFF/FHFH/FFFH/HFFG",
    8: "SFFFFFFF/FFFFFFFF/FFFHFFFF/FFFFFHFF/FFFHFFFF/FHHFFFHF/FHFFHFHF/FFFHFFFG",
}
FROZEN_PROBABILITY = 0.8
ATTEMPTS = 10_000


@dataclass(frozen=True, kw_only=True)
class FrozenLake(Environment):
    """Walk over a frozen lake to the goal, around the holes.

    State    (row, column), counted from the top-left corner. The episode starts on the tile S.
    Actions  left, down, right, up, numbered as in Gymnasium. Walking into the shore changes nothing.
    Reward   1 on reaching the goal, otherwise 0.
    Ends     on reaching the goal or falling into a hole.
    Limit    25 steps for each cell of the longer side: 100 on the 4x4 map and 200 on the 8x8 map, as in Gymnasium.
    Chance   on slippery ice the chosen action is executed, or one of the two perpendicular ones, 1/3 each, and never
             the opposite one. No `random_actions(p)` expresses that, because it executes each action with at least
             p / 4.
    Ours     the ice is not slippery unless `slippery` says so. In Gymnasium it is by default.
    Source   Gymnasium FrozenLake-v1 (Brockman et al., 2016); the pharos paper, section 3.3.

    Attributes:
        size: 4 or 8 for Gymnasium's maps, or the side of a random map. None stands for 4, or for the size of `map`.
        map: own map, rows of S (start), F (ice), H (hole) and G (goal) separated by "/", spaces or line ends. It has
            one S, at least one G, and a way from S to a G.
        seed: draws a random map of `size` x `size` that has a way to the goal, start top left, goal bottom right.
        frozen_probability: of each tile of a random map to be ice, in (0, 1], as in Gymnasium 0.8.
        slippery: whether the ice is, Gymnasium's `is_slippery`.
    """

    size: int | None = parameter(None, kind=int, low=2)
    map: str | None = None
    seed: int | None = parameter(None, kind=int, low=0)
    frozen_probability: float = parameter(FROZEN_PROBABILITY, low=0.0, high=1.0)
    slippery: bool = parameter(False, added=True)

    name = "frozen_lake"
    actions = ("left", "down", "right", "up")
    version = 1
    numbered_by = ("row", "column")
    layers = {
        "holes": Layer("O", (110, 110, 110)),
        "goal": Layer("G", (236, 236, 236)),
        "agent": Layer("A", (66, 72, 200)),
    }

    look = Look(ground="ice", color="#56B4E9")
    instances = {"4x4": {"size": 4}, "8x8": {"size": 8}}
    paper_instances = ("4x4", "8x8")
    foreign_parameters = {"is_slippery": "it is called slippery here: slippery=True"}
    hyperparameters = {
        # With a discount of 0.99 the goal of 8x8 is not found.
        "dqn": {
            "default": {
                "gamma": 0.95,
                "learning_rate": 0.001,
                "target_update_interval": 1000,
                "exploration_fraction": 0.5,
                "exploration_final_eps": 0.02,
            }
        }
    }

    def validate(self) -> None:
        if self.map is not None:
            if self.size is not None or self.seed is not None:
                raise ParameterError("FrozenLake: map was given with size or seed; expected a map alone")
            store(self, "map", _checked_map(self.map))
            return
        if self.size is None:
            store(self, "size", 4)
        if self.seed is not None:
            _ = self.tiles
        elif self.size not in MAPS:
            raise ParameterError(
                f"FrozenLake: size={self.size} has no map of its own; expected 4 or 8, or seed=... for a random map"
            )
        elif self.frozen_probability != FROZEN_PROBABILITY:
            raise ParameterError(
                f"FrozenLake: frozen_probability={self.frozen_probability} has no effect without a seed; add seed=..."
            )

    @cached_property
    def tiles(self) -> np.ndarray:
        """(rows, columns) int64: ICE, START, HOLE or GOAL."""
        if self.map is not None:
            return _tiles(self.map)
        assert self.size is not None
        if self.seed is None:
            return _tiles(MAPS[self.size])
        return _random_tiles(self.size, self.seed, self.frozen_probability)

    @property
    def height(self) -> int:
        """Rows of the map."""
        return self.tiles.shape[0]

    @property
    def width(self) -> int:
        """Columns of the map."""
        return self.tiles.shape[1]

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return 25 * max(self.height, self.width)

    def variables(self):
        return {"row": range(self.height), "column": range(self.width)}

    def initial_state(self):
        row, column = np.argwhere(self.tiles == START)[0]
        return int(row), int(column)

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        """Three on slippery ice: the action before the chosen one, the chosen one, the one after it; else one."""
        return 3 if self.slippery else 1

    def probability(self, state, action, outcome):
        return 1 / 3 if self.slippery else 1.0

    def transition(self, state, action, outcome, out):
        executed = (action + outcome + 3) % 4 if self.slippery else action
        row = state[ROW] + (executed == DOWN) - (executed == UP)
        column = state[COLUMN] + (executed == RIGHT) - (executed == LEFT)
        out[ROW] = min(max(row, 0), self.height - 1)
        out[COLUMN] = min(max(column, 0), self.width - 1)

    def is_terminal(self, state):
        return self.tiles[state[ROW], state[COLUMN]] >= HOLE

    def reward(self, state, action, next_state):
        return 1.0 if self.tiles[next_state[ROW], next_state[COLUMN]] == GOAL else 0.0

    def grid(self):
        return self.height, self.width

    def draw(self, state, planes):
        for row in range(self.height):
            for column in range(self.width):
                tile = self.tiles[row, column]
                if tile == HOLE:
                    planes[0, row, column] = 1
                if tile == GOAL:
                    planes[1, row, column] = 1
        planes[2, state[ROW], state[COLUMN]] = 1


def _checked_map(text: object) -> str:
    """The map with its rows separated by "/"; ParameterError if the text is no map."""
    rows = str(text).upper().replace("/", " ").split() if isinstance(text, str) else []
    if not rows or len({len(row) for row in rows}) > 1 or set("".join(rows)) - set(LETTERS):
        raise ParameterError(f"FrozenLake: map={text!r}; expected rows of equal length of the letters S, F, H and G")
    joined = "/".join(rows)
    if joined.count("S") != 1 or "G" not in joined:
        raise ParameterError(
            f"FrozenLake: map has {joined.count('S')} S and {joined.count('G')} G; expected one S and at least one G"
        )
    if not _has_a_way(_tiles(joined)):
        raise ParameterError(f"FrozenLake: map={joined!r} has no way from S to G; expected one")
    return joined


def _tiles(text: str) -> np.ndarray:
    return np.array([[LETTERS.index(letter) for letter in row] for row in text.split("/")], np.int64)


def _random_tiles(size: int, seed: int, frozen_probability: float) -> np.ndarray:
    """The first drawn map with a way to the goal."""
    rng = np.random.Generator(np.random.PCG64(seed))
    for _ in range(ATTEMPTS):
        tiles = np.where(rng.random((size, size)) < frozen_probability, ICE, HOLE).astype(np.int64)
        tiles[0, 0], tiles[-1, -1] = START, GOAL
        if _has_a_way(tiles):
            return tiles
    raise ParameterError(
        f"FrozenLake: none of {ATTEMPTS} random maps with size={size}, frozen_probability={frozen_probability} "
        f"has a way to the goal; raise frozen_probability"
    )


def _has_a_way(tiles: np.ndarray) -> bool:
    frontier = [tuple(cell) for cell in np.argwhere(tiles == START)]
    region = set(frontier)
    while frontier:
        row, column = frontier.pop()
        if tiles[row, column] == GOAL:
            return True
        for cell in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            inside = 0 <= cell[0] < tiles.shape[0] and 0 <= cell[1] < tiles.shape[1]
            if inside and cell not in region and tiles[cell] != HOLE:
                region.add(cell)
                frontier.append(cell)
    return False
