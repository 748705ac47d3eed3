"""What several processes cost and bring: building by one thread, two threads, and two or three processes, in one run.

    python benchmarks/ranks.py [TARGET] [--rounds 3] [--processes 2 3]

Each round builds the space anew in every way, in processes of their own, and compares the files. Prints the median of
seconds and of processor seconds of all processes, and their ratio to one thread's.
"""

import argparse
import filecmp
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def measure(command):
    """(seconds of the build, seconds of wall clock, processor seconds of all processes) of a command."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    answer = json.loads(output[output.index("{") :])
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return answer["seconds"] - answer["compiling_seconds"], wall, used


def main():
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", nargs="*", default=["breakout", "height=14", "columns=8", "brick_rows=3"])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--processes", type=int, nargs="*", default=[2, 3])
    options = parser.parse_args()
    pharos = [sys.executable, "-m", "pharos", "build", *options.target, "--json", "--out"]
    ways = {"one thread": ["--workers", "1"], "threads": []}
    for number in options.processes:
        ways[f"{number} processes"] = ["--processes", str(number)]
    results = {way: [] for way in ways}
    with tempfile.TemporaryDirectory(dir=os.environ.get("PHAROS_CACHE_DIR")) as folder:
        for _ in range(options.rounds):
            for way, arguments in ways.items():
                out = Path(folder) / way.replace(" ", "-")
                results[way].append(measure([*pharos, str(out), *arguments]))
                first = Path(folder) / "one-thread"
                names = sorted(path.name for path in first.iterdir())
                assert filecmp.cmpfiles(first, out, names, shallow=False)[0] == names, way
                if out != first:
                    subprocess.run(["rm", "-r", out], check=True)
            subprocess.run(["rm", "-r", first], check=True)
    base = statistics.median(build for build, _, _ in results["one thread"])
    print("way                    seconds  of one thread's  processor seconds")
    for way, measured in results.items():
        build, _, used = (statistics.median(column) for column in zip(*measured, strict=True))
        print(f"{way:22} {build:7.2f} {build / base:16.2f} {used:18.1f}")


if __name__ == "__main__":
    main()
