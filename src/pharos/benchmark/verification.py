"""One verifier: values and regret of the policies in a file, computed again from the rules, beside what it claims.

A file has the run of one task, whose setting it names (`entry.py`), or runs of a suite (`submission.py`). Of both, only
numbers and names are used.
"""

import contextlib
import errno
import math
import os
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark.agents import sha256
from pharos.benchmark.entry import Claim, Entry
from pharos.benchmark.entry_policy import checked_table, policy_of, task_of
from pharos.benchmark.limits import Limits
from pharos.benchmark.scores import check_suite
from pharos.benchmark.submission import ProgressCallback, Submission, read
from pharos.benchmark.suite import BenchmarkTask, Suite, load_suite
from pharos.errors import FileFormatError, ParameterError, StateSpaceTooLarge, TimeLimit, UntrustedCode
from pharos.policies import Evaluation
from pharos.system.interrupts import time_limit
from pharos.system.memory import available_memory
from pharos.system.records import takes
from pharos.system.sealed import LONGEST_TEXT
from pharos.training import ReferenceValues, Task, TaskValues, evaluate_agent, regret

SHARE_OF_MEMORY = 0.9
SEED = 1
"""Of estimates; another one than that of runs, so that an estimate is not compared with itself."""


@dataclass(frozen=True)
class Check:
    """A claimed number beside the computed one.

    Attributes:
        name: of an entry "value", "regret", "value_optimal" or "value_uniform". Of a suite: TASK/SEED.
        claimed, found: the two numbers, for a suite normalised regrets.
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Verdict:
    """Result of verifying a file.

    Attributes:
        file: it. sha256: of it.
        checks: claimed numbers beside computed ones.
        refused: name of a claim, task or run -> why it cannot be true, whatever was computed.
        missing: runs without a policy, of which nothing was computed: all that is said of them is claimed.
        final: final score, computed from the policies: 1 less normalised regret, clipped to [0, 1]. Of a suite the mean
            over the seeds of a task, then over the tasks of the core, and a run without a policy counts as 0.
    """

    file: Path
    sha256: str
    checks: tuple[Check, ...]
    refused: Mapping[str, str]
    missing: tuple[str, ...] = ()
    final: float

    @property
    def wrong(self) -> tuple[Check, ...]:
        """Checks that do not hold."""
        return tuple(check for check in self.checks if not check.holds)

    @property
    def holds(self) -> bool:
        """Whether all that can be computed is as claimed, and possible. The rest stays claimed."""
        return not self.refused and not self.wrong

    @property
    def reasons(self) -> str:
        """Why it does not hold, in one line."""
        wrong = [f"{each.name}: {each.found:.8g} computed, {each.claimed:.8g} claimed" for each in self.wrong]
        return "; ".join((*wrong, *(f"{name}: {reason}" for name, reason in self.refused.items())))


@dataclass(frozen=True, eq=False, kw_only=True)
class SubmissionVerdict(Verdict):
    """Result of verifying runs of a suite.

    Attributes:
        submission: what was verified. suite: of its runs.
    """

    submission: Submission
    suite: Suite


@dataclass(frozen=True, eq=False, kw_only=True)
class EntryVerdict(Verdict):
    """Result of verifying the run of one task.

    Attributes:
        entry: what was verified.
        value, regret: of the policy, as they were computed.
        normalized_regret: regret / (V* - U), or NaN if V* = U.
        value_optimal, value_uniform: V* and U, computed.
        exact: whether the value is computed. If not, it is estimated from episodes.
        error_bound: how far the value may be off. For an estimate, half the width of a 99 % interval.
        states: in which the policy was asked. episodes: behind an estimate.
    """

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


@takes(Limits)
def verify(
    file: str | os.PathLike,
    suite: Suite | Sequence[Suite] | None = None,
    *,
    trust: bool = False,
    values: MutableMapping[str, TaskValues] | None = None,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> EntryVerdict | SubmissionVerdict:
    """Compute values and regret of the policies in a file again, and compare them with its claims.

    The states of each task are enumerated from pharos' own rules, solved, and the policy is evaluated on them. Of the
    file only numbers and names are used.

    Of one task a claim holds if its interval (its error bound) and the computed one meet, if it is not above V*, and if
    its interval is narrower than V* - U. A value that can only be estimated is estimated from other episodes than the
    run's own. Of a suite the last point of each curve holds or does not. A curve that is better than the optimal policy
    is refused.

    Args:
        suite: of runs of a suite, or several that it may be. Default: v1. Its tasks are the ones on this
            installation, not the tasks in the file.
        trust: whether code that an entry names may be imported: an environment, observation or agent that is no part
            of pharos or Stable-Baselines3. It comes from this machine, as no file holds any.
        values: filled with the values of each task of an entry, for the entries that follow.
        progress: called with tasks done, tasks in all, and the next one.
        options: of `Limits`. Beyond max_states, max_horizon or max_seconds a task is refused. If the policy of an entry
            reaches more than max_reached states, its value is estimated.
    Raises:
        ParameterError: there is no such file, it is of another suite, or a task of the suite is another one on this
            installation. FileFormatError: it is no submission, or not one of this version of the rules.
        ResultCorrupted: it was cut short or changed. UntrustedCode: it names code, and is not trusted.
        StateSpaceTooLarge: it has more states. TimeLimit: a task takes longer.
    Cost: as solving each task, and evaluating each policy.
    """
    path, limits = Path(file), Limits(**options)
    content = read(path)
    if isinstance(content, Entry):
        return _verify_entry(path, content, limits, trust, values)
    suites = [suite] if isinstance(suite, Suite) else suite or [load_suite()]
    own = next((each for each in suites if each.digest == content.results.digest), suites[0])
    check_suite(content.results, own, str(path))
    return _verify_submission(path, content, own, limits, progress)


def _final(normalized_regret: float) -> float:
    return 1.0 - min(max(normalized_regret, 0.0), 1.0)


# One task -------------------------------------------------------------------------------------------------------------


def _verify_entry(
    path: Path, entry: Entry, limits: Limits, trust: bool, values: MutableMapping[str, TaskValues] | None
) -> EntryVerdict:
    for name, steps in (("horizon", entry.config.horizon or 0), ("reward_delay", entry.config.chance.reward_delay)):
        if steps > limits.max_horizon:
            raise FileFormatError(f"{path}: its {name} is {steps:,} steps; expected at most {limits.max_horizon:,}")
    # Value of the policy and reference values, computed again within limits of time and memory
    try:
        with time_limit(limits.max_seconds, TimeLimit), _memory_limit():
            task = task_of(entry, trust, limits.max_states, values)
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
    claim, spread = entry.claim, reference.spread()
    spread = spread if math.isfinite(spread) else float(np.ptp(range_of_returns))
    loss, normalized = (regret(evaluation.value, reference, normalized_by=each) for each in (None, "uniform"))
    slack = limits.tolerance * max(1.0, abs(reference.optimal)) + reference.error_bound
    bound = min(claim.error_bound, slack) if claim.exact else claim.error_bound
    apart = slack + evaluation.error_bound + bound
    return EntryVerdict(
        file=path,
        sha256=sha256(path),
        checks=(
            Check("value", claim.value, evaluation.value, apart),
            Check("regret", claim.regret, loss, apart + slack),
            Check("value_optimal", claim.value_optimal, reference.optimal, slack),
            Check("value_uniform", claim.value_uniform, reference.uniform, slack),
        ),
        refused=_objections(claim, evaluation, reference, spread, slack),
        final=_final(normalized),
        entry=entry,
        regret=loss,
        normalized_regret=normalized,
        value_optimal=reference.optimal,
        value_uniform=reference.uniform,
        **{name: value for name, value in vars(evaluation).items() if name != "gain"},
    )


def _objections(
    claim: Claim, evaluation: Evaluation, reference: ReferenceValues, spread: float, slack: float
) -> dict[str, str]:
    """Parts of a claim that cannot be true, and why."""
    objections = {}
    bound = min(claim.error_bound, slack) if claim.exact else claim.error_bound
    if claim.value - bound > reference.optimal + slack:
        objections["value"] = (
            f"the value claimed, {claim.value:.8g}, is above that of the optimal policy, {reference.optimal:.8g}"
        )
    if claim.error_bound > spread + slack:
        objections["error_bound"] = (
            f"the error bound claimed, {claim.error_bound:.3g}, is larger than the values of policies are apart, "
            f"{spread:.3g}"
        )
    if claim.exact and not evaluation.exact:
        objections["exact"] = (
            f"the value is claimed to be exact, and is an estimate here (± {evaluation.error_bound:.2g})"
        )
    return objections


# A suite --------------------------------------------------------------------------------------------------------------


def _verify_submission(
    path: Path, submission: Submission, suite: Suite, limits: Limits, progress: ProgressCallback | None
) -> SubmissionVerdict:
    results = submission.results
    checks, missing, refused = [], [], {}
    for done, (name, curve) in enumerate(results.curves.items()):
        if progress is not None:
            progress(done, len(results.curves), name)
        if curve.min() < -limits.tolerance:
            refused[name] = f"its normalised regret is {curve.min():.6g}, better than the optimal policy"
        entry = suite.task(name)
        try:
            with time_limit(limits.max_seconds, TimeLimit), _memory_limit():
                task = entry.check(suite.protocol)
                for seed, claimed in zip(results.seeds, curve[:, -1], strict=True):
                    run, policy = f"{name}/{seed}", submission.policies.get((name, seed))
                    if policy is None:
                        missing.append(run)
                        continue
                    try:
                        checks.append(Check(run, float(claimed), _regret(policy, task, entry), limits.tolerance))
                    except (FileFormatError, ParameterError) as error:
                        refused[run] = str(error)
        except TimeLimit as error:
            raise TimeLimit(f"{path}: task {name} {error}") from None
    scores = {check.name: _final(check.found) for check in checks}
    runs = [scores.get(f"{task.name}/{seed}", 0.0) for task in suite.core for seed in results.seeds]
    return SubmissionVerdict(
        file=path,
        sha256=sha256(path),
        checks=tuple(checks),
        refused=refused,
        missing=tuple(missing),
        final=sum(runs) / max(1, len(runs)),
        submission=submission,
        suite=suite,
    )


def _regret(policy: np.ndarray, task: Task, entry: BenchmarkTask) -> float:
    """Normalised regret of a table."""
    table = checked_table(policy, (task.mdp.num_states, task.mdp.num_actions))
    value = evaluate_agent(table, task, max_states=task.mdp.num_states).value
    return (entry.value_optimal - value) / (entry.value_optimal - entry.value_uniform)


# Limits of memory -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _memory_limit() -> Iterator[None]:
    """Raise MemoryError if the block requests more memory than is free, before the system kills the process.

    On Linux, by RLIMIT_DATA of the whole process. Elsewhere there is no limit.
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
