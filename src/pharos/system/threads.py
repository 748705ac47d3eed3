"""Threads of this process that share a loop over rows."""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_pool: tuple[int, ThreadPoolExecutor] | None = None  # of this process: threads do not survive a fork


def in_blocks(run: Callable[[int, int], None], number: int, block: int) -> None:
    """run(first, last) over 0 .. number - 1, on all processors if there are at least two blocks."""
    if number < 2 * block:
        run(0, number)
        return
    from pharos.system.workers import usable_workers

    workers = usable_workers(None)
    if workers < 2:
        run(0, number)
        return
    parts = min(4 * workers, number // block)
    edges = [number * part // parts for part in range(parts + 1)]
    for future in [_threads(workers).submit(run, *edge) for edge in itertools.pairwise(edges)]:
        future.result()


def _threads(workers: int) -> ThreadPoolExecutor:
    global _pool
    if _pool is None or _pool[0] != os.getpid():
        _pool = os.getpid(), ThreadPoolExecutor(workers, thread_name_prefix="pharos-observations")
    return _pool[1]
