"""Markov chains of proper policies: linear equations by elimination without subtraction, component by component.

A policy's chain has small strongly connected components even if the components of the MDP are large: it is eliminated
from the components that lead to no other one up, each in the order of minimum degree. See kernels/elimination.py.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from pharos.kernels import elimination, linear_algebra
from pharos.kernels.hitting import UNIT
from pharos.solvers.policy_iteration import iterated

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# Entries that a factor may fill in, and multiplications: 1 GB, or 2 GB of pairs, and a minute.
MOST_FILLED, MOST_MULTIPLICATIONS = 30_000_000, 3e10
# Steps of refinement in floats.
REFINEMENTS = 3


def mean_changes(matrix: "csr_matrix", owner: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((R,) sum_m p(m) (v(m) - v(n)), (R,) sum_m p(m) |v(m) - v(n)|, (R,) how far off differences are) of rows.

    Args:
        matrix: (R, M + 1) CSR of p, without what stays. owner: (R,) the node n of each.
        v: (M + 1,) floats, or pairs of them as complex numbers: their differences are right to a unit of themselves and
            two of their low parts.
    """
    counts = np.diff(matrix.indptr)
    row, at, own = np.repeat(np.arange(len(counts)), counts), matrix.indices, np.repeat(owner, counts)
    high, start = v.real[at], v.real[own]
    steps: np.ndarray = high - start
    off: np.ndarray = np.zeros(len(counts))
    if np.iscomplexobj(v):
        part = steps - high
        rounding, low = (high - (steps - part)) - (start + part), v.imag[at] - v.imag[own]
        steps = steps + (rounding + low)
        off = 2 * UNIT * np.bincount(row, matrix.data * (np.abs(rounding) + np.abs(low)), minlength=len(counts))
    steps *= matrix.data
    return (
        np.bincount(row, steps, minlength=len(counts)),
        np.bincount(row, np.abs(steps), minlength=len(counts)),
        off,
    )


class Chain:
    """Linear equations x(n) sum_m p(n, m) = b(n) + sum_m p(n, m) x(m) of M nodes, 0 at the end, node M.

    Elimination keeps the relative accuracy of what is not negative: floats give x to some 1e-13 of itself, pairs of
    floats to some 1e-29, even if a loop is left once in 1e300 steps.

    Attributes:
        dtype: of x: float, or complex, which is pairs of floats. unit: the relative rounding of such a number.
    """

    def __init__(self, matrix: "csr_matrix", dtype: type):
        """
        matrix: (M, M + 1) CSR of the probabilities, without what stays. dtype: complex: in pairs of floats.
        """
        from scipy import sparse
        from scipy.sparse import csgraph

        self.dtype, self.unit = dtype, UNIT * UNIT if dtype is complex else UNIT
        self._matrix, size = matrix, matrix.shape[0]
        component = csgraph.connected_components(matrix[:, :-1], connection="strong")[1]
        # components by number: SciPy counts those first that lead to no other one
        row = np.repeat(np.arange(size), np.diff(matrix.indptr))
        is_inner = np.append(component, -1)[matrix.indices] == component[row]
        ends = (row[is_inner], matrix.indices[is_inner])
        inner = sparse.csr_matrix((np.ones(len(ends[0])), ends), shape=(size, size))
        inner = (inner + inner.T).tocsr()
        order = np.lexsort((_place_of_least_degree(inner), component))
        self._order = order
        index = np.empty(size + 1, np.int64)
        index[np.append(order, size)] = np.arange(size + 1)
        inner = inner[order][:, order]
        entries = linear_algebra.entries_of_factor(inner.indptr, inner.indices, MOST_FILLED)
        self._is_eliminated = bool(entries.sum() <= MOST_FILLED and (1.0 * entries) @ entries <= MOST_MULTIPLICATIONS)
        if not self._is_eliminated:
            return
        up_first = np.append(0, np.cumsum(entries))
        up_node = np.empty(up_first[-1], np.int64)
        linear_algebra.entries_of_factor(inner.indptr, inner.indices, MOST_FILLED, up_first, up_node)
        below = sparse.csr_matrix((up_node, up_node, up_first), shape=(size, size)).tocsc()
        ordered, numbers = matrix[order], component[order]
        rows = (ordered.indptr, index[ordered.indices], ordered.data)
        blocks = np.searchsorted(numbers, numbers), np.searchsorted(numbers, numbers, side="right")
        factor = up_first, up_node, below.indptr, below.indices, *np.zeros((2, len(up_node)), dtype)
        pivot, leaving, work = np.zeros((3, size), dtype)
        self._parts = elimination.EliminationArrays._make((*rows, *blocks, *factor, pivot))
        elimination.factorize(self._parts, leaving, work)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """(M + 1,) x of b (M,), 0 at the end. Infinite or NaN if numbers are too small, or it is too large."""
        with np.errstate(all="ignore"):
            x, least, own = self._solved(right), math.inf, np.arange(len(right))
            for _ in range(0 if np.iscomplexobj(x) else REFINEMENTS):
                left = right + mean_changes(self._matrix, own, x)[0]
                largest = float(np.abs(left).max(initial=0.0))
                if not largest < 0.5 * least:
                    break
                least = largest
                x += self._solved(left)
        return x

    def _solved(self, right: np.ndarray) -> np.ndarray:
        if not self._is_eliminated:
            return np.append(self._iterated(right), 0.0)
        x: np.ndarray = np.empty(len(right) + 1, self.dtype)
        ordered: np.ndarray = np.zeros(len(right) + 1, self.dtype)
        elimination.substitute(self._parts, right[self._order], ordered)
        x[np.append(self._order, len(right))] = ordered
        return x

    def _iterated(self, right: np.ndarray) -> np.ndarray:
        """(M,) x, as BiCGSTAB has it: if any state soon leads anywhere, it converges within some tens of steps."""
        from scipy import sparse

        leaving = np.asarray(self._matrix.sum(axis=1)).ravel()
        return iterated((sparse.diags(leaving) - self._matrix[:, :-1]).tocsr(), right, np.zeros(len(right)))


def _place_of_least_degree(pattern: "csr_matrix") -> np.ndarray:
    """(M,) the index of each node in an order of minimum degree, of a symmetric pattern, or another, if all is lost."""
    from scipy import sparse
    from scipy.sparse import csgraph, linalg

    indices = np.zeros(pattern.shape[0], np.int64)
    joined = np.flatnonzero(np.diff(pattern.indptr))
    if not len(joined):
        return indices
    part = pattern[joined][:, joined]
    order = csgraph.reverse_cuthill_mckee(part, symmetric_mode=True)
    banded = part[order][:, order]
    entries = linear_algebra.entries_of_factor(banded.indptr, banded.indices, 2 * MOST_FILLED)
    if entries.sum() <= 2 * MOST_FILLED and (1.0 * entries) @ entries <= MOST_MULTIPLICATIONS:
        # SciPy has the order from a factor alone
        part = part + sparse.diags(np.asarray(part.sum(axis=1)).ravel() + 1.0)
        options = {"SymmetricMode": True}
        indices[joined] = linalg.splu(part.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).perm_c
    else:
        indices[joined[order]] = np.arange(len(joined))
    return indices
