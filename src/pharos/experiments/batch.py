"""Many runs at once: configurations that fit together are trained as one program by the batched engine.

    FOLDER/                      of each run, as `train` leaves it: run.json, curve.parquet, agent/
    CHECKPOINTS/BATCH/           while a batch is trained: arrays of all its runs, their configurations and curves

A run does not depend on who else is in its batch, so nothing does on how runs are grouped, and a batch that was killed
goes on from its last checkpoint to the bytes that it gives undisturbed. What is finished is not trained again; a run
that fails is said to have failed, and the others go on.
"""

import contextlib
import json
import shutil
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import FileFormatError, FolderLocked, ParameterError, PharosError
from pharos.experiments import results as _results
from pharos.experiments.config import RunConfig
from pharos.experiments.learners import publish_network
from pharos.experiments.members import FailedRun, Member, Members, in_one_line
from pharos.experiments.run_folder import Checkpoint, Record, TrainingResult, finished_result
from pharos.storage import digest_of_json, lock, replace_json
from pharos.wording import many


@dataclass(frozen=True)
class Progress:
    """How far the runs of `train_configs` are, told after each evaluation.

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


Tell = Callable[[Progress], None]


class Stopped(BaseException):
    """What the caller's own function raised, which is not an error of a run."""


def train_configs(
    configs: Sequence[RunConfig | Mapping[str, Any]],
    folders: Sequence[Path] | None = None,
    *,
    checkpoints: Path | None = None,
    progress: Tell | None = None,
    members: Members | None = None,
    device: str = "cpu",
    lane: int | None = None,
) -> list[TrainingResult | FailedRun]:
    """Train as each configuration says; those of the batched engine that fit together as one program.

    Args:
        folders: of the runs, one for each; None: nothing is written. Finished runs there are returned.
        checkpoints: folder for those of whole batches; None: none are written. A batch that was killed goes on from
            there with the runs that it had.
        progress: called after each evaluation; what it raises ends the training and is raised here.
        members: makes tasks, with values that are known already, and code of the user's own where it is trusted; None:
            from scratch, trusting none.
        device: "cpu" or "cuda".
        lane: the most runs in a batch; None: all that fit together. Changes no result.
    Returns:
        The result of each run, or why it has none.
    Raises:
        FileFormatError: not the configuration of a run. ParameterError: there is no such device.
        MissingExtra: PyTorch is not installed.
    """
    _check_device(device)
    made = [config if isinstance(config, RunConfig) else RunConfig.from_dict(config) for config in configs]
    work = _Work(made, folders, checkpoints, progress, members or Members(), device, lane)
    work.run()
    return [work.results[place] for place in range(len(made))]


def _check_device(device: str) -> None:
    if device == "cpu":
        return
    import torch

    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch has a type for each of its builds
        reason = (str(error).splitlines() or [""])[0]
        raise ParameterError(f"device is {device!r}, which torch does not have here: {reason}; try cpu") from None


