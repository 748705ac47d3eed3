"""Observations that need no rules: loops over the components of a block of states."""

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
