"""What both effective horizons consist of. Source: Laidlaw, Russell and Dragan (2023), theorem 5.4."""

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class LookAhead:
    """How far ahead one must look, and the samples that each depth takes.

    Attributes:
        value: min over k of k + log_A m_k, at most the number of steps.
        k_min: smallest k for which acting greedily in Q^k is optimal, Q^1 being the value of uniform play.
        effective_planning_window: the same from Q^1 = r: how many rewards ahead one must see.
        ks, ms, gaps, vars: for each k that was tried and does not fail: k, the samples m_k, and gap and variance bound
            where m_k is attained.
    """

    value: float
    k_min: int
    effective_planning_window: int
    ks: list[int]
    ms: list[int]
    gaps: list[float]
    vars: list[float]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; infinite gaps are None."""
        return {
            "value": self.value,
            "k_min": self.k_min,
            "effective_planning_window": self.effective_planning_window,
            "ks": self.ks,
            "ms": self.ms,
            "gaps": [gap if math.isfinite(gap) else None for gap in self.gaps],
            "vars": self.vars,
        }

    def __str__(self) -> str:
        return f"{self.value:.6g} (k_min {self.k_min}, window {self.effective_planning_window})"
