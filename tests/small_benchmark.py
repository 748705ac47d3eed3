"""A suite of three core tasks and one ladder, without worlds, and results on it."""

import numpy as np

from pharos.benchmark import AgentResults
from pharos.benchmark.suite import BenchmarkTask, Ladder, Protocol, Suite

DIGEST = "ab" * 32
CORE = ("core-a", "core-b", "core-c")
LEVELS = (1.0, 2.0, 4.0, 8.0)
RUNGS = tuple(f"noise-{level:g}" for level in LEVELS)


def small_suite(digest=DIGEST, core=CORE, rungs=RUNGS):
    levels = zip(rungs, LEVELS, strict=True)
    ladder = tuple(BenchmarkTask(name, "", axis="noise", level=level) for name, level in levels)
    tasks = tuple(BenchmarkTask(name, "") for name in core)
    return Suite("small", Protocol(), tasks, (Ladder("noise", "sd", "of rewards", ladder),), digest)


def results(curves, agent="agent", digest=DIGEST, evaluations=3):
    """Results from task -> regrets, one for each seed (the same at every evaluation) or (seeds, evaluations)."""
    arrays = {name: np.asarray(own, float) for name, own in curves.items()}
    arrays = {name: own if own.ndim == 2 else np.repeat(own[:, None], evaluations, 1) for name, own in arrays.items()}
    seeds = len(next(iter(arrays.values())))
    return AgentResults(agent, "small", digest, tuple(range(seeds)), arrays)


def constant(regret, seeds=10, **options):
    """Results of runs that all have this regret on every task."""
    return results({name: np.full(seeds, regret) for name in (*CORE, *RUNGS)}, **options)


def drawn(seed=0, seeds=10, worse=0.0, tasks=(*CORE, *RUNGS), **options):
    """Results of runs that vary: regret rises along the ladder, some runs are below random and some optimal."""
    rng = np.random.default_rng(seed)
    middle = dict(zip((*CORE, *RUNGS), (0.2, 0.5, 0.9, 0.1, 0.3, 0.6, 0.9), strict=True))
    return results({name: rng.normal(middle[name] + worse, 0.15, (seeds, 5)) for name in tasks}, **options)
