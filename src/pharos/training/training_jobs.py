"""What is done of the runs of one call, and who is told: batches and runs that train alone write it up as they end."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pharos.training import results as _results
from pharos.training.config import RunConfig
from pharos.training.run_folder import Record, TrainingResult
from pharos.training.task_cache import FailedRun, TaskCache, in_one_line


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


class CallbackError(BaseException):
    """What the caller's own function raised, which is not an error of a run."""


class TrainingJobs:
    """The runs of one call, by their place among the configurations.

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
        progress: Tell | None,
        members: TaskCache,
        lane: int | None,
    ):
        self.configs, self.folders, self.checkpoints = configs, folders, checkpoints
        self.tell, self.members, self.lane = progress, members, lane
        self.results: dict[int, TrainingResult | FailedRun] = {}
        self.total, self.done = sum(config.steps for config in configs), 0
        self.reasons: set[str] = set()

    def folder(self, place: int) -> Path | None:
        """Of a run."""
        return None if self.folders is None else Path(self.folders[place])

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
            raise CallbackError(error) from error
