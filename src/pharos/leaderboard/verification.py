"""Verifying an entry: value and regret of its policy, computed again from the rules and held against its claim.

What it has learnt is checked before anything of its size is made, and never executed.
"""

import contextlib
import errno
import inspect
import itertools
import math
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import agent_called, agents, algorithm, extractor, make_model
from pharos.environments import BUILT_IN
from pharos.errors import FileFormatError, ParameterError, StateSpaceTooLarge, TimeLimit, UntrustedCode
from pharos.leaderboard.entry import LARGEST_FILE, LONGEST_TEXT, POLICY, Claim, Entry, read
from pharos.leaderboard.limits import Limits
from pharos.observations import names as observation_names
from pharos.observations import observe
from pharos.policies import PolicyLike, deep_policy
from pharos.state_space import build
from pharos.system import storage
from pharos.system.memory import available_memory
from pharos.system.records import takes
from pharos.system.sources import is_reference
from pharos.training import ReferenceValues, RunConfig, Task, TaskValues, evaluate_agent, regret

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

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
    has_table = agent_called(entry.config.agent).has_table
    return _table(entry, task) if has_table else _network(entry, task, trust)


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
    if module in LIBRARIES and attribute.isidentifier():
        from stable_baselines3.common.base_class import BaseAlgorithm

        cls = algorithm(name)
        if isinstance(cls, type) and issubclass(cls, BaseAlgorithm):
            return name
    raise UntrustedCode(f"the agent {name!r} is code, which is executed only if you trust it: add --trust")


