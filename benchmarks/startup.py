"""How long does a first command take in a fresh process, with nothing compiled yet, and once more?

    python benchmarks/startup.py [REPEATS]

Prints medians of wall clock and of processor time, the interpreter's own start included. Cold: Numba's cache and
pharos' own are empty folders. Warm: the same command once more. The bytecode of Python modules is there in both.
`pharos.system.compiling.SMALL` is where the times when cold are short; below it the build of 4,620 states compiles.
"""

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MODULE = [sys.executable, "-m", "pharos"]
KERNEL_REGRET = ["--observation", "vector", "--network", "mlp128x2", "--measures", "kernel_regret"]
COMMANDS = {
    "import pharos": [sys.executable, "-c", "import pharos"],
    "pharos list": [*MODULE, "list"],
    "hardness frozen_lake/8x8 (64 states)": [*MODULE, "hardness", "frozen_lake/8x8"],
    "hardness frozen_lake/8x8 --random 0.1": [*MODULE, "hardness", "frozen_lake/8x8", "--random", "0.1"],
    "kernel_regret of taxi (404 states)": [*MODULE, "hardness", "taxi", *KERNEL_REGRET],
    "build simple_grid (16 states)": ["build", "simple_grid"],
    "build frozen_lake/8x8": ["build", "frozen_lake/8x8"],
    "build breakout height=6 columns=4 (4,620 states)": ["build", "breakout", "height=6", "columns=4"],
    "build freeway num_cars=4 (many short levels)": ["build", "freeway", "num_cars=4"],
}


def run(arguments, caches, out):
    """Wall clock and processor time of one command in a process of its own; seconds."""
    command = arguments
    if arguments[0] == "build":
        command = [*MODULE, *arguments, "--out", str(out)]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(caches / "numba"), "PHAROS_CACHE_DIR": str(caches / "pharos")}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure and print."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    for name, arguments in COMMANDS.items():
        times = {"cold": [], "warm": []}
        for i in range(repeats):
            with tempfile.TemporaryDirectory() as folder:
                for kind, found in times.items():
                    found.append(run(arguments, Path(folder), Path(folder) / f"{kind}{i}"))
        text = "; ".join(
            f"{kind} {statistics.median(wall for wall, _ in found):.2f} s "
            f"(processor time {statistics.median(cpu for _, cpu in found):.2f} s)"
            for kind, found in times.items()
        )
        print(f"{name}: {text}", flush=True)


if __name__ == "__main__":
    main()
