"""Training loops that are the user's own: a task of a suite, or any target, with the exact regret of what is learnt.

`task` gives the environment of a task of a suite, which counts its steps and takes policies. Its files have the form of
`benchmark.run`, so that reports and comparisons read them. `LoopRun`, which is `pharos.Run`, is the same for any
environment. Its folder has the form of `pharos.train`.
"""

import contextlib
import os
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from pharos.benchmark.agents import Form, Job, is_finished, record_run
from pharos.benchmark.execution import claimed, collected
from pharos.benchmark.suite import BenchmarkTask, Suite, load_suite
from pharos.environments import Environment, class_called
from pharos.errors import AllRunsFailed, FolderLocked, ParameterError
from pharos.mdp import whole_number
from pharos.observations import own_observation
from pharos.policies import PolicyLike
from pharos.system import storage
from pharos.system.records import split_options, takes
from pharos.system.wording import in_one_line
from pharos.training import (
    BudgetSpent,
    CountedEnv,
    Curve,
    PolicyRecorder,
    RunConfig,
    StepBudget,
    Task,
    TrainingOptions,
    TrainingResult,
    read_record,
    versions,
    write_curve,
    write_policy,
    write_record,
)

OWN_LOOP = "own loop"
"""Name of an agent that has none."""


# A task of a suite ----------------------------------------------------------------------------------------------------


class TaskEnv(CountedEnv):
    """The environment of one task of a suite, for a loop of the user's own. Made by `task`.

    `record(policy)` lets a policy be the one in force from this step on. `steps` are the steps that the task allows,
    summed over all copies (`copy`). `close`, or the end of a `with` block, evaluates the policies and writes the files.
    A step beyond the budget raises `BudgetSpent`, which ends such a block quietly.

    Attributes:
        task: of the suite. folder: of the results. If None, nothing is written.
    """

    def __init__(
        self, task: BenchmarkTask, suite: Suite, seed: int, folder: Path | None, agent: str, setting: Mapping[str, Any]
    ):
        protocol = suite.protocol
        self._recorder = PolicyRecorder(
            task.check(protocol), steps=protocol.steps, interval=protocol.evaluation_interval, seed=seed
        )
        super().__init__(self._recorder.task, self._recorder.budget, seed)
        self.task, self.suite, self.folder = task, suite, folder
        self._form, self._is_closed = Form(agent, "loop", dict(setting)), False

    def record(self, policy: PolicyLike) -> None:
        """Let a policy be the one in force from this step on. It is asked about every state now, and never again.

        Args:
            policy: a function from (N, ...) observations to (N,) actions or (N, A) probabilities, a model of
                Stable-Baselines3, a table, or one with a memory, as `training.evaluate_agent` takes it.
        Raises:
            ParameterError: it is no policy, or the environment is closed.
        """
        if self._is_closed:
            raise ParameterError(f"task {self.task.name}: is closed; record policies before close()")
        self._recorder.record(policy)

    def curve(self) -> Curve:
        """The learning curve so far, with the last policy in force at all points to come. Cost: evaluates policies."""
        return self._recorder.curve()

    def notes(self) -> dict[str, str]:
        """Sentences on what looks like a mistake of the loop, by kind."""
        return self._recorder.notes()

    def close(self) -> None:
        """End the run: evaluate its policies, and write the files of a run of `benchmark.run`, if there is a folder."""
        self._end(None)

    def __exit__(self, *error: Any) -> bool:
        kind, value, _ = error
        is_end = kind is None or issubclass(kind, BudgetSpent)
        self._end(None if is_end else value)
        return is_end

    def _end(self, error: BaseException | None) -> None:
        if self._is_closed:
            return
        self._is_closed = True
        super().close()
        if self.folder is None:
            return
        end = error if error is not None else self.curve()
        suite, name = self.suite, self._form.label
        self.folder.mkdir(parents=True, exist_ok=True)
        with storage.lock(self.folder, FolderLocked, "writing a run"):
            record = claimed(self.folder, self._form, suite, name)
            job = Job(self.task, self.seed, storage.inside(self.folder, "runs", self.task.name, f"seed-{self.seed}"))
            record_run(name, job, suite.protocol, end, self.notes())
            with contextlib.suppress(AllRunsFailed):  # other seeds are still to come
                collected(self.folder, self._form, suite, record, finished_jobs(self.folder, suite))


