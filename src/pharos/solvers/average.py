"""Long-run average reward, the *gain*, of the best, the worst or a given policy, with bounds from both sides, and its
bias.

Nodes are states, under sticky actions pairs (state, previously executed action). With T_a h(n) = r(n, a) + sum_m
p(m | n, a) h(m):

1. End components first: whoever goes on for ever does so in one of them. Inside, every node can reach every other one,
   so that all have the same best gain g. For any h whatever, g <= max T_a h(n) - h(n) over all nodes and choices, and a
   policy a has at least min T_a h(n) - h(n) over all nodes: the bounds come from one backup, its rounding included.
2. A good h is the bias of the best policy. Damped sweeps h + (T h - h) / 2 - constant, which converge if a chain is
periodic, too. Then policy iteration from there. A policy is solved for by what it earns, and the steps it takes,
   until it comes back to one node. A policy with several recurrent classes is led to the best one first: in an end
   component it can be.
3. Components become one node each, which may stop and be paid its gain. Then the gain of a node is a total reward
   (`goals.py`): the mean of the gains of the components in which it ends up, 0 if the episode ends.

A policy makes a Markov chain, whose recurrent classes are its end components, and with one choice a node the same three
steps hold. Its bias is what it earns beyond its gain, h = lim sum over t of E r_t - g: in a recurrent class h is known
up to a constant, which is such that the stationary mean of h is 0. Elsewhere h is the total of r - g until a class is
entered, and then its bias. All are expected sums until a node is reached, each within what its residual proves.

Source: Puterman (2005), sections 8.2, 8.5, 9.1, 9.5; Haviv and Puterman (1991), "An improved algorithm for solving
communicating average reward Markov decision processes"; components first: Ashok, Chatterjee, Daca, Kretinsky and
Meggendorfer (2017), "Value iteration for long-run average reward in Markov decision processes".
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pharos.errors import PrecisionError, UnknownName
from pharos.kernels import hitting
from pharos.kernels.hitting import UNIT
from pharos.mdp import BEST, WORST, PolicyTable, Selection, TabularMDP, end_components, require_mdp, stand_ins
from pharos.solvers.chains import Chain
from pharos.solvers.goals import (
    BOUND_MARGIN,
    MOST_UNSWEPT_NODES,
    Choices,
    GoalProblem,
    WrittenOut,
    best_rows,
    recurrent_classes,
)
from pharos.solvers.policy_iteration import DENSE
from pharos.solvers.reaching import StateBounds
from pharos.solvers.values import TableAgent, TablePolicy

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# Sweeps before policies are improved, and in all; the damping, which makes chains aperiodic.
FIRST_SWEEPS, MOST_GAIN_SWEEPS, DAMPING = 32, 100_000, 0.5
# Outcomes that all sweeps of one component may read, some ten seconds.
MOST_READ = 3e9
# Damped steps after which the likeliest node of a class is the one to come back to.
HOMING = 32
# Improvements of a policy, at most.
MOST_GAIN_IMPROVEMENTS = 200
POLICIES = ("optimal", "worst")
"""Names of the policies that are found."""


class GainInterval(NamedTuple):
    """A number between two proven bounds."""

    lower: float
    upper: float

    def __str__(self) -> str:
        return f"[{self.lower:.8g}, {self.upper:.8g}]"


@dataclass(frozen=True, eq=False)
class AverageReward:
    """The long-run average reward of a policy, from each state.

    Attributes:
        mdp: with no horizon, whatever was given. Its discount does not count.
        kind: "optimal", "worst" or "policy".
        gain: `lower` and `upper` (S,), proven bounds of the average reward a step in the long run.
        policy: one whose gain is as near to the optimal (or worst) one as the bounds are, or the one that was given:
            (S,) actions or (S, A) probabilities, under sticky actions (S, A + 1) actions or (S, A + 1, A).
        tolerance: half of the widest interval of a gain, at most.

    Under sticky actions the numbers of a state belong to an episode that starts in it, without a previous action.
    """

    mdp: TabularMDP
    kind: str
    gain: StateBounds
    policy: np.ndarray
    tolerance: float

    @property
    def gain_at_start(self) -> "GainInterval":
        """The gain of an episode's first state."""
        return self.at_start(self.gain)

    def at_start(self, bounds: StateBounds) -> "GainInterval":
        """The mean over an episode's first state of numbers of the states, within bounds (S,)."""
        lower, upper = (
            float(self.mdp.start_probabilities @ each[self.mdp.start_states]) for each in (bounds.lower, bounds.upper)
        )
        terms = len(self.mdp.start_states) + 4
        room = terms * UNIT * float(np.abs([bounds.lower, bounds.upper])[:, self.mdp.start_states].max())
        return GainInterval(lower - room, upper + room)

    @cached_property
    def bias(self) -> StateBounds:
        """Surplus of `policy` over its gain: `lower` and `upper` (S,), proven.

        h(s) = sum over t of E r_t - g(s), summed in the mean (Cesaro) if the chain is periodic. So the stationary
        mean of h is 0 in each recurrent class, and h is 0 at the end. Of two states of one class the difference says
        how much more is earned from the one than from the other, in all.

        Raises:
            PrecisionError: the equations are too large, or floats do not prove a bound.
        Cost: linear equations of the policy's chain, up to 20,000 nodes, or more if elimination fills little in.
        Source: Puterman (2005), section 8.2.
        """
        return _bias(self.mdp, PolicyTable.of(self.mdp, self.policy))

    def __repr__(self) -> str:
        return f"AverageReward({self.kind}, gain_at_start={self.gain_at_start})"


