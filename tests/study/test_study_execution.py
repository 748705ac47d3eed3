"""Executing a study: what is missing runs, failures stay alone, and kill -9 at any moment loses and repeats nothing."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

import fake_training
from children import exit_code
from edits import edited_json, flip
from patience import PATIENCE, wait_for
from pharos import study
from pharos.errors import AllRunsFailed, ParameterError, PharosError
from pharos.study import execution as _execution
from pharos.study import execution as preparing
from pharos.study import worker as _worker
from pharos.study.execution import shard_of
from pharos.system import storage, workers
from refusals import failing

TESTS = Path(__file__).parents[1]


def specification(name="fake", **given):
    usual = {"agents": ["dqn", "q_learning"], "seeds": 3, "steps": 100, "evaluations": 10}
    return fake_training.specification(name, **usual | given)


@pytest.fixture
def log(tmp_path, monkeypatch):
    """Which runs were finished, one line each time."""
    path = tmp_path / "log"
    path.touch()
    monkeypatch.setenv("PHAROS_FAKE_LOG", str(path))
    return path


def test_every_run_is_executed_once_and_a_second_command_finds_nothing_to_do(tmp_path, log):
    spec = specification()
    end = study.run(spec, tmp_path / "out", runner=fake_training.train, workers=2)
    assert (end.total, end.finished, end.failed, end.missing) == (6, 6, 0, 0)
    again = study.run(spec, tmp_path / "out", runner=fake_training.train, workers=2)
    assert again.finished == 6
    assert sorted(log.read_text().split()) == sorted(run.id for run in spec.runs)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["runs", "status.json", "study.yaml"]
    assert study.status(spec, tmp_path / "out").finished == 6
    assert json.loads((tmp_path / "out" / "status.json").read_text())["finished"] == 6


def test_a_part_of_a_study_is_executed_and_the_rest_afterwards(tmp_path, log):
    spec = specification()
    part = [run.id for run in spec.runs if run.config["agent"] == "dqn"]
    end = study.run(spec, tmp_path, runner=fake_training.train, workers=2, block=[1], agent=["dqn"])
    assert (end.total, end.finished) == (3, 3) and sorted(log.read_text().split()) == sorted(part)
    for wrong, message in (({"block": [2]}, "has blocks 1 to 1"), ({"observation": ["hash"]}, "hash")):
        with pytest.raises(PharosError, match=message):
            study.run(spec, tmp_path, runner=fake_training.train, **wrong)
    assert study.run(spec, tmp_path, runner=fake_training.train, workers=2).finished == 6
    assert len(log.read_text().split()) == 6


@pytest.mark.slow
def test_the_folder_of_a_study_is_a_specification_of_the_same_runs(tmp_path):
    spec = specification(chance=["plain", {"sticky": 0.25}])
    study.run(spec, tmp_path, runner=fake_training.train, workers=2)
    assert [run.id for run in study.specification(tmp_path).runs] == [run.id for run in spec.runs]
    with pytest.raises(ParameterError, match="holds the study 'fake', not 'other'"):
        study.run(specification("other"), tmp_path, runner=fake_training.train)


def test_a_run_that_fails_fails_alone_says_why_and_is_repeated_only_on_request(tmp_path, log):
    spec = specification(agents=["dqn"], hyperparameters={"dqn": {"target_update_interval": 1}})
    end = study.run(spec, tmp_path / "out", runner=fake_training.train, workers=2)
    assert (end.finished, end.failed) == (2, 1)
    (failed,) = end.errors
    assert end.errors[failed] == "ValueError: this seed fails on purpose"
    assert "Traceback" in (tmp_path / "out" / "runs" / failed / "log.txt").read_text()
    assert study.run(spec, tmp_path / "out", runner=fake_training.train).failed == 1
    assert study.run(spec, tmp_path / "out", runner=fake_training.train, retry_failed=True).failed == 1
    assert len(log.read_text().split()) == 2


@pytest.mark.slow
def test_failed_runs_that_are_repeated_with_success_replace_the_failure(tmp_path):
    spec = specification(agents=["dqn"], seeds=2)
    assert end_of_failures(spec, tmp_path, runner=raise_always, workers=2).failed == 2
    assert end_of_failures(spec, tmp_path, runner=fake_training.train, workers=2).failed == 2
    end = study.run(spec, tmp_path, runner=fake_training.train, workers=2, retry_failed=True)
    assert (end.finished, end.failed) == (2, 0)


def end_of_failures(*given, **options):
    """The status of a study all of whose runs fail."""
    with pytest.raises(AllRunsFailed) as caught:
        study.run(*given, **options)
    return caught.value.outcome


def raise_always(config, folder):
    raise RuntimeError("no")


def write_nothing(config, folder):
    """A runner that returns without results."""


def never_end(config, folder):
    time.sleep(PATIENCE)


def kill_itself(config, folder):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_runner_that_writes_nothing_has_failed(tmp_path):
    end = end_of_failures(specification(agents=["dqn"], seeds=1), tmp_path, runner=write_nothing)
    assert "without a finished run.json" in next(iter(end.errors.values()))


@pytest.mark.slow
def test_a_run_that_takes_too_long_is_ended(tmp_path):
    end = end_of_failures(specification(agents=["dqn"], seeds=1), tmp_path, runner=never_end, timeout=0.5)
    (error,) = end.errors.values()
    assert error == "took longer than 0.5 s; it was ended: raise --timeout, or look for a loop without an end"


@pytest.mark.slow
def test_a_process_that_dies_three_times_has_failed(tmp_path):
    end = end_of_failures(specification(agents=["dqn"], seeds=1), tmp_path, runner=kill_itself)
    assert "ended by SIGKILL, 3 times" in next(iter(end.errors.values()))


def test_shards_are_disjoint_and_together_all(tmp_path):
    runs = specification(seeds=10).runs
    parts = [shard_of(runs, f"{i}/3") for i in (1, 2, 3)]
    assert sorted(run.id for part in parts for run in part) == sorted(run.id for run in runs)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    for wrong in ("0/3", "4/3", "1", "a/b"):
        with pytest.raises(ParameterError, match="expected i/n"):
            shard_of(runs, wrong)


@pytest.mark.slow
def test_shards_share_a_folder(tmp_path, log):
    spec = specification()
    for i in (1, 2):
        study.run(spec, tmp_path / "out", runner=fake_training.train, shard=f"{i}/2", workers=2)
        assert study.status(spec, tmp_path / "out").finished == 3 * i
    assert len(log.read_text().split()) == 6
    assert len(list((tmp_path / "out").glob("status-*-of-2.json"))) == 2


@pytest.mark.slow
def test_progress_tells_how_long_it_will_take(tmp_path):
    told = []
    study.run(specification(), tmp_path, runner=fake_training.train, workers=1, progress=told.append)
    assert told[-1].finished == 6 and told[-1].remaining == 0
    assert any(now.remaining for now in told)
    assert str(told[-1]) == "fake: 6 of 6 runs finished"


@pytest.mark.long
def test_instances_are_prepared_once_each_before_the_runs_and_a_failure_there_stops_nothing(tmp_path, log):
    spec = specification(agents=["dqn"], seeds=2, environments=["frozen_lake/4x4", "frozen_lake/8x8"])
    end = study.run(spec, tmp_path / "out", runner=fake_training.train, prepare=prepare, workers=2)
    assert end.finished == 4
    lines = log.read_text().split()
    assert lines[:2] == ["prepared-4", "prepared-8"]
    assert sorted(lines[2:]) == sorted(run.id for run in spec.runs)


def prepare(config):
    with open(os.environ["PHAROS_FAKE_LOG"], "a") as file:
        file.write(f"prepared-{config['parameters']['size']}\n")
    raise RuntimeError("no matter")


def die_once(config, folder):
    """Killed at the first attempt, after it left a note; tells at the next whether it found the note."""
    note = folder / "note"
    if not (folder.parent.parent / "died").exists():
        note.touch()
        (folder.parent.parent / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    fake_training.train(config, folder)
    (folder / f"found-{note.exists()}").touch()


@pytest.mark.parametrize("resume", [False, True])
def test_a_killed_run_starts_anew_unless_it_is_to_be_resumed(tmp_path, resume):
    spec = specification(agents=["dqn"], seeds=1)
    assert study.run(spec, tmp_path, runner=die_once, resume=resume).finished == 1
    assert (tmp_path / "runs" / spec.runs[0].id / f"found-{resume}").exists()


# kill -9 -------------------------------------------------------------------------------------------------------------

RUNNER = """
import sys, fake_training
from pharos import study
if __name__ == "__main__":
    study.run(study.specification(sys.argv[1]), sys.argv[2], runner=fake_training.train, workers=2)
