"""The numbers of docs/article.md are those of the packed runs, and its PDF has the same tables."""

import importlib
import re
import shutil
from pathlib import Path

import pytest

pytest.importorskip("pyarrow.parquet")
pytest.importorskip("statsmodels")
ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "article.md").read_text(encoding="utf-8")


def script(name, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    return importlib.import_module(name)


@pytest.mark.long
def test_the_tables_are_those_of_the_packed_runs(monkeypatch, packed_runs):
    article = script("article", monkeypatch)
    tables = {name: table() for name, table in article.TABLES.items()}
    assert tables.keys() == {"findings", "encodings", "sealed"}
    for name, table in tables.items():
        assert table in PAGE, f"{name} is now:\n{table}"
    assert len(re.findall(r"\n\n\| ", PAGE)) == len(tables)


@pytest.mark.long
def test_the_numbers_of_the_text_are_those_of_the_packed_runs(monkeypatch, packed_runs):
    words = " ".join(PAGE.split())
    for phrase in script("article", monkeypatch).facts():
        assert phrase in words


@pytest.mark.long
def test_the_sealed_cells_are_the_kept_ones(monkeypatch, packed_runs):
    """The regret of each cell, computed from curves, is that of cells.csv; the measures are those of the kept table."""
    import pandas as pd

    article = script("article", monkeypatch)
    kept = pd.read_csv(article.SEALED / "cells.csv").merge(article.sealed()[0], on=article.CELL)
    assert len(kept) == 196 and kept["greedy_x"].to_numpy() == pytest.approx(kept["greedy_y"].to_numpy(), abs=1e-12)
    judged = pd.read_csv(article.SEALED / "unseen-classes.csv")
    rows = judged[judged["outcome"] == "greedy"].set_index(["agent", "predictor"])
    for key in (("ppo", "clipped_regret_evaluated"), ("dqn", "kernel_regret"), ("ppo", "tabular measures")):
        assert article.judged()[key]["r_squared"] == pytest.approx(rows["r_squared"][key], abs=1e-6)


@pytest.mark.long
def test_findings_of_the_runs_are_the_kept_ones(monkeypatch, packed_runs):
    import pandas as pd

    article = script("article", monkeypatch)
    kept = pd.read_csv(article.STUDIES / "classes" / "findings.csv").set_index(["finding", "of"])
    found = article.found("classes")
    assert len(kept) == len(found) == len(article.ROWS) == 13
    for key, row in found.items():
        assert row["effect"] == pytest.approx(kept["effect"][key], abs=1e-9) and row["verdict"] == kept["verdict"][key]


@pytest.mark.slow
def test_shares_of_variance(monkeypatch, packed_runs):
    """What differs between MDPs has the rest of the variance,."""
    article = script("article", monkeypatch)
    for agent in ("dqn", "ppo"):
        cells = article.joined(agent)
        regret, mean = cells["greedy"], cells.groupby("instance")["greedy"].transform("mean")
        within, between = (article.variance_share(part, cells) for part in (regret - mean, mean - regret.mean()))
        assert within[0] + between[0] == pytest.approx(1) and 0 < within[1] < within[0] < within[2] < 1
        assert article.variance_share(regret - regret.mean(), cells)[0] == pytest.approx(1)
        twice = article.pd.concat([cells, cells])
        assert article.variance_share(article.pd.concat([regret - mean] * 2), twice) == pytest.approx(within)


def test_the_article_is_short_and_has_few_figures():
    assert len([word for word in PAGE.split() if re.search(r"\w", word)]) <= 2500
    figures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", PAGE)
    assert len(figures) <= 5 and all((ROOT / "docs" / file).exists() for file in figures)


def test_each_table_and_figure_has_a_number_and_a_caption():
    for kind, place in (("Table", r"\n\n\| "), ("Figure", r"\n\n!\[")):
        numbers = re.findall(rf"^\*\*{kind} (\d+)\.\*\* \S", PAGE, re.MULTILINE)
        assert numbers == [str(n + 1) for n in range(len(re.findall(place, PAGE)))]


def test_latex_has_every_cell_of_every_table_and_every_figure(monkeypatch):
    latex = script("article_latex", monkeypatch)
    text = latex.latex(PAGE)
    rows = [line for line in PAGE.splitlines() if line.startswith("|") and "---" not in line]
    assert len(rows) > 25 and text.count(r" \\") >= len(rows)
    for row in rows:
        assert " & ".join(latex.inline(cell.strip()) for cell in row.strip("| ").split("|")) in text
    for name in ("table", "figure", "section", "abstract", "thebibliography"):
        assert name in text
    assert text.count(r"\includegraphics") == PAGE.count("![")
    assert text.count(r"\bibitem") == PAGE.count("\n- ", PAGE.index("## References"))
    assert "**" not in text and "](" not in text


def test_wide_tables_are_written_a_section_early(monkeypatch):
    latex = script("article_latex", monkeypatch)
    row = "| " + " | ".join(["word"] * 20) + " |"
    page = "# T\n\n## One\n\na\n\n## Two\n\nb\n\n**Table 1.** Wide.\n\n" + "\n".join([row, row, row])
    text = latex.latex(page)
    assert text.index(r"\begin{table*}") < text.index(r"\section{One}") < text.index(r"\section{Two}")
    narrow = latex.latex(page.replace(row, "| a | b |"))
    assert narrow.index(r"\section{Two}") < narrow.index(r"\begin{table}")


def test_latex_of_what_a_line_may_hold(monkeypatch):
    inline = script("article_latex", monkeypatch).inline
    assert inline("a_b & 5 % of `x_y`, **bold**, *or*") == (
        r"a\_b \& 5 \% of \texttt{x\_\allowbreak{}y}, \textbf{bold}, \emph{or}"
    )
    assert inline("$V^*_0$ in [x](https://a.b/c#d)") == r"$V^*_0$ in \href{https://a.b/c\#d}{x}"
    assert inline("[why](why.md)").startswith(r"\href{https://github.com/") and "docs/why.md}{why}" in inline(
        "[why](why.md)"
    )
    assert inline("−0.5 (R²)") == "$-$0.5 (R$^2$)"


def test_without_latex_one_line_says_so(monkeypatch, tmp_path, capsys):
    latex = script("article_latex", monkeypatch)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    latex.main(tmp_path)
    assert "no LaTeX (pdflatex) is installed" in capsys.readouterr().out
    assert (tmp_path / "article.tex").read_text().startswith("\\documentclass")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_the_pdf_is_made(monkeypatch, tmp_path):
    latex = script("article_latex", monkeypatch)
    latex.main(tmp_path)
    assert (tmp_path / "article.pdf").read_bytes().startswith(b"%PDF")
    assert "Overfull" not in (tmp_path / "article.log").read_text(errors="replace")
