"""Small environments for tests: a row of cells to derive others from, and random tables dressed as environments."""

import inspect
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from hypothesis import strategies as st

from pharos.environments import Environment


@dataclass(frozen=True, kw_only=True)
class Row(Environment):
    """A row of `length` cells, walked from the first one: a base for rules, good ones and broken ones."""

    length: int = 1000

    name = "row"
    actions = ("left", "right")
    variable = "cell"

    def variables(self):
        return {self.variable: range(self.length)}

    def initial_state(self):
        return (0,)

    def transition(self, state, action, out):
        out[0] = min(max(state[0] + 2 * action - 1, 0), self.length - 1)

    def reward(self, state, action, next_state):
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Corridor(Row):
    """A row whose last cell ends the episode and pays 1."""

    length: int = 5

    name = "corridor"

    def is_terminal(self, state):
        return state[0] == self.length - 1

    def reward(self, state, action, next_state):
        return 1.0 if next_state[0] == self.length - 1 else 0.0


def random_states(env: Environment, number: int, seed: int = 0) -> np.ndarray:
    """(N, D) whatever values the variables can have."""
    components = env.components
    return components.low + np.random.default_rng(seed).integers(0, components.size, (number, len(components)))


def code_of(*classes: type) -> str:
    """The text of a file that defines these classes, as a user would write it."""
    imports = "from dataclasses import dataclass\n\nfrom pharos.environments import Environment\n"
    return "\n\n".join([imports, *map(inspect.getsource, classes)])


@dataclass(frozen=True, kw_only=True)
class TableWorld(Environment):
    """`num_positions` positions; position p goes to moves[p][a] by action a, and ends the episode where ends[p].

    A position is written into the state in several components, of which only the first and the last together tell it;
    the ones between are wide or narrow, negative or constant, so that states differ in any of their words.
    """

    num_positions: int = 1
    seed: int = 0
    lows: str = "0"  # text: compiled rules see numbers only, and tuples of every length would be compiled anew
    sizes: str = "1"
    num_starts: int = 1
    end_share: float = 0.2

    name = "table_world"
    actions = ("first", "second", "third")
    BASE = 4

    @property
    def low(self) -> np.ndarray:
        """Lowest value of each component: the first, those between, the last."""
        return np.array([-3, *map(int, self.lows.split(",")), 5], np.int64)

    @property
    def size(self) -> np.ndarray:
        """Number of values of each component."""
        return np.array([-(-self.num_positions // self.BASE), *map(int, self.sizes.split(",")), self.BASE], np.int64)

    @cached_property
    def codes(self) -> np.ndarray:
        """(positions, D) the state of each position."""
        rng = np.random.default_rng(self.seed)
        codes = self.low + rng.integers(0, self.size, (self.num_positions, len(self.size)))
        position = np.arange(self.num_positions)
        codes[:, 0] = self.low[0] + position // self.BASE
        codes[:, -1] = self.low[-1] + position % self.BASE
        return codes

    @cached_property
    def moves(self) -> np.ndarray:
        """(positions, A) where each action leads."""
        rng = np.random.default_rng(self.seed + 1)
        return rng.integers(0, self.num_positions, (self.num_positions, len(self.actions)))

    @cached_property
    def ends(self) -> np.ndarray:
        """(positions,) whether the episode ends there."""
        rng = np.random.default_rng(self.seed + 2)
        return rng.random(self.num_positions) < self.end_share

    def variables(self):
        ranges = [range(int(low), int(low + size)) for low, size in zip(self.low, self.size, strict=True)]
        return {"high": ranges[0], "middle": ranges[1:-1], "low": ranges[-1]}

    def initial_states(self):
        positions = np.random.default_rng(self.seed + 3).integers(0, self.num_positions, self.num_starts)
        return [(tuple(self.codes[p].tolist()), 1 / self.num_starts) for p in positions]

    def transition(self, state, action, out):
        position = (state[0] - self.low[0]) * self.BASE + state[-1] - self.low[-1]
        target = self.moves[position, action]
        for i in range(len(state)):
            out[i] = self.codes[target, i]

    def is_terminal(self, state):
        return self.ends[(state[0] - self.low[0]) * self.BASE + state[-1] - self.low[-1]]

    def reward(self, state, action, next_state):
        return float(state[0] + 10 * action) - 0.5 * next_state[-1]


@st.composite
def table_worlds(draw, max_positions: int = 300) -> TableWorld:
    """Random transition tables, one to a few words wide."""
    ranges = st.tuples(
        st.integers(-(2**40), 2**40),
        st.sampled_from([1, 1, 2, 3, 7, 256, 2**20, 2**33, 2**62]) | st.integers(1, 2**63 - 1),
    )
    middle = draw(st.lists(ranges, min_size=1, max_size=9))
    middle = [(low, min(size, 2**63 - 1 - max(low, 0))) for low, size in middle]
    return TableWorld(
        num_positions=draw(st.integers(1, max_positions)),
        seed=draw(st.integers(0, 2**32)),
        lows=",".join(str(low) for low, _ in middle),
        sizes=",".join(str(size) for _, size in middle),
        num_starts=draw(st.integers(1, 5)),
        end_share=draw(st.sampled_from([0.0, 0.2, 1.0])),
    )


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
