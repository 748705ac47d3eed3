"""Training an agent on a task, with the exact regret of its policy at chosen steps. Runs that are killed resume.

    FOLDER/run.json         configuration, versions, status, result
    FOLDER/curve.csv        a row for each evaluation
    FOLDER/checkpoint/      while it runs: what the next attempt goes on from: arrays, JSON and tensors, never code

A run that is killed goes on from its last checkpoint when it is started again: at most the last interval between
evaluations is lost (or the last ten seconds, if intervals are shorter). Without interruption the same seed gives the
same curve file.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pharos.agents import agent_called, agent_name
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.environments import Environment
from pharos.errors import AllRunsFailed, ParameterError
from pharos.mdp import whole_number
from pharos.observations import own_observation
from pharos.system.records import split_options, takes
from pharos.training.execution import ProgressCallback, Training, TrainingProgress, train_configs
from pharos.training.options import TrainingOptions
from pharos.training.results import TrainingResult
from pharos.training.schedule import FailedRun, Shapes, TaskCache
from pharos.training.task import RunConfig, Task, TaskValues

RunProgress = Callable[[int, int, Mapping[str, Any]], None]


@takes(TrainingOptions)
def train(
    agent: str | Callable[..., Any],
    environment: Environment | str,
    *,
    seed: int = 0,
    out: str | os.PathLike | None = None,
    tensorboard: bool = False,
    progress: RunProgress | None = None,
    **options: Any,
) -> TrainingResult:
    """Train an agent, and measure the exact regret of its policy as it learns.

    Args:
        agent: "q_learning", "dqn", "ppo", "a2c". Or "module:Name" or "file.py:Name" of an algorithm for
            Stable-Baselines3, or of a function learn(env, steps, seed) that yields policies. Or such a class or
            function itself.
        environment: a name, with its parameters as keywords, or an Environment.
        seed: decides everything random.
        out: folder of the run. None: nothing is written. A finished run there is returned, an unfinished one resumed.
        tensorboard: write TensorBoard's logs into `out`/tensorboard (algorithms of Stable-Baselines3).
        progress: called after each evaluation with steps done, steps in all, and the row of the curve.
        options: of `TrainingOptions`: steps, observation, observation_options, sticky, random, lazy, reward_noise,
            reward_delay, gamma, horizon, objective, evaluation_interval, hyperparameters, engine, and the parameters of
            the environment.
    Raises:
        ParameterError: an option is wrong, or `out` holds another run. UnknownName: no such name. The nearest is
            suggested.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    task, (config,) = _runs(environment, {"agent": agent_name(agent), **options}, [seed])
    tasks = TaskCache()
    tasks.adopt(config, task)
    return _train(config, tasks, None if out is None else Path(out), progress, tensorboard)


