"""Algorithms of Stable-Baselines3 on tasks of pharos: the same network everywhere, apart from the feature extractor.

Vectors go through one hidden layer, images through one convolution and one hidden layer (the network of MinAtar: Young
and Tian, 2019), both to 128 features. Then follows one hidden layer. So a difference between observations is one
between representations, not between networks (the pharos paper, section 4.2).

`DeepAgent` is an agent that trains alone, `BatchedAgent` one that the batched engine has as well.
"""

import contextlib
import importlib
import inspect
import json
import math
import sys
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents.agent import (
    NETWORK,
    OBSERVATIONS,
    WORLD,
    Agent,
    ArrayLearner,
    AtPoint,
    Learner,
    LearningRun,
    LearningTask,
    PlannedRun,
    agents,
    is_known,
    new_agent,
    reading_checkpoint,
)
from pharos.environments import Environment
from pharos.errors import MissingExtra, ParameterError, UnknownName
from pharos.policies import PolicyLike, deep_policy
from pharos.system.sources import find_source, load_source

if TYPE_CHECKING:
    from stable_baselines3.common.buffers import ReplayBuffer

    from pharos.agents.batched import Batch, BatchRun
    from pharos.interaction import SB3VecEnv

EXTRACTED_FEATURES = 128
LEAST_ONE = ("n_envs", "n_steps", "n_epochs", "batch_size", "buffer_size", "train_freq", "target_update_interval")
SHARE_OPTIONS = (
    *("gamma", "gae_lambda", "tau"),
    *("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"),
)
POSITIVE = ("learning_rate", "clip_range", "max_grad_norm")
NOT_NEGATIVE = ("learning_starts", "ent_coef", "vf_coef")
# What `make_model` gives itself.
RESERVED_ARGUMENTS = {"env", "seed", "device", "tensorboard_log", "_init_setup_model"}
# What is asked of a model.
INTERFACE = ("learn", "policy", "num_timesteps", "set_logger", "get_parameters", "set_parameters")
NO_NORMALIZER = (
    "leave it out, as `vector` is in [0, 1] and rewards are small; or train behind VecNormalize yourself, and evaluate "
    "with pharos.evaluate_policy, which applies it"
)
# Hyperparameters of RL Zoo that are wrappers, and what to do here instead.
ZOO = {
    "normalize": NO_NORMALIZER,
    "normalize_kwargs": NO_NORMALIZER,
    "frame_stack": "give frames=k among the observation's options",
    "env_wrapper": "choose an observation, chance or a class of your own",
    "vec_env_wrapper": "choose an observation, chance or a class of your own",
    "env_kwargs": "give parameters to the environment",
}


def algorithm(agent: str | Callable[..., Any]) -> type:
    """The class of an algorithm: the name of an agent, "module:Class" or "file.py:Class", or a class itself.

    Raises:
        UnknownName: no such name or class. ParameterError: no such module or file, or something else than a class.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    if not isinstance(agent, str):
        return _class(agent, agent)
    path = getattr(agents().get(agent), "path", agent)
    module, colon, name = path.partition(":")
    if not colon:
        raise UnknownName("agent", agent, agents())
    if not is_known(path):
        return _class(agent, load_source(find_source(path)))
    try:
        target = getattr(importlib.import_module(module), name)
        from stable_baselines3.common.base_class import BaseAlgorithm

        return _class(agent, target, BaseAlgorithm)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith(("stable_baselines3", "torch")):
            raise MissingExtra(f"the agent {agent!r}", "stable-baselines3", "agents") from error
        if error.name == "sb3_contrib":
            raise ParameterError(
                f"the agent {agent!r} needs sb3-contrib; install it with: pip install sb3-contrib"
            ) from error
        raise UnknownName("module of an agent", module, []) from error
    except AttributeError as error:
        raise UnknownName(
            "agent", path, [f"{module}:{each}" for each in dir(importlib.import_module(module))]
        ) from error


def _class(agent: object, target: object, base: type = object) -> type:
    """Return what an agent's name stands for if it is a class. Anything else in a module is neither called nor read."""
    if not isinstance(target, type) or not issubclass(target, base):
        raise ParameterError(
            f"agent {str(agent)[:60]!r}: found {str(target)[:60]}; expected the class of an algorithm for "
            f"Stable-Baselines3"
        )
    return target