class _Work:
    """The runs of one call: what is done of them, and the loop over batches."""

    def __init__(
        self,
        configs: Sequence[RunConfig],
        folders: Sequence[Path] | None,
        checkpoints: Path | None,
        progress: Tell | None,
        members: Members,
        device: str,
        lane: int | None,
    ):
        self.configs, self.folders, self.checkpoints = configs, folders, checkpoints
        self.tell, self.members, self.device, self.lane = progress, members, device, lane
        self.results: dict[int, TrainingResult | FailedRun] = {}
        self.total, self.done = sum(config.steps for config in configs), 0
        self.said: set[str] = set()  # why batches were halved, each reason once

    def folder(self, place: int) -> Path | None:
        """Of a run."""
        return None if self.folders is None else Path(self.folders[place])

    def run(self) -> None:
        """Everything."""
        alone, waiting = [], {}
        for place, config in enumerate(self.configs):
            if self._is_finished(place, config):
                self.done += config.steps
            elif config.engine == "batched":
                waiting[place] = config
            else:
                alone.append(place)
        for place in alone:
            self._alone(place)
        if waiting:
            for group in self._groups(waiting):
                _Batch(self, group).train()
            if self.checkpoints is not None and self.checkpoints.is_dir() and not any(self.checkpoints.iterdir()):
                self.checkpoints.rmdir()

    def _is_finished(self, place: int, config: RunConfig) -> bool:
        folder = self.folder(place)
        try:
            done = None if folder is None else finished_result(folder, config)
        except (ParameterError, FileFormatError) as error:
            self.results[place] = FailedRun(config.to_dict(), folder, error)
            return True
        if done is not None:
            self.results[place] = done
        return done is not None

    def _alone(self, place: int) -> None:
        """A run that has no batch: a table, or a model of Stable-Baselines3."""
        from pharos.experiments.train import train_task

        config, folder, before = self.configs[place], self.folder(place), self.done

        def progress(done: int, _steps: int, row: Mapping[str, Any]) -> None:
            self.report({place: row}, before + done)

        try:
            algorithm = config.algorithm(trust=self.members.trust, strict=self.members.strict)
            self.results[place] = train_task(
                config, self.members.task(config), folder, progress=progress, algorithm=algorithm
            )
        except Stopped as stop:
            raise stop.args[0] from None
        except Exception as error:
            self.fail(place, error)
        self.done = before + config.steps

    def fail(self, place: int, error: Exception) -> None:
        """A run that could not begin, or ended with an error."""
        config, folder = self.configs[place], self.folder(place)
        self.results[place] = FailedRun(config.to_dict(), folder, error)
        if folder is not None and not (folder / _results.RECORD).exists():
            folder.mkdir(parents=True, exist_ok=True)
            Record(folder, config, config.hyperparameters).write("failed", error=in_one_line(error))

    def report(self, rows: Mapping[int, Mapping[str, Any]], done: int) -> None:
        """Tell the caller; what that raises is not an error of the runs."""
        if self.tell is None:
            return
        failed = sum(isinstance(each, FailedRun) for each in self.results.values())
        try:
            self.tell(Progress(done, self.total, rows, len(self.results) - failed, failed))
        except BaseException as error:
            raise Stopped(error) from error

    # Groups ----------------------------------------------------------------------------------------------------------

    def _groups(self, waiting: dict[int, RunConfig]) -> Iterator[list[Member]]:
        """Those of checkpoints as they were, then the rest, by what fits together."""
        by_id = {config.id: place for place, config in waiting.items()}
        for ids, configs in self._stored_batches():
            if not any(id in by_id for id in ids):
                continue
            try:
                group = [
                    self.members.member(by_id.get(id), config, self._folder_of(by_id.get(id)))
                    for id, config in zip(ids, configs, strict=True)
                ]
            except Exception:  # what is wrong with a run is found below, where it fails alone
                continue
            for id in ids:
                if id in by_id:
                    del waiting[by_id.pop(id)]
            yield group
        groups: dict[Hashable, list[Member]] = defaultdict(list)
        for place, config in waiting.items():
            try:
                member = self.members.member(place, config, self.folder(place))
            except Exception as error:
                self.fail(place, error)
                self.done += config.steps
                continue
            groups[member.key].append(member)
        for group in groups.values():
            width = self.lane or len(group)
            for first in range(0, len(group), width):
                yield group[first : first + width]

    def _folder_of(self, place: int | None) -> Path | None:
        return None if place is None else self.folder(place)

    def _stored_batches(self) -> Iterator[tuple[list[str], list[RunConfig]]]:
        if self.checkpoints is None:
            return
        for folder in sorted(self.checkpoints.glob("*")):
            try:
                stored = json.loads((folder / "batch.json").read_text(encoding="utf-8"))
                configs = [RunConfig.from_dict(entry) for entry in stored["configs"]]
            except (OSError, ValueError, KeyError, TypeError, PharosError):
                continue
            yield [config.id for config in configs], configs


