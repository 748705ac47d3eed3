"""Loops of Krylov methods over vectors (n,) float64, each with the sums that the next step needs."""

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
