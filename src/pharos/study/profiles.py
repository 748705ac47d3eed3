"""Performance profiles of agents and observations in a study, differences, and how probable one improves on another.

The score of a run is 1 minus its normalised regret: 1 is optimal from the first episode on, 0 as bad as acting at
random. A task is an instance under one kind of chance. Runs are resampled within each task.

Source: Agarwal et al. (2021), Deep reinforcement learning at the edge of the statistical precipice, section 4 (the
authors' library does not import beside pandas 3).
"""

from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.statistics import (
    bootstrap_interval,
    holm,
    mean_of_means,
    probability_of_improvement,
    standard_error,
    student_interval,
    welch_p_value,
)

if TYPE_CHECKING:
    import pandas as pd

THRESHOLDS = np.linspace(-0.25, 1.0, 51)
GROUP = ["agent", "observation"]
TASK_KEYS = ["instance", "chance"]
DIFFERENCE_COLUMNS = ["ours", "theirs", "tasks", "difference", "lower", "upper", "p_value", "adjusted"]
IMPROVEMENT_COLUMNS = ["environment", "ours", "theirs", "tasks", "probability", "lower", "upper"]


def profiles(runs: "pd.DataFrame", *, resamples: int = 500) -> "pd.DataFrame":
    """The performance profile of each agent and observation on each class, with 95 % stratified bootstrap intervals.

        F(tau) = mean over tasks of the share of the task's runs with a score above tau   (section 4.2)

    Args:
        runs: as from `table`.
    Returns:
        Columns `environment`, `agent`, `observation`, `score` (the threshold), `share` (of runs above it), `lower`,
        `upper` (NaN if a task has one run), `tasks`. Tasks whose regret cannot be normalised are left out.
    """
    import pandas as pd

    parts = []
    for (environment, agent, observation), part in runs.groupby(["environment", *GROUP], sort=True):
        tasks = list(_scores(part).values())
        if not tasks:
            continue
        above = [task > THRESHOLDS[:, None] for task in tasks]
        lower, upper = bootstrap_interval(above, mean_of_means, resamples=resamples)
        parts.append(
            pd.DataFrame(
                {
                    "environment": environment,
                    "agent": agent,
                    "observation": observation,
                    "score": THRESHOLDS,
                    "share": mean_of_means(*above),
                    "lower": lower,
                    "upper": upper,
                    "tasks": len(tasks),
                }
            )
        )
    columns = ["environment", *GROUP, "score", "share", "lower", "upper", "tasks"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def improvements(runs: "pd.DataFrame", *, resamples: int = 500) -> "pd.DataFrame":
    """Probability that the first of two agents or observations scores higher, for each class and each two of them.

    Args:
        runs: as from `table`.
    Returns:
        Columns IMPROVEMENT_COLUMNS. `ours` and `theirs` are pairs "agent, observation" that have runs on the same
        tasks. The interval is the 95 % stratified bootstrap's, NaN if a task has one run.
    """
    import pandas as pd

    rows = []
    for environment, part in runs.groupby("environment", sort=True):
        groups = {key: _scores(own) for key, own in part.groupby(GROUP, sort=True)}
        for (one, ours), (other, theirs) in combinations(groups.items(), 2):
            tasks = [task for task in ours if task in theirs]
            if not tasks:
                continue
            samples = [scores[task] for scores in (ours, theirs) for task in tasks]

            def improvement(*drawn: np.ndarray, axis: int = -1, number: int = len(tasks)) -> np.ndarray:
                return probability_of_improvement(drawn[:number], drawn[number:], axis)

            lower, upper = bootstrap_interval(samples, improvement, resamples=resamples)
            names = (", ".join(one), ", ".join(other))
            rows.append((environment, *names, len(tasks), float(improvement(*samples)), float(lower), float(upper)))
    return pd.DataFrame(rows, columns=IMPROVEMENT_COLUMNS)


def regret_differences(runs: "pd.DataFrame") -> "pd.DataFrame":
    """Difference in normalised regret of each two agents or observations, the mean over the tasks that both have.

    Args:
        runs: as from `table`.
    Returns:
        Columns DIFFERENCE_COLUMNS. `ours` and `theirs` are pairs (agent, observation), `difference` is the regret of
        the first less the regret of the second, with Student's 95 % interval over runs within tasks. `p_value` belongs
        to Welch's t, and `adjusted` is the same after Holm's correction for the number of rows. NaN if a task has one
        run.
    """
    import pandas as pd

    rows: list[tuple[Any, ...]] = []
    groups = {key: _scores(own) for key, own in runs.groupby(GROUP, sort=True)}
    for (one, ours), (other, theirs) in combinations(groups.items(), 2):
        tasks = [task for task in ours if task in theirs]
        if not tasks:
            continue
        strata, weight = [scores[task] for scores in (theirs, ours) for task in tasks], 1.0 / len(tasks)
        value = sum(float(theirs[task].mean() - ours[task].mean()) for task in tasks) * weight
        error, degrees = standard_error(strata, [weight] * len(strata))
        p_value = welch_p_value(value, error, degrees)
        rows.append((one, other, len(tasks), *student_interval(value, error, degrees), p_value))
    table = pd.DataFrame(rows, columns=DIFFERENCE_COLUMNS[:-1])
    return table.assign(adjusted=holm(table["p_value"].to_numpy(float)))


def other_winners(runs: "pd.DataFrame") -> "pd.DataFrame":
    """Tasks on which the agent with the highest return is not the one with the least regret.

    Args:
        runs: as from `table`.
    Returns:
        Columns `instance` and `chance`, `most` and `least`, the pairs (agent, observation) with the highest return and
        with the least regret, and of both the means `most_return`, `most_regret`, `least_return`, `least_regret`. The
        attribute `attrs["tasks"]` counts the tasks that several of them have.
    """
    import pandas as pd

    rows, tasks = [], 0
    means = runs.groupby([*TASK_KEYS, *GROUP], sort=True)[["return", "normalized_regret"]].mean().dropna()
    for task, part in means.groupby(level=TASK_KEYS, sort=True):
        if len(part) < 2:
            continue
        tasks += 1
        part = part.droplevel(TASK_KEYS)
        most, least = part["return"].idxmax(), part["normalized_regret"].idxmin()
        if part.loc[most, "return"] > part.loc[least, "return"] and (
            part.loc[most, "normalized_regret"] > part.loc[least, "normalized_regret"]
        ):
            rows.append((*task, most, least, *part.loc[most], *part.loc[least]))
    numbers = ["most_return", "most_regret", "least_return", "least_regret"]
    result = pd.DataFrame(rows, columns=[*TASK_KEYS, "most", "least", *numbers])
    result.attrs["tasks"] = tasks
    return result


def _scores(part: "pd.DataFrame") -> dict[Any, np.ndarray]:
    """Scores of the runs of each task."""
    defined = part[np.isfinite(part["normalized_regret"].to_numpy(float))]
    return {task: 1.0 - own["normalized_regret"].to_numpy(float) for task, own in defined.groupby(TASK_KEYS, sort=True)}
