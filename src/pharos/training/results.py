"""The folder of a run: record and checkpoints while it is trained, result and agent once it is finished.

run.json and curve.csv are each written whole or not at all, with digests. Nothing is pickled. Earlier runs have their
curve in curve.parquet, with the same columns, values to the last bit and digest. It is read.
"""

import contextlib
import csv
import importlib.util
import io
import json
import math
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import NETWORK, POLICY, Learner, agent_called, agents, read_policy_table
from pharos.errors import FileFormatError, MissingExtra, ParameterError, ResultCorrupted, UntrustedCode
from pharos.system import storage
from pharos.system.sources import is_reference
from pharos.system.storage import CLAIM, LOCK, check_regular, digest_of_bytes, digest_of_file, read_json, sync
from pharos.training.task import RunConfig, Task, run_id

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


RECORD_FORMAT = 1
RECORD, CURVE, EARLIER_CURVE = "run.json", "curve.csv", "curve.parquet"
RUN_AGAIN = "delete the folder and execute the run again"
ANEW = "delete the folder to start anew"
RUN_CHECKPOINT_SECONDS = 10.0
# Writing checkpoints takes at most this share of the time
SHARE_OF_TIME = 0.05
_ID = re.compile(r"[0-9a-f]{16}")
CURVE_COLUMNS = {
    "step": "int64",
    "episodes": "int64",
    "value": "float64",
    "expected_regret": "float64",
    "cumulative_expected_regret": "float64",
    "normalized_regret": "float64",
    "mean_return": "float64",
    "realised_regret": "float64",
    "cumulative_realised_regret": "float64",
    "exact": "bool",
    "error_bound": "float64",
}
"""Columns of curve.csv, a row for each evaluation. docs/agents.md defines them."""
AVERAGE_COLUMNS = dict.fromkeys(("gain_lower", "gain_upper", "average_regret_lower", "average_regret_upper"), "float64")
"""Further columns of runs that measure the average reward a step in the long run."""
ALL_COLUMNS = CURVE_COLUMNS | AVERAGE_COLUMNS
_TYPES: dict[str, Callable[[Any], Any]] = {"int64": int, "float64": float, "bool": bool}
_TRUTHS = {"True": True, "False": False}


