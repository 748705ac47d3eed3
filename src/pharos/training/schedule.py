"""Runs before they are trained: each with its task and its hyperparameters, checked; and which of them train together.

A *lane* is a list of runs that one program trains at full pace: runs with equal keys (`Agent.group_key`), at most as
many as its agent says (`Agent.width`). A run does not depend on who else is in its lane, so nothing does on a schedule.
Runs share what they can of their tasks. Nothing is trained here.
"""

import json
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pharos.agents import WORLD, RunShape, agent_called
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.environments import class_called
from pharos.mdp import TabularMDP
from pharos.observations import observe
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
OBSERVED_FIELDS = ("environment", "parameters", "observation", "observation_options", "sources")


def plan(
    configs: Sequence[RunConfig], *, workers: int, device: str = "cpu", seconds: Sequence[float] | None = None
) -> list[list[int]]:
    """Return the indices of runs by process: whole lanes, the longest first, each to the least busy process.

    Args:
        workers: most processes.
        device: on which networks are trained.
        seconds: that each run takes, in any unit. Default: all take as long.
    """
    if workers < 2 or len(configs) < 2:
        return [list(range(len(configs)))]
    shapes = Shapes(device)
    groups = lanes([shapes.key(config) for config in configs], [shapes.width(config) for config in configs])
    costs = [float(len(group)) if seconds is None else sum(seconds[i] for i in group) for group in groups]
    return [[i for lane in part for i in groups[lane]] for part in dealt(costs, workers)]


def lanes(keys: Sequence[Hashable | None], widths: Sequence[int]) -> list[list[int]]:
    """Return the lanes of runs, in the order of their first run.

    Args:
        keys: runs with equal keys fit together. None: a run is alone.
        widths: most runs of the lane that a run begins.
    """
    groups: list[list[int]] = []
    begun: dict[Hashable, list[int]] = {}
    for i, key in enumerate(keys):
        lane = None if key is None else begun.get(key)
        if lane is None or len(lane) >= widths[lane[0]]:
            lane = []
            groups.append(lane)
            if key is not None:
                begun[key] = lane
        lane.append(i)
    return groups


def dealt(costs: Sequence[float], workers: int) -> list[list[int]]:
    """Return the indices of jobs by worker: the most expensive first, each to the least busy worker."""
    parts: list[list[int]] = [[] for _ in range(min(workers, len(costs)))]
    busy = [0.0] * len(parts)
    for i in sorted(range(len(costs)), key=lambda i: -costs[i]):
        least = busy.index(min(busy))
        parts[least].append(i)
        busy[least] += costs[i]
    return parts


def halves(group: Sequence[Any]) -> list[list[Any]]:
    """Return the halves of a group that was too large for memory, or that one of its runs has ended."""
    middle = len(group) // 2
    return [list(group[:middle]), list(group[middle:])]


class Shapes:
    """Keys and widths of runs by their configurations alone: no states are built. Code that they name is trusted."""

    def __init__(self, device: str = "cpu"):
        self.device = device
        self._shapes: dict[str, RunShape] = {}

    def key(self, config: RunConfig) -> Hashable | None:
        """Key of a run. Runs with equal keys fit together. None: it is alone, or something is wrong with it."""
        try:
            return agent_called(config.agent).group_key(_Sizes(config, self), self.device)
        except Exception:  # the error is reported when the run begins
            return None

    def width(self, config: RunConfig) -> int:
        """Most runs in a lane with this one."""
        return agent_called(config.agent).width(_Sizes(config, self), self.device)

    def shape(self, config: RunConfig) -> RunShape:
        """The sizes of a run. The sizes of an observation that needs states, or cannot be made, are not known."""
        entry = config.to_dict()
        key = json.dumps([entry.get(name) for name in OBSERVED_FIELDS], sort_keys=True)
        if key not in self._shapes:
            self._shapes[key] = _run_shape(config, key)
        return self._shapes[key]


def _run_shape(config: RunConfig, unknown: str) -> RunShape:
    try:
        env = config.make_environment(trust=True)
        sizes = env.num_actions, float(np.prod(env.components.size.astype(float)))
    except Exception:
        return RunShape((), unknown, False, 1, 0, 0.0)
    try:
        task = config.task(trust=True)
        observation = observe(task.env, task.observation, **dict(task.observation_options))
        shape, dtype = tuple(observation.space.shape or ()), str(observation.space.dtype)
    except Exception:
        return RunShape((), unknown, False, 1, *sizes)
    return RunShape(shape, dtype, len(shape) == 3 and dtype == "uint8", observation.frames, *sizes)


class _WithHyperparameters:
    """A run, by its configuration, with all hyperparameters that are known, those of the configuration first."""

    config: RunConfig

    @cached_property
    def hyperparameters(self) -> dict[str, Any]:
        config = self.config
        return hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)


@dataclass(frozen=True)
class _Sizes(_WithHyperparameters):
    """A run as `Agent.group_key` takes it: a `PlannedRun`."""

    config: RunConfig
    shapes: Shapes

    @property
    def steps(self) -> int:
        return self.config.steps

    @property
    def shape(self) -> RunShape:
        return self.shapes.shape(self.config)


# Prepared runs --------------------------------------------------------------------------------------------------------


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
class PreparedRun(_WithHyperparameters):
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
