"""Rewards of all transitions, held exactly and compactly.

Games pay few different rewards: up to 256 distinct values are kept as one byte for each transition and a palette of
float64, an eighth of the memory of (S, A) float64 and an eighth of what a sweep has to stream; more are kept as
float64.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pharos.errors import ParameterError
from pharos.mdp.arguments import as_array
from pharos.system.memory import large_zeros

_BLOCK = 1 << 16
# Entries of a palette that each reward is compared with, before it is searched for.
_FEW = 4


@dataclass(frozen=True)
class Rewards:
    """Rewards of S states and A actions: `palette[table[s, a]]`, or `table[s, a]` where the palette is empty.

    Attributes:
        table: (S, A) uint8 codes, or (S, A) float64 rewards.
        palette: (at most 256,) float64, or empty.
    """

    table: np.ndarray
    palette: np.ndarray

    @staticmethod
    def from_array(rewards: np.ndarray) -> "Rewards":
        """From (S, A) numbers; ParameterError where one is NaN or infinite."""
        rewards = np.asarray(rewards, np.float64)
        collector = RewardsCollector((rewards.shape[0], rewards.shape[1]))
        for start in range(0, len(rewards), _BLOCK):
            block = rewards[start : start + _BLOCK]
            if not np.isfinite(block).all():
                s, a = map(int, np.argwhere(~np.isfinite(block))[0])
                raise ParameterError(
                    f"the reward of state {start + s}, action {a} is {block[s, a]}; expected a finite number"
                )
            collector.add(start, block)
        return collector.finish()

    @property
    def shape(self) -> tuple[int, int]:
        """(S, A)."""
        return self.table.shape  # type: ignore[return-value]

    @property
    def array(self) -> np.ndarray:
        """(S, A) float64; made anew by each call where the rewards are kept as a palette."""
        return self.rows(slice(None))

    def rows(self, states: slice | np.ndarray) -> np.ndarray:
        """(N, A) float64, the rewards of some states."""
        return self.palette[self.table[states]] if len(self.palette) else self.table[states]

    def of(self, states: slice | np.ndarray) -> "Rewards":
        """The rewards of some states alone."""
        return Rewards(np.asarray(self.table[states]), self.palette)

    def mixed(self, other: "Rewards", p: float) -> "Rewards":
        """(1 - p) these + p others, of as many states and actions; where both are equal, that."""
        collector = RewardsCollector(self.shape)
        for start in range(0, len(self.table), _BLOCK):
            block = slice(start, start + _BLOCK)
            own = self.rows(block)
            collector.add(start, own + p * (other.rows(block) - own))
        return collector.finish()

    @property
    def lowest(self) -> float:
        """The smallest reward."""
        return float(self.palette.min() if len(self.palette) else self.table.min())

    @property
    def highest(self) -> float:
        """The largest reward."""
        return float(self.palette.max() if len(self.palette) else self.table.max())


class RangedRewards(Rewards):
    """Rewards of a state space of which only some ranges may be asked for: they are computed when they are.

    Attributes:
        whole: all of them, once somebody has asked for them; else None.
    """

    def __init__(self, shape: tuple[int, int], compute: Callable[[int, int], Rewards]):
        """compute(start, stop): the rewards of the states [start, stop)."""
        vars(self).update(_shape=shape, _compute=compute, whole=None)  # the class is frozen

    @property
    def shape(self) -> tuple[int, int]:
        return vars(self)["_shape"]

    def __getattr__(self, name: str) -> np.ndarray:
        if name not in ("table", "palette"):
            raise AttributeError(name)
        if vars(self)["whole"] is None:
            vars(self)["whole"] = vars(self)["_compute"](0, self.shape[0])
        return getattr(vars(self)["whole"], name)

    def of(self, states: slice | np.ndarray) -> Rewards:
        if vars(self)["whole"] is None and isinstance(states, slice) and states.step is None:
            start, stop, _ = states.indices(self.shape[0])
            return vars(self)["_compute"](start, stop)
        return super().of(states)


@dataclass
class RewardsCollector:
    """Takes rewards block by block and ends with a palette where there are few distinct ones."""

    shape: tuple[int, int]
    _codes: np.ndarray | None = None
    _values: np.ndarray | None = None
    _palette: np.ndarray = field(default_factory=lambda: np.empty(0))

    def add(self, start: int, block: np.ndarray) -> None:
        """Rewards of the states from `start` on."""
        if self._values is None:
            if self._codes is None:
                self._codes = large_zeros(self.shape, np.uint8)
            entries = self._palette
            if self._is_known(start, block):
                return
            new = np.setdiff1d(block, entries)  # sorted and unique
            if len(entries) + len(new) <= 256:
                self._palette = palette = np.concatenate([entries, new])
                order = np.argsort(palette)
                codes = order[np.searchsorted(palette[order], block)]
                self._codes[start : start + len(block)] = codes
                return
            self._values = entries[self._codes] if len(entries) else np.zeros(self.shape)
            self._codes = None
        self._values[start : start + len(block)] = block

    def _is_known(self, start: int, block: np.ndarray) -> bool:
        """Enter a block whose rewards are all among the first few of the palette; whether they are."""
        assert self._codes is not None
        codes, left = np.zeros(block.shape, np.uint8), block.size
        for code, reward in enumerate(self._palette[:_FEW]):
            equal = block == reward
            left -= int(np.count_nonzero(equal))
            codes += equal.view(np.uint8) * np.uint8(code)
        if left == 0:
            self._codes[start : start + len(block)] = codes
        return left == 0

    def finish(self) -> Rewards:
        """The rewards of all states."""
        if self._values is not None:
            return Rewards(self._values, np.empty(0))
        codes = self._codes if self._codes is not None else np.zeros(self.shape, np.uint8)
        return Rewards(codes, self._palette if len(self._palette) else np.zeros(1))


# Given by users -------------------------------------------------------------------------------------------------------


def rewards_of_shape(rewards: npt.ArrayLike, shape: tuple[int, ...]) -> Rewards:
    """Rewards (S, A) of this shape; ParameterError where they have another, or one is not finite."""
    array = as_array(rewards, "rewards", np.float64)
    if array.shape != shape:
        raise ParameterError(f"rewards have shape {array.shape}; expected {shape}, one for each state and action")
    return Rewards.from_array(array)


def expected_over_outcomes(rewards: npt.ArrayLike, probabilities: np.ndarray) -> np.ndarray:
    """(S, A) expected rewards: those given, or the mean of those of the outcomes, (S, A, K).

    Raises:
        ParameterError: they have neither shape, or one of a possible outcome is not finite.
    """
    array, shape = as_array(rewards, "rewards", np.float64), probabilities.shape
    if array.shape == shape[:2]:
        return array
    if array.shape != shape:
        raise ParameterError(
            f"rewards have shape {array.shape}; expected {shape[:2]}, one for each state and action, or {shape}, one "
            "for each outcome"
        )
    possible = probabilities > 0
    wrong = possible & ~np.isfinite(array)
    if wrong.any():
        s, a, k = map(int, np.argwhere(wrong)[0])
        raise ParameterError(
            f"the reward of state {s}, action {a}, outcome {k} is {array[s, a, k]}; expected a finite number"
        )
    return (probabilities * np.where(possible, array, 0.0)).sum(axis=2)
