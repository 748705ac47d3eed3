"""State spaces whose checksums are right and whose content is not: one line, or the answer to what the files say."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xxhash

import pharos
from pharos import exporters, importers
from pharos.errors import PharosError, StateSpaceCorrupted, StateSpaceError, StateSpaceMismatch
from pharos.mdp import TabularMDP
from pharos.state_space import files as writing
from pharos.state_space import manifest as manifests
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
    manifest["digest"] = manifests.digest_of(manifest)
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
    manifest["digest"] = manifests.digest_of(manifest)
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
    manifest["digest"] = manifests.digest_of(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    refused(folder, r"successors\.bin: 0 checksums for \d+ bytes")


def test_an_environment_with_other_actions_or_components_is_refused(folder):
    with pytest.raises(StateSpaceMismatch, match="choose another folder"):
        pharos.load(folder, environment=pharos.make("simple_grid"))


# Many mutations, in a process of their own, which must live ----------------------------------------------------------


def mutate(folder, rng):
    """Change one thing, and make checksums and digest right."""
    kind = rng.integers(4)
    if kind == 3:
        path = folder / "manifest.json"
        manifest = json.loads(path.read_text())
        values = [0, -1, 1, 1657, 1659, 2**31, 2**63, 2**80, 1e30, float("nan"), 0.5, None, "x", [], {}, True, [[0, 1]]]
        value, target = values[rng.integers(len(values))], manifest
        while True:
            key = rng.choice(sorted(target)) if isinstance(target, dict) else int(rng.integers(len(target)))
            inner = target[key]
            if not isinstance(inner, dict | list) or not inner or rng.random() < 0.2:
                target[key] = value
                break
            target = inner
        manifest["digest"] = manifests.digest_of(manifest)
        path.write_text(json.dumps(manifest))
        return
    name = ("states.bin", "successors.bin", "terminal.bin")[kind]
    data = bytearray((folder / name).read_bytes())
    for _ in range(rng.integers(1, 4)):
        if kind == 1 and rng.random() < 0.5:
            place = 4 * int(rng.integers(len(data) // 4))
            data[place : place + 4] = int(rng.integers(-(2**31), 2**31)).to_bytes(4, "little", signed=True)
        else:
            data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    (folder / name).write_bytes(data)
    sealed(folder)


def naive_value(folder, rewards, gamma):
    """The value at the start, from the files alone."""
    states, actions = rewards.shape
    successors = np.fromfile(folder / "successors.bin", "<i4").reshape(states, actions)
    v = np.zeros(states)
    for _ in range(400):
        v = (rewards + gamma * v[successors]).max(axis=1)
    return v[0]


def survive(folder, mutations):
    """Read, solve and measure each mutant; anything but one line of pharos, or the right value, ends the process."""
    pharos.build(pharos.make("breakout", **BREAKOUT), folder)
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    rng, right, wrong = np.random.default_rng(7), 0, 0
    for _ in range(mutations):
        for name, data in files.items():
            (folder / name).write_bytes(data)
        mutate(folder, rng)
        try:
            space = pharos.load(folder)
            mdp = space.mdp(gamma=0.9)
            solution = pharos.value_iteration(mdp, 1e-9)
            space.indices(space.states(slice(0, 50)))
        except PharosError as error:
            assert "\n" not in str(error), error
            wrong += 1
            continue
        expected = naive_value(folder, mdp.rewards, 0.9)
        assert abs(solution.value_at_start - expected) <= solution.error_bound + 1e-12
        right += 1
    print(right, wrong)


@pytest.mark.long
def test_mutants_of_a_space_never_end_the_process(tmp_path):
    code = f"import sys, pathlib; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_hostile_spaces as t\n"
    code += f"t.survive(pathlib.Path({str(tmp_path / 'space')!r}), 400)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    right, wrong = map(int, done.stdout.split())
    assert right + wrong == 400 and right > 20 and wrong > 100


# Imported folders ----------------------------------------------------------------------------------------------------


def test_a_folder_of_an_imported_mdp_is_said_to_be_one_and_never_to_be_deleted(tmp_path):
    mdp = TabularMDP.from_arrays([[0, 1], [1, -1]], [[0.0, 0.0], [0.0, 1.0]])
    folder = importers.save(mdp, tmp_path / "imported", source="a friend")
    for attempt in (pharos.load, lambda path: pharos.build(pharos.make("simple_grid"), path)):
        with pytest.raises(StateSpaceError, match=r"holds an imported MDP.*solve") as caught:
            attempt(folder)
        assert "delete" not in str(caught.value) and "\n" not in str(caught.value)
    assert exporters.gym_p(importers.load(folder))[1][1] == [(1.0, 2, 1.0, True)]


def survive_imported(folder, mutations):
    """The same with the arrays of imported MDPs, tables and matrices."""
    rng, right, wrong = np.random.default_rng(3), 0, 0
    table = TabularMDP.from_arrays(rng.integers(-1, 40, (40, 3)), rng.random((40, 3)))
    matrices = rng.random((20, 2, 20)) * (rng.random((20, 2, 20)) < 0.2)
    general = TabularMDP.from_matrices(matrices / np.maximum(matrices.sum(2, keepdims=True), 1), rng.random((20, 2)))
    for mdp in (table, general):
        place = importers.save(mdp, folder / str(mdp.num_states))
        files = {path.name: path.read_bytes() for path in place.iterdir()}
        for _ in range(mutations // 2):
            for name, data in files.items():
                (place / name).write_bytes(data)
            name = rng.choice(sorted(name for name in files if name.endswith(".npy")))
            data = bytearray(files[name])
            first = 0 if rng.random() < 0.2 else 128  # headers now and then
            for _ in range(rng.integers(1, 4)):
                data[rng.integers(first, len(data))] ^= 1 << int(rng.integers(8))
            (place / name).write_bytes(data)
            manifest = json.loads(files["manifest.json"])
            manifest.pop("digest")
            manifest["arrays"][name.removesuffix(".npy")] = xxhash.xxh3_128_hexdigest(bytes(data))
            (place / "manifest.json").write_text(json.dumps(manifest))
            try:
                solution = pharos.value_iteration(importers.load(place).with_gamma(0.5))
                assert np.isfinite(solution.v).all() and solution.error_bound < np.inf
                right += 1
            except PharosError as error:
                assert "\n" not in str(error), error
                wrong += 1
    print(right, wrong)


@pytest.mark.long
def test_mutants_of_an_imported_mdp_never_end_the_process(tmp_path):
    code = f"import sys, pathlib; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_hostile_spaces as t\n"
    code += f"t.survive_imported(pathlib.Path({str(tmp_path)!r}), 400)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    right, wrong = map(int, done.stdout.split())
    assert right + wrong == 400 and right > 20 and wrong > 100
