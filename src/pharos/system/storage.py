"""Files that are written whole or not at all: replacement in one step, locks, JSON, digests. Knows no format of pharos.

Every writer of pharos replaces files by `replacing`, `replace_file` or `replace_json`: whoever reads, and whatever
happens to the machine, finds the old file or the new one. A new file is written beside the old one under a name that
holds the host, the process and a random number, so that two machines that share a file system never write to the same
file.

What pharos can make again is kept in PHAROS_CACHE_DIR, else in the user's cache directory (`cache_directory`).
"""

import atexit
import contextlib
import errno
import json
import math
import os
import re
import shutil
import socket
import stat
import sys
import tempfile
import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import xxhash

from pharos.errors import FileFormatError, FolderLocked, ParameterError, PharosError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

LOCK = "lock"
CLAIM = "lock.claim"
"""File that stands in for a lock where the file system has none: the process that makes it holds the folder."""
LOCK_POLL_SECONDS = 0.2
CLAIM_ATTEMPTS = 200

DIGEST = "digest"
DIGEST_BLOCK_BYTES = 1 << 24

_HELD = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)
_UNSUPPORTED = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)
_LEFTOVER_SECONDS = 86400.0


# Replacing files ------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def replacing(path: str | os.PathLike, *, durable: bool = True, follow: bool = False) -> Iterator[BinaryIO]:
    """Open a file for writing that takes the place of `path` when the block ends, and never if it raises.

    Args:
        path: a symbolic link, a pipe or a device there is replaced, so that a folder of results that somebody else has
            made decides about no file elsewhere.
        follow: whether it is a path that the user named: a link is followed, a pipe or a device written to.
        durable: the new file is on the disk before it has its name, and the name before this returns.
    Raises:
        OSError: the file cannot be written. An older one of that name is then as it was.
    """
    path = Path(path)
    if follow and _is_special(path):
        with open(path, "wb") as file:
            yield file
        return
    path = Path(os.path.realpath(path)) if follow else path
    remove_leftovers(path)
    temporary = temporary_path(path)
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            if durable:
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if durable:
            sync(path.parent)
    except OSError as error:
        if error.filename in (None, str(temporary), temporary):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def replace_file(path: str | os.PathLike, data: bytes | str, *, durable: bool = True, follow: bool = False) -> None:
    """Replace a file by these bytes, or by this text in UTF-8, in one step, see `replacing`."""
    with replacing(path, durable=durable, follow=follow) as file:
        file.write(data.encode() if isinstance(data, str) else data)


def replace_json(path: str | os.PathLike, value: object, *, durable: bool = True) -> None:
    """Replace a file by a value in JSON (see `json_text`), in one step, see `replacing`."""
    replace_file(path, json_text(value) + "\n", durable=durable)


def replace_array(path: str | os.PathLike, array: object, *, follow: bool = False) -> None:
    """Replace a file by an array as .npy, in one step, see `replacing`.

    NumPy writes to a real file by C's `fwrite` and does not notice a full disk at its end, so it gets no real file
    here.
    """
    import numpy as np

    with replacing(path, follow=follow) as file:
        np.lib.format.write_array(_Writer(file), np.asanyarray(array), allow_pickle=False)


class _Writer:
    """The method `write` of a file, and nothing else."""

    def __init__(self, file: BinaryIO):
        self.write = file.write


def inside(root: Path, *names: str) -> Path:
    """The path of a folder within a folder of results. A symbolic link on the way below `root` is removed."""
    path = root
    for name in names:
        path = path / name
        if path.is_symlink():
            path.unlink()
    return path


def own_file(path: str, flags: int) -> int:
    """Opener of `open` for a file in a folder of results: a symbolic link there is replaced, never followed."""
    if flags & os.O_CREAT and os.path.islink(path):
        os.unlink(path)
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def check_name(name: str, context: str = "name") -> str:
    """Return a name that is fit for a file: at most 128 letters, digits and `._-`, and a letter or digit first.

    Raises:
        ParameterError: it is another one, such as one that leads out of a folder.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{,127}", name):
        raise ParameterError(
            f"{context} is {name[:60]!r}; expected at most 128 letters, digits and ._-, and a letter or a digit first"
        )
    return name


def is_full(error: BaseException) -> bool:
    """Whether an error says that the disk, or the user's part of it, is full."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def sync(path: Path) -> None:
    """Wait until a file, or the list of files of a folder, is on the disk."""
    is_folder = path.is_dir()
    if is_folder and os.name == "nt":
        return
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:  # some file systems do not sync folders, and some folders cannot be read
        if not is_folder or error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EACCES):
            raise


def write_out(descriptor: int, start: int, size: int) -> None:
    """Ask the system to begin writing a part of a file to the disk, so that a later fsync has less to wait for.

    It waits for nothing and promises nothing. If the system has no such call (only Linux has it), nothing happens.
    """
    call = _sync_file_range()
    if call is not None:
        call(descriptor, start, size, _BEGIN)