def finished_jobs(folder: Path, suite: Suite) -> list[Job]:
    """All pairs of a task and a seed of which both have finished runs in a folder of results, in the suite's order."""
    runs = {
        (task.name, int(path.name.removeprefix("seed-"))): Job(task, int(path.name.removeprefix("seed-")), path)
        for task in suite.tasks
        for path in (folder / "runs" / task.name).glob("seed-*")
        if path.name.removeprefix("seed-").isdigit()
    }
    whole = {key: job for key, job in runs.items() if is_finished(job)}
    seeds, names = sorted({seed for _, seed in whole}), {name for name, _ in whole}
    return [
        Job(task, seed, folder / "runs" / task.name / f"seed-{seed}")
        for task in suite.tasks
        if task.name in names
        for seed in seeds
    ]


def task(
    name: str,
    *,
    suite: str | Path | Suite = "v1",
    seed: int = 0,
    out: str | os.PathLike | None = None,
    agent: str = OWN_LOOP,
    hyperparameters: Mapping[str, Any] | None = None,
) -> TaskEnv:
    """The environment of a task of a suite, which counts its steps and takes the policies of a loop of your own.

        with pharos.benchmark.task("deep_sea-8", seed=0, out="results/mine") as env:
            ...
            env.record(policy)

    Args:
        name: of the task, as `pharos benchmark show` lists it.
        suite: name, file, or a suite that was loaded.
        seed: of the run.
        out: folder of one agent with one setting, with the files of `benchmark.run`. results.safetensors has the tasks
            of which all seeds that are there have finished. None: nothing is written.
        agent: label in tables.
        hyperparameters: JSON-able, for the record. Another setting needs another folder.
    Raises:
        UnknownName: there is no such suite or task. ParameterError: the task is another one on this installation.
    Cost: states of the task are built and solved.
    """
    loaded = suite if isinstance(suite, Suite) else load_suite(suite)
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ParameterError(f"seed is {seed!r}; expected a whole number of at least 0")
    folder = None if out is None else Path(out).absolute()
    return TaskEnv(loaded.task(name), loaded, int(seed), folder, agent, hyperparameters or {})


# Any target -----------------------------------------------------------------------------------------------------------


