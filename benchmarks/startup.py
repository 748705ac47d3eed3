"""How long does a first command take in a fresh process, with nothing compiled yet, and once more?

    python benchmarks/startup.py [REPEATS [WORDS OF A COMMAND'S NAME]]

Prints medians of wall clock and of processor time, the interpreter's own start included. Cold: Numba's cache and
pharos' own are empty folders. Warm: the same command once more. The bytecode of Python modules is there in both.
Cold times are short because of `pharos.system.compiling.SMALL_STATES`; with less the build of 4,620 states compiles.
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
BREAKOUT = ["breakout", "height=12", "columns=8"]
GAPS = ["--measures", "diameter,start_eccentricity,sum_of_reciprocal_gaps,minimal_gap"]
TWO_LOOKS = ["--observation", "vector", "--observation", "simple_image"]
LESSON = """
import pharos
from pharos import hardness

space = pharos.build(pharos.make("breakout", height=12, columns=8))
mdp = space.mdp(gamma=0.99)
solution = pharos.value_iteration(mdp, tolerance=1e-6)
pharos.evaluate_policy(pharos.sticky_actions(mdp, 0.25), solution.policy)
hardness.diameter(mdp)
"""
# OUT stands for a folder of the command's own
COMMANDS = {
    "import pharos": [sys.executable, "-c", "import pharos"],
    "pharos list": [*MODULE, "list"],
    "hardness frozen_lake/8x8 (64 states)": [*MODULE, "hardness", "frozen_lake/8x8"],
    "hardness frozen_lake/8x8 --random 0.1": [*MODULE, "hardness", "frozen_lake/8x8", "--random", "0.1"],
    "kernel_regret of taxi (404 states)": [*MODULE, "hardness", "taxi", *KERNEL_REGRET],
    "build simple_grid (16 states)": [*MODULE, "build", "simple_grid", "--out", "OUT"],
    "build frozen_lake/8x8": [*MODULE, "build", "frozen_lake/8x8", "--out", "OUT"],
    "build breakout height=6 columns=4 (4,620 states)": [
        *MODULE,
        "build",
        "breakout",
        "height=6",
        "columns=4",
        "--out",
        "OUT",
    ],
    "build freeway num_cars=4 (many short levels)": [*MODULE, "build", "freeway", "num_cars=4", "--out", "OUT"],
    "hardness breakout height=12 columns=8, as in README": [*MODULE, "hardness", *BREAKOUT, *GAPS],
    "the lines of Python in README, without training": [sys.executable, "-c", LESSON],
    "predict frozen_lake/8x8": [*MODULE, "predict", "frozen_lake/8x8", *TWO_LOOKS],
    "solve breakout/12x8x3 --sticky 0.25": [*MODULE, "solve", "breakout/12x8x3", "--sticky", "0.25"],
    "train frozen_lake/4x4, tabular": [
        *MODULE,
        "train",
        "frozen_lake/4x4",
        "--random",
        "0.1",
        "--steps",
        "20000",
        "--out",
        "OUT",
    ],
    "train frozen_lake/4x4 --agent dqn": [
        *MODULE,
        "train",
        "frozen_lake/4x4",
        "--agent",
        "dqn",
        "--steps",
        "2000",
        "--out",
        "OUT",
    ],
    "benchmark run, one task": [
        *MODULE,
        "benchmark",
        "run",
        "--agent",
        "q_learning",
        "--tasks",
        "deep_sea-8",
        "--out",
        "OUT",
    ],
}


def run(arguments, caches, out):
    """Wall clock and processor time of one command in a process of its own; seconds."""
    command = [str(out) if word == "OUT" else word for word in arguments]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(caches / "numba"), "PHAROS_CACHE_DIR": str(caches / "pharos")}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure and print."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    for name, arguments in COMMANDS.items():
        if not all(word in name for word in sys.argv[2:]):
            continue
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
