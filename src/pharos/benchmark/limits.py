"""Limits of a verification, declared once: for keywords of Python, and flags of the command line."""

from dataclasses import dataclass

from pharos.environments import parameter
from pharos.system.sealed import LARGEST_SEALED_FILE


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a verification.

    Attributes:
        tolerance: how far an exact number may be from the claimed one, relative to V*. For rounding of networks on
            another processor, times V* if that is larger than 1. Of a suite: of normalised regret.
        max_states: refuse state spaces larger than this. A table says itself how many states there are, and a suite has
            tasks of its own.
        max_reached: values of policies that reach more states are estimated. Up to so many a value is exact. Policies
            of a suite are tables, whose values are exact.
        max_horizon: refuse runs with more steps of an episode than this. A suite has its own.
        max_seconds: refuse tasks that take longer, each. By the clock, for all of it. Counted in the main thread alone,
            and not on Windows.
    """

    tolerance: float = parameter(1e-6, low=0)
    max_states: int = parameter(10_000_000, low=1)
    max_reached: int = parameter(100_000, low=1)
    max_horizon: int = parameter(100_000, low=1)
    max_seconds: float = parameter(600.0, low=1)

    def to_dict(self) -> dict[str, float]:
        """The largest "states", "reached", "horizon", "seconds" and "bytes", JSON-able."""
        limits = {name.removeprefix("max_"): value for name, value in vars(self).items() if name != "tolerance"}
        return limits | {"bytes": LARGEST_SEALED_FILE}
