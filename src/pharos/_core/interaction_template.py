# mypy: ignore-errors
# ruff: noqa: F821
"""The kernels of interaction, which call an environment's rules on states that are rows of int64; a template, run once per
class of environments by `compiling.py`.

Names that the template gets from there: the rules `transition`, `is_terminal`, `reward`, `draw`; `Parameters`, a namedtuple,
what the rules see as `self`; NUM_ACTIONS; CACHE, whether compiled code is kept on disk.
`ranges` (2, D) int64: lowest and highest value of each component.
"""

from numba import int64, njit


@njit(forceinline=True)
def advance(self, ranges, state, action, following):
    """Write the successor of `state`; return the reward and 0 (goes on), 1 (terminal) or 2 + i (component i left its range)."""
    for i in range(len(state)):
        following[i] = state[i]
    transition(self, state, action, following)
    for i in range(len(state)):
        if following[i] < ranges[0, i] or following[i] > ranges[1, i]:
            return 0.0, 2 + i
    return float(reward(self, state, action, following)), int64(is_terminal(self, following))


@njit(cache=CACHE, nogil=True)
def step_one(parameters, ranges, scale, state, action, following, vector):
    """One step: `advance`, and vector[i] = (following[i] - low[i]) * scale[i] where `vector` has room (0 entries: not wanted)."""
    value, code = advance(Parameters(*parameters), ranges, state, action, following)
    if len(vector) > 0:
        for i in range(len(state)):
            vector[i] = (following[i] - ranges[0, i]) * scale[i]
    return value, code


@njit(cache=CACHE, nogil=True)
def is_terminal_one(parameters, state):
    """Whether `state` is terminal."""
    return bool(is_terminal(Parameters(*parameters), state))
