"""The measures of a report: name, function, definition and source; and how a user adds one."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pharos.errors import ParameterError, UndefinedMeasure, UnknownName
from pharos.hardness.gaps.gaps import Gaps, resolved_gaps, solved
from pharos.hardness.interval import Budget, Progress
from pharos.hardness.representation.mean_field import Rollouts, Schedule
from pharos.hardness.representation.representation import Representation
from pharos.hardness.representation.sampled_regret import Sampling
from pharos.mdp import TabularMDP
from pharos.solvers import Solution, value_iteration


@dataclass(frozen=True, eq=False)
class Problem:
    """An MDP that is being measured, with what several measures need, computed once.

    Attributes:
        mdp: the MDP. Its gamma, and its horizon where it has one, are those of values and gaps.
        horizon: number of steps T for measures of episodes; that of the MDP where it has one; or None.
        tolerance: largest error of a value, in units of return; a larger one is used where floats cannot reach it.
        restart: convention of the diameter: terminal states lead back to the start.
        budget: what each measure may spend before it returns a proven interval.
        progress: called with the name of the running measure and a line on how far it is.
        representation: what the agent's network makes of the states, for measures that need one; or None.
        schedule: of the idealised learner.
        rollouts: of the idealised actor-critic; None: those of `Rollouts`.
        sampling: of the learner that draws; None: that of `Sampling`.
        folder: where optimal values and bounds of searches are kept while they are computed; None: in memory.
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
    folder: Path | None = None

    @cached_property
    def solution(self) -> Solution:
        """Optimal values."""
        return solved(
            value_iteration,
            self.mdp,
            self.tolerance,
            keep_all=self.mdp.horizon is not None and self._is_small,
            progress=lambda sweeps, bound: self.report("values", f"sweep {sweeps}, error at most {bound:.2g}"),
            values=None if self.folder is None or self.mdp.horizon is not None else self.folder / "optimal.npy",
        )

    @cached_property
    def gaps(self) -> Gaps:
        """Suboptimality gaps."""
        return resolved_gaps(self.mdp, self.solution, in_place=self.folder is not None)

    def episode(self, measure: str) -> int:
        """The horizon; UndefinedMeasure where there is none."""
        if self.horizon is None:
            raise UndefinedMeasure(f"{measure} is defined for episodes of T steps: give a horizon")
        return self.horizon

    def seen(self, measure: str) -> Representation:
        """The representation; UndefinedMeasure where there is none."""
        if self.representation is None:
            raise UndefinedMeasure(f"{measure} is of what an agent sees: give an observation and a network")
        return self.representation

    def report(self, what: str, line: str) -> None:
        """Report progress."""
        if self.progress is not None:
            self.progress(what, line)

    def interval_reporter(self, what: str) -> Callable[[Progress], None]:
        """A callback for measures that narrow an interval down."""

        def show(progress: Progress) -> None:
            upper = f"{progress.upper:.6g}" if math.isfinite(progress.upper) and progress.upper < 2**31 - 1 else "?"
            self.report(
                what,
                f"between {progress.lower:.6g} and {upper}, {progress.searches} searches, "
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
        function: Problem -> a number, or an object with `to_dict()`; UndefinedMeasure where it does not exist. What is
            proven of it the result says itself, by attributes `exact`, `lower`, `upper`, `note`; a plain number says
            nothing, and the report says so: "float64". `Certified` is a number that has them.
        definition: formula, in a line.
        source: who defined it.
        complexity: "visitation", "estimation", "planning", "representation" or "other".
        version: goes up when the function's results change, so that kept ones are not used; None: never keep results.
        depends: on what results depend, beside the transitions, chance and start: "structure" (nothing else), "values"
            (rewards, gamma), "episodes" (rewards, horizon), "all" (these), "representation" (what the agent sees, too).
        on_request: only part of a report where it is named, or where all are asked for; if it depends on the
            representation, also where one is given.
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
            `Certified` number, or an object with `to_dict()`; see `Measure`.
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
    _MEASURES[name] = Measure(
        name=name,
        function=function,
        definition=definition,
        source=source,
        complexity=complexity,
        version=version,
        depends=depends,
        on_request=on_request,
    )
    return _MEASURES[name]


def measures() -> dict[str, Measure]:
    """The known measures by name, in the order of a report."""
    return dict(_MEASURES)


def chosen(names: Any, is_seen: bool = False) -> list[Measure]:
    """The measures of these names; None: all but those on request; "all": these as well.

    Args:
        is_seen: whether there is a representation; without names, measures of it are among them then.

    Raises:
        UnknownName: there is no such measure; the nearest is suggested.
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