@require_mdp
def average_reward(
    mdp: TabularMDP, policy: TablePolicy | str | None = None, *, tolerance: float = 1e-6
) -> AverageReward:
    """The long-run average reward a step, and the bias, of the best or another policy, with proven bounds.

    g(s) = lim 1/T sum over t < T of E r_t. Discount and horizon of the MDP do not count: play goes on for ever. If an
    episode ends, nothing more is paid, so the gain is 0.

    Args:
        policy: None or "optimal", "uniform", "worst", or a policy as `evaluate_policy` takes it.
        tolerance: each gain is within this of the middle of its bounds.
    Returns:
        An `AverageReward` with `gain`, `gain_at_start`, `policy` and `bias`.
    Raises:
        ParameterError: the policy has the wrong shape. UnknownName: no such policy.
        PrecisionError: floats, within limits of time, prove no bound within the tolerance.
    Cost: nodes and outcomes are written out, 12 bytes an outcome. Sweeps, and linear equations of some policies of each
        end component, in components of more than 20,000 nodes if elimination fills little in, else sweeps alone.
    Source: Puterman (2005), chapters 8 and 9; Ashok et al. (2017).
    """
    mdp = mdp.with_horizon(None)
    select = _selection(mdp, policy)
    nodes = WrittenOut.of(mdp, select)
    nodes.matrix.eliminate_zeros()
    component, inside = _components(nodes, select)
    stops, errors, staying = _gains(nodes, component, inside, tolerance / 2)
    room = float(errors.max(initial=0.0))
    v, error, choices = _ends(nodes, component, inside, stops, room, staying, tolerance / 4)
    gain = _of_states(mdp, select, v - error, v + error)
    if not (gain.upper - gain.lower).max(initial=0.0) <= 2 * tolerance and not any(mdp.residual):
        raise _precision_error(mdp, tolerance)
    if isinstance(select, PolicyTable):
        return AverageReward(mdp, select.kind, gain, select.table, tolerance)
    return AverageReward(mdp, select.kind, gain, _policy_table(mdp, nodes.sign, v, choices), tolerance)


def _selection(mdp: TabularMDP, policy: TablePolicy | str | None) -> Selection:
    if policy is None or isinstance(policy, str):
        if policy == "uniform":
            return PolicyTable.of(mdp)
        if policy is not None and policy not in POLICIES:
            raise UnknownName("policy", policy, [*POLICIES, "uniform"])
        return WORST if policy == "worst" else BEST
    return PolicyTable.of(mdp, policy.policy_table() if isinstance(policy, TableAgent) else policy)


