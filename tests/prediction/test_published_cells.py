"""Statistics of the published cells, which benchmarks/prediction_cells.py prints, beside plain loops; and the pages."""

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmark_modules import benchmark
from pharos import study
from pharos.agents import primary_predictors
from pharos.prediction import Published

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def cells():
    return benchmark("prediction_cells")


def published(classes=5):
    """Classes of different sizes, whose regrets go with predictions."""
    rng = np.random.default_rng(0)
    names = np.repeat([f"class-{c}" for c in range(classes)], rng.integers(4, 9, classes))
    mdps = np.array([f"{name} {i % 2}" for i, name in enumerate(names)])
    x = rng.random(len(names))
    y = x + rng.normal(0, 0.3, len(names)) + np.unique(names, return_inverse=True)[1] / classes
    return Published(names, mdps, x, y, *np.ones((3, len(names))))


def plainly(known, count):
    """The four statistics of a sample of classes, copy by copy; a class is left out with all of its copies."""
    copies = [name for name, number in zip(np.unique(known.classes), count, strict=True) for _ in range(number)]
    rows = [np.flatnonzero(known.classes == name) for name in copies]
    x, y = known.predicted, known.observed
    estimates = []
    for name, own in zip(copies, rows, strict=True):
        rest = [other for each, other in zip(copies, rows, strict=True) if each != name]
        weights = np.sqrt(np.concatenate([np.full(len(other), 1 / len(other)) for other in rest]))
        slope, level = np.polyfit(x[np.concatenate(rest)], y[np.concatenate(rest)], 1, w=weights)
        estimates.append(level + slope * x[own])
    mean = np.mean([y[own].mean() for own in rows])
    total = sum(np.mean((y[own] - mean) ** 2) for own in rows)
    errors = sum(np.mean((y[own] - each) ** 2) for own, each in zip(rows, estimates, strict=True))
    together = np.concatenate(rows)
    right, pairs = 0, 0
    for own in rows:
        for i, first in enumerate(own):
            for second in own[i + 1 :]:
                if known.mdps[first] == known.mdps[second] and abs(y[first] - y[second]) > 0.05:
                    pairs, right = pairs + 1, right + ((x[first] > x[second]) == (y[first] > y[second]))
    return (
        1 - errors / total,
        stats.spearmanr(x[together], y[together]).statistic,
        1 - sum(np.mean((y[own] - x[own]) ** 2) for own in rows) / total,
        right / pairs,
    )


@pytest.mark.parametrize("count", [(1, 1, 1, 1, 1), (2, 0, 1, 1, 1), (0, 3, 1, 0, 1), (1, 0, 3, 1, 0), (0, 0, 1, 2, 2)])
def test_statistics_of_a_sample_of_classes_are_those_of_plain_loops(cells, count):
    known = published()
    found = [float(each[0]) for each in cells.statistics(known, np.array([count]))]
    assert found == pytest.approx(plainly(known, count), abs=1e-9)


def test_a_class_that_is_drawn_twice_is_not_predicted_from_its_copy(cells):
    """Points (0, 0) and (1, 1), four times each, and (2, 0): lines through the others say 2, 0 and 2."""
    names, x, y = np.repeat(["a", "b", "c"], 2), np.repeat([0.0, 1.0, 2.0], 2), np.repeat([0.0, 1.0, 0.0], 2)
    known = Published(names, names, x, y, *np.ones((3, 6)))
    r_squared, _, _, pairs = cells.statistics(known, np.array([[4, 4, 1]]))
    assert r_squared == pytest.approx([1 - (4 * 4 + 4 * 1 + 1 * 4) / (20 / 9)])
    assert np.isnan(pairs).all()  # no regrets of an MDP differ


def lines_of(capsys, task, *arguments):
    task(*arguments)
    return capsys.readouterr().out.splitlines()


