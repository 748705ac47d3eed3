"""Outcomes of actions as state spaces store them: those that are possible, row after row, and their probabilities as
codes of a palette.

Row s A + a is that of action a in state s. Probabilities are seen as their bits, uint64: 0 is an impossible outcome.
The palette (capacity, K) uint64 has the distinct rows of probabilities, the possible ones in their order, then zeros,
numbered in the order in which they are met; a table of slots finds them by their hash. K is the most outcomes of a row.
"""

from numba import int64, njit, uint64

from pharos.kernels.hash_table import mixed, slot_of

_SEED = uint64(0x9E3779B97F4A7C15)


@njit(cache=True, nogil=True)
def possible(successors, bits, num_actions, out, likely, counts):
    """Take the possible outcomes of some states: N successors to out, their bits to likely, how many each row has to
    counts.

    successors (rows, A K), bits (rows, A K); out, likely (at least N,), counts (rows * A,). Returns N.
    """
    rows, branches = successors.shape
    most = branches // num_actions
    n = 0
    for i in range(rows):
        for a in range(num_actions):
            before = n
            for b in range(a * most, (a + 1) * most):
                if bits[i, b] != 0:
                    out[n], likely[n] = successors[i, b], bits[i, b]
                    n += 1
            counts[i * num_actions + a] = n - before
    return n


@njit(cache=True, nogil=True)
def encode(likely, counts, first_row, first, palette, size, table, codes):
    """codes[r] = the number of row r's probabilities in the palette, for the rows from `first_row` on; new ones are
    entered.

    likely (N,): the row's are those from `first` on. Returns (row, first, size) of the first row that finds the palette
    full; row is len(counts) where there is none.
    """
    capacity, most = palette.shape
    slots = table.shape[0]
    code = int64(-1)
    row = first_row
    while row < len(counts):
        n = counts[row]
        if code < 0 or not _is(palette, code, likely, first, n):
            h = _SEED
            for k in range(n):
                h = mixed(h ^ likely[first + k])
            slot = slot_of(h, slots)
            while True:
                code = int64(table[slot])
                if code < 0 or _is(palette, code, likely, first, n):
                    break
                slot = slot + 1 if slot + 1 < slots else 0
            if code < 0:
                if size == capacity:
                    return row, first, size
                code = size
                for k in range(n):
                    palette[code, k] = likely[first + k]
                for k in range(n, most):
                    palette[code, k] = 0
                table[slot] = code
                size += 1
        codes[row] = code
        first += n
        row += 1
    return row, first, size


@njit(cache=True, nogil=True)
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


@njit(forceinline=True)
def _is(palette, code, likely, first, n):
    """Whether the vector of this number is that of a row of n outcomes."""
    if n < palette.shape[1] and palette[code, n] != 0:
        return False
    for k in range(n):
        if palette[code, k] != likely[first + k]:
            return False
    return True


@njit(cache=True, nogil=True)
def padded(values, counts, fill_with_first, out):
    """out[r] (K,) = the values of row r, then the first of them, or zeros.

    values (N,), counts (rows,), out (rows, K).
    """
    first = 0
    for row in range(len(counts)):
        n = counts[row]
        rest = values[first] if fill_with_first else values[first] * 0
        for k in range(out.shape[1]):
            out[row, k] = values[first + k] if k < n else rest
        first += n
