"""Aggregates over tasks and seeds: interquartile mean, performance profile, probability of improvement.

Their intervals are those of a stratified bootstrap. The score of a run is 1 minus its normalised regret: 1 is optimal
from the first episode on, 0 as bad as acting at random. A task is an instance under one kind of chance; runs are
resampled within each task.

Source: Agarwal et al. (2021), Deep reinforcement learning at the edge of the statistical precipice, section 4; computed
through scipy.stats (the authors' library does not import beside pandas 3).

Aliasing, the states of a study's instances that share an observation, counted once and kept in its folder.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import TABULAR_OBSERVATION
from pharos.errors import PharosError
from pharos.observations import Aliasing, aliasing
from pharos.system.storage import ResultCache
from pharos.training import bootstrap_interval

if TYPE_CHECKING:
    import pandas as pd

    from pharos.study.specification import Specification


def interquartile_mean(*tasks: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half of all runs of all tasks pooled: their 25 % trimmed mean.

    Args:
        tasks: an array for each task, whose `axis` counts runs.
    Note: with five runs a task, percentile intervals of it are too narrow (about 85 % coverage for a nominal 95 %).
    """
    from scipy import stats

    return np.asarray(stats.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis))


def mean_of_means(*tasks: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean over tasks of the mean over runs."""
    return np.mean([task.mean(axis=axis) for task in tasks], axis=0)


def probability_of_improvement(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray], axis: int = -1) -> np.ndarray:
    """Return how probable it is that a run of ours scores higher than one of theirs on a task drawn at random.

        P(X > Y) = mean over tasks of the mean over pairs of runs of 1 where x > y, 1/2 where x = y   (section 4.3)

    Args:
        ours, theirs: for each task the scores of its runs along `axis`, the same tasks in the same order.
    """
    probabilities = []
    for one, other in zip(ours, theirs, strict=True):
        x, y = np.moveaxis(one, axis, -1)[..., :, None], np.moveaxis(other, axis, -1)[..., None, :]
        probabilities.append(((x > y) + 0.5 * (x == y)).mean(axis=(-1, -2)))
    return np.mean(probabilities, axis=0)


# Profiles and improvements of a study ---------------------------------------------------------------------------------


THRESHOLDS = np.linspace(-0.25, 1.0, 51)
GROUP = ["agent", "observation"]
TASK = ["instance", "chance"]
IMPROVEMENT_COLUMNS = ["environment", "ours", "theirs", "tasks", "probability", "lower", "upper"]


def profiles(runs: "pd.DataFrame", *, resamples: int = 500) -> "pd.DataFrame":
    """The performance profile of each agent and observation on each class, with 95 % stratified bootstrap intervals.

        F(tau) = mean over tasks of the share of the task's runs with a score above tau   (section 4.2)

    Args:
        runs: as from `table`.
    Returns:
        Columns `environment`, `agent`, `observation`, `score` (the threshold), `share` (of runs above it), `lower`,
        `upper`, `tasks`. Tasks whose regret cannot be normalised are left out.
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
        Columns IMPROVEMENT_COLUMNS; `ours` and `theirs` are pairs "agent, observation" that have runs on the same
        tasks; the interval is the 95 % stratified bootstrap's.
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


def _scores(part: "pd.DataFrame") -> dict[Any, np.ndarray]:
    """Scores of the runs of each task."""
    defined = part[np.isfinite(part["normalized_regret"].to_numpy(float))]
    return {task: 1.0 - own["normalized_regret"].to_numpy(float) for task, own in defined.groupby(TASK, sort=True)}


# Aliasing -------------------------------------------------------------------------------------------------------------


# Instances with more states are not counted for a report
MOST_STATES = 100_000


def aliasing_table(
    study: "Specification",
    folder: Path,
    num_states: Mapping[str, float],
    progress: Callable[[str], None] | None = None,
) -> "pd.DataFrame":
    """Aliasing of every instance and observation of a study with at most MOST_STATES states; kept in the folder
    `aliasing`.

    Args:
        num_states: of the instances that are to be looked at, by name.
    Returns:
        Columns `environment`, `instance`, `observation`, `states`, `observations`, `share`.
    """
    import pandas as pd

    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for run in study.runs:
        key = (run.instance, run.cell["observation"])
        number = num_states.get(run.instance, np.inf)
        if key in rows or key[1] == TABULAR_OBSERVATION or not number <= MOST_STATES:
            continue
        if progress is not None:
            progress(f"states that share an observation: {', '.join(key)}")
        try:
            count = _aliasing_of(folder, run.config)
        except PharosError:
            continue
        rows[key] = {"environment": run.cell["environment"], "instance": key[0], "observation": key[1]}
        rows[key] |= {"states": count.num_states, "observations": count.num_observations, "share": count.share}
    columns = ["environment", "instance", "observation", "states", "observations", "share"]
    return pd.DataFrame(list(rows.values()), columns=columns)


def with_aliasing(cells: "pd.DataFrame", counts: "pd.DataFrame") -> "pd.DataFrame":
    """Cells with `aliasing` beside their regret: the share of states whose observation another state has; NaN where it
    was not counted, 0 for the number of the state.
    """
    shares = counts[["environment", "instance", "observation", "share"]].rename(columns={"share": "aliasing"})
    joined = cells.merge(shares.astype({"aliasing": float}), on=["environment", "instance", "observation"], how="left")
    joined.loc[joined["observation"] == TABULAR_OBSERVATION, "aliasing"] = 0.0
    return joined


def _aliasing_of(folder: Path, config: Mapping[str, Any]) -> Aliasing:
    from pharos.observations import observe
    from pharos.state_space import build
    from pharos.study.batches import task_of

    task, cache = task_of(config), ResultCache(folder / "aliasing")
    names = ("environment", "parameters", "observation", "observation_options")
    dependencies = json.loads(json.dumps({**{name: config[name] for name in names}, "version": task.env.version}))
    stored = cache.get(dependencies)
    if stored is None:
        space = build(task.env, progress=False)
        counts = aliasing(space, observe(task.env, task.observation, **dict(task.observation_options)))
        cache.put(dependencies, counts=asdict(counts))
        return counts
    return Aliasing(**stored["counts"])
