"""Deep sea: dive from the top left, one row a step, to the treasure at the bottom right. Source: bsuite."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import Environment, Layer, Look, parameter

ROW, COLUMN = range(2)


@dataclass(frozen=True, kw_only=True)
class DeepSea(Environment):
    """Dive through `size` rows, to the left or to the right in each. Only going right every time finds the treasure.

    State    (row, column), counted from the top-left corner, where every dive starts. After the last row (size, 0).
    Actions  first, second: one of them goes right and the other one left, which one is drawn for each cell by
             `mapping_seed`.
    Chance   stochastic: going right stays in its column with probability 1 / size. With `p_rand` an action that is
             drawn evenly is executed, while the choice pays.
    Reward   1 for choosing right in the last column, -move_cost / size for choosing right anywhere, left_reward for
             choosing left.
    Ends     after the last row.
    Limit    `size` steps: a dive.
    Ours     bsuite's stochastic sea adds noise with mean 0 to the rewards in both corners of the last row. Rewards here
             are the means. bsuite's optimal return, (1 - 1/size)^(size - 1) - move_cost, is for going right every time,
             even if the treasure is lost. The optimum saves the cost from then on and has move_cost (1 - 1/size)^size
             more.
    Source   bsuite deep_sea; Osband, Van Roy, Russo and Wen (2019), "Deep Exploration via Randomized Value Functions".
             Colosseum's DeepSea is `endless_sea`.

    Attributes:
        size: rows and columns, at least 2.
        stochastic: whether going right may fail.
        mapping_seed: of the actions, as bsuite draws them. None: the second action goes right everywhere.
        move_cost: of going right every time.
        left_reward: for each choice of left.
        p_rand: from 0 to 0.9999.
    """

    size: int = parameter(10, low=2, high=1000)
    stochastic: bool = parameter(False)
    mapping_seed: int | None = parameter(None, kind=int, low=0, high=2**32 - 1)
    move_cost: float = parameter(0.01, low=0.0)
    left_reward: float = parameter(0.0)
    p_rand: float = parameter(0.0, low=0.0, high=0.9999)

    name = "deep_sea"
    actions = ("first", "second")
    version = 1
    restarts = False  # whether a dive follows another one
    layers = {"treasure": Layer("T", (226, 190, 62), shape="goal"), "diver": Layer("D", (66, 72, 200), shape="agent")}
    look = Look(color="#332288")
    instances = {
        "10x10": {"mapping_seed": 42},
        "50x50": {"size": 50, "mapping_seed": 42},
        "10x10-stochastic": {"stochastic": True, "mapping_seed": 42},
    }
    foreign_parameters = {"deterministic": "write stochastic=true", "unscaled_move_cost": "write move_cost"}
    hyperparameters = {  # chosen by hand: hopeful values make Q-learning dive everywhere
        "q_learning": {"default": {"initial_q": 1.0}},
        "dqn": {"default": {"learning_rate": 0.001, "target_update_interval": 250, "exploration_fraction": 0.5}},
    }

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        """Outcomes: the chosen action; the other one; and each of them with a failure of going right."""
        return (2 if self.p_rand > 0 else 1) * (2 if self.stochastic else 1)

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return self.size

    @cached_property
    def right(self) -> np.ndarray:
        """(size, size) int64: the action that goes right."""
        if self.mapping_seed is None:
            return np.ones((self.size, self.size), np.int64)
        return np.random.RandomState(self.mapping_seed).binomial(1, 0.5, [self.size, self.size]).astype(np.int64)

    def variables(self):
        return {"row": range(self.size + (not self.restarts)), "column": range(self.size)}

    def initial_state(self):
        return (0, 0)

    def age(self, state):
        return state[ROW]

    def probability(self, state, action, outcome):
        if state[ROW] == self.size:
            return 1.0 if outcome == 0 else 0.0
        other = outcome % 2 if self.p_rand > 0 else 0
        fails = outcome // (2 if self.p_rand > 0 else 1)
        chance = self.p_rand / 2 if other == 1 else 1.0 - self.p_rand / 2
        if (action == self.right[state[ROW], state[COLUMN]]) == (other == 1):  # left is executed
            return 0.0 if fails == 1 else chance
        if not self.stochastic:
            return chance
        return chance / self.size if fails == 1 else chance * (1.0 - 1.0 / self.size)

    def transition(self, state, action, outcome, out):
        row, column = state[ROW], state[COLUMN]
        if row == self.size:
            return
        other = outcome % 2 if self.p_rand > 0 else 0
        fails = outcome // (2 if self.p_rand > 0 else 1)
        if (action == self.right[row, column]) == (other == 1):
            column = max(column - 1, 0)
        elif fails == 0:
            column = min(column + 1, self.size - 1)
        if row == self.size - 1:
            out[ROW] = 0 if self.restarts else self.size
            out[COLUMN] = 0
        else:
            out[ROW] = row + 1
            out[COLUMN] = column

    def is_terminal(self, state):
        return state[ROW] == self.size

    def reward(self, state, action, next_state):
        if action != self.right[state[ROW], state[COLUMN]]:
            return self.left_reward
        return float(state[COLUMN] == self.size - 1) - self.move_cost / self.size

    def grid(self):
        return self.size, self.size

    def draw(self, state, planes):
        planes[0, self.size - 1, self.size - 1] = 1
        if state[ROW] < self.size:
            planes[1, state[ROW], state[COLUMN]] = 1