def versions() -> dict[str, str]:
    """Versions of Python, pharos and the packages that a result depends on."""
    import platform
    from importlib import metadata

    import pharos

    numbers = {"pharos": pharos.__version__, "python": platform.python_version()}
    for name in ("numpy", "numba", "gymnasium", "stable-baselines3", "torch"):
        try:
            numbers[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return numbers


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """Replace run.json in one step. Numbers that JSON cannot say are null.

    The record gets a `digest` of all that it says. The record of a finished run also has `checksums` of the other files
    of the run, which are written before it: of `curve.csv` (see `digest_of_curve`), and of what the agent has learnt;
    and `written`, the date.
    """
    if record.get("status") == "finished":
        written = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        record = {**record, "checksums": _checksums(folder), "written": written}
    storage.replace_json(folder / RECORD, storage.sealed(record))


def write_curve(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Replace curve.csv in one step. The same rows give the same bytes.

    Numbers are the shortest decimals that mean the same float64.
    """
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    columns = {
        name: dtype for name, dtype in ALL_COLUMNS.items() if name in CURVE_COLUMNS or (rows and name in rows[0])
    }
    writer.writerow(columns)
    writer.writerows([repr(_TYPES[dtype](row[name])) for name, dtype in columns.items()] for row in rows)
    storage.replace_file(folder / CURVE, lines.getvalue())
    (folder / EARLIER_CURVE).unlink(missing_ok=True)


def _has_pyarrow() -> bool:
    try:
        return importlib.util.find_spec("pyarrow") is not None
    except ValueError:  # its place in sys.modules is taken
        return False


def read_record(folder: str | os.PathLike) -> dict[str, Any]:
    """Return the record in run.json.

    Raises:
        FileFormatError: there is none, or it is not of a run. ResultCorrupted: it was cut short or changed after it was
        written, or the folder has the name of another run.
    """
    path = Path(folder) / RECORD
    try:
        record = storage.read_json(path, ResultCorrupted, RUN_AGAIN)
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file; expected the folder of a run") from None
    if (
        not isinstance(record, dict)
        or record.get("format") != RECORD_FORMAT
        or not isinstance(record.get("config"), dict)
    ):
        raise FileFormatError(f"{path}: is not the record of a run in format {RECORD_FORMAT}")
    if not storage.is_intact(record):
        raise ResultCorrupted(f"{path}: was changed after it was written; {RUN_AGAIN}")
    id, name = run_id(record["config"]), path.absolute().parent.name
    if (
        storage.DIGEST in record and "id" in record
    ):  # what was written says so; a configuration may hold infinite numbers
        id = record["id"]
    elif record.get("id", id) != id:
        raise ResultCorrupted(
            f"{path}: says that it is run {record['id']}, but its configuration is that of run {id}; {RUN_AGAIN}"
        )
    if _ID.fullmatch(name) and name != id:
        raise ResultCorrupted(f"{path}: holds run {id}, in the folder of run {name}; move it back, or delete it")
    return record


def read_curve(folder: str | os.PathLike, *, columns: Iterable[str] = tuple(CURVE_COLUMNS)) -> "pd.DataFrame":
    """Return the evaluations of a run, a row each, as `read_curve_table` does."""
    curve = _read_curve(Path(folder), columns)
    if isinstance(curve, dict):
        import pandas as pd

        return pd.DataFrame(curve)
    return curve.to_pandas()


def read_curve_table(folder: str | os.PathLike, columns: Iterable[str] = tuple(CURVE_COLUMNS)) -> "pa.Table":
    """Return the evaluations of a run, a row each, as an Arrow table.

    Args:
        columns: those that must be there.
    Raises:
        FileFormatError: there are none, or columns are missing. ResultCorrupted: the file was cut short or changed
        after it was written, or belongs to another run. MissingExtra: pyarrow is not installed.
    """
    curve = _read_curve(Path(folder), columns)
    if isinstance(curve, dict):
        import pyarrow as pa

        return pa.table(curve)
    return curve


def read_rows(folder: str | os.PathLike, columns: Iterable[str] = tuple(CURVE_COLUMNS)) -> list[dict[str, Any]]:
    """Return the evaluations of a run, a dictionary each, as `read_curve_table`. curve.csv needs no pyarrow."""
    curve = _read_curve(Path(folder), columns)
    if isinstance(curve, dict):
        values = (column.tolist() for column in curve.values())
        return [dict(zip(curve, row, strict=True)) for row in zip(*values, strict=True)]
    return curve.to_pylist()


def _read_curve(folder: Path, columns: Iterable[str]) -> "dict[str, np.ndarray] | pa.Table":
    """The curve of a run, compared with its digest: columns of curve.csv, or the table of an earlier Parquet file."""
    path = _curve_file(folder)
    curve = _read_text(path) if path.name == CURVE else read_table(path)
    names = curve if isinstance(curve, dict) else curve.column_names
    missing = [name for name in columns if name not in names]
    if missing:
        raise FileFormatError(f"{path}: lacks the columns {', '.join(missing)}")
    _check_digest(path, curve if isinstance(curve, dict) else _columns_of(curve))
    return curve


def _curve_file(folder: Path) -> Path:
    """The file that has the curve: curve.csv, or the Parquet file of an earlier run or of a study's own runner."""
    earlier = folder / EARLIER_CURVE
    return earlier if earlier.exists() and not (folder / CURVE).exists() else folder / CURVE


def _read_text(path: Path) -> dict[str, np.ndarray]:
    """Columns of a curve.csv by name.

    Raises:
        FileFormatError: there is none. ResultCorrupted: it was cut short or changed.
    """
    read: dict[str, Callable[[str], Any]] = {"int64": int, "float64": float, "bool": _TRUTHS.__getitem__}
    try:
        check_regular(path)
        with open(path, encoding="utf-8", newline="") as file:
            text = file.read()
        if not text.endswith("\n"):
            raise ValueError("its last line has no end")
        head, *rows = csv.reader(io.StringIO(text), strict=True)
        return {
            name: np.array([read[ALL_COLUMNS[name]](text) for text in column], ALL_COLUMNS[name])
            for name, column in zip(head, zip(*rows, strict=True) if rows else [()] * len(head), strict=True)
        }
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file; expected the folder of a finished run") from None
    except (OSError, ValueError, KeyError, csv.Error) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ResultCorrupted(f"{path}: cannot be read, it was cut short or changed: {reason}; {RUN_AGAIN}") from None


def _check_digest(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    if (path.parent / RECORD).exists():
        expected = _expected_checksums(path.parent).get(path.name)
        if expected is not None and _digest_of_columns(columns) != expected:
            raise ResultCorrupted(f"{path}: does not match its checksum in {RECORD}; {RUN_AGAIN}")


def check_agent_files(folder: Path) -> None:
    """Check the files of the trained agent against the checksums in run.json.

    Raises:
        ResultCorrupted: one is missing or was changed after it was written.
    """
    for name, expected in _expected_checksums(folder).items():
        if name in (CURVE, EARLIER_CURVE):
            continue
        try:
            digest = storage.digest_of_file(folder / name)
        except OSError as error:
            raise ResultCorrupted(f"{folder / name}: cannot be read: {error.strerror}; {RUN_AGAIN}") from None
        if digest != expected:
            raise ResultCorrupted(f"{folder / name}: was changed after it was written; {RUN_AGAIN}")


def write_table(path: Path, table: "pa.Table", *, follow: bool = False) -> None:
    """Replace a Parquet file in one step, with checksums of its pages, see `storage.replacing`."""
    import pyarrow.parquet as pq

    with storage.replacing(path, follow=follow) as file:
        pq.write_table(table, file, compression="zstd", write_page_checksum=True)


def read_table(path: Path, advice: str = RUN_AGAIN) -> "pa.Table":
    """Read a Parquet file, and compare its pages with their checksums.

    Raises:
        FileFormatError: there is no such file. ResultCorrupted: it cannot be read. The message ends with the advice.
        MissingExtra: pyarrow is not installed.
    """
    if not _has_pyarrow():
        raise MissingExtra(f"reading {path}", "pyarrow", "study")
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        storage.check_regular(path)  # and opened here, as its name need not be UTF-8
        with open(path, "rb") as stored, pq.ParquetFile(stored, page_checksum_verification=True) as file:
            return file.read(use_threads=False)  # in half the time of pq.read_table, for small files
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file; expected the folder of a finished run") from None
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ResultCorrupted(f"{path}: cannot be read, it was cut short or changed: {reason}; {advice}") from None


def digest_of_curve(table: "pa.Table") -> str:
    """XXH3-128 of the columns of a curve, whatever their order or the version of Parquet that holds them.

    For each column, by name: its name, type and number of rows, and its values as little-endian int64, float64 (NaN
    if there is none) or bytes of truth. Other types are JSON.
    """
    return _digest_of_columns(_columns_of(table))


def _columns_of(table: "pa.Table") -> dict[str, np.ndarray]:
    return {name: table.column(name).to_numpy() for name in table.column_names}


def _digest_of_columns(columns: Mapping[str, np.ndarray]) -> str:
    import xxhash

    digest = xxhash.xxh3_128()
    for name, values in sorted(columns.items()):
        rows, kind = len(values), values.dtype.kind
        if kind == "f":
            values = np.where(np.isnan(values), np.nan, values).astype("<f8")
        elif kind in "iu":
            values = values.astype("<i8")
        elif kind == "b":
            values = values.astype("|u1")
        else:
            text = storage.json_text(values.tolist())
            kind, values = "O", np.frombuffer(text.encode(), "|u1")
        digest.update(f"{name}:{kind}:{rows}:".encode())
        digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()


def _checksums(folder: Path) -> dict[str, str]:
    """Checksums of the files of a finished run, by their names within its folder."""
    checksums = {}
    if (curve := _curve_file(folder)).exists():
        columns = _read_text(curve) if curve.name == CURVE else _columns_of(read_table(curve))
        checksums[curve.name] = _digest_of_columns(columns)
    for path in (folder / POLICY, *sorted((folder / NETWORK).rglob("*"))):
        if path.is_file():
            storage.sync(path)
            checksums[path.relative_to(folder).as_posix()] = storage.digest_of_file(path)
    return checksums


def _expected_checksums(folder: Path) -> dict[str, str]:
    checksums = read_record(folder).get("checksums", {})
    if not isinstance(checksums, dict):
        raise ResultCorrupted(f"{folder / RECORD}: its checksums are none; {RUN_AGAIN}")
    return checksums


def write_policy(folder: Path, policy: object) -> None:
    """Replace policy.npy: the policy of a tabular agent, as `pharos evaluate --policy` takes it."""
    storage.replace_array(folder / POLICY, policy)


# Checkpoints and agents -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrainingResult:
    """Result of a run: its summary, curve and agent.

    Attributes:
        config: of the run.
        result: summary: values of the optimal, uniform, worst and final policy, regrets, episodes.
        curve: a row for each evaluation, a dictionary with the columns of curve.csv.
        agent: the trained agent: a `QLearning` or a model of Stable-Baselines3. None if the run was finished before.
        folder: of the run, or None.
        seconds: time that it took, without compiling.
        notes: sentences on what looks like a mistake of a function of the user's own, by kind.
    """

    config: dict[str, Any]
    result: dict[str, Any]
    curve: list[dict[str, Any]]
    agent: Any
    folder: Path | None
    seconds: float
    notes: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        config, result = self.config, self.result
        numbers = (f"{name}={result[name]}" for name in ("final_value", "value_optimal", "normalized_regret"))
        title = f"{config['agent']} on {config['environment']}, steps={config['steps']}"
        return f"TrainingResult({title}, {', '.join(numbers)}, seconds={self.seconds:.2f})"


def finished_result(folder: Path, config: RunConfig) -> TrainingResult | None:
    """The result in a folder, or None if there is none. ParameterError if it belongs to another run."""
    if not (folder / "run.json").exists():
        return None
    record = read_record(folder)
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
    rows = read_rows(folder)
    notes = record.get("notes", {})
    return TrainingResult(record["config"], record["result"], rows, None, folder, record["seconds"], notes)


def clear_run(folder: Path) -> None:
    """Remove checkpoints and locks of a finished run, also those that a kill left while they were replaced."""
    for leftover in folder.glob("checkpoint*"):
        shutil.rmtree(leftover, ignore_errors=True)
    for name in (LOCK, CLAIM):  # whoever waits for it finds a finished run
        with contextlib.suppress(OSError):
            (folder / name).unlink()


def _digests(folder: Path) -> dict[str, str]:
    """The digest of each file below a folder, but for the one that holds the digests."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / "curve.json")
    return {path.relative_to(folder).as_posix(): digest_of_file(path) for path in files}


def _record_digest(record: Mapping[str, Any]) -> str:
    """Digest of a record that may hold infinities and NaN."""
    return digest_of_bytes(json.dumps(record, sort_keys=True).encode())


class Checkpoint:
    """A folder that holds the last checkpoint, replaced in one step."""

    def __init__(self, folder: Path, id: str):
        self.folder, self.id = folder, id
        self._next = -math.inf

    def save(self, learner: Learner, curves: Callable[[], list[Any]], seconds: float) -> None:
        """Write a checkpoint, unless the last is not ten seconds old, or writing would take more than SHARE_OF_TIME.

        Args:
            curves: returns the rows so far, for which it may have to wait.
        """
        began = time.monotonic()
        if began < self._next:
            return
        rows = curves()
        partial = self.folder.with_name(f"{self.folder.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        learner.save(partial)
        record = {"id": self.id, "rows": rows, "seconds": seconds, "files": _digests(partial)}
        (partial / "curve.json").write_text(json.dumps({**record, "digest": _record_digest(record)}))
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
        self._next = now + max(RUN_CHECKPOINT_SECONDS, (now - began) / SHARE_OF_TIME if RUN_CHECKPOINT_SECONDS else 0.0)

    def restore(self, learner: Learner) -> tuple[list[Any], float] | None:
        """(rows of the curve, seconds spent) of the last checkpoint, from which the learner goes on, or None.

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
                if digest is not None and (digest != _record_digest(record) or record["files"] != _digests(folder)):
                    raise FileFormatError(
                        f"{folder}: cannot be resumed from: it was changed after it was written; {ANEW}"
                    )
                learner.load(folder)
                return record["rows"], record["seconds"]
        return None


def load_agent(folder: str | os.PathLike, *, trust: bool = False) -> tuple[Task, Any]:
    """The task of a finished run, and its policy, as `evaluate_agent` and `pharos.evaluate_policy` take it.

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
    from pharos.training.schedule import PreparedRun, TaskCache

    folder = Path(folder)
    record = read_record(folder)
    if record.get("status") != "finished":
        raise FileFormatError(
            f"{folder}: the run is {record.get('status')}; the same command that began it finishes it"
        )
    check_agent_files(folder)
    try:
        config = RunConfig.from_dict(record["config"])
        task = config.task(trust=trust)
        if config.agent not in agents() and not is_reference(config.agent):  # the label of a loop of the user's own
            return task, _policy_of_loop(folder)
        tasks = TaskCache(trust=trust)
        tasks.adopt(config, task)
        run = PreparedRun(None, config, None, tasks)
        run.hyperparameters = record["hyperparameters"]
        _ = run.algorithm  # or what is wrong with it
    except UntrustedCode as error:
        raise UntrustedCode(f"{folder / 'run.json'}: {error}") from error
    except FileFormatError as error:
        raise FileFormatError(f"{folder / 'run.json'}: {error}") from error
    return task, agent_called(config.agent).load(folder, run)


def _policy_of_loop(folder: Path) -> np.ndarray:
    """The last table that a `pharos.Run` has recorded. FileFormatError: it has recorded something else."""
    if not (folder / POLICY).exists():
        raise FileFormatError(
            f"{folder}: a loop of your own keeps its policy if that is a table of states; record one, or save your "
            "network yourself, and give it to pharos.evaluate_policy"
        )
    return read_policy_table(folder)
