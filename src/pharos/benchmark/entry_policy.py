"""Task and policy of an entry, made of the numbers and names in its file.

What it has learnt is checked before anything of its size is made, and never executed.
"""

import inspect
import itertools
import math
from collections.abc import Iterator, Mapping, MutableMapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import AGENT_LIBRARIES, agent_called, agents, algorithm, extractor_class, make_model
from pharos.benchmark.entry import POLICY_ARRAY, Entry
from pharos.environments import BUILT_IN
from pharos.errors import FileFormatError, ParameterError, StateSpaceTooLarge, UntrustedCode
from pharos.observations import names as observation_names
from pharos.observations import observe
from pharos.policies import PolicyLike, deep_policy
from pharos.state_space import build
from pharos.system import storage
from pharos.system.sources import is_reference, untrusted_code
from pharos.training import RunConfig, Task, TaskValues

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

LARGEST_OBSERVATION = 1 << 21
NETWORK_OPTIONS = ("net_arch", "normalize_images", "ortho_init", "features_extractor_kwargs")
"""What `policy_kwargs` of an entry may say."""
SMALLEST = ({"buffer_size": 1}, {"n_steps": 2, "batch_size": 2})
"""What takes memory, and does not matter to a policy that learns no more: of replay, or of rollouts."""
SMALLEST_CHANCE = 1e-12


