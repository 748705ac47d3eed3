"""Packing states into words and back: a few states at a time, where NumPy (rules/layout.py) would take a call for each
component.
"""

import numpy as np
from numba import njit

from pharos.kernels.interpreted import interpreted_first


@interpreted_first("states")
@njit(cache=True, nogil=True)
def pack_rows(word, shift, low, states, packed):
    """packed (N, W) uint64 |= states (N, D) int64, component i in bits from shift[i] of word[i].

    `packed` is zero before.
    """
    for n in range(len(states)):
        for i in range(len(word)):
            packed[n, word[i]] |= np.uint64(states[n, i] - low[i]) << shift[i]


@interpreted_first("states")
@njit(cache=True, nogil=True)
def unpack_rows(word, shift, mask, low, packed, states):
    """states (N, D) int64 = components of packed (N, W); the inverse of `pack_rows`."""
    for n in range(len(packed)):
        for i in range(len(word)):
            states[n, i] = np.int64((packed[n, word[i]] >> shift[i]) & mask[i]) + low[i]
