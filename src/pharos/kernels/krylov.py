"""Loops of Krylov methods over vectors (n,) float64, each with the sums that the next step needs.

What elimination of a sparse matrix will cost, before it is done. Source: Liu (1990), elimination trees.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def products(a, b):
    """(a . b, b . b)."""
    across, own = 0.0, 0.0
    for i in range(len(b)):
        across += a[i] * b[i]
        own += b[i] * b[i]
    return across, own


@njit(cache=True, nogil=True)
def shift(y, constant, out):
    """out = y + constant."""
    for i in range(len(y)):
        out[i] = y[i] + constant


@njit(cache=True, nogil=True)
def take_from(y, out):
    """out = y - out."""
    for i in range(len(y)):
        out[i] = y[i] - out[i]


@njit(cache=True, nogil=True)
def advance(x, factor, y):
    """x += factor y; the sum of x."""
    total = 0.0
    for i in range(len(x)):
        x[i] += factor * y[i]
        total += x[i]
    return total


@njit(cache=True, nogil=True)
def turn(direction, beta, omega, moved, residual):
    """direction = residual + beta (direction - omega moved); its sum."""
    total = 0.0
    for i in range(len(direction)):
        direction[i] = residual[i] + beta * (direction[i] - omega * moved[i])
        total += direction[i]
    return total


# Elimination ----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def entries_of_factor(first, columns, limit):
    """(N,) entries below the diagonal in each column of the factor of a matrix whose pattern is symmetric.

    Row i of the matrix has its entries in columns[first[i] : first[i + 1]]; pivots are taken in order. In place of the
    counts of all rows those so far are returned as soon as their sum passes the limit.

    Cost: O(entries of the factor) time, 24 bytes a row.
    """
    size = len(first) - 1
    entries = np.zeros(size, np.int64)
    parent = np.full(size, -1)
    marks = np.full(size, -1)
    total = 0
    for row in range(size):
        marks[row] = row
        for place in range(first[row], first[row + 1]):
            column = columns[place]
            # row `row` of the factor: the ways up the tree from the entries left of the diagonal
            while column < row and marks[column] != row:
                if parent[column] < 0:
                    parent[column] = row
                entries[column] += 1
                total += 1
                marks[column] = row
                column = parent[column]
        if total > limit:
            break
    return entries