@pytest.mark.slow
def test_the_pages_have_the_numbers_of_the_cells(cells, capsys):
    pages = ("evidence/sealed-3.md", "evidence/sealed-2.md", "evidence/network-regret.md", "prediction.md")
    evidence, second, newest, page = ((DOCS / name).read_text(encoding="utf-8") for name in pages)
    lines = lines_of(capsys, cells.judge, pd.read_csv(cells.CELLS_FILE), 1000)
    assert len(lines) == 10
    for line in lines:
        assert line in newest
        name, agent, count, r_squared, rho, pairs, _, width, coverage = line.strip("| ").split(" | ")
        if name == "all 54":
            assert f"| {agent} | {count} | {r_squared} | {rho} | {pairs} | {width} | {coverage} |" in page
    lines = lines_of(capsys, cells.judge, cells.before(cells.CELLS_FILE), 1000)
    assert len(lines) == 10
    for line in lines:
        assert line in evidence
        name, agent, _, r_squared, *_ = line.strip("| ").split(" | ")
        if agent == "DQN" and name not in ("twelve of development", "all 54"):
            (row,) = (line for line in page.splitlines() if "`huber_regret`, named" in line)
            assert f"| {r_squared}" in row
    for task in (cells.orders, cells.held, cells.pilots):
        for line in lines_of(capsys, task, cells.CELLS_FILE):
            assert line in page
    for text, lines in (
        (newest, lines_of(capsys, cells.units, pd.read_csv(cells.CELLS_FILE))),
        (newest, lines_of(capsys, cells.other, 1000)),
        (second, lines_of(capsys, cells.sealed, 1000)),
        (evidence, lines_of(capsys, cells.third, 1000)),
        (evidence, lines_of(capsys, cells.beside, cells.CELLS_FILE, 1000)),
        (evidence, lines_of(capsys, cells.units, cells.before(cells.CELLS_FILE))),
    ):
        assert len(lines) > 4
        for line in lines:
            assert line in text
            blocks, agent, predictor, _, said, *_ = [*line.strip("| ").split(" | "), "", "", ""]
            if blocks == "a, b, c":
                rows = [row for row in page.splitlines() if row.startswith(f"| {agent} | {predictor}, named")]
                assert all(f"| {said}" in row for row in rows)


@pytest.mark.slow
def test_the_verdicts_on_ten_other_classes_follow_from_their_design(cells):
    frame, page = cells.other_cells(), (DOCS / "prediction.md").read_text(encoding="utf-8")
    design = (DOCS / "studies/other-classes/design.md").read_text(encoding="utf-8")
    asked = " | ".join(f"> {limit}" for limit in cells.OTHER_ASKED)
    for agent, name in primary_predictors().items():
        width = cells.OTHER_WIDTHS[agent]
        assert f"| {agent.upper()}, `{name}` | {asked} | 0.72 to 0.88 of ± {width} |" in design
        part = frame[frame["agent"] == agent]
        assert len(part) == 40 and set(part["seeds"]) == {3}
        rows = cells.verdicts(part, "predicted", "observed", width, cells.OTHER_ASKED, 1000)
        assert sum(held for *_, held in rows) == 4  # as the pages say in words
        fit = cells.said_of(part, 1000).split(" | ")[0]
        (row,) = (line for line in page.splitlines() if f"`{name}`, named before the ten" in line)
        assert row.endswith(f"| {fit}: failed |")
    assert "Each met four of the five criteria that were set before" in " ".join(page.split())


@pytest.mark.slow
def test_the_ten_other_classes_were_predicted_before_they_were_run(cells):
    with tempfile.TemporaryDirectory() as folder:
        study.unpack(cells.OTHER / "runs-all.parquet", Path(folder) / "runs", into=cells.OTHER / "study.yaml")
        runs = study.table(cells.OTHER / "study.yaml", Path(folder) / "runs")
    _, record = study.read_predictions(cells.OTHER / "predictions.parquet")
    assert len(runs) == 240 and (runs["began"] > record["date"]).all()
    assert record["sha256"] in (cells.OTHER / "design.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_verdicts_of_the_third_test_follow_from_its_criteria(cells):
    """A predictor held if it met all criteria that the design asks for."""
    rows = cells.criteria(1000)
    design = (DOCS / "studies/sealed-3/design.md").read_text(encoding="utf-8")
    for agent, asked in cells.ASKED.items():
        (row,) = (line for line in design.splitlines() if line.startswith(f"| {agent.upper()} |") and "| >" in line)
        assert row.endswith(" | ".join(f"> {limit}" for limit in asked) + " |")
    assert "72 to 88 %" in design and cells.SHARE_HELD == (0.72, 0.88)
    page = (DOCS / "prediction.md").read_text(encoding="utf-8")
    evidence = (DOCS / "evidence/sealed-3.md").read_text(encoding="utf-8")
    for agent, name in (("dqn", "huber_regret"), ("ppo", "clipped_regret_evaluated")):
        met = [held for of, *_, held in rows if of == agent]
        assert len(met) == 5
        (row,) = (line for line in page.splitlines() if f"`{name}`, named" in line)
        assert row.endswith(": held |" if all(met) else ": failed |")
    counts = {agent: sum(row[-1] for row in rows if row[0] == agent) for agent in cells.ASKED}
    assert counts == {"dqn": 2, "ppo": 1}  # as the pages say in words:
    assert "DQN's new one met its R² and its interval" in evidence
    assert "PPO's, which had passed two tests, met one of five" in " ".join(evidence.split())


def test_classes_of_one_size_weigh_alike_if_their_cells_do():
    """All sealed classes have as many cells of an agent, so that weights explain no difference between two tables."""
    for name in ("sealed-1", "sealed-3"):
        cells = pd.read_csv(DOCS / "studies" / name / "cells.csv")
        if "part" in cells:
            cells = cells[cells["part"].str[0].isin([*"abc"])]
        sizes = cells.groupby(["agent", "environment"]).size()
        assert len(sizes) == 28 and set(sizes) == {7}
