"""The report: one file that needs nothing else, with every section, figures and tables beside it."""

import base64
import hashlib
import json
import re
from html.parser import HTMLParser

import pandas as pd
import pytest

import fake_training
from command_line import process
from edits import edited_json
from pharos import study
from pharos.study import worker as _worker
from pharos.study.execution import write_specification
from pharos.study.figures import representations, same_steps
from pharos.study.report import files, number_text
from pharos.study.report.page import data_table
from pharos.system.wording import latex_text

HARDNESS = {"measures": ["sum_of_reciprocal_gaps", "diameter"], "budget": 5}
CELLS = {
    "environments": ["simple_grid/4x4-decoy", "simple_grid/4x4-plain", "frozen_lake/4x4"],
    "observations": ["vector", "simple_image"],
    "agents": ["dqn", "ppo", "q_learning"],
}
BEGINNING = ("Summary", "Findings of the paper", "Regret", "Profiles", "Vector against image", "Hardness and regret")
MIDDLE = ("Unseen classes", "Agreement of agents", "Hardness of the instances", "Returns", "Beside the paper")
HEADINGS = [*BEGINNING, *MIDDLE, "Instances", "Each instance", "How it was made"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """(folder, StudyReport) of a study with one failed and one missing run."""
    folder = tmp_path_factory.mktemp("study")
    spec = fake_training.specification("lakes", steps=400, evaluations=8, seeds=2, hardness=HARDNESS, **CELLS)
    write_specification(spec, folder)
    for run in spec.runs[2:]:
        fake_training.attempt(run, folder)
    failed = spec.runs[0]
    (folder / "partial" / failed.id).mkdir()
    _worker.write_failure(folder / "partial" / failed.id, failed.config, failed.id, "ValueError: <no>", 1.0)
    _worker.publish_run(folder / "partial" / failed.id, folder, failed.id)
    return folder, study.report(folder)


@pytest.fixture(scope="module")
def again(written, tmp_path_factory):
    """(folder, what was printed) of a report of the same study by the command line, in a process of its own."""
    folder = tmp_path_factory.mktemp("again")
    return folder, process("study", "report", written[0], "--to", folder, "--json", check=True).stdout


@pytest.fixture
def sketched(monkeypatch):
    """Figures of a report are made, and not drawn: for tests of what the page and the tables say."""

    def save(draw, place):
        return None if draw() is None else {"light": b"light", "dark": b"dark"}

    monkeypatch.setattr(files, "save_for_page", save)


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


@pytest.mark.long
def test_the_page_is_well_formed_and_loads_nothing_from_outside(written):
    page = written[1].html.read_text()
    reader = read(page)
    assert all(item.startswith(("data:image/png;base64,", "#")) for item in reader.loaded)
    assert not re.search("https?:", re.sub(r'"data:[^"]*"', "", page))
    assert "<!--TITLE-->" not in page
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)  # its own, and the browser runs no other
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert page.count("<script") == 1
    assert f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'" in page


@pytest.mark.long
def test_every_section_is_there_and_every_link_leads_to_one(written):
    page = written[1].html.read_text()
    reader = read(page)
    assert reader.headings == HEADINGS
    for link in (item for item in reader.loaded if item.startswith("#")):
        assert f'id="{link[1:]}"' in page


@pytest.mark.long
def test_failed_and_missing_runs_and_models_without_rows_are_told(written):
    page = written[1].html.read_text()
    assert "28 of 30 runs are finished, 1 failed" in page and "1 run missing" in page
    assert "ValueError: &lt;no&gt;" in page
    assert any("the class model of frozen_lake has 2 rows; needs at least" in note for note in written[1].notes)


@pytest.mark.slow
def test_each_figure_is_a_png_and_a_pdf_and_stands_in_the_page_light_and_dark(written):
    report = written[1]
    assert len(report.figures) % 2 == 0
    for file in report.figures:
        start = file.read_bytes()[:8]
        assert start.startswith(b"\x89PNG" if file.suffix == ".png" else b"%PDF")
    names = {file.stem for file in report.figures}
    assert {"regret", "regret_by_instance", "representations", "agents"} <= names
    assert report.html.read_text().count('prefers-color-scheme: dark)" srcset') == len(names)


