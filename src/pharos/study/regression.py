"""The linear models of the paper's section 4.3: regret explained by hardness, class and representation.

One row of the data is one agent on one instance under one kind of chance with one observation, averaged over seeds:
columns `environment` (class), `observation`, `regret`, and the measures `effective_horizon`, `sum_of_reciprocal_gaps`,
`diameter`, which enter as logarithms.

A task is an instance under one kind of chance. Its rows, one for each observation, have the same measures, so they are
not independent: tests and R2 outside the sample count a task once. If every task has the same observations, the
estimates of least squares come from two strata that are independent of each other (a split plot): class and measures
from the means of the tasks, observations from the differences within tasks. Otherwise standard errors are clustered by
task.

Source: Cochran and Cox (1957), Experimental designs, chapter 7 (split plots); Liang and Zeger (1986) for clusters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.statistics import r_squared
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    import pandas as pd
    from statsmodels.regression.linear_model import RegressionResultsWrapper

MODEL_MEASURES = ("effective_horizon", "sum_of_reciprocal_gaps", "diameter")


@dataclass(frozen=True)
class Fit:
    """One ordinary least squares fit.

    Attributes:
        model, subset: such as ("class", "freeway").
        r_squared, adjusted_r_squared: in sample.
        cross_validated_r_squared: each task predicted by the model fitted on the others, from the leverages:
            1 - PRESS / total sum of squares. Without columns of tasks a row is a task.
        coefficients: one row a predictor: estimate, standard error, p-value, lower and upper end of its 95 % interval.
        dropped: predictors left out because they are constant or a linear combination of the others.
        condition_number: of the standardised predictors.
        fitted, actual: one entry a row. influence: Cook's distances, NaN if a row alone determines a coefficient,
            classes: of environments. tasks: instance and chance. observations: what the agent saw.
        design: (rows, predictors), as they entered, in the order of `coefficients`.
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
    observations: tuple[str, ...] = ()
    design: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))


def fit_models(rows: "pd.DataFrame", measures: Sequence[str] = MODEL_MEASURES) -> tuple[list[Fit], list[str]]:
    """The single model (equation 7), one model a representation (8), one model a class (9).

    Returns:
        The models that there are enough rows for, and a line for each other and for predictors that are left out.
    Raises:
        ParameterError: a column is missing, a number is not finite, or a measure is not positive (its logarithm is
            needed).
    """
    rows = _checked(rows, measures)
    kinds: list[tuple[str, str, pd.DataFrame, list[str]]] = [("single", "all", rows, ["observation", "environment"])]
    for model, column, other in (
        ("representation", "observation", "environment"),
        ("class", "environment", "observation"),
    ):
        kinds += [(model, str(name), part, [other]) for name, part in rows.groupby(column, sort=True)]
    fits: list[Fit] = []
    notes: list[str] = []
    for model, subset, part, dummies in kinds:
        try:
            fits.append(fit(part.reset_index(drop=True), model, subset, [*dummies, *measures]))
        except ParameterError as error:
            notes.append(str(error))
            continue
        if dropped := fits[-1].dropped:
            notes.append(
                f"the {model} model of {subset} leaves out {', '.join(dropped)}: constant, or a combination of the "
                f"others"
            )
    return fits, notes


