"""The page on regret shows code that runs, numbers that come out, and commands and options that exist."""

import re
import shlex
from pathlib import Path

import pytest

import pharos
from pharos.training import train

PAGE = (Path(__file__).parents[2] / "docs" / "regret.md").read_text(encoding="utf-8")


def test_the_code_on_the_page_runs_and_gives_its_numbers(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    train("q_learning", "frozen_lake/4x4", random=0.1, steps=500, out="runs/dqn-0")
    names: dict = {}
    checked = 0
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(block, names)
        for line, number in re.findall(r"^(regret\(.*?\)) +# ([0-9.]+)$", block, re.MULTILINE):
            assert eval(line, names) == pytest.approx(float(number), abs=5e-4)
            checked += 1
    assert checked == 2
    printed = re.search(r"# optimal ([0-9.]+), uniform ([0-9.]+), worst ([0-9.]+)", PAGE)
    values = names["values"]
    assert [f"{value:.3f}" for value in (values.optimal, values.uniform, values.worst)] == list(printed.groups())
    assert names["solution"].value_at_start > 0
    assert len(names["curve"].expected) == len(names["curve"].steps)


def test_every_command_and_option_on_the_page_exists():
    from typer.main import get_command

    from pharos.cli import app

    verbs = get_command(app).commands
    lines = re.findall(r"^[ $]*pharos (.*)$|`pharos ([^`]*)`", PAGE, re.MULTILINE)
    assert len(lines) >= 8
    for first, second in lines:
        words = shlex.split(first or second)
        command = verbs[words[0]]
        if hasattr(command, "commands"):
            command = command.commands[words[1]]
        known = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= known


def test_every_name_of_the_plots_is_there():
    assert set(pharos.plots.__all__) >= {"regret", "value_map", "policies", "hardness_plane", "growth"}