@pytest.mark.slow
def test_latex_tables_have_the_papers_columns_and_balanced_environments(written):
    text = next(file for file in written[1].tables if file.name == "returns_simple_grid.tex").read_text()
    assert r" & & \multicolumn{2}{c}{PPO} & \multicolumn{2}{c}{DQN} \\" in text
    lines = [line for line in text.splitlines() if line.endswith(r"\\") and r"\pm" in line]
    assert len(lines) == 2 and all(line.count("&") == 5 for line in lines)
    assert text.count(r"\begin{") == text.count(r"\end{") == 1
    assert text.count("{") == text.count("}")
    assert latex_text("a_b & 50%") == r"a\_b \& 50\%"


@pytest.mark.long
def test_a_report_made_again_is_the_same_but_for_its_date(written, again):
    page = written[1].html.read_text()
    date = re.compile(r"\d{4}-\d{2}-\d{2} \d{2}:\d{2}")
    assert date.sub("", (again[0] / "report.html").read_text()) == date.sub("", page)


@pytest.mark.long
def test_runs_of_different_length_or_without_regret_leave_a_report(tmp_path):
    block = {"environments": ["frozen_lake/4x4"], "agents": ["q_learning"], "observations": ["vector"]}
    hardness = {"measures": ["diameter"]}
    blocks = [{**block, "seeds": [0, 1], "steps": 100}, {**block, "seeds": [2], "steps": 70}]
    spec = study.specification({"name": "odd", "evaluations": 5, "hardness": hardness, "blocks": blocks})
    for run in spec.runs:
        fake_training.attempt(run, tmp_path)
        with edited_json(tmp_path / "runs" / run.id / "run.json") as record:
            record["result"]["normalized_regret"] = None  # as pharos writes what is not a number
    steps, tasks, _ = same_steps(study.curves(spec, tmp_path))
    assert list(steps) == [20, 40, 60, 80, 100] and [task.shape for task in tasks] == [(2, 5)]
    report = study.report(spec, tmp_path)
    page = report.html.read_text()
    assert "no cells of DQN with both" in page and "fewer than three cells that both DQN and PPO" in page
    assert report.notes == ["q_learning sees the index of the state: models are of agents that see observations"]
    assert "3 of 3 runs are finished: 1 instance of 1 class" in page


def test_numbers_are_short():
    assert [number_text(x) for x in (0.0, 0.12345, 12.3456, 1234567.0, 1e-5, 3e9, -0.5)] == [
        "0.000", "0.123", "12.346", "1,234,567", "1.00e-05", "3.00e+09", "-0.500",
    ]  # fmt: skip


@pytest.mark.long
def test_the_command_prints_where_the_report_is(written, again):
    assert json.loads(again[1])["html"] == str(again[0] / "report.html")
    status = process("study", "status", written[0])
    assert status.stdout.splitlines()[0] == "lakes: 28 of 30 runs finished, 1 failed"
    assert "ValueError: <no>" in status.stderr


# A study of one's own ------------------------------------------------------------------------------------------------


def report_of(tmp_path, name="own", change=None, **block):
    block = {"environments": ["frozen_lake/4x4", "frozen_lake/8x8"], "observations": ["vector", "simple_image"]} | block
    spec = fake_training.specification(name, steps=400, evaluations=4, seeds=2, hardness=HARDNESS, **block)
    for run in spec.runs:
        fake_training.attempt(run, tmp_path)
    if change is not None:
        change(spec)
    report = study.report(spec, tmp_path)
    return report, read(report.html.read_text())


@pytest.mark.long
def test_a_study_without_dqn_says_nothing_false_and_has_no_empty_section(tmp_path):
    report, page = report_of(tmp_path, agents=["ppo", "q_learning"], chance=["plain", {"sticky": 0.25}])
    text = " ".join(page.text)
    assert "is known for no instance" not in text and "dqn" not in text
    left_out = ("Findings of the paper", "Unseen classes", "Agreement of agents", "Beside the paper")
    assert page.headings == [each for each in HEADINGS if each not in left_out]
    assert "the paper prints" not in text and "Findings" not in text and "The paper's figure" not in text
    assert "Cumulative regret of PPO" in text and "costs PPO more regret" not in text  # of four tasks
    names = {file.stem for file in report.figures}
    assert {"representations_ppo", "single_model_cumulative", "regret_by_task_frozen_lake"} <= names
    assert any(file.name == "coefficients_cumulative_regret.csv" for file in report.tables)
    assert not any("findings" in file.name or "paper" in file.name for file in report.tables)
    latex = next(file for file in report.tables if file.name == "returns_frozen_lake.tex").read_text()
    assert r"\multicolumn{2}{c}{PPO} & tabular Q-learning \\" in latex
    assert "simple image & vector & index" in latex and "DQN" not in latex and "--" not in latex


