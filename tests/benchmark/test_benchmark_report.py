"""The report: what it says of results whose scores are known, that it loads nothing, and that it escapes texts."""

import math
import re
from html.parser import HTMLParser
from xml.etree.ElementTree import tostring

import numpy as np
import pytest

from pharos import benchmark
from pharos.benchmark import AgentResults
from pharos.benchmark.charts import element, frontier_text, shade
from pharos.benchmark.contents import (
    contents_of,
    description,
    learning_curve,
    learning_sentence,
    number,
    residual_tasks,
    sentence,
    unclipped_regret,
)
from pharos.benchmark.latex import latex_of
from pharos.benchmark.page import page
from pharos.benchmark.scores import ConfidenceInterval
from pharos.benchmark.suite import BenchmarkTask, Ladder, Protocol, Suite
from pharos.errors import ParameterError

VILE = "<script>alert('x')</script> & \"b\".py:learn_50%"
ELEMENTS_THAT_LOAD = {"script", "link", "img", "iframe", "object", "embed", "image", "use", "audio", "video", "source"}


def task(name, axis="core", level=None, **predicted):
    return BenchmarkTask(name, "deep_sea", axis=axis, level=level, predicted=predicted, digest=name)


def rungs(axis, levels):
    return tuple(task(f"{axis}-{level:g}", axis, float(level), dqn=level / 100, ppo=0.0) for level in levels)


SUITE = Suite(
    "small",
    Protocol(steps=1000, evaluations=5, seeds=10),
    (task("easy", dqn=0.1, ppo=0.2, table=0.1), task("hard", dqn=0.1, ppo=0.8, table=0.3), task("odd", table=0.1)),
    (
        Ladder("exploration", "bits", "episodes that random play needs", rungs("exploration", (6, 8, 10, 24))),
        Ladder("credit", "steps", "steps between a choice and its consequence", rungs("credit", (8, 16, 32))),
        Ladder("scale", "log10 states", "number of states", rungs("scale", (1, 2, 3))),
    ),
    "d1",
)


def results(agent, regrets, seeds=10, spread=0.05, **record):
    """Results of so much regret on each task, at all points or at each, and runs that differ a little."""
    noise = spread * np.linspace(-1, 1, seeds)[:, None]
    curves = {name: np.full((seeds, 5), regret) + noise for name, regret in regrets.items()}
    return AgentResults(agent, SUITE.name, SUITE.digest, tuple(range(seeds)), curves, record)


def everywhere(core, exploration, credit, scale):
    """Regrets on all tasks: (easy, hard, odd), and those of each rung."""
    columns = (*core, *exploration, *credit, *scale)
    return {task.name: regret for task, regret in zip(SUITE.tasks, columns, strict=True)}


MINE = everywhere((0.1, 0.9, 0.2), (0.1, 0.3, 0.7, 1.0), (0.1, 0.6, 0.9), (0.0, 0.1, 0.2))
DQN = everywhere((0.2, 0.4, 0.3), (0.1, 0.7, 0.9, 1.0), (0.0, 0.1, 0.2), (0.0, 0.1, 0.2))
PPO = everywhere((0.6, 0.1, 0.9), (0.8, 0.9, 1.0, 1.0), (0.1, 0.6, 0.9), (0.0, 0.6, 0.9))


@pytest.fixture
def contents():
    return contents_of(results("mine.py:learn", MINE), beside=[results("dqn", DQN), results("ppo", PPO)], suite=SUITE)


