"""Steps per second: native vector environments beside Gymnasium's SyncVectorEnv, single environments beside FrozenLake.

python benchmarks/stepping.py [--seconds S]
"""

import argparse
import time

import gymnasium
import numpy as np

import pharos
from pharos.interaction import make_vec

NUM_ENVS = 1024


def steps_per_second_of_vector(env, seconds):
    """Random actions, drawn beforehand."""
    actions = np.random.default_rng(0).integers(env.single_action_space.n, size=(64, env.num_envs))
    env.reset(seed=0)
    env.step(actions[0])
    return _rate(lambda k: env.step(actions[k % 64]), seconds) * env.num_envs


def steps_per_second_of_one(env, seconds):
    """Random actions, drawn beforehand, with resets at the ends of episodes, in a loop that does nothing else."""
    actions = np.random.default_rng(0).integers(env.action_space.n, size=4096).tolist()
    env.reset(seed=0)
    env.step(actions[0])
    env.reset()
    step, reset, rounds = env.step, env.reset, 0
    began = time.perf_counter()
    while time.perf_counter() - began < seconds:
        for action in actions:
            _, _, terminated, truncated, _ = step(action)
            if terminated or truncated:
                reset()
        rounds += 1
    return rounds * len(actions) / (time.perf_counter() - began)


def _rate(step, seconds):
    steps, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds:
        for _ in range(32):
            step(steps)
            steps += 1
    return steps / (time.perf_counter() - began)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0, help="measured for each row")
    seconds = parser.parse_args().seconds
    lake = pharos.make("frozen_lake")
    space = pharos.build(lake)
    games = [("breakout", {}), ("freeway", {"num_cars": 16, "lane_length": 7})]
    sync = gymnasium.make_vec("FrozenLake-v1", num_envs=NUM_ENVS, vectorization_mode="sync")
    rows = [
        ("Gymnasium's FrozenLake, SyncVectorEnv", steps_per_second_of_vector(sync, seconds)),
        ("frozen_lake", steps_per_second_of_vector(make_vec(lake, NUM_ENVS), seconds)),
        ("frozen_lake, random 2/3", steps_per_second_of_vector(make_vec(lake, NUM_ENVS, random=2 / 3), seconds)),
        ("frozen_lake, walking its table", steps_per_second_of_vector(make_vec(lake, NUM_ENVS, space=space), seconds)),
        (
            "frozen_lake, walking its table, index",
            steps_per_second_of_vector(make_vec(lake, NUM_ENVS, space=space, observation="index"), seconds),
        ),
    ]
    for name, parameters in games:
        for observation in ("vector", "simple_image"):
            vec = make_vec(name, NUM_ENVS, observation=observation, sticky=0.25, **parameters)
            rows.append((f"{name}, {observation}, sticky 0.25", steps_per_second_of_vector(vec, seconds)))
    print(f"{NUM_ENVS} environments: million steps/s, times the first row")
    for label, rate in rows:
        print(f"  {label:45} {rate / 1e6:8.3f} {rate / rows[0][1]:8.1f}x")
    rows = [
        ("Gymnasium's FrozenLake, gymnasium.make", steps_per_second_of_one(gymnasium.make("FrozenLake-v1"), seconds)),
        ("frozen_lake", steps_per_second_of_one(gymnasium.make("pharos/FrozenLake-v0"), seconds)),
        ("breakout", steps_per_second_of_one(gymnasium.make("pharos/Breakout-v0"), seconds)),
    ]
    print("one environment: thousand steps/s, times the first row")
    for label, rate in rows:
        print(f"  {label:45} {rate / 1e3:8.1f} {rate / rows[0][1]:8.1f}x")


if __name__ == "__main__":
    main()
