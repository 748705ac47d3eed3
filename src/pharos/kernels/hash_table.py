"""Hash tables of states, with open addressing: find the index of a state, and number states that are new.

A state's hash names a slot; its entry is in the first slot from there that is free or holds this very state. The same
table in three forms, a section each:

In memory, the keys are not in the table: slot -> index -> states[index], so it costs 4 bytes a slot, whatever the width
of a state. -1 marks a free slot.

In a search by several processes each state has an owner, the process that its hash names, whoever finds it. An owner
has keys (capacity, W) uint64, states in the order in which it received them, and numbers (capacity,) int64: the number
of a state, or -1 - index while it waits for one, `index` being the first of the indices in the block that lead to
it. table (slots,) leads from the hash of a state to its entry, a row of keys and numbers.

On disk each entry is a whole state and its index: entries (slots, W + 1) uint64, a mapped file, holds the W words of a
state, then 1 + its index, 0 in a free slot, or NEW + j while candidate j waits for its number. Memory is read and
written in order of slots: many candidates are first sorted by the 16 highest bits of their hash, their bucket, which
are the highest bits of their slot in a table of any size. keys (M, W) uint64: candidates. indices (M,) int64: -1 -
bucket, or an index if it is known. order (M,) int32: candidates that are looked up, by bucket, each bucket in the order
of candidates.

The last section packs states into words and unpacks them a few at a time, whereas NumPy (rules/layout.py) would take a
call for each component.
"""

from typing import Any

import numba.extending
import numpy as np
from llvmlite import ir
from numba import int64, types, uint64
from numba.core import cgutils

from pharos.kernels.interpreted import in_python, interpreted_first
from pharos.kernels.kernel_cache import inlined, kernel

intrinsic: Any = numba.extending.intrinsic  # whose types would hide those of the functions that it makes
_BATCH = 32  # states whose slots are fetched from memory at the same time

# Fields of `progress`, (5,) int64, of a breadth-first search: states expanded; states numbered; states up to the end of
# the current level; levels finished; 0, or what is at fault: 1 + a component, D + 2 for a probability or an age.
FIRST, COUNT, LEVEL_END, DEPTH, FAULT = range(5)


