"""The diameter of a graph by directed ExactSumSweep, searches from many nodes at once, and the argument of clocks.

`Graph` is the graph of a deterministic MDP, with searches forward and backward. `GraphLayers` are the layers of a graph
that contains a clock: every edge leads from one layer of nodes to the next, and round again. `orbits` are states that
cannot be told apart by the states that actions lead to. Source: Borassi et al. (2015); Then et al. (2014). Clocks are
an argument of ours.

Clocks that the restart hides: the largest distances to many states, by searches that stand in the same layer. Let H be
the graph without the edges of states that end, and e(u) the least number of steps from u to a state that ends, and one
more. A shortest path from the start s does not pass it again, so d(s, v) is the distance in H, and

    d(u, v) = min(d_H(u, v), e(u) + d(s, v)).

e and d(s, .) come from the searches from the start. If all cycles of H are multiples of P steps long, as if
traffic goes by, all edges of H lead from one layer {v: d(s, v) = j modulo P} to the next. Searches in H backward from
many targets then stand in one layer if each begins when the layer of its target has its turn
(`kernels.search_in_step`): that one layer is read for all targets, while levels, counted from each target, are as many
layers as targets have. They end after as many steps as the other way has. Restarts, which lead from all layers to the
first, make the common length of cycles 1 and would spread every search over all layers. In H they do not exist.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from pharos.hardness.interval import COMMAND_SECONDS, MORE, Budget, BudgetClock, Interval
from pharos.kernels import graph as kernels
from pharos.kernels import many_searches
from pharos.mdp import TabularMDP
from pharos.system.arrays import Indices
from pharos.system.wording import pluralize


class Graph:
    """The graph of a deterministic MDP, with restart edges and the implicit end, see `pharos.kernels.graph`.

    Attributes:
        num_nodes: N, the states and, if some transition of a state that is not terminal is -1, the end.
        start: the node that terminal states lead to. -1: they lead nowhere.
        pivot: a start state, at which searches begin.
    """

    def __init__(self, next_states: Indices, terminal: np.ndarray, start: int, pivot: int):
        self.next_states = next_states
        self.ends = np.ascontiguousarray(terminal, np.bool_)
        self.start, self.pivot = start, pivot
        self.has_end = _leads_to_end(next_states, self.ends)
        self.num_nodes = len(next_states) + self.has_end
        self.dtype = np.int32 if self.num_nodes < 2**31 else np.int64
        self.queue = np.empty(self.num_nodes, self.dtype)
        self._reversed: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    @staticmethod
    def of(mdp: TabularMDP, restart: bool) -> "Graph | None":
        """The graph of `mdp`, or None if a choice or a restart has several outcomes."""
        if not mdp.chance.is_none:
            return None
        table = mdp.dynamics.deterministic_table()
        if table is None:
            return None
        restarts = restart and (bool(mdp.terminal.any()) or _leads_to_end(table, mdp.terminal))
        if restarts and len(mdp.start_states) > 1:
            return None
        pivot = int(mdp.start_states[0])
        return Graph(table, mdp.terminal, pivot if restarts else -1, pivot)

    @property
    def backward(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(first, previous, restarting): the reversed graph, made when it is first needed."""
        if self._reversed is None:
            restarting = np.empty(0, self.dtype)
            if self.start >= 0:
                ending = np.flatnonzero(self.ends)
                restarting = np.append(ending, [len(self.next_states)] * self.has_end).astype(self.dtype)
            self._reversed = (*kernels.reversed_graph(self.next_states, self.ends, self.num_nodes), restarting)
        return self._reversed

    def search_forward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """Set distance[v] to d(source, v). Return (nodes found, largest distance, sum of distances)."""
        return kernels.search((self.next_states, self.ends), None, self.start, source, distance, self.queue)

    def search_backward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """Set distance[v] to d(v, source). Return (nodes found, largest distance, sum of distances)."""
        return kernels.search(None, self.backward, self.start, source, distance, self.queue)


def _leads_to_end(table: Indices, terminal: np.ndarray) -> bool:
    """Whether a row that is followed holds -1. In blocks, for tables that are larger than memory."""
    block = 1 << 20
    for low in range(0, len(table), block):
        rows = table[low : low + block]
        if rows.min(initial=0) >= 0:
            continue
        ending = (rows < 0).any(axis=1)
        if (ending & ~np.asarray(terminal[low : low + block])).any():
            return True
    return False


# Layers ---------------------------------------------------------------------------------------------------------------


