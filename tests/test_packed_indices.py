"""Indices of 40 bits: what they hold, what loops and tables read of them, and the folders that hold them."""

import json
import shutil

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import pharos
from chance_worlds import ChanceWorld
from pharos import packed_indices
from pharos.errors import StateSpaceCorrupted, StateSpaceMismatch, StateSpaceTooLarge
from pharos.mdp import Table
from pharos.packed_indices import INT40, PACKED, PackedIndices, blocks_of, holds_end
from pharos.state_space import files as writing
from pharos.state_space import manifest as manifests
from pharos.state_space import search
from test_format_page import CODE_OF_40_BITS
from test_hostile_spaces import sealed
from test_resuming import build, files_of

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
        patch.setattr(packed_indices, "_BLOCK", data.draw(st.integers(1, 7)))
        parts = list(blocks_of(indices))
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
        patch.setattr(packed_indices, "_BLOCK", data.draw(st.integers(1, 40)))
        patch.setattr(packed_indices, "INT32_STATES", data.draw(st.sampled_from([0, 2**31 - 1])))
        local, halo = Table(PackedIndices.of(plain)).part(start, stop)
    halo = halo.tolist()
    assert halo == sorted({t for row in plain[start:stop].tolist() for t in row if t >= 0 and not start <= t < stop})
    numbers = {-1: -1} | {t: t - start for t in range(start, stop)} | {t: stop - start + i for i, t in enumerate(halo)}
    expected = [[numbers[t] for t in row] for row in plain[start:stop].tolist()]
    assert np.asarray(local.next_states).tolist() == expected
