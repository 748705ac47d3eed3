"""Training of one group: runs that fit together learn under one loop, with the exact value of each policy at chosen
steps.

    FOLDER/                      of each run: run.json, curve.csv, and what was learnt
    FOLDER/checkpoint/           of a run that learns alone, while it is trained
    CHECKPOINTS/BATCH/           of runs that learn together: all of them, their configurations and curves

A run alone is a batch of one. A run does not depend on who else is in its batch, so nothing does on how runs are
grouped, and what was killed goes on from its last checkpoint to the bytes that it gives undisturbed. What is finished
is not trained again. A run that fails is said to have failed, and the others go on.
"""

import contextlib
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pharos.agents import Learner, agent_called, is_known
from pharos.errors import FileFormatError, FolderLocked, ParameterError, PharosError
from pharos.policies import PolicyLike
from pharos.system import compiling
from pharos.system.sources import is_reference
from pharos.system.storage import digest_of_json, inside, is_full, lock, read_json, remove_leftovers, replace_json
from pharos.system.wording import in_one_line
from pharos.training import functions  # noqa: F401  (who trains functions)
from pharos.training import results as _results
from pharos.training.curve import Evaluation, joint_values
from pharos.training.evaluators import Evaluators, NetworkLearner, evaluates_apart
from pharos.training.results import Checkpoint, TrainingResult, clear_run, finished_result
from pharos.training.schedule import FailedRun, PreparedRun, lanes
from pharos.training.task import RunConfig

Values = dict[int, Evaluation | PharosError]
Counts = tuple[int, np.ndarray, np.ndarray]
"""Steps of each run, and finished episodes and their returns by run."""
ReportCallback = Callable[[tuple[Any, ...]], object]
"""report(("rows", steps so far of the runs that are trained now, {index: row})), report(("end", index, result)), or
report(("halve", indices, why they cannot be trained together))."""


class CallbackError(BaseException):
    """An error of the caller's own progress function, which is not one of a run."""


def train_group(
    runs: Sequence[PreparedRun],
    checkpoints: Path | None,
    report: ReportCallback,
    *,
    lane: int | None = None,
    is_single: bool = False,
    raises: bool = False,
    tensorboard: bool = False,
) -> None:
    """Train runs in this process: those with equal keys as one program, one program after the other.

    Args:
        runs: none of which was trained before, each with its index.
        checkpoints: folder for checkpoints of programs. None: none are written.
        report: called with each evaluation and each end.
        lane: the most runs in a program. Default: all that fit together.
        is_single: whether the run is the only one of its call.
        raises: whether errors of runs are raised, and not written down if the run cannot begin.
        tensorboard: whether TensorBoard's logs are written into the folder of a run.
    """
    # Finished runs need no training; others train alone or wait for a program
    waiting: list[PreparedRun] = []
    finished: set[str] = set()
    for run in runs:
        try:
            done = None if run.folder is None else finished_result(run.folder, run.config)
        except (ParameterError, FileFormatError) as error:
            _refuse(run, error, report, raises)
            continue
        if done is not None and run.folder is not None:
            clear_run(run.folder)
            finished.add(run.id)
            report(("end", run.index, done))
            continue
        try:
            run.prepare(is_single=is_single or (run.folder is not None and (run.folder / "checkpoint").exists()))
        except Exception as error:
            _refuse(run, error, report, raises)
            continue
        waiting.append(run)
    # Runs alone, programs of checkpoints, and the rest by what fits together
    programs = [[run] for run in waiting if run.is_alone]
    joint = {run.index: run for run in waiting if not run.is_alone}
    programs += _stored_programs(runs, joint, finished, checkpoints)
    rest = list(joint.values())
    programs += [[rest[i] for i in each] for each in lanes([run.key for run in rest], [lane or len(rest)] * len(rest))]
    for program in programs:
        Program(program, checkpoints, report, raises=raises, tensorboard=tensorboard).train()


def _refuse(run: PreparedRun, error: Exception, report: ReportCallback, raises: bool) -> None:
    """Raise the error of a run that could not begin if `raises` is set, else write it down and report it."""
    if raises:
        raise error
    if run.folder is not None and not (run.folder / _results.RECORD).exists():
        run.folder.mkdir(parents=True, exist_ok=True)
        run.hyperparameters = dict(run.config.hyperparameters)
        run.write("failed", error=in_one_line(error))
    report(("end", run.index, FailedRun(run.config.to_dict(), run.folder, error)))


