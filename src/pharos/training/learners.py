"""What learns in a run: the table of Q-learning, or a model of Stable-Baselines3; each can be stored and resumed."""

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pharos.agents import QLearning, check_hyperparameters, make_model
from pharos.errors import FileFormatError
from pharos.policies import DeepPolicy
from pharos.training import results
from pharos.training.config import RunConfig
from pharos.training.task import Task

AtPoint = Callable[[int, int, float], dict[str, Any]]
"""at_point(steps, finished episodes, sum of their returns) -> row of the curve."""


class Learner(Protocol):
    """What a run needs of an agent that learns."""

    agent: Any

    def learn(self, points: list[int], at_point: AtPoint) -> None:
        """Learn until the last of `points`, and call `at_point` at each."""

    def save(self, folder: Path) -> None:
        """Write what `load` needs."""

    def load(self, folder: Path) -> None:
        """Go on from what `save` wrote."""

    def publish(self, folder: Path) -> None:
        """Write what was learnt into the folder of the run, as `load_agent` reads it."""


def make_learner(
    config: RunConfig,
    algorithm: str | type,
    task: Task,
    hyperparameters: dict[str, Any],
    tensorboard: Path | None = None,
) -> Learner:
    """The learner of a run, with all its hyperparameters; `algorithm` as `RunConfig.algorithm` gives it."""
    if config.is_tabular:
        return Tabular(task, hyperparameters, config.steps, config.seed)
    logs = None if tensorboard is None else str(tensorboard)
    return Deep(algorithm, task, hyperparameters, config.steps, config.seed, logs)


class Tabular:
    """Q-learning."""

    def __init__(self, task: Task, hyperparameters: dict[str, Any], steps: int, seed: int):
        self.agent = QLearning(
            task.mdp,
            total_steps=steps,
            seed=seed,
            time_limit=task.time_limit,
            reward_noise=task.reward_noise,
            reward_delay=task.reward_delay,
            **hyperparameters,
        )

    def learn(self, points: list[int], at_point: AtPoint) -> None:
        """As `Learner` says."""
        for point in points:
            self.agent.learn(point - self.agent.steps)
            at_point(self.agent.steps, self.agent.episodes, self.agent.sum_of_returns)

    def save(self, folder: Path) -> None:
        """Plain arrays."""
        np.savez(folder / "q_learning.npz", **self.agent.state())  # type: ignore[arg-type]

    def load(self, folder: Path) -> None:
        """From plain arrays."""
        with _said_to_be_damaged(folder), np.load(folder / "q_learning.npz", allow_pickle=False) as stored:
            self.agent.restore({name: stored[name] for name in stored.files})

    def publish(self, folder: Path) -> None:
        """The greedy policy, as policy.npy."""
        results.write_policy(folder, self.agent.policy_table())


class Deep:
    """A model of Stable-Baselines3."""

    def __init__(
        self,
        agent: str | type,
        task: Task,
        hyperparameters: dict[str, Any],
        steps: int,
        seed: int,
        tensorboard: str | None,
    ):
        check_hyperparameters(agent, hyperparameters)
        self.task, self.steps = task, steps
        env = vector_environment(task, int(hyperparameters.get("n_envs", 1)), seed)
        self.env = env
        self.model = make_model(agent, env, hyperparameters, seed=seed, tensorboard=tensorboard)
        self.agent = DeepPolicy(self.model)
        self.finished = (0, 0.0)  # episodes, and the sum of their returns

    def learn(self, points: list[int], at_point: AtPoint) -> None:
        """As `Learner` says."""
        from pharos.training.callback import AtPoints

        callback = AtPoints(points, at_point, self.task.gamma, self.finished, lambda: self.env.earned)
        callback.counted_by(self)
        self.model.learn(self.steps - self.model.num_timesteps, callback=callback, reset_num_timesteps=False)
        callback.at_the_end()

    def save(self, folder: Path) -> None:
        """Tensors (torch's own format, read back with weights_only), arrays and JSON."""
        import torch

        folder.mkdir(parents=True, exist_ok=True)
        model = self.model
        torch.save(model.get_parameters(), folder / "parameters.pt")
        counters = {name: int(getattr(model, name)) for name in _COUNTERS if hasattr(model, name)}
        counters["episodes"], returns = int(self.finished[0]), float(self.finished[1])
        (folder / "model.json").write_text(json.dumps({"counters": counters, "returns": returns}))
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None and folder.name.startswith("checkpoint"):
            np.savez(folder / "replay.npz", **_buffer_arrays(buffer))  # type: ignore[arg-type]

    def load(self, folder: Path) -> None:
        """Go on from what was saved; the episode that was running is started anew."""
        import torch

        model = self.model
        with _said_to_be_damaged(folder):
            parameters = torch.load(folder / "parameters.pt", weights_only=True)
            if set(parameters) == {"policy"}:  # of the batched engine: what was learnt, without an optimiser
                model.policy.load_state_dict(parameters["policy"])
            else:
                model.set_parameters(parameters, device="cpu")
            stored = json.loads((folder / "model.json").read_text())
            for name, value in stored["counters"].items():
                if name in _COUNTERS:
                    setattr(model, name, value)
            self.finished = (stored["counters"]["episodes"], stored["returns"])
            buffer = getattr(model, "replay_buffer", None)
            if buffer is not None and (folder / "replay.npz").exists():
                with np.load(folder / "replay.npz", allow_pickle=False) as arrays:
                    _restore_buffer(buffer, arrays)
        model.set_random_seed(model.seed + model.num_timesteps)

    def publish(self, folder: Path) -> None:
        """The network, in the folder agent."""
        self.save(folder / "agent")


