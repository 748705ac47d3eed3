"""Elimination without subtraction: equations of Markov chains whose loops may be left ever so rarely.

x[n] sum_m p(n, m) = b[n] + sum_m p(n, m) x[m] of nodes n, with p >= 0: the sum leaves out what stays. The end, node N,
has x = 0. An eliminated node is left to the others, and its pivot is the sum of what leaves it: sums, products and
quotients of numbers that are not negative, so that each keeps its relative accuracy, however small it is. What leaves a
component is carried beside its rows: no difference from 1 is taken.

Nodes come by strongly connected component, those that lead to no other one first: no component fills in another one.
Row n has the entries node[k], weight[k] for k from first[n] to first[n + 1]. Its component has the nodes begin[n] to
stop[n]. In components the pattern of a factor is symmetric: row n of `upper` has the columns up_node of up_first[n] to
up_first[n + 1], which are above n. `lower` has low_node, below n.

Numbers are float64, or pairs of them, held as complex numbers, whose sum real + imag has 106 bits.
Source: Grassmann, Taksar and Heyman (1985); O'Cinneide (1993), "Entrywise perturbation theory and error analysis for
Markov chains"; Alfa, Xue and Ye (2002), "Accurate computation of the smallest eigenvalue of a diagonally dominant
M-matrix"; pairs: Dekker (1971), "A floating-point technique for extending the available precision".
"""

from typing import NamedTuple

import numpy as np
from numba import types

from pharos.kernels.interpreted import interpreted_first, overload
from pharos.kernels.kernel_cache import kernel

SUM_LOSS = 2.0**-44  # more than sums lose
SPLITTER = 2.0**27 + 1  # times a float, it splits it into halves of 26 bits


class EliminationArrays(NamedTuple):
    """Rows of a chain, their components, and the factors that `factorize` fills in: upper, lower, and pivot (N,)."""

    first: np.ndarray
    node: np.ndarray
    weight: np.ndarray
    begin: np.ndarray
    stop: np.ndarray
    up_first: np.ndarray
    up_node: np.ndarray
    low_first: np.ndarray
    low_node: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    pivot: np.ndarray


@interpreted_first()
@kernel(makes_arrays=False)
def factorize(chain, leaving, work):
    """Fill in upper, lower, pivot and leaving (N,): of each node, when all before it in its component are left out,
    what leaves the node, and what leads out of the component. work (N,): zero before and after."""
    first, node, weight, begin, stop, up_first, up_node, low_first, low_node, upper, lower, pivot = chain
    for n in range(len(pivot)):
        out = pivot[n] * 0.0
        for k in range(first[n], first[n + 1]):
            m = node[k]
            if begin[n] <= m < stop[n]:
                work[m] = plus(work[m], weight[k])
            else:
                out = plus(out, weight[k])
        for k in range(low_first[n], low_first[n + 1]):
            m = low_node[k]
            factor = over(work[m], pivot[m])
            work[m] = 0.0
            lower[k] = factor
            if factor.real > 0.0:
                out = plus(out, times(leaving[m], factor))
                for j in range(up_first[m], up_first[m + 1]):
                    t = up_node[j]
                    work[t] = plus(work[t], times(upper[j], factor))
        leaving[n] = out
        work[n] = 0.0  # what stays
        for k in range(up_first[n], up_first[n + 1]):
            upper[k] = work[up_node[k]]
            work[up_node[k]] = 0.0
            out = plus(out, upper[k])
        pivot[n] = out


@interpreted_first()
@kernel(makes_arrays=False)
def substitute(chain, right, x):
    """x (N + 1,) of the right sides (N,) float64, by what `factorize` filled in. x[N] = 0 before and after."""
    first, node, weight, begin, stop, up_first, up_node, low_first, low_node, upper, lower, pivot = chain
    start = 0
    while start < len(pivot):
        end = stop[start]
        for n in range(start, end):
            b = plus(x[-1], right[n])
            for k in range(first[n], first[n + 1]):
                m = node[k]
                if not begin[n] <= m < end:
                    b = plus(b, times(x[m], weight[k]))
            for k in range(low_first[n], low_first[n + 1]):
                b = plus(b, times(x[low_node[k]], lower[k]))
            x[n] = b
        for n in range(end - 1, start - 1, -1):
            b = x[n]
            for k in range(up_first[n], up_first[n + 1]):
                b = plus(b, times(x[up_node[k]], upper[k]))
            x[n] = over(b, pivot[n])
        start = end


@interpreted_first()
@kernel(makes_arrays=False)
def improve(matrix, rows, rewards, backward, v, policy):
    """Sweep v (N + 1,) in place to the best of the rows of each node, from rows[n] to rows[n + 1], and keep that row in
    policy (N,) if it is better beyond rounding. matrix: (first, node, weight). Returns how many were."""
    first, node, weight = matrix
    count, size = 0, len(policy)
    for i in range(size):
        n = size - 1 - i if backward else i
        for row in range(rows[n], rows[n + 1]):
            total, leaving = rewards[row], 0.0
            for k in range(first[row], first[row + 1]):
                total += weight[k] * v[node[k]]
                leaving += weight[k]
            value = total / leaving
            if value - v[n] > SUM_LOSS * (abs(value) + abs(v[n]) + abs(rewards[row]) / leaving):
                v[n], policy[n] = value, row
                count += 1
    return count


# Numbers --------------------------------------------------------------------------------------------------------------


def plus(x, y):
    """x + y, as accurate as x is held. y may be a float if x is a pair."""


def times(x, y):
    """x y, as accurate as x is held. y may be a float if x is a pair."""


def over(x, y):
    """x / y, both floats or both pairs."""


@overload(plus)
def _plus(x, y):
    if not isinstance(x, types.Complex):
        return lambda x, y: x + y

    def of_pairs(x, y):
        high, error = two_sum(x.real, y.real)
        low, more = two_sum(x.imag, y.imag)
        high, low = shorter_sum(high, error + low)
        high, low = shorter_sum(high, low + more)
        return complex(high, low)

    return of_pairs


@overload(times)
def _times(x, y):
    if not isinstance(x, types.Complex):
        return lambda x, y: x * y

    def of_pairs(x, y):
        high, error = two_product(x.real, y.real)
        high, low = shorter_sum(high, error + (x.real * y.imag + x.imag * y.real))
        return complex(high, low)

    return of_pairs


@overload(over, jit_options={"error_model": "numpy"})
def _over(x, y):
    if not isinstance(x, types.Complex):
        return lambda x, y: x / y

    def of_pairs(x, y):
        quotient = x.real / y.real
        high, error = two_product(quotient, y.real)
        left = ((x.real - high) - error) + (x.imag - quotient * y.imag)
        high, low = shorter_sum(quotient, left / y.real)
        return complex(high, low)

    return of_pairs


@kernel
def two_sum(x, y):
    """(x + y, the rounding error of it)."""
    total = x + y
    part = total - x
    return total, (x - (total - part)) + (y - part)


@kernel
def shorter_sum(x, y):
    """The same, if x is 0 or no smaller than y."""
    total = x + y
    return total, y - (total - x)


@kernel
def two_product(x, y):
    """(x y, the rounding error of it)."""
    product = x * y
    part = SPLITTER * x
    x_high = part - (part - x)
    part = SPLITTER * y
    y_high = part - (part - y)
    x_low, y_low = x - x_high, y - y_high
    return product, ((x_high * y_high - product) + x_high * y_low + x_low * y_high) + x_low * y_low
