"""How many threads or processes this process may use."""

import os

from pharos.errors import ParameterError


def usable_workers(workers: int | None) -> int:
    """`workers`, or the number of processors that this process may use."""
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if workers < 1:
        raise ParameterError(f"workers is {workers}; expected at least 1")
    return int(workers)