def check_hyperparameters(
    agent: str | Callable[..., Any], hyperparameters: Mapping[str, Any], also: Iterable[str] = ()
) -> None:
    """Refuse hyperparameters that the algorithm lacks, and values that it would accept silently or fail with late.

    Args:
        also: names that the engine adds to the algorithm's.
    Raises:
        UnknownName: with the nearest name that it has. ParameterError: a number out of its range, something else for
        one, or RL Zoo's wrappers.
    """
    name = _title(agent)
    parameters = inspect.signature(algorithm(agent)).parameters
    for hyperparameter, remedy in ZOO.items():
        if hyperparameter in hyperparameters and hyperparameter not in parameters:
            raise ParameterError(f"agent {name!r}: {hyperparameter} is RL Zoo's, for wrappers; {remedy}")
    if all(each.kind is not inspect.Parameter.VAR_KEYWORD for each in parameters.values()):
        names = sorted({*parameters, "n_envs", "n_timesteps", "net_arch", *also} - RESERVED_ARGUMENTS)
        for hyperparameter in hyperparameters:
            if hyperparameter not in names:
                raise UnknownName(f"hyperparameter of {name}", hyperparameter, names)
    check_ranges(name, hyperparameters)


def check_ranges(name: str, hyperparameters: Mapping[str, Any]) -> None:
    """ParameterError: a number is out of the range of its hyperparameter, or something else stands for it."""
    for hyperparameter, value in hyperparameters.items():
        expected = _expected(hyperparameter, value)
        if expected is not None:
            raise ParameterError(f"agent {name!r}: {hyperparameter} is {value!r}; expected {expected}")


def check_masks(agent: str | Callable[..., Any], env: Environment) -> None:
    """Refuse an algorithm that needs action masks if all actions are available, and one without if not all are.

    Raises:
        ParameterError: with what to do.
    """
    predict = getattr(algorithm(agent), "predict", None)
    is_masked = predict is not None and "action_masks" in inspect.signature(predict).parameters
    if is_masked and not env.has_sets:
        raise ParameterError(
            f"agent {_title(agent)!r}: needs action masks, and {env} has none: every action is available; for masks of "
            f"your own train it on pharos.GymEnv in sb3_contrib's ActionMasker, and give masks= to "
            f"pharos.evaluate_policy"
        )
    if env.has_sets and not is_masked:
        raise ParameterError(
            f"agent {_title(agent)!r}: takes no action masks, and some actions of {env} are not available in some "
            f"states; take sb3_contrib:MaskablePPO, q_learning, or dqn and ppo with the engine batched"
        )


def _title(agent: str | Callable[..., Any]) -> str:
    return agent if isinstance(agent, str) else getattr(agent, "__name__", str(agent))


def _expected(name: str, value: object) -> str | None:
    """Expected type of a hyperparameter if `value` has another one. Schedules and the like pass."""
    if not isinstance(value, int | float | str):
        return None
    number = value if not isinstance(value, bool | str) else math.nan
    if name in LEAST_ONE and not (number >= 1 and float(number).is_integer()):
        return "an integer of at least 1"
    if name in SHARE_OPTIONS and not 0 <= number <= 1:
        return "a number from 0 to 1"
    if name in POSITIVE and not 0 < number < math.inf:
        return "a number above 0"
    if name == "ent_coef" and str(value).startswith("auto"):  # SAC's, with or without a first value
        return None
    if name in NOT_NEGATIVE and not 0 <= number < math.inf:
        return "a number of at least 0"
    return None


def extractor_class(space: Any) -> type:
    """The class of feature extractor for an observation space."""
    from stable_baselines3.common.torch_layers import CombinedExtractor

    from pharos.agents.networks import SmallCNN, SmallMLP

    if hasattr(space, "spaces"):
        return CombinedExtractor
    return SmallCNN if len(space.shape) == 3 and space.dtype == np.uint8 else SmallMLP


