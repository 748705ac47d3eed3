"""Statistics of a study: intervals, linear models, correlation of agents, and their comparison with the paper.

Numbers that the paper printed, as tables: the returns of its appendix C and the fits of its section 4.3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np

from pharos.agents import TABULAR_OBSERVATION
from pharos.errors import ParameterError
from pharos.statistics import bootstrap_interval, interquartile_mean, mean_of_means
from pharos.study.blocks import Run
from pharos.study.regression import (
    MODEL_MEASURES,
    Fit,
    aggregate_r_squared,
    fit,
    fit_models,
    leave_one_class_out_r_squared,
)
from pharos.study.tables import paper_instance

if TYPE_CHECKING:
    import pandas as pd

REGRETS = {"cumulative_regret": "cumulative regret", "normalized_regret": "normalised regret"}
PAPER_CHANCE = {"none": "plain", "random_actions": "random", "sticky_actions": "sticky"}
IMAGE, VECTOR = "simple_image", "vector"
PAPER_AGENTS = ("dqn", "ppo")
PAPER_AGENT = PAPER_AGENTS[0]  # the agent of the paper's models and of its figure 3


@dataclass(frozen=True)
class Models:
    """The linear models of section 4.3 for one agent and one kind of regret.

    Attributes:
        regret: the column that is explained.
        fits: those that there are enough rows for.
        notes: one line for whatever was left out, and why.
        representation_r_squared, class_r_squared: of the fits together, or None without them.
        leave_one_class_out: R2 for classes that the model has not seen. None if there are fewer than two,
            or no single model.
        class_alone: R2 of the single model without the measures: class and representation alone. None without a model.
        agent: whose regret it is.
    """

    regret: str
    fits: Sequence[Fit]
    notes: Sequence[str]
    representation_r_squared: float | None
    class_r_squared: float | None
    leave_one_class_out: float | None
    class_alone: float | None = None
    agent: str = PAPER_AGENT

    def suffix(self, first: str) -> str:
        """Ending of the names of this agent's files, empty for the first agent of a study."""
        return "" if self.agent == first else "_" + "".join(c if c.isalnum() else "_" for c in self.agent)

    def get(self, model: str, subset: str) -> Fit | None:
        """The fit of a model to a subset of the rows, or None if there is none."""
        return next((one for one in self.fits if (one.model, one.subset) == (model, subset)), None)


def models(
    cells: "pd.DataFrame",
    *,
    agent: str = "dqn",
    regret: str = "cumulative_regret",
    measures: Sequence[str] = MODEL_MEASURES,
) -> Models:
    """Fit the models to the cells of one agent: the single one, one a representation, one a class, as far as there are
    rows.

    Rows without one of the measures are left out. Measures that no row has are left out of the models. Both are noted.
    """
    notes: list[str] = []
    rows = cells[(cells["agent"] == agent) & (cells["observation"] != TABULAR_OBSERVATION)]
    rows = rows.rename(columns={regret: "regret"})
    used = []
    for measure in measures:
        if _has_positive(rows, measure):
            used.append(measure)
        elif len(rows) == 0 and _has_positive(cells, measure):
            continue  # it is the agent that has no cells, which the last note says
        else:
            notes.append(f"{measure} is known for no instance: the models leave it out")
    for column in ("regret", *used):
        values = rows[column].to_numpy(float)
        usable = np.isfinite(values) & ((values > 0) | (column == "regret"))
        if not usable.all():
            notes.append(f"{int((~usable).sum())} of {len(rows)} cells have no positive {column}: left out")
            rows = rows[usable]
    if len(rows) == 0:
        notes.append(f"no cell of {agent} has all measures: there are no models")
        return Models(regret, [], notes, None, None, None, agent=agent)
    fits, more = fit_models(rows, used)
    notes += more
    outside = alone = None
    if any(part.model == "single" for part in fits):
        alone = fit(rows.reset_index(drop=True), "single", "all", ["observation", "environment"]).r_squared
        try:
            outside = leave_one_class_out_r_squared(rows, used)
        except ParameterError as error:
            notes.append(str(error))
    pooled = (_pooled_r_squared(fits, "representation"), _pooled_r_squared(fits, "class"))
    return Models(regret, fits, notes, *pooled, outside, alone, agent)


def _has_positive(rows: "pd.DataFrame", measure: str) -> bool:
    return measure in rows and bool((np.isfinite(rows[measure].to_numpy(float)) & (rows[measure] > 0)).any())


def _pooled_r_squared(fits: Sequence[Fit], model: str) -> float | None:
    parts = [one for one in fits if one.model == model]
    return aggregate_r_squared(parts) if len(parts) > 1 else None


def intervals(rows: "pd.DataFrame", *, resamples: int = 1000) -> "pd.DataFrame":
    """Interquartile mean of the normalised regret for each class, agent and observation, with 95 % bootstrap interval.

    Runs are resampled within each task (instance and chance), as Agarwal et al. (2021) do. NaN if a task has one run.
    """
    import pandas as pd

    lines = []
    for key, part in rows.groupby(["environment", "agent", "observation"], sort=True):
        defined = part[
            np.isfinite(part["normalized_regret"].to_numpy(float))
        ]  # else random play is optimal, or no episode ended
        if len(defined) == 0:
            continue
        tasks = [task["normalized_regret"].to_numpy(float) for _, task in defined.groupby(["instance", "chance"])]
        lower, upper = bootstrap_interval(tasks, interquartile_mean, resamples=resamples)
        line = dict(zip(("environment", "agent", "observation"), key, strict=True))
        line |= {"tasks": len(tasks), "runs": len(defined)}
        lines.append(line | {"iqm": float(interquartile_mean(*tasks)), "lower": float(lower), "upper": float(upper)})
    columns = ["environment", "agent", "observation", "tasks", "runs", "iqm", "lower", "upper"]
    return pd.DataFrame(lines, columns=columns)


