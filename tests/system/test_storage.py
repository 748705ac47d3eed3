"""Replacement in one step, locks on file systems with and without them, JSON and digests."""

import errno
import json
import math
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from children import exit_code, fork, in_a_child, kill
from patience import PATIENCE
from pharos.errors import FileFormatError, FolderLocked, ParameterError, StateSpaceLocked
from pharos.system import storage
from refusals import failing
from strategies import examples

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# Replacing files -----------------------------------------------------------------------------------------------------


def test_a_file_that_cannot_be_written_whole_leaves_the_old_one(tmp_path):
    file = tmp_path / "kept"
    storage.replace_file(file, "old")
    with pytest.raises(RuntimeError), storage.replacing(file) as out:
        out.write(b"half")
        raise RuntimeError
    assert file.read_text() == "old" and names(tmp_path) == ["kept"]


def _write_with_little_disk(limit, file):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        storage.replace_file(file, b"x" * 20_000)
    except OSError as error:
        os._exit(7 if error.filename == str(file) and error.errno == errno.EFBIG else 1)
    os._exit(0)


@pytest.mark.parametrize("limit", (0, 100, 10_000))
def test_a_full_disk_leaves_the_old_file_and_names_it(limit, tmp_path):
    file = tmp_path / "kept"
    file.write_text("old")
    assert exit_code(_write_with_little_disk, limit, file) == 7
    assert file.read_text() == "old" and names(tmp_path) == ["kept"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_file_has_its_name_only_once_it_is_on_the_disk(call, tmp_path, monkeypatch):
    file = tmp_path / "kept"
    file.write_text("old")
    monkeypatch.setattr(os, call, failing(errno.ENOSPC))
    with pytest.raises(OSError, match="No space left"):
        storage.replace_file(file, "new")
    assert file.read_text() == "old" and names(tmp_path) == ["kept"]


def test_writers_with_the_same_process_number_do_not_meet(tmp_path, monkeypatch):
    """As in containers, where each runner is process 1."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    errors = []

    def write(text):
        for _ in range(300):
            try:
                storage.replace_file(tmp_path / "status.json", text * 1000, durable=False)
            except OSError as error:
                errors.append(error)

    threads = [threading.Thread(target=write, args=(text,)) for text in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert (tmp_path / "status.json").read_text() in ("a" * 1000, "b" * 1000)
    assert names(tmp_path) == ["status.json"]


def test_links_and_devices_that_the_user_named_are_written_through(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "file").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real" / "file")
    storage.replace_file(tmp_path / "link", "new", follow=True)
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real" / "file").read_text() == "new"
    code = "from pharos.system import storage; storage.replace_file('/dev/stdout', 'hello', follow=True)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "hello"


WRITERS = {
    "file": lambda path: storage.replace_file(path, "new"),
    "JSON": lambda path: storage.replace_json(path, {}),
    "array": lambda path: storage.replace_array(path, np.zeros(2)),
    "growing": lambda path: open(path, "w+b", opener=storage.own_file).close(),
    "log": lambda path: open(path, "ab", opener=storage.own_file).close(),
    "lock": lambda path: storage.lock(path.parent).__enter__(),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("leads_to", ["a file", "nothing", "a device", "a folder"])
def test_links_in_a_folder_of_results_are_replaced(name, leads_to, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "other").mkdir()
    target = {"a file": "victim", "nothing": "none", "a device": "/dev/full", "a folder": "other"}[leads_to]
    link = tmp_path / "results" / "lock"
    link.symlink_to(tmp_path / target)
    WRITERS[name](link)
    assert link.is_file() and not link.is_symlink()
    assert (tmp_path / "victim").read_text() == "precious" and names(tmp_path) == ["other", "results", "victim"]
    assert names(tmp_path / "other") == [] and names(tmp_path / "results") == ["lock"]


def test_a_file_that_goes_on_is_not_one_behind_a_link(tmp_path):
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "link").symlink_to("victim")
    with pytest.raises(OSError, match="symbolic link"), open(tmp_path / "link", "r+b", opener=storage.own_file):
        pass


def test_folders_behind_links_are_none_of_the_results(tmp_path):
    (tmp_path / "elsewhere" / "b").mkdir(parents=True)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "a").symlink_to(tmp_path / "elsewhere")
    place = storage.inside(tmp_path / "results", "a", "b")
    assert place == tmp_path / "results" / "a" / "b" and not place.exists() and (tmp_path / "elsewhere" / "b").is_dir()
    (tmp_path / "named").symlink_to(tmp_path / "results")
    assert storage.inside(tmp_path / "named", "a") == tmp_path / "named" / "a" and (tmp_path / "named").is_symlink()


def test_names_that_lead_out_of_a_folder_are_refused():
    for name in ("v1", "deep_sea-6", "4x4.plain", "A"):
        assert storage.check_name(name) == name
    wrong = ["", ".", "..", "../x", "/x", "a/b", "a\nb", "a\n", "a\0b", ".a", "-a", " a", "a b", "\u00e4", "a\x1b[2J"]
    for name in (*wrong, "a" * 129):
        with pytest.raises(ParameterError, match="expected at most 128 letters") as error:
            storage.check_name(name, "the name of a task")
        assert "\n" not in str(error.value)


def test_pipes_devices_sockets_and_folders_are_no_regular_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
        for path in (tmp_path / "pipe", tmp_path / "socket", tmp_path, "/dev/zero"):
            with pytest.raises(OSError, match="no regular file"):
                storage.check_regular(path)
    with pytest.raises(FileNotFoundError):
        storage.check_regular("a\0b")


def test_leftovers_of_killed_processes_are_removed_and_others_stay(tmp_path):
    file = tmp_path / "kept.json"

    def die():
        with storage.replacing(file) as out:
            out.write(b"half")
            os.kill(os.getpid(), signal.SIGKILL)

    process = in_a_child(die)
    process.join()
    assert len(names(tmp_path)) == 1 and storage.is_temporary(names(tmp_path)[0])
    alive = storage.temporary_path(file)
    elsewhere = tmp_path / f".kept.json.another-machine.{process.pid}.0123456789ab.tmp"
    other = storage.temporary_path(tmp_path / "other")
    for path in (alive, elsewhere, other):
        path.write_text("being written")
    storage.remove_leftovers(file)
    assert names(tmp_path) == sorted([alive.name, elsewhere.name, other.name])
    os.utime(elsewhere, (0, 0))
    storage.remove_leftovers(file)
    assert names(tmp_path) == sorted([alive.name, other.name])


# Locks ---------------------------------------------------------------------------------------------------------------


def _hold(folder, ready, release):
    with storage.lock(folder):
        ready.set()
        release.wait()


@pytest.fixture(params=["flock", "ENOSYS", "ENOLCK", "EOPNOTSUPP"])
def locks(request, monkeypatch):
    """File systems that lock, and those that answer that they do not."""
    if request.param != "flock":
        monkeypatch.setattr(storage.fcntl, "flock", failing(getattr(errno, request.param)))


@pytest.fixture
def no_locks(monkeypatch):
    monkeypatch.setattr(storage.fcntl, "flock", failing(errno.ENOSYS))


@pytest.fixture
def holder(locks, tmp_path):
    """A process that holds the folder, and what releases it."""
    ready, release = fork.Event(), fork.Event()
    process = in_a_child(_hold, tmp_path, ready, release)
    ready.wait()
    return process, release


def test_one_process_holds_a_folder_until_it_ends(holder, tmp_path):
    process, release = holder
    for error, activity in ((FolderLocked, "at work"), (StateSpaceLocked, "building")):
        with (
            pytest.raises(error, match=rf"another process \(process {process.pid}\) is {activity} there; wait for it"),
            storage.lock(tmp_path, error, activity),
        ):
            raise AssertionError
    release.set()
    process.join()
    with storage.lock(tmp_path):
        pass
    assert names(tmp_path) == ["lock"] and (tmp_path / "lock").read_text() == ""


def test_a_lock_that_its_holder_has_removed_holds_nothing(tmp_path, monkeypatch):
    """Another process may hold the new one of that name."""
    usual = storage.fcntl.flock
    monkeypatch.setattr(storage.fcntl, "flock", lambda file, how: (tmp_path / "lock").unlink() or usual(file, how))
    with pytest.raises(FolderLocked), storage.lock(tmp_path):
        raise AssertionError
    monkeypatch.undo()
    with storage.lock(tmp_path):
        assert names(tmp_path) == ["lock"]


def test_a_process_that_is_killed_holds_nothing(holder, tmp_path):
    kill(holder[0])
    for _ in range(2):
        with storage.lock(tmp_path):
            pass
    assert names(tmp_path) == ["lock"]


def test_a_claim_of_another_machine_is_left_alone_and_named(no_locks, tmp_path):
    (tmp_path / storage.CLAIM).write_text("process 1 on another-machine, 0123")
    with (
        pytest.raises(FolderLocked, match=r"\(process 1 on another-machine\).*if it is gone, delete .*lock\.claim"),
        storage.lock(tmp_path),
    ):
        raise AssertionError
    assert names(tmp_path) == ["lock", "lock.claim"]


def test_a_claim_that_cannot_be_removed_is_said_to_be_there(no_locks, tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "CLAIM_ATTEMPTS", 3)
    dead = in_a_child(int)
    dead.join()
    (tmp_path / storage.CLAIM).write_text(f"process {dead.pid} on {storage._host()}, 0123")
    (tmp_path / "lock.claim.removal").write_text("killed in the middle of it")
    with pytest.raises(FolderLocked, match=r"delete .*lock\.claim and .*removal"), storage.lock(tmp_path):
        raise AssertionError


def _count(folder, times, counter):
    done, deadline = 0, time.monotonic() + PATIENCE
    while done < times and time.monotonic() < deadline:
        try:
            with storage.lock(folder):
                value = int(counter.read_text())
                counter.write_text(str(value + 1))
                done += 1
                if done == times // 2:
                    os.kill(os.getpid(), signal.SIGKILL)
        except FolderLocked:
            continue


@pytest.mark.long
def test_processes_with_claims_never_hold_a_folder_together(no_locks, tmp_path):
    """Half of them are killed while they hold it, so that others race to take the claim over."""
    folder, counter = tmp_path / "folder", tmp_path / "counter"
    folder.mkdir()
    counter.write_text("0")
    for process in [in_a_child(_count, folder, 100, counter) for _ in range(6)]:
        process.join()
    assert int(counter.read_text()) == 6 * 50


def test_a_lock_that_fails_otherwise_is_no_lock_of_another(tmp_path, monkeypatch):
    monkeypatch.setattr(storage.fcntl, "flock", failing(errno.EIO))
    with pytest.raises(ParameterError, match="cannot be locked: Input/output error"), storage.lock(tmp_path):
        raise AssertionError


# JSON and digests ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@examples(100, value=st.dictionaries(st.text(max_size=5), values, max_size=4))
def test_what_is_written_as_json_comes_back_and_is_intact(tmp_path_factory, value):
    file = tmp_path_factory.mktemp("json") / "value.json"
    record = storage.sealed(value)
    storage.replace_json(file, record, durable=False)
    back = storage.read_json(file)
    assert back == record and storage.is_intact(back)
    assert {**back, "digest": 0} == {**value, "digest": 0}
    back["added"] = not back.get("added")
    assert not storage.is_intact(back)


def test_numbers_that_json_cannot_say_are_null():
    value = {"a": math.nan, "b": [math.inf, np.float64(2.5), np.arange(3)], 3: (True, None)}
    assert json.loads(storage.json_text(value)) == {"a": None, "b": [None, 2.5, [0, 1, 2]], "3": [True, None]}
    assert storage.is_intact(json.loads(storage.json_text(storage.sealed(value))))
    with pytest.raises(TypeError):
        storage.json_text({"a": object()})


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b'{"a": 1', "is no JSON, or was cut short"),
        (b"", "is no JSON, or was cut short"),
        (b"\xff\xfe\x01", "cannot be read as JSON"),
        (b"[" * 100_000, "nested too deep"),
    ],
)
def test_what_is_no_json_is_said_in_one_line(data, message, tmp_path):
    (tmp_path / "x.json").write_bytes(data)
    with pytest.raises(FileFormatError, match=message) as caught:
        storage.read_json(tmp_path / "x.json", advice="write it again")
    assert str(tmp_path / "x.json") in str(caught.value) and "\n" not in str(caught.value)
    assert str(caught.value).endswith("; write it again")
    with pytest.raises(FileFormatError, match="cannot be read: it is no regular file"):
        storage.read_json(tmp_path)
    with pytest.raises(FileNotFoundError):
        storage.read_json(tmp_path / "none.json")


def test_a_file_has_the_digest_of_its_bytes(tmp_path):
    data = bytes(range(256)) * 10
    (tmp_path / "x").write_bytes(data)
    assert storage.digest_of_file(tmp_path / "x", block_bytes=100) == storage.digest_of_bytes(data)


def test_nothing_heavy_is_loaded():
    code = "import sys, pharos.system.storage; print([n for n in ('numba', 'scipy', 'pandas') if n in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
    assert Path(storage.__file__).name == "storage.py"


def test_what_is_appended_is_sent_on_to_the_disk_without_gaps(tmp_path, monkeypatch):
    from pharos.state_space.manifest import SENT_BYTES, GrowingFile

    sent = []
    monkeypatch.setattr(storage, "write_out", lambda descriptor, start, size: sent.append((start, start + size)))
    file = GrowingFile(tmp_path / "file")
    for _ in range(5):
        file.append(np.zeros(SENT_BYTES // 8 // 2 + 1))
    file.close()
    assert len(sent) == 2 and sent[0][0] == 0
    assert sent[0][1] == sent[1][0]


def test_asking_the_system_to_write_out_changes_nothing_and_fails_nowhere(tmp_path, monkeypatch):
    with open(tmp_path / "file", "wb", buffering=0) as file:
        file.write(b"abc")
        storage.write_out(file.fileno(), 0, 3)
        storage.write_out(-1, 0, 3)
        monkeypatch.setattr(storage, "_sync_file_range", lambda: None)
        storage.write_out(file.fileno(), 0, 3)
    assert (tmp_path / "file").read_bytes() == b"abc"
