"""Runs that are to be trained together: each with its task, what it sees, and its hyperparameters, checked."""

import json
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pharos.agents import check_hyperparameters
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.errors import ParameterError, PharosError
from pharos.training.config import RunConfig
from pharos.training.curve import Curve
from pharos.training.learners import Tabular
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


def in_one_line(error: BaseException) -> str:
    """An error as pharos says it, or with its type."""
    text = " ".join(str(error).split())
    return text if isinstance(error, PharosError) else f"{type(error).__name__}: {text}"


@dataclass(eq=False)
class Member:
    """A run that waits for its batch, or is in it.

    Attributes:
        place: among the configurations; None for a run of a checkpoint that nobody asks for.
    """

    place: int | None
    config: RunConfig
    folder: Path | None
    task: Task
    hyperparameters: dict[str, Any]
    run: Any
    key: Hashable
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

    def member(self, place: int | None, config: RunConfig, folder: Path | None) -> Member:
        """A run, ready to be grouped.

        Raises:
            ParameterError: a hyperparameter is wrong, or the engine lacks it.
        """
        if config.is_tabular:
            return self._table(place, config, folder)
        from pharos.agents.batched import BatchRun, ObservationSource, group_key, supports

        chosen = hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)
        check_hyperparameters(config.agent, chosen)
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
            laziness=chance.lazy,
            staying=self._once("staying", config, WORLD, lambda: _staying(task)) if chance.lazy else None,
            reward_noise=chance.reward_noise,
            reward_delay=chance.reward_delay,
        )
        key = (config.agent, config.steps, config.evaluation_interval, group_key(config.agent, run, self.device))
        return Member(place, config, folder, task, chosen, run, key)

    def _table(self, place: int | None, config: RunConfig, folder: Path | None) -> Member:
        """A run of Q-learning, which a batch makes; that it can be made is seen before."""
        chosen = hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)
        task = self.task(config)

        def make() -> Any:
            return Tabular(task, chosen, config.steps, config.seed).agent

        make()
        return Member(
            place, config, folder, task, chosen, make, (config.agent, config.steps, config.evaluation_interval)
        )

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
