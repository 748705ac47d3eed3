"""Training an agent on a task, with the exact regret of its policy at chosen steps; what is done stays done.

    FOLDER/run.json         configuration, versions, status, result
    FOLDER/curve.parquet    a row for each evaluation (curve.csv where pyarrow is not installed)
    FOLDER/checkpoint/      while it runs: what the next attempt goes on from; arrays, JSON and tensors, never code

A run that is killed goes on from its last checkpoint when it is started again: at most the last interval between
evaluations is lost (or the last ten seconds, where intervals are shorter). Without interruption the same seed gives the
same curve file.
"""

import json
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pharos.agents import agent_kind
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.environments import Environment, make
from pharos.errors import ParameterError
from pharos.experiments import results as _results
from pharos.experiments.config import RunConfig, run_id
from pharos.experiments.evaluation import evaluate_agent
from pharos.experiments.learners import Learner, make_learner
from pharos.experiments.task import Task, TaskValues
from pharos.observations import own_observation
from pharos.storage import sync

Progress = Callable[[int, int, Mapping[str, Any]], None]
CHECKPOINT_SECONDS = 10.0


@dataclass(frozen=True)
class TrainingResult:
    """What a run gave.

    Attributes:
        config: of the run.
        result: summary: values of the optimal, uniform, worst and final policy, regrets, episodes.
        curve: a row for each evaluation, a dictionary with the columns of curve.parquet.
        agent: the trained agent: a `QLearning` or a model of Stable-Baselines3; None where the run was finished before.
        folder: of the run, or None.
        seconds: time that it took.
    """

    config: dict[str, Any]
    result: dict[str, Any]
    curve: list[dict[str, Any]]
    agent: Any
    folder: Path | None
    seconds: float


