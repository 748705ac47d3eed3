"""Random search of DQN's or PPO's hyperparameters where many sets share a program: for days when processors are dear.

    python benchmarks/search.py INSTANCE [NAME=VALUE ...] --agent dqn --steps 100000 --sets 10 --group n_steps=1
        --group n_steps=3 --out docs/tuning/NAME.json

`pharos tune` goes on from trial to trial and measures exact values; here a group is one batch: sets of hyperparameters
that may differ within it x kinds of chance x seeds, all of the same shapes. The first set of each group is the table's.
The score of a set is its normalised realised regret, (V* - mean return) / (V* - U), of the episodes that end in the
second half of the training, exploration included, averaged over chances and seeds; beside it stands the exact value of
the greedy policy at the end, without chance. OUT has every set; groups that it has already are not repeated.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from drawing import drawn_set
from pharos.agents import hyperparameters
from pharos.agents.batched import BatchRun, ObservationSource, make_batch
from pharos.environments import make
from pharos.training import Task, evaluate_agent

CHANCES = ({}, {"random": 0.1}, {"sticky": 0.25})
SPACES = {
    "dqn": {
        "learning_rate": ("log", 5e-5, 1e-3),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "target_update_interval": ("one of", 250, 1000, 4000),
        "exploration_fraction": ("linear", 0.05, 0.4),
        "exploration_final_eps": ("log", 0.001, 0.05),
        "learning_starts": ("one of", 1000, 5000),
    },
    "ppo": {
        "learning_rate": ("log", 1e-4, 3e-3),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "gae_lambda": ("linear", 0.8, 1.0),
        "ent_coef": ("log", 1e-4, 0.1),
        "clip_range": ("one of", 0.1, 0.2, 0.3),
    },
}


def trained(agent, tasks, sets, steps, seeds):
    """(one mean return of the second half, one exact value without chance) for each set, task and seed."""
    source = ObservationSource.of(tasks[0].space, tasks[0].observer.observe)
    places = [(i, j, seed) for i in range(len(sets)) for j in range(len(tasks)) for seed in seeds]
    runs = [
        BatchRun(tasks[j].mdp, source, tasks[j].time_limit, sets[i], steps, seed, (i << 40) + (j << 32) + seed)
        for i, j, seed in places
    ]
    batch = make_batch(agent, runs)
    half = {}

    def at_point(point):
        half.setdefault("episodes", batch.episodes.copy())
        half.setdefault("returns", batch.returns.copy())

    batch.learn([steps // 2, steps], at_point)
    shape = (len(sets), len(tasks), len(seeds))
    means = (batch.returns - half["returns"]) / np.maximum(batch.episodes - half["episodes"], 1)
    values = [
        evaluate_agent(batch.policy(k), tasks[j], deterministic=True).value
        for k, (_, j, _) in enumerate(places)
        if j == 0
    ]
    return means.reshape(shape), np.array(values).reshape(shape[0], shape[2])


def named_values(text):
    """{"gamma": 0.99, "n_steps": 5} of "gamma=0.99,n_steps=5"."""
    return {name: json.loads(value) for name, value in (each.split("=") for each in text.split(",") if each)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("instance")
    parser.add_argument("parameters", nargs="*")
    parser.add_argument("--agent", default="dqn")
    parser.add_argument("--observation", default="vector")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--sets", type=int, default=10)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1000])
    parser.add_argument("--group", action="append", default=[], help="hyperparameters of a group: NAME=VALUE,...")
    parser.add_argument("--set", action="append", default=[], help="a set beside those drawn: NAME=VALUE,...")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    parameters = dict(each.split("=") for each in arguments.parameters)
    environment = make(arguments.instance, **{name: json.loads(text) for name, text in parameters.items()})
    tasks = [Task.of(environment, observation=arguments.observation, **chance) for chance in CHANCES]
    table = hyperparameters(arguments.agent, environment.name, arguments.observation)
    config = {
        "agent": arguments.agent,
        "instances": [{"environment": environment.name, "parameters": environment.parameters}],
        "observation": arguments.observation,
        "steps": arguments.steps,
        "seeds": arguments.seeds,
        "chance": list(CHANCES),
        "space": SPACES[arguments.agent],
        "method": "benchmarks/search.py: random sets; score: normalised realised regret of the second half",
    }
    found = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"config": config, "trials": []}
    best, uniform = (np.array([getattr(task.reference, name) for task in tasks]) for name in ("optimal", "uniform"))
    for number, text in enumerate(arguments.group or [""]):
        if any(trial["group"] == text for trial in found["trials"]):
            continue
        own = named_values(text)
        rng = np.random.default_rng(number)
        drawn = [drawn_set(rng, SPACES[arguments.agent], 3) for _ in range(arguments.sets - 1)]
        given = [{}, *map(named_values, arguments.set), *drawn]
        began = time.process_time()
        means, values = trained(
            arguments.agent, tasks, [{**table, **own, **each} for each in given], arguments.steps, arguments.seeds
        )
        regret = (best[:, None] - means) / (best - uniform)[:, None]
        for i, each in enumerate(given):
            trial = {
                "group": text,
                "hyperparameters": {**own, **each},
                "score": float(regret[i].mean()),
                "scores": regret[i].mean(axis=1).tolist(),
                "returns": means[i].mean(axis=1).tolist(),
                "values": values[i].tolist(),
                "seconds": (time.process_time() - began) / len(given),
            }
            found["trials"].append(trial)
            print(
                f"{trial['score']:.3f} {np.round(trial['returns'], 2)} {values[i]} {trial['hyperparameters']}",
                flush=True,
            )
        found["optimal"], found["uniform"] = best.tolist(), uniform.tolist()
        arguments.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
