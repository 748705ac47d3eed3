"""Runs with their tasks, and their learners: N >= 1 runs under one loop, each with the result that it has alone.

A `PreparedRun` is a run before it is trained: with its task, what it sees, and its hyperparameters, checked. Learners
are `Tables` of Q-learning, `Networks` of the batched engine, or one model of Stable-Baselines3 (`Deep`); all of each
can be stored and resumed.
"""

import contextlib
import json
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from pharos.agents import QLearning, check_hyperparameters, joined_states, make_model, state_of
from pharos.agents import hyperparameters as hyperparameters_of
from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import TabularMDP
from pharos.policies import PolicyLike, deep_policy
from pharos.state_space import StateSpace
from pharos.system import storage
from pharos.system.wording import in_one_line
from pharos.training import results
from pharos.training.curve import Curve
from pharos.training.results import Record
from pharos.training.task import RunConfig, Task, TaskValues

if TYPE_CHECKING:
    from stable_baselines3.common.buffers import ReplayBuffer

    from pharos.agents.batched import Batch
    from pharos.interaction import SB3VecEnv

T = TypeVar("T")
# Entries of a configuration that decide about rewards and states, about the task, about observations
WORLD = ("environment", "parameters", "gamma", "sources")
TASK = ("environment", "parameters", "chance", "observation", "observation_options", "gamma", "horizon", "sources")
OBSERVATIONS = ("environment", "parameters", "observation", "observation_options", "sources")


@dataclass(frozen=True)
class FailedRun:
    """A run that has no result, and why."""

    config: dict[str, Any]
    folder: Path | None
    exception: Exception

    @property
    def error(self) -> str:
        """The reason in one line."""
        return in_one_line(self.exception)


@dataclass(eq=False)
class PreparedRun:
    """A run before and while it is trained, with its task and hyperparameters.

    Attributes:
        place: among the configurations; None for a run of a checkpoint that nobody asks for.
        run: what its learner is made of: a BatchRun, a function that makes a table, or an algorithm.
        key: runs with equal keys can be trained together.
        is_alone: whether it has checkpoints in its own folder, and holds that.
    """

    place: int | None
    config: RunConfig
    folder: Path | None
    task: Task
    hyperparameters: dict[str, Any]
    run: Any
    key: Hashable
    is_alone: bool = False
    error: Exception | None = None
    curve: Curve = field(init=False)

    def __post_init__(self) -> None:
        self.curve = Curve(self.task)

    @property
    def record(self) -> Record:
        """The run.json of the run."""
        return Record(self.folder, self.config, self.hyperparameters)

    def fail(self, error: Exception) -> None:
        """Mark the run as failed; the reason is kept in run.json."""
        self.error = error
        self.record.write("failed", error=in_one_line(error))


