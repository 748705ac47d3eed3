"""The files of a state space do not depend on threads, blocks, or on how often the build was killed, stopped or
refused."""

import errno
import importlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import pharos
from children import exit_code, fork, in_a_child, kill
from patience import PATIENCE
from pharos.errors import DiskFull, RuleError, StateSpaceIncomplete, StateSpaceLocked, StateSpaceTooLarge
from pharos.state_space import manifest as writing
from pharos.system import storage
from pharos.system.arrays import PackedIndices
from refusals import failing
from worlds import Row, TableWorld

building = importlib.import_module("pharos.state_space.build")
search = importlib.import_module("pharos.state_space.search")
table = importlib.import_module("pharos.state_space.table")
machine = importlib.import_module("pharos.system.memory")

BREAKOUT = pharos.make("breakout", height=7, columns=5)  # 27,692 states; a frontier of hundreds
NARROW = TableWorld(num_positions=5000, lows="-1000,0,7", sizes=f"{2**40},{2**30},1", num_starts=3, end_share=0.05)
DATA = ("states.bin", "successors.bin", "terminal.bin")


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks so small that a build of 27,692 states goes through every path: narrow, wide, table growing,
    checkpoints."""
    monkeypatch.setattr(search, "CHUNK", 512)
    monkeypatch.setattr(search, "WIDE_FOR_THREADS", 200)


def build(env, folder, **options) -> pharos.StateSpace:
    return pharos.build(env, folder, progress=options.pop("progress", False), **options)


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def assert_same_files(folder: Path, expected: Path) -> None:
    found, reference = files_of(folder), files_of(expected)
    assert found.keys() == reference.keys()
    for name in reference:
        assert found[name] == reference[name], name


def assert_resumes(folder: Path, expected: Path) -> None:
    """What was begun in a folder is built to the end, and has the files of a build that nothing disturbed."""
    build(BREAKOUT, folder)
    assert_same_files(folder, expected)


def stop_at(max_states: int, folder: Path, **options) -> None:
    """Begin a build that ends at a limit of states."""
    with pytest.raises(StateSpaceTooLarge, match=rf"passed max_states={max_states}, \d+ left to expand"):
        build(BREAKOUT, folder, max_states=max_states, **options)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("undisturbed")
    for env in (BREAKOUT, NARROW):
        build(env, folder / env.name, workers=1)
    return {env.name: folder / env.name for env in (BREAKOUT, NARROW)}


@pytest.mark.slow
@pytest.mark.parametrize("env", (BREAKOUT, NARROW), ids=lambda env: env.name)
@pytest.mark.parametrize("workers", (1, 2, 3))
@pytest.mark.parametrize(("chunk", "wide"), ((64, 8), (512, 100), (1 << 16, 1 << 13)))
def test_files_do_not_depend_on_threads_or_blocks(env, workers, chunk, wide, tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", chunk)
    monkeypatch.setattr(search, "WIDE_FOR_THREADS", wide)
    build(env, tmp_path / "space", workers=workers, checkpoint_seconds=0.01)
    assert_same_files(tmp_path / "space", undisturbed[env.name])


@pytest.mark.parametrize("room", (1 << 16, 0))
def test_a_table_that_threads_fill_together_gives_the_same_files(room, tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(table, "PARALLEL_FILL", 0)
    monkeypatch.setattr(table, "LEFT_OVER", room)
    stop_at(20_000, tmp_path / "space", workers=2)
    build(BREAKOUT, tmp_path / "space", workers=3)
    assert_same_files(tmp_path / "space", undisturbed["breakout"])


def _build_a_part(env, folder):
    """Build some blocks, each of which is slow, and then wait to be killed."""
    blocks = iter(range(6))

    def go_on(_):
        time.sleep(0.02 if next(blocks, None) is not None else PATIENCE)

    build(env, folder, checkpoint_seconds=0.0, workers=2, progress=go_on)


@pytest.mark.long
def test_a_build_killed_again_and_again_ends_in_the_same_files(tmp_path, undisturbed, small_blocks):
    folder = tmp_path / "space"
    rng = np.random.default_rng(0)
    for _ in range(8):  # of 55 blocks
        process = in_a_child(_build_a_part, BREAKOUT, folder)
        while process.is_alive() and not (folder / "manifest.json").exists():  # the first child's first checkpoint
            time.sleep(0.001)
        process.join(timeout=rng.uniform(0.03, 0.12))
        kill(process)
    with pytest.raises(StateSpaceIncomplete):
        pharos.load(folder)
    assert_resumes(folder, undisturbed["breakout"])


def _build_and_die_at(call: int, env, folder):
    """Build, and die at this call of write, fsync or rename: before it, or in the middle of writing."""
    calls = 0

    def counted(real):
        def dying(*args):
            nonlocal calls
            calls += 1
            if calls == call:
                os._exit(9)
            return real(*args)

        return dying

    append = writing.GrowingFile.append

    def append_half(self, rows):
        nonlocal calls
        calls += 1
        if calls == call:
            append(self, rows[: len(rows) // 2])
            os._exit(9)
        append(self, rows)

    os.fsync, os.replace, os.truncate = counted(os.fsync), counted(os.replace), counted(os.truncate)
    writing.GrowingFile.append = append_half
    build(env, folder, checkpoint_seconds=0.0)


@pytest.mark.long
def test_a_build_that_dies_at_any_step_of_a_checkpoint_ends_in_the_same_files(tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 4096)
    for call in range(1, 30):
        assert exit_code(_build_and_die_at, call, BREAKOUT, tmp_path / f"space{call}") == 9
        assert_resumes(tmp_path / f"space{call}", undisturbed["breakout"])


def test_what_was_written_after_the_last_checkpoint_does_not_count(tmp_path, undisturbed, small_blocks):
    folder = tmp_path / "space"
    stop_at(9000, folder)
    for name in DATA:
        with open(folder / name, "ab") as file:
            file.write(b"\x07" * 1000)
    (folder / "manifest.json.tmp").write_text('{"format": "pharos sta')
    assert_resumes(folder, undisturbed["breakout"])


def test_a_keyboard_interrupt_keeps_what_was_found(tmp_path, undisturbed, small_blocks):
    folder = tmp_path / "space"
    found = []

    def interrupt(done):
        if done.num_states > 3000 * (len(found) + 1):
            found.append(done.num_expanded)
            raise KeyboardInterrupt

    for _ in range(4):
        with pytest.raises(KeyboardInterrupt):
            build(BREAKOUT, folder, progress=interrupt, checkpoint_seconds=1e9)
        assert building.read_manifest(folder)["num_expanded"] == found[-1]
    assert_resumes(folder, undisturbed["breakout"])


class _InterruptAtLine:
    """Raises KeyboardInterrupt in the main thread at the n-th line that the builder runs in Python."""

    def __init__(self, n: int):
        self.left = n

    def __call__(self, frame, event, arg):
        if not frame.f_code.co_filename.startswith(os.path.dirname(building.__file__)):
            return None
        if event == "line":
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt
        return self

    def build(self, env, folder):
        previous = sys.gettrace()
        sys.settrace(self)
        try:
            build(env, folder, checkpoint_seconds=1e9, workers=2)
        finally:
            sys.settrace(previous)


@pytest.mark.long
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # a file interrupted between open and with
def test_an_interrupt_at_any_line_keeps_counts_and_files_together(tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 4096)
    counter = _InterruptAtLine(-1)
    counter.build(BREAKOUT, tmp_path / "counted")
    num_lines = -1 - counter.left
    for line in range(1, num_lines, max(1, num_lines // 60)):
        folder = tmp_path / f"space{line}"
        with pytest.raises(KeyboardInterrupt):
            _InterruptAtLine(line).build(BREAKOUT, folder)
        assert_resumes(folder, undisturbed["breakout"])


def test_raising_max_states_goes_on_where_the_build_stopped(tmp_path, undisturbed, small_blocks):
    folder = tmp_path / "space"
    for limit in (1000, 5000, 20000):
        stop_at(limit, folder)
    assert building.read_manifest(folder)["num_states"] > 15000
    assert build(BREAKOUT, folder, max_states=33674).num_states == 33674
    assert_same_files(folder, undisturbed["breakout"])
    with pytest.raises(StateSpaceTooLarge):
        build(BREAKOUT, folder, max_states=33673)


# A table on disk -----------------------------------------------------------------------------------------------------


@pytest.fixture
def any_memory(monkeypatch):
    monkeypatch.setattr(machine, "LEAST_MEMORY", 1 << 16)


@pytest.fixture
def little_memory(any_memory, monkeypatch):
    """Memory that holds nothing: the table is on disk at once, chunks have 1024 rows, and a part of the table is a few
    pages."""
    monkeypatch.setattr(machine, "available_memory", lambda: 0)


@pytest.fixture(scope="module")
def wall(tmp_path_factory) -> pharos.StateSpace:
    """142,063 states: the table grows twice."""
    env = pharos.make("breakout", height=8, columns=6)
    return build(env, tmp_path_factory.mktemp("wall") / "undisturbed")


@pytest.mark.slow
@pytest.mark.parametrize("env", (BREAKOUT, NARROW), ids=lambda env: env.name)
@pytest.mark.parametrize("workers", (1, 2))
@pytest.mark.parametrize("wide", (8, 1 << 13))
def test_files_do_not_depend_on_where_the_table_is(
    env, workers, wide, tmp_path, undisturbed, little_memory, monkeypatch
):
    monkeypatch.setattr(search, "WIDE_FOR_THREADS", wide)
    build(env, tmp_path / "space", workers=workers, checkpoint_seconds=0.01)
    assert_same_files(tmp_path / "space", undisturbed[env.name])


@pytest.mark.long
@pytest.mark.parametrize("limit", (1 << 16, 1 << 20, 3 << 19))
@pytest.mark.parametrize("chunk", (64, 1 << 16))
def test_the_table_moves_to_disk_in_the_middle_of_a_build(limit, chunk, wall, tmp_path, any_memory, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", chunk)
    moved = []
    spill = search.Search._spill
    monkeypatch.setattr(
        search.Search, "_spill", lambda self, *args: (moved.append(self.position.count), spill(self, *args))
    )
    build(wall.environment, tmp_path / "space", memory=limit)
    assert len(moved) == 1 and (moved[0] > 1000) == (limit > 1 << 16)
    assert_same_files(tmp_path / "space", wall.folder)


@pytest.mark.slow
@pytest.mark.parametrize("workers", (1, 2))
def test_a_fuller_table_stays_in_memory_where_one_of_twice_the_size_does_not_fit(
    workers, wall, tmp_path, any_memory, monkeypatch
):
    """4 MiB by a table of which half is used."""
    monkeypatch.setattr(search.Search, "_spill", lambda *_: pytest.fail("the table moved to disk"))
    sizes = []
    grow = table.MemoryTable.grow
    monkeypatch.setattr(
        table.MemoryTable, "grow", lambda self, *args: (grow(self, *args), sizes.append((len(self.slots), self.room)))
    )
    build(wall.environment, tmp_path / "space", workers=workers, memory=3 << 20)
    assert_same_files(tmp_path / "space", wall.folder)
    slots, room = sizes[-1]
    assert room > 142_063 > 0.5 * slots and 4 * slots + 8 * room <= 3 << 20


@pytest.mark.long
def test_memory_may_come_and_go_between_sessions(tmp_path, undisturbed, any_memory):
    folder = tmp_path / "space"
    for limit, memory in ((3000, 1 << 16), (9000, None), (15_000, 1 << 16), (25_000, 1 << 20)):
        stop_at(limit, folder, memory=memory)
    build(BREAKOUT, folder, memory=1 << 16)
    assert_same_files(folder, undisturbed["breakout"])


@pytest.mark.long
def test_a_build_on_disk_killed_again_and_again_leaves_no_table_behind(tmp_path, undisturbed, little_memory):
    folder = tmp_path / "space"
    rng = np.random.default_rng(0)
    for _ in range(6):
        process = in_a_child(_build_a_part, BREAKOUT, folder)
        process.join(timeout=rng.uniform(0.05, 0.2))
        kill(process)
        left = {name for name in files_of(folder) if not storage.is_temporary(name)}
        assert left <= {*building.OUR_FILES, "manifest.json"}
    assert_resumes(folder, undisturbed["breakout"])


@pytest.mark.parametrize("num_actions", (2, 1000, 3_000_000, 10**8))
@pytest.mark.parametrize("memory", (1 << 16, 1 << 24, 1 << 34))
def test_a_chunk_has_whole_bytes_of_terminal_bits_and_candidates_that_int32_can_number(num_actions, memory):
    rows = table.rows_of_chunk(memory, 2, num_actions)
    assert rows >= 8 and rows % 8 == 0 and rows * num_actions < 2**31


@pytest.mark.long
def test_indices_widen_while_the_table_is_on_disk(widened, tmp_path, little_memory, monkeypatch):
    monkeypatch.setattr(search, "INT32_STATES", 5000)
    build(BREAKOUT, tmp_path / "space")
    wide, expected = pharos.load(tmp_path / "space"), pharos.load(widened)
    assert isinstance(wide.successors, PackedIndices)
    assert (np.asarray(wide.successors) == np.asarray(expected.successors)).all()
    assert (wide.packed_states == expected.packed_states).all()


@pytest.mark.long
def test_interpreted_rules_are_enumerated_with_the_table_on_disk(tmp_path, undisturbed, little_memory, interpreted):
    assert_resumes(tmp_path / "space", undisturbed["breakout"])


def _build_where_the_table_does_not_fit(env, folder):
    os.posix_fallocate = failing(errno.ENOSPC)
    try:
        build(env, folder, memory=1 << 20)
    except DiskFull as error:
        os._exit(7 if "the table of states: cannot write (No space left" in str(error) else 1)
    os._exit(0)


def test_a_disk_without_room_for_the_table_loses_nothing(wall, tmp_path, any_memory, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 512)
    assert exit_code(_build_where_the_table_does_not_fit, wall.environment, tmp_path / "space") == 7
    assert building.read_manifest(tmp_path / "space")["num_expanded"] > 0
    build(wall.environment, tmp_path / "space")
    assert_same_files(tmp_path / "space", wall.folder)


@pytest.mark.long
def test_a_rule_that_fails_is_blamed_with_the_table_on_disk(tmp_path, little_memory):
    @dataclass(frozen=True, kw_only=True)
    class Overflowing(TableWorld):
        name = "overflowing"

        def transition(self, state, action, out):
            out[0] = state[0] + 1 if state[0] < 1200 else 10**6

        def is_terminal(self, state):
            return False

    with pytest.raises(RuleError, match="declared"):
        build(Overflowing(num_positions=8000), tmp_path / "space")


# Interpreted rules in several processes ------------------------------------------------------------------------------


@pytest.fixture
def interpreted(monkeypatch):
    """Rules that are not compiled: each state is asked."""
    monkeypatch.setattr("pharos.rules.rules.compiled_or_none", lambda *args: None)


@pytest.mark.slow
@pytest.mark.parametrize("env", (BREAKOUT, NARROW), ids=lambda env: env.name)
@pytest.mark.parametrize("workers", (1, 2, 3))
def test_files_do_not_depend_on_processes_that_interpret(env, workers, tmp_path, undisturbed, interpreted):
    build(env, tmp_path / "space", workers=workers)
    assert_same_files(tmp_path / "space", undisturbed[env.name])
    for child in multiprocessing.active_children():
        child.join(PATIENCE)
        assert not child.is_alive()


def test_processes_that_interpret_may_be_killed(tmp_path, undisturbed, interpreted):
    killed = []

    def kill(done):
        if done.num_states > 5000 and not killed:
            killed.extend(multiprocessing.active_children())
            for child in killed:
                os.kill(child.pid, signal.SIGKILL)

    build(BREAKOUT, tmp_path / "space", workers=3, progress=kill, checkpoint_seconds=0.0)
    assert len(killed) == 2
    assert_same_files(tmp_path / "space", undisturbed["breakout"])


def test_a_rule_that_fails_in_another_process_is_blamed(tmp_path, interpreted):
    with pytest.raises(RuleError, match=r"action .* in state .* leads to .* declared"):
        build(Fanning(), tmp_path / "space", workers=2)
    build(Fanning(fails=False), tmp_path / "fine", workers=2)


@dataclass(frozen=True, kw_only=True)
class Fanning(Row):
    """Doubles its level's width at each step; the last state of a wide level leaves its range."""

    length: int = 2**13
    fails: bool = True
    name = "fanning"

    def initial_states(self):
        return [((1,), 1.0)]

    def transition(self, state, action, out):
        place = 2 * state[0] + action
        out[0] = place if place < 2**13 else (2**13 if self.fails and place == 2**14 - 1 else 0)

    def is_terminal(self, state):
        return state[0] == 0


