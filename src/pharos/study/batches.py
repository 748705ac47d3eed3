"""Runs of a study that are trained as one program: which fit together, what trains them, and the values they share.

A run belongs to a batch where the study says `engine: batched`. Batches are formed when a worker is free, from the
runs that are missing then; a run does not depend on its batch, so neither do results. While a batch is trained, its
checkpoints are in DIR/batches; a batch that was killed goes on from there with the runs that it had.

Values at the start of each task are solved once for all runs of a study, and kept in the user's cache. A run needs the
values of the optimal, the uniform and the worst policy only where episodes start; solving a large instance again for
each run would take longer than some training.
"""

import contextlib
import json
import math
import shutil
import time
from collections import deque
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pharos.environments import start_distribution
from pharos.regret import ReferenceValues
from pharos.study.blocks import Run
from pharos.study.worker import BATCHES
from pharos.system import storage
from pharos.system.storage import ResultCache, cache_directory
from pharos.training import RunConfig, Shapes, halves, lanes

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
    """Whether a policy may be better than uniform play: False where stored values of the task tell otherwise."""
    values = stored_values(config)
    return values is None or not math.isnan(ReferenceValues(**values["reference"]).spread())


def _cache() -> ResultCache:
    return ResultCache(cache_directory() / "values")


def _dependencies(config: Mapping[str, Any]) -> dict[str, Any]:
    """Key of stored values: parameters, rules by their code, start states, chance and setting."""
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


# Batches --------------------------------------------------------------------------------------------------------------


def train_batch(
    configs: Sequence[Mapping[str, Any]], folders: Sequence[Path], checkpoints: Path, *, device: str = "cpu"
) -> list[str | None]:
    """Train runs by `pharos.training.train_configs`, with the values that the study has solved already."""
    from pharos.training import FailedRun, RunConfig, TaskCache, TaskValues, train_configs

    def values(config: RunConfig) -> TaskValues | None:
        stored = stored_values(config.to_dict())
        return None if stored is None else TaskValues.from_dict(stored)

    tasks = TaskCache(values, trust=True, strict=True, device=device)
    ends = train_configs(configs, folders, checkpoints=checkpoints, tasks=tasks)
    return [end.error if isinstance(end, FailedRun) else None for end in ends]


class Batches:
    """Batches of the missing runs of a study: which runs are trained as one program.

    Args:
        folder: of the study.
        device: where networks are trained.
    """

    def __init__(self, folder: Path, device: str = "cpu"):
        self.folder = folder / BATCHES
        self.sizes: dict[str, int] = {}  # id -> largest batch of a run whose batch was too large for memory
        self.shapes = Shapes(device)
        self.keys: dict[str, Hashable | None] = {}  # by id, as widths
        self.widths: dict[str, int] = {}
        self.stored: dict[str, frozenset[str]] = {}
        self.scan_checkpoints()

    def scan_checkpoints(self) -> None:
        """Read which batches have checkpoints: their runs stay together."""
        self.stored = {id: ids for ids in self._checkpoints().values() for id in ids}

    def _checkpoints(self) -> dict[Path, frozenset[str]]:
        """Folder -> ids of the runs of the batch."""
        batches = {}
        for file in self.folder.glob("*/batch.json"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                batches[file.parent] = frozenset(storage.read_json(file)["ids"])
        return batches

    def next_batch(self, run: Run, pending: "deque[tuple[float, Run]]") -> tuple[Run, ...]:
        """The batch of a run: itself and the runs that are trained with it, which are taken from `pending`."""
        if run.engine != "batched":
            return (run,)
        if (stored := self.stored.get(run.id)) is not None:
            entries = [entry for entry in pending if entry[1].id in stored]
        else:
            now = time.monotonic()
            ready = [
                (due, other)
                for due, other in pending
                if due <= now and other.id not in self.stored and other.engine == "batched"
            ]
            runs = [run, *(other for _, other in ready)]
            widths = [self.width(each) for each in runs]
            keys = [self.key(each) for each in runs]
            keyed = [None if key is None else (width, key) for width, key in zip(widths, keys, strict=True)]
            entries = [ready[i - 1] for i in lanes(keyed, widths)[0][1:]]
        for entry in entries:
            pending.remove(entry)
        return run, *(other for _, other in entries)

    def width(self, run: Run) -> int:
        """Largest number of runs in a batch with this one."""
        if run.id not in self.widths:
            self.widths[run.id] = self.shapes.width(run.configuration)
        return min(self.widths[run.id], self.sizes.get(run.id, self.widths[run.id]))

    def key(self, run: Run) -> Hashable | None:
        """Key of a run: runs with equal keys fit together; None: it is alone."""
        if run.id not in self.keys:
            self.keys[run.id] = self.shapes.key(run.configuration)
        return self.keys[run.id]

    def halve(self, batch: Sequence[Run]) -> None:
        """Halve a batch whose process was killed too often: its runs start anew, in batches of half its size."""
        ids = {run.id for run in batch}
        self.sizes |= {run.id: len(half) for half in halves(batch) for run in half}
        for folder, others in self._checkpoints().items():
            if ids & others:
                shutil.rmtree(folder, ignore_errors=True)
        self.scan_checkpoints()
