"""Solving: optimal values and values of given policies, each with an error bound that is proven and met."""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.solvers.average import AverageReward, GainInterval, average_reward
    from pharos.solvers.policy_iteration import chain
    from pharos.solvers.reaching import Bounds, Reachability, StateBounds, reach
    from pharos.solvers.solution import Solution, Solving, SolvingOptions
    from pharos.solvers.values import (
        TablePolicy,
        evaluate_parts,
        evaluate_policy,
        uniform_policy,
        uniform_value,
        value_iteration,
        worst_value,
    )

__all__ = [
    "AverageReward",
    "Bounds",
    "GainInterval",
    "Reachability",
    "Solution",
    "Solving",
    "StateBounds",
    "average_reward",
    "evaluate_policy",
    "reach",
    "uniform_value",
    "value_iteration",
]

__getattr__ = lazy.attributes(__name__)
