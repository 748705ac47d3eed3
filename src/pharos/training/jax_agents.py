"""An agent in JAX: one function that is compiled, and learns with all seeds of a task at once.

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

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.interaction import to_gymnax
from pharos.mdp import uniform_choice
from pharos.policies import PolicyAnswers
from pharos.training.curve import Curve, evaluate_agent
from pharos.training.task import Task

TABLE_BLOCK = 4096  # observations that are made at once

LearnCompiled = Callable[..., tuple[Callable[..., Any], Any]]
"""learn(env, params, steps, key) -> (apply, snapshots)."""


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
