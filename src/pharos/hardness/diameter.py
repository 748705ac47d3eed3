"""Diameter: the largest number of steps of the best way between two states. Source: Jaksch, Ortner and Auer (2010).

Deterministic MDPs: directed ExactSumSweep (Borassi et al. 2015) from the start state, searches from many nodes at once
if it does not close (Then et al. 2014), and an argument of ours for spaces that contain a clock. Chance:
`stochastic_diameter`.

The diameter as Colosseum defines it for episodes of a fixed length. Source: Conserva and Rauber (2022).

If searches do not fit in memory (`LeanSweep`): two bytes a node and bound, and the table read in order. The
algorithm is the one of sum_sweep.py, without the parts that need more memory. Distances come from sweeps over the table
(kernels/graph.py) in place of searches with a queue and a reversed graph, which takes 8 bytes an edge. Arrays that
memory has no room for are mapped files. Bounds may be in files that outlive the process, of which the search in
progress is all that is lost.

`KeptBounds`: bounds on all eccentricities in a folder, so that a diameter whose searches take minutes goes on after it
was killed. Searches only ever raise lower bounds and lower upper ones, so that a file that was left in the middle of an
update holds bounds all the same. What counts is that they are of the same graph, of which a digest is kept beside them.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
import xxhash

from pharos.errors import FileFormatError, ParameterError, UndefinedMeasure
from pharos.hardness.interval import MORE, Budget, BudgetClock, Interval, MeasureProgress, conventions_of
from pharos.hardness.stochastic_diameter import stochastic_diameter, stochastic_start_eccentricity
from pharos.hardness.sum_sweep import Graph, SumSweep
from pharos.kernels import graph as kernels
from pharos.mdp import ExpandedMDP, TabularMDP, require_mdp, whole_number
from pharos.system import storage
from pharos.system.memory import available_memory, kept_array, large_zeros, ranges_from_the_end
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


@require_mdp
def diameter(
    mdp: TabularMDP,
    *,
    restart: bool = True,
    tolerance: float = 1e-6,
    budget: Budget | float | None = None,
    progress: Callable[[MeasureProgress], None] | None = None,
    bounds: str | os.PathLike | None = None,
) -> Interval:
    """Return D, the maximum over ordered pairs of states s != s' of the least expected number of steps from s to s'.

        D = max over s != s' of min over policies of E[steps from s to s']

    Deterministic MDPs: the largest distance in the graph, exact. With chance: the largest optimal expected hitting
    time, up to `tolerance`. Rewards, gamma and the horizon do not matter.

    Args:
        restart: in a terminal state every action leads to a start state, drawn from the start distribution, in one
            step.
            False: terminal states are absorbing, so that D is infinite wherever a state cannot be reached from one.
        tolerance: relative width of the interval from which on it counts as exact. Counted steps are exact anyway.
        budget: seconds (300 by default), or a `Budget`. A value out of reach comes as the interval proven by then.
        progress: called with a `MeasureProgress` now and then.
        bounds: a folder for the bounds on all states, 8 bytes each, if memory has no room for searches of a
            deterministic MDP: the same call goes on from them after one was killed, or its budget spent. They are
            removed once the diameter is known.
    Returns:
        An `Interval`, in steps. The implicit end of an episode (-1 in a row of `next_states`) counts as one more state,
        the only one beside the S states. Under sticky actions s' is a state reached with any previous action, and s
        stands for every reachable (state, previously executed action) and the start states without a previous action.
    Raises:
        ParameterError: an option is out of range. FileFormatError: `bounds` are of another MDP. FolderLocked: in use.
    Cost:
        deterministic: usually 3 to 100 breadth-first searches, each one pass over the table in the order of discovery;
        memory 8 bytes an edge and 32 a state. If there is less, some ten sweeps over the table in place of each
        search, and 12 bytes a state, which may be mapped files. Chance: see `stochastic_diameter`.
    Source: Jaksch, Ortner and Auer (2010), definition 1; Borassi et al. (2015), "Fast diameter and radius BFS-based
        computation in (weakly connected) real-world graphs", section 4.
    """
    _check_tolerance(tolerance)
    spending = BudgetClock(Budget.of(budget), progress, conventions_of(mdp, restart))
    graph = Graph.of(mdp, restart)
    if graph is None:
        return stochastic_diameter(mdp, restart, tolerance, spending)
    if needs_more_than_memory(graph):
        return lean_diameter(graph, spending, bounds)
    return SumSweep(graph, spending).interval()


@require_mdp
def start_eccentricity(
    mdp: TabularMDP,
    *,
    restart: bool = True,
    tolerance: float = 1e-6,
    budget: Budget | float | None = None,
) -> float:
    """Return the largest least expected number of steps from the start to a state: the paper's (1), read literally.

        max over s' of min over policies of E[steps from a start state to s'], the start being drawn

    Args:
        restart: as in `diameter`. Without chance and with one start state it makes no difference.
        tolerance: relative accuracy under chance, and with several start states. Without, it is counted.
        budget: seconds (300 by default), or a `Budget`, under chance and with several start states.
    Returns:
        Steps, infinite if some state cannot be reached from some start state. An expectation comes as its upper
        bound, proven to lie within `tolerance`.
    Raises:
        UndefinedMeasure: out of reach of the budget or of 64-bit floats. It names the interval that is proven.
        `start_eccentricity_interval` returns it.
    Cost: one search for each start state. Under chance, and if terminal states lead back to several start states,
        one stochastic shortest path problem for each target that bounds do not rule out.
    Source: the pharos paper, equation 1.
    """
    interval = start_eccentricity_interval(mdp, restart=restart, tolerance=tolerance, budget=budget)
    if not interval.exact:
        raise UndefinedMeasure(
            f"start_eccentricity: between {interval.lower:.6g} and {interval.upper:.6g}; {interval.note}"
        )
    return interval.upper


@require_mdp
def start_eccentricity_interval(
    mdp: TabularMDP,
    *,
    restart: bool = True,
    tolerance: float = 1e-6,
    budget: Budget | float | None = None,
    progress: Callable[[MeasureProgress], None] | None = None,
) -> Interval:
    """Return `start_eccentricity` as an `Interval`: exact, or what is proven within the budget.

    Arguments: the same, and `progress`, as of `diameter`.
    """
    _check_tolerance(tolerance)
    spending = BudgetClock(Budget.of(budget), progress, conventions_of(mdp, restart))
    graph = Graph.of(mdp, restart)
    if graph is None:
        return stochastic_start_eccentricity(mdp, restart, tolerance, spending)
    starts = mdp.start_states[mdp.start_probabilities > 0]
    if len(starts) == 1 and needs_more_than_memory(graph):
        return lean_eccentricity(graph, int(starts[0]), spending)
    weights = mdp.start_probabilities[mdp.start_probabilities > 0]
    mean, distance = np.zeros(graph.num_nodes), np.empty(graph.num_nodes, np.int32)
    note, unreachable, largest = "", 0, 0
    for start, weight in zip(starts, weights, strict=True):
        if spending.is_over and spending.searches:
            num_starts = pluralize(len(starts), "start state")
            note = f"budget spent after the searches from {spending.searches} of {num_starts}; {MORE}"
            break
        num_reached, largest, _ = graph.search_forward(int(start), distance)
        spending.searches += 1
        if num_reached < graph.num_nodes:
            unreachable = graph.num_nodes - int(num_reached)
            break
        mean += weight * distance
    if unreachable:
        lower = upper = math.inf
    elif len(starts) == 1:
        lower = upper = float(largest)
    else:  # a rounding of each product and each sum; a distance is at most the number of nodes less one
        rounding = 1 + (len(starts) + 2) * 2.0**-53
        lower, upper = float(mean.max()) / rounding, float(mean.max()) * rounding
    if note:
        upper = math.inf
    interval = Interval(
        lower,
        upper,
        exact=not note,
        unreachable_pairs=unreachable,
        finite_part=float(largest) if unreachable else lower,
        counted=not unreachable or len(starts) == 1,
        tolerance=0.0 if len(starts) == 1 else tolerance,
        method="a breadth-first search from each start state",
        note=note,
    )
    return spending.signed(interval)


def _check_tolerance(tolerance: float) -> None:
    if not (isinstance(tolerance, int | float) and 0 < tolerance < 1):
        raise ParameterError(f"tolerance is {tolerance!r}; expected a number between 0 and 1")


# Colosseum ------------------------------------------------------------------------------------------------------------


_TARGETS = 256  # targets at a time


@require_mdp
def colosseum_diameter(mdp: TabularMDP, *, horizon: int | None = None) -> float:
    """Return Colosseum's episodic diameter: 1 + the largest, over states e, of the least expected time to e.

        ET_e(h, e) = 0;  ET_e(h, s) = 1 + min_a E[ET_e(h + 1, s')] for h < H - 1;  ET_e(H - 1, s) = 1 + E[ET_e(0, s0)]

    That time is E[ET_e(0, s0)], from the start. After H steps an episode starts again, in a state s0 of the start
    distribution. Colosseum says it differently: the largest over e and s of the least positive ET_e(h, s), over
    h = H - 1 and all h at which s can be reached. At h = H - 1 it makes no exception of s = e, so e itself has
    1 + E[ET_e(0, s0)], and no state has more. Terminal states last until the episode starts again.

    Args:
        horizon: H, in steps. Default: the MDP's.
    Returns:
        Steps, infinite if some state cannot be reached within an episode with positive probability.
    Raises:
        ParameterError: there is no horizon, or it is below 1.
    Cost: a few backward passes of H steps for each state, each in O(H S^2 A) time with sparse rows.
    Source: Conserva and Rauber (2022), "Hardness in Markov decision processes: theory and practice", and its code.
    """
    expected = "an integer of at least 1, here or in the MDP"
    steps = whole_number(mdp.horizon if horizon is None else horizon, "horizon", expected)
    choices = ExpandedMDP.of(mdp, False)
    size, num_actions = len(choices.underlying), choices.num_actions
    rho = np.zeros(size)
    for node, probability in choices.starts:
        rho[node] += probability
    largest = 0.0
    for low in range(0, choices.num_targets, _TARGETS):
        targets = np.arange(low, min(low + _TARGETS, choices.num_targets))
        goal = choices.underlying[:, None] == targets
        around = _Episodes(choices.matrix, num_actions, goal, rho, steps)
        largest = max(largest, 1 + float(around.times_from_start().max()))
    return largest


class _Episodes:
    """Least expected times to each of several targets, through episodes of H steps.

    With x = E[ET(0, s0)], every policy of an episode gives x -> c + q x: c its expected steps, q the probability that
    it misses the target. The least of these lines crosses the diagonal at x. It is found from above by Newton's method,
    each step of which takes the best policy for the last x. It starts with the policy that is least likely to miss.
    """

    def __init__(self, matrix: "csr_matrix", num_actions: int, goal: np.ndarray, rho: np.ndarray, horizon: int):
        self.matrix, self.num_actions, self.goal, self.rho, self.horizon = matrix, num_actions, goal, rho, horizon

    def _pass(self, x: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """c and q of the episode that is best for x at `step` a step."""
        steps, misses = np.where(self.goal, 0.0, 1.0), np.where(self.goal, 0.0, 1.0)
        shape = (len(self.goal), self.num_actions, self.goal.shape[1])
        for _ in range(self.horizon - 1):
            c, q = (self.matrix @ steps).reshape(shape), (self.matrix @ misses).reshape(shape)
            best = (step * c + q * x).argmin(axis=1)[:, None]
            steps = np.where(self.goal, 0.0, 1 + np.take_along_axis(c, best, axis=1)[:, 0])
            misses = np.where(self.goal, 0.0, np.take_along_axis(q, best, axis=1)[:, 0])
        return self.rho @ steps, self.rho @ misses

    def times_from_start(self) -> np.ndarray:
        """(targets,), E[ET(0, s0)], infinite if every episode from the start misses the target."""
        c, q = self._pass(np.ones(self.goal.shape[1]), 0.0)
        lost = q >= 1 - 1e-12
        x = np.where(lost, 0.0, c / np.where(lost, 1.0, 1 - q))
        while True:
            c, q = self._pass(x, 1.0)
            better = np.where(lost | (q >= 1), x, c / np.where(q >= 1, 1.0, 1 - q))
            done = (x - better <= 1e-12 * np.maximum(1, x)).all()
            x = np.minimum(x, better)
            if done:
                return np.where(lost, np.inf, x)


# Beyond memory --------------------------------------------------------------------------------------------------------


_FILE, _BOUNDS_RECORD = "bounds.npy", "bounds.json"
_BOUNDS_FORMAT = 1
# Rows of a table that a digest reads in one go.
_DIGEST_ROWS = 1 << 20


class KeptBounds:
    """The bounds of one graph in a folder: `bounds.npy` (4, N), and `bounds.json`, which says of which graph.

    Attributes:
        dtype: of the existing bounds, or None: there are none yet.
    """

    def __init__(self, folder: Path, graph: Graph):
        """
        Raises:
            FileFormatError: the folder holds the bounds of another graph.
        """
        self._folder, self._graph = folder, graph_digest(graph)
        self._size = graph.num_nodes
        self.dtype: np.dtype | None = None
        path = folder / _BOUNDS_RECORD
        if not path.exists():
            return
        record = storage.read_json(path)
        if not isinstance(record, dict) or record.get("format") != _BOUNDS_FORMAT or record.get("graph") != self._graph:
            raise FileFormatError(
                f"{path}: is of another graph, or of another pharos; choose another folder, or delete {_FILE} and "
                f"{_BOUNDS_RECORD} there"
            )
        self.dtype = np.dtype(np.int16 if record.get("bytes") == 2 else np.int32)

    def arrays(self, dtype: np.dtype) -> np.ndarray:
        """(4, N): lower bounds on out(v) and in(v), then upper ones, from the file, or 0 and the largest number.

        The record is written once these are on the disk: after a power failure a file may hold what it held before.
        """
        path, record = storage.inside(self._folder, _FILE), self._folder / _BOUNDS_RECORD
        try:
            if self.dtype != dtype:
                record.unlink(missing_ok=True)
                path.unlink(missing_ok=True)
            bounds = kept_array(path, (4, self._size), dtype, "bounds")
            if self.dtype != dtype or not record.exists():
                bounds[:2] = 0
                bounds[2:] = np.iinfo(dtype).max
                storage.sync(path)
                storage.replace_json(record, {"format": _BOUNDS_FORMAT, "graph": self._graph, "bytes": dtype.itemsize})
                self.dtype = dtype
        except OSError as error:
            raise ParameterError(f"{path}: cannot be used for bounds: {error.strerror}; choose another one") from error
        return bounds

    def remove(self) -> None:
        """Delete the files, once the diameter is known."""
        for name in (_BOUNDS_RECORD, _FILE):
            (self._folder / name).unlink(missing_ok=True)


def graph_digest(graph: Graph) -> str:
    """Digest of all that distances depend on: the table, the states that end, and the state to which these lead."""
    digest = xxhash.xxh3_128(f"{graph.next_states.shape} {graph.start} {graph.has_end}".encode())
    for rows in (graph.next_states, graph.ends):
        for start in range(0, len(rows), _DIGEST_ROWS):
            digest.update(np.ascontiguousarray(rows[start : start + _DIGEST_ROWS]).data)
    return digest.hexdigest()


Result = TypeVar("Result")
Integers: TypeAlias = type[np.int16] | type[np.int32]


def needs_more_than_memory(graph: Graph) -> bool:
    """Whether memory has no room for the arrays of `SumSweep` and the reversed graph."""
    entry = np.dtype(graph.dtype).itemsize
    edges = graph.next_states.size
    first = 2 * (graph.num_nodes + 2) * (4 if edges < 2**31 else 8)
    return 7 * entry * graph.num_nodes + first + graph.next_states.dtype.itemsize * edges > available_memory()


def lean_diameter(graph: Graph, spending: BudgetClock, folder: str | os.PathLike | None = None) -> Interval:
    """The diameter, or the interval proven within the budget.

    folder: in which bounds are kept, and from which tightening goes on. None: in memory.
    """
    store = None if folder is None else KeptBounds(Path(folder), graph)

    def interval(dtype: Integers) -> Interval:
        return LeanSweep(LeanGraph(graph, dtype), spending, store).interval()

    result = interval(np.int32) if store and store.dtype == np.int32 else _in_two_bytes_or_four(interval)
    if store and result.exact:
        store.remove()
    return result


def lean_eccentricity(graph: Graph, source: int, spending: BudgetClock) -> Interval:
    """The largest number of steps from a state to another one."""
    reach, largest, _ = _in_two_bytes_or_four(
        lambda dtype: LeanGraph(graph, dtype).search_forward(source, large_zeros((graph.num_nodes,), dtype))
    )
    spending.searches += 1
    unreachable = graph.num_nodes - int(reach)
    value = math.inf if unreachable else float(largest)
    method = "a breadth-first search, by sweeps over the table"
    return spending.signed(Interval(value, value, True, unreachable, float(largest), method=method))


def _in_two_bytes_or_four(result: Callable[[Integers], Result]) -> Result:
    """result(dtype) with distances of two bytes, or of four if one does not fit into two."""
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

    def __init__(self, graph: Graph, dtype: Integers):
        self.next_states, self.ends, self.start, self.pivot = graph.next_states, graph.ends, graph.start, graph.pivot
        self.num_nodes, self.has_end = graph.num_nodes, graph.has_end
        self.dtype, self.far = dtype, int(np.iinfo(dtype).max)

    def search_forward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """Set distance[v] to d(source, v), or `far`. Return (nodes found, largest distance, sum of distances).

        OverflowError if a distance does not fit.
        """
        return self._swept(kernels.lower_forward, source, distance, False)

    def search_backward(self, source: int, distance: np.ndarray) -> tuple[int, int, int]:
        """Set distance[v] to d(v, source). Returns and raises as `search_forward`."""
        return self._swept(kernels.lower_backward, source, distance, True)

    def _swept(
        self, kernel: Callable[..., int], source: int, distance: np.ndarray, backward: bool
    ) -> tuple[int, int, int]:
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
        """Follow the edge from the end to the start, which is in no row. Return whether it lowers a distance."""
        if not self.has_end or self.start < 0:
            return 0
        here, there = (self.start, self.num_nodes - 1) if backward else (self.num_nodes - 1, self.start)
        if int(distance[here]) + 1 < int(distance[there]):
            distance[there] = distance[here] + 1
            return 1
        return 0


class LeanSweep(SumSweep):
    """`SumSweep` on a graph that is searched by sweeps, in little memory."""

    def __init__(self, graph: LeanGraph, spending: BudgetClock, store: KeptBounds | None = None):
        """store: of the bounds, in files. None: in memory."""
        self.graph: Any = graph
        self.spending = spending
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
        """The diameter, or the interval proven within the budget. OverflowError if bounds do not fit."""
        graph = self.graph
        if not self._is_bounded() and not self._pivot(graph.pivot):
            note = "some states cannot be reached from others; how many pairs was not counted, for want of memory"
            interval = Interval(np.inf, np.inf, True, 1, float(self.best), counted=False, method=self.method, note=note)
            return self.spending.signed(interval)
        if not self._is_bounded():
            raise OverflowError  # a bound was cut
        self._sweep()
        upper = self._upper()
        note = f"budget spent: {self._open()[0]} states may have a larger eccentricity than {self.best}; {MORE}"
        return self._result(self.best, upper, note if upper > self.best else "")

    def _is_bounded(self) -> bool:
        """Whether every node has upper bounds, as after a search from one in both directions that found all."""
        return int(self.out_upper.max()) < self.graph.far and int(self.in_upper.max()) < self.graph.far

    def _fits(self, words: int) -> bool:
        return False  # for searches from many nodes at once
