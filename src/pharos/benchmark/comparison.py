"""Comparisons of two agents on a suite, and how many seeds a difference needs.

All differences are of the first agent less the second. A p-value belongs to Welch's t over seeds within tasks, as the
interval does: the interval excludes 0 if p < 0.05. Holm's correction covers the axes, and for themselves the tasks. The
core is one question and stands alone.

Source: Newcombe (1998), Interval estimation for the difference between independent proportions, for differences of
frontiers. For the others see `pharos.statistics`.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pharos.benchmark.results import AgentResults
from pharos.benchmark.scores import (
    ConfidenceInterval,
    as_one_run,
    axis_score,
    check_suite,
    equal_seeds,
    has_equal_seeds,
    run_scores,
)
from pharos.benchmark.suite import Suite, load_suite, shipped_suites
from pharos.errors import ParameterError
from pharos.statistics import (
    CONFIDENCE,
    holm,
    improvement_error,
    mean_of_means,
    probability_of_improvement,
    standard_error,
    student_interval,
    welch_p_value,
)

SIGNIFICANCE = 1.0 - CONFIDENCE
POWER = 0.8
SEEDS = (3, 5, 10, 20)
MOST_SEEDS = 100_000
LEAST_DIFFERENCE = 0.02  # a difference of scores that matters
BETTER, WORSE, NOT_SHOWN_TO_DIFFER, ONE_SEED = "better", "worse", "not shown to differ", "one seed"
NEGLIGIBLE = f"less than {LEAST_DIFFERENCE:g} apart"
EQUAL_SEEDS = "equal seeds"


@dataclass(frozen=True)
class Difference:
    """Difference of two agents' mean scores.

    Attributes:
        ours, theirs: the scores, in [0, 1].
        interval: first agent less second, with its 95 % interval. Its ends are NaN if one of them has one seed.
        improvement: how probable it is that a run of the first scores higher, ties half, mean over the tasks.
        p_value: two-sided, or NaN with one seed.
        adjusted: the same after Holm's correction in its family.
        verdict: "better" or "worse" if adjusted < 0.05 and the scores are 0.02 apart or more; "less than 0.02 apart"
            if they are not. Otherwise "not shown to differ". Without a p-value "one seed", or "equal seeds" if the
            seeds of one agent are one run.
    """

    ours: float
    theirs: float
    interval: ConfidenceInterval
    improvement: ConfidenceInterval
    p_value: float
    adjusted: float
    verdict: str


@dataclass(frozen=True)
class AxisComparison:
    """Difference on one ladder: of the scores, and of the frontiers in the ladder's unit.

    Attributes:
        frontiers: first agent's and second's.
        frontier: their difference: NaN if both lie beyond the same end, a bound ("above", "below") if one does.
    """

    axis: str
    unit: str
    score: Difference
    frontiers: tuple[ConfidenceInterval, ConfidenceInterval]
    frontier: ConfidenceInterval


@dataclass(frozen=True)
class Comparison:
    """One agent against another on the tasks that both have run.

    Attributes:
        ours, theirs: labels. core: None if no core task is common to both.
        axes: by axis. tasks: by name.
        left_out: tasks of the suite that one of them lacks, which nothing here contains.
    """

    ours: str
    theirs: str
    core: Difference | None
    axes: Mapping[str, AxisComparison]
    tasks: Mapping[str, Difference]
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class Power:
    """Precision of a score, and of its comparison with an agent that varies as much.

    Attributes:
        standard_error: over the seeds that there are.
        least_differences: number of seeds -> least difference that is found with power 0.8.
        seeds_needed: of each agent, for the difference that was asked for. None if none was, or beyond 100,000.
    """

    standard_error: float
    least_differences: Mapping[int, float]
    seeds_needed: int | None


def compare(
    ours: AgentResults | Path | str, theirs: AgentResults | Path | str, *, suite: Suite | str | None = None
) -> Comparison:
    """Return per task, per axis and for the core how two agents differ.

    Args:
        ours, theirs: results, a folder or file of them, or the name of a shipped baseline.
        suite: the one that `ours` was run on, if that is not shipped.
    Raises:
        ParameterError: the suites' digests differ, or no task is common to both.
    Cost: milliseconds.
    """
    ours, theirs = results_of(ours), results_of(theirs)
    suite = suite_of_results(ours, suite)
    for each in (ours, theirs):
        check_suite(each, suite)
    # Scores of the tasks that both have run
    unknown = EQUAL_SEEDS if has_equal_seeds(ours) or has_equal_seeds(theirs) else ONE_SEED
    x, y = run_scores(as_one_run(ours)), run_scores(as_one_run(theirs))
    common = [task.name for task in suite.tasks if task.name in x and task.name in y]
    if not common:
        raise ParameterError(
            f"{ours.agent} and {theirs.agent} have no task of {suite.name} in common; run one for both"
        )
    left_out = tuple(task.name for task in suite.tasks if task.name not in common)
    x, y = ({name: runs[name] for name in common} for runs in (x, y))
    # Differences on the core and on each ladder
    core = sorted(task.name for task in suite.core if task.name in common)
    axes, differences = {}, {}
    for ladder in suite.ladders:
        mine, other = axis_score(ladder, x), axis_score(ladder, y)
        if mine is not None and other is not None:
            axes[ladder.axis] = mine.frontier, other.frontier
            weights = ladder.weights(common)
            differences[ladder.axis] = _difference(x, y, sorted(weights), weights if ladder.pairs else None)
    units = {ladder.axis: ladder.unit for ladder in suite.ladders}
    return Comparison(
        ours.agent,
        theirs.agent,
        _judged({"": _difference(x, y, core)}, unknown)[""] if core else None,
        {
            axis: AxisComparison(axis, units[axis], each, axes[axis], frontier_difference(*axes[axis]))
            for axis, each in _judged(differences, unknown).items()
        },
        _judged({name: _difference(x, y, [name]) for name in common}, unknown),
        left_out,
    )


def compare_groups(
    ours: AgentResults, theirs: AgentResults, groups: Mapping[str, Sequence[str]]
) -> dict[str, Difference]:
    """The difference of the mean scores on each group of tasks, with Holm's correction over the groups.

    Args:
        ours, theirs: results on one suite.
        groups: name -> names of tasks. Tasks that one of them lacks are left out, and so are groups without a task.
    """
    unknown = EQUAL_SEEDS if has_equal_seeds(ours) or has_equal_seeds(theirs) else ONE_SEED
    x, y = run_scores(as_one_run(ours)), run_scores(as_one_run(theirs))
    common = {group: [name for name in names if name in x and name in y] for group, names in groups.items()}
    return _judged({group: _difference(x, y, names) for group, names in common.items() if names}, unknown)


def power(
    results: AgentResults | Path | str, *, suite: Suite | str | None = None, difference: float | None = None
) -> dict[str, Power]:
    """Return the precision of the score and the detectable difference, for the core ("core") and each axis.

        t = difference / se,  se^2 = 2 sum of w_t^2 s_t^2 / n: noncentral t with power 0.8 at a level of 0.05

    Args:
        results, suite: as for `compare`.
        difference: of scores, to be found with power 0.8.
    Raises:
        ParameterError: fewer than two seeds, seeds that are one run, a difference that is not positive, or another
            suite.
    """
    results = results_of(results)
    suite = suite_of_results(results, suite)
    check_suite(results, suite)
    if has_equal_seeds(results):
        raise ParameterError(
            f"results of {results.agent}: {equal_seeds(results.curves)}; expected runs that differ, to see how they "
            f"vary"
        )
    if len(results.seeds) < 2:
        raise ParameterError(f"results of {results.agent} have one seed; expected two or more, to see how seeds vary")
    if difference is not None and not difference > 0:
        raise ParameterError(f"difference {difference}; expected a number above 0, such as 0.05")
    runs = run_scores(results)
    core = [task.name for task in suite.core if task.name in runs]
    families = {"core": {name: 1.0 / len(core) for name in core}}
    families |= {ladder.axis: ladder.weights(runs) for ladder in suite.ladders}
    scores = {}
    for family, weights in families.items():
        if weights:
            variances = np.array([np.var(runs[name], ddof=1) * weight**2 for name, weight in weights.items()])
            least = {number: float(least_difference(variances, number)) for number in SEEDS}
            error = math.sqrt(variances.sum() / len(results.seeds))
            scores[family] = Power(error, least, None if difference is None else _seeds_for(variances, difference))
    return scores


def least_difference(variances: np.ndarray, seeds: int) -> float:
    """Return the least difference of two agents that Welch's t finds with power 0.8 at a level of 0.05.

    Args:
        variances: (T,) for each task w_t^2 s_t^2, of a run of either agent.
        seeds: of each agent, two or more.
    """
    from scipy.special import nctdtrinc, stdtrit

    total = variances.sum()
    if total == 0.0:
        return 0.0
    degrees = 2.0 * (seeds - 1) * total**2 / (variances**2).sum()
    return float(nctdtrinc(degrees, 1.0 - POWER, stdtrit(degrees, 1.0 - SIGNIFICANCE / 2))) * math.sqrt(
        2 * total / seeds
    )


def frontier_difference(ours: ConfidenceInterval, theirs: ConfidenceInterval) -> ConfidenceInterval:
    """Return the difference of two frontiers, with the interval that follows from theirs (Newcombe's, or MOVER).

    low = d - sqrt((v1 - l1)^2 + (u2 - v2)^2),   high = d + sqrt((u1 - v1)^2 + (v2 - l2)^2)
    """
    if ours.censored and ours.censored == theirs.censored:
        return ConfidenceInterval(math.nan, -math.inf, math.inf, ours.censored)
    value = ours.value - theirs.value
    low = value - math.hypot(ours.value - ours.low, theirs.high - theirs.value)
    high = value + math.hypot(ours.high - ours.value, theirs.value - theirs.low)
    above = ours.censored == "above" or theirs.censored == "below"
    return ConfidenceInterval(
        value, low, high, "above" if above else "below" if ours.censored or theirs.censored else ""
    )


def _difference(
    x: Mapping[str, np.ndarray],
    y: Mapping[str, np.ndarray],
    names: Sequence[str],
    pair_weights: Mapping[str, float] | None = None,
) -> Difference:
    """Difference of mean scores. With weights of pairs, the difference of 1 less what the second tasks lose.

    The improvement of pairs is that on their second tasks.
    """
    one, other = [x[name] for name in names], [y[name] for name in names]
    weights = [1.0 / len(names)] * len(names)
    first, second = float(mean_of_means(*one)), float(mean_of_means(*other))
    if pair_weights is not None:
        weights = [pair_weights[name] for name in names]
        first, second = (
            1.0 + float(sum(w * own.mean() for w, own in zip(weights, each, strict=True))) for each in (one, other)
        )
    error, degrees = standard_error([*one, *other], weights * 2)
    p_value = welch_p_value(first - second, error, degrees)
    if pair_weights is not None:
        one, other = ([own for own, w in zip(each, weights, strict=True) if w > 0] for each in (one, other))
    probability = float(probability_of_improvement(one, other))
    return Difference(
        ours=first,
        theirs=second,
        interval=ConfidenceInterval(*student_interval(first - second, error, degrees)),
        improvement=ConfidenceInterval(
            *student_interval(probability, *improvement_error(one, other), bounds=(0.0, 1.0))
        ),
        p_value=p_value,
        adjusted=p_value,
        verdict=NOT_SHOWN_TO_DIFFER,
    )


def _judged(differences: Mapping[str, Difference], unknown: str = ONE_SEED) -> dict[str, Difference]:
    """The differences of one family, with Holm's correction and verdicts. `unknown` is the verdict without a
    p-value."""
    adjusted = holm([each.p_value for each in differences.values()]).tolist()
    return {
        name: replace(each, adjusted=p, verdict=_verdict(each.interval.value, p, unknown))
        for (name, each), p in zip(differences.items(), adjusted, strict=True)
    }


def _verdict(difference: float, p_value: float, unknown: str) -> str:
    if not p_value < SIGNIFICANCE:
        return unknown if math.isnan(p_value) else NOT_SHOWN_TO_DIFFER
    return NEGLIGIBLE if abs(difference) < LEAST_DIFFERENCE else BETTER if difference > 0 else WORSE


def _seeds_for(variances: np.ndarray, difference: float) -> int | None:
    """Least number of seeds whose least difference is at most this one, by bisection: it falls with seeds."""
    low, high = 2, MOST_SEEDS
    if least_difference(variances, high) > difference:
        return None
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if least_difference(variances, middle) <= difference else (middle + 1, high)
    return low


def results_of(results: AgentResults | str | os.PathLike) -> AgentResults:
    """Results as given, or read from a folder or file."""
    return results if isinstance(results, AgentResults) else AgentResults.read(results)


def suite_of_results(results: AgentResults, suite: Suite | str | None) -> Suite:
    """The given suite, or the one that the results name."""
    if suite is None and results.suite not in shipped_suites():
        raise ParameterError(
            f"results of {results.agent} are of the suite {results.suite!r}, which is not shipped; give its file: "
            "--suite FILE.yaml (in Python: suite=)"
        )
    return suite if isinstance(suite, Suite) else load_suite(suite or results.suite)
