"""Submissions: curves and final policies in one file, which `verify` checks by computing regret again.

The file has the layout of an entry of the leaderboard (`leaderboard/entry.py`): a record as JSON, and arrays

    curve/TASK        (seeds, evaluations) float64, normalised regret
    policy/TASK/SEED  what the agent plays at the end: (S,) actions, or (S, A) probabilities, by state

with digests of all. Nothing in it is executed. `verify` solves each task and evaluates each policy: V*, the value of
uniform play and the last point of each curve hold or do not. All else is claimed: the points before cannot be seen from
policies, and an exact solver has the best policies without any learning.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark.agents import sha256
from pharos.benchmark.budget import Snapshots
from pharos.benchmark.results import AgentResults, entries_of
from pharos.benchmark.scores import check_suite
from pharos.benchmark.suite import BenchmarkTask, Suite
from pharos.errors import FileFormatError, PharosError
from pharos.leaderboard import Check, check_ending, in_file, read_sealed, stored_table, write_checked, write_sealed
from pharos.training import Task, check_agent, evaluate_agent, load_agent

FORMAT = 1
WHAT = "submission to a benchmark"
TOLERANCE = 1e-6
"""Of normalised regret: processors round sums of values in another way."""

Tell = Callable[[int, int, str], None]
"""tell(done, all, what is next)."""


@dataclass(frozen=True, eq=False)
class Submission:
    """A submission: curves, final policies, and the texts of its author.

    Attributes:
        results: curves of the agent. policies: (task, seed) -> final policy; those of some runs may be missing.
        author, note: texts to show.
    """

    results: AgentResults
    policies: Mapping[tuple[str, int], np.ndarray]
    author: str = ""
    note: str = ""

    def write(self, file: str | os.PathLike) -> None:
        """Write the submission to a file, replacing it atomically; the same submission gives the same bytes."""
        results = self.results
        record = {
            "format": FORMAT,
            "name": results.agent,
            "author": self.author,
            "note": self.note,
            "suite": results.suite,
            "suite_digest": results.digest,
            "seeds": list(results.seeds),
            "record": dict(results.record),
        }
        arrays = {f"curve/{task}": curve for task, curve in results.curves.items()}
        arrays |= {f"policy/{task}/{seed}": policy for (task, seed), policy in self.policies.items()}
        write_sealed(file, record, arrays, WHAT, follow=True)

    @staticmethod
    def read(file: str | os.PathLike) -> "Submission":
        """Read a submission that `write` wrote; executes nothing, and checks sizes against the file before allocating.

        Raises:
            ParameterError: there is no such file. FileFormatError: it is no submission.
            ResultCorrupted: it was changed.
        """
        record, arrays = read_sealed(Path(file), WHAT)
        return in_file(Path(file), lambda: _submission(record, arrays))


def _submission(record: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Submission:
    kinds = {"name": str, "author": str, "note": str, "suite": str, "suite_digest": str, "seeds": list, "record": dict}
    name, author, note, suite, digest, seeds, provenance = entries_of(record, kinds, WHAT)
    curves, policies = {}, {}
    for key, array in arrays.items():
        kind, *words = key.split("/")
        if kind == "curve" and len(words) == 1:
            curves[words[0]] = array
        elif kind == "policy" and len(words) == 2 and words[1] in map(str, seeds):
            policies[words[0], int(words[1])] = array
        else:
            raise FileFormatError(f"its array {key!r} is neither a curve nor a policy of one of its seeds")
    results = AgentResults(name, suite, digest, tuple(seeds), curves, provenance)
    if {task for task, _ in policies} - {*results.curves}:
        raise FileFormatError("it has policies of tasks without a curve")
    return Submission(results, policies, author, note)


def submit(
    folder: str | os.PathLike,
    file: str | os.PathLike,
    suite: Suite,
    *,
    author: str = "",
    note: str = "",
    trust: bool = False,
    progress: Tell | None = None,
) -> Submission:
    """Pack the results of a folder and the final policies of its runs into one file, which `verify` reads.

    Nothing is trained. A network is asked about every state once; policies that see more than the state have none.

    Args:
        folder: of `benchmark.run`.
        file: ends in .safetensors.
        suite: that the runs are of.
        trust: whether code that the run.json of a run names, the class of an agent, may be imported.
    Raises:
        ParameterError: the folder holds no results, or of another suite; a text cannot be printed.
        FileFormatError: a run is damaged, or its files are not the ones that its run.json has checksums of.
        UntrustedCode: a run names code, and is not trusted.
    """
    folder, target = Path(folder), check_ending(Path(file))
    results = AgentResults.read(folder)
    check_suite(results, suite, str(folder))
    policies: dict[tuple[str, int], np.ndarray] = {}
    runs = [(task, seed) for task in results.curves for seed in results.seeds]
    for place, (name, seed) in enumerate(runs):
        if progress is not None:
            progress(place, len(runs), name)
        task = suite.task(name).training_task(suite.protocol)
        policy = final_policy(folder / "runs" / name / f"seed-{seed}", task, trust=trust)
        if policy is not None:
            policies[name, seed] = policy
    submission = Submission(results, policies, author, note)
    return write_checked(target, lambda: submission.write(target), lambda: Submission.read(target))


def final_policy(run: Path, task: Task, *, trust: bool = False) -> np.ndarray | None:
    """Final policy of a finished run: (S,) actions or (S, A) probabilities.

    None if the policy sees more than the state, or the run kept none.

    Args:
        trust: whether code that its run.json names may be imported.
    Raises:
        ResultCorrupted: its files are not the ones that its run.json has checksums of.
        UntrustedCode: it names code, and is not trusted.
    """
    table: Any
    if (run / "run.json").exists():
        check_agent(run)
    if (run / "policy.npy").exists():
        table = stored_table(run)
    elif (run / "agent").is_dir():
        table = Snapshots(task).taken(load_agent(run, trust=trust)[1])
    else:
        return None
    if not isinstance(table, np.ndarray) or table.ndim > 2:
        return None
    if table.ndim == 2 and ((table == 0) | (table == 1)).all():
        table = table.argmax(axis=1)
    return table.astype(np.float64) if table.ndim == 2 else table.astype(np.min_scalar_type(int(table.max(initial=0))))


@dataclass(frozen=True, eq=False)
class SubmissionVerdict:
    """Result of verifying a submission.

    Attributes:
        file, submission: what was verified. sha256: of the file.
        checks: normalised regret of each policy beside the last point of its curve; their names are TASK/SEED.
        missing: runs without a policy, of which nothing was computed: all that is said of them is claimed.
        final: score of the core that the policies have at the end, computed: 1 less normalised regret, clipped to
            [0, 1], mean over the seeds of a task, then over tasks; a run without a policy counts as 0.
        refused: name of a task or run -> why its policy is none.
    """

    file: Path
    submission: Submission
    sha256: str
    checks: tuple[Check, ...]
    missing: tuple[str, ...]
    final: float
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def wrong(self) -> tuple[Check, ...]:
        """Checks that do not hold."""
        return tuple(check for check in self.checks if not check.holds)

    @property
    def holds(self) -> bool:
        """Whether all that can be computed is as claimed; the rest stays claimed."""
        return not self.refused and not self.wrong


def verify(
    file: str | os.PathLike, suite: Suite, *, tolerance: float = TOLERANCE, progress: Tell | None = None
) -> SubmissionVerdict:
    """Solve the tasks of a submission, and evaluate its final policies again.

    Of the file only numbers and names are used. What cannot be true of a curve is refused too: a policy better than the
    optimal one.

    Args:
        suite: that it is of; its tasks are the ones on this installation, not those of the file.
        tolerance: of normalised regret.
    Raises:
        ParameterError: there is no such file, or it is of another suite, or a task is another one on this installation.
        FileFormatError: it is no submission. ResultCorrupted: it was cut short or changed.
    Cost: as solving each task, and evaluating each policy.
    """
    path = Path(file)
    submission = Submission.read(path)
    results = submission.results
    check_suite(results, suite, str(path))
    checks, missing, refused = [], [], {}
    for place, (name, curve) in enumerate(results.curves.items()):
        if progress is not None:
            progress(place, len(results.curves), name)
        entry = suite.task(name)
        task = entry.check(suite.protocol)
        if curve.min() < -tolerance:
            refused[name] = f"its normalised regret is {curve.min():.6g}, better than the optimal policy"
        for seed, claimed in zip(results.seeds, curve[:, -1], strict=True):
            run, policy = f"{name}/{seed}", submission.policies.get((name, seed))
            if policy is None:
                missing.append(run)
                continue
            try:
                computed = _regret(policy, task, entry)
            except PharosError as error:
                refused[run] = str(error)
                continue
            checks.append(Check(run, float(claimed), computed, tolerance))
    scores = {check.name: 1.0 - min(max(check.found, 0.0), 1.0) for check in checks}
    runs = [scores.get(f"{task.name}/{seed}", 0.0) for task in suite.core for seed in results.seeds]
    final = sum(runs) / max(1, len(runs))
    return SubmissionVerdict(path, submission, sha256(path), tuple(checks), tuple(missing), final, refused)


def _regret(policy: np.ndarray, task: Task, entry: BenchmarkTask) -> float:
    """Normalised regret of a table."""
    states, actions = task.mdp.num_states, task.mdp.num_actions
    is_choice = policy.shape == (states,) and policy.dtype.kind in "iu"
    if not is_choice and not (policy.shape == (states, actions) and policy.dtype.kind == "f"):
        raise FileFormatError(
            f"its policy has shape {policy.shape} and type {policy.dtype}; expected ({states},) actions or ({states}, "
            f"{actions}) probabilities"
        )
    if is_choice and states and not (int(policy.min()) >= 0 and int(policy.max()) < actions):
        raise FileFormatError(f"its policy names an action beyond 0 to {actions - 1}")
    value = evaluate_agent(policy.astype(np.int64 if is_choice else np.float64), task, max_states=states).value
    return (entry.value_optimal - value) / (entry.value_optimal - entry.value_uniform)