def _network_options(entry: Entry) -> dict[str, Any]:
    """Hyperparameters that shape the network; FileFormatError if some are not plain numbers and truths."""
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
        features = extractor(env.observation_space)(
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


# Verification ---------------------------------------------------------------------------------------------------------


SMALLEST_CHANCE = 1e-12
SHARE_OF_MEMORY = 0.9
SEED = 1
"""Of estimates; another one than that of runs, so that an estimate is not compared with itself."""


@dataclass(frozen=True)
class Check:
    """A claimed number beside the computed one.

    Attributes:
        name: "value", "regret", "value_optimal" or "value_uniform".
        claimed, found: the two numbers.
        within: how far apart they may be.
    """

    name: str
    claimed: float
    found: float
    within: float

    @property
    def holds(self) -> bool:
        """Whether claimed and computed number differ by at most `within`."""
        return abs(self.claimed - self.found) <= self.within


@dataclass(frozen=True, eq=False)
class Verdict:
    """Result of verifying an entry.

    Attributes:
        file, entry: what was verified.
        value, regret: of the policy, as they were computed.
        normalized_regret: regret / (V* - U); NaN where V* = U.
        value_optimal, value_uniform: V* and U, computed.
        exact: whether the value is computed; else it is estimated from episodes.
        error_bound: how far the value may be off; of an estimate half the width of a 99 % interval.
        states: in which the policy was asked; episodes: behind an estimate.
        checks: the claim, number by number.
        objections: what cannot be true of the claim, whatever was computed; sentences.
        seconds: that it took.
        limits: under which it was computed: the largest "states", "reached", "horizon", "seconds" and "bytes".
    """

    file: Path
    entry: Entry
    value: float
    regret: float
    normalized_regret: float
    value_optimal: float
    value_uniform: float
    exact: bool
    error_bound: float
    states: int
    episodes: int
    checks: tuple[Check, ...]
    seconds: float
    objections: tuple[str, ...] = ()
    limits: Mapping[str, float] = field(default_factory=dict)

    @property
    def holds(self) -> bool:
        """Whether all that can be computed is as claimed, possible, and not claimed to be exact where it is not."""
        return all(check.holds for check in self.checks) and not self.claims_too_much and not self.objections

    @property
    def claims_too_much(self) -> bool:
        """Whether the entry says that a value is exact which is only estimated here."""
        return self.entry.claim.exact and not self.exact


@takes(Limits)
def verify(
    file: str | os.PathLike,
    *,
    trust: bool = False,
    values: MutableMapping[str, TaskValues] | None = None,
    **options: Any,
) -> Verdict:
    """Compute the value and the regret of an entry's policy again, and compare them with its claim.

    The states are enumerated from pharos' own rules, solved, and the policy is evaluated on them; of the file only
    numbers and names are used. A claim holds where its interval (its error bound) and the one found here meet, where it
    is not above V*, and where its interval is narrower than V* - U. A value that can only be estimated is estimated
    from other episodes than the run's own.

    Args:
        trust: whether code that the entry names may be imported: an environment, observation or agent that is no part
            of pharos or Stable-Baselines3. It comes from this machine; no file of an entry holds any.
        values: filled with the values of each task, for the entries that follow.
        options: of `Limits`: tolerance; beyond max_states, max_horizon or max_seconds an entry is refused, and beyond
            max_reached states that its policy reaches the value is estimated.
    Raises:
        ParameterError: there is no such file. FileFormatError: it is no entry, or not one of this version of the rules.
        ResultCorrupted: it was cut short or changed. UntrustedCode: it names code, and is not trusted.
        StateSpaceTooLarge: it has more states. TimeLimit: it takes longer.
    """
    began, path, limits = time.perf_counter(), Path(file), Limits(**options)
    entry = read(path)
    for name, steps in (("horizon", entry.config.horizon or 0), ("reward_delay", entry.config.chance.reward_delay)):
        if steps > limits.max_horizon:
            raise FileFormatError(f"{path}: its {name} is {steps:,} steps; expected at most {limits.max_horizon:,}")
    # Value of the policy and reference values, computed again within limits of time and memory
    try:
        with _time_limit(limits.max_seconds), _memory_limit():
            task = _task(entry, trust, limits.max_states, values)
            policy = policy_of(entry, task, trust=trust)
            evaluation = evaluate_agent(policy, task, max_states=limits.max_reached, seed=SEED)
            reference, range_of_returns = task.reference, task.return_range
    except (TimeLimit, UntrustedCode, StateSpaceTooLarge) as error:
        raise type(error)(f"{path}: {str(error)[:LONGEST_TEXT]}") from None
    except (ParameterError, FileFormatError) as error:
        raise FileFormatError(f"{path}: {str(error)[:LONGEST_TEXT]}") from None
    except (MemoryError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.ENOMEM:
            raise
        raise FileFormatError(f"{path}: asks for more memory than there is: {error}") from None
    # Each claimed number beside the computed one
    claim = entry.claim
    slack = limits.tolerance * max(1.0, abs(reference.optimal)) + reference.error_bound
    apart = slack + evaluation.error_bound + (min(claim.error_bound, slack) if claim.exact else claim.error_bound)
    lost, spread = regret(evaluation.value, reference), reference.spread()
    checks = (
        Check("value", claim.value, evaluation.value, apart),
        Check("regret", claim.regret, lost, apart + slack),
        Check("value_optimal", claim.value_optimal, reference.optimal, slack),
        Check("value_uniform", claim.value_uniform, reference.uniform, slack),
    )
    return Verdict(
        path,
        entry,
        evaluation.value,
        lost,
        regret(evaluation.value, reference, normalized_by="uniform"),
        reference.optimal,
        reference.uniform,
        evaluation.exact,
        evaluation.error_bound,
        evaluation.states,
        evaluation.episodes,
        checks,
        time.perf_counter() - began,
        _objections(claim, reference, spread if math.isfinite(spread) else float(np.ptp(range_of_returns)), slack),
        {name: getattr(limits, f"max_{name}") for name in ("states", "reached", "horizon", "seconds")}
        | {"bytes": LARGEST_FILE},
    )


def _objections(claim: Claim, reference: ReferenceValues, spread: float, slack: float) -> tuple[str, ...]:
    """Sentences on parts of a claim that cannot be true."""
    objections = []
    bound = min(claim.error_bound, slack) if claim.exact else claim.error_bound
    if claim.value - bound > reference.optimal + slack:
        objections.append(
            f"the value claimed, {claim.value:.8g}, is above that of the optimal policy, {reference.optimal:.8g}"
        )
    if claim.error_bound > spread + slack:
        objections.append(
            f"the error bound claimed, {claim.error_bound:.3g}, is larger than the values of policies are apart, "
            f"{spread:.3g}"
        )
    return tuple(objections)


@contextlib.contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeLimit in the block after that many seconds of wall-clock time, and every second until the block ends.

    A compiled kernel is not interrupted; it raises when it returns. Only the main thread can be stopped, by SIGALRM:
    elsewhere, and on Windows, there is no limit.
    """
    able = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if not able or not seconds < math.inf:
        yield
        return

    def stop(*_: object) -> None:
        raise TimeLimit(f"takes more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-6), 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _memory_limit() -> Iterator[None]:
    """Raise MemoryError if the block requests more memory than is free, before the system kills the process.

    On Linux, by RLIMIT_DATA of the whole process; elsewhere there is no limit.
    """
    statistics = Path("/proc/self/statm")
    if not statistics.exists():
        yield
        return
    import resource

    used = int(statistics.read_text().split()[5]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_DATA)
    limits = [int(used + SHARE_OF_MEMORY * available_memory()), *(each for each in before if each >= 0)]
    resource.setrlimit(resource.RLIMIT_DATA, (min(limits), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _task(entry: Entry, trust: bool, max_states: int, values: MutableMapping[str, TaskValues] | None) -> Task:
    """The task of an entry, its state space built, within limits that hold before it is."""
    config = entry.config
    _check_code(config, trust)
    for name, value in config.chance.to_dict().items():
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
            f"another MDP: train again, or verify with the pharos of then ({entry.versions.get('pharos', 'unknown')})"
        )
    table = entry.arrays.get(POLICY)
    has_table = agent_called(config.agent).has_table
    limit = len(table) if has_table and table is not None and table.ndim else max_states
    space = build(env, max_states=max(1, limit), progress=False)
    if space.num_states > limit:
        raise StateSpaceTooLarge(f"{env} has {space.num_states:,} states; expected at most {limit:,}")
    if values is not None and key not in values:
        values[key] = TaskValues(task.reference, task.return_range)
    return task


def task_key(config: RunConfig) -> str:
    """Digest of the task by which entries are compared: environment, chance, setting of values; 1 and 1.0 are equal."""
    chance = {name: value for name, value in config.chance.to_dict().items() if value}
    task = [config.environment, config.parameters, chance, config.gamma, config.horizon]
    return storage.digest_of_json(_as_floats(storage.plain(task)))


def _as_floats(value: object) -> object:
    if isinstance(value, dict):
        return {name: _as_floats(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_as_floats(item) for item in value]
    return float(value) + 0.0 if isinstance(value, int | float) else value  # 0.0, where it is -0.0


def _check_code(config: RunConfig, trust: bool) -> None:
    """Refuse code, environments and observations that are not part of pharos, unless trusted; not agents."""
    if trust:
        return
    if config.sources:
        part, source = next(iter(config.sources.items()))
        raise UntrustedCode(
            f"the {part} {source.name!r} is code, which is executed only if you trust it: add --trust (in Python: "
            f"trust=True)"
        )
    if config.environment not in {entry.name for entry in BUILT_IN}:
        raise UntrustedCode(f"the environment {config.environment!r} is no part of pharos: add --trust if you trust it")
    if is_reference(config.observation) or config.observation not in observation_names():
        raise UntrustedCode(f"the observation {config.observation!r} is no part of pharos: add --trust if you trust it")
