"""Submissions: what an agent has learnt and what it claims, in one file, which `verify` checks by computing it again.

`submit` packs the folder of one training run (`entry.py`) or of runs of a suite. A file has the layout of
`system/sealed.py`. The arrays of a suite's runs are

    curve/TASK        (seeds, evaluations) float64, normalised regret
    policy/TASK/SEED  what the agent plays at the end: (S,) actions, or (S, A) probabilities, by state

Nothing in a file is executed. V*, the value of uniform play and the last point of each curve hold or do not. All else
is claimed: the points before cannot be seen from policies, and an exact solver has the best policies without any
learning.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark.entry import ENTRY_KIND, Entry, stored_table
from pharos.benchmark.results import AgentResults, entries_of
from pharos.benchmark.scores import check_suite
from pharos.benchmark.suite import Suite, load_suite
from pharos.errors import FileFormatError, ParameterError
from pharos.system.sealed import SUFFIX, read_sealed, write_sealed
from pharos.training import Snapshots, Task, check_agent_files, load_agent

ProgressCallback = Callable[[int, int, str], None]
"""Called with how many are done, how many there are, and the next one."""


@dataclass(frozen=True, eq=False)
class Submission:
    """A submission: curves, final policies, and the texts of its author.

    Attributes:
        results: curves of the agent. policies: (task, seed) -> final policy. Policies of some runs may be missing.
        author, note: texts to show.
    """

    results: AgentResults
    policies: Mapping[tuple[str, int], np.ndarray]
    author: str = ""
    note: str = ""

    def write(self, file: str | os.PathLike) -> None:
        """Write the submission to a file, replacing it atomically. The same submission gives the same bytes."""
        results = self.results
        record = {
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
        write_sealed(file, record, arrays, ENTRY_KIND, follow=True)

    @staticmethod
    def read(file: str | os.PathLike) -> "Submission":
        """Read runs of a suite. Errors are those of `pharos.benchmark.read`, also for the run of one task."""
        return read_sealed(file, ENTRY_KIND, Submission.of_record)

    @staticmethod
    def of_record(record: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Submission":
        """Submission of the record and the arrays of a file. FileFormatError or ValueError if they are damaged."""
        kinds = {"name": str, "author": str, "note": str, "suite": str, "suite_digest": str, "seeds": list}
        values = entries_of(record, {**kinds, "record": dict}, ENTRY_KIND)
        name, author, note, suite, digest, seeds, provenance = values
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

    @staticmethod
    def of_folder(
        folder: Path, suite: Suite, *, trust: bool = False, progress: ProgressCallback | None = None
    ) -> "Submission":
        """Results in the folder of `benchmark.run` and the final policies of its runs. Errors are the same as for
        `submit`."""
        results = AgentResults.read(folder)
        check_suite(results, suite, str(folder))
        if large := [task for task in suite.tasks if task.stored and task.name in results.curves]:
            raise ParameterError(
                f"{folder}: {large[0].name} has {int(large[0].stored['states']):,} states, so its policies fit in no "
                f"file; expected runs of another suite: publish its results.safetensors, and the agent's code"
            )
        policies: dict[tuple[str, int], np.ndarray] = {}
        runs = [(task, seed) for task in results.curves for seed in results.seeds]
        for done, (name, seed) in enumerate(runs):
            if progress is not None:
                progress(done, len(runs), name)
            task = suite.task(name).training_task(suite.protocol)
            policy = final_policy(folder / "runs" / name / f"seed-{seed}", task, trust=trust)
            if policy is not None:
                policies[name, seed] = policy
        return Submission(results, policies)


def read(file: str | os.PathLike) -> Entry | Submission:
    """Read a submission: the run of one task, or runs of a suite.

    Nothing is executed, and nothing is allocated before sizes in the file were compared with the size of the file.

    Raises:
        ParameterError: there is no such file. FileFormatError: it is no submission, or of another format.
        ResultCorrupted: it was cut short, or changed after it was written.
    """

    def content(record: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Entry | Submission:
        return (Submission if "suite" in record else Entry).of_record(record, arrays)

    return read_sealed(file, ENTRY_KIND, content)


def submit(
    folder: str | os.PathLike,
    file: str | os.PathLike | None = None,
    suite: Suite | None = None,
    *,
    name: str = "",
    author: str = "",
    note: str = "",
    trust: bool = False,
    progress: ProgressCallback | None = None,
) -> Path:
    """Pack what a finished run, or the runs of a suite, have learnt and claim into one file, and return the file.

    Nothing is trained: values and regret come from the runs' evaluations. The same folder and texts give the same
    bytes. A network of a suite is asked about every state once. Policies that see more than the state have no table.

    Args:
        folder: of a run, or of `benchmark.run`.
        file: ends in .safetensors. Default: ID.safetensors in the current directory, with the id of the run or the name
            of the folder of a suite's runs.
        suite: that the runs are of. Default: v1. Not needed for one run.
        name: label. Default: the agent's.
        author, note: texts to show beside it.
        trust: whether code that the run.json of a suite's run names, the class of an agent, may be imported.
    Raises:
        ParameterError: the folder holds no results, or results of another suite. Or the environment of a run is an
            imported MDP, which others do not have, or a text cannot be printed.
        FileFormatError: a run is damaged or not finished. ResultCorrupted: files are not the ones that its run.json has
            checksums of. UntrustedCode: a run names code, and is not trusted.
        MissingExtra: a run is of a network, and PyTorch is not installed.
    """
    folder = Path(folder)
    target = None if file is None else _checked_ending(Path(file))
    content: Entry | Submission
    if (folder / "run.json").exists():
        content = Entry.of_run(folder, name=name, author=author, note=note)
        target = target or Path(f"{content.id}{SUFFIX}")
    else:
        packed = Submission.of_folder(folder, load_suite() if suite is None else suite, trust=trust, progress=progress)
        results = replace(packed.results, agent=name or packed.results.agent)
        content = replace(packed, results=results, author=author, note=note)
        target = target or Path(f"{folder.absolute().name}{SUFFIX}")
    target.parent.mkdir(parents=True, exist_ok=True)
    content.write(target)
    try:
        read(target)
    except FileFormatError as error:  # of a text
        target.unlink()
        raise ParameterError(str(error)) from None
    return target


def _checked_ending(target: Path) -> Path:
    if target.suffix.lower() != SUFFIX:
        raise ParameterError(f"{target}: expected a file name that ends in {SUFFIX}")
    return target


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
        check_agent_files(run)
    if (run / "policy.npy").exists():
        table = stored_table(run)
    elif (run / "agent").is_dir():
        table = Snapshots(task).evaluate(load_agent(run, trust=trust)[1])
    else:
        return None
    if not isinstance(table, np.ndarray) or table.ndim > 2:
        return None
    if table.ndim == 2 and ((table == 0) | (table == 1)).all():
        table = table.argmax(axis=1)
    return table.astype(np.float64) if table.ndim == 2 else table.astype(np.min_scalar_type(int(table.max(initial=0))))
