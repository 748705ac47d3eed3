"""The sections on models of regret, on the agreement of agents, and on classes that a predictor has not seen."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.plots import agent_label, slug
from pharos.study.analysis import PAPER_AGENT, REGRETS, Models, agreement, paper_agreement
from pharos.study.figures import agents_figure
from pharos.study.regression import Fit
from pharos.study.report.page import Figures, ReportTable, Section, data_table, figure_image
from pharos.study.report.results import Results, coefficients
from pharos.system.wording import in_words, pluralize

if TYPE_CHECKING:
    import pandas as pd

    from pharos.study.predictions import PredictedCells


def models_section(results: Results, figures: Figures, left_out: list[str]) -> Section | None:
    """The models of regret by hardness. None if there are none: `left_out` says why."""
    if not results.agents:
        left_out.append("Hardness and regret: tabular agents, which see the state itself, have no models.")
        return None
    if not results.has_models:
        left_out.append(f"Hardness and regret: {results.models[0].notes[0]}.")
        return None
    return Section(
        "Hardness and regret", "models", parts=[_models_of(models, results, figures) for models in results.models]
    )


def _models_of(models: Models, results: Results, figures: Figures) -> dict[str, Any]:
    import pandas as pd

    paper = results.comparison is not None and models.agent == PAPER_AGENT
    what = REGRETS[models.regret]
    heading = f"{what.capitalize()} of {agent_label(models.agent)}"
    fits = pd.DataFrame([_line(fit) for fit in models.fits])
    caption = (
        "Ordinary least squares, section 4.3 of the paper: equations 7 (single), 8 (representation) and 9 (class). R² "
        "outside is for each task by the model fitted on the others; the condition number is that of the standardised "
        "predictors, above 30 the coefficients cannot be told apart; influence is the largest Cook's distance. "
        "Significant: p < 0.05, a task counted once."
    )
    values = {
        "class and representation alone, without measures": models.class_alone,
        "representation models together": models.representation_r_squared,
        "class models together": models.class_r_squared,
        "classes that the model has not seen": models.leave_one_class_out,
    }
    suffix = models.suffix(results.models[0].agent)
    images = []
    for kind, number in (("single_model", 4), ("representation_models", 5), ("class_models", 6)):
        text = f"Fitted against actual {what}, {kind.replace('_', ' ')}."
        text += f" The paper's figure {number}." if paper else ""
        images.append(figure_image(figures, f"{kind}_{models.regret.removesuffix('_regret')}{suffix}", text))
    return {
        "title": heading,
        "table": data_table(fits, caption) if models.fits else None,
        "together": [f"R² of {name}: {value:.2f}" for name, value in values.items() if value is not None],
        "figures": [each for each in images if each is not None],
        "coefficients": data_table(coefficients(models), digits=4) if models.fits else None,
        "notes": list(models.notes),
    }


def _line(fit: Fit) -> dict[str, Any]:
    significant = [
        _predictor(str(name)) for name, p in fit.coefficients["p_value"].items() if p < 0.05 and name != "Intercept"
    ]
    return {
        "model": fit.model,
        "of": fit.subset,
        "rows": fit.num_rows,
        "R²": fit.r_squared,
        "adjusted": fit.adjusted_r_squared,
        "outside": fit.cross_validated_r_squared,
        "condition": fit.condition_number,
        "influence": float(np.nanmax(fit.influence)) if np.isfinite(fit.influence).any() else float("nan"),
        "significant": ", ".join(significant) or "none",
        "left out": ", ".join(fit.dropped),
    }


def _predictor(name: str) -> str:
    """`np.log(diameter)` -> `log diameter`, `C(environment)[T.freeway]` -> `freeway`."""
    if name.startswith("C("):
        return name.split("[T.")[1].rstrip("]")
    return name.replace("np.log(", "log ").rstrip(")")


def agreement_section(results: Results, figures: Figures, left_out: list[str]) -> Section | None:
    """The correlation of agents over cells. None if too few are common: `left_out` says so."""
    lines, images = [], []
    for i, one in enumerate(results.agents):
        for two in results.agents[i + 1 :]:
            for value in ("return", "normalized_regret", "cumulative_regret"):
                if (pair := agreement(results.cells, value, (one, two))) is not None:
                    names = f"{agent_label(one)} and {agent_label(two)}, {REGRETS.get(value, value)}"
                    lines.append(f"{names}: r = {pair[0]:.2f} over {pluralize(pair[1], 'cell')}")
            caption = f"Normalised regret of {agent_label(two)} against that of {agent_label(one)}."
            images.append(figure_image(figures, agents_figure(one, two), caption))
    if not lines:
        left_out.append(
            "Agreement of agents: there are fewer than three cells that both DQN and PPO have, or two other agents."
        )
        return None
    text = "Pearson correlation of agents over instances, kinds of chance and observations"
    if results.comparison is not None:
        text += "; the paper prints 0.81 for DQN and PPO, and the returns that it prints in appendix C give "
        text += f"{paper_agreement():.2f}"
    return Section(
        "Agreement of agents",
        "agreement",
        text=text + ".",
        lines=lines,
        figures=[each for each in images if each is not None],
    )


# Classes that a predictor has not seen: tables, figures, and what the file of predictions says ------------------------


FEW_PERMUTATIONS = 499


def judged_cells(results: Results, predictions: "PredictedCells | None") -> "tuple[pd.DataFrame | None, pd.DataFrame]":
    """(statistics of predictors, or None if there are fewer than two classes, cells with outcomes).

    Raises:
        ParameterError: there are predictions, but of other cells, or of fewer than three classes.
    """
    from pharos.study.leave_one_class_out import outcomes, unseen_classes

    cells = outcomes(results.runs, results.points)
    if predictions is not None:
        return unseen_classes(predictions.cells, cells, measures=results.hardness), cells
    own = cells[cells["agent"].isin(results.agents)]
    try:
        judgement = unseen_classes(None, own, measures=results.hardness, least_classes=2, permutations=FEW_PERMUTATIONS)
    except ParameterError:
        return None, cells
    return (judgement if len(judgement) else None), cells


def unseen_section(
    judgement: "pd.DataFrame",
    results: Results,
    predictions: "PredictedCells | None",
    figures: Figures,
) -> Section:
    """The section on predictors of unseen classes, MDPs and observations: how well they predict, with baselines."""
    parts = []
    for agent in dict.fromkeys(judgement["agent"]):
        for outcome in dict.fromkeys(judgement["outcome"]):
            rows = judgement[(judgement["agent"] == agent) & (judgement["outcome"] == outcome)]
            rows = rows.sort_values("baseline", ascending=False, kind="stable")
            if len(rows):
                parts.append(_part(str(agent), str(outcome), rows, figures))
    return Section(
        "Unseen classes",
        "unseen",
        text=_text(judgement),
        provenance=_provenance(results, predictions),
        parts=parts,
    )


def _text(judgement: "pd.DataFrame") -> list[str]:
    number = int(judgement["tests"].max())
    return [
        *winners(judgement),
        "Does a number that is known before training predict regret on classes that it has not met? Each class is "
        "predicted by a line through the others, classes weighing alike; baselines stand first, and a measure that "
        "does not beat them says nothing that is new. R² below 0 is worse than the mean of all classes.",
        f"{pluralize(number, 'test')} in all; p-values are corrected for that number (Holm). Intervals are over "
        "classes drawn anew, and permutations exchange whole classes: instances and observations of a class are not "
        "independent. The floor is what 95 % of such permutations stay below; the ceiling is what noise over "
        "seeds leaves.",
    ]


def winners(judgement: "pd.DataFrame") -> list[str]:
    """A sentence for each agent: which predictor has the largest R2 on classes left out, and the best baseline."""
    sentences = []
    for agent, rows in judgement[judgement["outcome"] == "greedy"].groupby("agent", sort=False):
        best = {
            is_baseline: some.loc[some["r_squared"].idxmax()]
            for is_baseline, some in rows.dropna(subset="r_squared").groupby("baseline")
        }
        if best:
            texts = [f"{best[key]['predictor']} (R² {best[key]['r_squared']:.2f})" for key in sorted(best)]
            baseline = f"; of the baselines {texts[1]}" if len(texts) > 1 else ""
            sentences.append(f"{agent_label(str(agent))}: on classes left out {texts[0]} predicts best{baseline}.")
    return sentences


def _provenance(results: Results, predictions: "PredictedCells | None") -> list[str]:
    """Date, version and hash of files of predictions, and whether they were written before the runs, a line each."""
    if predictions is None:
        return ["Without predictions (pharos study predict), of tabular measures alone."]
    lines = [
        f"Predictions written {about['date']} by pharos {about['version']}, sha256 {about['sha256']}."
        for _, about in predictions.parts
    ]
    return [*lines, *(doubts(results, predictions) or ["All runs began after that."])]


def doubts(results: Results, predictions: "PredictedCells") -> list[str]:
    """Reasons to doubt predictions: runs that began before these were written, or that do not say when they began."""
    before, unknown = predictions.late(results.runs)
    total, reasons = f"of {pluralize(len(results.runs), 'run')}", []
    if before:
        reasons.append(f"not a prediction: {before:,} {total} had begun when the predictions were written")
    if unknown:
        reasons.append(f"{unknown:,} {total} do not say whether they began after the predictions were written")
    return reasons


def _part(agent: str, outcome: str, rows: "pd.DataFrame", figures: Figures) -> dict[str, Any]:
    from pharos.study.leave_one_class_out import OUTCOMES

    images = []
    if outcome == "greedy":
        texts = {
            "predicted_by_class": "Regret against what was predicted for it when its class was left out; a point a "
            "cell. On the dotted line the prediction was right.",
            "observations_of_mdps": "The same MDP under its observations: regret of the agent (full) and as predicted "
            "(hollow).",
            "idealised_curves": "Regret of the learnt policy while learning: of the agent (full line, the mean over "
            "seeds; of actor-critics the distribution over actions) and of the greedy policy of the idealised learner "
            "(dashed), which was never trained.",
        }
        images = [figure_image(figures, f"{name}_{slug(agent)}", text) for name, text in texts.items()]
    return {
        "title": f"{agent_label(agent)}: {OUTCOMES[outcome]}",
        "tables": [each for each in (_left_out(rows), _within(rows), _mixed(rows)) if each is not None],
        "figures": [each for each in images if each is not None],
    }


def _left_out(rows: "pd.DataFrame") -> ReportTable | None:
    columns = {
        "cells": rows["cells"],
        "classes": rows["classes"],
        "R²": _with_interval(rows, "r_squared"),
        "rho": _with_interval(rows, "rho"),
        "floor of rho": rows["floor_rho"],
        "p": _p_values(rows, "p_rho_holm"),
        "R² of MDPs": rows["r_squared_mdp"],
        "calibration": rows["calibration"],
        "ceiling of R²": rows["ceiling"],
    }
    caption = (
        "Classes left out one by one (R² of MDPs: instances one by one): R², Spearman's rho, with 95 % intervals; "
        "calibration: slope of the outcome on what was predicted, 1 is perfect."
    )
    return _of_predictors(rows, columns, caption)


def _within(rows: "pd.DataFrame") -> ReportTable | None:
    rows = rows[(rows["pairs"] > 0) & rows["p_agreement"].notna() | rows["agreement_lower"].notna()]
    columns = {
        "pairs": rows["pairs"],
        "rightly ordered": _with_interval(rows, "agreement"),
        "ceiling": rows["agreement_ceiling"],
        "p": _p_values(rows, "p_agreement_holm"),
        "image and vector": rows["image_pairs"],
        "rightly ordered of these": rows["image_agreement"],
        "rho within a class": rows["rho_within"],
    }
    caption = (
        "Pairs of observations of one MDP whose outcomes differ by more than 0.05, and the share that is ordered "
        "rightly. Tabular measures have no opinion, 0.5. Ceiling: what noise over seeds leaves. p: observations change "
        "names, in all MDPs of a class alike."
    )
    return _of_predictors(rows, columns, caption)


def _mixed(rows: "pd.DataFrame") -> ReportTable | None:
    rows = rows[rows["slope"].notna()]
    columns = {
        "slope": rows["slope"],
        "error": rows["slope_error"],
        "p": _p_values(rows, "p_slope_holm"),
        "classes' share": rows["class_share"],
        "MDPs' share": rows["mdp_share"],
        "rho given tabular measures": _with_interval(rows, "given_tabular"),
        "rho given the tabular learner": _with_interval(rows, "given_tabular_regret"),
    }
    caption = (
        "Mixed models: slope of the standardised predictor, with random intercepts of classes and of MDPs, and their "
        "shares of the variance that is left. Partial rank correlations, 95 % intervals over classes."
    )
    return _of_predictors(rows, columns, caption)


def _of_predictors(rows: "pd.DataFrame", columns: Mapping[str, Any], caption: str) -> ReportTable | None:
    """A row for each predictor, or None if there is none."""
    import pandas as pd

    if not len(rows):
        return None
    return data_table(
        pd.DataFrame({"predictor": [_name(row) for row in rows.to_dict("records")], **columns}), caption, digits=2
    )


def _name(row: Mapping[str, Any]) -> str:
    return f"{in_words(str(row['predictor']))}{', baseline' if row['baseline'] else ''}"


def _with_interval(rows: "pd.DataFrame", name: str) -> list[str]:
    """`0.61 (0.36 to 0.79)`."""
    texts = []
    for value, low, high in zip(rows[name], rows[f"{name}_lower"], rows[f"{name}_upper"], strict=True):
        if not np.isfinite(value):
            texts.append("–")
        else:
            texts.append(f"{value:.2f}" + (f" ({low:.2f} to {high:.2f})" if np.isfinite(low) else ""))
    return texts


def _p_values(rows: "pd.DataFrame", name: str) -> list[str]:
    return ["–" if not np.isfinite(p) else "< 0.001" if p < 0.001 else f"{p:.3f}" for p in rows[name]]
