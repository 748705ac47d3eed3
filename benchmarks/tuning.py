"""Hyperparameters of DQN and PPO for a class of environments: drawn at random, and compared as one batched program.

    python benchmarks/tuning.py taxi --agent dqn --steps 100000 --shape n_envs=8,train_freq=1,n_steps=5
    python benchmarks/tuning.py taxi --agent dqn --check gamma=0.9,learning_rate=0.002

Where `pharos tune` asks Optuna for one trial after the other, this fills the lanes of the batched engine: candidates
with the same shapes share a program. The first candidate is what the table says. A trial's score is the mean normalised
regret of the evaluations after the first, over the seeds 1000, 1001, ...; `last` that of the last evaluation. It is
written as `pharos tune` writes its record, AGENT-CLASS-OBSERVATION.json. `--check NAME=VALUE,...` compares the table
with other values on seeds 0 to 4, and writes nothing.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

import pharos
from drawing import drawn_set
from pharos import training
from pharos.agents import hyperparameters as hyperparameters_of

SPACES = {
    "dqn": {
        "learning_rate": ("log", 0.0003, 0.004),
        "gamma": ("one of", 0.9, 0.95, 0.99, 1.0),
        "target_update_interval": ("one of", 100, 250, 1000),
        "learning_starts": ("one of", 1000, 2000),
        "exploration_fraction": ("linear", 0.1, 0.8),
        "exploration_final_eps": ("linear", 0.01, 0.1),
    },
    "ppo": {
        "learning_rate": ("log", 0.0003, 0.004),
        "gamma": ("one of", 0.9, 0.95, 0.99, 1.0),
        "gae_lambda": ("one of", 0.8, 0.9, 0.95, 1.0),
        "ent_coef": ("log", 0.001, 0.1),
        "clip_range": ("one of", 0.1, 0.2, 0.3),
    },
}
EVALUATIONS = 10
"""Of a run."""


def candidates_of(agent, environment, observation, number, seed, shapes):
    """`number` candidates of each of some shapes; the first one is the table."""
    rng = np.random.default_rng(seed)
    table = hyperparameters_of(agent, environment, observation)
    candidates = []
    for shape in shapes:
        drawn = [drawn_set(rng, SPACES[agent], 2) for _ in range(number)]
        candidates += [{**table, **shape, **each} for each in drawn]
    return [table, *candidates[1:]] if not shapes[0] else [{**table, **shapes[0]}, *candidates[1:]]


def read(words):
    """`["gamma=0.9,n_steps=3"]` -> `[{"gamma": 0.9, "n_steps": 3}]`"""
    return [{name: value_of(value) for name, value in (part.split("=") for part in each.split(","))} for each in words]


def compare(agent, tasks, candidates, seeds, steps):
    """For each candidate: normalised regrets (runs, evaluations) and final values (runs,) of all tasks and seeds."""
    configs = []
    for given in candidates:
        for task in tasks:
            for seed in seeds:
                configs.append(
                    training.RunConfig.of_task(
                        task,
                        agent,
                        steps=steps,
                        seed=seed,
                        evaluation_interval=steps // EVALUATIONS,
                        hyperparameters=given,
                        engine="batched",
                    )
                )
    ends = training.train_configs(configs)
    regrets, finals = [], []
    for end in ends:
        if not hasattr(end, "curve"):
            raise end.exception
        regrets.append([row["normalized_regret"] for row in end.curve[1:]])
        finals.append(end.result["final_value"])
    shape = (len(candidates), len(tasks) * len(seeds))
    return np.array(regrets).reshape(*shape, -1), np.array(finals).reshape(shape), ends[0].result


def value_of(text):
    try:
        return json.loads(text)
    except ValueError:
        return text


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("environment", help="name of a class")
    parser.add_argument("--instance", action="append", help="its name, or {name: value, ...}; default: the class's own")
    parser.add_argument("--chance", action="append", help="plain, or random=P or sticky=P; default: plain")
    parser.add_argument("--agent", default="dqn", choices=SPACES)
    parser.add_argument("--observation", default="vector")
    parser.add_argument("--steps", type=int, default=20000)
    parser.add_argument("--candidates", type=int, default=16, help="for each of the shapes, the table included")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--search-seed", type=int, default=0)
    parser.add_argument(
        "--shape", action="append", help="NAME=VALUE,... that all candidates have: a program of its own"
    )
    parser.add_argument(
        "--search", action="append", default=[], help="NAME=KIND,VALUE,...: instead of what SPACES says"
    )
    parser.add_argument("--check", action="append", help="a candidate, NAME=VALUE,...; no search, seeds 0 to 4")
    parser.add_argument("--out", type=Path, default=Path("docs/tuning"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    for name, choices in (words.split("=") for words in given.search):
        SPACES[given.agent][name] = tuple(
            value_of(choice.replace("one of", '"one of"')) for choice in choices.split(",")
        )
    named = [value_of(each) for each in given.instance or [given.environment]]
    envs = [pharos.make(given.environment, **each) if isinstance(each, dict) else pharos.make(each) for each in named]
    chances = [{} if each == "plain" else read([each])[0] for each in given.chance or ["plain"]]
    tasks = [training.Task(env, observation=given.observation, **chance) for env in envs for chance in chances]
    table = hyperparameters_of(given.agent, given.environment, given.observation)
    if given.check:
        candidates, seeds = [table, *({**table, **each} for each in read(given.check))], list(range(5))
    else:
        shapes = read(given.shape) if given.shape else [{}]
        candidates = candidates_of(
            given.agent, given.environment, given.observation, given.candidates, given.search_seed, shapes
        )
        seeds = list(range(1000, 1000 + given.seeds))
    began, processor = time.perf_counter(), time.process_time()
    regrets, finals, one = compare(given.agent, tasks, candidates, seeds, given.steps)
    took, used = time.perf_counter() - began, time.process_time() - processor
    scores, last = regrets.mean((1, 2)), regrets[:, :, -1].mean(1)
    values = f"V* {one['value_optimal']:.4g}, uniform {one['value_uniform']:.4g}"
    print(f"{', '.join(map(str, envs))}, {given.agent}: {values}; {took:.0f} s, {used:.0f} s of processor time")
    for i in [0, *[int(i) for i in np.argsort(scores) if i][:5]]:
        changed = (
            {name: value for name, value in candidates[i].items() if table.get(name) != value}
            if i
            else f"the table {given.shape or ''}"
        )
        print(f"  {scores[i]:.4f} last {last[i]:.4f} final {np.round(finals[i], 3).tolist()} {changed}", flush=True)
    if given.check:
        return
    trials = [
        {"number": i, "hyperparameters": each, "score": float(scores[i]), "last": float(last[i]), "status": "finished"}
        for i, each in enumerate(candidates)
    ]
    best = int(scores.argmin())
    record = {
        "format": 1,
        "config": {
            "agent": given.agent,
            "instances": [{"environment": env.name, "parameters": env.parameters} for env in envs],
            "observation": given.observation,
            "steps": given.steps,
            "seeds": seeds,
            "chance": chances,
            "space": {name: list(choices) for name, choices in SPACES[given.agent].items()},
            "shapes": shapes,
            "search_seed": given.search_seed,
            "engine": "batched",
        },
        "versions": training.results.versions() if hasattr(training, "results") else {},
        "seconds": round(used, 1),
        "trials": trials,
        "best": {"trial": best, "score": float(scores[best]), "hyperparameters": candidates[best]},
    }
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / f"{given.agent}-{given.environment}-{given.observation}.json"
    path.write_text(json.dumps(record, indent=1, default=list) + "\n")


if __name__ == "__main__":
    main()
