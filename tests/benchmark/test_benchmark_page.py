"""The page for users: its agent learns, its commands are there, and the site has a board of all baselines."""

import importlib
import re
import shlex
import sys
from dataclasses import replace
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


@pytest.mark.long
def test_commands_of_the_page_are_there():
    for line in re.findall(r"^pharos (benchmark [^#\n]*)", PAGE, re.MULTILINE):
        words = shlex.split(line)
        assert CliRunner().invoke(app, [*words[:2], "--help"]).exit_code == 0, line
        options = CliRunner().invoke(app, [*words[:2], "--help"], terminal_width=200).output
        assert all(word in options for word in words if word.startswith("--")), line


@pytest.mark.long
def test_the_agent_of_the_page_learns(tmp_path):
    code = re.search(r"```python\n(# mine.py\n.*?)```", PAGE, re.DOTALL)[1]
    space = {}
    exec(code, space)
    task = next(task for task in benchmark.load_suite("v1").tasks if task.environment == "catch")
    outcome = benchmark.run(space["learn"], "v1", out=tmp_path, seeds=[0], tasks=[task.name])
    assert outcome.results.curves[task.name].shape == (1, 15)
    assert outcome.results.curves[task.name][0, -1] < 0.9


@pytest.mark.long
def test_loops_of_the_pages_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agents = (ROOT / "docs" / "agents.md").read_text()
    for page in (PAGE, agents):
        space = {}
        exec(re.search(r"## A loop of your own\n.*?```python\n(.*?)```", page, re.DOTALL)[1], space)
    assert benchmark.read_results("results/my-loop").curves["deep_sea-8"].shape == (2, 15)
    assert Path("runs/mine/run.json").exists() and space["row"]["step"] == 3000


def test_the_report_says_what_failed_and_what_looks_like_a_mistake(tmp_path):
    suite = benchmark.load_suite("v1")
    results = fabricated("mine", suite, 0.3)
    failed = {f"lake, seed {k}": f"mine on lake, seed {k}: ValueError: <b>no</b> (mine.py, line 3)" for k in range(3)}
    failed |= {f"sea, seed {k}": f"mine on sea, seed {k}: reason {k}" for k in range(6)}
    notes = {"no policy": {"lake, seed 4": "yielded no policy", "lake, seed 5": "yielded no policy"}}
    record = {"steps_used": 1234567, "failed": failed, "notes": notes}
    (page,) = benchmark.report(replace(results, record=record), tmp_path / "page.html", beside=[])
    text = page.read_text()
    for sentence in (
        "Failed: lake, seed 0 and 2 more: ValueError: &lt;b&gt;no&lt;/b&gt; (mine.py, line 3)",
        "Failed: sea, seed 3: reason 3",
        "Failed: 2 runs for other reasons.",
        "Note: lake, seed 4 and 1 more: yielded no policy.",
        "1,234,567",
    ):
        assert sentence in text, sentence
    assert "reason 4" not in text and "<b>" not in text
    (page,) = benchmark.report(replace(results, record={"failed": [1], "notes": 3}), tmp_path / "odd.html", beside=[])
    assert "Failed" not in page.read_text()
