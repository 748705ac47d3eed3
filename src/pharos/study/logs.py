"""The curves of finished runs for TensorBoard and for Weights & Biases: exact values and regret, a run for each run."""

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pharos.errors import FileFormatError, MissingExtra, UnknownName
from pharos.plots import slug
from pharos.study import worker as _worker
from pharos.study.blocks import Run, Specification
from pharos.study.figures import line_label
from pharos.study.specification import Source
from pharos.study.status import opened
from pharos.study.tables import described, run_curve

if TYPE_CHECKING:
    import pandas as pd

LOGGERS = ("tensorboard", "wandb")
SCALARS = ("value", "expected_regret", "cumulative_expected_regret", "normalized_regret", "mean_return", "episodes")


def log(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    to: str,
    project: str | None = None,
    offline: bool = False,
    progress: Callable[[str], None] | None = None,
    trust: bool | None = None,
) -> int:
    """Write the curves of the finished runs that were not written yet, and return how many.

    Nothing is trained, and nothing of the results changes. A run keeps its name and identity, and may be written again.

    Args:
        source: YAML file, preset, mapping, Specification, the folder of a study, or the name of one in `studies`.
        folder: of the results. Default: that folder, or studies/NAME.
        to: "tensorboard", for event files in the folder `tensorboard` of the study, or "wandb".
        project: of Weights & Biases. Default: the name of the study.
        offline: Weights & Biases keeps its files in the folder `wandb` of the study, for `wandb sync` to send.
        progress: called with what is being written.
    Raises:
        UnknownName: `to` is neither. MissingExtra: the package is not installed.
    """
    study, directory = opened(source, folder, trust=trust)
    return RunLog(study, directory, to, project=project, offline=offline).update(progress or (lambda _: None))


@dataclass
class RunLog:
    """Log of the runs of a study, which remembers those that were written.

    A file in `tensorboard/written` or `wandb/written` stands for each run.
    """

    study: Specification
    directory: Path
    to: str
    project: str | None = None
    offline: bool = False
    write: Callable[[Run, str, Mapping[str, Any], Any], None] = field(init=False)

    def __post_init__(self) -> None:
        if self.to not in LOGGERS:
            raise UnknownName("place for the curves of runs", self.to, LOGGERS)
        self.write = self._tensorboard() if self.to == "tensorboard" else self._wandb()

    def update(self, progress: Callable[[str], None] = lambda _: None) -> int:
        """Write the runs that are finished and not written yet, and return how many."""
        written = self.directory / self.to / "written"
        number = 0
        for run, name in named_runs(self.study):
            if (written / run.id).exists():
                continue
            try:
                record = _worker.run_record(self.directory / "runs" / run.id)
                if record is None or record["status"] != _worker.FINISHED:
                    continue
                curve = run_curve(self.directory, run.id)
            except FileFormatError:  # `status` and `report` tell which, and why
                continue
            progress(name)
            self.write(run, name, record, curve)
            written.mkdir(parents=True, exist_ok=True)
            (written / run.id).touch()
            number += 1
        return number

    def _tensorboard(self) -> Callable[[Run, str, Mapping[str, Any], Any], None]:
        try:
            from tensorboard.compat.proto.event_pb2 import Event
            from tensorboard.compat.proto.summary_pb2 import Summary
            from tensorboard.plugins.hparams.summary_v2 import hparams_pb
            from tensorboard.summary.writer.event_file_writer import EventFileWriter
        except ImportError as error:
            raise MissingExtra("logs for TensorBoard", "tensorboard", "agents") from error

        def write(run: Run, name: str, record: Mapping[str, Any], curve: object) -> None:
            folder = self.directory / self.to / name
            for old in folder.glob("events.out.tfevents.*"):  # of an attempt that was killed
                old.unlink()
            writer = EventFileWriter(str(folder))
            ended = (self.directory / "runs" / run.id / "run.json").stat().st_mtime
            began = ended - float(record["seconds"])
            writer.add_event(Event(wall_time=began, step=0, summary=hparams_pb(_settings(run), trial_id=run.id)))
            for step, seconds, values in _points(curve):
                scalars = [Summary.Value(tag=f"pharos/{key}", simple_value=value) for key, value in values.items()]
                event = Event(wall_time=min(began + seconds, ended), step=step, summary=Summary(value=scalars))
                writer.add_event(event)
            writer.close()

        return write

    def _wandb(self) -> Callable[[Run, str, Mapping[str, Any], Any], None]:
        try:
            import wandb
        except ImportError as error:
            raise MissingExtra("logs for Weights & Biases", "wandb", "wandb") from error

        def write(run: Run, name: str, record: Mapping[str, Any], curve: object) -> None:
            (self.directory / self.to).mkdir(parents=True, exist_ok=True)
            logged = wandb.init(
                project=self.project or self.study.name,
                id=run.id,
                name=name,
                group=name.rpartition("/")[0],
                config={**run.config, **_settings(run)},
                dir=str(self.directory),
                mode="offline" if self.offline else None,
                resume="allow" if not self.offline else None,
                settings=wandb.Settings(silent=True, console="off"),
            )
            for step, _, values in _points(curve):
                logged.log({f"pharos/{key}": value for key, value in values.items()}, step=step)
            logged.summary.update({key: value for key, value in record["result"].items() if _is_number(value)})
            logged.finish()

        return write


def named_runs(study: Specification) -> Iterator[tuple[Run, str]]:
    """Yield (run, its name): INSTANCE/CHANCE/AGENT/SEED, and its id if others have the same name."""
    names = [_name(run) for run in study.runs]
    often = Counter(names)
    for run, name in zip(study.runs, names, strict=True):
        yield run, f"{name}-{run.id[:8]}" if often[name] > 1 else name


def _name(run: Run) -> str:
    columns = described(run)
    parts = (run.instance, run.chance, line_label(columns["agent"], columns["observation"]))
    return "/".join((*(slug(part.replace(", ", "-")) for part in parts), f"seed-{columns['seed']}"))


def _settings(run: Run) -> dict[str, Any]:
    """Settings by which runs are compared: words and numbers."""
    own = {f"hyperparameters/{key}": value for key, value in run.config["hyperparameters"].items()}
    return {key: value if _is_number(value) or isinstance(value, str) else str(value) for key, value in
            {**described(run), **own}.items()}  # fmt: skip


def _points(curve: "pd.DataFrame") -> Iterator[tuple[int, float, dict[str, float]]]:
    """Yield (step, seconds since the run began, finite values of SCALARS) for each evaluation."""
    for row in curve.to_dict("records"):
        values = {key: float(row[key]) for key in SCALARS if key in row}
        yield (
            int(row["step"]),
            float(row.get("seconds", 0.0)),
            {key: value for key, value in values.items() if math.isfinite(value)},
        )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
