"""Compiled kernels on disk: one file for each kernel and each signature, in a folder that nobody else can write to.

Reading such a file runs what is in it (it is a pickle, and machine code), so the folder is private to its user. Damage
is noticed by a checksum: a damaged file is deleted, and the kernel is compiled again.
"""

import contextlib
import hashlib
import os
import pickle
import stat
import sys
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from pharos.system import paths, storage
from pharos.system.paths import compiled_folders

DIGEST_BYTES = 32


class KernelCache(NullCache):
    """What Numba asks for compiled code: `load_overload` and `save_overload` of one kernel.

    Args:
        path: of the files, without what tells one signature from another.
    """

    def __init__(self, path: Path):
        self.path = path

    @property
    def cache_path(self) -> str:
        return str(self.path.parent)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel; None where there is none, or a damaged one, which is deleted."""
        target_context.refresh()
        file = self._file(sig, target_context.codegen())
        try:
            data = file.read_bytes()
        except OSError:
            return None
        try:
            if hashlib.sha256(data[DIGEST_BYTES:]).digest() != data[:DIGEST_BYTES]:
                raise ValueError("it was changed after it was written")
            return CompileResult._rebuild(target_context, *pickle.loads(data[DIGEST_BYTES:]))
        except Exception:  # whatever is wrong with it: the kernel is compiled again
            with contextlib.suppress(OSError):
                file.unlink()
            return None

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Keep a compiled kernel, where there is room: the next process compiles again where there is none."""
        if cres.lifted or cres.library.has_dynamic_globals:  # it refers to addresses of this process
            return
        data = dumps(cres._reduce())
        file = self._file(sig, cres.codegen)
        with contextlib.suppress(OSError):
            storage.replace_file(file, hashlib.sha256(data).digest() + data, durable=False)

    def _file(self, sig: Any, codegen: Any) -> Path:
        key = repr((sig, codegen.magic_tuple(), numba.__version__, sys.version_info[:2]))
        return self.path.with_name(f"{self.path.name}.{hashlib.sha256(key.encode()).hexdigest()[:16]}.nbc")


def cache_of_kernel(name: str) -> Any:
    """The cache of the kernel with this name; one that keeps nothing where no folder is private."""
    folder = private_folder(paths.cache_directory())
    return NullCache() if folder is None else KernelCache(folder / name)


@cache
def private_folder(cache_directory: Path) -> Path | None:
    """The folder of compiled rules, which is this user's and which nobody else can write to; None where there is none.

    It is `compiled`, or, where several users share the cache, `compiled-` and the user's number. A warning says what is
    wrong with a folder that is refused.
    """
    problems = []
    for folder in compiled_folders(cache_directory):
        problem = _problem_of(folder)
        if not problem:
            break
        problems.append(f"{folder} {problem}")
    if problems:
        instead = f"{folder} is used instead" if not problem else "rules are compiled anew by every process"
        warnings.warn(
            f"compiled rules: {'; '.join(problems)}; {instead}. "
            f"Reading compiled rules runs them: `chmod 700` the folder or delete it, or set PHAROS_CACHE_DIR",
            RuntimeWarning,
            stacklevel=2,
        )
    return None if problem else folder


def _problem_of(folder: Path) -> str:
    """Make the folder where it is missing. Returns why it is not to be used, "" where it is."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status = folder.stat()
    except OSError as error:
        return f"cannot be used ({error.strerror})"
    if not stat.S_ISDIR(status.st_mode):
        return "is no folder"
    if not hasattr(os, "getuid"):
        return ""
    if status.st_uid != os.getuid():
        return f"belongs to another user (number {status.st_uid})"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "can be written to by other users"
    return "" if os.access(folder, os.W_OK | os.X_OK) else "cannot be written to"
