"""Suites: what their files say, and tasks that are refused where they are others."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from pharos.benchmark import BenchmarkTask, Protocol, load_suite
from pharos.benchmark.suite import FOLDER, digest_of_task, rounded, suite_of
from pharos.errors import FileFormatError, ParameterError, UnknownName

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


def test_a_file_that_was_changed_is_refused(entry):
    suite_of(entry, "file")
    for change in (
        lambda each: each["protocol"].update(steps=40_000),
        lambda each: each["core"].pop(),
        lambda each: each["core"][0].update(digest="0" * 64),
        lambda each: each["ladders"][0]["tasks"][0].update(level=1.0),
        lambda each: each["core"][0].update(name="other"),
    ):
        changed = yaml.safe_load(yaml.safe_dump(entry))
        change(changed)
        with pytest.raises(FileFormatError, match=r"^file: its tasks and protocol have the digest .*it was changed"):
            suite_of(changed, "file")


def test_errors_say_where(entry, tmp_path):
    with pytest.raises(UnknownName, match="v0"):
        load_suite("v0")
    with pytest.raises(FileFormatError, match=r"^file: is no suite; expected the entries name"):
        suite_of({"name": "v1"}, "file")
    del entry["core"][1]["digest"]
    with pytest.raises(FileFormatError, match=rf"^file: core: task {entry['core'][1]['name']} lacks digest"):
        suite_of(entry, "file")
    (tmp_path / "bad.yaml").write_text("a: [")
    with pytest.raises(FileFormatError, match=r"bad\.yaml: is no YAML"):
        load_suite(tmp_path / "bad.yaml")
