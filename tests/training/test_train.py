"""Training runs: what is written, what a kill loses, that seeds decide everything, and that regret is what it is
defined to be."""

import importlib
import json
import math
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pharos
from patience import PATIENCE, wait_for
from pharos.agents import agents
from pharos.agents.sb3 import Deep, check_hyperparameters
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted, UnknownName
from pharos.training import read_curve, read_record, train, train_config, train_many
from pharos.training.results import CURVE_COLUMNS
from pharos.training.task import Task
from refusals import refusal

_results = importlib.import_module("pharos.training.results")

SMALL = {"learning_starts": 50, "buffer_size": 1000, "target_update_interval": 50}


@pytest.fixture(autouse=True)
def always_checkpoint(monkeypatch):
    monkeypatch.setattr(_results, "RUN_CHECKPOINT_SECONDS", 0.0)


def short(agent, out=None, steps=400, seed=1, progress=None, **options):
    hyperparameters = SMALL if agent == "dqn" else {"n_steps": 16} if agent == "ppo" else {}
    options = {"evaluation_interval": 100, "hyperparameters": hyperparameters, "progress": progress, **options}
    return train(agent, "simple_grid/4x4-plain", steps=steps, seed=seed, out=out, **options)


def test_seeds_are_whole_numbers_and_several():
    for seeds, said in ((3, "seeds is 3; expected several"), ([0.5], "seed is 0.5; expected a whole number")):
        with pytest.raises(ParameterError, match=said):
            train_many("q_learning", "frozen_lake/4x4", seeds=seeds, steps=100)


@pytest.mark.slow
@pytest.mark.parametrize("agent", agents())
def test_a_run_writes_its_record_and_its_curve(agent, tmp_path):
    result = short(agent, tmp_path / "run", observation="vector", sticky=0.25)
    record, curve = read_record(tmp_path / "run"), read_curve(tmp_path / "run")
    assert record["status"] == "finished"
    assert record["config"]["chance"] == {"sticky": 0.25, "random": 0.0}
    assert record["result"]["episodes"] == result.result["episodes"] == curve["episodes"].iloc[-1]
    assert list(curve.columns) == list(CURVE_COLUMNS)
    assert curve["step"].tolist() == [0, 100, 200, 300, 400]
    assert not (tmp_path / "run" / "checkpoint").exists()
    assert not any(path.suffix in (".pkl", ".zip") for path in (tmp_path / "run").rglob("*"))


@pytest.mark.long
@pytest.mark.parametrize("agent", agents())
def test_the_same_seed_gives_the_same_file_and_another_seed_another(agent, tmp_path):
    seen = {} if agent == "q_learning" else {"observation": "simple_image"}
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        short(agent, tmp_path / name, seed=seed, **seen)
    files = [(tmp_path / name / "curve.csv").read_bytes() for name in "abc"]
    assert files[0] == files[1]
    assert files[0] != files[2]


def test_regret_is_what_it_is_defined_to_be():
    result = train("q_learning", "frozen_lake/4x4", steps=2000, evaluation_interval=250, random=0.1)
    curve, best, uniform = result.curve, result.result["value_optimal"], result.result["value_uniform"]
    cumulative = 0.0
    for before, row in zip([None, *curve], curve, strict=False):
        assert row["expected_regret"] == pytest.approx(best - row["value"])
        assert row["normalized_regret"] == pytest.approx((best - row["value"]) / (best - uniform))
        if before is not None:
            finished = row["episodes"] - before["episodes"]
            cumulative += finished * before["expected_regret"]
            assert row["realised_regret"] == pytest.approx(best - row["mean_return"])
        assert row["cumulative_expected_regret"] == pytest.approx(cumulative)
    total = result.result["mean_return"] * result.result["episodes"]
    assert curve[-1]["cumulative_realised_regret"] == pytest.approx(result.result["episodes"] * best - total)
    assert result.result["normalized_regret"] == pytest.approx(
        cumulative / (result.result["episodes"] * (best - uniform))
    )


def test_the_values_are_those_of_the_task_by_other_means():
    result = train("q_learning", "frozen_lake/4x4", steps=500, gamma=0.9, horizon=None)
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=0.9)
    assert result.result["value_optimal"] == pytest.approx(0.9**5, abs=1e-6)
    policy = result.agent.policy_table()
    assert result.result["final_value"] == pytest.approx(pharos.evaluate_policy(mdp, policy).value_at_start, abs=1e-6)


