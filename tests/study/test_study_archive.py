"""Packed studies: what comes out is what went in, and nothing that was changed on the way gets in."""

import errno
import json
import os
import shutil
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import fake_training
from pharos import study
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from pharos.training import run_id
from refusals import failing, refusal

BLOCK = {
    "environments": ["frozen_lake/4x4"],
    "agents": ["dqn", "q_learning"],
    "chance": ["plain", {"sticky": 0.25}],
    "seeds": 2,
}
SPEC = {"name": "fake", "steps": 100, "evaluations": 10, "blocks": [BLOCK]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("study")
    study.run(SPEC, place, runner=fake_training.train, workers=2)
    return place


@pytest.fixture
def packed(folder, tmp_path):
    study.pack(folder, file=tmp_path / "fake.parquet")
    return tmp_path / "fake.parquet"


def changed(packed, **columns):
    """The packed study with other columns: functions of the lists that are there."""
    table = pq.read_table(packed)
    data = table.to_pydict()
    for name, change in columns.items():
        data[name] = change(data[name])
    pq.write_table(pa.table(data, schema=table.schema), packed)


def older(packed):
    """As versions of pharos before digests packed it."""
    table = pq.read_table(packed)
    metadata = {name: text for name, text in table.schema.metadata.items() if name != b"pharos.digests"}
    pq.write_table(table.replace_schema_metadata(metadata), packed)


def test_unpacked_runs_have_the_same_tables_and_curves(folder, packed, tmp_path):
    place, added = study.unpack(packed, tmp_path / "other")
    assert (place, added) == (tmp_path / "other", 8)
    same_study(place, folder)
    assert study.specification(place) == study.specification(folder)


def test_runs_are_unpacked_into_another_study_that_has_them(folder, packed, tmp_path):
    other = {**SPEC, "name": "lakes", "blocks": [{**BLOCK, "agents": ["dqn"], "seeds": 3}]}
    place, added = study.unpack(packed, tmp_path / "other", into=other)
    assert added == 4 and study.specification(place) == study.specification(other)
    status = study.status(place)
    assert (status.finished, status.missing) == (4, 2)
    theirs = study.table(folder).set_index("id")
    pd.testing.assert_frame_equal(study.table(place).set_index("id"), theirs[theirs["agent"] == "dqn"])


def test_what_is_missing_is_run_and_what_is_there_stays(packed, tmp_path, monkeypatch):
    changed(packed, **{name: lambda values: values[:5] for name in pq.read_schema(packed).names})
    older(packed)
    log = tmp_path / "log"
    monkeypatch.setenv("PHAROS_FAKE_LOG", str(log))
    place, _ = study.unpack(packed, tmp_path / "other")
    before = {path: path.stat().st_mtime_ns for path in place.rglob("run.json")}
    assert study.run(SPEC, place, runner=fake_training.train, workers=2).finished == 8
    assert len(log.read_text().split()) == 3
    assert study.unpack(packed, place)[1] == 0
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())


def test_a_study_without_finished_runs_is_not_packed_and_an_older_file_stays(folder, packed, tmp_path, monkeypatch):
    assert "no run of 'fake' is finished" in refusal(ParameterError, study.pack, SPEC, tmp_path / "empty", file=packed)
    old = packed.read_bytes()
    monkeypatch.setattr(pq, "write_table", failing(errno.ENOSPC))
    assert "No space left" in refusal(OSError, study.pack, folder, file=packed)
    assert packed.read_bytes() == old and os.listdir(tmp_path) == [packed.name]