def mean_curve(
    tasks: Sequence[np.ndarray], *, resamples: int = 500, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over tasks of the mean over runs, and the ends of its 95 % interval. Runs are resampled within each task.

    Args:
        tasks: for each task an array (runs, T).
    Returns:
        mean, lower, upper: (T,) each, with both ends NaN if a task has one run.
    """
    curves = [np.asarray(task).T for task in tasks]
    lower, upper = bootstrap_interval(curves, mean_of_means, resamples=resamples, seed=seed)
    return mean_of_means(*curves), lower, upper


def agreement(cells: "pd.DataFrame", value: str, agents: tuple[str, str] = ("dqn", "ppo")) -> tuple[float, int] | None:
    """Pearson correlation of two agents over the cells that both have, and how many these are. None for fewer than
    three."""
    wide = cells.pivot_table(index=["instance", "chance", "observation"], columns="agent", values=value)
    if not set(agents) <= set(wide.columns):
        return None
    both = wide[list(agents)].dropna()
    if len(both) < 3 or (both.std() == 0).any():
        return None
    return float(np.corrcoef(both[agents[0]], both[agents[1]])[0, 1]), len(both)


def paper_agreement() -> float:
    """Pearson correlation of DQN and PPO over the returns that the paper prints in appendix C."""
    wide = paper_returns().pivot_table(
        index=["environment", "instance", "randomization", "observation"], columns="agent", values="mean"
    )
    return float(np.corrcoef(wide["DQN"], wide["PPO"])[0, 1])


@dataclass(frozen=True)
class PaperComparison:
    """Numbers of the paper beside ours.

    Attributes:
        returns: one row a printed mean and deviation: the columns of `paper_returns`, `ours`, `our_deviation`,
            `our_steps` (the paper's are 50 thousand for grids and lakes, else 600 thousand), `difference`.
        regressions: one row a printed fit: the columns of `paper_regressions`, and for both kinds of regret ours and
            the difference.
    """

    returns: "pd.DataFrame"
    regressions: "pd.DataFrame"
    notes: Sequence[str] = field(default_factory=list)


def compare(cells: "pd.DataFrame", runs: Sequence[Run], models: Sequence[Models]) -> PaperComparison:
    """Comparison of each number that the paper prints with ours, NaN if the study has none."""
    numbers = {run.instance: paper_instance(run.config["environment"], run.config["parameters"]) for run in runs}
    ours: dict[tuple, tuple[float, ...]] = {}
    for row in cells.to_dict("records"):
        if (number := numbers.get(row["instance"])) is None:
            continue
        chance = row["chance"].split()[0] if "," not in row["chance"] else row["chance"]
        observation = {IMAGE: "image", VECTOR: "vector"}.get(row["observation"], row["observation"])
        key = (row["environment"], number, chance, row["agent"].upper(), observation)
        ours.setdefault(key, (row["return"], row["return_deviation"], row["steps"]))
    returns = paper_returns()
    keys = [
        (row.environment, row.instance, PAPER_CHANCE[row.randomization], row.agent, row.observation)
        for row in returns.itertuples()
    ]
    nothing = (float("nan"),) * 3
    for index, column in enumerate(("ours", "our_deviation", "our_steps")):
        returns[column] = [ours.get(key, nothing)[index] for key in keys]
    returns["difference"] = returns["ours"] - returns["mean"]
    return PaperComparison(returns, _regressions(cells, models))


def _regressions(cells: "pd.DataFrame", models: Sequence[Models]) -> "pd.DataFrame":
    printed = paper_regressions()
    printed["paper"] = printed["r_squared"].astype(str).str.extract(r"([0-9.]+)")[0].astype(float)
    for result in models:
        values = []
        for row in printed.itertuples():
            values.append(_ours(str(row.model), str(row.subset), result, cells))
        name = result.regret.removesuffix("_regret")
        printed[f"ours_{name}"] = values
        printed[f"difference_{name}"] = printed[f"ours_{name}"] - printed["paper"]
    return printed


def _ours(model: str, subset: str, models: Models, cells: "pd.DataFrame") -> float:
    missing = float("nan")
    if model == "agents":
        agreed = agreement(cells, "return")
        return agreed[0] if agreed else missing
    if "aggregate" in subset:
        value = models.representation_r_squared if model == "representation" else models.class_r_squared
        return missing if value is None else value
    name = {"image": IMAGE}.get(subset, subset)
    one = models.get(model.split()[0], name)
    return missing if one is None else one.r_squared


# Paper ----------------------------------------------------------------------------------------------------------------


def paper_returns() -> "pd.DataFrame":
    """One row a printed mean and deviation: environment, instance, randomization, agent, observation, mean, std."""
    return _table("paper_returns.csv")


def paper_regressions() -> "pd.DataFrame":
    """One row a printed fit: model, subset, r_squared, significant_predictors_as_printed."""
    return _table("paper_regressions.csv")


def _table(name: str) -> "pd.DataFrame":
    import pandas as pd

    with resources.files("pharos.study").joinpath("data", name).open() as file:
        return pd.read_csv(file)
