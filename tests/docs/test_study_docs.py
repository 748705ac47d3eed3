"""The page on studies shows specifications that are valid, and commands and options that exist."""

import re
from pathlib import Path

import pytest

from pharos import study
from pharos.errors import ParameterError
from pharos.study.specification import parse

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "study.md").read_text(encoding="utf-8")


def test_the_study_on_the_page_is_valid():
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    runs = parse(text, "lakes.yaml").runs
    assert len(runs) == 2 * 3 * 5 * (2 + 1) + 2
    wrong = text.replace("[dqn, q_learning]", "[dqm, q_learning]").replace("{dqn: large}", "{}")
    with pytest.raises(ParameterError) as caught:
        parse(wrong, "lakes.yaml")
    assert f"pharos: {caught.value}\n" in PAGE


@pytest.mark.long
def test_the_numbers_of_runs_on_the_page_are_those_of_the_presets(tmp_path):
    (tmp_path / "one.yaml").write_text("- taxi/5x5")
    lists = {"hardness-sealed": tmp_path / "one.yaml"}  # the number is of each environment that is given
    printed = dict(re.findall(r"^\| `([\w-]+)` \|.*\| (\d+)(?: an instance)? \|$", PAGE, re.MULTILINE))
    assert {name: int(count) for name, count in printed.items()} == {
        name: len(study.specification(name, environments=lists.get(name)).runs) for name in study.presets()
    }


def test_every_option_on_the_page_is_one_of_the_command():
    from typer.main import get_command

    from pharos.cli.study import app

    commands = get_command(app).commands
    known = {option for command in commands.values() for parameter in command.params for option in parameter.opts}
    for block in re.findall(r"```\n(.*?)```", PAGE, re.DOTALL):
        for line in block.splitlines():
            if line.startswith("pharos study"):
                assert line.split()[2] in commands
                assert set(re.findall(r"(?<!\S)--[a-z-]+", line)) <= known, line


def test_every_name_of_the_python_example_is_public():
    for name in re.findall(r"study\.(\w+)\(", PAGE):
        assert name in study.__all__