# More than 2^31 states -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def widened(tmp_path_factory) -> Path:
    """A build that passed the limit of 32-bit indices, lowered to 5000 states."""
    folder = tmp_path_factory.mktemp("widened") / "space"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "CHUNK", 512)
        patch.setattr(search, "INT32_STATES", 5000)
        build(BREAKOUT, folder, workers=1)
    return folder


def test_beyond_32_bit_indices_only_the_width_of_the_successors_changes(widened, undisturbed):
    narrow, wide = pharos.load(undisturbed["breakout"]), pharos.load(widened)
    assert sorted(files_of(widened)) == ["lock", "manifest.json", "states.bin", "successors40.bin", "terminal.bin"]
    assert isinstance(wide.successors, PackedIndices)
    assert (wide.successors == narrow.successors).all()
    assert (wide.packed_states == narrow.packed_states).all()
    assert (wide.terminal == narrow.terminal).all()
    assert wide.indices(wide.states()).tolist() == list(range(wide.num_states))


@pytest.mark.long
@pytest.mark.parametrize("limit", (3000, 25_000, 28_000))  # beyond 24,000 the table grows as well
def test_indices_widen_while_threads_are_a_piece_ahead(limit, tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(search, "CHUNK", 512)
    monkeypatch.setattr(search, "WIDE_FOR_THREADS", 16)
    monkeypatch.setattr(search, "INT32_STATES", limit)
    widen, ahead = search.Search._widen_indices, []

    def noted(self, pool):
        ahead.append(self._ahead)
        widen(self, pool)

    monkeypatch.setattr(search.Search, "_widen_indices", noted)
    wide, narrow = build(BREAKOUT, tmp_path / "space", workers=2), pharos.load(undisturbed["breakout"])
    assert len(ahead) == 1 and ahead[0] is not None
    assert (wide.successors == narrow.successors).all()
    assert (wide.packed_states == narrow.packed_states).all()


@pytest.mark.parametrize("limit", (1000, 4000, 6000, 20000))
def test_a_build_that_widens_its_indices_resumes_to_the_same_files(limit, widened, tmp_path, small_blocks, monkeypatch):
    monkeypatch.setattr(search, "INT32_STATES", 5000)
    stop_at(limit, tmp_path / "space")
    build(BREAKOUT, tmp_path / "space", workers=2)
    assert_same_files(tmp_path / "space", widened)


@pytest.mark.long
def test_a_build_that_dies_while_it_widens_its_indices_resumes_to_the_same_files(widened, tmp_path, monkeypatch):
    monkeypatch.setattr(search, "INT32_STATES", 5000)
    monkeypatch.setattr(search, "CHUNK", 512)
    stop_at(3000, tmp_path / "start")
    for call in range(1, 25):
        folder = shutil.copytree(tmp_path / "start", tmp_path / f"space{call}")
        assert exit_code(_build_and_die_at, call, BREAKOUT, folder) == 9
        assert_resumes(folder, widened)


# Disks and other processes -------------------------------------------------------------------------------------------


def _build_with_little_disk(limit, env, folder):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # so that writing fails instead
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        build(env, folder, checkpoint_seconds=0.0)
    except DiskFull as error:
        os._exit(7 if "cannot write" in str(error) else 1)
    os._exit(0)


@pytest.mark.parametrize("limit", (0, 100, 3000, 20_000, 100_000, 200_000))
def test_a_full_disk_loses_nothing(limit, tmp_path, undisturbed, small_blocks):
    folder = tmp_path / "space"
    assert exit_code(_build_with_little_disk, limit, BREAKOUT, folder) == 7
    manifest = building.read_manifest(folder)
    if limit >= 20_000:
        assert 12 * (manifest["num_expanded"] + 2 * 512) > limit  # all that fitted, but for the blocks under way
    assert_resumes(folder, undisturbed["breakout"])


class FullDisk:
    """A disk that has no room from the n-th call of one kind on: a write to a file, an fsync, a rename, or making a
    file.

    Half of the write that fails is on the disk. `freed_at_once`: the next call has room again.
    """

    def __init__(self, monkeypatch, kind: str, call: int, freed_at_once: bool):
        self.kind, self.call, self.freed_at_once = kind, call, freed_at_once
        self.calls = 0
        real_open, real_fsync, real_replace = open, os.fsync, os.replace

        def opened(path, *args, **options):
            name = Path(path).name
            if storage.is_temporary(name):
                name = "manifest.json.tmp"
            if name not in ("lock", "meminfo"):
                self.count("open")
            file = real_open(path, *args, **options)
            return _FileOnFullDisk(file, name, self) if name == self.kind else file

        def fsync(*args):
            self.count("fsync")
            real_fsync(*args)

        def replace(*args):
            self.count("rename")
            real_replace(*args)

        monkeypatch.setattr(writing, "open", opened, raising=False)
        monkeypatch.setattr(storage, "open", opened, raising=False)
        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(os, "replace", replace)

    def count(self, kind: str) -> None:
        if kind == self.kind:
            self.calls += 1
            if self.calls == self.call or (self.calls > self.call and not self.freed_at_once):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class _FileOnFullDisk:
    def __init__(self, file, name: str, disk: FullDisk):
        self.file, self.name, self.disk = file, name, disk

    def write(self, data):
        try:
            self.disk.count(self.name)
        except OSError:
            self.file.write(data[: len(data) // 2])
            time.sleep(0.05)  # the next chunk is handed over meanwhile, and must not be written behind the gap
            raise
        return self.file.write(data)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.file.close()

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.mark.slow
@pytest.mark.parametrize("freed_at_once", (False, True))
@pytest.mark.parametrize("call", (1, 2, 7, 23))
@pytest.mark.parametrize(
    ("kind", "seconds"),
    [(kind, 0.0) for kind in (*DATA, "manifest.json.tmp", "open", "fsync", "rename")] + [(kind, 1e9) for kind in DATA],
)
def test_a_disk_that_is_full_at_any_point_loses_nothing(
    kind, seconds, call, freed_at_once, tmp_path, undisturbed, small_blocks, monkeypatch
):
    folder = tmp_path / "space"
    committed = [0]

    def expanded():  # what a checkpoint has promised so far
        return (building.read_manifest(folder) or {"num_expanded": 0})["num_expanded"]

    with monkeypatch.context() as patch:
        disk = FullDisk(patch, kind, call, freed_at_once)
        with pytest.raises(
            DiskFull, match=r"cannot write \(No space left on device; \d+ MiB free\).*same command resumes"
        ):
            build(BREAKOUT, folder, checkpoint_seconds=seconds, progress=lambda _: committed.append(expanded()))
        assert disk.calls >= call
    kept = expanded()
    assert kept >= max(committed)
    if not freed_at_once and kind != "open":
        with pytest.MonkeyPatch.context() as patch:  # the disk is still full: the same error, and still nothing is lost
            FullDisk(patch, kind, 1, False)
            with pytest.raises(DiskFull):
                build(BREAKOUT, folder, checkpoint_seconds=0.0)
        assert expanded() >= kept
    assert_resumes(folder, undisturbed["breakout"])


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="files are known by their descriptors")
def test_data_are_on_the_disk_before_the_manifest_speaks_of_them(tmp_path, small_blocks, monkeypatch):
    folder = tmp_path / "space"
    calls = []
    fsync, replace, append = os.fsync, os.replace, writing.GrowingFile.append

    def noted_fsync(descriptor):
        calls.append(("sync", Path(os.readlink(f"/proc/self/fd/{descriptor}"))))
        fsync(descriptor)

    def noted_replace(source, target):
        calls.append(("replace", Path(target)))
        replace(source, target)

    def noted_append(self, rows):
        append(self, rows)
        calls.append(("append", self.path))

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(os, "replace", noted_replace)
    monkeypatch.setattr(writing.GrowingFile, "append", noted_append)
    build(BREAKOUT, folder, checkpoint_seconds=0.0)
    commits = [i for i, call in enumerate(calls) if call == ("replace", folder / "manifest.json")]
    assert len(commits) > 5
    for commit in commits:
        before = calls[:commit]
        for name in DATA:
            appended = [i for i, call in enumerate(before) if call == ("append", folder / name)]
            assert ("sync", folder / name) in before[appended[-1] :] if appended else True, name
        kind, path = before[-1]  # the new manifest itself
        assert kind == "sync" and path.parent == folder and storage.is_temporary(path.name)
        assert calls[commit + 1] == ("sync", folder)  # its name


def _hold(env, folder, ready, release):
    def wait(_):
        ready.set()
        release.wait()

    build(env, folder, progress=wait)


def another_build(folder):
    """A process that builds in a folder, and what it waits for."""
    ready, release = fork.Event(), fork.Event()
    process = in_a_child(_hold, BREAKOUT, folder, ready, release)
    ready.wait()
    return process, release


def test_two_builds_do_not_share_a_folder(tmp_path, undisturbed, small_blocks):
    folder = tmp_path / "space"
    process, release = another_build(folder)
    try:
        with pytest.raises(StateSpaceLocked, match=rf"another process \(process {process.pid}\) is building there"):
            build(BREAKOUT, folder)
    finally:
        release.set()
        process.join()
    assert process.exitcode == 0
    assert_same_files(folder, undisturbed["breakout"])


def test_in_the_cache_another_build_is_waited_for(tmp_path, undisturbed, small_blocks, monkeypatch):
    """As the jobs of an array do, whose cache is cold: nobody named that folder."""
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    folder = building.cached_folder(BREAKOUT)
    process, release = another_build(folder)
    warn = warnings.warn
    monkeypatch.setattr(warnings, "warn", lambda *given, **options: (release.set(), warn(*given, **options)))
    with pytest.warns(RuntimeWarning, match="another process is building there; waiting until it is done"):
        build(BREAKOUT, None)
    process.join()
    assert_same_files(folder, undisturbed["breakout"])


def test_a_folder_in_which_somebody_has_just_begun_is_not_foreign(tmp_path, undisturbed, monkeypatch):
    """Its manifest comes between a look for it and a look for what else is there."""
    shutil.copytree(undisturbed["breakout"], tmp_path / "space")
    usual, looks = building.read_manifest, []
    monkeypatch.setattr(
        building, "read_manifest", lambda path: looks.append(path) or (usual(path) if len(looks) > 1 else None)
    )
    build(BREAKOUT, tmp_path / "space")
    assert len(looks) > 1


def test_a_killed_build_leaves_no_lock(tmp_path, undisturbed, small_blocks):
    process, _ = another_build(tmp_path / "space")
    kill(process)
    assert_resumes(tmp_path / "space", undisturbed["breakout"])
