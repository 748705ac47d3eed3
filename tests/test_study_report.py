"""The report: one file that needs nothing else, with every section, figures and tables beside it."""

import json
import re
import subprocess
import sys
from html.parser import HTMLParser

import pytest

import fake_training
from pharos import study
from pharos.study import worker as _worker
from pharos.study.execution import claim
from pharos.study.figures import _tasks
from pharos.study.latex import escape
from pharos.study.report import number

SPECIFICATION = {
    "name": "lakes",
    "steps": 400,
    "evaluations": 8,
    "seeds": 2,
    "hardness": {"measures": ["sum_of_reciprocal_gaps", "diameter"], "budget": 5},
    "blocks": [
        {
            "environments": ["simple_grid/4x4-decoy", "simple_grid/4x4-plain", "frozen_lake/4x4"],
            "observations": ["vector", "simple_image"],
            "agents": ["dqn", "ppo", "q_learning"],
        }
    ],
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """(folder, StudyReport) of a study with one failed and one missing run."""
    folder = tmp_path_factory.mktemp("study")
    spec = study.specification(SPECIFICATION)
    claim(spec, folder)
    for run in spec.runs[2:]:
        _worker.attempt(fake_training.train, run.config, run.id, folder)
    failed = spec.runs[0]
    (folder / "partial" / failed.id).mkdir()
    _worker.write_failure(folder / "partial" / failed.id, failed.config, failed.id, "ValueError: <no>", 1.0)
    _worker.publish(folder / "partial" / failed.id, folder, failed.id)
    return folder, study.report(folder)


class Reader(HTMLParser):
    """Checks that tags nest, and collects what is loaded and what is said."""

    VOID = {"meta", "img", "source", "br", "link"}

    def __init__(self):
        super().__init__()
        self.open, self.loaded, self.headings, self.text = [], [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        self.loaded += [value for name, value in attrs if name in ("src", "srcset", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def read(page):
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    return reader


def test_the_page_is_well_formed_and_loads_nothing_from_outside(written):
    page = written[1].html.read_text()
    reader = read(page)
    assert all(item.startswith(("data:image/png;base64,", "#")) for item in reader.loaded)
    assert "http" not in re.sub(r'"data:[^"]*"', "", page)
    assert "<!--TITLE-->" not in page and "<script" not in page


def test_every_section_is_there_and_every_link_leads_to_one(written):
    page = written[1].html.read_text()
    reader = read(page)
    assert reader.headings == [
        "Summary",
        "Findings of the paper",
        "Regret",
        "Vector against image",
        "Hardness and regret",
        "Agreement of agents",
        "Hardness of the instances",
        "Returns",
        "Beside the paper",
        "Instances",
        "Each instance",
        "How it was made",
    ]
    for link in (item for item in reader.loaded if item.startswith("#")):
        assert f'id="{link[1:]}"' in page


def test_failed_and_missing_runs_and_models_without_rows_are_told(written):
    page = written[1].html.read_text()
    assert "28 of 30 runs are finished, 1 failed" in page and "1 run missing" in page
    assert "ValueError: &lt;no&gt;" in page
    assert any("the class model of frozen_lake has 2 rows; needs at least" in note for note in written[1].notes)


def test_each_figure_is_a_png_and_a_pdf_and_stands_in_the_page_light_and_dark(written):
    report = written[1]
    assert len(report.figures) % 2 == 0
    for file in report.figures:
        start = file.read_bytes()[:8]
        assert start.startswith(b"\x89PNG" if file.suffix == ".png" else b"%PDF")
    names = {file.stem for file in report.figures}
    assert {"regret", "regret_by_instance", "representations", "agents"} <= names
    assert report.html.read_text().count('prefers-color-scheme: dark)" srcset') == len(names)


def test_latex_tables_have_the_papers_columns_and_balanced_environments(written):
    text = next(file for file in written[1].tables if file.name == "returns_simple_grid.tex").read_text()
    assert r" & & \multicolumn{2}{c}{PPO} & \multicolumn{2}{c}{DQN} \\" in text
    lines = [line for line in text.splitlines() if line.endswith(r"\\") and r"\pm" in line]
    assert len(lines) == 2 and all(line.count("&") == 5 for line in lines)
    assert text.count(r"\begin{") == text.count(r"\end{") == 1
    assert text.count("{") == text.count("}")
    assert escape("a_b & 50%") == r"a\_b \& 50\%"


def test_a_report_made_again_is_the_same_but_for_its_date(written):
    page = written[1].html.read_text()
    again = study.report(written[0]).html.read_text()
    date = re.compile(r"\d{4}-\d{2}-\d{2} \d{2}:\d{2}")
    assert date.sub("", again) == date.sub("", page)


def test_runs_of_different_length_or_without_regret_leave_a_report(tmp_path):
    block = {"environments": ["frozen_lake/4x4"], "agents": ["q_learning"], "observations": ["vector"]}
    hardness = {"measures": ["diameter"]}
    blocks = [{**block, "seeds": [0, 1], "steps": 100}, {**block, "seeds": [2], "steps": 70}]
    spec = study.specification({"name": "odd", "evaluations": 5, "hardness": hardness, "blocks": blocks})
    for run in spec.runs:
        _worker.attempt(fake_training.train, run.config, run.id, tmp_path)
        file = tmp_path / "runs" / run.id / "run.json"
        record = json.loads(file.read_text())
        record["result"]["normalized_regret"] = None  # as pharos writes what is not a number
        file.write_text(json.dumps(record))
    steps, tasks = _tasks(study.curves(spec, tmp_path))
    assert list(steps) == [20, 40, 60, 80, 100] and [task.shape for task in tasks] == [(2, 5)]
    report = study.report(spec, tmp_path)
    page = report.html.read_text()
    assert "no cells of DQN with both" in page and "fewer than three cells that both DQN and PPO" in page
    assert report.notes[-1] == "no cell of dqn has all measures: there are no models"


def test_numbers_are_short():
    assert [number(x) for x in (0.0, 0.12345, 12.3456, 1234567.0, 1e-5, 3e9, -0.5)] == [
        "0.000", "0.123", "12.346", "1,234,567", "1.00e-05", "3.00e+09", "-0.500",
    ]  # fmt: skip


def test_the_command_prints_where_the_report_is(written, tmp_path):
    command = [sys.executable, "-m", "pharos", "study", "report", str(written[0]), "--to", str(tmp_path), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["html"] == str(tmp_path / "report.html")
    status = subprocess.run([*command[:4], "status", str(written[0])], capture_output=True, text=True)
    assert status.stdout.splitlines()[0] == "lakes: 28 of 30 runs finished, 1 failed"
    assert "ValueError: <no>" in status.stderr
