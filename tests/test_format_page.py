"""docs/format.md: its code reads a folder without pharos, and gets what pharos says; the file is described to the
byte."""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import xxhash

import pharos

PAGE = (Path(__file__).parents[1] / "docs" / "format.md").read_text()
CODE = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1]


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
