"""Policies, as tables or as functions of observations: queried in the states that they reach, and evaluated."""

from pharos.policies.losses import state_losses
from pharos.policies.models import DeepPolicy, SB3Model, deep_policy
from pharos.policies.policy import (
    MasksLike,
    NumberObserver,
    Observer,
    Policy,
    PolicyAnswers,
    PolicyLike,
    QueriedPolicy,
    ReachableRows,
    RecurrentPolicy,
    TableAnswers,
    TabularAgent,
    policy_function,
    reachable_rows,
)
from pharos.policies.value import (
    AverageRegret,
    Evaluation,
    ReachedSolution,
    average_regret,
    endless_value,
    evaluate_policy,
    is_small_table,
    is_walk,
    policy_gain,
    policy_value,
    table_values,
    walk_values,
)

__all__ = [
    "AverageRegret",
    "average_regret",
    "evaluate_policy",
]
