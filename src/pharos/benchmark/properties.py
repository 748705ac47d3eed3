"""Properties of the tasks of v1 that are known before any run, by which the report groups them.

`data/task_properties.csv` holds them, by `benchmarks/benchmark_properties.py`. A test computes them again. The digest
of a task is its key, so tasks of v1 in a suite of somebody's own have them as well.
"""

import csv
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark.suite import BenchmarkTask, Protocol
from pharos.mdp import rewards_of_outcomes
from pharos.policies import evaluate_policy

PROPERTIES_FILE = Path(__file__).parent / "data" / "task_properties.csv"
PURPOSES = PROPERTIES_FILE.with_name("task_purposes.csv")
SHORT, LONG = 32, 400  # steps


@dataclass(frozen=True)
class TaskProperties:
    """Properties of a task.

    Attributes:
        digest: of the task.
        num_sizes: distinct sizes |r| > 0 of rewards of its world, without chance that was added.
        num_actions: in each state.
        time_limit: of episodes, in steps.
        ends_by_time: whether nothing but the time limit ends an episode.
        has_chance: whether the world has chance, or some was added.
        constant: normalised regret of the best policy that always plays the same action: 0 optimal, 1 uniform play.
    """

    digest: str
    num_sizes: int
    num_actions: int
    time_limit: int
    ends_by_time: bool
    has_chance: bool
    constant: float

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups of tasks that it is in, one of each property, in the order of the fields."""
        lengths = f"at most {SHORT} steps", f"{SHORT + 1} to {LONG} steps", f"more than {LONG} steps"
        return (
            f"rewards of {'one size' if self.num_sizes <= 1 else 'several sizes'}",
            lengths[(self.time_limit > SHORT) + (self.time_limit > LONG)],
            "ended by time alone" if self.ends_by_time else "ended by the world too",
            "chance" if self.has_chance else "no chance",
            f"{self.num_actions} actions" if self.num_actions < 4 else "4 actions and more",
        )


def properties_of(task: BenchmarkTask, protocol: Protocol) -> TaskProperties:
    """The properties of a task. Cost: as building its states, and solving for each action."""
    learnt = task.training_task(protocol)
    space = learnt.space
    mdp = space.mdp(gamma=1.0)
    terminal = np.asarray(mdp.terminal, bool)
    rewards = rewards_of_outcomes(space) if space.has_chance else np.asarray(mdp.rewards, np.float64)[~terminal].ravel()
    sizes = np.unique(np.abs(rewards[np.abs(rewards) > 1e-12]).round(9))
    values = [
        evaluate_policy(learnt.mdp, np.full(learnt.mdp.num_states, action), horizon=learnt.horizon_steps).value_at_start
        for action in range(mdp.num_actions)
    ]
    regret = (task.value_optimal - max(values)) / (task.value_optimal - task.value_uniform)
    chance = space.has_chance or any(task.chance.values())
    return TaskProperties(
        task.digest, len(sizes), mdp.num_actions, learnt.time_limit, not terminal.any(), chance, round(regret, 4) + 0.0
    )


@cache
def known_properties() -> dict[str, TaskProperties]:
    """Properties by digest of the task, of the tasks of v1."""
    read: dict[str, Callable[[str], Any]] = {
        "digest": str,
        "num_sizes": int,
        "num_actions": int,
        "time_limit": int,
        "constant": float,
    }
    with open(PROPERTIES_FILE, encoding="utf-8", newline="") as lines:
        rows = [
            TaskProperties(
                **{each.name: read.get(each.name, "True".__eq__)(row[each.name]) for each in fields(TaskProperties)}
            )
            for row in csv.DictReader(lines)
        ]
    return {each.digest: each for each in rows}


@dataclass(frozen=True)
class Purpose:
    """Words on a task: what it asks of an agent, and what failing it means."""

    asks: str
    failing: str


@cache
def _purposes() -> dict[str, Purpose]:
    with open(PURPOSES, encoding="utf-8", newline="") as lines:
        return {row["environment"]: Purpose(row["asks"], row["failing"]) for row in csv.DictReader(lines)}


def purpose_of(task: BenchmarkTask) -> Purpose | None:
    """Purpose of a task by its class of environments, and kind of MiniGrid, or None for other classes."""
    name, _, instance = task.environment.partition("/")
    kind = str(task.parameters.get("kind", instance))
    keys = [key for key in _purposes() if key.split()[0] == name and kind.startswith(key.partition(" ")[2])]
    return _purposes()[keys[0]] if keys else None
