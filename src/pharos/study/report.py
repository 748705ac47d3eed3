"""The report of a study: one HTML file that needs nothing else, its figures as PNG and PDF, its tables as CSV and LaTeX."""

import base64
import html
import io
import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.storage import replace_file
from pharos.study import analysis as _analysis
from pharos.study import figures as _figures
from pharos.study import tables as _table
from pharos.study.analysis import REGRETS, Comparison, Models
from pharos.study.execution import Status, duration, opened, status
from pharos.study.findings import findings
from pharos.study.latex import returns_table, tables_of
from pharos.study.regression import Fit
from pharos.study.specification import Source, Specification

if TYPE_CHECKING:
    import pandas as pd

Figures = Mapping[str, Mapping[str, bytes] | None]
PICTURE_PIXELS = 220


@dataclass(frozen=True)
class StudyReport:
    """What was written.

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
) -> StudyReport:
    """Make the paper's figures and tables of the runs that are finished.

    Args:
        source: YAML file, preset, mapping, Specification, or the folder of a study.
        folder: of the results; None for studies/NAME.
        out: folder to write to; None for `report` in the folder of the study.
        progress: called with what is being done.
    Raises:
        ParameterError: no run is finished.
    Cost: the measures of hardness, once; then seconds.
    """
    tell = progress or (lambda _: None)
    study, place = opened(source, folder)
    now = status(study, place)
    tell("reading results")
    rows = _table.table(study, place)
    points = _table.curves(study, place)
    measured = _table.hardness_table(study, place, progress=tell)
    cells = _table.cells(rows, measured)
    tell("fitting models")
    found = [_analysis.models(cells, regret=regret, measures=study.hardness.predictors) for regret in REGRETS]
    comparison = _analysis.compare(cells, study.runs, found)
    estimates = _analysis.intervals(rows)
    said = findings(cells, found[0])
    target = Path(out) if out is not None else place / "report"
    target.mkdir(parents=True, exist_ok=True)
    figures = {}
    for name, draw in _figures.all_figures(rows, points, cells, found).items():
        tell(f"drawing {name}")
        figures[name] = _figures.save(draw, target / "figures" / name)
    tell("drawing instances")
    pictures = _pictures(study)
    tables = _write_tables(target / "tables", rows, cells, measured, found, comparison, estimates, said)
    page = _page(study, now, rows, cells, measured, found, comparison, estimates, said, figures, pictures)
    replace_file(target / "report.html", page)
    notes = [*dict.fromkeys(note for models in found for note in models.notes)]
    drawn = [
        target / "figures" / f"{name}.{kind}" for name, images in figures.items() if images for kind in ("png", "pdf")
    ]
    return StudyReport(target / "report.html", drawn, tables, notes)


def _write_tables(
    folder: Path,
    rows: "pd.DataFrame",
    cells: "pd.DataFrame",
    measured: "pd.DataFrame",
    found: Sequence[Models],
    comparison: Comparison,
    estimates: "pd.DataFrame",
    said: "pd.DataFrame",
) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    tables = {"runs": rows, "cells": cells, "hardness": measured, "paper_returns": comparison.returns}
    tables |= {"paper_regressions": comparison.regressions, "intervals": estimates, "findings": said}
    for models in found:
        tables[f"coefficients_{models.regret}"] = coefficients(models)
    for name, data in tables.items():
        data.to_csv(folder / f"{name}.csv", index=False)
        written.append(folder / f"{name}.csv")
    for name, text in tables_of(cells, measured, found).items():
        (folder / f"{name}.tex").write_text(text, encoding="utf-8")
        written.append(folder / f"{name}.tex")
    return written


def coefficients(models: Models) -> "pd.DataFrame":
    """All coefficients of all fits: one row each."""
    import pandas as pd

    parts = [
        fit.coefficients.reset_index(names="predictor").assign(model=fit.model, subset=fit.subset)
        for fit in models.fits
    ]
    columns = ["model", "subset", "predictor", "estimate", "standard_error", "p_value", "lower", "upper"]
    return pd.concat(parts)[columns] if parts else pd.DataFrame(columns=columns)


# Pictures ---------------------------------------------------------------------------------------------------------------


def _pictures(study: Specification) -> dict[str, bytes]:
    """Instance -> PNG of its start state; environments that draw nothing are left out."""
    from PIL import Image

    from pharos.drawing import human
    from pharos.environments import start_distribution
    from pharos.errors import PharosError

    pictures = {}
    for run in study.runs:
        if run.instance in pictures:
            continue
        try:
            environment = run.configuration.make_environment()
            image = Image.fromarray(human(environment, start_distribution(environment)[0][0], cell=16))
        except PharosError:
            continue
        image.thumbnail((PICTURE_PIXELS * 2, PICTURE_PIXELS * 2))
        buffer = io.BytesIO()
        image.save(buffer, format="PNG", optimize=True)
        pictures[run.instance] = buffer.getvalue()
    return pictures


# The page ---------------------------------------------------------------------------------------------------------------


def _page(
    study: Specification,
    now: Status,
    rows: "pd.DataFrame",
    cells: "pd.DataFrame",
    measured: "pd.DataFrame",
    found: Sequence[Models],
    comparison: Comparison,
    estimates: "pd.DataFrame",
    said: "pd.DataFrame",
    figures: Figures,
    pictures: Mapping[str, bytes],
) -> str:
    sections = {
        "Summary": _summary(study, now, rows, found, comparison),
        "Findings of the paper": _findings(said),
        "Regret": _regret(estimates, figures),
        "Vector against image": _representations(cells, figures),
        "Hardness and regret": "".join(_models(models, figures) for models in found),
        "Agreement of agents": _agreement(cells, comparison, figures),
        "Hardness of the instances": _hardness(measured),
        "Returns": _returns(cells, comparison),
        "Beside the paper": _beside(comparison),
        "Instances": _instances(pictures),
        "Each instance": _figure(figures, "regret_by_instance", "Cumulative regret on each instance, all kinds of chance together."),
        "How it was made": _made(study, rows),
    }  # fmt: skip
    bodies, links = [], []
    for name, body in sections.items():
        if body:
            anchor = name.lower().replace(" ", "-")
            links.append(f'<a href="#{anchor}">{_text(name)}</a>')
            bodies.append(f'<section id="{anchor}"><h2>{_text(name)}</h2>{body}</section>')
    template = resources.files("pharos.study").joinpath("report.html").read_text(encoding="utf-8")
    for mark, value in {
        "TITLE": _text(f"Study {study.name}"),
        "DESCRIPTION": _text(study.description),
        "LINKS": "".join(links),
        "SECTIONS": "\n".join(bodies),
    }.items():
        template = template.replace(f"<!--{mark}-->", value)
    return template


def _summary(
    study: Specification, now: Status, rows: "pd.DataFrame", found: Sequence[Models], comparison: Comparison
) -> str:
    lines = [
        f"{now.finished:,} of {now.total:,} runs are finished"
        + (f", {now.failed} failed" if now.failed else "")
        + f": {_many(rows['instance'].nunique(), 'instance')} of {_many(rows['environment'].nunique(), 'class', 'classes')}, "
        f"{_many(rows['chance'].nunique(), 'kind')} of chance, {_many(rows['agent'].nunique(), 'agent')}, "
        f"{_many(rows['seed'].nunique(), 'seed')}; {int(rows['steps'].sum()):,} steps, which took one processor "
        f"{duration(rows['seconds'].sum())}."
    ]
    main = found[0].get("single", "all")
    if main is not None:
        lines.append(
            f"One linear model of DQN's cumulative regret over all classes and representations explains R² = {main.r_squared:.2f} "
            f"of it ({main.cross_validated_r_squared:.2f} for rows it has not seen); the paper prints 0.09."
        )
    known = int(comparison.returns["ours"].notna().sum())
    lines.append(f"{known} of the {len(comparison.returns)} returns that the paper prints have their counterpart here.")
    if now.missing:
        lines.append(f"<b>{_many(now.missing, 'run')} missing: every number below is of the runs that are there.</b>")
    text = "".join(f"<p>{line}</p>" for line in lines)
    if now.errors:
        counted = Counter(now.errors.values())
        text += (
            "<p>Failed:</p><ul>" + "".join(f"<li>{count} × {_text(e)}</li>" for e, count in counted.items()) + "</ul>"
        )
    return text


def _findings(said: "pd.DataFrame") -> str:
    decided = said[said["verdict"] != "no data"]
    if len(decided) == 0:
        return "<p>The study has no data for any of them.</p>"
    counts = ", ".join(f"{number} {verdict}" for verdict, number in decided["verdict"].value_counts().items())
    return f"<p>{len(decided)} of {len(said)} can be looked at here: {counts}.</p>" + _html_table(
        said,
        "What the paper says in words, and the same from these runs. Undecided: not significant at 0.05; no correction for the number of "
        "tests. How each is tested: docs/study.md.",
    )


def _many(count: int, one: str, several: str | None = None) -> str:
    return f"{count:,} {one if count == 1 else several or one + 's'}"


def _regret(estimates: "pd.DataFrame", figures: Figures) -> str:
    text = _figure(
        figures,
        "regret",
        "Cumulative regret by steps (lower is better), the mean over instances and kinds of chance with the 95 % bootstrap "
        "interval over seeds. The paper's figure 2.",
    )
    shown = estimates.assign(
        interval=[
            f"{low:.3f} to {high:.3f}" if np.isfinite(low) else "one run a task"
            for low, high in zip(estimates["lower"], estimates["upper"], strict=True)
        ]
    )
    columns = ["environment", "agent", "observation", "tasks", "runs", "iqm", "interval"]
    return text + _html_table(
        shown[columns],
        "Interquartile mean of the normalised regret (0: optimal from the first episode on; 1: as bad as acting at random) and its "
        "95 % stratified bootstrap interval. With few seeds such intervals are too narrow.",
    )


def _representations(cells: "pd.DataFrame", figures: Figures) -> str:
    if figures.get("representations") is None:
        return "<p>The study has no cells of DQN with both a vector and a simple image.</p>"
    wide = cells[cells["agent"] == "dqn"].pivot_table(
        index=["environment", "instance", "chance"], columns="observation", values="normalized_regret"
    )
    wide = wide[[_analysis.IMAGE, _analysis.VECTOR]].dropna()
    harder = (wide[_analysis.IMAGE] > wide[_analysis.VECTOR]).groupby(level="environment").agg(["sum", "size"])
    lines = "".join(
        f"<li>{_text(_figures.title(name))}: the image costs more regret in {row['sum']} of {row['size']} tasks</li>"
        for name, row in harder.iterrows()
    )
    return (
        _figure(
            figures,
            "representations",
            "Normalised regret of DQN that sees a vector against that of DQN that sees an image, a point for each instance and "
            "kind of chance. Below the dotted line the image is harder. The paper's figure 3.",
        )
        + f"<p>The paper finds the image harder in simple grid and frozen lake, the vector harder in freeway and breakout.</p><ul>{lines}</ul>"
    )


def _models(models: Models, figures: Figures) -> str:
    import pandas as pd

    name = models.regret.removesuffix("_regret")
    text = f"<h3>{_text(REGRETS[models.regret].capitalize())}</h3>"
    if models.fits:
        table = pd.DataFrame([_line(fit) for fit in models.fits])
        text += _html_table(
            table,
            "Ordinary least squares, section 4.3 of the paper: equations 7 (single), 8 (representation) and 9 (class). R² outside "
            "is for each row by the model fitted on the others; the condition number is that of the standardised predictors, above "
            "30 the coefficients cannot be told apart; influence is the largest Cook's distance. Significant: p < 0.05.",
        )
        together = {
            "representation models together": models.representation_r_squared,
            "class models together": models.class_r_squared,
            "classes that the model has not seen": models.leave_one_class_out,
        }
        text += "<ul>" + "".join(
            f"<li>R² of {what}: {value:.2f}</li>" for what, value in together.items() if value is not None
        )
        text += "</ul>"
    for kind, number in (("single_model", 4), ("representation_models", 5), ("class_models", 6)):
        what = kind.replace("_", " ")
        text += _figure(
            figures,
            f"{kind}_{name}",
            f"Fitted against actual {REGRETS[models.regret]}, {what}. The paper's figure {number}.",
        )
    if models.fits:
        text += (
            "<details><summary>All coefficients</summary>" + _html_table(coefficients(models), digits=4) + "</details>"
        )
    if models.notes:
        text += "<p>Notes:</p><ul>" + "".join(f"<li>{_text(note)}</li>" for note in models.notes) + "</ul>"
    return text


def _line(fit: Fit) -> dict[str, Any]:
    significant = [
        _predictor(str(name))
        for name, p in fit.coefficients["p_value"].items()
        if p < 0.05 and name != "Intercept"
    ]  # fmt: skip
    return {
        "model": fit.model,
        "of": fit.subset,
        "rows": fit.num_rows,
        "R²": fit.r_squared,
        "adjusted": fit.adjusted_r_squared,
        "outside": fit.cross_validated_r_squared,
        "condition": fit.condition_number,
        "influence": float(np.nanmax(fit.influence)) if len(fit.influence) else float("nan"),
        "significant": ", ".join(significant) or "none",
        "left out": ", ".join(fit.dropped),
    }


def _predictor(name: str) -> str:
    """`np.log(diameter)` -> `log diameter`, `C(environment)[T.freeway]` -> `freeway`."""
    if name.startswith("C("):
        return name.split("[T.")[1].rstrip("]")
    return name.replace("np.log(", "log ").rstrip(")")


def _agreement(cells: "pd.DataFrame", comparison: Comparison, figures: Figures) -> str:
    lines = []
    for value in ("return", "normalized_regret", "cumulative_regret"):
        found = _analysis.agreement(cells, value)
        if found is not None:
            lines.append(f"<li>{REGRETS.get(value, value)}: r = {found[0]:.2f} over {found[1]} cells</li>")
    if not lines:
        return "<p>The study has fewer than three cells that both DQN and PPO have.</p>"
    return (
        f"<p>Pearson correlation of DQN and PPO over instances, kinds of chance and observations; the paper prints 0.81, and the "
        f"returns that it prints in appendix C give {_analysis.paper_agreement():.2f}.</p><ul>{''.join(lines)}</ul>"
        + _figure(figures, "agents", "Normalised regret of PPO against that of DQN.")
    )


def _hardness(measured: "pd.DataFrame") -> str:
    return _html_table(
        measured,
        "The tabular measures of each instance under each kind of chance, as they enter the models; notes say where one is of the "
        "instance without chance, or stands for a proven interval.",
    )


def _returns(cells: "pd.DataFrame", comparison: Comparison) -> str:
    """The tables of appendix C, with our instances; LaTeX below each."""
    text = "<p>Mean return of the training episodes in the last tenth of each run, undiscounted, ± the deviation over seeds.</p>"
    for environment in dict.fromkeys(cells["environment"]):
        part = cells[cells["environment"] == environment]
        text += f"<h3>{_text(_figures.title(environment))}</h3>"
        wide = _wide_returns(part)
        text += _html_table(wide)
        text += f"<details><summary>LaTeX</summary><pre>{_text(returns_table(cells, environment))}</pre></details>"
    return text


def _wide_returns(part: "pd.DataFrame") -> "pd.DataFrame":
    import pandas as pd

    lines: dict[tuple[str, str], dict[str, Any]] = {}
    columns = sorted(
        {(row.agent, row.observation) for row in part.itertuples()}, key=lambda key: (key[0] != "ppo", *key)
    )
    for row in part.to_dict("records"):
        line = lines.setdefault(
            (row["instance"], row["chance"]), {"instance": row["instance"], "chance": row["chance"]}
        )
        name = _figures.label(row["agent"], row["observation"])
        deviation = f" ± {row['return_deviation']:.2f}" if row["seeds"] > 1 else ""
        line[name] = f"{row['return']:.2f}{deviation}"
    names = [_figures.label(*key) for key in columns]
    return pd.DataFrame(list(lines.values()), columns=["instance", "chance", *names]).fillna("")


def _beside(comparison: Comparison) -> str:
    shown = comparison.regressions.drop(columns=["r_squared", "significant_predictors_as_printed"])
    shown = shown.rename(columns={name: name.replace("_", ", ") for name in shown.columns})
    text = _html_table(shown, "R² and correlation: printed, ours, and the difference, for both kinds of regret.")
    known = comparison.returns[comparison.returns["ours"].notna()]
    if len(known) == 0:
        return text + "<p>No instance of the study is one of the paper's tables.</p>"
    return text + (
        f"<p>Returns: {len(known)} of {len(comparison.returns)} printed values have one of ours; the difference is "
        f"{known['difference'].mean():+.2f} in the mean, and {known['difference'].abs().median():.2f} in the middle case. The paper "
        f"trains 50 thousand steps on grids and lakes, else 600 thousand; it prints no rewards, discounts, probabilities of chance, or "
        f"what of a run its returns are means of: differences are to be "
        f"expected.</p><details><summary>All {len(known)} values</summary>"
        + _html_table(known.drop(columns=["parameters_as_printed"]), digits=2)
        + "</details>"
    )


def _instances(pictures: Mapping[str, bytes]) -> str:
    cards = [
        f'<figure class="card"><img alt="{_text(name)}" src="{_data(png)}"><figcaption>{_text(name)}</figcaption></figure>'
        for name, png in pictures.items()
    ]
    return f'<div class="cards">{"".join(cards)}</div>' if cards else ""


def _made(study: Specification, rows: "pd.DataFrame") -> str:
    import yaml

    import pharos

    facts = f"pharos {pharos.__version__}, Python {platform.python_version()}, {time.strftime('%Y-%m-%d %H:%M', time.gmtime())} UTC"
    text = yaml.safe_dump(study.model_dump(mode="json", exclude_unset=True), sort_keys=False, width=100)
    return f"<p>{_text(facts)}</p><details><summary>The specification</summary><pre>{_text(text)}</pre></details>"


# Pieces -----------------------------------------------------------------------------------------------------------------


def _figure(figures: Figures, name: str, caption: str) -> str:
    images = figures.get(name)
    if not images:
        return ""
    return (
        f'<figure><picture><source media="(prefers-color-scheme: dark)" srcset="{_data(images["dark"])}">'
        f'<img alt="{_text(caption)}" src="{_data(images["light"])}"></picture>'
        f"<figcaption>{_text(caption)} <span class='file'>figures/{name}.pdf</span></figcaption></figure>"
    )


def _data(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _html_table(data: "pd.DataFrame", caption: str = "", *, digits: int = 3) -> str:
    numeric = [column for column in data.columns if data[column].dtype.kind in "fiu"]
    short = [column for column in data.columns if data[column].astype(str).str.len().max() <= 30]
    whole = [column for column in numeric if _is_whole(data[column].to_numpy(float))]
    head = "".join(
        f'<th class="{"n" if column in numeric else "t"}">{_text(str(column).replace("_", " "))}</th>'
        for column in data.columns
    )
    body = []
    for line in data.itertuples(index=False):
        entries = zip(data.columns, line, strict=True)
        body.append(
            "".join(
                f'<td class="{"n" if column in numeric else "s" if column in short else "t"}">{_cell(value, 0 if column in whole else digits)}</td>'
                for column, value in entries
            )
        )
    lines = "".join(f"<tr>{line}</tr>" for line in body)
    said = f"<caption>{_text(caption)}</caption>" if caption else ""
    return f'<div class="scroll"><table>{said}<thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table></div>'


def _is_whole(values: np.ndarray) -> bool:
    known = values[np.isfinite(values)]
    return bool((known == np.round(known)).all())


def _cell(value: Any, digits: int) -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    if isinstance(value, float | np.floating):
        return number(float(value), digits)
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return f"{value:,}"
    return _text(str(value))


def number(value: float, digits: int = 3) -> str:
    """A number for people: digits after the point, thousands separated, small and huge ones with a power of ten."""
    if digits > 0 and value != 0 and not 10.0**-digits <= abs(value) < 1e7:
        return f"{value:.{max(1, digits - 1)}e}"
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.{digits}f}"


def _text(value: str) -> str:
    return html.escape(value, quote=True)
