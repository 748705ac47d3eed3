"""The finished runs of a study, without their agents, in one Parquet file to keep, publish or carry elsewhere."""

import contextlib
import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from pharos import training
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from pharos.study import worker as _worker
from pharos.study.execution import opened, write_specification
from pharos.study.specification import Source, Specification, parse
from pharos.system import storage
from pharos.training import run_id

if TYPE_CHECKING:
    import pyarrow as pa

ARCHIVE_FORMAT = 1
STEP_COLUMNS = ("step",)
_STUDY, _FORMAT_KEYS, _DIGESTS = b"pharos.study", b"pharos.format", b"pharos.digests"
_FETCH_AGAIN = "fetch or pack it again"
EARLIER_HYPERPARAMETERS = {
    "dqn": {
        "breakout": {
            "vector": {
                "learning_rate": 0.00025,
                "buffer_size": 100000,
                "learning_starts": 5000,
                "batch_size": 32,
                "gamma": 0.99,
                "train_freq": 4,
                "gradient_steps": 1,
                "target_update_interval": 1000,
                "exploration_initial_eps": 1.0,
                "exploration_final_eps": 0.02,
                "exploration_fraction": 0.1,
                "max_grad_norm": 10,
            }
        }
    }
}
"""Hyperparameters that the library had once, by agent, class and observation. Whoever changes those of the library adds
here what they were, so that studies which were packed before can be read."""


