"""Values that are solved once for all runs are those that each run would have found."""

import json
import shutil
from dataclasses import asdict

import pytest

from pharos import study
from pharos.study import execution as _execution
from pharos.study import values as _values
from pharos.system.paths import cache_directory
from pharos.system.storage import sealed
from pharos.training import train_config


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A cache for these tests, so that they find nothing there, but compile the rules once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def config(cache, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(cache))
    shutil.rmtree(cache / "values", ignore_errors=True)
    block = {"environments": ["frozen_lake/4x4"], "chance": [{"sticky": 0.25}], "agents": ["q_learning"], "seeds": 1}
    return study.specification({"name": "a", "steps": 300, "evaluations": 3, "blocks": [block]}).runs[0].config


def test_kept_values_are_those_of_the_task_to_the_last_bit(config):
    assert _values.stored_values(config) is None
    found = _values.solve(config)
    task = _values.task_of(config)
    assert found == {"reference": asdict(task.reference), "return_range": list(task.return_range)}
    assert _values.stored_values(config) == found == _values.solve(config)


def test_a_run_with_kept_values_ends_with_the_same_files(config, tmp_path):
    train_config(config, tmp_path / "alone")
    _execution.prepare_instance(config)
    assert _values.stored_values(config) is not None
    _execution.train(config, tmp_path / "prepared")
    for name in ("curve.parquet", "policy.npy"):
        assert (tmp_path / "alone" / name).read_bytes() == (tmp_path / "prepared" / name).read_bytes()
    results = [json.loads((tmp_path / name / "run.json").read_text())["result"] for name in ("alone", "prepared")]
    assert results[0] == results[1]


@pytest.mark.parametrize(
    "change", [{"gamma": 0.9}, {"horizon": 50}, {"chance": {"sticky": 0.0, "random": 0.1}}, {"parameters": {"size": 8}}]
)
def test_another_setting_has_values_of_its_own(config, change):
    _values.solve(config)
    assert _values.stored_values({**config, **change}) is None


def test_another_seed_agent_or_observation_shares_them(config):
    found = _values.solve(config)
    assert _values.stored_values({**config, "seed": 7, "agent": "dqn", "observation": "vector", "steps": 9}) == found


@pytest.mark.parametrize(
    "change", [lambda text: text.replace("0.", "0.1", 1), lambda text: text[:40], lambda text: "[" * 9999]
)
def test_stored_values_that_were_changed_are_solved_again(change, config):
    values = _values.solve(config)
    (file,) = (cache_directory() / "values").iterdir()
    text = file.read_text()
    start = text.index('"values"')
    file.write_text(text[:start] + change(text[start:]) if "values" in change(text) else change(text))
    assert _values.stored_values(config) is None
    assert _values.solve(config) == values == _values.stored_values(config)


def test_values_that_an_earlier_pharos_has_kept_are_read_on(config):
    values = _values.solve(config)
    (file,) = (cache_directory() / "values").iterdir()
    record = json.loads(file.read_text())
    entry = {"values": record.pop("values"), "task": {name: record[name] for name in record if name != "digest"}}
    file.write_text(json.dumps(sealed(entry)))
    assert _values.stored_values(config) == values


def test_values_of_other_rules_are_not_taken(config, monkeypatch):
    _values.solve(config)
    monkeypatch.setattr("pharos.rules.fingerprint_of_rules", lambda env, names: "other")
    assert _values.stored_values(config) is None


@pytest.mark.long
def test_a_study_with_the_usual_runner_ends_with_the_results_of_training_alone(config, tmp_path):
    block = {"environments": ["frozen_lake/4x4"], "chance": [{"sticky": 0.25}], "agents": ["q_learning"], "seeds": 2}
    spec = study.specification({"name": "a", "steps": 300, "evaluations": 3, "blocks": [block]})
    assert study.run(spec, tmp_path / "study", workers=2).finished == 2
    train_config(config, tmp_path / "alone")
    there = tmp_path / "study" / "runs" / spec.runs[0].id
    assert (there / "curve.parquet").read_bytes() == (tmp_path / "alone" / "curve.parquet").read_bytes()
