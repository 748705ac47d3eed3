"""Training: runs that fit together learn under one loop, with the exact value of each policy at chosen steps.

    FOLDER/                      of each run: run.json, curve.csv, and what was learnt
    FOLDER/checkpoint/           of a run that learns alone, while it is trained
    CHECKPOINTS/BATCH/           of runs that learn together: all of them, their configurations and curves

A run alone is a batch of one. A run does not depend on who else is in its batch, so nothing does on how runs are
grouped, and what was killed goes on from its last checkpoint to the bytes that it gives undisturbed. What is finished
is not trained again; a run that fails is said to have failed, and the others go on.
"""

import contextlib
import shutil
import time
import warnings
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pharos.agents import Learner, agent_called, is_known
from pharos.errors import FileFormatError, FolderLocked, ParameterError, PharosError
from pharos.system import compiling
from pharos.system.sources import is_reference
from pharos.system.storage import digest_of_json, inside, is_full, lock, read_json, remove_leftovers, replace_json
from pharos.system.wording import in_one_line, pluralize
from pharos.training import results as _results
from pharos.training.curve import joint_values
from pharos.training.prepared import FailedRun, PreparedRun, TaskCache
from pharos.training.results import Checkpoint, Record, TrainingResult, clear_run, finished_result
from pharos.training.schedule import halves, lanes
from pharos.training.task import RunConfig


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of the runs of `train_configs` after an evaluation.

    Attributes:
        done, total: environment steps of all runs together.
        rows: of the curves, by the place of the run among the configurations; of this evaluation alone.
        finished, failed: numbers of runs.
    """

    done: int
    total: int
    rows: Mapping[int, Mapping[str, Any]]
    finished: int
    failed: int


ProgressCallback = Callable[[TrainingProgress], None]


class CallbackError(BaseException):
    """An error of the caller's own progress function, which is not one of a run."""


def train_configs(
    configs: Sequence[RunConfig | Mapping[str, Any]],
    folders: Sequence[Path] | None = None,
    *,
    checkpoints: Path | None = None,
    progress: ProgressCallback | None = None,
    tasks: TaskCache | None = None,
    device: str | None = None,
    lane: int | None = None,
) -> list[TrainingResult | FailedRun]:
    """Train a run for each configuration; those of the batched engine that fit together train as one program.

    Args:
        folders: of the runs, one for each; None: nothing is written. Finished runs there are returned.
        checkpoints: folder for those of whole batches; None: none are written. A batch that was killed goes on from
            there with the runs that it had.
        progress: called after each evaluation; what it raises ends the training and is raised here.
        tasks: makes tasks, with values that are known already, and code of the user's own where it is trusted; None:
            from scratch, trusting none.
        device: "cpu" or "cuda"; None: that of the tasks, and "cpu" where there are none.
        lane: the most runs in a batch; None: all that fit together. Changes no result.
    Returns:
        The result of each run, or why it has none.
    Raises:
        FileFormatError: not the configuration of a run. ParameterError: there is no such device, or the tasks are
            for another one.
        MissingExtra: PyTorch is not installed. OSError: the disk is full.
    """
    tasks = TaskCache(device=device or "cpu") if tasks is None else tasks
    if device not in (None, tasks.device):
        raise ParameterError(f"device is {device!r}, and the tasks are for {tasks.device!r}; expected one device")
    check_device(tasks.device)
    run_configs = [config if isinstance(config, RunConfig) else RunConfig.from_dict(config) for config in configs]
    return TrainingJobs(run_configs, folders, checkpoints, progress, tasks, lane).run()


def check_device(device: str) -> None:
    """Raise ParameterError for a device that torch does not have here."""
    if device == "cpu":
        return
    import torch

    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch has a type for each of its builds
        reason = (str(error).splitlines() or [""])[0]
        raise ParameterError(f"device is {device!r}, which torch does not have here: {reason}; try cpu") from None


