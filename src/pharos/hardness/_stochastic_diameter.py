"""Diameter under chance: for every target one stochastic shortest path problem, most of them only as far as bounds need.

For a target e let T J(n) = 1 + min_a sum_m p(m | n, a) J(m), J = 0 at e; the least expected hitting time J* is its fixed point.

Certificate. For any J >= 0 with T J - J <= above < 1 and J - T J <= below everywhere,

    J / (1 + below)  <=  J*  <=  J / (1 - above).

With c = 1 / (1 - above), T(c J) = 1 + c (T J - 1) <= 1 + c (J + above - 1) = c J: the policy that is greedy in c J loses at least
one expected step a step, so it needs at most c J. With c = 1 / (1 + below), T(c J) >= c J in the same way, and iterating T from
c J rises to J*. It does not matter where J comes from: sweeps in place from the target outwards, then policies evaluated by a
sparse linear solve where sweeps are slow. They begin with the distance times what the first target's hitting times are of its
distances, at their upper end: from above, few sweeps prove that a target is not the one. A target whose upper bound falls below the largest proven hitting time is dropped
at once.

Nodes. Without sticky actions the states, and the implicit end. Under sticky actions the pairs (state, previously executed
action) that can be reached, and the start states without a previous action; a target is a state, reached with any previous action.
"""

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu

from pharos._core.compiling import usable_workers
from pharos.errors import UndefinedMeasure
from pharos.hardness._interval import Budget, Interval, Spending
from pharos.mdp import TabularMDP

SWEEPS = 40  # before a policy is evaluated by a linear solve
SOLVABLE = 60_000  # nodes up to which linear solves are tried
TOP = 1e300
BATCH = 64  # targets that threads look at with the same largest hitting time known


