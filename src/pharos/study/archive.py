"""The finished runs of a study in one Parquet file, to be kept, published or carried to another machine; without the agents."""

import contextlib
import json
import os
import shutil
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from pharos.errors import FileFormatError, ParameterError
from pharos.experiments import run_id
from pharos.study import worker as _worker
from pharos.study.execution import claim, opened
from pharos.study.specification import Source, Specification, parse

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT = 1
_STUDY, _FORMAT = b"pharos.study", b"pharos.format"


def pack(source: Source, folder: str | os.PathLike | None = None, *, file: str | os.PathLike) -> int:
    """Write the finished runs of a study into one Parquet file; return how many.

    A row for each run: `id`; `record`, its run.json; and for each column of curve.parquet a list. The specification is among the
    metadata of the file. What agents learnt stays in the folder: some hundred kilobytes a run, where a row takes two.

    Raises:
        ParameterError: no run is finished. OSError: the file cannot be written; an older one then stays as it was.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    study, place = opened(source, folder)
    ids, records, curves = [], [], []
    for run in study.runs:
        record = _worker.read_record(place / "runs" / run.id)
        if record is not None and record["status"] == _worker.FINISHED:
            ids.append(run.id)
            records.append(json.dumps(record))
            curves.append(pq.read_table(place / "runs" / run.id / "curve.parquet"))
    if not ids:
        raise ParameterError(f"{place}: no run of {study.name!r} is finished; execute `pharos study run` first")
    columns: dict[str, Any] = {"id": pa.array(ids), "record": pa.array(records)}
    for field in pa.unify_schemas([curve.schema for curve in curves]):
        lists = [curve.column(field.name).to_pylist() if field.name in curve.column_names else None for curve in curves]
        columns[field.name] = pa.array(lists, pa.list_(field.type))
    text = yaml.safe_dump(study.model_dump(mode="json", exclude_unset=True), sort_keys=False, width=120)
    table = pa.table(columns).replace_schema_metadata({_STUDY: text.encode(), _FORMAT: str(FORMAT).encode()})
    file = Path(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        pq.write_table(table, temporary, compression="zstd")
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)
    return len(ids)


def unpack(
    file: str | os.PathLike, folder: str | os.PathLike | None = None, *, into: Source | None = None
) -> tuple[Path, int]:
    """Put the runs of a packed study into a folder, where `run` goes on with those that are missing and `report` reports on all.

    Args:
        file: written by `pack`.
        folder: of the study; studies/NAME in the current directory when not given. Runs that it has stay as they are.
        into: another study, which gets those of the runs that it has as well; None: the packed one.
    Returns:
        The folder, and how many runs were added.
    Raises:
        FileFormatError: not such a file, or a run in it is not one of its study. ParameterError: the folder holds another study.
    """
    file = Path(file)
    study, table = _read(file)
    target, place = opened(study if into is None else into, folder)
    configs, wanted = {run.id: run.config for run in study.runs}, {run.id for run in target.runs}
    runs = []
    for row in table.to_pylist():
        id, record = row.pop("id"), row.pop("record")
        runs.append((id, _checked(file, id, record, configs), _curve(file, id, row, table.schema)))
    claim(target, place)
    added = sum(_write(place, *run) for run in runs if run[0] in wanted)
    with contextlib.suppress(OSError):  # others may be at work there
        (place / "partial").rmdir()
    return place, added


def _read(file: Path) -> tuple[Specification, "pa.Table"]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(file)
    except FileNotFoundError:
        raise ParameterError(f"{file}: no such file") from None
    except (pa.ArrowException, OSError) as error:
        raise FileFormatError(
            f"{file}: not a Parquet file, or cut short ({str(error).splitlines()[0]}); fetch or pack it again"
        ) from error
    metadata = table.schema.metadata or {}
    if _STUDY not in metadata or not {"id", "record"} <= set(table.column_names):
        raise FileFormatError(f"{file}: not a packed study; expected a file made by `pharos study pack`")
    if metadata.get(_FORMAT) != str(FORMAT).encode():
        raise FileFormatError(
            f"{file}: format {metadata.get(_FORMAT, b'?').decode()} of packed studies; this version of pharos reads {FORMAT}"
        )
    return parse(metadata[_STUDY].decode(), str(file)), table


def _checked(file: Path, id: str, record: str, configs: dict[str, Any]) -> dict[str, Any]:
    """The record of a run, which must be a finished run of the study."""
    try:
        found = json.loads(record)
        config, status = found["config"], found["status"]
    except (ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"{file}: the record of run {id} cannot be read; fetch or pack the file again") from error
    if id not in configs or run_id(config) != id:
        raise FileFormatError(f"{file}: run {id} is not one of the study, or its configuration was changed")
    if status != _worker.FINISHED:
        raise FileFormatError(f"{file}: run {id} is {status!r}; expected finished runs")
    return found


def _curve(file: Path, id: str, row: dict[str, list | None], schema: "pa.Schema") -> "pa.Table":
    import pyarrow as pa

    columns = {name: values for name, values in row.items() if values is not None}
    lengths = {len(values) for values in columns.values()}
    if "step" not in columns or len(lengths) != 1:
        raise FileFormatError(f"{file}: the columns of the curve of run {id} differ in length, or have no steps")
    return pa.table({name: pa.array(values, schema.field(name).type.value_type) for name, values in columns.items()})


def _write(place: Path, id: str, record: dict[str, Any], curve: "pa.Table") -> bool:
    """Whether the run was added: a finished one that is there already stays."""
    import pyarrow.parquet as pq

    if _worker.read_status(place, id) == _worker.FINISHED:
        return False
    partial = place / "partial" / f"{id}.{uuid.uuid4().hex}"
    partial.mkdir(parents=True)
    try:
        pq.write_table(curve, partial / "curve.parquet")
        (partial / "run.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        _worker.publish(partial, place, id)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return True
