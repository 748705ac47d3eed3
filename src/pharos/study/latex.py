"""The tables of a study in LaTeX, those of the paper in its layout (packages booktabs, multirow), by pandas' Styler."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pharos.agents import TABULAR_OBSERVATION
from pharos.plots import agent_name
from pharos.study.analysis import IMAGE, VECTOR, Models
from pharos.system.wording import in_words, latex_text

if TYPE_CHECKING:
    import pandas as pd

# As the paper orders them
COLUMNS = (("ppo", IMAGE), ("ppo", VECTOR), ("dqn", IMAGE), ("dqn", VECTOR))
TITLES = {"ppo": "PPO", "dqn": "DQN", IMAGE: "IMAGE", VECTOR: "MINIMAL"}
CHANCES = {"plain": "None", "random": "random", "sticky": "stick"}


def tables_of(cells: "pd.DataFrame", measured: "pd.DataFrame", models: Sequence[Models]) -> dict[str, str]:
    """Name -> LaTeX: the returns of each class, hardness, and the fits for each agent and kind of regret."""
    tables = {
        f"returns_{environment}": returns_table(cells, environment)
        for environment in dict.fromkeys(cells["environment"])
    }
    tables["hardness"] = hardness_table(measured)
    for each in models:
        tables[f"models_{each.regret}{each.suffix(models[0].agent)}"] = models_table(each)
    return tables


def returns_table(cells: "pd.DataFrame", environment: str) -> str:
    """The returns of one class, a line for each kind of chance.

    As in appendix C where PPO and DQN see images and vectors: IMAGE and MINIMAL (the vector). Else a column for each
    agent and observation that there is.
    """
    import pandas as pd

    part = cells[cells["environment"] == environment]
    rows: dict[tuple[str, str], dict[tuple[str, str], str]] = {}
    for row in part.to_dict("records"):
        kind = row["chance"] if "," in row["chance"] else CHANCES.get(row["chance"].split()[0], row["chance"])
        name = rf"{{\small {latex_text(row['instance'])}}}"
        entries = rows.setdefault((name, latex_text(kind)), {})
        entries[row["agent"], row["observation"]] = _entry(row["return"], row["return_deviation"])
    keys = sorted({(row.agent, row.observation) for row in part.itertuples()}, key=lambda key: (key[0] != "ppo", *key))
    titles = [(latex_text(agent_name(agent)), latex_text(in_words(name))) for agent, name in keys]
    if {key for key in keys if key[1] != TABULAR_OBSERVATION} == set(COLUMNS):
        keys, titles = list(COLUMNS), [(TITLES[agent], TITLES[name]) for agent, name in COLUMNS]
    columns = pd.MultiIndex.from_tuples(titles)
    index = pd.MultiIndex.from_tuples(list(rows), names=["instance", "randomization"])
    data = [[entries.get(column, "--") for column in keys] for entries in rows.values()]
    return _latex(
        pd.DataFrame(data, index, columns), "ll" + "c" * len(keys), multirow_align="c", clines="skip-last;data"
    )


def hardness_table(measured: "pd.DataFrame") -> str:
    """The measures of each instance under each kind of chance."""
    names = [name for name in measured.columns if name not in ("environment", "instance", "chance", "notes")]
    texts = measured[["instance", "chance"]].map(latex_text)
    numbers = measured[names].map(lambda x: "--" if x is None or not np.isfinite(x) else f"{x:.6g}")
    table = texts.join(numbers).rename(columns=lambda name: latex_text(in_words(name)))
    return _latex(table, "ll" + "r" * len(names), is_indexed=False)


def models_table(models: Models) -> str:
    """The fits: rows, R2 within and outside the sample."""
    import pandas as pd

    names = ["model", "of", "rows", "$R^2$", "adjusted", "outside"]
    lines = []
    for fit in models.fits:
        numbers = (f"{value:.2f}" for value in (fit.r_squared, fit.adjusted_r_squared, fit.cross_validated_r_squared))
        lines.append([fit.model, latex_text(fit.subset), str(fit.num_rows), *numbers])
    return _latex(pd.DataFrame(lines, columns=names), "llrrrr", is_indexed=False)


def _latex(
    data: "pd.DataFrame",
    column_format: str,
    *,
    is_indexed: bool = True,
    multirow_align: str = "c",
    clines: str | None = None,
) -> str:
    """A frame of LaTeX texts as a tabular."""
    styler = data.style if is_indexed else data.style.hide(axis="index")
    text = styler.to_latex(
        hrules=True,
        column_format=column_format,
        multicol_align="c",
        multirow_align=multirow_align,
        clines=clines,
    )
    return re.sub(r" +", " ", text)


def _entry(mean: float, deviation: float) -> str:
    if not np.isfinite(mean):
        return "--"
    return rf"${mean:.2f}$" if np.isnan(deviation) else rf"${mean:.2f} \pm {deviation:.2f}$"
