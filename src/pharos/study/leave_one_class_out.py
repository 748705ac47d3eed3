"""Statistics of predictors of regret on classes that they have not seen, with baselines to compare.

Cells of one class share more than any measure tells, so a class is held out as a whole, and classes weigh alike. The
four classes of the paper are too few for that: any measure may order four points well by luck.

Mixed models of an outcome: a slope for the predictor, random intercepts for classes and for the MDPs within them.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pharos.agents import (
    HUBER_PREDICTORS,
    NETWORK_POLICY_PREDICTORS,
    NETWORK_PREDICTORS,
    POLICY_PREDICTORS,
    SAMPLED_PREDICTORS,
)
from pharos.errors import ParameterError
from pharos.prediction import PREDICTORS, Pairs
from pharos.statistics import holm, percentiles, permutation_p_value, r_squared, spearman
from pharos.study import cross_validation
from pharos.training import CELL

if TYPE_CHECKING:
    import pandas as pd

OUTCOMES = {
    "greedy": "mean normalised regret of the learnt policies",  # greedy; of actor-critics the distribution over actions
    "played": "that of the training episodes",
    "steps_to_tenth": "share of the steps until that regret is 0.1; 1: never",
    "cumulative": "cumulative regret of the training episodes, logarithm",
}
ABSOLUTE = "cumulative"  # in units of reward: judged only beside what random play would lose
LINEAR = tuple(
    name
    for name in (
        *PREDICTORS,
        *SAMPLED_PREDICTORS,
        *HUBER_PREDICTORS,
        *POLICY_PREDICTORS,
        *NETWORK_PREDICTORS,
        *NETWORK_POLICY_PREDICTORS,
    )
    if "regret" in name or name == "aliasing_floor"
)
"""Predictors that enter as they are; the others as logarithms."""
TENTH = 0.1
RESAMPLES = 1000
PERMUTATIONS = 4999
CONTROL = "tabular_regret"
IMAGES, VECTOR_NAME = ("simple_image", "complex_image", "recorded"), "vector"
TABULAR, SCALE, CLASSES = "tabular measures", "random play", "class alone"
TABULAR_PREDICTORS = (
    *("tabular_regret", "tabular_regret_played", "policy_tabular_regret", "clipped_tabular_regret"),
    *(NETWORK_PREDICTORS[2], NETWORK_POLICY_PREDICTORS[2]),
)
"""Learners without a kernel."""
BASELINE_MODELS = (CLASSES, SCALE, TABULAR, "exploration_time", "num_states", *TABULAR_PREDICTORS)
P_VALUES = ("p_rho", "p_agreement", "p_slope")


def outcomes(runs: "pd.DataFrame", points: "pd.DataFrame") -> "pd.DataFrame":
    """The outcomes of each cell, means over seeds: a row each.

    Args:
        runs, points: of `table` and `curves`.
    Returns:
        CELL. OUTCOMES, `cumulative` before its logarithm. For each the column NAME_noise, its variance over the seeds
        that have it, divided by their number (NaN for one seed). `random_scale`, what random play would lose in as many
        episodes.
    """
    regret = points["normalized_regret"]
    cells = runs[[*CELL, "id"]].copy()
    cells["greedy"] = cells["id"].map(regret.groupby(points["id"]).mean())
    first_step = points["step"].where(regret <= TENTH).groupby(points["id"]).min()
    share = (first_step / points.groupby("id")["step"].max()).fillna(1.0)
    cells["steps_to_tenth"] = cells["id"].map(share).where(cells["greedy"].notna())
    for name in ("played", "cumulative", "random_scale"):
        cells[name] = np.nan
    if {"cumulative_realised_regret", "normalized_realised_regret"} <= {*runs}:
        cells["cumulative"] = runs["cumulative_realised_regret"]
        cells["random_scale"] = runs["episodes"] * (runs["value_optimal"] - runs["value_uniform"])
        cells["played"] = runs["normalized_realised_regret"]
    groups = cells.groupby(CELL, sort=False)
    table = groups[[*OUTCOMES, "random_scale"]].mean()
    of_seeds = groups[list(OUTCOMES)]
    return table.join((of_seeds.var(ddof=1) / of_seeds.count()).add_suffix("_noise")).reset_index()


@dataclass(frozen=True)
class Model:
    """A model of an outcome: one predictor, several together, or none.

    Attributes:
        name: of the predictor, or of several together.
        columns: of the table. None for the mean alone.
        is_baseline: whether others are to beat it.
    """

    name: str
    columns: tuple[str, ...]
    is_baseline: bool = False


def models_of(frame: "pd.DataFrame", predictors: Sequence[str], measures: Sequence[str]) -> list[Model]:
    """Models of the predictors, and of the baselines that the table has columns for.

    Args:
        measures: tabular ones. Each is judged alone too, if there are no predictions.
    """
    models = [
        Model(name, (name,), name in BASELINE_MODELS)
        for name in predictors
        if name in frame and frame[name].notna().any()
    ]
    if not models:
        models = [Model(name, (name,), True) for name in measures]
    if measures:
        models.append(Model(TABULAR, tuple(measures), True))
    if "random_scale" in frame:
        models.append(Model(SCALE, ("random_scale",), True))
    return [*models, Model(CLASSES, (), True)]


def unseen_classes(
    predictions: "pd.DataFrame | None",
    cells: "pd.DataFrame",
    *,
    predictors: Sequence[str] | None = None,
    measures: "pd.DataFrame | None" = None,
    least_classes: int = 3,
    permutations: int = PERMUTATIONS,
    seed: int = 0,
) -> "pd.DataFrame":
    """Return how well each predictor orders and predicts each outcome of each agent: a row each, baselines included.

    Args:
        predictions: of `predict`. None: the measures alone are judged.
        cells: of `outcomes`.
        predictors: columns of the predictions. Default: all of ours, and the numbers that a user's measures added.
        measures: of `hardness_table`. Their logarithms together are a baseline.
        least_classes: with fewer there is an error.
        permutations: of classes, and of observations within them. 0: no floors and no p-values of these.
    Returns:
        Columns `agent`, `outcome`, `predictor`, `baseline`, `cells`, `classes`, and these.

        Of classes left out one by one:

        - `r_squared` and `rho` (Spearman's), with the ends of their 95 % intervals over classes drawn anew (NaN for
          fewer than four)
        - `floor_r_squared` and `floor_rho`: what 95 % of permutations of classes stay below, and `p_rho`
        - `r_squared_mdp`: each instance left out with all its kinds of chance
        - `calibration` and `calibration_offset`: slope and intercept of the outcome on what was predicted
        - `ceiling`: the largest R2 that noise over seeds leaves

        Within classes:

        - `rho_within`: the mean over classes of the rank correlation within
        - `pairs`: of observations of one MDP whose outcomes differ by more than 0.05
        - `agreement`: the share of pairs that is ordered rightly, with interval, `p_agreement` and
          `agreement_ceiling`, what noise over seeds leaves
        - `image_pairs`, `image_agreement`: of image against vector alone

        By a mixed model and partial correlations:

        - `slope` of the standardised predictor in a model with random classes and MDPs, `slope_error`,
          `p_slope`, and the shares of the variance that it leaves to `class_share`, `mdp_share`
        - `given_tabular`, `given_tabular_regret`: partial rank correlations given the tabular measures, and given the
          regret of the tabular learner, with intervals

        And `tests`, how many p-values the table has, and each of them corrected for that number (Holm) as NAME_holm.
    Raises:
        ParameterError: there are no cells that both have, or too few classes.
    """
    import pandas as pd

    both = cells if predictions is None else predictions.merge(cells, on=CELL, how="inner")
    if predictors is None:
        predictors = () if predictions is None else _predictors_of(predictions)
    if not len(both):
        raise ParameterError("no cell of the predictions has finished runs; are they of this study?")
    names = sorted(both["environment"].unique())
    if len(names) < least_classes:
        words = {2: "two", 3: "three"}.get(least_classes, str(least_classes))
        raise ParameterError(
            f"predictions on unseen classes need at least {words} classes with finished runs; found "
            f"{', '.join(names)}: run more, or report without predictions"
        )
    tabular: list[str] = []
    if measures is not None:
        table = measures.drop(columns=["notes"], errors="ignore").rename(columns={"num_states": "states"})
        tabular = [name for name in table if name not in CELL and table[name].dtype.kind in "fiu" and table[name].any()]
        both = both.merge(table[["environment", "instance", "chance", *tabular]], on=CELL[:3], how="left")
    rows = []
    for agent, part in both.groupby("agent", sort=False):
        for outcome in OUTCOMES:
            if outcome not in part:
                continue
            for model in models_of(part, predictors, tabular):
                if outcome == ABSOLUTE and model.name not in (SCALE, CLASSES, "kernel_regret_played"):
                    continue
                row = _line(part, model, outcome, tabular, permutations, seed)
                if row is not None:
                    rows.append({"agent": agent, "outcome": outcome, "predictor": model.name, **row})
    return _corrected(pd.DataFrame(rows))


def _predictors_of(predictions: "pd.DataFrame") -> list[str]:
    """Names of pharos' predictors, and of other columns of numbers, such as a user's measures."""
    ours = (
        *(*PREDICTORS, SAMPLED_PREDICTORS[0], HUBER_PREDICTORS[0], *POLICY_PREDICTORS),
        *(NETWORK_PREDICTORS[0], NETWORK_POLICY_PREDICTORS[0]),
    )
    drawn = *SAMPLED_PREDICTORS, *HUBER_PREDICTORS, *NETWORK_PREDICTORS, *NETWORK_POLICY_PREDICTORS
    others = {*CELL, *drawn, "estimated_error"}
    added = [name for name in predictions if name not in (*ours, *others) and predictions[name].dtype.kind in "fiu"]
    return [*ours, *added]


def _corrected(table: "pd.DataFrame") -> "pd.DataFrame":
    """The table with the number of tests, and p-values corrected for it."""
    if len(table) == 0:
        return table
    p = table[list(P_VALUES)].to_numpy(float)
    table["tests"] = int(np.isfinite(p).sum())
    corrected = holm(p.ravel()).reshape(p.shape)
    for i, name in enumerate(P_VALUES):
        table[f"{name}_holm"] = corrected[:, i]
    return table


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of one agent as arrays.

    Attributes:
        frame: the N rows. x: (N, P) predictors, as they enter. y: (N,) the outcome.
        classes, instances, mdps: (N,) numbers from 0.
    """

    frame: "pd.DataFrame"
    x: np.ndarray
    y: np.ndarray
    classes: np.ndarray
    instances: np.ndarray
    mdps: np.ndarray

    @staticmethod
    def of(part: "pd.DataFrame", columns: Sequence[str], outcome: str) -> "Cells":
        """Cells of the rows in which the outcome and all columns are finite."""
        x = np.column_stack([np.zeros((len(part), 0)), *(scaled(part, name) for name in columns)])
        y = part[outcome].to_numpy(float)
        if outcome == ABSOLUTE:
            y = np.log(np.maximum(y, 1e-12))
        usable = np.isfinite(x).all(axis=1) & np.isfinite(y)
        frame = part[usable].reset_index(drop=True)
        numbers = [_numbers(frame, CELL[: 1 + i]) for i in range(3)]
        return Cells(frame, x[usable], y[usable], *numbers)

    @property
    def positions(self) -> list[tuple[int, str, str]]:
        """(Position of the instance in its class, chance, observation) of each row."""
        position: dict[int, int] = {}
        counts: dict[int, int] = {}
        for family, instance in zip(self.classes, self.instances, strict=True):
            if instance not in position:
                position[instance] = counts.get(family, 0)
                counts[family] = position[instance] + 1
        instances = [position[each] for each in self.instances]
        return list(zip(instances, self.frame["chance"], self.frame["observation"], strict=True))


