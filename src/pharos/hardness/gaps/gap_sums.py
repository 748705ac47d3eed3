"""Sums over the gaps of many states, and sums of such sums."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from pharos.hardness.gaps.gap_blocks import GapBlock
from pharos.kernels import gaps as kernels

# Of Colosseum.
REGULARIZER = 0.1


@dataclass
class GapSums:
    """What is added up of the gaps of states, a block at a time; the arrays are those of `kernels.gaps`.

    Attributes:
        minimal: the smallest gap above the tolerance. num_rows: how many rows count.
    """

    sums: np.ndarray = field(default_factory=kernels.empty_sums)
    counts: np.ndarray = field(default_factory=kernels.empty_counts)
    histogram: np.ndarray = field(default_factory=kernels.empty_histogram)
    minimal: float = math.inf
    num_rows: int = 0

    def add(self, part: GapBlock, tolerance: float, error: float) -> tuple[int, int]:
        """Add a block. Returns how many of its ties are small, and how many equal."""
        previous = self.counts.copy()
        arguments = (tolerance, error, REGULARIZER, self.sums, self.counts, self.histogram)
        self.minimal = kernels.add_up(part.gap, part.weight, part.counted, self.minimal, *arguments)
        self.num_rows += int(part.counted.sum())
        small, equal = (self.counts - previous)[1:].tolist()
        return small, equal

    # As numbers that are sent ---------------------------------------------------------------------------------------

    def to_numbers(self) -> np.ndarray:
        """(K,) int64: all of it, floats by their bits."""
        floats = np.append(self.sums.ravel(), self.minimal).view(np.int64)
        return np.concatenate([floats, [self.num_rows], self.counts, self.histogram])

    @staticmethod
    def of_numbers(numbers: np.ndarray) -> "GapSums":
        """What `to_numbers` was made of."""
        empty = GapSums()
        edges = np.cumsum([empty.sums.size, 1, 1, empty.counts.size])
        sums, minimal, num_rows, counts, histogram = np.split(numbers, edges)
        sums = sums.view(np.float64).reshape(empty.sums.shape)
        return GapSums(
            sums.copy(), counts.copy(), histogram.copy(), float(minimal.view(np.float64)[0]), int(num_rows[0])
        )

    @staticmethod
    def of_all(parts: Iterable["GapSums"]) -> "GapSums":
        """The sums of several ranges of states. Those of floats are rounded once more."""
        result = GapSums()
        parts = list(parts)
        for k in range(result.sums.shape[1]):
            result.sums[0, k] = _sum([x for part in parts for x in (part.sums[0, k], -part.sums[1, k])])
        for part in parts:
            result.counts += part.counts
            result.histogram += part.histogram
            result.minimal = min(result.minimal, part.minimal)
            result.num_rows += part.num_rows
        return result


def _sum(numbers: list[float]) -> float:
    try:
        return math.fsum(numbers)
    except OverflowError:  # the sum of finite ones is not
        return math.inf
