"""Outcomes of executing an action, for loops that need not know how they are stored.

`PackedIndices` are read like arrays of int64, entry by entry. So a loop over `next_states[s, a]` is written once, and
Numba compiles it for each width of the indices. Its code for int32 and int64 is the same as without them. They cannot
be written to here, nor returned.

Kernels take `transitions`, one of three things:

- a table (S, A) of next states, -1 if the episode ends: an array, or `PackedIndices`;
- several outcomes, as a tuple (successors (N,), offsets, codes, weights, (S, A), each). The outcomes of (s, a), row =
  s A + a, are successors[row K : (row + 1) K], or successors[offsets[row] : offsets[row + 1]] if there are offsets.
  Their probabilities are weights[codes[row]], or, without codes, weights at the same indices as the successors. Without
  offsets the last ones of a row may have probability 0: they repeat its first successor. each: K, or, so that the
  compiler knows it and unrolls loops (twice as fast), a tuple of K zeros (`each_of`);
- a pair (`transitions` of the first two kinds, p): with probability p a state stays what it is, else they hold. Staying
  is the last outcome of each row.

`outcome_numbers` and `outcome` give them one by one, `expectation` adds up values. Loops over tables cost nothing more:
their indices are unsigned, as signed ones would be checked at each read for counting from the end.

State spaces store the possible outcomes, row after row, and their probabilities as codes of a palette. Row s A + a
belongs to action a in state s. Probabilities are compared as their bits, uint64: 0 is an impossible outcome. The
palette (capacity, K) uint64 has the distinct rows of probabilities, the possible ones in their order, then zeros,
numbered in the order in which they appear. A table of slots finds them by their hash. K is the most outcomes of a row.
"""

import operator

import numba.extending
import numpy as np
from numba import from_dtype, int64, types, uint64
from numba.core import cgutils
from numba.extending import (
    NativeValue,
    make_attribute_wrapper,
    models,
    overload_attribute,
    register_model,
    unbox,
)

from pharos.kernels.hash_table import mixed, prefetch, slot_of
from pharos.kernels.interpreted import interpreted_first, overload
from pharos.kernels.kernel_cache import inlined, kernel
from pharos.system.arrays import PACKED, PackedIndices

# Indices of 40 bits ---------------------------------------------------------------------------------------------------


class PackedIndicesType(types.Type):
    """Numba's type of `PackedIndices`, by the number of dimensions."""

    def __init__(self, ndim):
        self.entries = types.Array(from_dtype(PACKED), ndim, "C", readonly=True)
        super().__init__(name=f"pharos.PackedIndices({ndim})")


@register_model(PackedIndicesType)
class _PackedIndicesModel(models.StructModel):
    def __init__(self, manager, indices_type):
        super().__init__(manager, indices_type, [("entries", indices_type.entries)])


make_attribute_wrapper(PackedIndicesType, "entries", "entries")


@unbox(PackedIndicesType)
def _unboxed(indices_type, indices, c):
    array = c.pyapi.object_getattr_string(indices, "packed")
    entries = c.unbox(indices_type.entries, array)
    c.pyapi.decref(array)  # the object keeps it
    result = cgutils.create_struct_proxy(indices_type)(c.context, c.builder)
    result.entries = entries.value
    return NativeValue(result._getvalue(), is_error=entries.is_error, cleanup=entries.cleanup)


@numba.extending.overload(operator.getitem, jit_options={"forceinline": True})
def _getitem(indices, where):
    if not isinstance(indices, PackedIndicesType):
        return None

    def entry(indices, where):
        parts = indices.entries[where]
        return np.int64(parts.high) << 32 | np.int64(parts.low)

    return entry


@overload_attribute(PackedIndicesType, "shape")
def _typed_shape(indices):
    return lambda indices: indices.entries.shape


@numba.extending.overload(len)
def _length(indices):
    if isinstance(indices, PackedIndicesType):
        return lambda indices: len(indices.entries)
    return None


def _type_of(indices):
    return PackedIndicesType(indices.ndim)


PackedIndices._numba_type_ = property(_type_of)  # type: ignore[attr-defined]


# Transitions ----------------------------------------------------------------------------------------------------------


UNROLLED_OUTCOMES = 4  # the largest K for which loops over outcomes are unrolled
UNROLLED_FROM = 100_000
"""States from which sweeps are compiled for each number of actions and outcomes; fewer are swept sooner than that."""


def is_unrolled(num_states):
    """Whether sweeps over so many states are compiled for their very numbers of actions and outcomes, and kinds of
    rewards. Otherwise one compiled form serves all."""
    return num_states >= UNROLLED_FROM


