"""State spaces whose checksums are right and whose content is not: one line, or the answer to what the files say."""

import json

import numpy as np
import pytest
import xxhash

import pharos
from pharos import exporters, importers
from pharos.errors import StateSpaceCorrupted, StateSpaceError, StateSpaceMismatch
from pharos.mdp import TabularMDP
from pharos.state_space import manifest as manifests
from pharos.state_space import manifest as writing
from pharos.state_space import store as reading

BREAKOUT = {"height": 7, "columns": 4, "brick_rows": 1}  # 1,658 states


def sealed(folder):
    """Make checksums and digest right again, as somebody would who means harm."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    for name, entry in manifest["arrays"].items():
        data = (folder / name).read_bytes()
        blocks = [data[i : i + 2**24] for i in range(0, len(data), 2**24)]
        entry |= {"bytes": len(data), "checksums": [xxhash.xxh3_128_hexdigest(block) for block in blocks]}
    manifest["digest"] = manifests.manifest_digest(manifest)
    path.write_text(json.dumps(manifest))


def edited(folder, **changes):
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text()) | changes
    path.write_text(json.dumps(manifest))
    sealed(folder)


@pytest.fixture
def folder(tmp_path):
    pharos.build(pharos.make("breakout", **BREAKOUT), tmp_path / "space")
    return tmp_path / "space"


def refused(folder, match, error=StateSpaceCorrupted):
    with pytest.raises(error, match=match) as caught:
        pharos.load(folder).mdp()
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("index", [-1, 1658, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("row", [0, 829, 1657])
def test_a_successor_that_is_no_state_is_found(index, row, folder):
    successors = np.fromfile(folder / "successors.bin", "<i4").reshape(1658, 3)
    successors[row, 2] = index
    successors.tofile(folder / "successors.bin")
    sealed(folder)
    refused(folder, rf"successors\.bin: action 2 leads from state {row} to state {index}; expected 0 to 1657")
    for verify in (True, False):
        space = pharos.load(folder, verify=verify) if row not in (0, 1657) else None
        if space is not None:  # the 64 states that are compared with the rules do not have it
            with pytest.raises(StateSpaceCorrupted, match=f"from state {row} to"):
                space.successors  # noqa: B018


def test_indices_are_looked_at_once(folder, monkeypatch):
    calls = []
    real = reading.check_successors
    monkeypatch.setattr(reading, "check_successors", lambda *arguments: calls.append(real(*arguments)))
    space = pharos.load(folder)
    assert calls == []
    for _ in range(3):
        pharos.value_iteration(space.mdp(gamma=0.9))
    assert len(calls) == 1


def test_a_component_out_of_its_range_is_found(folder):
    states = np.fromfile(folder / "states.bin", "<u8")
    space = pharos.load(folder)
    i = next(i for i, size in enumerate(space.layout.size) if int(space.layout.mask[i]) + 1 != size)
    states[800] |= space.layout.mask[i] << space.layout.shift[i]
    states.tofile(folder / "states.bin")
    sealed(folder)
    refused(folder, rf"states\.bin: component {i} of state 800 is {int(space.layout.mask[i])}; expected less than")


def test_terminal_states_that_lead_elsewhere_or_are_miscounted_are_found(folder):
    bits = np.fromfile(folder / "terminal.bin", "u1")
    changed = bits.copy()
    ended = np.flatnonzero(np.unpackbits(bits, bitorder="little")[:1658])
    other = next(state for state in range(900, 1658) if state not in ended)
    changed[other // 8] |= 1 << other % 8
    changed.tofile(folder / "terminal.bin")
    sealed(folder)
    refused(folder, f"terminal state {other} leads to another state")
    changed = bits.copy()
    changed[ended[1] // 8] ^= 1 << ended[1] % 8
    changed.tofile(folder / "terminal.bin")
    sealed(folder)
    refused(folder, rf"terminal\.bin: marks {len(ended) - 1} terminal states; expected {len(ended)}")


@pytest.mark.parametrize("probability", [1e30, float("nan"), -0.5, 0.25, "1", None, float("inf")])
def test_start_probabilities_that_are_none_are_found(probability, folder):
    start = json.loads((folder / "manifest.json").read_text())["start"]
    edited(folder, initial=[[0, probability]], start=[[start[0][0], probability]])
    refused(folder, r"manifest\.json: .*probabilit")


@pytest.mark.parametrize(
    "change",
    [
        {"num_states": 10**9},
        {"num_states": -1},
        {"num_states": "1658"},
        {"num_actions": 2},
        {"num_terminal_states": 1e300},
        {"initial": [[5, 1.0]]},
        {"initial": []},
        {"initial": 7},
        {"layout": None},
        {"arrays": 0.5},
        {"arrays": {}},
        {"parameters": []},
        {"actions": "abc"},
        {"complete": "yes"},
    ],
)
def test_a_manifest_that_says_what_cannot_be_is_refused(change, folder):
    manifest = json.loads((folder / "manifest.json").read_text()) | change
    manifest["digest"] = manifests.manifest_digest(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    refused(folder, r"manifest\.json: .*; delete the folder and build again")


@pytest.mark.parametrize(
    ("name", "value"),
    [("shift", 64), ("shift", -1), ("word", 1), ("bits", 63), ("size", 0), ("size", 2**70), ("low", 2**63)],
)
def test_a_layout_outside_of_the_words_is_refused(name, value, folder):
    layout = json.loads((folder / "manifest.json").read_text())["layout"]
    layout[name][0] = value
    edited(folder, layout=layout)
    refused(folder, r"manifest\.json: ")


def test_every_block_of_a_file_is_verified(tmp_path, monkeypatch):
    for module in (manifests, reading, writing):
        monkeypatch.setattr(module, "CHECKSUM_BYTES", 64)
    folder = tmp_path / "space"
    pharos.build(pharos.make("breakout", **BREAKOUT), folder)
    rng = np.random.default_rng(0)
    for name in ("states.bin", "successors.bin", "terminal.bin"):
        data = (folder / name).read_bytes()
        for place in (0, len(data) - 1, *rng.choice(len(data), 10).tolist()):
            damaged = bytearray(data)
            damaged[place] ^= 1
            (folder / name).write_bytes(damaged)
            with pytest.raises(
                StateSpaceCorrupted, match=rf"{name}: block {place // 64} .*does not match its checksum"
            ):
                pharos.load(folder)
        (folder / name).write_bytes(data)
    pharos.load(folder)


def test_changed_rules_are_noticed_in_each_of_64_states(folder):
    original = np.fromfile(folder / "successors.bin", "<i4").reshape(1658, 3)
    for state in np.unique(np.linspace(0, 1657, 64).astype(int)).tolist():
        successors = original.copy()
        successors[state] = (successors[state] + 1) % 1658
        successors.tofile(folder / "successors.bin")
        sealed(folder)
        with pytest.raises(StateSpaceMismatch, match="was built with other rules"):
            pharos.load(folder)


def test_checksums_left_out_are_missed(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["arrays"]["successors.bin"]["checksums"] = []
    manifest["digest"] = manifests.manifest_digest(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    refused(folder, r"successors\.bin: 0 checksums for \d+ bytes")


def test_an_environment_with_other_actions_or_components_is_refused(folder):
    with pytest.raises(StateSpaceMismatch, match="choose another folder"):
        pharos.load(folder, environment=pharos.make("simple_grid"))


# Imported folders ----------------------------------------------------------------------------------------------------


def test_a_folder_of_an_imported_mdp_is_said_to_be_one_and_never_to_be_deleted(tmp_path):
    mdp = TabularMDP.from_arrays([[0, 1], [1, -1]], [[0.0, 0.0], [0.0, 1.0]])
    folder = importers.save(mdp, tmp_path / "imported", source="a friend")
    for attempt in (pharos.load, lambda path: pharos.build(pharos.make("simple_grid"), path)):
        with pytest.raises(StateSpaceError, match=r"holds an imported MDP.*solve") as caught:
            attempt(folder)
        assert "delete" not in str(caught.value) and "\n" not in str(caught.value)
    assert exporters.gym_p(importers.load(folder))[1][1] == [(1.0, 2, 1.0, True)]
