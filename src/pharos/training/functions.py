"""Learners of agents that are functions: a generator of policies, and a function of JAX, see `pharos.agents.own`.

Neither is resumed: a run that was killed begins anew, and ends with the same bytes if its function has chance by its
seed alone.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pharos.agents import COMPILED, GENERATOR, generator_of, register_form
from pharos.errors import ParameterError
from pharos.mdp import uniform_choice
from pharos.policies import PolicyLike
from pharos.solvers import GainInterval
from pharos.training.budget import PolicyRecorder, end_process, errors_in_one_line, generate
from pharos.training.curve import Evaluation, evaluate_agent
from pharos.training.jax_agents import compiled_curves
from pharos.training.results import write_policy


class GeneratorLearner(PolicyRecorder):
    """Learner of one run: learn(env, steps, seed, **hyperparameters) yields policies."""

    def __init__(self, runs: Sequence[Any], learn: Callable[..., Any]):
        (run,) = runs
        config = run.config
        super().__init__(run.task, steps=config.steps, interval=config.evaluation_interval, seed=config.seed)
        self.run, self.function = run, learn
        self.budget.give_up = partial(end_process, self.run.config.agent, self.budget.limit)

    @property
    def episodes(self) -> np.ndarray:
        return np.array([self.ended[0]])

    @property
    def returns(self) -> np.ndarray:
        return np.array([self.ended[1]])

    def learn(self, points: Sequence[int], at_point: Callable[[int], object]) -> None:
        """Train until the generator ends or its budget is spent, and call `at_point` at each point.

        Raises:
            ParameterError: it is no generator, or it has a second policy, or ends with another one than uniform play,
                when no step was counted. Or it yields very many policies without a step while it has some.
            PharosError: its code raises something, SystemExit included.
        """
        self.at_point = at_point
        with errors_in_one_line(self.run.config.agent, self._file):
            generate(partial(generator_of(self.function), **self.run.hyperparameters), self, self.run.config.seed)
        self.run.curve.counted_steps = self.budget.steps
        self.pass_points(math.inf)
        self.check_steps(self.run.curve)

    @property
    def _file(self) -> str | None:
        """The file with the code of the function."""
        source = self.run.config.sources.get("agent")
        return source.file if source else getattr(getattr(self.function, "__code__", None), "co_filename", None)

    def policy(self, i: int) -> PolicyLike | Evaluation:
        return self.in_force

    def publish(self, i: int, folder: Path) -> None:
        """Write the last policy if it is a table of the states."""
        if isinstance(self.in_force, np.ndarray):
            write_policy(folder, self.in_force)


class CompiledLearner:
    """Learner of runs of one task: a function of JAX, one program for all seeds. Neither steps nor episodes count."""

    def __init__(self, runs: Sequence[Any], learn: Callable[..., Any]):
        self.runs, self.function = runs, learn
        self.episodes, self.returns = np.zeros(len(runs), np.int64), np.zeros(len(runs))
        self.values = [evaluate_agent(uniform_choice(runs[0].task.mdp), runs[0].task)] * len(runs)

    def learn(self, points: Sequence[int], at_point: Callable[[int], object]) -> None:
        """Train, then call `at_point` at each point. ParameterError: these are not equally distant."""
        config, hyperparameters = self.runs[0].config, self.runs[0].hyperparameters
        if config.steps % config.evaluation_interval:
            raise ParameterError(
                f"evaluation_interval is {config.evaluation_interval} of {config.steps} steps; expected a divisor: "
                f"snapshots of agents in JAX are equally distant"
            )
        curves = compiled_curves(
            partial(self.function, **hyperparameters),
            self.runs[0].task,
            steps=config.steps,
            evaluations=config.steps // config.evaluation_interval,
            seeds=[run.config.seed for run in self.runs],
        )
        for row, point in enumerate(points, start=1):
            rows = [curve.rows[row] for curve in curves]
            self.values = [_evaluation(row) for row in rows]
            at_point(point)

    def policy(self, i: int) -> Evaluation:
        return self.values[i]

    def publish(self, i: int, folder: Path) -> None:
        """Write nothing: what was learnt has a form of its own."""


def _evaluation(row: Mapping[str, Any]) -> Evaluation:
    """The value, and the gain if it was measured, in a row of a curve."""
    gain = GainInterval(row["gain_lower"], row["gain_upper"]) if "gain_lower" in row else None
    return Evaluation(row["value"], row["exact"], row["error_bound"], 0, gain=gain)


register_form(GENERATOR, GeneratorLearner)
register_form(COMPILED, CompiledLearner)
