"""Files of runs: replaced whole, the same bytes for the same rows, and what is damaged or failed is said to be."""

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from edits import flip
from pharos.errors import FileFormatError, FolderLocked, ResultCorrupted
from pharos.system import storage
from pharos.training import (
    evaluate_agent,
    load_agent,
    read_curve,
    read_curve_table,
    read_record,
    read_rows,
    run_id,
    train,
)
from pharos.training import results as _results
from refusals import refusal
from strategies import examples

ROW = {
    name: 1 if dtype == "int64" else True if dtype == "bool" else 0.5 for name, dtype in _results.CURVE_COLUMNS.items()
}
values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)


class CallbackError(RuntimeError):
    pass


def stop(done, *_):
    if done >= 200:
        raise CallbackError("no space left")


@examples(30, config=st.dictionaries(st.text(max_size=5), values, max_size=5))
def test_an_identifier_depends_on_what_a_configuration_says_and_not_on_its_order(config):
    turned = dict(reversed(list(config.items())))
    assert _results.run_id(config) == _results.run_id(turned)
    assert _results.run_id({**config, "seed of the test": 1}) != _results.run_id(config)


def test_the_same_rows_give_the_same_bytes_and_come_back(tmp_path):
    rows = [{**ROW, "step": step, "mean_return": math.nan} for step in range(3)]
    _results.write_curve(tmp_path, rows)
    first = (tmp_path / "curve.csv").read_bytes()
    _results.write_curve(tmp_path, rows)
    assert (tmp_path / "curve.csv").read_bytes() == first
    curve = read_curve(tmp_path)
    assert curve["step"].tolist() == [0, 1, 2]
    assert curve["mean_return"].isna().all()
    assert {name: str(dtype) for name, dtype in curve.dtypes.items()} == _results.CURVE_COLUMNS


def test_a_record_that_cannot_be_written_leaves_the_old_one(tmp_path):
    _results.write_record(tmp_path, {"format": 1, "config": {}, "result": math.inf})
    assert read_record(tmp_path)["result"] is None
    with pytest.raises(TypeError):
        _results.write_record(tmp_path, {"format": 1, "config": {}, "result": object()})
    assert read_record(tmp_path)["config"] == {}


def test_a_curve_without_a_column_is_refused(tmp_path):
    import pandas as pd

    pd.DataFrame({"step": [1]}).to_parquet(tmp_path / "curve.parquet")
    assert "lacks the columns episodes, value" in refusal(FileFormatError, read_curve, tmp_path)


def test_a_run_that_fails_says_why_and_can_be_started_again(tmp_path):
    options = {"steps": 400, "evaluation_interval": 100, "out": tmp_path / "run"}
    with pytest.raises(CallbackError):
        train("q_learning", "simple_grid/4x4-plain", progress=stop, **options)
    record = read_record(tmp_path / "run")
    assert record["status"] == "failed"
    assert record["error"] == "CallbackError: no space left"
    train("q_learning", "simple_grid/4x4-plain", **options)
    assert read_record(tmp_path / "run")["status"] == "finished"
    assert "error" not in read_record(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "file"), [("q_learning", "q_learning.npz"), ("dqn", "parameters.pt")])
def test_a_damaged_checkpoint_is_said_to_be_one(agent, file, tmp_path, monkeypatch):
    monkeypatch.setattr(_results, "RUN_CHECKPOINT_SECONDS", 0.0)
    options = {"steps": 400, "evaluation_interval": 100, "out": tmp_path / "run"}
    with pytest.raises(CallbackError):
        train(agent, "simple_grid/4x4-plain", progress=stop, **options)
    (tmp_path / "run" / "checkpoint" / file).write_bytes(b"PK")
    with pytest.raises(FileFormatError, match=r"checkpoint: cannot be resumed from.*delete the folder to start anew"):
        train(agent, "simple_grid/4x4-plain", **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "engine", "file"),
    [
        ("q_learning", "sb3", "curve.json"),
        ("q_learning", "sb3", "q_learning.npz"),
        ("dqn", "sb3", "model.json"),
        ("dqn", "batched", "curve.json"),
    ],
)
def test_one_digit_of_a_checkpoint_is_not_learnt_from(agent, engine, file, tmp_path, monkeypatch):
    monkeypatch.setattr(_results, "RUN_CHECKPOINT_SECONDS", 0.0)
    options = {"steps": 400, "evaluation_interval": 100, "out": tmp_path / "run", "engine": engine}
    with pytest.raises((CallbackError, RuntimeError)):
        train(agent, "simple_grid/4x4-plain", progress=stop, **options)
    (changed,) = [path for path in (tmp_path / "run").rglob(file) if "checkpoint" in path.parts]
    data = changed.read_bytes()
    place = data.index(b"1", data.find(b'"rows"') + 1) if file.endswith("json") else len(data) // 2
    changed.write_bytes(data[:place] + b"2" + data[place + 1 :])
    with pytest.raises(FileFormatError, match="was changed after it was written; delete the folder to start anew"):
        train(agent, "simple_grid/4x4-plain", **options)


