"""Loaded once by the process from which runs of agents are forked: a run then starts in milliseconds.

Everything that a run imports, and a run of a few steps, which loads compiled code and what PyTorch loads late. One
thread only, by the variables with which it is started: a process with threads must not be forked.
"""

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator

import gymnasium
import numpy as np

from pharos.benchmark import agents  # noqa: F401  (what runs begin with)
from pharos.benchmark.suite import BenchmarkTask, Protocol
from pharos.training import generated_curve

LAKE = BenchmarkTask("lake", "frozen_lake", {"size": 4}, chance={"random": 0.1})


def _learn(env: gymnasium.Env, steps: int, seed: int) -> Iterator[object]:
    env.reset(seed=seed)
    for _ in range(steps):
        env.step(0)
    yield lambda observations: np.zeros(len(observations), int)


def _train() -> None:
    import torch

    torch.set_num_threads(1)
    network = torch.nn.Linear(1, 1)
    optimizer = torch.optim.Adam(network.parameters())
    network(torch.zeros(1, 1)).sum().backward()
    optimizer.step()


def _is_single() -> bool:
    return os.environ.get("NUMBA_NUM_THREADS") == os.environ.get("OMP_NUM_THREADS") == "1"


with warnings.catch_warnings(), contextlib.suppress(Exception):
    warnings.simplefilter("ignore")
    if _is_single():
        generated_curve(_learn, LAKE.training_task(Protocol()), steps=4, evaluations=2, seed=0)  # type: ignore[arg-type]
        if "torch" in sys.modules:
            _train()
