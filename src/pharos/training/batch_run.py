"""One batch of runs that fit together: trained as one program, evaluated, kept, and brought into the runs' folders."""

import contextlib
import shutil
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import FileFormatError, FolderLocked, PharosError
from pharos.system.storage import digest_of_json, lock, replace_json
from pharos.system.wording import many
from pharos.training import results as _results
from pharos.training.joint_evaluation import values_together
from pharos.training.learners import publish_network
from pharos.training.run_folder import Checkpoint, TrainingResult
from pharos.training.tables import Tables
from pharos.training.task_cache import FailedRun, Member, in_one_line
from pharos.training.training_jobs import CallbackError, TrainingJobs

# What a member is begun anew from, where its batch is halved.
BEGINNING = ("place", "config", "folder", "task", "hyperparameters", "run", "key")


class Batch:
    """One batch: it is trained, evaluated, kept, and leaves the folders of its runs."""

    def __init__(self, ledger: TrainingJobs, group: list[Member]):
        self.ledger, self.group = ledger, group
        self.config, self.places = group[0].config, [member.place for member in group]
        self.batch: Any = None
        self.spent = 0.0
        self.held = contextlib.ExitStack()
        self.keeps = False  # whether this process holds the folder of checkpoints

    @property
    def _place(self) -> Path | None:
        """The folder of its checkpoints."""
        if self.ledger.checkpoints is None:
            return None
        return self.ledger.checkpoints / digest_of_json([member.config.id for member in self.group])[:16]

    def train(self) -> None:
        """All of it; in halves where it needs too much memory, or where one run ends the program."""
        before = self.ledger.done
        try:
            self._train()
        except CallbackError as stop:
            self.held.close()
            raise stop.args[0] from None
        except Exception as error:
            self.batch = None
            self._remove_checkpoint()
            if len(self.group) == 1:
                self._end_with(error)
                return
            middle = len(self.group) // 2
            reason = "out of memory" if _is_memory(error) else in_one_line(error)
            if reason not in self.ledger.reasons:
                self.ledger.reasons.add(reason)
                warnings.warn(
                    f"{reason}: {many(len(self.group), 'run')} at once; goes on with {many(middle, 'run')} at once",
                    stacklevel=2,
                )
            self.ledger.done = before
            for part in (self.group[:middle], self.group[middle:]):
                fresh = [Member(*(getattr(each, name) for name in BEGINNING)) for each in part]
                Batch(self.ledger, fresh).train()
            return

    def _train(self) -> None:
        began = time.perf_counter()
        runs = [member.run for member in self.group]
        if self.config.is_tabular:
            self.batch = Tables(runs)
        else:
            from pharos.agents.batched import make_batch

            self.batch = make_batch(self.config.agent, runs, device=self.ledger.members.device)
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
        start, before = int(self.batch.steps), self.ledger.done
        points = [point for point in [*range(interval, steps, interval), steps] if point > start]

        def at_point(step: int) -> None:
            rows = self._evaluate(step)
            if checkpoint is not None and step < steps:
                curves = [
                    {"rows": member.curve.rows, "error": member.error and in_one_line(member.error)}
                    for member in self.group
                ]
                checkpoint.save(self, curves, time.perf_counter() - began)
            self.ledger.report(rows, before + step * sum(place is not None for place in self.places))

        if points:
            self.batch.learn(points, at_point)
        self.ledger.done = before + steps * sum(place is not None for place in self.places)

    def _evaluate(self, step: int) -> dict[int, dict[str, Any]]:
        """A row for each run that has not failed, by its place."""
        rows, values = {}, values_together(self.batch, self.group)
        for i, member in enumerate(self.group):
            if member.error is not None:
                continue
            episodes, returns = int(self.batch.episodes[i]), float(self.batch.returns[i])
            try:
                row = member.curve.add(step, episodes, returns, self.batch.policy(i), values.get(i))
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
                self.ledger.results[member.place] = FailedRun(member.config.to_dict(), member.folder, member.error)
                continue
            curve, result = member.curve.rows, member.curve.result()
            if member.folder is not None:
                self._publish_agent(i, member.folder)
                _results.write_curve(member.folder, curve)
                size = {"runs": len(self.group), "seconds": seconds, "device": self.ledger.members.device}
                member.record.write("finished", seconds=share, batch=size, result=result)
            rows = [{name: row[name] for name in _results.COLUMNS} for row in curve]
            self.ledger.results[member.place] = TrainingResult(
                member.config.to_dict(), result, rows, self.batch.policy(i), member.folder, share
            )
        self._remove_checkpoint()

    def _publish_agent(self, i: int, folder: Path) -> None:
        """What run i has learnt: the greedy policy of a table, or a network."""
        if self.config.is_tabular:
            _results.write_policy(folder, self.batch.policy(i).policy_table())
            return
        counters = {"num_timesteps": int(self.batch.steps), "episodes": int(self.batch.episodes[i])}
        publish_network(folder, self.batch.parameters(i), counters, float(self.batch.returns[i]))

    def _end_with(self, error: Exception) -> None:
        """The only run of a batch has failed."""
        member = self.group[0]
        if member.place is None:
            return
        if member.error is None:
            member.fail(error)
        self.ledger.results[member.place] = FailedRun(member.config.to_dict(), member.folder, error)
        self.ledger.done += member.config.steps

    def _remove_checkpoint(self) -> None:
        if self._place is not None and self.keeps:
            shutil.rmtree(self._place, ignore_errors=True)
        self.held.close()
        self.keeps = False


def _is_memory(error: BaseException) -> bool:
    """Whether memory was not enough, in the words of Python, torch on the processor, or torch on a GPU."""
    words = str(error).lower()
    return isinstance(error, MemoryError) or "out of memory" in words or "can't allocate memory" in words