def train(
    agent: str,
    environment: Environment | str,
    *,
    steps: int,
    observation: str = "vector",
    observation_options: Mapping[str, Any] | None = None,
    sticky: float = 0.0,
    random: float = 0.0,
    gamma: float = 1.0,
    horizon: int | str | None = "default",
    seed: int = 0,
    evaluation_interval: int | None = None,
    hyperparameters: Mapping[str, Any] | str | os.PathLike | None = None,
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
        sticky, random: chance.
        gamma, horizon: setting of values and returns, see `Task`; the agent's own discount is a hyperparameter.
        evaluation_interval: steps between evaluations; None: a hundredth of `steps`.
        hyperparameters: go before those of agents/defaults.py; or a YAML file of the same form, such as one
            that `tune` wrote.
        out: folder of the run; None: nothing is written. A finished run there is returned, an unfinished one resumed.
        tensorboard: write TensorBoard's logs into `out`/tensorboard (algorithms of Stable-Baselines3).
        progress: called after each evaluation with steps done, steps in all, and the row of the curve.
    Raises:
        ParameterError: an option is wrong, or `out` holds another run. UnknownName: no such name; the nearest is
            suggested.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    seen = agent_kind(agent).observation(observation)
    task = Task(
        make(environment, **parameters) if isinstance(environment, str) else environment,
        sticky=sticky,
        random=random,
        observation=own_observation(seen) or seen,
        observation_options=dict(observation_options or {}),
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
        out=out,
        tensorboard=tensorboard,
        progress=progress,
    )


def train_on(
    task: Task,
    agent: str,
    *,
    steps: int,
    seed: int = 0,
    evaluation_interval: int | None = None,
    hyperparameters: Mapping[str, Any] | str | os.PathLike | None = None,
    out: str | os.PathLike | None = None,
    tensorboard: bool = False,
    progress: Progress | None = None,
) -> TrainingResult:
    """As `train`, on a task, which is built and solved once for all runs on it."""
    if hyperparameters is not None and not isinstance(hyperparameters, Mapping):
        table = Path(hyperparameters)
        hyperparameters = hyperparameters_of(agent, task.env.name, str(task.observation), table=table)
    config = RunConfig.of_task(
        task,
        agent,
        steps=steps,
        seed=seed,
        evaluation_interval=evaluation_interval,
        hyperparameters=hyperparameters,
    )
    return _run(config, task, None if out is None else Path(out), tensorboard, progress)


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
    return _run(config, task, Path(folder), False, progress, algorithm)


# One run --------------------------------------------------------------------------------------------------------------


@dataclass
class _Curve:
    """The rows so far, and the regret of the episodes between evaluations."""

    task: Task
    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, step: int, episodes: int, returns: float, agent: Any) -> dict[str, Any]:
        """Evaluate the policy after `step` steps and `episodes` finished episodes, whose returns sum to `returns`."""
        found = evaluate_agent(agent, self.task)
        best, uniform = self.task.reference.optimal, self.task.reference.uniform
        last = self.rows[-1] if self.rows else None
        finished = episodes - (last["episodes"] if last else 0)
        gained = returns - (last["returns"] if last else 0.0)
        mean = gained / finished if finished else math.nan
        regret = best - found.value
        spread = best - uniform
        row = {
            "step": step,
            "episodes": episodes,
            "value": found.value,
            "expected_regret": regret,
            "cumulative_expected_regret": (
                last["cumulative_expected_regret"] + finished * last["expected_regret"] if last else 0.0
            ),
            "normalized_regret": regret / spread if spread > 1e-12 else math.nan,
            "mean_return": mean,
            "realised_regret": best - mean,
            "cumulative_realised_regret": episodes * best - returns,
            "exact": found.exact,
            "error_bound": found.error_bound,
            "returns": returns,
        }
        self.rows.append(row)
        return row

    def result(self) -> dict[str, Any]:
        """The summary of a finished run."""
        task, last = self.task, self.rows[-1]
        best, uniform = task.reference.optimal, task.reference.uniform
        scale = last["episodes"] * (best - uniform)
        return {
            "value_optimal": best,
            "value_uniform": uniform,
            "value_worst": task.reference.worst,
            "final_value": last["value"],
            "final_regret": last["expected_regret"],
            "cumulative_regret": last["cumulative_expected_regret"],
            "normalized_regret": last["cumulative_expected_regret"] / scale if scale > 1e-12 else math.nan,
            "cumulative_realised_regret": last["cumulative_realised_regret"],
            "normalized_realised_regret": last["cumulative_realised_regret"] / scale if scale > 1e-12 else math.nan,
            "mean_return": last["returns"] / last["episodes"] if last["episodes"] else math.nan,
            "episodes": last["episodes"],
            "exact": all(row["exact"] for row in self.rows),
            "conventions": task.conventions,
        }


def _run(
    config: RunConfig,
    task: Task,
    folder: Path | None,
    tensorboard: bool,
    progress: Progress | None,
    algorithm: str | type | None = None,
) -> TrainingResult:
    if tensorboard and (folder is None or config.is_tabular):
        raise ParameterError(
            f"TensorBoard's logs were asked for, with {config.agent} and {'a' if folder else 'no'} folder for results; "
            f"expected an algorithm of Stable-Baselines3 and a folder (out)"
        )
    began = time.perf_counter()
    if folder is not None:
        done = _finished(folder, config)
        if done is not None:
            return done
    chosen = hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    logs = folder / "tensorboard" if folder is not None and tensorboard else None
    learner = make_learner(config, algorithm or config.algorithm(), task, chosen, logs)
    curve, checkpoint = _Curve(task), None
    if folder is not None:
        checkpoint = _Checkpoint(folder / "checkpoint", config.id)
        curve.rows, spent = checkpoint.restore(learner) or ([], 0.0)
        began -= spent
    record = _Record(folder, config, chosen)
    record.write("running")
    _learn(learner, curve, config, progress, checkpoint, record, began)
    seconds = time.perf_counter() - began
    result = curve.result()
    if folder is not None:
        learner.publish(folder)
        _results.write_curve(folder, curve.rows)
        record.write("finished", seconds=seconds, result=result)
        for leftover in folder.glob("checkpoint*"):  # of kills in the middle of replacing one, too
            shutil.rmtree(leftover, ignore_errors=True)
    rows = [{name: row[name] for name in _results.COLUMNS} for row in curve.rows]
    return TrainingResult(config.to_dict(), result, rows, learner.agent, folder, seconds)