def each_of(num_outcomes, unrolled):
    """The last entry of `transitions`, for sweeps: a tuple of K zeros if K is small and sweeps are unrolled, else K."""
    return (0,) * num_outcomes if num_outcomes <= UNROLLED_OUTCOMES and unrolled else num_outcomes


def _is_lazy(transitions):
    """Whether the type is a pair (transitions, probability of staying)."""
    return isinstance(transitions, types.BaseTuple) and len(transitions) == 2


def is_table(transitions):
    """Whether the type is a table of next states."""
    return isinstance(transitions, types.Array | PackedIndicesType)


def size_of(transitions):
    """(S, A): number of states and actions."""


@overload(size_of)
def _size_of(transitions):
    if _is_lazy(transitions):
        return lambda transitions: size_of(transitions[0])
    if is_table(transitions):
        return lambda transitions: transitions.shape
    return lambda transitions: transitions[4]


def outcome_numbers(transitions, s, a):
    """The numbers of the outcomes of (s, a), as a range. Impossible ones among them repeat the state of another."""


@overload(outcome_numbers)
def _typed_outcome_numbers(transitions, s, a):
    if _is_lazy(transitions):
        return lambda transitions, s, a: range(len(outcome_numbers(transitions[0], s, a)) + 1)
    if is_table(transitions):
        return lambda transitions, s, a: range(1)
    if isinstance(transitions[5], types.BaseTuple):
        return lambda transitions, s, a: range(len(transitions[5]))
    if isinstance(transitions[1], types.NoneType):
        return lambda transitions, s, a: range(transitions[5])

    def ragged(transitions, s, a):
        row = uint64(s * transitions[4][1] + a)
        return range(np.int64(transitions[1][row + uint64(1)]) - np.int64(transitions[1][row]))

    return ragged


def outcome(transitions, s, a, k):
    """(next state or -1 for the end, probability) of outcome k of (s, a)."""


@overload(outcome)
def _outcome(transitions, s, a, k):
    if _is_lazy(transitions):

        def moves_or_stays(transitions, s, a, k):
            if np.int64(k) == len(outcome_numbers(transitions[0], s, a)):
                return np.int64(s), transitions[1]
            t, p = outcome(transitions[0], s, a, k)
            return np.int64(t), (1.0 - transitions[1]) * p

        return moves_or_stays
    if is_table(transitions):
        return lambda transitions, s, a, k: (transitions[s, a], 1.0)
    if isinstance(transitions[2], types.NoneType):

        def one_by_one(transitions, s, a, k):
            index, is_padding = _outcome_index(transitions, s * transitions[4][1] + a, k)
            return transitions[0][index], 0.0 if is_padding else transitions[3][index]

        return one_by_one

    def by_palette(transitions, s, a, k):
        row = s * transitions[4][1] + a
        index, _ = _outcome_index(transitions, row, k)
        return transitions[0][index], transitions[3][uint64(transitions[2][uint64(row)]), uint64(k)]

    return by_palette


def _outcome_index(transitions, row, k):
    """(index of successor k of a row, whether k is padding, so that it repeats the last one)."""


@overload(_outcome_index)
def _typed_outcome_index(transitions, row, k):
    if isinstance(transitions[1], types.NoneType):
        if isinstance(transitions[5], types.BaseTuple):
            return lambda transitions, row, k: (uint64(row) * uint64(len(transitions[5])) + uint64(k), False)
        return lambda transitions, row, k: (uint64(row) * uint64(transitions[5]) + uint64(k), False)
    if not isinstance(transitions[5], types.BaseTuple):
        return lambda transitions, row, k: (uint64(transitions[1][uint64(row)]) + uint64(k), False)

    def ragged(transitions, row, k):
        first, after = transitions[1][uint64(row)], transitions[1][uint64(row) + uint64(1)]
        index = first + k
        return uint64(min(index, after - 1)), index >= after

    return ragged


def expectation(transitions, v, s, a):
    """The mean of v (S + 1,), or of v (S + 1, A) at a, over what (s, a) leads to. -1 reads the last entry."""