def test_two_processes_do_not_train_one_run(tmp_path):
    options = {"steps": 400, "evaluation_interval": 100}

    def again(*_):
        with pytest.raises(FolderLocked, match=r"another process .* is training there; wait for it"):
            train("q_learning", "simple_grid/4x4-plain", out=tmp_path / "run", **options)

    train("q_learning", "simple_grid/4x4-plain", out=tmp_path / "run", progress=again, **options)
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"run.json", "curve.csv", "policy.npy"}


def test_files_that_a_killed_process_was_writing_go_with_the_next_run(tmp_path, monkeypatch):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    monkeypatch.setattr(os, "getpid", lambda: dead.pid)
    for name in ("run.json", "curve.csv", "policy.npy", "regret.png"):
        storage.temporary_path(tmp_path / name).touch()
    monkeypatch.undo()
    assert len([*tmp_path.iterdir()]) == 4
    train("q_learning", "simple_grid/4x4-plain", out=tmp_path, steps=100)
    assert {path.name for path in tmp_path.iterdir()} == {"run.json", "curve.csv", "policy.npy"}


@pytest.mark.slow
def test_training_leaves_nothing_among_temporary_files(tmp_path, monkeypatch):
    train("dqn", "simple_grid/4x4-plain", steps=50)  # torch makes a folder of its own when it is first used
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


def test_the_last_row_is_of_the_policy_that_is_kept_though_one_call_passes_two_points(tmp_path):
    rollouts = {"n_envs": 8, "n_steps": 4, "batch_size": 16, "learning_rate": 3e-3}  # 8 steps a call, points every 3
    options = {"steps": 64, "evaluation_interval": 3, "hyperparameters": rollouts}
    train("ppo", "simple_grid/4x4-plain", out=tmp_path / "run", **options)
    task, agent = load_agent(tmp_path / "run")
    kept = evaluate_agent(agent, task).value
    curve = read_curve(tmp_path / "run")
    assert curve["value"].iloc[-1] == pytest.approx(kept, abs=1e-6)
    assert curve["step"].tolist()[-2:] == [63, 64] and abs(curve["value"].iloc[-2] - kept) > 1e-6


def test_episodes_after_the_last_step_are_not_counted():
    rollouts = {"n_envs": 1, "n_steps": 64, "batch_size": 64}
    options = {"steps": 30, "evaluation_interval": 30, "horizon": 10, "hyperparameters": rollouts}
    episodes = train("ppo", "simple_grid/4x4-plain", **options).result["episodes"]
    assert 30 // 10 <= episodes <= 30 // 6  # the shortest way takes 6 steps, and no episode more than 10


def test_the_configuration_in_a_record_is_plain_json(tmp_path):
    train("q_learning", "simple_grid/4x4-decoy", steps=100, out=tmp_path / "run", hyperparameters={"gamma": 0.9})
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["config"]["parameters"]["rewards"] == [[[2, 2], 0.1]]
    assert record["hyperparameters"]["gamma"] == 0.9
    assert np.isfinite(record["seconds"])


def test_the_page_about_agents_defines_every_column_and_every_key():
    page = (Path(__file__).parents[2] / "docs" / "agents.md").read_text()
    result = train("q_learning", "simple_grid/4x4-plain", steps=10).result
    result |= train("q_learning", "endless_sea", size=3, steps=10, objective="average").result
    assert [name for name in (*_results.ALL_COLUMNS, *result) if f"`{name}`" not in page] == []


# Damage --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two finished runs, in folders that have their names."""
    folders = []
    for seed in range(2):
        made = tmp_path_factory.mktemp("runs") / "run"
        options = {"steps": 400, "evaluation_interval": 20, "seed": seed, "out": made}
        config = train("q_learning", "simple_grid/4x4-decoy", **options).config
        folders.append(made.rename(made.with_name(run_id(config))))
    return folders


@pytest.fixture
def copies(runs, tmp_path):
    return [Path(shutil.copytree(folder, tmp_path / folder.name)) for folder in runs]


def test_a_result_that_was_not_changed_is_read(copies):
    for folder in copies:
        assert read_record(folder)["status"] == "finished"
        assert len(read_curve(folder)) == 21
        load_agent(folder)


