"""A study on other engines ends with the same files as on this machine."""

import os
import shutil
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

import fake_batches
import fake_training
from pharos import study
from pharos.errors import MissingExtra, ParameterError
from pharos.study.execution import shard_of

SPECIFICATION = fake_training.specification(steps=100, evaluations=10, seeds=4, agents=["dqn", "q_learning"])


@pytest.fixture
def undisturbed(tmp_path):
    """The results of the study on this machine."""
    study.run(SPECIFICATION, tmp_path / "here", runner=fake_training.train, workers=2)
    return fake_training.results(tmp_path / "here")


@pytest.mark.long
def test_submitted_jobs_execute_their_shards(tmp_path, undisturbed, monkeypatch):
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)
    options = {"shards": 2, "cluster": "local", "parameters": {"timeout_min": 2}, "runner": fake_training.train}
    jobs = study.submit(SPECIFICATION, tmp_path / "there", **options)
    assert [job.result()["finished"] for job in jobs] == [4, 4]
    assert fake_training.results(tmp_path / "there") == undisturbed
    assert study.submit(SPECIFICATION, tmp_path / "there", **options) == []
    one = shard_of(SPECIFICATION.runs, "2/2")[0].id
    shutil.rmtree(tmp_path / "there" / "runs" / one)
    (job,) = study.submit(SPECIFICATION, tmp_path / "there", **options)
    assert job.result()["finished"] == 4
    assert fake_training.results(tmp_path / "there") == undisturbed


def test_where_there_is_no_slurm_submitting_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ParameterError, match="cannot submit to slurm"):
        study.submit(SPECIFICATION, tmp_path, shards=2)
    with pytest.raises(ParameterError, match="expected slurm or local"):
        study.submit(SPECIFICATION, tmp_path, shards=2, cluster="cloud")


class RayDouble(SimpleNamespace):
    """What pharos uses of Ray, executed at once in this process; `dies` are runs whose process is lost."""

    def __init__(self, dies=()):
        super().__init__(started=False, ended=False, waits=0, dies=set(dies))

    def is_initialized(self):
        return self.started

    def init(self, **options):
        self.started = True

    def shutdown(self):
        self.ended = True

    def remote(self, **options):
        assert options == {"num_cpus": 1, "max_retries": 2}
        return lambda function: SimpleNamespace(remote=lambda *arguments: partial(function, *arguments))

    def wait(self, references, num_returns, timeout):
        self.waits += 1
        return references[:num_returns], references[num_returns:]

    def get(self, reference):
        ids = reference.args[2]
        if self.dies & ({ids} if isinstance(ids, str) else set(ids)):
            raise RuntimeError("the worker died")
        return reference()


@pytest.mark.slow
def test_on_ray_every_run_is_one_task_and_lost_ones_have_failed(tmp_path, undisturbed, monkeypatch):
    lost = SPECIFICATION.runs[3].id
    double = RayDouble(dies=[lost])
    monkeypatch.setitem(sys.modules, "ray", double)
    end = study.run_on_ray(SPECIFICATION, tmp_path / "ray", runner=fake_training.train)
    assert (end.finished, end.failed) == (7, 1)
    assert end.errors == {lost: "RuntimeError: the worker died"}
    assert double.ended and double.waits == 8
    double.dies.clear()
    end = study.run_on_ray(SPECIFICATION, tmp_path / "ray", runner=fake_training.train, retry_failed=True)
    assert end.finished == 8
    assert fake_training.results(tmp_path / "ray") == undisturbed


def test_on_ray_a_batch_is_one_task_and_one_that_is_lost_goes_on_in_halves(tmp_path, monkeypatch):
    sizes = tmp_path / "sizes"
    sizes.touch()
    monkeypatch.setenv("PHAROS_FAKE_BATCHES", str(sizes))
    spec = fake_training.specification(steps=100, evaluations=10, engine="batched", agents=["dqn"], seeds=6)
    lost = spec.runs[0].id
    double = RayDouble(dies=[lost])
    monkeypatch.setitem(sys.modules, "ray", double)
    runners = {"runner": fake_training.train, "batch_runner": fake_batches.train}
    end = study.run_on_ray(spec, tmp_path / "ray", **runners)
    assert (end.finished, end.errors) == (5, {lost: "RuntimeError: the worker died"})
    assert sorted(map(int, sizes.read_text().split())) == [2, 3]  # six are lost, then three, then one
    double.dies.clear()
    assert study.run_on_ray(spec, tmp_path / "ray", retry_failed=True, **runners).finished == 6


def test_without_ray_the_message_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtra, match=r"pip install 'pharos-rl\[ray\]'"):
        study.run_on_ray(SPECIFICATION, tmp_path)
    assert not os.listdir(tmp_path)
