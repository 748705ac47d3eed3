"""Runs before they are trained: each with its task, which runs on it share, and its hyperparameters, checked."""

import json
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from pharos.agents import WORLD, agent_called
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.environments import class_called
from pharos.mdp import TabularMDP
from pharos.state_space import StateSpace
from pharos.system.wording import in_one_line
from pharos.training.curve import Curve
from pharos.training.results import RECORD_FORMAT, versions, write_record
from pharos.training.task import RunConfig, Task, TaskValues

T = TypeVar("T")
# Entries of a configuration that decide about the task
TASK_ENTRIES = (
    *("environment", "parameters", "chance", "observation", "observation_options", "gamma", "horizon", "objective"),
    "sources",
)


@dataclass(frozen=True)
class FailedRun:
    """A run that has no result, and why."""

    config: dict[str, Any]
    folder: Path | None
    exception: Exception

    @property
    def error(self) -> str:
        """The reason in one line."""
        return in_one_line(self.exception)


class TaskCache:
    """Tasks of runs by configuration. They share spaces, rewards, solved values and observations.

    Args:
        values: config -> values at the start of its task, if they are known.
        trust, strict: as for `RunConfig.task`.
        device: on which networks are trained, which decides about what fits together.
    """

    def __init__(
        self,
        values: Callable[[RunConfig], TaskValues | None] | None = None,
        *,
        trust: bool = False,
        strict: bool = False,
        device: str = "cpu",
    ):
        self.values, self.trust, self.strict, self.device = values, trust, strict, device
        self._shared: dict[str, Any] = {}

    def task(self, config: RunConfig) -> Task:
        """The task of a run, the same object for all runs on it. Tasks share spaces and rewards."""
        return self.shared("task", config, TASK_ENTRIES, lambda: self._task(config))

    def adopt(self, config: RunConfig, task: Task) -> None:
        """Keep a task that exists already as the task of a run."""
        self.shared("task", config, TASK_ENTRIES, lambda: task)

    def _task(self, config: RunConfig) -> Task:
        values = self.values(config) if self.values is not None else None
        task = config.task(values, trust=self.trust, strict=self.strict)
        space, plain = self.world(config, task)
        vars(task).update(space=space, mdp=task.chance.of(plain.with_horizon(task.horizon_steps)))
        return task

    def world(self, config: RunConfig, task: Task) -> tuple[StateSpace, TabularMDP]:
        """The states of a task, and their MDP without chance and horizon, the same for all tasks of a world."""
        return self.shared("world", config, WORLD, lambda: (task.space, task.space.mdp(gamma=task.gamma)))

    def shared(self, what: str, config: RunConfig, names: Sequence[str], make: Callable[[], T]) -> T:
        """Return what `make` returns, made once for all configurations with the same entries `names`."""
        entry = config.to_dict()
        key = json.dumps([what, *(entry.get(name) for name in names)], sort_keys=True)
        if key not in self._shared:
            self._shared[key] = make()
        return self._shared[key]


@dataclass(eq=False)
class PreparedRun:
    """A run before and while it is trained: a `pharos.agents.LearningRun`, with its curve and its record.

    Attributes:
        index: among the configurations. None for a run of a checkpoint that nobody asks for.
        tasks: that it shares with other runs.
        key: runs with equal keys train together, see `pharos.agents.Agent.prepare`. None: it is alone, has checkpoints
            in its own folder, and holds that.
        error: why it has failed.
    """

    index: int | None
    config: RunConfig
    folder: Path | None
    tasks: TaskCache
    key: Hashable | None = None
    error: Exception | None = None

    @property
    def id(self) -> str:
        """The id of its configuration."""
        return self.config.id

    @property
    def is_alone(self) -> bool:
        """Whether it is the only run of its program."""
        return self.key is None

    @cached_property
    def hyperparameters(self) -> dict[str, Any]:
        """All that are known, the configuration's first."""
        config = self.config
        return hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)

    @cached_property
    def curve(self) -> Curve:
        """Its learning curve."""
        return Curve(self.task)

    @cached_property
    def task(self) -> Task:
        """Its task, made when it is first used."""
        return self.tasks.task(self.config)

    @property
    def algorithm(self) -> str | Callable[..., Any]:
        """The name of its agent, or a class or function of the user's own."""
        return self.config.algorithm(trust=self.tasks.trust, strict=self.tasks.strict)

    @property
    def world_mdp(self) -> TabularMDP:
        """States and rewards without chance and horizon."""
        return self.tasks.world(self.config, self.task)[1]

    def shared(self, what: str, names: Sequence[str], make: Callable[[], T]) -> T:
        """Return what `make` returns, made once for all runs whose configurations have the same entries `names`."""
        return self.tasks.shared(what, self.config, names, make)

    def prepare(self, *, is_single: bool = False) -> None:
        """Make the key. Raises what is wrong with the run."""
        config = self.config
        key = agent_called(config.agent).prepare(self, self.tasks.device, is_single=is_single)
        self.key = None if key is None else (config.agent, config.steps, config.evaluation_interval, key)

    def write(self, status: str, **entries: object) -> None:
        """Replace run.json if there is a folder: the run is "running", "failed" or "finished"."""
        if self.folder is None:
            return
        config = self.config
        record = {"format": RECORD_FORMAT, "id": config.id, "config": config.to_dict(), "versions": versions()}
        if (rules := class_called(config.environment)) is not None:
            record["rules_version"] = rules.version
        record |= {"status": status, "hyperparameters": self.hyperparameters, **entries}
        write_record(self.folder, record)

    def fail(self, error: Exception) -> None:
        """Mark the run as failed. The reason is kept in run.json."""
        self.error = error
        self.write("failed", error=in_one_line(error))
