"""How hard an MDP is to learn: how long it takes to get around, to tell actions apart, and to look ahead.

Visitation complexity: `diameter`, `start_eccentricity`, `covering`. Estimation complexity: `gaps`,
`sum_of_reciprocal_gaps`, `minimal_gap`, `environmental_value_norm`. Planning: `effective_horizon`. All of them:
`report`; one of your own: `register`.
"""

from pharos.hardness import built_in as _built_in  # noqa: F401  (registers the measures; the order of a report)
from pharos.hardness.action_gap import ActionGapRegularity, action_gap_regularity
from pharos.hardness.colosseum import colosseum_diameter
from pharos.hardness.covering import Covering, covering
from pharos.hardness.diameter import diameter, start_eccentricity, start_eccentricity_interval
from pharos.hardness.effective_horizon import EffectiveHorizon, effective_horizon
from pharos.hardness.exploration_time import ExplorationTime, exploration_time
from pharos.hardness.gaps import Gaps, gaps, minimal_gap, sum_of_reciprocal_gaps
from pharos.hardness.gorp import GorpBound, GorpRuns, gorp_bound, run_gorp
from pharos.hardness.interval import Budget, Certificate, Certified, Interval, Progress
from pharos.hardness.kernel_regret import KernelRegret, kernel_regret
from pharos.hardness.kernel_spectrum import (
    Spectral,
    aliasing_floor,
    kernel_learning_time,
    kernel_sample_complexity,
)
from pharos.hardness.mean_field import LearningCurve, Rollouts, Schedule
from pharos.hardness.mismatch import distribution_mismatch
from pharos.hardness.mixing_time import MixingTime, mixing_time
from pharos.hardness.occupancy import Occupancy, discounted_visits, occupancy
from pharos.hardness.policy_regret import kernel_policy_regret
from pharos.hardness.registry import Measure, Problem, chosen, measures, register
from pharos.hardness.report import Report, Result, report
from pharos.hardness.representation import Representation
from pharos.hardness.return_distribution import ReturnDistribution, return_distribution
from pharos.hardness.stationary_horizon import StationaryHorizon, stationary_effective_horizon
from pharos.hardness.value_norm import environmental_value_norm

__all__ = [
    "ActionGapRegularity",
    "Budget",
    "Certificate",
    "Certified",
    "Covering",
    "EffectiveHorizon",
    "ExplorationTime",
    "Gaps",
    "GorpBound",
    "GorpRuns",
    "Interval",
    "KernelRegret",
    "LearningCurve",
    "Measure",
    "MixingTime",
    "Occupancy",
    "Problem",
    "Progress",
    "Report",
    "Representation",
    "Result",
    "ReturnDistribution",
    "Rollouts",
    "Schedule",
    "Spectral",
    "StationaryHorizon",
    "action_gap_regularity",
    "aliasing_floor",
    "chosen",
    "colosseum_diameter",
    "covering",
    "diameter",
    "discounted_visits",
    "distribution_mismatch",
    "effective_horizon",
    "environmental_value_norm",
    "exploration_time",
    "gaps",
    "gorp_bound",
    "kernel_learning_time",
    "kernel_policy_regret",
    "kernel_regret",
    "kernel_sample_complexity",
    "measures",
    "minimal_gap",
    "mixing_time",
    "occupancy",
    "register",
    "report",
    "return_distribution",
    "run_gorp",
    "start_eccentricity",
    "start_eccentricity_interval",
    "stationary_effective_horizon",
    "sum_of_reciprocal_gaps",
]
