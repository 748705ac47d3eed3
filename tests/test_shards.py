"""Shards: ranges of the files of a state space on several disks are read as the one space that they are."""

import errno
import json
import os
import shutil

import numpy as np
import pytest

import pharos
from chance_worlds import ChanceWorld
from pharos.errors import DiskFull, ParameterError, StateSpaceCorrupted, StateSpaceError, StateSpaceMismatch
from pharos.state_space import shards

WORLD = pharos.make("breakout", height=7, columns=5, brick_rows=1)


@pytest.fixture(autouse=True)
def _small_borders(monkeypatch):
    monkeypatch.setattr(shards, "BORDER", 1 << 14)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder of a state space in one piece."""
    return pharos.build(WORLD, tmp_path_factory.mktemp("built") / "space", progress=False).folder


@pytest.fixture
def folder(built, tmp_path):
    """A copy."""
    return shutil.copytree(built, tmp_path / "space")


def sharded(folder, count=3, world=WORLD):
    names = [folder.parent / f"disk-{k}" for k in range(count)]
    return pharos.build(world, folder, shards=names, progress=False), names


@pytest.mark.slow
def test_ranges_put_together_are_the_files(built, folder):
    whole = pharos.load(built)
    space, disks = sharded(folder)
    assert not (folder / "states.bin").exists()
    for name in ("states.bin", "successors.bin", "terminal.bin"):
        assert b"".join((disk / name).read_bytes() for disk in disks) == (built / name).read_bytes()
    assert sum((disk / "successors.bin").stat().st_size > 0 for disk in disks) == 3
    for again in (space, pharos.load(folder)):
        assert (again.packed_states == whole.packed_states).all()
        assert (again.successors == whole.successors).all()
        assert (again.terminal == whole.terminal).all()
    one, other = (pharos.value_iteration(each.mdp(0.5)) for each in (whole, space))
    assert (one.v == other.v).all()
    assert pharos.build(WORLD, folder, shards=disks, progress=False).num_states == whole.num_states


@pytest.mark.long
def test_outcomes_are_read_from_shards(tmp_path):
    world = ChanceWorld(num_positions=3000)
    whole = pharos.build(world, tmp_path / "whole", progress=False)
    shards.BORDER = os.sysconf("SC_PAGESIZE")
    space, _ = sharded(shutil.copytree(whole.folder, tmp_path / "space"), world=world)
    for one, other in zip(whole.outcomes, space.outcomes, strict=True):
        assert one is other is None or np.array_equal(one, other)


def test_a_missing_shard_is_named(folder):
    _, disks = sharded(folder)
    disks[1].rename(folder.parent / "moved")
    with pytest.raises(StateSpaceError, match=r"disk-1: shard 1 of 3 of .*space is missing .* mount its disk"):
        pharos.load(folder)
    record = json.loads((folder / "shards.json").read_text())
    record["folders"][1] = "../moved"
    (folder / "shards.json").write_text(json.dumps(record))
    assert pharos.load(folder).num_states > 0


@pytest.mark.long
def test_shards_of_different_builds_are_told_apart(folder, tmp_path):
    _, disks = sharded(folder)
    another = pharos.make("breakout", height=6, columns=5, brick_rows=1)
    (tmp_path / "other").mkdir()
    pharos.build(another, tmp_path / "other" / "space", progress=False)
    _, others = sharded(tmp_path / "other" / "space", world=another)
    record = json.loads((disks[2] / "shard.json").read_text())
    shutil.copy(others[2] / "shard.json", disks[2])
    with pytest.raises(StateSpaceMismatch, match=r"disk-2: shard 2 of 3 .* is of another build: its digest is"):
        pharos.load(folder)
    (disks[2] / "shard.json").write_text(json.dumps({**record, "number": 0}))
    with pytest.raises(StateSpaceMismatch, match=r"is shard 0 of 3 in its own words"):
        pharos.build(WORLD, folder, progress=False)


@pytest.mark.long
def test_a_shard_that_was_changed_is_no_shard(folder):
    _, disks = sharded(folder)
    path = disks[1] / "successors.bin"
    data = bytearray(path.read_bytes())
    path.write_bytes(data[:-1])
    with pytest.raises(StateSpaceCorrupted, match=r"shard 1 of 3 .*: successors.bin has \d+ bytes; expected \d+"):
        pharos.load(folder)
    data[3] ^= 1
    path.write_bytes(data)
    with pytest.raises(StateSpaceCorrupted, match="does not match its checksum"):
        pharos.load(folder)


@pytest.mark.long
def test_a_full_disk_of_one_shard_loses_nothing(folder, monkeypatch):
    opened = open

    class Full:
        def __init__(self, file):
            self._file = file

        def __getattr__(self, name):
            return getattr(self._file, name)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self._file.close()

        def write(self, _):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def disk_1_is_full(path, *arguments, **options):
        file = opened(path, *arguments, **options)
        return Full(file) if "disk-1" in str(path) and "wb" in arguments else file

    monkeypatch.setattr(shards, "open", disk_1_is_full, raising=False)
    with pytest.raises(DiskFull, match=r"disk-1/states.bin: cannot write \(No space left.*the same command resumes"):
        sharded(folder)
    monkeypatch.undo()
    monkeypatch.setattr(shards, "BORDER", 1 << 14)
    assert pharos.load(folder).num_states > 0  # in one piece
    first = (folder.parent / "disk-0" / "states.bin").stat().st_mtime_ns
    space, disks = sharded(folder)
    assert (disks[0] / "states.bin").stat().st_mtime_ns == first
    assert not (folder / "states.bin").exists()
    assert space.num_states > 0


@pytest.mark.long
def test_one_that_was_killed_while_files_went_goes_on(built, folder):
    sharded(folder)
    shutil.copy(built / "states.bin", folder)
    assert pharos.load(folder).num_states > 0
    sharded(folder)
    assert not (folder / "states.bin").exists()


@pytest.mark.long
def test_folders_that_cannot_be_shards_are_refused(folder, tmp_path):
    with pytest.raises(ParameterError, match="a folder is given twice"):
        pharos.build(WORLD, folder, shards=[tmp_path / "a", tmp_path / "a"], progress=False)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter").write_text("dear")
    with pytest.raises(ParameterError, match="is not empty and holds no shard; choose another folder"):
        pharos.build(WORLD, folder, shards=[tmp_path / "full"], progress=False)
    sharded(folder)
    with pytest.raises(ParameterError, match="is in shards already"):
        pharos.build(WORLD, folder, shards=[tmp_path / "elsewhere"], progress=False)
