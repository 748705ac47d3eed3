"""Runs before they are trained: each with its task, what it sees, and its hyperparameters, checked."""

import json
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pharos.agents import QLearning, check_hyperparameters
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.errors import ParameterError
from pharos.system.wording import in_one_line
from pharos.training.config import RunConfig
from pharos.training.curve import Curve
from pharos.training.run_folder import Record
from pharos.training.task import Task, TaskValues

# What of a configuration decides about rewards and states, about the task, about what is seen
WORLD = ("environment", "parameters", "gamma", "sources")
TASK = ("environment", "parameters", "chance", "observation", "observation_options", "gamma", "horizon", "sources")
SIGHT = ("environment", "parameters", "observation", "observation_options", "sources")


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


@dataclass(eq=False)
class Member:
    """A run that waits for its learner, or is learnt.

    Attributes:
        place: among the configurations; None for a run of a checkpoint that nobody asks for.
        run: what its learner is made of: a BatchRun, a function that makes a table, or an algorithm.
        key: runs with equal keys can be trained together.
        is_alone: whether it has checkpoints in its own folder, and holds that.
    """

    place: int | None
    config: RunConfig
    folder: Path | None
    task: Task
    hyperparameters: dict[str, Any]
    run: Any
    key: Hashable
    is_alone: bool = False
    error: Exception | None = None
    curve: Curve = field(init=False)

    def __post_init__(self) -> None:
        self.curve = Curve(self.task)

    @property
    def record(self) -> Record:
        """Its run.json."""
        return Record(self.folder, self.config, self.hyperparameters)

    def fail(self, error: Exception) -> None:
        """It has failed; the reason is kept in run.json."""
        self.error = error
        self.record.write("failed", error=in_one_line(error))


class TaskCache:
    """Makes members of batches; what several runs share is made once: spaces, rewards, solved values, observations.

    Args:
        values: config -> values at the start of its task, where they are known.
        trust, strict: as for `RunConfig.task`.
        device: where networks are trained, which decides about what fits together.
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
        self.made: dict[str, Any] = {}

    def task(self, config: RunConfig) -> Task:
        """The task of a run, the same object for all that have it; spaces and rewards are those of other tasks."""
        return self._once("task", config, TASK, lambda: self._task(config))

    def adopt(self, config: RunConfig, task: Task) -> None:
        """Take a task that is made already for that of a run."""
        self._once("task", config, TASK, lambda: task)

    def _task(self, config: RunConfig) -> Task:
        values = self.values(config) if self.values is not None else None
        task = config.task(values, trust=self.trust, strict=self.strict)
        space, plain = self._world(config, task)
        vars(task).update(space=space, mdp=task.chance.of(plain.with_horizon(task.horizon_steps)))
        return task

    def _world(self, config: RunConfig, task: Task) -> tuple[Any, Any]:
        """The states of a task, and their MDP without chance and horizon; the same for all tasks of a world."""
        world: tuple[Any, Any] = self._once(
            "world", config, WORLD, lambda: (task.space, task.space.mdp(gamma=task.gamma))
        )
        return world

    def member(self, place: int | None, config: RunConfig, folder: Path | None, *, is_alone: bool = False) -> Member:
        """A run, ready to be grouped.

        Raises:
            ParameterError: a hyperparameter is wrong, or the engine lacks it.
        """
        chosen = hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)
        key: Hashable = (config.agent, config.steps, config.evaluation_interval)
        if config.engine != "batched":
            algorithm, task = config.algorithm(trust=self.trust, strict=self.strict), self.task(config)

            def table() -> QLearning:
                limit, noise, delay = task.time_limit, task.chance.reward_noise, task.chance.reward_delay
                return QLearning(
                    task.mdp,
                    total_steps=config.steps,
                    seed=config.seed,
                    time_limit=limit,
                    reward_noise=noise,
                    reward_delay=delay,
                    **chosen,
                )

            if config.is_tabular and not is_alone:
                table()  # what is wrong is said before others are concerned
            make = table if config.is_tabular else algorithm
            return Member(place, config, folder, task, chosen, make, key, is_alone)
        from pharos.agents.batched import OURS, BatchRun, ObservationSource, group_key, supports

        check_hyperparameters(config.agent, chosen, OURS)
        lacking = supports(config.agent, chosen)
        if lacking is not None:
            raise ParameterError(f"the batched engine: {lacking}; the engine sb3 has it")
        task, chance = self.task(config), config.chance
        run = BatchRun(
            mdp=replace(chance, lazy=0.0).of(self._world(config, task)[1]) if chance.lazy else task.mdp,
            observe=self._once("sight", config, SIGHT, lambda: ObservationSource.of(task.space, task.sight.observe)),
            time_limit=task.time_limit,
            hyperparameters=chosen,
            steps=config.steps,
            seed=config.seed,
            key=int(config.id, 16),
            gamma=config.gamma,
            outcome_rewards=self._once("rewards", config, WORLD, lambda: _drawn_rewards(task)),
            chance=chance,
            staying=self._once("staying", config, WORLD, lambda: _staying(task)) if chance.lazy else None,
        )
        return Member(place, config, folder, task, chosen, run, (key, group_key(config.agent, run, self.device)))

    def _once(self, what: str, config: RunConfig, names: Sequence[str], make: Callable[[], Any]) -> Any:
        entry = config.to_dict()
        key = json.dumps([what, *(entry.get(name) for name in names)], sort_keys=True)
        if key not in self.made:
            self.made[key] = make()
        return self.made[key]


def _staying(task: Task) -> Any:
    """(S, A) what an action without effect pays."""
    from pharos.mdp import rewards_of_staying

    return rewards_of_staying(task.space).array.astype(float)


def _drawn_rewards(task: Task) -> Any:
    """What each outcome pays where the rules have chance; None where rewards belong to pairs."""
    from pharos.mdp import rewards_of_outcomes

    return rewards_of_outcomes(task.space) if task.space.has_chance else None
