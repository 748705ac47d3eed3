"""State spaces in shards, as an earlier pharos wrote them: ranges of their files in several folders are read as one."""

import json
import shutil
from pathlib import Path

import pytest

import pharos
from pharos.errors import StateSpaceCorrupted, StateSpaceError, StateSpaceMismatch

STORED = Path(__file__).parents[1] / "data" / "shards"
WORLD = pharos.make("breakout", height=6, columns=5, brick_rows=1)


@pytest.fixture
def folder(tmp_path):
    """A space whose successors lie in two shards, its other files in the second."""
    return shutil.copytree(STORED, tmp_path / "stored") / "space"


def test_ranges_are_read_as_the_files_that_they_are(folder, tmp_path):
    whole = pharos.build(WORLD, tmp_path / "whole", progress=False)
    assert (folder.parent / "shard-0" / "successors.bin").stat().st_size == 1 << 14
    for space in (pharos.load(folder), pharos.build(WORLD, folder, progress=False)):
        assert (space.packed_states == whole.packed_states).all()
        assert (space.successors == whole.successors).all()
        assert (space.terminal == whole.terminal).all()


def test_a_missing_shard_is_named(folder):
    shard = folder.parent / "shard-0"
    shard.rename(folder.parent / "moved")
    with pytest.raises(StateSpaceError, match=r"shard-0: shard 0 of 2 of .*space is missing .* mount its disk"):
        pharos.load(folder)
    (folder / "shards.json").write_text(json.dumps({"folders": ["../moved", "../shard-1"]}))
    assert pharos.load(folder).num_states == 3580


def test_a_shard_of_another_build_or_place_is_told_apart(folder):
    path = folder.parent / "shard-1" / "shard.json"
    record = json.loads(path.read_text())
    for wrong in ({"digest": "0" * 32}, {"number": 0}):
        path.write_text(json.dumps(record | wrong))
        with pytest.raises(StateSpaceMismatch, match=r"shard 1 of 2 .* is another one, or of another build"):
            pharos.load(folder)


def test_a_shard_that_was_changed_is_no_shard(folder):
    path = folder.parent / "shard-1" / "successors.bin"
    data = bytearray(path.read_bytes())
    path.write_bytes(data[:-1])
    with pytest.raises(StateSpaceCorrupted, match=r"successors.bin has \d+ bytes in its shards; expected \d+"):
        pharos.load(folder)
    data[3] ^= 1
    path.write_bytes(data)
    with pytest.raises(StateSpaceCorrupted, match="does not match its checksum"):
        pharos.load(folder)
    (folder / "shards.json").write_text(json.dumps({"folders": []}))
    with pytest.raises(StateSpaceCorrupted, match="expected a list of folders"):
        pharos.load(folder)
