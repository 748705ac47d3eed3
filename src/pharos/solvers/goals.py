"""Total reward until the end, and probabilities and costs of reaching a target, with bounds from both sides.

Nodes are states, under sticky actions pairs (state, previously executed action). The value of a node is the supremum
over policies whose expected sums of positive and of negative rewards are not both infinite.

1. End components that pay nothing are collapsed: a policy may stay there for ever, so that each becomes one node with
   the choices that leave it, and one more that stops and pays 0. No other way of staying for ever has a finite value:
   whoever stays in a component that pays is paid infinitely often. So policies that end almost surely, *proper* ones,
   are all that counts. If there is none, there is no finite value.
2. Policy iteration from a proper policy, in which actions are replaced by those that are better beyond rounding alone.
   If the new policy is not proper, it stays in a component with a positive mean reward, which can be repeated before
   the end as often as one likes: the value is infinite. With T_a v(n) = r(n, a) + sum_m p(m | n, a) v(m), the mean
   reward is the mean of the residuals T_a v - v, none of which is negative.
3. Bounds. For any u with u >= T_a u everywhere and u = 0 at the end, u >= V: along each proper policy of finite value
   u plus what was paid does not rise on average. For any l with l <= T_pi l under a proper policy pi, l <= V of pi.
   Both hold for v + w and v - w, if w is what a policy collects that is paid more than the residuals of v and their
   rounding: pi for the lower bound, and for the upper one the policy that collects most.

Rows sum to 1, so T_a v(n) - v(n) = r(n, a) + sum_m p(m | n, a) (v(m) - v(n)): in this form no rounding error grows
with v itself, rows that floats do not sum to 1 are taken as divided by their sum, and a choice that stays with
probability 1 - 1e-12 loses no digit.

A policy's equations are solved by elimination without subtraction (`chains.py`), in floats, then in pairs of them: no
digit is lost if a loop is left once in 10^12 steps, and a bound is proven wherever rounding of one step, times the
steps, is less than the tolerance. If that is too much, or if actions are as good as each other, and to mix them
would never end, policy iteration is repeated in rational numbers (`rational.py`).

Source: Bertsekas and Tsitsiklis (1991), "An analysis of stochastic shortest path problems"; Haddad and Monmege (2018),
"Interval iteration algorithm for MDPs and IMDPs"; Baier et al. (2018), "Stochastic shortest paths and weight-bounded
properties in Markov decision processes".
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pharos.errors import DivergenceError, PrecisionError
from pharos.kernels import bellman, elimination, hitting
from pharos.kernels.hitting import UNIT
from pharos.mdp import (
    PolicyTable,
    Selection,
    TabularMDP,
    end_components,
    executed_actions,
    nodes_of_outcomes,
    stand_ins,
)
from pharos.solvers.chains import Chain, mean_changes
from pharos.solvers.policy_iteration import GREEDY_BLOCK

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# Pairs of a cycle that an error names.
NAMED = 6
# Improvements of a policy, at most; each changes all nodes that can be.
MOST_IMPROVEMENTS = 1000
# Improvements after which sweeps look further ahead, and how many.
SWEPT, SWEEPS = 50, 100
# Solutions of the same policy's equations, each with the rounding of the one before.
SETTLING_SOLUTIONS = 4
# Tolerances within which values may be for every MDP within the residual of one.
WIDER = 1e6
# Units of a number in its last place that may be rounding.
NOISE = 64
# More than what sums of numbers too small for a float lose.
UNDERFLOW_SLACK = 2.0**-1000
# Nodes of the largest MDP that is not swept first.
MOST_UNSWEPT_NODES = 20_000
# Sweeps of paths before their steps are looked at for a cycle.
LOOK_AHEAD = 8
# More than the rounding of the computation of a bound itself.
BOUND_MARGIN = 1 + 2.0**-30


class Choices(NamedTuple):
    """Choices of nodes, written out: the choices of node n are the rows rows[n] to rows[n + 1].

    Attributes:
        matrix: (R, M + 1) CSR of the outcomes that leave the node. Node M is the end.
        rows: (M + 1,). owner: (R,) the node of each row.
        rewards: (R,), to be maximised. error: (R,) bound on the error of each, of one that is 0 exactly none.
        origin: (R,) node of the MDP times its choices, plus the choice. -1: to stop if nothing is paid.
        terms: the most outcomes of a row, and the numbers that a probability was computed from.
        deviation: how far the probabilities of a row may be from its own, in sum. Bounds hold for all of them.
    """

    matrix: "csr_matrix"
    rows: np.ndarray
    owner: np.ndarray
    rewards: np.ndarray
    error: np.ndarray
    origin: np.ndarray
    terms: int
    deviation: float = 0.0

    @property
    def num_nodes(self) -> int:
        return len(self.rows) - 1

    def residuals(self, v: np.ndarray, rewards: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """((R,) T_a v - v, by how much each may be off) of v (M + 1,), floats or pairs of them."""
        rewards = self.rewards if rewards is None else rewards
        total, size, off = mean_changes(self.matrix, self.owner, v)
        slack = (self.terms + 24) * UNIT * (np.abs(rewards) + size) + off + UNDERFLOW_SLACK
        if self.deviation:
            slack += self.deviation * 2 * float(np.abs(v).max(initial=0.0))
        return rewards + total, slack


@dataclass(frozen=True)
class Goals:
    """Values with bounds from both sides.

    Attributes:
        v: (N,) of the nodes of the MDP. error: (N,) each is within this of the true one.
        policy: (N,) a choice for each node, of a policy that ends almost surely if it does not stay for nothing.
        improvements: of the policy, or sweeps. is_exact: whether values of actions, which follow from v, are exact.
    """

    v: np.ndarray
    error: np.ndarray
    policy: np.ndarray
    improvements: int
    is_exact: bool = False

    def policy_table(self, mdp: TabularMDP) -> np.ndarray:
        """The policy as `Solution.policy` has it: (S,) actions, or (S, A + 1) if it looks at the previous action."""
        return table_of_choices(mdp, self.policy)


def table_of_choices(mdp: TabularMDP, policy: np.ndarray) -> np.ndarray:
    """Choices (N,) of the nodes as (S,) actions, or (S, A + 1) if they look at the previous action."""
    by_node = policy.reshape(mdp.num_states, mdp.width)
    if (by_node == by_node[:, :1]).all():
        return by_node[:, 0].copy()
    return np.concatenate([by_node, by_node[:, :1]], axis=1)


def total_reward(
    mdp: TabularMDP, select: Selection, tolerance: float, progress: Callable[[int, float], None] | None = None
) -> Goals:
    """The expected sum of rewards until the end of the best, the worst or a given policy.

    Raises:
        DivergenceError: it is infinite, or there is no policy that has one. The message names a cycle.
        PrecisionError: floats cannot tell it, or prove no bound within the tolerance.
    """
    goals = _goals(mdp, select, tolerance, progress)
    if mdp.available is None or isinstance(select, PolicyTable):
        return goals
    states = np.repeat(np.arange(mdp.num_states), mdp.width)
    return replace(goals, policy=stand_ins(mdp.available)[states, goals.policy])


def _goals(
    mdp: TabularMDP, select: Selection, tolerance: float, progress: Callable[[int, float], None] | None
) -> Goals:
    if mdp.is_deterministic and not isinstance(select, PolicyTable):
        return longest_paths(mdp, select)
    if mdp.num_states * mdp.width > MOST_UNSWEPT_NODES and not any(mdp.residual):
        goals = swept_goals(mdp, select, tolerance, progress)
        if goals is not None:
            return goals
    return GoalProblem.of(mdp, select).solve(tolerance, progress)


class WrittenOut(NamedTuple):
    """Nodes of an MDP and the outcomes of their choices.

    Attributes:
        mdp: its nodes are states, under sticky actions pairs (state, previously executed action), N in all.
        sign: -1 if rewards are to be minimised, else 1. per_node: C, choices of a node: A, or 1 under a policy.
        matrix: (N C, N + 2) CSR. Column N: it is over. Column N + 1: it is over without having arrived.
        rewards: (N C,) means. size: (N C,) means of their absolute values. error: (N C,) bounds.
        live: (N,) bool, nodes of states that are not terminal. arrived: as `GoalProblem.of` takes it.
    """

    mdp: TabularMDP
    sign: float
    per_node: int
    matrix: "csr_matrix"
    rewards: np.ndarray
    size: np.ndarray
    error: np.ndarray
    live: np.ndarray
    arrived: np.ndarray | None

    @staticmethod
    def of(mdp: TabularMDP, select: Selection, arrived: np.ndarray | None = None) -> "WrittenOut":
        """The nodes of an MDP under a selection of actions."""
        from scipy import sparse

        is_policy = isinstance(select, PolicyTable)
        num_states, num_actions, width = mdp.num_states, mdp.num_actions, mdp.width
        nodes = num_states * width
        owner = np.repeat(np.arange(num_states), width)
        previous = np.tile(np.arange(width), num_states)
        if isinstance(select, PolicyTable):
            table = np.broadcast_to(select.later, (num_states, width, num_actions)).reshape(nodes, num_actions)
            per_node = 1
        else:
            acts = (
                np.tile(np.arange(num_actions), (num_states, 1)) if mdp.available is None else stand_ins(mdp.available)
            )
            table, per_node = np.eye(num_actions)[np.repeat(acts, width, axis=0).ravel()], num_actions
        live = ~np.repeat(np.asarray(mdp.terminal), width)
        outcomes = nodes_of_outcomes(mdp.dynamics.matrix(~np.asarray(mdp.terminal)), num_actions, width)
        each_reward = mdp.rewards.ravel()
        error = mdp.reward_table.rounding * np.ones(nodes * per_node)
        if is_policy or not mdp.chance.is_none:
            each = np.repeat(np.arange(nodes), per_node)
            weights = executed_actions(mdp, table, owner[each], previous[each])
            matrix = (weights @ outcomes).tocsr()
            rewards, size = weights @ each_reward, weights @ np.abs(each_reward)
            error += (num_actions + 8) * UNIT * size
        else:
            matrix, rewards, size = outcomes, each_reward, np.abs(each_reward)
        # what leads to a terminal state, or to the end, is over: column N, or N + 1 if it has not arrived
        column = np.full(matrix.shape[1], nodes)
        column[:nodes][live] = np.flatnonzero(live)
        if arrived is not None:
            column[~np.repeat(arrived, width)[: len(column)] & (column == nodes)] = nodes + 1
        matrix = sparse.csr_matrix((matrix.data, column[matrix.indices], matrix.indptr), (matrix.shape[0], nodes + 2))
        matrix.sum_duplicates()
        sign = -1.0 if select.kind == "worst" else 1.0
        return WrittenOut(mdp, sign, per_node, matrix, rewards, size, error, live, arrived)


class GoalProblem:
    """Nodes of an MDP, their choices, and the same after components that pay nothing are collapsed.

    Attributes:
        choices: of the collapsed nodes. node_of: (N,) the collapsed node of each node, M if it is over.
        matrix: (N C, N + 1) the outcomes of all C choices of the nodes. Column N: it is over.
        inside: (N C,) bool, the choices that stay in a collapsed component.
        staying: (N,) the choices of nodes that stay there for ever. None: any.
    """

    def __init__(
        self,
        mdp: TabularMDP,
        sign: float,
        num_choices: int,
        choices: Choices,
        node_of: np.ndarray,
        matrix: "csr_matrix",
        inside: np.ndarray,
        staying: np.ndarray | None = None,
    ):
        self.mdp, self.sign, self.num_choices, self.choices, self.node_of = mdp, sign, num_choices, choices, node_of
        self.matrix, self.inside, self.staying = matrix, inside, staying

    @staticmethod
    def of(mdp: TabularMDP, select: Selection, arrived: np.ndarray | None = None) -> "GoalProblem":
        """
        arrived: (S + 1,) bool, the terminal states, and last the end, in which play has arrived. The other ones, and to
            stay for ever if nothing is paid, then have no value. None: everything counts as arrived.
        """
        nodes = WrittenOut.of(mdp, select, arrived)
        size = nodes.size
        if isinstance(select, PolicyTable):
            component, inside = recurrent_classes(nodes.matrix, nodes.live)
            pays = inside & (size > 0)
            if pays.any():
                same = np.flatnonzero(component == component[np.argmax(pays)])
                raise DivergenceError(
                    f"{mdp}: under this policy the total reward is infinite or does not exist: it stays for ever in "
                    f"{_states_in_words(mdp, same)}, which pay; give a horizon, or gamma < 1"
                )
        else:
            shape = (mdp.num_states, mdp.width, mdp.num_actions) if mdp.is_sticky else (mdp.num_states, mdp.num_actions)
            free = end_components(mdp, (size == 0).reshape(shape))
            component, inside = free.labels.ravel(), free.pairs.ravel()
        total = int(component.max(initial=-1)) + 1
        stops = np.zeros(0 if arrived is not None else total)
        return GoalProblem.collapsed(nodes, component, inside, stops, nodes.rewards, nodes.error)

    @staticmethod
    def collapsed(
        nodes: "WrittenOut",
        component: np.ndarray,
        inside: np.ndarray,
        stops: np.ndarray,
        rewards: np.ndarray,
        error: np.ndarray,
        staying: np.ndarray | None = None,
    ) -> "GoalProblem":
        """
        component: (N,) the component of each node, from 0 on, each of which becomes one node, -1 for none.
        inside: (N C,) bool, the choices that stay in a component.
        stops: what staying in the first components pays for ever, to be maximised.
        rewards: (N C,) of the choices. error: (N C,) bounds on the error of each.
        staying: (N,) the choices of nodes of components that stay. None: any that is inside.
        """
        from scipy import sparse

        mdp, matrix, live, count_of_nodes = nodes.mdp, nodes.matrix, nodes.live, len(nodes.live)
        # one node for each component, then those in none, a trap without choices, and the end
        is_collapsed = component >= 0
        total = int(component.max(initial=-1)) + 1
        alone = np.flatnonzero(live & ~is_collapsed)
        trap = total + len(alone)
        count = trap + (nodes.arrived is not None)
        node_of = np.full(count_of_nodes + 2, count)
        node_of[:-2][is_collapsed] = component[is_collapsed]
        node_of[alone] = total + np.arange(len(alone))
        node_of[-1] = trap
        if nodes.arrived is not None:
            node_of[:-2][np.repeat(~nodes.arrived[:-1], mdp.width) & ~live] = trap
        row_node = np.repeat(np.arange(count_of_nodes), nodes.per_node)
        keep = np.flatnonzero(live[row_node] & ~inside)
        part = matrix[keep]
        own = node_of[row_node[keep]]
        after = node_of[part.indices]
        data = np.where(after == np.repeat(own, np.diff(part.indptr)), 0.0, part.data)
        joined = sparse.csr_matrix((data, after, part.indptr), shape=(len(keep), count + 1))
        joined.sum_duplicates()
        joined.eliminate_zeros()
        terms = int(np.diff(joined.indptr).max(initial=0)) + mdp.num_actions + mdp.dynamics.operations
        choices = _sorted_choices(joined, own, nodes.sign * rewards[keep], keep, stops, error[keep], terms)
        return GoalProblem(mdp, nodes.sign, nodes.per_node, choices, node_of, matrix, inside, staying)

    # Solving ----------------------------------------------------------------------------------------------------------

    def solve_in(self, inside: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """((N,) values, (N,) error of each, (N,) choices) if `inside` (M + 1,) bool holds, at the end 0, else
        infinite.

        From the nodes inside, the end among them, some policy surely ends without leaving them. Choices that may leave
        them are left out.
        """
        choices = self.choices
        counts = np.diff(choices.matrix.indptr)
        which = np.repeat(np.arange(len(counts)), counts)
        leaves = np.bincount(which, ~inside[choices.matrix.indices], minlength=len(counts))
        rows = np.flatnonzero(inside[choices.owner] & (leaves == 0) & (counts > 0))
        nodes = np.flatnonzero(inside)
        number = np.cumsum(inside) - 1
        owner = number[choices.owner[rows]]
        part = choices._replace(
            matrix=choices.matrix[rows][:, nodes],
            rows=np.searchsorted(owner, np.arange(len(nodes))),
            owner=owner,
            rewards=choices.rewards[rows],
            error=choices.error[rows],
            origin=choices.origin[rows],
        )
        v, error = np.full(len(inside), np.inf), np.zeros(len(inside))
        values, errors, policy, _ = _values(part, self.proper(part)[1], tolerance, self._infinite, None)
        v[nodes], error[nodes] = np.append(self.sign * values, 0.0), np.append(errors, 0.0)
        origin = np.full(len(inside) - 1, -1)
        origin[nodes[:-1]] = part.origin[policy]
        return v[self.node_of[:-2]], error[self.node_of[:-2]], self.unfolded(origin)

    def solve(self, tolerance: float, progress: Callable[[int, float], None] | None = None) -> Goals:
        """Policy iteration, then bounds, in rational numbers if floats do not decide it, or are too short."""
        choices = self._without_idle(self.choices)
        sure, policy = self.proper(choices)
        if not sure[:-1].all():
            raise _without_end(self.mdp, ~sure[self.node_of[:-2]])
        v, error, policy, improvements = _values(choices, policy, tolerance, self._infinite, progress)
        if any(self.mdp.residual):
            error = self._within_residual(choices, v, policy, tolerance)
        nodes = self.node_of[:-2]
        return Goals(
            self.sign * np.append(v, 0.0)[nodes],
            np.append(error, 0.0)[nodes],
            self.unfolded(choices.origin[policy]),
            improvements,
        )

    def _within_residual(self, choices: Choices, v: np.ndarray, policy: np.ndarray, tolerance: float) -> np.ndarray:
        """(M,) error of v that holds for every MDP within the residual of this one."""
        residual = self.mdp.residual
        wider = choices._replace(error=choices.error + residual.rewards, deviation=residual.probabilities)
        try:
            values, error, _, _ = _iterated(wider, policy, self._infinite, None, WIDER * tolerance)
        except Undecided:
            raise PrecisionError(
                f"{self.mdp}: rows that were off by {residual.probabilities:.2g} and divided by their sums leave no "
                "bound of the total reward; give probabilities that sum to 1 as floats"
            ) from None
        return np.abs(values - v) + error

    def _without_idle(self, choices: Choices) -> Choices:
        """The choices without those that change nothing and may be repeated for ever."""
        idle = np.diff(choices.matrix.indptr) == 0
        if not idle.any():
            return choices
        paying = idle & (choices.rewards > 0)
        if paying.any():
            raise self._infinite(choices, np.flatnonzero(paying)[:1])
        keep = np.flatnonzero(~idle)
        rows = np.searchsorted(choices.owner[keep], np.arange(choices.num_nodes + 1))
        return choices._replace(
            matrix=choices.matrix[keep],
            rows=rows,
            owner=choices.owner[keep],
            rewards=choices.rewards[keep],
            error=choices.error[keep],
            origin=choices.origin[keep],
        )

    @staticmethod
    def proper(choices: Choices) -> tuple[np.ndarray, np.ndarray]:
        """((M + 1,) bool whether some policy surely ends, (M,) the rows of one that does)."""
        return _proper(choices.matrix, choices.rows)

    def _infinite(self, choices: Choices, rows: np.ndarray) -> DivergenceError:
        """The error that repeating some rows pays without limit."""
        return _without_limit(
            self.mdp, self.sign, [divmod(int(each), self.num_choices) for each in choices.origin[rows]]
        )

    def unfolded(self, origin: np.ndarray) -> np.ndarray:
        """(N,) choices of the nodes, from the choices of the collapsed nodes (M,). -1 is to stop."""
        nodes = len(self.node_of) - 2
        policy = np.zeros(nodes, np.int64)
        matrix, inside = self.matrix, self.inside
        stops = np.append(origin < 0, False)[self.node_of[:-2]]
        moves = origin[origin >= 0]
        at = moves // self.num_choices
        policy[at] = moves % self.num_choices
        collapsed = np.flatnonzero(inside.reshape(nodes, -1).any(axis=1))
        if not len(collapsed):
            return policy
        goal = np.ones(nodes + 2, np.bool_)
        goal[collapsed] = False
        goal[at] = True
        goal[:nodes][stops] = True
        rows_in = np.flatnonzero(inside)
        rows = np.searchsorted(rows_in // self.num_choices, np.arange(nodes + 3))
        part = matrix[rows_in]
        sure, scratch = np.empty(nodes + 2, np.bool_), np.empty(nodes + 2, np.bool_)
        row = np.zeros(nodes + 2, np.int64)
        first, node = part.indptr.astype(np.int64), part.indices.astype(np.int64)
        hitting.almost_surely(first, node, rows, goal, sure, scratch, row)
        towards = np.flatnonzero(~goal)
        policy[towards] = rows_in[row[towards]] % self.num_choices
        stays = collapsed[stops[collapsed]]
        policy[stays] = rows_in[rows[stays]] % self.num_choices if self.staying is None else self.staying[stays]
        return policy


def _sorted_choices(
    matrix: "csr_matrix",
    owner: np.ndarray,
    rewards: np.ndarray,
    origin: np.ndarray,
    stops: np.ndarray,
    error: np.ndarray,
    terms: int,
) -> Choices:
    """Choices by node, with one more row that stops for each of the first nodes, and is paid what `stops` says."""
    from scipy import sparse

    count = matrix.shape[1] - 1
    if len(stops):
        first = np.arange(len(stops))
        entries = (np.ones(len(stops)), (first, np.full(len(stops), count)))
        matrix = sparse.vstack([matrix, sparse.csr_matrix(entries, shape=(len(stops), count + 1))], format="csr")
        owner, rewards, error = np.append(owner, first), np.append(rewards, stops), np.append(error, 0.0 * stops)
        origin = np.append(origin, np.full(len(stops), -1))
    order = np.argsort(owner, kind="stable")
    if (order[1:] < order[:-1]).any():
        matrix, owner, rewards, origin, error = (each[order] for each in (matrix, owner, rewards, origin, error))
    return Choices(matrix, np.searchsorted(owner, np.arange(count + 1)), owner, rewards, error, origin, terms)


def recurrent_classes(matrix: "csr_matrix", live: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((N,) number of the recurrent class of each live node of a Markov chain, -1 for none, whether in one).

    matrix (N, N + K): the last columns are nodes that are never left, and no live ones.
    """
    from scipy import sparse
    from scipy.sparse import csgraph

    size = matrix.shape[1]
    ends = np.append(matrix.indptr, np.full(size - len(live), matrix.nnz))
    square = sparse.csr_matrix((matrix.data, matrix.indices, ends), (size, size))
    number, component = csgraph.connected_components(square, connection="strong")
    row = np.repeat(np.arange(len(live)), np.diff(matrix.indptr))
    is_recurrent = np.ones(number, np.bool_)
    is_recurrent[component[row[component[row] != component[matrix.indices]]]] = False
    inside = is_recurrent[component[: len(live)]] & live
    numbers = np.full(len(live), -1)
    numbers[inside] = np.unique(component[: len(live)][inside], return_inverse=True)[1]
    return numbers, inside


