"""Aliasing, the states of a study's instances that share an observation, counted once and kept in its folder."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import TABULAR_OBSERVATION
from pharos.errors import PharosError
from pharos.hardness import Aliasing
from pharos.observations import aliasing
from pharos.system.storage import ResultCache

if TYPE_CHECKING:
    import pandas as pd

    from pharos.study.specification import Specification


# Instances with more states are not counted for a report
MOST_COUNTED_STATES = 100_000


def aliasing_table(
    study: "Specification",
    folder: Path,
    num_states: Mapping[str, float],
    progress: Callable[[str], None] | None = None,
) -> "pd.DataFrame":
    """Aliasing of every instance and observation of a study with at most MOST_STATES states, kept in the folder
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
        if key in rows or key[1] == TABULAR_OBSERVATION or not number <= MOST_COUNTED_STATES:
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
    """Cells with `aliasing` beside their regret: the share of states whose observation another state has. NaN if it was
    not counted, 0 for the number of the state.
    """
    shares = counts[["environment", "instance", "observation", "share"]].rename(columns={"share": "aliasing"})
    joined = cells.merge(shares.astype({"aliasing": float}), on=["environment", "instance", "observation"], how="left")
    joined.loc[joined["observation"] == TABULAR_OBSERVATION, "aliasing"] = 0.0
    return joined


def _aliasing_of(folder: Path, config: Mapping[str, Any]) -> Aliasing:
    from pharos.observations import observe
    from pharos.state_space import build
    from pharos.study.batches import task_of_config

    task, cache = task_of_config(config), ResultCache(folder / "aliasing")
    names = ("environment", "parameters", "observation", "observation_options")
    dependencies = json.loads(json.dumps({**{name: config[name] for name in names}, "version": task.env.version}))
    stored = cache.get(dependencies)
    if stored is None:
        space = build(task.env, progress=False)
        counts = aliasing(space, observe(task.env, task.observation, **dict(task.observation_options)))
        cache.put(dependencies, counts=asdict(counts))
        return counts
    return Aliasing(**stored["counts"])
