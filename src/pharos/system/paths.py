"""Where pharos keeps what it can make again: PHAROS_CACHE_DIR, else the user's cache directory."""

import atexit
import os
import shutil
import sys
import tempfile
import warnings
from functools import cache
from pathlib import Path

_temporary: list[Path] = []


def cache_directory() -> Path:
    """The folder of cached state spaces and compiled code: PHAROS_CACHE_DIR, else `pharos` in the user's cache.

    Where there is no such folder and none can be made (no home, or one that cannot be written to, as in containers), it
    is a temporary one for this process and those that it starts.
    """
    if chosen := os.environ.get("PHAROS_CACHE_DIR"):
        return Path(chosen).expanduser()
    try:
        place, problem = _of_user(), ""
    except RuntimeError:
        place, problem = None, "there is no home directory"
    if place is not None:
        problem = _problem_of(place)
    if place is None or problem:
        place = temporary_folder("pharos-")
        os.environ["PHAROS_CACHE_DIR"] = str(place)
        warnings.warn(
            f"{problem}; state spaces and compiled code go to a temporary folder and are gone at the end: "
            f"to keep them set PHAROS_CACHE_DIR",
            RuntimeWarning,
            stacklevel=2,
        )
    return place


def _of_user() -> Path:
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "pharos"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "pharos" / "Cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pharos"


@cache
def _problem_of(place: Path) -> str:
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return f"the cache {place} cannot be made ({error.strerror})"
    return "" if os.access(place, os.W_OK | os.X_OK) else f"the cache {place} cannot be written to"


def temporary_folder(prefix: str) -> Path:
    """A new folder that only this user can read, and that is deleted when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    _temporary.append(folder)
    atexit.register(_delete, folder, os.getpid())
    return folder


def _delete(folder: Path, process: int) -> None:
    """Unless this is a fork of the process that made it."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


def is_temporary() -> bool:
    """Whether something of this process is kept no longer than the process."""
    return bool(_temporary)


def compiled_folders(cache: Path) -> list[Path]:
    """Where compiled rules may be in a cache, the first choice first: `compiled-NUMBER` where another user has that."""
    users = [cache / f"compiled-{os.getuid()}"] if hasattr(os, "getuid") else []
    return [cache / "compiled", *users]
