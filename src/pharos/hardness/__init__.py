"""How hard an MDP is to learn: how long it takes to get around, to tell actions apart, and to look ahead.

Visitation complexity: `diameter`, `start_eccentricity`, `covering`. Estimation complexity: `gaps`,
`sum_of_reciprocal_gaps`, `minimal_gap`, `environmental_value_norm`. Planning: `effective_horizon`. All of them:
`report`; one of your own: `register`.
"""

from pharos.hardness import built_in as _built_in  # registers the measures; the order of a report
from pharos.hardness.distances.diameter import (
    colosseum_diameter,
    diameter,
    start_eccentricity,
    start_eccentricity_interval,
)
from pharos.hardness.gaps.gaps import Gaps, gaps, minimal_gap, sum_of_reciprocal_gaps
from pharos.hardness.gaps.value_norm import ActionGapRegularity, action_gap_regularity, environmental_value_norm
from pharos.hardness.interval import Budget, Certificate, Certified, Interval, Progress
from pharos.hardness.planning.effective_horizon import EffectiveHorizon, effective_horizon
from pharos.hardness.planning.gorp import GorpBound, GorpRuns, gorp_bound, run_gorp
from pharos.hardness.planning.return_distribution import ReturnDistribution, return_distribution
from pharos.hardness.planning.stationary_horizon import StationaryHorizon, stationary_effective_horizon
from pharos.hardness.registry import Measure, Problem, chosen, measures, register
from pharos.hardness.report import Report, Result, report
from pharos.hardness.representation.kernel_regret import KernelRegret, kernel_regret
from pharos.hardness.representation.kernel_spectrum import (
    Spectral,
    aliasing_floor,
    kernel_learning_time,
    kernel_sample_complexity,
)
from pharos.hardness.representation.mean_field import LearningCurve, Rollouts, Schedule
from pharos.hardness.representation.policy_regret import kernel_policy_regret
from pharos.hardness.representation.representation import Representation
from pharos.hardness.representation.sampled_regret import SampledRegret, Sampling, sampled_regret
from pharos.hardness.visitation.exploration_time import Covering, ExplorationTime, covering, exploration_time
from pharos.hardness.visitation.mixing_time import MixingTime, distribution_mismatch, mixing_time
from pharos.hardness.visitation.occupancy import Occupancy, discounted_visits, occupancy

__all__ = [
    "Budget",
    "Certified",
    "EffectiveHorizon",
    "Gaps",
    "Interval",
    "Measure",
    "Problem",
    "Report",
    "Representation",
    "Result",
    "Rollouts",
    "Sampling",
    "Schedule",
    "action_gap_regularity",
    "aliasing_floor",
    "colosseum_diameter",
    "covering",
    "diameter",
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
    "sampled_regret",
    "start_eccentricity",
    "start_eccentricity_interval",
    "stationary_effective_horizon",
    "sum_of_reciprocal_gaps",
]
_shared = """
    ActionGapRegularity Certificate Covering ExplorationTime GorpBound GorpRuns KernelRegret LearningCurve MixingTime
    Occupancy Progress ReturnDistribution SampledRegret Spectral StationaryHorizon chosen discounted_visits
"""
