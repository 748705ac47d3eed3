"""Published cells, predicted and then run: how wide an interval has to be, and which differences were ordered rightly.

data/cells.csv has a row for each cell of the published runs, with what today's primary predictor says of it;
benchmarks/prediction_cells.py makes it, and prints how well the predictions agree with the runs.
"""

import csv
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from pharos.agents import primary_predictors
from pharos.errors import ParameterError
from pharos.prediction.pairs import CLEAR, Pairs

CELLS_FILE = Path(__file__).parent / "data" / "cells.csv"
BINS = (0.0, 0.05, 0.1, 0.2, 0.4)
"""Lower ends of the predicted differences that are counted together."""
LEVEL = 0.8
REGRET_BINS = (0.0, 0.1, 0.2, 0.4, 0.8)
"""Lower ends of the predicted regrets that are counted together."""
COMMON: dict[str, dict[str, object]] = {
    "dqn": {
        **{"learning_rate": 0.001, "buffer_size": 50000, "learning_starts": 1000, "batch_size": 32, "gamma": 0.95},
        **{"train_freq": 4, "gradient_steps": 1, "n_steps": 1, "n_envs": 1, "target_update_interval": 250},
        **{"exploration_initial_eps": 1.0, "exploration_final_eps": 0.05, "exploration_fraction": 0.3},
        "max_grad_norm": 10,
    },
    "ppo": {
        **{"n_envs": 8, "n_steps": 64, "batch_size": 128, "n_epochs": 4, "learning_rate": 0.0005, "gamma": 0.95},
        **{"gae_lambda": 0.95, "ent_coef": 0.01, "clip_range": 0.2},
    },
}
"""Hyperparameters of the published cells: those of the presets hardness-dev and hardness-sealed."""
NUMBER_COLUMNS = ("predicted", "observed", "states", "steps", "spread")


@dataclass(frozen=True, kw_only=True)
class OrderCounts:
    """Counts of pairs whose predictions differ about as much.

    Attributes:
        pairs: all of them. right: those in which the one that was predicted to have less regret had less, however
            little. A tie is not right.
        clear_pairs, clear_right: the same of the pairs whose regrets differ by more than `CLEAR`.
    """

    pairs: int
    right: int
    clear_pairs: int
    clear_right: int


@dataclass(frozen=True, eq=False)
class Published:
    """Published cells of one agent: the regret that was predicted, and the regret of the runs.

    Attributes:
        classes: (N,) names of the classes of environments, which weigh alike.
        mdps: (N,) study, instance and chance of each.
        predicted, observed: (N,) normalised regret of the learnt policies, 0 optimal and 1 uniform play. observed is
            the mean over evaluations and seeds.
        states: (N,) numbers of states. steps: (N,) of training. spreads: (N,) V* - U, in return.
    """

    classes: np.ndarray
    mdps: np.ndarray
    predicted: np.ndarray
    observed: np.ndarray
    states: np.ndarray
    steps: np.ndarray
    spreads: np.ndarray

    def half_width(self, level: float = LEVEL, but: str | None = None) -> float:
        """Half of an interval about a prediction that held this share of the cells, each class weighing the same.

        Conformal: the quantile at level (C + 1) / C of the errors |observed - predicted| of C classes, so that a class
        that is the next one of the same kind is covered with this probability on average.

        Args:
            but: a class that is left out.
        Source: Lei et al. (2018), split conformal prediction, and Dunn, Wasserman and Ramdas (2023) for groups.
        """
        use = self.classes != but
        errors, classes = np.abs(self.observed - self.predicted)[use], self.classes[use]
        names, number, counts = np.unique(classes, return_inverse=True, return_counts=True)
        order = np.argsort(errors, kind="stable")
        cumulative = np.cumsum((1 / (counts[number] * len(names)))[order])
        aim = min(1.0, level * (len(names) + 1) / len(names))
        index = min(int(np.searchsorted(cumulative, aim - 1e-12)), len(errors) - 1)
        return float(errors[order][index])

    def coverage(self, level: float = LEVEL, near: float | None = None) -> float:
        """The share of cells within the interval of the other classes, a mean over classes that are left out.

        Args:
            near: a predicted regret. Only cells count whose prediction lies in the same of REGRET_BINS. NaN if none do.
        """
        errors, use = np.abs(self.observed - self.predicted), self.is_near(near)
        shares = []
        for name in np.unique(self.classes[use]):
            of_class = errors[use & (self.classes == name)]
            shares.append(np.mean(of_class <= self.half_width(level, name)))
        return float(np.mean(shares)) if shares else math.nan

    def is_near(self, near: float | None) -> np.ndarray:
        """(N,) bool: cells whose prediction lies in the same of REGRET_BINS as this regret. None: all."""
        if near is None:
            return np.ones(len(self.predicted), bool)
        inner = REGRET_BINS[1:]  # whatever is below 0 lies in the first one
        return np.searchsorted(inner, self.predicted, side="right") == np.searchsorted(inner, near, side="right")

    def ordered(self, difference: float) -> "OrderCounts":
        """Count the pairs of observations of one MDP whose predictions differ about as much, all of them."""
        every = Pairs.of(self.observed, self.mdps, clear=-1.0)
        apart = self.predicted[every.first] - self.predicted[every.second]
        same_bin = np.searchsorted(BINS, np.abs(apart), side="right") == np.searchsorted(
            BINS, abs(difference), side="right"
        )
        observed = self.observed[every.first] - self.observed[every.second]
        is_right, is_clear = (apart * observed > 0)[same_bin], (np.abs(observed) > CLEAR)[same_bin]
        return OrderCounts(
            pairs=int(same_bin.sum()),
            right=int(is_right.sum()),
            clear_pairs=int(is_clear.sum()),
            clear_right=int((is_right & is_clear).sum()),
        )

    @property
    def pairs(self) -> Pairs:
        """Pairs of observations of one MDP whose regrets differ, see `Pairs`."""
        return Pairs.of(self.observed, self.mdps)


@cache
def published(agent: str) -> Published:
    """Return the published cells of an agent.

    Raises:
        ParameterError: there are none.
    """
    if agent not in primary_predictors():
        raise ParameterError(
            f"agent {agent!r}: no published runs to calibrate on; expected one of {', '.join(primary_predictors())}"
        )
    with CELLS_FILE.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["agent"] == agent]
    mdps = [" ".join((row["study"], row["instance"], row["chance"])) for row in rows]
    numbers = (np.array([float(row[name]) for row in rows]) for name in NUMBER_COLUMNS)
    return Published(np.array([row["environment"] for row in rows]), np.array(mdps), *numbers)
