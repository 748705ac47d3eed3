"""What others send to the benchmark: suites and folders of runs decide about numbers alone, not about code or files."""

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from command_line import answer, process, run, usage_error
from patience import PATIENCE
from pharos import benchmark
from pharos.benchmark import BenchmarkTask, Protocol, Submission, Suite, load_suite, submit, verify, write_suite
from pharos.benchmark.suite import digest_of_suite, frozen
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted, UntrustedCode
from pharos.system import storage
from pharos.training import read_record
from refusals import refusal

PROTOCOL = Protocol(steps=300, evaluations=3, seeds=2)
SEA = BenchmarkTask("sea", "deep_sea", {"size": 4, "mapping_seed": 1}, "one_hot")
EVIL = """
import pathlib
import numpy as np
from gymnasium import spaces
from pharos.environments import DeepSea

pathlib.Path(__file__).with_name("mark").touch()

class Evil(DeepSea):
    name, instances = "evil_sea", {}  # none is listed in this process

seen = (lambda env, states: states.astype(np.float32), spaces.Box(0, 99, (2,), np.float32))
"""


def whole(*tasks):
    made = Suite("mini", PROTOCOL, tasks, (), "", {})
    return replace(made, digest=digest_of_suite(made))


@pytest.fixture(scope="module")
def suite():
    return whole(frozen(SEA, PROTOCOL))


@pytest.fixture(scope="module")
def finished(suite, tmp_path_factory):
    """The folder of two runs of Q-learning, and the file of their suite."""
    folder = tmp_path_factory.mktemp("finished")
    write_suite(suite, folder / "mini.yaml")
    benchmark.run("q_learning", suite, out=folder / "runs", seeds=range(2), workers=1)
    return folder


@pytest.fixture
def place(finished, tmp_path, monkeypatch):
    """A copy of it, where commands are given."""
    shutil.copytree(finished, tmp_path / "place")
    monkeypatch.chdir(tmp_path / "place")
    return tmp_path / "place"


# Code -----------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("named", ["evil.py:Evil", "evil:Evil", "observation"])
def test_a_received_suite_runs_code_only_if_it_is_trusted(named, suite, place):
    (place / "evil.py").write_text(EVIL)
    (task,) = suite.tasks
    change = {"observation": "evil.py:seen"} if named == "observation" else {"environment": named}
    write_suite(whole(replace(task, **change)), place / "received.yaml")
    submit("runs", "it.safetensors", suite)
    for words in (
        ("verify", "it.safetensors"),
        ("submit", "runs"),
        ("run", "--agent", "random", "--out", "out"),
        ("board", "it.safetensors", "--out", "board.html"),
    ):
        said = usage_error("benchmark", *words, "--suite", "received.yaml")
        assert "received.yaml: task sea: 'evil" in said and "add --trust" in said
    assert "evil" in run("benchmark", "show", "received.yaml", "--json").stdout
    with pytest.raises(UntrustedCode):
        load_suite("received.yaml")
    assert not (place / "mark").exists()
    load_suite("received.yaml", trust=True).tasks[0].training_task(PROTOCOL).observer.observe  # noqa: B018
    assert (place / "mark").exists()


def test_submit_runs_no_code_that_a_run_names(suite, place):
    """The run.json of a network, forged: the class of its environment lies in a file."""
    file = place / "evil_run.py"  # of another name than the suite's, which this process has imported
    file.write_text(EVIL)
    for seed in range(2):
        folder = place / "runs" / "runs" / "sea" / f"seed-{seed}"
        (folder / "agent").mkdir()
        (folder / "policy.npy").unlink()
        record = read_record(folder)
        source = {"name": "evil_run.py:Evil", "file": str(file), "checksum": storage.digest_of_file(file)}
        record["config"] |= {"agent": "ppo", "engine": "batched", "sources": {"environment": source}}
        record["checksums"].pop("policy.npy")
        storage.replace_json(folder / "run.json", storage.sealed(record))
    said = usage_error("benchmark", "submit", "runs", "--suite", "mini.yaml")
    assert "run.json: evil_run.py:Evil" in said and "add --trust" in said
    assert not (place / "mark").exists()


# Names ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["../../../x", "/tmp/x", "..", "", "a/b", "a\nb", "a\0b", "\x1b[2J"])
def test_names_of_tasks_that_lead_out_of_a_folder_are_refused(name, suite, place):
    entry = yaml.safe_load((place / "mini.yaml").read_text())
    entry["core"][0]["name"] = name
    forged = replace(suite, core=(_renamed(suite.tasks[0], name),))
    entry["digest"] = digest_of_suite(forged)
    (place / "received.yaml").write_text(yaml.safe_dump(entry))
    before = sorted(place.parent.rglob("*"))
    done = run("benchmark", "run", "--agent", "random", "--suite", "received.yaml", "--out", "deep/deep/out")
    assert (done.exit_code, done.stdout, done.stderr.count("\n")) == (1, "", 1), done.output
    assert "the name of a task is" in done.stderr and "\x1b" not in done.stderr
    assert sorted(place.parent.rglob("*")) == before
    assert "the name of a task" in refusal(ParameterError, replace, suite.tasks[0], name=name)


