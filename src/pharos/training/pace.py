"""How fast an agent learns on this machine: some steps of a run, without evaluations."""

import time
from dataclasses import replace
from typing import Any

from pharos.agents import hyperparameters as hyperparameters_of
from pharos.training.config import RunConfig
from pharos.training.learners import make_learner
from pharos.training.task import Task
from pharos.training.task_cache import TaskCache

EARLY = 100  # steps before DQN learns, in place of its own
NO_ROW = {"value": 0.0, "expected_regret": 0.0, "mean_return": 0.0}


def steps_in_seconds(config: RunConfig, task: Task, warm: int, measured: int, together: int = 1) -> tuple[float, Any]:
    """The seconds that `measured` steps take after `warm` ones, and the policy by then.

    Args:
        task: of the configuration.
        together: runs of the batched engine that take these steps at once, with other seeds.
    """
    chosen = hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)
    if "learning_starts" in chosen:
        chosen["learning_starts"] = min(EARLY, chosen["learning_starts"])
    short = replace(config, steps=warm + measured, hyperparameters=chosen)
    times = []

    def at_point(*_: Any) -> dict[str, float]:
        times.append(time.perf_counter())
        return NO_ROW

    if config.engine == "batched":
        from pharos.agents.batched import make_batch

        members = TaskCache()
        members.adopt(short, task)
        runs = [members.member(None, replace(short, seed=config.seed + i), None).run for i in range(together)]
        batch = make_batch(config.agent, runs)
        batch.learn([warm, warm + measured], lambda _: times.append(time.perf_counter()))
        return times[1] - times[0], batch.policy(0)
    learner = make_learner(short, config.algorithm(trust=True, strict=True), task, chosen)
    learner.learn([warm, warm + measured], at_point)
    return times[1] - times[0], learner.agent
