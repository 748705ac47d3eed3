"""How much rarer an exploring policy is where the optimal policy goes: the distribution mismatch coefficient."""

import math
from typing import Any

import numpy as np

from pharos.errors import UndefinedMeasure
from pharos.hardness.gaps.gaps import optimal_solution
from pharos.hardness.interval import Interval
from pharos.hardness.visitation.occupancy import discounted_arrivals, support_with_ends
from pharos.mdp import TabularMDP, require_mdp
from pharos.solvers import Solution
from pharos.system.compiling import Stopwatch


@require_mdp
def distribution_mismatch(
    mdp: TabularMDP, policy: Any = None, solution: Solution | None = None, *, tolerance: float = 1e-9
) -> Interval:
    """Return the distribution mismatch coefficient of a policy.

        max over s with d*(s) > 0 of d*(s) / d(s),   d(s) = sum over t of gamma^t P(s_t = s),   t = 0, 1, ...

    over all states, terminal ones and the implicit end of an episode among them, which are never left. d* is that of
    the optimal policy that takes the first of the best actions everywhere, d that of `policy`, both from the start. The
    result is at least 1.

    Args:
        policy: as for `evaluate_policy`; None: uniform.
        solution: the optimal solution of `mdp`; None: solved here to an error of 1e-9, or what floats reach.
        tolerance: of the sums of d and of d*.
    Returns:
        An interval: it is wide where d(s) is not much larger than `tolerance`, and infinite at the upper end where it
        is smaller.
    Raises:
        UndefinedMeasure: gamma is 1, or there is a horizon: the optimal policy then depends on the step.
        ParameterError: `solution` is not of this MDP, or an argument is wrong.
    Cost: two occupancy measures.
    Source: Kakade and Langford (2002); Agarwal, Kakade, Lee and Mahajan (2021), "On the theory of policy gradient
        methods", section 4.2.
    """
    watch = Stopwatch()
    if mdp.horizon is not None or mdp.gamma == 1.0:
        raise UndefinedMeasure(
            "distribution_mismatch is defined for discounted MDPs without a horizon: give gamma < 1 and no horizon"
        )
    solution = optimal_solution(mdp, solution)
    best, lacking = discounted_arrivals(mdp, solution.policy, tolerance=tolerance)
    other, missing = discounted_arrivals(mdp, policy, tolerance=tolerance)
    there = support_with_ends(mdp, solution.policy)
    # All numbers are sums of products, each of at most as many factors as there are steps that count.
    steps = mdp.num_states + 32 / (1 - mdp.gamma)
    rounding = 4 * (mdp.num_actions + mdp.dynamics.operations + 8) * steps * 2.0**-53
    one, two = best[there], other[there]
    with np.errstate(divide="ignore", invalid="ignore"):
        lower = float(np.nanmax(one / (two + missing), initial=0.0)) * (1 - rounding)
        upper = float(np.nanmax((one + lacking) / two, initial=0.0)) * (1 + rounding)
    # Both are distributions times 1 / (1 - gamma): somewhere d* is at least d.
    lower, upper = max(lower, 1.0), max(upper, 1.0)
    return Interval(
        lower,
        upper,
        exact=math.isfinite(upper) and upper - lower <= 1e-6 * upper,
        tolerance=1e-6,
        method="occupancy measures",
        conventions={"gamma": mdp.gamma, "policy": "uniform" if policy is None else "given"},
        note="" if math.isfinite(upper) else "the policy hardly ever reaches a state of the optimal policy",
        seconds=watch.seconds,
    )
