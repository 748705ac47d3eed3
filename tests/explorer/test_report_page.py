"""The page of a report: the numbers behind its curves, and what a reader does with them in a browser."""

import html
import json
import re
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest

from patience import PATIENCE
from pharos.study.figures import Curves, Line, Panel, lines, regret_curves
from pharos.study.report.page import Section, data_table, figure_image, render_page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def of(label, last):
    """A line of five points with two runs."""
    values = np.linspace(0.0, last, 5)
    runs = {"seed 0": values - 0.5, "seed 1": values + 0.5}
    return Line(label, "#0072B2", "-", np.arange(5) * 100, values, values - 1, values + 1, runs)


@pytest.fixture
def points():
    columns = ["instance", "chance", "agent", "observation", "id", "seed", "step", "cumulative_expected_regret"]
    rows = [
        ("a", chance, "ppo", "vector", f"{chance}{seed}", seed, step, seed + step)
        for chance in ("plain", "sticky 0.25")
        for seed in range(3)
        for step in (1, 2)
    ]
    return pd.DataFrame(rows, columns=columns)


def test_curves_of_each_kind_of_chance_have_a_line_for_each_seed(points):
    figure = lines(regret_curves(points, by=["instance", "chance"], draws_runs=True))
    axes = [axis for axis in figure.axes if axis.get_visible()]
    assert [axis.get_title() for axis in axes] == ["a, plain", "a, sticky 0.25"]
    assert [len(axis.lines) for axis in axes] == [1 + 3, 1 + 3]


def test_the_page_gets_the_numbers_of_its_curves_and_of_each_run_in_words(points):
    curves = json.loads(regret_curves(points, by="instance").to_json())
    (panel,) = curves["panels"]
    (line,) = panel["lines"]
    assert (curves["x"], curves["y"], panel["title"], line["label"]) == (
        "steps",
        "cumulative regret",
        "a",
        "PPO, vector",
    )
    assert (line["x"], line["mean"]) == ([1, 2], [2, 3])
    assert line["lower"][0] < 2 < line["upper"][0]
    assert list(line["runs"]) == [f"a, {chance}, seed {n}" for chance in ("plain", "sticky 0.25") for n in range(3)]
    assert line["runs"]["a, plain, seed 2"] == [3, 4]


def test_numbers_in_the_page_are_short_and_missing_ones_are_null():
    values = np.array([123456.7, 0.1 + 0.2, np.nan, -2.0, 1e-9])
    line = Line("DQN", "#000000", "-", np.arange(5), values, values, values)
    assert Curves([Panel("x", [line])], "steps", "regret").to_json().count("[123460,0.3,null,-2,1e-09]") == 3


def test_more_runs_than_one_can_tell_apart_are_not_in_the_page():
    run = np.zeros(1)
    shown = [Line("a", "#000000", "-", run, run, run, run, {str(n): run for n in range(number)}) for number in (60, 61)]
    (panel,) = json.loads(Curves([Panel("x", shown)], "steps", "regret").to_json())["panels"]
    assert [len(line["runs"]) for line in panel["lines"]] == [0, 0]
    (panel,) = json.loads(Curves([Panel("x", shown[:1] * 2)], "steps", "regret").to_json())["panels"]
    assert [len(line["runs"]) for line in panel["lines"]] == [60, 60]


USED = """
<script>
const press = (target, key) => target.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}));
const button = (text) => [...document.querySelectorAll(".legend button")].find((b) => b.textContent === text);
const said = {};
const frame = document.querySelector(".frame"), told = frame.querySelector(".told"), figure = frame.closest("figure");
said.panels = [...figure.querySelectorAll("h4")].map((title) => title.textContent);
said.picture = figure.querySelector("picture").hidden;
said.curves = figure.querySelectorAll(".frame path[stroke]").length;
frame.focus(); press(frame, "End");
said.told = [...told.children].map((part) => part.textContent);
press(frame, "ArrowLeft"); said.before = told.firstChild.textContent;
press(frame, "Escape"); said.gone = told.hidden;
button("DQN, image").click();
said.hidden = [button("DQN, image").getAttribute("aria-pressed"),
  figure.querySelectorAll(".frame path[stroke]").length];
button("a line for each run").click();
said.runs = figure.querySelectorAll(".frame path[stroke]").length;
const seen = frame.querySelector("svg").getBoundingClientRect();
frame.dispatchEvent(new PointerEvent("pointermove", {clientX: seen.left + 0.6 * seen.width, clientY: seen.top + 9}));
said.pointed = told.firstChild.textContent;
const table = document.querySelector("#regret table");
const sort = (place) => {
  const head = table.tHead.rows[0].cells[place];
  head.querySelector("button").click();
  (said.orders = said.orders ?? []).push(head.getAttribute("aria-sort"));
  return [...table.tBodies[0].rows].map((row) => row.cells[place].textContent);
};
said.texts = [sort(0), sort(0), sort(0)]; said.orders = []; said.numbers = [sort(1), sort(1), sort(1)];
document.body.replaceChildren(); document.body.textContent = "SAID" + JSON.stringify(said) + "SAID";
</script>
"""


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_reader_points_at_curves_hides_lines_and_sorts_tables(tmp_path):
    curves = Curves(
        [Panel("lakes", [of("DQN, image", 9), of("DQN, vector", 7)]), Panel("grids", [of("PPO", 5)])], "steps", "regret"
    )
    drawn = {"regret": {"light": b"light", "dark": b"dark", "curves": curves.to_json().encode()}}
    data = pd.DataFrame({"agent": ["a10", "a9", "a1"], "iqm": ["≈ 0.5", "1,234", "–"]})
    sections = [Section("Regret", "regret", figure=figure_image(drawn, "regret", "caption"), table=data_table(data))]
    page = render_page("a study", "", sections)
    used = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page).replace("</body>", USED + "</body>")
    (tmp_path / "used.html").write_text(used)
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    command = [CHROMIUM, *options, f"--user-data-dir={tmp_path}", "--dump-dom", str(tmp_path / "used.html")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE).stdout
    said = json.loads(html.unescape(done.split("SAID")[1]))
    assert said["panels"] == ["lakes", "grids"] and said["picture"] and said["gone"]
    assert said["told"] == ["steps 400", "DQN, image: 9 (8 to 10)", "DQN, vector: 7 (6 to 8)"]
    assert said["before"] == "steps 300" and said["pointed"] == "steps 200"
    assert (said["curves"], said["hidden"], said["runs"]) == (3, ["false", 2], 2 + 4)
    assert said["texts"] == [["a1", "a9", "a10"], ["a10", "a9", "a1"], ["a10", "a9", "a1"]]
    up, down, back = ["≈ 0.5", "1,234", "–"], ["1,234", "≈ 0.5", "–"], ["≈ 0.5", "1,234", "–"]
    assert said["numbers"] == [up, down, back] and said["orders"] == ["ascending", "descending", None]
