"""The paper's findings in words, each tested on the data of a study."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import helmert

from pharos.agents import TABULAR_OBSERVATION
from pharos.statistics import bootstrap_interval, r_squared
from pharos.study.analysis import IMAGE, VECTOR, Models, agreement, paper_agreement
from pharos.study.regression import Fit
from pharos.system.wording import in_words

if TYPE_CHECKING:
    import pandas as pd

SIGNIFICANCE_LEVEL = 0.05  # of every test; each stands alone, without a correction for their number
FINDING_COLUMNS = ["finding", "of", "paper", "ours", "evidence", "effect", "lower", "upper", "p", "power", "verdict"]
# By the paper's sections 4.2 and 4.1
_HARDER = {"simple_grid": "image", "frozen_lake": "image", "breakout": "vector", "freeway": "vector"}
_OBSERVATIONS = {"image": ("dqn", IMAGE), "vector": ("dqn", VECTOR)}
_SLOWER = {"simple_grid": "DQN", "frozen_lake": "DQN", "breakout": "table", "freeway": "table"}
_FINDING_LEARNERS = {"table": ("q_learning", TABULAR_OBSERVATION), "DQN": ("dqn", VECTOR)}
_PRINTED_AGREEMENT = 0.81
# R2 that the paper prints: of one model, of those by representation and by class together, with vectors and with images
_PRINTED_R2 = {"single": 0.09, "representation": 0.48, "class": 0.65, "vector": 0.6, "image": 0.3}
# In units of random play's regret: the paper prints no sizes of this, and less would be of no consequence
SMALLEST_DIFFERENCE = 0.05
NORMAL = 1.959964  # the 97.5th percentile of the normal distribution
Effect = tuple[float, float, float]  # with the ends of its 95 % interval


def findings(cells: "pd.DataFrame", models: Models, *, resamples: int = 1000) -> "pd.DataFrame":
    """Return the findings of the paper's sections 4.1 to 4.3 and appendix C beside what the data say.

    A task is an instance under one kind of chance. Every test counts it once, whatever the number of its observations.

    - Which observation costs DQN more regret, for each class: the normalised regret of both on the same tasks,
      Wilcoxon's signed-rank test, two-sided. Likewise, whether a table or DQN with vectors has more regret. The effect
      is the difference by Hodges and Lehmann, image less vector and table less DQN, with the interval of the test.
    - One linear model of all explains next to nothing: the F test of class and measures on the means of the tasks over
      observations. If it is significant, the verdict adds "mostly by class" if class and representation alone
      explain more than half of R2, and the evidence tests what the measures add.
    - Models by representation explain more: the F test of class and measures on the differences within tasks. Models
      by class explain more: the F test of their slopes on the means of the tasks. The single model is nested in both.
      The effect of an F test is the share of what the smaller model leaves that the larger one explains.
    - Hardness explains regret better with vectors than with images: the difference of R2, tasks resampled, 95 %
      percentile interval.
    - DQN and PPO agree: Pearson's r of their mean returns over cells, with Fisher's interval.

    Args:
        cells: as from `cells`.
        models: of DQN's cumulative regret.
    Returns:
        One row a finding: what the paper says, ours, the statistic in words, the effect and the ends of its 95 %
        interval, p-value (NaN if an interval decides), the power, and the verdict: "agrees" or "disagrees" if
        the test is significant at 0.05, "undecided" if it is not, "no data".
        The power is the probability that these tasks find the effect, at 0.05, if it is as large as the paper
        prints: its R2 for the F tests, its r, its difference of R2. For observations, whose sizes it does not print, a
            difference of SMALLEST_DIFFERENCE. "undecided" with little power says nothing against the paper.
    Cost: `resamples` small regressions.
    """
    import pandas as pd

    rows = [
        _compared(cells, "the harder observation of DQN", environment, harder, _OBSERVATIONS)
        for environment, harder in _HARDER.items()
    ]
    rows += [
        _compared(cells, "the learner with more regret", environment, slower, _FINDING_LEARNERS)
        for environment, slower in _SLOWER.items()
    ]
    rows += [_single(models), *_nested(models), _vectors_explained_better(models, resamples), _agreement(cells)]
    return pd.DataFrame(rows, columns=FINDING_COLUMNS)


def _row(
    finding: str,
    of: str,
    paper: str,
    ours: str,
    evidence: str,
    p: float,
    verdict: str,
    power: float = math.nan,
    effect: Effect = (math.nan, math.nan, math.nan),
) -> dict[str, Any]:
    return dict(zip(FINDING_COLUMNS, (finding, of, paper, ours, evidence, *effect, p, power, verdict), strict=True))


def _power_of_mean(effect: float, deviation: float, number: int) -> float:
    """Probability that a two-sided test at LEVEL finds a mean difference. Ranks need pi / 3 as many normal values."""
    from scipy import stats

    if number < 2:
        return math.nan
    if deviation == 0:
        return 1.0
    shift = effect / deviation * math.sqrt(number * 3 / math.pi)
    return float(stats.norm.sf(NORMAL - shift) + stats.norm.cdf(-NORMAL - shift))


def _power_of_f(added: int, free: int, r_squared: float, without: float = 0.0) -> float:
    """Probability that an F test at LEVEL finds parameters that raise R2 from `without` to `r_squared`.

    Source: Cohen (1988), Statistical power analysis, chapter 9: f2 (u + v + 1) is the noncentrality.
    """
    from scipy import stats

    shift = (r_squared - without) / (1 - r_squared) * (added + free + 1)
    if shift <= 0:
        return SIGNIFICANCE_LEVEL
    return float(stats.ncf.sf(stats.f.isf(SIGNIFICANCE_LEVEL, added, free), added, free, shift))


def _nothing(finding: str, of: str, paper: str, why: str) -> dict[str, Any]:
    return _row(finding, of, paper, "", why, math.nan, "no data")


def _compared(
    cells: "pd.DataFrame", finding: str, environment: str, paper: str, sides: Mapping[str, tuple[str, str]]
) -> dict[str, Any]:
    """Finding on which of two pairs of agent and observation, in `sides`, has more regret on the tasks of a class."""
    part = cells[cells["environment"] == environment]
    wide = part.pivot_table(index=["instance", "chance"], columns=["agent", "observation"], values="normalized_regret")
    (first, one), (second, other) = sides.items()
    if not {one, other} <= set(wide.columns) or len(both := wide[[one, other]].dropna()) == 0:
        return _nothing(finding, environment, paper, "no task with both")
    difference = both[one].to_numpy(float) - both[other].to_numpy(float)
    effect, p = _signed_ranks(difference)
    ours = first if effect[0] > 0 else second
    evidence = (
        f"{first} {both[one].mean():.3f}, {second} {both[other].mean():.3f} of random play's regret; {first} harder in "
        f"{int((difference > 0).sum())} of {len(difference)} tasks"
    )
    power = _power_of_mean(SMALLEST_DIFFERENCE, float(difference.std(ddof=1)), len(difference)) if p < 1 else math.nan
    return _row(finding, environment, paper, ours, evidence, p, _verdict(ours == paper, p), power, effect)


def _signed_ranks(differences: np.ndarray) -> tuple[Effect, float]:
    """The estimate by Hodges and Lehmann of paired differences, its interval, and the two-sided p-value of Wilcoxon's
    signed-rank test, by the exact distribution without ties. Averages of two differences that are 0 count as evidence
    for either side, so the interval holds 0 if p >= LEVEL, and everything with fewer than six differences.

    Source: Hollander, Wolfe and Chicken (2014), Nonparametric statistical methods, sections 3.1 to 3.3.
    """
    first, second = np.triu_indices(len(differences))
    averages = np.sort((differences[first] + differences[second]) / 2)
    chances = np.ones(1)  # probabilities of each sum of the positive ranks under the null hypothesis
    for rank in range(1, len(differences) + 1):
        chances = (np.pad(chances, (0, rank)) + np.pad(chances, (rank, 0))) / 2
    tail = np.cumsum(chances)
    excluded = int((tail <= SIGNIFICANCE_LEVEL / 2).sum())
    ends = (averages[excluded - 1], averages[-excluded]) if excluded else (-math.inf, math.inf)
    p = min(1.0, 2 * float(tail[min((averages >= 0).sum(), (averages <= 0).sum())]))
    return (float(np.median(averages)), float(ends[0]), float(ends[1])), p


def _verdict(agrees: bool, p: float) -> str:
    if not p < SIGNIFICANCE_LEVEL:
        return "undecided"
    return "agrees" if agrees else "disagrees"


@dataclass(frozen=True)
class _Tasks:
    """The rows of a fit by task: T tasks that have all R observations.

    Attributes:
        names: of the tasks.
        regrets: (T, R).
        design: (T, P) predictors that belong to a task, the intercept first. Predictors of observations are left out.
        class_design: the first columns of that, without the measures of hardness.
    """

    names: tuple[str, ...]
    regrets: np.ndarray
    design: np.ndarray
    class_design: np.ndarray

    @property
    def means(self) -> np.ndarray:
        """(T,) means over observations."""
        return self.regrets.mean(axis=1)

    @property
    def contrasts(self) -> np.ndarray:
        """(T, R - 1) differences between observations, by orthonormal contrasts."""
        return self.regrets @ helmert(self.regrets.shape[1]).T


def _tasks(fit: Fit) -> _Tasks:
    names = fit.tasks or tuple(map(str, range(fit.num_rows)))
    observations = sorted(set(fit.observations)) or [""]
    rows = {key: row for row, key in enumerate(zip(names, fit.observations or [""] * len(names), strict=True))}
    complete = [name for name in dict.fromkeys(names) if all((name, each) in rows for each in observations)]
    row_numbers = np.array([[rows[name, each] for each in observations] for name in complete], int).reshape(
        -1, len(observations)
    )
    columns = [str(name) for name in fit.coefficients.index]
    of_task = [i for i, name in enumerate(columns) if not name.startswith("C(observation)")]
    of_class = [i for i in of_task if not columns[i].startswith("np.log(")]
    first = row_numbers[:, 0]
    return _Tasks(
        tuple(complete), fit.actual[row_numbers], fit.design[first][:, of_task], fit.design[first][:, of_class]
    )


def _rest(design: np.ndarray, values: np.ndarray) -> float:
    """The residual sum of squares of least squares."""
    return float(((values - design @ np.linalg.lstsq(design, values, rcond=None)[0]) ** 2).sum())


def _f_test(small: float, large: float, added: int, free: int) -> tuple[float, float]:
    """F and p of `added` parameters that leave `large` of a sum of squares `small`, with `free` degrees of freedom."""
    from scipy import stats

    statistic = (small - large) / added / (large / free) if large > 0 else math.inf
    return statistic, float(stats.f.sf(statistic, added, free))


def _share(statistic: float, added: int, free: int) -> Effect:
    """Effect of an F test: the share of the smaller model's residual squares that the larger one explains. Its interval
    follows from the interval of the noncentrality.

    Source: Steiger (2004), Beyond the F test, with f2 (u + v + 1) as the noncentrality.
    """
    from scipy import optimize, stats

    if not math.isfinite(statistic):
        return 1.0, 1.0, 1.0

    def end(probability: float) -> float:
        def excess(shift: float) -> float:
            return float(stats.ncf.cdf(statistic, added, free, shift)) - probability

        if stats.f.cdf(statistic, added, free) <= probability:
            return 0.0
        highest = 1.0
        while excess(highest) > 0:
            highest *= 2
        shift = float(optimize.brentq(excess, 0.0, highest))
        return shift / (shift + added + free + 1)

    return added * statistic / (added * statistic + free), end(1 - SIGNIFICANCE_LEVEL / 2), end(SIGNIFICANCE_LEVEL / 2)


def _single(models: Models) -> dict[str, Any]:
    finding, paper = "one model explains next to nothing", "R² 0.09, nothing significant"
    fit = models.get("single", "all")
    if fit is None or len(fit.coefficients) < 2:
        return _nothing(finding, "all", paper, "no single model")
    tasks = _tasks(fit)
    number, parameters = tasks.design.shape
    if parameters < 2 or number <= parameters:
        return _nothing(finding, "all", paper, f"{number} tasks for {parameters} parameters")
    means = tasks.means
    total, large = _rest(tasks.design[:, :1], means), _rest(tasks.design, means)
    statistic, p = _f_test(total, large, parameters - 1, number - parameters)
    evidence = f"F({parameters - 1}, {number - parameters}) = {statistic:.1f} of task means"
    evidence += f"; R² {fit.cross_validated_r_squared:.2f} for tasks not seen"
    verdict = "agrees"
    if p < SIGNIFICANCE_LEVEL:
        verdict = "disagrees"
        by_class = models.class_alone
        if by_class is not None and by_class > fit.r_squared / 2:
            verdict += ", mostly by class"
        if by_class is not None and (measures := parameters - tasks.class_design.shape[1]):
            added, p_added = _f_test(_rest(tasks.class_design, means), large, measures, number - parameters)
            evidence += f"; class and representation alone {by_class:.2f}, measures add {fit.r_squared - by_class:.2f} "
            evidence += f"(F({measures}, {number - parameters}) = {added:.1f}, p = {p_added:.1g})"
    power = _power_of_f(parameters - 1, number - parameters, _PRINTED_R2["single"])
    effect = _share(statistic, parameters - 1, number - parameters)
    return _row(finding, "all", paper, f"R² {fit.r_squared:.2f}", evidence, p, verdict, power, effect)


def _nested(models: Models) -> list[dict[str, Any]]:
    single = models.get("single", "all")
    printed = {
        "representation": "R² 0.48 together, 0.09 for one model",
        "class": "R² 0.65 together, 0.09 for one model",
    }
    rows = []
    for model, paper in printed.items():
        finding = f"models by {model} explain more than one"
        parts = [fit for fit in models.fits if fit.model == model]
        if single is None or len(parts) < 2 or sum(fit.num_rows for fit in parts) != single.num_rows:
            rows.append(_nothing(finding, "all", paper, "the single model or some of the others are missing"))
            continue
        rows.append(_more_slopes(finding, paper, model, single, parts))
    return rows


def _more_slopes(finding: str, paper: str, model: str, single: Fit, parts: Sequence[Fit]) -> dict[str, Any]:
    """The F test of slopes of their own for each part, a task counted once."""
    tasks = _tasks(single)
    number, parameters = tasks.design.shape
    if model == "representation":  # slopes differ between observations: the differences within tasks depend on the task
        columns, of = tasks.contrasts.shape[1], "of differences within tasks"
        small, large = _rest(tasks.design[:, :1], tasks.contrasts), _rest(tasks.design, tasks.contrasts)
        added, free = (parameters - 1) * columns, (number - parameters) * columns
    else:
        of = "of task means"
        small, large = _rest(tasks.design, tasks.means), 0.0
        added, free = -parameters, number
        of_parts = [_tasks(part) for part in parts]
        if sum(len(part.names) for part in of_parts) != number:
            return _nothing(finding, "all", paper, "some tasks lack an observation that others have")
        for part in of_parts:
            large += _rest(part.design, part.means)
            added, free = added + part.design.shape[1], free - part.design.shape[1]
    if added < 1 or free < 1 or large <= 0:
        return _nothing(finding, "all", paper, f"{number} tasks are too few for so many parameters")
    statistic, p = _f_test(small, large, added, free)
    rest = sum(float(((fit.actual - fit.fitted) ** 2).sum()) for fit in parts)
    total = float(((single.actual - single.actual.mean()) ** 2).sum())
    ours = f"R² {1 - rest / total:.2f} together, {single.r_squared:.2f} for one model"
    power = _power_of_f(added, free, _PRINTED_R2[model], _PRINTED_R2["single"])
    evidence, verdict = f"F({added}, {free}) = {statistic:.1f} {of}", _verdict(True, p)
    return _row(finding, "all", paper, ours, evidence, p, verdict, power, _share(statistic, added, free))


def _vectors_explained_better(models: Models, resamples: int) -> dict[str, Any]:
    finding, paper = "hardness explains vectors better than images", "R² 0.6 with vectors, 0.3 with images"
    vector, image = (models.get("representation", name) for name in (VECTOR, IMAGE))
    if vector is None or image is None:
        return _nothing(finding, "all", paper, "no models of both representations")
    tasks = sorted(set(vector.tasks) & set(image.tasks))
    if len(tasks) < 10:
        return _nothing(finding, "all", paper, f"{len(tasks)} tasks with both; needs 10")
    vectors, images = (np.array([fit.tasks.index(task) for task in tasks]) for fit in (vector, image))

    def difference(drawn: np.ndarray, axis: int) -> np.ndarray:  # noqa: ARG001  (SciPy gives it, always the last)
        draws = drawn.astype(int).reshape(-1, drawn.shape[-1])
        values = [_r_squared(vector, vectors[draw]) - _r_squared(image, images[draw]) for draw in draws]
        return np.nan_to_num(np.array(values)).reshape(drawn.shape[:-1])

    ends = bootstrap_interval([np.arange(len(tasks))], difference, resamples=resamples)
    lower, upper = map(float, ends)
    value = float(difference(np.arange(len(tasks)), 0))
    verdict = "agrees" if min(value, lower) > 0 else "disagrees" if max(value, upper) < 0 else "undecided"
    ours = f"R² {vector.r_squared:.2f} with vectors, {image.r_squared:.2f} with images"
    evidence = f"difference {lower:+.2f} to {upper:+.2f} (95 %, {len(tasks)} tasks resampled)"
    error = (upper - lower) / (2 * NORMAL)
    printed = _PRINTED_R2["vector"] - _PRINTED_R2["image"]
    power = _power_of_error(printed, error)
    return _row(finding, "all", paper, ours, evidence, math.nan, verdict, power, (value, lower, upper))


def _power_of_error(effect: float, error: float) -> float:
    """Probability that an interval of 95 % whose ends are NORMAL errors away does not hold 0."""
    from scipy import stats

    return float(stats.norm.sf(NORMAL - effect / error)) if error > 0 else 1.0


def _r_squared(fit: Fit, rows: np.ndarray) -> float:
    """R2 of the same model fitted to some of the rows, or NaN if they are all alike."""
    design, actual = fit.design[rows], fit.actual[rows]
    coefficients, *_ = np.linalg.lstsq(design, actual, rcond=None)
    return r_squared(actual, actual - design @ coefficients)


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
        spread = NORMAL / math.sqrt(number - 3)
        lower, upper = (math.tanh(math.atanh(r) + side * spread) for side in (-1, 1))
    verdict = "agrees" if upper >= _PRINTED_AGREEMENT else "disagrees"
    evidence = f"of returns {lower:.2f} to {upper:.2f} (95 %, {number} cells)"
    for regret in ("normalized_regret", "cumulative_regret"):
        if (other := agreement(cells, regret)) is not None:
            evidence += f"; of {in_words(regret)} r = {other[0]:.2f}"
    power = _power_of_error(math.atanh(_PRINTED_AGREEMENT), 1 / math.sqrt(number - 3))
    return _row(finding, "all", paper, f"r = {r:.2f}", evidence, math.nan, verdict, power, (r, lower, upper))
