"""The diameter of a graph whose searches do not fit in memory: two bytes a node and bound, and the table read in order.

The algorithm is that of sum_sweep.py, without what needs room for more. Distances come from sweeps over the table
(kernels/graph.py) in place of searches with a queue and a reversed graph, which takes 8 bytes an edge. Arrays
that memory has no room for are mapped files; bounds may be in files that outlive the process, of which
the search in progress is all that is lost.

Bounds on all eccentricities in a folder, so that a diameter whose searches take minutes goes on where it was killed.

Searches only ever raise lower bounds and lower upper ones, so that a file that was left in the middle of an update
holds bounds all the same. What counts is that they are of the same graph, of which a digest is kept beside them.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import xxhash

from pharos.errors import FileFormatError, ParameterError
from pharos.hardness.distances.sum_sweep import SumSweep
from pharos.hardness.distances.transition_graph import Graph
from pharos.hardness.interval import BudgetClock, Interval
from pharos.kernels import graph as kernels
from pharos.system import storage
from pharos.system.memory import available_memory, kept_array, large_zeros, ranges_from_the_end

_FILE, _RECORD = "bounds.npy", "bounds.json"
_FORMAT = 1
# Rows of a table that a digest reads in one go.
_BLOCK = 1 << 20


class KeptBounds:
    """The bounds of one graph in a folder: `bounds.npy` (4, N), and `bounds.json`, which says of which graph.

    Attributes:
        dtype: of the bounds that are there, or None: there are none yet.
    """

    def __init__(self, folder: Path, graph: Graph):
        """
        Raises:
            FileFormatError: the folder holds the bounds of another graph.
        """
        self._folder, self._graph = folder, digest_of(graph)
        self._size = graph.num_nodes
        self.dtype: np.dtype | None = None
        path = folder / _RECORD
        if not path.exists():
            return
        record = storage.read_json(path)
        if not isinstance(record, dict) or record.get("format") != _FORMAT or record.get("graph") != self._graph:
            raise FileFormatError(
                f"{path}: is of another graph, or of another pharos; choose another folder, or delete {_FILE} and "
                f"{_RECORD} there"
            )
        self.dtype = np.dtype(np.int16 if record.get("bytes") == 2 else np.int32)

    def arrays(self, dtype: np.dtype) -> np.ndarray:
        """(4, N): lower bounds on out(v) and in(v), then upper ones; what is there, or 0 and the largest number.

        The record is written once these are on the disk: after a power failure a file may hold what it held before.
        """
        path, record = self._folder / _FILE, self._folder / _RECORD
        try:
            if self.dtype != dtype:
                record.unlink(missing_ok=True)
                path.unlink(missing_ok=True)
            bounds = kept_array(path, (4, self._size), dtype, "bounds")
            if self.dtype != dtype or not record.exists():
                bounds[:2] = 0
                bounds[2:] = np.iinfo(dtype).max
                storage.sync(path)
                storage.replace_json(record, {"format": _FORMAT, "graph": self._graph, "bytes": dtype.itemsize})
                self.dtype = dtype
        except OSError as error:
            raise ParameterError(f"{path}: cannot be used for bounds: {error.strerror}; choose another one") from error
        return bounds

    def remove(self) -> None:
        """The diameter is known: the files are not needed any more."""
        for name in (_RECORD, _FILE):
            (self._folder / name).unlink(missing_ok=True)


def digest_of(graph: Graph) -> str:
    """What distances depend on: the table, which states end, and where these lead."""
    digest = xxhash.xxh3_128(f"{graph.next_states.shape} {graph.start} {graph.has_end}".encode())
    for rows in (graph.next_states, graph.ends):
        for start in range(0, len(rows), _BLOCK):
            digest.update(np.ascontiguousarray(rows[start : start + _BLOCK]).data)
    return digest.hexdigest()


Result = TypeVar("Result")


def needs_more_than_memory(graph: Graph) -> bool:
    """Whether memory has no room for the arrays of `SumSweep` and the reversed graph."""
    entry = np.dtype(graph.dtype).itemsize
    edges = graph.next_states.size
    first = 2 * (graph.num_nodes + 2) * (4 if edges < 2**31 else 8)
    return 7 * entry * graph.num_nodes + first + graph.next_states.dtype.itemsize * edges > available_memory()


def lean_diameter(
    graph: Graph, spending: BudgetClock, conventions: dict[str, Any], folder: str | os.PathLike | None = None
) -> Interval:
    """The diameter, or the interval proven within the budget.

    folder: where bounds are kept while they are tightened, and gone on from; None: in memory.
    """
    store = None if folder is None else KeptBounds(Path(folder), graph)

    def interval(dtype: Any) -> Interval:
        return LeanSweep(LeanGraph(graph, dtype), spending, conventions, store).interval()

    result = interval(np.int32) if store and store.dtype == np.int32 else _in_two_bytes_or_four(interval)
    if store and result.exact:
        store.remove()
    return result


def lean_eccentricity(graph: Graph, source: int, spending: BudgetClock, conventions: dict[str, Any]) -> Interval:
    """The largest number of steps from a state to another one."""
    reach, largest, _ = _in_two_bytes_or_four(
        lambda dtype: LeanGraph(graph, dtype).search_forward(source, large_zeros((graph.num_nodes,), dtype))
    )
    spending.searches += 1
    is_whole = reach == graph.num_nodes
    value = float(largest) if is_whole else math.inf
    return Interval(
        value,
        value,
        True,
        finite_part=value if is_whole else 0.0,
        searches=1,
        method="a breadth-first search, by sweeps over the table",
        conventions=conventions,
        seconds=spending.seconds,
    )


def _in_two_bytes_or_four(result: Callable[[Any], Result]) -> Result:
    """result(dtype) with distances of two bytes; of four where one does not fit into two."""
    try:
        return result(np.int16)
    except OverflowError:
        return result(np.int32)


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
        """distance[v] = d(source, v), `far` where there is no way; (nodes found, largest distance, sum of distances).

        OverflowError where a distance does not fit.
        """
        return self._swept(kernels.lower_forward, source, distance, False)

    def search_backward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """distance[v] = d(v, source); returns and raises as `search_forward`."""
        return self._swept(kernels.lower_backward, source, distance, True)

    def _swept(self, kernel: Any, source: int, distance: np.ndarray, backward: bool) -> tuple[int, int, int]:
        distance[:] = self.far
        distance[source] = 0
        size, lowered = len(self.next_states), 1
        while lowered:
            lowered = self._through_end(distance, backward)
            for first, stop in ranges_from_the_end(self.next_states, 0, size) if backward else [(0, size)]:
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


class LeanSweep(SumSweep):
    """`SumSweep` on a graph that is searched by sweeps, in little memory."""

    def __init__(
        self, graph: LeanGraph, spending: BudgetClock, conventions: dict[str, Any], store: KeptBounds | None = None
    ):
        """store: where the bounds are; None: in memory."""
        self.graph: Any = graph
        self.spending, self.conventions = spending, conventions
        size, dtype = graph.num_nodes, graph.dtype
        if store is None:
            bounds = [large_zeros((size,), dtype) for _ in range(4)]
            for upper in bounds[2:]:
                upper[:] = graph.far
        else:
            bounds = [*store.arrays(np.dtype(dtype))]
        self.out_lower, self.in_lower, self.out_upper, self.in_upper = bounds
        self.away = large_zeros((size,), dtype)
        self.to = large_zeros((size,), dtype)
        self.best = max(int(self.out_lower.max()), int(self.in_lower.max()))  # what is at most an out(v) is at most D
        self.method = "directed ExactSumSweep, by sweeps over the table"

    def interval(self) -> Interval:
        """The diameter, or what is proven of it. OverflowError where bounds do not fit."""
        graph = self.graph
        if not self._is_bounded() and not self._pivot(graph.pivot):
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
        if not self._is_bounded():
            raise OverflowError  # a bound was cut
        self._sweep()
        upper = self._upper()
        note = f"budget spent: {self._open()[0]} states may have a larger eccentricity than {self.best}"
        return self._result(self.best, upper, note if upper > self.best else "")

    def _is_bounded(self) -> bool:
        """Whether every node has upper bounds, as after a search from one in both directions that found all."""
        return int(self.out_upper.max()) < self.graph.far and int(self.in_upper.max()) < self.graph.far

    def _fits(self, words: int) -> bool:
        return False  # for searches from many nodes at once