class LoopRun:
    """A run whose loop is your own, with the exact regret of its policies. It writes the folder that `train` writes.

        with pharos.Run("frozen_lake/8x8", observation="one_hot", out="runs/mine") as run:
            observation, _ = run.env.reset()
            ...
            run.record(policy)

    Public as `pharos.Run`.

    Args:
        environment: a name, with its parameters as keywords, or an Environment.
        steps: that `env` allows, the budget of the run.
        seed: of `env`, and of the record.
        agent: label of what learns.
        out: folder of the run. If None, nothing is written.
        options: of `TrainingOptions`: observation, observation_options, sticky, random and the like, gamma, horizon,
            objective, evaluation_interval, hyperparameters, and parameters of the environment.
    Attributes:
        env: the environment, which counts the steps of all of its copies (`env.copy`). Use it, or your own.
        task: environment, observation and setting of values, a `training.Task`.
        rows: of the curve so far, dictionaries with the columns of curve.csv.
        config: the `training.RunConfig`.
    Raises:
        ParameterError: an option is wrong, or `out` holds a finished run, or another one.
    """

    @takes(TrainingOptions)
    def __init__(
        self,
        environment: Environment | str,
        *,
        steps: int = 50_000,
        seed: int = 0,
        agent: str = OWN_LOOP,
        out: str | os.PathLike | None = None,
        **options: Any,
    ):
        training, parameters = split_options(TrainingOptions, {**options, "steps": steps})
        self.task = Task.of(
            environment,
            parameters,
            chance=training.chance,
            observation=own_observation(training.observation) or training.observation,
            observation_options=dict(training.observation_options or {}),
            gamma=training.gamma,
            horizon=training.horizon,
            objective=training.objective,
        )
        self.config = RunConfig.of_task(
            self.task,
            agent.replace(":", " "),  # else it would be the name of code
            steps=steps,
            seed=seed,
            evaluation_interval=training.evaluation_interval,
            hyperparameters=training.hyperparameters,
        )
        self.env = CountedEnv(self.task, StepBudget(steps, self.config.evaluation_interval), seed)
        self._curve, self._began = Curve(self.task), time.perf_counter()
        self.folder = None if out is None else Path(out).absolute()
        if self.folder is not None and (self.folder / "run.json").exists():
            record = read_record(self.folder)
            if record.get("status") == "finished" or record.get("id") != self.config.id:
                what = "a finished run" if record.get("status") == "finished" else "another run"
                raise ParameterError(f"{self.folder}: holds {what}; choose another folder, or delete it")

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Rows of the curve so far."""
        return self._curve.rows

    def evaluate(self, step: int, policy: PolicyLike) -> dict[str, Any]:
        """Evaluate a policy exactly, and add it to the curve.

        Args:
            step: environment steps so far, of `env` or of your own.
            policy: as `training.evaluate_agent` takes it.
        Returns:
            The row: `value`, `expected_regret`, `normalized_regret` (0 optimal, 1 as bad as random), `exact`, ...;
            episodes and returns are counted in `env`.
        Raises:
            ParameterError: it is no policy, or the step is no number of steps, or not later than the row before.
        """
        number: object = step
        if isinstance(number, float) and number.is_integer():
            number = int(number)
        step = whole_number(number, "evaluate: step", "a whole number of steps so far", least=0)
        if policy is None:
            raise ParameterError("evaluate: policy is None; expected a table of states, a model, or a function")
        if self.rows and step <= self.rows[-1]["step"]:
            raise ParameterError(
                f"evaluate: step {step:,} comes after step {self.rows[-1]['step']:,}; expected a later one: give the "
                f"steps of the environment so far, each evaluation more"
            )
        budget = self.env.budget
        row = self._curve.add(step, budget.episodes, budget.returns, policy)
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_curve(self.folder, self.rows)
        return row

    def record(self, policy: PolicyLike) -> dict[str, Any]:
        """Evaluate a policy after the steps that `env` has counted, as `evaluate` does."""
        return self.evaluate(self.env.budget.steps, policy)

    def __enter__(self) -> "LoopRun":
        self._write("running")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        is_end = kind is None or issubclass(kind, BudgetSpent)
        self.env.close()
        if not is_end:
            self._write("failed", error=in_one_line(error) if error is not None else "")
        else:
            self.finish()
        return is_end

    def finish(self) -> TrainingResult:
        """Write the files of the finished run, and return its result. The end of a `with` block calls it.

        Raises:
            ParameterError: no policy was evaluated.
        """
        if not self.rows:
            raise ParameterError("a run without a policy: call run.record(policy), or run.evaluate(step, policy)")
        result, seconds = self._curve.result(), time.perf_counter() - self._began
        if self.env.budget.steps:
            result["counted_steps"] = self.env.budget.steps
        if self.folder is not None:
            if self._curve.table is not None:
                write_policy(self.folder, self._curve.table)
            write_curve(self.folder, self.rows)
            self._write("finished", result=result, seconds=seconds)
        return TrainingResult(self.config.to_dict(), result, list(self.rows), None, self.folder, seconds)

    def _write(self, status: str, **entries: object) -> None:
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        record = {"format": 1, "id": self.config.id, "config": self.config.to_dict(), "versions": versions()}
        rules = class_called(self.config.environment)
        if rules is not None:
            record["rules_version"] = rules.version
        setting = {"status": status, "hyperparameters": dict(self.config.hyperparameters)}
        write_record(self.folder, {**record, **setting, **entries})
