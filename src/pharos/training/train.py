"""Training an agent on a task, with the exact regret of its policy at chosen steps; what is done stays done.

    FOLDER/run.json         configuration, versions, status, result
    FOLDER/curve.parquet    a row for each evaluation (curve.csv where pyarrow is not installed)
    FOLDER/checkpoint/      while it runs: what the next attempt goes on from; arrays, JSON and tensors, never code

A run that is killed goes on from its last checkpoint when it is started again: at most the last interval between
evaluations is lost (or the last ten seconds, where intervals are shorter). Without interruption the same seed gives the
same curve file.
"""

import os
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pharos.agents import agent_kind
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.environments import Environment, make
from pharos.errors import FolderLocked, ParameterError
from pharos.observations import own_observation
from pharos.system import compiling
from pharos.system.storage import CLAIM, LOCK, lock, remove_leftovers
from pharos.training import results as _results
from pharos.training.config import RunConfig
from pharos.training.curve import Curve
from pharos.training.learners import Learner, make_learner
from pharos.training.run_folder import Checkpoint, Record, TrainingResult, finished_result
from pharos.training.task import Task, TaskValues

Progress = Callable[[int, int, Mapping[str, Any]], None]


def train(
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
    progress: Progress | None = None,
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
        hyperparameters: go before those of agents/defaults.py; or a YAML file of the same form, such as one
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
    return train_on(
        task,
        agent,
        steps=steps,
        seed=seed,
        evaluation_interval=evaluation_interval,
        hyperparameters=hyperparameters,
        engine=engine,
        out=out,
        tensorboard=tensorboard,
        progress=progress,
    )


def task_for(
    agent: str, environment: Environment | str, parameters: Mapping[str, Any], *, observation: str, **setting: Any
) -> Task:
    """The task of an agent that asks for an observation, which tables do not get; `setting` as `train` takes it."""
    sight = agent_kind(agent).observation(observation)
    options = dict(setting.pop("observation_options") or {})
    made = make(environment, **parameters) if isinstance(environment, str) else environment
    return Task(made, observation=own_observation(sight) or sight, observation_options=options, **setting)


def train_on(
    task: Task,
    agent: str,
    *,
    steps: int,
    seed: int = 0,
    evaluation_interval: int | None = None,
    hyperparameters: Mapping[str, Any] | str | os.PathLike | None = None,
    engine: str = "sb3",
    out: str | os.PathLike | None = None,
    tensorboard: bool = False,
    progress: Progress | None = None,
) -> TrainingResult:
    """As `train`, on a task, which is built and solved once for all runs on it."""
    config = RunConfig.of_task(
        task,
        agent,
        steps=steps,
        seed=seed,
        evaluation_interval=evaluation_interval,
        hyperparameters=given_hyperparameters(agent, task, hyperparameters),
        engine=engine,
    )
    return train_task(config, task, None if out is None else Path(out), tensorboard, progress)


def given_hyperparameters(
    agent: str, task: Task, source: Mapping[str, Any] | str | os.PathLike | None
) -> Mapping[str, Any] | None:
    """Those of a mapping, or of a YAML file for this agent and task."""
    if source is None or isinstance(source, Mapping):
        return source
    return hyperparameters_of(agent, task.env.name, str(task.observation), table=Path(source))


def train_config(
    config: RunConfig | Mapping[str, Any],
    folder: str | os.PathLike,
    progress: Progress | None = None,
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
    task, algorithm = config.task(values, trust=trust, strict=strict), config.algorithm(trust=trust, strict=strict)
    return train_task(config, task, Path(folder), False, progress, algorithm)


# One run --------------------------------------------------------------------------------------------------------------


def train_task(
    config: RunConfig,
    task: Task,
    folder: Path | None,
    tensorboard: bool = False,
    progress: Progress | None = None,
    algorithm: str | type | None = None,
) -> TrainingResult:
    """As `train_config`, on a task that is made already; with `algorithm` as `RunConfig.algorithm` gives it."""
    if tensorboard and (folder is None or config.is_tabular):
        raise ParameterError(
            f"TensorBoard's logs were asked for, with {config.agent} and {'a' if folder else 'no'} folder for results; "
            f"expected an algorithm of Stable-Baselines3 and a folder (out)"
        )
    if config.engine == "batched":
        return _as_a_batch(config, task, folder, tensorboard, progress)
    if folder is None:
        return _train(config, task, None, tensorboard, progress, algorithm)
    if (done := finished_result(folder, config)) is not None:
        return done
    folder.mkdir(parents=True, exist_ok=True)
    with lock(folder, FolderLocked, "training"):
        for name in (_results.RECORD, _results.CURVE, "policy.npy", "regret.png"):  # of a process that was killed
            remove_leftovers(folder / name)
        result = _train(config, task, folder, tensorboard, progress, algorithm)
        for name in (LOCK, CLAIM):  # whoever waits for it finds a finished run
            (folder / name).unlink(missing_ok=True)
    return result


def _train(
    config: RunConfig,
    task: Task,
    folder: Path | None,
    tensorboard: bool,
    progress: Progress | None,
    algorithm: str | type | None,
) -> TrainingResult:
    """A run that nobody else is at."""
    began, compiled = time.perf_counter(), compiling.seconds()
    if folder is not None and (done := finished_result(folder, config)) is not None:
        return done
    chosen = hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)
    logs = folder / "tensorboard" if folder is not None and tensorboard else None
    learner = make_learner(config, algorithm or config.algorithm(), task, chosen, logs)
    curve, checkpoint = Curve(task), None
    if folder is not None:
        checkpoint = Checkpoint(folder / "checkpoint", config.id)
        curve.rows, spent = checkpoint.restore(learner) or ([], 0.0)
        began -= spent
    record = Record(folder, config, chosen)
    record.write("running")
    _learn(learner, curve, config, progress, checkpoint, record, began)
    compiled = compiling.seconds() - compiled
    seconds = time.perf_counter() - began - compiled
    result = curve.result()
    if folder is not None:
        learner.publish(folder)
        _results.write_curve(folder, curve.rows)
        record.write("finished", seconds=seconds, compiling_seconds=compiled, result=result)
        for leftover in folder.glob("checkpoint*"):  # of kills in the middle of replacing one, too
            shutil.rmtree(leftover, ignore_errors=True)
    rows = [{name: row[name] for name in _results.COLUMNS} for row in curve.rows]
    return TrainingResult(config.to_dict(), result, rows, learner.agent, folder, seconds)


def _as_a_batch(
    config: RunConfig, task: Task, folder: Path | None, tensorboard: bool, progress: Progress | None
) -> TrainingResult:
    """A single run of the batched engine: a batch of one."""
    from pharos.training.batch import train_configs
    from pharos.training.task_cache import FailedRun, TaskCache

    if tensorboard:
        raise ParameterError("TensorBoard's logs are those of Stable-Baselines3; expected the engine sb3, or none")
    members = TaskCache()
    members.adopt(config, task)

    def tell(now: Any) -> None:
        if progress is not None and 0 in now.rows:
            progress(now.rows[0]["step"], config.steps, now.rows[0])

    folders, checkpoints = (None, None) if folder is None else ([folder], folder / "checkpoints")
    (end,) = train_configs([config], folders, checkpoints=checkpoints, progress=tell, members=members)
    if isinstance(end, FailedRun):
        raise end.exception
    return end


def _learn(
    learner: Learner,
    curve: Curve,
    config: RunConfig,
    progress: Progress | None,
    checkpoint: Checkpoint | None,
    record: Record,
    began: float,
) -> None:
    """Learn from the last row of the curve on, with an evaluation at each point; `began`: when the run did."""
    if not curve.rows:
        curve.add(0, 0, 0.0, learner.agent)
    start, steps, interval = curve.rows[-1]["step"], config.steps, config.evaluation_interval
    points = [point for point in [*range(interval, steps, interval), steps] if point > start]

    def at_point(step: int, episodes: int, returns: float) -> dict[str, Any]:
        row = curve.add(step, episodes, returns, learner.agent)
        if progress is not None:
            progress(step, steps, row)
        if checkpoint is not None and step < steps:
            checkpoint.save(learner, curve.rows, time.perf_counter() - began)
        return row

    if not points:
        return
    try:
        learner.learn(points, at_point)
    except Exception as error:
        record.write("failed", error=f"{type(error).__name__}: {' '.join(str(error).split())}")
        raise
