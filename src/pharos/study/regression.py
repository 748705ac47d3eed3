"""The linear models of the paper's section 4.3: regret explained by hardness, class and representation.

One row of the data is one agent on one instance under one kind of chance with one observation, averaged over seeds:
columns `environment` (class), `observation`, `regret`, and the measures `effective_horizon`, `sum_of_reciprocal_gaps`,
`diameter`, which enter as logarithms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError

if TYPE_CHECKING:
    import pandas as pd

MEASURES = ("effective_horizon", "sum_of_reciprocal_gaps", "diameter")


@dataclass(frozen=True)
class Fit:
    """One ordinary least squares fit.

    Attributes:
        model, subset: such as ("class", "freeway").
        r_squared, adjusted_r_squared: in sample.
        cross_validated_r_squared: leave one row out, from the leverages: 1 - PRESS / total sum of squares.
        coefficients: one row a predictor: estimate, standard error, p-value, lower and upper end of its 95 % interval.
        dropped: predictors left out because they are constant or a linear combination of the others.
        condition_number: of the standardised predictors.
        fitted, actual: one entry a row; influence: Cook's distances; classes: of environments; tasks: instance and chance.
        design: (rows, predictors), as they entered.
    """

    model: str
    subset: str
    formula: str
    num_rows: int
    r_squared: float
    adjusted_r_squared: float
    cross_validated_r_squared: float
    coefficients: "pd.DataFrame"
    dropped: tuple[str, ...]
    condition_number: float
    fitted: np.ndarray
    actual: np.ndarray
    influence: np.ndarray
    classes: tuple[str, ...] = ()
    tasks: tuple[str, ...] = ()
    design: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))


def fit_models(data: "pd.DataFrame", *, measures: Sequence[str] = MEASURES) -> list[Fit]:
    """The single model (equation 7), one model a representation (8), one model a class (9).

    Raises:
        ParameterError: a column is missing, a measure is not positive (its logarithm is needed), or there are too few rows.
    """
    checked = _checked(data, measures)
    fits = [fit(checked, "single", "all", ["observation", "environment", *measures])]
    for observation, rows in checked.groupby("observation", sort=True):
        fits.append(fit(rows, "representation", str(observation), ["environment", *measures]))
    for environment, rows in checked.groupby("environment", sort=True):
        fits.append(fit(rows, "class", str(environment), ["observation", *measures]))
    return fits


def fit(rows: "pd.DataFrame", model: str, subset: str, predictors: Sequence[str]) -> Fit:
    """One fit; predictors that are constant or collinear in these rows are dropped and named."""
    import statsmodels.formula.api as smf

    terms, dropped = _independent(rows, predictors)
    needed = len(terms) + 3
    if len(rows) < needed:
        raise ParameterError(
            f"the {model} model of {subset} has {len(rows)} rows; needs at least {needed} for its {len(terms)} predictors: "
            f"run more instances or fewer predictors"
        )
    formula = "regret ~ " + (" + ".join(terms) if terms else "1")
    result = smf.ols(formula, rows).fit()
    influence = result.get_influence()
    residuals = np.asarray(result.resid) / (1 - np.clip(influence.hat_matrix_diag, 0, 1 - 1e-12))
    actual = rows["regret"].to_numpy(float)
    total = float(((actual - actual.mean()) ** 2).sum())
    return Fit(
        model=model,
        subset=subset,
        formula=formula,
        num_rows=len(rows),
        r_squared=float(result.rsquared),
        adjusted_r_squared=float(result.rsquared_adj),
        cross_validated_r_squared=1 - float((residuals**2).sum()) / total if total > 0 else float("nan"),
        coefficients=_coefficients(result),
        dropped=tuple(dropped),
        condition_number=_condition_number(result.model.exog),
        fitted=np.asarray(result.fittedvalues),
        actual=actual,
        influence=np.asarray(influence.cooks_distance[0]),
        classes=tuple(map(str, rows["environment"])) if "environment" in rows else (),
        tasks=tuple(map(" ".join, zip(rows["instance"], rows["chance"], strict=True)))
        if {"instance", "chance"} <= {*rows}
        else (),
        design=np.asarray(result.model.exog, np.float64),
    )


def aggregate_r_squared(fits: Sequence[Fit]) -> float:
    """R2 of several fits together: 1 - residual over total sum of squares, all rows pooled, one overall mean."""
    actual = np.concatenate([fit.actual for fit in fits])
    residual = actual - np.concatenate([fit.fitted for fit in fits])
    return 1 - float((residual**2).sum()) / float(((actual - actual.mean()) ** 2).sum())


def leave_one_class_out_r_squared(data: "pd.DataFrame", *, measures: Sequence[str] = MEASURES) -> float:
    """R2 of predictions for each class by a model fitted on the others (representation and measures only)."""
    import statsmodels.formula.api as smf

    checked = _checked(data, measures)
    predicted = np.empty(len(checked))
    for environment in checked["environment"].unique():
        inside = (checked["environment"] == environment).to_numpy()
        if inside.all():
            raise ParameterError(f"leaving one class out needs at least two classes; found only {environment!r}")
        terms, _ = _independent(checked[~inside], ["observation", *measures])
        result = smf.ols("regret ~ " + (" + ".join(terms) or "1"), checked[~inside]).fit()
        predicted[inside] = result.predict(checked[inside])
    actual = checked["regret"].to_numpy(float)
    return 1 - float(((actual - predicted) ** 2).sum()) / float(((actual - actual.mean()) ** 2).sum())


def _checked(data: "pd.DataFrame", measures: Sequence[str]) -> "pd.DataFrame":
    for column in ("environment", "observation", "regret", *measures):
        if column not in data.columns:
            raise ParameterError(
                f"the study's table has no column {column!r}; found {', '.join(map(str, data.columns))}"
            )
    for column in ("regret", *measures):
        values = data[column].to_numpy(float)
        if not np.isfinite(values).all():
            raise ParameterError(
                f"column {column!r} has {int((~np.isfinite(values)).sum())} values that are not finite"
            )
    for column in measures:
        if (data[column] <= 0).any():
            raise ParameterError(f"column {column!r} has values <= 0; the models take its logarithm")
    return data.reset_index(drop=True)


def _independent(rows: "pd.DataFrame", predictors: Sequence[str]) -> tuple[list[str], list[str]]:
    """The terms of a formula that are linearly independent of those before them, and the predictors left out."""
    kept: list[str] = []
    dropped: list[str] = []
    columns = [np.ones(len(rows))]
    for predictor in predictors:
        if predictor in ("observation", "environment"):
            levels = sorted(rows[predictor].unique())[1:]
            added = [(rows[predictor] == level).to_numpy(float) for level in levels]
            term = f"C({predictor})"
        else:
            added = [np.log(rows[predictor].to_numpy(float))]
            term = f"np.log({predictor})"
        design = np.column_stack([*columns, *added])
        scaled = design / np.maximum(np.abs(design).max(axis=0), 1e-300)
        if added and np.linalg.matrix_rank(scaled, tol=1e-9 * np.sqrt(len(rows))) == design.shape[1]:
            kept.append(term)
            columns += added
        else:
            dropped.append(predictor)
    return kept, dropped


def _coefficients(result: Any) -> "pd.DataFrame":
    import pandas as pd

    interval = result.conf_int()
    return pd.DataFrame(
        {
            "estimate": result.params,
            "standard_error": result.bse,
            "p_value": result.pvalues,
            "lower": interval[0],
            "upper": interval[1],
        }
    )


def _condition_number(design: np.ndarray) -> float:
    varying = design[:, design.std(axis=0) > 0]
    if varying.shape[1] == 0:
        return 1.0
    return float(np.linalg.cond((varying - varying.mean(axis=0)) / varying.std(axis=0)))
