"""What a sweep by several processes takes, of two versions of the source in turn; and how much of it can hide messages.

    python benchmarks/rank_sweeps.py [TARGET] [--processes 2 3] [--rounds 5] [--before OTHER/src] [--shares 16]

Each round solves under `mpiexec`: in place until 1e-6 is proven, and 40 steps of a horizon, which are not in
place. Prints medians over rounds of the median milliseconds between two sweeps, and of the ratio of pairs. `--shares P`
prints for P ranges which part of the rows reads no halo, which is read by no other range, and how much is sent early.
"""

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent.parent / "src"


def times(target):
    """Seconds between two sweeps, in place and not, at a rank of MPI."""
    import pharos

    mdp = pharos.build(target, progress=False).mdp(0.99)
    results = {}
    for name, options in (("in place", {}), ("not in place", {"horizon": 40})):
        moments = []
        pharos.value_iteration(
            mdp, processes="mpi", progress=lambda *_, to=moments: to.append(time.perf_counter()), **options
        )
        results[name] = statistics.median(np.diff(moments)) if len(moments) > 1 else None  # the first rank reports
    return results


def shares(target, ranges):
    """Print the parts of the rows of ranges."""
    import pharos
    from pharos.mdp import Part, count_of, runs_of
    from pharos.ranks import cuts_of

    mdp = pharos.build(target, progress=False).mdp(0.99)
    cuts = cuts_of(mdp.num_states, ranges)
    parts = [Part.of(mdp, int(start), int(stop)) for start, stop in itertools.pairwise(cuts)]
    inside, rest, early, sent = [], [], 0, 0
    for part in parts:
        others = np.concatenate([each.halo for each in parts])
        rows = others[(others >= part.start) & (others < part.stop)] - part.start
        is_wanted = np.zeros(len(part), bool)
        is_wanted[rows] = True
        is_border = (part.dynamics.deterministic_table() >= len(part)).any(axis=1)
        inside.append(1 - is_border.mean())
        rest.append(1 - count_of(runs_of(is_wanted, 64)) / len(part))
        early, sent = early + np.count_nonzero(rows >= len(part) // 8), sent + len(rows)
    print(f"{target}, {mdp.num_states:,} states, {ranges} ranges")
    print(f"rows that read no halo: {np.mean(inside):.2%} (least {min(inside):.2%})")
    print(f"swept while messages travel, not in place: {np.mean(rest):.2%} (least {min(rest):.2%})")
    print(f"of what is sent, sent before the last eighth of a sweep in place: {early / max(sent, 1):.1%}")


def main():
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", nargs="?", default="breakout/12x8x1")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--processes", type=int, nargs="*", default=[2, 3])
    parser.add_argument("--before", help="another version's src folder")
    parser.add_argument("--shares", type=int)
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--mpiexec", default=str(Path(sys.executable).parent / "mpiexec"))
    options = parser.parse_args()
    if options.once:
        results = times(options.target)
        if None not in results.values():
            print(json.dumps(results))
        return
    if options.shares:
        shares(options.target, options.shares)
        return
    sources = {"now": str(HERE), **({"before": options.before} if options.before else {})}
    measured = {}
    for _ in range(options.rounds):
        for processes in options.processes:
            for source, path in sources.items():
                command = [options.mpiexec, "-n", str(processes), sys.executable, __file__, options.target, "--once"]
                environment = {**os.environ, "PYTHONPATH": path}
                done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
                for way, seconds in json.loads(done.stdout).items():
                    measured.setdefault((processes, way), {}).setdefault(source, []).append(1e3 * seconds)
    print("processes  sweeps        " + "".join(f"{source:>12}" for source in sources) + "   now / before")
    for (processes, way), by in measured.items():
        line = "".join(f"{statistics.median(by[source]):9.2f} ms" for source in sources)
        ratios = [now / before for now, before in zip(by["now"], by.get("before", []), strict=False)]
        print(f"{processes:9}  {way:13} {line}", f"{statistics.median(ratios):10.2f}" if ratios else "")


if __name__ == "__main__":
    main()