def test_every_digit_of_a_record_counts(copies):
    file = copies[0] / "run.json"
    text = file.read_text()
    digits = [place for place, letter in enumerate(text) if letter.isdigit()]
    rng = np.random.default_rng(0)
    for place in rng.choice(digits, 60, replace=False):
        changed = text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :]
        if json.loads(changed) == json.loads(text):  # the 17th digit of a number
            continue
        file.write_text(changed)
        assert str(file) in refusal(FileFormatError, read_record, copies[0])


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
@pytest.mark.parametrize("name", ["run.json", "curve.csv"])
def test_a_file_that_was_cut_short_is_said_to_be(name, share, copies):
    file = copies[0] / name
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    said = refusal(ResultCorrupted, lambda folder: (read_record(folder), read_curve(folder)), copies[0])
    assert "cut short" in said and str(file) in said


def test_runs_that_were_exchanged_are_noticed(copies):
    one, other = copies
    one.rename(one.with_name("aside"))
    other.rename(one)
    one.with_name("aside").rename(other)
    for folder, inside in ((one, other), (other, one)):
        with pytest.raises(ResultCorrupted, match=f"holds run {inside.name}, in the folder of run {folder.name}"):
            read_record(folder)
    moved = one.rename(one.with_name("anywhere"))
    assert read_record(moved)["id"] == other.name


def test_the_curve_of_another_run_is_noticed(copies):
    shutil.copy(copies[1] / "curve.csv", copies[0] / "curve.csv")
    said = refusal(ResultCorrupted, read_curve, copies[0])
    assert "does not match its checksum" in said and str(copies[0] / "curve.csv") in said


@pytest.mark.slow
def test_no_bit_of_a_curve_changes_what_is_read(copies):
    file = copies[0] / "curve.csv"
    data, expected = file.read_bytes(), read_curve(copies[0])
    rng = np.random.default_rng(1)
    for bit in rng.choice(8 * len(data), 300, replace=False):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        file.write_bytes(damaged)
        try:
            found = read_curve(copies[0])
        except FileFormatError as error:
            assert str(file) in str(error) and "\n" not in str(error)
        else:
            assert found.equals(expected)


def make_earlier(folder):
    """Turn a run into one of an earlier pharos, whose curve was a Parquet file with the same digest."""
    _results.write_table(folder / "curve.parquet", read_curve_table(folder))
    (folder / "curve.csv").unlink()
    record = json.loads((folder / "run.json").read_text())
    record["checksums"]["curve.parquet"] = record["checksums"].pop("curve.csv")
    storage.replace_json(folder / "run.json", storage.sealed(record))


def test_the_parquet_file_of_an_earlier_curve_is_read(copies):
    frame, rows = read_curve(copies[0]), read_rows(copies[0])
    make_earlier(copies[0])
    assert read_curve(copies[0]).equals(frame) and repr(read_rows(copies[0])) == repr(rows)  # nan is nan
    make_earlier(copies[1])
    shutil.copy(copies[1] / "curve.parquet", copies[0] / "curve.parquet")
    assert "does not match its checksum" in refusal(ResultCorrupted, read_curve, copies[0])


def test_the_pages_of_an_earlier_curve_have_checksums(copies):
    """So that a bit is noticed where no record says what the curve was."""
    make_earlier(copies[0])
    file = copies[0] / "curve.parquet"
    (copies[0] / "run.json").unlink()
    flip(file, file.stat().st_size // 3)
    assert "cut short or changed" in refusal(ResultCorrupted, read_curve, copies[0])


def test_what_an_agent_learnt_has_checksums(copies):
    file = copies[0] / "policy.npy"
    policy = np.load(file)
    np.save(file, policy + 1)
    assert "policy.npy: was changed" in refusal(ResultCorrupted, load_agent, copies[0])
    file.unlink()
    assert "policy.npy: cannot be read" in refusal(ResultCorrupted, load_agent, copies[0])


def test_runs_of_older_versions_are_read_and_their_configuration_is_held_against_their_name(copies):
    file = copies[0] / "run.json"
    record = json.loads(file.read_text())
    del record["digest"], record["checksums"]
    file.write_text(json.dumps(record))
    assert read_record(copies[0]) == record
    assert len(read_curve(copies[0])) == 21
    load_agent(copies[0])
    record["config"]["seed"] += 1
    file.write_text(json.dumps(record))
    assert "its configuration is that of run" in refusal(ResultCorrupted, read_record, copies[0])
    del record["id"]
    file.write_text(json.dumps(record))
    assert f"in the folder of run {copies[0].name}" in refusal(ResultCorrupted, read_record, copies[0])
