"""Regret of play of shipped agents at the end of training: src/pharos/benchmark/data/baseline_play.csv.

    python benchmarks/baseline_play.py --out FOLDER

Runs them on v1, with three seeds, and keeps runs that have finished in FOLDER. The table has a row for each task that
an agent without a memory can learn, and the regret of play of each agent, see `pharos.benchmark.play`. It prints how
far their curves are from the shipped ones, and how often one, two or three of their seeds have a symptom of play,
beside each of them.
"""

import argparse
import csv
import itertools
from pathlib import Path

import numpy as np

from benchmark_baselines import settings
from pharos import benchmark
from pharos.benchmark.play import PLAY_FILE, play_of, play_symptoms
from pharos.benchmark.results import AgentResults
from pharos.benchmark.suite import CORE

AGENTS, SEEDS = ("dqn", "ppo", "q_learning"), range(3)
AXES = (CORE, "exploration", "estimation", "credit")
DECIMALS = 3


def ran(name, seeds, out):
    """Results of a shipped agent, with what it played."""
    suite = benchmark.load_suite("v1")
    agent, hyperparameters = settings(suite)[name]
    options = {"seeds": seeds, "tasks": AXES, "name": name, "hyperparameters": hyperparameters, "workers": 1}
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
    table = {name: ran(name, SEEDS, options.out) for name in AGENTS}
    play = {name: play_of(results) for name, results in table.items()}
    with open(PLAY_FILE, "w", encoding="utf-8", newline="") as lines:
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerow(["task", *play])
        for task in sorted({task for regrets in play.values() for task in regrets}):
            cells = [f"{round(own[task], DECIMALS) + 0.0:g}" if task in own else "" for own in play.values()]
            writer.writerow([task, *cells])
    for name in AGENTS:
        draws = [ran(name, seeds, options.out) for size in SEEDS for seeds in itertools.combinations(SEEDS, size + 1)]
        told = sum(bool(play_symptoms(each, table[other], other)) for each in draws for other in AGENTS)
        print(f"{name}: {differences(table[name]):.2g} from the shipped curves, {told} of {3 * len(draws)} draws told")


if __name__ == "__main__":
    main()
