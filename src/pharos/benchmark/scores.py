"""Scores of an agent: of each task, of each axis with its frontier, and of the core, with intervals over seeds.

The score of a run is 1 minus the mean over its evaluations of the normalised regret (V* - V) / (V* - U), that mean
clipped to [0, 1] as a whole: evaluations are not clipped one by one, and what lies below 0 by rounding becomes 0. Runs
(seeds) alone are replications, and tasks are fixed. All else is a mean over runs, then over tasks of equal weight.

Intervals are Student's t with the standard error over seeds within each task and the degrees of freedom of Welch and
Satterthwaite. The percentile bootstrap of seeds within tasks is too narrow with few seeds: its spread lacks the factor
sqrt(n / (n - 1)) and it has normal quantiles: it covers 89 to 94 % with 10 seeds, t 93 to 97 %, in
docs/evidence/benchmark.md. No random numbers are drawn: equal results give equal intervals, to the last digit.

Source: Agarwal et al. (2021), Deep reinforcement learning at the edge of the statistical precipice, for the
interquartile mean, the optimality gap and the strata.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pharos import statistics
from pharos.errors import ParameterError
from pharos.statistics import UNBOUNDED
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from pharos.benchmark.results import AgentResults
    from pharos.benchmark.suite import Ladder, Suite

CROSSING = 0.5  # normalised regret at the frontier
SOLVED = 1e-6  # normalised regret of a policy that counts as optimal


@dataclass(frozen=True)
class ConfidenceInterval:
    """A value and its 95 % interval over seeds.

    Attributes:
        value: of a frontier that the ladder does not reach: its last or first level.
        low, high: NaN with one seed. An infinite end of a frontier lies beyond the ladder. Also `lower` and `upper`.
        censored: "above" or "below" if the value lies beyond the last or before the first rung, else empty.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    censored: str = ""

    @property
    def lower(self) -> float:
        """Lower end of the interval."""
        return self.low

    @property
    def upper(self) -> float:
        """Upper end of the interval."""
        return self.high

    def to_dict(self) -> dict[str, float]:
        """The value and the ends, for JSON."""
        return {"value": self.value, "lower": self.lower, "upper": self.upper}

    @staticmethod
    def of_mean(strata: Sequence[np.ndarray], bounds: tuple[float, float] = UNBOUNDED) -> "ConfidenceInterval":
        """Mean over tasks of the mean over runs, with Student's interval clipped to `bounds`, or NaN without tasks."""
        return ConfidenceInterval(*statistics.mean_interval(strata, bounds))

    def text(self, *, ends: bool = True) -> str:
        """The value, and its interval if `ends` are wanted and there are some: `9.4 (8.3 to 10.8)`, `> 24 (19.2 or
        more)`.
        """
        sign = {"above": "> ", "below": "< "}.get(self.censored, "")
        text = "not comparable" if math.isnan(self.value) else sign + _digits(self.value)
        if not ends or math.isnan(self.low) or (math.isinf(self.low) and math.isinf(self.high)):
            return text
        if math.isinf(self.low):
            return f"{text} ({_digits(self.high)} or less)"
        return f"{text} ({_digits(self.low)} {'or more' if math.isinf(self.high) else f'to {_digits(self.high)}'})"

    __str__ = text


UNKNOWN_INTERVAL = ConfidenceInterval(math.nan)


def _digits(number: float) -> str:
    return f"{number:.3f}" if abs(number) < 1.0005 else f"{number:.3g}"


@dataclass(frozen=True)
class AxisScore:
    """Result on one ladder.

    Attributes:
        unit: of the frontier.
        score: mean over the rungs, in [0, 1]. Of pairs 1 less the mean loss: the score of the first less the second's.
        frontier: level at which the mean normalised regret crosses 0.5. NaN for pairs, and if one rung alone was run.
        lowest: score on the first rung, or NaN if it was not run.
        fall: `lowest` less the mean score on the rungs above it: what the axis adds to the difficulty of its world.
    """

    axis: str
    unit: str
    score: ConfidenceInterval
    frontier: ConfidenceInterval
    lowest: ConfidenceInterval = field(default=UNKNOWN_INTERVAL)
    fall: ConfidenceInterval = field(default=UNKNOWN_INTERVAL)

    def to_dict(self) -> Mapping[str, Mapping[str, object]]:
        """Score and frontier, for JSON."""
        of_frontier = {"unit": self.unit, "censored": self.frontier.censored}
        return {"score": self.score.to_dict(), "frontier": {**self.frontier.to_dict(), **of_frontier}}


