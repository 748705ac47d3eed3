"""A pilot beside the prediction: one seed of the real agent, cut after a share of its steps, and what both say."""

import csv
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.prediction.calibration import Published

if TYPE_CHECKING:
    from pharos.training import Task

PILOT_SHARES = (0.1, 0.25, 0.5)
EVALUATIONS = 30  # of a whole run
PILOTS_FILE = Path(__file__).parent / "data" / "pilots.csv"


class Plane:
    """Regret of other seeds as a plane over the pilot's regret so far and the prediction, classes weighing alike.

    Attributes:
        calibration: cells with what the planes of the other classes say of them.
    """

    def __init__(self, classes: np.ndarray, x: np.ndarray, observed: np.ndarray):
        self.coefficients = self._fit(classes, x, observed)
        left_out = np.empty(len(observed))
        for name in np.unique(classes):
            own = classes == name
            left_out[own] = _with_one(x[own]) @ self._fit(classes[~own], x[~own], observed[~own])
        none = np.zeros(len(observed))
        self.calibration = Published(classes, classes, left_out, observed, none, none, none)

    @staticmethod
    def _fit(classes: np.ndarray, x: np.ndarray, observed: np.ndarray) -> np.ndarray:
        _, number, counts = np.unique(classes, return_inverse=True, return_counts=True)
        weights = 1 / np.sqrt(counts[number])
        return np.linalg.lstsq(weights[:, None] * _with_one(x), weights * observed, rcond=None)[0]

    def value(self, pilot: float, predicted: float) -> float:
        """The regret that both say, at least 0."""
        return max(0.0, float((_with_one(np.array([[pilot, predicted]])) @ self.coefficients)[0]))


def _with_one(x: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(x)), x])


@cache
def plane(agent: str, share: float) -> Plane:
    """Return the plane of an agent's pilots: of the second and third sealed tests, 196 cells of 28 classes an agent.

    Raises:
        ParameterError: the share is none of PILOT_SHARES.
    """
    if share not in PILOT_SHARES:
        raise ParameterError(
            f"pilot is {share!r}; expected one of {', '.join(map(str, PILOT_SHARES))}, shares of the steps"
        )
    with PILOTS_FILE.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["agent"] == agent]
    x = np.array([[float(row[str(share)]), float(row["predicted"])] for row in rows])
    return Plane(np.array([row["environment"] for row in rows]), x, np.array([float(row["others"]) for row in rows]))


def cut(hyperparameters: Mapping[str, Any], share: float) -> dict[str, Any]:
    """Hyperparameters with which a run of this share of the steps is the beginning of a whole one."""
    settings = dict(hyperparameters)
    if "exploration_fraction" in settings:
        first, last = (float(settings[f"exploration_{end}_eps"]) for end in ("initial", "final"))
        fraction = float(settings["exploration_fraction"]) / share
        settings["exploration_fraction"] = min(fraction, 1.0)
        settings["exploration_final_eps"] = first + (last - first) / max(fraction, 1.0)
    return settings


def pilot_regret(agent: str, task: "Task", steps: int, hyperparameters: Mapping[str, Any], share: float) -> float:
    """Train one seed for a share of the steps, and return its mean regret so far.

    Raises:
        MissingExtra: torch is not installed.
    """
    from pharos.training import train

    run = train(
        agent,
        task.env,
        engine="batched",
        steps=max(1, round(share * steps)),
        evaluation_interval=max(1, steps // EVALUATIONS),
        hyperparameters=cut(hyperparameters, share),
        observation=str(task.observation),
        observation_options=dict(task.observation_options),
        chance=task.chance,
        horizon=task.horizon_steps,
    )
    return float(np.mean([row["normalized_regret"] for row in run.curve]))
