"""Commands are made of functions: parameters, fields of dataclasses, docstrings, and what a function returns."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from typer.main import get_command
from typer.testing import CliRunner

from pharos.cli.answers import Answer
from pharos.cli.command import Commands
from pharos.cli.options import Chance, Count
from pharos.training import TrainingOptions

app = Commands()


@dataclass(frozen=True)
class Size:
    """A size.

    Attributes:
        height: of the grid. Not the width.
        is_open: whether it has no walls.
    """

    height: Count | None = None
    is_open: bool = True


@app.command("walk")
def walk(
    name: str,
    *,
    size: Size,
    chance: Chance,
    training: Annotated[TrainingOptions, "steps agent observation_options"] = TrainingOptions(steps=7),  # noqa: B008
    option: Mapping[str, Any],
    fail: bool = False,
) -> Answer:
    """Walk.

    Args:
        name: Of the walk.
        agent: Who walks.
    """
    said = {"height": size.height, "is_open": size.is_open, "lazy": chance.lazy, "option": option}
    return Answer({**said, "steps": training.steps, "seen": training.observation_options}, f"{name} walked", fail)


@app.command("keep")
def keep(*, values: Path | None = None, json: bool = False) -> None:
    """Keep."""
    print(type(values).__name__, values.name, json)


@app.command("rest")
def rest() -> Answer:
    """Rest."""
    return Answer({}, ("rest", [("hours", 8)]))


def run(*words):
    return CliRunner().invoke(app, words)


def options(name):
    return {word: each for each in get_command(app).commands[name].params for word in each.opts}


def test_fields_are_options_and_the_function_gets_one_object():
    done = run("walk", "far", "--height", "3", "--lazy", "0.5", "--no-is-open", "--option", "a=1", "--json")
    expected = {"height": 3, "is_open": False, "lazy": 0.5, "option": {"a": 1}, "steps": 7, "seen": {}}
    assert done.exit_code == 0 and json.loads(done.stdout) == expected


def test_texts_and_limits_are_those_of_the_declaration():
    made = options("walk")
    assert made["--height"].help == "Of the grid." and made["--height"].min == 1
    assert made["--sticky"].help == "Probability that the previous action is executed again."
    assert (made["--sticky"].min, made["--sticky"].max, made["--steps"].min, made["--steps"].default) == (0, 1, 1, 7)
    assert made["--agent"].help == "Who walks." and made["name"].help == "Of the walk."
    assert "--reward-noise" not in made and "--observation" not in made and "--json" in made
    assert get_command(app).commands["walk"].help == "Walk."


def test_people_get_text_or_facts_and_failures_a_code():
    assert run("walk", "far").stdout == "far walked\n"
    assert run("walk", "far", "--fail").exit_code == 1
    assert "hours  8" in run("rest").stdout


def test_an_option_may_have_any_name():
    assert run("keep", "--values", "a/b").output.split() == [type(Path()).__name__, "b", "False"]