def test_a_result_says_in_one_line_how_the_run_ended():
    result = train("q_learning", "frozen_lake/4x4", steps=500)
    line = f"TrainingResult(q_learning on frozen_lake, steps=500, final_value={result.result['final_value']}, "
    assert repr(result).startswith(line) and "normalized_regret=" in repr(result) and len(repr(result)) < 200


class Killed(BaseException):
    pass


def kill_at(step):
    def progress(done, *_):
        if done >= step:
            raise Killed

    return progress


@pytest.mark.slow
@pytest.mark.parametrize("agent", agents())
def test_a_run_that_died_goes_on_from_its_last_checkpoint(agent, tmp_path):
    with pytest.raises(Killed):
        short(agent, tmp_path / "run", progress=kill_at(300))
    assert read_record(tmp_path / "run")["status"] == "running"
    steps = []
    result = short(agent, tmp_path / "run", progress=lambda done, *_: steps.append(done))
    assert steps == [300, 400]
    assert [row["step"] for row in result.curve] == [0, 100, 200, 300, 400]
    if agents()[agent].resumes_exactly("sb3"):
        short(agent, tmp_path / "whole")
        assert (tmp_path / "run" / "curve.csv").read_bytes() == (tmp_path / "whole" / "curve.csv").read_bytes()


@pytest.mark.parametrize(("moved", "goes_on_from"), [("checkpoint.old", 200), ("checkpoint", 200), ("nothing", 300)])
def test_a_run_killed_while_it_replaces_its_checkpoint_loses_one_interval(moved, goes_on_from, tmp_path, monkeypatch):
    """Killed before the older checkpoint is moved aside, before the newer one takes its place, or right after that."""
    run = tmp_path / "run"
    replace, remove = os.replace, shutil.rmtree

    def dying(source, target):
        if Path(target).name == moved and (run / "checkpoint.partial" / "curve.json").exists() and third:
            raise Killed
        replace(source, target)

    third: list[int] = []
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "replace", dying)
        patch.setattr(shutil, "rmtree", lambda path, **options: None if third else remove(path, **options))
        short("q_learning", run, progress=lambda done, *_: third.append(done) if done == 300 else kill_at(400)(done))
    assert (run / "checkpoint.old").exists() == (moved != "checkpoint.old")
    assert (run / "checkpoint").exists() == (moved != "checkpoint")
    steps = []
    short("q_learning", run, progress=lambda done, *_: steps.append(done))
    assert steps == list(range(goes_on_from + 100, 401, 100))
    short("q_learning", tmp_path / "whole")
    assert (run / "curve.csv").read_bytes() == (tmp_path / "whole" / "curve.csv").read_bytes()
    assert not list(run.glob("checkpoint*"))


def test_a_checkpoint_is_on_the_disk_before_the_older_one_goes(tmp_path, monkeypatch):
    class Learner:
        def save(self, folder):
            (folder / "network").mkdir()
            (folder / "network" / "weights").write_bytes(b"weights")

    synced, moves = set(), []
    sync, replace = os.fsync, os.replace

    def syncing(descriptor):
        synced.add(os.fstat(descriptor).st_ino)
        sync(descriptor)

    def replacing(source, target):
        moves.append((Path(source).name, Path(target).name))
        if Path(source).name == "checkpoint.partial":
            assert {path.stat().st_ino for path in (*Path(source).rglob("*"), Path(source))} <= synced
        replace(source, target)

    monkeypatch.setattr(os, "fsync", syncing)
    monkeypatch.setattr(os, "replace", replacing)
    checkpoint = _results.Checkpoint(tmp_path / "checkpoint", "id")
    for _ in range(2):
        synced.clear()
        checkpoint.save(Learner(), list, 0.0)
        assert tmp_path.stat().st_ino in synced
    swap = ("checkpoint.partial", "checkpoint")
    assert moves == [swap, ("checkpoint", "checkpoint.old"), swap]


