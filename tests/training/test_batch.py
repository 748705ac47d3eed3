"""Many runs at once: each leaves what it leaves alone, whoever else is there, however often it is killed."""

import errno
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import fake_engine
import pharos
from batched_runs import Killed, bytes_of, kill_at
from pharos.agents import hyperparameters
from pharos.errors import AllRunsFailed, ParameterError, PharosError, UnknownName
from pharos.system import storage
from pharos.training import (
    FailedRun,
    RunConfig,
    Task,
    TaskCache,
    evaluate_agent,
    load_agent,
    read_curve,
    read_record,
    train_configs,
    train_many,
    tune,
)
from pharos.training.execution import Training
from pharos.training.results import CURVE_COLUMNS
from pharos.training.schedule import plan
from refusals import failing, refusal

_results = importlib.import_module("pharos.training.results")


@pytest.fixture
def engine(monkeypatch):
    monkeypatch.setitem(sys.modules, "pharos.agents.batched", fake_engine)
    monkeypatch.setattr(_results, "RUN_CHECKPOINT_SECONDS", 0.0)
    fake_engine.made.clear()
    return fake_engine


def many(out=None, seeds=(0, 1, 2), agent="dqn", **options):
    options = {"steps": 40, "evaluation_interval": 10, "observation": "vector", **options}
    return train_many(agent, "simple_grid/4x4-plain", seeds=seeds, out=out, **options)


def config(seed=0, environment="simple_grid/4x4-plain", engine="batched", agent="dqn", observation="vector", **given):
    task = Task.of(environment, observation=observation)
    return RunConfig.of_task(
        task, agent, steps=40, seed=seed, evaluation_interval=10, hyperparameters=given, engine=engine
    )


