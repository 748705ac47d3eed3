"""Compiled kernels on disk: one file for each kernel and each signature, in a folder that nobody else can write to.

Reading such a file runs its content (it is a pickle, and machine code), so the folder is private to its user. Damage is
noticed by a checksum: a damaged file is deleted, and the kernel is compiled again.

The kernels of pharos lie under a digest of the texts of all of them, as one may call another's: whoever has the same
texts, another checkout or another job on other days, finds them compiled. They lie in the folder NUMBA_CACHE_DIR if it
is set, else in the folder `compiled` of the cache. The functions that rules are compiled into have files of their own
there (rules/compiler.py).
"""

import contextlib
import hashlib
import os
import pickle  # noqa: TID251  (a folder that is private to its user)
import shutil
import sys
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol

import numba
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from pharos.system import storage
from pharos.system.compiling import private_folder

libraries: Any = None
if (0, 61) <= numba.version_info.short <= (0, 68):  # with which it was tried; any other compiles in its own way
    with contextlib.suppress(ImportError, AttributeError):
        from pharos.kernels import libraries

        libraries.install()

DIGEST_BYTES = 32
UNUSED_DAYS = 30
"""Days after which the kernels of other texts, which no process has asked for since, are deleted."""

_KERNELS = Path(__file__).parent
_TEXTS = (*sorted(_KERNELS.glob("*.py")), _KERNELS.parent / "system" / "arrays.py")


class Codegen(Protocol):
    """Numba's interface to the processor, as far as the cache needs it."""

    def magic_tuple(self) -> object:
        """Features of the processor on which compiled code depends."""


class TargetContext(Protocol):
    """Numba's interface to the process that loads a kernel, as far as the cache needs it."""

    def refresh(self) -> None:
        """Take over functions registered since."""

    def codegen(self) -> Codegen:
        """The interface to the processor."""


class KernelCache(NullCache):
    """Cache of the compiled forms of one kernel, a file for each signature: the interface that Numba calls.

    Args:
        path: of the files, without the ending that tells one signature from another.
    """

    def __init__(self, path: Path):
        self.path = path
        self._is_there = False

    @property
    def cache_path(self) -> str:
        return str(self.path.parent)

    def holds_any(self) -> bool:
        """Whether a compiled form is on disk, for any signature."""
        if not self._is_there:
            with contextlib.suppress(OSError), os.scandir(self.path.parent) as files:
                self._is_there = any(each.name.startswith(f"{self.path.name}.") for each in files)
        return self._is_there

    def load_overload(self, sig: object, target_context: TargetContext) -> CompileResult | None:
        """The compiled kernel of a signature. None if there is none, or a damaged one, which is deleted."""
        file = self._file(sig, target_context.codegen())
        try:
            data = file.read_bytes()
        except OSError:
            return None
        try:
            if hashlib.sha256(data[DIGEST_BYTES:]).digest() != data[:DIGEST_BYTES]:
                raise ValueError("it was changed after it was written")
            if libraries is None:
                target_context.refresh()
            else:
                libraries.get_ready(target_context, data)
            return CompileResult._rebuild(target_context, *pickle.loads(data[DIGEST_BYTES:]))
        except Exception:  # whatever is wrong with it: the kernel is compiled again
            with contextlib.suppress(OSError):
                file.unlink()
            return None

    def save_overload(self, sig: object, cres: Any) -> None:
        """Write a compiled kernel to disk. Without room for it, the next process compiles again."""
        if cres.lifted or cres.library.has_dynamic_globals:  # it refers to addresses of this process
            return
        data = dumps(cres._reduce() if libraries is None else libraries.reduced(cres))
        file = self._file(sig, cres.codegen)
        with contextlib.suppress(OSError):
            storage.replace_file(file, hashlib.sha256(data).digest() + data, durable=False)

    def _file(self, sig: object, codegen: Codegen) -> Path:
        key = repr((sig, codegen.magic_tuple(), numba.__version__, sys.version_info[:2]))
        return self.path.with_name(f"{self.path.name}.{hashlib.sha256(key.encode()).hexdigest()[:16]}.nbc")


def is_on_disk(dispatcher: Callable) -> bool:
    """Whether a compiled form of a kernel is on disk."""
    return isinstance(dispatcher._cache, KernelCache) and dispatcher._cache.holds_any()


def cache_in(folder: Path | None, name: str) -> NullCache:
    """The cache of the kernel with this name in a folder. Without a folder, one that stores nothing."""
    return NullCache() if folder is None else KernelCache(folder / name)


def folder_of_rules() -> Path | None:
    """The folder of kernels that are made of rules, private to this user. None: there is none."""
    return private_folder(storage.cache_directory())


def kernel(function: Callable | None = None, /, *, makes_arrays: bool = True, **options: object) -> Callable:
    """Decorator of a kernel: `numba.njit` without the interpreter's lock, whose compiled forms are kept on disk.

    Args:
        makes_arrays: False: it allocates none, which Numba checks. Then it counts no references either: a count up and
            down for each array and each function that is called in a loop, 20 ns for a state of a sweep.
    """
    if function is None:
        return partial(kernel, makes_arrays=makes_arrays, **options)
    compiled = called_by_kernels if function.__name__.startswith("_") else called_by_python
    dispatcher = compiled(nogil=True, _nrt=makes_arrays, **options)(function)
    dispatcher._cache = cache_in(_folder(), f"{function.__module__.rpartition('.')[2]}.{function.__name__}")
    return dispatcher


called_by_python: Any = partial(numba.njit, no_cfunc_wrapper=True)
"""`numba.njit` of a function that Python calls, and C does not."""


def called_by_kernels(function: Callable | None = None, /, **options: object) -> Callable:
    """Decorator of a function that kernels call and Python does not: `numba.njit` without the ways in from outside, a
    sixth of compiling.

    Raises:
        TypeError: Python calls it.
    """
    if function is None:
        return partial(called_by_kernels, **options)
    dispatcher = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)(function)

    def refuse(*arguments: object) -> None:
        raise TypeError(f"{function.__name__} is called by kernels alone; expected a call of its text, `.py_func`")

    dispatcher._insert, dispatcher._compile_for_args = lambda *overload: None, refuse  # else its calls end the process
    return dispatcher


inlined = called_by_kernels(forceinline=True)
"""Decorator of a function that becomes part of the kernels that call it."""


@cache
def _folder() -> Path | None:
    """The folder of the kernels with the texts of today. Folders of other texts are deleted after UNUSED_DAYS."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    root = Path(named).expanduser() if named else folder_of_rules()
    if root is None:
        return None
    digest = hashlib.sha256(b"\0".join(path.read_bytes() for path in _TEXTS)).hexdigest()[:16]
    folder = root / f"kernels-{digest}"
    with contextlib.suppress(OSError):  # of a folder that can be read alone
        if folder.is_dir():
            os.utime(folder)
        else:
            folder.mkdir(parents=True, exist_ok=True)
            for other in root.glob("kernels-*"):
                if other.stat().st_mtime < time.time() - UNUSED_DAYS * 86400:
                    shutil.rmtree(other, ignore_errors=True)
    return folder