_BEGIN = 2  # SYNC_FILE_RANGE_WRITE


@cache
def _sync_file_range() -> Callable[[int, int, int, int], int] | None:
    import ctypes

    try:
        call = ctypes.CDLL(None).sync_file_range
    except (OSError, AttributeError, TypeError):
        return None
    call.argtypes = [ctypes.c_int, ctypes.c_int64, ctypes.c_int64, ctypes.c_uint]
    return call


def temporary_path(path: Path) -> Path:
    """A name beside `path` that no other process of any machine has: .NAME.HOST.PROCESS.RANDOM.tmp."""
    return path.with_name(f"{_temporary_prefix(path)}{_host()}.{os.getpid()}.{uuid.uuid4().hex[:12]}.tmp")


def is_temporary(name: str) -> bool:
    """Whether a file of this name is one that `replacing` writes, or left behind when its process was killed."""
    parts = name.split(".")
    return len(parts) >= 6 and not parts[0] and parts[-1] == "tmp" and parts[-3].isdigit() and len(parts[-2]) == 12


def remove_leftovers(path: Path) -> None:
    """Remove unfinished replacements of `path` by processes of this machine that are gone, or older than a day.

    `replacing` does it before it begins. Cost: a listing of the folder.
    """
    with contextlib.suppress(OSError):
        for name in os.listdir(path.parent):
            if name.startswith(_temporary_prefix(path)) and is_temporary(name):
                _remove_leftover(path.with_name(name))


def _remove_leftover(leftover: Path) -> None:
    host, process = leftover.name.split(".")[-4:-2]
    with contextlib.suppress(OSError):
        old = time.time() - leftover.stat().st_mtime > _LEFTOVER_SECONDS
        if old or (host == _host() and not _is_alive(int(process))):
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()


def _temporary_prefix(path: Path) -> str:
    return f".{path.name[:100]}."


def _is_special(path: Path) -> bool:
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def _host() -> str:
    """The name of this machine, as part of a file's name."""
    return "".join(c if c.isalnum() or c in "-_" else "-" for c in socket.gethostname())[:40] or "localhost"


def _is_alive(process: int) -> bool:
    """Whether a process of this machine is alive. True if that is unknown."""
    if os.name == "nt":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    try:
        text = Path(f"/proc/{process}/stat").read_text(errors="replace")
    except OSError:  # no Linux
        return True
    return text.rpartition(")")[2].split()[0] not in ("Z", "X")  # it is over, but its parent has not asked yet


# Locks ----------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def lock(folder: Path, error: type[PharosError] = FolderLocked, activity: str = "at work") -> Iterator[None]:
    """Hold a folder for this process: by `flock` on its file `lock`, so that a process that is killed holds nothing.

    If the file system has no such locks (ENOSYS, ENOLCK, EOPNOTSUPP: Lustre without `-o flock`, some network file
    systems), the folder is held by a file `lock.claim` that only one process can make. It says who made it. One whose
    process is gone is removed by the next process of the same machine. From another machine nobody can tell, so the
    error names the file.

    Args:
        folder: exists.
        error, activity: raised if another process holds the folder: "another process (process 7) is `activity`
            there".
    Raises:
        ParameterError: the folder cannot be written to, or cannot be locked at all.
    """
    path = folder / LOCK
    try:
        if path.exists() and not path.is_symlink():
            check_regular(path)
        file = open(path, "a+", opener=own_file)  # noqa: SIM115
    except OSError as problem:
        raise ParameterError(f"{folder}: cannot be written to: {problem.strerror}; choose another folder") from problem
    with file:
        if not _flock(file, folder, error, activity):
            with hold_claim(folder / CLAIM, error, activity):
                yield
            return
        if not _is_at(path, file):  # who held it has removed it, and another may hold a new one
            raise error(_held(folder, "", activity))
        file.truncate(0)
        with contextlib.suppress(OSError):  # a full disk: the name of the holder is a courtesy
            os.write(file.fileno(), _holder().encode())
        try:
            yield
        finally:
            file.truncate(0)


def _is_at(path: Path, file: TextIO) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def waiting_lock(
    folder: Path, error: type[PharosError], activity: str, on_wait: Callable[[str], Any]
) -> contextlib.ExitStack:
    """Hold a folder as `lock` does, waiting while another process holds it. `on_wait` is called once, with a line.

    Returns:
        A context in which the folder is held, already entered: `with waiting_lock(...):`.
    """
    held, is_announced = contextlib.ExitStack(), False
    while True:
        try:
            held.enter_context(lock(folder, error, activity))
            return held
        except error:
            if not is_announced:
                on_wait(f"{folder}: another process is {activity} there; waiting until it is done")
                is_announced = True
            time.sleep(LOCK_POLL_SECONDS)


