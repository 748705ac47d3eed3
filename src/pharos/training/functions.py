"""Learners of agents that are functions: a generator of policies, a function of JAX, see `pharos.agents.registry`.

Neither is resumed: a run that was killed begins anew, and ends with the same bytes if its function has chance by its
seed alone.

An agent in JAX is one function that is compiled, and learns with all seeds of a task at once.

    def learn(env, params, steps, key):
        ...
        return apply, snapshots

`env, params` come from `pharos.to_gymnax`, `key` from the seed, and `steps` is an integer that is known when it
is compiled. `snapshots` are parameters: a tree of arrays whose first axis has K entries, after steps / K, 2 steps / K,
..., `steps` steps. `apply(parameters, observations)` gives (N, A) probabilities or (N,) actions. Observations of all
states are one batch, so that a policy is one forward pass.

At an evaluation point the snapshot counts that was taken last, at that step or before. Before the first, uniform play
counts. Steps are not counted here, nor are episodes: that a function takes `steps` steps can be read in its code alone.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pharos.agents import COMPILED, GENERATOR, generator_of, register_form
from pharos.errors import ParameterError
from pharos.interaction import to_gymnax
from pharos.mdp import uniform_choice
from pharos.policies import PolicyAnswers, PolicyLike
from pharos.solvers import GainInterval
from pharos.training.budget import PolicyRecorder, end_process, errors_in_one_line, generate
from pharos.training.curve import Curve, Evaluation, evaluate_agent
from pharos.training.results import write_policy
from pharos.training.task import Task

TABLE_BLOCK = 4096  # observations that are made at once

LearnCompiled = Callable[..., tuple[Callable[..., Any], Any]]
"""learn(env, params, steps, key) -> (apply, snapshots)."""


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


# Functions of JAX -----------------------------------------------------------------------------------------------------


def compiled_curves(
    learn: LearnCompiled, task: Task, *, steps: int, evaluations: int, seeds: Sequence[int]
) -> list[Curve]:
    """Train with a function of JAX for each seed, and evaluate the policy in force at each evaluation point.

    Returns:
        A curve for each seed: a row before the first step, for uniform play, and one for each point. There are no
        episodes in it.
    Raises:
        MissingExtra: JAX or gymnax is not installed.
        ParameterError: the task is none of tables alone, or the function returns something else.
    """
    context = task.observer.observe
    lacking = [
        name
        for name, is_wanted in {
            "frames": context.observation.frames > 1,
            "irrelevant entries": context.observation.irrelevant,
            "previous_action": task.previous_action,
            "reward_delay": task.chance.reward_delay,
            "scale_rewards": task.chance.scale_rewards,
        }.items()
        if is_wanted
    ]
    if lacking:
        raise ParameterError(f"agents in JAX learn from tables, which have no {', '.join(lacking)}; leave it out")
    # The task as an environment of gymnax, with the observations of all states
    count = task.mdp.num_states
    blocks = [np.arange(first, min(first + TABLE_BLOCK, count)) for first in range(0, count, TABLE_BLOCK)]
    observations = np.concatenate([context.observation(task.space.states(block)) for block in blocks])
    env = to_gymnax(
        task.mdp, observations, time_limit=task.env.max_episode_steps, reward_noise=task.chance.reward_noise
    )
    import jax

    functions = []

    def snapshots_of(key: Any) -> Any:
        policy, snapshots = learn(env, env.default_params, steps, key)
        functions.append(policy)
        return snapshots

    keys = jax.numpy.stack([jax.random.PRNGKey(seed) for seed in seeds])
    snapshots = jax.jit(jax.vmap(snapshots_of))(keys)
    numbers = {leaf.shape[1] if leaf.ndim > 1 else 0 for leaf in jax.tree.leaves(snapshots)}
    if len(numbers) != 1 or 0 in numbers:
        raise ParameterError(
            f"learn returned snapshots whose first axes have {sorted(numbers)} entries; expected one number of at "
            f"least 1: stack the parameters of each"
        )
    (number,) = numbers
    ask = jax.jit(jax.vmap(functions[-1], (0, None)))
    everything, answers = env.default_params.observations[:-1], PolicyAnswers(functions[-1], task.mdp, task.observer)
    indices = [point * number // evaluations - 1 for point in range(evaluations + 1)]
    uniform, curves = uniform_choice(task.mdp), []
    for i in range(len(seeds)):
        tables = np.asarray(ask(jax.tree.map(lambda leaf, i=i: leaf[i], snapshots), everything))
        policies = {index: answers.checked(tables[index], count) for index in sorted(set(indices) - {-1})}
        curve = Curve(task)
        values = {index: evaluate_agent(policy, task) for index, policy in {-1: uniform, **policies}.items()}
        for point, index in enumerate(indices):
            curve.add(point * (steps // evaluations), 0, 0.0, None, values[index])
        curves.append(curve)
    return curves
