"""States that cannot be told apart by where actions lead: orbits of the symmetries of a deterministic table."""

from collections.abc import Callable
from typing import Any

import numpy as np

from pharos.kernels import symmetry
from pharos.system.packed_indices import Indices

# Untyped, as starred arguments of compiled functions are not checked.
kernels: Any = symmetry
# States to which a symmetry is sought, and maps that join nothing before the search for others ends.
_CANDIDATES, _IN_VAIN = 200, 3


def orbits(
    next_states: Indices, ends: np.ndarray, start: int, pivot: int, is_over: Callable[[], bool]
) -> np.ndarray | None:
    """Return (S,) integers: for each state the smallest one of its orbit; None where no symmetry was found.

    A symmetry maps the states onto each other so that every action does the same; it keeps all distances. There are
    many where states can be renamed, as the tiles of a tray, or the positions of a cube without an end. The image of
    one state decides it, so that it takes one pass over the table at most, and mostly a few steps, to find the symmetry
    that takes `pivot` to a state drawn at random, or that there is none.

    Args:
        next_states, ends: (S, A), -1 leads to the end; (S,) the states that end the episode. All must be within reach
            of `pivot`.
        start: the state to which those lead that end the episode; -1: nowhere.
        is_over: whether to stop looking for more.
    Cost: at most four passes over the table for maps that fail, one for each that is found. Without symmetries mostly
        some thousand entries are read, and no more memory is touched: the scratch arrays are zero pages until then.
    Source: ours.
    """
    size, rng = len(next_states), np.random.Generator(np.random.PCG64(0))
    dtype = np.int32 if size < 2**31 else np.int64
    image, preimage, queue = np.zeros(size, dtype), np.zeros(size, dtype), np.empty(size, dtype)
    orbit = None
    count, in_vain, steps_left = size, 0, 4 * size
    others = rng.integers(0, size, _CANDIDATES)
    for t in others[others != pivot]:
        if count == 1 or in_vain == _IN_VAIN or steps_left < 0 or is_over():
            break
        is_symmetry, steps = kernels.symmetry(next_states, ends, start, pivot, t, image, preimage, queue)
        if is_symmetry:
            orbit = np.arange(size, dtype=dtype) if orbit is None else orbit
            before, count = count, int(kernels.join(orbit, image))
            in_vain = in_vain + 1 if count == before else 0
        else:
            steps_left -= steps
        kernels.forget(image, preimage, queue, steps)
    while orbit is not None and (orbit != orbit[orbit]).any():
        orbit = orbit[orbit]
    return orbit