def _flock(file: TextIO, folder: Path, error: type[PharosError], activity: str) -> bool:
    """Take the lock. False if the file system has none."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as problem:
        if problem.errno in _HELD:
            file.seek(0)
            raise error(_held(folder, file.read().strip(), activity)) from None
        if problem.errno in _UNSUPPORTED:
            return False
        raise ParameterError(f"{folder}: cannot be locked: {problem.strerror}; choose another folder") from problem
    return True


def has_no_locks(problem: OSError) -> bool:
    """Whether an error means that the file system has no locks."""
    return problem.errno in _UNSUPPORTED


@contextlib.contextmanager
def hold_claim(path: Path, error: type[PharosError], activity: str) -> Iterator[None]:
    """Hold the folder of `path` by making that file, which only one process can, see `lock`."""
    folder = path.parent
    mine = f"{_holder()}, {uuid.uuid4().hex}"
    for _ in range(CLAIM_ATTEMPTS):
        if _create(path, mine):
            break
        holder = _text(path)
        if holder is not None and not _is_of_a_dead_process(holder):
            message = _held(folder, holder.split(",")[0], activity)
            raise error(f"{message}; if it is gone, delete {path}")
        if holder is not None:
            _remove_claim(path, holder)
    else:
        raise error(f"{_held(folder, '', activity)}; if there is none, delete {path} and {_guard_of(path)}")
    try:
        yield
    finally:
        if _text(path) == mine:
            path.unlink(missing_ok=True)


def _create(path: Path, text: str) -> bool:
    """Make a file that is not there. False if it is."""
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
    except FileExistsError:
        return False
    try:
        os.write(descriptor, text.encode())
    except OSError:
        path.unlink(missing_ok=True)
        raise
    finally:
        os.close(descriptor)
    return True


def _remove_claim(path: Path, holder: str) -> None:
    """Remove the claim of a process that is gone. Only one process at a time removes, and only what it has read."""
    guard = _guard_of(path)
    if not _create(guard, _holder()):
        time.sleep(0.01)
        return
    try:
        if _text(path) == holder:
            path.unlink(missing_ok=True)
    finally:
        guard.unlink(missing_ok=True)


def _guard_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.removal")


def _holder() -> str:
    return f"process {os.getpid()} on {_host()}"


def _is_of_a_dead_process(holder: str) -> bool:
    words = holder.split(",")[0].split()
    return len(words) == 4 and words[1].isdigit() and words[3] == _host() and not _is_alive(int(words[1]))


def _held(folder: Path, holder: str, activity: str) -> str:
    holder = holder.removesuffix(f" on {_host()}")
    return (
        f"{folder}: another process{f' ({holder})' if holder else ''} is {activity} there; "
        f"wait for it, or use another folder"
    )


def _text(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return None


# JSON and digests -----------------------------------------------------------------------------------------------------


def json_text(value: object) -> str:
    """A value in JSON: arrays are lists, and numbers that JSON cannot say (NaN, infinity) are null.

    Raises:
        TypeError: it holds something else than numbers, text, lists, arrays and mappings.
    """
    return json.dumps(plain(value), indent=1, allow_nan=False)


def plain(value: object) -> Any:
    """A value as JSON has it: mappings with names, lists, text, finite numbers and None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_regular(path: str | os.PathLike) -> None:
    """Refuse what is there and is no regular file: a pipe, a socket or a device, which may never end.

    Every reader of a file that somebody else may have written calls it before the file is opened.

    Raises:
        OSError: it is none, or there is nothing, as `strerror` says.
    """
    try:
        is_regular = stat.S_ISREG(os.stat(path).st_mode)
    except ValueError as error:  # a zero in its name
        raise FileNotFoundError(errno.ENOENT, f"{error}", ascii(os.fspath(path))) from None
    if not is_regular:
        raise OSError(errno.EINVAL, "it is no regular file", os.fspath(path))


def read_json(path: str | os.PathLike, error: type[PharosError] = FileFormatError, advice: str = "") -> Any:
    """The value that a file of JSON holds.

    Args:
        error, advice: raised if the file is none, in one line that ends with the advice.
    Raises:
        FileNotFoundError: there is no such file.
    """
    advice = f"; {advice}" if advice else ""
    try:
        check_regular(path)
        data = Path(path).read_bytes()
    except (FileNotFoundError, NotADirectoryError) as problem:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path)) from problem
    except OSError as problem:
        raise error(f"{path}: cannot be read: {problem.strerror}{advice}") from None
    try:
        return json.loads(data)
    except RecursionError:
        raise error(f"{path}: is no JSON that pharos reads: its lists or objects are nested too deep{advice}") from None
    except UnicodeDecodeError as problem:
        raise error(f"{path}: cannot be read as JSON: {problem}{advice}") from None
    except ValueError as problem:
        raise error(f"{path}: is no JSON, or was cut short: {' '.join(str(problem).split())}{advice}") from None


