"""Symmetries that the end of an episode hides: the diameter where all states but one look alike from some few.

A puzzle looks the same from many states, but for the solved one: there the episode ends, and the next one begins at the
start. Let H be the graph in which that state t goes on like the others; G is H with the one edge from t to the start in
place of the edges of t. Then for u other than t

    d_G(u, v) <= d of ways in H from u to v that do not pass t (v = t is no passing),

and where a symmetry of H takes u to r, this is the distance from r to some node with some node x left out. So the
largest distance from r with any one node left out (kernels/replacement.py) is an upper bound on out(u) for all u that
look like r; out(t) is searched for.
Source: ours; vertex replacement paths.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pharos.hardness.distances.orbits import orbits
from pharos.kernels import graph, replacement, symmetry
from pharos.system.packed_indices import Indices, copy_of

# Untyped, as starred arguments of compiled functions are not checked.
searches: Any = graph
paths: Any = replacement
maps: Any = symmetry
# States to which a symmetry is sought that tells the edges of the end; edges read for detours, for each of the graph.
_CANDIDATES, _READS = 100, 50


class Restored(NamedTuple):
    """A graph without an end, and its symmetries.

    Attributes:
        table: (S, A) next states; the row of the end is what symmetries say.
        end: the state whose row that is.
        orbit: (S,) for each state the smallest one that looks the same.
    """

    table: Indices
    end: int
    orbit: np.ndarray


def restored(next_states: Indices, ends: np.ndarray, pivot: int, is_over: Callable[[], bool]) -> Restored | None:
    """Return the graph without its only end; None where that has no symmetries, or there are other ends.

    Args:
        next_states, ends: (S, A) without -1 but for the end; (S,) the states that end the episode.
        pivot: a state from which all can be reached.
    Cost: a copy of the table, and some passes over it.
    """
    where = np.flatnonzero(ends)
    if len(where) != 1 or len(next_states) < 3:
        return None
    end, size = int(where[0]), len(next_states)
    table = copy_of(next_states)
    table[end] = symmetry.UNKNOWN
    going_on = np.zeros(size, np.bool_)
    dtype = np.int32 if size < 2**31 else np.int64
    image, preimage, queue = np.zeros(size, dtype), np.zeros(size, dtype), np.empty(size, dtype)
    rng, steps_left = np.random.Generator(np.random.PCG64(0)), 4 * size
    for t in rng.integers(0, size, _CANDIDATES):
        if steps_left < 0 or is_over():
            return None
        is_symmetry, steps = maps.symmetry(table, going_on, -1, pivot, t, image, preimage, queue)
        alike = image[end] - 1
        if is_symmetry and alike != end:
            table[end] = preimage[table[alike]] - 1
            orbit = orbits(table, going_on, -1, pivot, is_over)
            return None if orbit is None else Restored(table, end, orbit)
        steps_left -= 0 if is_symmetry else steps
        maps.forget(image, preimage, queue, steps)
    return None


def largest_distances(space: Restored, representatives: np.ndarray) -> list[int] | None:
    """For each of some states r, the largest distance from r in the graph without its end, any one state that looks
    like the end left out; None where that is out of reach, or some state cannot be reached."""
    table, size = space.table, len(space.table)
    nothing, small = np.zeros(size, np.bool_), space.orbit.dtype
    first, previous = graph.reversed_graph(table, nothing, size)
    may_fall = space.orbit == space.orbit[space.end]
    distance, queue = np.empty(size, small), np.empty(size, small)
    nodes, detour = np.empty(size, small), np.empty(size, np.int32)
    result = []
    for r in representatives:
        reached, largest, _ = searches.search_forward(table, nothing, -1, int(r), distance, queue)
        if reached < size:
            return None
        dominator, child, sibling, mark = (np.full(size, -1, small) for _ in range(4))
        paths.dominators(table, int(r), distance, queue, dominator)
        scratch = (child, sibling, mark, nodes, detour)
        limit = _READS * len(previous)
        detoured, _ = paths.longest_detour(first, previous, int(r), distance, dominator, may_fall, *scratch, limit)
        if detoured == replacement.FAR:
            return None
        result.append(max(int(largest), int(detoured)))
    return result
