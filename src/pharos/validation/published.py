"""Published cells, predicted and then run: how wide an interval has to be, and which differences were ordered rightly.

data/cells.csv has a row for each cell of the published runs, with what today's primary predictor says of it;
benchmarks/prediction_cells.py makes it, and prints how well the predictions agree with the runs.
"""

import csv
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from pharos.errors import ParameterError
from pharos.validation.learners import PRIMARY

FILE = Path(__file__).parent / "data" / "cells.csv"
CLEAR = 0.05
"""Difference between the regrets of two observations of one MDP that counts, as in the studies."""
BINS = (0.0, 0.05, 0.1, 0.2, 0.4)
"""Lower ends of the predicted differences that are counted together."""
LEVEL = 0.8


@dataclass(frozen=True, eq=False)
class Published:
    """Cells of one agent.

    Attributes:
        classes: (N,) names of the classes of environments, which weigh alike.
        mdps: (N,) study, instance and chance of each.
        predicted, observed: (N,) normalised regret of the learnt policies, 0 optimal and 1 uniform play; observed is
            the mean over evaluations and seeds.
        states: (N,) numbers of states. steps: (N,) of training.
    """

    classes: np.ndarray
    mdps: np.ndarray
    predicted: np.ndarray
    observed: np.ndarray
    states: np.ndarray
    steps: np.ndarray

    def half_width(self, level: float = LEVEL, but: str | None = None) -> float:
        """Half of an interval about a prediction that held this share of the cells, each class weighing the same.

        Conformal: the quantile at level (C + 1) / C of the errors |observed - predicted| of C classes, so that a class
        that is the next one of the same kind is covered with this probability on average.

        Args:
            but: a class that is left out.
        Source: Lei et al. (2018), split conformal prediction; Dunn, Wasserman and Ramdas (2023) for groups.
        """
        use = self.classes != but
        errors, classes = np.abs(self.observed - self.predicted)[use], self.classes[use]
        names, number, counts = np.unique(classes, return_inverse=True, return_counts=True)
        order = np.argsort(errors, kind="stable")
        reached = np.cumsum((1 / (counts[number] * len(names)))[order])
        aim = min(1.0, level * (len(names) + 1) / len(names))
        place = min(int(np.searchsorted(reached, aim - 1e-12)), len(errors) - 1)
        return float(errors[order][place])

    def coverage(self, level: float = LEVEL) -> float:
        """The share of cells within the interval of the other classes, a mean over classes that are left out."""
        errors = np.abs(self.observed - self.predicted)
        return float(
            np.mean([np.mean(errors[self.classes == name] <= self.half_width(level, name)) for name in self._names])
        )

    @property
    def _names(self) -> np.ndarray:
        return np.unique(self.classes)

    def ordered(self, difference: float) -> tuple[int, int]:
        """(ordered rightly, in all) of the pairs of observations of one MDP whose predictions differ about as much.

        Pairs whose regrets differ by less than CLEAR do not count.
        """
        number = np.searchsorted(BINS, abs(difference), side="right")
        first, second, _ = self.pairs
        apart = self.predicted[first] - self.predicted[second]
        alike = np.searchsorted(BINS, np.abs(apart), side="right") == number
        right = np.sign(apart) == np.sign(self.observed[first] - self.observed[second])
        return int((right & alike).sum()), int(alike.sum())

    @property
    def pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of both cells of each pair, and the difference of what was observed."""
        first, second = np.triu_indices(len(self.mdps), 1)
        apart = self.observed[first] - self.observed[second]
        clear = (self.mdps[first] == self.mdps[second]) & (np.abs(apart) > CLEAR)
        return first[clear], second[clear], apart[clear]


@cache
def published(agent: str) -> Published:
    """Return the published cells of an agent.

    Raises:
        ParameterError: there are none.
    """
    if agent not in PRIMARY:
        raise ParameterError(
            f"agent {agent!r}: no published runs to calibrate on; expected one of {', '.join(PRIMARY)}"
        )
    with FILE.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["agent"] == agent]
    mdps = [" ".join((row["study"], row["instance"], row["chance"])) for row in rows]
    numbers = (np.array([float(row[name]) for row in rows]) for name in ("predicted", "observed", "states", "steps"))
    return Published(np.array([row["environment"] for row in rows]), np.array(mdps), *numbers)