# Nodes of a layer beyond which layers are not narrow: a set of them no longer fits into a core's cache.
WIDE_LAYER = 1024


class GraphLayers(NamedTuple):
    """The nodes of a graph by layer.

    Attributes:
        order: (N,) nodes by layer. first: (P + 1,) the beginning of each layer in it.
        position: (N,) int32, the index of a node in its layer.
    """

    order: np.ndarray
    first: np.ndarray
    position: np.ndarray

    @staticmethod
    def of(layer: np.ndarray, widths: np.ndarray, dtype: DTypeLike) -> "GraphLayers":
        """
        Args:
            layer: (N,) the layer of each node. widths: (P,) how many nodes each has. dtype: of nodes.
        """
        first = np.concatenate([[0], np.cumsum(widths)])
        order = np.argsort(layer, kind="stable").astype(dtype)
        position = np.empty(len(layer), np.int32)
        position[order] = np.arange(len(layer)) - np.repeat(first[:-1], widths)
        return GraphLayers(order, first, position)

    @property
    def number(self) -> int:
        """P."""
        return len(self.first) - 1

    @property
    def widest(self) -> int:
        """Nodes of the largest layer."""
        return int(np.diff(self.first).max())


# Hidden clocks --------------------------------------------------------------------------------------------------------


# Cycles shorter than this leave layers so wide that searches by levels read as little.
_SHORTEST = 64
# Times that searches may go round.
_ROUNDS = 4


