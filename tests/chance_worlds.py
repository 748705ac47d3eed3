"""Random environments with chance: a table of outcomes and their probabilities dressed as an Environment."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from hypothesis import strategies as st

from pharos.environments import Environment


@dataclass(frozen=True, kw_only=True)
class ChanceWorld(Environment):
    """`num_positions` positions; outcome k of action a leads from p to moves[p, a, k] with probability likely[p, a, k].

    Args:
        vectors: how many different distributions there are; 0 for another one of each position and action.
        possible_share: of the outcomes.
    """

    num_positions: int = 1
    seed: int = 0
    vectors: int = 3
    possible_share: float = 0.7
    end_share: float = 0.2
    num_starts: int = 1

    name = "chance_world"
    actions = ("first", "second")
    outcomes = 3

    @cached_property
    def moves(self) -> np.ndarray:
        """(positions, A, K) where each outcome leads."""
        rng = np.random.default_rng(self.seed)
        return rng.integers(0, self.num_positions, (self.num_positions, len(self.actions), self.outcomes))

    @cached_property
    def likely(self) -> np.ndarray:
        """(positions, A, K) how likely they are."""
        rng = np.random.default_rng(self.seed + 1)
        pairs = self.num_positions * len(self.actions)
        weights = rng.integers(1, 50, (self.vectors or pairs, self.outcomes))
        weights = np.where(rng.random(weights.shape) < self.possible_share, weights, 0)
        weights[:, 1] += weights.sum(axis=1) == 0
        probabilities = weights / weights.sum(axis=1, keepdims=True)
        which = rng.integers(0, self.vectors, pairs) if self.vectors else np.arange(pairs)
        return probabilities[which].reshape(self.num_positions, len(self.actions), self.outcomes)

    @cached_property
    def ends(self) -> np.ndarray:
        """(positions,) whether the episode ends there."""
        return np.random.default_rng(self.seed + 2).random(self.num_positions) < self.end_share

    def variables(self):
        return {"position": range(self.num_positions)}

    def initial_states(self):
        positions = np.random.default_rng(self.seed + 3).integers(0, self.num_positions, self.num_starts)
        return [((int(p),), 1 / self.num_starts) for p in positions]

    def probability(self, state, action, outcome):
        return self.likely[state[0], action, outcome]

    def transition(self, state, action, outcome, out):
        out[0] = self.moves[state[0], action, outcome]

    def is_terminal(self, state):
        return self.ends[state[0]]

    def reward(self, state, action, next_state):
        return float((7 * state[0] + 3 * action + next_state[0]) % 5) - 1.0


@st.composite
def chance_worlds(draw, max_positions: int = 200) -> ChanceWorld:
    """Random tables of outcomes: few distributions or many, dense or sparse."""
    return ChanceWorld(
        num_positions=draw(st.integers(1, max_positions)),
        seed=draw(st.integers(0, 2**32)),
        vectors=draw(st.sampled_from([0, 1, 3])),
        possible_share=draw(st.sampled_from([0.0, 0.3, 0.7, 1.0])),
        end_share=draw(st.sampled_from([0.0, 0.2, 1.0])),
        num_starts=draw(st.integers(1, 3)),
    )
