"""How much memory this process may still take."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

LEAST_MEMORY = 1 << 24  # bytes that a build needs
_PROC, _GROUPS = Path("/proc"), Path("/sys/fs/cgroup")


def available_memory() -> int:
    """Bytes: free memory of the machine, or of a control group that this process is in (Slurm, containers) where that
    is less.

    What files have left in memory counts as free: it goes when somebody needs the room.
    """
    free = 1 << 62
    with contextlib.suppress(OSError, StopIteration, ValueError), open(_PROC / "meminfo") as file:
        free = next(int(line.split()[1]) * 1024 for line in file if line.startswith("MemAvailable"))
    for limit, used, statistics in _groups():
        with contextlib.suppress(OSError, ValueError):  # such as "max", no limit
            left = int(limit.read_text()) - int(used.read_text())
            free = min(free, left + _of_files(statistics))
    return max(free, 0)


def _groups() -> Iterator[tuple[Path, Path, Path]]:
    """(limit, usage, statistics) of the groups of this process and those around them; the root, too, which may be a
    container's.
    """
    with contextlib.suppress(OSError, ValueError):
        for line in (_PROC / "self" / "cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers == "":
                root, names = _GROUPS, ("memory.max", "memory.current")
            elif "memory" in controllers.split(","):
                root, names = _GROUPS / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")
            else:
                continue
            folder = root / path.lstrip("/")
            for group in (folder, *folder.parents):
                if group.is_relative_to(root):
                    yield group / names[0], group / names[1], group / "memory.stat"


def _of_files(statistics: Path) -> int:
    with contextlib.suppress(OSError, ValueError):
        entries = dict(line.split() for line in statistics.read_text().splitlines())
        return sum(int(entries.get(f"total_{name}", entries.get(name, 0))) for name in ("inactive_file", "active_file"))
    return 0