@in_python(lambda array, index: None)
@intrinsic
def prefetch(typing_context, array, index):
    """Ask the processor to fetch array[index] (first axis, C order), which will be read soon."""

    def codegen(context, builder, sig, args):
        array = context.make_array(sig.args[0])(context, builder, args[0])
        stride = cgutils.unpack_tuple(builder, array.strides)[0]
        base = builder.bitcast(array.data, ir.IntType(8).as_pointer())
        address = builder.gep(base, [builder.mul(args[1], stride)])
        i32 = ir.IntType(32)
        function_type = ir.FunctionType(ir.VoidType(), [address.type, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch.p0")
        builder.call(function, [address, i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), codegen


def _entry(context, builder, array_type, array, index):
    array = context.make_array(array_type)(context, builder, array)
    return builder.gep(array.data, [index])


@in_python(lambda table, slot: int(table[slot]))
@intrinsic
def entry_at(typing_context, table, slot):
    """table[slot], by an acquiring load: all that another thread wrote before it published the entry is visible."""

    def codegen(context, builder, sig, args):
        address = _entry(context, builder, sig.args[0], *args)
        value = builder.load_atomic(address, "acquire", sig.args[0].dtype.bitwidth // 8)
        return context.cast(builder, value, sig.args[0].dtype, types.int64)

    return types.int64(table, types.int64), codegen


@in_python(lambda table, slot, index: table.__setitem__(slot, index))
@intrinsic
def store_released(typing_context, table, slot, index):
    """Set table[slot] = index by a releasing store: threads that read it by `entry_at` see all earlier writes."""

    def codegen(context, builder, sig, args):
        address = _entry(context, builder, sig.args[0], *args[:2])
        value = context.cast(builder, args[2], types.int64, sig.args[0].dtype)
        builder.store_atomic(value, address, "release", sig.args[0].dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(table, types.int64, types.int64), codegen


@inlined
def mixed(h):
    """A 64-bit mixer (two rounds of multiply and xor-shift): every input bit reaches the high bits of the result."""
    h ^= h >> uint64(32)
    h *= uint64(0x9E3779B97F4A7C15)
    h ^= h >> uint64(29)
    h *= uint64(0xD6E8FEB86659FD93)
    return h


@inlined
def slot_of(h, capacity):
    """The slot of hash h in a table of `capacity` slots, a multiple of 65536 below 2^40: floor(h / 2^64 * capacity)."""
    return int64(((h >> uint64(24)) * (uint64(capacity) >> uint64(16))) >> uint64(24))


@inlined
def hash_of_row(states, i):
    """The hash of states[i], a row of words."""
    h = mixed(states[i, 0])
    for k in range(1, states.shape[1]):
        h = mixed(h ^ states[i, k])
    return h


@interpreted_first("count")
@kernel
def fill(table, states, count):
    """Put states [0, count), all different, into an empty table (every slot -1)."""
    capacity = table.shape[0]
    slots = np.empty(_BATCH, np.int64)
    for first in range(0, count, _BATCH):
        n = min(_BATCH, count - first)
        # hash a batch and fetch its slots, so that the processor waits for all of them at once
        for i in range(n):
            slots[i] = slot_of(hash_of_row(states, first + i), capacity)
            prefetch(table, slots[i])
        # put each state into the first free slot from its own
        for i in range(n):
            slot = slots[i]
            while table[slot] >= 0:
                slot = slot + 1 if slot + 1 < capacity else 0
            table[slot] = first + i


@kernel
def fill_range(table, states, count, low, high, left_over):
    """Put the states whose slots are in [low, high) into a table: threads fill disjoint ranges of one table.

    Returns the number of states that found no free slot before `high`, and puts their indices into left_over, as many
    as fit.
    """
    capacity = table.shape[0]
    slots = np.empty(2 * _BATCH, np.int64)
    indices = np.empty(2 * _BATCH, np.int64)
    n, over = 0, 0
    for first in range(0, count, _BATCH):
        stop = min(first + _BATCH, count)
        # collect the states of this range; n only grows if the slot is in it
        for i in range(first, stop):
            slots[n] = slot_of(hash_of_row(states, i), capacity)
            indices[n] = i
            n += low <= slots[n] < high
        # wait until a batch is full, or the states end
        if n < _BATCH and stop < count:
            continue
        for i in range(n):
            prefetch(table, slots[i])
        # put each into the first free slot before `high`, else note that it is left over
        for i in range(n):
            slot = slots[i]
            while slot < high and table[slot] >= 0:
                slot += 1
            if slot < high:
                table[slot] = indices[i]
            else:
                if over < len(left_over):
                    left_over[over] = indices[i]
                over += 1
        n = 0
    return over


@kernel
def fill_more(table, states, indices):
    """Put states[indices] into a table, none of which is there yet."""
    capacity = table.shape[0]
    for index in indices:
        slot = slot_of(hash_of_row(states, index), capacity)
        while table[slot] >= 0:
            slot = slot + 1 if slot + 1 < capacity else 0
        table[slot] = index


@interpreted_first("keys")
@kernel
def find_states(table, states, keys, out):
    """out[j] = index of keys[j] among the states, or -1. keys (N, W) uint64."""
    capacity = table.shape[0]
    words = states.shape[1]
    for j in range(len(keys)):
        slot = slot_of(hash_of_row(keys, j), capacity)
        out[j] = -1
        # probe until the same state or a free slot
        while table[slot] >= 0:
            index = int64(table[slot])
            equal = True
            for k in range(words):
                equal = equal and states[index, k] == keys[j, k]
            if equal:
                out[j] = index
                break
            slot = slot + 1 if slot + 1 < capacity else 0


@interpreted_first("keys")
@kernel
def slots_of(keys, capacity, out):
    """out[j] = the slot in a table of `capacity` slots from which to search for keys[j]."""
    for j in range(len(keys)):
        out[j] = slot_of(hash_of_row(keys, j), capacity)


@interpreted_first("keys")
@kernel
def insert_missing(table, states, keys, indices, successors, progress):
    """Number the successors that threads did not find, in order: the serial half of expanding a wide frontier.

    keys (rows * A, W): the successors. indices (rows * A,): index, or -1 - slot from which to search on. Row i belongs
    to state progress[FIRST] + i. successors (rows, A) gets the indices. `progress` goes on by these rows.
    """
    first, count, level_end, depth = progress[FIRST], progress[COUNT], progress[LEVEL_END], progress[DEPTH]
    capacity = table.shape[0]
    words = states.shape[1]
    rows, num_actions = successors.shape
    # slots are fetched so many successors before they are read
    lookahead = 24
    for j in range(min(lookahead, rows * num_actions)):
        if indices[j] < 0:
            prefetch(table, -1 - indices[j])
    for i in range(rows):
        for a in range(num_actions):
            j = i * num_actions + a
            if j + lookahead < rows * num_actions and indices[j + lookahead] < 0:
                prefetch(table, -1 - indices[j + lookahead])
            index = indices[j]
            # search on; another successor of this block may have entered the state meanwhile
            slot = -1 - index
            while index < 0:
                index = int64(table[slot])
                # a free slot: the state is new and gets the next number
                if index < 0:
                    index = count
                    for k in range(words):
                        states[count, k] = keys[j, k]
                    store_released(table, slot, count)
                    count += 1
                    break
                # an occupied slot: compare all words, and go on to the next slot if they differ
                equal = True
                for k in range(words):
                    equal = equal and states[index, k] == keys[j, k]
                if not equal:
                    index = -1
                    slot = slot + 1 if slot + 1 < capacity else 0
            successors[i, a] = index
        # the last state of a level is expanded: the next level ends with the newest state
        if first + i + 1 == level_end:
            level_end = count
            depth += 1
    progress[FIRST], progress[COUNT], progress[LEVEL_END], progress[DEPTH] = first + rows, count, level_end, depth


# Key owner ------------------------------------------------------------------------------------------------------------


_AHEAD = 16
_OWNER_BITS = 24  # the lowest of a hash, which the slots of tables below 2^32 of them do not depend on


@kernel
def route(keys, indices, size, order, counts):
    """Sort candidates by their owners.

    keys: (M, W). indices (M,): negative if a candidate must be looked up by its owner. order (M,) int64 gets these
    candidates, the candidates of the first owner first and each owner's in their order. counts (size,) int64 gets the
    number of each owner's.
    """
    owners = np.empty(len(keys), np.int64)
    counts[:] = 0
    # the owner of each candidate, by the lowest bits of its hash
    for j in range(len(keys)):
        if indices[j] < 0:
            low = hash_of_row(keys, j) & uint64((1 << _OWNER_BITS) - 1)
            owners[j] = int64((low * uint64(size)) >> uint64(_OWNER_BITS))
            counts[owners[j]] += 1
    # counting sort: owner o begins behind all smaller owners
    next_index = np.zeros(size, np.int64)
    for owner in range(1, size):
        next_index[owner] = next_index[owner - 1] + counts[owner - 1]
    for j in range(len(keys)):
        if indices[j] < 0:
            order[next_index[owners[j]]] = j
            next_index[owners[j]] += 1


@kernel
def claim_entries(table, keys, numbers, count, candidates, indices, entries):
    """Find the entry of each candidate that this owner is asked for, and make one for each that is new.

    candidates (N, W), indices (N,): states and their indices in the block. entries (N,) int64 gets their entries. Of
    the indices that lead to a new state the first is kept, whatever the order in which they come. Returns the number of
    entries.
    """
    capacity, words = table.shape[0], keys.shape[1]
    for j in range(len(candidates)):
        if j + _AHEAD < len(candidates):
            prefetch(table, slot_of(hash_of_row(candidates, j + _AHEAD), capacity))
        slot = slot_of(hash_of_row(candidates, j), capacity)
        while True:
            entry = int64(table[slot])
            # a free slot: the state is new and waits for its number
            if entry < 0:
                entry = count
                for k in range(words):
                    keys[count, k] = candidates[j, k]
                numbers[count] = -1 - indices[j]
                table[slot] = count
                count += 1
                break
            # an occupied slot: a match without a number yet keeps the smallest index
            equal = True
            for k in range(words):
                equal = equal and keys[entry, k] == candidates[j, k]
            if equal:
                if numbers[entry] < 0:
                    numbers[entry] = max(numbers[entry], -1 - indices[j])
                break
            slot = slot + 1 if slot + 1 < capacity else 0
        entries[j] = entry
    return count


# On disk --------------------------------------------------------------------------------------------------------------


BUCKETS = 1 << 16
_FEW = 1 << 12  # candidates that are not worth sorting
_NEW = uint64(1 << 63)


@inlined
def _slot_for(entries, keys, j):
    """(slot, its entry) of keys[j]: its slot, or the free one in which it belongs, whose entry is 0."""
    capacity, words = entries.shape[0], keys.shape[1]
    slot = slot_of(hash_of_row(keys, j), capacity)
    while True:
        entry = entries[slot, words]
        if entry == 0:
            return slot, entry
        equal = True
        for k in range(words):
            equal = equal and entries[slot, k] == keys[j, k]
        if equal:
            return slot, entry
        slot = slot + 1 if slot + 1 < capacity else 0


@inlined
def _enter(entries, slot, keys, j, entry):
    """Put keys[j] and its `entry`, the last word, into a slot."""
    words = keys.shape[1]
    for k in range(words):
        entries[slot, k] = keys[j, k]
    entries[slot, words] = entry


@kernel
def sort_by_bucket(indices, first, order):
    """Fill order (M,) with the candidates to look up, sorted by bucket. Returns their number.

    indices[j] >= 0, a state in this block that leads to itself, gets its index: first + indices[j].
    """
    size = 0
    # few candidates are looked up in the order in which they come
    if len(indices) <= _FEW:
        for j in range(len(indices)):
            if indices[j] >= 0:
                indices[j] += first
            else:
                order[size] = j
                size += 1
        return size
    # counting sort by bucket: sizes, then the beginning of each bucket, then the candidates
    next_index = np.zeros(BUCKETS + 1, np.int64)
    for j in range(len(indices)):
        if indices[j] >= 0:
            indices[j] += first
        else:
            next_index[-indices[j]] += 1
            size += 1
    for bucket in range(BUCKETS):
        next_index[bucket + 1] += next_index[bucket]
    for j in range(len(indices)):
        if indices[j] < 0:
            bucket = -1 - indices[j]
            order[next_index[bucket]] = j
            next_index[bucket] += 1
    return size


@kernel
def look_up(entries, keys, order, low, high, indices, slots):
    """Look up candidates order[low:high], entering those that are new.

    indices[j] becomes the index of candidate j. It is -1 if it is new, slots[j] then being its slot, and -2 - i if it
    equals the earlier candidate i, which is new.
    """
    capacity = entries.shape[0]
    for p in range(low, high):
        if p + _AHEAD < high:
            prefetch(entries, slot_of(hash_of_row(keys, order[p + _AHEAD]), capacity))
        j = order[p]
        slot, entry = _slot_for(entries, keys, j)
        slots[j] = -1
        # a new state's entry names this candidate until states are numbered
        if entry == 0:
            _enter(entries, slot, keys, j, _NEW | uint64(j))
            indices[j] = -1
            slots[j] = slot
        elif entry & _NEW:
            indices[j] = -2 - int64(entry ^ _NEW)
        else:
            indices[j] = int64(entry) - 1


@kernel
def number_states(keys, indices, successors, states, appended, progress):
    """Number new states in the order of candidates, and write them to states[count - appended :].

    indices (M,): as `look_up` leaves them. Row i of successors (rows, A) belongs to state progress[FIRST] + i;
    `progress` goes on by these rows.
    """
    first, count, level_end, depth = progress[FIRST], progress[COUNT], progress[LEVEL_END], progress[DEPTH]
    rows, num_actions = successors.shape
    for i in range(rows):
        for a in range(num_actions):
            j = i * num_actions + a
            # a new state takes the next number; a copy of an earlier candidate takes that one's
            if indices[j] == -1:
                for k in range(keys.shape[1]):
                    states[count - appended, k] = keys[j, k]
                indices[j] = count
                count += 1
            elif indices[j] < 0:
                indices[j] = indices[-2 - indices[j]]  # an earlier candidate
            successors[i, a] = indices[j]
        # the last state of a level is expanded: the next level ends with the newest state
        if first + i + 1 == level_end:
            level_end = count
            depth += 1
    progress[FIRST], progress[COUNT], progress[LEVEL_END], progress[DEPTH] = first + rows, count, level_end, depth


@kernel
def assign_numbers(entries, order, low, high, indices, slots):
    """Replace the provisional entries of new candidates order[low:high] by their numbers."""
    words = entries.shape[1] - 1
    for p in range(low, high):
        j = order[p]
        if slots[j] >= 0:
            entries[slots[j], words] = uint64(indices[j] + 1)


@kernel
def place(entries, keys, order, low, high, first):
    """Put states order[low:high] of keys, not there yet, into the table. State j has index first + j."""
    for p in range(low, high):
        j = order[p]
        slot, _ = _slot_for(entries, keys, j)
        _enter(entries, slot, keys, j, uint64(first + j + 1))


@kernel
def place_from_memory(entries, table, states, low, high):
    """Copy the states in slots [low, high) of a table in memory into an empty table on disk."""
    for i in range(low, high):
        if i + _AHEAD < high and table[i + _AHEAD] >= 0:
            prefetch(states, int64(table[i + _AHEAD]))
        index = int64(table[i])
        if index >= 0:
            slot, _ = _slot_for(entries, states, index)
            _enter(entries, slot, states, index, uint64(index + 1))


@kernel
def place_again(entries, old, low, high):
    """Copy the entries in slots [low, high) of an old table into a larger one."""
    words = old.shape[1] - 1
    keys = old[:, :words]
    for i in range(low, high):
        if old[i, words] > 0:
            slot, _ = _slot_for(entries, keys, i)
            _enter(entries, slot, keys, i, old[i, words])