@dataclass(frozen=True)
class BenchmarkScore:
    """All scores of an agent on a suite.

    Attributes:
        core: mean over the tasks of the core of the mean score over the run. NaN if none was run, as the next three.
        final: the same of the last evaluation alone.
        iqm: mean of the middle half of all runs of all core tasks, pooled as in Agarwal et al. (2021).
        optimality_gap: mean over core runs of max(0, regret): 1 - core, but runs below random count in full.
        axes: by axis. tasks: score by name, the core's and the ladders'.
        preliminary: fewer seeds than the suite asks for, 10 of v1, or tasks without results.
        below_random: tasks whose mean normalised regret exceeds 1 by its whole interval.
        missing: tasks of the suite without results, which no score contains.
    """

    core: ConfidenceInterval
    final: ConfidenceInterval
    iqm: ConfidenceInterval
    optimality_gap: ConfidenceInterval
    axes: Mapping[str, AxisScore]
    tasks: Mapping[str, ConfidenceInterval]
    preliminary: bool
    below_random: tuple[str, ...]
    missing: tuple[str, ...] = field(default=())

    @property
    def has_core(self) -> bool:
        """Whether a task of the core was run."""
        return not math.isnan(self.core.value)

    @property
    def rank(self) -> tuple[bool, float]:
        """Sort key of boards: the best core score first, agents without one last."""
        return not self.has_core, -self.core.value


def score(results: "AgentResults", suite: "Suite") -> BenchmarkScore:
    """Return the scores of an agent's results on a suite. The optimal policy scores 1 and uniform play 0.

    Raises:
        ParameterError: the results belong to another suite.
    Cost: milliseconds.
    """
    check_suite(results, suite)
    seeds, results = len(results.seeds), as_one_run(results)
    runs, finals, regrets = run_scores(results), run_scores(results, last=True), run_regrets(results)
    core = sorted(task.name for task in suite.core if task.name in runs)
    names = sorted(task.name for task in suite.tasks if task.name in runs)
    missing = tuple(task.name for task in suite.tasks if task.name not in runs)
    regret_intervals = {name: ConfidenceInterval.of_mean([regrets[name]]) for name in names}
    return BenchmarkScore(
        core=ConfidenceInterval.of_mean([runs[name] for name in core], (0.0, 1.0)),
        final=ConfidenceInterval.of_mean([finals[name] for name in core], (0.0, 1.0)),
        iqm=ConfidenceInterval(*statistics.interquartile_interval([runs[name] for name in core], (0.0, 1.0))),
        optimality_gap=ConfidenceInterval.of_mean([np.maximum(regrets[name], 0.0) for name in core], (0.0, math.inf)),
        axes={ladder.axis: axis for ladder in suite.ladders if (axis := axis_score(ladder, runs)) is not None},
        tasks={name: ConfidenceInterval.of_mean([runs[name]], (0.0, 1.0)) for name in names},
        preliminary=seeds < suite.protocol.seeds or bool(missing),
        below_random=tuple(name for name in names if regret_intervals[name].low > 1.0),
        missing=missing,
    )


def axis_score(ladder: "Ladder", runs: Mapping[str, np.ndarray]) -> AxisScore | None:
    """Return score and frontier over the rungs that have runs, or None if none has.

    Args:
        runs: task name -> (seeds,) scores of its runs.
    """
    weights = ladder.weights(runs)
    if not weights:
        return None
    rungs = [task for task in ladder.tasks if task.name in weights]
    own = [runs[task.name] for task in rungs]
    if ladder.pairs:
        return AxisScore(ladder.axis, ladder.unit, _contrast(own, list(weights.values()), 1.0), UNKNOWN_INTERVAL)
    levels = np.array([task.level for task in rungs], np.float64)
    several = len(rungs) > 1
    return AxisScore(
        ladder.axis,
        ladder.unit,
        ConfidenceInterval.of_mean(own, (0.0, 1.0)),
        frontier(levels, [1.0 - x for x in own]) if several else UNKNOWN_INTERVAL,
        *((ConfidenceInterval.of_mean(own[:1], (0.0, 1.0)), _fall(own)) if rungs[0] is ladder.tasks[0] else ()),
    )


def _fall(rungs: Sequence[np.ndarray]) -> ConfidenceInterval:
    """Mean on the first rung less the mean over the others, with Student's interval, or NaN with one rung."""
    if len(rungs) < 2:
        return UNKNOWN_INTERVAL
    return _contrast(rungs, [1.0, *[-1.0 / (len(rungs) - 1)] * (len(rungs) - 1)])


def _contrast(strata: Sequence[np.ndarray], weights: Sequence[float], constant: float = 0.0) -> ConfidenceInterval:
    """A constant and the weighted sum of means over runs, with Student's interval."""
    value = constant + float(sum(weight * own.mean() for weight, own in zip(weights, strata, strict=True)))
    return ConfidenceInterval(*statistics.student_interval(value, *statistics.standard_error(strata, weights)))


