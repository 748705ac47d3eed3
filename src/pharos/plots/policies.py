"""Policies at play beside each other, such as a learnt one beside the best, as an animated GIF."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.drawing import NIGHT, image, save_gif
from pharos.errors import ParameterError
from pharos.interaction import GymEnv
from pharos.observations import render as render_state
from pharos.policies import PolicyAnswers

if TYPE_CHECKING:
    from pharos.environments import State
    from pharos.training import Task

GAP = 12  # pixels between two pictures


def policies(
    task: "Task",
    agents: Mapping[str, Any],
    path: str | os.PathLike,
    *,
    steps: int | None = None,
    observation: str = "human",
    seed: int = 0,
    frames_per_second: float = 8.0,
) -> Path:
    """Write an episode of each agent, side by side, with the return so far below.

    All start in the same state and meet the same chance as far as they act alike. For the best policy give that of a
    discounted solution: with many undiscounted steps to go, a policy that waits is as good as one that goes straight
    to the goal.

    Args:
        task: environment, chance, and what the agents see.
        agents: label -> what `training.evaluate_agent` takes: a table (S,) or (S, A), a model, or a function of
            observations.
        path: of the .gif.
        steps: at most; None for the time limit of the task.
        observation: how states are drawn, "human" or an observation that is an image.
        seed: of chance and of random actions.
    Raises:
        ParameterError: no agent, or a path that does not end in .gif.
    """
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise ParameterError(f"{path}: expected a name that ends in .gif")
    if not agents:
        raise ParameterError("no policies to draw; give at least one")
    limit = task.time_limit if steps is None else steps
    played = [_episode(task, agent, limit, seed) for agent in agents.values()]
    frames = []
    for step in range(max(len(episode) for episode in played)):
        parts = []
        for label, episode in zip(agents, played, strict=True):
            state, gained = episode[min(step, len(episode) - 1)]
            over = "   over" if step >= len(episode) - 1 else ""
            picture = _enlarged(render_state(task.env, state, observation))
            parts.append(np.asarray(image(picture, f"{label}   return {gained:g}{over}")))
        frames.append(_beside(parts))
    return save_gif(path, frames, frames_per_second=frames_per_second)


def _enlarged(picture: np.ndarray) -> np.ndarray:
    factor = max(1, -(-200 // max(picture.shape[:2])))
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def _beside(parts: Sequence[np.ndarray]) -> np.ndarray:
    gap = np.full((parts[0].shape[0], GAP, 3), NIGHT, np.uint8)
    return np.concatenate([piece for part in parts for piece in (gap, part)][1:], axis=1)


def _episode(task: "Task", agent: Any, steps: int, seed: int) -> list[tuple["State", float]]:
    """[(state, return so far)] from the start to the end of one episode, as `GymEnv` plays it."""
    env = GymEnv(task.env, **task.interaction)
    choose = _chooser(task, agent, np.random.default_rng(seed))
    observation, info = env.reset(seed=seed)
    episode, gained = [(info["state"], 0.0)], 0.0
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(choose(observation, info["state"]))
        gained += float(reward)
        episode.append((info["state"], gained))
        if terminated or truncated:
            break
    return episode


def _chooser(task: "Task", agent: Any, rng: np.random.Generator) -> Callable[[Any, "State"], int]:
    """A function (observation, state) -> action."""
    if hasattr(agent, "policy_table"):
        agent = agent.policy_table()
    if isinstance(agent, np.ndarray):
        if agent.shape[1:] not in ((), (task.env.num_actions,)) or len(agent) != task.space.num_states:
            raise ParameterError(
                f"the policy has shape {agent.shape}; expected ({task.space.num_states},) actions or "
                f"({task.space.num_states}, {task.env.num_actions}) probabilities"
            )
        answers = None
    else:
        answers = PolicyAnswers(agent, task.mdp, task.sight)

    def choose(observation: Any, state: "State") -> int:
        if answers is None:
            row = agent[task.space.index(state)]
            if np.ndim(row) == 0:
                return int(row)
        else:
            row = answers.answer(_batch(observation))[0]
        return int(rng.choice(task.env.num_actions, p=row / row.sum()))

    return choose


def _batch(observation: Any) -> Any:
    return (
        {name: _batch(value) for name, value in observation.items()}
        if isinstance(observation, dict)
        else np.asarray(observation)[None]
    )
