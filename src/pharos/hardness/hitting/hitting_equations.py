"""The linear equations of the hitting times of one policy, with nodes that are alike as one unknown; shorter rows."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # whose `sparse` is loaded where it is used

from pharos.kernels import hitting
from pharos.mdp import ExpandedMDP


@dataclass(frozen=True)
class Factors:
    """Factors of a linear system in which nodes that are alike are one unknown.

    first: (unknowns,) the first node of each. unknown: (inner nodes,) which one a node is.
    """

    factors: Any
    first: np.ndarray
    unknown: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """(inner nodes,) the solution, given the right side."""
        solution: np.ndarray = self.factors.solve(right[self.first])[self.unknown]
        return solution


def factors_of(choices: ExpandedMDP, policy: np.ndarray, inner: np.ndarray) -> Factors | None:
    """The factors of 1 - P of a policy on the `inner` nodes; None where it is not proper. Rows are made to sum to 1."""
    first, unknown = _numbered_once(choices.alike[inner])
    place = np.full(len(policy), first.size)  # what leads elsewhere is left out of the equations
    place[inner] = unknown
    solved = inner[first]
    rows = scipy.sparse.csr_matrix(choices.matrix[solved * choices.num_actions + policy[solved]])
    row, column = np.repeat(np.arange(first.size), np.diff(rows.indptr)), place[rows.indices]
    data = np.where(row == column, 0.0, rows.data)
    leaving = np.bincount(row, data, first.size)
    inside = column < first.size
    matrix = scipy.sparse.coo_matrix((data[inside], (row[inside], column[inside])), shape=(first.size, first.size))
    try:
        return Factors(
            scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(scipy.sparse.diags(leaving) - matrix)), first, unknown
        )
    except RuntimeError:  # singular
        return None


def _numbered_once(alike: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(first member of each group, (N,) its group): nodes that are alike are one group, every other one a group."""
    opens = ~alike
    if alike.any():
        opens[alike.argmax()] = True
    group = np.cumsum(opens) - 1
    if alike.any():
        group[alike] = group[alike.argmax()]
    return np.flatnonzero(opens), group


def without_common(matrix: Any, num_actions: int) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """What the actions of a node have in common is added up once: under random and sticky actions most of a row.

    Returns:
        ((first, node, weight) of the rows without it, one for each action; (first, node, weight) of it, one for each
        node).
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
    distinct = rest > 8 * hitting.UNIT * matrix.data  # the kernels count as much as rounding of `least`
    if distinct.sum() + np.count_nonzero(least) >= matrix.nnz:  # nothing gained
        least[:] = 0.0
        rest, distinct = matrix.data, np.ones(matrix.nnz, np.bool_)
    shared = least > 0
    first = np.concatenate([[0], np.cumsum(np.bincount(row[distinct], minlength=matrix.shape[0]))])
    always = np.concatenate([[0], np.cumsum(np.bincount(pairs[shared] // nodes, minlength=nodes))])
    return (
        (first.astype(np.int64), matrix.indices[distinct].astype(np.int64), rest[distinct]),
        (always.astype(np.int64), (pairs[shared] % nodes).astype(np.int64), least[shared]),
    )
