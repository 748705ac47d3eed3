"""Limits of a verification, declared once: for keywords of Python, and flags of the command line."""

from dataclasses import dataclass

from pharos.environments import parameter


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a verification.

    Attributes:
        tolerance: how far an exact number may be from the claimed one, relative to V*. For rounding of networks on
            another processor; times V* where that is larger than 1.
        max_states: refuse state spaces larger than this. A table says itself how many states there are.
        max_reached: values of policies that reach more states are estimated. Up to so many a value is exact.
        max_horizon: refuse entries with more steps than this. Of values.
        max_seconds: refuse entries that take longer, each. By the clock, for all of it; counted in the main thread
            alone, and not on Windows.
    """

    tolerance: float = parameter(1e-6, low=0)
    max_states: int = parameter(10_000_000, low=1)
    max_reached: int = parameter(100_000, low=1)
    max_horizon: int = parameter(100_000, low=1)
    max_seconds: float = parameter(600.0, low=1)
