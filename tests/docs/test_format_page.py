"""docs/format.md: its code reads a folder without pharos, and gets what pharos says; the file is described to the
byte."""

import hashlib
import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import xxhash

import pharos
from worlds import ChanceWorld

PAGE = (Path(__file__).parents[2] / "docs" / "format.md").read_text()
CODE, CODE_WITH_CHANCE, CODE_OF_40_BITS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("name", ["simple_grid/6x6-decoy", "frozen_lake/8x8", "freeway", "breakout"])
def test_the_code_of_the_page_reads_what_pharos_wrote(name, tmp_path, monkeypatch):
    small = {
        "freeway": {"num_cars": 9, "lane_length": 5, "car_speeds": (1, 2, 3)},
        "breakout": {"height": 6, "columns": 3},
    }
    space = pharos.build(pharos.make(name, **small.get(name, {})), tmp_path / "space")
    monkeypatch.chdir(space.folder)
    read: dict = {}
    exec(CODE, read)
    assert (read["vectors"] == space.states()).all()
    assert (read["successors"] == space.successors).all()
    assert (read["terminal"] == space.terminal).all()


@pytest.mark.long
@pytest.mark.parametrize(("most_codes", "possible_share"), [(2**16, 1.0), (2**16, 0.3), (2, 1.0), (2, 0.3)])
def test_the_code_of_the_page_reads_chance(most_codes, possible_share, tmp_path, monkeypatch):
    """Dense and one after another, with a palette and without."""
    monkeypatch.setattr(importlib.import_module("pharos.state_space.journal"), "MOST_CODES", most_codes)
    world = ChanceWorld(num_positions=50, seed=3, vectors=0, possible_share=possible_share)
    space = pharos.build(world, tmp_path / "space", progress=False)
    assert (("offsets.bin" in space.manifest["arrays"]), ("palette.bin" in space.manifest["arrays"])) == (
        possible_share < 1,
        most_codes > 2,
    )
    monkeypatch.chdir(space.folder)
    read: dict = {}
    exec(CODE_WITH_CHANCE, read)
    states = np.arange(space.num_states)
    stored = [pair for state in space.outcomes.of_states(states, 2).values() for pair in state]
    assert (read["successors"] == np.concatenate([successors for successors, _ in stored])).all()
    assert (read["probabilities"] == np.concatenate([probabilities for _, probabilities in stored])).all()
    assert (read["row"] == np.repeat(np.arange(len(stored)), [len(each) for each, _ in stored])).all()
    described = {key for key in space.manifest if f"`{key}`" in PAGE}
    assert described == set(space.manifest)
    assert set(space.manifest["arrays"]) | {"manifest.json", "lock"} == {path.name for path in space.folder.iterdir()}


def test_checksums_and_digest_are_as_the_page_says(tmp_path):
    folder = pharos.build(pharos.make("breakout", height=7, columns=5), tmp_path / "space").folder
    manifest = json.loads((folder / "manifest.json").read_text())
    for name, entry in manifest["arrays"].items():
        data = (folder / name).read_bytes()
        blocks = [data[i : i + 2**24] for i in range(0, len(data), 2**24)]
        assert entry["checksums"] == [xxhash.xxh3_128(block).hexdigest() for block in blocks]
        assert entry["bytes"] == len(data)
    digest = manifest.pop("digest")
    assert digest == hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
    assert set(manifest["arrays"]) | {"manifest.json", "lock"} == {path.name for path in folder.iterdir()}
    assert all(f"`{key}`" in PAGE for key in [*manifest, *manifest["layout"]])


def test_bits_of_no_component_are_zero(tmp_path):
    space = pharos.build(pharos.make("frozen_lake/4x4"), tmp_path / "space")
    layout = space.manifest["layout"]
    used = sum(((1 << bits) - 1) << shift for bits, shift in zip(layout["bits"], layout["shift"], strict=True))
    assert not (np.asarray(space.packed_states).ravel() & np.uint64(2**64 - 1 - used)).any()


@pytest.mark.parametrize(
    ("name", "parameters", "digest"),
    (
        ("frozen_lake/8x8", {}, "59df3691fed2895f"),
        ("frozen_lake/8x8", {"slippery": False}, "59df3691fed2895f"),
        ("freeway", {"num_cars": 4, "lane_length": 5}, "d0b6759b3dbc156c"),
        ("breakout", {"height": 6, "columns": 3}, "3048e62854259b67"),
        ("simple_grid/6x6-decoy", {}, "34fa7f2d9c0c3f46"),
    ),
)
def test_folders_without_chance_are_what_they_were_byte_for_byte(name, parameters, digest, tmp_path):
    """SHA-256 of the files of a build, written by a pharos that knew of no chance in rules."""
    folder = pharos.build(pharos.make(name, **parameters), tmp_path / "space", progress=False).folder
    files = b"".join(path.name.encode() + path.read_bytes() for path in sorted(folder.iterdir()))
    assert hashlib.sha256(files).hexdigest()[:16] == digest
