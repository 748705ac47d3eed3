"""How fast is training, and which share of it is the environment's? Beside CartPole of Gymnasium in the same run.

    python benchmarks/training.py [--steps N] [--repeats R] [INSTANCE ...]

Prints, for DQN of Stable-Baselines3 with the hyperparameters and the network of pharos: steps/s, and the share of the
wall time that steps and resets of the environment take, observation and chance included; for CartPole-v1 the same with
the same hyperparameters. Rounds go through all of them in turn, so that a busy machine slows all alike; medians over
rounds. Then steps/s of tabular Q-learning.
"""

import argparse
import statistics
import time

import gymnasium
from stable_baselines3.common.vec_env import DummyVecEnv

import pharos
from pharos.agents import QLearning, hyperparameters
from pharos.agents.sb3 import make_model
from pharos.training import Task

INSTANCES = ("simple_grid/8x8-plain", "frozen_lake/8x8", "freeway/16x7-speed1", "breakout/12x8x1")
OBSERVATIONS = ("vector", "simple_image")


class Timed(gymnasium.Wrapper):
    """Counts the seconds in steps and resets."""

    seconds = 0.0

    def step(self, action):
        began = time.perf_counter()
        found = self.env.step(action)
        self.seconds += time.perf_counter() - began
        return found

    def reset(self, **options):
        began = time.perf_counter()
        found = self.env.reset(**options)
        self.seconds += time.perf_counter() - began
        return found


def trained(env: gymnasium.Env, options, steps: int) -> tuple[float, float]:
    """(steps/s, share of the environment) of DQN."""
    clock = Timed(env)
    model = make_model("dqn", DummyVecEnv([lambda: clock]), options, seed=0)
    model.learn(options["learning_starts"] + 200)  # first updates load much
    clock.seconds, began = 0.0, time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    total = time.perf_counter() - began
    return steps / total, clock.seconds / total


def contestants(instances):
    """(name, function that makes the environment, hyperparameters) of everything that is compared."""
    for instance in instances:
        env = pharos.make(instance)
        for observation in OBSERVATIONS:
            task = Task(env, observation=observation)
            options = {**hyperparameters("dqn", env.name, observation), **COMMON}
            yield f"{instance} {observation}", lambda task=task: pharos.GymEnv(task.env, **task.interaction), options
    options = {**hyperparameters("dqn", "simple_grid", "vector"), **COMMON}
    yield "CartPole-v1", lambda: gymnasium.make("CartPole-v1"), options


COMMON = {
    "buffer_size": 20_000,
    "learning_starts": 500,
    "train_freq": 4,
    "gradient_steps": 1,
    "n_steps": 1,
    "batch_size": 64,
    "learning_rate": 0.0005,
}
"""The same work of the agent everywhere."""


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words.add_argument("instances", nargs="*", default=INSTANCES, metavar="INSTANCE")
    words.add_argument("--steps", type=int, default=8_000)
    words.add_argument("--repeats", type=int, default=3)
    given = words.parse_args()

    compared = list(contestants(given.instances))
    found: dict[str, list[tuple[float, float]]] = {name: [] for name, _, _ in compared}
    for _ in range(given.repeats):
        for name, make_env, options in compared:
            found[name].append(trained(make_env(), options, given.steps))
    speed = {name: statistics.median(each[0] for each in runs) for name, runs in found.items()}
    print(f"DQN, one update of 64 for 4 steps, medians of {given.repeats} rounds of {given.steps:,} steps")
    print(f"{'':40}{'steps/s':>10}{'of CartPole':>14}{'environment':>14}")
    for name, runs in found.items():
        share = statistics.median(each[1] for each in runs)
        print(f"{name:40}{speed[name]:10,.0f}{speed[name] / speed['CartPole-v1']:14.2f}{share:14.1%}")

    for instance in given.instances:
        mdp = Task(pharos.make(instance)).mdp
        agent = QLearning(mdp, total_steps=10_000_000, **hyperparameters("q_learning", instance.split("/")[0], "index"))
        agent.learn(1000)
        rates = []
        for _ in range(given.repeats):
            began = time.perf_counter()
            agent.learn(2_000_000)
            rates.append(2e6 / (time.perf_counter() - began))
        print(f"Q-learning, {instance}: {statistics.median(rates) / 1e6:.1f} million steps/s")


if __name__ == "__main__":
    main()
