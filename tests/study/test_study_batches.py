"""Studies with `engine: batched`: what fits together is trained together, and nothing else changes."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

import fake_batches
import fake_training
from patience import wait_for
from pharos import study
from pharos.agents.batched import lane_width
from pharos.errors import ParameterError
from pharos.study import batches as _batches
from pharos.study import execution as _execution
from pharos.study.batches import batches
from pharos.system.storage import cache_directory, sealed
from pharos.training import ExecutionOptions, Shapes, read_record, train_config

TESTS = Path(__file__).parents[1]


def specification(**given):
    usual = {"agents": ["dqn"], "seeds": 3, "steps": 100, "evaluations": 10, "engine": "batched"}
    return fake_training.specification(**usual | given)


@pytest.fixture
def sizes(tmp_path, monkeypatch):
    """How many runs each batch had."""
    path = tmp_path / "sizes"
    path.touch()
    monkeypatch.setenv("PHAROS_FAKE_BATCHES", str(path))
    return lambda: sorted(map(int, path.read_text().split()))


def run(spec, folder, **options):
    return study.run(spec, folder, runner=fake_training.train, batch_runner=fake_batches.train, workers=2, **options)


@pytest.mark.slow
def test_what_fits_together_is_trained_together(tmp_path, sizes):
    cells = {"environments": ["frozen_lake/4x4", "frozen_lake/8x8"], "chance": ["plain", {"random": 0.1}]}
    spec = specification(agents=["dqn", "q_learning"], **cells)
    end = run(spec, tmp_path / "out")
    assert (end.total, end.finished, end.failed, end.running) == (24, 24, 0, 0)
    assert sizes() == [12, 12]  # both lakes and chances share the shape of vectors; tables are another batch
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["runs", "status.json", "study.yaml"]
    assert run(spec, tmp_path / "out").finished == 24 and sizes() == [12, 12]
    images = specification(observations=["vector", "simple_image"])
    run(images, tmp_path / "images")
    assert sizes() == [3, 3, 12, 12]


def test_more_runs_than_a_lane_are_several_batches(tmp_path, sizes):
    assert run(specification(seeds=lane_width(is_image=False) + 2), tmp_path).finished == lane_width(is_image=False) + 2
    assert sizes() == [2, lane_width(is_image=False)]


def test_batches_are_larger_where_networks_are_not_on_the_processor(tmp_path):
    runs = specification(seeds=lane_width(is_image=False) + 2).runs
    sizes = {device: [len(group) for group in batches(runs, tmp_path, device)] for device in ("cpu", "cuda")}
    assert sizes == {"cpu": [lane_width(is_image=False), 2], "cuda": [len(runs)]}


def test_runs_of_a_checkpoint_stay_together(tmp_path):
    runs = specification(seeds=5).runs
    (tmp_path / "old").mkdir()
    ids = [runs[3].id, runs[1].id, "of-a-run-that-is-over"]
    (tmp_path / "old" / "batch.json").write_text(json.dumps({"ids": ids}))
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "batch.json").write_text("[")
    seeds = [[run.configuration.seed for run in group] for group in batches(runs, tmp_path)]
    assert seeds == [[0, 2, 4], [1, 3]]


@pytest.mark.long
@pytest.mark.skipif("forkserver" not in multiprocessing.get_all_start_methods(), reason="nothing is forked here")
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_what_trains_on_a_gpu_is_not_forked(tmp_path, sizes, monkeypatch, device):
    """CUDA refuses in a fork of a process that has asked whether there is a GPU, as Stable-Baselines3 does."""
    parents = tmp_path / "parents"
    monkeypatch.setenv("PHAROS_FAKE_PARENTS", str(parents))
    assert run(specification(seeds=2), tmp_path / "out", device=device).finished == 2 and sizes() == [2]
    assert (parents.read_text() == f"{os.getpid()}\n") == (device == "cuda")


@pytest.mark.long
def test_a_device_that_is_not_there_is_refused_before_any_run(tmp_path):
    with pytest.raises(ParameterError, match=r"device is 'tpu', which torch does not have here: .*; try cpu"):
        study.run(specification(seeds=1), tmp_path, device="tpu")
    assert not (tmp_path / "runs").exists()


def test_a_gpu_has_one_process_unless_more_are_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(_execution, "usable_workers", lambda workers: 7 if workers is None else workers)

    def processes(**options):
        return _execution.StudyExecution(specification(), tmp_path, ExecutionOptions(**options)).num_workers

    assert [processes(device=device) for device in ("cpu", "cuda")] == [7, 1]
    assert [processes(device=device, workers=3) for device in ("cpu", "cuda")] == [3, 3]


def test_the_engine_is_said_for_the_study_for_a_block_and_for_an_agent():
    agents = {"agents": ["dqn", "ppo", "q_learning"], "seeds": 1}

    def engines(**said):
        return [(each.engine, each.configuration.engine) for each in specification(**agents, **said).runs]

    batched, alone, table = ("batched", "batched"), ("sb3", "sb3"), ("batched", "sb3")
    assert engines() == [batched, batched, table]
    assert engines(engine={"ppo": "batched"}) == [alone, batched, alone]
    block = {"environments": ["frozen_lake/4x4"], **agents, "engine": {"dqn": "batched"}}
    spec = study.specification({"name": "one", "blocks": [block]})
    assert [each.engine for each in spec.runs] == ["batched", "sb3", "sb3"]
    with pytest.raises(ParameterError, match=r"agent 'a2c': .* write engine: {dqn: batched} for some agents only"):
        specification(agents=["a2c"])
    with pytest.raises(ParameterError, match="unknown engine 'batch'; did you mean 'batched'"):
        specification(engine="batch")
    with pytest.raises(ParameterError, match="engine: unknown agent 'dqm'; did you mean 'dqn'"):
        specification(engine={"dqm": "batched"})


def test_ids_without_an_engine_are_those_of_before():
    (usual,) = specification(seeds=1, engine="sb3").runs
    (batched,) = specification(seeds=1).runs
    assert "engine" not in usual.config and batched.config["engine"] == "batched" and usual.id != batched.id
    tables = [specification(seeds=1, engine=engine, agents=["q_learning"]).runs[0] for engine in ("sb3", "batched")]
    assert tables[0].id == tables[1].id


def test_a_run_that_fails_in_a_batch_fails_alone(tmp_path, sizes, monkeypatch):
    monkeypatch.setenv("PHAROS_FAKE_FAIL", "1")
    spec = specification()
    end = run(spec, tmp_path / "out")
    assert (end.finished, end.failed) == (2, 1)
    (failed,) = end.errors
    assert end.errors[failed] == "this seed fails on purpose"
    assert (tmp_path / "out" / "runs" / failed / "log.txt").exists()
    assert run(spec, tmp_path / "out").failed == 1 and len(sizes()) == 1
    assert run(spec, tmp_path / "out", retry_failed=True).failed == 1 and sizes() == [1, 3]


@pytest.mark.slow
def test_a_batch_that_is_killed_too_often_goes_on_in_halves(tmp_path, sizes, monkeypatch):
    monkeypatch.setenv("PHAROS_FAKE_MOST", "2")
    end = run(specification(seeds=4), tmp_path / "out")
    assert (end.finished, end.failed) == (4, 0)
    assert sizes() == [2, 2, 4, 4, 4]


SCRIPT = """
import sys
sys.path[:0] = sys.argv[1:3]
if __name__ == "__main__":
    from test_study_batches import run, specification
    run(specification(seeds=6), sys.argv[3])
