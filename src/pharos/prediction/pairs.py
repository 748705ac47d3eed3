"""Pairs of observations of one MDP: a predictor may order them rightly, which no tabular measure can do."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pharos.statistics import PERMUTED, TIE_TOLERANCE

CLEAR = 0.05  # difference of an outcome between two observations of one MDP that counts


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of cells of one MDP that differ in the observation and whose outcomes differ by more than CLEAR.

    Attributes:
        first, second: (M,) rows of the cells.
        sign: (M,) 1 if the outcome of the first is the larger one, else -1.
    """

    first: np.ndarray
    second: np.ndarray
    sign: np.ndarray

    @staticmethod
    def of(y: np.ndarray, mdps: np.ndarray, clear: float = CLEAR) -> "Pairs":
        """Pairs of the cells with outcomes y (N,) and MDPs (N,)."""
        first, second = np.triu_indices(len(y), 1)
        same = mdps[first] == mdps[second]
        first, second = first[same], second[same]
        counts = np.abs(y[first] - y[second]) > clear
        first, second = first[counts], second[counts]
        return Pairs(first, second, np.sign(y[first] - y[second]))

    def only(self, mask: np.ndarray) -> "Pairs":
        """The pairs for which the mask (M,) is true."""
        return Pairs(self.first[mask], self.second[mask], self.sign[mask])

    def right(self, x: np.ndarray) -> np.ndarray:
        """(M,) 1 if x (N,) orders the pair as the outcome does, 1/2 if it says that both are alike, else 0.

        Alike is what differs by at most TIE_TOLERANCE of the spread of x.
        """
        return self._right(x, x)

    def _right(self, values: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(..., M) of values (..., N) of x at other indices, NaN if one of a pair is."""
        difference = values[..., self.first] - values[..., self.second]
        is_rounding = np.abs(difference) <= TIE_TOLERANCE * (x.max(initial=-np.inf) - x.min(initial=np.inf))
        return 0.5 + 0.5 * np.where(is_rounding, 0.0, np.sign(difference)) * self.sign

    def agreement(self, x: np.ndarray) -> float:
        """The share of pairs that x orders rightly, NaN without pairs."""
        return float(self.right(x).mean()) if len(self.first) else np.nan

    def ceiling(self, y: np.ndarray, noise: np.ndarray) -> float:
        """The agreement of a predictor that knows the expectation of each cell: noise over seeds turns pairs around.

            mean over pairs of P(the expectations differ as the means y do) = Phi(|y1 - y2| / sqrt(noise1 + noise2))

        for means that are normal about their expectations, under a flat prior on the difference of two expectations.

        Args:
            y, noise: (N,) of cells: the mean over seeds, and the variance over seeds / seeds. NaN for a single seed.
        Returns:
            NaN if no pair has two seeds in both of its cells.
        """
        from scipy.special import ndtr

        variance = noise[self.first] + noise[self.second]
        is_known = np.isfinite(variance)
        if not is_known.any():
            return np.nan
        difference = np.abs(y[self.first] - y[self.second])[is_known]
        deviation = np.sqrt(np.maximum(variance[is_known], 1e-300))
        return float(ndtr(difference / deviation).mean())

    def interval(self, x: np.ndarray, classes: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
        """95 % interval of the agreement over samples of classes. (NaN, NaN) without any, or if fewer than two
        classes have pairs.

        Args:
            x, classes: (N,) of cells. counts: (R, C), how often each class counts in each sample.
        """
        number = counts.shape[1]
        right = np.bincount(classes[self.first], self.right(x), minlength=number)
        pairs = np.bincount(classes[self.first], minlength=number)
        if (pairs > 0).sum() < 2 or len(counts) == 0:
            return np.nan, np.nan
        total = counts @ pairs
        lower, upper = np.percentile((counts @ right)[total > 0] / total[total > 0], (2.5, 97.5))
        return float(lower), float(upper)

    def permuted(
        self,
        x: np.ndarray,
        classes: np.ndarray,
        mdps: np.ndarray,
        observations: Sequence[str],
        permutations: int,
        seed: int,
    ) -> np.ndarray:
        """(R,) agreement if observations change names, in all MDPs of a class alike, but in each class otherwise.

        So a class whose instances all prefer the same observation counts once. NaN if no pair is left.

        Args:
            x, classes, mdps, observations: (N,) of cells. Classes and MDPs are numbers from 0.
            permutations: R.
        """
        names = {name: i for i, name in enumerate(dict.fromkeys(observations))}
        columns = np.array([names[each] for each in observations])
        row_at = np.full((mdps.max() + 1, len(names)), -1)
        row_at[mdps, columns] = np.arange(len(x))
        rng = np.random.default_rng(seed)
        agreements = np.full(permutations, np.nan)
        for start in range(0, permutations, PERMUTED):
            size = min(PERMUTED, permutations - start)
            orders = np.broadcast_to(np.arange(len(names)), (size, classes.max() + 1, len(names)))
            rows = row_at[mdps, rng.permuted(orders, axis=2)[:, classes, columns]]
            other = np.where(rows >= 0, x[rows], np.nan)
            right = self._right(other, x)
            some = np.isfinite(right).any(axis=1)
            agreements[start : start + size][some] = np.nanmean(right[some], axis=1)
        return agreements
