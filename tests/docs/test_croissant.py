"""docs/studies/croissant.json describes the packed studies that are there."""

import hashlib
import importlib
import json
import shutil
from pathlib import Path

import pytest

pq = pytest.importorskip("pyarrow.parquet")
ROOT = Path(__file__).parents[2]
STUDIES = ROOT / "docs" / "studies"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    return importlib.import_module("croissant")


def test_metadata_are_those_of_the_files(script, capsys, packed_runs):
    assert script.main(["--check"]) == 0, capsys.readouterr().out
    document = json.loads((STUDIES / "croissant.json").read_text())
    records = {record["field"][0]["source"]["fileObject"]["@id"]: record for record in document["recordSet"]}
    assert len(records) == len(document["recordSet"]) == len(document["distribution"]) >= 4
    for file in document["distribution"]:
        path = STUDIES / file["contentUrl"]
        assert hashlib.sha256(path.read_bytes()).hexdigest() == file["sha256"]
        columns = {field["source"]["extract"]["column"]: field for field in records[file["@id"]]["field"]}
        schema = pq.read_schema(path)
        assert list(columns) == schema.names
        for name, field in columns.items():
            assert field["description"]
            assert field.get("repeated", False) == str(schema.field(name).type).startswith("list<")


def test_changed_studies_need_new_metadata(script, tmp_path, monkeypatch, capsys, packed_runs):
    (tmp_path / "docs" / "studies" / "one_hot").mkdir(parents=True)
    studies = tmp_path / "docs" / "studies"
    for name in ("CITATION.cff", "docs/agents.md", "docs/studies/one_hot/runs.parquet"):
        shutil.copy(ROOT / name, tmp_path / name)
    for name, value in {"ROOT": tmp_path, "STUDIES": studies, "FILE": studies / "croissant.json"}.items():
        monkeypatch.setattr(script, name, value)
    assert script.main(["--check"]) == 1
    assert script.main([]) == script.main(["--check"]) == 0
    path = studies / "one_hot" / "runs.parquet"
    table = pq.read_table(path)
    pq.write_table(table.slice(1).replace_schema_metadata(table.schema.metadata), path)
    assert script.main(["--check"]) == 1
    assert "run python scripts/croissant.py" in capsys.readouterr().out


def test_the_format_accepts_the_metadata(packed_runs):
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = mlcroissant.Dataset(STUDIES / "croissant.json")
    assert not dataset.metadata.ctx.issues.errors
    record = next(iter(dataset.records("one_hot-runs")))
    row = pq.read_table(STUDIES / "one_hot" / "runs.parquet").slice(0, 1).to_pylist()[0]
    assert record["one_hot-runs/id"] == row["id"].encode()
    assert list(record["one_hot-runs/step"]) == row["step"]