def fit(rows: "pd.DataFrame", model: str, subset: str, predictors: Sequence[str]) -> Fit:
    """One fit. Predictors that are constant or collinear in these rows are dropped and named.

    Raises:
        ParameterError: there are too few rows for the coefficients, or all regrets are the same.
    """
    import statsmodels.formula.api as smf

    terms, columns, dropped = _independent(rows, predictors)
    needed = columns + 2
    if len(rows) < needed:
        what = f"{pluralize(columns - 1, 'predictor')}" if columns > 1 else "mean, as no predictor varies"
        raise ParameterError(
            f"the {model} model of {subset} has {pluralize(len(rows), 'row')}; needs at least {needed} for its {what}: "
            f"run more instances or fewer predictors"
        )
    if np.ptp(rows["regret"]) == 0:
        raise ParameterError(
            f"the {model} model of {subset} has nothing to explain: the regret is {rows['regret'].iloc[0]:g} in all of "
            f"its {pluralize(len(rows), 'row')}"
        )
    formula = "regret ~ " + (" + ".join(terms) if terms else "1")
    result = smf.ols(formula, rows).fit()
    influence = result.get_influence()
    with np.errstate(divide="ignore", invalid="ignore"):  # of rows that are alone in determining a coefficient
        distances = np.where(influence.hat_matrix_diag < 1 - 1e-9, influence.cooks_distance[0], np.nan)
    actual = rows["regret"].to_numpy(float)
    tasks = _tasks(rows)
    errors = _errors_without_the_task(np.asarray(result.model.exog, float), np.asarray(result.resid), tasks)
    return Fit(
        model=model,
        subset=subset,
        formula=formula,
        num_rows=len(rows),
        r_squared=float(result.rsquared),
        adjusted_r_squared=float(result.rsquared_adj),
        cross_validated_r_squared=r_squared(actual, errors),
        coefficients=_coefficients(result, rows, tasks),
        dropped=tuple(dropped),
        condition_number=_condition_number(result.model.exog),
        fitted=np.asarray(result.fittedvalues),
        actual=actual,
        influence=distances,
        classes=tuple(map(str, rows["environment"])) if "environment" in rows else (),
        tasks=tasks,
        observations=tuple(map(str, rows["observation"])) if "observation" in rows else (),
        design=np.asarray(result.model.exog, np.float64),
    )


def _tasks(rows: "pd.DataFrame") -> tuple[str, ...]:
    """The task of each row, empty if the rows have no instance and chance."""
    if not {"instance", "chance"} <= {*rows}:
        return ()
    return tuple(map(" ".join, zip(rows["instance"], rows["chance"], strict=True)))


def _errors_without_the_task(design: np.ndarray, residuals: np.ndarray, tasks: Sequence[str]) -> np.ndarray:
    """(N,) the error of each row under the model fitted without its task: (I - H)^-1 residuals, H the task's block of
    the hat matrix. The shortest such vector if the task alone determines a coefficient.
    """
    basis, _ = np.linalg.qr(design)
    errors = np.empty(len(residuals))
    rows_by_task: dict[Any, list[int]] = {}
    for row, task in enumerate(tasks or range(len(residuals))):
        rows_by_task.setdefault(task, []).append(row)
    for rows in rows_by_task.values():
        remainder = np.eye(len(rows)) - basis[rows] @ basis[rows].T
        if len(rows) == 1:
            remainder = np.maximum(remainder, 1e-12)
        errors[rows] = np.linalg.lstsq(remainder, residuals[rows])[0]
    return errors


def aggregate_r_squared(fits: Sequence[Fit]) -> float:
    """R2 of several fits together: all rows pooled, one overall mean."""
    actual = np.concatenate([fit.actual for fit in fits])
    return r_squared(actual, actual - np.concatenate([fit.fitted for fit in fits]))


def leave_one_class_out_r_squared(rows: "pd.DataFrame", measures: Sequence[str] = MODEL_MEASURES) -> float:
    """R2 of predictions for each class by a model fitted on the others (representation and measures only).

    Returns:
        NaN if all regrets are the same.
    Raises:
        ParameterError: a table that `fit_models` refuses, or there is one class alone.
    """
    import statsmodels.formula.api as smf

    rows = _checked(rows, measures)
    predicted = np.empty(len(rows))
    for environment in rows["environment"].unique():
        inside = (rows["environment"] == environment).to_numpy()
        if inside.all():
            raise ParameterError(f"leaving one class out needs at least two classes; found only {environment!r}")
        terms, _, _ = _independent(rows[~inside], ["observation", *measures])
        result = smf.ols("regret ~ " + (" + ".join(terms) or "1"), rows[~inside]).fit()
        predicted[inside] = result.predict(rows[inside])
    actual = rows["regret"].to_numpy(float)
    return r_squared(actual, actual - predicted)


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


