"""Arrays in reserved address space: memory is taken as they are written, in huge pages, and never copied to grow."""

import contextlib
import mmap
import sys

import numpy as np


def reserved_states(num_words: int) -> np.ndarray:
    """(rows, W) uint64, zeros."""
    for rows in (1 << 32, 1 << 30, 1 << 28, 1 << 26):
        try:
            return huge_pages(rows * num_words, np.dtype("<u8")).reshape(-1, num_words)
        except (OSError, ValueError):
            continue
    raise MemoryError("no address space for 2^26 states; set a larger ulimit -v")


def reserved_table() -> np.ndarray:
    """Bytes in which the table grows; an empty array where there is no address space."""
    for size in (1 << 35, 1 << 33, 1 << 31):
        with contextlib.suppress(OSError, ValueError):
            return huge_pages(size, np.dtype("|u1"))
    return np.empty(0, np.uint8)


def huge_pages(length: int, dtype: np.dtype) -> np.ndarray:
    """An array of zeros in huge pages, where the system has them."""
    if not hasattr(mmap, "MAP_PRIVATE"):
        return np.zeros(min(length, 1 << 28), dtype)
    no_reserve = 0x4000 if sys.platform == "linux" else 0  # MAP_NORESERVE, which Python names from 3.13 on
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | no_reserve
    memory = mmap.mmap(-1, length * dtype.itemsize, flags=flags)
    if hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):
            memory.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(memory, dtype)
