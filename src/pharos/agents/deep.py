"""Algorithms of Stable-Baselines3 on tasks of pharos: the same network everywhere, apart from the feature extractor.

Vectors go through one hidden layer, images through one convolution and one hidden layer (the network of MinAtar: Young
and Tian, 2019), both to 128 features; then follows one hidden layer. So a difference between observations is one
between representations, not between networks (the pharos paper, section 4.2).

What each agent is: tabular or a network, and how figures call it. States of learners, as checkpoints keep them.
"""

import importlib
import inspect
import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import MissingExtra, ParameterError, UnknownName
from pharos.policies import DeepPolicy
from pharos.system.sources import Source, find, is_reference, load

__all__ = ["ALGORITHMS", "DeepPolicy", "algorithm", "check_hyperparameters", "extractor", "make_model"]

FEATURES = 128
LEAST_ONE = ("n_envs", "n_steps", "n_epochs", "batch_size", "buffer_size", "train_freq", "target_update_interval")
SHARES = ("gamma", "gae_lambda", "tau", "exploration_fraction", "exploration_initial_eps", "exploration_final_eps")
POSITIVE = ("learning_rate", "clip_range", "max_grad_norm")
NOT_NEGATIVE = ("learning_starts", "ent_coef", "vf_coef")
# What `make_model` gives itself.
OURS = {"env", "seed", "device", "tensorboard_log", "_init_setup_model"}
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
ALGORITHMS = {"dqn": "stable_baselines3:DQN", "ppo": "stable_baselines3:PPO", "a2c": "stable_baselines3:A2C"}


def algorithm(agent: str | type) -> type:
    """The class of an algorithm: "dqn", "ppo", "a2c", "module:Class" or "file.py:Class"; or a class itself.

    Raises:
        UnknownName: no such name or class. ParameterError: no such module or file, or something else than a class.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    if not isinstance(agent, str):
        return _class(agent, agent)
    path = ALGORITHMS.get(agent, agent)
    module, colon, name = path.partition(":")
    if not colon:
        raise UnknownName("agent", agent, AGENTS)
    if not is_known(path):
        source = agent_source(path)
        assert source is not None
        return _class(agent, load(source))
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
    """Return what an agent's name stands for if it is a class; what else a module has is neither called nor read."""
    if not isinstance(target, type) or not issubclass(target, base):
        raise ParameterError(
            f"agent {str(agent)[:60]!r}: found {str(target)[:60]}; expected the class of an algorithm for "
            f"Stable-Baselines3"
        )
    return target


def check_hyperparameters(agent: str | type, hyperparameters: Mapping[str, Any], also: Iterable[str] = ()) -> None:
    """Refuse hyperparameters that the algorithm lacks, and values that it would accept silently or fail with late.

    Args:
        also: names that the engine adds to those of the algorithm.
    Raises:
        UnknownName: with the nearest name that it has. ParameterError: a number out of its range, or something else for
            one; RL Zoo's wrappers; or an algorithm that needs action masks.
    """
    name = _title(agent)
    parameters = inspect.signature(algorithm(agent)).parameters
    predict = getattr(algorithm(agent), "predict", None)
    if predict is not None and "action_masks" in inspect.signature(predict).parameters:
        raise ParameterError(
            f"agent {name!r}: needs action masks, which pharos does not give while it trains; train it on "
            f"pharos.GymEnv in sb3_contrib's ActionMasker, and use pharos.evaluate_policy(mdp, model, masks=...)"
        )
    for hyperparameter, remedy in ZOO.items():
        if hyperparameter in hyperparameters and hyperparameter not in parameters:
            raise ParameterError(f"agent {name!r}: {hyperparameter} is RL Zoo's, for wrappers; {remedy}")
    if all(each.kind is not inspect.Parameter.VAR_KEYWORD for each in parameters.values()):
        names = sorted({*parameters, "n_envs", "n_timesteps", "net_arch", *also} - OURS)
        for hyperparameter in hyperparameters:
            if hyperparameter not in names:
                raise UnknownName(f"hyperparameter of {name}", hyperparameter, names)
    for hyperparameter, value in hyperparameters.items():
        expected = _expected(hyperparameter, value)
        if expected is not None:
            raise ParameterError(f"agent {name!r}: {hyperparameter} is {value!r}; expected {expected}")


def _title(agent: str | type) -> str:
    return agent if isinstance(agent, str) else agent.__name__


