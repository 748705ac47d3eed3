"""Hardness measures of MDPs: how long it takes to get around, to tell actions apart, and to look ahead.

Visitation complexity: `diameter`, `start_eccentricity`, `covering`. Estimation complexity: `gaps`,
`sum_of_reciprocal_gaps`, `minimal_gap`, `environmental_value_norm`. Planning: `effective_horizon`. All of them:
`report`. `register` adds your own.
"""

from typing import TYPE_CHECKING

from pharos.hardness.diameter import (
    colosseum_diameter,
    diameter,
    start_eccentricity,
    start_eccentricity_interval,
)
from pharos.hardness.effective_horizon import (
    EffectiveHorizon,
    StationaryHorizon,
    effective_horizon,
    stationary_effective_horizon,
)
from pharos.hardness.gaps import ERRORS_PER_TIE, Gaps, gaps, minimal_gap, sum_of_reciprocal_gaps
from pharos.hardness.gorp import GorpBound, GorpRuns, gorp_bound, run_gorp
from pharos.hardness.interval import Budget, Certificate, Certified, Interval, MeasureProgress
from pharos.hardness.registry import Measure, Problem, measures, register, selected_measures
from pharos.hardness.report import Report, Result, report
from pharos.hardness.representation.kernel_regret import (
    KernelRegret,
    Spectral,
    aliasing_floor,
    kernel_learning_time,
    kernel_policy_regret,
    kernel_regret,
    kernel_sample_complexity,
)
from pharos.hardness.representation.learning import (
    Adam,
    LearningCurve,
    OutputLayer,
    Representation,
    Rollouts,
    Schedule,
)
from pharos.hardness.representation.network_regret import (
    NETWORK_WALKS,
    NetworkRegret,
    is_for_networks,
    network_policy_regret,
    network_regret,
)
from pharos.hardness.representation.sampled_regret import SampledRegret, Sampling, huber_regret, sampled_regret
from pharos.hardness.steps import ReturnDistribution, return_distribution
from pharos.hardness.value_norm import ActionGapRegularity, action_gap_regularity, environmental_value_norm
from pharos.hardness.visitation import (
    Covering,
    ExplorationTime,
    MixingTime,
    Occupancy,
    covering,
    discounted_visits,
    distribution_mismatch,
    exploration_time,
    mixing_time,
    occupancy,
)
from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.hardness.representation.aliasing import Aliasing, aliasing_of_classes
    from pharos.hardness.representation.empirical import ModuleKernel, empirical_ntk, kernel_of_module
    from pharos.hardness.representation.memoryless import MemorylessLoss, memoryless_loss
    from pharos.hardness.representation.networks import (
        Network,
        check_memory,
        default_network,
        is_channels_last,
        tangent_kernel,
    )

__all__ = [
    "NETWORK_WALKS",
    "Adam",
    "Certified",
    "EffectiveHorizon",
    "Gaps",
    "Interval",
    "Measure",
    "Problem",
    "Representation",
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
    "huber_regret",
    "kernel_learning_time",
    "kernel_policy_regret",
    "kernel_regret",
    "kernel_sample_complexity",
    "measures",
    "minimal_gap",
    "mixing_time",
    "network_policy_regret",
    "network_regret",
    "occupancy",
    "register",
    "report",
    "run_gorp",
    "sampled_regret",
    "start_eccentricity",
    "start_eccentricity_interval",
    "stationary_effective_horizon",
    "sum_of_reciprocal_gaps",
]

__getattr__ = lazy.attributes(__name__)
