"""Colosseum's MiniGridEmpty: turn and walk over a grid that never ends an episode. A goal on the far side pays.

`RoomGrid` is what it has in common with `mini_grid_rooms`. Source: Conserva and Rauber (2022).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pharos.environments.base import Environment, Look, parameter
from pharos.environments.mini_grid.look import LAYERS

ROW, COLUMN, DIRECTION = range(3)
UP, RIGHT, DOWN, LEFT = range(4)
FORWARD, TURN_RIGHT, TURN_LEFT = range(3)
GOAL_LAYER, WALL_LAYER, PLAYER_LAYER = range(3)

Place = tuple[int, int]


class Drawn(NamedTuple):
    """Goal and start states that Colosseum draws by its seed, in its coordinates: (x, y), y upwards.

    Attributes:
        goal: the cell that pays.
        starts: (x, y, direction) of the start states, all equally likely.
        possible_starts: those that another seed could have drawn on the same side, or in the same room.
    """

    goal: Place
    starts: Sequence[tuple[int, int, int]]
    possible_starts: Sequence[tuple[int, int, int]]


@dataclass(frozen=True, kw_only=True)
class RoomGrid(Environment):
    """A player that turns and walks in rooms: the rules of `mini_grid_empty` and `mini_grid_rooms`."""

    n_starting_states: int = parameter(1, low=1)
    seed: int = parameter(0, low=0, high=2**32 - 1)
    p_lazy: float = parameter(0.0, low=0.0, high=0.9999)
    p_rand: float = parameter(0.0, low=0.0, high=0.9999)

    actions = ("forward", "turn right", "turn left")
    layers = {name: LAYERS[name] for name in ("goal", "walls", "player")}
    hyperparameters = {  # chosen by hand: the goal pays at every step that is spent on it
        "q_learning": {"default": {"gamma": 0.95, "initial_q": 5.0}},
        "dqn": {"default": {"gamma": 0.95, "learning_rate": 0.001, "exploration_fraction": 0.5}},
        "ppo": {"default": {"gamma": 0.95}},
    }

    @cached_property
    def is_free(self) -> np.ndarray:
        """(rows, columns) bool: no wall."""
        raise NotImplementedError

    @cached_property
    def drawn(self) -> Drawn:
        """Goal and start states, as Colosseum draws them."""
        raise NotImplementedError

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        """The action itself; each other action, with `p_rand`; nothing, with `p_lazy`."""
        return 1 + 2 * (self.p_rand > 0) + (self.p_lazy > 0)

    @property
    def goal(self) -> Place:
        """(row, column)."""
        x, y = self.drawn.goal
        return len(self.is_free) - 1 - y, x

    @cached_property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        """Colosseum's shortest horizon: from any possible start to any state, and one step more."""
        rows, columns = self.is_free.shape
        starts = self.drawn.possible_starts
        reached = np.zeros((len(starts), rows, columns, 4), bool)
        for number, (x, y, direction) in enumerate(starts):
            reached[number, rows - 1 - y, x, direction] = True
        steps = 0
        while not reached[:, self.is_free].all():
            grown = reached | np.roll(reached, 1, axis=3) | np.roll(reached, -1, axis=3)
            grown[:, :-1, :, UP] |= reached[:, 1:, :, UP]
            grown[:, 1:, :, DOWN] |= reached[:, :-1, :, DOWN]
            grown[:, :, 1:, RIGHT] |= reached[:, :, :-1, RIGHT]
            grown[:, :, :-1, LEFT] |= reached[:, :, 1:, LEFT]
            reached = grown & self.is_free[:, :, None]
            steps += 1
        return steps + 1

    def variables(self):
        rows, columns = self.is_free.shape
        return {"row": range(rows), "column": range(columns), "direction": range(4)}

    def initial_states(self):
        top = len(self.is_free) - 1
        starts = self.drawn.starts
        return [((top - y, x, direction), 1 / len(starts)) for x, y, direction in starts]

    def initial_state(self):
        return self.initial_states()[0][0]

    def probability(self, state, action, outcome):
        acts = 1.0 - self.p_lazy
        if self.p_lazy > 0 and outcome == self.outcomes - 1:
            return self.p_lazy
        return acts * (1.0 - self.p_rand + self.p_rand / 3) if outcome == 0 else acts * self.p_rand / 3

    def transition(self, state, action, outcome, out):  # type: ignore[override]
        if self.p_lazy > 0 and outcome == self.outcomes - 1:
            return
        taken = (action + outcome) % 3
        direction = state[DIRECTION]
        if taken == TURN_RIGHT:
            out[DIRECTION] = (direction + 1) % 4
        elif taken == TURN_LEFT:
            out[DIRECTION] = (direction + 3) % 4
        else:
            row = state[ROW] + (direction == DOWN) - (direction == UP)
            column = state[COLUMN] + (direction == RIGHT) - (direction == LEFT)
            rows, columns = self.is_free.shape
            if 0 <= row < rows and 0 <= column < columns and self.is_free[row, column]:
                out[ROW] = row
                out[COLUMN] = column

    def reward(self, state, action, next_state):
        return float(next_state[ROW] == self.goal[0] and next_state[COLUMN] == self.goal[1])

    def grid(self):
        return self.is_free.shape

    def draw(self, state, planes):
        rows, columns = self.is_free.shape
        planes[GOAL_LAYER, self.goal[0], self.goal[1]] = 1
        for row in range(rows):
            for column in range(columns):
                if not self.is_free[row, column]:
                    planes[WALL_LAYER, row, column] = 1
        planes[PLAYER_LAYER, state[ROW], state[COLUMN]] = 1 + (state[DIRECTION] + 3) % 4  # glyphs begin with ">"


