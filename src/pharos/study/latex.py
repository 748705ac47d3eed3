"""The tables of a study in LaTeX, in the paper's layout (packages booktabs, multirow, makecell)."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pharos.study.analysis import IMAGE, VECTOR, Models

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (("ppo", IMAGE), ("ppo", VECTOR), ("dqn", IMAGE), ("dqn", VECTOR))  # as the paper orders them
CHANCES = {"plain": "None", "random": "random", "sticky": "stick"}


def tables_of(cells: "pd.DataFrame", measured: "pd.DataFrame", found: Sequence[Models]) -> dict[str, str]:
    """Name -> LaTeX: the returns of each class, hardness, and the fits for each kind of regret."""
    tables = {
        f"returns_{environment}": returns_table(cells, environment)
        for environment in dict.fromkeys(cells["environment"])
    }
    tables["hardness"] = hardness_table(measured)
    for models in found:
        tables[f"models_{models.regret}"] = models_table(models)
    return tables


def returns_table(cells: "pd.DataFrame", environment: str) -> str:
    """The table of one class as in appendix C: PPO and DQN, IMAGE and MINIMAL (the vector), three lines an instance."""
    part = cells[cells["environment"] == environment]
    values = {
        (row["instance"], row["chance"], row["agent"], row["observation"]): (row["return"], row["return_deviation"])
        for row in part.to_dict("records")
    }
    lines = [
        r"\begin{tabular}{llcccc}",
        r"\toprule",
        r" & & \multicolumn{2}{c}{PPO} & \multicolumn{2}{c}{DQN} \\",
        r"\makecell[l]{environment\\parameter} & randomization & IMAGE & MINIMAL & IMAGE & MINIMAL \\",
        r"\midrule",
    ]
    instances = list(dict.fromkeys(part["instance"]))
    for instance in instances:
        chances = list(dict.fromkeys(part.loc[part["instance"] == instance, "chance"]))
        for i, chance in enumerate(chances):
            name = rf"\multirow[c]{{{len(chances)}}}{{*}}{{{{\small {escape(instance)}}}}}" if i == 0 else ""
            entries = (_entry(values.get((instance, chance, *column))) for column in COLUMNS)
            kind = CHANCES.get(chance.split()[0], chance) if "," not in chance else chance
            lines.append(f"{name} & {escape(kind)} & {' & '.join(entries)} \\\\")
        lines.append(r"\cline{1-6}" if instance != instances[-1] else r"\bottomrule")
    return "\n".join([*lines, r"\end{tabular}", ""])


def hardness_table(measured: "pd.DataFrame") -> str:
    """The measures of each instance under each kind of chance."""
    names = [name for name in measured.columns if name not in ("environment", "instance", "chance", "notes")]
    lines = [
        rf"\begin{{tabular}}{{ll{'r' * len(names)}}}",
        r"\toprule",
        " & ".join(["instance", "chance", *(escape(name.replace("_", " ")) for name in names)]) + r" \\",
        r"\midrule",
    ]
    for row in measured.to_dict("records"):
        numbers = ("--" if row[name] is None or not np.isfinite(row[name]) else f"{row[name]:.6g}" for name in names)
        lines.append(" & ".join([escape(row["instance"]), escape(row["chance"]), *numbers]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def models_table(models: Models) -> str:
    """The fits: rows, R2 within and outside the sample."""
    lines = [
        r"\begin{tabular}{llrrrr}",
        r"\toprule",
        r"model & of & rows & $R^2$ & adjusted & outside \\",
        r"\midrule",
    ]
    for fit in models.fits:
        numbers = (f"{value:.2f}" for value in (fit.r_squared, fit.adjusted_r_squared, fit.cross_validated_r_squared))
        lines.append(" & ".join([fit.model, escape(fit.subset), str(fit.num_rows), *numbers]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def escape(text: str) -> str:
    """Text as LaTeX prints it."""
    for letter in "&%$#_{}":
        text = text.replace(letter, "\\" + letter)
    return text


def _entry(value: tuple[float, float] | None) -> str:
    if value is None or not np.isfinite(value[0]):
        return "--"
    return rf"${value[0]:.2f}$" if np.isnan(value[1]) else rf"${value[0]:.2f} \pm {value[1]:.2f}$"
