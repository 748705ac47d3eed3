"""The paper's findings in words, each tested on the data of a study."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.study.analysis import IMAGE, VECTOR, Models, agreement, paper_agreement
from pharos.study.regression import Fit

if TYPE_CHECKING:
    import pandas as pd

LEVEL = 0.05  # of every test; each stands alone, without a correction for their number
COLUMNS = ["finding", "of", "paper", "ours", "evidence", "p", "verdict"]
_HARDER = {
    "simple_grid": IMAGE,
    "frozen_lake": IMAGE,
    "breakout": VECTOR,
    "freeway": VECTOR,
}  # by the paper's section 4.2
_PRINTED_AGREEMENT = 0.81


def findings(cells: "pd.DataFrame", found: Models, *, resamples: int = 1000) -> "pd.DataFrame":
    """Return the findings of the paper's sections 4.2 and 4.3 and appendix C beside what the data say.

    - Which observation costs DQN more regret, for each class: the normalised regret of both on the same tasks (instance and chance),
      Wilcoxon's signed-rank test, two-sided.
    - One linear model of all explains next to nothing: the F test of all its predictors.
    - Models by representation, and by class, explain more: the F test of their slopes against those of the single model, which is
      nested in them.
    - Hardness explains regret better with vectors than with images: the difference of R2, tasks resampled, 95 % percentile interval.
    - DQN and PPO agree: Pearson's r of their mean returns over cells, with Fisher's interval.

    Args:
        cells: as from `cells`.
        found: the models of DQN's cumulative regret.
    Returns:
        One row a finding: what the paper says, ours, the statistic in words, p-value (NaN where an interval decides), and the verdict:
        "agrees" or "disagrees" where the test is significant at 0.05, "undecided" where it is not, "no data".
    Cost: `resamples` small regressions.
    """
    import pandas as pd

    rows = [_representation(cells, environment, harder) for environment, harder in _HARDER.items()]
    rows += [_single(found), *_nested(found), _vectors_explained_better(found, resamples), _agreement(cells)]
    return pd.DataFrame(rows, columns=COLUMNS)


def _row(finding: str, of: str, paper: str, ours: str, evidence: str, p: float, verdict: str) -> dict[str, Any]:
    return dict(zip(COLUMNS, (finding, of, paper, ours, evidence, p, verdict), strict=True))


def _nothing(finding: str, of: str, paper: str, why: str) -> dict[str, Any]:
    return _row(finding, of, paper, "", why, math.nan, "no data")


def _representation(cells: "pd.DataFrame", environment: str, harder: str) -> dict[str, Any]:
    from scipy import stats

    finding, paper = "the harder observation of DQN", "image" if harder == IMAGE else "vector"
    part = cells[(cells["agent"] == "dqn") & (cells["environment"] == environment)]
    wide = part.pivot_table(index=["instance", "chance"], columns="observation", values="normalized_regret")
    if not {IMAGE, VECTOR} <= set(wide.columns) or len(both := wide[[IMAGE, VECTOR]].dropna()) == 0:
        return _nothing(finding, environment, paper, "no task with both observations")
    difference = both[IMAGE].to_numpy(float) - both[VECTOR].to_numpy(float)
    p = float(stats.wilcoxon(difference).pvalue) if (difference != 0).any() else 1.0
    ours = "image" if np.median(difference) > 0 else "vector"
    evidence = (
        f"image {both[IMAGE].mean():.3f}, vector {both[VECTOR].mean():.3f} of random play's regret; image harder in "
        f"{int((difference > 0).sum())} of {len(difference)} tasks"
    )
    return _row(finding, environment, paper, ours, evidence, p, _verdict(ours == paper, p))


def _verdict(agrees: bool, p: float) -> str:
    if not p < LEVEL:
        return "undecided"
    return "agrees" if agrees else "disagrees"


def _single(found: Models) -> dict[str, Any]:
    from scipy import stats

    finding, paper = "one model explains next to nothing", "R² 0.09, nothing significant"
    fit = found.get("single", "all")
    if fit is None or len(fit.coefficients) < 2:
        return _nothing(finding, "all", paper, "no single model")
    predictors, free = len(fit.coefficients) - 1, fit.num_rows - len(fit.coefficients)
    statistic = fit.r_squared / predictors / ((1 - fit.r_squared) / free) if fit.r_squared < 1 else math.inf
    p = float(stats.f.sf(statistic, predictors, free))
    evidence = f"F({predictors}, {free}) = {statistic:.1f}; R² {fit.cross_validated_r_squared:.2f} for rows not seen"
    return _row(finding, "all", paper, f"R² {fit.r_squared:.2f}", evidence, p, "disagrees" if p < LEVEL else "agrees")


def _nested(found: Models) -> list[dict[str, Any]]:
    single = found.get("single", "all")
    printed = {
        "representation": "R² 0.48 together, 0.09 for one model",
        "class": "R² 0.65 together, 0.09 for one model",
    }
    rows = []
    for model, paper in printed.items():
        finding = f"models by {model} explain more than one"
        parts = [fit for fit in found.fits if fit.model == model]
        if single is None or len(parts) < 2 or sum(fit.num_rows for fit in parts) != single.num_rows:
            rows.append(_nothing(finding, "all", paper, "the single model or some of the others are missing"))
            continue
        rows.append(_more_slopes(finding, paper, single, parts))
    return rows


def _more_slopes(finding: str, paper: str, single: Fit, parts: Sequence[Fit]) -> dict[str, Any]:
    from scipy import stats

    residual = [float(((fit.actual - fit.fitted) ** 2).sum()) for fit in (single, *parts)]
    total = float(((single.actual - single.actual.mean()) ** 2).sum())
    rest, parameters = sum(residual[1:]), sum(len(fit.coefficients) for fit in parts)
    added, free = parameters - len(single.coefficients), single.num_rows - parameters
    if added < 1 or free < 1 or rest <= 0:
        return _nothing(finding, "all", paper, f"{single.num_rows} rows for {parameters} parameters")
    statistic = (residual[0] - rest) / added / (rest / free)
    p = float(stats.f.sf(statistic, added, free))
    ours = f"R² {1 - rest / total:.2f} together, {single.r_squared:.2f} for one model"
    return _row(finding, "all", paper, ours, f"F({added}, {free}) = {statistic:.1f}", p, _verdict(True, p))


def _vectors_explained_better(found: Models, resamples: int) -> dict[str, Any]:
    finding, paper = "hardness explains vectors better than images", "R² 0.6 with vectors, 0.3 with images"
    fits = [found.get("representation", name) for name in (VECTOR, IMAGE)]
    vector, image = fits
    if vector is None or image is None:
        return _nothing(finding, "all", paper, "no models of both representations")
    tasks = sorted(set(vector.tasks) & set(image.tasks))
    if len(tasks) < 10:
        return _nothing(finding, "all", paper, f"{len(tasks)} tasks with both; needs 10")
    places = [np.array([fit.tasks.index(task) for task in tasks]) for fit in (vector, image)]
    rng = np.random.default_rng(0)
    draws = []
    for _ in range(resamples):
        chosen = rng.integers(len(tasks), size=len(tasks))
        one, two = (_r_squared(fit, place[chosen]) for fit, place in zip((vector, image), places, strict=True))
        draws.append(one - two)
    lower, upper = np.nanquantile(draws, [0.025, 0.975])
    verdict = "agrees" if lower > 0 else "disagrees" if upper < 0 else "undecided"
    ours = f"R² {vector.r_squared:.2f} with vectors, {image.r_squared:.2f} with images"
    evidence = f"difference {lower:+.2f} to {upper:+.2f} (95 %, {len(tasks)} tasks resampled)"
    return _row(finding, "all", paper, ours, evidence, math.nan, verdict)


def _r_squared(fit: Fit, rows: np.ndarray) -> float:
    """R2 of the same model fitted to some of the rows; NaN where they are all alike."""
    design, actual = fit.design[rows], fit.actual[rows]
    total = float(((actual - actual.mean()) ** 2).sum())
    coefficients, *_ = np.linalg.lstsq(design, actual, rcond=None)
    return 1 - float(((actual - design @ coefficients) ** 2).sum()) / total if total > 0 else math.nan


def _agreement(cells: "pd.DataFrame") -> dict[str, Any]:
    finding = "DQN and PPO find the same hard"
    paper = f"r = {_PRINTED_AGREEMENT} ({paper_agreement():.2f} by its appendix C)"
    agreed = agreement(cells, "return")
    if agreed is None or agreed[1] < 4:
        return _nothing(finding, "all", paper, "fewer than four cells of both")
    r, number = agreed
    if abs(r) > 1 - 1e-12:
        lower = upper = r
    else:
        spread = 1.959964 / math.sqrt(number - 3)
        lower, upper = (math.tanh(math.atanh(r) + side * spread) for side in (-1, 1))
    verdict = "agrees" if upper >= _PRINTED_AGREEMENT else "disagrees"
    evidence = f"of returns {lower:.2f} to {upper:.2f} (95 %, {number} cells)"
    for regret in ("normalized_regret", "cumulative_regret"):
        if (other := agreement(cells, regret)) is not None:
            evidence += f"; of {regret.replace('_', ' ')} r = {other[0]:.2f}"
    return _row(finding, "all", paper, f"r = {r:.2f}", evidence, math.nan, verdict)
