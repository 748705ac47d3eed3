"""The page for users: its agent learns, its commands are there, and the site has a board of all baselines."""

import importlib
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pharos import benchmark
from pharos.benchmark import AgentResults
from pharos.cli import app

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "benchmark.md").read_text()


@pytest.fixture(scope="module")
def site_pages():
    sys.path.insert(0, str(ROOT / "scripts"))
    yield importlib.import_module("site_pages")
    sys.path.remove(str(ROOT / "scripts"))


def fabricated(agent, suite, regret):
    curves = {task.name: np.full((2, 15), regret) + np.array([[0.0], [0.01]]) for task in suite.tasks}
    return AgentResults(agent, suite.name, suite.digest, (0, 1), curves)


def test_the_board_ranks_agents_by_the_core_and_says_frontiers(site_pages):
    suite = benchmark.load_suite("v1")
    table = site_pages.board(suite, [fabricated("random", suite, 0.9), fabricated("oracle", suite, 0.0)])
    rows = [line.split(" | ") for line in table.splitlines() if line.startswith("| ")]
    assert [row[0] for row in rows] == ["| agent", "| oracle", "| random"]
    assert len({len(row) for row in rows}) == 1 and len(rows[0]) == 3 + len(suite.ladders)
    assert all(cell.startswith("beyond") for cell in rows[1][2:-1])
    assert all(cell.startswith("below") for cell in rows[2][2:-1])
    assert suite.digest in table and site_pages.BOARD in PAGE


def test_the_report_of_results_in_a_file_is_written_by_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    suite = benchmark.load_suite("v1")
    for name, regret in (("mine", 0.3), ("other", 0.6)):
        fabricated(name, suite, regret).write(f"{name}.safetensors")
    line = "benchmark report mine.safetensors --out mine.html --beside other.safetensors --latex --predictor dqn --json"
    done = CliRunner().invoke(app, line.split())
    assert done.exit_code == 0, done.output
    assert done.stdout == '{"files": ["mine.html", "mine.tex"]}\n' or "mine.tex" in done.stdout
    assert "<h1>mine on the Pharos Benchmark v1</h1>" in Path("mine.html").read_text()
    assert " & mine & other" in Path("mine.tex").read_text()


def test_commands_of_the_page_are_there():
    for line in re.findall(r"^pharos (benchmark [^#\n]*)", PAGE, re.MULTILINE):
        words = shlex.split(line)
        assert CliRunner().invoke(app, [*words[:2], "--help"]).exit_code == 0, line
        options = CliRunner().invoke(app, [*words[:2], "--help"], terminal_width=200).output
        assert all(word in options for word in words if word.startswith("--")), line


def test_the_agent_of_the_page_learns(tmp_path):
    code = re.search(r"```python\n(# mine.py\n.*?)```", PAGE, re.DOTALL)[1]
    space = {}
    exec(code, space)
    task = next(task for task in benchmark.load_suite("v1").tasks if task.environment == "catch")
    outcome = benchmark.run(space["learn"], "v1", out=tmp_path, seeds=[0], tasks=[task.name])
    assert outcome.results.curves[task.name].shape == (1, 15)
    assert outcome.results.curves[task.name][0, -1] < 0.9
