"""Progress of a study, by the files in its folder.

Warnings of code of the user's own that has changed since the study's runs were trained.
"""

import contextlib
import os
import socket
import time
import warnings
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pharos.errors import FileFormatError, ParameterError, PharosError
from pharos.study import worker as _worker
from pharos.study.specification import (
    STUDIES,
    STUDY_FILE,
    Source,
    Specification,
    specification,
    study_folder,
    study_name,
)
from pharos.system.storage import read_json, replace_file
from pharos.system.wording import pluralize
from pharos.training import read_record


@dataclass(frozen=True)
class Status:
    """Progress of a study.

    Attributes:
        name, folder: of the study.
        total, finished, failed, running: numbers of runs. Runs in `running` are started and not over.
        errors: of the failed runs, by id.
        damaged: what is wrong with results that cannot be read, by id. Such runs count as missing, and are executed
            again.
        elapsed, remaining: seconds since this runner began, and until the end as far as one can tell (None: not yet).
        preparing: what is built or solved before the runs, empty otherwise.
    """

    name: str
    folder: str
    total: int
    finished: int
    failed: int
    running: int
    errors: Mapping[str, str]
    elapsed: float = 0.0
    remaining: float | None = None
    preparing: str = ""
    damaged: Mapping[str, str] = field(default_factory=dict)

    @property
    def missing(self) -> int:
        """Runs that are not over."""
        return self.total - self.finished - self.failed

    def to_dict(self) -> dict[str, Any]:
        """The attributes and `missing`, JSON-able."""
        return {**asdict(self), "missing": self.missing}

    def __str__(self) -> str:
        if self.preparing:
            return f"{self.name}: {self.preparing}"
        text = f"{self.name}: {self.finished} of {pluralize(self.total, 'run')} finished"
        if self.failed:
            text += f", {self.failed} failed"
        if self.damaged:
            text += f", {len(self.damaged)} damaged"
        if self.running:
            text += f", {self.running} running"
        if self.missing and self.remaining is not None:
            text += f", about {duration(self.remaining)} left"
        return text


@dataclass(frozen=True)
class Forecast:
    """Forecast of the missing runs of a study.

    Attributes:
        runs, steps: how many are missing.
        workers: processes.
        seconds: until the last is finished, at the pace of finished runs. None: no run is finished.
    """

    runs: int
    steps: int
    workers: int
    seconds: float | None

    def __str__(self) -> str:
        text = f"{pluralize(self.runs, 'run')} to come, {self.steps:,} steps"
        if self.seconds is None:
            return f"{text}; how long they take is told once one is finished"
        workers = pluralize(self.workers, "worker")
        return f"{text}: about {duration(self.seconds)} with {workers}, at the pace of finished runs"


def duration(seconds: float) -> str:
    """A duration in words: `40 s`, `12 min`, `3.5 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def opened(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    trust: bool | None = None,
    environments: str | os.PathLike | None = None,
) -> tuple[Specification, Path]:
    """A study and the folder of its results: `folder`, else the source, if it is a study's folder, else studies/NAME.

    Args:
        trust, environments: as for `specification`.
    """
    if folder is None and isinstance(source, str | Path):
        folder = study_folder(source)
    study = specification(source, trust=trust, environments=environments)
    directory = Path(STUDIES, study.name) if folder is None else Path(folder)
    warn_of_changes(study, directory)
    return study, directory


def status(source: Source, folder: str | os.PathLike | None = None) -> Status:
    """The progress of a study, from its files. `remaining` is the last estimate of its runners."""
    study, directory = opened(source, folder)
    # Records of runs that are over
    errors, damaged, finished = {}, {}, 0
    for run in study.runs:
        try:
            record = _worker.run_record(directory / "runs" / run.id)
        except FileFormatError as error:
            damaged[run.id] = str(error)
            continue
        if record is not None and record["status"] == _worker.FAILED:
            errors[run.id] = str(record.get("error"))
        finished += record is not None and record["status"] == _worker.FINISHED
    # Status files of runners that are alive
    running, remaining = 0, None
    for file in sorted(directory.glob("status*.json")):
        with contextlib.suppress(ValueError, OSError, KeyError, TypeError, OverflowError):
            record = read_json(file)
            if _is_alive(record):
                running += record["running"]
                if record["remaining"] is not None:
                    remaining = max(remaining or 0.0, record["remaining"])
    return Status(
        name=study.name,
        folder=str(directory),
        total=len(study.runs),
        finished=finished,
        failed=len(errors),
        running=running,
        errors=errors,
        remaining=remaining,
        damaged=damaged,
    )


def _is_alive(record: Mapping[str, Any]) -> bool:
    """Whether the runner that wrote a status file is alive: by the age of the file, and on its own machine by its
    process."""
    if record["host"] != socket.gethostname():
        return time.time() - record["updated"] < 60
    try:
        os.kill(record["process"], 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return time.time() - record["updated"] < 60


def write_specification(study: Specification, folder: Path) -> None:
    """Write the specification into the folder, so that it can be reported on alone. Refuse a folder of another
    study."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / STUDY_FILE
    if file.exists():
        name = study_name(file)
        if name is not None and name != study.name:
            raise ParameterError(f"{folder}: holds the study {name!r}, not {study.name!r}; choose another --out")
    replace_file(file, study.to_yaml())


# Custom code ----------------------------------------------------------------------------------------------------------


def warn_of_changes(study: Specification, folder: Path) -> None:
    """Warn of each file of the user's own that has changed since finished runs in `folder` were trained with it.

    Their ids do not depend on it, so they count as runs of the study.
    """
    changed: dict[str, int] = defaultdict(int)
    for run in study.runs:
        if not run.configuration.sources or not (folder / "runs" / run.id / "run.json").is_file():
            continue
        try:
            stored = read_record(folder / "runs" / run.id)["config"]["sources"]
            for part, source in run.configuration.sources.items():
                changed[source.file] += stored[part]["checksum"] != source.checksum
        except (PharosError, KeyError, TypeError):  # damaged: whoever reads the result says so
            continue
    for file, count in changed.items():
        if count:
            warnings.warn(
                f"{file} has changed since {count} runs in {folder} were trained with it; "
                f"another --out trains them anew",
                stacklevel=3,
            )