def _learn(
    learner: Learner,
    curve: _Curve,
    config: RunConfig,
    progress: Progress | None,
    checkpoint: "_Checkpoint | None",
    record: "_Record",
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


class _Record:
    """The file run.json, where there is a folder for results."""

    def __init__(self, folder: Path | None, config: RunConfig, hyperparameters: Mapping[str, Any]):
        self.folder, self.hyperparameters = folder, hyperparameters
        versions = _results.versions()
        self.run = {"format": _results.FORMAT, "id": config.id, "config": config.to_dict(), "versions": versions}

    def write(self, status: str, **entries: Any) -> None:
        """Replace it: the run is "running", "failed" or "finished"."""
        if self.folder is None:
            return
        record = {**self.run, "status": status, "hyperparameters": self.hyperparameters, **entries}
        _results.write_record(self.folder, record)


def _finished(folder: Path, config: RunConfig) -> TrainingResult | None:
    """The result that lies there; None where there is none; ParameterError where it is that of another run."""
    if not (folder / "run.json").exists():
        return None
    record = _results.read_record(folder)
    stored = record["config"]
    if run_id(stored) != config.id:
        entry = json.loads(json.dumps(config.to_dict()))
        different = [name for name in {**entry, **stored} if stored.get(name) != entry.get(name)]
        raise ParameterError(
            f"{folder}: holds a run with another {', '.join(different) or 'configuration'}; "
            f"choose another folder, or delete it"
        )
    for part, source in config.sources.items():
        if stored["sources"][part].get("checksum") != source.checksum:
            raise ParameterError(
                f"{folder}: holds a run from before {source.file} was changed; choose another folder, or delete it"
            )
    if record.get("status") != "finished":
        return None
    rows = _results.read_rows(folder)
    return TrainingResult(record["config"], record["result"], rows, None, folder, record["seconds"])


class _Checkpoint:
    """A folder that holds the last checkpoint, replaced in one step."""

    def __init__(self, folder: Path, id: str):
        self.folder, self.id = folder, id
        self._saved = -math.inf

    def save(self, learner: Learner, rows: list[dict[str, Any]], seconds: float) -> None:
        """Write one, unless the last is not ten seconds old."""
        if time.monotonic() - self._saved < CHECKPOINT_SECONDS:
            return
        partial = self.folder.with_name(f"{self.folder.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        learner.save(partial)
        (partial / "curve.json").write_text(json.dumps({"id": self.id, "rows": rows, "seconds": seconds}))
        for path in (*partial.rglob("*"), partial):  # the older one goes only when this one is on the disk
            sync(path)
        old = self.folder.with_name(f"{self.folder.name}.old")
        if self.folder.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(self.folder, old)
        os.replace(partial, self.folder)
        sync(self.folder.parent)
        shutil.rmtree(old, ignore_errors=True)
        self._saved = time.monotonic()

    def restore(self, learner: Learner) -> tuple[list[dict[str, Any]], float] | None:
        """(rows of the curve, seconds spent) of the last checkpoint, from which the learner goes on; or None."""
        for folder in (self.folder, self.folder.with_name(f"{self.folder.name}.old")):
            try:
                kept = json.loads((folder / "curve.json").read_text())
            except (FileNotFoundError, ValueError):
                continue
            if kept.get("id") == self.id:
                learner.load(folder)
                return kept["rows"], kept["seconds"]
        return None