def remove_batch(folder: Path) -> None:
    """Remove the checkpoint of a program, and last what says which runs these are: a kill leaves what can be told."""
    clear_run(folder)
    shutil.rmtree(folder, ignore_errors=True)


def _stored_programs(
    runs: Sequence[PreparedRun], waiting: dict[int | None, PreparedRun], finished: set[str], checkpoints: Path | None
) -> Iterator[list[PreparedRun]]:
    """Yield programs of checkpoints, with the runs that they had, which are taken from `waiting`."""
    by_id = {run.id: index for index, run in waiting.items()}
    for folder in [] if checkpoints is None else sorted(checkpoints.glob("*")):
        try:
            configs = [RunConfig.from_dict(entry) for entry in read_json(folder / "batch.json")["configs"]]
        except (OSError, ValueError, KeyError, TypeError, PharosError):
            continue
        if not any(config.id in by_id for config in configs):
            if finished.issuperset(config.id for config in configs):  # it was killed before it removed this
                remove_batch(folder)
            continue
        if any(config.id not in by_id and _is_foreign(config, runs) for config in configs):
            continue
        program = [
            waiting[by_id[config.id]] if config.id in by_id else PreparedRun(None, config, None, runs[0].tasks)
            for config in configs
        ]
        try:
            for run in program:
                run.prepare()
        except Exception:  # what is wrong with a run is said later, when it fails alone
            continue
        for config in configs:
            if config.id in by_id:
                del waiting[by_id.pop(config.id)]
        yield program


def _is_foreign(config: RunConfig, runs: Sequence[PreparedRun]) -> bool:
    """Whether a run of a checkpoint, which somebody else may have written, names code that no run here names."""
    names = {"environment": config.environment, "observation": config.observation}
    if not is_known(config.agent):
        names["agent"] = config.agent
    has_no_source = any(is_reference(name) and part not in config.sources for part, name in names.items())
    ours = [item for each in runs for item in each.config.sources.items()]
    return has_no_source or any(item not in ours for item in config.sources.items())


