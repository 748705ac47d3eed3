"""Indices of 40 bits: what they hold, what loops and tables read of them, and the folders that hold them."""

import contextlib
import importlib
import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from test_format_page import CODE_OF_40_BITS
from test_hostile_spaces import sealed
from test_ranks import build_by_threads
from test_resuming import _build_and_die_at, build, files_of

import pharos
from children import exit_code
from pharos import hardness
from pharos.errors import StateSpaceCorrupted, StateSpaceMismatch, StateSpaceTooLarge
from pharos.interaction import GymEnv, make_vec
from pharos.mdp import OutcomeTable, Table, lazy_actions, random_actions, sticky_actions
from pharos.solvers import evaluate_policy, ranked, uniform_value, value_iteration, worst_value
from pharos.state_space import manifest as manifests
from pharos.state_space import manifest as writing
from pharos.state_space import search
from pharos.system import arrays, memory
from pharos.system.arrays import INT40, PACKED, PackedIndices, holds_end, index_blocks
from rank_threads import threads
from strategies import deterministic_mdps, examples, outcome_mdps
from worlds import ChanceWorld

EDGES = (0, 1, -1, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**39 - 1, -(2**31), -(2**39))
numbers = st.one_of(st.sampled_from(EDGES), st.integers(-(2**39), 2**39 - 1))
WORLDS = {
    "breakout": pharos.make("breakout", height=7, columns=5, brick_rows=1),  # 5,439 states
    "lake": pharos.make("frozen_lake/8x8"),
    "dense": ChanceWorld(num_positions=600, seed=3, vectors=4, possible_share=1.0, end_share=0.02),
    "ragged": ChanceWorld(num_positions=600, seed=1, vectors=0, possible_share=0.4, end_share=0.02, num_starts=5),
}


# The array ------------------------------------------------------------------------------------------------------------


@settings(max_examples=25)
@given(st.lists(numbers, min_size=1, max_size=20))
def test_entries_are_five_bytes_of_twos_complement(values):
    indices = PackedIndices.of(values)
    data = b"".join(value.to_bytes(5, "little", signed=True) for value in values)
    assert indices.packed.tobytes() == data and indices.nbytes == 5 * len(values)
    assert np.asarray(indices).tolist() == values and [int(indices[i]) for i in range(len(values))] == values
    assert holds_end(indices) == (-1 in values)


@settings(max_examples=25)
@given(hnp.arrays(np.int64, st.tuples(st.integers(1, 6), st.integers(1, 3)), elements=numbers), st.data())
def test_it_reads_like_an_array_of_64_bits(plain, data):
    indices, (rows, columns) = PackedIndices.of(plain), plain.shape
    low, high = sorted(data.draw(st.tuples(st.integers(0, rows), st.integers(0, rows))))
    some = np.array(data.draw(st.lists(st.integers(0, rows - 1))), np.int64)
    last = np.full(len(some), columns - 1)
    for where in (0, slice(low, high), (slice(low, high), 0), some, (some, last), plain[:, 0] > 0):
        assert indices[where].dtype == np.int64 and (indices[where] == plain[where]).all()
    assert (indices.shape, indices.ndim, indices.size, len(indices)) == (plain.shape, 2, plain.size, rows)
    assert (np.asarray(indices.reshape(-1)) == plain.reshape(-1)).all()
    assert (np.asarray(indices.rows(low, high)) == plain[low:high]).all()
    assert np.asarray(indices, np.float64).dtype == np.float64
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrays, "_ENTRIES_AT_ONCE", data.draw(st.integers(1, 7)))
        parts = list(index_blocks(indices))
    assert [first for first, _ in parts] == np.cumsum([0, *(len(part) for _, part in parts)])[:-1].tolist()
    assert (np.concatenate([part for _, part in parts]) == plain).all()
    indices[low:high] = plain[low:high] // 2
    plain[low:high] //= 2
    assert (np.asarray(indices) == plain).all()


