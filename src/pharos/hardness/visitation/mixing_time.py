"""How many steps until a policy has forgotten where it began.

How much rarer an exploring policy is where the optimal policy goes: the distribution mismatch coefficient.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy  # whose `sparse` is loaded where it is used

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.gaps.gaps import optimal_solution
from pharos.hardness.interval import Interval
from pharos.hardness.visitation.occupancy import discounted_arrivals, support_with_ends
from pharos.mdp import ExpandedMDP, PolicyTable, TabularMDP, require_mdp
from pharos.solvers import Solution
from pharos.system.compiling import Stopwatch

MOST_NODES = 4096
ROUNDING = 1e-12  # of a distance, that a tie with epsilon is one


@dataclass(frozen=True)
class MixingTime:
    """How long a policy takes to forget where it began.

    Attributes:
        value: t_mix in steps; infinite where the chain does not converge.
        period: of the recurrent class; 0 where there are several.
        distance: the total variation distance at t_mix.
        conventions: epsilon, restart, policy, nodes.
    """

    value: float
    period: int
    distance: float
    conventions: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; an infinite time is None."""
        finite = math.isfinite(self.value)
        return {
            "value": self.value if finite else None,
            "infinite": not finite,
            "period": self.period,
            "distance": self.distance,
            **self.conventions,
        }

    def __str__(self) -> str:
        if math.isfinite(self.value):
            return f"{self.value:.0f}"
        return f"infinite (period {self.period})" if self.period else "infinite (several recurrent classes)"


@require_mdp
def mixing_time(
    mdp: TabularMDP, policy: Any = None, *, epsilon: float = 0.25, restart: bool = True, lazy: bool = False
) -> MixingTime:
    """Return the mixing time of the Markov chain of a policy.

        t_mix = min t with max over s of 1/2 sum over s' of |P^t(s, s') - mu(s')| <= epsilon,   mu P = mu

    Args:
        policy: as for `evaluate_policy`; None: uniform.
        epsilon: in (0, 1/2).
        restart: an action in a terminal state leads back to the start, as for the diameter.
        lazy: of the chain (I + P) / 2, which has no period.
    Returns:
        A MixingTime; infinite where the chain has a period, or several recurrent classes.
    Raises:
        UndefinedMeasure: there are more than 4096 nodes (states, under sticky actions pairs with the previous action).
        ParameterError: an option or the policy is wrong.
    Cost: 2 log2(t_mix) products of N x N matrices.
    Source: Kearns and Singh (2002); Levin, Peres and Wilmer (2009), "Markov chains and mixing times", section 4.5.
    """
    if isinstance(epsilon, bool) or not isinstance(epsilon, int | float | np.floating) or not 0 < epsilon < 0.5:
        raise ParameterError(f"epsilon is {epsilon!r}; expected a number between 0 and 1/2")
    if mdp.num_states > 100 * MOST_NODES:  # too many to be written out, even if few can be reached
        raise UndefinedMeasure(_too_many(mdp.num_states))
    choices = ExpandedMDP.of(mdp, restart).reachable()
    size = len(choices.underlying)
    if size > MOST_NODES:
        raise UndefinedMeasure(_too_many(size))
    table = PolicyTable.of(mdp, policy)
    inside = np.minimum(choices.underlying, mdp.num_states - 1)
    actions = table.probabilities[inside, choices.previous if table.looks_back else 0]
    chain = scipy.sparse.csr_matrix(choices.matrix.multiply(actions.reshape(-1, 1)))
    owner = scipy.sparse.csr_matrix(
        (np.ones(chain.shape[0]), (np.repeat(np.arange(size), mdp.num_actions), np.arange(chain.shape[0])))
    )
    chain = scipy.sparse.csr_matrix(owner @ chain)
    if mdp.is_sticky:
        chain = _merged(chain, choices.underlying, np.append(np.asarray(mdp.terminal), True))
        size = chain.shape[0]
    chain.eliminate_zeros()
    if lazy:
        chain = scipy.sparse.csr_matrix((chain + scipy.sparse.identity(size)) / 2)
    conventions = {
        "epsilon": float(epsilon),
        "restart": restart,
        "lazy": lazy,
        "policy": "uniform" if policy is None else "given",
        "nodes": size,
    }
    period = _period(chain)
    if period != 1:
        return MixingTime(math.inf, period, 1.0, conventions)
    steps, distance = _time(chain.toarray(), float(epsilon))
    return MixingTime(float(steps), 1, distance, conventions)


def _merged(chain: Any, underlying: np.ndarray, ended: np.ndarray) -> Any:
    """The chain in which an episode that has ended does not remember the previous action."""
    label = np.where(ended[underlying], underlying, len(ended) + np.arange(len(underlying)))
    _, first, place = np.unique(label, return_index=True, return_inverse=True)
    members = scipy.sparse.csr_matrix((np.ones(len(place)), (np.arange(len(place)), place)))
    return scipy.sparse.csr_matrix(chain[first] @ members)


def _too_many(nodes: int) -> str:
    return (
        f"mixing_time: {nodes} nodes are more than the {MOST_NODES} whose matrix fits; a smaller instance "
        f"would define it"
    )


def _period(chain: Any) -> int:
    """The period of the recurrent class; 0 where there are several."""
    count, labels = scipy.sparse.csgraph.connected_components(chain, directed=True, connection="strong")
    rows, columns = chain.nonzero()
    leaves = np.zeros(count, np.bool_)
    leaves[labels[rows][labels[rows] != labels[columns]]] = True
    closed = np.flatnonzero(~leaves)
    if len(closed) != 1:
        return 0
    members = np.flatnonzero(labels == closed[0])
    inner = chain[members][:, members]
    order, before = scipy.sparse.csgraph.breadth_first_order(inner, 0)
    level = np.zeros(len(members), np.int64)
    for node in order[1:]:
        level[node] = level[before[node]] + 1
    rows, columns = inner.nonzero()
    return int(np.gcd.reduce(level[rows] + 1 - level[columns]))


def _time(chain: np.ndarray, epsilon: float) -> tuple[int, float]:
    """(t_mix, distance there): squares until it is near enough, then bisection by the squares on the way."""
    size = len(chain)
    epsilon += ROUNDING
    system = np.vstack([chain.T - np.eye(size), np.ones(size)])
    stationary = np.linalg.lstsq(system, np.append(np.zeros(size), 1.0), rcond=None)[0]

    def distance(power: np.ndarray) -> float:
        return float(0.5 * np.abs(power - stationary).sum(axis=1).max())

    if distance(np.eye(size)) <= epsilon:
        return 0, distance(np.eye(size))
    powers = [chain]
    while distance(powers[-1]) > epsilon:
        powers.append(powers[-1] @ powers[-1])
        if len(powers) > 60:
            raise UndefinedMeasure("mixing_time: the chain takes more than 2^60 steps")
    steps, reached = 0, np.eye(size)  # the largest t that is not near enough
    for i in range(len(powers) - 2, -1, -1):
        further = reached @ powers[i]
        if distance(further) > epsilon:
            steps, reached = steps + 2**i, further
    return steps + 1, distance(reached @ chain)


# Mismatch -------------------------------------------------------------------------------------------------------------


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
