"""Training an agent on a task, with the exact regret of its policy at chosen steps; what is done stays done.

    FOLDER/run.json         configuration, versions, status, result
    FOLDER/curve.parquet    a row for each evaluation (curve.csv where pyarrow is not installed)
    FOLDER/checkpoint/      while it runs: what the next attempt goes on from; arrays, JSON and tensors, never code

A run that is killed goes on from its last checkpoint when it is started again: at most the last interval between
evaluations is lost (or the last ten seconds, where intervals are shorter). Without interruption the same seed gives the
same curve file.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pharos.agents import agent_kind
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.environments import Environment, make
from pharos.errors import AllRunsFailed, ParameterError
from pharos.mdp import ChanceSetting
from pharos.observations import own_observation
from pharos.training.batch import Progress, ProgressCallback, TrainingJobs, train_configs
from pharos.training.config import RunConfig
from pharos.training.process_pool import parts_of, train_parts
from pharos.training.run_folder import TrainingResult
from pharos.training.task import Task, TaskValues
from pharos.training.task_cache import FailedRun, TaskCache

RunProgress = Callable[[int, int, Mapping[str, Any]], None]


def train(  # noqa: PLR0913
    agent: str,
    environment: Environment | str,
    *,
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
    seed: int = 0,
    evaluation_interval: int | None = None,
    hyperparameters: Mapping[str, Any] | str | os.PathLike | None = None,
    engine: str = "sb3",
    out: str | os.PathLike | None = None,
    tensorboard: bool = False,
    progress: RunProgress | None = None,
    **parameters: Any,
) -> TrainingResult:
    """Train an agent, and measure the exact regret of its policy as it learns.

    Args:
        agent: "q_learning", "dqn", "ppo", "a2c", or "module:Class" or "file.py:Class" of an algorithm for
            Stable-Baselines3.
        environment: a name, with its `parameters` as keywords, or an Environment.
        steps: number of environment steps to learn from.
        observation, observation_options: what the agent sees, also "module:name" or "file.py:name"; tabular agents see
            the index of the state.
        sticky, random, lazy: chance of acting, see `Task`.
        reward_noise, reward_delay: how the agent is paid; values, returns and regret are of what it earns.
        gamma, horizon: setting of values and returns, see `Task`; the agent's own discount is a hyperparameter.
        evaluation_interval: steps between evaluations; None: a hundredth of `steps`.
        hyperparameters: go before those of agents/hyperparameters.py; or a YAML file of the same form, such as one
            that `tune` wrote.
        engine: what trains networks: "sb3", Stable-Baselines3; or "batched", pharos' own DQN and PPO, which trains many
            runs at once (`train_many`).
        out: folder of the run; None: nothing is written. A finished run there is returned, an unfinished one resumed.
        tensorboard: write TensorBoard's logs into `out`/tensorboard (algorithms of Stable-Baselines3).
        progress: called after each evaluation with steps done, steps in all, and the row of the curve.
    Raises:
        ParameterError: an option is wrong, or `out` holds another run. UnknownName: no such name; the nearest is
            suggested.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    task, (config,) = _runs([seed], **locals())
    members = TaskCache()
    members.adopt(config, task)
    return _train(config, members, None if out is None else Path(out), progress, tensorboard)


def train_many(  # noqa: PLR0913
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
    progress: ProgressCallback | None = None,
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
    options = locals()
    numbers = [int(seed) for seed in seeds]
    if not numbers or len(set(numbers)) != len(numbers):
        raise ParameterError(f"seeds are {numbers}; expected at least one, each once")
    task, configs = _runs(numbers, **options)
    folder = None if out is None else Path(out)
    folders = None if folder is None else [folder / f"seed-{seed}" for seed in numbers]
    checkpoints = None if folder is None else folder / "checkpoints"
    parts = parts_of(configs, workers, device)
    if folders is not None and len(parts) > 1:
        results = train_parts(configs, folders, parts, checkpoints=checkpoints, device=device, progress=progress)
    else:
        members = TaskCache(device=device)
        members.adopt(configs[0], task)
        results = train_configs(configs, folders, checkpoints=checkpoints, progress=progress, members=members)
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
    """Train as a configuration says, the `config` of a run.json or of a study; results go into `folder`.

    Args:
        values: at the start of the task, where they are known already.
        trust: whether code that the configuration names may be imported: an environment, observation or agent of its
            own.
        strict: whether a file of such code that has changed since is an error instead of a warning.
    Raises:
        FileFormatError: it is not the configuration of a run. UntrustedCode: it names code. Else as `train`.
    """
    if not isinstance(config, RunConfig):
        config = RunConfig.from_dict(config)
    members = TaskCache(lambda _: values, trust=trust, strict=strict)
    return _train(config, members, Path(folder), progress)


def _train(
    config: RunConfig,
    members: TaskCache,
    folder: Path | None,
    progress: RunProgress | None,
    tensorboard: bool = False,
) -> TrainingResult:
    """A single run, whose errors are raised."""
    if tensorboard and config.engine == "batched":
        raise ParameterError("TensorBoard's logs are those of Stable-Baselines3; expected the engine sb3, or none")
    if tensorboard and (folder is None or config.is_tabular):
        raise ParameterError(
            f"TensorBoard's logs were asked for, with {config.agent} and {'a' if folder else 'no'} folder for results; "
            f"expected an algorithm of Stable-Baselines3 and a folder (out)"
        )

    def tell(now: Progress) -> None:
        if progress is not None and 0 in now.rows:
            progress(now.rows[0]["step"], config.steps, now.rows[0])

    folders, checkpoints = (None, None) if folder is None else ([folder], folder / "checkpoints")
    jobs = TrainingJobs([config], folders, checkpoints, tell, members, raises=True, tensorboard=tensorboard)
    (end,) = jobs.run()
    assert isinstance(end, TrainingResult)
    return end


# What is trained ------------------------------------------------------------------------------------------------------


def _runs(
    numbers: Sequence[int],
    *,
    agent: str,
    environment: Environment | str,
    parameters: Mapping[str, Any],
    steps: int,
    evaluation_interval: int | None,
    hyperparameters: Mapping[str, Any] | str | os.PathLike | None,
    engine: str,
    **options: Any,
) -> tuple[Task, list[RunConfig]]:
    """The task, and the configuration of a run with each of the seeds; `options` as `train` takes them."""
    names = ("observation", "observation_options", "gamma", "horizon", *vars(ChanceSetting()))
    task = task_for(agent, environment, parameters, **{name: options[name] for name in names})
    if hyperparameters is not None and not isinstance(hyperparameters, Mapping):
        hyperparameters = hyperparameters_of(agent, task.env.name, str(task.observation), table=Path(hyperparameters))
    setting: dict[str, Any] = {"steps": steps, "evaluation_interval": evaluation_interval, "engine": engine}
    return task, [
        RunConfig.of_task(task, agent, seed=number, hyperparameters=hyperparameters, **setting) for number in numbers
    ]


def task_for(
    agent: str, environment: Environment | str, parameters: Mapping[str, Any], *, observation: str, **setting: Any
) -> Task:
    """The task of an agent that asks for an observation, which tables do not get; `setting` as `train` takes it."""
    sight = agent_kind(agent).observation(observation)
    options = dict(setting.pop("observation_options") or {})
    made = make(environment, **parameters) if isinstance(environment, str) else environment
    return Task(made, observation=own_observation(sight) or sight, observation_options=options, **setting)
