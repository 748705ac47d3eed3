"""Where pharos keeps what it can make again: PHAROS_CACHE_DIR, else the user's cache directory."""

import os
import sys
from pathlib import Path


def cache_directory() -> Path:
    """The folder of cached state spaces and compiled rules: PHAROS_CACHE_DIR, else `pharos` in the user's cache."""
    if chosen := os.environ.get("PHAROS_CACHE_DIR"):
        return Path(chosen).expanduser()
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "pharos"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "pharos" / "Cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pharos"


def compiled_folders(cache: Path) -> list[Path]:
    """Where compiled rules may be in a cache, the first choice first: `compiled-NUMBER` where another user has that."""
    users = [cache / f"compiled-{os.getuid()}"] if hasattr(os, "getuid") else []
    return [cache / "compiled", *users]
