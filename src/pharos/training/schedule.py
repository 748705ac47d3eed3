"""Schedule: which runs train together, and which of them in one process. Nothing is trained here.

A *lane* is a list of runs that one program trains at full pace: runs with equal keys (`Agent.group_key`), at most as
many as its agent says (`Agent.width`). A run does not depend on who else is in its lane, so nothing does on a schedule.
"""

import json
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pharos.agents import RunShape, agent_called
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.observations import observe
from pharos.training.task import RunConfig

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


@dataclass(frozen=True)
class _Sizes:
    """A run as `Agent.group_key` takes it: a `PlannedRun`."""

    config: RunConfig
    shapes: Shapes

    @property
    def steps(self) -> int:
        return self.config.steps

    @cached_property
    def hyperparameters(self) -> Mapping[str, Any]:
        config = self.config
        return hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)

    @property
    def shape(self) -> RunShape:
        return self.shapes.shape(self.config)
