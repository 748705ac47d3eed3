"""Products with a symmetric matrix that read its lower half alone: they are as fast as memory is."""

from numba import njit


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def product(matrix, z, out):
    """out (A, C) = z matrix, of a symmetric matrix (C, C) float32 and z (A, C), with float64 sums; the upper half of
    the matrix is not read. z, out: float64. Two rows of the matrix go over z at once."""
    out[:] = 0.0
    for s in range(0, len(matrix) - 1, 2):
        for a in range(len(z)):
            first, second = z[a, s], z[a, s + 1]
            upper, lower = 0.0, 0.0
            for m in range(s):
                x, y = matrix[s, m], matrix[s + 1, m]
                upper += x * z[a, m]
                lower += y * z[a, m]
                out[a, m] += x * first + y * second
            beside = matrix[s + 1, s]
            out[a, s] += upper + matrix[s, s] * first + beside * second
            out[a, s + 1] += lower + beside * first + matrix[s + 1, s + 1] * second
    if len(matrix) % 2:
        s = len(matrix) - 1
        for a in range(len(z)):
            last, total = z[a, s], 0.0
            for m in range(s):
                total += matrix[s, m] * z[a, m]
                out[a, m] += matrix[s, m] * last
            out[a, s] += total + matrix[s, s] * last