def pack(source: Source, folder: str | os.PathLike | None = None, *, file: str | os.PathLike) -> int:
    """Write the finished runs of a study into one Parquet file, and return how many.

    A row for each run: `id`; `record`, its run.json; and for each column of the curve a list. Among the metadata of
    the file are the specification, its digest, and a digest of each run. What agents learnt stays in the folder: some
    hundred kilobytes a run, while a row takes two. Files of code are named relative to the specification, or by their
    name alone if they are elsewhere, with their checksums. No path of this machine is stored.

    Raises:
        ParameterError: no run is finished. OSError: the file cannot be written. An older one then stays as it was.
    """
    import pyarrow as pa

    study, directory = opened(source, folder)
    ids, records, curves = [], [], []
    for run in study.runs:
        record = _worker.run_record(directory / "runs" / run.id)
        if record is not None and record["status"] == _worker.FINISHED:
            ids.append(run.id)
            records.append(json.dumps(_placeless(record, study.folder)))
            curves.append(training.read_curve_table(directory / "runs" / run.id, STEP_COLUMNS))
    if not ids:
        raise ParameterError(f"{directory}: no run of {study.name!r} is finished; execute `pharos study run` first")
    columns: dict[str, Any] = {"id": pa.array(ids), "record": pa.array(records)}
    for field in pa.unify_schemas([curve.schema for curve in curves]):
        lists = [curve.column(field.name).to_pylist() if field.name in curve.column_names else None for curve in curves]
        columns[field.name] = pa.array(lists, pa.list_(field.type))
    text = study.to_yaml(folder=".")
    runs = zip(ids, records, curves, strict=True)
    digests = {"study": storage.digest_of_json(text), "runs": {id: _digest(id, *rest) for id, *rest in runs}}
    metadata = {
        _STUDY: text.encode(),
        _FORMAT_KEYS: str(ARCHIVE_FORMAT).encode(),
        _DIGESTS: json.dumps(digests).encode(),
    }
    file = Path(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    training.write_table(file, pa.table(columns).replace_schema_metadata(metadata), follow=True)
    return len(ids)


def _placeless(record: dict[str, Any], folder: str | None) -> dict[str, Any]:
    """A record whose files of code are named relative to the folder of the specification."""
    sources = record["config"].get("sources")
    if not sources:
        return record
    moved = {}
    for part, source in sources.items():
        file = Path(source["file"])
        within = folder is not None and file.is_relative_to(folder)
        inside = file.relative_to(str(folder)) if within else Path(file.name)
        moved[part] = {**source, "file": inside.as_posix()}
    record = {**record, "config": {**record["config"], "sources": moved}}
    return storage.sealed(record) if storage.DIGEST in record else record


def unpack(
    file: str | os.PathLike,
    folder: str | os.PathLike | None = None,
    *,
    into: Source | None = None,
    trust: bool = False,
) -> tuple[Path, int]:
    """Put the runs of a packed study into a folder, for `run` to go on with and for `report` to report on.

    Args:
        file: written by `pack`.
        folder: of the study. Default: studies/NAME in the current directory. Runs that it has stay as they are.
        into: another study, which gets the runs that it has as well. Default: the packed one, with the defaults
            of hyperparameters that it was packed with.
        trust: whether code that the packed study names may be imported, from beside the file. `into` is read in its
            place.
    Returns:
        The folder, and how many runs were added.
    Raises:
        FileFormatError: not such a file, or a run in it is not one of its study. ParameterError: the folder holds
            another study. UntrustedCode: the packed study names code, and is not trusted.
    """
    file = Path(file)
    text, table, digests = _read(file)
    target, directory = opened(_study(file, text, table, trust) if into is None else into, folder, trust=trust or None)
    wanted = {run.id for run in target.runs}
    runs = []
    for row in _rows(file, table):
        id, record = row.pop("id"), row.pop("record")
        run = id, _checked(file, id, record, wanted if into is None else None), _curve(file, id, row, table.schema)
        if digests is not None and digests["runs"].get(id) != _digest(id, record, run[2]):
            raise ResultCorrupted(f"{file}: run {id} was changed after it was packed; {_FETCH_AGAIN}")
        runs.append(run)
    write_specification(target, directory)
    added = sum(_write(directory, *run) for run in runs if run[0] in wanted)
    with contextlib.suppress(OSError):  # others may be at work there
        (directory / "partial").rmdir()
    return directory, added


def _read(file: Path) -> tuple[str, "pa.Table", dict[str, Any] | None]:
    """The study in YAML, its runs, and the digests of both, with None in place of digests if an older version packed
    it."""
    if not file.exists():
        raise ParameterError(f"{file}: no such file")
    table = training.read_table(file, _FETCH_AGAIN)
    metadata = table.schema.metadata or {}
    if _STUDY not in metadata or not {"id", "record"} <= set(table.column_names):
        raise FileFormatError(f"{file}: not a packed study; expected a file made by `pharos study pack`")
    if metadata.get(_FORMAT_KEYS) != str(ARCHIVE_FORMAT).encode():
        raise FileFormatError(
            f"{file}: format {metadata.get(_FORMAT_KEYS, b'?').decode(errors='replace')} of packed studies; "
            f"this version of pharos reads {ARCHIVE_FORMAT}"
        )
    try:
        text = metadata[_STUDY].decode()
        digests = json.loads(metadata[_DIGESTS]) if _DIGESTS in metadata else None
        if digests is not None and (
            digests["study"] != storage.digest_of_json(text) or set(digests["runs"]) != set(table["id"].to_pylist())
        ):
            raise ValueError("its study, or the list of its runs, was changed after it was packed")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ResultCorrupted(f"{file}: its description cannot be read: {error}; {_FETCH_AGAIN}") from None
    return text, table, digests


def _study(file: Path, text: str, table: "pa.Table", trust: bool) -> Specification:
    """The packed study, with the defaults of hyperparameters that the library had when it was packed."""
    study = parse(text, str(file), folder=file.absolute().parent, trust=trust)
    if not study.defaults and not set(table["id"].to_pylist()) <= {run.id for run in study.runs}:
        defaults = yaml.safe_dump({"defaults": EARLIER_HYPERPARAMETERS})
        return parse(f"{text}\n{defaults}", str(file), folder=file.absolute().parent, trust=trust)
    return study


def _rows(file: Path, table: "pa.Table") -> list[dict[str, Any]]:
    try:
        return table.to_pylist()
    except (ValueError, TypeError) as error:  # text that is none
        raise ResultCorrupted(f"{file}: its rows cannot be read: {error}; {_FETCH_AGAIN}") from None


def _digest(id: str, record: str, curve: "pa.Table") -> str:
    """Digest of a run: of its id, its record as text, and the values of its curve."""
    return storage.digest_of_json([id, record, training.digest_of_curve(curve)])


def _checked(file: Path, id: str, record: str, ids: set[str] | None) -> dict[str, Any]:
    """The record of a run, which must be finished, and one of `ids`."""
    try:
        entry = json.loads(record)
        config, status = entry["config"], entry["status"]
        if not storage.is_intact(entry):
            raise ValueError("it was changed after it was written")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ResultCorrupted(f"{file}: the record of run {id} cannot be read: {error}; {_FETCH_AGAIN}") from None
    if (ids is not None and id not in ids) or run_id(config) != id:
        raise FileFormatError(f"{file}: run {id} is not one of the study, or its configuration was changed")
    if status != _worker.FINISHED:
        raise FileFormatError(f"{file}: run {id} is {status!r}; expected finished runs")
    return entry


def _curve(file: Path, id: str, row: dict[str, list | None], schema: "pa.Schema") -> "pa.Table":
    import pyarrow as pa

    columns = {name: values for name, values in row.items() if values is not None}
    try:
        if not set(STEP_COLUMNS) <= set(columns) or len({len(values) for values in columns.values()}) != 1:
            raise ValueError("its columns differ in length, or have no steps")
        return pa.table(
            {name: pa.array(values, schema.field(name).type.value_type) for name, values in columns.items()}
        )
    except (ValueError, TypeError, AttributeError, pa.ArrowException) as error:
        raise FileFormatError(f"{file}: the curve of run {id} cannot be read: {error}; {_FETCH_AGAIN}") from None


def _write(directory: Path, id: str, record: dict[str, Any], curve: "pa.Table") -> bool:
    """Write a run into the folder. False if a finished one is there already, which stays."""
    target = directory / "partial" / id
    storage.remove_leftovers(target)
    if _worker.read_status(directory / "runs" / id) == _worker.FINISHED:
        return False
    partial = storage.temporary_path(target)
    partial.mkdir(parents=True)
    try:
        if "curve.csv" in record.get("checksums", {}):
            training.write_curve(partial, curve.to_pylist())
        else:
            training.write_table(partial / "curve.parquet", curve)
        storage.replace_json(partial / "run.json", record)
        _worker.publish_run(partial, directory, id)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return True
