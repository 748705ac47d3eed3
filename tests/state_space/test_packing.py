"""Integer vectors <-> packed states: the layout of docs/format.md, its twin in Python integers, and the compiled
view."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import strategies as st
from numba import njit

from pharos.environments import Components
from pharos.errors import ParameterError
from pharos.kernels.hash_table import fill, fill_more, fill_range, find_states, mixed, slot_of
from pharos.rules.layout import AT_ONCE, layout_of, pack_states, unpack_states
from pharos.rules.packed_view import fault, get_word, packed_view, set_word
from strategies import examples

sizes = st.sampled_from([1, 2, 3, 4, 5, 8, 9, 64, 255, 256, 257, 2**31, 2**32, 2**32 + 1, 2**62, 2**63 - 1])
ranges = st.lists(st.tuples(st.integers(-(2**62), 0), sizes), min_size=1, max_size=30)


def components_of(ranges) -> Components:
    low, size = (np.array(column, np.int64) for column in zip(*ranges, strict=True))
    return Components(tuple(f"x{i}" for i in range(len(ranges))), {}, low, size)


def states_of(components: Components, seed: int, rows: int = 20) -> np.ndarray:
    rng = np.random.default_rng(seed)
    states = components.low + rng.integers(0, components.size, (rows, len(components)))
    return np.concatenate([states, [components.low, components.high]])


def packed_by_hand(components: Components, state) -> list[int]:
    """The words of one state: the fields one after the other from the lowest bit; one that does not fit starts a new
    word."""
    words, used = [0], 0
    for value, low, size in zip(state, components.low, components.size, strict=True):
        bits = len(bin(int(size) - 1)) - 2 if size > 1 else 0
        if used + bits > 64:
            words.append(0)
            used = 0
        words[-1] += (int(value) - int(low)) << used
        used += bits
    return words


@examples(200, ranges, st.integers(0, 2**32))
def test_packing_is_what_the_format_says(ranges, seed):
    components = components_of(ranges)
    layout, states = layout_of(components), states_of(components, seed)
    assert pack_states(layout, states).tolist() == [packed_by_hand(components, state) for state in states]


@examples(200, ranges, st.integers(0, 2**32))
def test_unpacking_gives_back_what_was_packed(ranges, seed):
    components = components_of(ranges)
    layout, states = layout_of(components), states_of(components, seed)
    assert (unpack_states(layout, pack_states(layout, states)) == states).all()
    many = np.tile(states, (AT_ONCE * len(ranges) // len(states) + 1, 1))  # component by component
    assert (unpack_states(layout, pack_states(layout, many)) == many).all()


def test_a_component_never_straddles_two_words():
    layout = layout_of(components_of([(0, 2**40), (0, 2**24), (0, 2), (0, 2**63 - 1), (0, 1), (0, 2)]))
    assert layout.word.tolist() == [0, 0, 1, 1, 1, 2]
    assert layout.shift.tolist() == [0, 40, 0, 1, 0, 0]
    assert layout.num_words == 3


def test_a_component_with_one_value_takes_no_bits():
    layout = layout_of(components_of([(7, 1), (-3, 1), (0, 2)]))
    assert layout.num_words == 1
    assert pack_states(layout, np.array([[7, -3, 1]])).tolist() == [[1]]
    assert unpack_states(layout, np.array([[1]], np.uint64)).tolist() == [[7, -3, 1]]


# The compiled view ---------------------------------------------------------------------------------------------------

WORDS = (0, 0, 0, 0)


@njit
def copy_through_views(layout, packed, index, value):
    """Read every component of `packed` and write it to another view, then view[index] = value; the words and the
    fault."""
    source, target = packed_view(WORDS, *layout), packed_view(WORDS, *layout)
    for k in range(len(packed)):
        set_word(source, k, packed[k])
    for i in range(len(source)):
        target[i] = source[i]
    target[index] = value
    words = np.empty(len(packed), np.uint64)
    for k in range(len(packed)):
        words[k] = get_word(target, k)
    return words, fault(target), fault(source)


@njit
def read_component(layout, packed, index):
    view = packed_view(WORDS, *layout)
    for k in range(len(packed)):
        set_word(view, k, packed[k])
    return view[index], fault(view)


few = st.lists(
    st.tuples(st.integers(-(2**62), 0), st.sampled_from([1, 2, 3, 9, 256, 2**31, 2**62])), min_size=1, max_size=4
)


@pytest.mark.long
@examples(200, few, st.integers(0, 2**32), st.data())
def test_the_compiled_view_reads_and_writes_components(ranges, seed, data):
    components = components_of(ranges)
    layout, state = layout_of(components), states_of(components, seed, 1)[0].tolist()
    packed = pack_states(layout, np.array([state]))[0]
    index = data.draw(st.integers(-len(state), len(state) - 1))
    value = data.draw(st.integers(int(components.low[index]), int(components.high[index])))
    assert read_component(layout.tables, packed, index) == (state[index], 0)
    words, found, source = copy_through_views(layout.tables, packed, index, value)
    state[index] = value
    assert words.tolist() == pack_states(layout, np.array([state]))[0].tolist()
    assert (found, source) == (0, 0)


@pytest.mark.long
@examples(200, few, st.integers(0, 2**32), st.data())
def test_a_value_out_of_range_is_noted_and_leaves_the_neighbours_alone(ranges, seed, data):
    components = components_of(ranges)
    layout, state = layout_of(components), states_of(components, seed, 1)[0].tolist()
    packed = pack_states(layout, np.array([state]))[0]
    index = data.draw(st.integers(0, len(state) - 1))
    low, high = int(components.low[index]), int(components.high[index])
    value = data.draw(st.integers(-(2**63), low - 1) | st.integers(high + 1, 2**63 - 1))
    words, found, _ = copy_through_views(layout.tables, packed, index, value)
    assert found == 1 + index
    others = np.arange(len(state)) != index
    assert (unpack_states(layout, words[None])[0][others] == np.array(state)[others]).all()


@pytest.mark.parametrize("index", (3, -4, 10**9, -(10**9)))
def test_a_component_that_does_not_exist_is_noted(index):
    layout = layout_of(components_of([(0, 4), (2, 8), (-1, 3)]))
    packed = pack_states(layout, np.array([[1, 5, 0]]))[0]
    assert read_component(layout.tables, packed, index)[1] == 1 + 3
    words, found, _ = copy_through_views(layout.tables, packed, index, 1)
    assert found in (1, 1 + 3)
    assert unpack_states(layout, words[None])[0, 1:].tolist() == [5, 0]


# The table of states -------------------------------------------------------------------------------------------------


@njit
def slots(keys, capacity):
    return [slot_of(mixed(key), capacity) for key in keys]


@pytest.mark.parametrize("capacity", (1 << 16, 3 << 16, 1 << 30, (1 << 40) - (1 << 16)))
def test_slots_are_inside_of_the_table_and_spread_over_it(capacity):
    found = np.array(slots(np.arange(20_000, dtype=np.uint64), capacity))
    assert found.min() >= 0 and found.max() < capacity
    expected = 20_000 / 16
    counts = np.bincount(found * 16 // capacity, minlength=16)
    assert ((counts - expected) ** 2 / expected).sum() < 50  # chi-squared with 15 degrees of freedom


@examples(50, st.integers(1, 3), st.integers(1, 3000), st.integers(0, 2**32))
def test_what_is_in_the_table_is_found_and_nothing_else(words, count, seed):
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(0, 4000, (2 * count, words)).astype(np.uint64), axis=0)
    rng.shuffle(keys)
    states, others = keys[:count], keys[count:]
    table = np.full(1 << 16, -1, np.int32)
    fill(table, states, len(states))
    assert sorted(table[table >= 0].tolist()) == list(range(len(states)))
    out = np.empty(len(keys), np.int64)
    find_states(table, states, keys, out)
    assert out.tolist() == [*range(len(states)), *[-1] * len(others)]


def test_a_full_table_wraps_around():
    keys = np.arange(65_535, dtype=np.uint64)[:, None]
    table = np.full(1 << 16, -1, np.int32)
    fill(table, keys, len(keys))
    out = np.empty(len(keys), np.int64)
    find_states(table, keys, keys, out)
    assert (out == np.arange(len(keys))).all()


@pytest.mark.parametrize("parts", (1, 2, 3, 64))
@pytest.mark.parametrize("count", (1000, 40_000, 65_000))
def test_a_table_filled_part_by_part_holds_every_state_once(parts, count):
    keys = np.random.default_rng(count).permutation(80_000).astype(np.uint64)[:, None]
    states, others = keys[:count], keys[count:]
    table = np.full(1 << 16, -1, np.int32)
    cuts = [(1 << 16) * i // parts for i in range(parts + 1)]
    left = []
    for low, high in pairwise(cuts):
        left_over = np.empty(1 << 16, np.int64)
        over = fill_range(table, states, count, low, high, left_over)
        assert set(table[low:high][table[low:high] >= 0].tolist()).isdisjoint(left_over[:over].tolist())
        left.append(left_over[:over])
    assert parts == 1 or count < 65_000 or sum(map(len, left)) > 0  # a full part has no room for all of its states
    for indices in left:
        fill_more(table, states, indices)
    assert sorted(table[table >= 0].tolist()) == list(range(count))
    out = np.empty(len(keys), np.int64)
    find_states(table, states, keys, out)
    assert out.tolist() == [*range(count), *[-1] * len(others)]


def test_states_beyond_the_room_for_what_is_left_over_are_counted():
    states = np.arange(65_000, dtype=np.uint64)[:, None]
    table, few = np.full(1 << 16, -1, np.int32), np.empty(3, np.int64)
    left = fill_range(table, states, len(states), 0, 1 << 12, few)
    assert left > len(few)
    assert (table[: 1 << 12] >= 0).sum() + left == fill_range(
        np.full(1 << 16, 0, np.int32), states, len(states), 0, 1 << 12, np.empty(0, np.int64)
    )


def test_a_range_that_is_too_large_is_refused():
    with pytest.raises(ParameterError, match=r"2\^64 values does not fit; a range may have at most 2\^63"):
        layout_of(Components(("x",), {}, np.array([0]), np.array([2**64], object)))
