"""Registry of the measures of a report, with name, function, definition and source, and the measures of pharos."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from pharos.errors import MeasureUnfinished, ParameterError, UndefinedMeasure, UnknownName
from pharos.hardness.diameter import diameter, start_eccentricity_interval
from pharos.hardness.effective_horizon import effective_horizon, stationary_effective_horizon
from pharos.hardness.gaps import Gaps, resolved_gaps, solution_within
from pharos.hardness.gorp import gorp_bound
from pharos.hardness.interval import Budget, BudgetClock, Certified, MeasureProgress
from pharos.hardness.representation.kernel_regret import (
    aliasing_floor,
    kernel_learning_time,
    kernel_policy_regret,
    kernel_regret,
    kernel_sample_complexity,
)
from pharos.hardness.representation.learning import Adam, Representation, Rollouts, Schedule
from pharos.hardness.representation.network_regret import network_policy_regret, network_regret
from pharos.hardness.representation.sampled_regret import Sampling, huber_regret, sampled_regret
from pharos.hardness.value_norm import action_gap_regularity, certified_value_norm
from pharos.hardness.visitation import covering, distribution_mismatch, exploration_time, mixing_time
from pharos.mdp import TabularMDP
from pharos.solvers import Solution, value_iteration
from pharos.system.wording import pluralize


@dataclass(frozen=True, eq=False)
class Problem:
    """An MDP that is being measured, with what several measures need, computed once.

    Attributes:
        mdp: the MDP. Values and gaps have its gamma, and its horizon if it has one.
        horizon: number of steps T for measures of episodes: the MDP's if it has one, or None.
        tolerance: largest error of a value, in units of return. A larger one is used if floats cannot reach it.
        restart: convention of the diameter: terminal states lead back to the start.
        budget: of each measure, after which it returns a proven interval.
        progress: called with the name of the running measure and a line on its progress.
        representation: of the states by the agent's network, for measures that need one, or None.
        schedule: of the idealised learner.
        rollouts: of the idealised actor-critic. Default: the defaults of `Rollouts`.
        sampling: of the learner that draws. Default: the default of `Sampling`.
        adam: of the learners that step as an agent does. Default: the default of `Adam`.
        folder: in which optimal values and bounds of searches are kept while they are computed. None: in memory.
        is_strict: whether the budget also ends measures without bounds to show for it, which are then not available.
        clock: of the running measure.
    """

    mdp: TabularMDP
    horizon: int | None = None
    tolerance: float = 1e-9
    restart: bool = True
    budget: Budget = field(default_factory=Budget)
    progress: Callable[[str, str], None] | None = None
    representation: Representation | None = None
    schedule: Schedule = field(default_factory=Schedule)
    rollouts: Rollouts | None = None
    sampling: Sampling | None = None
    adam: Adam | None = None
    folder: Path | None = None
    is_strict: bool = False

    @cached_property
    def clock(self) -> BudgetClock:
        """Clock of the budget, which `report` starts anew for each measure."""
        return BudgetClock(self.budget, None)

    @property
    def solution(self) -> Solution:
        """Optimal values. MeasureUnfinished if the budget of a measure ended before they were there."""
        if isinstance(self._solved, MeasureUnfinished):
            raise self._solved
        return self._solved

    @cached_property
    def _solved(self) -> Solution | MeasureUnfinished:  # what a budget has ended is not tried by the next measure again
        try:
            return solution_within(
                value_iteration,
                self.mdp,
                self.tolerance,
                keep_all=self.mdp.horizon is not None and self._is_small,
                progress=self._on_sweep,
                values=None if self.folder is None or self.mdp.horizon is not None else self.folder / "optimal.npy",
            )
        except MeasureUnfinished as error:
            return error

    @property
    def error_bound(self) -> float | None:
        """Error bound of the optimal values. None if no measure has used them, or the budget has ended them."""
        result = vars(self).get("_solved")
        return result.error_bound if isinstance(result, Solution) else None

    @cached_property
    def gaps(self) -> Gaps:
        """Suboptimality gaps."""
        return resolved_gaps(self.mdp, self.solution, in_place=self.folder is not None, go_on=self._may_go_on)

    def _may_go_on(self) -> bool:
        return not self.is_strict or self.clock.seconds_left > 0

    def episode(self, measure: str) -> int:
        """The horizon. UndefinedMeasure if there is none."""
        if self.horizon is None:
            raise UndefinedMeasure(f"{measure} is defined for episodes of T steps: give a horizon")
        return self.horizon

    def seen(self, measure: str) -> Representation:
        """The representation. UndefinedMeasure if there is none."""
        if self.representation is None:
            raise UndefinedMeasure(f"{measure} is of what an agent sees: give an observation and a network")
        return self.representation

    def report(self, what: str, line: str) -> None:
        """Report progress. MeasureUnfinished if the budget has ended, so that every loop that reports keeps to it."""
        if self.is_strict:
            self.clock.check(line)
        self._show(what, line)

    def _on_sweep(self, sweeps: int, bound: float) -> None:
        self.report("values", f"sweep {sweeps} of the optimal values, error at most {bound:.2g}")

    def reporter(self, what: str) -> Callable[[str], None]:
        """Progress callback of a measure, which keeps to the budget."""
        return lambda line: self.report(what, line)

    def _show(self, what: str, line: str) -> None:
        if self.progress is not None:
            self.progress(what, line)

    def interval_reporter(self, what: str) -> Callable[[MeasureProgress], None]:
        """A callback for measures that narrow an interval down."""

        def show(progress: MeasureProgress) -> None:
            upper = f"{progress.upper:.6g}" if math.isfinite(progress.upper) and progress.upper < 2**31 - 1 else "?"
            self._show(
                what,
                f"between {progress.lower:.6g} and {upper}, {pluralize(progress.searches, 'search', 'searches')}, "
                f"{progress.candidates:,} states open",
            )

        return show

    @property
    def _is_small(self) -> bool:
        return self.mdp.num_states * self.mdp.width * ((self.mdp.horizon or 0) + 1) * 8 <= 2**30


@dataclass(frozen=True)
class Measure:
    """One line of a report.

    Attributes:
        name: key of the result.
        function: Problem -> a number, or an object with `to_dict()`. It raises UndefinedMeasure if there is no value.
            The result's attributes `exact`, `lower`, `upper`, `note`, as of `Certified`, state its proven interval. A
            number has none, and is reported as "float64".
        definition: formula, in a line.
        source: who defined it.
        complexity: "visitation", "estimation", "planning", "representation" or "other".
        version: goes up when the function's results change, so that kept ones are not used. None: never keep results.
        depends: on what results depend, beside the transitions, chance and start: "structure" (nothing else), "values"
            (rewards, gamma), "episodes" (rewards, horizon), "all" (these), "representation" (what the agent sees, too).
        on_request: only part of a report if it is named, or if all are asked for. If it depends on the representation,
            also if one is given.
    """

    name: str
    function: Callable[[Problem], Any]
    definition: str
    source: str
    complexity: str = "other"
    version: int | None = None
    depends: str = "all"
    on_request: bool = False


_MEASURES: dict[str, Measure] = {}


def register(
    name: str,
    function: Callable[[Problem], Any],
    *,
    definition: str,
    source: str = "the user",
    complexity: str = "other",
    version: int | None = None,
    depends: str = "all",
    on_request: bool = False,
) -> Measure:
    """Make a measure part of every report.

        register("density", lambda p: float((p.mdp.rewards != 0).mean()), definition="share of transitions that pay")

    Args:
        function: takes a `Problem` (`.mdp`, `.solution`, `.gaps`, `.horizon`, `.budget`) and returns a number, a
            `Certified` number, or an object with `to_dict()`, see `Measure`.
        definition, source: printed beside the value.
        version: give one to keep results beside the state space, and raise it when the function changes.
        depends, on_request: see `Measure`.
    Raises:
        ParameterError: the name is no identifier, or taken by a measure of pharos.
    """
    if not name.isidentifier():
        raise ParameterError(
            f"the measure's name is {name!r}; expected letters, digits and underscores, as in 'my_measure'"
        )
    if name in _MEASURES and _MEASURES[name].source != "the user" and source == "the user":
        raise ParameterError(f"{name!r} is a measure of pharos; choose another name")
    _MEASURES[name] = Measure(name, function, definition, source, complexity, version, depends, on_request)
    return _MEASURES[name]


def measures() -> dict[str, Measure]:
    """The known measures by name, in the order of a report."""
    return dict(_MEASURES)


def selected_measures(names: str | Iterable[str] | None, is_seen: bool = False) -> list[Measure]:
    """The measures of these names. None: all but those on request. "all": these as well.

    Args:
        is_seen: whether there is a representation. If so, and without names, measures of it are among them.

    Raises:
        UnknownName: there is no such measure. The nearest is suggested.
    """
    if names is None:
        wanted = _MEASURES.values()
        return [each for each in wanted if not each.on_request or (is_seen and each.depends == "representation")]
    if names == "all":
        return list(_MEASURES.values())
    if isinstance(names, str):
        names = names.split(",")
    result = []
    for name in names:
        if name.strip() not in _MEASURES:
            raise UnknownName("measure", name.strip(), _MEASURES)
        result.append(_MEASURES[name.strip()])
    if not result:
        raise ParameterError("no measures are named; name at least one, or give None for all")
    return result


Outcome = TypeVar("Outcome")


# Measures of pharos ---------------------------------------------------------------------------------------------------


def _start_eccentricity(problem: Problem) -> Certified:
    interval = start_eccentricity_interval(
        problem.mdp,
        restart=problem.restart,
        budget=problem.budget,
        progress=problem.interval_reporter("start_eccentricity"),
    )
    if not interval.exact and math.isinf(interval.upper):
        raise UndefinedMeasure(f"start_eccentricity: at least {interval.lower:.6g}; {interval.note}")
    return Certified(interval.upper, interval.lower, interval.upper, interval.exact, interval.note)


def _of_episodes(function: Callable[..., Outcome], problem: Problem) -> Outcome:
    """Result of a measure of episodes, which has the function's name."""
    name = function.__name__
    return function(problem.mdp, horizon=problem.episode(name), progress=problem.reporter(name))


