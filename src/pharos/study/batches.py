"""Runs of a study that are trained as one program: which fit together, what trains them, and the values they share.

A run belongs to a batch if the study says `engine: batched`. Batches are formed when a worker is free, from the runs
that are missing then. A run does not depend on its batch, so neither do results. While a batch is trained, its
checkpoints are in DIR/batches. A batch that was killed goes on from there with the runs that it had.

Values at the start of each task are solved once for all runs of a study, and kept in the user's cache. A run needs the
values of the optimal, the uniform and the worst policy only in start states. Solving a large instance again for
each run would take longer than some training.
"""

import json
import math
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pharos.environments import start_distribution
from pharos.regret import ReferenceValues
from pharos.study.blocks import Run
from pharos.study.worker import HalfAsMany
from pharos.system.storage import ResultCache, cache_directory
from pharos.training import RunConfig, Shapes, lanes, stored_batches

if TYPE_CHECKING:
    from pharos.training import Task


def task_of_config(config: Mapping[str, Any]) -> "Task":
    """The task of a run of a study that was read already, so that code which it names is trusted."""
    return RunConfig.from_dict(config).task(trust=True, strict=True)


def solve(config: Mapping[str, Any]) -> dict[str, Any]:
    """The values at the start of a task, as `TaskValues.to_dict` writes them, solved now unless they are stored."""
    values = stored_values(config)
    if values is None:
        from pharos.training import TaskValues  # loads what an MDP needs

        task = task_of_config(config)
        values = TaskValues(task.reference, task.return_range).to_dict()
        _cache().put(_dependencies(config), values=values)
    return values


def stored_values(config: Mapping[str, Any]) -> dict[str, Any] | None:
    """The stored values for these rules. None if there are none, or if the file was changed."""
    stored = _cache().get(_dependencies(config))
    return None if stored is None else stored["values"]


def has_regret(config: Mapping[str, Any]) -> bool:
    """Whether a policy may be better than uniform play: False if stored values of the task show otherwise."""
    values = stored_values(config)
    return values is None or not math.isnan(ReferenceValues(**values["reference"]).spread())


def _cache() -> ResultCache:
    return ResultCache(cache_directory() / "values")


def _dependencies(config: Mapping[str, Any]) -> dict[str, Any]:
    """Key of stored values: parameters, rules by their code, start states, chance and setting."""
    from pharos.rules import fingerprint_of_rules

    env = task_of_config(config).env
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


# Batches --------------------------------------------------------------------------------------------------------------


def train_batch(
    configs: Sequence[Mapping[str, Any]], folders: Sequence[Path], checkpoints: Path, *, device: str = "cpu"
) -> list[str | None]:
    """Train runs in this process, with values that the study has solved already. Raise the error of a single run."""
    from pharos.training import FailedRun, PreparedRun, TaskCache, TaskValues, train_group

    def values(config: RunConfig) -> TaskValues | None:
        stored = stored_values(config.to_dict())
        return None if stored is None else TaskValues.from_dict(stored)

    tasks = TaskCache(values, trust=True, strict=True, device=device)
    errors: list[str | None] = [None] * len(configs)

    def on_message(message: tuple[Any, ...]) -> None:
        match message:
            case "end", index, FailedRun() as end:
                errors[index] = end.error
            case "halve", indices, reason:
                reason_of_all = HalfAsMany(reason)
                for index in indices:
                    errors[index] = reason_of_all

    runs = [PreparedRun(i, RunConfig.from_dict(config), folders[i], tasks) for i, config in enumerate(configs)]
    train_group(runs, checkpoints, on_message, is_single=len(runs) == 1, raises=len(runs) == 1)
    return errors


def batches(runs: Sequence[Run], checkpoints: Path, device: str = "cpu") -> list[list[Run]]:
    """Return the runs by process, in the order of the first: the runs of a checkpoint as they were, others by lanes.

    Args:
        checkpoints: folder of the batches' checkpoints. device: on which networks are trained.
    """
    shapes, stored = Shapes(device), {id: ids for ids in stored_batches(checkpoints).values() for id in ids}
    keys: list[Hashable | None] = []
    widths: list[int] = []
    for run in runs:
        config, is_stored = run.configuration, run.id in stored
        width = 1 if run.engine != "batched" else len(runs) if is_stored else shapes.width(config)
        key = None if run.engine != "batched" else stored[run.id] if is_stored else shapes.key(config)
        keys.append(None if key is None else (width, key))
        widths.append(width)
    return [[runs[i] for i in lane] for lane in lanes(keys, widths)]
