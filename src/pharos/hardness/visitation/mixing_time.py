"""How many steps until a policy has forgotten where it began."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy  # whose `sparse` is loaded where it is used

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.mdp import ExpandedMDP, PolicyTable, TabularMDP, require_mdp

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