@dataclass(frozen=True, kw_only=True)
class MiniGridEmpty(RoomGrid):
    """Turn and walk over an empty grid of `size` x `size` cells to the goal on the far side, and stay there.

    State    (row, column, direction: up, right, down, left).
    Start    one of `n_starting_states` cells of one side of the grid, each with a direction, all equally likely.
    Actions  forward, turn right, turn left. A step into the border changes nothing.
    Reward   1 for every step that ends on the goal, a turn on it included, otherwise 0.
    Ends     never. Colosseum's episodic setting is a horizon, such as the limit. Its continuous one has none.
    Limit    Colosseum's shortest horizon: steps from any state of the start's side to the farthest state, and one more.
    Chance   with `p_lazy` nothing happens, else with `p_rand` an action that is drawn evenly, as by `random_actions`.
    Ours     rewards are the means of Colosseum's. Its actions change their numbers from state to state. These do not,
             which no measure of hardness notices.
    Source   Conserva and Rauber (2022), "Hardness in Markov decision processes: theory and practice".

    Attributes:
        size: of the side, at least 3.
        n_starting_states: at most `size` count.
        seed: of the starts and the goal, as Colosseum draws them.
        p_lazy, p_rand: from 0 to 0.9999.
    """

    size: int = parameter(8, low=3, high=1000)

    name = "mini_grid_empty"
    look = Look(ground="plain", color="#AA4499")
    instances = {
        "8x8": {"size": 8, "n_starting_states": 3},
        "8x8-lazy": {"size": 8, "n_starting_states": 3, "p_lazy": 0.1},
    }

    @cached_property
    def is_free(self) -> np.ndarray:
        return np.ones((self.size, self.size), bool)

    @cached_property
    def drawn(self) -> Drawn:
        rng = np.random.RandomState(self.seed)
        side = rng.randint(4)
        goal = self._side((side + 2) % 4)[rng.randint(self.size)]
        cells = self._side(side)
        rng.shuffle(cells)
        starts = [(x, y, rng.randint(4)) for x, y in cells[: self.n_starting_states]]
        return Drawn(goal, starts, [(x, y, direction) for x, y in cells for direction in range(4)])

    def _side(self, side: int) -> list[Place]:
        """The cells of the left, lower, right or upper side, in the order in which Colosseum draws from them."""
        last = self.size - 1
        if side in (0, 1):
            return [(0, i) if side == 0 else (i, 0) for i in range(self.size)]
        return [(last, last - i) if side == 2 else (last - i, last) for i in range(self.size)]
