"""What an entry has learnt as a policy: checked before anything of its size is made, and never executed."""

import inspect
import itertools
import math
from typing import Any

import numpy as np

from pharos.agents import AGENTS, algorithm, extractor, make_model
from pharos.errors import FileFormatError, ParameterError, UntrustedCode
from pharos.leaderboard.entry import POLICY, Entry
from pharos.observations import observe
from pharos.policies import PolicyLike, deep_policy
from pharos.training import Task

LIBRARIES = ("stable_baselines3", "sb3_contrib")
LARGEST_OBSERVATION = 1 << 21
NETWORK_OPTIONS = ("net_arch", "normalize_images", "ortho_init", "features_extractor_kwargs")
"""What `policy_kwargs` of an entry may say."""
SMALLEST = ({"buffer_size": 1}, {"n_steps": 2, "batch_size": 2})
"""What takes memory, and does not matter to a policy that learns no more: of replay, or of rollouts."""


def policy_of(entry: Entry, task: Task, *, trust: bool = False) -> PolicyLike:
    """The policy of an entry, as `training.evaluate_agent` takes it.

    Args:
        trust: whether the agent may be code that is no part of pharos or of Stable-Baselines3.
    Raises:
        FileFormatError: what is in the file is no policy for this task. UntrustedCode: the agent is code.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    return _table(entry, task) if entry.config.is_tabular else _network(entry, task, trust)


def _table(entry: Entry, task: Task) -> np.ndarray:
    if set(entry.arrays) != {POLICY}:
        raise FileFormatError(f"a table has the array {POLICY!r} alone; found {', '.join(entry.arrays)}")
    table, mdp = entry.arrays[POLICY], task.mdp
    states, actions = mdp.num_states, mdp.num_actions
    if table.shape == (states,) and table.dtype.kind in "iu":
        if states and not (int(table.min()) >= 0 and int(table.max()) < actions):
            raise FileFormatError(f"its table names actions from {table.min()} to {table.max()}; there are {actions}")
        return table.astype(np.int64)
    if table.shape == (states, actions + 1, actions):
        return table.astype(np.float64)
    raise FileFormatError(
        f"its table has shape {table.shape}; expected ({states},) or ({states}, {actions + 1}, {actions})"
    )


def _network(entry: Entry, task: Task, trust: bool) -> PolicyLike:
    config = entry.config
    if trust:
        agent, hyperparameters = config.algorithm(trust=True, strict=True), dict(entry.hyperparameters)
    else:
        agent, hyperparameters = _known_agent(config.agent), _network_options(entry)
        _check_sizes(entry, task, hyperparameters)
    parameters = inspect.signature(algorithm(agent)).parameters  # or what is missing for it is told
    import torch

    from pharos.interaction import make_sb3_vec

    smallest = next((options for options in SMALLEST if set(options) <= set(parameters)), {})
    env = make_sb3_vec(task.env, 1, seed=0, **task.interaction)
    try:
        if not trust:
            _check_arrays(entry, env, hyperparameters)
        model = make_model(agent, env, {**hyperparameters, **smallest}, seed=0)
        tensors = {name: torch.from_numpy(np.array(array)) for name, array in entry.arrays.items()}
        model.policy.load_state_dict(tensors)
    except FileFormatError:
        raise
    except ParameterError as error:
        raise FileFormatError(str(error)) from None
    except (RuntimeError, TypeError, ValueError, KeyError, AttributeError) as error:
        first = " ".join(str(error).split())[:200]
        raise FileFormatError(f"its network is none of {config.agent} on this task: {first}") from None
    return deep_policy(model)


def _known_agent(name: str) -> str:
    """The name of an agent of pharos, or of a class that Stable-Baselines3 or sb3-contrib announce."""
    if name in AGENTS:
        return name
    module, _, attribute = name.partition(":")
    if module in LIBRARIES and attribute.isidentifier():
        from stable_baselines3.common.base_class import BaseAlgorithm

        cls = algorithm(name)
        if isinstance(cls, type) and issubclass(cls, BaseAlgorithm):
            return name
    raise UntrustedCode(f"the agent {name!r} is code, which is executed only if you trust it: add --trust")


def _network_options(entry: Entry) -> dict[str, Any]:
    """Of the hyperparameters, those that shape the network; plain numbers and truths alone."""
    hyperparameters = entry.hyperparameters
    options = {name: hyperparameters[name] for name in ("net_arch", "policy_kwargs") if name in hyperparameters}
    kwargs = options.get("policy_kwargs", {})
    if not isinstance(kwargs, dict) or not set(kwargs) <= set(NETWORK_OPTIONS):
        raise FileFormatError(
            f"its policy_kwargs are {kwargs!r}; without --trust they may be {', '.join(NETWORK_OPTIONS)}"
        )
    extractor = kwargs.get("features_extractor_kwargs", {})
    if not isinstance(extractor, dict) or not set(extractor) <= {"features_dim"}:
        raise FileFormatError(f"its features_extractor_kwargs are {extractor!r}; expected features_dim alone")
    return options


def _check_sizes(entry: Entry, task: Task, hyperparameters: dict[str, Any]) -> None:
    """Refuse layers and observations of other types, or of more entries, than a network has."""
    kwargs = hyperparameters.get("policy_kwargs", {})
    features = kwargs.get("features_extractor_kwargs", {}).get("features_dim", 1)
    if type(features) is not int or features < 1:
        raise FileFormatError(f"its features_dim is {str(features)[:40]}; expected a whole number of at least 1")
    layers = 0
    for arch in (hyperparameters.get("net_arch", []), kwargs.get("net_arch", [])):
        for each in arch.values() if isinstance(arch, dict) else [arch]:
            if not isinstance(each, list) or not all(type(width) is int and width >= 1 for width in each):
                raise FileFormatError(f"its net_arch is {str(arch)[:80]}; expected widths of layers")
            layers += len(each)
    if layers > 2 * len(entry.arrays) + 8:
        raise FileFormatError(f"its hyperparameters ask for {layers:,} layers that its network does not have")
    space = {"state_space": task.space} if task.observation == "index" else {}
    observation = observe(task.env, task.observation, **space, **task.observation_options)
    size = math.prod(observation.space.shape or (1,))
    if size > LARGEST_OBSERVATION:
        raise FileFormatError(f"its observations have {size:,} entries; expected at most {LARGEST_OBSERVATION:,}")


def _check_arrays(entry: Entry, env: Any, hyperparameters: dict[str, Any]) -> None:
    """Refuse a network that is not the one in the file before it takes memory: each layer is found among the arrays.

    The extractor of features is made without numbers (on PyTorch's device "meta"), which tells its shapes.
    """
    import torch

    kwargs = hyperparameters.get("policy_kwargs", {})
    with torch.device("meta"):
        features = extractor(env.observation_space)(
            env.observation_space, **kwargs.get("features_extractor_kwargs", {})
        )
    expected = {tuple(each.shape) for each in features.state_dict().values()}
    for arch in (hyperparameters.get("net_arch", []), kwargs.get("net_arch", [])):
        for layers in arch.values() if isinstance(arch, dict) else [arch]:
            expected |= {(after, before) for before, after in itertools.pairwise((features.features_dim, *layers))}
    shapes = {array.shape for array in entry.arrays.values() if array.dtype == np.float32}
    if missing := sorted(expected - shapes):
        raise FileFormatError(f"its hyperparameters ask for layers {missing[:3]} that its network does not have")
    for name, array in entry.arrays.items():
        if not np.isfinite(array).all():
            raise FileFormatError(f"its weights {name!r} are not finite")