def make_model(
    agent: str | Callable[..., Any],
    env: Any,
    hyperparameters: dict[str, Any],
    *,
    seed: int,
    tensorboard: str | None = None,
) -> Any:
    """A model of Stable-Baselines3 on the CPU, with the network described above unless `policy_kwargs` says otherwise.

    Args:
        agent: as for `algorithm`.
        env: a VecEnv of Stable-Baselines3.
        hyperparameters: of the algorithm, with `net_arch` for the layers after the features. `n_envs` and `n_timesteps`
            are left out.
    Raises:
        ParameterError: the algorithm does not know a hyperparameter (`check_hyperparameters` says so better), or does
            not fit the environment.
    """
    import torch

    torch.set_num_threads(1)
    options = {key: value for key, value in hyperparameters.items() if key not in ("n_envs", "n_timesteps", "policy")}
    if not isinstance(options.get("policy_kwargs", {}), Mapping):
        wrong = options["policy_kwargs"]
        raise ParameterError(f"agent {_title(agent)!r}: policy_kwargs is {wrong!r}; expected a mapping")
    network = {
        "features_extractor_class": extractor_class(env.observation_space),
        "net_arch": options.pop("net_arch", [EXTRACTED_FEATURES]),
        **options.pop("policy_kwargs", {}),
    }
    policy = "MultiInputPolicy" if hasattr(env.observation_space, "spaces") else "MlpPolicy"
    if (with_memory := policy.replace("Policy", "LstmPolicy")) in getattr(algorithm(agent), "policy_aliases", {}):
        policy = with_memory
    try:
        model = algorithm(agent)(
            hyperparameters.get("policy", policy),
            env,
            seed=seed,
            device="cpu",
            policy_kwargs=network,
            tensorboard_log=tensorboard,
            **options,
        )
    except (TypeError, ValueError, AssertionError) as error:
        names = getattr(algorithm(agent), "policy_aliases", {})
        remedy = f"; give its hyperparameter policy: {', '.join(names)}" if "policy" in str(error).lower() else ""
        raise ParameterError(f"agent {_title(agent)!r} cannot be made: {error}{remedy}") from error
    except RuntimeError as error:  # torch, of memory
        if "allocate" not in str(error):
            raise
        raise MemoryError(f"the network of {_title(agent)!r}: net_arch is {network['net_arch']}") from error
    if missing := [name for name in INTERFACE if not hasattr(model, name)]:
        raise ParameterError(
            f"agent {_title(agent)!r} has no {', '.join(missing)}; expected a class derived from Stable-Baselines3's "
            "BaseAlgorithm, or one with act, observe and policy"
        )
    if tensorboard is None:  # the logger that it would make itself leaves a folder among the temporary files
        from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger

        formats: list[KVWriter] = [HumanOutputFormat(sys.stdout)] if options.get("verbose") else []
        model.set_logger(Logger(folder=None, output_formats=formats))
    return model


# Agents ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class DeepAgent(Agent):
    """An algorithm of Stable-Baselines3, whose runs train alone.

    Attributes:
        path: of its class, `module:Class` or `file.py:Class`.
    """

    path: str

    def resumes_exactly(self, engine: str) -> bool:
        return engine != "sb3"

    def has_tensorboard(self, engine: str) -> bool:
        return engine == "sb3"

    def library_default(self, name: str) -> object:
        parameter = inspect.signature(algorithm(self.name)).parameters.get(name)
        return None if parameter is None or parameter.default is parameter.empty else parameter.default

    def check(self, hyperparameters: Mapping[str, Any], engine: str) -> None:
        check_hyperparameters(self.name, hyperparameters)

    def check_before(self, hyperparameters: Mapping[str, Any], engine: str) -> None:
        check_ranges(_title(self.name), hyperparameters)
        if not {*hyperparameters} <= {*self.defaults, *self.space, *self.benchmark_defaults}:
            with contextlib.suppress(MissingExtra):
                self.check(hyperparameters, engine)

    def prepare(self, run: LearningRun, device: str, *, is_single: bool) -> Hashable | None:
        _ = run.algorithm  # or what is wrong with it
        return None

    def learner(self, runs: Sequence[LearningRun], device: str, logs: Path | None = None) -> Learner:
        (run,) = runs
        check_masks(run.algorithm, run.task.env)
        return _model(run, logs)

    def load(self, folder: Path, run: LearningRun) -> PolicyLike:
        learner = _model(run)
        learner.load(folder / NETWORK)
        return learner.agent


@dataclass(frozen=True, kw_only=True, eq=False)
class BatchedAgent(DeepAgent):
    """An algorithm that the batched engine has, too, in the file of its name in batched/: many runs as one program."""

    engines: tuple[str, ...] = ("sb3", "batched")

    def check(self, hyperparameters: Mapping[str, Any], engine: str) -> None:
        from pharos.agents.batched import OWN_OPTIONS, supports

        if engine == "sb3":
            super().check(hyperparameters, engine)
            return
        check_hyperparameters(self.name, hyperparameters, OWN_OPTIONS)
        lacking = supports(self.name, hyperparameters)
        if lacking is not None:
            raise ParameterError(f"the batched engine: {lacking}; the engine sb3 has it")

    def group_key(self, run: PlannedRun, device: str) -> Hashable | None:
        from pharos.agents.batched import group_key

        if run.config.engine == "sb3":
            return None
        return run.config.evaluation_interval, group_key(self.name, run, device)

    def width(self, run: PlannedRun, device: str) -> int:
        from pharos.agents.batched import lane_width

        return 1 if run.config.engine == "sb3" else lane_width(run.shape.is_image, device)

    def prepare(self, run: LearningRun, device: str, *, is_single: bool) -> Hashable | None:
        from pharos.agents.batched import group_key

        if run.config.engine == "sb3":
            return super().prepare(run, device, is_single=is_single)
        self.check(run.hyperparameters, run.config.engine)
        return group_key(self.name, _batch_run(run), device)

    def learner(self, runs: Sequence[LearningRun], device: str, logs: Path | None = None) -> Learner:
        from pharos.agents.batched import make_batch

        if runs[0].config.engine == "sb3":
            return super().learner(runs, device, logs)
        return Networks(make_batch(self.name, [_batch_run(run) for run in runs], device=device))


