"""Regret of play of shipped agents at the end of training: src/pharos/benchmark/data/baseline_play.csv.

    python benchmarks/baseline_play.py --out FOLDER

Runs them on v1, with few seeds, and keeps runs that have finished in FOLDER. The table has a row for each task that a
network without a memory can learn, and the regret of play of each agent, see `pharos.benchmark.play`. It prints what is
said of each agent, beside the shipped ones.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

from benchmark_baselines import settings
from pharos import benchmark
from pharos.benchmark.play import PLAY_FILE, play_of, play_symptoms
from pharos.benchmark.results import AgentResults
from pharos.benchmark.suite import CORE

AGENTS = {"dqn": 3, "ppo": 3, "q_learning": 3}  # in the table, with their number of seeds
OTHERS = {"double_dqn": 2, "n_step_dqn": 2, "a2c": 2}  # of the core alone
AXES = (CORE, "exploration", "estimation", "credit")
DECIMALS = 3


def ran(name, seeds, axes, out):
    """Results of a shipped agent, with what it played."""
    suite = benchmark.load_suite("v1")
    agent, hyperparameters = settings(suite)[name]
    options = {"seeds": range(seeds), "tasks": axes, "name": name, "hyperparameters": hyperparameters, "workers": 1}
    return benchmark.run(agent, suite, out=out / name, **options).results


def differences(results):
    """Largest difference of the curves from those of the same seeds of the shipped agent."""
    shipped = AgentResults.read(results.agent)
    rows = [shipped.seeds.index(seed) for seed in results.seeds]
    return max(float(np.abs(curve - shipped.curves[name][rows]).max()) for name, curve in results.curves.items())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    table = {name: ran(name, seeds, AXES, options.out) for name, seeds in AGENTS.items()}
    play = {name: play_of(results) for name, results in table.items()}
    with open(PLAY_FILE, "w", encoding="utf-8", newline="") as lines:
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerow(["task", *play])
        for task in sorted({task for regrets in play.values() for task in regrets}):
            cells = [f"{round(own[task], DECIMALS) + 0.0:g}" if task in own else "" for own in play.values()]
            writer.writerow([task, *cells])
    whole = table | {name: ran(name, seeds, [CORE], options.out) for name, seeds in OTHERS.items()}
    for name, results in whole.items():
        said = [
            f"{other}: {each.name} {each.value:.2f}"
            for other in table
            if other != name
            for each in play_symptoms(results, table[other], other)
        ]
        print(f"{name}: differs by {differences(results):.3g} from the shipped curves; {'; '.join(said) or 'nothing'}")


if __name__ == "__main__":
    main()