def check_suite(results: "AgentResults", suite: "Suite", source: str = "") -> None:
    """Refuse results of another suite, by name.

    Args:
        source: the file that they come from, for messages.
    Raises:
        ParameterError: the digest is another one, or there are curves of tasks that are not in the suite.
    """
    if results.digest != suite.digest:
        raise ParameterError(
            f"{f'{source}: ' * bool(source)}results of {results.agent} are of suite {results.suite} with digest "
            f"{results.digest[:12]}; expected {suite.name} with {suite.digest[:12]}: run the agent on that suite, or "
            f"name its suite (--suite)"
        )
    if unknown := sorted({*results.curves} - {task.name for task in suite.tasks}):
        raise ParameterError(
            f"{source or f'results of {results.agent}'}: curves of {unknown[0]!r}, which is no task of suite "
            f"{suite.name}"
        )


def equal_seeds(curves: Mapping[str, np.ndarray]) -> str:
    """A sentence if all seeds have equal curves on more than a third of the tasks on which any run learns, else "".

    A task does not count if all runs go from the first regret to 0 at once: sound runs have equal curves there.
    """
    several = [curve for curve in curves.values() if len(curve) > 1 and _shows_learning(curve)]
    equal = sum((curve == curve[0]).all() for curve in several)
    if not several or equal <= len(several) / 3:
        return ""
    return (
        f"all seeds have the same curve on {equal} of {pluralize(len(several), 'task')}, so intervals over seeds say "
        f"nothing; expected learn to use its seed: random numbers, weights, the first reset"
    )


def _shows_learning(curve: np.ndarray) -> bool:
    """Whether a run (seeds, evaluations) has a regret besides the first one and 0."""
    return bool(((curve != curve[:1, :1]) & (np.abs(curve) > SOLVED)).any())


def has_equal_seeds(results: "AgentResults") -> bool:
    """Whether the seeds are one run, by `equal_seeds`. False if no run learns, as with a fixed policy."""
    return bool(equal_seeds(results.curves))


def as_one_run(results: "AgentResults") -> "AgentResults":
    """The results. If their seeds are one run, their mean as a single one, so that nothing has an interval."""
    if not has_equal_seeds(results):
        return results
    curves = {name: curve.mean(axis=0, keepdims=True) for name, curve in results.curves.items()}
    return replace(results, seeds=results.seeds[:1], curves=curves)


def run_regrets(results: "AgentResults", *, last: bool = False) -> dict[str, np.ndarray]:
    """Return for each task the normalised regret of its runs, (seeds,): mean over evaluations, or at the last one."""
    return {name: curves[:, -1] if last else curves.mean(axis=1) for name, curves in results.curves.items()}


def run_scores(results: "AgentResults", *, last: bool = False) -> dict[str, np.ndarray]:
    """Return for each task the scores of its runs, (seeds,) in [0, 1]: 1 minus the clipped regret of `run_regrets`."""
    return {name: 1.0 - np.clip(regret, 0.0, 1.0) for name, regret in run_regrets(results, last=last).items()}


# Frontier -------------------------------------------------------------------------------------------------------------


def frontier(levels: np.ndarray, regrets: Sequence[np.ndarray]) -> ConfidenceInterval:
    """Return the level at which mean normalised regret crosses 0.5, linear between rungs, with its interval.

    Means over seeds are made increasing along the rungs (isotonic regression, equal weights). The interval holds the
    levels at which Student's interval of the mean, interpolated between two rungs, contains 0.5 (Fieller), with limits
    that increase as the mean does: a noisy rung opens no interval that rungs below it exclude.

    Args:
        levels: (R,) increasing. regrets: for each rung the mean regret of its runs in [0, 1].
    Returns:
        Censored "above" with the last level if even that rung stays below 0.5, "below" with the first one if that
        exceeds it. An end of the interval beyond the ladder is infinite.
    """
    from scipy.optimize import isotonic_regression

    # The level at which increasing means cross 0.5
    means = np.array([own.mean() for own in regrets])
    value, censored = _crossing(levels, isotonic_regression(means).x)
    low, high = statistics.fieller_interval(levels, regrets, CROSSING)
    if math.isnan(low):
        return ConfidenceInterval(value, censored=censored)
    return ConfidenceInterval(value, min(low, value), max(high, value), censored)


def _crossing(levels: np.ndarray, regrets: np.ndarray) -> tuple[float, str]:
    """First level at which increasing regrets reach 0.5, and how it is censored."""
    if regrets[0] > CROSSING:
        return float(levels[0]), "below"
    crossing = int(np.searchsorted(regrets, CROSSING))
    if crossing == len(regrets):
        return float(levels[-1]), "above"
    if crossing == 0:
        return float(levels[0]), ""
    below, above = regrets[crossing - 1 : crossing + 1]
    return float(np.interp(CROSSING, (below, above), levels[crossing - 1 : crossing + 1])), ""