"""


@pytest.mark.long
def test_a_runner_that_is_killed_leaves_nothing_half_done(tmp_path, sizes):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PHAROS_FAKE_SECONDS": "0.1"}
    folders = [str(TESTS), str(TESTS / "study")]
    process = subprocess.Popen([sys.executable, str(script), *folders, str(tmp_path / "out")], env=environment)
    wait_for(sizes, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    end = run(specification(seeds=6), tmp_path / "out")
    assert (end.finished, end.failed) == (6, 0)
    assert all(read_record(path)["status"] == "finished" for path in (tmp_path / "out" / "runs").iterdir())


def test_the_papers_instances_share_batches_where_shapes_and_numbers_of_states_allow_it():
    paper = study.specification("paper").model_dump(mode="json", exclude_unset=True)
    runs = study.specification({**paper, "engine": "batched"}).runs
    shapes, groups = Shapes(), batches(runs, Path("nowhere"))
    assert sum(map(len, groups)) == len(runs) == 2100 and min(map(len, groups)) >= 6
    for group in groups:
        assert len({shapes.key(run.configuration) for run in group}) == 1
        assert len(group) <= shapes.width(group[0].configuration)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A cache for these tests, so that they find nothing there, but compile the rules once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def config(cache, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(cache))
    shutil.rmtree(cache / "values", ignore_errors=True)
    return kept_study(seeds=1).runs[0].config


def kept_study(seeds):
    return fake_training.specification(steps=300, evaluations=3, chance=[{"sticky": 0.25}], seeds=seeds)


def test_kept_values_are_those_of_the_task_to_the_last_bit(config):
    assert _batches.stored_values(config) is None
    found = _batches.solve(config)
    task = _batches.task_of_config(config)
    assert found == {"reference": asdict(task.reference), "return_range": list(task.return_range)}
    assert _batches.stored_values(config) == found == _batches.solve(config)


def test_a_run_with_kept_values_ends_with_the_same_files(config, tmp_path):
    train_config(config, tmp_path / "alone")
    _execution.prepare_instance(config)
    assert _batches.stored_values(config) is not None
    _execution.train_run(config, tmp_path / "prepared")
    for name in ("curve.csv", "policy.npy"):
        assert (tmp_path / "alone" / name).read_bytes() == (tmp_path / "prepared" / name).read_bytes()
    results = [json.loads((tmp_path / name / "run.json").read_text())["result"] for name in ("alone", "prepared")]
    assert results[0] == results[1]


@pytest.mark.parametrize(
    "change", [{"gamma": 0.9}, {"horizon": 50}, {"chance": {"sticky": 0.0, "random": 0.1}}, {"parameters": {"size": 8}}]
)
def test_another_setting_has_values_of_its_own(config, change):
    _batches.solve(config)
    assert _batches.stored_values({**config, **change}) is None


def test_another_seed_agent_or_observation_shares_them(config):
    found = _batches.solve(config)
    assert _batches.stored_values({**config, "seed": 7, "agent": "dqn", "observation": "vector", "steps": 9}) == found


@pytest.mark.parametrize(
    "change", [lambda text: text.replace("0.", "0.1", 1), lambda text: text[:40], lambda text: "[" * 9999]
)
def test_stored_values_that_were_changed_are_solved_again(change, config):
    values = _batches.solve(config)
    (file,) = (cache_directory() / "values").iterdir()
    text = file.read_text()
    start = text.index('"values"')
    file.write_text(text[:start] + change(text[start:]) if "values" in change(text) else change(text))
    assert _batches.stored_values(config) is None
    assert _batches.solve(config) == values == _batches.stored_values(config)


def test_values_that_an_earlier_pharos_has_kept_are_read_on(config):
    values = _batches.solve(config)
    (file,) = (cache_directory() / "values").iterdir()
    record = json.loads(file.read_text())
    entry = {"values": record.pop("values"), "task": {name: record[name] for name in record if name != "digest"}}
    file.write_text(json.dumps(sealed(entry)))
    assert _batches.stored_values(config) == values


def test_values_of_other_rules_are_not_taken(config, monkeypatch):
    _batches.solve(config)
    monkeypatch.setattr("pharos.rules.fingerprint_of_rules", lambda env, names: "other")
    assert _batches.stored_values(config) is None


@pytest.mark.long
def test_a_study_with_the_usual_runner_ends_with_the_results_of_training_alone(config, tmp_path):
    spec = kept_study(seeds=2)
    assert study.run(spec, tmp_path / "study", workers=2).finished == 2
    train_config(config, tmp_path / "alone")
    there = tmp_path / "study" / "runs" / spec.runs[0].id
    assert (there / "curve.csv").read_bytes() == (tmp_path / "alone" / "curve.csv").read_bytes()