@pytest.mark.long
@pytest.mark.parametrize("agent", ["dqn", "ppo"])
def test_a_resumed_agent_does_not_repeat_its_first_random_numbers(agent, tmp_path):
    import torch

    task = Task.of("simple_grid/4x4-plain", observation="vector")
    hyperparameters = SMALL if agent == "dqn" else {"n_steps": 16, "batch_size": 16}

    def random_numbers(resumed):
        learner = Deep(agent, task, hyperparameters, 400, 1, None)
        if resumed:
            learner.load(tmp_path)
        drawn = (torch.rand(4).tolist(), np.random.rand(4).tolist())
        return (*drawn, [learner.model.action_space.sample() for _ in range(32)])

    learner = Deep(agent, task, hyperparameters, 400, 1, None)
    learner.learn([64], lambda *_: {"value": 0.0, "expected_regret": 0.0, "mean_return": 0.0})
    learner.save(tmp_path)
    first, again, resumed, same = (random_numbers(each) for each in (False, False, True, True))
    assert first == again and resumed == same
    assert all(before != after for before, after in zip(first, resumed, strict=True))


@pytest.mark.parametrize("ended", [False, True])
def test_returns_of_several_steps_end_where_a_run_was_resumed(ended, tmp_path):
    task = Task.of("simple_grid/4x4-plain", observation="vector")
    learners = [Deep("dqn", task, {**SMALL, "n_steps": 3}, 400, 1, None) for _ in range(2)]
    learners[0].model.learn(100)
    buffer = learners[0].model.replay_buffer
    buffer.dones[buffer.pos - 1] = ended
    learners[0].save(tmp_path / "checkpoint")
    learners[1].load(tmp_path / "checkpoint")
    resumed = learners[1].model.replay_buffer
    last = resumed.pos - 1
    observation = resumed.observations[last]
    for _ in range(2):
        resumed.add(observation, observation, resumed.actions[last], np.array([100.0]), np.array([False]), [{}])
    sample = resumed._get_samples(np.array([last - 1, last]))
    assert sample.rewards.numpy().max() <= 1.0
    assert sample.dones.numpy().ravel().tolist() == [float(ended)] * 2  # what did not end is worth what follows


def _long_run(folder, **options):
    train("q_learning", "frozen_lake/8x8", steps=40_000_000, evaluation_interval=100_000, out=folder, **options)


@pytest.mark.long
def test_a_killed_process_loses_no_more_than_an_interval(tmp_path):
    folder = tmp_path / "run"
    process = multiprocessing.get_context("spawn").Process(target=_long_run, args=(folder,))
    process.start()
    wait_for((folder / "checkpoint" / "curve.json").exists)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    places = [folder / name / "curve.json" for name in ("checkpoint", "checkpoint.old")]  # one of them, at any moment
    kept = json.loads(next(place for place in places if place.exists()).read_text())
    steps = []

    def progress(done, *_):
        steps.append(done)
        raise Killed

    with pytest.raises(Killed):
        _long_run(folder, progress=progress)
    assert steps == [kept["rows"][-1]["step"] + 100_000]


def test_a_task_wants_an_environment_not_its_name():
    assert "use Task.of" in refusal(ParameterError, Task, "simple_grid/4x4-plain")


def test_a_finished_run_is_returned_and_another_refused(tmp_path):
    first = short("q_learning", tmp_path / "run")
    again = short("q_learning", tmp_path / "run", progress=kill_at(0))
    assert again.result == first.result
    assert again.agent is None
    with pytest.raises(ParameterError, match="another seed; choose another folder"):
        short("q_learning", tmp_path / "run", seed=5)


def test_a_configuration_repeats_a_run(tmp_path):
    short("q_learning", tmp_path / "a", random=0.1)
    train_config(read_record(tmp_path / "a")["config"], tmp_path / "b")
    assert (tmp_path / "a" / "curve.csv").read_bytes() == (tmp_path / "b" / "curve.csv").read_bytes()


def test_the_policy_of_a_tabular_agent_is_kept_as_an_array(tmp_path):
    result = short("q_learning", tmp_path / "run", steps=5000)
    policy = np.load(tmp_path / "run" / "policy.npy", allow_pickle=False)
    assert (policy == result.agent.policy_table()).all()