class TaskCache:
    """Members of batches by configuration; runs share spaces, rewards, solved values and observations.

    Args:
        values: config -> values at the start of its task, where they are known.
        trust, strict: as for `RunConfig.task`.
        device: where networks are trained, which decides about what fits together.
    """

    def __init__(
        self,
        values: Callable[[RunConfig], TaskValues | None] | None = None,
        *,
        trust: bool = False,
        strict: bool = False,
        device: str = "cpu",
    ):
        self.values, self.trust, self.strict, self.device = values, trust, strict, device
        self.shared: dict[str, Any] = {}

    def task(self, config: RunConfig) -> Task:
        """The task of a run, the same object for all runs on it; tasks share spaces and rewards."""
        return self._once("task", config, TASK, lambda: self._task(config))

    def adopt(self, config: RunConfig, task: Task) -> None:
        """Keep a task that exists already as that of a run."""
        self._once("task", config, TASK, lambda: task)

    def _task(self, config: RunConfig) -> Task:
        values = self.values(config) if self.values is not None else None
        task = config.task(values, trust=self.trust, strict=self.strict)
        space, plain = self._world(config, task)
        vars(task).update(space=space, mdp=task.chance.of(plain.with_horizon(task.horizon_steps)))
        return task

    def _world(self, config: RunConfig, task: Task) -> tuple[StateSpace, TabularMDP]:
        """The states of a task, and their MDP without chance and horizon; the same for all tasks of a world."""
        return self._once("world", config, WORLD, lambda: (task.space, task.space.mdp(gamma=task.gamma)))

    def prepare(
        self, place: int | None, config: RunConfig, folder: Path | None, *, is_alone: bool = False
    ) -> PreparedRun:
        """A run prepared for a batch, with its task and its key.

        Raises:
            ParameterError: a hyperparameter is wrong, or the engine lacks it.
        """
        settings = hyperparameters_of(config.agent, config.environment, config.observation, config.hyperparameters)
        key: Hashable = (config.agent, config.steps, config.evaluation_interval)
        if config.engine != "batched":
            algorithm, task = config.algorithm(trust=self.trust, strict=self.strict), self.task(config)

            def table() -> QLearning:
                limit, noise, delay = task.time_limit, task.chance.reward_noise, task.chance.reward_delay
                return QLearning(
                    task.mdp,
                    total_steps=config.steps,
                    seed=config.seed,
                    time_limit=limit,
                    reward_noise=noise,
                    reward_delay=delay,
                    **settings,
                )

            if config.is_tabular and not is_alone:
                table()  # an error is raised before others are concerned
            make = table if config.is_tabular else algorithm
            return PreparedRun(place, config, folder, task, settings, make, key, is_alone)
        from pharos.agents.batched import OURS, BatchRun, ObservationSource, group_key, supports

        check_hyperparameters(config.agent, settings, OURS)
        lacking = supports(config.agent, settings)
        if lacking is not None:
            raise ParameterError(f"the batched engine: {lacking}; the engine sb3 has it")
        task, chance = self.task(config), config.chance
        run = BatchRun(
            mdp=replace(chance, lazy=0.0).of(self._world(config, task)[1]) if chance.lazy else task.mdp,
            observe=self._once(
                "observations", config, OBSERVATIONS, lambda: ObservationSource.of(task.space, task.observer.observe)
            ),
            time_limit=task.time_limit,
            hyperparameters=settings,
            steps=config.steps,
            seed=config.seed,
            key=int(config.id, 16),
            gamma=config.gamma,
            outcome_rewards=self._once("rewards", config, WORLD, lambda: _drawn_rewards(task)),
            chance=chance,
            staying=self._once("staying", config, WORLD, lambda: _staying(task)) if chance.lazy else None,
        )
        return PreparedRun(place, config, folder, task, settings, run, (key, group_key(config.agent, run, self.device)))

    def _once(self, what: str, config: RunConfig, names: Sequence[str], make: Callable[[], T]) -> T:
        entry = config.to_dict()
        key = json.dumps([what, *(entry.get(name) for name in names)], sort_keys=True)
        if key not in self.shared:
            self.shared[key] = make()
        return self.shared[key]


def _staying(task: Task) -> np.ndarray:
    """(S, A) rewards of actions without effect."""
    from pharos.mdp import rewards_of_staying

    return rewards_of_staying(task.space).array.astype(float)


def _drawn_rewards(task: Task) -> np.ndarray | None:
    """Rewards of each outcome where the rules have chance; None where rewards belong to pairs."""
    from pharos.mdp import rewards_of_outcomes

    return rewards_of_outcomes(task.space) if task.space.has_chance else None


# Learners -------------------------------------------------------------------------------------------------------------


AtPoint = Callable[[int], Mapping[str, Any] | None]
"""at_point(steps) -> row of the curve of the first run, which TensorBoard shows."""


class Learner(Protocol):
    """Learner of N runs.

    Attributes:
        episodes: (N,) int64, finished ones; returns: (N,) float64, the sums of their returns.
    """

    @property
    def episodes(self) -> np.ndarray: ...

    @property
    def returns(self) -> np.ndarray: ...

    def learn(self, points: Sequence[int], at_point: AtPoint) -> None:
        """Train until the last of `points`, and call `at_point` at each."""

    def policy(self, i: int) -> PolicyLike:
        """The policy of run i, as `evaluate_agent` takes it."""

    def greedy_actions(self, places: Sequence[int]) -> dict[int, np.ndarray] | None:
        """(S,) actions of each of some runs whose policies are tables of states; None where none is."""

    def save(self, folder: Path) -> None:
        """Write the state that `load` goes on from."""

    def load(self, folder: Path) -> None:
        """Go on from what `save` wrote. FileFormatError: it cannot be read."""

    def publish(self, i: int, folder: Path) -> None:
        """Write the policy of run i into its folder, as `load_agent` reads it."""