"""


def start_runner(tmp_path, log, limit=10**6):
    path = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    environment = {"PYTHONPATH": path, "PHAROS_FAKE_LOG": str(log), "PHAROS_FAKE_SECONDS": "0.2"}
    environment["PHAROS_FAKE_LIMIT"] = str(limit)
    arguments = [sys.executable, "-c", RUNNER, str(tmp_path / "fake.yaml"), str(tmp_path / "out")]
    return subprocess.Popen(arguments, env={**os.environ, **environment})


def workers_of(folder):
    """Living processes that hold the lock of a run, by what they wrote into it."""
    found = []
    for lock in Path(folder).glob("locks/*/lock"):
        words = lock.read_text().split()
        if len(words) == 4 and Path(f"/proc/{words[1]}").exists():
            found.append(int(words[1]))
    return found


def undisturbed(spec, tmp_path, log):
    """Results of a study that nothing disturbs, beside whose folder its specification lies now."""
    assert study.run(spec, tmp_path / "undisturbed", runner=fake_training.train, workers=2).finished == len(spec.runs)
    log.write_text("")
    (tmp_path / "fake.yaml").write_text((tmp_path / "undisturbed" / "study.yaml").read_text())
    return fake_training.results(tmp_path / "undisturbed")


@pytest.mark.long
def test_killing_runner_and_workers_loses_and_repeats_nothing(tmp_path, log):
    expected, out = undisturbed(specification(seeds=8), tmp_path, log), tmp_path / "out"
    assert len(expected) == 16

    for killed in (1, 2):
        target = len(log.read_text().split()) + 2
        runner = start_runner(tmp_path, log, limit=target + 3)  # it cannot end before it is killed
        wait_for(lambda target=target: len(log.read_text().split()) >= target)
        os.kill(wait_for(lambda: workers_of(out))[0], signal.SIGKILL)
        wait_for(lambda target=target: len(log.read_text().split()) >= target + 2)
        orphans = wait_for(lambda: workers_of(out))
        runner.kill()
        assert runner.wait() == -signal.SIGKILL
        wait_for(lambda orphans=orphans: not any(Path(f"/proc/{pid}").exists() for pid in orphans))
        assert len(fake_training.results(out)) < 16, f"kill {killed} came too late"

    assert start_runner(tmp_path, log).wait(PATIENCE) == 0
    assert fake_training.results(out) == expected
    assert set(Counter(log.read_text().split()).values()) == {1}
    assert not (out / "partial").exists()


@pytest.mark.long
def test_two_runners_on_one_folder_share_the_work(tmp_path, log):
    expected = undisturbed(specification(seeds=4), tmp_path, log)
    both = [start_runner(tmp_path, log) for _ in range(2)]
    assert [runner.wait(PATIENCE) for runner in both] == [0, 0]
    assert fake_training.results(tmp_path / "out") == expected
    assert set(Counter(log.read_text().split()).values()) == {1}


@pytest.mark.slow
def test_what_another_runner_finishes_is_counted_at_once(tmp_path, log, monkeypatch):
    monkeypatch.setattr(_execution, "OTHERS_SECONDS", 0.0)
    monkeypatch.setenv("PHAROS_FAKE_SECONDS", "0.2")
    spec = specification()
    others, told = spec.runs[-3:], []

    def look(status):
        told.append((status.finished, len(log.read_text().splitlines()) if log.exists() else 0))
        if len(told) == 2:
            for run in others:
                assert fake_training.attempt(run, tmp_path / "out") == "finished"

    end = study.run(spec, tmp_path / "out", runner=fake_training.train, workers=1, progress=look)
    assert end.finished == len(spec.runs) and end.missing == 0
    early = [finished for finished, _ in told[3:6]]
    assert min(early) >= len(others)
    assert len(log.read_text().splitlines()) == len(spec.runs)  # each once


def test_a_result_that_was_complete_when_its_process_was_killed_is_kept(tmp_path, log):
    spec = specification(agents=["dqn"], seeds=1)
    id = spec.runs[0].id
    (tmp_path / "partial" / id).mkdir(parents=True)
    fake_training.train(spec.runs[0].config, tmp_path / "partial" / id)
    study.run(spec, tmp_path, runner=raise_always)
    assert study.status(spec, tmp_path).finished == 1
    assert log.read_text().split() == [id]


# Damage, and processes that die --------------------------------------------------------------------------------------


def cut(file):
    file.write_bytes(file.read_bytes()[:300])


def no_run(file):
    file.write_text('{"hello": [1, 2]}')


def of_text(file):
    with edited_json(file) as record:
        record["result"]["cumulative_regret"] = "=cmd"


DAMAGES = {
    "a cut record": ("run.json", cut),
    "a cut curve": ("curve.parquet", cut),
    "a foreign record": ("run.json", no_run),
    "a foreign curve": ("curve.parquet", lambda file: file.write_bytes(b"PAR1 is the beginning and the end PAR1")),
    "no curve": ("curve.parquet", Path.unlink),
    "a record of text": ("run.json", of_text),
}


@pytest.mark.long
def test_a_bit_in_a_page_of_a_curve_is_noticed_and_the_run_made_again(tmp_path):
    spec = fake_training.specification(steps=60, seeds=2)
    study.run(spec, tmp_path, workers=2)
    bad = spec.runs[1].id
    file = tmp_path / "runs" / bad / "curve.csv"
    whole = file.read_bytes()
    flip(file, 200, 4)
    assert list(study.status(spec, tmp_path).damaged) == [bad]
    assert study.run(spec, tmp_path, workers=2).finished == 2
    assert file.read_bytes() == whole


@pytest.mark.long
@pytest.mark.parametrize(
    "damage", [each if each == "a cut record" else pytest.param(each, marks=pytest.mark.long) for each in DAMAGES]
)
def test_one_damaged_run_is_a_line_and_does_not_stop_the_others(tmp_path, log, damage):
    spec = specification()
    out = tmp_path / "out"
    study.run(spec, out, runner=fake_training.train, workers=2)
    bad = spec.runs[1].id
    name, change = DAMAGES[damage]
    change(out / "runs" / bad / name)
    name = "curve.csv" if damage == "no curve" else name
    with pytest.warns(RuntimeWarning, match=f"1 run left out, {bad}: .*{name}.*`pharos study run` makes them again"):
        assert bad not in set(study.table(spec, out)["id"])
    with pytest.warns(RuntimeWarning, match="1 run left out"):
        assert set(study.curves(spec, out)["id"]) == {run.id for run in spec.runs} - {bad}
    now = study.status(spec, out)
    if damage != "a record of text":  # without a digest, as older versions wrote them
        assert (now.finished, now.missing) == (5, 1)
        assert list(now.damaged) == [bad] and "\n" not in now.damaged[bad] and name in now.damaged[bad]
        assert str(now).startswith("fake: 5 of 6 runs finished, 1 damaged")
        log.write_text("")
        assert study.run(spec, out, runner=fake_training.train, workers=2).finished == 6
        assert log.read_text().split() == [bad]
        assert study.status(spec, out).damaged == {}
    report = study.report(spec, out)
    assert len(report.notes) > 0 and report.html.is_file()


@pytest.mark.slow
def test_a_file_in_the_place_of_a_run_and_foreign_files_beside_it_stop_nothing(tmp_path, log):
    spec = specification()
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / spec.runs[0].id).write_text("what is this?")
    (tmp_path / "runs" / "README").write_text("notes")
    (tmp_path / "status-old.json").write_text('["no status"]')
    assert "is a file" in study.status(spec, tmp_path).damaged[spec.runs[0].id]
    assert study.run(spec, tmp_path, runner=fake_training.train, workers=2).finished == 6


@pytest.mark.long
def test_the_process_that_forks_workers_is_begun_again_when_it_dies(tmp_path, log, monkeypatch):
    from multiprocessing.forkserver import _forkserver

    monkeypatch.setenv("PHAROS_FAKE_SECONDS", "0.3")
    spec = specification(seeds=4)
    killed = []

    def kill(status):
        if len(killed) < 2 and _forkserver._forkserver_pid not in (None, *killed):
            killed.append(_forkserver._forkserver_pid)
            os.kill(_forkserver._forkserver_pid, signal.SIGKILL)

    end = study.run(spec, tmp_path / "out", runner=fake_training.train, workers=2, progress=kill)
    assert len(killed) == 2 and (end.finished, end.failed) == (8, 0)


def test_a_runner_whose_starts_always_fail_gives_up_in_one_line(tmp_path, log, monkeypatch):
    monkeypatch.setattr(importlib.import_module("pharos.training.execution"), "BUSY_SECONDS", 0.0)
    monkeypatch.setattr(workers.Workers, "start", failing(EOFError()))
    with pytest.raises(PharosError, match="the process that starts runs died 11 times in a row"):
        study.run(specification(), tmp_path / "out", runner=fake_training.train, workers=2)


def without_flock(monkeypatch):
    import errno
    import fcntl

    monkeypatch.setattr(fcntl, "flock", failing(errno.ENOSYS))


def test_where_locks_are_not_supported_runs_and_instances_are_no_longer_taken_for_held(tmp_path, log, monkeypatch):
    without_flock(monkeypatch)
    run = specification().runs[0]
    assert fake_training.attempt(run, tmp_path) == "finished"
    sent = []
    preparing.unless_locked(lambda config: sent.append(config), run.config, sent.append)
    assert sent == [run.config]


def test_a_run_that_another_process_holds_is_busy_and_says_so_of_training(tmp_path, log):
    from pharos.errors import FolderLocked, StateSpaceLocked
    from pharos.system.storage import lock

    run = specification().runs[0]
    place = tmp_path / "locks" / run.id
    place.mkdir(parents=True)
    with lock(place, FolderLocked, "training"):
        assert fake_training.attempt(run, tmp_path) == "busy"
    assert not issubclass(FolderLocked, StateSpaceLocked)


@pytest.mark.long
@pytest.mark.parametrize("sent", (signal.SIGINT, signal.SIGTERM))
def test_an_interrupted_study_leaves_no_warning_of_semaphores(tmp_path, log, sent):
    (tmp_path / "fake.yaml").write_text(json.dumps(specification().model_dump(mode="json", exclude_unset=True)))
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); from pharos.cli import main; "
    code += f"from pharos.system import workers; workers.TERMINATION_SECONDS = {PATIENCE}; "  # none is killed
    code += "import fake_training, pharos.study.execution as e; e.run.__kwdefaults__['runner'] = fake_training.hold; "
    code += "sys.argv = ['pharos', 'study', 'run', 'fake.yaml', '--workers', '2']; main()"
    place = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path])}}
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, **place)
    wait_for(lambda: len([*(tmp_path / "studies/fake/partial").glob("*/held")]) == 2)
    process.send_signal(sent)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == (130 if sent == signal.SIGINT else 143)
    assert "resource_tracker" not in errors and "Traceback" not in errors, errors


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_worker_on_a_full_disk_says_a_line(tmp_path, capfd, monkeypatch):
    """Not even its log takes the reason."""
    run, own_file = specification().runs[0], storage.own_file
    full = {"log.txt": "/dev/full"}
    monkeypatch.setattr(storage, "own_file", lambda path, flags: own_file(full.get(Path(path).name, path), flags))
    arguments = (lambda *_: 1 / 0, [run.config], [run.id], tmp_path, (), True, dict(os.environ))
    assert exit_code(_worker.main, *arguments) == 1
    assert capfd.readouterr().err == f"pharos: run {run.id}: No space left on device\n"