@pytest.mark.long
def test_each_agent_that_sees_observations_has_models(tmp_path):
    report, page = report_of(tmp_path, agents=["ppo", "a2c"], chance=["plain", {"sticky": 0.25}])
    text = " ".join(page.text)
    assert "Cumulative regret of PPO" in text and "Cumulative regret of A2C" in text
    assert {"representations_ppo", "representations_a2c"} <= {file.stem for file in report.figures}
    files = {file.name for file in report.tables}
    assert {"coefficients_cumulative_regret.csv", "coefficients_cumulative_regret_a2c.csv"} <= files


def test_a_study_too_small_for_models_has_a_line_in_their_place(tmp_path, sketched):
    report, page = report_of(tmp_path, agents=["dqn"], environments=["frozen_lake/4x4"], observations=["vector"])
    assert "Hardness and regret" not in page.headings
    (note,) = report.notes
    why = "the single model of all has 1 row; needs at least 3 for its mean, as no predictor varies"
    assert note.startswith(f"no models of hardness: {why}") and why in " ".join(page.text)


def test_what_has_no_run_is_not_measured_and_the_cost_is_told_beforehand(tmp_path, sketched):
    hardness = {"measures": ["diameter"], "budget": 7}
    spec = fake_training.specification(hardness=hardness, environments=["frozen_lake/4x4", "frozen_lake/8x8"])
    fake_training.attempt(spec.runs[0], tmp_path)
    told = []
    study.report(spec, tmp_path, progress=told.append)
    assert [line for line in told if "hardness of" in line] == [
        "hardness of 1 instances and kinds of chance: at most 7 s, and building",
        "hardness of frozen_lake/4x4, plain",
    ]
    assert len(list(tmp_path.glob("hardness/*.json"))) == 1
    assert len(study.hardness_table(spec, tmp_path)) == 2


@pytest.mark.long
def test_a_report_begins_with_who_won_by_how_much_and_how_sure_that_is(tmp_path, sketched):
    _, page = report_of(tmp_path, agents=["ppo"])
    text = " ".join(page.text)
    first = text.partition("Summary")[2]
    first = first.partition("Summary")[2] or first  # after the list of contents
    assert first.index("has the least normalised regret") < first.index("are finished")
    assert re.search(r"PPO, \w+: \d\.\d\d, \d\.\d\d more on \d tasks? \(95 % interval .* p [<=] ", first)


@pytest.mark.long
def test_a_report_says_where_chance_is_of_the_world(tmp_path, sketched):
    slippery = {"name": "frozen_lake", "parameters": {"slippery": True}}
    _, page = report_of(tmp_path, agents=["ppo"], environments=[slippery, "frozen_lake/4x4"])
    text = " ".join(page.text)
    assert "of the world" in text and "plain" in text


@pytest.mark.long
def test_estimated_regret_is_marked_and_its_half_width_stands_in_the_summary(tmp_path, sketched):
    def estimate(spec):
        file = tmp_path / "runs" / spec.runs[0].id / "curve.parquet"
        pd.read_parquet(file).assign(exact=False, error_bound=0.05).to_parquet(file)

    report, page = report_of(tmp_path, change=estimate, agents=["ppo"])
    text = " ".join(page.text)
    assert "The regret of 1 run of 8 is estimated by playing" in text and "PPO on frozen lake (1)" in text
    assert "≈ 0." in text
    runs = next(file for file in report.tables if file.name == "runs.csv").read_text().splitlines()
    cells = next(file for file in report.tables if file.name == "cells.csv").read_text().splitlines()
    for lines in (runs, cells):
        exact = lines[0].split(",").index("exact")
        assert [line.split(",")[exact] for line in lines[1:]].count("False") == 1
        assert "half_width" in lines[0].split(",")