def _precision_error(mdp: TabularMDP, tolerance: float) -> PrecisionError:
    return PrecisionError(
        f"{mdp}: 64-bit floats, within limits of time, prove no average reward to a tolerance of {tolerance:g}; raise "
        "the tolerance, or discount (gamma < 1)"
    )


# Components -----------------------------------------------------------------------------------------------------------


def _components(nodes: WrittenOut, select: Selection) -> tuple[np.ndarray, np.ndarray]:
    """((N,) end component of each node, -1 for none, (N C,) bool, the choices that stay in one)."""
    if isinstance(select, PolicyTable):
        return recurrent_classes(nodes.matrix, nodes.live)
    components = end_components(nodes.mdp)
    return components.labels.ravel(), components.pairs.ravel()


def _gains(
    nodes: WrittenOut, component: np.ndarray, inside: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((K,) the gain of each component, to be maximised, (K,) the error of each, (N,) choices that attain it)."""
    total, per_node = int(component.max(initial=-1)) + 1, nodes.per_node
    rows = np.flatnonzero(inside)
    labels = component[rows // per_node]
    rewards = nodes.sign * nodes.rewards[rows]
    staying = np.zeros(len(component), np.int64)
    staying[rows[::-1] // per_node] = rows[::-1] % per_node
    least, most = np.full(total, np.inf), np.full(total, -np.inf)
    np.minimum.at(least, labels, rewards)
    np.maximum.at(most, labels, rewards)
    # if all choices pay the same, or a node stays for ever alone, there is nothing to solve
    size = np.bincount(component[component >= 0], minlength=total)
    alone = np.flatnonzero(size[labels] == 1)
    at = alone[rewards[alone] == most[labels[alone]]][::-1]
    staying[rows[at] // per_node] = rows[at] % per_node
    gains, error = most.copy(), np.full(total, nodes.error.max(initial=0.0) + nodes.mdp.residual.rewards)
    order = np.argsort(labels, kind="stable")
    ends = np.searchsorted(labels[order], np.arange(total + 1))
    for k in np.flatnonzero((least < most) & (size > 1)):
        choices = _inner(nodes, rows[order[ends[k] : ends[k + 1]]])
        mean = MeanPayoff(choices)
        mean.solve(tolerance)
        gains[k], error[k] = (mean.upper + mean.lower) / 2, (mean.upper - mean.lower) / 2 * BOUND_MARGIN
        error[k] += 2 * UNIT * abs(gains[k])
        if not error[k] <= tolerance and not any(nodes.mdp.residual):
            raise _precision_error(nodes.mdp, 2 * tolerance)
        origin = choices.origin[mean.policy]
        staying[origin // per_node] = origin % per_node
    return gains, error, staying


def _inner(nodes: WrittenOut, rows: np.ndarray) -> Choices:
    """The choices (R,) of one component, by node. The last column of their outcomes is never reached."""
    from scipy import sparse

    members, owner = np.unique(rows // nodes.per_node, return_inverse=True)
    part = nodes.matrix[rows]
    column = np.searchsorted(members, part.indices)
    stays = column == np.repeat(owner, np.diff(part.indptr))
    data = np.where(stays, 0.0, part.data)
    matrix = sparse.csr_matrix((data, column, part.indptr), shape=(len(rows), len(members) + 1))
    matrix.eliminate_zeros()
    terms = int(np.diff(part.indptr).max(initial=0)) + nodes.mdp.num_actions + nodes.mdp.dynamics.operations
    residual = nodes.mdp.residual
    return Choices(
        matrix=matrix,
        rows=np.searchsorted(owner, np.arange(len(members) + 1)),
        owner=owner,
        rewards=nodes.sign * nodes.rewards[rows],
        error=nodes.error[rows] + residual.rewards,
        origin=rows,
        terms=terms,
        deviation=residual.probabilities,
    )


class MeanPayoff:
    """The best mean reward in an end component.

    Attributes:
        lower, upper: of the gain, the same for all nodes. policy: (M,) rows, whose gain is at least `lower`.
    """

    def __init__(self, choices: Choices):
        self.choices = choices
        self.lower, self.upper = -np.inf, np.inf
        self.policy = choices.rows[:-1].copy()

    def solve(self, tolerance: float) -> None:
        """Sweep, improve policies, and sweep on if that fails, until the bounds are as near as the tolerance."""
        sweeps = Sweeps(self.choices)
        sweeps.go_on(FIRST_SWEEPS, tolerance)
        if self._is_met(sweeps.h, tolerance) or self._improve(tolerance) or self._in_rational_numbers():
            return
        is_settled = False
        most = min(MOST_GAIN_SWEEPS, MOST_READ / (self.choices.matrix.nnz + len(self.choices.owner)))
        while not (self._is_met(sweeps.h, tolerance) or is_settled or sweeps.count >= most):
            is_settled = sweeps.go_on(sweeps.count, tolerance)
        self._bound(sweeps.h)

    def _is_met(self, h: np.ndarray, tolerance: float) -> bool:
        """Whether the bounds are near enough, also the ones that h (M + 1,) gives."""
        self._bound(h)
        return self.upper - self.lower <= 2 * tolerance * (1 - 2.0**-20)

    def _bound(self, h: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take the bounds of h (M + 1,). Return ((R,) residuals, (R,) error of each, (M,) best rows)."""
        choices = self.choices
        total, slack = choices.residuals(h)
        slack = slack + choices.error
        best = best_rows(choices, total)
        lower = float((total - slack)[best].min())
        if lower > self.lower:
            self.lower, self.policy = lower, best
        self.upper = min(self.upper, float((total + slack).max()))
        return total, slack, best

    def _improve(self, tolerance: float) -> bool:
        """Policy iteration from the policy so far. Return whether the bounds are near enough."""
        policy, choices = self.policy, self.choices
        for _ in range(MOST_GAIN_IMPROVEMENTS):
            policy, class_of = self._towards_one_class(policy)
            h = _solved(choices, policy, class_of, np.ones(len(policy), np.bool_))[0]
            if not np.isfinite(h).all():
                return False
            total, slack, best = self._bound(h)
            if self.upper - self.lower <= 2 * tolerance * (1 - 2.0**-20):
                return True
            own = total[policy]  # the gain everywhere, but for rounding, which h has, too
            is_better = total[best] - own > slack[best] + slack[policy] + 2 * (own.max() - own.min())
            if not is_better.any():
                return False
            policy = np.where(is_better, best, policy)
        return False

    def _in_rational_numbers(self) -> bool:
        """The same in rational numbers, if floats do not hold h. Return whether there was room for them."""
        from pharos.solvers.rational import best_mean, fractions_of

        small = self.choices.num_nodes <= DENSE and not self.choices.deviation
        rows = fractions_of(self.choices) if small else None
        if rows is None:
            return False
        policy = self.policy
        for _ in range(MOST_GAIN_IMPROVEMENTS):
            policy, class_of = self._towards_one_class(policy)
            result = best_mean(self.choices, rows, policy, class_of)
            if result is None:
                return False
            gain, better = result
            if np.array_equal(better, policy):
                room = float(self.choices.error.max()) + 2 * UNIT * abs(float(gain)) + 2.0**-1074
                self.lower, self.upper, self.policy = float(gain) - room, float(gain) + room, policy
                return True
            policy = better
        return False

    def _towards_one_class(self, policy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(A policy (M,) with one recurrent class, the best one of a policy, (M,) 0 inside the class, else -1)."""
        choices, nodes = self.choices, np.ones(self.choices.num_nodes, np.bool_)
        class_of, _ = recurrent_classes(choices.matrix[policy], nodes)
        if not class_of.max() > 0:
            return policy, class_of
        gains = _solved(choices, policy, class_of, class_of >= 0)[1]
        target = int(np.nanargmax(gains)) if np.isfinite(gains).any() else 0
        goal = np.append(class_of == target, False)
        goal[:-1] = _surely(choices.matrix[policy], np.arange(len(policy) + 1), goal)[0][:-1]
        towards = _surely(choices.matrix, choices.rows, goal)[1]
        return np.where(goal[:-1], policy, towards[:-1]), np.where(class_of == target, 0, -1)


def _surely(matrix: "csr_matrix", rows: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((M + 1,) bool whether some choices surely lead to the goal (M + 1,) bool, (M + 1,) rows that do)."""
    sure, scratch, policy = np.empty(len(goal), np.bool_), np.empty(len(goal), np.bool_), np.zeros(len(goal), np.int64)
    bounds = np.append(rows, rows[-1]).astype(np.int64)
    hitting.almost_surely(
        matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64), bounds, goal, sure, scratch, policy
    )
    return sure, policy


class Sweeps:
    """Damped relative value iteration: h + (T h - h) / 2, less what its first entry is.

    Attributes:
        h: (M + 1,). count: sweeps so far.
    """

    def __init__(self, choices: Choices):
        self.choices, self.count = choices, 0
        self.h = np.zeros(choices.num_nodes + 1)
        self._leaving = np.asarray(choices.matrix.sum(axis=1)).ravel()

    def go_on(self, sweeps: int, tolerance: float) -> bool:
        """Sweep so often, or until the span of T h - h is a half of what the tolerance allows. Return whether it is."""
        choices, h = self.choices, self.h
        for _ in range(sweeps):
            total = choices.rewards + choices.matrix @ h - self._leaving * h[choices.owner]
            change = np.maximum.reduceat(total, choices.rows[:-1])
            self.count += 1
            if change.max() - change.min() <= tolerance:
                return True
            h[:-1] += DAMPING * change
            h[:-1] -= h[0]
        return False


# Chains ---------------------------------------------------------------------------------------------------------------


class Sums:
    """Expected sums under a policy (M,) until play leaves some nodes: x with (1 - P) x = b there, 0 elsewhere."""

    def __init__(self, choices: Choices, policy: np.ndarray, inside: np.ndarray):
        """inside: (M,) bool, the nodes, each of which is left almost surely."""
        from scipy import sparse

        self.nodes, self.num_nodes = np.flatnonzero(inside), choices.num_nodes
        count = len(self.nodes)
        number = np.full(self.num_nodes + 1, count)
        number[self.nodes] = np.arange(count)
        part = choices.matrix[policy[self.nodes]]
        matrix = sparse.csr_matrix((part.data, number[part.indices], part.indptr), shape=(count, count + 1))
        matrix.sum_duplicates()
        own = np.arange(count)
        self.choices = choices._replace(
            matrix=matrix, rows=np.arange(count + 1), owner=own, rewards=np.zeros(count), origin=own
        )
        self.chain = Chain(matrix, float)

    def until(self, b: np.ndarray) -> np.ndarray:
        """(M + 1,) x of b (M,), as floats have it, or NaN if it cannot be solved for."""
        x = np.zeros(self.num_nodes + 1)
        x[self.nodes] = self.chain.solve(b[self.nodes])[:-1]
        return x

    def bounded(self, b: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((M + 1,) x, (M + 1,) error of each) of b (M,), each within an error (M,).

        |x - X| <= w if (1 - P) w >= the residuals of x, with their rounding and the error of b.
        """
        b, error = b[self.nodes], error[self.nodes]
        v = self.chain.solve(b)
        total, slack = self.choices.residuals(v, b)
        off = np.abs(total) + slack + error
        w = self.chain.solve(2 * off + 2.0**-20 * off.max(initial=0.0) + 2.0**-1000)
        more, rounding = self.choices.residuals(w, np.zeros(len(b)))
        if not ((off + more + rounding <= 0).all() and (w >= 0).all()):
            v, w = self._rational(b, error)
        x, room = np.zeros(self.num_nodes + 1), np.zeros(self.num_nodes + 1)
        x[self.nodes], room[self.nodes] = v[:-1], w[:-1] * BOUND_MARGIN
        return x, room

    def _rational(self, b: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same of the nodes that it solves for, if floats are too short."""
        from pharos.solvers.rational import exact_sums, fractions_of

        rows, sums = fractions_of(self.choices), None
        if rows is not None and not self.choices.deviation:
            after = [row[1] for row in rows]
            sums = [exact_sums(after, [Fraction(float(x)) for x in each]) for each in (b, error)]
        if sums is None or sums[0] is None or sums[1] is None:
            raise PrecisionError(
                f"64-bit floats prove no bias of {self.num_nodes} nodes, which are too many for rational numbers"
            )
        x, room = (np.array([*map(float, each), 0.0]) for each in sums if each is not None)
        return x, room + 2.0**-52 * np.abs(x) + 2.0**-1074


def _homes(matrix: "csr_matrix", class_of: np.ndarray) -> np.ndarray:
    """(K,) a node of each class that is come back to soon: one of the largest probability after some damped steps.

    matrix: (M, M + 1) of a policy, without what stays. class_of: (M,) the recurrent class of each node, -1: none.
    """
    inside = np.flatnonzero(class_of >= 0)
    steps, leaving = matrix[:, :-1].T.tocsr(), np.asarray(matrix.sum(axis=1)).ravel()
    mass = (class_of >= 0) * 1.0
    for _ in range(HOMING):
        mass += DAMPING * (steps @ mass - leaving * mass)
    order = inside[np.lexsort((-mass[inside], class_of[inside]))]
    return order[np.searchsorted(class_of[order], np.arange(int(class_of.max(initial=-1)) + 1))]


def _solved(
    choices: Choices, policy: np.ndarray, class_of: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """((M + 1,) h, 0 at the home of each class, (K,) mean rewards) of a policy, NaN if it is not solved for.

    Args:
        class_of: (M,) the recurrent class of each node, -1: none.
        inside: (M,) bool: the nodes to solve for: the nodes of the classes, and others, too, if there is one class.
    """
    home = _homes(choices.matrix[policy], class_of)
    inside = inside.copy()
    inside[home] = False
    sums, rewards, ones = Sums(choices, policy, inside), choices.rewards[policy], np.ones(len(policy))
    x, steps = sums.until(rewards), sums.until(ones)
    again = choices.matrix[policy[home]]
    with np.errstate(all="ignore"):
        gains = (rewards[home] + again @ x) / (1 + again @ steps)
    of_nodes = gains[0] if len(home) == 1 else np.append(gains, 0.0)[np.append(class_of, -1)]
    return x - of_nodes * steps, gains


# Components in which play ends ----------------------------------------------------------------------------------------


def _ends(
    nodes: WrittenOut,
    component: np.ndarray,
    inside: np.ndarray,
    stops: np.ndarray,
    room: float,
    staying: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((N,) gains, (N,) error of each, (N,) choices) if the components are paid `stops` (K,), each within `room`."""
    count, live = len(nodes.live), nodes.live
    may_end = bool((nodes.matrix.indices == count).any())
    amounts = np.unique(np.append(stops, 0.0) if may_end or not len(stops) else stops)
    if len(amounts) == 1:
        v, error = np.where(live, nodes.sign * amounts[0], 0.0), np.where(live, room, 0.0)
        return v, error, staying
    nothing = np.zeros(len(nodes.rewards))
    problem = GoalProblem.collapsed(nodes, component, inside, stops, nothing, nothing, staying)
    if problem.choices.num_nodes > MOST_UNSWEPT_NODES:
        v, error, choices = _swept_ends(problem, tolerance)
    else:
        goals = problem.solve(tolerance)
        v, error, choices = goals.v, goals.error, goals.policy
    return v, np.where(live, (error + room) * BOUND_MARGIN, 0.0), choices


def _swept_ends(problem: GoalProblem, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same as `_ends`, by sweeps from above and from below: there is no component left, so that both meet.

    Source: Haddad and Monmege (2018), "Interval iteration algorithm for MDPs and IMDPs".
    """
    choices = problem.choices
    leaving = np.asarray(choices.matrix.sum(axis=1)).ravel()
    largest = float(np.abs(choices.rewards).max(initial=0.0))
    step = (choices.terms + 24) * UNIT * largest + choices.deviation * 2 * largest
    lower, upper = (np.append(np.full(choices.num_nodes, each), 0.0) for each in (-largest, largest))
    for sweep in range(int(min(MOST_GAIN_SWEEPS, MOST_READ / (2 * choices.matrix.nnz)))):
        for bound, side in ((lower, -1.0), (upper, 1.0)):
            values = (choices.rewards + choices.matrix @ bound) / leaving
            moved = np.maximum.reduceat(values, choices.rows[:-1]) + side * step
            bound[:-1] = np.maximum(bound[:-1], moved) if side < 0 else np.minimum(bound[:-1], moved)
        if sweep % 8 == 7 and (upper - lower).max() <= 2 * tolerance:
            break
    else:
        raise _precision_error(problem.mdp, tolerance)
    best = best_rows(choices, (choices.rewards + choices.matrix @ lower) / leaving)
    middle, half = (upper + lower) / 2, (upper - lower) / 2 * BOUND_MARGIN
    of_nodes = problem.node_of[:-2]
    return problem.sign * middle[of_nodes], half[of_nodes], problem.unfolded(choices.origin[best])


# States ---------------------------------------------------------------------------------------------------------------


def _first_values(mdp: TabularMDP, x: np.ndarray, rewards: np.ndarray | float = 0.0) -> np.ndarray:
    """(S, A) rewards, plus the numbers x (N,) of the nodes that executing an action leads to."""
    numbers = np.zeros((mdp.num_states + 1, mdp.width))
    numbers[:-1] = x.reshape(mdp.num_states, mdp.width)
    return np.asarray(rewards + mdp.acting(mdp.dynamics.expected(numbers), slice(None)))


def _of_states(
    mdp: TabularMDP, select: Selection, lower: np.ndarray, upper: np.ndarray, rewards: np.ndarray | float = 0.0
) -> StateBounds:
    """StateBounds of the states, without a previous action, from the bounds of the nodes (N,)."""
    if mdp.is_sticky:
        first, bounds = mdp.chance.first, []
        for x, side in ((lower, -1.0), (upper, 1.0)):
            q = _first_values(mdp, x, rewards)
            value = select.first_value(q)
            room = (mdp.dynamics.operations + 2 * mdp.num_actions + 24) * UNIT * np.abs(q).max(initial=0.0)
            room += mdp.residual.deviation(1.0, float(np.abs(x).max(initial=0.0)))
            bounds.append(first.choice(q, value if first.chosen else np.zeros_like(value))[:, 0] + side * room)
        lower, upper = bounds
    live = ~np.asarray(mdp.terminal)
    room = 2 * UNIT * np.maximum(np.abs(lower), np.abs(upper))
    return StateBounds(np.where(live, lower - room, 0.0), np.where(live, upper + room, 0.0))


def _policy_table(mdp: TabularMDP, sign: float, v: np.ndarray, choices: np.ndarray) -> np.ndarray:
    """A policy as users write it, from choices (N,) of the nodes, whose gains are v (N,)."""
    by_node = choices.reshape(mdp.num_states, mdp.width)
    if mdp.is_sticky:
        q = sign * _first_values(mdp, v)
        by_node = np.concatenate([by_node, q.argmax(axis=1)[:, None]], axis=1)
    if mdp.available is not None:
        by_node = stand_ins(mdp.available)[np.arange(mdp.num_states)[:, None], by_node]
    return by_node[:, 0].copy() if (by_node == by_node[:, :1]).all() else by_node


def _bias(mdp: TabularMDP, select: PolicyTable) -> StateBounds:
    nodes = WrittenOut.of(mdp, select)
    nodes.matrix.eliminate_zeros()
    members = np.flatnonzero(nodes.live)
    choices = _inner(nodes, members)
    class_of = recurrent_classes(nodes.matrix, nodes.live)[0][members]
    policy, is_recurrent, home = np.arange(len(members)), class_of >= 0, _homes(choices.matrix, class_of)
    rewards, unit = choices.rewards, (choices.terms + 24) * UNIT
    # gains of the classes, by the residuals of h
    h, _ = _solved(choices, policy, class_of, is_recurrent)
    total, slack = choices.residuals(h)
    low, high = np.full(len(home), np.inf), np.full(len(home), -np.inf)
    np.minimum.at(low, class_of[is_recurrent], (total - slack - choices.error)[is_recurrent])
    np.maximum.at(high, class_of[is_recurrent], (total + slack + choices.error)[is_recurrent])
    gains, room = (low + high) / 2, (high - low) / 2 * BOUND_MARGIN + 2 * UNIT * np.abs(low)
    g, g_error = np.zeros(len(members) + 1), np.zeros(len(members) + 1)
    g[:-1][is_recurrent], g_error[:-1][is_recurrent] = gains[class_of[is_recurrent]], room[class_of[is_recurrent]]
    # h of the classes, and its stationary mean: of one round from the home of each
    inner = is_recurrent.copy()
    inner[home] = False
    sums = Sums(choices, policy, inner)
    size = np.abs(rewards) + np.abs(g[:-1])
    h, h_error = sums.bounded(rewards - g[:-1], g_error[:-1] + choices.error + unit * size)
    steps, steps_error = sums.bounded(np.ones(len(members)), np.zeros(len(members)))
    round_of, round_error = sums.bounded(h[:-1], h_error[:-1])
    again = choices.matrix[home]
    length, length_error = 1 + again @ steps, again @ steps_error + unit * (1 + again @ steps)
    mean = again @ round_of / length
    mean_error = again @ round_error + unit * (again @ np.abs(round_of)) + np.abs(mean) * length_error
    mean_error = mean_error / (length - length_error) * BOUND_MARGIN + 4 * UNIT * np.abs(mean)
    h[:-1][is_recurrent] -= mean[class_of[is_recurrent]]
    h_error[:-1][is_recurrent] += (mean_error + 4 * UNIT * np.abs(mean))[class_of[is_recurrent]] + unit * np.abs(
        h[:-1][is_recurrent]
    )
    # elsewhere: the total of r - g until a class is entered, and then its h
    sums = Sums(choices, policy, ~is_recurrent)

    def entering(x: np.ndarray, x_error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return choices.matrix @ x, choices.matrix @ x_error + unit * (choices.matrix @ np.abs(x))

    before, before_error = sums.bounded(*entering(g, g_error))
    g, g_error = g + before, g_error + before_error
    after, after_error = entering(h, h_error)
    size = np.abs(rewards) + np.abs(g[:-1]) + np.abs(after)
    more, more_error = sums.bounded(rewards - g[:-1] + after, choices.error + g_error[:-1] + after_error + unit * size)
    h, h_error = h + more, h_error + more_error
    of_nodes = [np.zeros(len(nodes.live)) for _ in range(4)]
    for numbers, each in zip(of_nodes, (h - h_error, h + h_error, g - g_error, g + g_error), strict=True):
        numbers[members] = each[:-1]
    if not mdp.is_sticky:
        return _of_states(mdp, select, of_nodes[0], of_nodes[1])
    bias = _of_states(mdp, select, of_nodes[0], of_nodes[1], mdp.rewards)
    gain = _of_states(mdp, select, of_nodes[2], of_nodes[3])
    lower, upper = bias.lower - gain.upper, bias.upper - gain.lower
    extra = 2 * UNIT * (np.abs(lower) + np.abs(upper)) + choices.error.max(initial=0.0)
    return StateBounds(lower - extra, upper + extra)
