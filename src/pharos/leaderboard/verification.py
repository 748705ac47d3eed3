"""Verifying an entry: value and regret of its policy, computed again from the rules and held against its claim."""

import contextlib
import errno
import math
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments import BUILT_IN
from pharos.errors import FileFormatError, ParameterError, StateSpaceTooLarge, TimeLimit, UntrustedCode
from pharos.leaderboard.entry import LARGEST_FILE, LONGEST_TEXT, POLICY, Claim, Entry, read
from pharos.leaderboard.policy import policy_of
from pharos.observations import names as observation_names
from pharos.state_space import build
from pharos.system import storage
from pharos.system.memory import available_memory
from pharos.system.sources import is_reference
from pharos.training import ReferenceValues, RunConfig, Task, TaskValues, evaluate_agent, regret

TOLERANCE = 1e-6
MAX_STATES = 10_000_000
REACHED = 100_000
MAX_HORIZON = 100_000
MAX_SECONDS = 600.0
SMALLEST_CHANCE = 1e-12
SHARE_OF_MEMORY = 0.9
SEED = 1
"""Of estimates; another one than that of runs, so that an estimate is not compared with itself."""


@dataclass(frozen=True)
class Check:
    """A number of the claim beside what was computed.

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
        """Whether they are no farther apart than that."""
        return abs(self.claimed - self.found) <= self.within


@dataclass(frozen=True, eq=False)
class Verdict:
    """What was computed of an entry.

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


def verify(
    file: str | os.PathLike,
    *,
    trust: bool = False,
    tolerance: float = TOLERANCE,
    max_states: int = MAX_STATES,
    max_reached: int = REACHED,
    max_horizon: int = MAX_HORIZON,
    max_seconds: float = MAX_SECONDS,
    values: MutableMapping[str, TaskValues] | None = None,
) -> Verdict:
    """Compute the value and the regret of an entry's policy again, and compare them with its claim.

    The states are enumerated from pharos' own rules, solved, and the policy is evaluated on them; of the file only
    numbers and names are used. A claim holds where its interval (its error bound) and the one found here meet, where it
    is not above V*, and where its interval is narrower than V* - U. A value that can only be estimated is estimated
    from other episodes than the run's own.

    Args:
        trust: whether code that the entry names may be imported: an environment, observation or agent that is no part
            of pharos or Stable-Baselines3. It comes from this machine; no file of an entry holds any.
        tolerance: how far exact numbers may be apart, for rounding of networks on another processor; times V* where
            that is larger than 1.

        Cost only:
        max_states: StateSpaceTooLarge beyond. A table says itself how many states there are.
        max_reached: up to so many reached states a value is exact.
        max_horizon: of values, in steps.
        max_seconds: by the clock, for all of it; counted in the main thread alone, and not on Windows.
        values: filled with the values of each task, for the entries that follow.
    Raises:
        ParameterError: there is no such file. FileFormatError: it is no entry, or not one of this version of the rules.
        ResultCorrupted: it was cut short or changed. UntrustedCode: it names code, and is not trusted.
        StateSpaceTooLarge: it has more states. TimeLimit: it takes longer.
    """
    began, path = time.perf_counter(), Path(file)
    entry = read(path)
    for name, steps in (("horizon", entry.config.horizon or 0), ("reward_delay", entry.config.chance.reward_delay)):
        if steps > max_horizon:
            raise FileFormatError(f"{path}: its {name} is {steps:,} steps; expected at most {max_horizon:,}")
    try:
        with _time_limit(max_seconds), _memory_limit():
            task = _task(entry, trust, max_states, values)
            policy = policy_of(entry, task, trust=trust)
            evaluation = evaluate_agent(policy, task, max_states=max_reached, seed=SEED)
            reference, range_of_returns = task.reference, task.return_range
    except (TimeLimit, UntrustedCode, StateSpaceTooLarge) as error:
        raise type(error)(f"{path}: {str(error)[:LONGEST_TEXT]}") from None
    except (ParameterError, FileFormatError) as error:
        raise FileFormatError(f"{path}: {str(error)[:LONGEST_TEXT]}") from None
    except (MemoryError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.ENOMEM:
            raise
        raise FileFormatError(f"{path}: asks for more memory than there is: {error}") from None
    claim = entry.claim
    slack = tolerance * max(1.0, abs(reference.optimal)) + reference.error_bound
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
        {
            "states": max_states,
            "reached": max_reached,
            "horizon": max_horizon,
            "seconds": max_seconds,
            "bytes": LARGEST_FILE,
        },
    )


def _objections(claim: Claim, reference: ReferenceValues, spread: float, slack: float) -> tuple[str, ...]:
    """What cannot be true of a claim."""
    said = []
    bound = min(claim.error_bound, slack) if claim.exact else claim.error_bound
    if claim.value - bound > reference.optimal + slack:
        said.append(
            f"the value claimed, {claim.value:.8g}, is above that of the optimal policy, {reference.optimal:.8g}"
        )
    if claim.error_bound > spread + slack:
        said.append(
            f"the error bound claimed, {claim.error_bound:.3g}, is larger than the values of policies are apart, "
            f"{spread:.3g}"
        )
    return tuple(said)


@contextlib.contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeLimit within the block after so many seconds by the clock, and each second after that until it ends.

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
    """Raise MemoryError within the block where it asks for more than is free, before the system ends the process.

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
    limit = len(table) if config.is_tabular and table is not None and table.ndim else max_states
    space = build(env, max_states=max(1, limit), progress=False)
    if space.num_states > limit:
        raise StateSpaceTooLarge(f"{env} has {space.num_states:,} states; expected at most {limit:,}")
    if values is not None and key not in values:
        values[key] = TaskValues(task.reference, task.return_range)
    return task


def task_key(config: RunConfig) -> str:
    """A digest of what an entry is compared in: environment, chance, and the setting of values; 1 and 1.0 are one."""
    chance = {name: value for name, value in config.chance.to_dict().items() if value}
    task = [config.environment, config.parameters, chance, config.gamma, config.horizon]
    return storage.digest_of_json(_as_floats(storage.plain(task)))


def _as_floats(value: object) -> Any:
    if isinstance(value, dict):
        return {name: _as_floats(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_as_floats(item) for item in value]
    return float(value) + 0.0 if isinstance(value, int | float) else value  # 0.0, where it is -0.0


def _check_code(config: RunConfig, trust: bool) -> None:
    """Refuse whatever is not part of pharos; agents are looked at where they are made."""
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
