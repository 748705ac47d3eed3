"""How much faster is a study with all processors than with one, and what does the runner take for itself?

    python benchmarks/study.py [--steps N] [--runs K]

The same K runs (DQN with vectors, simple_grid/4x4-plain, seeds 0 to K - 1) by one worker and by two, in the order 1, 2,
2, 1, each study in a folder of its own, its state spaces built beforehand. A run's own seconds are those of its
training; what one worker takes beyond them is the runner's: starting processes, status, files. The first run of a study
pays for the warm process that the others are forked from.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

from pharos import study


def measured(steps: int, runs: int, workers: int) -> tuple[float, float]:
    """Seconds of the study, and of its runs together."""
    specification = {
        "name": "benchmark",
        "steps": steps,
        "evaluations": 5,
        "seeds": runs,
        "blocks": [
            {
                "environments": ["simple_grid/4x4-plain"],
                "chance": ["plain"],
                "observations": ["vector"],
                "agents": ["dqn"],
            }
        ],
    }
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        status = study.run(specification, folder, workers=workers)
        seconds = time.perf_counter() - began
        if status.finished != runs:
            raise SystemExit(f"{status.finished} of {runs} runs finished: {status.errors}")
        each = [json.loads(path.read_text())["seconds"] for path in Path(folder).glob("runs/*/run.json")]
    return seconds, sum(each)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--runs", type=int, default=6)
    options = parser.parse_args()
    measured(2000, 1, 1)  # state spaces, compiled kernels
    found = {1: [], 2: []}
    for workers in (1, 2, 2, 1):
        seconds, own = measured(options.steps, options.runs, workers)
        found[workers].append(seconds)
        rate = options.steps * options.runs / seconds
        print(
            f"{workers} worker{'s' if workers > 1 else ' '}: {seconds:.1f} s, {rate:,.0f} steps/s; runs together "
            f"{own:.1f} s" + (f", beyond them {100 * (seconds - own) / seconds:.1f} %" if workers == 1 else ""),
            flush=True,
        )
    print(f"two workers: {sum(found[1]) / sum(found[2]):.2f} times the throughput of one")


if __name__ == "__main__":
    main()