@pytest.mark.slow
def test_damaged_runs_are_named_in_the_report_and_absurd_numbers_do_not_stop_it(tmp_path):
    def damage(spec):
        for run, change in zip(spec.runs, ({"seconds": 1e308}, {"cumulative_regret": -1e300}), strict=False):
            with edited_json(tmp_path / "runs" / run.id / "run.json") as record:
                record["seconds"] = change.pop("seconds", 0.5)
                record["result"] |= change

    report, page = report_of(tmp_path, change=damage, agents=["ppo"])
    assert "Damaged, counted as missing:" in " ".join(page.text)
    assert any("seconds are 1e+308" in note for note in report.notes)
    assert any("cumulative_regret is -1e+300" in note for note in report.notes)


def test_texts_that_a_spreadsheet_would_run_are_escaped_and_numbers_stay_numbers():
    texts = ["=HYPERLINK(1)", "+1+cmd", "-1+cmd", "@SUM(A1)", "\tx", "\rx", "plain", "-5", None]
    data = pd.DataFrame({"=cmd|calc": texts, "number": [-1.5] * 9})
    safe = files.spreadsheet_safe(data)
    assert list(safe.columns) == ["'=cmd|calc", "number"]
    assert safe.iloc[:, 0].tolist()[:8] == [*("'" + text for text in texts[:6]), "plain", "-5"]
    assert (safe["number"] == -1.5).all() and safe["number"].dtype == float


@pytest.mark.long
def test_received_records_reach_the_tables_without_formulas(tmp_path, sketched):
    def inject(spec):
        with edited_json(tmp_path / "runs" / spec.runs[0].id / "run.json") as record:
            record["result"] |= {"=cmd|' /C calc'!A0": 1.0, "note": "=HYPERLINK(0)"}

    report, _ = report_of(tmp_path, change=inject, agents=["ppo"])
    text = next(file for file in report.tables if file.name == "runs.csv").read_text()
    assert "'=cmd" in text and "'=HYPERLINK" in text
    assert ",=" not in text and "\n=" not in text


def test_the_page_escapes_whatever_a_study_says(tmp_path, sketched):
    spec = fake_training.specification(description="<script>alert(1)</script>", steps=10, seeds=1)
    fake_training.attempt(spec.runs[0], tmp_path)
    page = study.report(spec, tmp_path).html.read_text()
    assert "<script>alert" not in page and page.count("<script") == 1 and "&lt;script&gt;" in page


@pytest.mark.long
def test_a_report_says_which_images_hide_something(tmp_path, sketched):
    small = {"name": "breakout", "parameters": {"height": 7, "columns": 4, "brick_rows": 1}}
    report, page = report_of(tmp_path, agents=["ppo"], environments=[small, "frozen_lake/4x4"])
    text = " ".join(page.text)
    assert "States that share an observation" in page.headings and "62.5 %" in text
    assert len(list(tmp_path.glob("aliasing/*.json"))) == 4
    aliasing = next(file for file in report.tables if file.name == "aliasing.csv").read_text()
    assert ",1658,1068,0.62" in aliasing and ",1658,1658,0.0" in aliasing


def test_columns_that_say_nothing_are_left_out_of_a_table():
    rows = pd.DataFrame({"model": ["single", "class"], "notes": ["", ""], "left_out": ["", "diameter"], "R2": [0.5, 0]})
    shown = data_table(rows)
    assert [column.title for column in shown.columns] == ["model", "left out", "R2"]
    assert shown.rows == [["single", "", "0.500"], ["class", "diameter", "0.000"]]


def test_kinds_of_chance_are_in_the_legend_if_there_are_several():
    """A legend with one entry for all points says nothing."""
    rows = [
        {"environment": "frozen_lake", "instance": "a", "chance": chance, "agent": "dqn", "observation": observation}
        for chance in ("plain", "random 0.1")
        for observation in ("vector", "simple_image")
    ]
    cells = pd.DataFrame(rows).assign(normalized_regret=[0.2, 0.3, 0.4, 0.5])
    expected = {1: ["frozen lake"], 2: ["frozen lake", "no added noise", "random"]}
    for count, words in expected.items():
        (axis,) = representations(cells[: 2 * count]).axes
        assert [text.get_text() for text in axis.get_legend().get_texts()] == words
