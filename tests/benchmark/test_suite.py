"""Suites: what their files say, and tasks that are refused where they are others."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

import pharos
from pharos import importers
from pharos.benchmark import BenchmarkTask, Protocol, Suite, baselines, frozen, load_suite, read_results, write_suite
from pharos.benchmark.results import BASELINES
from pharos.benchmark.suite import EARLIER, FOLDER, digest_of_task, rounded, suite_of
from pharos.errors import FileFormatError, ParameterError, UnknownName
from pharos.mdp import TabularMDP
from pharos.state_space import build
from pharos.training import Task

SEA = BenchmarkTask("deep_sea-6", "deep_sea", {"size": 6, "mapping_seed": 1}, "one_hot")
GOLDEN = "2adcdf195088af7a62a30504d7da6715b15251b22f6dba377dac22192adebccc"  # made on Linux, Python 3.11


def test_the_digest_of_a_task_is_the_same_everywhere():
    assert digest_of_task(SEA.training_task(Protocol())) == GOLDEN


def test_names_are_unique_and_fit_for_files():
    suite = load_suite()
    names = [task.name for task in suite.tasks]
    assert len(names) == len(set(names)) > 20
    assert all(name.replace("-", "").replace("_", "").replace(".", "").isalnum() for name in names)
    assert all(task is suite.task(task.name) for task in suite.tasks)


def test_levels_of_a_ladder_increase():
    for ladder in load_suite().ladders:
        levels = [task.level for task in ladder.tasks]
        assert levels == sorted(set(levels)) and None not in levels, ladder.axis


@pytest.mark.parametrize(
    "other",
    (
        {"parameters": {"size": 6, "mapping_seed": 2}},
        {"parameters": {"size": 6, "mapping_seed": 1, "move_cost": 0.02}},
        {"observation": "vector"},
        {"observation": "hash", "observation_options": {"bits": 8}},
        {"chance": {"random": 0.1}},
        {"chance": {"reward_noise": 1.0}},
    ),
)
def test_another_task_of_the_same_name_is_refused_by_it(other):
    frozen = replace(SEA, digest=GOLDEN, value_optimal=0.99, value_uniform=0.010625)
    frozen.check(Protocol())
    with pytest.raises(ParameterError, match=r"^task deep_sea-6: its digest is"):
        replace(frozen, **other).check(Protocol())


def test_another_setting_of_values_is_refused():
    frozen = replace(SEA, digest=GOLDEN, value_optimal=0.99, value_uniform=0.010625)
    with pytest.raises(ParameterError, match=r"^task deep_sea-6"):
        frozen.check(Protocol(gamma=0.9))
    with pytest.raises(ParameterError, match=r"^task deep_sea-6: gamma is 1 without a horizon, so regret may be infin"):
        frozen.check(Protocol(horizon="none"))
    with pytest.raises(ParameterError, match=r"^task deep_sea-6: the value of uniform play is"):
        replace(frozen, value_uniform=0.0107).check(Protocol())


def test_what_differs_in_the_last_bits_is_rounded_alike():
    values = np.random.default_rng(0).normal(size=1000) * 10.0 ** np.arange(-10, 10).repeat(50)
    assert (rounded(values) == rounded(values * (1 + 2**-52))).all()
    assert (rounded(values) != rounded(values * (1 + 1e-9))).all()
    assert not np.signbit(rounded(np.array([-0.0]))).any()
    assert (rounded(np.array([1 - 2**-53])) == rounded(np.array([1.0]))).all()


@pytest.fixture
def entry():
    return yaml.safe_load((FOLDER / "v1.yaml").read_text())


@pytest.mark.long
def test_a_file_that_was_changed_is_refused(entry):
    suite_of(entry, "file")
    for change in (
        lambda each: each["protocol"].update(steps=40_000),
        lambda each: each["core"].pop(),
        lambda each: each["core"][0].update(digest="0" * 64),
        lambda each: each["ladders"][0]["tasks"][0].update(level=1.0),
        lambda each: each["core"][0].update(name="other"),
        lambda each: each["core"][0]["predicted"].update(dqn=0.5),
        lambda each: each["core"][1]["seconds"].update(dqn=0.5),
        lambda each: each["ladders"][0].update(unit="nats"),
        lambda each: each["ladders"][0].update(quantity="another"),
        lambda each: each["hyperparameters"]["ppo"].update(learning_rate=0.1),
        lambda each: each.update(name="v2"),
    ):
        changed = yaml.safe_load(yaml.safe_dump(entry))
        change(changed)
        with pytest.raises(FileFormatError, match=r"^file: what it says has the digest .*it was changed"):
            suite_of(changed, "file")


def leaves(entry, path=()):
    """Path of every value in nested objects and lists."""
    for key, value in entry.items() if isinstance(entry, dict) else enumerate(entry):
        yield from leaves(value, (*path, key)) if isinstance(value, dict | list) else [(*path, key)]


@pytest.mark.long
def test_the_digest_covers_every_value_of_the_file(entry):
    paths = list(leaves(entry))
    assert len(paths) > 500
    for path in paths:
        place = entry
        for key in path[:-1]:
            place = place[key]
        before = place[path[-1]]
        place[path[-1]] = f"{before}x" if isinstance(before, str) else before + 1
        with pytest.raises(FileFormatError, match=r"^file: "):
            suite_of(entry, "file")
        place[path[-1]] = before
    suite_of(entry, "file")


def test_results_that_name_the_earlier_digest_are_of_the_suite_with_these_tasks():
    suite = load_suite()
    tasks = [[task.name, task.axis, task.level, task.digest] for task in suite.tasks]
    text = json.dumps({"protocol": vars(suite.protocol), "tasks": tasks}, sort_keys=True, separators=(",", ":"))
    earlier = hashlib.sha256(text.encode()).hexdigest()
    assert {earlier: suite.digest} == EARLIER
    for name in baselines():
        assert earlier.encode() in (BASELINES / "v1" / f"{name}.safetensors").read_bytes()
        assert read_results(name).digest == suite.digest


def test_a_suite_of_your_own_is_read_as_it_was_written(tmp_path):
    suite = Suite("mine", Protocol(), (frozen(replace(SEA, predicted={"dqn": 1e-5}), Protocol()),), ())
    write_suite(suite, tmp_path / "mine.yaml")
    read = load_suite(tmp_path / "mine.yaml")
    assert replace(read, digest="") == suite and len(read.digest) == 64
    read.check()
    text = (tmp_path / "mine.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text.replace("hyperparameters: {}", "hyperparameters: {dqn: {x: 2026-01-01}}"))
    with pytest.raises(FileFormatError, match="expected entries that JSON has"):
        load_suite(tmp_path / "mine.yaml")


def test_errors_say_where(entry, tmp_path):
    with pytest.raises(UnknownName, match="v0"):
        load_suite("v0")
    with pytest.raises(FileFormatError, match=r"^file: is no suite; expected the entries name"):
        suite_of({"name": "v1"}, "file")
    del entry["core"][1]["digest"]
    with pytest.raises(FileFormatError, match=rf"^file: core: task {entry['core'][1]['name']} lacks digest"):
        suite_of(entry, "file")
    (tmp_path / "bad.yaml").write_text("a: [")
    with pytest.raises(FileFormatError, match=r"bad\.yaml:1: "):
        load_suite(tmp_path / "bad.yaml")


def outcomes(**changes):
    """Arrays of a small world with several outcomes: two states, two actions, and the end, a third state."""
    arrays = {
        "successors": [[[0, 1], [1, -1]], [[-1, 0], [1, 0]]],
        "probabilities": [[[0.25, 0.75], [0.5, 0.5]], [[1.0, 0.0], [0.125, 0.875]]],
        "rewards": [[0.0, 1.0], [0.5, -1.0]],
        "initial": [0.5, 0.5],
    }
    return {name: np.array(changes.get(name, values)) for name, values in arrays.items()}


@pytest.fixture
def digest_of(monkeypatch):
    def digest(observation="index", **changes):
        mdp = TabularMDP.from_outcomes(**outcomes(**changes)).with_horizon(5)
        task = Task(importers.environment(mdp), observation=observation, horizon=5)
        assert task.mdp.num_states == 3 and task.observer.observe.observation.space is not None
        with monkeypatch.context() as patch:  # its folder, which is named by what it holds
            patch.setattr(type(task.env), "parameters", {"folder": "world"})
            return digest_of_task(task)

    return digest


@pytest.mark.long
def test_every_array_of_the_world_counts(digest_of):
    digests = [
        digest_of(),
        digest_of(successors=[[[0, 1], [1, -1]], [[-1, 0], [0, 1]]]),
        digest_of(probabilities=[[[0.25, 0.75], [0.5, 0.5]], [[1.0, 0.0], [0.25, 0.75]]]),
        digest_of(rewards=[[0.0, 1.0], [0.5, -1.0 + 1e-9]]),
        digest_of(initial=[0.25, 0.75]),
        digest_of("one_hot"),
    ]
    assert len(set(digests)) == len(digests)


@pytest.mark.long
def test_the_order_of_outcomes_does_not_count(digest_of):
    other = {"successors": [[[1, 0], [-1, 1]], [[-1, 0], [0, 1]]]}
    other["probabilities"] = [[[0.75, 0.25], [0.5, 0.5]], [[1.0, 0.0], [0.875, 0.125]]]
    assert digest_of(**other) == digest_of()
    assert digest_of(rewards=[[-0.0, 1.0], [0.5, -1.0]]) == digest_of()


def test_every_observation_counts():
    from gymnasium import spaces

    def picture(env, states):
        return np.concatenate([states, np.where(states[:, :1] == unseen, 1, 0)], axis=1).astype(np.float32)

    def digest():
        task = SEA.training_task(Protocol())
        box = spaces.Box(0, 10, (task.space.states().shape[1] + 1,), np.float32)
        return digest_of_task(replace(task, observation=(picture, box)))

    unseen = 99
    before = digest()
    assert digest() == before
    unseen = 3
    assert digest() != before


@pytest.mark.slow
def test_a_table_on_disk_has_the_digest_of_one_in_memory(tmp_path):
    task = BenchmarkTask("lake", "frozen_lake", {"size": 5, "seed": 0}).training_task(Protocol())
    other = BenchmarkTask("lake", "frozen_lake", {"size": 5, "seed": 0}).training_task(Protocol())
    other.__dict__["space"] = pharos.load(build(task.env, tmp_path / "lake", memory=1 << 24, workers=2).folder)
    assert digest_of_task(other) == digest_of_task(task)


@pytest.mark.long
def test_every_task_of_v1_is_what_it_was():
    load_suite().check()
