"""Files of runs: replaced whole, the same bytes for the same rows, and what is damaged or failed is said to be."""

import importlib
import json
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pharos.errors import FileFormatError
from pharos.experiments import read_curve, read_record, train
from pharos.experiments import results as _results

_train = importlib.import_module("pharos.experiments.train")

ROW = {name: 1 if dtype == "int64" else True if dtype == "bool" else 0.5 for name, dtype in _results.COLUMNS.items()}
values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)


class Stopped(RuntimeError):
    pass


def stop(done, *_):
    if done >= 200:
        raise Stopped("no space left")


@settings(max_examples=100, deadline=None)
@given(config=st.dictionaries(st.text(max_size=5), values, max_size=5))
def test_an_identifier_depends_on_what_a_configuration_says_and_not_on_its_order(config):
    turned = dict(reversed(list(config.items())))
    assert _results.identifier(config) == _results.identifier(turned)
    assert _results.identifier({**config, "seed of the test": 1}) != _results.identifier(config)


def test_the_same_rows_give_the_same_bytes_and_come_back(tmp_path):
    rows = [{**ROW, "step": step, "mean_return": math.nan} for step in range(3)]
    _results.write_curve(tmp_path, rows)
    first = (tmp_path / "curve.parquet").read_bytes()
    _results.write_curve(tmp_path, rows)
    assert (tmp_path / "curve.parquet").read_bytes() == first
    curve = read_curve(tmp_path)
    assert curve["step"].tolist() == [0, 1, 2]
    assert curve["mean_return"].isna().all()
    assert {name: str(dtype) for name, dtype in curve.dtypes.items()} == _results.COLUMNS


def test_a_record_that_cannot_be_written_leaves_the_old_one(tmp_path):
    _results.write_record(tmp_path, {"format": 1, "config": {}, "result": math.inf})
    assert read_record(tmp_path)["result"] is None
    with pytest.raises(TypeError):
        _results.write_record(tmp_path, {"format": 1, "config": {}, "result": object()})
    assert read_record(tmp_path)["config"] == {}


def test_a_curve_without_a_column_is_refused(tmp_path):
    import pandas as pd

    pd.DataFrame({"step": [1]}).to_parquet(tmp_path / "curve.parquet")
    with pytest.raises(FileFormatError, match="lacks the columns episodes, value"):
        read_curve(tmp_path)


def test_a_run_that_fails_says_why_and_can_be_started_again(tmp_path):
    options = {"steps": 400, "evaluation_interval": 100, "out": tmp_path / "run"}
    with pytest.raises(Stopped):
        train("q_learning", "simple_grid/4x4-plain", progress=stop, **options)
    record = read_record(tmp_path / "run")
    assert record["status"] == "failed"
    assert record["error"] == "Stopped: no space left"
    train("q_learning", "simple_grid/4x4-plain", **options)
    assert read_record(tmp_path / "run")["status"] == "finished"
    assert "error" not in read_record(tmp_path / "run")


@pytest.mark.parametrize(("agent", "file"), [("q_learning", "q_learning.npz"), ("dqn", "parameters.pt")])
def test_a_damaged_checkpoint_is_said_to_be_one(agent, file, tmp_path, monkeypatch):
    monkeypatch.setattr(_train, "CHECKPOINT_SECONDS", 0.0)
    options = {"steps": 400, "evaluation_interval": 100, "out": tmp_path / "run"}
    with pytest.raises(Stopped):
        train(agent, "simple_grid/4x4-plain", progress=stop, **options)
    (tmp_path / "run" / "checkpoint" / file).write_bytes(b"PK")
    with pytest.raises(FileFormatError, match=r"checkpoint: cannot be resumed from.*delete the folder to start anew"):
        train(agent, "simple_grid/4x4-plain", **options)


def test_training_leaves_nothing_among_temporary_files(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    train("dqn", "simple_grid/4x4-plain", steps=50)
    assert list(tmp_path.iterdir()) == []


def test_tensorboard_gets_the_exact_regret(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    options = {"steps": 300, "evaluation_interval": 100, "out": tmp_path / "run", "tensorboard": True}
    result = train("ppo", "simple_grid/4x4-plain", hyperparameters={"n_steps": 10, "batch_size": 20}, **options)
    events = EventAccumulator(str(next(Path(tmp_path / "run" / "tensorboard").iterdir())))
    events.Reload()
    scalars = events.Scalars("pharos/expected_regret")
    assert scalars[-1].value == pytest.approx(result.result["final_regret"])


def test_episodes_after_the_last_step_are_not_counted():
    rollouts = {"n_envs": 1, "n_steps": 64, "batch_size": 64}
    result = train(
        "ppo", "simple_grid/4x4-plain", steps=30, evaluation_interval=30, horizon=10, hyperparameters=rollouts
    )
    assert (
        30 // 10 <= result.result["episodes"] <= 30 // 6
    )  # the shortest way takes 6 steps, and no episode more than 10


def test_the_configuration_in_a_record_is_plain_json(tmp_path):
    train("q_learning", "simple_grid/4x4-decoy", steps=100, out=tmp_path / "run", hyperparameters={"gamma": 0.9})
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["config"]["parameters"]["rewards"] == [[[2, 2], 0.1]]
    assert record["hyperparameters"]["gamma"] == 0.9
    assert np.isfinite(record["seconds"])


def test_the_page_about_agents_defines_every_column_and_every_key():
    page = (Path(__file__).parents[1] / "docs" / "agents.md").read_text()
    result = train("q_learning", "simple_grid/4x4-plain", steps=10).result
    assert [name for name in (*_results.COLUMNS, *result) if f"`{name}`" not in page] == []