def test_compiled_loops_read_it_as_they_read_an_array():
    @numba.njit
    def total(indices, pair, weights):
        result = 0
        for s in range(len(indices)):
            for a in range(indices.shape[1]):
                result += indices[numba.uint64(s), numba.uint64(a)] * weights[s] - pair[0][a]
        return result

    plain = np.array(EDGES).reshape(5, 2)
    indices, weights = PackedIndices.of(plain), np.arange(1, 6)
    packed = total(indices, (indices.reshape(-1), 1), weights)
    assert packed == int((plain * weights[:, None] - plain.reshape(-1)[:2]).sum())


# Folders --------------------------------------------------------------------------------------------------------------


def built(world, folder, limit=0, **options):
    """A state space whose successors have 40 bits from `limit` states on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "INT32_STATES", limit)
        patch.setattr(search, "CHUNK", 512)
        return build(WORLDS[world], folder, **options)


@pytest.fixture(scope="module")
def spaces(tmp_path_factory):
    """(with indices of 32 bits, with indices of 40 bits) of each world."""
    folder = tmp_path_factory.mktemp("spaces")
    found: dict = {}

    def of(world):
        if world not in found:
            narrow = build(WORLDS[world], folder / f"{world}-32", workers=1)
            found[world] = narrow, built(world, folder / f"{world}-40", workers=1)
        return found[world]

    return of


@pytest.fixture
def folder(spaces, tmp_path):
    """A copy of one with 40 bits."""
    return shutil.copytree(spaces("breakout")[1].folder, tmp_path / "space")


@pytest.mark.long
def test_a_folder_holds_five_bytes_a_successor_and_says_so(spaces):
    narrow, wide = spaces("breakout")
    entry = wide.manifest["arrays"]["successors40.bin"]
    assert (wide.manifest["format_version"], entry["dtype"], entry["bytes"]) == (3, INT40, 5 * narrow.successors.size)
    data = (wide.folder / "successors40.bin").read_bytes()
    read = [int.from_bytes(data[i : i + 5], "little") for i in range(0, len(data), 5)]
    assert read == narrow.successors.reshape(-1).tolist()
    files, others = files_of(wide.folder), files_of(narrow.folder)
    assert files.keys() - {"successors40.bin"} == others.keys() - {"successors.bin"}
    assert (files["states.bin"], files["terminal.bin"]) == (others["states.bin"], others["terminal.bin"])
    assert manifests.read_manifest(narrow.folder)["format_version"] == 1


@pytest.mark.long
def test_the_code_of_the_page_reads_them(spaces, monkeypatch):
    narrow, wide = spaces("breakout")
    monkeypatch.chdir(wide.folder)
    read: dict = {}
    exec(CODE_OF_40_BITS, read)
    assert (read["successors"] == narrow.successors.reshape(-1)).all()


@pytest.mark.parametrize("index", (-1, 5439, 2**39 - 1, -(2**39)))
def test_a_successor_that_is_no_state_is_found(index, folder):
    successors = np.fromfile(folder / "successors40.bin", PACKED)
    successors[3 * 4000 + 2] = PackedIndices.of([index]).packed[0]
    successors.tofile(folder / "successors40.bin")
    sealed(folder)
    with pytest.raises(StateSpaceCorrupted, match=f"from state 4000 to state {index}; expected 0 to 5438"):
        pharos.load(folder).successors  # noqa: B018


def test_a_folder_that_was_changed_is_refused(folder):
    path = folder / "successors40.bin"
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    with pytest.raises(StateSpaceCorrupted, match="truncated or replaced"):
        pharos.load(folder)
    path.write_bytes(data[:-1] + b"\x01")
    with pytest.raises(StateSpaceCorrupted, match="does not match its checksum"):
        pharos.load(folder)
    path.write_bytes(data)
    manifest = json.loads((folder / "manifest.json").read_text())
    for version, match in ((1, "not those of version 1"), (2, "not those of version 2"), (4, "reads versions 1 to 3")):
        writing.write_manifest(folder, {**manifest, "format_version": version})
        with pytest.raises((StateSpaceCorrupted, StateSpaceMismatch), match=match):
            pharos.load(folder)
    manifest["arrays"]["successors40.bin"]["dtype"] = "<i8"
    writing.write_manifest(folder, {**manifest})
    with pytest.raises(StateSpaceCorrupted, match=r"of type <i8; expected .* of type <i5"):
        pharos.load(folder)


def as_64_bits(folder):
    """The folder as an earlier pharos has written it."""
    manifest = json.loads((folder / "manifest.json").read_text())
    name = "building-" * ("building-successors40.bin" in manifest["arrays"]) + "successors"
    file = writing.GrowingFile(folder / f"{name}64.bin")
    file.append(np.asarray(PackedIndices(np.fromfile(folder / f"{name}40.bin", PACKED))))
    file.close()
    arrays = {key.replace("40", "64"): entry for key, entry in manifest["arrays"].items()}
    arrays[f"{name}64.bin"] = {"dtype": "<i8", **file.entry()}
    version = 2 if "outcomes" in manifest else 1
    writing.write_manifest(folder, {**manifest, "format_version": version, "arrays": arrays})
    (folder / f"{name}40.bin").unlink()


def test_folders_of_64_bits_are_read(spaces, folder):
    as_64_bits(folder)
    space = pharos.load(folder)
    assert space.successors.dtype == np.int64 and isinstance(space.successors, np.memmap)
    assert (space.successors == spaces("breakout")[0].successors).all()


@pytest.mark.long
@pytest.mark.parametrize("world", ("breakout", "dense", "ragged"))
def test_builds_that_began_with_64_bits_go_on(world, spaces, tmp_path):
    folder = tmp_path / "space"
    with pytest.raises(StateSpaceTooLarge):
        built(world, folder, max_states=300)
    as_64_bits(folder)
    build(WORLDS[world], folder)
    expected = shutil.copytree(spaces(world)[1].folder, tmp_path / "expected")
    as_64_bits(expected)
    assert files_of(folder) == files_of(expected)
    assert "successors64.bin" in files_of(folder)


# Parts ----------------------------------------------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.integers(1, 30), st.integers(1, 3), st.integers(0, 2**32), st.data())
def test_a_part_has_the_same_next_states_whatever_the_width_and_the_blocks(states, actions, seed, data):
    plain = np.random.default_rng(seed).integers(-1, states, (states, actions))
    start, stop = sorted(data.draw(st.tuples(st.integers(0, states), st.integers(0, states))))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrays, "_ENTRIES_AT_ONCE", data.draw(st.integers(1, 40)))
        patch.setattr(arrays, "INT32_STATES", data.draw(st.sampled_from([0, 2**31 - 1])))
        local, halo = Table(PackedIndices.of(plain)).part(start, stop)
    halo = halo.tolist()
    assert halo == sorted({t for row in plain[start:stop].tolist() for t in row if t >= 0 and not start <= t < stop})
    numbers = {-1: -1} | {t: t - start for t in range(start, stop)} | {t: stop - start + i for i, t in enumerate(halo)}
    expected = [[numbers[t] for t in row] for row in plain[start:stop].tolist()]
    assert np.asarray(local.next_states).tolist() == expected


# Builds ---------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@examples(
    40,
    world=st.sampled_from(sorted(WORLDS)),
    limit=st.sampled_from([0, 60, 300, 2000, 10**6]),
    stops=st.lists(st.integers(20, 6000), max_size=2),
    ranks=st.integers(0, 3),
)
def test_files_depend_on_nothing_but_the_width(spaces, world, limit, stops, ranks):
    """Widened at the start, in between or never; stopped and gone on with, by one process or by ranks."""
    narrow, wide = spaces(world)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        path = Path(folder) / "space"
        for most in stops:
            with contextlib.suppress(StateSpaceTooLarge):
                built(world, path, limit, max_states=most)
        if ranks and not (stops and manifests.read_manifest(path)["complete"]):
            patch.setattr(search, "INT32_STATES", limit)
            build_by_threads(WORLDS[world], path, ranks)
        else:
            built(world, path, limit, workers=2)
        is_wide = "successors40.bin" in files_of(path)
        assert is_wide if limit < 60 else limit < 10**6 or not is_wide
        assert files_of(path) == files_of((wide if is_wide else narrow).folder)


@pytest.mark.long
@pytest.mark.parametrize("world", ("breakout", "ragged"))
def test_a_build_that_dies_ends_in_the_same_files(world, spaces, tmp_path, monkeypatch):
    monkeypatch.setattr(search, "INT32_STATES", 200)
    monkeypatch.setattr(search, "CHUNK", 512)
    for call in range(1, 60, 4):
        exit_code(_build_and_die_at, call, WORLDS[world], tmp_path / f"space{call}")
        build(WORLDS[world], tmp_path / f"space{call}")
        found = {**files_of(tmp_path / f"space{call}"), "lock": b""}
        assert found == files_of(spaces(world)[1].folder)


# What is computed -----------------------------------------------------------------------------------------------------

CHANCES = {
    "none": lambda mdp: mdp,
    "sticky": lambda mdp: sticky_actions(mdp, 0.25),
    "random": lambda mdp: random_actions(mdp, 0.2),
    "lazy": lambda mdp: lazy_actions(mdp, 0.3),
}


def packed(mdp):
    """The same MDP, its successors in five bytes each."""
    dynamics = mdp.dynamics
    if isinstance(dynamics, Table):
        return replace(mdp, dynamics=Table(PackedIndices.of(dynamics.next_states)))
    arrays = {**dynamics.arrays(), "successors": PackedIndices.of(dynamics.successors)}
    return replace(mdp, dynamics=OutcomeTable(num_actions=mdp.num_actions, **arrays))


def refuse_to_unpack_all(monkeypatch):
    """Whoever makes one array of all successors from here on is found out."""

    def refused(self, *_, **__):
        raise AssertionError("all of the successors were unpacked")

    def some(self, where):
        assert where != slice(None) if isinstance(where, slice) else True, "all of the successors were unpacked"
        return arrays.unpacked(self.packed[where])

    monkeypatch.setattr(PackedIndices, "__array__", refused)
    monkeypatch.setattr(PackedIndices, "__getitem__", some)


def same(one, other):
    return np.array_equal(one, other, equal_nan=True)


@pytest.mark.long
@examples(
    60,
    st.one_of(deterministic_mdps(), outcome_mdps(("dense, palette", "ragged, one by one"))),
    st.sampled_from(sorted(CHANCES)),
    st.integers(0, 2**32),
)
def test_values_are_the_same_to_the_last_bit(mdp, chance, seed):
    one, other = (CHANCES[chance](each) for each in (mdp, packed(mdp)))
    rng = np.random.default_rng(seed)
    for solve in (value_iteration, worst_value, uniform_value):
        found, expected = solve(other), solve(one)
        assert same(found.v, expected.v) and same(found.q, expected.q) and found.error_bound == expected.error_bound
    actions = rng.integers(0, mdp.num_actions, mdp.num_states)
    assert same(evaluate_policy(other, actions).v, evaluate_policy(one, actions).v)
    drawn = rng.dirichlet(np.ones(mdp.num_actions), mdp.num_states)
    assert same(evaluate_policy(other, drawn).v, evaluate_policy(one, drawn).v)


@pytest.mark.long
@examples(
    60, st.one_of(deterministic_mdps(), outcome_mdps(("dense, palette", "ragged, one by one"))), st.integers(0, 2**32)
)
def test_dynamics_answer_the_same(mdp, seed):
    one, other, rng = mdp.dynamics, packed(mdp).dynamics, np.random.default_rng(seed)
    size, actions = mdp.num_states, mdp.num_actions
    assert (one.has_ends, one.is_deterministic) == (other.has_ends, other.is_deterministic)
    x, mass = rng.random((size + 1, actions)), rng.random((size, actions))
    some, chosen = rng.integers(0, size, 5), rng.integers(0, actions, 5)
    for ask in (
        lambda d: d.expected(x),
        lambda d: d.expected(x[:, 0], some),
        lambda d: d.push_forward(mass, actions),
        lambda d: d.largest(x[:, 0]),
        lambda d: d.successors_of(some),
        lambda d: d.arrivals(some),
        lambda d: d.reachable(some[:1]),
        lambda d: d.matrix().toarray(),
        lambda d: d.restricted_to(np.unique(some)).matrix().toarray(),
        lambda d: d.sample(some, chosen, np.random.default_rng(seed)),
        lambda d: getattr(d.order(~np.asarray(mdp.terminal)), "longest", -1),
        lambda d: d.components(~np.asarray(mdp.terminal), 1).order,
        lambda d: np.concatenate([np.asarray(each, float) for each in d.outcomes(some, chosen)]),
        lambda d: d.part(0, (size + 1) // 2)[0].matrix().toarray() if size > 1 else 0,
    ):
        assert same(ask(one), ask(other))
    table = one.deterministic_table()
    assert table is None or same(table, other.deterministic_table())


@pytest.mark.long
@examples(40, deterministic_mdps(), st.booleans(), st.booleans())
def test_distances_and_gaps_are_the_same(mdp, restart, is_lean):
    wide = packed(mdp)
    with pytest.MonkeyPatch.context() as patch:
        if is_lean:
            patch.setattr(importlib.import_module("pharos.hardness.diameter"), "available_memory", lambda: 0)
        one, other = (hardness.diameter(each, restart=restart) for each in (mdp, wide))
        assert (one.lower, one.upper, one.method, one.searches) == (
            other.lower,
            other.upper,
            other.method,
            other.searches,
        )
        assert hardness.start_eccentricity(mdp, restart=restart) == hardness.start_eccentricity(wide, restart=restart)
    for measure in (hardness.sum_of_reciprocal_gaps, hardness.minimal_gap):
        assert measure(mdp) == measure(wide)


@pytest.mark.long
@pytest.mark.parametrize("world", sorted(WORLDS))
def test_spaces_are_solved_and_searched_where_they_lie(world, spaces, tmp_path, monkeypatch):
    narrow, wide = spaces(world)
    refuse_to_unpack_all(monkeypatch)
    assert wide.num_states == narrow.num_states
    one, other = (pharos.load(each.folder, environment=WORLDS[world]).mdp(0.95) for each in (narrow, wide))
    assert same(one.rewards, other.rewards)
    for options in ({}, {"dtype": "float32", "tolerance": 1e-3}, {"processes": "mpi"}):
        with threads(ranked, 2):
            found, expected = value_iteration(other, **options), value_iteration(one, **options)
        assert same(found.v, expected.v) and same(found.q, expected.q), options
    kept = [value_iteration(each, values=tmp_path / f"{i}") for i, each in enumerate((one, other))]
    assert same(kept[0].v, kept[1].v)
    assert hardness.sum_of_reciprocal_gaps(other) == hardness.sum_of_reciprocal_gaps(one)
    if not narrow.has_chance:
        assert replace(hardness.diameter(other), seconds=0.0) == replace(hardness.diameter(one), seconds=0.0)


@pytest.mark.long
@pytest.mark.parametrize("world", sorted(WORLDS))
def test_steps_through_a_space_are_the_same(world, spaces):
    walks = []
    for space in spaces(world):
        rng = np.random.default_rng(0)
        vec = make_vec(space.environment, 5, space=space)
        walk = [vec.reset(seed=3)[0], *(vec.step(rng.integers(0, space.num_actions, 5))[0] for _ in range(50))]
        one = GymEnv(space.environment, space=space, time_limit=1000)
        walk.append(one.reset(seed=4)[0])
        for _ in range(20):
            *seen, info = one.step(int(rng.integers(space.num_actions)))
            walk += [seen[0], np.array([info["index"]])]
            if seen[2]:
                one.reset()
        walks.append(np.concatenate([np.ravel(each) for each in walk]))
    assert same(*walks)


@pytest.mark.long
def test_mapped_files_are_read_ahead(spaces, monkeypatch):
    asked = []
    monkeypatch.setattr(memory, "RANGE_ROWS", 1000)
    monkeypatch.setattr(memory, "_advise", lambda array, *place: asked.append((array.dtype, *place[:2])))
    successors = pharos.load(spaces("breakout")[1].folder).successors
    ranges = [*memory.ranges_from_the_end(successors, 0, 5439)]
    assert ranges[0] == (4439, 5439) and asked[0] == (PACKED, 3439, 4439)