def make_learner(runs: Sequence[PreparedRun], device: str = "cpu", logs: Path | None = None) -> Learner:
    """The learner of runs that fit together.

    Args:
        device: of networks of the batched engine.
        logs: folder for those of TensorBoard, of Stable-Baselines3.
    """
    config, task = runs[0].config, runs[0].task
    if config.is_tabular:
        return Tables([each.run for each in runs])
    if config.engine == "batched":
        from pharos.agents.batched import make_batch

        return Networks(make_batch(config.agent, [each.run for each in runs], device=device))
    (prepared,) = runs
    where = None if logs is None else str(logs)
    return Deep(prepared.run, task, prepared.hyperparameters, config.steps, config.seed, where)


class _Arrays:
    """A learner whose `state` is a dictionary of arrays."""

    file = "batch.npz"

    def save(self, folder: Path) -> None:
        np.savez(folder / self.file, **self.state())  # type: ignore[attr-defined]

    def load(self, folder: Path) -> None:
        with _reading_checkpoint(folder), np.load(folder / self.file, allow_pickle=False) as stored:
            self.restore({name: stored[name] for name in stored.files})  # type: ignore[attr-defined]


class Tables(_Arrays):
    """Tables of Q-learning."""

    def __init__(self, makers: Sequence[Callable[[], QLearning]]):
        self.tables = [make() for make in makers]
        if len(makers) == 1:
            (table,) = self.tables
            self.file, self.state, self.restore = "q_learning.npz", table.state, table.restore  # type: ignore[method-assign]

    @property
    def episodes(self) -> np.ndarray:
        return np.array([table.episodes for table in self.tables], np.int64)

    @property
    def returns(self) -> np.ndarray:
        return np.array([table.sum_of_returns for table in self.tables])

    def learn(self, points: Sequence[int], at_point: AtPoint) -> None:
        for point in points:
            for table in self.tables:
                table.learn(point - table.steps)
            at_point(point)

    def policy(self, i: int) -> QLearning:
        return self.tables[i]

    def greedy_actions(self, places: Sequence[int]) -> dict[int, np.ndarray]:
        """(S,) greedy actions by place; runs whose policy depends on the previous action are left out."""
        tables = {i: self.tables[i].policy_table() for i in places}
        return {i: table for i, table in tables.items() if table.ndim == 1}

    def state(self) -> dict[str, np.ndarray]:
        return joined_states(table.state() for table in self.tables)

    def restore(self, state: dict[str, np.ndarray]) -> None:
        for i, table in enumerate(self.tables):
            table.restore(state_of(state, i))

    def publish(self, i: int, folder: Path) -> None:
        """Write the greedy policy, as policy.npy."""
        results.write_policy(folder, self.tables[i].policy_table())


class Networks(_Arrays):
    """A batch of the batched engine."""

    def __init__(self, batch: "Batch"):
        self.batch = batch
        self.learn, self.policy, self.best_actions = batch.learn, batch.policy, batch.best_actions
        self.greedy_actions, self.state, self.restore = batch.greedy_actions, batch.state, batch.restore

    @property
    def episodes(self) -> np.ndarray:
        return self.batch.episodes

    @property
    def returns(self) -> np.ndarray:
        return self.batch.returns

    def publish(self, i: int, folder: Path) -> None:
        """Write the network, as `Deep` reads it, with the names of parameters in the policy of Stable-Baselines3."""
        import torch

        place = results.new_agent(folder)
        parameters = self.batch.parameters(i).items()
        policy = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in parameters}
        torch.save({"policy": policy}, place / "parameters.pt")
        counters = {"num_timesteps": int(self.batch.steps), "episodes": int(self.episodes[i])}
        (place / "model.json").write_text(json.dumps({"counters": counters, "returns": float(self.returns[i])}))