def test_each_run_leaves_what_a_run_leaves(engine, tmp_path):
    results = many(tmp_path, sticky=0.25)
    assert engine.made == [3]
    for seed, result in enumerate(results):
        folder = tmp_path / f"seed-{seed}"
        record, curve = read_record(folder), read_curve(folder)
        assert record["status"] == "finished" and record["config"]["engine"] == "batched"
        assert record["config"]["seed"] == seed and record["result"] == result.result
        assert record["batch"]["runs"] == 3 and record["seconds"] == pytest.approx(record["batch"]["seconds"] / 3)
        assert list(curve.columns) == list(CURVE_COLUMNS) and curve["step"].tolist() == [0, 10, 20, 30, 40]
        assert set(record["checksums"]) == {"curve.csv", "agent/model.json", "agent/parameters.pt"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seed-0", "seed-1", "seed-2"]


def test_what_is_finished_is_not_trained_again(engine, tmp_path):
    first = many(tmp_path, seeds=(0, 1))
    again = many(tmp_path, seeds=(0, 1, 2))
    assert engine.made == [2, 1]
    assert [each.result for each in again[:2]] == [each.result for each in first]
    assert all(each.agent is None for each in again[:2])


def test_a_run_does_not_depend_on_who_else_is_there(engine, tmp_path):
    many(tmp_path / "together", seeds=(0, 1, 2, 3))
    many(tmp_path / "alone", seeds=(2,))
    assert bytes_of(tmp_path / "together" / "seed-2") == bytes_of(tmp_path / "alone" / "seed-2")


@pytest.mark.parametrize("asked_again", [(0, 1, 2), (2, 1), (0, 1, 2, 3)])
def test_a_killed_batch_goes_on_to_the_bytes_of_an_undisturbed_one(asked_again, engine, tmp_path):
    many(tmp_path / "whole", seeds=(0, 1, 2, 3))
    with pytest.raises(Killed):
        many(tmp_path / "killed", progress=kill_at(3 * 20))
    assert read_record(tmp_path / "killed" / "seed-1")["status"] == "running"
    done = []
    many(tmp_path / "killed", seeds=asked_again, progress=lambda now: done.extend(now.rows.items()))
    resumed = [row["step"] for place, row in done if asked_again[place] < 3]
    assert sorted(set(resumed)) == [30, 40]
    for seed in asked_again:
        whole, killed = (tmp_path / name / f"seed-{seed}" for name in ("whole", "killed"))
        assert bytes_of(whole) == bytes_of(killed)
    assert not (tmp_path / "killed" / "checkpoints").exists()


@pytest.mark.parametrize("named", ["source", "name", "observation", "agent"])
def test_a_checkpoint_runs_no_code_that_no_run_names(named, engine, tmp_path, monkeypatch):
    """A folder that somebody else has made: its batch has another run, of a class in a file."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Killed):
        many("killed", progress=kill_at(3 * 20))
    (file,) = Path("killed", "checkpoints").glob("*/batch.json")
    evil = tmp_path / "evil.py"
    evil.write_text("import pathlib\npathlib.Path(__file__).with_name('mark').touch()\n")
    source = {"name": "evil.py:Evil", "file": str(evil), "checksum": storage.digest_of_file(evil)}
    change = {"name": {"environment": "evil.py:Evil"}, "source": {"sources": {"environment": source}}}
    change |= {"observation": {"observation": "evil.py:Evil"}, "agent": {"agent": "evil.py:Evil", "engine": "sb3"}}
    stored = json.loads(file.read_text())
    configs = [RunConfig.from_dict(entry) for entry in stored["configs"]]
    folders = [Path("killed", f"seed-{each.seed}") for each in configs]
    stored["configs"].append(stored["configs"][0] | {"seed": 9} | change[named])
    storage.replace_json(file, stored)
    tasks = TaskCache(trust=True)  # as a benchmark and a study have, whose own code was looked at
    ends = train_configs(configs, folders, checkpoints=Path("killed", "checkpoints"), tasks=tasks)
    assert not any(isinstance(each, FailedRun) for each in ends) and not Path("mark").exists()


def test_a_run_with_what_the_engine_lacks_is_named_and_the_others_go_on(engine, tmp_path):
    runs = [config(0), config(1, optimize_memory_usage=True), config(2, learning_rate=-1.0)]
    folders = [tmp_path / str(i) for i in range(3)]
    good, lacking, wrong = train_configs(runs, folders)
    assert good.result["episodes"] == 4
    assert isinstance(lacking, FailedRun) and isinstance(wrong, FailedRun)
    lacks = "the batched engine: it has no hyperparameter 'optimize_memory_usage'; the engine sb3 has it"
    assert lacking.error == lacks
    assert "learning_rate is -1.0" in wrong.error
    assert [read_record(folder)["status"] for folder in folders] == ["finished", "failed", "failed"]


def test_a_run_that_ends_the_program_is_found_and_the_others_finish(engine, tmp_path):
    runs = [config(seed, learning_rate=fake_engine.BROKEN if seed == 2 else 0.001) for seed in range(5)]
    with pytest.warns(UserWarning, match="this run is broken: 5 runs at once; goes on with 2 runs at once"):
        results = train_configs(runs, [tmp_path / str(i) for i in range(5)])
    assert [isinstance(each, FailedRun) for each in results] == [False, False, True, False, False]
    assert results[2].error == "RuntimeError: this run is broken"
    assert read_record(tmp_path / "2")["status"] == "failed"
    alone = train_configs([runs[4]])
    assert str(alone[0].curve) == str(results[4].curve)


@pytest.mark.filterwarnings("error")
def test_a_full_disk_ends_all_runs_with_its_own_words(engine, tmp_path, monkeypatch):
    """A batch is not halved, as for memory: fewer runs at once need as much room. The same call goes on later."""
    runs, folders = [config(seed) for seed in range(4)], [tmp_path / f"{seed}" for seed in range(4)]
    with monkeypatch.context() as disk:
        disk.setattr(_results, "write_curve", failing(errno.ENOSPC))
        with pytest.raises(OSError, match="No space left"):
            train_configs(runs, folders)
    assert engine.made == [4]
    assert not any(isinstance(each, FailedRun) for each in train_configs(runs, folders))


def test_a_batch_that_memory_has_no_room_for_is_halved_with_one_line(engine, monkeypatch):
    monkeypatch.setattr(fake_engine, "MOST", 3)
    with pytest.warns(UserWarning) as said:
        results = many(seeds=range(5))
    assert [str(each.message) for each in said] == ["out of memory: 5 runs at once; goes on with 2 runs at once"]
    assert engine.made == [5, 2, 3]
    assert [each.config["seed"] for each in results] == list(range(5))


def test_runs_that_cannot_share_a_batch_are_grouped(engine):
    runs = [
        *(config(seed, batch_size=size) for size in (32, 64) for seed in (0, 1)),
        config(0, "frozen_lake/4x4", batch_size=64),
        config(0, observation="simple_image", batch_size=64),
    ]
    results = train_configs(runs)
    assert sorted(engine.made) == [1, 2, 3]
    assert [each.config["environment"] for each in results] == [run.environment for run in runs]


def test_a_lane_changes_no_result(engine):
    whole, parts = train_configs([config(i) for i in range(5)]), train_configs([config(i) for i in range(5)], lane=2)
    assert engine.made == [5, 2, 2, 1]
    assert str([each.curve for each in whole]) == str([each.curve for each in parts])


def test_one_run_is_a_batch_of_one(engine, tmp_path):
    steps, options = [], {"evaluation_interval": 10, "out": tmp_path, "progress": lambda done, *_: steps.append(done)}
    result = pharos.train("dqn", "simple_grid/4x4-plain", steps=40, engine="batched", **options)
    assert steps == [10, 20, 30, 40]
    assert str(result.curve) == str(many(seeds=(0,))[0].curve)
    options = {"engine": "batched", "hyperparameters": {"optimize_memory_usage": True}}
    assert "optimize_memory_usage" in refusal(
        PharosError, pharos.train, "dqn", "simple_grid/4x4-plain", steps=40, **options
    )


def test_tables_of_many_seeds_are_those_of_single_runs(tmp_path):
    options = {"steps": 4000, "evaluation_interval": 1000}
    results = many(tmp_path, agent="q_learning", **options)
    assert [each.config["seed"] for each in results] == [0, 1, 2]
    alone = pharos.train("q_learning", "simple_grid/4x4-plain", seed=1, out=tmp_path / "alone", **options)
    for name in ("q", "visits"):
        assert np.array_equal(getattr(results[1].agent, name), getattr(alone.agent, name))
    for name in ("curve.csv", "policy.npy"):
        assert (tmp_path / "alone" / name).read_bytes() == (tmp_path / "seed-1" / name).read_bytes()
    assert read_record(tmp_path / "alone")["id"] == read_record(tmp_path / "seed-1")["id"]


def test_tables_that_were_killed_go_on_together_to_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(_results, "RUN_CHECKPOINT_SECONDS", 0.0)
    options = {"agent": "q_learning", "steps": 4000, "evaluation_interval": 1000, "sticky": 0.25}
    many(tmp_path / "whole", **options)
    with pytest.raises(Killed):
        many(tmp_path / "killed", progress=kill_at(2000 * 3), **options)
    assert list((tmp_path / "killed" / "checkpoints").glob("*/checkpoint/batch.npz"))
    results = many(tmp_path / "killed", **options)
    assert not (tmp_path / "killed" / "checkpoints").exists() and len(results) == 3
    whole, killed = (tmp_path / name / "seed-2" for name in ("whole", "killed"))
    for name in ("curve.csv", "policy.npy"):
        assert (whole / name).read_bytes() == (killed / name).read_bytes()


def test_a_table_that_cannot_be_learnt_fails_by_itself(tmp_path):
    task = Task.of("simple_grid/4x4-plain")
    good, bad = (
        RunConfig.of_task(task, "q_learning", steps=40, seed=seed, evaluation_interval=10, hyperparameters=given)
        for seed, given in ((0, {}), (1, {"learning_rate": 2.0}))
    )
    first, second, third = train_configs([good, bad, good], [tmp_path / name for name in "abc"])
    assert isinstance(second, FailedRun) and "learning_rate is 2.0" in second.error
    assert first.result["final_value"] == third.result["final_value"]


def test_the_engine_belongs_to_the_id_only_where_it_is_another():
    usual = config(engine="sb3")
    assert "engine" not in usual.to_dict()
    assert usual.id == RunConfig.from_dict(usual.to_dict()).id
    batched = RunConfig.from_dict(json.loads(json.dumps(config().to_dict())))
    assert batched == config() and batched.id != usual.id
    table = {"agent": "q_learning", "observation": "index"}
    assert config(**table) == config(**table, engine="sb3")


def test_a_device_that_is_not_there_is_named_before_anything_is_trained(engine):
    assert "device is 'tpu', which torch does not have here" in refusal(ParameterError, many, device="tpu")
    assert engine.made == []


def test_members_know_the_device_and_nobody_contradicts_them(engine):
    with pytest.raises(ParameterError, match="device is 'cuda', and the tasks are for 'cpu'; expected one device"):
        train_configs([], tasks=TaskCache(), device="cuda")
    assert engine.made == []


def test_what_the_caller_raises_ends_the_training_and_fails_no_run(engine, tmp_path):
    with pytest.raises(Killed):
        many(tmp_path / "batch", progress=kill_at(1))
    with pytest.raises(ZeroDivisionError):
        many(tmp_path / "table", agent="q_learning", progress=lambda now: 1 / 0)
    for folder in (tmp_path / "batch" / "seed-0", tmp_path / "table" / "seed-0"):
        assert read_record(folder)["status"] == "running"


def test_an_engine_that_lacks_the_agent_is_refused_with_the_one_that_has_it():
    with pytest.raises(ParameterError, match="agent 'a2c': the batched engine has dqn, ppo and q_learning;"):
        config(agent="a2c")
    assert "unknown engine 'batch'; did you mean 'batched'" in refusal(UnknownName, config, engine="batch")
    assert "expected at least one, each once" in refusal(ParameterError, many, seeds=(1, 1))


@pytest.mark.long
def test_what_the_engine_itself_has_learnt_is_read_and_resumed(tmp_path, monkeypatch):
    monkeypatch.setattr(_results, "RUN_CHECKPOINT_SECONDS", 0.0)
    small = {"learning_starts": 50, "buffer_size": 500, "target_update_interval": 50}
    options = {"steps": 400, "evaluation_interval": 100, "hyperparameters": small, "random": 0.1}
    many(tmp_path / "whole", seeds=(0, 1, 2), **options)
    with pytest.raises(Killed):
        many(tmp_path / "killed", seeds=(0, 1), progress=kill_at(2 * 200), **options)
    ends = many(tmp_path / "killed", seeds=(0, 1), **options)
    for seed, end in enumerate(ends):
        assert bytes_of(tmp_path / "killed" / f"seed-{seed}") == bytes_of(tmp_path / "whole" / f"seed-{seed}")
        task, agent = load_agent(tmp_path / "killed" / f"seed-{seed}")
        assert evaluate_agent(agent, task).value == pytest.approx(end.result["final_value"], abs=1e-9)


@pytest.mark.long
def test_a_trial_of_a_search_is_one_batch(engine, tmp_path):
    instances, chances = ["simple_grid/4x4-plain", "simple_grid/4x4-decoy"], [{}, {"random": 0.1}]
    options = {"steps": 40, "seeds": [5, 6], "chances": chances, "engine": "batched"}
    found = tune("dqn", instances, trials=2, out=tmp_path / "found", **options)
    assert engine.made == [8, 8]
    assert json.loads((tmp_path / "found" / "tuning.json").read_text())["config"]["engine"] == "batched"
    given = {**hyperparameters("dqn", "simple_grid", "vector"), **found.trials[0]["hyperparameters"]}
    tasks = [Task.of(instance, **chance) for instance in instances for chance in chances]
    setting = {"steps": 40, "evaluation_interval": 2, "hyperparameters": given, "engine": "batched"}
    runs = [RunConfig.of_task(task, "dqn", seed=seed, **setting) for seed in (5, 6) for task in tasks]
    rows = [row["normalized_regret"] for end in train_configs(runs) for row in end.curve[1:]]
    assert found.first_score == pytest.approx(sum(rows) / len(rows))
    with pytest.raises(PharosError, match="the batched engine: it has no hyperparameter"):
        tune("dqn", instances, trials=1, space={"optimize_memory_usage": ("one of", True)}, **options)


def test_whole_lanes_are_dealt_out_to_processes():
    runs = [config(seed) for seed in range(70)]
    assert [len(part) for part in plan(runs, workers=2)] == [32 + 6, 32]
    assert [len(part) for part in plan(runs, workers=9)] == [32, 32, 6]
    assert sorted(place for part in plan(runs, workers=2) for place in part) == list(range(70))
    assert len(plan(runs[:32], workers=2)) == len(plan(runs, workers=1)) == 1
    assert len(plan([config(seed, engine="sb3") for seed in range(70)], workers=2)) == 2
    assert len(plan([config(seed, observation="simple_image") for seed in range(9)], workers=2)) == 2


@pytest.mark.long
def test_processes_leave_what_one_leaves(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.import_module("pharos.training.schedule").Shapes, "width", lambda *_: 2)
    small = {"learning_starts": 50, "buffer_size": 500, "optimize_memory_usage": False}
    options = {"seeds": (0, 1, 2), "steps": 200, "evaluation_interval": 100, "hyperparameters": small}
    done = []
    parts = many(tmp_path / "parts", workers=2, progress=lambda now: done.append(now.done), **options)
    whole = many(tmp_path / "whole", **options)
    assert done[-1] == 600 and done == sorted(done)
    assert [end.result for end in parts] == [end.result for end in whole]
    for seed in options["seeds"]:
        assert bytes_of(tmp_path / "parts" / f"seed-{seed}") == bytes_of(tmp_path / "whole" / f"seed-{seed}")
    bad = {**options, "hyperparameters": {"optimize_memory_usage": True}}
    with pytest.raises(AllRunsFailed, match="all 3 runs failed") as lacking:
        many(tmp_path / "bad", workers=2, **bad)
    assert all(isinstance(end, FailedRun) and "optimize_memory_usage" in end.error for end in lacking.value.outcome)


def test_progress_never_goes_back_while_runs_of_a_group_end_one_by_one():
    done = []
    runs = [config(seed=seed) for seed in range(3)]
    training = Training(runs, None, [[0, 1], [2]], None, lambda now: done.append(now.done), TaskCache())
    ended = FailedRun(runs[0].to_dict(), None, PharosError("ended"))
    for key, *message in [
        ("pair", "rows", 80, {}),
        ("pair", "end", 0, ended),
        ("alone", "rows", 20, {}),
        ("pair", "end", 1, ended),
        ("alone", "rows", 40, {}),
        ("alone", "end", 2, ended),
    ]:
        training.receive(key, tuple(message))
    assert done == [80, 100, 120]


@pytest.mark.long
def test_knobs_of_chance_and_pay_are_those_of_the_run_alone():
    knobs = {"lazy": 0.2, "sticky": 0.1, "reward_noise": 0.5, "reward_delay": 2}
    together = many(seeds=(0, 1, 2), **knobs)
    alone = many(seeds=(1,), **knobs)[0]
    np.testing.assert_equal(together[1].result, alone.result)  # nan, where no episode has ended, equals nan
    optimal = Task.of("simple_grid/4x4-plain", sticky=0.1, lazy=0.2).optimal
    assert alone.result["value_optimal"] == optimal.value_at_start


@pytest.fixture
def apart(monkeypatch):
    """Policies of every batch are evaluated by two processes."""
    monkeypatch.setattr("pharos.training.batch.evaluates_apart", lambda *_: True)
    monkeypatch.setattr("pharos.training.evaluators.usable_workers", lambda _: 3)
    monkeypatch.setattr(_results, "RUN_CHECKPOINT_SECONDS", 0.0)


@pytest.mark.long
@pytest.mark.parametrize("agent, chance", [("dqn", {}), ("ppo", {"sticky": 0.25})])
def test_policies_that_other_processes_evaluate_leave_the_same_bytes(agent, chance, tmp_path, request):
    own = {"learning_starts": 50, "buffer_size": 500} if agent == "dqn" else {"n_steps": 64}
    options = {"agent": agent, "steps": 200, "evaluation_interval": 50, "hyperparameters": own, "engine": "batched"}
    whole = many(tmp_path / "whole", **options, **chance)
    request.getfixturevalue("apart")
    done = []
    parts = many(tmp_path / "parts", progress=lambda now: done.append((now.done, len(now.rows))), **options, **chance)
    assert done[:4] == [(150 * i, 3) for i in range(1, 5)]
    assert [end.result for end in parts] == [end.result for end in whole]
    with pytest.raises(Killed):
        many(tmp_path / "killed", progress=kill_at(3 * 150), **options, **chance)
    assert any((tmp_path / "killed" / "checkpoints").glob("*/checkpoint"))
    many(tmp_path / "killed", **options, **chance)
    for seed in range(3):
        folders = [tmp_path / name / f"seed-{seed}" for name in ("whole", "parts", "killed")]
        expected, *others = [(bytes_of(folder), read_record(folder)["result"]) for folder in folders]
        assert others == [expected] * 2


@pytest.mark.long
def test_a_batch_whose_evaluating_process_dies_is_halved_and_ends(apart, tmp_path, monkeypatch):
    evaluators = importlib.import_module("pharos.training.evaluators")
    begin, killed = evaluators.Evaluators.begin, []

    def kill_once(self):
        if not killed:
            killed.append(self.workers.kill("0"))
        begin(self)

    monkeypatch.setattr(evaluators.Evaluators, "begin", kill_once)
    own = {"learning_starts": 50, "buffer_size": 500}
    with pytest.warns(UserWarning, match="evaluates ended with exit code -9"):
        ends = many(steps=100, evaluation_interval=50, hyperparameters=own, engine="batched")
    assert not any(isinstance(end, FailedRun) for end in ends)


def test_policies_are_evaluated_apart_where_a_gpu_learns_many_runs_of_importable_code():
    from pharos.training.evaluators import FEWEST, evaluates_apart

    class Run:
        config = config()

    assert evaluates_apart("cuda", [Run()] * FEWEST)
    assert not evaluates_apart("cpu", [Run()] * FEWEST) and not evaluates_apart("cuda", [Run()] * (FEWEST - 1))
