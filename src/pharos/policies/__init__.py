"""Policies: tables, and functions of observations; asked in the states that they reach, and evaluated."""

from pharos.policies.copies import is_small_table, table_values, whole_values
from pharos.policies.evaluation import (
    Evaluation,
    ReachedSolution,
    evaluate_observing,
    evaluate_policy,
    evaluate_seeing,
)
from pharos.policies.policy import DeepPolicy, Model, Policy, PolicyLike, TabularAgent, policy_function
from pharos.policies.query import PolicyAnswers, QueriedPolicy, ReachableRows, Sight, TableAnswers, reachable_rows
from pharos.policies.walks import is_walk, walk_values

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
    "evaluate_observing",
    "evaluate_policy",
    "evaluate_seeing",
    "is_small_table",
    "is_walk",
    "policy_function",
    "reachable_rows",
    "table_values",
    "walk_values",
    "whole_values",
]
