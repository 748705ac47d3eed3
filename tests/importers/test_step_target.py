"""pharos import env: targets, folders, imports that go on after they were killed, and processes that share the work."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import planted
import pytest

from command_line import run
from pharos import importers, value_iteration
from pharos.errors import FolderLocked, ParameterError, RuleError, StateSpaceTooLarge
from pharos.system import storage
from refusals import failing

HERE = Path(planted.__file__)


def imported(target, folder, **options):
    return importers.StepTarget(target, **options.pop("names", {})).import_into(
        folder,
        **{"max_outcomes": 3_000, "horizon": None, "max_states": 1_000, "check": False, "seconds": 0.0, **options},
    )


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def here(monkeypatch):
    monkeypatch.chdir(HERE.parent)


def stop_after(count):
    """Progress that interrupts when so many states are expanded."""

    def report(states, seconds, finished):
        if states.num_expanded >= count:
            raise KeyboardInterrupt

    return report


@pytest.mark.parametrize("count", [1, 7, 20])
def test_an_interrupted_import_goes_on_and_ends_with_the_same_bytes(count, tmp_path, here, monkeypatch):
    from pharos.importers import search

    monkeypatch.setattr(search, "REPORT_SECONDS", -1.0)
    imported("planted.py:Clock", tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        imported("planted.py:Clock", tmp_path / "parts", progress=stop_after(count))
    assert [path.name for path in (tmp_path / "parts").iterdir()] == [".building"]
    resumed = []
    imported("planted.py:Clock", tmp_path / "parts", progress=lambda states, *_: resumed.append(states.num_resumed))
    assert resumed[0] == count
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


@pytest.mark.long
def test_draws_are_repeated_where_an_import_goes_on(tmp_path, here, monkeypatch):
    from pharos.importers import search

    monkeypatch.setattr(search, "REPORT_SECONDS", -1.0)
    imported("planted.py:TicTacToe", tmp_path / "whole", horizon=2, seconds=9.0)
    with pytest.raises(KeyboardInterrupt):
        imported("planted.py:TicTacToe", tmp_path / "parts", horizon=2, seconds=9.0, progress=stop_after(9))
    imported("planted.py:TicTacToe", tmp_path / "parts", horizon=2, seconds=9.0)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


@pytest.mark.long
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal")
def test_a_killed_import_goes_on(tmp_path, here):
    armed = tmp_path / "armed"
    armed.touch()
    command = [sys.executable, "-m", "pharos", "import", "env", "planted.py:KillsItself", "--no-check"]
    command += ["--option", f"armed={armed}", "--out"]
    assert subprocess.run([*command, str(tmp_path / "parts")], check=False).returncode == -signal.SIGKILL
    assert not importers.is_folder(tmp_path / "parts")
    armed.unlink()
    for name in ("parts", "whole"):
        subprocess.run([*command, str(tmp_path / name)], check=True, stdout=subprocess.DEVNULL)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


@pytest.mark.long
def test_a_disk_that_is_full_is_one_line_and_loses_nothing(tmp_path, here, monkeypatch):
    """Full from the n-th file on, for each n until the import fits."""
    command = ["import", "env", "planted.py:Clock", "--no-check", "--out"]
    assert run(*command, tmp_path / "whole").exit_code == 0
    for files in range(20):
        with monkeypatch.context() as disk:
            disk.setattr(os, "fsync", failing(errno.ENOSPC, files, os.fsync))
            done = run(*command, tmp_path / f"full-{files}")
        if done.exit_code == 0:
            break
        assert "No space left" in done.stderr and done.stderr.count("\n") == 1
        assert run(*command, tmp_path / f"full-{files}").exit_code == 0
        assert contents(tmp_path / f"full-{files}") == contents(tmp_path / "whole")
    assert files > 3


def test_more_states_go_on_from_the_first_ones(tmp_path, here):
    with pytest.raises(StateSpaceTooLarge, match="more than 9 states"):
        imported("planted.py:Clock", tmp_path / "e", max_states=9)
    mdp, _ = imported("planted.py:Clock", tmp_path / "e")
    assert mdp.num_states == importers.load(tmp_path / "e").num_states


def test_the_beginning_of_another_import_is_refused(tmp_path, here):
    with pytest.raises(StateSpaceTooLarge):
        imported("planted.py:Clock", tmp_path / "e", max_states=9)
    with pytest.raises(ParameterError, match="a part of another import, with another ignore"):
        imported("planted.py:Clock", tmp_path / "e", ignore=("cell",))
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "notes.txt").touch()
    with pytest.raises(ParameterError, match="is not empty and holds no imported MDP"):
        imported("planted.py:Walk", tmp_path / "f")


def test_an_environment_that_changed_is_noticed(tmp_path, here):
    with pytest.raises(StateSpaceTooLarge):
        imported("planted.py:Clock", tmp_path / "e", max_states=9)
    building = tmp_path / "e" / ".building"
    identity = json.loads((building / "identity.json").read_text())
    target = importers.StepTarget("planted.py:Slips")
    other = target._identity(importers.stepping.__globals__["SteppingOptions"](), None)
    storage.replace_json(building / "identity.json", other)
    assert identity["code"] == other["code"]
    with pytest.raises(RuleError, match="is not the environment of which"):
        imported("planted.py:Slips", tmp_path / "e")
    assert not (tmp_path / "e").exists()


def test_a_refusal_leaves_nothing_behind(tmp_path, here):
    with pytest.raises(RuleError, match="global generator"):
        imported("planted.py:HiddenPython", tmp_path / "e")
    assert not (tmp_path / "e").exists()


def test_two_imports_do_not_meet(tmp_path, here):
    building = tmp_path / "e" / ".building"
    building.mkdir(parents=True)
    with storage.lock(building, FolderLocked, "importing"), pytest.raises(FolderLocked):
        imported("planted.py:Walk", tmp_path / "e")


@pytest.mark.long
def test_two_processes_find_the_same(tmp_path, here):
    for target in ("Clock", "Heavy"):  # what is sent at once is more than a pipe holds
        one, two = (tmp_path / f"{target}{workers}" for workers in (1, 2))
        imported(f"planted.py:{target}", one, seconds=9.0)
        imported(f"planted.py:{target}", two, seconds=9.0, workers=2)
        assert contents(one) == contents(two)
    with pytest.raises(RuleError, match="global generator"):
        imported("planted.py:HiddenPython", tmp_path / "3", workers=2)
    with pytest.raises(ParameterError, match="other processes cannot import its factory"):
        importers.stepping(lambda: planted.Walk(), workers=2)


@pytest.mark.long
def test_folders_are_environments(tmp_path, here):
    import pharos

    mdp, _ = imported("planted.py:sticky", tmp_path / "e", gamma=0.9)
    env = pharos.make("imported", folder=str(tmp_path / "e"))
    space = pharos.build(env, progress=False)
    value = value_iteration(space.mdp(gamma=0.9)).value_at_start
    assert value == pytest.approx(value_iteration(mdp).value_at_start)


def test_keys_rewards_and_weights_are_named(tmp_path, here):
    mdp, _ = imported("planted.py:Clock", tmp_path / "k", ignore=("elapsed",), names={"key": "planted.py:cell"})
    assert mdp.num_states == 4
    mdp, _ = imported("planted.py:PaysVectors", tmp_path / "w", gamma=1.0, names={"weights": "10,1"})
    assert value_iteration(mdp).value_at_start == 10 - 3


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("FrozenLake-v1", "expected gymnasium:ID, gymnax:ID, pgx:ID, module:factory or file.py:factory"),
        ("gymnasium:NoSuch-v7", "Gymnasium cannot make it"),
        ("gymnasium:CartPole-v1", "CartPole-v1: reset() drew"),
        ("planted.py:nobody", "expected a function or a class"),
        ("no_such_file.py:make", "there is no file"),
    ],
)
def test_wrong_targets(target, message, tmp_path, here):
    with pytest.raises((ParameterError, RuleError)) as caught:
        imported(target, tmp_path / "e")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_environments_that_packages_announce(tmp_path, monkeypatch):
    import gymnasium

    (tmp_path / "announced.py").write_text(
        "import gymnasium\n"
        "def register():\n"
        "    gymnasium.register('Announced/Lake-v0', entry_point='gymnasium.envs.toy_text:FrozenLakeEnv')\n"
    )
    metadata = tmp_path / "announced-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Name: announced\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[gymnasium.envs]\n__root__ = announced:register\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    try:
        mdp, _ = imported("gymnasium:Announced/Lake-v0", tmp_path / "e", names={"options": {"is_slippery": False}})
    finally:
        gymnasium.registry.pop("Announced/Lake-v0", None)
    assert mdp.num_states == 28


@pytest.mark.long
def test_the_page_runs_as_printed(tmp_path, monkeypatch, capsys):
    page = (HERE.parents[2] / "docs" / "your-own-environment.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(\w*)\n(.*?)```", page, re.DOTALL)
    shop, python = (text for kind, text in blocks if kind == "python")
    commands, printed, array_text = [text for kind, text in blocks if kind != "python"][:3]  # the others are of JAX
    (tmp_path / "shop.py").write_text(shop)
    monkeypatch.chdir(tmp_path)
    for command, count in zip(commands.splitlines(), (4, 4), strict=True):
        words = [sys.executable, "-m", *command.split()]
        lines = subprocess.run(words, check=True, capture_output=True, text=True).stdout.splitlines()[:count]
        expected, printed = printed.splitlines()[:count], "\n".join(printed.splitlines()[count:])
        found, said = (" ".join(" ".join(text).split()) for text in (lines, expected))
        bound = r"error at most ([0-9.e-]+)"  # its last digits depend on the processor
        assert re.sub(bound, "", found) == re.sub(bound, "", said)
        assert all(0 <= float(each) < 1e-10 for text in (found, said) for each in re.findall(bound, text))
    capsys.readouterr()
    exec(shop + python, {})
    assert capsys.readouterr().out == array_text
