"""The measures that pharos registers, in the order of a report."""

import math
from typing import Any

from pharos.errors import UndefinedMeasure
from pharos.hardness.distances.diameter import diameter, start_eccentricity_interval
from pharos.hardness.gaps.value_norm import action_gap_regularity, certified_value_norm
from pharos.hardness.interval import Certified
from pharos.hardness.planning.effective_horizon import effective_horizon
from pharos.hardness.planning.gorp import gorp_bound
from pharos.hardness.planning.stationary_horizon import stationary_effective_horizon
from pharos.hardness.registry import Problem, register
from pharos.hardness.representation.kernel_regret import kernel_regret
from pharos.hardness.representation.kernel_spectrum import (
    aliasing_floor,
    kernel_learning_time,
    kernel_sample_complexity,
)
from pharos.hardness.representation.policy_regret import kernel_policy_regret
from pharos.hardness.representation.sampled_regret import sampled_regret
from pharos.hardness.visitation.exploration_time import covering, exploration_time
from pharos.hardness.visitation.mixing_time import distribution_mismatch, mixing_time


def _diameter(problem: Problem) -> Any:
    reporter = problem.interval_reporter("diameter")
    options: dict[str, Any] = {"restart": problem.restart, "budget": problem.budget, "bounds": problem.folder}
    return diameter(problem.mdp, progress=reporter, **options)


def _start_eccentricity(problem: Problem) -> Certified:
    interval = start_eccentricity_interval(problem.mdp, restart=problem.restart, budget=problem.budget)
    if not interval.exact and math.isinf(interval.upper):
        raise UndefinedMeasure(f"start_eccentricity: at least {interval.lower:.6g}; {interval.note}")
    return Certified(interval.upper, interval.lower, interval.upper, interval.exact, interval.note)


def _minimal_gap(problem: Problem) -> Certified:
    result = problem.gaps.certified_minimal
    if not result.exact and math.isinf(result.value):
        raise UndefinedMeasure(f"minimal_gap: there is none, or {result.note}")
    return result


register(
    "diameter",
    _diameter,
    definition="max over s != s' of min over policies of E[steps from s to s']",
    source="Jaksch, Ortner and Auer (2010), definition 1; the pharos paper, equation 1",
    complexity="visitation",
    version=2,
    depends="structure",
)
register(
    "start_eccentricity",
    _start_eccentricity,
    definition="max over s' of min over policies of E[steps from the start to s']",
    source="the pharos paper, equation 1, read literally",
    complexity="visitation",
    version=2,
    depends="structure",
)
register(
    "sum_of_reciprocal_gaps",
    lambda problem: problem.gaps.certified_sum,
    definition="sum of 1 / (V*(s) - Q*(s, a)) over reachable s and actions that are not optimal",
    source="Simchowitz and Jamieson (2019); the pharos paper, equation 2",
    complexity="estimation",
    version=2,
    depends="values",
)
register(
    "sum_of_reciprocal_gaps_regularized",
    lambda problem: problem.gaps.certified_regularized,
    definition="sum of 1 / (V*(s) - Q*(s, a) + 0.1) over all s and a",
    source="Conserva and Rauber (2022), as in Colosseum",
    complexity="estimation",
    version=2,
    depends="values",
)
register(
    "minimal_gap",
    _minimal_gap,
    definition="the smallest V*(s) - Q*(s, a) > 0 over reachable s",
    source="Simchowitz and Jamieson (2019)",
    complexity="estimation",
    version=2,
    depends="values",
)
register(
    "environmental_value_norm",
    lambda problem: certified_value_norm(problem.mdp, problem.solution),
    definition="max over s, a of the standard deviation of V*(s') under p(. | s, a)",
    source="Maillard, Mann and Mannor (2014), definition 1",
    complexity="estimation",
    version=2,
    depends="values",
)
register(
    "effective_horizon",
    lambda problem: effective_horizon(problem.mdp, horizon=problem.episode("effective_horizon")),
    definition="min over k of k + log_A m_k: m_k samples of k steps followed by random play tell optimal actions apart",
    source="Laidlaw, Russell and Dragan (2023), theorem 5.4",
    complexity="planning",
    version=1,
    depends="episodes",
)
register(
    "covering",
    lambda problem: covering(problem.mdp, horizon=problem.episode("covering")),
    definition="min over s, a of max over t of mu_t(s, a) under uniform play; length <= ln(2 S A) / omega",
    source="Laidlaw, Russell and Dragan (2023); Even-Dar and Mansour (2003)",
    complexity="visitation",
    version=1,
    depends="episodes",
)
register(
    "action_gap_regularity",
    lambda problem: action_gap_regularity(problem.mdp, problem.solution),
    definition="smallest c with P(0 < V*(s) - best Q*(s, a) that is not optimal <= t) <= c t for all t, s uniform",
    source="Farahmand (2011), assumption A1",
    complexity="estimation",
    version=2,
    depends="values",
    on_request=True,
)
register(
    "distribution_mismatch",
    lambda problem: distribution_mismatch(problem.mdp, solution=problem.solution),
    definition="max over s of d*(s) / d(s), discounted visits of the optimal and of the uniform policy",
    source="Kakade and Langford (2002); Agarwal et al. (2021), section 4.2",
    complexity="visitation",
    version=2,
    depends="values",
    on_request=True,
)
register(
    "mixing_time",
    lambda problem: mixing_time(problem.mdp, restart=problem.restart),
    definition="min t with max over s of the total variation of P^t(s, .) to the stationary distribution <= 1/4; "
    "uniform play",
    source="Kearns and Singh (2002); Levin, Peres and Wilmer (2009), section 4.5",
    complexity="visitation",
    version=1,
    depends="structure",
    on_request=True,
)
register(
    "tight_effective_horizon",
    lambda problem: gorp_bound(problem.mdp, horizon=problem.episode("tight_effective_horizon")),
    definition="1 + log_A m, m samples with which greedy over random policy fails with probability <= 1/2",
    source="Laidlaw, Russell and Dragan (2023), appendix C",
    complexity="planning",
    version=2,
    depends="episodes",
    on_request=True,
)
register(
    "stationary_effective_horizon",
    lambda problem: stationary_effective_horizon(
        problem.mdp,
        problem.solution if problem.mdp.horizon is None else None,
        steps=problem.horizon,
        progress=lambda line: problem.report("stationary_effective_horizon", line),
    ),
    definition="the effective horizon with one discounted value a state in place of one for each step",
    source="pharos; after Laidlaw, Russell and Dragan (2023), theorem 5.4",
    complexity="planning",
    version=1,
    depends="all",
    on_request=True,
)
register(
    "exploration_time",
    lambda problem: exploration_time(problem.mdp, horizon=problem.episode("exploration_time")),
    definition="expected steps after which uniform play, in episodes of T steps, meets a reward above half the largest",
    source="pharos",
    complexity="visitation",
    version=1,
    depends="episodes",
    on_request=True,
)


