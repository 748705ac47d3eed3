"""A batched engine that learns nothing: what a run does is a function of its key and step, as the real one promises.

MOST is how many runs memory has room for; a run with the learning rate BROKEN ends the program that it is in.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

MOST = 1000
BROKEN = 0.666
OWN_OPTIONS = ()
"""Hyperparameters that only this engine has: none."""
made: list[int] = []
"""How many runs each batch had."""


class ObservationSource:
    def __init__(self, space, observe):
        self.space, self.observe, self.shape = space, observe, observe.space.shape

    @staticmethod
    def of(space, observe):
        return ObservationSource(space, observe)


@dataclass(frozen=True)
class BatchRun:
    mdp: Any
    observe: Any
    time_limit: int
    hyperparameters: dict
    steps: int
    seed: int
    key: int
    gamma: float
    outcome_rewards: Any = None
    chance: Any = None
    staying: Any = None

    @property
    def shape(self):
        return SimpleNamespace(shape=self.observe.shape)


def supports(agent, hyperparameters):
    return "it has no hyperparameter 'optimize_memory_usage'" if "optimize_memory_usage" in hyperparameters else None


def group_key(agent, run, device="cpu"):
    return (run.shape.shape, run.hyperparameters["batch_size"])


def make_batch(agent, runs, *, device="cpu", threads=None):
    made.append(len(runs))
    if len(runs) > MOST:
        raise MemoryError
    return Batch(runs)


class Batch:
    def __init__(self, runs):
        self.runs, self.steps = runs, 0
        self.walk = np.zeros((len(runs), 3))
        self.episodes, self.returns = np.zeros(len(runs), np.int64), np.zeros(len(runs))

    def learn(self, points, at_point):
        for point in points:
            if any(run.hyperparameters["learning_rate"] == BROKEN for run in self.runs):
                raise RuntimeError("this run is broken")
            for i, run in enumerate(self.runs):
                for step in range(self.steps, point):
                    self.walk[i] += np.random.default_rng((run.key, step)).normal(size=3)
                self.episodes[i] += (point - self.steps) // 10
                self.returns[i] += self.walk[i, 0]
            self.steps = point
            at_point(point)

    def policy(self, i):
        return Policy(self.runs[i].mdp.num_actions, int(abs(self.walk[i, 0]) * 100))

    def greedy_actions(self, indices):
        return None  # they are asked about observations

    def best_actions(self, states):
        actions = []
        for i, source in enumerate(run.observe for run in self.runs):
            seen = source.observe.observation(source.space.states(states[i : i + 1]))
            actions.append(self.policy(i).action_probabilities(seen).argmax())
        return np.array(actions)

    def state(self):
        return {
            "steps": np.array(self.steps),
            "walk": self.walk,
            "episodes": self.episodes,
            "returns": self.returns,
        }

    def restore(self, state):
        self.steps = int(state["steps"])
        self.walk, self.episodes, self.returns = (state[name].copy() for name in ("walk", "episodes", "returns"))

    def parameters(self, i):
        return {"walk": self.walk[i]}


class Policy:
    def __init__(self, num_actions, number):
        self.num_actions, self.number = num_actions, number

    def action_probabilities(self, observations):
        seen = np.round(observations.reshape(len(observations), -1).sum(axis=1) * 7).astype(int)
        return np.eye(self.num_actions)[(seen + self.number) % self.num_actions]
