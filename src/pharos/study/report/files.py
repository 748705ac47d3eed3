"""Report of a study: writes the page, the figures and the tables."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pharos.plots import save_for_page
from pharos.study.figures import all_curves, all_figures, tables_of
from pharos.study.prediction_figures import unseen_figures
from pharos.study.report.model_sections import doubts, judged_cells, unseen_section
from pharos.study.report.page import render_page
from pharos.study.report.results import Results, coefficients, study_results
from pharos.study.report.sections import sections_of
from pharos.study.specification import Source
from pharos.study.status import opened
from pharos.system.storage import inside, replace_file

if TYPE_CHECKING:
    import pandas as pd

    from pharos.study.predictions import Predictions

MODELS = "Hardness and regret"
FORMULA = ("=", "+", "-", "@", "\t", "\r")


@dataclass(frozen=True)
class StudyReport:
    """Files of a report, and notes on it.

    Attributes:
        html: the file to open.
        figures, tables: other files.
        notes: what is left out of the report, and why.
    """

    html: Path
    figures: Sequence[Path]
    tables: Sequence[Path]
    notes: Sequence[str]


def report(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    out: str | os.PathLike | None = None,
    progress: Callable[[str], None] | None = None,
    trust: bool | None = None,
    predictions: "Predictions | Sequence[Predictions] | None" = None,
) -> StudyReport:
    """Make the paper's figures and tables of the runs that are finished.

    Args:
        source: YAML file, preset, mapping, Specification, the folder of a study, or the name of one in `studies`.
        folder: of the results. Default: that folder, or studies/NAME.
        out: folder to write to. Default: `report` in the folder of the study.
        progress: called with what is being done.
        trust: whether code that the study names may be imported, as for `specification`.
        predictions: of `read_predictions`, or several of them, of different cells. Figures, a section and a table say
            what came true of them, and how many runs had begun before they were written.
    Raises:
        ParameterError: no run is finished. Or none of the predicted runs is, or these have fewer than three classes, or
            a cell was predicted twice.
    Cost: the measures of hardness of what has finished runs, once, each at most its budget, then seconds.
    """
    from pharos.study.predictions import PredictedCells

    report_progress = progress or (lambda _: None)
    predicted = PredictedCells.of(predictions)
    study, directory = opened(source, folder, trust=trust)
    results = study_results(study, directory, report_progress)
    target = Path(out) if out is not None else directory / "report"
    target.mkdir(parents=True, exist_ok=True)
    for name in ("figures", "tables"):
        inside(target, name)
    # Figures of the results
    figures: dict[str, dict[str, bytes] | None] = {}
    curves = all_curves(results.points, results.profiles)
    for name, draw in all_figures(curves, results.cells, results.models, results.agents).items():
        report_progress(f"drawing {name}")
        images = figures[name] = save_for_page(draw, target / "figures" / name)
        if images and name in curves:
            images["curves"] = curves[name].to_json().encode()
    # Predictors on classes left out, with their figures and tables
    report_progress("leaving out classes")
    judgement, outcomes = judged_cells(results, predicted)
    more = {"outcomes": outcomes}
    if predicted is not None:
        more["predicted"] = predicted.cells
        for name, draw in unseen_figures(predicted.cells, outcomes, results.points).items():
            figures[name] = save_for_page(draw, target / "figures" / name)
    if judgement is not None:
        more["predictions" if predicted is not None else "unseen_classes"] = judgement
    tables = _write_tables(target / "tables", results, more)
    # The page
    report_progress("drawing instances")
    sections = sections_of(results, figures)
    if judgement is not None:
        models = next((i for i, each in enumerate(sections) if each.title == MODELS), len(sections) - 2)
        sections.insert(models + 1, unseen_section(judgement, results, predicted, figures))
    page = render_page(f"Study {study.name}", study.description, sections)
    replace_file(target / "report.html", page)
    image_files = [
        target / "figures" / f"{name}.{kind}" for name, images in figures.items() if images for kind in ("png", "pdf")
    ]
    notes = [*results.notes, *(doubts(results, predicted) if predicted is not None else ())]
    return StudyReport(target / "report.html", image_files, tables, notes)


def _write_tables(folder: Path, results: Results, more: "Mapping[str, pd.DataFrame]") -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    tables = {"runs": results.runs, "cells": results.cells, "hardness": results.hardness}
    tables |= {"aliasing": results.aliasing, "intervals": results.intervals, **more}
    tables |= {"profiles": results.profiles, "improvements": results.improvements}
    if results.comparison is not None and results.findings is not None:
        tables |= {"paper_returns": results.comparison.returns, "paper_regressions": results.comparison.regressions}
        tables["findings"] = results.findings
    first = results.models[0].agent
    for models in results.models:
        tables[f"coefficients_{models.regret}{models.suffix(first)}"] = coefficients(models)
    written = []
    for name, data in tables.items():
        replace_file(folder / f"{name}.csv", spreadsheet_safe(data).to_csv(index=False))
        written.append(folder / f"{name}.csv")
    for name, text in tables_of(results.cells, results.hardness, results.models).items():
        replace_file(folder / f"{name}.tex", text)
        written.append(folder / f"{name}.tex")
    return written


def spreadsheet_safe(data: "pd.DataFrame") -> "pd.DataFrame":
    """The same table, in which no text begins as a formula of a spreadsheet does. Numbers stay numbers."""
    safe = data.rename(columns=_no_formula)
    for name in safe.columns:
        if safe[name].dtype.kind not in "fiub":
            safe[name] = safe[name].map(_no_formula)
    return safe


def _no_formula(value: object) -> object:
    """A value, with an apostrophe before text that a spreadsheet would run: it marks text."""
    if not isinstance(value, str) or not value.startswith(FORMULA):
        return value
    try:
        float(value)
    except ValueError:
        return "'" + value
    return value
