"""What `pharos benchmark show` prints."""

import pytest

from command_line import answer, run, usage_error
from pharos.benchmark import load_suite
from pharos.cli import benchmark as commands


def test_the_answer_has_every_task():
    said, suite = answer("benchmark", "show"), load_suite()
    tasks = said["core"] + [task for ladder in said["ladders"] for task in ladder["tasks"]]
    assert [each["name"] for each in tasks] == [task.name for task in suite.tasks]
    assert [each["digest"] for each in tasks] == [task.digest for task in suite.tasks]
    assert (said["digest"], said["protocol"]["steps"]) == (suite.digest, 30_000)
    assert said["minutes"]["dqn"] == pytest.approx(commands._minutes(suite)["dqn"])


def test_the_table_has_every_task_with_its_level(monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    shown = run("benchmark", "show", "v1").stdout
    assert all(task.name in shown for task in load_suite().tasks)
    assert "6 bits" in shown and load_suite().digest in shown.replace("\n", "")


def test_minutes_count_tasks_without_a_time_as_the_mean():
    suite = load_suite()
    seconds = [task.seconds["ppo"] for task in suite.tasks if "ppo" in task.seconds]
    expected = sum(seconds) / len(seconds) * len(suite.tasks) * 10 / 60
    assert commands._minutes(suite)["ppo"] == pytest.approx(expected)


def test_no_such_suite_is_one_line():
    said = usage_error("benchmark", "show", "v9")
    assert "'v9'" in said and "did you mean 'v" in said
