"""The folder of a run: record and checkpoints while it is trained; result and agent once it is finished."""

import contextlib
import json
import math
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pharos.environments import class_called
from pharos.errors import FileFormatError, ParameterError, UntrustedCode
from pharos.system.storage import CLAIM, LOCK, check_regular, digest_of_bytes, digest_of_file, read_json, sync
from pharos.training import results as _results
from pharos.training.config import RunConfig, run_id
from pharos.training.task import Task

CHECKPOINT_SECONDS = 10.0
ANEW = "delete the folder to start anew"
# Writing checkpoints takes at most this share of the time
SHARE_OF_TIME = 0.05


class Stored(Protocol):
    """What a checkpoint keeps."""

    def save(self, folder: Path) -> None:
        """Write what `load` needs."""

    def load(self, folder: Path) -> None:
        """Go on from what `save` wrote."""


@dataclass(frozen=True)
class TrainingResult:
    """What a run gave.

    Attributes:
        config: of the run.
        result: summary: values of the optimal, uniform, worst and final policy, regrets, episodes.
        curve: a row for each evaluation, a dictionary with the columns of curve.parquet.
        agent: the trained agent: a `QLearning` or a model of Stable-Baselines3; None where the run was finished before.
        folder: of the run, or None.
        seconds: time that it took, without that of compiling.
    """

    config: dict[str, Any]
    result: dict[str, Any]
    curve: list[dict[str, Any]]
    agent: Any
    folder: Path | None
    seconds: float


class Record:
    """The file run.json, where there is a folder for results."""

    def __init__(self, folder: Path | None, config: RunConfig, hyperparameters: Mapping[str, Any]):
        self.folder, self.hyperparameters = folder, hyperparameters
        versions = _results.versions()
        self.run = {"format": _results.FORMAT, "id": config.id, "config": config.to_dict(), "versions": versions}
        if (rules := class_called(config.environment)) is not None:
            self.run["rules_version"] = rules.version

    def write(self, status: str, **entries: object) -> None:
        """Replace it: the run is "running", "failed" or "finished"."""
        if self.folder is None:
            return
        record = {**self.run, "status": status, "hyperparameters": self.hyperparameters, **entries}
        _results.write_record(self.folder, record)


def finished_result(folder: Path, config: RunConfig) -> TrainingResult | None:
    """The result that lies there; None where there is none; ParameterError where it is that of another run."""
    if not (folder / "run.json").exists():
        return None
    record = _results.read_record(folder)
    stored = record["config"]
    if run_id(stored) != config.id:
        entry = json.loads(json.dumps(config.to_dict()))
        different = [name for name in {**entry, **stored} if stored.get(name) != entry.get(name)]
        raise ParameterError(
            f"{folder}: holds a run with another {', '.join(different) or 'configuration'}; "
            f"choose another folder, or delete it"
        )
    for part, source in config.sources.items():
        if stored["sources"][part].get("checksum") != source.checksum:
            raise ParameterError(
                f"{folder}: holds a run from before {source.file} was changed; choose another folder, or delete it"
            )
    if record.get("status") != "finished":
        return None
    rows = _results.read_rows(folder)
    return TrainingResult(record["config"], record["result"], rows, None, folder, record["seconds"])


def clear_run(folder: Path) -> None:
    """Remove what a finished run does not need; of kills in the middle of replacing or removing it, too."""
    for leftover in folder.glob("checkpoint*"):
        shutil.rmtree(leftover, ignore_errors=True)
    for name in (LOCK, CLAIM):  # whoever waits for it finds a finished run
        with contextlib.suppress(OSError):
            (folder / name).unlink()


