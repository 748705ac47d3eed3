"""The sections on models of regret, and on the agreement of agents."""

from typing import Any

import numpy as np

from pharos.plots import agent_name
from pharos.study.analysis import REGRETS, Models, agreement, paper_agreement
from pharos.study.figures import agents_figure
from pharos.study.regression import Fit
from pharos.study.report.page import Figures, image, table
from pharos.study.report.results import Results, coefficients
from pharos.study.report.section import Section
from pharos.system.wording import many


def models_section(results: Results, figures: Figures, left_out: list[str]) -> Section | None:
    """The models of regret by hardness; None where there are none: `left_out` says why."""
    if not results.agents:
        left_out.append("Hardness and regret: tabular agents, which see the state itself, have no models.")
        return None
    if not results.has_models:
        left_out.append(f"Hardness and regret: {results.models[0].notes[0]}.")
        return None
    return Section.of(
        "Hardness and regret", "models", parts=[_models_of(models, results, figures) for models in results.models]
    )


def _models_of(models: Models, results: Results, figures: Figures) -> dict[str, Any]:
    import pandas as pd

    paper = results.comparison is not None and models.agent == "dqn"
    what = REGRETS[models.regret]
    heading = f"{what.capitalize()} of {agent_name(models.agent)}"
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
    drawn = []
    for kind, number in (("single_model", 4), ("representation_models", 5), ("class_models", 6)):
        text = f"Fitted against actual {what}, {kind.replace('_', ' ')}."
        text += f" The paper's figure {number}." if paper else ""
        drawn.append(image(figures, f"{kind}_{models.regret.removesuffix('_regret')}{suffix}", text))
    return {
        "title": heading,
        "table": table(fits, caption) if models.fits else None,
        "together": [f"R² of {name}: {value:.2f}" for name, value in values.items() if value is not None],
        "figures": [each for each in drawn if each is not None],
        "coefficients": table(coefficients(models), digits=4) if models.fits else None,
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
    """The correlation of agents over cells; None where too few are common: `left_out` says so."""
    lines, drawn = [], []
    for i, one in enumerate(results.agents):
        for two in results.agents[i + 1 :]:
            for value in ("return", "normalized_regret", "cumulative_regret"):
                if (pair := agreement(results.cells, value, (one, two))) is not None:
                    names = f"{agent_name(one)} and {agent_name(two)}, {REGRETS.get(value, value)}"
                    lines.append(f"{names}: r = {pair[0]:.2f} over {many(pair[1], 'cell')}")
            caption = f"Normalised regret of {agent_name(two)} against that of {agent_name(one)}."
            drawn.append(image(figures, agents_figure(one, two), caption))
    if not lines:
        left_out.append(
            "Agreement of agents: there are fewer than three cells that both DQN and PPO have, or two other agents."
        )
        return None
    text = "Pearson correlation of agents over instances, kinds of chance and observations"
    if results.comparison is not None:
        text += "; the paper prints 0.81 for DQN and PPO, and the returns that it prints in appendix C give "
        text += f"{paper_agreement():.2f}"
    return Section.of(
        "Agreement of agents",
        "agreement",
        text=text + ".",
        lines=lines,
        figures=[each for each in drawn if each is not None],
    )