def scaled(part: "pd.DataFrame", name: str) -> np.ndarray:
    """(N,) a predictor as models take it: its logarithm, unless it is one of LINEAR."""
    values = part[name].to_numpy(float)
    return values if name in LINEAR else np.log(np.maximum(values, 1e-12))


def _numbers(frame: "pd.DataFrame", columns: Sequence[str]) -> np.ndarray:
    return frame.groupby(list(columns), sort=False).ngroup().to_numpy()


def _line(
    part: "pd.DataFrame", model: Model, outcome: str, tabular: Sequence[str], permutations: int, seed: int
) -> dict[str, float] | None:
    """Statistics of a model of an outcome, by column. None with fewer than two classes, or if nothing varies."""
    cells = Cells.of(part, model.columns, outcome)
    count = len(np.unique(cells.classes))
    if count < 2 or np.ptp(cells.y) == 0 or (model.columns and (np.ptp(cells.x, axis=0) == 0).all()):
        return None
    row: dict[str, float] = {"baseline": model.is_baseline, "cells": len(cells.y), "classes": count}
    row |= _left_out(cells, outcome, permutations, seed)
    row |= _within(cells, outcome, permutations, seed)
    return row | _mixed(cells, model, tabular, seed)


def _left_out(cells: Cells, outcome: str, permutations: int, seed: int) -> dict[str, float]:
    """Statistics of classes and MDPs left out. Rank correlations are NaN if there is no predictor."""
    x, y, classes = cells.x, cells.y, cells.classes
    count = classes.max() + 1
    scores, rho = cross_validation.held_out(x, y, classes, np.ones((1, count), int))
    drawn = cross_validation.resampled_classes(count, RESAMPLES, seed)
    ends = np.array([percentiles(each, 2.5, 97.5) for each in cross_validation.held_out(x, y, classes, drawn)])
    predicted = cross_validation.class_predictions(x, y, classes, classes)
    dummies = np.eye(count)[classes][:, 1:] if not x.shape[1] else x
    by_mdp = cross_validation.class_predictions(dummies, y, cells.instances, classes)
    slope, offset = cross_validation.calibration(y, predicted, classes)
    noise = _noise(cells, outcome)
    floors, p = [np.nan, np.nan], np.nan
    if permutations and x.shape[1] and count >= 3:
        shuffled = cross_validation.permuted_classes(x, y, classes, cells.positions, permutations, seed)
        floors = [float(percentiles(each[1:], 95)[0]) for each in shuffled]
        p = permutation_p_value(shuffled[1][0], shuffled[1][1:])
    return {
        "r_squared": scores[0],
        "r_squared_lower": ends[0, 0],
        "r_squared_upper": ends[0, 1],
        "rho": rho[0] if x.shape[1] else np.nan,
        "rho_lower": ends[1, 0] if x.shape[1] else np.nan,
        "rho_upper": ends[1, 1] if x.shape[1] else np.nan,
        "floor_r_squared": floors[0],
        "floor_rho": floors[1],
        "p_rho": p,
        "r_squared_mdp": r_squared(y, y - by_mdp, classes) if cells.instances.max() else np.nan,
        "calibration": slope if x.shape[1] else np.nan,
        "calibration_offset": offset if x.shape[1] else np.nan,
        "ceiling": np.nan if noise is None else cross_validation.ceiling(y, noise, classes),
    }


