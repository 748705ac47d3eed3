"""States of an MDP as the page shows them: variables, layers, and actions of a learned policy.

`States`: the variables of a state space, or the number itself if there are none. `StateLayers`, breadth-first: the
states whose shortest way from a start state has 0, 1, 2, ... steps. `Learnt`: the policy of a run, its table, its
value, and its losses.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import Dynamics, TabularMDP
from pharos.policies import Observer, PolicyAnswers, PolicyLike, TabularAgent, evaluate_policy
from pharos.solvers import Solution
from pharos.state_space import StateSpace

MOST_AXIS_CELLS = 128  # intervals of an axis
ROW_CELLS = 24  # values of an only variable that make one row


class States(Protocol):
    """S states of D variables.

    Attributes:
        names: of the D variables.
        low, size: (D,) the least value of each variable, and how many it may have.
    """

    num_states: int
    low: np.ndarray
    size: np.ndarray

    @property
    def names(self) -> tuple[str, ...]: ...

    def values(self, states: np.ndarray) -> np.ndarray:
        """(N, D) int64, the values of states (N,)."""

    def column(self, variable: int, block: slice) -> np.ndarray:
        """(N,) int64, the values of one variable in a block of states."""

    def matching(self, fixed: Mapping[int, int], block: slice) -> np.ndarray:
        """(N,) bool: which states of a block have these values, of the variables that are named by their number."""

    def number(self, values: Sequence[int]) -> int:
        """The number of the state that has these values. ParameterError if it is not reachable."""


class SpaceStates:
    """The states of a state space, read from its packed words.

    The states of a block that have some values are found by one mask and one comparison a word.
    """

    def __init__(self, space: StateSpace):
        self.space, self.num_states, self.names = space, space.num_states, space.component_names
        self.low, self.size = space.layout.low, space.layout.size

    def values(self, states: np.ndarray) -> np.ndarray:
        return self.space.states(np.asarray(states, np.int64))

    def column(self, variable: int, block: slice) -> np.ndarray:
        return self.space.column(variable, block)

    def matching(self, fixed: Mapping[int, int], block: slice) -> np.ndarray:
        layout, packed = self.space.layout, self.space.packed_states
        result = np.ones(len(range(*block.indices(self.num_states))), np.bool_)
        for word in sorted({int(layout.word[variable]) for variable in fixed}):
            mask = wanted = 0
            for variable, value in fixed.items():
                if int(layout.word[variable]) == word:
                    mask |= int(layout.mask[variable]) << int(layout.shift[variable])
                    wanted |= (value - int(self.low[variable])) << int(layout.shift[variable])
            result &= (packed[block, word] & np.uint64(mask)) == np.uint64(wanted)
        return result

    def number(self, values: Sequence[int]) -> int:
        return self.space.index(values)


class NumberedStates:
    """States with one variable: their number."""

    names = ("state",)

    def __init__(self, num_states: int):
        self.num_states = num_states
        self.low, self.size = np.zeros(1, np.int64), np.array([num_states])

    def values(self, states: np.ndarray) -> np.ndarray:
        return np.asarray(states, np.int64)[:, None]

    def column(self, variable: int, block: slice) -> np.ndarray:
        return np.arange(self.num_states)[block]

    def matching(self, fixed: Mapping[int, int], block: slice) -> np.ndarray:
        result = np.ones(len(range(*block.indices(self.num_states))), np.bool_)
        for variable, value in fixed.items():
            result &= self.column(variable, block) == value
        return result

    def number(self, values: Sequence[int]) -> int:
        if len(values) != 1 or not 0 <= values[0] < self.num_states:
            raise ParameterError(f"state {tuple(values)} does not exist; expected a number below {self.num_states}")
        return int(values[0])


class NamedStates:
    """States with the variables that an MDP names, such as the variables of an imported model."""

    def __init__(self, variables: Mapping[str, np.ndarray]):
        self.names = tuple(variables)
        self._columns = np.stack([np.asarray(column, np.int64) for column in variables.values()], axis=1)
        self.num_states = len(self._columns)
        self.low = self._columns.min(axis=0)
        self.size = self._columns.max(axis=0) - self.low + 1

    def values(self, states: np.ndarray) -> np.ndarray:
        return self._columns[states]

    def column(self, variable: int, block: slice) -> np.ndarray:
        return self._columns[block, variable]

    def matching(self, fixed: Mapping[int, int], block: slice) -> np.ndarray:
        part = self._columns[block]
        return np.all([part[:, variable] == value for variable, value in fixed.items()] or [np.ones(len(part))], axis=0)

    def number(self, values: Sequence[int]) -> int:
        if len(values) == len(self.low):
            same = np.flatnonzero((self._columns == np.asarray(values)).all(axis=1))
            if len(same):
                return int(same[0])
        raise ParameterError(f"no state has the values {tuple(values)} of {', '.join(self.names)}")


@dataclass(frozen=True)
class Axis:
    """An axis of a heat map: a variable, or a part of the only one, in intervals of equal width.

        interval = ((value - origin) // divisor % modulus) // width, without `% modulus` if that is 0

    Attributes:
        name: as the page asks for it.
        variable: number of the variable.
        origin: its least value.
        low, count, width: what the first interval is called, how many intervals, values in each of them.
    """

    name: str
    variable: int
    origin: int
    low: int
    count: int
    width: int = 1
    divisor: int = 1
    modulus: int = 0

    def indices(self, values: np.ndarray) -> np.ndarray:
        """(N,) the intervals of values of the variable."""
        part = (values - self.origin) // self.divisor
        return (part % self.modulus if self.modulus else part) // self.width


def axes_of(states: States) -> dict[str, Axis]:
    """Name -> axis. A variable each. If there is but one, its values fill a row, or rows if there are many."""
    if len(states.names) == 1:
        return {axis.name: axis for axis in _folded(states.names[0], int(states.low[0]), int(states.size[0]))}
    listed = enumerate(zip(states.names, states.low.tolist(), states.size.tolist(), strict=True))
    return {name: Axis(name, i, low, low, *_intervals(size)) for i, (name, low, size) in listed}


def _folded(name: str, low: int, size: int) -> tuple[Axis, Axis]:
    """The axes across and down of the only variable."""
    if size <= ROW_CELLS:
        return Axis(name, 0, low, low, size), Axis("all", 0, low, 0, 1, 1, size)
    side = min(MOST_AXIS_CELLS, math.ceil(math.sqrt(size)))
    rows = Axis(f"{name} div {side}", 0, low, 0, *_intervals(-(-size // side)), side)
    return Axis(f"{name} mod {side}", 0, low, 0, side, 1, 1, side), rows


def _intervals(size: int) -> tuple[int, int]:
    """(number of intervals, values in each)."""
    width = -(-size // MOST_AXIS_CELLS)
    return -(-size // width), width


# Layers ---------------------------------------------------------------------------------------------------------------


STATES_PER_BLOCK = 1 << 16  # states whose successors are looked at in one go
BARS = 200  # of the drawing of all layers


class StateLayers:
    """The layers of an MDP.

    Args:
        is_numbered: whether states are numbered layer by layer, as in a state space: then a layer is a range
            of numbers, and nothing is kept of each state.
    Attributes:
        counts: (L,) states of each layer.
    Cost: one read of the successors, and 8 bytes a state while they are read.
    """

    def __init__(self, mdp: TabularMDP, *, is_numbered: bool):
        self._order: np.ndarray | None = None  # states, layer by layer, if their numbers are not in this order
        self._of_states: np.ndarray | None = None
        if is_numbered:
            ends = _ends(mdp.dynamics, len(mdp.starts))
        else:
            self._of_states = _distances(mdp)
            states = np.flatnonzero(self._of_states >= 0)
            self._order = states[np.argsort(self._of_states[states], kind="stable")]
            ends = np.cumsum(np.bincount(self._of_states[states]))
        self._ends = ends
        self.counts = np.diff(ends, prepend=0)

    def of(self, states: np.ndarray) -> np.ndarray:
        """(N,) the layers of states, -1 of states that no actions lead to."""
        if self._of_states is not None:
            return self._of_states[states]
        return np.searchsorted(self._ends, states, side="right")

    def states(self, layer: int) -> np.ndarray:
        """(N,) the states of a layer, ascending."""
        first, last = int(self._ends[layer - 1]) if layer else 0, int(self._ends[layer])
        return np.arange(first, last) if self._order is None else self._order[first:last]

    def bars(self) -> dict[str, list[int]]:
        """Numbers of states in at most BARS groups of consecutive layers: `first` layer and `count` of each group."""
        width = -(-len(self.counts) // BARS)
        first = np.arange(0, len(self.counts), width)
        return {"first": first.tolist(), "count": np.add.reduceat(self.counts, first).tolist()}


def _ends(dynamics: Dynamics, num_starts: int) -> np.ndarray:
    """(L,) the number after the last state of each layer. A layer ends with the last state that the layer before leads
    to."""
    farthest = np.maximum.accumulate(_largest_successors(dynamics))
    ends = [num_starts]
    while ends[-1] < dynamics.num_states:
        after = int(farthest[ends[-1] - 1]) + 1
        if after <= ends[-1]:
            break
        ends.append(after)
    return np.array(ends)


def _largest_successors(dynamics: Dynamics) -> np.ndarray:
    result = np.empty(dynamics.num_states, np.int64)
    table = dynamics.deterministic_table()
    for start in range(0, dynamics.num_states, STATES_PER_BLOCK):
        states = np.arange(start, min(start + STATES_PER_BLOCK, dynamics.num_states))
        if table is not None:
            result[states] = table[start : states[-1] + 1].max(axis=1)
            continue
        actions = np.tile(np.arange(dynamics.num_actions), len(states))
        outcomes = dynamics.outcomes(np.repeat(states, dynamics.num_actions), actions)
        inside = np.where(outcomes.states < dynamics.num_states, outcomes.states, -1)
        largest = np.full(len(states), -1)
        np.maximum.at(largest, outcomes.which // dynamics.num_actions, inside)
        result[states] = largest
    return result


def _distances(mdp: TabularMDP) -> np.ndarray:
    """(S,) steps from a start state, -1 if there is no way."""
    result = np.full(mdp.num_states + 1, -1, np.int32)
    frontier, layer = mdp.starts, 0
    result[frontier] = 0
    live = ~np.append(np.asarray(mdp.terminal), True)
    while frontier.size:
        next_states = mdp.dynamics.successors_of(frontier[live[frontier]])
        frontier = next_states[(result[next_states] < 0) & (next_states < mdp.num_states)]
        layer += 1
        result[frontier] = layer
    return result[:-1]


# Learnt policies ------------------------------------------------------------------------------------------------------


OPTIMAL, UNIFORM, LEARNT = "optimal", "uniform", "learnt"  # the policies, by name
ASKED_EVERYWHERE = 200_000  # states and, if it matters, previous actions; above, only in states that it reaches


@dataclass(frozen=True, eq=False)
class Learnt:
    """A policy to explore.

    Attributes:
        policy: a table, or what sees observations.
        name: for people.
        observation, observation_options, previous_action: what it sees, if it is no table.
        facts: what is known of it, such as the regret of its run: name -> text.
    """

    policy: PolicyLike
    name: str = "learnt"
    observation: object = "vector"
    observation_options: Mapping[str, Any] = field(default_factory=dict)
    previous_action: bool = False
    facts: Mapping[str, str] = field(default_factory=dict)

    def solution(self, mdp: TabularMDP, space: StateSpace | None) -> Solution:
        """Values of the policy, NaN in states that it never reaches and was not asked about.

        Raises:
            ParameterError: it does not fit the MDP, or its values belong to no state, as it sees more than the state.
        """
        policy = self.policy.policy_table() if isinstance(self.policy, TabularAgent) else self.policy
        if isinstance(policy, np.ndarray):
            return evaluate_policy(mdp, policy)
        if space is None or space.environment is None:
            raise ParameterError("a policy of observations needs an environment that is known; give it as a table")
        observer = Observer(
            space, space.environment, self.observation, dict(self.observation_options), self.previous_action
        )
        width = mdp.policy_width
        if observer.frames > 1 or mdp.num_states * width > ASKED_EVERYWHERE or (self.previous_action and width == 1):
            return evaluate_policy(
                mdp,
                policy,
                observation=self.observation,
                observation_options=self.observation_options,
                previous_action=self.previous_action,
            )
        answers = PolicyAnswers(policy, mdp, observer)
        table = answers.query(np.arange(mdp.num_states * width))
        return evaluate_policy(mdp, table.reshape(mdp.num_states, width, -1) if width > 1 else table)


def probabilities(solution: Solution, states: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """(N, A) action probabilities of a given policy in states after executing actions (N,). A: no action before."""
    table, num_actions = np.asarray(solution.given_policy), solution.mdp.num_actions
    if table.ndim == 1:
        return np.eye(num_actions)[table[states]]
    return table[states] if table.ndim == 2 else table[states, previous]