class HiddenClock(NamedTuple):
    """The layers of a graph without its restarts.

    Attributes:
        home: (N,) steps to the start. away: (N,) steps from it.
        layers: of the nodes, by `away` modulo P.
    """

    home: np.ndarray
    away: np.ndarray
    layers: GraphLayers

    @staticmethod
    def of(graph: Graph, home: np.ndarray, away: np.ndarray) -> "HiddenClock | None":
        """The clock of a graph with restarts. None if there is none, or its layers do not pay.

        Args:
            home, away: (N,) distances to the start, and from it.
        """
        if graph.start < 0 or graph.has_end:
            return None
        # Without a cycle nothing goes round: as many layers as there are distances.
        cycle = int(kernels.period(graph.next_states, graph.ends, -1, away, False)) or int(away.max()) + 1
        if cycle < _SHORTEST or int(away.max()) + int(home.max()) > _ROUNDS * cycle:
            return None
        layer = away % cycle
        widths = np.bincount(layer, minlength=cycle)
        if int(widths.max()) > WIDE_LAYER:
            return None
        return HiddenClock(home.copy(), away.copy(), GraphLayers.of(layer, widths, graph.dtype))

    def largest_to(self, graph: Graph, targets: np.ndarray, best: int) -> tuple[np.ndarray, int]:
        """((targets,) max over u of d(u, target), or `best` if that is larger, table entries read)."""
        cycle = self.layers.number
        of_target = self.away[targets] % cycle
        order = np.argsort(-of_target, kind="stable")
        # The first is the one after the longest stretch of layers without a target.
        gaps = (np.roll(of_target[order], 1) - of_target[order]) % cycle
        order = np.roll(order, -int(gaps.argmax()))
        first = int(of_target[order[0]])
        offset = (first - of_target[order]) % cycle
        words = -(-len(targets) // 64)
        scratch = np.zeros((2, self.layers.widest, words), np.uint64)
        visits = np.zeros((len(self.away), words), np.uint64)
        largest = np.full(len(targets), best, np.int64)
        ordered = np.ascontiguousarray(targets[order], np.int64)
        reads = kernels.search_in_step(
            graph.next_states,
            graph.ends,
            *self.layers,
            ordered,
            first,
            offset.astype(np.int64),
            self.away[ordered].astype(np.int64),
            self.home,
            best,
            scratch,
            visits,
            largest,
        )
        result = np.empty_like(largest)
        result[order] = largest
        return result, int(reads)


# Sum sweep ------------------------------------------------------------------------------------------------------------


# Widths of searches from many nodes, in words of 64 sources: eight words are a cache line.
_WORDS = (1, 8)
# Levels up to which every node pulls on every level. Breakout has six times as many, puzzles half of them.
_FEW_LEVELS = 100
# Orbits from each of which a search is made.
_FEW_ORBITS = 64
# Bytes that searches from many nodes may take.
_BATCH_MEMORY = 2**31
COUNTING = 10.0  # seconds for counting the pairs of an infinite diameter, unless a budget is given
DEFAULT_BUDGETS = (Budget(), Budget(seconds=COMMAND_SECONDS))
# Table entries that are followed in a second on a slow core, to know how many a budget allows for.
READS = 10**8


class SumSweep:
    """Bounds on all eccentricities, tightened by searches until one side leaves no node that could be farther.

    out(v) = max over w of d(v, w), in(v) = max over w of d(w, v). From d(v, w) <= d(v, p) + d(p, w) follow
    out(v) <= d(v, p) + out(p) and in(v) <= in(p) + d(p, v) for a pivot p searched in both directions. A search from w
    in one direction gives out(w) or in(w) exactly, and a lower bound for everyone. D = max out = max in: it is proven
    as soon as no out(v), or no in(v), can exceed the largest eccentricity found.
    """

    def __init__(self, graph: Graph, spending: BudgetClock):
        self.graph, self.spending = graph, spending
        size, dtype = graph.num_nodes, graph.dtype
        self.away, self.to = np.empty(size, dtype), np.empty(size, dtype)
        self.out_lower, self.in_lower = np.zeros(size, dtype), np.zeros(size, dtype)
        unknown = np.iinfo(dtype).max
        self.out_upper, self.in_upper = np.full(size, unknown, dtype), np.full(size, unknown, dtype)
        self.best = 0
        self.method = "directed ExactSumSweep"

    def interval(self) -> Interval:
        graph = self.graph
        if not self._pivot(graph.pivot):
            return _infinite_diameter(graph, self.spending)
        note = ""
        clock = self._from_clock()
        if isinstance(clock, Interval):
            return clock
        self._search_in_step()
        self._search_orbits()
        self._sweep()
        upper = self._upper()
        if upper > self.best:
            open_states = pluralize(self._open()[0], "state")
            note = f"budget spent: {open_states} may have a larger eccentricity than {self.best}"
            note += f"; {MORE}"
            if clock:
                note += f"; {clock}"
        return self._result(self.best, upper, note)

    def _result(self, lower: int, upper: int, note: str) -> Interval:
        exact = lower == upper
        self.spending.report(lower, upper, 0 if exact else self._open()[0], now=True)
        bounds = float(lower), float(upper)
        interval = Interval(*bounds, exact, finite_part=float(lower), counted=exact, method=self.method, note=note)
        return self.spending.signed(interval)

    # Searches ---------------------------------------------------------------------------------------------------------

    def _pivot(self, p: int) -> bool:
        """Search from p in both directions. False if p does not reach all nodes, or not all reach p."""
        forward, out_pivot, _ = self.graph.search_forward(p, self.away)
        backward, in_pivot, _ = self.graph.search_backward(p, self.to)
        self.spending.searches += 2
        if forward < self.graph.num_nodes or backward < self.graph.num_nodes:
            return False
        kernels.bound_eccentricities(
            self.away, self.to, out_pivot, in_pivot, self.out_lower, self.out_upper, self.in_lower, self.in_upper
        )
        self._settle_out(p, out_pivot)
        self._settle_in(p, in_pivot)
        return True

    def _search_out(self, v: int) -> None:
        _, largest, _ = self.graph.search_forward(v, self.away)
        np.maximum(self.in_lower, self.away, out=self.in_lower)
        self._settle_out(v, largest)
        self.spending.searches += 1

    def _search_in(self, v: int) -> None:
        _, largest, _ = self.graph.search_backward(v, self.to)
        np.maximum(self.out_lower, self.to, out=self.out_lower)
        self._settle_in(v, largest)
        self.spending.searches += 1

    def _settle_out(self, v: int, value: int) -> None:
        self.out_lower[v] = self.out_upper[v] = value
        self.best = max(self.best, int(value))

    def _settle_in(self, v: int, value: int) -> None:
        self.in_lower[v] = self.in_upper[v] = value
        self.best = max(self.best, int(value))

    def _open(self) -> tuple[int, tuple[int, int, int, int, int]]:
        counts = kernels.open_eccentricities(self.out_lower, self.out_upper, self.in_lower, self.in_upper, self.best)
        return min(counts[0], counts[1]), counts

    def _upper(self) -> int:
        return max(self.best, min(int(self.out_upper.max()), int(self.in_upper.max())))

    # The sweep --------------------------------------------------------------------------------------------------------

    def _sweep(self) -> None:
        """Search in the way that pays: the kind that closed most nodes for its cost, the others now and then.

        The kinds: from the node of the largest upper bound forward, or backward; from the middle in both directions;
        from up to 512 open nodes at once, pushing to neighbours or, if levels are few, pulling from them. Costs are
        counted in table entries read, not in seconds, so that the searches made are the same on every machine.
        """
        one = max(1, self.graph.num_nodes * self.graph.next_states.shape[1])
        worth = {"out": math.inf, "in": math.inf, "middle": math.inf}
        still_open, (num_out, num_in, far_out, far_in, middle) = self._open()
        while still_open and not self.spending.is_over:
            if len(worth) == 3 and self.spending.searches >= 12 and still_open >= 16:
                if self.best <= _FEW_LEVELS and self._fits(many_searches.WORDS):
                    worth["dense"] = math.inf
                else:
                    worth |= {f"many {words}": math.inf for words in _WORDS if self._fits(words)}
            kind = max(worth, key=lambda name: worth[name])
            cost = 1.0
            if kind == "out":
                self._search_out(far_out)
            elif kind == "in":
                self._search_in(far_in)
            elif kind == "middle":
                self._pivot(middle)
                cost = 2.0
            elif kind == "dense":
                cost = self._search_densely() / one
            else:
                cost = self._search_many(num_out <= num_in, int(kind.split()[1])) / one
            before = still_open
            still_open, (num_out, num_in, far_out, far_in, middle) = self._open()
            for name in worth:
                worth[name] *= 1.05
            worth[kind] = (before - still_open + 1e-3) / max(cost, 1e-3)
            self.spending.report(self.best, self._upper(), still_open)

    def _fits(self, words: int) -> bool:
        return 24 * words * self.graph.num_nodes <= _BATCH_MEMORY

    def _limit(self, words: int) -> int:
        """Number of searches at once that `words` and the budget allow for."""
        return int(min(64 * words, max(1, self.spending.budget.searches - self.spending.searches)))

    def _farthest(self, upper: np.ndarray, words: int) -> np.ndarray:
        """Open nodes, the largest upper bounds first, as many as are searched from at once."""
        nodes = np.flatnonzero(np.greater(upper, self.best))
        return nodes[np.argsort(-upper[nodes].astype(np.int64), kind="stable")[: self._limit(words)]]

    def _search_many(self, outward: bool, words: int) -> int:
        """Find the eccentricities of the open nodes of largest upper bounds. Return table entries read, times words."""
        graph = self.graph
        upper, lower = (self.out_upper, self.out_lower) if outward else (self.in_upper, self.in_lower)
        nodes = np.sort(self._farthest(upper, words))
        sources = nodes.astype(graph.dtype)
        words = -(-len(sources) // 64)
        largest = np.empty(len(sources), np.int64)
        origins, front, coming = (np.zeros((graph.num_nodes, words), np.uint64) for _ in range(3))
        scratch = (origins, front, coming, graph.queue, np.empty_like(graph.queue))
        table, reverse = ((graph.next_states, graph.ends), None) if outward else (None, graph.backward)
        _, reads = many_searches.search_from_many(table, reverse, graph.start, sources, *scratch, largest)
        upper[nodes] = lower[nodes] = largest
        self.best = max(self.best, int(largest.max()))
        self.spending.searches += len(sources)
        self.method = "directed ExactSumSweep, then searches from many states at once"
        return int(reads) * (1 + words)

    def _search_densely(self) -> int:
        """Find the exact in(v) of up to 512 open nodes, and bounds along edges. Return the cost, in table entries.

        If most eccentricities are nearly equal, as in puzzles whose moves can be taken back, no pivot rules many nodes
        out. But a node with in(u) < D does so for its successors, as in(v) <= 1 + in(u). So none of the nodes is a
        successor of another one, and those with many successors come first: they lie in the middle and close most. A
        line that is pulled takes an eighth of the time of one that is pushed (512 nodes of the 8-puzzle: 0.25 s in
        place of 2.8 s).
        """
        graph = self.graph
        table, ends, start = graph.next_states, graph.ends, graph.start
        nodes = np.flatnonzero(np.greater(self.in_upper, self.best)).astype(graph.dtype)
        degrees = many_searches.num_successors(table, ends, graph.num_nodes)[nodes]
        order = nodes[np.lexsort((-self.in_upper[nodes].astype(np.int64), -degrees.astype(np.int64)))]
        limit = self._limit(many_searches.WORDS)
        blocked, active, arriving = (np.zeros(graph.num_nodes, np.bool_) for _ in range(3))
        sources = np.sort(many_searches.spread_out(table, ends, order, blocked, limit))
        origins, front, coming = (np.zeros((graph.num_nodes, many_searches.WORDS), np.uint64) for _ in range(3))
        largest = np.empty(len(sources), np.int64)
        scratch = (origins, front, coming, active, arriving)
        reads = many_searches.dense_search_backward(table, ends, start, sources, *scratch, largest)
        self.in_upper[sources] = self.in_lower[sources] = largest
        self.best = max(self.best, int(largest.max()))
        passes = 1
        while many_searches.lower_along_edges(table, ends, start, self.in_upper, self.out_upper):
            passes += 1
        self.spending.searches += len(sources)
        self.method = "directed ExactSumSweep, then searches from many states at once"
        return int(reads) * (1 + many_searches.WORDS) // 8 + passes * table.size

    # Symmetries -------------------------------------------------------------------------------------------------------

    def _search_orbits(self) -> None:
        """Find the exact out(v) of all states by a search from one of each orbit, if symmetries leave few orbits."""
        graph = self.graph
        orbit = orbits(graph.next_states, graph.ends, graph.start, graph.pivot, lambda: self.spending.is_over)
        if orbit is None:
            return
        representatives = np.flatnonzero(orbit == np.arange(len(orbit)))
        if len(representatives) > _FEW_ORBITS:
            return
        for v in representatives:
            if self.spending.is_over:
                return
            self._search_out(int(v))
            self.out_upper[: len(orbit)][orbit == v] = self.out_upper[v]
        self.method = f"searches from one state of each of {len(representatives)} orbits of symmetries"

    # Clocks -----------------------------------------------------------------------------------------------------------

    def _search_in_step(self) -> None:
        """Find in(v) of all open nodes, the farthest first, if the graph without restarts has a clock."""
        is_tried = self._open()[0] and self._fits(1)
        clock = HiddenClock.of(self.graph, self.to, self.away) if is_tried else None
        while clock is not None and self._open()[0] and not self.spending.is_over:
            targets = self._farthest(self.in_upper, _WORDS[-1] if self._fits(_WORDS[-1]) else 1)
            largest, _ = clock.largest_to(self.graph, targets, self.best)
            self.in_upper[targets] = largest
            self.best = max(self.best, int(largest.max()))
            self.spending.searches += len(targets)
            self.method = f"searches in step with {clock.layers.number} layers of a clock that restarts hide"
            self.spending.report(self.best, self._upper(), self._open()[0])

    def _from_clock(self) -> "Interval | str":
        """D of a graph that contains a clock, or why this argument does not give it ("": there is no clock).

        Let the graph be strongly connected and P the greatest common divisor of the lengths of its cycles. The layers
        C_j = {v: d(p, v) = j modulo P} are such that every edge leads from C_j to C_{j+1}. Let R_k(u) be the set of
        nodes that u in C_j reaches in exactly k steps, a subset of C_{j+k}. Once R_k(u) is all of C_{j+k}, so is
        R_{k+1}(u) all of C_{j+k+1}, as every node has a predecessor, which lies in the layer before. Let g be the
        largest k at which some u does not reach its whole layer, g = -1 if there is none.

        Claim: if g < P then D = P + g. At most: for all u and v one of g + 1, ..., g + P is the difference of their
        layers modulo P, and R of that many steps is whole, so d(u, v) <= g + P. At least, for g >= 0: let v be missing
        in R_g(u). All walks from u to v have a length of g modulo P. g itself is none, and as g < P nothing smaller is,
        so d(u, v) >= g + P. For g = -1 every layer is one node and the graph is a cycle of P nodes: D = P - 1.

        The sets are found for one layer at a time, a bit for each of its nodes. This pays if layers are narrow.
        """
        graph = self.graph
        if graph.num_nodes < 64:
            return ""
        cycle = int(kernels.period(graph.next_states, graph.ends, graph.start, self.away, graph.has_end))
        if cycle < 8:
            return ""
        layer = self.away % cycle
        widths = np.bincount(layer, minlength=cycle)
        widest = int(widths.max())
        if widest > WIDE_LAYER:
            return f"all cycles have multiples of {cycle} steps, but a layer of {widest} states is too wide to follow"
        layers = GraphLayers.of(layer, widths, graph.dtype)
        now, later = (np.empty((widest, -(-widest // 64)), np.uint64) for _ in range(2))
        affordable = max(self.spending.seconds_left, 0.0) * READS
        max_reads = int(min(200 * graph.num_nodes * graph.next_states.shape[1] + 10**8, affordable))
        gap, _ = kernels.last_gap(graph.next_states, graph.ends, graph.start, *layers, now, later, max_reads)
        if gap == -2:
            return f"all cycles have multiples of {cycle} steps, but some state needs more to reach its whole layer"
        if gap == -3:
            return f"all cycles have multiples of {cycle} steps, but following the layers takes too long for the budget"
        self.method = f"reach sets in the {cycle} layers of a clock, none of more than {widest} states"
        return self._result(cycle + int(gap), cycle + int(gap), "")


def _infinite_diameter(graph: Graph, spending: BudgetClock) -> Interval:
    """D of a graph that is not strongly connected: infinite, with unreachable pairs and the finite part.

    The value is known before any pair is counted, so of the default budget no more than COUNTING seconds go into that.
    """
    size = graph.num_nodes
    end = spending.seconds + COUNTING if spending.budget in DEFAULT_BUDGETS else math.inf
    words = 8 if 24 * 8 * size <= _BATCH_MEMORY else 1
    origins, front, coming = (np.zeros((size, words), np.uint64) for _ in range(3))
    scratch = (origins, front, coming, graph.queue, np.empty_like(graph.queue))
    num_reached = finite = done = 0
    while done < size and not spending.is_over and spending.seconds < end:
        sources = np.arange(done, min(done + 64 * words, size), dtype=graph.dtype)
        origins[:] = 0
        largest = np.empty(len(sources), np.int64)
        table = (graph.next_states, graph.ends)
        pairs, _ = many_searches.search_from_many(table, None, graph.start, sources, *scratch, largest)
        num_reached += int(pairs)
        finite = max(finite, int(largest.max()))
        done += len(sources)
        spending.searches += len(sources)
        spending.report(finite, math.inf, size - done)
    unreachable = done * (size - 1) - num_reached
    counted = done == size
    note = "some states cannot be reached from others"
    if not counted:
        note += f"; counted for {spending.seconds:.0f} s: the pairs from {done} of {pluralize(size, 'state')}"
        note += ", so the counts are lower bounds; a budget of your own (--budget) counts more"
        unreachable = max(unreachable, 1)
    method = "searches from all states, many at once"
    interval = Interval(math.inf, math.inf, True, unreachable, float(finite), counted, method=method, note=note)
    return spending.signed(interval)


# Orbits ---------------------------------------------------------------------------------------------------------------


# States to which a symmetry is sought, and maps that join nothing before the search for others ends.
_CANDIDATES, _IN_VAIN = 200, 3


def orbits(
    next_states: Indices, ends: np.ndarray, start: int, pivot: int, is_over: Callable[[], bool]
) -> np.ndarray | None:
    """Return (S,) integers: for each state the smallest one of its orbit. None if no symmetry was found.

    A symmetry maps the states onto each other so that every action does the same. It keeps all distances. There are
    many if states can be renamed, as the tiles of a tray, or the positions of a cube without an end. The image of
    one state decides it, so that it takes one pass over the table at most, and mostly a few steps, to find the symmetry
    that takes `pivot` to a state drawn at random, or that there is none.

    Args:
        next_states: (S, A), -1 leads to the end. ends: (S,) the states that end the episode. All must be within reach
            of `pivot`.
        start: the state to which states lead that end the episode. -1: nowhere.
        is_over: whether to stop looking for more.
    Cost: at most four passes over the table for maps that fail, one for each that is found. Without symmetries mostly
        some thousand entries are read, and no more memory is touched: the scratch arrays are zero pages until then.
    Source: ours.
    """
    size, rng = len(next_states), np.random.Generator(np.random.PCG64(0))
    dtype = np.int32 if size < 2**31 else np.int64
    image, preimage, queue = np.zeros(size, dtype), np.zeros(size, dtype), np.empty(size, dtype)
    orbit = None
    count, in_vain, steps_left = size, 0, 4 * size
    others = rng.integers(0, size, _CANDIDATES)
    for t in others[others != pivot]:
        if count == 1 or in_vain == _IN_VAIN or steps_left < 0 or is_over():
            break
        is_symmetry, steps = kernels.symmetry(next_states, ends, start, pivot, t, image, preimage, queue)
        if is_symmetry:
            orbit = np.arange(size, dtype=dtype) if orbit is None else orbit
            before, count = count, int(kernels.join(orbit, image))
            in_vain = in_vain + 1 if count == before else 0
        else:
            steps_left -= steps
        kernels.forget(image, preimage, queue, steps)
    while orbit is not None and (orbit != orbit[orbit]).any():
        orbit = orbit[orbit]
    return orbit