def _noise(cells: Cells, outcome: str) -> np.ndarray | None:
    """(N,) the variance of the mean over seeds. None if it is not known, or does not hold for the logarithm."""
    if outcome == ABSOLUTE or f"{outcome}_noise" not in cells.frame:
        return None
    return cells.frame[f"{outcome}_noise"].to_numpy(float)


def _within(cells: Cells, outcome: str, permutations: int, seed: int) -> dict[str, float]:
    """Statistics within classes and MDPs. NaN for several predictors together, and for none."""
    row = {"rho_within": np.nan, "pairs": 0, "agreement": np.nan}
    row |= dict.fromkeys(("agreement_lower", "agreement_upper", "p_agreement", "agreement_ceiling"), np.nan)
    row |= {"image_pairs": 0, "image_agreement": np.nan}
    if cells.x.shape[1] != 1:
        return row
    x, y, classes = cells.x[:, 0], cells.y, cells.classes
    # Rank correlation within classes
    within = [spearman(x[classes == each], y[classes == each]) for each in range(classes.max() + 1)]
    if np.isfinite(within).any():
        row["rho_within"] = float(np.nanmean(within))
    # Pairs of observations: all, then pairs of an image and a vector
    pairs = Pairs.of(y, cells.mdps)
    row |= {"pairs": len(pairs.first), "agreement": pairs.agreement(x)}
    noise = _noise(cells, outcome)
    if noise is not None:
        row["agreement_ceiling"] = pairs.ceiling(y, noise)
    names = cells.frame["observation"].to_numpy()
    is_vector = names == VECTOR_NAME
    is_image = np.array([name.split("(")[0] in IMAGES for name in names])
    first, second = pairs.first, pairs.second
    of_both = pairs.only((is_image[first] & is_vector[second]) | (is_vector[first] & is_image[second]))
    row |= {"image_pairs": len(of_both.first), "image_agreement": of_both.agreement(x)}
    # Interval and p-value, if the predictor distinguishes observations
    if (pairs.right(x) == 0.5).all():
        return row
    drawn = cross_validation.resampled_classes(classes.max() + 1, RESAMPLES, seed)
    row["agreement_lower"], row["agreement_upper"] = pairs.interval(x, classes, drawn)
    if permutations:
        shuffled = pairs.permuted(x, classes, cells.mdps, names, permutations, seed)
        row["p_agreement"] = permutation_p_value(pairs.agreement(x), shuffled)
    return row


