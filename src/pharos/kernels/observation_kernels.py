"""Observations that need no rules: loops over the components of a block of states."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def normalize(states, low, scale, out):
    """out[n, i] = (states[n, i] - low[i]) * scale[i] for the first D columns of out (N, D or more) float32."""
    for n in range(states.shape[0]):
        for i in range(states.shape[1]):
            out[n, i] = (states[n, i] - low[i]) * scale[i]


@njit(cache=True, nogil=True)
def mark_components(states, low, offset, out):
    """out[n, offset[i] + states[n, i] - low[i]] = 1 for every component i."""
    for n in range(states.shape[0]):
        for i in range(states.shape[1]):
            out[n, offset[i] + states[n, i] - low[i]] = 1


@njit(cache=True, nogil=True, inline="always")
def _mixed(word):
    """The finalizer of SplitMix64 (Steele, Lea and Flood, 2014)."""
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))


@njit(cache=True, nogil=True)
def scramble(states, low, lengths, keys, out):
    """out (N, B), zeros: the components of each state in binary, permuted by a Feistel network of len(keys) rounds."""
    one, step = np.uint64(1), np.uint64(0x9E3779B97F4A7C15)
    bits, half = out.shape[1], out.shape[1] // 2
    for n in range(states.shape[0]):
        place = 0
        for i in range(states.shape[1]):
            for b in range(lengths[i]):
                out[n, place] = ((states[n, i] - low[i]) >> b) & 1
                place += 1
        for r in range(len(keys)):
            first, last = (0, half) if r % 2 == 0 else (half, bits)
            word = keys[r]
            for place in range(first, last):
                word = _mixed(word + step + np.uint64(out[n, place]))
            begin, end = (half, bits) if r % 2 == 0 else (0, half)
            drawn = word
            for place in range(begin, end):
                if (place - begin) % 64 == 0:
                    word += step
                    drawn = _mixed(word)
                out[n, place] ^= np.int8(drawn & one)
                drawn >>= one