def _digests(folder: Path) -> dict[str, str]:
    """The digest of each file below a folder, but for the one that holds the digests."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / "curve.json")
    return {path.relative_to(folder).as_posix(): digest_of_file(path) for path in files}


def _digest(record: Mapping[str, Any]) -> str:
    """Of a record that may hold infinities and nan."""
    return digest_of_bytes(json.dumps(record, sort_keys=True).encode())


class Checkpoint:
    """A folder that holds the last checkpoint, replaced in one step."""

    def __init__(self, folder: Path, id: str):
        self.folder, self.id = folder, id
        self._next = -math.inf

    def save(self, learner: Stored, rows: list[Any], seconds: float) -> None:
        """Write one, unless the last is not ten seconds old, or writing would take more than SHARE_OF_TIME."""
        began = time.monotonic()
        if began < self._next:
            return
        partial = self.folder.with_name(f"{self.folder.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        learner.save(partial)
        record = {"id": self.id, "rows": rows, "seconds": seconds, "files": _digests(partial)}
        (partial / "curve.json").write_text(json.dumps({**record, "digest": _digest(record)}))
        for path in (*partial.rglob("*"), partial):  # the older one goes only when this one is on the disk
            sync(path)
        old = self.folder.with_name(f"{self.folder.name}.old")
        if self.folder.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(self.folder, old)
        os.replace(partial, self.folder)
        sync(self.folder.parent)
        shutil.rmtree(old, ignore_errors=True)
        now = time.monotonic()
        self._next = now + max(CHECKPOINT_SECONDS, (now - began) / SHARE_OF_TIME if CHECKPOINT_SECONDS else 0.0)

    def restore(self, learner: Stored) -> tuple[list[Any], float] | None:
        """(rows of the curve, seconds spent) of the last checkpoint, from which the learner goes on; or None.

        Raises:
            FileFormatError: it was changed after it was written.
        """
        for folder in (self.folder, self.folder.with_name(f"{self.folder.name}.old")):
            try:
                record = read_json(folder / "curve.json", advice=ANEW)
            except FileNotFoundError:
                continue
            if not isinstance(record, dict):
                record = {"id": self.id, "digest": ""}
            if record.get("id") == self.id:
                digest = record.pop("digest", None)  # which an older pharos did not write
                if digest is not None and (digest != _digest(record) or record["files"] != _digests(folder)):
                    raise FileFormatError(
                        f"{folder}: cannot be resumed from: it was changed after it was written; {ANEW}"
                    )
                learner.load(folder)
                return record["rows"], record["seconds"]
        return None


def load_agent(folder: str | os.PathLike, *, trust: bool = False) -> tuple[Task, Any]:
    """The task of a finished run, and what it learnt, as `evaluate_agent` and `pharos.evaluate_policy` take it.

    Args:
        trust: whether code that the run names may be imported: an environment, observation or agent of its own. What
            this process has imported already, such as the environment that a command names, needs no trust.
    Returns:
        The task, and (S,) actions of tabular agents, else the policy of the model.
    Raises:
        FileFormatError: the folder holds no finished run. ResultCorrupted: its files were cut short or changed.
        UntrustedCode: the run names code, and is not trusted.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    folder = Path(folder)
    record = _results.read_record(folder)
    if record.get("status") != "finished":
        raise FileFormatError(
            f"{folder}: the run is {record.get('status')}; the same command that began it finishes it"
        )
    _results.check_agent(folder)
    try:
        config = RunConfig.from_dict(record["config"])
        task = config.task(trust=trust)
        agent = config.algorithm(trust=trust)
    except UntrustedCode as error:
        raise UntrustedCode(f"{folder / 'run.json'}: {error}") from error
    except FileFormatError as error:
        raise FileFormatError(f"{folder / 'run.json'}: {error}") from error
    if config.is_tabular:
        try:
            check_regular(folder / "policy.npy")
            return task, np.load(folder / "policy.npy", allow_pickle=False)
        except Exception as error:  # the header is read as Python
            raise FileFormatError(f"{folder / 'policy.npy'}: cannot be read: {error}") from error
    from pharos.training.learners import Deep

    learner = Deep(agent, task, record["hyperparameters"], config.steps, config.seed, None)
    learner.load(folder / "agent")
    return task, learner.agent