def _minimal_gap(problem: Problem) -> Certified:
    result = problem.gaps.certified_minimal
    if not result.exact and math.isinf(result.value):
        raise UndefinedMeasure(f"minimal_gap: there is none, or {result.note}")
    return result


# Settings that several measures share
_VALUE_SETTINGS: dict[str, Any] = {"complexity": "estimation", "version": 2, "depends": "values"}
_REPRESENTATION: dict[str, Any] = {
    "complexity": "representation",
    "version": 1,
    "depends": "representation",
    "on_request": True,
}

register(
    "diameter",
    lambda problem: diameter(
        problem.mdp,
        restart=problem.restart,
        budget=problem.budget,
        progress=problem.interval_reporter("diameter"),
        bounds=problem.folder,
    ),
    definition="max over s != s' of min over policies of E[steps from s to s']",
    source="Jaksch, Ortner and Auer (2010), definition 1; the pharos paper, equation 1",
    complexity="visitation",
    version=2,
    depends="structure",
)
register(
    "start_eccentricity",
    _start_eccentricity,
    definition="max over s' of min over policies of E[steps from the start to s']",
    source="the pharos paper, equation 1, read literally",
    complexity="visitation",
    version=2,
    depends="structure",
)
register(
    "sum_of_reciprocal_gaps",
    lambda problem: problem.gaps.certified_sum,
    definition="sum of 1 / (V*(s) - Q*(s, a)) over reachable s and actions that are not optimal",
    source="Simchowitz and Jamieson (2019); the pharos paper, equation 2",
    **_VALUE_SETTINGS,
)
register(
    "sum_of_reciprocal_gaps_regularized",
    lambda problem: problem.gaps.certified_regularized,
    definition="sum of 1 / (V*(s) - Q*(s, a) + 0.1) over all s and a",
    source="Conserva and Rauber (2022), as in Colosseum",
    **_VALUE_SETTINGS,
)
register(
    "minimal_gap",
    _minimal_gap,
    definition="the smallest V*(s) - Q*(s, a) > 0 over reachable s",
    source="Simchowitz and Jamieson (2019)",
    **_VALUE_SETTINGS,
)
register(
    "environmental_value_norm",
    lambda problem: certified_value_norm(
        problem.mdp, problem.solution, progress=problem.reporter("environmental_value_norm")
    ),
    definition="max over s, a of the standard deviation of V*(s') under p(. | s, a)",
    source="Maillard, Mann and Mannor (2014), definition 1",
    **_VALUE_SETTINGS,
)
register(
    "effective_horizon",
    lambda problem: _of_episodes(effective_horizon, problem),
    definition="min over k of k + log_A m_k: m_k samples of k steps followed by random play tell optimal actions apart",
    source="Laidlaw, Russell and Dragan (2023), theorem 5.4",
    complexity="planning",
    version=1,
    depends="episodes",
)
register(
    "covering",
    lambda problem: _of_episodes(covering, problem),
    definition="min over s, a of max over t of mu_t(s, a) under uniform play; length <= ln(2 S A) / omega",
    source="Laidlaw, Russell and Dragan (2023); Even-Dar and Mansour (2003)",
    complexity="visitation",
    version=1,
    depends="episodes",
)
register(
    "action_gap_regularity",
    lambda problem: action_gap_regularity(problem.mdp, problem.solution),
    definition="smallest c with P(0 < V*(s) - best Q*(s, a) that is not optimal <= t) <= c t for all t, s uniform",
    source="Farahmand (2011), assumption A1",
    **_VALUE_SETTINGS,
    on_request=True,
)
register(
    "distribution_mismatch",
    lambda problem: distribution_mismatch(
        problem.mdp, solution=problem.solution, progress=problem.reporter("distribution_mismatch")
    ),
    definition="max over s of d*(s) / d(s), discounted visits of the optimal and of the uniform policy",
    source="Kakade and Langford (2002); Agarwal et al. (2021), section 4.2",
    complexity="visitation",
    version=2,
    depends="values",
    on_request=True,
)
register(
    "mixing_time",
    lambda problem: mixing_time(problem.mdp, restart=problem.restart, progress=problem.reporter("mixing_time")),
    definition="min t with max over s of the total variation of P^t(s, .) to the stationary distribution <= 1/4; "
    "uniform play",
    source="Kearns and Singh (2002); Levin, Peres and Wilmer (2009), section 4.5",
    complexity="visitation",
    version=1,
    depends="structure",
    on_request=True,
)
register(
    "tight_effective_horizon",
    lambda problem: gorp_bound(
        problem.mdp,
        horizon=problem.episode("tight_effective_horizon"),
        progress=problem.reporter("tight_effective_horizon"),
    ),
    definition="1 + log_A m, m samples with which greedy over random policy fails with probability <= 1/2",
    source="Laidlaw, Russell and Dragan (2023), appendix C",
    complexity="planning",
    version=2,
    depends="episodes",
    on_request=True,
)
register(
    "stationary_effective_horizon",
    lambda problem: stationary_effective_horizon(
        problem.mdp,
        problem.solution if problem.mdp.horizon is None else None,
        steps=problem.horizon,
        progress=problem.reporter("stationary_effective_horizon"),
    ),
    definition="the effective horizon with one discounted value a state in place of one for each step",
    source="pharos; after Laidlaw, Russell and Dragan (2023), theorem 5.4",
    complexity="planning",
    version=1,
    depends="all",
    on_request=True,
)
register(
    "exploration_time",
    lambda problem: _of_episodes(exploration_time, problem),
    definition="expected steps after which uniform play, in episodes of T steps, meets a reward above half the largest",
    source="pharos",
    complexity="visitation",
    version=2,
    depends="episodes",
    on_request=True,
)


