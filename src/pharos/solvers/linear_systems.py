"""Sparse linear systems (1 - gamma P) x = r of a policy, within limits of time and memory.

Two families of MDPs are slow by sweeps near gamma = 1, and each is quick by one of two methods. Where states lead to
near ones (rings, grids, corridors, games of many screens), elimination in the order of Cuthill and McKee fills little
in; how much is counted beforehand. Where any state soon leads anywhere, BiCGSTAB converges within some tens of steps.
What has neither is not solved here.
Source: Cuthill and McKee (1969); Liu (1990), elimination trees; van der Vorst (1992), BiCGSTAB.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# Unknowns of the largest dense system, and of the largest that is eliminated whatever it fills in.
DENSE, ELIMINATED = 400, 3000
# Steps of BiCGSTAB; by how much each call shrinks the residual; calls, each for the residual of the one before.
STEPS, SHRINKAGE, CALLS = 500, 1e-8, 4
# Entries of one factor, and multiplications: 250 MB and some seconds at most.
MOST_ENTRIES, MOST_MULTIPLICATIONS = 10_000_000, 5e9


def solution_of_system(system: "csr_matrix", right: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The x of system x = right, from a guess; NaN where the system is singular to the last bit, or takes too long."""
    try:
        if len(right) <= DENSE:
            return np.linalg.solve(system.toarray(), right)
        if len(right) <= ELIMINATED:
            return _eliminated(system, right)
        return _large(system, right, x)
    except (np.linalg.LinAlgError, RuntimeError):
        return np.full(len(right), np.nan)


def _eliminated(system: "csr_matrix", right: np.ndarray) -> np.ndarray:
    from scipy.sparse import linalg

    return linalg.splu(system.tocsc()).solve(right)


def _large(system: "csr_matrix", right: np.ndarray, x: np.ndarray) -> np.ndarray:
    """By elimination where it fills little in, else by BiCGSTAB."""
    from scipy.sparse import csgraph, linalg

    order = csgraph.reverse_cuthill_mckee(system)
    ordered = system[order][:, order]
    if not fills_little(ordered):
        return _iterated(system, right, x)
    # in each row the diagonal outweighs the rest, so pivots are on the diagonal, and the pattern is that of the count
    options = {"SymmetricMode": True}
    factors = linalg.splu(ordered.tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)
    solved = np.empty(len(right))
    solved[order] = factors.solve(right[order])
    solved[order] += factors.solve((right - system @ solved)[order])
    return solved


def _iterated(system: "csr_matrix", right: np.ndarray, x: np.ndarray) -> np.ndarray:
    """By BiCGSTAB from x, again for what is left, as far as rounding allows; NaN where it does not converge."""
    residual = right - system @ x
    for call in range(CALLS):
        step, left, _ = bicgstab(lambda y: system @ y, residual, SHRINKAGE, STEPS)
        if call == 0 and not left <= SHRINKAGE:
            return np.full(len(right), np.nan)
        after = right - system @ (x + step)
        if not np.abs(after).max() < np.abs(residual).max():
            break
        x, residual = x + step, after
    return x


def bicgstab(
    times: Callable[[np.ndarray], np.ndarray], right: np.ndarray, shrinkage: float, steps: int
) -> tuple[np.ndarray, float, int]:
    """(x, norm of its residual divided by that of `right`, applications of the operator) of `times(x) = right`, from 0.

    Args:
        times: the image of a vector (n,), a new array, or one that the next call may overwrite.
        shrinkage: at most this ratio of norms is enough.
        steps: of two applications each, at most.
    SciPy's adds up by BLAS, whose sums depend on the number of threads, and which waits for them on a busy machine.
    """
    from pharos.kernels import linear_algebra

    size = len(right)
    constant = float(times(np.ones(size)).mean())
    x, towards, onwards = np.zeros(size), np.empty(size), np.empty(size)
    residual, direction, moved = right.copy(), right.copy(), np.empty(size)
    total = float(right.sum())
    rho = norm = whole = linear_algebra.products(right, right)[1]
    enough, step = shrinkage * shrinkage * norm, 0
    best = norm
    with np.errstate(all="ignore"):  # a breakdown is NaN, and does not converge
        while norm > enough and step < steps:
            step += 1
            # Preconditioned: where episodes do not end, constant vectors shrink to 1 - gamma, which slows all methods.
            linear_algebra.shift(direction, np.float64(total) / size / constant, towards)
            moved[:] = times(towards)
            alpha = np.float64(rho) / linear_algebra.products(right, moved)[0]
            total = linear_algebra.advance(residual, -alpha, moved)
            linear_algebra.shift(residual, np.float64(total) / size / constant, onwards)
            stabilised = times(onwards)
            across, own = linear_algebra.products(residual, stabilised)
            omega = np.float64(across) / own
            linear_algebra.advance(x, alpha, towards)
            linear_algebra.advance(x, omega, onwards)
            linear_algebra.advance(residual, -omega, stabilised)
            before = rho
            rho, norm = linear_algebra.products(right, residual)
            total = linear_algebra.turn(direction, (rho / np.float64(before)) * (alpha / omega), omega, moved, residual)
            if not norm < 1e8 * best:
                break
            best = min(best, norm)
    ratio = math.sqrt(norm / whole) if whole > 0 and norm >= 0 else math.nan if norm != 0 else 0.0
    return x, ratio, 2 * step + 1


def fills_little(matrix: "csr_matrix") -> bool:
    """Whether elimination in the order of the rows, with pivots on the diagonal, keeps within the limits above."""
    from pharos.kernels import linear_algebra

    both = (abs(matrix) + abs(matrix).T).tocsr()
    entries = linear_algebra.entries_of_factor(both.indptr, both.indices, MOST_ENTRIES).astype(float)
    return bool(entries.sum() <= MOST_ENTRIES and entries @ entries <= MOST_MULTIPLICATIONS)
