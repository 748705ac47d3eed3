"""Whether a measure predicts regret on classes that it has not seen: held-out statistics of predictions.

Cells of one class share more than any measure tells, so a class is held out as a whole, and classes weigh alike. The
present four classes of the paper tell nothing here: with four points every measure can be ordered well by luck.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pharos.errors import ParameterError
from pharos.study.predictions import PREDICTORS
from pharos.study.tables import CELL

if TYPE_CHECKING:
    import pandas as pd

OUTCOMES = {"greedy": "mean normalised regret of the greedy policies", "played": "that of the training episodes"}
LINEAR = tuple(name for name in PREDICTORS if "regret" in name or name == "aliasing_floor")
"""Predictors that enter as they are; the others as logarithms."""
CLEAR = 0.05  # difference of regret between two observations of one MDP that counts
RESAMPLES = 1000


def outcomes(runs: "pd.DataFrame", points: "pd.DataFrame") -> "pd.DataFrame":
    """The outcomes of each cell, means over seeds: a row each, CELL and OUTCOMES.

    Args:
        runs, points: of `table` and `curves`.
    """
    spread = runs.set_index("id")["value_optimal"] - runs.set_index("id")["value_uniform"]
    optimal = points["id"].map(runs.set_index("id")["value_optimal"])
    regret = ((optimal - points["value"]) / points["id"].map(spread)).replace([np.inf, -np.inf], np.nan)
    cells = runs[[*CELL, "id"]].copy()
    cells["greedy"] = cells["id"].map(regret.groupby(points["id"]).mean())
    cells["played"] = np.nan
    if {"cumulative_realised_regret", "episodes"} <= {*runs}:
        lost = runs["cumulative_realised_regret"] / (runs["episodes"] * (runs["value_optimal"] - runs["value_uniform"]))
        cells["played"] = lost.replace([np.inf, -np.inf], np.nan)
    return cells.groupby(CELL, sort=False)[list(OUTCOMES)].mean().reset_index()


def validation(
    predictions: "pd.DataFrame", cells: "pd.DataFrame", *, predictors: Sequence[str] = PREDICTORS, seed: int = 0
) -> "pd.DataFrame":
    """How well each predictor orders and predicts each outcome of each agent; a row each.

    Args:
        predictions: of `predict`. cells: of `outcomes`.
    Returns:
        Columns `agent`, `outcome`, `predictor`, `cells`, `classes`; `r_squared`, of classes left out one by one, with
        the ends of its 95 % interval over classes drawn anew; `rho`, Spearman's of the same held-out predictions, with
        an interval; `rho_within`, the mean over classes of the rank correlation within; `pairs`, of observations of one
        MDP whose regrets differ by more than 0.05, and `agreement`, the share of them that is ordered rightly.
    Raises:
        ParameterError: there are no cells that both have, or fewer than three classes.
    """
    import pandas as pd

    both = predictions.merge(cells, on=CELL, how="inner")
    if not len(both):
        raise ParameterError("no cell of the predictions has finished runs; are they of this study?")
    if both["environment"].nunique() < 3:
        raise ParameterError("predictions on unseen classes need at least three classes with finished runs")
    rows = []
    for agent, part in both.groupby("agent", sort=False):
        for outcome in OUTCOMES:
            for predictor in predictors:
                row = _line(part[[*CELL, predictor, outcome]].dropna(), predictor, outcome, seed)
                if row is not None:
                    rows.append({"agent": agent, "outcome": outcome, "predictor": predictor, **row})
    return pd.DataFrame(rows)


def _line(part: "pd.DataFrame", predictor: str, outcome: str, seed: int) -> dict[str, float] | None:
    x, y = part[predictor].to_numpy(float), part[outcome].to_numpy(float)
    if predictor not in LINEAR:
        x = np.log(np.maximum(x, 1e-12))
    usable = np.isfinite(x) & np.isfinite(y)
    x, y, part = x[usable], y[usable], part[usable]
    classes = part["environment"].astype("category").cat.codes.to_numpy()
    count = len(np.unique(classes))
    if count < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(count, np.full(count, 1 / count), RESAMPLES)
    drawn = drawn[(drawn > 0).sum(axis=1) >= 3]
    r_squared, rho = (values[0] for values in _held_out(x, y, classes, np.ones((1, count), int)))
    ends = np.nanpercentile(np.stack(_held_out(x, y, classes, drawn), axis=1), [2.5, 97.5], axis=0)
    within = [_spearman(x[classes == each], y[classes == each]) for each in range(count)]
    pairs, agreement = _agreement(part, x, y)
    return {
        "cells": len(x),
        "classes": count,
        "r_squared": r_squared,
        "r_squared_lower": ends[0, 0],
        "r_squared_upper": ends[1, 0],
        "rho": rho,
        "rho_lower": ends[0, 1],
        "rho_upper": ends[1, 1],
        "rho_within": float(np.nanmean(within)) if np.isfinite(within).any() else np.nan,
        "pairs": pairs,
        "agreement": agreement,
    }


def _held_out(x: np.ndarray, y: np.ndarray, classes: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((R,) R2, (R,) rho): each class predicted by a line through the others; classes weigh by counts (R, C).

    A class that counts twice is held out wherever it stands, so no class is predicted from itself.
    """
    sizes = np.bincount(classes)
    powers = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    moments = np.stack([np.bincount(classes, power) / sizes for power in powers], axis=1)  # (C, 6), means of classes
    total = counts @ moments
    others = total[:, None] - counts[:, :, None] * moments
    _, sx, sy, sxx, sxy, _ = np.moveaxis(others, 2, 0) / others[:, :, 0]
    variance = sxx - sx**2
    slope = np.divide(sxy - sx * sy, variance, out=np.zeros_like(sx), where=variance > 1e-15 * np.abs(sxx))
    offset = sy - slope * sx
    _, mx, my, mxx, mxy, myy = moments.T
    left = myy - 2 * offset * my - 2 * slope * mxy + offset**2 + 2 * offset * slope * mx + slope**2 * mxx
    spread = total[:, 5] / total[:, 0] - (total[:, 2] / total[:, 0]) ** 2
    r_squared = 1 - (counts * left).sum(axis=1) / total[:, 0] / spread
    rho = np.empty(len(counts))
    for r, count in enumerate(counts):
        some = count[classes] > 0
        rho[r] = _spearman((offset[r, classes] + slope[r, classes] * x)[some], y[some])
    return r_squared, rho


def _spearman(x: np.ndarray, y: np.ndarray) -> float:
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return np.nan
    from scipy.stats import rankdata

    return float(np.corrcoef(rankdata(x), rankdata(y))[0, 1])


def _agreement(part: "pd.DataFrame", x: np.ndarray, y: np.ndarray) -> tuple[int, float]:
    """(clear pairs of observations of one MDP, the share that x orders as y does; ties of x count half)."""
    number, right = 0, 0.0
    for rows in part.reset_index(drop=True).groupby(["environment", "instance", "chance"]).indices.values():
        for a, i in enumerate(rows):
            for j in rows[a + 1 :]:
                if abs(y[i] - y[j]) > CLEAR:
                    number += 1
                    right += 0.5 + 0.5 * float(np.sign(x[i] - x[j]) * np.sign(y[i] - y[j]))
    return number, (right / number if number else np.nan)
