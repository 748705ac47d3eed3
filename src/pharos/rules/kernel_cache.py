"""Compiled kernels on disk: one file for each kernel and each signature, in a folder that nobody else can write to.

Reading such a file runs what is in it (it is a pickle, and machine code), so the folder is private to its user. Damage
is noticed by a checksum: a damaged file is deleted, and the kernel is compiled again.
"""

import contextlib
import hashlib
import pickle  # noqa: TID251  (a folder that is private to its user)
import sys
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from pharos.system import paths, storage
from pharos.system.compiling import private_folder

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
