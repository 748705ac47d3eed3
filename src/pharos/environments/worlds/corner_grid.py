"""Colosseum's SimpleGrid: staying in some of the corners of a grid pays, staying in the others costs the usual reward.

Source: Conserva and Rauber (2022). (`simple_grid` is the grid world of the pharos paper.)
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import Environment, Layer, Look, one_of, parameter

ROW, COLUMN = range(2)
UP, RIGHT, DOWN, LEFT, STAY = range(5)


@dataclass(frozen=True, kw_only=True)
class CornerGrid(Environment):
    """Walk over a grid of `size` x `size` cells from its middle to a corner that pays, and stay there.

    State    (row, column), counted from the top-left corner.
    Start    one of the `n_starting_states` cells that are nearest to the middle, all equally likely.
    Actions  up, right, down, left, stay. Walking into a wall changes nothing.
    Chance   with `p_lazy` nothing happens, else with `p_rand` an action that is drawn evenly.
    Reward   1 for a step that stays in a paying corner, 0 for one that stays in another corner, 0.5 otherwise.
    Ends     never. Colosseum's episodic setting is a horizon, such as the limit. Its continuous one has none.
    Limit    Colosseum's shortest horizon: steps from any possible start to the farthest corner, and one more.
    Ours     rewards are the means of Colosseum's. Its actions change their numbers from state to state. These do not,
             which no measure of hardness notices.
    Source   SimpleGrid of Colosseum; Conserva and Rauber (2022), "Hardness in Markov decision processes: theory and
             practice".

    Attributes:
        size: of the side, at least 2.
        pays: which corners, said of "not left" and "not at the bottom": and (the upper right), nand (the other three),
            or (all but the lower left), xor (the upper left and the lower right).
        n_starting_states: at most (size - 1)^2.
        seed: of the starts, if several cells are equally near, as Colosseum draws them.
        p_lazy, p_rand: from 0 to 0.9999.
    """

    size: int = parameter(8, low=2, high=1000)
    pays: str = parameter("xor", kind=one_of("and", "nand", "or", "xor"))
    n_starting_states: int = parameter(1, low=1, high=lambda env: (env.size - 1) ** 2)
    seed: int = parameter(0, low=0, high=2**32 - 1)
    p_lazy: float = parameter(0.0, low=0.0, high=0.9999)
    p_rand: float = parameter(0.0, low=0.0, high=0.9999)

    name = "corner_grid"
    actions = ("up", "right", "down", "left", "stay")
    version = 1
    layers = {
        "corners": Layer(("+", "-"), ((90, 170, 90), (190, 90, 80))),
        "agent": Layer("A", (66, 72, 200)),
    }
    look = Look(ground="tiles", color="#88CCEE")
    instances = {"8x8": {}, "8x8-random": {"n_starting_states": 3, "p_rand": 0.09}}
    foreign_parameters = {"reward_type": "write pays=and, nand, or, xor"}
    hyperparameters = {  # chosen by hand: every step pays
        "q_learning": {"default": {"gamma": 0.95, "initial_q": 15.0}},
        "dqn": {"default": {"gamma": 0.95, "learning_rate": 0.001, "exploration_fraction": 0.5}},
    }

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        """The action itself; each other action, with `p_rand`; nothing, with `p_lazy`."""
        return 1 + 4 * (self.p_rand > 0) + (self.p_lazy > 0)

    @cached_property
    def by_distance(self) -> list[tuple[int, int]]:
        """The possible starts, in Colosseum's order and coordinates: (x, y), y upwards, the nearest first."""
        middle = (self.size - 1) / 2
        cells = [(x, y) for x in range(self.size) for y in range(self.size)]
        distances = [(x - middle) ** 2 + (y - middle) ** 2 for x, y in cells]
        nearest = [cell for cell, distance in zip(cells, distances, strict=True) if distance == min(distances)]
        others = [cell for _, cell in sorted(zip(distances, cells, strict=True)) if cell not in nearest]
        np.random.RandomState(self.seed).shuffle(nearest)
        return [*nearest, *others][: (self.size - 1) ** 2]

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        last = self.size - 1
        return max(max(x, last - x) + max(y, last - y) for x, y in self.by_distance) + 1

    @cached_property
    def corners(self) -> np.ndarray:
        """(size, size) int64: 1 in cells that pay for staying, 2 in the other corners, 0 elsewhere."""
        table = np.zeros((self.size, self.size), np.int64)
        for right in (False, True):
            for up in (False, True):
                pays = {"and": right and up, "nand": not (right and up), "or": right or up, "xor": right != up}
                table[0 if up else -1, -1 if right else 0] = 1 if pays[self.pays] else 2
        return table

    def variables(self):
        return {"row": range(self.size), "column": range(self.size)}

    def initial_states(self):
        starts = self.by_distance[: self.n_starting_states]
        return [((self.size - 1 - y, x), 1 / len(starts)) for x, y in starts]

    def probability(self, state, action, outcome):
        if self.p_lazy > 0 and outcome == self.outcomes - 1:
            return self.p_lazy
        share = self.p_rand / 5 if outcome > 0 else 1.0 - self.p_rand + self.p_rand / 5
        return (1.0 - self.p_lazy) * share

    def transition(self, state, action, outcome, out):
        if self.p_lazy > 0 and outcome == self.outcomes - 1:
            return
        way = (action + outcome) % 5
        out[ROW] = min(max(state[ROW] + (way == DOWN) - (way == UP), 0), self.size - 1)
        out[COLUMN] = min(max(state[COLUMN] + (way == RIGHT) - (way == LEFT), 0), self.size - 1)

    def reward(self, state, action, next_state):
        if next_state[ROW] != state[ROW] or next_state[COLUMN] != state[COLUMN]:
            return 0.5
        corner = self.corners[state[ROW], state[COLUMN]]
        return 0.5 if corner == 0 else float(corner == 1)

    def grid(self):
        return self.size, self.size

    def draw(self, state, planes):
        last = self.size - 1
        planes[0, 0, 0], planes[0, 0, last] = self.corners[0, 0], self.corners[0, last]
        planes[0, last, 0], planes[0, last, last] = self.corners[last, 0], self.corners[last, last]
        planes[1, state[ROW], state[COLUMN]] = 1
