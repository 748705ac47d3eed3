"""Proven intervals of measures whose value may be out of reach, and budgets for computing them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from pharos.errors import MeasureUnfinished, ParameterError
from pharos.mdp import TabularMDP
from pharos.system.compiling import Stopwatch


def finite(value: object) -> object:
    """The value with None in place of what is infinite or NaN, as JSON has no such numbers. Arrays become lists."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, np.ndarray):
        return finite(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def fields_of(result: object, *without: str) -> dict[str, Any]:
    """The fields of a measure's result by name, `finite`, but for some."""
    return {name: finite(value) for name, value in vars(result).items() if name not in without}


@dataclass(frozen=True)
class Interval:
    """A value between two proven bounds.

    Attributes:
        lower, upper: the value lies in [lower, upper]. Both are infinite if the value is.
        exact: whether the interval is the value: lower == upper for counted steps, a relative width of at most
            `tolerance` for expected ones.
        unreachable_pairs: ordered pairs (s, s') such that no policy leads from s to s' with probability 1.
        finite_part: the largest value among the other pairs. Equal to `upper` if the value is finite and exact.
        counted: whether `unreachable_pairs` and `finite_part` are exact. Otherwise both are lower bounds.
        tolerance: relative width up to which the interval counts as exact.
        searches: searches of the graph, or targets solved, that it took.
        method: how it was computed.
        conventions: what the value refers to.
        note: why it is not exact or not finite, or anything else worth knowing. Empty otherwise.
        seconds: time that it took.
    """

    lower: float
    upper: float
    exact: bool
    unreachable_pairs: int = 0
    finite_part: float = 0.0
    counted: bool = True
    tolerance: float = 0.0
    searches: int = 0
    method: str = ""
    conventions: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""
    seconds: float = 0.0

    def __post_init__(self) -> None:
        for name, kind in (("lower", float), ("upper", float), ("finite_part", float), ("exact", bool)):
            object.__setattr__(self, name, kind(getattr(self, name)))
        if not self.lower <= self.upper:
            raise ValueError(
                f"an interval from {self.lower} to {self.upper}: the lower end must not exceed the upper one"
            )

    def to_dict(self) -> dict[str, Any]:
        """JSON-able. An infinite bound is None, as in JSON nothing else is, and `infinite` says so."""
        first = dict.fromkeys(("lower", "upper", "exact"))  # the order of keys
        return {**first, "infinite": math.isinf(self.lower), **fields_of(self, "conventions", "seconds")}

    def __str__(self) -> str:
        if math.isinf(self.lower):
            at_least = "" if self.counted else "at least "
            return f"infinite ({at_least}{self.unreachable_pairs} unreachable pairs; else up to {self.finite_part:g})"
        if self.exact:
            return f"{self.upper:.10g}"
        return f"[{self.lower:.10g}, {self.upper:.10g}]"


@dataclass(frozen=True)
class Certified:
    """A number, and the proven interval of the true one.

    Attributes:
        value: the number as computed.
        lower, upper: the true one lies in [lower, upper].
        exact: whether the interval is the value: its relative width is at most 1e-6, and no question is open.
        note: why it is not exact. Empty otherwise.
        details: anything else worth knowing, JSON-able.
    """

    value: float
    lower: float
    upper: float
    exact: bool
    note: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        if self.exact:
            return f"{self.value:.10g}"
        if not math.isfinite(self.upper):
            return f"at least {self.lower:.10g}"
        if self.lower == 0.0:
            return f"at most {self.upper:.10g}"
        return f"[{self.lower:.10g}, {self.upper:.10g}]"


@dataclass(frozen=True)
class Certificate:
    """Proof of a measure's value: exact, a proven interval, or none.

    Attributes:
        kind: "exact", proven to be the value (counted, or to a relative width of 1e-6 and less); "interval", proven to
            contain the value; "float64", computed in 64-bit floats without a bound of the error.
        lower, upper: of the interval. None for "float64", and for results that are more than one number.
        note: why it is not exact. Empty otherwise.
        details: anything else worth knowing, JSON-able: ties, for measures of gaps.
    """

    kind: str
    lower: float | None = None
    upper: float | None = None
    note: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_exact(self) -> bool:
        """Whether the value is proven."""
        return self.kind == "exact"

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, with None for infinite ends."""
        return {**fields_of(self, "details"), **self.details}


EXACT_WIDTH = 1e-6
"""Relative width of an interval up to which a `Certified` may call its value exact."""


def certificate_of(outcome: object) -> Certificate:
    """Certificate of a measure's result, from its `exact`, `lower`, `upper` and `note`, if it has them.

    Raises:
        ParameterError: it is a `Certified` whose interval does not contain its value, or is too wide to be exact.
    """
    if not hasattr(outcome, "exact"):
        return Certificate("float64", note=getattr(outcome, "note", ""))
    kind = "exact" if outcome.exact else "interval"
    lower, upper = getattr(outcome, "lower", None), getattr(outcome, "upper", None)
    note = getattr(outcome, "note", "")
    if isinstance(outcome, Certified) and lower is not None and upper is not None:
        slack = 1e-9 * max(abs(lower), abs(upper)) if math.isfinite(upper - lower) else 0.0
        if outcome.value < lower - slack or outcome.value > upper + slack:
            raise ParameterError(f"a measure is {outcome.value}, outside of its interval [{lower}, {upper}]")
        if outcome.exact and lower != upper and not upper - lower <= EXACT_WIDTH * max(abs(lower), abs(upper)):
            raise ParameterError(
                f"a measure calls the interval [{lower}, {upper}] exact; expected {EXACT_WIDTH:g} of it"
            )
    return Certificate(kind, lower, upper, note, dict(getattr(outcome, "details", {})))


def conventions_of(mdp: TabularMDP, restart: bool) -> dict[str, Any]:
    """Conventions behind the steps between states, JSON-able: restart, starts and chance."""
    return {
        "restart": restart,
        "start_states": len(mdp.start_states),
        "chance": {
            "chosen": mdp.chance.chosen,
            "previous": mdp.chance.previous,
            "uniform": mdp.chance.uniform,
            **({"lazy": mdp.laziness} if mdp.laziness else {}),
        },
    }


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Limits of a measure: at the first one reached it returns the interval proven by then, not the exact value.

    Attributes:
        seconds: of wall clock without compiling, looked at between searches.
        searches: searches of the graph, or targets solved. Unlike seconds, the same on every machine.
    """

    seconds: float = 300.0
    searches: float = math.inf

    def __post_init__(self) -> None:
        for name in ("seconds", "searches"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and value >= 0):
                raise ParameterError(
                    f"budget of {value!r} {name}; expected a number of at least 0 (math.inf: no limit)"
                )

    def exceeds(self, other: "Budget") -> bool:
        """Whether it allows for more than `other` in any way."""
        return self.seconds > other.seconds or self.searches > other.searches

    @staticmethod
    def of(budget: "Budget | float | None") -> "Budget":
        """`budget`, in which a number stands for seconds and None for the default of 300 seconds."""
        if budget is None:
            return Budget()
        return budget if isinstance(budget, Budget) else Budget(seconds=budget)


COMMAND_SECONDS = 30.0
"""Budget of `pharos hardness` if none is given, in seconds."""

MORE = "a larger budget (--budget) may prove closer bounds"
"""What the note of an interval that a budget has ended advises."""


@dataclass(frozen=True)
class MeasureProgress:
    """Progress of a measure: the interval so far, searches done, candidates left, and seconds since the start."""

    lower: float
    upper: float
    searches: int
    candidates: int
    seconds: float


class BudgetClock:
    """Clock of a budget: when to stop, and reports of progress at most every tenth of a second.

    Seconds of compiling do not count: what is proven must not depend on whether the code was compiled before.
    """

    def __init__(
        self,
        budget: Budget,
        progress: Callable[[MeasureProgress], None] | None,
        conventions: Mapping[str, Any] = MappingProxyType({}),
    ):
        """conventions: of the values that are measured meanwhile."""
        self.budget, self.progress, self.conventions = budget, progress, dict(conventions)
        self._watch = Stopwatch()
        self.searches = 0
        self._reported = -math.inf

    def restart(self) -> None:
        """Begin again, for another measure of the same budget."""
        self._watch, self.searches, self._reported = Stopwatch(), 0, -math.inf

    @property
    def seconds(self) -> float:
        """Seconds since the start, without compiling."""
        return self._watch.seconds

    @property
    def is_over(self) -> bool:
        """Whether a limit is reached."""
        return self.searches >= self.budget.searches or self.seconds_left <= 0

    @property
    def seconds_left(self) -> float:
        """Seconds until the budget ends, infinite if it does not limit them."""
        return self.budget.seconds - self.seconds

    def check(self, line: str) -> None:
        """MeasureUnfinished if the seconds are over. `line` says how far the work is."""
        if self.seconds_left <= 0:
            spent = f"the budget of {self.budget.seconds:g} s ended at {line}" if line else "the budget has ended"
            raise MeasureUnfinished(f"not available: {spent}; give a larger one (--budget)")

    def signed(self, interval: Interval) -> Interval:
        """The interval, with its conventions, searches and seconds."""
        return replace(interval, conventions=self.conventions, searches=self.searches, seconds=self.seconds)

    def report(self, lower: float, upper: float, candidates: int, *, now: bool = False) -> None:
        """Call `progress`, if there is one and the last call is long enough ago."""
        if self.progress is not None and (now or self.seconds - self._reported >= 0.1):
            self._reported = self.seconds
            self.progress(MeasureProgress(lower, upper, self.searches, candidates, self.seconds))