class _Batch:
    """One batch: it is trained, evaluated, kept, and leaves the folders of its runs."""

    def __init__(self, work: _Work, group: list[Member]):
        self.work, self.group = work, group
        self.config, self.places = group[0].config, [member.place for member in group]
        self.batch: Any = None
        self.spent = 0.0
        self.held = contextlib.ExitStack()
        self.keeps = False  # whether this process holds the folder of checkpoints

    @property
    def _place(self) -> Path | None:
        """The folder of its checkpoints."""
        if self.work.checkpoints is None:
            return None
        return self.work.checkpoints / digest_of_json([member.config.id for member in self.group])[:16]

    def train(self) -> None:
        """All of it; in halves where it needs too much memory, or where one run ends the program."""
        before = self.work.done
        try:
            self._train()
        except Stopped as stop:
            self.held.close()
            raise stop.args[0] from None
        except Exception as error:
            self.batch = None
            self._remove_checkpoint()
            if len(self.group) == 1:
                self._end_with(error)
                return
            middle = len(self.group) // 2
            said = "out of memory" if _is_memory(error) else in_one_line(error)
            if said not in self.work.said:
                self.work.said.add(said)
                warnings.warn(
                    f"{said}: {many(len(self.group), 'run')} at once; goes on with {many(middle, 'run')} at once",
                    stacklevel=2,
                )
            self.work.done = before
            for part in (self.group[:middle], self.group[middle:]):
                fresh = [Member(*(getattr(each, name) for name in _GIVEN)) for each in part]
                _Batch(self.work, fresh).train()
            return

    def _train(self) -> None:
        from pharos.agents.batched import make_batch

        began = time.perf_counter()
        self.batch = make_batch(self.config.agent, [member.run for member in self.group], device=self.work.device)
        checkpoint = None
        if self._place is not None and self._claim(self._place):
            members = [member.config for member in self.group]
            entry = {"ids": [each.id for each in members], "configs": [each.to_dict() for each in members]}
            replace_json(self._place / "batch.json", entry)
            checkpoint = Checkpoint(self._place / "checkpoint", self._place.name)
            rows, self.spent = checkpoint.restore(self) or ([], 0.0)
            for member, curve in zip(self.group, rows, strict=False):
                member.curve.rows = curve["rows"]
                member.error = None if curve["error"] is None else PharosError(curve["error"])
        began -= self.spent
        for member in self.group:
            if member.folder is not None:
                member.folder.mkdir(parents=True, exist_ok=True)
            member.record.write("running")
        self._learn(checkpoint, began)
        self._publish(time.perf_counter() - began)

    def _claim(self, place: Path) -> bool:
        """Hold the folder of checkpoints; False where another process does, which trains the same runs."""
        place.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FolderLocked):
            self.held.enter_context(lock(place, FolderLocked, "training"))
            self.keeps = True
        return self.keeps

    def _learn(self, checkpoint: Checkpoint | None, began: float) -> None:
        """Learn from the last row of the curves on, with evaluations at each point."""
        steps, interval = self.config.steps, self.config.evaluation_interval
        if not any(member.curve.rows for member in self.group):
            self._evaluate(0)
        start, before = int(self.batch.steps), self.work.done
        points = [point for point in [*range(interval, steps, interval), steps] if point > start]

        def at_point(step: int) -> None:
            rows = self._evaluate(step)
            if checkpoint is not None and step < steps:
                curves = [
                    {"rows": member.curve.rows, "error": member.error and in_one_line(member.error)}
                    for member in self.group
                ]
                checkpoint.save(self, curves, time.perf_counter() - began)
            self.work.report(rows, before + step * sum(place is not None for place in self.places))

        if points:
            self.batch.learn(points, at_point)
        self.work.done = before + steps * sum(place is not None for place in self.places)

    def _evaluate(self, step: int) -> dict[int, dict[str, Any]]:
        """A row for each run that has not failed, by its place."""
        rows = {}
        for i, member in enumerate(self.group):
            if member.error is not None:
                continue
            episodes, returns = int(self.batch.episodes[i]), float(self.batch.returns[i])
            try:
                row = member.curve.add(step, episodes, returns, self.batch.policy(i))
            except Exception as error:
                member.fail(error)
                continue
            if member.place is not None:
                rows[member.place] = row
        if all(member.error is not None for member in self.group):
            raise self.group[0].error or PharosError("no run is left")
        return rows

    def save(self, folder: Path) -> None:
        """The arrays of all runs, as `Checkpoint` asks for them."""
        np.savez(folder / "batch.npz", **self.batch.state())

    def load(self, folder: Path) -> None:
        """Go on from what was saved.

        Raises:
            FileFormatError: it cannot be read.
        """
        try:
            with np.load(folder / "batch.npz", allow_pickle=False) as stored:
                self.batch.restore({name: stored[name] for name in stored.files})
        except Exception as error:
            raise FileFormatError(
                f"{folder}: cannot be resumed from: {error}; delete the folder to start anew"
            ) from error

    def _publish(self, seconds: float) -> None:
        """What each run leaves; its seconds are its share of those of the batch."""
        share = seconds / len(self.group)
        for i, member in enumerate(self.group):
            if member.place is None:
                continue
            if member.error is not None:
                self.work.results[member.place] = FailedRun(member.config.to_dict(), member.folder, member.error)
                continue
            curve, result = member.curve.rows, member.curve.result()
            if member.folder is not None:
                counters = {"num_timesteps": int(self.batch.steps), "episodes": int(self.batch.episodes[i])}
                returns = float(self.batch.returns[i])
                publish_network(member.folder, self.batch.parameters(i), counters, returns)
                _results.write_curve(member.folder, curve)
                size = {"runs": len(self.group), "seconds": seconds, "device": self.work.device}
                member.record.write("finished", seconds=share, batch=size, result=result)
            rows = [{name: row[name] for name in _results.COLUMNS} for row in curve]
            self.work.results[member.place] = TrainingResult(
                member.config.to_dict(), result, rows, self.batch.policy(i), member.folder, share
            )
        self._remove_checkpoint()

    def _end_with(self, error: Exception) -> None:
        """The only run of a batch has failed."""
        member = self.group[0]
        if member.place is None:
            return
        if member.error is None:
            member.fail(error)
        self.work.results[member.place] = FailedRun(member.config.to_dict(), member.folder, error)
        self.work.done += member.config.steps

    def _remove_checkpoint(self) -> None:
        if self._place is not None and self.keeps:
            shutil.rmtree(self._place, ignore_errors=True)
        self.held.close()
        self.keeps = False


_GIVEN = ("place", "config", "folder", "task", "hyperparameters", "run", "key")


def _is_memory(error: BaseException) -> bool:
    """Whether memory was not enough, in the words of Python, torch on the processor, or torch on a GPU."""
    words = str(error).lower()
    return isinstance(error, MemoryError) or "out of memory" in words or "can't allocate memory" in words
