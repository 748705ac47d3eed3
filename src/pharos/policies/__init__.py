"""Policies: tables, and functions of observations; asked in the states that they reach, and evaluated."""

from pharos.policies.asking import Answers, PolicyAnswers, Sight, TableAnswers
from pharos.policies.evaluation import (
    Evaluation,
    ReachedSolution,
    evaluate_observing,
    evaluate_policy,
    evaluate_seeing,
)
from pharos.policies.policy import DeepPolicy, Model, Policy, PolicyLike, TabularAgent, policy_function

__all__ = [
    "Answers",
    "DeepPolicy",
    "Evaluation",
    "Model",
    "Policy",
    "PolicyAnswers",
    "PolicyLike",
    "ReachedSolution",
    "Sight",
    "TableAnswers",
    "TabularAgent",
    "evaluate_observing",
    "evaluate_policy",
    "evaluate_seeing",
    "policy_function",
]