def _mixed(cells: Cells, model: Model, tabular: Sequence[str], seed: int) -> dict[str, float]:
    """The mixed model and partial correlations. NaN for several predictors together, and for none."""
    names = ("slope", "slope_error", "p_slope", "class_share", "mdp_share")
    row: dict[str, float] = dict.fromkeys(names, np.nan)
    for name in ("given_tabular", "given_tabular_regret"):
        row |= dict.fromkeys((name, f"{name}_lower", f"{name}_upper"), np.nan)
    if len(model.columns) != 1:
        return row
    x, y, classes = cells.x[:, 0], cells.y, cells.classes
    fit = mixed_fit(x, y, classes, cells.mdps)
    if fit is not None:
        total = fit.class_variance + fit.mdp_variance + fit.residual_variance
        shares = (fit.class_variance / total, fit.mdp_variance / total) if total > 0 else (np.nan, np.nan)
        row |= dict(zip(names, (fit.slope, fit.error, fit.p_value, *shares), strict=True))
    for name, columns in {"given_tabular": tabular, "given_tabular_regret": (CONTROL,)}.items():
        if not columns or model.name in columns or not {*columns} <= {*cells.frame}:
            continue
        others = np.column_stack([scaled(cells.frame, column) for column in columns])
        some = np.isfinite(others).all(axis=1)
        if some.sum() < len(columns) + 4 or len(np.unique(classes[some])) < 3:
            continue
        numbers = np.unique(classes[some], return_inverse=True)[1]
        drawn = cross_validation.resampled_classes(numbers.max() + 1, RESAMPLES // 2, seed)
        counts = np.vstack([np.ones((1, drawn.shape[1]), int), drawn])
        values = cross_validation.partial_correlation(x[some], y[some], others[some], numbers, counts)
        row |= zip(
            (name, f"{name}_lower", f"{name}_upper"), (values[0], *percentiles(values[1:], 2.5, 97.5)), strict=True
        )
    return row


# Mixed models ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MixedFit:
    """Fit of y = intercept + slope z + class + MDP + residual, by restricted maximum likelihood.

    Attributes:
        slope: of the standardised predictor z, in units of the outcome. error: its standard error.
        p_value: two-sided, of slope / error under Student's t with two degrees of freedom fewer than classes: a
            predictor can differ between classes alone, and the normal distribution would trust few classes too much.
        class_variance, mdp_variance, residual_variance: of the random parts and of what is left.
    """

    slope: float
    error: float
    p_value: float
    class_variance: float
    mdp_variance: float
    residual_variance: float


def mixed_fit(x: np.ndarray, y: np.ndarray, classes: np.ndarray, mdps: np.ndarray) -> MixedFit | None:
    """Fit the model to cells: x, y (N,), classes and mdps (N,) integers. MDPs of different classes are different.

    Returns:
        None if there are fewer than three classes, x is constant, or no maximum of the likelihood is found.
    Source: statsmodels' MixedLM; Laird and Ware (1982).
    """
    import pandas as pd
    import statsmodels.formula.api as smf
    from scipy import stats

    count = len(np.unique(classes))
    if count < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    data = pd.DataFrame({"y": y, "z": (x - x.mean()) / x.std(), "family": classes, "mdp": mdps})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # variances at 0 are told as warnings
        try:
            model = smf.mixedlm("y ~ z", data, groups="family", re_formula="1", vc_formula={"mdp": "0 + C(mdp)"})
            fit = model.fit(reml=True, method=["lbfgs", "powell"])
            slope, error = float(fit.fe_params["z"]), float(fit.bse_fe["z"])  # of a perfect line: a root of about -0
        except (np.linalg.LinAlgError, ValueError):
            return None
    if not np.isfinite(slope) or not error > 0:
        return None
    p = float(2 * stats.t.sf(abs(slope / error), count - 2))
    return MixedFit(slope, error, p, float(fit.cov_re.iloc[0, 0]), float(fit.vcomp[0]), float(fit.scale))