def _model(run: LearningRun, logs: Path | None = None) -> "Deep":
    where = None if logs is None else str(logs)
    return Deep(run.algorithm, run.task, run.hyperparameters, run.config.steps, run.config.seed, where)


def _batch_run(run: LearningRun) -> "BatchRun":
    """A run as the batched engine takes it. Runs share observations, rewards of outcomes and rewards of staying."""
    from pharos.agents.batched import BatchRun, ObservationSource
    from pharos.mdp import rewards_of_outcomes, rewards_of_staying

    config, task, chance = run.config, run.task, run.task.scaled_chance
    space, staying = task.space, None
    if chance.lazy:
        staying = run.shared("staying", WORLD, lambda: rewards_of_staying(space).array.astype(float))
    return BatchRun(
        mdp=replace(chance, lazy=0.0).of(run.world_mdp) if chance.lazy else task.mdp,
        observe=run.shared("observations", OBSERVATIONS, lambda: ObservationSource.of(space, task.observer.observe)),
        time_limit=task.time_limit,
        hyperparameters=run.hyperparameters,
        steps=config.steps,
        seed=config.seed,
        key=int(config.id, 16),
        gamma=config.gamma,
        # If the rules have chance, rewards belong to outcomes, not to pairs
        outcome_rewards=run.shared("rewards", WORLD, lambda: rewards_of_outcomes(space) if space.has_chance else None),
        chance=chance,
        staying=staying,
    )


# Learners -------------------------------------------------------------------------------------------------------------


class Networks(ArrayLearner):
    """A batch of the batched engine."""

    def __init__(self, batch: "Batch"):
        self.batch = batch
        self.learn, self.policy, self.best_actions = batch.learn, batch.policy, batch.best_actions
        self.greedy_actions = batch.greedy_actions

    @property
    def episodes(self) -> np.ndarray:
        return self.batch.episodes

    @property
    def returns(self) -> np.ndarray:
        return self.batch.returns

    def state(self) -> dict[str, np.ndarray]:
        return self.batch.state()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        self.batch.restore(state)

    def parameters(self, i: int) -> dict[str, np.ndarray]:
        """The network of run i, under the names of Stable-Baselines3."""
        return self.batch.parameters(i)

    def set_parameters(self, i: int, parameters: Mapping[str, np.ndarray]) -> None:
        """Replace the network of run i."""
        self.batch.set_parameters(i, parameters)

    def publish(self, i: int, folder: Path) -> None:
        """Write the network, as `Deep` reads it, with the names of parameters in the policy of Stable-Baselines3."""
        import torch

        target = new_agent(folder)
        parameters = self.parameters(i).items()
        policy = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in parameters}
        torch.save({"policy": policy}, target / "parameters.pt")
        counters = {"num_timesteps": int(self.batch.steps), "episodes": int(self.episodes[i])}
        (target / "model.json").write_text(json.dumps({"counters": counters, "returns": float(self.returns[i])}))


class Deep:
    """A model of Stable-Baselines3, the only run of its program."""

    def __init__(
        self,
        agent: str | Callable[..., Any],
        task: LearningTask,
        hyperparameters: dict[str, Any],
        steps: int,
        seed: int,
        tensorboard: str | None = None,
    ):
        check_hyperparameters(agent, hyperparameters)
        self.gamma, self.steps = task.gamma, steps
        self.env = vector_environment(task, int(hyperparameters.get("n_envs", 1)), seed)
        self.model = make_model(agent, self.env, hyperparameters, seed=seed, tensorboard=tensorboard)
        self.agent = deep_policy(self.model, masked=task.env.has_sets, imposed=True)
        self.finished = (0, 0.0)  # episodes, and the sum of their returns

    @property
    def episodes(self) -> np.ndarray:
        return np.array([self.finished[0]])

    @property
    def returns(self) -> np.ndarray:
        return np.array([self.finished[1]])

    def policy(self, i: int) -> PolicyLike:
        return self.agent

    def greedy_actions(self, indices: Sequence[int]) -> None:
        return None

    def learn(self, points: Sequence[int], at_point: AtPoint) -> None:
        """Train until the last of `points`, which comes after the last update, and call `at_point` at each.

        Algorithms that learn from whole rollouts, such as PPO, take the steps of their last rollout although fewer are
        left. Episodes that end after the last point are not counted.
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
        """Restore what `save` wrote. The episode that was running is started anew."""
        import torch

        model = self.model
        with reading_checkpoint(folder):
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
        self.save(new_agent(folder))


_COUNTERS = ("num_timesteps", "_n_updates", "_n_calls", "_episode_num")


def vector_environment(task: LearningTask, num_envs: int, seed: int) -> "SB3VecEnv":
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