def _independent(rows: "pd.DataFrame", predictors: Sequence[str]) -> tuple[list[str], int, list[str]]:
    """The terms of a formula that are linearly independent of those before them, how many coefficients they have, the
    constant included, and the predictors left out.
    """
    terms: list[str] = []
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
            terms.append(term)
            columns += added
        else:
            dropped.append(predictor)
    return terms, len(columns), dropped


def _coefficients(result: "RegressionResultsWrapper", rows: "pd.DataFrame", tasks: Sequence[str]) -> "pd.DataFrame":
    """Estimates of least squares with standard errors that count a task once, see the head of this file."""
    import pandas as pd
    from scipy import stats

    table = pd.DataFrame({"estimate": result.params, "standard_error": result.bse, "p_value": result.pvalues})
    table["lower"], table["upper"] = result.conf_int()[0], result.conf_int()[1]
    if len(set(tasks)) == len(tasks):
        return table
    groups = pd.factorize(pd.Series(tasks))[0]
    strata = _strata(result, rows, groups)
    if strata is None:
        clustered = result.get_robustcov_results("cluster", groups=groups, use_t=True)
        table["standard_error"], free = clustered.bse, pd.Series(groups.max(), table.index)
    else:
        table["standard_error"], free = strata
    p = 2 * stats.t.sf((table["estimate"] / table["standard_error"].replace(0, np.nan)).abs(), free)
    table["p_value"] = np.where(table["standard_error"] > 0, p, 0.0)
    width = stats.t.ppf(0.975, free) * table["standard_error"]
    table["lower"], table["upper"] = table["estimate"] - width, table["estimate"] + width
    return table


def _strata(
    result: "RegressionResultsWrapper", rows: "pd.DataFrame", groups: np.ndarray
) -> tuple["pd.Series", "pd.Series"] | None:
    """Standard errors and degrees of freedom from the strata between and within tasks.

    None if tasks differ in their observations, or there are too few tasks.
    """
    import pandas as pd

    design = pd.DataFrame(result.model.exog, columns=result.params.index)
    actual = pd.Series(np.asarray(result.model.endog, float))
    observations = rows["observation"].reset_index(drop=True) if "observation" in rows else pd.Series(dtype=str)
    number, each = groups.max() + 1, observations.nunique()
    if number * each != len(rows) or pd.DataFrame({"g": groups, "o": observations}).duplicated().any():
        return None
    within = [name for name in design if name.startswith("C(observation)")]
    between = [name for name in design if name not in within]
    means, regrets = design.groupby(groups).mean()[between], actual.groupby(groups).mean()
    free = {name: number - len(between) for name in between} | {name: (number - 1) * (each - 1) for name in within}
    if min(free.values()) < 1:
        return None
    rest = regrets - means @ np.linalg.lstsq(means, regrets)[0]
    spread = float((rest**2).sum()) / (number - len(between))
    covariance = np.linalg.pinv(means.T @ means) * spread
    errors = dict(zip(between, np.sqrt(np.diag(covariance)), strict=True))
    if within:
        inside = actual - regrets.to_numpy()[groups]
        inside -= inside.groupby(observations).transform("mean")
        difference = np.sqrt(2 * float((inside**2).sum()) / ((number - 1) * (each - 1)) / number)
        errors |= dict.fromkeys(within, difference)
        # The intercept is the level of the first observation: the mean of the tasks less the mean of the differences
        if "Intercept" in errors:
            errors["Intercept"] = np.hypot(errors["Intercept"], difference * np.sqrt((each - 1) / (2 * each)))
    return pd.Series(errors)[design.columns], pd.Series(free)[design.columns]


def _condition_number(design: np.ndarray) -> float:
    varying = design[:, design.std(axis=0) > 0]
    if varying.shape[1] == 0:
        return 1.0
    return float(np.linalg.cond((varying - varying.mean(axis=0)) / varying.std(axis=0)))
