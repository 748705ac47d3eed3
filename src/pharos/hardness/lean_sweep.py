"""The diameter of a graph whose searches do not fit in memory: two bytes a node and bound, and the table read in order.

The algorithm is that of sum_sweep.py, without what needs room for more. Distances come from sweeps over the table
(kernels/distance_sweeps.py) in place of searches with a queue and a reversed graph, which takes 8 bytes an edge. Arrays
that memory has no room for are mapped files.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from pharos.hardness.interval import Interval, Spending
from pharos.hardness.sum_sweep import SumSweep
from pharos.hardness.transition_graph import Graph
from pharos.kernels import distance_sweeps
from pharos.large_arrays import large_zeros, read_ahead
from pharos.memory import available_memory

# Untyped, as starred arguments of compiled functions are not checked.
kernels: Any = distance_sweeps
# Rows that are swept while the next ones are read.
_RANGE = 1 << 22


def needs_more_than_memory(graph: Graph) -> bool:
    """Whether memory has no room for the arrays of `SumSweep` and the reversed graph."""
    entry = np.dtype(graph.dtype).itemsize
    edges = graph.next_states.size
    first = 2 * (graph.num_nodes + 2) * (4 if edges < 2**31 else 8)
    return 7 * entry * graph.num_nodes + first + graph.next_states.dtype.itemsize * edges > available_memory()


def lean_diameter(graph: Graph, spending: Spending, conventions: dict[str, Any]) -> Interval:
    """The diameter, or the interval proven within the budget."""
    try:
        return LeanSweep(LeanGraph(graph, np.int16), spending, conventions).interval()
    except OverflowError:
        return LeanSweep(LeanGraph(graph, np.int32), spending, conventions).interval()


def lean_eccentricity(graph: Graph, source: int, spending: Spending, conventions: dict[str, Any]) -> Interval:
    """The largest number of steps from a state to another one."""
    try:
        reach, largest, _ = LeanGraph(graph, np.int16).search_forward(source, large_zeros((graph.num_nodes,), np.int16))
    except OverflowError:
        reach, largest, _ = LeanGraph(graph, np.int32).search_forward(source, large_zeros((graph.num_nodes,), np.int32))
    spending.searches += 1
    value = float(largest) if reach == graph.num_nodes else np.inf
    return Interval(
        value,
        value,
        True,
        finite_part=value if reach == graph.num_nodes else 0.0,
        searches=1,
        method="a breadth-first search, by sweeps over the table",
        conventions=conventions,
        seconds=spending.seconds,
    )


class LeanGraph:
    """A graph that is searched by sweeps.

    Attributes:
        dtype: of distances.
        far: the largest number of that type, for nodes that were not found.
    """

    def __init__(self, graph: Graph, dtype: Any):
        self.next_states, self.ends, self.start, self.pivot = graph.next_states, graph.ends, graph.start, graph.pivot
        self.num_nodes, self.has_end = graph.num_nodes, graph.has_end
        self.dtype, self.far = dtype, int(np.iinfo(dtype).max)

    def search_forward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """distance[v] = d(source, v), `far` where there is no way; (nodes reach, largest distance, sum of distances).

        OverflowError where a distance does not fit.
        """
        return self._swept(kernels.lower_forward, source, distance, False)

    def search_backward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """distance[v] = d(v, source); as above."""
        return self._swept(kernels.lower_backward, source, distance, True)

    def _swept(self, kernel: Any, source: int, distance: np.ndarray, backward: bool) -> tuple[int, int, int]:
        distance[:] = self.far
        distance[source] = 0
        lowered = 1
        while lowered:
            lowered = self._through_end(distance, backward)
            for first, stop in self._ranges(backward):
                count = int(kernel(self.next_states, self.ends, self.start, distance, self.far, first, stop))
                if count < 0:
                    raise OverflowError
                lowered += count
        reach, largest, total = kernels.summary(distance, self.far)
        return int(reach), int(largest), int(total)

    def _through_end(self, distance: np.ndarray, backward: bool) -> int:
        """The one edge that is in no row: from the end to the start; whether it lowers a distance."""
        if not self.has_end or self.start < 0:
            return 0
        here, there = (self.start, self.num_nodes - 1) if backward else (self.num_nodes - 1, self.start)
        if int(distance[here]) + 1 < int(distance[there]):
            distance[there] = distance[here] + 1
            return 1
        return 0

    def _ranges(self, backward: bool) -> Iterator[tuple[int, int]]:
        size = len(self.next_states)
        starts = range(0, size, _RANGE)
        for first in reversed(starts) if backward else starts:
            if backward and isinstance(self.next_states, np.memmap):
                read_ahead(self.next_states, max(first - _RANGE, 0), first)
            yield first, min(first + _RANGE, size)


class LeanSweep(SumSweep):
    """`SumSweep` on a graph that is searched by sweeps, in little memory."""

    def __init__(self, graph: LeanGraph, spending: Spending, conventions: dict[str, Any]):
        self.graph: Any = graph
        self.spending, self.conventions = spending, conventions
        size, dtype = graph.num_nodes, graph.dtype
        self.away = large_zeros((size,), dtype)
        self.to = large_zeros((size,), dtype)
        self.out_lower, self.in_lower, self.out_upper, self.in_upper = (large_zeros((size,), dtype) for _ in range(4))
        self.out_upper[:] = self.in_upper[:] = graph.far
        self.best = 0
        self.method = "directed ExactSumSweep, by sweeps over the table"

    def interval(self) -> Interval:
        """The diameter, or what is proven of it. OverflowError where bounds do not fit."""
        graph = self.graph
        if not self._pivot(graph.pivot):
            return Interval(
                np.inf,
                np.inf,
                True,
                unreachable_pairs=1,
                finite_part=float(self.best),
                counted=False,
                searches=self.spending.searches,
                method=self.method,
                conventions=self.conventions,
                note="some states cannot be reached from others; how many pairs was not counted, for want of memory",
                seconds=self.spending.seconds,
            )
        if int(self.out_upper.max()) >= graph.far or int(self.in_upper.max()) >= graph.far:
            raise OverflowError  # a bound was cut
        self._sweep()
        upper = self._upper()
        note = f"budget spent: {self._open()[0]} states may have a larger eccentricity than {self.best}"
        return self._result(self.best, upper, note if upper > self.best else "")

    def _fits(self, words: int) -> bool:
        return False  # for searches from many nodes at once