def _proper(matrix: "csr_matrix", rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((M + 1,) bool, (M,) rows), see `GoalProblem.proper`."""
    size = matrix.shape[1]
    goal, sure, scratch = (np.zeros(size, np.bool_) for _ in range(3))
    goal[-1] = True
    policy = np.zeros(size, np.int64)
    first, node = matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64)
    bounds = np.append(rows, rows[-1])
    hitting.almost_surely(first, node, bounds.astype(np.int64), goal, sure, scratch, policy)
    return sure, policy[:-1]


# Policy iteration -----------------------------------------------------------------------------------------------------


Infinite = Callable[[Choices, np.ndarray], DivergenceError]


class Undecided(Exception):
    """Floats cannot tell whether a cycle pays.

    Attributes:
        policy: (M,) rows of the best proper policy so far.
    """

    def __init__(self, policy: np.ndarray):
        super().__init__()
        self.policy = policy


def _values(
    choices: Choices,
    policy: np.ndarray,
    tolerance: float,
    infinite: Infinite,
    progress: Callable[[int, float], None] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """((M,) values, (M,) error of each, (M,) rows, improvements), from a proper policy: by floats, if they can tell
    and are long enough, else by rational numbers."""
    from pharos.solvers.rational import rational_values

    for dtype in (float, complex):
        try:
            v, error, policy, improvements = _iterated(choices, policy, infinite, progress, tolerance, dtype)
            if error.max(initial=0.0) <= tolerance:
                return v, error, policy, improvements
        except Undecided as undecided:
            policy = undecided.policy
    return rational_values(choices, policy, infinite)


def _iterated(
    choices: Choices,
    policy: np.ndarray,
    infinite: Infinite,
    progress: Callable[[int, float], None] | None,
    tolerance: float,
    dtype: type = float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """((M,) values, (M,) error of each, (M,) rows, improvements), from a proper policy. `Undecided` if floats, or pairs
    of them (complex), do not decide it."""
    nodes = np.arange(choices.num_nodes)
    if not len(nodes):
        return np.zeros(0), np.zeros(0), policy, 0
    for improvements in range(1, MOST_IMPROVEMENTS):
        chain = Chain(choices.matrix[policy], dtype)
        v = chain.solve(choices.rewards[policy])
        if not np.isfinite(v).all():
            raise Undecided(policy)
        total, slack = choices.residuals(v)
        slack += choices.error
        # how far v may be from the policy's own values: pairs are right to more than their residuals are computed to
        own = np.abs(total[policy]) + slack[policy] if dtype is float else NOISE * chain.unit * np.abs(v.real[:-1])
        gain = total - slack
        better = best_rows(choices, gain)
        is_better = gain[better] > 2 * own
        if not is_better.any():
            error = _errors(choices, policy, chain, total, slack, tolerance) + np.abs(v.imag[:-1])
            if progress is not None:
                progress(improvements, float(error.max()))
            return v.real[:-1], error, policy, improvements
        changed = np.where(is_better, better, policy)
        if not _is_proper(choices, changed):
            stuck = np.flatnonzero(recurrent_classes(choices.matrix[changed], nodes >= 0)[0] == 0)
            raise infinite(choices, changed[stuck]) if _pays(choices, changed, stuck) else Undecided(policy)
        policy = _swept(choices, v.real.copy(), changed) if improvements <= SWEPT else changed
    raise Undecided(policy)


def _errors(
    choices: Choices, policy: np.ndarray, chain: Chain, total: np.ndarray, slack: np.ndarray, tolerance: float
) -> np.ndarray:
    """(M,) the error of a policy's values with residuals `total` (R,), each within `slack`. `Undecided` if unproven."""
    nodes = np.arange(choices.num_nodes)
    own = choices._replace(
        matrix=choices.matrix[policy], rows=np.arange(len(nodes) + 1), owner=nodes, rewards=choices.rewards[policy]
    )
    below = _room(own, nodes, chain, slack[policy] - total[policy], slack[policy], tolerance)
    above = None if below is None else _room(choices, policy, chain, total + slack, slack, tolerance)
    if below is None or above is None:
        raise Undecided(policy)
    return np.maximum(below, above) * BOUND_MARGIN


def _room(
    choices: Choices, rows: np.ndarray, chain: Chain, off: np.ndarray, slack: np.ndarray, tolerance: float
) -> np.ndarray | None:
    """(M,) w <= tolerance with w(n) >= off + sum_m p(m) w(m) for all choices (R,), rounding included. None if unproven.

    w is what a policy collects that is paid so much, and its slack more, improved from a proper one (M,) whose chain is
    given. Each row is paid its own rounding, not the rounding of another choice of its node.
    """
    least = NOISE * chain.unit * tolerance + UNDERFLOW_SLACK  # more than rounding of w takes away
    extra, zeros, settled = np.zeros(len(off)), np.zeros(len(off)), 0
    for improvements in range(MOST_IMPROVEMENTS):
        payment = off + slack + 2 * extra + least
        w = chain.solve(payment[rows])
        if not w.real.max() <= tolerance:
            return None
        more, rounding = choices.residuals(w, zeros)
        above = off + more + rounding
        if (above <= 0).all():
            return w.real[:-1] + np.abs(w.imag[:-1])
        # a row that is no better but for the rounding of w is paid that, too
        better = best_rows(choices, above)
        changed = np.where((above[better] > 0) & ((payment + more - rounding)[better] > 0), better, rows)
        extra = np.maximum(extra, rounding)
        if np.array_equal(changed, rows):
            settled += 1
            if settled > SETTLING_SOLUTIONS:
                return None
            continue
        if not _is_proper(choices, changed):
            return None
        rows = changed
        if improvements < SWEPT:
            rows = _swept(choices._replace(rewards=payment), w.real.copy(), changed)
        chain = Chain(choices.matrix[rows], chain.dtype)
    return None


def _is_proper(choices: Choices, policy: np.ndarray) -> bool:
    """Whether a policy (M,) surely ends."""
    return bool(_proper(choices.matrix[policy], np.arange(len(policy) + 1))[0].all())


def _swept(choices: Choices, v: np.ndarray, policy: np.ndarray) -> np.ndarray:
    """(M,) rows of a policy that is better than a proper one, as sweeps from its values v (M + 1,) have it."""
    better = policy.copy()
    matrix = (choices.matrix.indptr, choices.matrix.indices, choices.matrix.data)
    for sweep in range(SWEEPS):
        if not elimination.improve(matrix, choices.rows, choices.rewards, sweep % 2 == 0, v, better):
            break
    return better if _is_proper(choices, better) else policy


def best_rows(choices: Choices, gain: np.ndarray) -> np.ndarray:
    """(M,) the row of each node whose gain (R,) is largest, the first among equals."""
    largest = np.maximum.reduceat(gain, choices.rows[:-1])
    at = np.flatnonzero(gain == largest[choices.owner])
    best = np.empty(choices.num_nodes, np.int64)
    best[choices.owner[at[::-1]]] = at[::-1]
    return best


def _pays(choices: Choices, policy: np.ndarray, nodes: np.ndarray) -> bool:
    """Whether it is proven that the mean reward of a recurrent class is positive: r + P h - h > 0 in it for some h."""
    rows = choices.matrix[policy[nodes]][:, nodes].toarray()
    leaving = rows.sum(axis=1)
    rewards = choices.rewards[policy[nodes]]
    # g and h with h = 0 at the first node: g + leaving h - P h = r
    system = np.diag(leaving) - rows
    system[:, 0] = 1.0
    with np.errstate(all="ignore"):
        try:
            h = np.linalg.solve(system, rewards)
        except np.linalg.LinAlgError:
            return False
    h[0] = 0.0
    v = np.zeros(choices.num_nodes + 1)
    v[nodes] = h
    total, slack = choices.residuals(v)
    at = policy[nodes]
    return bool((total[at] - slack[at] - choices.error[at] > 0).all())


# Longest paths --------------------------------------------------------------------------------------------------------


# Whole numbers that 64 bits hold, and those that floats hold.
WHOLE, FLOAT_INTEGERS = 2**62, 2**53


def longest_paths(mdp: TabularMDP, select: Selection) -> Goals:
    """Total rewards if every choice has one outcome: longest paths to the end, or to a cycle that pays nothing.

    Rewards are whole multiples of a power of 2, so that all sums are of whole numbers, and no tie is left to rounding.
    Paths become longer step by step. Once the steps of their states form a cycle, it pays: the value is infinite.
    """
    sign = -1 if select.kind == "worst" else 1
    table, terminal = np.asarray(mdp.dynamics.deterministic_table()), np.asarray(mdp.terminal)
    rewards = mdp.reward_table
    if len(rewards.palette):
        floats, codes = rewards.palette, rewards.table
    else:
        floats, codes = np.unique(rewards.table, return_inverse=True)
    shift = max(float(each).as_integer_ratio()[1].bit_length() - 1 for each in floats)
    numbers = [sign * numerator * (2**shift // below) for numerator, below in map(float.as_integer_ratio, floats)]
    fits = max(map(abs, numbers)) * (mdp.num_states + 1) < WHOLE
    whole = np.array(numbers, np.int64 if fits else object)[codes.reshape(table.shape)]
    free = end_components(mdp, whole == 0)
    v = np.zeros(mdp.num_states + 1, whole.dtype)
    is_reached = np.append(terminal | (free.labels >= 0), True)
    action, mark = np.full(mdp.num_states, -1, np.int64), np.empty(mdp.num_states, np.int64)
    lengthen = bellman.lengthen_paths if fits else bellman.lengthen_paths.py_func
    sweeps = 0
    while lengthen(table, whole, terminal, v, is_reached, action):
        sweeps += 1
        if sweeps & (sweeps - 1) == 0 and sweeps > LOOK_AHEAD:
            state = int(bellman.cycle_of(table, action, mark))
            if state >= 0:
                pairs = [(state, int(action[state]))]
                while (after := int(table[pairs[-1]])) != state:
                    pairs.append((after, int(action[after])))
                raise _without_limit(mdp, sign, pairs)
    if not is_reached.all():
        raise _without_end(mdp, ~is_reached[:-1])
    stays = action < 0
    action[stays] = free.pairs[stays].argmax(axis=1)
    largest = max(int(np.abs(v).max()), 1) + max(map(abs, numbers))
    values = sign * np.ldexp(v[:-1].astype(np.float64), -shift)
    is_exact = largest < FLOAT_INTEGERS
    return Goals(values, np.zeros(len(values)) if is_exact else 2 * UNIT * np.abs(values), action, sweeps, is_exact)


# Many nodes -----------------------------------------------------------------------------------------------------------


# Sweeps before bounds are tried first, of one attempt, and of all; the part of the tolerance by which values are moved.
FIRST_BOUNDS, ATTEMPT, MOST_SWEEPS, PART = 32, 64, 100_000, 0.25


def swept_goals(
    mdp: TabularMDP, select: Selection, tolerance: float, progress: Callable[[int, float], None] | None
) -> Goals | None:
    """Total rewards by sweeps, if no component pays nothing and to stay in one always costs, else None.

    There T has one fixed point V. Values that a sweep lowers everywhere are no less than V, and those that it raises
    everywhere no more, as long as each backup is rounded up, or down: it pays its rounding more, or less. So values
    that have nearly settled are moved up and down by a part of the tolerance, and swept until they fall, and rise.
    Source: Hartmanns and Kaminski (2020), "Optimistic value iteration".
    """
    components = end_components(mdp)
    if components.total:
        sign = -1.0 if select.kind == "worst" else 1.0
        is_chance = isinstance(select, PolicyTable) or not mdp.chance.is_none
        if is_chance or not (sign * mdp.rewards[components.pairs] < 0).all():
            return None
    from pharos.solvers.fixed_point import Backup, largest_of

    backup = Backup(mdp, select)
    x, sweeps, changes, attempt = backup.zeros(), 0, [math.inf], FIRST_BOUNDS
    over = np.asarray(mdp.terminal)
    while sweeps < MOST_SWEEPS:
        changes.append(backup.sweep(x))
        sweeps += 1
        if progress is not None:
            progress(sweeps, math.inf)
        if not math.isfinite(changes[-1]):
            return None
        if sweeps < attempt:
            continue
        ratio = (changes[-1] / changes[sweeps // 2]) ** (2 / sweeps) if changes[-1] > 0 else 0.0
        if not changes[-1] * ratio <= PART * PART * tolerance * max(1 - ratio, 1e-12):
            attempt = sweeps + max(8, sweeps // 16)
            continue
        largest = largest_of(x) + tolerance
        step = (backup.rounding(largest) + (backup.operations + 16) * UNIT * largest) * BOUND_MARGIN
        bounds = []
        for side in (1.0, -1.0):
            settled = _monotone(mdp, select, x, over, side, PART * tolerance, step)
            sweeps += settled[1]
            bounds.append(settled[0])
        upper, lower = bounds
        if upper is not None and lower is not None:
            v, error = (upper + lower) / 2, float((upper - lower).max()) / 2 * BOUND_MARGIN
            if progress is not None:
                progress(sweeps, error)
            nodes = mdp.num_states * mdp.width
            # if staying in a component costs, the policy that attains the bound does not
            policy = _greedy(mdp, select, upper if select.kind == "worst" else lower)
            return Goals(v[:-1].reshape(nodes), np.full(nodes, error), policy, sweeps)
        changes += [changes[-1]] * (sweeps + 1 - len(changes))
        attempt = sweeps + max(64, sweeps // 4)
    return None


def _monotone(
    mdp: TabularMDP, select: Selection, x: np.ndarray, over: np.ndarray, side: float, part: float, step: float
) -> tuple[np.ndarray | None, int]:
    """(values moved by a part to a side, and swept until a sweep moves all of them back, sweeps). None: it does not."""
    from pharos.mdp import Rewards
    from pharos.solvers.fixed_point import Backup

    table = mdp.reward_table
    moved = (
        Rewards(table.table, table.palette + side * step, table.rounding)
        if len(table.palette)
        else Rewards(table.table + side * step, table.palette, table.rounding)
    )
    backup = Backup(replace(mdp, reward_table=moved), select)
    y = x + side * part
    y[-1] = 0.0
    y[:-1][over] = 0.0
    for sweep in range(ATTEMPT):
        before = y.copy()
        backup.sweep(y)
        y[:-1][over] = 0.0
        if (side * (y - before) <= 0).all():
            return y, sweep + 1
    return None, ATTEMPT


def _greedy(mdp: TabularMDP, select: Selection, x: np.ndarray) -> np.ndarray:
    """(N,) the greedy actions of values, block by block."""
    if isinstance(select, PolicyTable):
        return np.zeros(mdp.num_states * mdp.width, np.int64)
    actions = np.empty(mdp.num_states, np.int64)
    for start in range(0, mdp.num_states, GREEDY_BLOCK):
        states = slice(start, min(start + GREEDY_BLOCK, mdp.num_states))
        actions[states] = select.policy(mdp.reward_table.rows(states) + mdp.dynamics.expected(x, states)).table
    return np.repeat(actions, mdp.width)


# Words ----------------------------------------------------------------------------------------------------------------


def _without_limit(mdp: TabularMDP, sign: float, pairs: list[tuple[int, int]]) -> DivergenceError:
    """The error that repeating some pairs (node, choice) pays without limit."""
    return DivergenceError(
        f"{mdp}: the total reward has no {'lower' if sign < 0 else 'upper'} limit: a cycle pays again and again: "
        f"{_pairs_in_words(mdp, pairs)}; give a horizon, or gamma < 1"
    )


def _without_end(mdp: TabularMDP, unsure: np.ndarray) -> DivergenceError:
    """The error that from some nodes (N,) bool no policy surely ends or stays for nothing."""
    components = end_components(mdp)
    labels = components.labels.ravel()
    inside = components.pairs.reshape(len(labels), -1)
    stuck = np.flatnonzero(unsure & (labels >= 0))
    same = np.flatnonzero(labels == labels[stuck[0]]) if len(stuck) else np.flatnonzero(unsure)
    pairs = [(int(n), int(a)) for n in same[: NAMED + 1] for a in np.flatnonzero(inside[n])[:1]]
    return DivergenceError(
        f"{mdp}: no policy has a finite total reward from state {int(np.argmax(unsure)) // mdp.width}: none ends "
        f"surely, or stays where nothing is paid; a cycle that pays: {_pairs_in_words(mdp, pairs)}; give a horizon, or "
        "gamma < 1"
    )


def _pairs_in_words(mdp: TabularMDP, pairs: list[tuple[int, int]]) -> str:
    """ "state 3 by action 0, state 4 by action 1", of pairs (node, choice)."""
    texts = [f"state {node // mdp.width} by action {action}" for node, action in pairs[:NAMED]]
    return ", ".join(dict.fromkeys(texts)) + (", ..." if len(pairs) > NAMED else "")


def _states_in_words(mdp: TabularMDP, nodes: np.ndarray) -> str:
    states = np.unique(nodes // mdp.width)
    word = "state" if len(states) == 1 else "states"
    return f"{word} {', '.join(map(str, states[:NAMED].tolist()))}" + (", ..." if len(states) > NAMED else "")
