"""Distances by several processes: each has a range of the nodes of a graph, and exchanges its borders with the others.

Distances come from sweeps over the table in order, as in lean_sweep.py: an upper bound is lowered along every edge
until nothing is. Forward, a rank lowers the bounds of its halo, nodes of other ranks, too, and tells their owners;
backward, it gets them from the owners, those of high nodes while the low ones are swept. Sweeps follow ways in the
order of the nodes, and would be more in another one, so no more travels meanwhile; and forward a bound in a halo may be
lowered until the last node, so all messages wait for the end. Distances are whole numbers, so they are the same
whatever the number of ranks.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from pharos.hardness.distances.transition_graph import Graph
from pharos.hardness.interval import BudgetClock, Interval, interval_of_search
from pharos.kernels import distance_sweeps
from pharos.mdp import split
from pharos.ranks import Halo, Rank, check_number, cuts_of, together

# Untyped, as starred arguments of compiled functions are not checked.
kernels: Any = distance_sweeps
# Nodes whose edges are looked at in one go.
_BLOCK = 1 << 18
FAR = int(np.iinfo(np.int32).max)


class Found(NamedTuple):
    """What a search has found.

    Attributes:
        distances: (N,) int32 at the first rank, `FAR` where there is no way; None at the others.
        reached: how many nodes were. largest: distance of these.
    """

    distances: np.ndarray | None
    reached: int
    largest: int


class RankedGraph:
    """One rank's range of the nodes of a graph: states, and the end where there is one."""

    def __init__(self, graph: Graph, rank: Rank):
        self.rank, self.num_nodes = rank, graph.num_nodes
        cuts = cuts_of(graph.num_nodes, rank.size)
        self.start, self.stop = map(int, cuts[rank.rank : rank.rank + 2])
        self._local, halo = split(
            partial(_edges, graph, self.start, self.stop),
            (len(self), graph.next_states.shape[1]),
            self.start,
            self.stop,
        )
        self._halo = Halo(rank, halo, cuts)
        self._never = np.zeros(len(self), np.bool_)
        self.distance = np.empty(len(self) + len(self._halo), np.int32)

    def __len__(self) -> int:
        return self.stop - self.start

    def search(self, source: int, backward: bool) -> tuple[int, int]:
        """Distances from a node, or, backward, to it. Returns (nodes found, largest distance)."""
        self.distance[:] = FAR
        numbers = np.concatenate([np.arange(self.start, self.stop), self._halo.rows])
        self.distance[numbers == source] = 0
        lowered = 1
        while lowered:
            own = self._lowered_backward() if backward else self._lowered_forward()
            lowered = int(self.rank.numbers_of_all(own).sum())
            if backward:
                self._halo.finish(self.distance[len(self) :])
        reach, largest, _ = kernels.summary(self.distance[: len(self)], FAR)
        every = self.rank.numbers_of_all(reach, largest)
        return int(every[:, 0].sum()), int(every[:, 1].max())

    def _lowered_backward(self) -> int:
        """Sweep, and begin to get the distances of the halo; how many nodes have a smaller one."""
        halo, distance = self._halo, self.distance
        edges = (self._local, self._never, -1, distance, FAR)
        halo.receive(distance, in_two=True)
        lowered = kernels.lower_backward(*edges, halo.low, len(self))
        halo.send_high(distance)
        lowered += kernels.lower_backward(*edges, 0, halo.low)
        halo.send_low(distance)
        return int(lowered)

    def _lowered_forward(self) -> int:
        """Sweep, and lower distances to what others have found; how many."""
        distance = self.distance
        lowered = int(kernels.lower_forward(self._local, self._never, -1, distance, FAR, 0, len(self)))
        for rows, distances in self._halo.give_back(distance[len(self) :]):
            lower = distances < distance[rows]
            distance[rows[lower]] = distances[lower]
            lowered += int(np.count_nonzero(lower))
        return lowered

    def gathered(self) -> np.ndarray | None:
        """(N,) the distances of all nodes at the first rank; None at the others."""
        parts = self.rank.gather(self.distance[: len(self)])
        return np.concatenate(parts) if self.rank.rank == 0 else None


def ranked_distances(graph: Graph, source: int, processes: int | str, *, backward: bool = False) -> Found:
    """The distances from a node to all others, or, backward, from all others to it, by several processes."""
    check_number(processes)
    size = processes if isinstance(processes, int) else 1
    _warm(backward)

    def program(rank: Rank) -> Found:
        part = RankedGraph(graph, rank)
        count, largest = part.search(source, backward)
        return Found(part.gathered(), count, largest)

    return together(processes, program, ((graph.num_nodes // size + 1) * 8 + 256) * size)


def ranked_eccentricity(
    graph: Graph, source: int, processes: int | str, spending: BudgetClock, conventions: dict[str, Any]
) -> Interval:
    """The largest number of steps from a state to another one."""
    search = ranked_distances(graph, source, processes)
    spending.searches += 1
    is_whole, method = search.reached == graph.num_nodes, "a breadth-first search by several processes"
    return interval_of_search(search.largest, is_whole, method, spending, conventions)


def _edges(graph: Graph, start: int, stop: int) -> Iterator[tuple[int, np.ndarray]]:
    """The nodes that each of a range leads to, A each; to itself where that is nowhere. In blocks (first, rows)."""
    for first in range(start, stop, _BLOCK):
        yield first - start, _edges_of(graph, first, min(first + _BLOCK, stop))


def _edges_of(graph: Graph, start: int, stop: int) -> np.ndarray:
    """(n, A) of nodes [start, stop)."""
    states = np.asarray(graph.next_states[start:stop]).astype(np.int64)
    end = len(graph.next_states)
    if stop > end:
        states = np.concatenate([states, np.full((1, states.shape[1]), -1)])
    own = np.arange(start, stop)[:, None]
    states[states < 0] = end
    stops = np.append(graph.ends[start:stop], [True] * (stop > end))[:, None]
    return np.where(stops, own if graph.start < 0 else graph.start, states)


def _warm(backward: bool) -> None:
    """Compile what ranks run, once, before they are forked."""
    kernel = kernels.lower_backward if backward else kernels.lower_forward
    local, never, distance = np.zeros((1, 1), np.int32), np.zeros(1, np.bool_), np.zeros(1, np.int32)
    kernel(local, never, -1, distance, FAR, 0, 1)
    kernels.summary(distance, FAR)
