"""The page of the command line: every command and option, and keys of JSON that are those of real answers."""

import importlib
import json
import shlex
import sys
from pathlib import Path

import pytest

from command_line import run

ROOT = Path(__file__).parents[2]
LINES = (
    "list",
    "list frozen_lake",
    "build frozen_lake/4x4 --out space",
    "count frozen_lake/4x4",
    "solve frozen_lake/4x4",
    "hardness frozen_lake/4x4 --measures diameter,minimal_gap",
    "evaluate frozen_lake/4x4 --policy uniform",
    "observations frozen_lake/4x4 --observation vector",
    "render frozen_lake/4x4 --out lake.png",
    "explore frozen_lake/4x4 --out lake.html",
    "train frozen_lake/4x4 --steps 500 --out run",
    "train endless_sea --objective average --steps 200 --out sea",
    "export frozen_lake/4x4 --format gym --out lake.json",
    "benchmark submit run --out entry.safetensors",
    "benchmark verify entry.safetensors",
    "benchmark board entry.safetensors",
    "import gymnasium FrozenLake-v1 --out imported",
    "cache list",
    "study show quick",
    "benchmark show",
    "benchmark run --agent oracle --out benchmark --tasks exploration --seeds 1",
    "study status quick",
)


@pytest.fixture(scope="module")
def page():
    sys.path.insert(0, str(ROOT / "scripts"))
    yield importlib.import_module("cli_page")
    sys.path.remove(str(ROOT / "scripts"))


def test_every_command_has_keys_and_every_key_a_meaning(page):
    keys, meanings = page.keys()
    assert set(keys) == {name for name, _ in page.commands()}
    assert {key.rstrip("*") for several in keys.values() for key in several} == set(meanings)
    assert all("--json" in {name for each in command.params for name in each.opts} for _, command in page.commands())


@pytest.mark.long
def test_the_tables_have_every_option_and_no_row_is_long(page):
    text = page.tables()
    for name, command in page.commands():
        section = text.partition(f"### {name}\n")[2].partition("\n### ")[0]
        shown = [each for each in command.params if each.param_type_name == "option" and not each.hidden]
        assert all(f"`{option}`" in section for each in shown for option in each.opts[:1])
        assert section.count("\n| `") >= len(page.keys()[0][name])
    assert max(map(len, text.splitlines())) < 400


@pytest.mark.slow
def test_answers_have_the_keys_of_the_page(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keys, _ = page.keys()
    names = sorted(keys, key=len, reverse=True)
    for line in LINES:
        done = run(*shlex.split(line), "--json")
        assert done.exit_code == 0, (line, done.output)
        declared = keys[next(name for name in names if line == name or line.startswith(f"{name} "))]
        answer = set(json.loads(done.stdout))
        assert {key for key in declared if not key.endswith("*")} <= answer, line
        assert answer <= {key.rstrip("*") for key in declared}, line
