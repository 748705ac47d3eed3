"""Solving: optimal values and values of given policies, each with an error bound that is proven and met."""

from pharos.solvers._policy_evaluation import evaluate_policy, uniform_policy
from pharos.solvers._solution import Solution
from pharos.solvers._value_iteration import uniform_value, value_iteration, worst_value

__all__ = ["Solution", "evaluate_policy", "uniform_policy", "uniform_value", "value_iteration", "worst_value"]
