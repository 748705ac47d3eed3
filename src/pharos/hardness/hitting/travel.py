"""Upper bounds of expected times under chance, for all targets at once, from the solution of one of them.

Let E(s, y) be the least expected number of steps from s to y, and h a hub with E(s, h) <= U(s) for all s. To go from x
to y, choose an action a that may lead there. With probability P(s') it leads to s' != y instead. From there take a
short way back to y where there is one, each of its steps in the same manner; else give up, and go to the hub. This
attempt takes at most c(x, a, y) expected steps and is given up with probability at most l(x, a, y), where

    c(x, a, y) = 1 + sum over near s' of P(s') (sum of c along the way back) + sum over other s' of P(s') U(s')
    l(x, a, y) =     sum over near s' of P(s') (sum of l along the way back) + sum over other s' of P(s').

An s' counts as near as long as rho = sum of P(s') (steps of the way back) stays below a limit, so that both have a
solution:
for any c' that falls short of the right side by at most d, c' + d / (1 - rho) does not. Given up, go on from the hub to
y directly:

    E(h, y) <= E(h, x) + c(x, a, y) + l(x, a, y) E(h, y),

and Dijkstra's algorithm finds the best x and a for every y: E(h, y) <= V(y). The largest expected time to target e is
then at most the largest U(s) plus V(e). Under sticky actions sums are the largest over the previously executed action,
and so is U.

Where slips cannot be taken back, but lead on to where the way goes on as well, y need not be the next node: with the
nodes around y, those on short ways from h to y, the nearest to y first, as a problem of its own in which to leave them
is to give up,

    E(x, y) <= c(x) + l(x) E(h, y), where c(y) = l(y) = 0, and outside c = U, l = 1,

holds for c = U, l = 1 everywhere, and goes on to hold where c(x), l(x) become 1 + sum P c and sum P l under any action,
node by node (`shortened`). So E(h, y) <= (E(h, x) + c(x)) / (1 - l(x)) for every x around y, and what was a slip at
each step on the way is one for as many steps as lie between x and y. Each x on the way still has to be met exactly, at
a factor of 1 / (1 - l(x)) each time. So a few targets, drawn at random, are bounded by long ways of thousands of nodes
from each other, and every target by a short way from one of them: a few factors instead of hundreds.
"""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np

from pharos.kernels import hitting
from pharos.mdp import TabularMDP, outcomes_of
from pharos.system.workers import usable_workers

# Nodes around each state among which ways back are looked for: a few steps in all directions of a grid.
NEARBY = 64
# Expected steps on ways back, at most: a step takes 1 / (1 - LIMIT) = 5 times as long then; more ways are seldom worth
# it.
LIMIT = 0.8
# Outcomes of a state beyond which nothing counts as near: ways back are kept for each pair of them.
SQUARE = 64
# Passes over the ways back, and the change of a value, in steps, at which they end; what is missing is added to the
# bound.
PASSES = 100
ACCURACY = 1e-4
# Outcomes below which threads are not worth their start.
SMALL = 100_000
# Sweeps over the nodes around a target, at most, and parts of all targets, in the order of their bounds: each part
# knows the bounds of those before it, and threads share a part, so that results do not depend on their number.
SWEEPS, PARTS = 30, 64
# More than the relative rounding of sums of positive numbers along any way.
ROUNDING = 1 + 1e-9


