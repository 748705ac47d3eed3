"""Meaning of state numbers: the variables of a state space, or where there are none the number itself."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pharos.errors import ParameterError, UnknownName
from pharos.state_space import StateSpace

MOST = 128  # intervals of an axis
ROW = 24  # values of an only variable that make one row


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
        """The number of the state that has these values; ParameterError where it is not reachable."""


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
        layout = self.space.layout
        words = self.space.packed_states[block, int(layout.word[variable])]
        return ((words >> layout.shift[variable]) & layout.mask[variable]).astype(np.int64) + self.low[variable]

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
    """States that are known by their number alone, the one variable they have."""

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


@dataclass(frozen=True)
class Axis:
    """An axis of a heat map: a variable, or a part of the only one, in intervals of equal width.

        interval = ((value - origin) // divisor % modulus) // width, without `% modulus` where that is 0

    Attributes:
        name: as the page asks for it.
        variable: number of the variable.
        origin: its least value.
        low, count, width: what the first interval is called; how many intervals; values in each of them.
    """

    name: str
    variable: int
    origin: int
    low: int
    count: int
    width: int = 1
    divisor: int = 1
    modulus: int = 0

    def places(self, values: np.ndarray) -> np.ndarray:
        """(N,) the intervals of values of the variable."""
        part = (values - self.origin) // self.divisor
        return (part % self.modulus if self.modulus else part) // self.width


def axes_of(states: States) -> dict[str, Axis]:
    """Name -> axis. A variable each; where there is but one, its values fill a row, or rows if there are many."""
    if len(states.names) == 1:
        return {axis.name: axis for axis in _folded(states.names[0], int(states.low[0]), int(states.size[0]))}
    listed = enumerate(zip(states.names, states.low.tolist(), states.size.tolist(), strict=True))
    return {name: Axis(name, i, low, low, *_intervals(size)) for i, (name, low, size) in listed}


def _folded(name: str, low: int, size: int) -> tuple[Axis, Axis]:
    """The axes across and down of the only variable."""
    if size <= ROW:
        return Axis(name, 0, low, low, size), Axis("all", 0, low, 0, 1, 1, size)
    side = min(MOST, math.ceil(math.sqrt(size)))
    rows = Axis(f"{name} div {side}", 0, low, 0, *_intervals(-(-size // side)), side)
    return Axis(f"{name} mod {side}", 0, low, 0, side, 1, 1, side), rows


def _intervals(size: int) -> tuple[int, int]:
    """(number of intervals, values in each)."""
    width = -(-size // MOST)
    return -(-size // width), width


def find_axis(axes: Mapping[str, Axis], name: str) -> Axis:
    """UnknownName where there is none of this name."""
    if name not in axes:
        raise UnknownName("axis", name, axes)
    return axes[name]