@takes(TrainingOptions, engine="batched")
def train_many(
    agent: str | Callable[..., Any],
    environment: Environment | str,
    *,
    seeds: Iterable[int],
    device: str = "cpu",
    workers: int = 1,
    out: str | os.PathLike | None = None,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> list[TrainingResult | FailedRun]:
    """Train an agent once for each seed, and measure the exact regret of its policies as they learn.

    Args:
        seeds: of the runs, each another.
        device: of the batched engine: "cpu" or "cuda".
        workers: processes that share the runs, lane by lane, if there is a folder for results. Runs that train alone
            stay in one. Results do not depend on it.
        out: a folder, in which each run has its own, seed-0 and so on. None: nothing is written. Finished runs there
            are returned, and what was killed goes on from its last checkpoint.
        progress: called after each evaluation.
        options: as for `train`. The engine is "batched" by default, if it has the agent: all runs as one program (dqn,
            ppo, and q_learning one after the other). With "sb3" they train one after the other.
    Returns:
        The result of each run in the order of the seeds. A run that failed says why, and does not stop the others.
    Raises:
        ParameterError: no seed, one seed twice, or as for `train`. AllRunsFailed: none has a result.
    """
    if not isinstance(seeds, Iterable):
        raise ParameterError(f"seeds is {seeds!r}; expected several, such as range(3)")
    numbers = list(seeds)
    if not numbers or len(set(numbers)) != len(numbers):
        raise ParameterError(f"seeds are {numbers}; expected at least one, each once")
    name = agent_name(agent)
    options = {"agent": name, "engine": agent_called(name).engines[-1], **options}
    task, configs = _runs(environment, options, numbers)
    folder = None if out is None else Path(out)
    folders = None if folder is None else [folder / f"seed-{seed}" for seed in numbers]
    checkpoints = None if folder is None else folder / "checkpoints"
    tasks = TaskCache(device=device)
    tasks.adopt(configs[0], task)
    if Shapes(device).key(configs[0]) is None:
        workers = 1
    results = train_configs(configs, folders, checkpoints=checkpoints, progress=progress, tasks=tasks, workers=workers)
    failed = {
        f"seed {seed}": end.error for seed, end in zip(numbers, results, strict=True) if isinstance(end, FailedRun)
    }
    if len(failed) == len(numbers):
        raise AllRunsFailed("train_many" if folder is None else folder, failed, results)
    return results


def train_config(
    config: RunConfig | Mapping[str, Any],
    folder: str | os.PathLike,
    progress: RunProgress | None = None,
    *,
    values: TaskValues | None = None,
    trust: bool = False,
    strict: bool = False,
) -> TrainingResult:
    """Train as a configuration says, the `config` of a run.json or of a study. Results go into `folder`.

    Args:
        values: at the start of the task, if they are known already.
        trust: whether code that the configuration names may be imported: an environment, observation or agent of its
            own.
        strict: whether a file of such code that has changed since is an error instead of a warning.
    Raises:
        FileFormatError: it is not the configuration of a run. UntrustedCode: it names code. Else as `train`.
    """
    if not isinstance(config, RunConfig):
        config = RunConfig.from_dict(config)
    tasks = TaskCache(lambda _: values, trust=trust, strict=strict)
    return _train(config, tasks, Path(folder), progress)


def _train(
    config: RunConfig,
    tasks: TaskCache,
    folder: Path | None,
    progress: RunProgress | None,
    tensorboard: bool = False,
) -> TrainingResult:
    """Train a single run. Its errors are raised."""
    if tensorboard and (folder is None or not agent_called(config.agent).has_tensorboard(config.engine)):
        raise ParameterError(
            f"TensorBoard's logs were asked for, with {config.agent}, the engine {config.engine} and "
            f"{'a' if folder else 'no'} folder for results; expected an algorithm of Stable-Baselines3, the engine sb3 "
            f"and a folder (out)"
        )

    def report(now: TrainingProgress) -> None:
        if progress is not None and 0 in now.rows:
            progress(now.rows[0]["step"], config.steps, now.rows[0])

    folders, checkpoints = (None, None) if folder is None else ([folder], folder / "checkpoints")
    options = {"raises": True, "tensorboard": tensorboard}
    (end,) = Training([config], folders, [[0]], checkpoints, report, tasks, **options).results_in_order()
    assert isinstance(end, TrainingResult)
    return end


# What is trained ------------------------------------------------------------------------------------------------------


def _runs(
    environment: Environment | str, options: Mapping[str, Any], seeds: Sequence[int]
) -> tuple[Task, list[RunConfig]]:
    """The task, and the configuration of a run with each of the seeds. `options` are the same as for `train`."""
    training, parameters = split_options(TrainingOptions, options)
    agent, hyperparameters, table = training.agent, training.hyperparameters, options.get("hyperparameters")
    seeds = [whole_number(seed, "seed", "a whole number, at least 0", least=0) for seed in seeds]
    name = agent_called(agent).observation(training.observation)
    if training.observation_options and agent_called(agent).fixed_observation is not None:
        raise ParameterError(
            f"{agent} sees {name} whatever is asked for; leave out {', '.join(training.observation_options)}"
        )
    task = Task.of(
        environment,
        parameters,
        chance=training.chance,
        observation=own_observation(name) or name,
        observation_options=dict(training.observation_options or {}),
        gamma=training.gamma,
        horizon=training.horizon,
        objective=training.objective,
    )
    if isinstance(table, str | os.PathLike):
        hyperparameters = hyperparameters_of(agent, task.env.name, str(task.observation), table=Path(table))
    same = {name: getattr(training, name) for name in ("steps", "evaluation_interval", "engine")}
    return task, [RunConfig.of_task(task, agent, seed=seed, hyperparameters=hyperparameters, **same) for seed in seeds]
