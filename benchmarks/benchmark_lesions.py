"""Lesions: whether an axis measures what its name says, by agents that are known to lack one thing.

python benchmarks/benchmark_lesions.py --out FOLDER            run what FOLDER lacks, then print the matrix
python benchmarks/benchmark_lesions.py --out FOLDER --print    print the matrix of what is there

A DQN with the one setting of the suite is the whole agent. Each lesion changes what its axis is about and nothing else.
The score of an axis is the mean over rungs of 1 - normalised regret over the run, clipped to [0, 1]. A lesion's fall is
the whole agent's score less its own, with an interval of 95 % by a bootstrap of the seeds of each rung. An axis holds
if its lesion falls by at least FALL on it, and by at least TIMES what it falls by on any other.

The memory axis needs a recurrent agent; a DQN, which has no memory, is its lesion (docs/evidence/benchmark.md).
"""

import argparse
import json
from pathlib import Path

import numpy as np

from pharos.benchmark import load_suite
from pharos.training import train_many

FALL, TIMES, DRAWS = 0.2, 2.0, 2_000
FIRST_SEED = 1000  # of tuning and of lesions: the suite's own are 0 to 9
WHOLE = "whole"
LESIONS = {
    WHOLE: {},
    "exploration": {"exploration_initial_eps": 0.01, "exploration_final_eps": 0.01},
    "estimation": {"buffer_size": 32},
    "credit": {"gamma": 0.5},
    "representation": {"policy_kwargs": {"net_arch": [4]}},
    "scale": {"train_freq": 64},
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--tasks", nargs="*", help="only these, such as deep_sea-8")
    parser.add_argument("--lesions", nargs="*", default=list(LESIONS), choices=LESIONS)
    parser.add_argument("--print", action="store_true")
    options = parser.parse_args()
    suite = load_suite("v1")
    ladders = {each.axis: each.tasks for each in suite.ladders if each.axis != "memory"}
    options.out.mkdir(parents=True, exist_ok=True)
    if not options.print:
        for name in options.tasks or [task.name for tasks in ladders.values() for task in tasks]:
            for lesion in options.lesions:
                run(suite, suite.task(name), lesion, options.seeds, options.out)
    print_matrix(ladders, options.lesions, options.out)


def run(suite, task, lesion, seeds, out):
    """Regret over the run of each seed that the file of the task and the lesion lacks."""
    file = out / f"{task.name}.{lesion}.json"
    regrets = json.loads(file.read_text()) if file.exists() else []
    if len(regrets) >= seeds:
        return
    protocol = suite.protocol
    runs = train_many(
        "dqn",
        task.environment,
        seeds=range(FIRST_SEED + len(regrets), FIRST_SEED + seeds),
        observation=task.observation,
        observation_options=task.observation_options,
        hyperparameters={**suite.hyperparameters["dqn"], **LESIONS[lesion]},
        steps=protocol.steps,
        evaluation_interval=protocol.evaluation_interval,
        gamma=protocol.gamma,
        horizon=protocol.horizon,
        **task.chance,
        **task.parameters,
    )
    regrets += [float(np.mean([row["normalized_regret"] for row in each.curve if row["step"]])) for each in runs]
    file.write_text(json.dumps(regrets))
    print(f"# {task.name} {lesion}: {np.mean(regrets):.3f}", flush=True)


def print_matrix(ladders, lesions, out):
    """Falls of each lesion on each axis, and which axes hold."""
    rng, draws, rungs = np.random.default_rng(0), {}, {}
    for axis, tasks in ladders.items():
        files = {task.name: [out / f"{task.name}.{lesion}.json" for lesion in lesions] for task in tasks}
        rungs[axis] = [name for name, each in files.items() if all(file.exists() for file in each)]
        for lesion in lesions:
            scores = [
                1 - np.clip(json.loads((out / f"{name}.{lesion}.json").read_text()), 0, 1) for name in rungs[axis]
            ]
            samples = [np.append(one.mean(), rng.choice(one, (DRAWS, len(one))).mean(axis=1)) for one in scores]
            draws[lesion, axis] = np.mean(samples, axis=0) if samples else np.full(DRAWS + 1, np.nan)
    print(f"| | {' | '.join(ladders)} |\n|---|{'---|' * len(ladders)}")
    print(f"| rungs | {' | '.join(str(len(rungs[axis])) for axis in ladders)} |")
    print(f"| score of the whole agent | {' | '.join(f'{draws[WHOLE, axis][0]:.2f}' for axis in ladders)} |")
    for lesion in lesions:
        if lesion == WHOLE:
            continue
        falls = {axis: draws[WHOLE, axis] - draws[lesion, axis] for axis in ladders}
        ends = {axis: np.quantile(fall[1:], (0.025, 0.975)) for axis, fall in falls.items()}
        cells = [f"{fall[0]:.2f} ({ends[axis][0]:.2f} to {ends[axis][1]:.2f})" for axis, fall in falls.items()]
        print(f"| lesion of {lesion} | {' | '.join(cells)} |")
        own, others = falls[lesion][0], max(fall[0] for axis, fall in falls.items() if axis != lesion)
        holds = "holds" if own >= FALL and own >= TIMES * others else "fails"
        print(f"# {lesion} {holds}: falls by {own:.2f}, elsewhere by at most {others:.2f}")


if __name__ == "__main__":
    main()
