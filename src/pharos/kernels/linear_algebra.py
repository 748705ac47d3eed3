"""Loops of linear algebra: steps of Krylov methods, the fill of an elimination, products with kernels.

Krylov methods: fused operations on vectors (n,) float64, each with the sums that the next step needs. Elimination: the
number of entries that the factor of a sparse matrix will have. Source: Liu (1990), elimination trees.

Products with a kernel F F' + diagonal go in passes over the rows of F (C, M): each row is read once a product. Those
with a symmetric matrix read its lower half alone: they are as fast as memory is.
"""

import numpy as np

from pharos.kernels.kernel_cache import kernel


@kernel
def products(a, b):
    """(a . b, b . b), in one pass."""
    ab, bb = 0.0, 0.0
    for i in range(len(b)):
        ab += a[i] * b[i]
        bb += b[i] * b[i]
    return ab, bb


@kernel
def shift(y, constant, out):
    """out = y + constant."""
    for i in range(len(y)):
        out[i] = y[i] + constant


@kernel
def subtract_from(y, out):
    """out = y - out."""
    for i in range(len(y)):
        out[i] = y[i] - out[i]


@kernel
def add_scaled(x, factor, y):
    """x += factor y, in place. Returns the sum of x."""
    total = 0.0
    for i in range(len(x)):
        x[i] += factor * y[i]
        total += x[i]
    return total


@kernel
def next_direction(direction, beta, omega, moved, residual):
    """direction = residual + beta (direction - omega moved), in place. Returns its sum."""
    total = 0.0
    for i in range(len(direction)):
        direction[i] = residual[i] + beta * (direction[i] - omega * moved[i])
        total += direction[i]
    return total


# Elimination ----------------------------------------------------------------------------------------------------------


@kernel
def entries_of_factor(first, columns, limit, starts=None, rows=None):
    """(N,) entries below the diagonal in each column of the factor of a matrix whose pattern is symmetric.

    Row i of the matrix has its entries in columns[first[i] : first[i + 1]]. Pivots are taken in order. In place of the
    counts of all rows those so far are returned as soon as their sum passes the limit. Unless they are None, rows holds
    the rows of the entries of column j from starts[j] on, in order.

    Cost: O(entries of the factor) time, 24 bytes a row.
    """
    size = len(first) - 1
    entries = np.zeros(size, np.int64)
    parent = np.full(size, -1)
    marks = np.full(size, -1)
    total = 0
    for row in range(size):
        marks[row] = row
        for entry in range(first[row], first[row + 1]):
            column = columns[entry]
            # row `row` of the factor: the ways up the tree from the entries left of the diagonal
            while column < row and marks[column] != row:
                if parent[column] < 0:
                    parent[column] = row
                if rows is not None:
                    rows[starts[column] + entries[column]] = row
                entries[column] += 1
                total += 1
                marks[column] = row
                column = parent[column]
        if total > limit:
            break
    return entries


# Kernels of rank M ----------------------------------------------------------------------------------------------------


FLOAT32_ROWS = 256  # sums over so many rows are float32, sums of these float64


@kernel(fastmath={"reassoc", "contract", "nsz"})
def project(features, z, out):
    """out (A, M) float64 = (F' z)', z (C, A) float32."""
    part = np.zeros(out.shape, np.float32)
    out[:] = 0.0
    # float32 sums of FLOAT32_ROWS rows, added up as float64
    for first in range(0, len(features), FLOAT32_ROWS):
        part[:] = 0.0
        for s in range(first, min(first + FLOAT32_ROWS, len(features))):
            for a in range(z.shape[1]):
                value = z[s, a]
                for m in range(features.shape[1]):
                    part[a, m] += features[s, m] * value
        out += part


@kernel(fastmath={"reassoc", "contract", "nsz"})
def step(features, diagonal, weights, rate, projected, now, past, out):
    """One term of a Chebyshev series: past = 2 now - 4 rate K (weights now) - past, in place.

    projected (A, M) float32 = (F' (weights now))', and out (A, M) float64 = the same of the new term. now, past,
    weights (C, A) float32; diagonal (C, 1).
    """
    part = np.zeros(out.shape, np.float32)
    out[:] = 0.0
    for first in range(0, len(features), FLOAT32_ROWS):
        part[:] = 0.0
        for s in range(first, min(first + FLOAT32_ROWS, len(features))):
            for a in range(now.shape[1]):
                # entry (s, a) of K (weights now), and the new term
                total = np.float32(0.0)
                for m in range(features.shape[1]):
                    total += features[s, m] * projected[a, m]
                total += diagonal[s, 0] * weights[s, a] * now[s, a]
                past[s, a] = np.float32(2.0) * now[s, a] - np.float32(4.0) * rate * total - past[s, a]
                # its share of the next projection
                value = weights[s, a] * past[s, a]
                for m in range(features.shape[1]):
                    part[a, m] += features[s, m] * value
        out += part


# Symmetric ------------------------------------------------------------------------------------------------------------


@kernel(fastmath={"reassoc", "contract", "nsz"})
def product(matrix, z, out):
    """out (A, C) = z matrix, of a symmetric matrix (C, C) float32 and z (A, C), with float64 sums. The upper half of
    the matrix is not read. z, out: float64. Two rows of the matrix go over z at once."""
    out[:] = 0.0
    # rows s and s + 1, left of the diagonal: each entry counts for its row and, mirrored, for its column
    for s in range(0, len(matrix) - 1, 2):
        for a in range(len(z)):
            first, second = z[a, s], z[a, s + 1]
            upper, lower = 0.0, 0.0
            for m in range(s):
                x, y = matrix[s, m], matrix[s + 1, m]
                upper += x * z[a, m]
                lower += y * z[a, m]
                out[a, m] += x * first + y * second
            coupling = matrix[s + 1, s]
            out[a, s] += upper + matrix[s, s] * first + coupling * second
            out[a, s + 1] += lower + coupling * first + matrix[s + 1, s + 1] * second
    # the last row of an odd number
    if len(matrix) % 2:
        s = len(matrix) - 1
        for a in range(len(z)):
            last, total = z[a, s], 0.0
            for m in range(s):
                total += matrix[s, m] * z[a, m]
                out[a, m] += matrix[s, m] * last
            out[a, s] += total + matrix[s, s] * last
