"""Partitions of states: equal rows get equal numbers, and classes split by the classes that their members lead to.

Exact: hashes only narrow the search, and rows are compared entry by entry. `slots` is a hash table of at least twice as
many entries as rows, -1 if empty, that is empty again after each call.

Under transition probabilities classes split by the probabilities of reaching classes, into the coarsest stable
partition. Rows form a sparse matrix, row s A + a of state s and action a. Columns from S on are no state. Two
rows are equal if they reach every class with the same probability, rounded to 2^-40, so that the order of additions
does not matter. Members of a class lie side by side in `elements`. Of the groups into which it falls the largest keeps
its number, and only states that lead to a class with a new number are looked at again, the candidates of the next
round: a state is renumbered at most log2(S) times. Source: Hopcroft (1971); Valmari and Franceschinis (2010), "Simple
O(m log n) time Markov chain lumping".
"""

import numpy as np
from numba import uint64

from pharos.kernels.hash_table import mixed
from pharos.kernels.kernel_cache import kernel


@kernel
def number_rows(rows, before, slots, numbers):
    """numbers[i] = the same for equal pairs (before[i], rows[i]), counted in the order of appearance. Returns how many.

    rows: (N, W) uint8. before, numbers: (N,) int64.
    """
    mask = len(slots) - 1
    count = 0
    for i in range(len(rows)):
        # hash of the pair (before[i], rows[i])
        h = mixed(uint64(before[i]))
        for j in range(rows.shape[1]):
            h = (h ^ uint64(rows[i, j])) * uint64(0x100000001B3)
        h = mixed(h)
        slot = np.int64(h) & mask
        # probe for an equal pair, compared byte by byte; a free slot gives a new number
        while True:
            other = slots[slot]
            if other < 0:
                slots[slot] = i
                numbers[i] = count
                count += 1
                break
            same = before[other] == before[i]
            for j in range(rows.shape[1]):
                if not same:
                    break
                same = rows[other, j] == rows[i, j]
            if same:
                numbers[i] = numbers[other]
                break
            slot = (slot + 1) & mask
    slots[:] = -1
    return count


def numbered_rows(rows, before=None):
    """((N,) int64, how many): equal rows (N, ...) get equal numbers, in the order in which they appear first.

    before (N,) int64: rows are equal only if these are, too.
    """
    rows = np.ascontiguousarray(rows)
    before = np.zeros(len(rows), np.int64) if before is None else before
    numbers = np.empty(len(rows), np.int64)
    count = number_rows(rows.view(np.uint8).reshape(len(rows), -1), before, slots_for(len(rows)), numbers)
    return numbers, count


def slots_for(rows):
    """An empty hash table for so many rows."""
    return np.full(1 << max(3, (2 * rows - 1).bit_length()), -1, np.int32 if rows < 2**31 else np.int64)


@kernel
def affected_states(next_states, changed, candidates):
    """candidates[:n] = the states with a next state that changed its class. Returns n."""
    n = 0
    for s in range(len(next_states)):
        for a in range(next_states.shape[1]):
            t = next_states[s, a]
            if t >= 0 and changed[t]:
                candidates[n] = s
                n += 1
                break
    return n


@kernel
def split_classes(next_states, classes, sizes, count, candidates, n, slots, used, new, changed):
    """Split classes by the classes that the candidates lead to. Returns the number of classes.

    Members that are no candidates lead to what their class led to before, and keep its number. So does the first group
    if all members are candidates. classes (S,), sizes (S,) members of each class. candidates (S,), of which the first n
    count. used, new (S,) scratch. changed (S,) bool: whether the class changed.
    """
    mask = len(slots) - 1
    num_actions = next_states.shape[1]
    changed[:] = False
    # candidates of each class
    num_candidates = np.zeros(count, np.int32)
    for i in range(n):
        num_candidates[classes[candidates[i]]] += 1
    for i in range(n):
        s = candidates[i]
        # signature of s: its class and the classes of its successors; its hash names a slot
        h = mixed(uint64(classes[s]))
        for a in range(num_actions):
            t = next_states[s, a]
            h = mixed(h ^ uint64(classes[t] if t >= 0 else -1))
        slot = np.int64(h) & mask
        while True:
            index = slots[slot]
            # a new signature: its group keeps the number of the class, or gets a new one
            if index < 0:
                slots[slot] = i
                used[i] = slot
                c = classes[s]
                if num_candidates[c] == sizes[c]:  # no other member, and this is the first group
                    num_candidates[c] = -1
                    new[i] = c
                else:
                    new[i] = count
                    count += 1
                break
            # a signature in this slot: s joins its group if all classes agree
            other = candidates[index]
            same = classes[other] == classes[s]
            for a in range(num_actions):
                if not same:
                    break
                t, u = next_states[s, a], next_states[other, a]
                same = (classes[t] if t >= 0 else -1) == (classes[u] if u >= 0 else -1)
            if same:
                used[i] = slot
                new[i] = new[index]
                break
            slot = (slot + 1) & mask
    # empty the slots, and renumber the states of new groups
    for i in range(n):
        slots[used[i]] = -1
        s = candidates[i]
        if new[i] != classes[s]:
            sizes[classes[s]] -= 1
            sizes[new[i]] += 1
            classes[s] = new[i]
            changed[s] = True
    return count


