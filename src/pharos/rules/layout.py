"""Layout of states in 64-bit words: the position of each component, and integer vectors <-> packed states.

Component i with `size[i]` values takes ceil(log2(size[i])) bits and holds value - low[i]. Components follow one another
in the order of declaration. One that would straddle two words starts the next word. The rule is part of the file
format. `kernels.hash_table` has compiled twins of both functions for a few states at a time. This file loads no Numba.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments import Components
from pharos.errors import ParameterError

AT_ONCE = 64
"""States for each component up to which all components are unpacked at once; of more, one after another."""


@dataclass(frozen=True)
class Layout:
    """Tables of D entries: component i is `(words[word[i]] >> shift[i]) & mask[i]) + low[i]`, one of size[i] values."""

    word: np.ndarray
    shift: np.ndarray
    mask: np.ndarray
    low: np.ndarray
    size: np.ndarray
    num_words: int

    @cached_property
    def tables(self) -> tuple[np.ndarray, ...]:
        """The layout for compiled code: one table (D, 4) int64 of 64 * word + shift, mask << shift, low, size."""
        offset = (self.word << np.uint64(6)) + self.shift
        columns = (offset.astype(np.int64), (self.mask << self.shift).astype(np.int64), self.low, self.size)
        return (np.stack(columns, axis=1),)


def layout_of(components: Components) -> Layout:
    """The layout of states with these components."""
    bits = [int(size - 1).bit_length() for size in components.size]
    word, shift, used, current = [], [], 0, 0
    for width in bits:
        if width > 63:
            raise ParameterError(
                f"a component with 2^{width} values does not fit; a range may have at most 2^63 values"
            )
        if used + width > 64:
            current, used = current + 1, 0
        word.append(current)
        shift.append(used if width else 0)
        used += width
    mask = np.array([(1 << width) - 1 for width in bits], np.uint64)
    return Layout(
        word=np.array(word, np.uint64),
        shift=np.array(shift, np.uint64),
        mask=mask,
        low=components.low.astype(np.int64),
        size=components.size.astype(np.int64),
        num_words=current + 1,
    )


def pack_states(layout: Layout, states: np.ndarray) -> np.ndarray:
    """Packed states (N, W) uint64 of integers (N, D) within their ranges."""
    offsets = (np.asarray(states, np.int64) - layout.low).astype(np.uint64)
    packed = np.zeros((len(offsets), layout.num_words), np.uint64)
    for i in range(len(layout.word)):
        packed[:, int(layout.word[i])] |= offsets[:, i] << layout.shift[i]
    return packed


def unpack_states(layout: Layout, packed: np.ndarray) -> np.ndarray:
    """Integers (N, D) int64 of packed states (N, W) uint64."""
    packed = np.asarray(packed)
    if len(packed) <= AT_ONCE * len(layout.word):
        fields = packed.take(layout.word.astype(np.intp), axis=1, mode="clip")  # nothing to clip; it is faster
        fields >>= layout.shift
        fields &= layout.mask
        return fields.view(np.int64) + layout.low
    states = np.empty((len(packed), len(layout.word)), np.int64)
    for i in range(len(layout.word)):
        field = (packed[:, int(layout.word[i])] >> layout.shift[i]) & layout.mask[i]
        states[:, i] = field.astype(np.int64) + layout.low[i]
    return states