def _renamed(task, name):
    """A task with a name that no task can be given."""
    copy = object.__new__(BenchmarkTask)
    copy.__dict__.update(vars(task), name=name)
    return copy


# Files that are none, and YAML that is none ---------------------------------------------------------------------------


@pytest.mark.long
def test_a_suite_that_is_a_pipe_or_a_device_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    (tmp_path / "folder.yaml").mkdir()
    for name in ("pipe", "zero", "folder"):
        done = process("benchmark", "verify", "x", "--suite", tmp_path / f"{name}.yaml", timeout=PATIENCE)
        assert done.returncode == 1 and "no regular file" in done.stderr and done.stderr.count("\n") == 1


BOMB = "\n".join([f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9) if i else 'x'}]" for i in range(10)])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 20_000 + "]" * 20_000, "nested too deep"),
        ("name: " + "9" * 5000, "Exceeds the limit"),
        ("name: 2001-99-99", "month must be"),
        (BOMB, "aliases written out"),
        ("a: &a [*a]", "alias stands within"),
        ("a: 1\na: 2", "stands there twice"),
        ("a: !!python/object/apply:os.system [touch mark]", "could not determine a constructor"),
        ("a: \0", "no YAML"),
    ],
)
def test_yaml_that_no_suite_needs_is_refused_in_one_line(text, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "received.yaml").write_text(text)
    assert said in refusal(FileFormatError, load_suite, "received.yaml")
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize("value", [[], {"dqn": 3}, "x", None])
def test_hyperparameters_of_a_suite_are_mappings(value, place):
    entry = yaml.safe_load((place / "mini.yaml").read_text())
    (place / "received.yaml").write_text(yaml.safe_dump(entry | {"hyperparameters": value}))
    assert "hyperparameters" in refusal(FileFormatError, load_suite, "received.yaml")


# Links ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["score.json", "results.safetensors", "lock", "agent.json"])
def test_links_in_a_folder_of_results_are_replaced(name, place):
    victim = place.parent / "victim"
    victim.write_text("precious" if name != "agent.json" else (place / "runs" / name).read_text())
    before = victim.read_bytes()
    (place / "runs" / name).unlink(missing_ok=True)
    (place / "runs" / name).symlink_to(victim)
    answer("benchmark", "run", "--agent", "q_learning", "--suite", "mini.yaml", "--out", "runs", "--seeds", 2)
    assert victim.read_bytes() == before
    assert name == "agent.json" or not (place / "runs" / name).is_symlink()


@pytest.mark.parametrize("name", ["runs", "runs/sea", "runs/sea/seed-0", "checkpoints"])
def test_folders_behind_links_are_not_written_to(name, place):
    elsewhere = place.parent / "elsewhere"
    (elsewhere / "sea" / "seed-0").mkdir(parents=True)
    (elsewhere / "seed-0").mkdir()
    for folder in (elsewhere, elsewhere / "seed-0", elsewhere / "sea" / "seed-0"):
        (folder / "policy.npy").write_text("precious")
    before = {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()}
    shutil.rmtree(place / "runs" / name, ignore_errors=True)
    (place / "runs" / name).symlink_to(elsewhere)
    answer("benchmark", "run", "--agent", "q_learning", "--suite", "mini.yaml", "--out", "runs", "--seeds", 2)
    assert {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()} == before
    assert not (place / "runs" / name).is_symlink()


def test_a_file_that_the_user_named_may_be_a_link(place):
    (place / "real.safetensors").write_text("older")
    (place / "link.safetensors").symlink_to("real.safetensors")
    answer("benchmark", "submit", "runs", "--suite", "mini.yaml", "--out", "link.safetensors")
    assert (place / "link.safetensors").is_symlink()
    assert len(Submission.read(place / "real.safetensors").policies) == 2


# Damage ---------------------------------------------------------------------------------------------------------------


def test_a_damaged_policy_is_not_packed(suite, place):
    file = place / "runs" / "runs" / "sea" / "seed-0" / "policy.npy"
    np.save(file, 1 - np.load(file))
    assert "policy.npy: was changed" in refusal(ResultCorrupted, submit, "runs", "it.safetensors", suite)
    assert not (place / "it.safetensors").exists()
    done = run("benchmark", "run", "--agent", "q_learning", "--suite", "mini.yaml", "--out", "runs", "--seeds", 2)
    assert done.exit_code == 1 and "policy.npy: was changed" in done.stderr
    file.unlink()
    assert "policy.npy" in refusal(ResultCorrupted, submit, "runs", "it.safetensors", suite)
    os.mkfifo(file)
    assert "no regular file" in refusal(ResultCorrupted, submit, "runs", "it.safetensors", suite)


def test_a_whole_policy_is_packed_and_holds(suite, place):
    submit("runs", "it.safetensors", suite)
    assert verify("it.safetensors", suite).holds
    agent = json.loads((place / "runs" / "agent.json").read_text())
    assert agent["agent"] == "q_learning"
