"""What the paper printed, as tables: the returns of its appendix C and the fits of its section 4.3."""

from importlib import resources
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


def paper_returns() -> "pd.DataFrame":
    """One row a printed mean and deviation: environment, instance, randomization, agent, observation, mean, std."""
    return _table("paper_returns.csv")


def paper_regressions() -> "pd.DataFrame":
    """One row a printed fit: model, subset, r_squared, significant_predictors_as_printed."""
    return _table("paper_regressions.csv")


def _table(name: str) -> "pd.DataFrame":
    import pandas as pd

    with resources.files("pharos.study").joinpath("data", name).open() as file:
        return pd.read_csv(file)
