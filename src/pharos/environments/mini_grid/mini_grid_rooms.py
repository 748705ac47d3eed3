"""Colosseum's MiniGridRooms: rooms in a square, joined by doors, with the goal in another corner than the start.

Source: Conserva and Rauber (2022).
"""

import math
import random
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import Look, parameter
from pharos.environments.mini_grid.mini_grid_empty import Drawn, Place, RoomGrid
from pharos.errors import ParameterError


@dataclass(frozen=True, kw_only=True)
class MiniGridRooms(RoomGrid):
    """Turn and walk through `n_rooms` rooms of `room_size` x `room_size` cells to a goal in a corner room.

    Neighbouring rooms share a wall with one opening in its middle. State, reward, limit and chance are as in
    `mini_grid_empty`.

    Actions  as in `mini_grid_empty`: forward, turn right, turn left.
    Start    one of `n_starting_states` states of a corner room, all equally likely.
    Source   Conserva and Rauber (2022), "Hardness in Markov decision processes: theory and practice".

    Attributes:
        n_rooms: a square number, at least 4.
        room_size: cells on a side of a room, at least 2.
        n_starting_states: at most 4 room_size^2.
        seed: of the starts and the goal, as Colosseum draws them.
        p_lazy, p_rand: from 0 to 0.9999.
    """

    n_rooms: int = parameter(4, low=4, high=10_000)
    room_size: int = parameter(3, low=2, high=1000)
    n_starting_states: int = parameter(2, low=1, high=lambda env: 4 * env.room_size**2)

    name = "mini_grid_rooms"
    look = Look(ground="plain", color="#999933")
    instances = {
        "4x3": {"n_rooms": 4, "room_size": 3},
        "9x4": {"n_rooms": 9, "room_size": 4},
    }

    def validate(self) -> None:
        if math.isqrt(self.n_rooms) ** 2 != self.n_rooms:
            raise ParameterError(f"MiniGridRooms: n_rooms={self.n_rooms}; expected a square number, such as 4, 9 or 16")

    @property
    def rooms_per_side(self) -> int:
        """The square root of `n_rooms`."""
        return math.isqrt(self.n_rooms)

    @cached_property
    def is_free(self) -> np.ndarray:
        pitch = self.room_size + 1
        inside = np.arange(self.rooms_per_side * pitch - 1) % pitch
        in_room, is_middle = inside < self.room_size, inside == self.room_size // 2
        free = np.outer(in_room, in_room) | np.outer(~in_room, is_middle) | np.outer(is_middle, ~in_room)
        return free[::-1].copy()  # Colosseum counts y from below

    @cached_property
    def drawn(self) -> Drawn:
        lots, rng = random.Random(self.seed), np.random.RandomState(self.seed)
        last = self.rooms_per_side - 1
        corners = [(0, 0), (0, last), (last, 0), (last, last)]
        start = corners.pop(lots.randint(0, 3))
        goals = self._cells(corners[lots.randint(0, 2)])
        rng.shuffle(goals)
        starts = [(x, y, direction) for x, y in self._cells(start) for direction in range(4)]
        rng.shuffle(starts)
        return Drawn(goals[0], starts[: self.n_starting_states], starts)

    def _cells(self, room: Place) -> list[Place]:
        """The cells of a room, from its uppermost row down, as Colosseum lists them."""
        left, bottom = (self.room_size + 1) * room[0], (self.room_size + 1) * room[1]
        return [(left + i, bottom + j) for j in reversed(range(self.room_size)) for i in range(self.room_size)]