class HubBounds:
    """The bounds of an MDP; nodes are its states, and the implicit end where there is one.

    Cost: two searches of 64 nodes around each state, once; for a hub some passes over the ways back and one run of
        Dijkstra's algorithm. Memory: some 30 bytes for each outcome of each action and a byte for each pair of outcomes
        of a state.
    """

    def __init__(self, mdp: TabularMDP, restart: bool):
        chance, num_actions = mdp.chance, mdp.num_actions
        weights = (
            chance.chosen,
            chance.previous,
            chance.uniform / num_actions,
            chance.first_chosen,
            chance.first_uniform / num_actions,
        )
        self._outcomes = _outcomes(mdp, restart)
        first, _, node, _ = self._outcomes
        owner = np.repeat(np.arange(len(first) - 1), np.diff(first))
        self._num_actions = num_actions
        self._steps = -1, np.empty(0, np.int32)  # a hub, and those from it to each node
        self._fixed = (self._outcomes, owner, weights, mdp.policy_width - 1)
        self._threads = usable_workers(None) if len(node) > SMALL else 1
        with ThreadPoolExecutor(self._threads) as pool:
            self._find_ways_back(owner, pool)
        self.leak = self._solve(0.0, np.ones(len(first) - 1))

    def _find_ways_back(self, owner: np.ndarray, pool: ThreadPoolExecutor) -> None:
        first, _, node, _ = self._outcomes
        size = len(first) - 1
        counts = np.diff(first)[owner]
        used = (counts <= SQUARE) & (owner != node)
        ends = np.cumsum(np.where(used, counts, 0))
        square = np.where(used, ends - counts, -1)
        steps = np.empty(int(ends[-1]) if len(ends) else 0, np.uint8)
        into = hitting.outcomes_into(node, size)
        dtype = np.int32 if len(node) < 2**31 else np.int64
        edges = np.linspace(0, size, self._threads + 1).astype(np.int64)
        room = [
            (np.zeros(size, np.uint8), np.empty(NEARBY, np.int64), np.empty(size, dtype)) for _ in range(self._threads)
        ]

        def all_nodes(kernel, *arguments):  # type: ignore[no-untyped-def]
            def part(thread: int) -> None:
                low, high = edges[thread], edges[thread + 1]
                kernel(low, high, self._outcomes, owner, into, square, steps, *arguments, NEARBY, *room[thread])

            list(pool.map(part, range(self._threads)))

        all_nodes(hitting.steps_back)
        length = np.empty(len(node), np.int64)
        self._rho = hitting.keep_near(*self._fixed, square, steps, LIMIT, length)
        start = np.cumsum(length) - length
        way = np.empty(int(length.sum()), dtype)
        all_nodes(hitting.ways_back, start, way)
        self._ways = (square, steps, start, way)

    def _solve(self, own: float, times: np.ndarray) -> np.ndarray:
        """(outcomes,) c for own = 1 and times = U; l for own = 0 and times = 1."""
        value = np.full(len(self._fixed[1]), own)
        new = value.copy()
        edges = np.linspace(0, len(value), self._threads + 1).astype(np.int64)
        with ThreadPoolExecutor(self._threads) as pool:
            for passes in range(PASSES):
                arrays = (own, times, value, new, passes < 2)  # twice, as two arrays take turns
                parts = [
                    pool.submit(hitting.attempt, low, high, *self._fixed, *self._ways, *arrays)
                    for low, high in itertools.pairwise(edges)
                ]
                short = max(part.result() for part in parts)
                if short <= ACCURACY * (1 - self._rho):
                    break
                value, new = new, value
        return value + max(short, 0.0) / (1 - self._rho)

    def times_from(self, hub: int, times: np.ndarray) -> np.ndarray:
        """(N,) V: upper bounds of the expected steps from the hub to each node, given those from each node to the
        hub."""
        first, _, node, _ = self._outcomes
        return hitting.times_from(hub, first, node, self._solve(1.0, times), self.leak) * ROUNDING

    def shortened(
        self, times: np.ndarray, bound: np.ndarray, targets: np.ndarray, size: int, is_over: Callable[[], bool]
    ) -> np.ndarray:
        """(N,) `bound`, or less where the way through the nodes around a target is shorter.

        Args:
            times, bound: (N,) upper bounds of the expected steps to the hub, and from it.
            targets: those whose bounds are to be shortened.
            size: nodes around each of them.
            is_over: whether to leave the rest as it is; asked between parts.
        Cost: for each of the targets some passes over `size` nodes.
        """
        outcomes, owner, weights, num_previous = self._fixed
        num_nodes = len(outcomes[0]) - 1
        room = [
            (
                np.zeros(num_nodes, np.int32),
                np.empty(size, np.int64),
                np.empty((4 * size, 2), np.int64),
                np.empty(hitting.TURNS, np.int64),
                *np.empty((2, size, num_previous + 1)),
            )
            for _ in range(self._threads)
        ]
        bound, new = bound.copy(), np.empty(num_nodes)
        graph = (outcomes, owner, self._into, self._steps_from(int(np.argmin(bound))))
        chance = (weights, num_previous, self._num_actions)
        fixed = (graph, chance, times, bound, new, SWEEPS)
        with ThreadPoolExecutor(self._threads) as pool:
            order = targets[np.argsort(bound[targets], kind="stable")]
            for part in np.array_split(order, min(PARTS, max(len(order), 1))):
                if is_over():
                    break
                edges = np.linspace(0, len(part), self._threads + 1).astype(np.int64)
                tasks = [
                    pool.submit(hitting.shorten, part, low, high, *fixed, own)
                    for own, low, high in zip(room, edges[:-1], edges[1:], strict=True)
                ]
                for task in tasks:
                    task.result()
                bound[part] = new[part]
        return bound

    @cached_property
    def _into(self) -> tuple[np.ndarray, np.ndarray]:
        """Which outcomes lead to each node; made anew for shortening, as many MDPs need none, and it is large."""
        first, _, node, _ = self._outcomes
        return hitting.outcomes_into(node, len(first) - 1)

    def _steps_from(self, hub: int) -> np.ndarray:
        """(N,) int32, see `vicinity.steps_from`; the last ones are kept, as rounds of shortening have one hub."""
        if hub != self._steps[0]:
            first, _, node, _ = self._outcomes
            self._steps = hub, hitting.steps_from(hub, first, node)
        return self._steps[1]


def _outcomes(mdp: TabularMDP, restart: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(first, action, node, probability) of what executing each action in each state may lead to; -1: whatever
    action."""
    terminal = np.asarray(mdp.terminal)
    executed, ends = outcomes_of(mdp, terminal)
    num_states, num_actions = mdp.num_states, mdp.num_actions
    starts = np.flatnonzero(np.asarray(mdp.start_probabilities) > 0)
    ended = np.append(np.flatnonzero(terminal), np.full(int(ends), num_states, np.int64)).astype(np.int64)
    counts = np.zeros(num_states + ends, np.int64)
    counts[:num_states] = np.diff(executed.indptr).reshape(num_states, num_actions).sum(axis=1)
    counts[ended] = len(starts) if restart else 0
    first = np.concatenate([[0], np.cumsum(counts)])
    action = np.full(int(first[-1]), -1, np.int16)
    node, prob = np.empty(action.size, np.int64), np.empty(action.size)
    of_live = np.ones(action.size, np.bool_)
    if restart:
        places = (first[ended][:, None] + np.arange(len(starts))).ravel()
        of_live[places] = False
        node[places] = np.tile(np.asarray(mdp.start_states)[starts], len(ended))
        prob[places] = np.tile(np.asarray(mdp.start_probabilities)[starts], len(ended))
    rows = np.repeat(np.arange(num_states * num_actions), np.diff(executed.indptr))
    action[of_live], node[of_live], prob[of_live] = rows % num_actions, executed.indices, executed.data
    return first, action, node, prob