def _expected(name: str, value: Any) -> str | None:
    """Expected type of a hyperparameter where `value` has another one; schedules and the like pass."""
    if not isinstance(value, int | float | str):
        return None
    number = value if not isinstance(value, bool | str) else math.nan
    if name in LEAST_ONE and not (number >= 1 and float(number).is_integer()):
        return "an integer of at least 1"
    if name in SHARES and not 0 <= number <= 1:
        return "a number from 0 to 1"
    if name in POSITIVE and not 0 < number < math.inf:
        return "a number above 0"
    if name == "ent_coef" and str(value).startswith("auto"):  # SAC's, with or without a first value
        return None
    if name in NOT_NEGATIVE and not 0 <= number < math.inf:
        return "a number of at least 0"
    return None


def extractor(space: Any) -> type:
    """The class of feature extractor for an observation space."""
    from stable_baselines3.common.torch_layers import CombinedExtractor

    from pharos.agents.networks import SmallCNN, SmallMLP

    if hasattr(space, "spaces"):
        return CombinedExtractor
    return SmallCNN if len(space.shape) == 3 and space.dtype == np.uint8 else SmallMLP


def make_model(
    agent: str | type, env: Any, hyperparameters: dict[str, Any], *, seed: int, tensorboard: str | None = None
) -> Any:
    """A model of Stable-Baselines3 on the CPU, with the network described above unless `policy_kwargs` says otherwise.

    Args:
        agent: as for `algorithm`.
        env: a VecEnv of Stable-Baselines3.
        hyperparameters: of the algorithm; `net_arch` for the layers after the features; `n_envs` and `n_timesteps` are
            left out.
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
        "features_extractor_class": extractor(env.observation_space),
        "net_arch": options.pop("net_arch", [FEATURES]),
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
    if tensorboard is None:  # the logger that it would make itself leaves a folder among the temporary files
        from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger

        formats: list[KVWriter] = [HumanOutputFormat(sys.stdout)] if options.get("verbose") else []
        model.set_logger(Logger(folder=None, output_formats=formats))
    return model


# Kinds ----------------------------------------------------------------------------------------------------------------


TABULAR_OBSERVATION = "index"
"""What tabular agents see."""


@dataclass(frozen=True)
class AgentKind:
    """Properties of an agent that are known before it is made.

    Attributes:
        name: as `train` takes it.
        title: as figures and tables write it.
        is_tabular: whether it learns a table over the states, whose index it sees; else a network over observations.
    """

    name: str
    title: str
    is_tabular: bool = False

    def observation(self, requested: str) -> str:
        """The observation that the agent gets if `requested` is asked for: tables see the index of the state."""
        return TABULAR_OBSERVATION if self.is_tabular else requested


AGENTS = {
    kind.name: kind
    for kind in (
        AgentKind("q_learning", "tabular Q-learning", is_tabular=True),
        AgentKind("dqn", "DQN"),
        AgentKind("ppo", "PPO"),
        AgentKind("a2c", "A2C"),
    )
}
"""The agents that have a name. Any other algorithm for Stable-Baselines3 is named by its class, `module:Class`."""


BATCHED = ("dqn", "ppo")
"""The networks that the batched engine trains, many runs as one program."""


def agent_kind(name: str) -> AgentKind:
    """Kind of the agent called `name`; a class of an algorithm for Stable-Baselines3 is a network."""
    return AGENTS.get(name) or AgentKind(name, name.rpartition(":")[2])


LIBRARIES = ("stable_baselines3", "sb3_contrib")
"""Their algorithms are known by name: they need no trust, and no source in the configuration of a run."""


def is_known(name: str) -> bool:
    """Whether an agent comes with pharos or with one of LIBRARIES, so that it is not code of the user's own."""
    return not is_reference(name) or name.partition(":")[0].split(".")[0] in LIBRARIES


def agent_source(name: str, folder: str | Path | None = None, *, check: bool = True) -> Source | None:
    """Place of the code of a user's own agent; None for all others.

    Args:
        folder: relative files and modules are looked for there first; None: in the current directory.
        check: whether it is imported, to see that it is a class.
    Raises:
        ParameterError: it cannot be imported, or is no class.
    """
    if is_known(name):
        return None
    source = find(name, folder)
    if check and not isinstance(load(source), type):
        raise ParameterError(
            f"{name!r}: found {load(source)!r}; expected the class of an algorithm for Stable-Baselines3"
        )
    return source


# States of several learners -------------------------------------------------------------------------------------------


def joined_states(states: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One dictionary of arrays of several learners, as checkpoints keep them: "3/q" is `q` of learner 3."""
    return {f"{i}/{name}": array for i, state in enumerate(states) for name, array in state.items()}


def state_of(joined: Mapping[str, np.ndarray], i: int) -> dict[str, np.ndarray]:
    """State of learner i."""
    prefix = f"{i}/"
    return {name[len(prefix) :]: array for name, array in joined.items() if name.startswith(prefix)}
