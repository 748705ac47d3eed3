"""Values at the start of each task, solved once for all runs of a study, and kept in the user's cache.

A run needs the values of the optimal, the uniform and the worst policy only where episodes start; solving a large
instance again for each run would take longer than some training.
"""

import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pharos.environments import start_distribution
from pharos.solvers import ReferenceValues
from pharos.system.paths import cache_directory
from pharos.system.storage import ResultCache
from pharos.training import RunConfig

if TYPE_CHECKING:
    from pharos.training import Task


def task_of(config: Mapping[str, Any]) -> "Task":
    """The task of a run of a study that was read already, so that code which it names is trusted."""
    return RunConfig.from_dict(config).task(trust=True, strict=True)


def solve(config: Mapping[str, Any]) -> dict[str, Any]:
    """The values at the start of a task, as `TaskValues.to_dict` writes them; solved now unless they are stored."""
    values = stored_values(config)
    if values is None:
        from pharos.training import TaskValues  # loads what an MDP needs

        task = task_of(config)
        values = TaskValues(task.reference, task.return_range).to_dict()
        _cache().put(_dependencies(config), values=values)
    return values


def stored_values(config: Mapping[str, Any]) -> dict[str, Any] | None:
    """The stored values for these rules; None where there are none, or where the file was changed."""
    stored = _cache().get(_dependencies(config))
    return None if stored is None else stored["values"]


def has_regret(config: Mapping[str, Any]) -> bool:
    """False where the stored values of the task say that no policy is better than uniform play."""
    values = stored_values(config)
    return values is None or not math.isnan(ReferenceValues(**values["reference"]).spread())


def _cache() -> ResultCache:
    return ResultCache(cache_directory() / "values")


def _dependencies(config: Mapping[str, Any]) -> dict[str, Any]:
    """What the values depend on: parameters, rules by their code, start states, chance and setting."""
    from pharos.rules import fingerprint_of_rules

    env = task_of(config).env
    states, probabilities = start_distribution(env)
    setting = {name: config[name] for name in ("environment", "parameters", "chance", "gamma", "horizon")}
    return json.loads(
        json.dumps(
            {
                **setting,
                "format": 2,
                "version": env.version,
                "rules": fingerprint_of_rules(env, ("transition", "is_terminal", "reward")),
                "start": [[list(map(int, state)) for state in states], probabilities.tolist()],
            }
        )
    )
