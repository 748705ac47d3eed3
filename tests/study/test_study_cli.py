"""pharos study from the command line: what it prints, what it leaves, and its exit codes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import fake_training
from patience import PATIENCE
from pharos import study
from pharos.errors import UnknownName

SPECIFICATION = """\
name: lake
steps: 200
evaluations: 4
seeds: 2
blocks:
  - environments: [frozen_lake/4x4]
    agents: [q_learning]
"""


def pharos(*arguments, cwd):
    command = [sys.executable, "-m", "pharos", "study", *arguments]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cwd / "numba")}  # nothing is compiled yet
    environment.pop("NUMBA_NUM_THREADS", None)
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=PATIENCE, env=environment)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with lake.yaml, and where that has been run."""
    place = tmp_path_factory.mktemp("cli")
    (place / "lake.yaml").write_text(SPECIFICATION)
    done = pharos("run", "lake.yaml", "--json", "--workers", "1", cwd=place)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert (answer["total"], answer["finished"], answer["failed"], answer["missing"]) == (2, 2, 0, 0)
    return place


@pytest.mark.long
def test_results_are_in_studies_name_and_the_folder_stands_for_the_study(folder):
    assert len(list((folder / "studies" / "lake" / "runs").glob("*/run.json"))) == 2
    for what in ("lake.yaml", "studies/lake"):
        done = pharos("status", what, cwd=folder)
        assert (done.returncode, done.stdout) == (0, "lake: 2 of 2 runs finished\n")


@pytest.mark.long
def test_show_counts_the_runs(folder):
    answer = json.loads(pharos("show", "lake.yaml", "--json", cwd=folder).stdout)
    assert answer["num_runs"] == 2 and answer["steps"] == 400
    assert "2 runs, 400 steps" in pharos("show", "lake.yaml", cwd=folder).stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "lak.yaml"), "pharos: unknown study (no such file, and no such preset) 'lak.yaml'"),
        (
            ("run", "lake.yaml", "--shard", "3/2"),
            "pharos: shard is '3/2'; expected i/n with i from 1 to n, such as 1/8",
        ),
        (("run", "lake.yaml", "--on", "moon"), "pharos: unknown place to run on 'moon'; known: local, ray, slurm"),
        (("report", "lake.yaml", "--out", "nowhere"), "no run of 'lake' is finished; execute `pharos study run` first"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(folder, arguments, message):
    done = pharos(*arguments, cwd=folder)
    assert done.returncode == 2 and done.stdout == ""
    assert message in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.long
def test_a_study_with_failed_runs_ends_with_exit_code_1_and_says_where_to_look(folder):
    (folder / "broken.py").write_text("def learn(env, steps, seed):\n    raise ValueError('on purpose')\n    yield\n")
    text = SPECIFICATION.replace("name: lake", "name: wrong").replace("q_learning", "broken.py:learn")
    (folder / "wrong.yaml").write_text(text)
    done = pharos("run", "wrong.yaml", cwd=folder)
    assert done.returncode == 1
    assert done.stdout == "wrong: 0 of 2 runs finished, 2 failed\n"
    assert "2 x agent broken.py:learn raised ValueError: on purpose" in done.stderr and "--retry-failed" in done.stderr


@pytest.mark.long
def test_a_study_is_found_by_its_name_after_it_was_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = fake_training.specification("lake", steps=10, evaluations=1, seeds=1)
    study.run(spec, runner=fake_training.train)
    assert study.status("lake").finished == 1 and study.status("lake").folder == "studies/lake"
    assert study.specification("lake").name == "lake"
    assert study.report("lake").html == Path("studies/lake/report/report.html")
    with pytest.raises(UnknownName, match="did you mean 'lake'"):
        study.status("lakes")
