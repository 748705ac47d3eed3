"""Clocks that the restart hides: the largest distances to many states, by searches that stand in the same layer.

Let H be the graph without the edges of states that end, and e(u) the least number of steps from u to a state that ends,
and one more. A shortest path from the start s does not pass it again, so d(s, v) is that of H, and

    d(u, v) = min(d_H(u, v), e(u) + d(s, v)).

e and d(s, .) are what the searches from the start say. Where all cycles of H are multiples of P steps long, as where
traffic goes by, all edges of H lead from one layer {v: d(s, v) = j modulo P} to the next. Searches in H backward from
many targets then stand in one layer if each begins when that of its target has its turn (`clocks.search_in_step`): that
one layer is read for all targets, while levels, counted from each target, are as many layers as targets have. They end
after as many steps as the other way has. Restarts, which lead from all layers to the first, make the common length of
cycles 1 and would spread every search over all layers; in H they do not exist.
Source: ours.
"""

from typing import NamedTuple

import numpy as np

from pharos.hardness.distances.transition_graph import WIDE, Graph, Layers
from pharos.kernels import graph as kernels

# Cycles shorter than this leave layers so wide that searches by levels read as little.
_SHORTEST = 64
# Times that searches may go round.
_ROUNDS = 4


class HiddenClock(NamedTuple):
    """The layers of a graph without its restarts.

    Attributes:
        home: (N,) steps to the start; away: (N,) steps from it.
        layers: of the nodes, by `away` modulo P.
    """

    home: np.ndarray
    away: np.ndarray
    layers: Layers

    @staticmethod
    def of(graph: Graph, home: np.ndarray, away: np.ndarray) -> "HiddenClock | None":
        """The clock of a graph with restarts; None where there is none, or its layers do not pay.

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
        if int(widths.max()) > WIDE:
            return None
        return HiddenClock(home.copy(), away.copy(), Layers.of(layer, widths, graph.dtype))

    def largest_to(self, graph: Graph, targets: np.ndarray, best: int) -> tuple[np.ndarray, int]:
        """((targets,) max over u of d(u, target), or `best` where that is larger; table entries read)."""
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