def publish_network(folder: Path, parameters: dict[str, np.ndarray], counters: dict[str, int], returns: float) -> None:
    """Write a network of the batched engine into the folder of its run, as `Deep` reads it.

    Args:
        parameters: by their names in the policy of Stable-Baselines3.
        counters: num_timesteps and episodes.
        returns: the sum over episodes.
    """
    import torch

    place = folder / results.AGENT
    place.mkdir(parents=True, exist_ok=True)
    policy = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in parameters.items()}
    torch.save({"policy": policy}, place / "parameters.pt")
    (place / "model.json").write_text(json.dumps({"counters": counters, "returns": returns}))


@contextlib.contextmanager
def _said_to_be_damaged(folder: Path) -> Iterator[None]:
    """Whatever goes wrong in reading a checkpoint, as one line that names its folder."""
    try:
        yield
    except Exception as error:  # torch and NumPy have many
        first = str(error).split(". ")[0].splitlines()  # torch goes on with advice that is not ours
        raise FileFormatError(
            f"{folder}: cannot be resumed from: {first[0] if first else type(error).__name__}; "
            f"delete the folder to start anew"
        ) from error


_COUNTERS = ("num_timesteps", "_n_updates", "_n_calls", "_episode_num")


def vector_environment(task: Task, num_envs: int, seed: int) -> Any:
    """The environment of a task for Stable-Baselines3, all copies advanced by one compiled call."""
    from pharos.interaction import make_sb3_vec

    return make_sb3_vec(task.env, num_envs, seed=seed, **task.interaction)


def _buffer_arrays(buffer: Any) -> dict[str, np.ndarray]:
    """The filled part of a replay buffer."""
    size = buffer.buffer_size if buffer.full else buffer.pos
    arrays = {"place": np.array([buffer.pos, int(buffer.full)])}
    for name in ("actions", "rewards", "dones", "timeouts"):
        arrays[name] = getattr(buffer, name)[:size]
    for name in ("observations", "next_observations"):
        values = getattr(buffer, name)
        parts = values if isinstance(values, dict) else {"": values}
        arrays |= {f"{name}/{key}": value[:size] for key, value in parts.items()}
    return arrays


def _restore_buffer(buffer: Any, arrays: Any) -> None:
    buffer.pos, buffer.full = int(arrays["place"][0]), bool(arrays["place"][1])
    for name in arrays.files:
        if name == "place":
            continue
        owner, slash, key = name.partition("/")
        target = getattr(buffer, owner)
        if slash and key:
            target = target[key]
        target[: len(arrays[name])] = arrays[name]
    last = buffer.pos - 1  # its episode is started anew, so returns of several steps must not run on into the next
    buffer.timeouts[last] = np.logical_or(buffer.timeouts[last], np.logical_not(buffer.dones[last]))