class TrainingJobs:
    """The runs of one call, by their place among the configurations, and their grouping into batches.

    Args:
        raises: whether errors of runs are raised, instead of being recorded as a FailedRun.
        tensorboard: whether TensorBoard's logs are written into the folder of a run.
    Attributes:
        results: of the runs that have ended, by place.
        done, total: environment steps of all runs together.
        reasons: why batches were halved, each told once.
    """

    def __init__(
        self,
        configs: Sequence[RunConfig],
        folders: Sequence[Path] | None,
        checkpoints: Path | None,
        progress: ProgressCallback | None,
        tasks: TaskCache,
        lane: int | None = None,
        *,
        raises: bool = False,
        tensorboard: bool = False,
    ):
        self.configs, self.checkpoints, self.progress, self.tasks = configs, checkpoints, progress, tasks
        self.folders = [None] * len(configs) if folders is None else [Path(folder) for folder in folders]
        self.lane, self.raises, self.tensorboard = lane, raises, tensorboard
        self.results: dict[int, TrainingResult | FailedRun] = {}
        self.total, self.done = sum(config.steps for config in configs), 0
        self.reasons: set[str] = set()

    def run(self) -> list[TrainingResult | FailedRun]:
        """Train all runs; return their results in order."""
        for group in self._groups():
            waiting = deque([group])
            while waiting:
                runs, before = waiting.popleft(), self.done
                failure = TrainingGroup(self, runs).train()
                if failure is not None:
                    self.done = before
                    waiting.extendleft(reversed(self._halves(runs, failure)))
        if self.checkpoints is not None and self.checkpoints.is_dir():
            for folder in (*self.checkpoints.iterdir(), self.checkpoints):
                with contextlib.suppress(OSError):  # it is not empty
                    folder.rmdir()
        return [self.results[place] for place in range(len(self.configs))]

    def _halves(self, group: list[PreparedRun], failure: Exception) -> list[list[PreparedRun]]:
        """Halves of a group that needed too much memory, or whose program one run has ended; they begin anew."""
        parts = halves([PreparedRun(each.place, each.config, each.folder, each.tasks) for each in group])
        reason = "out of memory" if _is_memory(failure) else in_one_line(failure)
        if reason not in self.reasons:
            self.reasons.add(reason)
            warnings.warn(
                f"{reason}: {pluralize(len(group), 'run')} at once; "
                f"goes on with {pluralize(len(parts[0]), 'run')} at once",
                stacklevel=2,
            )
        return parts

    def fail(self, place: int, error: Exception) -> None:
        """Raise the error of a run that could not begin where `raises` is set, else record it as a FailedRun."""
        if self.raises:
            raise error
        config, folder = self.configs[place], self.folders[place]
        self.results[place] = FailedRun(config.to_dict(), folder, error)
        self.done += config.steps
        if folder is not None and not (folder / _results.RECORD).exists():
            folder.mkdir(parents=True, exist_ok=True)
            Record(folder, config, config.hyperparameters).write("failed", error=in_one_line(error))

    def report(self, rows: Mapping[int, Mapping[str, Any]], done: int) -> None:
        """Call the progress function; CallbackError for what it raises, which is not an error of the runs."""
        if self.progress is None:
            return
        failed = sum(isinstance(each, FailedRun) for each in self.results.values())
        try:
            self.progress(TrainingProgress(done, self.total, rows, len(self.results) - failed, failed))
        except BaseException as error:
            raise CallbackError(error) from error

    # Groups ----------------------------------------------------------------------------------------------------------

    def _groups(self) -> Iterator[list[PreparedRun]]:
        """Yield runs that train alone; then batches restored from checkpoints, and the rest by what fits together."""
        alone: list[PreparedRun] = []
        waiting: dict[int, PreparedRun] = {}
        keys: dict[int | None, Hashable] = {}
        # Finished runs need no training; others train alone or wait for a batch
        for place, config in enumerate(self.configs):
            try:
                folder = self.folders[place]
                done = None if folder is None else finished_result(folder, config)
            except (ParameterError, FileFormatError) as error:
                self.fail(place, error)
                continue
            if done is not None and folder is not None:
                clear_run(folder)
                self.results[place] = done
                self.done += config.steps
                continue
            try:
                run = PreparedRun(place, config, folder, self.tasks)
                is_single = len(self.configs) == 1 or (folder is not None and (folder / "checkpoint").exists())
                key = run.key(is_single=is_single)
                run.is_alone = key is None
            except Exception as error:
                self.fail(place, error)
                continue
            if run.is_alone:
                alone.append(run)
            else:
                waiting[place], keys[place] = run, key
        yield from ([run] for run in alone)
        yield from self._stored_groups(waiting)
        # Runs with equal keys, in lanes
        rest = list(waiting.values())
        for lane in lanes([keys[run.place] for run in rest], [self.lane or len(rest)] * len(rest)):
            yield [rest[i] for i in lane]

    def _stored_groups(self, waiting: dict[int, PreparedRun]) -> Iterator[list[PreparedRun]]:
        """Batches of checkpoints, with the runs that they had, which are taken from `waiting`."""
        by_id = {run.config.id: place for place, run in waiting.items()}
        finished = {self.configs[place].id for place, end in self.results.items() if isinstance(end, TrainingResult)}
        for folder, configs in self._stored_batches():
            places = [by_id.get(config.id) for config in configs]
            if all(place is None for place in places):
                if finished.issuperset(config.id for config in configs):  # it was killed before it removed this
                    shutil.rmtree(folder, ignore_errors=True)
                continue
            if any(place is None and self._is_foreign(config) for place, config in zip(places, configs, strict=True)):
                continue
            try:
                group = [
                    PreparedRun(None, config, None, self.tasks) if place is None else waiting[place]
                    for place, config in zip(places, configs, strict=True)
                ]
                for run in group:
                    run.key()
            except Exception:  # what is wrong with a run is found later, where it fails alone
                continue
            for config in configs:
                if config.id in by_id:
                    del waiting[by_id.pop(config.id)]
            yield group

    def _is_foreign(self, config: RunConfig) -> bool:
        """Whether a run of a checkpoint, which somebody else may have written, names code that no run here names."""
        names = {"environment": config.environment, "observation": config.observation}
        if not is_known(config.agent):
            names["agent"] = config.agent
        has_no_source = any(is_reference(name) and part not in config.sources for part, name in names.items())
        ours = [item for each in self.configs for item in each.sources.items()]
        return has_no_source or any(item not in ours for item in config.sources.items())

    def _stored_batches(self) -> Iterator[tuple[Path, list[RunConfig]]]:
        for folder in [] if self.checkpoints is None else sorted(self.checkpoints.glob("*")):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError, PharosError):
                stored = read_json(folder / "batch.json")
                yield folder, [RunConfig.from_dict(entry) for entry in stored["configs"]]