def another_seed(records):
    first = json.loads(records[0])
    first["config"]["seed"] += 1
    return [json.dumps(first), *records[1:]]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"record": another_seed}, "is not one of the study, or its configuration was changed"),
        ({"record": lambda values: ["{", *values[1:]]}, "cannot be read"),
        ({"record": lambda values: [values[0].replace("finished", "failed"), *values[1:]]}, "expected finished runs"),
        ({"id": lambda values: ["0" * 16, *values[1:]]}, "is not one of the study"),
        ({"value": lambda values: [values[0][:-1], *values[1:]]}, "differ in length"),
        ({"step": lambda values: [None, *values[1:]]}, "have no steps"),
    ],
)
def test_files_that_were_changed_are_refused_before_anything_is_written(packed, tmp_path, columns, message):
    changed(packed, **columns)
    older(packed)
    assert message in refusal(FileFormatError, study.unpack, packed, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_files_that_are_something_else_are_refused(packed, tmp_path):
    assert "no such file" in refusal(ParameterError, study.unpack, tmp_path / "none.parquet")
    table = pq.read_table(packed)
    packed.write_bytes(packed.read_bytes()[:-100])
    assert "cut short" in refusal(FileFormatError, study.unpack, packed)
    pq.write_table(table.replace_schema_metadata({}), packed)
    assert "not a packed study" in refusal(FileFormatError, study.unpack, packed)
    pq.write_table(table.replace_schema_metadata({**table.schema.metadata, b"pharos.format": b"9"}), packed)
    assert "format 9" in refusal(FileFormatError, study.unpack, packed)


def test_a_folder_of_another_study_is_not_written_to(packed, tmp_path):
    study.run(SPEC | {"name": "other"}, tmp_path / "other", runner=fake_training.train, workers=2)
    assert "holds the study 'other'" in refusal(ParameterError, study.unpack, packed, tmp_path / "other")


def same_study(place, folder):
    pd.testing.assert_frame_equal(study.table(place), study.table(folder))
    pd.testing.assert_frame_equal(study.curves(place), study.curves(folder))


@pytest.mark.parametrize(
    "columns",
    [
        {"value": lambda values: [[number + 1 for number in values[0]], *values[1:]]},
        {"record": lambda values: [values[0].replace('"seconds": 0.5', '"seconds": 0.6'), *values[1:]]},
        {"record": lambda values: [values[0], *values[:0:-1]]},
        {"value": lambda values: values[::-1]},
    ],
)
def test_edited_runs_of_a_packed_study_are_refused(packed, tmp_path, columns):
    changed(packed, **columns)
    with pytest.raises(FileFormatError, match=r"run [0-9a-f]{16}"):
        study.unpack(packed, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_packed_study_whose_specification_was_edited_is_refused(packed, tmp_path):
    table = pq.read_table(packed)
    metadata = {**table.schema.metadata, b"pharos.study": table.schema.metadata[b"pharos.study"] + b"\n# more\n"}
    pq.write_table(table.replace_schema_metadata(metadata), packed)
    with pytest.raises(ResultCorrupted, match="was changed after it was packed; fetch or pack it again"):
        study.unpack(packed, tmp_path / "other")


def test_a_run_left_out_of_a_packed_study_is_missed(packed, tmp_path):
    changed(packed, **{name: lambda values: values[1:] for name in pq.read_schema(packed).names})
    assert "the list of its runs, was changed" in refusal(ResultCorrupted, study.unpack, packed, tmp_path / "other")


def test_packed_studies_of_older_versions_are_read(folder, packed, tmp_path):
    older(packed)
    place, added = study.unpack(packed, tmp_path / "other")
    assert added == 8
    same_study(place, folder)


LARGE = Path(__file__).parents[2] / "docs" / "studies" / "classes" / "large.parquet"


@pytest.mark.long
def test_a_study_packed_when_the_library_had_other_hyperparameters_is_read_with_those(tmp_path):
    place, added = study.unpack(LARGE, tmp_path / "large")
    status = study.status(place)
    assert (added, status.finished, status.missing) == (100, 100, 0)
    again = study.pack(place, file=tmp_path / "again.parquet")
    assert again == study.unpack(tmp_path / "again.parquet", tmp_path / "again")[1] == 100


@pytest.mark.parametrize("change", [{"learning_rate": 0.00026}, {"n_steps": 5}])
def test_hyperparameters_that_the_library_never_had_are_refused(tmp_path, change):
    copy = Path(shutil.copy(LARGE, tmp_path))
    rows = pq.read_table(copy).to_pydict()
    number = next(i for i, record in enumerate(rows["record"]) if '"learning_rate": 0.00025' in record)
    record = json.loads(rows["record"][number])
    record["config"]["hyperparameters"] |= change
    record["id"] = run_id(record["config"])
    texts = {"record": json.dumps(record), "id": record["id"]}
    columns = {name: lambda old, new=new: [*old[:number], new, *old[number + 1 :]] for name, new in texts.items()}
    changed(copy, **columns)
    with pytest.raises(FileFormatError, match="is not one of the study, or its configuration was changed"):
        study.unpack(copy, tmp_path / "large")


def test_damaged_runs_are_not_packed(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    file = sorted(copy.glob("runs/*/curve.parquet"))[0]
    file.write_bytes(file.read_bytes()[:-100])
    assert "cut short" in refusal(ResultCorrupted, study.pack, copy, file=tmp_path / "fake.parquet")
    assert not (tmp_path / "fake.parquet").exists()