@overload(expectation)
def _expectation(transitions, v, s, a):
    if _is_lazy(transitions):

        def moves_or_stays(transitions, v, s, a):
            return (1.0 - transitions[1]) * expectation(transitions[0], v, s, a) + transitions[1] * _typed_value(
                v, s, a
            )

        return moves_or_stays
    if is_table(transitions):
        return lambda transitions, v, s, a: _typed_value(v, transitions[uint64(s), uint64(a)], uint64(a))

    def several(transitions, v, s, a):
        total = 0.0
        for k in outcome_numbers(transitions, s, a):
            t, p = outcome(transitions, s, a, k)
            total += p * _typed_value(v, t, a)
        return total

    return several


def _typed_value(v, s, a):
    """v[s], or v[s, a] if v depends on the executed action."""


@overload(_typed_value, jit_options={"forceinline": True})
def _value_of(v, s, a):
    return (lambda v, s, a: v[s]) if v.ndim == 1 else (lambda v, s, a: v[s, a])


def fetch_values(transitions, v, actions, s):
    """Ask the processor to fetch the entries of v that `expectation` reads for state s. actions: see bellman.py."""


@overload(fetch_values, jit_options={"forceinline": True})
def _fetch_values(transitions, v, actions, s):
    if not is_table(transitions):
        return lambda transitions, v, actions, s: None

    def each_action(transitions, v, actions, s):
        for a in range(len(actions)):
            prefetch(v, np.int64(transitions[uint64(s), uint64(a)]))

    return each_action


@interpreted_first("states")
@kernel
def expected(transitions, x, states, out):
    """out[i, a] = the mean of x (S + 1, W, M) over what (states[i], a) leads to. W = A by executed action, or 1.

    Outcomes that are impossible do not count, whatever x says there.
    """
    by_action = x.shape[1] > 1
    out[:] = 0.0
    for i in range(len(states)):
        for a in range(out.shape[1]):
            for j in outcome_numbers(transitions, states[i], a):
                t, p = outcome(transitions, states[i], a, j)
                if p > 0.0:
                    for m in range(x.shape[2]):
                        out[i, a, m] += p * x[t, a if by_action else 0, m]


@kernel
def entries(transitions, states, actions, index, next_states, probabilities):
    """The possible outcomes of (states[i], actions[i]), in order. Returns how many there are.

    index[j] = i, next_states[j], probabilities[j]: of outcome j.
    """
    n = 0
    for i in range(len(states)):
        for k in outcome_numbers(transitions, states[i], actions[i]):
            t, p = outcome(transitions, states[i], actions[i], k)
            if p > 0.0:
                index[n], next_states[n], probabilities[n] = i, t, p
                n += 1
    return n


@interpreted_first()
@kernel
def push_forward(transitions, mass, out):
    """out (S, W) += the mass (S, A) of executed actions, moved to their next states. Mass that ends is left out."""
    by_action = out.shape[1] > 1
    for s in range(mass.shape[0]):
        for a in range(mass.shape[1]):
            if mass[s, a] != 0.0:
                for i in outcome_numbers(transitions, s, a):
                    t, p = outcome(transitions, s, a, i)
                    if t >= 0:
                        out[t, a if by_action else 0] += p * mass[s, a]


@interpreted_first("states")
@kernel
def extreme_outcomes(transitions, x, states, sign, out):
    """out[i, a] = the largest (sign 1) or smallest (-1) of x (S + 1,) over what (states[i], a) may lead to."""
    for i in range(len(states)):
        for a in range(out.shape[1]):
            best = -np.inf
            for k in outcome_numbers(transitions, states[i], a):
                best = max(best, sign * x[outcome(transitions, states[i], a, k)[0]])
            out[i, a] = sign * best


@interpreted_first("states")
@kernel
def mark_arrivals(transitions, states, out):
    """out[t, a] = True if executing a in one of `states` may lead to t."""
    for s in states:
        for a in range(out.shape[1]):
            for k in outcome_numbers(transitions, s, a):
                t, _ = outcome(transitions, s, a, k)
                if t >= 0:
                    out[t, a] = True


def drawn_outcome(transitions, s, a, u):
    """(number, probability) of the outcome of (s, a) drawn by u in [0, 1).

    That is the first outcome with which the probabilities so far are more than u, else the last possible one.
    """


@overload(drawn_outcome)
def _drawn_outcome(transitions, s, a, u):
    if is_table(transitions):
        return lambda transitions, s, a, u: (0, 1.0)

    def several(transitions, s, a, u):
        number, probability, total = 0, 0.0, 0.0
        for k in outcome_numbers(transitions, s, a):
            p = outcome(transitions, s, a, k)[1]
            if p > 0.0 and total <= u:
                number, probability = k, p
                total += p
        return number, probability

    return several