def policy_of(entry: Entry, task: Task, *, trust: bool = False) -> PolicyLike:
    """The policy of an entry, as `training.evaluate_agent` takes it.

    Args:
        trust: whether the agent may be code that is no part of pharos or of Stable-Baselines3.
    Raises:
        FileFormatError: what is in the file is no policy for this task. UntrustedCode: the agent is code.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    has_table = agent_called(entry.config.agent).has_table
    return _table(entry, task) if has_table else _network(entry, task, trust)


def _table(entry: Entry, task: Task) -> np.ndarray:
    if set(entry.arrays) != {POLICY_ARRAY}:
        raise FileFormatError(f"a table has the array {POLICY_ARRAY!r} alone; found {', '.join(entry.arrays)}")
    states, actions = task.mdp.num_states, task.mdp.num_actions
    return checked_table(entry.arrays[POLICY_ARRAY], (states, actions + 1, actions))


def checked_table(table: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Table of a file as int64 actions (S,), or as float64 probabilities of a shape (S, ..., A).

    Raises:
        FileFormatError: it has another shape, or names actions that are not there.
    """
    states, num_actions = shape[0], shape[-1]
    if table.shape == (states,) and table.dtype.kind in "iu":
        if states and not (int(table.min()) >= 0 and int(table.max()) < num_actions):
            raise FileFormatError(
                f"its table names actions from {table.min()} to {table.max()}; there are {num_actions}"
            )
        return table.astype(np.int64)
    if table.shape == shape:
        return table.astype(np.float64)
    raise FileFormatError(
        f"its table has shape {table.shape}, {table.dtype}; expected ({states},) actions or {shape} probabilities"
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
        return deep_policy(model)
    except FileFormatError:
        raise
    except ParameterError as error:
        raise FileFormatError(str(error)) from None
    except (RuntimeError, TypeError, ValueError, KeyError, AttributeError) as error:
        first = " ".join(str(error).split())[:200]
        raise FileFormatError(f"its network is none of {config.agent} on this task: {first}") from None


def _known_agent(name: str) -> str:
    """The name of an agent of pharos, or of a class that Stable-Baselines3 or sb3-contrib announce."""
    if name in agents():
        return name
    module, _, attribute = name.partition(":")
    if module in AGENT_LIBRARIES and attribute.isidentifier():
        from stable_baselines3.common.base_class import BaseAlgorithm

        cls = algorithm(name)
        if isinstance(cls, type) and issubclass(cls, BaseAlgorithm):
            return name
    raise untrusted_code(f"the agent {name!r}")


def _network_options(entry: Entry) -> dict[str, Any]:
    """Hyperparameters that shape the network. FileFormatError if some are not plain numbers and truths."""
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
    for widths in _architectures(hyperparameters):
        if not isinstance(widths, list) or not all(type(width) is int and width >= 1 for width in widths):
            raise FileFormatError(f"its net_arch is {str(widths)[:80]}; expected widths of layers")
        layers += len(widths)
    if layers > 2 * len(entry.arrays) + 8:
        raise FileFormatError(f"its hyperparameters ask for {layers:,} layers that its network does not have")
    space = {"state_space": task.space} if task.observation == "index" else {}
    observation = observe(task.env, task.observation, **space, **task.observation_options)
    size = math.prod(observation.space.shape or (1,))
    if size > LARGEST_OBSERVATION:
        raise FileFormatError(f"its observations have {size:,} entries; expected at most {LARGEST_OBSERVATION:,}")


def _architectures(hyperparameters: Mapping[str, Any]) -> Iterator[Any]:
    """Yield the widths of layers that hyperparameters ask for, for each part of the network, unchecked."""
    for options in (hyperparameters, hyperparameters.get("policy_kwargs", {})):
        architecture = options.get("net_arch", [])
        yield from architecture.values() if isinstance(architecture, dict) else [architecture]


def _check_arrays(entry: Entry, env: "VecEnv", hyperparameters: dict[str, Any]) -> None:
    """Refuse hyperparameters whose network does not match the arrays of the file, before it takes memory.

    The feature extractor is made on PyTorch's device "meta", without numbers, to get its shapes.
    """
    import torch

    kwargs = hyperparameters.get("policy_kwargs", {})
    with torch.device("meta"):
        features = extractor_class(env.observation_space)(
            env.observation_space, **kwargs.get("features_extractor_kwargs", {})
        )
    expected = {tuple(each.shape) for each in features.state_dict().values()}
    for widths in _architectures(hyperparameters):
        expected |= {(after, before) for before, after in itertools.pairwise((features.features_dim, *widths))}
    shapes = {array.shape for array in entry.arrays.values() if array.dtype == np.float32}
    if missing := sorted(expected - shapes):
        raise FileFormatError(f"its hyperparameters ask for layers {missing[:3]} that its network does not have")
    for name, array in entry.arrays.items():
        if not np.isfinite(array).all():
            raise FileFormatError(f"its weights {name!r} are not finite")


# The task ------------------------------------------------------------------------------------------------------------


def task_of(entry: Entry, trust: bool, max_states: int, values: MutableMapping[str, TaskValues] | None) -> Task:
    """The task of an entry, its state space built, within limits that hold before it is."""
    config = entry.config
    _check_code(config, trust)
    for name, value in config.chance.to_dict().items():
        if (name, value) == ("scale_rewards", "range"):
            continue
        if type(value) not in (int, float):
            raise FileFormatError(f"its {name} is {str(value)[:40]!r}; expected a number")
        if 0 < value < SMALLEST_CHANCE:
            raise FileFormatError(f"its {name} is {value:g}; expected 0, or at least {SMALLEST_CHANCE:g}")
    key = task_key(config)
    try:
        task = config.task(None if values is None else values.get(key), trust=trust, strict=True)
    except (TypeError, KeyError, AttributeError, OverflowError) as error:  # parameters that are no parameters
        raise FileFormatError(f"its parameters cannot be read: {' '.join(str(error).split())[:200]}") from None
    env = task.env
    if storage.plain(env.parameters) != storage.plain(config.parameters):
        raise FileFormatError(f"its parameters are not those of {env}; expected all parameters, as the class has them")
    if env.version != entry.rules_version:
        raise FileFormatError(
            f"is of version {entry.rules_version} of the rules of {env.name}; this pharos has version {env.version}, "
            f"another MDP: train again, or verify with pharos {entry.versions.get('pharos', '(of an unknown version)')}"
        )
    table = entry.arrays.get(POLICY_ARRAY)
    has_table = agent_called(config.agent).has_table
    limit = len(table) if has_table and table is not None and table.ndim else max_states
    space = build(env, max_states=max(1, limit), progress=False)
    if space.num_states > limit:
        raise StateSpaceTooLarge(f"{env} has {space.num_states:,} states; expected at most {limit:,}")
    if values is not None and key not in values:
        values[key] = TaskValues(task.reference, task.return_range)
    return task


def task_key(config: RunConfig) -> str:
    """Digest of the task by which entries are compared: environment, chance, setting of values. 1 and 1.0 are equal."""
    chance = {name: value for name, value in config.chance.to_dict().items() if value}
    task = [config.environment, config.parameters, chance, config.gamma, config.horizon]
    return storage.digest_of_json(_as_floats(storage.plain(task)))


def _as_floats(value: object) -> object:
    if isinstance(value, dict):
        return {name: _as_floats(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_as_floats(item) for item in value]
    return float(value) + 0.0 if isinstance(value, int | float) else value  # 0.0, if it is -0.0


def _check_code(config: RunConfig, trust: bool) -> None:
    """Refuse code, environments and observations that are not part of pharos, unless trusted. Agents are not checked
    here."""
    if trust:
        return
    if config.sources:
        part, source = next(iter(config.sources.items()))
        raise untrusted_code(f"the {part} {source.name!r}")
    if config.environment not in {entry.name for entry in BUILT_IN}:
        raise UntrustedCode(f"the environment {config.environment!r} is no part of pharos: add --trust if you trust it")
    if is_reference(config.observation) or config.observation not in observation_names():
        raise UntrustedCode(f"the observation {config.observation!r} is no part of pharos: add --trust if you trust it")
