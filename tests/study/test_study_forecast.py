"""How long a study will take, told at its start."""

import subprocess
import sys

import pytest

import fake_training
from pharos import study
from pharos.study.forecast import EARLIER, FINISHED, GUESS, NIGHT_HOURS, forecast, pace_of


def runs_of(seeds=4, steps=1000, **block):
    block = {"environments": ["frozen_lake/4x4"], "agents": ["dqn"], "seeds": seeds} | block
    return study.specification({"name": "fake", "steps": steps, "evaluations": 10, "blocks": [block]}).runs


def test_paces_are_those_of_finished_runs_then_of_earlier_studies_then_guesses(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    runs = runs_of()
    (kind,) = {run.kind for run in runs}
    assert forecast(runs, 2, {}, measure=False).paces[kind][1] == GUESS
    told = forecast(runs, 2, {kind: (50.0, 1000)}, measure=False)
    assert told.paces[kind] == (0.05, FINISHED)
    assert told.seconds == 4 * 1000 * 0.05 / 2 and told.steps == 4000 and told.in_a_night == 4
    assert str(told) == "4 runs to come, 4,000 steps: about 2 min with 2 workers (paces: finished runs)"
    assert forecast(runs, 2, {}, measure=False).paces[kind] == (0.05, EARLIER)


def test_a_night_does_what_fits_into_it_in_the_order_of_the_study(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    runs = runs_of(seeds=5, steps=NIGHT_HOURS * 3600)
    told = forecast(runs, 2, {runs[0].kind: (1.0, 1)}, measure=False)
    assert told.in_a_night == 2 and told.seconds == 2.5 * NIGHT_HOURS * 3600
    assert str(told).endswith(f"; a night of {NIGHT_HOURS} h does 2 of them")


def test_a_pace_is_measured_with_its_evaluations():
    (run,) = runs_of(seeds=1, agents=["q_learning"])
    assert 0 < pace_of(run.config) < 1


@pytest.mark.slow
def test_a_study_says_it_before_its_first_run(tmp_path):
    said = []
    spec = {"name": "fake", "steps": 100, "blocks": [{"environments": ["frozen_lake/4x4"], "agents": ["dqn"]}]}
    study.run(spec, tmp_path, runner=fake_training.train, workers=2, foretold=said.append)
    assert [each.runs for each in said] == [5]
    study.run(spec, tmp_path, runner=fake_training.train, workers=2, foretold=said.append)
    assert len(said) == 1


ENDING = """
import atexit, time
from pharos.study import worker

worker.end_cleanly()
atexit.register(lambda: (print("ending", flush=True), time.sleep(0.5)))
worker.is_ending()
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
