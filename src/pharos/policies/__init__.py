"""Policies: tables, and functions of observations; asked in the states that they reach, and evaluated."""

from pharos.policies.policy import DeepPolicy, Model, Policy, PolicyLike, TabularAgent, policy_function
from pharos.policies.query import PolicyAnswers, QueriedPolicy, ReachableRows, Sight, TableAnswers, reachable_rows
from pharos.policies.value import (
    Evaluation,
    ReachedSolution,
    evaluate_policy,
    is_small_table,
    is_walk,
    policy_value,
    table_values,
    walk_values,
)

__all__ = [
    "DeepPolicy",
    "Evaluation",
    "Model",
    "Policy",
    "PolicyAnswers",
    "PolicyLike",
    "QueriedPolicy",
    "ReachableRows",
    "ReachedSolution",
    "Sight",
    "TableAnswers",
    "TabularAgent",
    "evaluate_policy",
    "is_small_table",
    "is_walk",
    "policy_function",
    "policy_value",
    "reachable_rows",
    "table_values",
    "walk_values",
]