class Elements(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data + "\n" * (data[-1] in ".:")


def test_the_sentence_says_frontiers_in_units_beside_those_of_baselines(contents):
    text = sentence(contents)
    assert text.startswith("mine.py:learn explores to 9 bits (")  # halfway from 0.3 at 8 bits to 0.7 at 10
    assert "; DQN 7.33, PPO below 6)" in text  # 6 + 2 * 0.4 / 0.6
    assert "assigns credit over 14.4 steps (" in text and "DQN beyond 32, PPO 14.4)" in text
    assert "scales to beyond 3 log10 states (DQN beyond 3, PPO 1.83)" in text


def test_ladders_without_a_core_have_a_page():
    ladders = {name: regret for name, regret in MINE.items() if name not in ("easy", "hard", "odd")}
    own, other = results("mine.py:learn", ladders), results("dqn", DQN)
    text = Elements(page(contents_of(own, beside=[other], suite=SUITE))).text
    assert "The core was not run." in text and "explores to 9 bits" in text and "nan" not in text.lower()
    assert "Learning curve" not in text and "Core tasks" not in text
    text = Elements(page(contents_of(other, beside=[own], suite=SUITE))).text
    assert "Learning curve" in text and "nan" not in text.lower()


def test_weaknesses_are_those_that_compare_says(contents):
    text = Elements(page(contents)).text
    words = text.split("in words")[1].split("Each axis as a fall")[0]
    worse, better, undecided = re.split("Worse|Better|Not shown to differ", words)[1:4]
    assert "credit: 14.4 steps" in worse and "DQN beyond 32, score -0.43 (" in worse and "exploration" not in worse
    assert "exploration: 9 bits" in better and "DQN 7.33" in better and "PPO below 6" in better
    assert "credit" in undecided and "PPO 14.4" in undecided and "DQN beyond 3" in undecided  # both beyond the ladder


def test_an_agent_beside_itself_is_shown_to_differ_nowhere():
    own = contents_of(results("a", MINE), beside=[results("b", MINE)], suite=SUITE)
    text = Elements(page(own)).text
    assert "On no axis is the score shown to lie below a baseline's." in text
    assert "Worse" not in text and "Better" not in text


def test_core_tasks_stand_beside_the_nearest_baseline_the_worst_first(contents):
    text = Elements(page(contents)).text.split("Core tasks beside ")[1]
    assert text.startswith("DQN") and "DQN is the nearest" in text  # apart by 0.1, 0.5, 0.1; PPO by 0.5, 0.8, 0.7
    order = [text.index(name) for name in ("hard", "easy", "odd")]
    assert order[0] < min(order[1:])
    assert "-0.50" in text and "+0.10" in text and "scores are 0.23 apart" in text


@pytest.mark.parametrize(
    ("agent", "predictor", "tasks"),
    [
        ("mine.py:DQN", None, ["hard", "exploration-24", "exploration-10", "credit-32", "credit-16"]),
        ("mine.py:learn", None, ["exploration-24", "exploration-10", "credit-32", "credit-16"]),  # both: PPO's 0.8
        ("sb3_contrib:RecurrentPPO", None, []),
        ("mine.py:learn", "table", ["hard"]),
        ("mine.py:DQN", "none", []),
    ],
)
def test_residuals_are_tasks_that_theory_solves_and_the_agent_does_not(agent, predictor, tasks):
    own = contents_of(results(agent, MINE), beside=[], predictor=predictor, suite=SUITE)
    names = [task.name for task, _, _ in residual_tasks(own)]
    assert set(names) == set(tasks) | ({"exploration-8"} if "credit-16" in tasks else set())
    excess = [own.value - expected for _, own, expected in residual_tasks(own)]
    assert excess == sorted(excess, reverse=True) and all(each > 0.2 for each in excess)


def test_a_prediction_of_two_learners_is_the_larger_regret(contents):
    assert contents.predictor == "both"
    assert [contents.predicted(task) for task in SUITE.core] == [0.2, 0.8, None]


def test_the_page_loads_nothing_and_runs_nothing(contents, tmp_path):
    (file,) = benchmark.report(results("a", MINE), tmp_path / "deep" / "a.html", beside=[], suite=SUITE)
    for text in (page(contents), file.read_text(encoding="utf-8")):
        elements = Elements(text)
        assert not elements.open and not ELEMENTS_THAT_LOAD & set(elements.tags)
        assert not {"src", "href", "srcset", "data"} & {name for name, _ in elements.attributes}
        assert "url(" not in text and "@import" not in text and "default-src 'none'" in text


def test_texts_of_results_are_escaped():
    own = results(VILE, MINE, hyperparameters={VILE: VILE}, **{VILE: "&amp;"})
    own = contents_of(own, beside=[results(VILE, DQN)], suite=SUITE)
    elements = Elements(page(own))
    assert "script" not in elements.tags and VILE in elements.text and "&amp;" in elements.text
    assert any(VILE in (value or "") for name, value in elements.attributes if name == "aria-label")
    latex = latex_of(own)
    assert "<" not in latex and r"\textless{}script\textgreater{}" in latex and r"learn\_50\%" in latex
    assert not re.search(r"(?<!\\)[%#]", latex)


def test_every_picture_has_a_name_or_is_hidden(contents):
    tags = re.findall(r"<svg [^>]*>", page(contents))
    assert len(tags) > 10
    for tag in tags:
        assert re.search(r'aria-label="[^"]+"', tag) or 'aria-hidden="true"' in tag, tag


def test_colours_of_agents_have_a_dark_and_a_light_form(contents):
    text = page(contents)
    assert "prefers-color-scheme: dark" in text
    for k in range(6):
        assert text.count(f"--c{k}: #") == 2


def test_results_of_few_seeds_and_tasks_are_preliminary():
    own = results("a", {name: MINE[name] for name in ("easy", "hard")}, seeds=3)
    own = contents_of(own, beside=[results("dqn", DQN)], suite=SUITE)
    text = Elements(page(own)).text
    assert "Preliminary: 3 seeds, and 11 tasks without results; a result has 10 seeds and all tasks." in text
    assert "The ladders were not run" in text and "Ladders" not in text
    assert "Preliminary" not in page(contents_of(results("a", MINE), beside=[], suite=SUITE))


def test_one_seed_has_no_intervals_and_a_page():
    own = contents_of(results("a", MINE, 1, 0.0), beside=[results("dqn", DQN, 1, 0.0)], suite=SUITE)
    text = page(own)
    assert "nan" not in text.lower().replace("exploration", "") and "inf" not in latex_of(own)
    assert "explores to 9 bits (DQN 7.33)" in sentence(own)


def test_runs_worse_than_random_play_are_named():
    own = results("a", MINE | {"odd": 1.4})
    text = page(contents_of(own, beside=[], suite=SUITE))
    assert "Worse than random play on odd." in text and "oracle" not in text


def test_the_table_in_latex_has_a_column_for_each_agent(tmp_path):
    own = results("mine", MINE, versions={"pharos": "1"})
    files = benchmark.report(own, tmp_path / "a.html", beside=[results("dqn", DQN)], latex=True, suite=SUITE)
    assert [file.name for file in files] == ["a.html", "a.tex"]
    text = files[1].read_text()
    table, methods = text.split("\n\n")
    rows = [line for line in table.splitlines() if line.endswith(r"\\")]
    assert len(rows) == 5 and all(row.count("&") == 2 for row in rows)
    assert rows[0] == r" & mine & DQN \\" and rows[1].startswith("core (score) & 0.60 (0.59 to 0.61) & 0.70")
    assert rows[3].endswith(r"& beyond 32 \\")
    assert r"\texttt{d1}" in methods and "13 of 13 tasks,\n1,000 steps each, with seeds 0, 1, 2" in methods
    assert "We ran mine beside DQN on the" in methods and "Versions: pharos 1." in methods
    assert "Source" not in methods


def test_the_same_results_give_the_same_bytes(tmp_path):
    own = results("mine", MINE)
    one, other = (benchmark.report(own, tmp_path / name, beside=[], suite=SUITE)[0] for name in ("a", "b"))
    assert one.read_bytes() == other.read_bytes()


def test_a_predictor_that_there_is_not_is_refused():
    with pytest.raises(ParameterError, match="predictor sac; expected one of dqn, ppo, table, both, none"):
        contents_of(results("a", MINE), beside=[], predictor="sac", suite=SUITE)


@pytest.mark.parametrize(
    ("frontier", "text"),
    [
        (ConfidenceInterval(9.43, 8.31, 10.77), "9.43 bits (8.31 to 10.8)"),
        (ConfidenceInterval(9.43), "9.43 bits"),
        (ConfidenceInterval(9.43, -math.inf, math.inf), "9.43 bits (below the ladder to beyond the ladder)"),
        (ConfidenceInterval(24.0, 24.0, math.inf, "above"), "beyond 24 bits"),
        (ConfidenceInterval(24.0, 19.0, math.inf, "above"), "beyond 24 bits (19 or more)"),
        (ConfidenceInterval(6.0, -math.inf, 6.0, "below"), "below 6 bits"),
        (ConfidenceInterval(6.0, -math.inf, 7.0, "below"), "below 6 bits (7 or less)"),
    ],
)
def test_frontiers_in_words(frontier, text):
    assert frontier_text(frontier, "bits") == text


def test_elements_keep_the_order_of_texts_and_children():
    node = element("p", "a ", element("b", "<"), " c", " d", class_="x", stroke_width=1.50)
    assert tostring(node, encoding="unicode", method="html") == '<p class="x" stroke-width="1.5">a <b>&lt;</b> c d</p>'


def test_shades_go_from_dark_to_light():
    lightness = [sum(int(shade(x)[k : k + 2], 16) for k in (1, 3, 5)) for x in np.linspace(0, 1, 11)]
    assert lightness == sorted(lightness) and lightness[0] < 120 < 500 < lightness[-1]


def test_an_agent_keeps_its_colour_where_another_one_has_not_run():
    whole = everywhere((0.1, 0.2, 0.3), (0.0, 0.2, 0.8, 1.0), (0.1, 0.2, 0.3), (0.1, 0.2, 0.3))
    core_alone = {name: whole[name] for name in ("easy", "hard", "odd")}
    own, first, second = results("mine", whole), results("core_alone", core_alone), results("other", whole)
    text = page(contents_of(own, beside=[first, second], suite=SUITE))
    chart = text.split('aria-label="exploration: scores of agents"')[1].split("</svg>")[0]
    assert re.findall(r'class="(f\d)"', chart) == ["f0", "f2"]


CORE = ("easy", "hard", "odd")


def learner(agent, curves, seeds=4, spread=0.01):
    """Results on the core: a curve of regret for each task, and runs that differ a little."""
    return results(agent, dict(zip(CORE, curves, strict=False)), seeds, spread)


LATE = ((3.0, 1.5, 1.2, 0.9, 0.1), (1.0, 1.0, 1.0, 1.0, 0.2), (0.9, 0.5, 0.4, 0.2, 0.1))
STEADY = ((0.3,) * 5, (0.2,) * 5, (0.1,) * 5)


def test_the_learning_curve_is_the_mean_over_core_tasks_with_runs_clipped():
    own = contents_of(learner("a", LATE, spread=0.0), beside=[results("dqn", DQN)], suite=SUITE)
    values = [each.value for each in learning_curve(own.agent, CORE)]
    assert values == pytest.approx([2.9 / 3, 2.5 / 3, 2.4 / 3, 2.1 / 3, 0.4 / 3])
    assert [each.value for each in learning_curve(own.beside[0], CORE)] == pytest.approx([0.3] * 5)
    text = page(own)
    assert "200 steps: regret 0.97" in text and "1,000 steps: regret 0.13" in text
    assert "1,000 steps: regret 0.30" in text and "Without" not in text


def test_an_agent_that_lacks_a_task_has_no_learning_curve():
    own = contents_of(learner("a", LATE), beside=[learner("dqn", STEADY[:2])], suite=SUITE)
    assert learning_curve(own.beside[0], CORE) == []
    assert "Without DQN, which did not run all of these." in page(own)


@pytest.mark.parametrize(
    ("curves", "text"),
    [
        (
            LATE,  # means 1.34, 0.84, 0.42: the first is clipped
            "Ends at a score of 0.87, averages 0.25: it learns late. At step 200 its policy is not shown to be better "
            "than random play on 2 of 3 tasks, at the end on 0.",
        ),
        (STEADY, "Ends at a score of 0.80, averages 0.80."),
        (tuple(curve[::-1] for curve in LATE[1:]), "Ends at a score of 0.05, averages 0.37: it ends worse than"),
    ],
)
def test_the_sentence_on_learning_says_what_numbers_show(curves, text):
    said = learning_sentence(contents_of(learner("a", curves), beside=[], suite=SUITE))
    assert said.startswith(text) and ("late" in said) == ("late" in text)


def test_late_learning_is_not_said_without_an_interval_that_shows_it():
    curves = {name: np.array([[1.0, 1.0, 1.0, 1.0, end] for end in (0.0, 0.01, 0.9, 0.9)]) for name in ("easy",)}
    for seeds, is_late in ((4, False), (2, True), (1, False)):
        own = {name: curve[:seeds] for name, curve in curves.items()}
        own = AgentResults("a", SUITE.name, SUITE.digest, tuple(range(seeds)), own)
        assert ("late" in learning_sentence(contents_of(own, beside=[], suite=SUITE))) == is_late


def test_residuals_say_the_regret_at_the_end():
    own = learner("mine.py:DQN", ((1.0, 1.0, 0.5, 0.0, 0.0), (1.0,) * 5, (0.1,) * 5), spread=0.0)
    section = page(contents_of(own, beside=[], suite=SUITE)).split("Residuals: ")[1].split("</section>")[0]
    assert "near 0, the agent is slow; near 1, it never learns the task" in section
    rows = [re.findall(r">([^<>]+)</(?:span|td)>", row) for row in section.split("<tr>")[2:]]
    assert rows == [["hard", "1.00", "0.10", "+0.90", "1.00"], ["easy", "0.50", "0.10", "+0.40", "0.00"]]


@pytest.mark.parametrize(("agent", "other"), [("f.py:PPO", "PPO"), ("f.py:A2C", "PPO"), ("f.py:learn", "DQN")])
def test_core_tasks_stand_beside_the_baseline_of_the_same_kind(agent, other):
    own = contents_of(results(agent, MINE), beside=[results("dqn", DQN), results("ppo", PPO)], suite=SUITE)
    text = Elements(page(own)).text
    assert f"Core tasks beside {other}" in text
    assert f"{other} is {'of the same kind' if other == 'PPO' else 'the nearest'}" in text


def test_names_of_tasks_show_what_the_task_is(contents):
    options = {"observation_options": {"bits": 64}, "chance": {"random": 0.1}}
    own = BenchmarkTask("x", "deep_sea", {"size": 8}, "hash", **options, digest="x")
    assert description(own) == "deep_sea, size 8; observation hash (bits 64); chance random 0.1"
    assert description(task("y")) == "deep_sea; observation vector; no chance added"
    text = page(contents)
    assert '<span title="deep_sea; observation vector; no chance added">hard</span>' in text
    assert "<title>hard: deep_sea; observation vector; no chance added; regret 0.90</title>" in text


def test_of_a_suite_without_ladders_the_sentence_begins_with_the_core_and_its_place():
    four = [BenchmarkTask(name, "deep_sea", digest=name) for name in "abcd"]
    suite = Suite("small", SUITE.protocol, tuple(four), (), "d1")

    def of(agent, *regrets, seeds=10):
        return results(agent, dict(zip("abcd", regrets, strict=False)), seeds)

    beside = [of("dqn", 0.2, 0.2, 0.2, 0.2), of("ppo", 0.9, 0.9), of("x", 0.41, 0.6, 0.7, 0.3), of("y", 0.5, seeds=1)]
    text = sentence(contents_of(of("mine", 0.4, 0.6, 0.7, 0.3), beside=beside, suite=suite))
    assert text == (
        "Core score 0.50 (0.49 to 0.51) on 4 tasks, below DQN's 0.80, above PPO's 0.10 on 2 tasks in common, not shown "
        "to differ from x's 0.50, beside y's 0.55 on 1 task in common; worst on c, b and a."
    )


def test_the_heading_of_scores_names_axes_where_there_are_some(contents):
    assert "Scores on the core and on each axis" in page(contents)
    text = page(contents_of(learner("a", LATE), beside=[], suite=SUITE))
    assert "<h2>Score on the core</h2>" in text and "each axis" not in text


def test_axes_of_the_plane_say_regret(contents):
    text = page(contents)
    assert ">extra regret of the idealised DQN</text>" in text and "representation<" not in text
    assert ">over a table (negative: it generalises)</text>" in text and ">regret of an idealised table</text>" in text


def test_regret_without_clipping_is_said_only_where_it_differs():
    own = contents_of(learner("a", ((28.0,) * 5, (0.5,) * 5, (0.5,) * 5)), beside=[], suite=SUITE)
    assert unclipped_regret(own) == "mean regret 9.67, not clipped (most of it from easy)"
    even = contents_of(learner("a", ((2.0,) * 5, (1.9,) * 5, (1.8,) * 5)), beside=[], suite=SUITE)
    assert unclipped_regret(even) == "mean regret 1.90, not clipped (the largest part from easy)"
    near = contents_of(learner("a", ((1.2,) * 5, (0.5,) * 5, (0.5,) * 5)), beside=[], suite=SUITE)
    assert unclipped_regret(near) == "" and "not clipped" not in page(near) and "not clipped" in page(even)


def test_zero_has_no_sign():
    assert number(ConfidenceInterval(-0.001, -0.004, 0.02), "+.2f") == "+0.00 (+0.00 to +0.02)"
    assert (
        number(ConfidenceInterval(-0.0)) == "0.00"
        and number(ConfidenceInterval(-0.006, -0.2, 0.0)) == "-0.01 (-0.20 to 0.00)"
    )


@pytest.mark.parametrize(("exact", "text"), [((1, 1), "exact on all tasks"), ((1, 0), "exact on 1 of 2 tasks, else")])
def test_how_policies_were_evaluated(exact, text):
    own = results("a", MINE, exact=dict(zip(("easy", "hard"), map(bool, exact), strict=True)))
    assert text in page(contents_of(own, beside=[], suite=SUITE))


def test_one_seed_is_said_once_and_leaves_no_verdicts():
    own = contents_of(results("a", MINE, 1, 0.0), beside=[results("dqn", DQN), results("b", PPO)], suite=SUITE)
    text = Elements(page(own)).text
    assert text.count("One seed: no verdict.") == 1 and "One seed: no verdict beside DQN and b." in text
    assert "shown to" not in text.replace("not shown to be better than random", "") and "Better" not in text
    assert "with seed 0." in latex_of(own)
    other = page(contents_of(results("a", MINE), beside=[results("dqn", DQN, 1, 0.0)], suite=SUITE))
    assert "seed 0<" in other and "seeds 0<" not in other


def test_agents_of_one_name_have_distinct_columns(tmp_path):
    for folder in ("one", "two", "deep/two"):
        (tmp_path / folder).mkdir(parents=True)
        results("mine", MINE).write(tmp_path / folder / "results.safetensors")
    results("Mine", MINE).write(tmp_path / "run.safetensors")
    sources = [*(tmp_path / name for name in ("two", "deep/two", "run.safetensors")), results("mine", MINE)]
    own = contents_of(tmp_path / "one", beside=sources, suite=SUITE)
    names = ["mine", "mine (two)", "mine (2)", "Mine (run)", "mine (3)"]
    assert [each.name for each in own.agents] == names
    assert " & ".join(("", *names)) in latex_of(own) and all(f">{name}</li>" in page(own) for name in names)


def test_on_narrow_screens_bars_are_hidden_with_their_heading(contents):
    text = page(contents)
    section = text.split("Core tasks beside")[1].split("</section>")[0]
    assert section.count('<th class="bar">') == 1 and section.count('<td class="bar">') == 3
    narrow = text.split("@media (max-width: 640px) {")[1].split("} }")[0]
    assert ".bar { display: none; }" in narrow and "td.n, th.n { white-space: normal; }" in narrow
