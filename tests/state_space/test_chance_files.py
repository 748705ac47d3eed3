"""Folders of worlds with chance: the same whatever disturbs their build, refused in one line where they are wrong."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_hostile_spaces import edited, refused, sealed
from test_resuming import FullDisk, _build_and_die_at, _InterruptAtLine, build, files_of

import pharos
from children import exit_code
from pharos.errors import DiskFull, PharosError, StateSpaceCorrupted, StateSpaceMismatch, StateSpaceTooLarge
from pharos.state_space import read_manifest
from pharos.system.arrays import PACKED, PackedIndices, unpacked
from worlds import ChanceWorld

search = importlib.import_module("pharos.state_space.search")
table = importlib.import_module("pharos.state_space.table")
journal = importlib.import_module("pharos.state_space.journal")

DENSE = ChanceWorld(num_positions=3000, seed=1, vectors=0, possible_share=1.0, end_share=0.05)
RAGGED = ChanceWorld(num_positions=3000, seed=1, vectors=0, possible_share=0.3, end_share=0.05)
FEW_VECTORS = ChanceWorld(num_positions=3000, seed=1, vectors=3, end_share=0.05)
# world, codes that a palette may have: with more vectors probabilities are spelled out, here in the middle of a build
FOLDERS = {
    "dense": (DENSE, 2**16),
    "ragged": (RAGGED, 2**16),
    "few vectors": (FEW_VECTORS, 2**16),
    "dense, spelled out": (DENSE, 2000),
    "ragged, spelled out": (RAGGED, 300),
}


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 256)
    monkeypatch.setattr(search, "WIDE_FOR_THREADS", 50)


@pytest.fixture(params=FOLDERS)
def case(request, monkeypatch, tmp_path):
    """(world, the files of its undisturbed build)."""
    world, codes = FOLDERS[request.param]
    monkeypatch.setattr(journal, "MOST_CODES", codes)
    if request.param not in _undisturbed:
        _undisturbed[request.param] = files_of(build(world, tmp_path / "undisturbed", workers=1).folder)
    return world, _undisturbed[request.param]


_undisturbed: dict[str, dict[str, bytes]] = {}


def test_each_world_has_the_files_that_it_should(case, request):
    _, files = case
    which = request.node.callspec.params["case"]
    always = {"lock", "manifest.json", "states.bin", "successors.bin", "terminal.bin"}
    probabilities = {"probabilities.bin"} if "spelled" in which else {"codes.bin", "palette.bin"}
    assert set(files) == always | probabilities | ({"offsets.bin"} if "ragged" in which else set())
    dtype = json.loads(files["manifest.json"])["arrays"].get("codes.bin", {"dtype": ""})["dtype"]
    assert dtype == ("" if "spelled" in which else "|u1" if which in ("few vectors",) else "<u2")


@pytest.mark.parametrize("where", ("memory", "disk"))
def test_files_do_not_depend_on_threads_blocks_or_where_the_table_is(where, case, tmp_path, small_blocks, monkeypatch):
    world, expected = case
    if where == "disk":
        monkeypatch.setattr(table.MemoryTable, "fits", lambda *_: False)
    assert files_of(build(world, tmp_path / "space", workers=3, checkpoint_seconds=0.0).folder) == expected


def test_a_build_that_stops_again_and_again_ends_in_the_same_files(case, tmp_path, small_blocks):
    world, expected = case
    for limit in (10, 300, 700, 1500):
        with pytest.raises(StateSpaceTooLarge, match=rf"passed max_states={limit}"):
            build(world, tmp_path / "space", max_states=limit)
        manifest = read_manifest(tmp_path / "space")
        assert not manifest["complete"] and manifest["format_version"] == 2
    assert files_of(build(world, tmp_path / "space").folder) == expected


@pytest.mark.long
def test_beyond_32_bit_indices_only_the_width_of_the_successors_changes(case, tmp_path, small_blocks, monkeypatch):
    world, expected = case
    narrow = json.loads(expected["manifest.json"])
    with pytest.raises(StateSpaceTooLarge):
        build(world, tmp_path / "space", max_states=500)
    monkeypatch.setattr(search, "INT32_STATES", 1000)
    with pytest.raises(StateSpaceTooLarge):
        build(world, tmp_path / "space", max_states=1200)
    files = files_of(build(world, tmp_path / "space").folder)
    wide = unpacked(np.frombuffer(files.pop("successors40.bin"), PACKED))
    assert (wide == np.frombuffer(expected["successors.bin"], "<i4")).all()
    for name in files.keys() - {"manifest.json"}:
        assert files[name] == expected[name]
    assert isinstance(pharos.load(tmp_path / "space").outcomes.successors, PackedIndices)
    assert narrow["num_transitions"] == json.loads(files["manifest.json"])["num_transitions"]


@pytest.mark.long
def test_a_build_that_dies_at_any_step_ends_in_the_same_files(case, tmp_path, monkeypatch):
    world, expected = case
    monkeypatch.setattr(search, "CHUNK", 1024)
    for call in range(1, 400, 3):
        folder = tmp_path / f"space{call}"
        if (code := exit_code(_build_and_die_at, call, world, folder)) == 0:
            break
        assert code == 9
        build(world, folder)
        assert {**files_of(folder), "lock": b""} == expected  # who died with all done has left its name in the lock
    assert 20 < call < 398


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_at_any_line_loses_nothing(case, tmp_path, monkeypatch):
    world, expected = case
    monkeypatch.setattr(search, "CHUNK", 1024)
    counter = _InterruptAtLine(-1)
    counter.build(world, tmp_path / "counted")
    num_lines = -1 - counter.left
    for line in range(1, num_lines, max(1, num_lines // 25)):
        folder = tmp_path / f"space{line}"
        with pytest.raises(KeyboardInterrupt):
            _InterruptAtLine(line).build(world, folder)
        build(world, folder)
        assert files_of(folder) == expected


KINDS = ("building-successors.bin", "building-codes.bin", "building-palette.bin", "building-probabilities.bin")
FINAL = ("successors.bin", "codes.bin", "palette.bin", "offsets.bin", "manifest.json.tmp", "fsync", "rename")


@pytest.mark.long
@pytest.mark.parametrize("call", (1, 3, 8))
@pytest.mark.parametrize("kind", (*KINDS, *FINAL))
def test_a_full_disk_loses_nothing(kind, call, case, tmp_path, small_blocks, monkeypatch):
    world, expected = case
    failed = False
    with monkeypatch.context() as patch:
        FullDisk(patch, kind, call, freed_at_once=False)
        try:
            build(world, tmp_path / "space", checkpoint_seconds=0.0)
        except DiskFull as error:
            failed = "cannot write" in str(error)
    kept = (read_manifest(tmp_path / "space") or {"complete": False})["complete"]
    assert failed != kept  # a kind of file that this build does not write
    build(world, tmp_path / "space")
    assert files_of(tmp_path / "space") == expected


def test_what_a_killed_build_left_behind_its_end_is_removed(case, tmp_path):
    world, expected = case
    folder = build(world, tmp_path / "space").folder
    (folder / "building-successors.bin").write_bytes(b"left")
    build(world, folder)
    assert files_of(folder) == expected


# Wrong content with the right checksums ------------------------------------------------------------------------------


@pytest.fixture(params=FOLDERS)
def folder(request, monkeypatch, tmp_path):
    world, codes = FOLDERS[request.param]
    monkeypatch.setattr(journal, "MOST_CODES", codes)
    return build(world, tmp_path / "space").folder


def changed(folder, name, dtype, place, value) -> None:
    """Write a value into an array, and make the checksums right."""
    array = np.fromfile(folder / name, dtype)
    array[place] = value
    array.tofile(folder / name)
    sealed(folder)


@pytest.mark.parametrize("index", (-1, 2**31 - 1))
@pytest.mark.parametrize("place", (0, 3001, -1))
def test_a_successor_that_is_no_state_is_found(index, place, folder):
    changed(folder, "successors.bin", "<i4", place, index)
    refused_outcomes(folder, rf"successors\.bin: action \d leads from state \d+ to state {index}; expected 0 to \d+")


def refused_outcomes(folder, match) -> None:
    with pytest.raises(StateSpaceCorrupted, match=match) as caught:
        pharos.load(folder).outcomes  # noqa: B018
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("value", (-0.25, 1.5, np.nan, np.inf, 0.0))
def test_probabilities_that_are_none_are_found(value, folder):
    name = "palette.bin" if (folder / "palette.bin").exists() else "probabilities.bin"
    changed(folder, name, "<f8", 0, value)
    refused_outcomes(folder, rf"{name}: (vector 0|action 0 in state 0) has the probabilities .*; expected positive")


def test_codes_and_beginnings_of_rows_out_of_range_are_found(folder):
    found = 0
    if (folder / "codes.bin").exists():
        dtype = read_manifest(folder)["arrays"]["codes.bin"]["dtype"]
        if dtype == "|u1":
            changed(folder, "codes.bin", dtype, 7, 200)
            refused_outcomes(folder, r"codes\.bin: action 1 in state 3 has the code 200; expected 0 to 3")
            found += 1
    if (folder / "offsets.bin").exists():
        for place, value in ((0, 5), (7, -5), (7, 2**40), (-1, 3)):
            before = (folder / "offsets.bin").read_bytes()
            changed(folder, "offsets.bin", "<i8", place, value)
            refused_outcomes(folder, r"offsets\.bin: (begins with|action \d in state \d+ )")
            (folder / "offsets.bin").write_bytes(before)
            found += 1
    if not found:
        pytest.skip("it has neither")


def test_terminal_states_that_lead_elsewhere_are_found(folder):
    space = pharos.load(folder)
    state = int(np.flatnonzero(space.terminal)[-1])
    offsets, most = space.outcomes.offsets, space.manifest["num_outcomes"]
    place = slice(state * 2 * most, (state * 2 + 1) * most) if offsets is None else int(offsets[state * 2])
    del space, offsets
    changed(folder, "successors.bin", "<i4", place, 0 if state else 1)
    refused_outcomes(folder, rf"successors\.bin: terminal state {state} leads to another state")


@pytest.mark.parametrize(
    ("change", "match"),
    (
        ({"num_outcomes": 0}, "num_outcomes is 0"),
        ({"num_outcomes": 2**40}, "transitions of at most"),
        ({"num_transitions": 1}, "num_transitions is 1; expected a whole number of at least"),
        ({"num_transitions": 2**40}, "transitions of at most"),
        ({"outcomes": 1}, "transitions of at most"),
        ({"format_version": 1}, "arrays are|bytes of type"),
    ),
)
def test_a_manifest_that_says_what_cannot_be_is_refused(change, match, folder):
    edited(folder, **change)
    refused(folder, match)


def test_a_truncated_file_is_found(folder):
    for name in read_manifest(folder)["arrays"]:
        before = (folder / name).read_bytes()
        (folder / name).write_bytes(before[:-1])
        refused(folder, f"{name}: expected {len(before)} bytes, found {len(before) - 1}")
        (folder / name).write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
        refused(folder, f"{name}: block 0 .* does not match its checksum")
        (folder / name).write_bytes(before)


def test_other_rules_are_noticed(folder):
    env = pharos.load(folder).manifest["parameters"]
    other = ChanceWorld(**{**env, "seed": 2})
    with pytest.raises(
        StateSpaceMismatch, match=r"was built with other rules: from state .* leads to .*, by the rules"
    ):
        pharos.load(folder, environment=other)


# Many mutations, in a process of their own, which must live ----------------------------------------------------------


def naive_value(folder, rewards, gamma) -> float:
    """The value at the start, from the files alone, row by row."""
    manifest = read_manifest(folder)
    arrays = {name: np.fromfile(folder / name, entry["dtype"]) for name, entry in manifest["arrays"].items()}
    pairs, most = rewards.size, manifest["num_outcomes"]
    first = arrays["offsets.bin"] if "offsets.bin" in arrays else most * np.arange(pairs + 1)
    P = np.zeros((pairs, len(rewards)))
    for row in range(pairs):
        successors = arrays["successors.bin"][first[row] : first[row + 1]]
        if "codes.bin" in arrays:
            likely = arrays["palette.bin"].reshape(-1, most)[arrays["codes.bin"][row]]
        else:
            likely = arrays["probabilities.bin"][first[row] : first[row + 1]]
        np.add.at(P[row], successors, likely[: len(successors)])
    v = np.zeros(len(rewards))
    for _ in range(300):
        v = (rewards + gamma * (P @ v).reshape(rewards.shape)).max(axis=1)
    return v[0]


def survive(folder, which, mutations) -> None:
    """Read and solve each mutant; anything but one line of pharos, or the right value, ends the process."""
    world, journal.MOST_CODES = FOLDERS[which]
    world = ChanceWorld(**{**world.parameters, "num_positions": 120, "end_share": 0.0})
    journal.MOST_CODES = min(journal.MOST_CODES, 2**16 if "spelled" not in which else 10)
    pharos.build(world, folder, progress=False)
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    rewards = pharos.load(folder, environment=world).mdp().rewards
    names = sorted(json.loads(files["manifest.json"])["arrays"])
    rng, right, wrong = np.random.default_rng(7), 0, 0
    for _ in range(mutations):
        for name, data in files.items():
            (folder / name).write_bytes(data)
        name = names[rng.integers(len(names))]
        data = bytearray(files[name])
        for _ in range(rng.integers(1, 3)):
            data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        (folder / name).write_bytes(data)
        sealed(folder)
        try:
            space = pharos.load(folder, environment=world if rng.random() < 0.5 else None)
            solution = pharos.value_iteration(space.mdp(0.9, rewards), 1e-9)
            space.indices(space.states(slice(0, 50)))
        except PharosError as error:
            assert "\n" not in str(error), error
            wrong += 1
            continue
        assert abs(solution.value_at_start - naive_value(folder, rewards, 0.9)) <= solution.error_bound + 1e-8
        right += 1
    print(right, wrong)


@pytest.mark.long
@pytest.mark.parametrize("which", FOLDERS)
def test_mutants_never_end_the_process(which, tmp_path):
    folders = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    code = f"import sys, pathlib; sys.path[:0] = {folders}; import test_chance_files as t\n"
    code += f"t.survive(pathlib.Path({str(tmp_path / 'space')!r}), {which!r}, 150)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    right, wrong = map(int, done.stdout.split())
    assert right + wrong == 150 and right > 0 and wrong > 50