def _of_representation(function: Any) -> Any:
    """A measure of what the agent sees, as a report takes it."""

    def measure(problem: Problem) -> Any:
        representation = problem.seen(function.__name__)
        return function(problem.mdp, representation, schedule=problem.schedule, horizon=problem.horizon)

    return measure


def _of_learner(function: Any, problem: Problem, **options: Any) -> Any:
    """A measure of an idealised learner."""
    options |= {"schedule": problem.schedule, "solution": problem.solution, "horizon": problem.horizon}
    return function(problem.mdp, problem.seen(function.__name__), **options)


register(
    "kernel_regret",
    lambda problem: _of_learner(kernel_regret, problem),
    definition="mean over learning of (V* - V of the greedy policy) / (V* - V of uniform play) of expected Q-learning "
    "in the tangent kernel of the agent's network; as played; and both of tabular Q-learning",
    source="pharos; after Sirignano and Spiliopoulos (2019)",
    complexity="representation",
    version=1,
    depends="representation",
    on_request=True,
)
register(
    "sampled_regret",
    lambda problem: _of_learner(sampled_regret, problem, sampling=problem.sampling),
    definition="mean over learning of (V* - V of the greedy policy) / (V* - V of uniform play) of Q-learning from "
    "drawn transitions in the tangent kernel of the agent's network and in its root; and that of a table",
    source="pharos; after Mnih et al. (2015)",
    complexity="representation",
    version=1,
    depends="representation",
    on_request=True,
)
register(
    "kernel_policy_regret",
    lambda problem: _of_learner(kernel_policy_regret, problem, rollouts=problem.rollouts),
    definition="mean over learning of (V* - V of the most probable actions) / (V* - V of uniform play) of an expected "
    "actor-critic in the tangent kernel of the agent's network; as played; and both of a table",
    source="pharos; Sutton et al. (2000), Schulman et al. (2016, 2017)",
    complexity="representation",
    version=1,
    depends="representation",
    on_request=True,
)
register(
    "kernel_learning_time",
    _of_representation(kernel_learning_time),
    definition="time after which gradient flow in the kernel (trace 1) has learnt 90 % of the energy of A* = Q* - V*",
    source="pharos; Jacot, Gabriel and Hongler (2018)",
    complexity="representation",
    version=1,
    depends="representation",
    on_request=True,
)
register(
    "kernel_sample_complexity",
    _of_representation(kernel_sample_complexity),
    definition="samples from which kernel regression explains 90 % of the variance of Q*",
    source="Simon, Dickens, Karkada and DeWeese (2023)",
    complexity="representation",
    version=1,
    depends="representation",
    on_request=True,
)
register(
    "aliasing_floor",
    _of_representation(aliasing_floor),
    definition="E Var(Q* | observation) / Var Q*: what no function of the observation explains",
    source="pharos",
    complexity="representation",
    version=1,
    depends="representation",
    on_request=True,
)