class Program:
    """Runs under one loop: trained, evaluated, resumed, and brought into their folders. Arguments are the same as for
    `train_group`."""

    learner: Learner  # from when the runs begin; gone if they failed
    evaluators: Evaluators | None = None  # if policies are evaluated apart
    pending: Counts | None = None  # of the policies that are evaluated apart

    def __init__(
        self,
        runs: list[PreparedRun],
        checkpoints: Path | None,
        report: ReportCallback,
        *,
        raises: bool,
        tensorboard: bool,
    ):
        self.runs, self.config, self.is_alone = runs, runs[0].config, runs[0].is_alone
        self.checkpoints, self.report, self.raises, self.tensorboard = checkpoints, report, raises, tensorboard
        self.has_begun = self.holds = False  # whether runs are marked as running; whether checkpoints are this batch's
        self.held = contextlib.ExitStack()  # the folder of checkpoints, or the folder of a run alone

    def train(self) -> None:
        """Train the runs, and report what becomes of them."""
        with self.held:
            try:
                self._train()
                return
            except CallbackError as stop:
                (cause,) = stop.args
                if self.raises and self.is_alone and isinstance(cause, Exception):
                    self.runs[0].fail(cause)
                raise
            except Exception as error:
                if is_full(error):  # which is no fault of these runs, and fewer at once need as much
                    raise
                failure = error
                vars(self).pop("learner", None)
                self._remove_checkpoint()
        if len(self.runs) == 1:
            self._fail(failure)
            return
        reason = "out of memory" if _is_memory(failure) else in_one_line(failure)
        self.report(("halve", [run.index for run in self.runs if run.index is not None], reason))

    def _train(self) -> None:
        began, compiled = time.perf_counter(), compiling.seconds()
        first = self.runs[0]
        if self.is_alone and self._is_finished():
            return
        logs = first.folder / "tensorboard" if self.tensorboard and first.folder is not None else None
        self.learner = agent_called(self.config.agent).learner(self.runs, first.tasks.device, logs)
        if isinstance(self.learner, NetworkLearner) and evaluates_apart(first.tasks.device, self.runs):
            self.evaluators = Evaluators(self.learner, self.runs)
            self.held.enter_context(self.evaluators.workers)
        checkpoint = self._checkpoint()
        if checkpoint is not None:
            entries, spent = checkpoint.restore(self.learner) or ([], 0.0)
            if self.is_alone:
                first.curve.rows = entries
            else:
                for run, entry in zip(self.runs, entries, strict=False):
                    run.curve.rows = entry["rows"]
                    run.error = None if entry["error"] is None else PharosError(entry["error"])
            began -= spent
        for run in self.runs:
            if run.folder is not None:
                run.folder.mkdir(parents=True, exist_ok=True)
            run.write("running")
        self.has_begun = True
        self._learn(checkpoint, began)
        self._publish(time.perf_counter() - began, compiling.seconds() - compiled)

    # Files -----------------------------------------------------------------------------------------------------------

    @property
    def _folder(self) -> Path | None:
        """The folder for checkpoints of a batch. None for a run alone, or if none are written."""
        if self.is_alone or self.checkpoints is None:
            return None
        return self.checkpoints / digest_of_json([run.id for run in self.runs])[:16]

    def _is_finished(self) -> bool:
        """Lock the folder of a run alone. Return whether another process has finished it meanwhile."""
        folder, index = self.runs[0].folder, self.runs[0].index
        if folder is None or index is None:
            return False
        folder.mkdir(parents=True, exist_ok=True)
        self.held.enter_context(lock(folder, FolderLocked, "training"))
        remove_leftovers(folder / "regret.png")  # of a killed process; leftovers of other files go with the next one
        done = finished_result(folder, self.config)
        if done is not None:
            clear_run(folder)
            self.report(("end", index, done))
        return done is not None

    def _checkpoint(self) -> Checkpoint | None:
        """The checkpoint of the group. None if it has no folder, if it cannot be resumed, or if another process trains
        the same batch.
        """
        if not hasattr(self.learner, "save"):
            return None
        if self.is_alone:
            folder = self.runs[0].folder
            return None if folder is None else Checkpoint(folder / "checkpoint", self.config.id)
        folder = self._folder
        if folder is None:
            return None
        inside(folder.parent, folder.name).mkdir(parents=True, exist_ok=True)
        try:
            self.held.enter_context(lock(folder, FolderLocked, "training"))
        except FolderLocked:
            return None
        configs = [run.config for run in self.runs]
        entry = {"ids": [each.id for each in configs], "configs": [each.to_dict() for each in configs]}
        replace_json(folder / "batch.json", entry)
        self.holds = True
        return Checkpoint(folder / "checkpoint", folder.name)

    def _remove_checkpoint(self) -> None:
        if self.holds and self._folder is not None:
            remove_batch(self._folder)

    # Learning --------------------------------------------------------------------------------------------------------

    def _learn(self, checkpoint: Checkpoint | None, began: float) -> None:
        """Train from the last row of the curves on, with an evaluation at each point."""
        steps, interval = self.config.steps, self.config.evaluation_interval
        if not any(run.curve.rows for run in self.runs):
            self._evaluate(0)
        # Steps of the evaluations to come, after the steps of a checkpoint
        start = max((run.curve.rows[-1]["step"] for run in self.runs if run.curve.rows), default=0)
        points = [point for point in [*range(interval, steps, interval), steps] if point > start]

        def save(step: int) -> None:
            if checkpoint is None or step == steps:
                return
            checkpoint.save(self.learner, self._curves, time.perf_counter() - began)

        def at_point(step: int) -> Mapping[str, Any] | None:
            rows = self._evaluate(step)
            if not self.is_alone:
                save(step)
            if self.evaluators is None:
                self._report(step, rows)
            if self.is_alone:
                save(step)
            return rows.get(0)

        if points:
            self.learner.learn(points, at_point)
        self._await_values()

    def _curves(self) -> list[Any]:
        """The curves so far, as a checkpoint has them."""
        self._await_values()
        if self.is_alone:
            return self.runs[0].curve.rows
        return [{"rows": run.curve.rows, "error": run.error and in_one_line(run.error)} for run in self.runs]

    def _report(self, step: int, rows: Mapping[int, Mapping[str, Any]]) -> None:
        by_index = {index: row for i, row in rows.items() if (index := self.runs[i].index) is not None}
        self.report(("rows", step * sum(run.index is not None for run in self.runs), by_index))

    def _evaluate(self, step: int) -> dict[int, dict[str, Any]]:
        """Evaluate the policies, or let them be evaluated: rows by index in the group, as far as they are there."""
        counts = step, np.array(self.learner.episodes), np.array(self.learner.returns)
        if self.evaluators is not None:
            self._await_values()
            self.evaluators.begin()
            self.pending = counts
            return {}
        policies: list[PolicyLike | Evaluation] = [self.learner.policy(i) for i in range(len(self.runs))]
        values: Values = {i: policy for i, policy in enumerate(policies) if isinstance(policy, Evaluation)}
        if not self.is_alone and not values:
            values |= joint_values(self.learner, self.runs)
        return self._add(counts, values, policies)

    def _await_values(self) -> None:
        """Add the rows of the policies that are being evaluated apart, and report them."""
        if self.evaluators is None or self.pending is None:
            return
        counts, self.pending = self.pending, None
        rows = self._add(counts, self.evaluators.values())
        if counts[0]:
            self._report(counts[0], rows)

    def _add(
        self, counts: Counts, values: Values, policies: Sequence[PolicyLike | Evaluation] = ()
    ) -> dict[int, dict[str, Any]]:
        """Add a row to the curve of each run that has not failed. Return the rows by the index of the run in the
        group."""
        rows: dict[int, dict[str, Any]] = {}
        step, episodes, returns = counts
        for i, run in enumerate(self.runs):
            if run.error is not None:
                continue
            try:
                value = values.get(i)
                if isinstance(value, PharosError):
                    raise value
                policy = policies[i] if policies else None
                rows[i] = run.curve.add(step, int(episodes[i]), float(returns[i]), policy, value)
            except Exception as error:
                run.fail(error)
        if all(run.error is not None for run in self.runs):
            raise self.runs[0].error or PharosError("no run is left")
        return rows

    def _publish(self, seconds: float, compiled: float) -> None:
        """Write and keep the result of each run. Its seconds are its share of the seconds of the batch."""
        size = {"runs": len(self.runs), "seconds": seconds, "device": self.runs[0].tasks.device}
        share = seconds - compiled if self.is_alone else seconds / len(self.runs)
        entries: dict[str, Any] = {"compiling_seconds": compiled} if self.is_alone else {"batch": size}
        notes: dict[str, str] = getattr(self.learner, "notes", dict)()
        if notes:
            entries["notes"] = notes
        for i, run in enumerate(self.runs):
            if run.index is None:
                continue
            config, folder, curve = run.config.to_dict(), run.folder, run.curve.rows
            if run.error is not None:
                self.report(("end", run.index, FailedRun(config, folder, run.error)))
                continue
            result = run.curve.result()
            if folder is not None:
                self.learner.publish(i, folder)
                _results.write_curve(folder, curve)
                run.write("finished", seconds=share, **entries, result=result)
            rows = [{name: row[name] for name in _results.ALL_COLUMNS if name in row} for row in curve]
            policy = self.learner.policy(i)
            learnt = None if isinstance(policy, Evaluation) else policy
            end = TrainingResult(config, result, rows, learnt, folder, share, notes)
            self.report(("end", run.index, end))
        self._remove_checkpoint()
        if self.is_alone and (folder := self.runs[0].folder) is not None:
            clear_run(folder)

    def _fail(self, error: Exception) -> None:
        """Record that the only run of the group has failed."""
        (run,) = self.runs
        if run.index is None:
            return
        if self.is_alone and not self.has_begun:
            _refuse(run, error, self.report, self.raises)
            return
        if run.error is None:
            run.fail(error)
        if self.raises:
            raise error
        self.report(("end", run.index, FailedRun(run.config.to_dict(), run.folder, error)))


def _is_memory(error: BaseException) -> bool:
    """Whether memory was not enough, in the words of Python, torch on the processor, or torch on a GPU."""
    words = str(error).lower()
    return isinstance(error, MemoryError) or "out of memory" in words or "can't allocate memory" in words