def test_an_algorithm_can_be_named_by_its_path():
    result = train("stable_baselines3:A2C", "simple_grid/4x4-plain", steps=50, evaluation_interval=25)
    assert [row["step"] for row in result.curve] == [0, 25, 50]
    assert result.curve[0]["value"] > result.result["value_worst"]  # a distribution, not one action


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"agent": "dqm"}, UnknownName, "did you mean 'dqn'"),
        ({"agent": "stable_baselines3:DQM"}, UnknownName, "did you mean"),
        ({"agent": "dqn", "observation": "vectro"}, UnknownName, "did you mean 'vector'"),
        ({"agent": "dqn", "hyperparameters": {"learning_rat": 1}}, UnknownName, "did you mean 'learning_rate'"),
        ({"agent": "q_learning", "steps": 0}, ParameterError, "steps is 0"),
        ({"agent": "q_learning", "evaluation_interval": -1}, ParameterError, "evaluation_interval is -1"),
        ({"agent": "q_learning", "horizon": 0}, ParameterError, "horizon: found 0"),
        ({"agent": "dqn", "tensorboard": True}, ParameterError, "no folder for results"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_learnt(options, error, message):
    agent = options.pop("agent")
    assert message in refusal(error, train, agent, "simple_grid/4x4-plain", **{"steps": 100, **options})


@pytest.mark.parametrize("text", ["[" * 5000, "9" * 5000, "2020-99-99"])
def test_yaml_that_cannot_be_read_is_a_line(text, tmp_path):
    (tmp_path / "own.yaml").write_text(f"q_learning: {{frozen_lake: {{index: {{learning_rate: {text}}}}}}}")
    with pytest.raises(ParameterError, match=r"own\.yaml: (is nested|Exceeds|month)") as caught:
        train("q_learning", "frozen_lake/4x4", steps=10, hyperparameters=tmp_path / "own.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["gamma: 0.9", "frozen_lake: {learning_rate: 0.1}", "default: 3"])
def test_yaml_whose_levels_are_missing_is_refused_not_ignored(text, tmp_path):
    (tmp_path / "own.yaml").write_text(f"q_learning: {{{text}}}")
    with pytest.raises(ParameterError, match="expected agent, then class, then observation"):
        train("q_learning", "frozen_lake/4x4", steps=10, hyperparameters=tmp_path / "own.yaml")


def test_options_of_a_network_are_a_mapping():
    with pytest.raises(ParameterError, match=r"'dqn': policy_kwargs is '\{net_arch: \[8\]\}'; expected a mapping"):
        train("dqn", "frozen_lake/4x4", steps=10, hyperparameters={"policy_kwargs": "{net_arch: [8]}"})


def test_a_network_that_no_machine_holds_is_a_line():
    with pytest.raises(MemoryError, match=r"the network of 'dqn': net_arch is \[1000000000000\]"):
        train("dqn", "frozen_lake/4x4", steps=10, hyperparameters={"net_arch": [10**12]})


def test_a_missing_package_of_agents_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(ParameterError, match="needs sb3-contrib; install it with: pip install sb3-contrib"):
        train("sb3_contrib:TRPO", "simple_grid/4x4-plain", steps=10)


def test_policies_that_an_algorithm_lacks_are_told_with_those_that_it_has():
    with pytest.raises(ParameterError, match=r"Policy NoPolicy unknown; .* policy: MlpPolicy, CnnPolicy"):
        train("ppo", "simple_grid/4x4-plain", steps=10, hyperparameters={"policy": "NoPolicy"})


@pytest.mark.parametrize(
    ("agent", "given", "expected"),
    [
        ("dqn", {"train_freq": 0}, "an integer of at least 1"),
        ("dqn", {"batch_size": 0.5}, "an integer of at least 1"),
        ("dqn", {"buffer_size": math.inf}, "an integer of at least 1"),
        ("dqn", {"n_envs": "many"}, "an integer of at least 1"),
        ("dqn", {"learning_rate": -1}, "a number above 0"),
        ("dqn", {"learning_rate": math.nan}, "a number above 0"),
        ("dqn", {"gamma": 2}, "a number from 0 to 1"),
        ("dqn", {"learning_starts": -1}, "a number of at least 0"),
        ("ppo", {"n_epochs": 0}, "an integer of at least 1"),
        ("ppo", {"clip_range": True}, "a number above 0"),
    ],
)
def test_numbers_that_an_algorithm_would_take_without_a_word_are_refused(agent, given, expected):
    (name, value), *_ = given.items()
    with pytest.raises(ParameterError, match=rf"{name} is {value!r}; expected {expected}"):
        train(agent, "simple_grid/4x4-plain", steps=100, hyperparameters=given)


def test_schedules_and_words_that_an_algorithm_takes_pass():
    falling = {"learning_rate": lambda left: 1e-3 * left}
    check_hyperparameters("dqn", {**falling, "train_freq": (1, "episode"), "net_arch": [8]})
    check_hyperparameters("stable_baselines3:SAC", {"ent_coef": "auto", "n_envs": 2, "gradient_steps": -1})
    check_hyperparameters("stable_baselines3:SAC", {"ent_coef": "auto_0.1"})


def test_a_folder_that_is_no_run_is_said_to_be_none(tmp_path):
    assert "expected the folder of a run" in refusal(FileFormatError, read_record, tmp_path)
    (tmp_path / "run.json").write_text("{")
    assert "is no JSON" in refusal(FileFormatError, read_record, tmp_path)
    (tmp_path / "curve.parquet").write_bytes(b"PAR1")
    assert "cannot be read" in refusal(FileFormatError, read_curve, tmp_path)


@pytest.mark.long
def test_tabular_agents_need_the_core_alone(tmp_path):
    """In a process in which nothing that an extra brings is installed; what it wrote is read with and without."""
    code = f"""
import sys
import tempfile
for name in ("torch", "stable_baselines3", "yaml", "pyarrow", "pandas", "matplotlib", "statsmodels", "pydantic"):
    sys.modules[name] = None
import pharos
for attempt in range(2):
    run = pharos.train("q_learning", "frozen_lake/4x4", steps=200, out={str(tmp_path / "run")!r})
    print(len(run.curve), run.curve[-1]["step"], run.result["final_regret"])
try:
    pharos.train("q_learning", "frozen_lake/4x4", steps=200, hyperparameters="own.yaml")
except pharos.errors.MissingExtra as error:
    print(error)
from pharos import benchmark
file = benchmark.submit({str(tmp_path / "run")!r}, {str(tmp_path / "entry.safetensors")!r})
print(benchmark.verify(file).holds)
try:
    benchmark.submit({str(tmp_path / "here")!r}, {str(tmp_path / "other.safetensors")!r})
except pharos.errors.MissingExtra as error:
    print(error)
"""
    here = train("q_learning", "frozen_lake/4x4", steps=200, out=tmp_path / "here")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE)
    first, second, refused, holds = done.stdout.splitlines() or [done.stderr] * 4
    assert first == second and first.startswith("101 200 "), done.stderr
    assert holds == "True"
    assert re.search(r"pip install 'pharos-rl\[study\]'", refused)
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["curve.csv", "policy.npy", "run.json"]
    pd.testing.assert_frame_equal(read_curve(tmp_path / "run"), read_curve(tmp_path / "here"), check_exact=True)
    digests = [read_record(tmp_path / name)["checksums"] for name in ("run", "here")]
    assert digests[0]["curve.csv"] == digests[1]["curve.csv"]
    again = train("q_learning", "frozen_lake/4x4", steps=200, out=tmp_path / "run")
    assert repr(again.curve) == repr(here.curve)  # nan is nan

    text = (tmp_path / "run" / "curve.csv").read_text()
    for changed in (text[:-9], text.replace("200,", "201,"), text.replace("exact", "exit"), ""):
        (tmp_path / "run" / "curve.csv").write_text(changed)
        with pytest.raises((ResultCorrupted, FileFormatError), match=r"curve\.csv"):
            read_curve(tmp_path / "run")


@pytest.mark.parametrize("verbose", [0, 1])
def test_a_model_makes_no_folder_among_the_temporary_files(verbose, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    task = Task(pharos.make("frozen_lake/4x4"), horizon=20)
    model = Deep("ppo", task, {"n_steps": 16, "batch_size": 16, "verbose": verbose}, 16, 0, None).model
    model._setup_learn(16)
    assert len(model.logger.output_formats) == verbose
    assert list(tmp_path.glob("SB3*")) == []  # PyTorch makes one of its own, when it is loaded


@pytest.mark.long
def test_the_process_that_workers_are_forked_from_leaves_no_folder_among_the_temporary_files(tmp_path):
    line = [sys.executable, "-c", "import pharos.study.warm"]
    subprocess.run(line, env=os.environ | {"TMPDIR": str(tmp_path)}, check=True)
    assert list(tmp_path.glob("SB3*")) == []
