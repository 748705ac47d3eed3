"""The same agent on the same task with many seeds: a folder for each, trained at once where the engine can."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pharos.environments import Environment
from pharos.errors import AllRunsFailed, ParameterError
from pharos.training.batch import train_configs
from pharos.training.config import RunConfig
from pharos.training.process_pool import parts_of, train_parts
from pharos.training.run_folder import TrainingResult
from pharos.training.task_cache import FailedRun, TaskCache
from pharos.training.train import given_hyperparameters, task_for
from pharos.training.training_jobs import Tell


def train_many(
    agent: str,
    environment: Environment | str,
    *,
    seeds: Iterable[int],
    steps: int,
    observation: str = "vector",
    observation_options: Mapping[str, Any] | None = None,
    sticky: float = 0.0,
    random: float = 0.0,
    lazy: float = 0.0,
    reward_noise: float = 0.0,
    reward_delay: int = 0,
    gamma: float = 1.0,
    horizon: int | str | None = "default",
    evaluation_interval: int | None = None,
    hyperparameters: Mapping[str, Any] | str | os.PathLike | None = None,
    engine: str = "batched",
    device: str = "cpu",
    workers: int = 1,
    out: str | os.PathLike | None = None,
    progress: Tell | None = None,
    **parameters: Any,
) -> list[TrainingResult | FailedRun]:
    """Train an agent once for each seed, and measure the exact regret of its policies as they learn.

    Args:
        seeds: of the runs, each another.
        engine: "batched", all runs as one program (dqn, ppo, and q_learning one after the other); or "sb3", one after
            the other.
        device: of the batched engine: "cpu" or "cuda".
        workers: processes that share whole lanes of the batched engine, where there is a folder for results. Results do
            not depend on it.
        out: a folder, in which each run has its own, seed-0 and so on; None: nothing is written. Finished runs there
            are returned, and what was killed goes on from its last checkpoint.
        progress: called after each evaluation.
        others: as for `train`.
    Returns:
        The result of each run in the order of the seeds; a run that failed says why, and does not stop the others.
    Raises:
        ParameterError: no seed, or one twice; or as `train`. AllRunsFailed: none has a result.
    """
    numbers = [int(seed) for seed in seeds]
    if not numbers or len(set(numbers)) != len(numbers):
        raise ParameterError(f"seeds are {numbers}; expected at least one, each once")
    task = task_for(
        agent,
        environment,
        parameters,
        observation=observation,
        observation_options=observation_options,
        sticky=sticky,
        random=random,
        lazy=lazy,
        reward_noise=reward_noise,
        reward_delay=reward_delay,
        gamma=gamma,
        horizon=horizon,
    )
    values = given_hyperparameters(agent, task, hyperparameters)
    configs = [
        RunConfig.of_task(
            task,
            agent,
            steps=steps,
            seed=seed,
            evaluation_interval=evaluation_interval,
            hyperparameters=values,
            engine=engine,
        )
        for seed in numbers
    ]
    folder = None if out is None else Path(out)
    if folder is not None and len(parts := parts_of(configs, workers, device)) > 1:
        results = train_parts(
            configs,
            [folder / f"seed-{seed}" for seed in numbers],
            parts,
            checkpoints=folder / "checkpoints",
            device=device,
            progress=progress,
        )
    else:
        members = TaskCache(device=device)
        members.adopt(configs[0], task)
        results = train_configs(
            configs,
            None if folder is None else [folder / f"seed-{seed}" for seed in numbers],
            checkpoints=None if folder is None else folder / "checkpoints",
            progress=progress,
            members=members,
        )
    failed = {
        f"seed {seed}": end.error for seed, end in zip(numbers, results, strict=True) if isinstance(end, FailedRun)
    }
    if len(failed) == len(numbers):
        raise AllRunsFailed("train_many" if folder is None else folder, failed, results)
    return results
