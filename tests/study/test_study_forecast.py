"""How long a study will take, told at its start."""

import subprocess
import sys

import pytest

import fake_training
from pharos import study


@pytest.mark.slow
def test_a_study_says_before_its_first_run_what_is_missing_at_the_pace_of_finished_runs(tmp_path):
    told = []
    block = {"environments": ["frozen_lake/4x4"], "agents": ["dqn"]}

    def run(seeds):
        spec = {"name": "fake", "steps": 100, "blocks": [block], "seeds": seeds}
        study.run(spec, tmp_path, runner=fake_training.train, workers=2, on_forecast=told.append)
        return sum(study.table(spec, tmp_path)["seconds"]) / seeds

    pace = run(2)
    run(5)
    run(5)
    first, second = told  # the third has nothing to run
    assert (first.runs, first.steps, first.workers, first.seconds) == (2, 200, 2, None)
    assert str(first) == "2 runs to come, 200 steps; how long they take is told once one is finished"
    assert (second.runs, second.steps) == (3, 300) and second.seconds == pytest.approx(3 * pace / 2)
    assert str(second).startswith("3 runs to come, 300 steps: about ")
    assert str(second).endswith(" with 2 workers, at the pace of finished runs")


ENDING = """
import atexit, os, time
from types import SimpleNamespace
from pharos.system import workers

atexit.register(lambda: (print("ending", flush=True), time.sleep(0.5)))
workers._work(lambda _: None, (), SimpleNamespace(send=lambda _: None), dict(os.environ), True, False)
"""


@pytest.mark.slow
def test_a_process_that_ends_by_itself_is_not_interrupted_in_it():
    process = subprocess.Popen(
        [sys.executable, "-c", ENDING], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ending\n"
    process.terminate()
    _, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