@dataclass
class Choices:
    """An MDP with chance written out: N nodes, A choices each.

    Attributes:
        matrix: (N A, N) CSR, probabilities.
        underlying: (N,) the state of each node; S for the implicit end.
        previous: (N,) the previously executed action, A for none; -1 where it does not matter.
        starts: [(node, probability)] of the first step.
        num_actions: A.
    """

    matrix: Any
    underlying: np.ndarray
    previous: np.ndarray
    starts: list[tuple[int, float]]
    num_actions: int
    num_targets: int

    @cached_property
    def reversed(self) -> tuple[np.ndarray, np.ndarray]:
        """(first, previous) of the graph of all transitions that some choice may take."""
        size = len(self.underlying)
        rows = np.repeat(np.arange(size * self.num_actions) // self.num_actions, np.diff(self.matrix.indptr))
        graph = sparse.csr_matrix((np.ones(len(rows), np.int8), (self.matrix.indices, rows)), shape=(size, size))
        return graph.indptr, graph.indices

    @cached_property
    def is_strongly_connected(self) -> bool:
        """Whether every node can be reached from every other."""
        first, previous = self.reversed
        size = len(self.underlying)
        graph = sparse.csr_matrix((np.ones(len(previous), np.int8), previous, first), shape=(size, size))
        return csgraph.connected_components(graph, connection="strong", return_labels=False) == 1

    @cached_property
    def crude_upper(self) -> float:
        """Proven, and far too large: a shortest path of at most H edges succeeds with probability q^H or more; H / q^H."""
        if not self.is_strongly_connected:
            return math.inf
        size = len(self.underlying)
        coo = self.matrix.tocoo()
        best = sparse.coo_matrix((coo.data, (coo.row // self.num_actions, coo.col)), shape=(size, size))
        order = np.lexsort((-best.data, best.col, best.row))
        row, col, data = best.row[order], best.col[order], best.data[order]
        first = np.ones(len(row), np.bool_)
        first[1:] = (row[1:] != row[:-1]) | (col[1:] != col[:-1])
        pivot = self.starts[0][0]
        graph = sparse.csr_matrix((np.ones(int(first.sum())), (row[first], col[first])), shape=(size, size))
        steps = 0
        for each in (graph, graph.T.tocsr()):
            distances = csgraph.dijkstra(each, indices=pivot, unweighted=True)
            steps += int(distances.max())
        exponent = -steps * math.log(float(data[first].min()))
        return steps * math.exp(exponent) if exponent < 690 else math.inf


def choices_of(mdp: TabularMDP, restart: bool) -> Choices:
    """The MDP written out, with the restart convention."""
    num_states, num_actions = mdp.num_states, mdp.num_actions
    terminal = np.asarray(mdp.terminal)
    executed, ends = _executed(mdp, terminal)  # (S A, S + ends): outcome of executing an action in a live state
    size = num_states + ends
    states = np.arange(size)
    live = np.zeros(size, np.bool_)
    live[:num_states] = ~terminal
    chance = mdp.chance
    if mdp.is_sticky:
        # node s (A + 1) + b, b = A: no previous action
        width = num_actions + 1
        nodes = size * width
        coo = executed.tocoo()
        arrived = coo.col * width + coo.row % num_actions
        outcome = sparse.csr_matrix((coo.data, (coo.row, arrived)), shape=(num_states * num_actions, nodes))
        owner, previous = np.repeat(states, width), np.tile(np.arange(width), size)
    else:
        width, nodes = 1, size
        outcome, owner, previous = executed, states, np.full(size, -1)
    starts = [
        (int(s) * width + (num_actions if width > 1 else 0), float(p))
        for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True)
        if p > 0
    ]
    weights = _weights(chance, (num_states, num_actions), owner, previous, live[owner])
    matrix = weights @ outcome
    matrix = matrix + _restarts(owner, live, starts, num_actions, nodes, restart)
    matrix = sparse.csr_matrix(matrix)
    matrix.sum_duplicates()
    choices = Choices(matrix, owner, previous, starts, num_actions, size)
    return _reachable(choices) if mdp.is_sticky else choices


def _executed(mdp: TabularMDP, terminal: np.ndarray) -> tuple[Any, bool]:
    """(S A, S + 1 or S) outcomes of executing actions, rows of terminal states empty; whether the end is among them."""
    num_states, num_actions = mdp.num_states, mdp.num_actions
    live = np.repeat(~terminal, num_actions)
    if mdp.transitions is None:
        assert mdp.next_states is not None
        column = np.asarray(mdp.next_states).ravel().astype(np.int64)
        ends = bool((column[live] < 0).any())
        column = np.where(column < 0, num_states, column)
        rows = np.flatnonzero(live)
        data = np.ones(rows.size)
        shape = (num_states * num_actions, num_states + ends)
        return sparse.csr_matrix((data, (rows, column[rows])), shape=shape), ends
    kept = sparse.diags(live.astype(np.float64)) @ mdp.transitions
    kept.eliminate_zeros()
    rest = np.where(live, 1 - np.asarray(kept.sum(axis=1)).ravel(), 0.0)
    rest[rest < 1e-12] = 0.0
    ends = bool(rest.any())
    if not ends:
        return sparse.csr_matrix(kept), False
    return sparse.csr_matrix(sparse.hstack([kept, sparse.csr_matrix(rest[:, None])])), True


def _weights(chance: Any, shape: tuple[int, int], owner: np.ndarray, previous: np.ndarray, live: np.ndarray) -> Any:
    """(N A, S A): the probability that choosing a in a node executes x in its state; previous (N,), A for none, -1 for any."""
    num_states, num_actions = shape
    node = np.flatnonzero(live)
    n = np.repeat(node, num_actions * num_actions)
    a = np.tile(np.repeat(np.arange(num_actions), num_actions), node.size)
    x = np.tile(np.arange(num_actions), node.size * num_actions)
    first = previous[n] == num_actions
    data = np.where(first, chance.first_uniform, chance.uniform) / num_actions
    data = data + (x == a) * np.where(first, chance.first_chosen, chance.chosen) + (x == previous[n]) * chance.previous
    keep = data > 0
    rows, columns = (n * num_actions + a)[keep], (owner[n] * num_actions + x)[keep]
    return sparse.csr_matrix((data[keep], (rows, columns)), shape=(owner.size * num_actions, num_states * num_actions))


def _restarts(
    owner: np.ndarray, live: np.ndarray, starts: list[tuple[int, float]], num_actions: int, nodes: int, restart: bool
) -> Any:
    """(N A, N): what terminal states and the end lead to."""
    ended = np.flatnonzero(~live[owner])
    if restart:
        rows = np.repeat((ended[:, None] * num_actions + np.arange(num_actions)).ravel(), len(starts))
        columns = np.tile([node for node, _ in starts], ended.size * num_actions)
        data = np.tile([p for _, p in starts], ended.size * num_actions)
    else:
        rows = (ended[:, None] * num_actions + np.arange(num_actions)).ravel()
        columns = np.repeat(ended, num_actions)
        data = np.ones(rows.size)
    return sparse.csr_matrix((data, (rows, columns)), shape=(nodes * num_actions, nodes))


def _reachable(choices: Choices) -> Choices:
    """The nodes that can be reached from the start, by whatever is chosen."""
    first, previous = choices.reversed
    size = len(choices.underlying)
    graph = sparse.csr_matrix((np.ones(len(previous), np.int8), previous, first), shape=(size, size)).T.tocsr()
    kept = np.zeros(size, np.bool_)
    for node, _ in choices.starts:
        kept[csgraph.breadth_first_order(graph, node, return_predecessors=False)] = True
    nodes = np.flatnonzero(kept)
    place = np.full(size, -1)
    place[nodes] = np.arange(nodes.size)
    rows = (nodes[:, None] * choices.num_actions + np.arange(choices.num_actions)).ravel()
    matrix = sparse.csr_matrix(choices.matrix[rows][:, nodes])
    starts = [(int(place[node]), p) for node, p in choices.starts]
    return Choices(
        matrix, choices.underlying[nodes], choices.previous[nodes], starts, choices.num_actions, choices.num_targets
    )


# Targets ----------------------------------------------------------------------------------------------------------------


class _Targets:
    """The hitting times of one target after the other."""

    def __init__(self, choices: Choices):
        matrix = choices.matrix
        self.choices = choices
        self.support = (matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64), choices.num_actions)
        self.arrays = _without_common(matrix, choices.num_actions)
        first, previous = choices.reversed
        self.back = (first.astype(np.int64), previous.astype(np.int64))
        self.members = np.argsort(choices.underlying, kind="stable")
        self.edges = np.searchsorted(choices.underlying[self.members], np.arange(choices.num_targets + 1))
        self.ratio = 1.0
        self._make_room()

    def learn_ratio(self, j: np.ndarray) -> None:
        """Guess the next hitting times from those of the target last opened: a guess somewhat too large is the quickest to be proven."""
        there = (self.distance > 0) & (j < TOP)
        if there.any():
            self.ratio = float(np.quantile(j[there] / self.distance[there], 0.99))

    def _make_room(self) -> None:
        size = len(self.choices.underlying)
        self.order, self.distance = np.empty(size, np.int64), np.empty(size, np.int64)
        self.policy, self.goal = np.zeros(size, np.int64), np.zeros(size, np.bool_)

    def for_another_thread(self) -> "_Targets":
        """The same problem with room of its own."""
        other = copy(self)
        other._make_room()
        return other

    def nodes_of(self, target: int) -> np.ndarray:
        return self.members[self.edges[target] : self.edges[target + 1]]

    def open(self, target: int) -> tuple[np.ndarray, int, np.ndarray | None]:
        """(J, nodes to sweep, nodes that do not surely reach the target, or None): J a guess, `ratio` times the distance."""
        from pharos._core import hitting

        self.goal[:] = False
        self.goal[self.nodes_of(target)] = True
        count = hitting.backward_order(*self.back, self.goal, self.order, self.distance)
        j = np.maximum(self.distance, 0) * self.ratio
        if self.choices.is_strongly_connected:
            return j, count, None
        sure, found = np.empty_like(self.goal), np.empty_like(self.goal)
        hitting.almost_surely(*self.support, self.goal, sure, found)
        keep = sure[self.order[:count]]
        kept = self.order[:count][keep]
        self.order[: kept.size] = kept
        j[~sure] = TOP  # a choice that may lead there is never the best
        return j, kept.size, ~sure

    def bounds(self, j: np.ndarray, count: int) -> tuple[float, float, float]:
        """(factor of the lower bound, factor of the upper bound, largest J): J* is between J times these."""
        from pharos._core import hitting

        above, below, largest = hitting.residuals(*self.arrays, self.goal, self.order, count, j, self.policy)
        return 1 / (1 + below), 1 / (1 - above) if above < 1 else math.inf, largest

    def sweep(self, j: np.ndarray, count: int, sweeps: int, enough: float) -> tuple[float, float, float]:
        """Sweeps in place; ends early where the upper bound is at most `enough`."""
        from pharos._core import hitting

        for number in range(sweeps):
            change = hitting.sweep_in_place(*self.arrays, self.goal, self.order, count, j)
            if number % 4 == 3 or change < 1e-13:
                low, high, largest = self.bounds(j, count)
                if largest * high <= enough or change < 1e-13:
                    return low, high, largest
        return self.bounds(j, count)

    def solve(
        self, j: np.ndarray, count: int, tolerance: float, enough: float, spending: Spending
    ) -> tuple[float, float, float]:
        """Until the bounds are within `tolerance` of each other, or the upper one is at most `enough`."""
        low, high, largest = self.sweep(j, count, SWEEPS, enough)
        while not _met(low, high, tolerance) and largest * high > enough and not spending.is_over:
            if count <= SOLVABLE:
                improved = self._evaluate(count)
                if improved is not None:
                    j[self.order[:count]] = improved
                    low, high, largest = self.bounds(j, count)
                    if _met(low, high, tolerance) or largest * high <= enough:
                        break
            low, high, largest = self.sweep(j, count, SWEEPS if count <= SOLVABLE else 8 * SWEEPS, enough)
        return low, high, largest

    def _evaluate(self, count: int) -> np.ndarray | None:
        """The hitting times of the greedy policy; None where it is not proper."""
        nodes = self.order[:count]
        inner = nodes[~self.goal[nodes]]
        rows = self.choices.matrix[inner * self.choices.num_actions + self.policy[inner]][:, inner]
        try:
            times = splu(sparse.csc_matrix(sparse.identity(inner.size) - rows)).solve(np.ones(inner.size))
        except RuntimeError:  # singular
            return None
        if not (np.isfinite(times).all() and (times > 0).all()):
            return None
        full = np.zeros(len(self.goal))
        full[inner] = times
        return full[nodes]


def _without_common(matrix: Any, num_actions: int) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """(first, node, weight) of the rows without what all actions of a node have in common, and that: (first, node, weight) of nodes.

    Under random actions each action may be replaced by any other, under sticky ones by the previous: that part is then added up once.
    """
    nodes = matrix.shape[0] // num_actions
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    pairs, place, times = np.unique(
        (row // num_actions) * np.int64(nodes) + matrix.indices, return_inverse=True, return_counts=True
    )
    least = np.full(len(pairs), np.inf)
    np.minimum.at(least, place, matrix.data)
    least[times < num_actions] = 0.0
    rest = matrix.data - least[place]
    kept = rest > 1e-15
    if kept.sum() + np.count_nonzero(least) >= matrix.nnz:  # nothing gained
        least[:] = 0.0
        rest, kept = matrix.data, np.ones(matrix.nnz, np.bool_)
    shared = least > 0
    first = np.concatenate([[0], np.cumsum(np.bincount(row[kept], minlength=matrix.shape[0]))])
    always = np.concatenate([[0], np.cumsum(np.bincount(pairs[shared] // nodes, minlength=nodes))])
    return (
        (first.astype(np.int64), matrix.indices[kept].astype(np.int64), rest[kept]),
        (always.astype(np.int64), (pairs[shared] % nodes).astype(np.int64), least[shared]),
    )


def _met(low: float, high: float, tolerance: float) -> bool:
    """Whether bounds by these factors are within `tolerance` of each other."""
    return math.isfinite(high) and high - low <= tolerance * high


def stochastic_diameter(mdp: TabularMDP, restart: bool, tolerance: float, spending: Spending) -> Interval:
    """The diameter of an MDP with chance: exact up to `tolerance`, or the interval proven when the budget ends."""
    from pharos.hardness._diameter import _conventions

    choices = choices_of(mdp, restart)
    targets = _Targets(choices)
    number = choices.num_targets
    lower = finite = 0.0
    highest = 0.0
    met = np.diff(targets.edges) > 0
    settled = int(np.count_nonzero(~met))  # states that cannot be reached at all
    unreachable = settled * (number - 1)
    order = [int(target) for target in _by_promise(targets, spending) if met[target]]
    threads = [targets, *(targets.for_another_thread() for _ in range(usable_workers(None) - 1))]
    with ThreadPoolExecutor(len(threads)) as pool:
        at, size = 0, 1  # the first one alone: its hitting times are large, and make a guess for the others
        while at < len(order) and not spending.is_over:
            left = spending.budget.searches - spending.searches
            batch = order[at : at + int(min(size, left))]
            parts = [batch[i :: len(threads)] for i in range(len(threads))]
            looks = [
                pool.submit(_look, own, part, tolerance, finite, spending, learn=at == 0)
                for own, part in zip(threads, parts, strict=True)
                if part
            ]
            for low, high, lost in itertools.chain.from_iterable(look.result() for look in looks):
                finite, highest = max(finite, low), max(highest, high)
                unreachable += lost
            spending.searches += len(batch)
            settled += len(batch)
            for own in threads:
                own.ratio = targets.ratio
            at, size = at + len(batch), min(2 * size, BATCH)
            spending.report(finite, max(highest, choices.crude_upper if settled < number else 0.0), number - settled)
    done = settled == number
    upper = max(highest, finite) if done else max(highest, choices.crude_upper)
    lower = finite
    note = "" if done else f"budget spent: {number - settled} of {number} targets were not looked at"
    if unreachable:
        lower = upper = math.inf
    exact = done and (math.isinf(lower) or (math.isfinite(upper) and upper - lower <= 2 * tolerance * upper))
    if done and not exact:
        note = "budget spent before the bounds of the last targets met"
    spending.report(lower, upper, number - settled, now=True)
    return Interval(
        lower,
        upper,
        exact,
        unreachable_pairs=int(unreachable),
        finite_part=finite,
        counted=done,
        tolerance=tolerance,
        searches=spending.searches,
        method="a stochastic shortest path problem for each target, bounds from residuals",
        conventions={**_conventions(mdp, restart), "nodes": len(choices.underlying), "sticky_pairs": mdp.is_sticky},
        note=note,
        seconds=spending.seconds,
    )


def _look(
    targets: _Targets, some: list[int], tolerance: float, enough: float, spending: Spending, learn: bool
) -> list[tuple[float, float, int]]:
    """For each target: bounds of the largest hitting time, and how many states do not surely reach it.

    What lies below `enough` is known no better than that; it is the same for all targets of a batch, so that results do not depend on
    the number of threads.
    """
    found = []
    for target in some:
        j, count, lost = targets.open(target)
        missing = 0 if lost is None else np.unique(targets.choices.underlying[lost]).size
        low, high, largest = targets.solve(j, count, tolerance, enough, spending)
        found.append((largest * low, largest * high, missing))
        if learn:
            targets.learn_ratio(j)
    return found


def _by_promise(targets: _Targets, spending: Spending) -> np.ndarray:
    """All targets, those first that are farthest from some node: a large hitting time found early lets others be dropped."""
    from pharos._core import hitting

    number = targets.choices.num_targets
    promise = np.zeros(number)
    if len(targets.choices.underlying) * number > 5e9:  # a look at each would cost more than it saves
        return np.arange(number)[::-1]
    for target in range(number):
        if spending.is_over:
            break
        targets.goal[:] = False
        targets.goal[targets.nodes_of(target)] = True
        count = hitting.backward_order(*targets.back, targets.goal, targets.order, targets.distance)
        promise[target] = targets.distance[targets.order[count - 1]] if count else 0
    return np.argsort(-promise, kind="stable")


def stochastic_start_eccentricity(
    mdp: TabularMDP, restart: bool, tolerance: float, budget: Budget | None = None
) -> float:
    """The largest least expected number of steps from the start, within `tolerance`.

    Raises:
        UndefinedMeasure: out of reach of the budget (300 seconds by default).
    """
    choices = choices_of(mdp, restart)
    targets = _Targets(choices)
    spending = Spending(budget or Budget(), None)
    nodes = np.array([node for node, _ in choices.starts])
    weights = np.array([weight for _, weight in choices.starts])
    best = 0.0
    for target in range(choices.num_targets):
        if spending.is_over:
            raise UndefinedMeasure(
                f"start_eccentricity: {target} of {choices.num_targets} targets were solved in the budget, and reach {best:.6g}; "
                f"a larger budget would define it"
            )
        if not targets.nodes_of(target).size:
            return math.inf
        j, count, lost = targets.open(target)
        if lost is not None and lost[nodes].any():
            return math.inf
        _, high, _ = targets.sweep(j, count, SWEEPS, 0.0)
        if float(weights @ j[nodes]) * high <= best:
            continue
        low, high, _ = targets.solve(j, count, tolerance, 0.0, spending)
        if not _met(low, high, tolerance):
            raise UndefinedMeasure(
                f"start_eccentricity: the budget ended within a target, at {float(weights @ j[nodes]) * low:.6g} or more; "
                f"a larger budget would define it"
            )
        best = max(best, float(weights @ j[nodes]) * high)
    return best