def _represented(function: Callable[..., Outcome], problem: Problem, *options: str) -> Outcome:
    """Result of a measure of the representation. options: names in `problem`, beside schedule and horizon."""
    name, representation = function.__name__, problem.seen(function.__name__)
    settings = {option: getattr(problem, option) for option in ("schedule", "horizon", *options)}
    return function(problem.mdp, representation, progress=problem.reporter(name), **settings)


register(
    "kernel_regret",
    lambda problem: _represented(kernel_regret, problem, "solution"),
    definition="mean over learning of (V* - V of the greedy policy) / (V* - V of uniform play) of expected Q-learning "
    "in the tangent kernel of the agent's network; as played; and both of tabular Q-learning",
    source="pharos; after Sirignano and Spiliopoulos (2019)",
    **_REPRESENTATION,
)
register(
    "sampled_regret",
    lambda problem: _represented(sampled_regret, problem, "solution", "sampling"),
    definition="mean over learning of (V* - V of the greedy policy) / (V* - V of uniform play) of Q-learning from "
    "drawn transitions in the tangent kernel of the agent's network and in its root. And the same of a table",
    source="pharos; after Mnih et al. (2015)",
    **_REPRESENTATION,
)
register(
    "huber_regret",
    lambda problem: _represented(huber_regret, problem, "solution", "sampling"),
    definition="mean over learning of (V* - V of the greedy policy) / (V* - V of uniform play) of Q-learning from "
    "drawn transitions in the tangent kernel of the agent's network and in its root, with the Huber loss and from a "
    "random network. And the same of a table",
    source="pharos; after Huber (1964), Mnih et al. (2015), Lee et al. (2018)",
    **_REPRESENTATION,
)
register(
    "kernel_policy_regret",
    lambda problem: _represented(kernel_policy_regret, problem, "solution", "rollouts"),
    definition="mean over learning of (V* - V of the most probable actions) / (V* - V of uniform play) of an expected "
    "actor-critic in the tangent kernel of the agent's network; as played; and both of a table",
    source="pharos; Sutton et al. (2000), Schulman et al. (2016, 2017)",
    **_REPRESENTATION,
)
register(
    "network_regret",
    lambda problem: _represented(network_regret, problem, "solution", "sampling", "adam"),
    definition="mean over learning of (V* - V of the greedy policy) / (V* - V of uniform play) of a DQN in an "
    "idealised network, whose output layer and layers beneath learn by the agent's own steps of Adam. And the same of "
    "a table",
    source="pharos; after Mnih et al. (2015), Kingma and Ba (2015), Jacot et al. (2018)",
    **_REPRESENTATION | {"version": 2},
)
register(
    "network_policy_regret",
    lambda problem: _represented(network_policy_regret, problem, "solution", "rollouts", "sampling", "adam"),
    definition="mean over learning of (V* - V of the policy) / (V* - V of uniform play) of a PPO in two idealised "
    "networks, whose output layers and layers beneath learn by the agent's own steps of Adam. And the same of a table",
    source="pharos; after Schulman et al. (2016, 2017), Kingma and Ba (2015), Jacot et al. (2018)",
    **_REPRESENTATION | {"version": 2},
)
register(
    "kernel_learning_time",
    lambda problem: _represented(kernel_learning_time, problem),
    definition="time after which gradient flow in the kernel (trace 1) has learnt 90 % of the energy of A* = Q* - V*",
    source="pharos; Jacot, Gabriel and Hongler (2018)",
    **_REPRESENTATION,
)
register(
    "kernel_sample_complexity",
    lambda problem: _represented(kernel_sample_complexity, problem),
    definition="samples from which kernel regression explains 90 % of the variance of Q*",
    source="Simon, Dickens, Karkada and DeWeese (2023)",
    **_REPRESENTATION,
)
register(
    "aliasing_floor",
    lambda problem: _represented(aliasing_floor, problem),
    definition="E Var(Q* | observation) / Var Q*: what no function of the observation explains",
    source="pharos",
    **_REPRESENTATION,
)