@kernel
def drawn(transitions, s, a, u):
    """The next state of (s, a), -1 for the end, drawn by u in [0, 1). Probabilities need not sum to 1."""
    total = 0.0
    for k in outcome_numbers(transitions, s, a):
        total += outcome(transitions, s, a, k)[1]
    return np.int64(outcome(transitions, s, a, drawn_outcome(transitions, s, a, u * total)[0])[0])


@kernel
def draw(transitions, states, actions, u, out):
    """out[i] = the next state of (states[i], actions[i]) drawn by u[i], as by `drawn`."""
    for i in range(len(states)):
        out[i] = drawn(transitions, states[i], actions[i], u[i])


@interpreted_first()
@kernel
def have_one_outcome(transitions):
    """Whether every (s, a) has one outcome, of probability 1."""
    num_states, num_actions = size_of(transitions)
    for s in range(num_states):
        for a in range(num_actions):
            for i in outcome_numbers(transitions, s, a):
                chance = outcome(transitions, s, a, i)[1]
                if chance != 1.0 and chance != 0.0:  # rows sum to 1 up to a tolerance: a second one may be small
                    return False
    return True


# Palettes -------------------------------------------------------------------------------------------------------------


_SEED = uint64(0x9E3779B97F4A7C15)


@kernel
def possible(successors, bits, num_actions, out, out_bits, counts):
    """Write the possible outcomes of some states one after another. Returns how many there are, N.

    successors (rows, A K), bits (rows, A K): of all outcomes. out, out_bits (at least N,): of the possible ones. counts
    (rows * A,): possible outcomes of each row.
    """
    rows, branches = successors.shape
    num_outcomes = branches // num_actions
    n = 0
    for i in range(rows):
        for a in range(num_actions):
            before = n
            for b in range(a * num_outcomes, (a + 1) * num_outcomes):
                if bits[i, b] != 0:
                    out[n], out_bits[n] = successors[i, b], bits[i, b]
                    n += 1
            counts[i * num_actions + a] = n - before
    return n


@kernel
def encode(bits, counts, first_row, first, palette, size, table, codes):
    """codes[r] = the palette's code of row r's probabilities, for the rows from `first_row` on. New ones are entered.

    bits (N,): of the probabilities. The bits of row `first_row` begin at `first`. Returns (row, first, size) of the
    first row that finds the palette full. row is len(counts) if there is none.
    """
    capacity, num_outcomes = palette.shape
    slots = table.shape[0]
    code = int64(-1)
    row = first_row
    while row < len(counts):
        n = counts[row]
        # often the same probabilities as in the last row; else probe by their hash
        if code < 0 or not _is(palette, code, bits, first, n):
            h = _SEED
            for k in range(n):
                h = mixed(h ^ bits[first + k])
            slot = slot_of(h, slots)
            while True:
                code = int64(table[slot])
                if code < 0 or _is(palette, code, bits, first, n):
                    break
                slot = slot + 1 if slot + 1 < slots else 0
            if code < 0:
                # probabilities that the palette lacks: enter them, padded by zeros
                if size == capacity:
                    return row, first, size
                code = size
                for k in range(n):
                    palette[code, k] = bits[first + k]
                for k in range(n, num_outcomes):
                    palette[code, k] = 0
                table[slot] = code
                size += 1
        codes[row] = code
        first += n
        row += 1
    return row, first, size


@kernel
def enter(palette, size, table):
    """Put the first `size` vectors of a palette, all different, into an empty table (every slot -1)."""
    slots = table.shape[0]
    for code in range(size):
        h = _SEED
        for k in range(palette.shape[1]):
            if palette[code, k] != 0:
                h = mixed(h ^ palette[code, k])
        slot = slot_of(h, slots)
        while table[slot] >= 0:
            slot = slot + 1 if slot + 1 < slots else 0
        table[slot] = code


@inlined
def _is(palette, code, bits, first, n):
    """Whether the entry of the palette with this code has the probabilities bits[first : first + n]."""
    if n < palette.shape[1] and palette[code, n] != 0:
        return False
    for k in range(n):
        if palette[code, k] != bits[first + k]:
            return False
    return True


@kernel
def padded(values, counts, fill_with_first, out):
    """out[r] (K,) = the values of row r, then its first value again, or zeros.

    values (N,): row after row. counts: (rows,). out: (rows, K).
    """
    first = 0
    for row in range(len(counts)):
        n = counts[row]
        padding = values[first] if fill_with_first else values[first] * 0
        for k in range(out.shape[1]):
            out[row, k] = values[first + k] if k < n else padding
        first += n