class Deep:
    """A model of Stable-Baselines3, the only run of its program."""

    def __init__(
        self,
        agent: str | type,
        task: Task,
        hyperparameters: dict[str, Any],
        steps: int,
        seed: int,
        tensorboard: str | None = None,
    ):
        check_hyperparameters(agent, hyperparameters)
        self.gamma, self.steps = task.gamma, steps
        self.env = vector_environment(task, int(hyperparameters.get("n_envs", 1)), seed)
        self.model = make_model(agent, self.env, hyperparameters, seed=seed, tensorboard=tensorboard)
        self.agent = deep_policy(self.model)
        self.finished = (0, 0.0)  # episodes, and the sum of their returns

    @property
    def episodes(self) -> np.ndarray:
        return np.array([self.finished[0]])

    @property
    def returns(self) -> np.ndarray:
        return np.array([self.finished[1]])

    def policy(self, i: int) -> PolicyLike:
        return self.agent

    def greedy_actions(self, places: Sequence[int]) -> None:
        return None

    def learn(self, points: Sequence[int], at_point: AtPoint) -> None:
        """Train until the last of `points`, which comes after the last update, and call `at_point` at each.

        Algorithms that learn from whole rollouts, such as PPO, take the steps of their last rollout although fewer are
        left; episodes that end after the last point are not counted.
        """
        model, last, waiting = self.model, points[-1], list(points)
        running, discount = np.zeros(self.env.num_envs), np.ones(self.env.num_envs)

        def call(due: Sequence[int]) -> None:
            step = max(point for point in due if point <= model.num_timesteps)
            waiting[:] = [point for point in waiting if point > step]
            row = at_point(step) or {}
            for name in ("value", "expected_regret", "mean_return"):
                model.logger.record(f"pharos/{name}", row[name])
            if step == last:
                model.logger.dump(model.num_timesteps)

        def after_step(local: dict[str, Any], _: object) -> bool:
            if model.num_timesteps > last:
                return True
            running[:] += discount * self.env.earned
            discount[:] *= self.gamma
            for i in np.flatnonzero(local["dones"]):
                self.finished = (self.finished[0] + 1, self.finished[1] + float(running[i]))
                running[i], discount[i] = 0.0, 1.0
            if len(waiting) > 1 and model.num_timesteps >= waiting[0]:
                call(waiting[:-1])
            return True

        model.learn(self.steps - model.num_timesteps, callback=after_step, reset_num_timesteps=False)
        if waiting:
            call(waiting)

    def save(self, folder: Path) -> None:
        """Write tensors (torch's own format, read back with weights_only), arrays and JSON."""
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
        """Restore what `save` wrote; the episode that was running is started anew."""
        import torch

        model = self.model
        with _reading_checkpoint(folder):
            parameters = torch.load(folder / "parameters.pt", weights_only=True)  # noqa: TID251
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

    def publish(self, i: int, folder: Path) -> None:
        """Write the network into the folder agent."""
        self.save(results.new_agent(folder))


@contextlib.contextmanager
def _reading_checkpoint(folder: Path) -> Iterator[None]:
    """Raise FileFormatError, one line that names the folder, for any error in reading a checkpoint."""
    try:
        for file in folder.iterdir():
            storage.check_regular(file)
        yield
    except Exception as error:  # torch and NumPy have many
        first = str(error).split(". ")[0].splitlines()  # torch goes on with advice that is not ours
        raise FileFormatError(
            f"{folder}: cannot be resumed from: {first[0] if first else type(error).__name__}; "
            f"delete the folder to start anew"
        ) from error


_COUNTERS = ("num_timesteps", "_n_updates", "_n_calls", "_episode_num")


def vector_environment(task: Task, num_envs: int, seed: int) -> "SB3VecEnv":
    """The environment of a task for Stable-Baselines3, all copies advanced by one compiled call."""
    from pharos.interaction import make_sb3_vec

    return make_sb3_vec(task.env, num_envs, seed=seed, **task.interaction)


def _buffer_arrays(buffer: "ReplayBuffer") -> dict[str, np.ndarray]:
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


def _restore_buffer(buffer: "ReplayBuffer", arrays: Mapping[str, np.ndarray]) -> None:
    buffer.pos, buffer.full = int(arrays["place"][0]), bool(arrays["place"][1])
    for name in arrays:
        if name == "place":
            continue
        owner, slash, key = name.partition("/")
        target = getattr(buffer, owner)
        if slash and key:
            target = target[key]
        target[: len(arrays[name])] = arrays[name]
    last = buffer.pos - 1  # its episode is started anew, so returns of several steps must not run on into the next
    buffer.timeouts[last] = np.logical_or(buffer.timeouts[last], np.logical_not(buffer.dones[last]))
