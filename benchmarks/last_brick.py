"""Why DQN's returns stop at all bricks but the last: how the greedy walk of trained agents ends, by what is changed.

    python benchmarks/last_brick.py --out docs/studies/last-brick.json

Trains DQN with vectors on `breakout/12x8x3` without chance, three seeds a variant, as one program where shapes agree;
variants change the table's hyperparameters. Then the greedy policy walks from the start until a state comes again
(without chance it circles there until the episode's limit), until the ball is missed, or until the limit.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from pharos.agents import hyperparameters
from pharos.agents.batched import BatchRun, ObservationSource, make_batch
from pharos.environments import make
from pharos.observations import observe as observation_of
from pharos.training import Task

INSTANCE = "breakout/12x8x3"
VARIANTS = {
    "the table's": {},
    "explores with 0.02 in the end": {"exploration_final_eps": 0.02},
    "explores with 0.1 in the end": {"exploration_final_eps": 0.1},
    "explores over half of the steps": {"exploration_fraction": 0.5},
    "copies the target every 10,000 steps": {"target_update_interval": 10_000},
    "discounts by 0.99": {"gamma": 0.99},
    "discounts by 0.997": {"gamma": 0.997},
    "0.99, and explores with 0.05 in the end": {"gamma": 0.99, "exploration_final_eps": 0.05},
    "keeps all transitions": {"buffer_size": 600_000},
    "returns of one step": {"n_steps": 1},
    "two layers of 256": {"net_arch": [256, 256]},
}
APART = ("buffer_size", "n_steps", "net_arch")  # what all runs of a program have in common


def walk(env, observe, policy, limit):
    """Return, steps and end of the greedy walk, and the bricks that are left."""
    state, seen, rewards = np.asarray(env.initial_state()), {}, 0.0
    for step in range(limit):
        if tuple(state) in seen:
            return rewards, step, f"circles in {step - seen[tuple(state)]} steps", int(np.sum(state[5:]))
        seen[tuple(state)] = step
        action = int(np.argmax(policy.action_probabilities(observe(state[None]))[0]))
        following = np.asarray(env.next_state(state, action))
        rewards += env.reward(state, action, following)
        state = following
        if env.is_terminal(state):
            return rewards, step + 1, "misses the ball", int(np.sum(state[5:]))
    return rewards, limit, "limit", int(np.sum(state[5:]))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=600_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 101, 102])
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    found = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    env = make(INSTANCE)
    task = Task.of(env, observation="vector")
    observe = observation_of(env, "vector")
    source = ObservationSource.of(task.space, task.observer.observe)
    table = hyperparameters("dqn", env.name, "vector")
    groups = {}
    for name, change in VARIANTS.items():
        if name not in found:
            groups.setdefault(str({key: change.get(key) for key in APART}), []).append(name)
    for names in groups.values():
        places = [(name, seed) for name in names for seed in arguments.seeds]
        runs = [
            BatchRun(task.mdp, source, task.time_limit, {**table, **VARIANTS[name]}, arguments.steps, seed, seed)
            for name, seed in places
        ]
        batch, late, began = make_batch("dqn", runs), {}, time.process_time()

        def at_point(point, batch=batch, late=late):
            late.setdefault("episodes", batch.episodes.copy())
            late.setdefault("returns", batch.returns.copy())

        batch.learn([arguments.steps * 9 // 10, arguments.steps], at_point)
        means = (batch.returns - late["returns"]) / np.maximum(batch.episodes - late["episodes"], 1)
        for k, (name, seed) in enumerate(places):
            greedy, steps, end, left = walk(env, observe, batch.policy(k), task.time_limit)
            row = {"seed": seed, "return": float(means[k]), "greedy": greedy, "steps": steps, "end": end, "left": left}
            found.setdefault(name, []).append(row)
            print(f"{name}, seed {seed}: {means[k]:.1f} in training; greedy {greedy:g}, {end}, {left} left", flush=True)
        print(f"{(time.process_time() - began) / len(runs):.0f} processor s a run", flush=True)
        arguments.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