# Transition probabilities ---------------------------------------------------------------------------------------------


# Probabilities are compared in these units.
UNITS = 2.0**40


@kernel
def predecessors(first, column, num_actions, edges, states):
    """states[edges[t]:edges[t + 1]] = the states that some action may lead to t.

    edges (S + 1,), states (outcomes,). A counting sort, in which a state appears once for each outcome that leads to t.
    """
    size = len(edges) - 1
    edges[:] = 0
    # how many outcomes lead to each state, and the beginning of its predecessors
    for k in range(len(column)):
        if column[k] < size:
            edges[column[k] + 1] += 1
    for t in range(size):
        edges[t + 1] += edges[t]
    # fill; edges[t] moves to the end of t, and is moved back by one place
    for s in range(size):
        for k in range(first[s * num_actions], first[(s + 1) * num_actions]):
            t = column[k]
            if t < size:
                states[edges[t]] = s
                edges[t] += 1
    for t in range(size, 0, -1):
        edges[t] = edges[t - 1]
    edges[0] = 0


@kernel
def _class_probabilities(matrix, row, classes, mass, keys):
    """mass[c] = the probability of reaching class c, for the c in keys[:result]. mass is 0 before."""
    first, column, weight = matrix
    n = 0
    for k in range(first[row], first[row + 1]):
        if column[k] < len(classes):
            c = classes[column[k]]
            if mass[c] == 0.0:
                keys[n] = c
                n += 1
            mass[c] += weight[k]
    return n


@kernel
def _hash(matrix, num_actions, s, classes, mass, keys):
    """A hash of the rows of s: equal for states with equal rows, in whatever order they name classes."""
    result = uint64(num_actions)
    for row in range(s * num_actions, (s + 1) * num_actions):
        total = uint64(0)
        for i in range(_class_probabilities(matrix, row, classes, mass, keys)):
            units = np.int64(np.rint(mass[keys[i]] * UNITS))
            if units > 0:
                total += mixed(mixed(uint64(keys[i])) ^ uint64(units))
            mass[keys[i]] = 0.0
        result = mixed(result ^ total)
    return result


@kernel
def _have_equal_rows(matrix, num_actions, s, other, classes, mass, keys, mass_of_other, keys_of_other):
    """Whether states s and `other` reach every class with the same probability under each action."""
    for a in range(num_actions):
        n = _class_probabilities(matrix, s * num_actions + a, classes, mass, keys)
        m = _class_probabilities(matrix, other * num_actions + a, classes, mass_of_other, keys_of_other)
        same = True
        for i in range(n):
            same = same and np.rint(mass[keys[i]] * UNITS) == np.rint(mass_of_other[keys[i]] * UNITS)
        for i in range(m):
            c = keys_of_other[i]
            same = same and np.rint(mass[c] * UNITS) == np.rint(mass_of_other[c] * UNITS)
        mass[keys[:n]] = 0.0
        mass_of_other[keys_of_other[:m]] = 0.0
        if not same:
            return False
    return True


@kernel
def refine(matrix, num_actions, into, classes, layout, slots):
    """Split classes (S,), numbered from 0 without gaps, until nothing splits. Returns the number of rounds.

    The last round splits nothing. into: `predecessors`. layout: elements, index, begin, sizes, (S,) each, and slots, a
    power of 2 of at least 2 S that are all -1: scratch.
    """
    size, kind = len(classes), classes.dtype
    count = _lay_out(classes, layout)
    candidates, touched, num_candidates = np.arange(size).astype(kind), np.empty(size, kind), np.zeros(size, kind)
    renumbered, number = np.empty(size, kind), np.empty(size, kind)
    rows = (np.zeros(size), np.empty(size, kind), np.zeros(size), np.empty(size, kind))
    groups = (np.empty(size, kind), np.empty(size, kind), np.empty(size, np.uint64), slots, np.empty(size, kind))
    group_sizes = np.empty(size, kind)
    is_candidate = np.zeros(size, np.bool_)
    n, rounds = size, 0
    while True:
        rounds += 1
        # group the candidates of each class by their rows, and split classes of several groups
        num_touched = _move_to_front(candidates, n, classes, layout, num_candidates, touched)
        changed = 0
        for i in range(num_touched):
            c = touched[i]
            k, num_candidates[c] = num_candidates[c], 0
            if layout[3][c] > 1:
                num_groups = _group_members(matrix, num_actions, c, k, classes, layout, groups, group_sizes, rows)
                if num_groups > 1:
                    count, changed = _split(
                        c, k, num_groups, count, layout, groups, group_sizes, renumbered, number, changed
                    )
        if changed == 0:
            return rounds
        n = 0
        edges, states = into
        # renumber, and collect the predecessors of renumbered states for the next round
        for i in range(changed):  # last: all rows of a round are in terms of the classes before it
            s = renumbered[i]
            classes[s] = number[i]
            for k in range(edges[s], edges[s + 1]):
                if not is_candidate[states[k]]:
                    is_candidate[states[k]] = True
                    candidates[n] = states[k]
                    n += 1
        for i in range(n):
            is_candidate[candidates[i]] = False


