"""Random numbers by counting: Philox4x32-10 (Salmon, Moraes, Dror and Shaw, SC 2011), four words of 32 bits a call.

The same counter and key give the same words, whoever asks, in whatever order. A key names a run; a counter names a
draw: (draw, copy, step, stream).
"""

import numpy as np
from numba import njit, uint32, uint64

MULTIPLIER_0, MULTIPLIER_1 = 0xD2511F53, 0xCD9E8D57
WEYL_0, WEYL_1 = 0x9E3779B9, 0xBB67AE85
ROUNDS = 10
MASK = 0xFFFFFFFF
UNIT = 2.0**-32


@njit(forceinline=True)
def philox(c0, c1, c2, c3, key):
    """Four words (uint64 below 2^32) of the counter (c0, c1, c2, c3) and a key of 64 bits, its low word first."""
    c0, c1, c2, c3 = uint64(c0), uint64(c1), uint64(c2), uint64(c3)
    k0, k1 = uint64(key) & uint64(MASK), uint64(key) >> uint64(32)
    for _ in range(ROUNDS):
        low, high = uint64(MULTIPLIER_0) * c0, uint64(MULTIPLIER_1) * c2
        c0, c1, c2, c3 = (
            (high >> uint64(32)) ^ c1 ^ k0,
            high & uint64(MASK),
            (low >> uint64(32)) ^ c3 ^ k1,
            low & uint64(MASK),
        )
        k0, k1 = (k0 + uint64(WEYL_0)) & uint64(MASK), (k1 + uint64(WEYL_1)) & uint64(MASK)
    return c0, c1, c2, c3


@njit(forceinline=True)
def unit(word):
    """A word as a number in (0, 1): the middle of its interval of length 2^-32."""
    return (np.float64(word) + 0.5) * UNIT


@njit(forceinline=True)
def below(word, n):
    """A word as an integer in [0, n), n < 2^32."""
    return np.int64((uint64(word) * uint64(n)) >> uint64(32))


@njit(cache=True, nogil=True)
def words(keys, stream, step, out):
    """out[i, j] = the four words of draw j of copy 0 at a step, in a stream, for key i; keys (N,), out (N, M, 4)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            w = philox(j, 0, step, stream, keys[i])
            for k in range(4):
                out[i, j, k] = uint32(w[k])