class TrainingGroup:
    """Runs under one loop: trained, evaluated, resumed, and brought into their folders."""

    learner: Learner  # from when the runs begin; gone where they failed

    def __init__(self, jobs: TrainingJobs, group: list[PreparedRun]):
        self.jobs, self.group, self.config, self.is_alone = jobs, group, group[0].config, group[0].is_alone
        self.has_begun = self.holds = False  # whether runs are marked as running; whether checkpoints are this batch's
        self.held = contextlib.ExitStack()  # the folder of checkpoints, or that of a run alone

    def train(self) -> Exception | None:
        """Train the group. Returns None, or the error that has ended the program of several runs."""
        with self.held:
            try:
                self._train()
                return None
            except CallbackError as stop:
                (cause,) = stop.args
                if self.jobs.raises and self.is_alone and isinstance(cause, Exception):
                    self.group[0].fail(cause)
                raise cause from None
            except Exception as error:
                if is_full(error):  # which is no fault of these runs, and fewer at once need as much
                    raise
                failure = error
                vars(self).pop("learner", None)
                self._remove_checkpoint()
        if len(self.group) > 1:
            return failure
        self._fail(failure)
        return None

    def _train(self) -> None:
        began, compiled = time.perf_counter(), compiling.seconds()
        first = self.group[0]
        if self.is_alone and self._is_finished():
            return
        logs = first.folder / "tensorboard" if self.jobs.tensorboard and first.folder is not None else None
        self.learner = agent_called(self.config.agent).learner(self.group, self.jobs.tasks.device, logs)
        checkpoint = self._checkpoint()
        if checkpoint is not None:
            entries, spent = checkpoint.restore(self.learner) or ([], 0.0)
            if self.is_alone:
                first.curve.rows = entries
            else:
                for run, entry in zip(self.group, entries, strict=False):
                    run.curve.rows = entry["rows"]
                    run.error = None if entry["error"] is None else PharosError(entry["error"])
            began -= spent
        for run in self.group:
            if run.folder is not None:
                run.folder.mkdir(parents=True, exist_ok=True)
            run.record.write("running")
        self.has_begun = True
        self._learn(checkpoint, began)
        self._publish(time.perf_counter() - began, compiling.seconds() - compiled)

    # Files -----------------------------------------------------------------------------------------------------------

    @property
    def _folder(self) -> Path | None:
        """The folder for checkpoints of a batch; None for a run alone, or where none are written."""
        if self.is_alone or self.jobs.checkpoints is None:
            return None
        return self.jobs.checkpoints / digest_of_json([run.config.id for run in self.group])[:16]

    def _is_finished(self) -> bool:
        """Lock the folder of a run alone; return whether another process has finished it meanwhile."""
        folder, place = self.group[0].folder, self.group[0].place
        if folder is None or place is None:
            return False
        folder.mkdir(parents=True, exist_ok=True)
        self.held.enter_context(lock(folder, FolderLocked, "training"))
        remove_leftovers(folder / "regret.png")  # of a killed process; those of other files go with the next one
        done = finished_result(folder, self.config)
        if done is not None:
            clear_run(folder)
            self.jobs.results[place] = done
            self.jobs.done += self.config.steps
        return done is not None

    def _checkpoint(self) -> Checkpoint | None:
        """The checkpoint of the group; None where it has no folder, or where another process trains the same batch."""
        if self.is_alone:
            folder = self.group[0].folder
            return None if folder is None else Checkpoint(folder / "checkpoint", self.config.id)
        folder = self._folder
        if folder is None:
            return None
        inside(folder.parent, folder.name).mkdir(parents=True, exist_ok=True)
        try:
            self.held.enter_context(lock(folder, FolderLocked, "training"))
        except FolderLocked:
            return None
        configs = [run.config for run in self.group]
        entry = {"ids": [each.id for each in configs], "configs": [each.to_dict() for each in configs]}
        replace_json(folder / "batch.json", entry)
        self.holds = True
        return Checkpoint(folder / "checkpoint", folder.name)

    def _remove_checkpoint(self) -> None:
        if self.holds and self._folder is not None:
            clear_run(self._folder)  # and last what says which runs these are
            shutil.rmtree(self._folder, ignore_errors=True)

    # Learning --------------------------------------------------------------------------------------------------------

    def _learn(self, checkpoint: Checkpoint | None, began: float) -> None:
        """Train from the last row of the curves on, with an evaluation at each point."""
        steps, interval = self.config.steps, self.config.evaluation_interval
        count, before = sum(run.place is not None for run in self.group), self.jobs.done
        if not any(run.curve.rows for run in self.group):
            self._evaluate(0)
        # Steps of the evaluations to come, after those of a checkpoint
        start = max(run.curve.rows[-1]["step"] for run in self.group if run.curve.rows)
        points = [point for point in [*range(interval, steps, interval), steps] if point > start]

        def save(step: int) -> None:
            if checkpoint is None or step == steps:
                return
            curves: list[Any] = [
                {"rows": run.curve.rows, "error": run.error and in_one_line(run.error)} for run in self.group
            ]
            entries = curves[0]["rows"] if self.is_alone else curves
            checkpoint.save(self.learner, entries, time.perf_counter() - began)

        def at_point(step: int) -> Mapping[str, Any] | None:
            rows = self._evaluate(step)
            if not self.is_alone:
                save(step)
            places = {place: row for i, row in rows.items() if (place := self.group[i].place) is not None}
            self.jobs.report(places, before + step * count)
            if self.is_alone:
                save(step)
            return rows.get(0)

        if points:
            self.learner.learn(points, at_point)
        self.jobs.done = before + steps * count

    def _evaluate(self, step: int) -> dict[int, dict[str, Any]]:
        """Evaluate the policies: a row for each run that has not failed, by its place in the group."""
        rows, values = {}, {} if self.is_alone else joint_values(self.learner, self.group)
        episodes, returns = self.learner.episodes, self.learner.returns
        for i, run in enumerate(self.group):
            if run.error is not None:
                continue
            policy = self.learner.policy(i)
            try:
                rows[i] = run.curve.add(step, int(episodes[i]), float(returns[i]), policy, values.get(i))
            except Exception as error:
                run.fail(error)
        if all(run.error is not None for run in self.group):
            raise self.group[0].error or PharosError("no run is left")
        return rows

    def _publish(self, seconds: float, compiled: float) -> None:
        """Write and keep the result of each run; its seconds are its share of those of the batch."""
        size = {"runs": len(self.group), "seconds": seconds, "device": self.jobs.tasks.device}
        share = seconds - compiled if self.is_alone else seconds / len(self.group)
        entries = {"compiling_seconds": compiled} if self.is_alone else {"batch": size}
        for i, run in enumerate(self.group):
            if run.place is None:
                continue
            config, folder, curve = run.config.to_dict(), run.folder, run.curve.rows
            if run.error is not None:
                self.jobs.results[run.place] = FailedRun(config, folder, run.error)
                continue
            result = run.curve.result()
            if folder is not None:
                self.learner.publish(i, folder)
                _results.write_curve(folder, curve)
                run.record.write("finished", seconds=share, **entries, result=result)
            rows = [{name: row[name] for name in _results.COLUMNS} for row in curve]
            self.jobs.results[run.place] = TrainingResult(config, result, rows, self.learner.policy(i), folder, share)
        self._remove_checkpoint()
        if self.is_alone and (folder := self.group[0].folder) is not None:
            clear_run(folder)

    def _fail(self, error: Exception) -> None:
        """Record that the only run of the group has failed."""
        (run,) = self.group
        if run.place is None:
            return
        if self.is_alone and not self.has_begun:
            self.jobs.fail(run.place, error)
            return
        if run.error is None:
            run.fail(error)
        if self.jobs.raises:
            raise error
        self.jobs.results[run.place] = FailedRun(run.config.to_dict(), run.folder, error)
        self.jobs.done += run.config.steps


def _is_memory(error: BaseException) -> bool:
    """Whether memory was not enough, in the words of Python, torch on the processor, or torch on a GPU."""
    words = str(error).lower()
    return isinstance(error, MemoryError) or "out of memory" in words or "can't allocate memory" in words
