"""Lesions: whether an axis measures what its name says, by agents that are known to lack one thing.

python benchmarks/benchmark_lesions.py --out FOLDER            run what FOLDER lacks, then print the matrix
python benchmarks/benchmark_lesions.py --out FOLDER --print    print the matrix of what is there

An agent has one setting for all tasks; its lesion changes what an axis is about, and nothing else. Two agents are
whole: a hopeful Q-learning on a table, whose exploration and averages have a parameter each, and the DQN of the suite.
The score of an axis is the mean over rungs of 1 - normalised regret over the run, clipped to [0, 1]. A lesion's fall is
the whole agent's score less its own, with an interval of 95 % by a bootstrap of the seeds of each rung. An axis holds
if its lesion falls by at least FALL on it, and by at least TIMES what it falls by on any other.

The memory axis is not run: without memory every policy scores 0 on it exactly, by tests/observations.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from pharos.benchmark import load_suite
from pharos.training import train_many

FALL, TIMES, DRAWS = 0.2, 2.0, 2_000
FIRST_SEED = 1000  # of tuning and of lesions: the suite's own are 0 to 9
TABLE = {"learning_rate": 0.1, "gamma": 1.0, "initial_q": 1.0}
LESIONS = {  # name: (agent, its setting, the name of the whole agent, the axis that must fall)
    "table": ("q_learning", TABLE, None, None),
    "table, not hopeful": ("q_learning", TABLE | {"initial_q": 0.0}, "table", "exploration"),
    "table, last reward only": ("q_learning", TABLE | {"learning_rate": 1.0}, "table", "estimation"),
    "table, discount 0.5": ("q_learning", TABLE | {"gamma": 0.5}, "table", "credit"),
    "dqn": ("dqn", {}, None, None),
    "dqn, discount 0.5": ("dqn", {"gamma": 0.5}, "dqn", "credit"),
    "dqn, epsilon 0.01": (
        "dqn",
        {"exploration_initial_eps": 0.01, "exploration_final_eps": 0.01},
        "dqn",
        "exploration",
    ),
    "dqn, buffer of 32": ("dqn", {"buffer_size": 32}, "dqn", "estimation"),
    "dqn, network of 4 units": ("dqn", {"policy_kwargs": {"net_arch": [4]}}, "dqn", "representation"),
    "dqn, update every 64 steps": ("dqn", {"train_freq": 64}, "dqn", "scale"),
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
    file = path(out, task.name, lesion)
    regrets = json.loads(file.read_text()) if file.exists() else []
    if len(regrets) >= seeds:
        return
    protocol, (agent, setting, _, _) = suite.protocol, LESIONS[lesion]
    runs = train_many(
        agent,
        task.environment,
        seeds=range(FIRST_SEED + len(regrets), FIRST_SEED + seeds),
        observation="index" if agent == "q_learning" else task.observation,
        observation_options={} if agent == "q_learning" else task.observation_options,
        hyperparameters={**suite.hyperparameters.get(agent, {}), **setting},
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
    """Falls of each lesion on each axis, over the rungs where both agents were run, and which axes hold."""
    print(f"| agent or lesion | {' | '.join(ladders)} | its axis |\n|---|{'---|' * (len(ladders) + 1)}")
    for lesion in lesions:
        _, _, whole, target = LESIONS[lesion]
        cells, falls = {}, {}
        for axis, tasks in ladders.items():
            names = [task.name for task in tasks if path(out, task.name, lesion).exists()]
            names = [name for name in names if path(out, name, whole or lesion).exists()]
            own, reference = scores(out, names, lesion), scores(out, names, whole or lesion)
            fall = reference - own if whole else own
            falls[axis] = fall[0]
            low, high = np.quantile(fall[1:], (0.025, 0.975))
            cells[axis] = f"{fall[0]:.2f} ({low:.2f} to {high:.2f}), {len(names)}"
        verdict = ""
        if whole:
            others = max(fall for axis, fall in falls.items() if axis != target and not np.isnan(fall))
            verdict = f"{target} {'holds' if falls[target] >= max(FALL, TIMES * others) else 'fails'}"
        print(f"| {lesion} | {' | '.join(cells.values())} | {verdict} |")


def path(out, name, lesion):
    return out / f"{name}.{lesion}.json"


def scores(out, names, lesion):
    """(1 + DRAWS,) score of an axis, and bootstraps of it by the seeds of each rung."""
    rng = np.random.default_rng(0)
    found = [1 - np.clip(json.loads(path(out, name, lesion).read_text()), 0, 1) for name in names]
    samples = [np.append(one.mean(), rng.choice(one, (DRAWS, len(one))).mean(axis=1)) for one in found]
    return np.mean(samples, axis=0) if samples else np.full(DRAWS + 1, np.nan)


if __name__ == "__main__":
    main()