@kernel
def _move_to_front(candidates, n, classes, layout, num_candidates, touched):
    """Move the candidates to the front of their class, num_candidates[c] of them. Returns how many classes have some.

    touched (S,): its first entries are these classes.
    """
    elements, index, begin, _ = layout
    num_touched = 0
    for i in range(n):
        s = candidates[i]
        c = classes[s]
        if num_candidates[c] == 0:
            touched[num_touched] = c
            num_touched += 1
        front, current = begin[c] + num_candidates[c], index[s]
        t = elements[front]
        elements[front], elements[current] = s, t
        index[s], index[t] = front, current
        num_candidates[c] += 1
    return num_touched


@kernel
def _group_members(matrix, num_actions, c, k, classes, layout, groups, group_sizes, rows):
    """group[j] of the first k members of class c, the candidates, by equal rows. Returns how many groups.

    The others lead to what they led to before: one of them stands for all, and opens group 0.
    """
    elements, _, begin, sizes = layout
    group, member, hashes, slots, used = groups
    mask = len(slots) - 1
    num_groups = 0
    # j = -1: the member that stands for all that are no candidates
    for j in range(-1 if k < sizes[c] else 0, k):
        s = elements[begin[c] + (k if j < 0 else j)]
        h = _hash(matrix, num_actions, s, classes, rows[0], rows[1])
        slot = np.int64(h) & mask
        # probe for a group with the same hash and equal rows; a free slot opens a group
        while True:
            g = slots[slot]
            if g < 0:
                g = num_groups
                slots[slot] = g
                used[g], hashes[g], member[g], group_sizes[g] = slot, h, s, 0
                num_groups += 1
                break
            if hashes[g] == h and _have_equal_rows(matrix, num_actions, s, member[g], classes, *rows):
                break
            slot = (slot + 1) & mask
        if j >= 0:
            group[j] = g
        group_sizes[g] += 1 if j >= 0 else sizes[c] - k
    # empty the slots that were used
    for g in range(num_groups):
        slots[used[g]] = -1
    return num_groups


@kernel
def _split(c, k, num_groups, count, layout, groups, group_sizes, renumbered, number, changed):
    """Lay the groups of class c side by side and renumber all but the largest. Returns (classes, renumbered states).

    Group 0 comes last, beside the members that are no candidates.
    """
    elements, index, begin, sizes = layout
    group, ends, _, _, states = groups
    # the beginning of each group, and which one is the largest
    largest, at = 0, begin[c]
    for g in range(num_groups - 1, -1, -1):
        ends[g] = at
        at += group_sizes[g]
        if group_sizes[g] > group_sizes[largest]:
            largest = g
    # move the candidates to their groups
    states[:k] = elements[begin[c] : begin[c] + k]
    for j in range(k):
        s = states[j]
        elements[ends[group[j]]], index[s] = s, ends[group[j]]
        ends[group[j]] += 1
    # new numbers: the largest group keeps c, each other gets the next one
    at = begin[c]
    for g in range(num_groups - 1, -1, -1):
        new = c
        if g != largest:
            new = count
            count += 1
            for j in range(at, at + group_sizes[g]):
                renumbered[changed], number[changed] = elements[j], new
                changed += 1
        begin[new], sizes[new] = at, group_sizes[g]
        at += group_sizes[g]
    return count, changed


@kernel
def _lay_out(classes, layout):
    """Lay the members of each class side by side. Returns the number of classes.

    elements[begin[c]:begin[c] + sizes[c]]: the members of class c. s is at index[s].
    """
    elements, index, begin, sizes = layout
    count = 0
    sizes[:] = 0
    for s in range(len(classes)):
        sizes[classes[s]] += 1
        count = max(count, classes[s] + 1)
    at = 0
    for c in range(count):
        begin[c] = at
        at += sizes[c]
    for s in range(len(classes)):
        index[s] = begin[classes[s]]
        elements[index[s]] = s
        begin[classes[s]] += 1
    for c in range(count):
        begin[c] -= sizes[c]
    return count