def digest_of_json(value: object) -> str:
    """XXH3-128 of a value as compact JSON with sorted keys. NaN and infinity are null."""
    text = json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return xxhash.xxh3_128_hexdigest(text.encode())


def digest_of_bytes(data: bytes | memoryview) -> str:
    """XXH3-128 of bytes."""
    return xxhash.xxh3_128_hexdigest(data)


def digest_of_file(path: str | os.PathLike, block_bytes: int = DIGEST_BLOCK_BYTES) -> str:
    """XXH3-128 of a file, read in blocks."""
    digest = xxhash.xxh3_128()
    check_regular(path)
    with open(path, "rb") as file:
        while block := file.read(block_bytes):
            digest.update(block)
    return digest.hexdigest()


def sealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """A record, as JSON has it, with the digest of its other entries under the key `digest`."""
    content = {key: value for key, value in plain(record).items() if key != DIGEST}
    return {**content, DIGEST: digest_of_json(content)}


def is_intact(record: Mapping[str, Any]) -> bool:
    """Whether a record is as it was when it was sealed.

    True for one without a digest, as older versions wrote them.
    """
    content = {key: value for key, value in record.items() if key != DIGEST}
    return DIGEST not in record or record[DIGEST] == digest_of_json(content)


class ResultCache:
    """A folder of results, each sealed in a file that is named by a digest of its dependencies."""

    def __init__(self, folder: Path):
        self.folder = folder

    def file(self, dependencies: Mapping[str, Any]) -> Path:
        """The file of the result that depends on this, JSON-able."""
        return self.folder / f"{xxhash.xxh3_64_hexdigest(json.dumps(dependencies, sort_keys=True).encode())}.json"

    def get(self, dependencies: Mapping[str, Any]) -> dict[str, Any] | None:
        """The entries of a result. None if there is none, or if its file was changed."""
        try:
            record = read_json(self.file(dependencies))
            entries = record.get("task", record)  # as values of 0.1.0 have it
            is_ours = DIGEST in record and all(entries.get(name) == value for name, value in dependencies.items())
            return record if is_ours and is_intact(record) else None
        except (FileNotFoundError, FileFormatError, AttributeError, TypeError):
            return None

    def put(self, dependencies: Mapping[str, Any], **entries: object) -> None:
        """Write a result, sealed."""
        self.folder.mkdir(parents=True, exist_ok=True)
        replace_json(self.file(dependencies), sealed({**dependencies, **entries}))


# Folders that can be made again ---------------------------------------------------------------------------------------


_temporary: list[Path] = []


def cache_directory() -> Path:
    """The folder of cached state spaces and compiled code: PHAROS_CACHE_DIR, else `pharos` in the user's cache.

    If there is no such folder and none can be made (no home, or one that cannot be written to, as in containers), it
    is a temporary one for this process and the processes that it starts.
    """
    if folder := os.environ.get("PHAROS_CACHE_DIR"):
        return Path(folder).expanduser()
    try:
        directory, problem = _of_user(), ""
    except RuntimeError:
        directory, problem = None, "there is no home directory"
    if directory is not None:
        problem = _problem_of(directory)
    if directory is None or problem:
        directory = temporary_folder("pharos-")
        os.environ["PHAROS_CACHE_DIR"] = str(directory)
        warnings.warn(
            f"{problem}; state spaces and compiled code go to a temporary folder and are deleted on exit: "
            f"to keep them set PHAROS_CACHE_DIR",
            RuntimeWarning,
            stacklevel=2,
        )
    return directory


def _of_user() -> Path:
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "pharos"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "pharos" / "Cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pharos"


@cache
def _problem_of(folder: Path) -> str:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return f"the cache {folder} cannot be made ({error.strerror})"
    return "" if os.access(folder, os.W_OK | os.X_OK) else f"the cache {folder} cannot be written to"


def temporary_folder(prefix: str) -> Path:
    """A new folder that only this user can read, and that is deleted when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    _temporary.append(folder)
    atexit.register(_delete, folder, os.getpid())
    return folder


def _delete(folder: Path, process: int) -> None:
    """Delete a temporary folder, unless this is a fork of the process that made it."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


def is_cache_temporary() -> bool:
    """Whether something of this process is kept no longer than the process."""
    return bool(_temporary)


def compiled_folders(cache: Path) -> list[Path]:
    """Folders for compiled rules in a cache, best first: `compiled-NUMBER` is used if another user has the first."""
    users = [cache / f"compiled-{os.getuid()}"] if hasattr(os, "getuid") else []
    return [cache / "compiled", *users]
